"""Targets without readings: experiments that name parameters only, and known densities to sample from."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Experiment, Start, ValuesBySymbol
from capsule_id.experiments.misfit import Misfit
from capsule_id.inference.curvature import jacobian
from capsule_id.inference.marginal import density_of
from capsule_id.inference.target import LogPosterior, Scale
from capsule_id.parameters import Parameter, Prior
from capsule_id.rig.model import Quantity, Rig, Settings, Table
from capsule_id.views import Comparison


def log_prior(target: LogPosterior, u: np.ndarray) -> float:
    """Normalised log prior density of u (d,), Jacobian included."""
    return float(jnp.sum(target.priors.terms(u, target.constrain(u))))


def log_likelihood(target: LogPosterior, u: np.ndarray) -> float:
    """Log-posterior of u (d,) without the priors, by the compiled program of the fit."""
    return float(density_of(target)(np.asarray(u)[None])[0]) - log_prior(target, u)


def log_posterior(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(w,) log-posterior of u (w, d) up to the evidence: every experiment alone, in NumPy."""
    values = [target.mapping(target.theta(one)) for one in u]
    parts = [sum(float(e.log_likelihood(e.local(one), np)) for e in target.experiments) for one in values]
    return np.array([log_prior(target, one) + own for one, own in zip(u, parts, strict=True)])


def rig_without_tables(priors: Mapping[str, Prior] | None = None) -> Rig:
    return Rig("bench", True, None, None, Quantity(9.81), priors or {}, (), {}, Path("bench"))


def plain_residuals(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """Residuals (n,) as ``LogPosterior.residuals`` has them at u (d,), by NumPy without compilation."""
    values = target.mapping(target.theta(u))
    parts = [np.asarray(e.residuals(e.local(values), np)) for e in target.experiments]
    return np.concatenate([*parts, target.prior_residuals(u)])


def plain_jacobian(target: LogPosterior, u: np.ndarray) -> np.ndarray:
    """(n, located) Jacobian of ``plain_residuals`` by central differences."""
    step = 1e-5 * np.where(target.positive, 1.0, target.prior_sd)
    return jacobian(partial(plain_residuals, target), u, step)[:, target.located]


class Nothing(Experiment):
    """Names parameters and holds no reading: its posterior is the prior."""

    def __init__(self, rows: Sequence[Parameter]) -> None:
        empty = Table("nothing", "nothing", "nothing.csv", {}, Settings(), np.zeros(0, dtype=int))
        self.about = About(empty, rig_without_tables(), tuple(rows))

    @property
    def observed(self) -> np.ndarray:
        return np.zeros(0)

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        return (Misfit(xp.zeros(0), 1.0, 0.0, xp.zeros((0, 0))),)

    def starts(self) -> dict[str, Start]:
        return {}

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        raise NotImplementedError


class Gaussian:
    """A known normal density in the place of a ``MarginalPosterior``: what the sampler asks of one, and no more.

    The approximation that it offers to start from is ``OFF`` sds off and ``WIDE`` times too wide.
    """

    OFF, WIDE = 0.5, 1.3
    fingerprint = "a known normal density"
    can_be_emulated = False
    work = 1

    def __init__(self, mean: np.ndarray, sigma: np.ndarray, blocks: Sequence[np.ndarray] | None = None) -> None:
        self.mean, self.sigma = mean, sigma
        self.names = tuple(f"x{i}" for i in range(len(mean)))
        self.dimension = len(mean)
        self.blocks = [np.arange(len(mean))] if blocks is None else list(blocks)
        self.precisions = [np.linalg.inv(sigma[np.ix_(block, block)]) for block in self.blocks]
        self.centre = mean + self.OFF * np.sqrt(np.diag(sigma))
        self.covariance = self.WIDE**2 * sigma
        self.normal_priors = np.full((2, len(mean)), np.nan)
        self.scaled = list[Scale]()
        self.event_driven = [True] * len(self.blocks)

    def parts(self, v: np.ndarray) -> np.ndarray:
        """(w, d) -> (w, blocks)."""
        d = v - self.mean
        pairs = zip(self.blocks, self.precisions, strict=True)
        return np.stack([-0.5 * np.einsum("wi,ij,wj->w", d[:, b], p, d[:, b]) for b, p in pairs], axis=1)

    def motions(self, v: np.ndarray) -> list[np.ndarray]:
        return [self.parts(v)]

    def emulated(self, v: np.ndarray, motions: list[np.ndarray]) -> "Gaussian":
        raise NotImplementedError

    def factors(self, v: np.ndarray) -> np.ndarray:
        """Nothing was integrated out: only the parts are kept."""
        return self.parts(v)[..., None]

    def whole(self, located: np.ndarray, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return located, np.sum(factors[..., 0], axis=-1)

    def theta(self, u: np.ndarray) -> np.ndarray:
        return u
