"""The joint log-posterior of all experiments in an unconstrained space.

u = log(theta) for positive parameters, theta otherwise. log p(u | data) = sum of log-likelihoods + log prior density
of theta + log |d theta / du|: natural and normalised, linear nuisances integrated out.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import stats
from scipy.sparse.csgraph import connected_components

from capsule_id.experiments.base import Experiment, Start
from capsule_id.inference.target import density
from capsule_id.parameters import QUANTILE_975, Parameter, Prior, parameter
from capsule_id.rig.model import PriorOverride, Rig

#: Starts from a prior alone are dispersed by no more than this, natural-log units.
WIDEST_START = 0.3


class LogPosterior:
    """Experiments and priors, joined.

    Attributes
    ----------
    parameters : (d,) sampled parameters, masses first, then in the order in which experiments name them
    names : (d,)
    fixed : constants by name: g and the masses stated without an sd
    """

    def __init__(self, rig: Rig, experiments: Sequence[Experiment]) -> None:
        self.rig, self.experiments = rig, tuple(experiments)
        self.fixed: dict[str, float] = {"g": rig.g.value}
        rows: dict[str, Parameter] = {}
        for symbol, mass in (("m1", rig.m1), ("m2", rig.m2)):
            if mass is not None and mass.sd > 0.0:
                rows[symbol] = parameter(symbol, prior=Prior("positive_normal", mass.value, mass.sd))
            elif mass is not None:
                self.fixed[symbol] = mass.value
        for experiment in self.experiments:
            for row in experiment.parameters:
                rows.setdefault(row.name, _override(row, rig.priors.get(row.name)))
        self.parameters = tuple(rows.values())
        self.names = tuple(rows)
        groups, self._arrays = density.make_groups(self.experiments, self.names, self.fixed)
        self.structure = density.Structure(self.names, tuple(row.positive for row in self.parameters), groups)

    @property
    def dimension(self) -> int:
        return len(self.names)

    @property
    def positive(self) -> np.ndarray:
        """(d,) which parameters are sampled through their logarithm."""
        return np.array(self.structure.positive)

    @cached_property
    def scatter(self) -> np.ndarray:
        """(d,) which parameters are standard deviations: they scale residuals, they move no prediction."""
        return np.array([row.scatter for row in self.parameters])

    @cached_property
    def priors(self) -> dict[str, np.ndarray]:
        """Kinds and numbers of the priors as arrays, so that the density is one expression."""
        priors = [_prior(row) for row in self.parameters]
        kinds = np.array([prior.kind for prior in priors])
        location = np.array([prior.location for prior in priors])
        spread = np.array([prior.spread for prior in priors])
        lognormal = kinds == "lognormal"
        with np.errstate(divide="ignore", invalid="ignore"):
            # The log-normal is a normal density of u; the others are normal densities of theta.
            centre = np.where(lognormal, np.log(location), location)
            width = np.where(lognormal, np.log(spread) / QUANTILE_975, spread)
        mass = np.where(kinds == "positive_normal", location / spread, 0.0)
        constant = np.where(kinds == "halfnormal", np.log(2.0), 0.0)
        constant = constant - np.where(kinds == "positive_normal", stats.norm.logcdf(mass), 0.0)
        jacobian = self.positive & ~lognormal
        return {
            "lognormal": lognormal, "centre": centre, "width": width, "constant": constant, "jacobian": jacobian,
        }  # fmt: skip

    @cached_property
    def prior_sd(self) -> np.ndarray:
        """(d,) sd of u under the prior (half-normal: of its logarithm, pi/sqrt(8))."""
        kinds = np.array([_prior(row).kind for row in self.parameters])
        location = np.array([_prior(row).location for row in self.parameters])
        width = self.priors["width"]
        sd = np.where(kinds == "positive_normal", width / np.where(location == 0.0, 1.0, location), width)
        return np.where(kinds == "halfnormal", np.pi / np.sqrt(8.0), sd)

    def theta(self, u: np.ndarray) -> np.ndarray:
        """(..., d) constrained values from u (..., d), NumPy."""
        return density.constrain(self.structure, u, np)

    def unconstrain(self, theta: np.ndarray) -> np.ndarray:
        """(..., d) u from constrained values (..., d), NumPy."""
        return np.where(self.positive, np.log(np.where(self.positive, theta, 1.0)), theta)

    def mapping(self, theta: np.ndarray) -> dict[str, float]:
        """Constrained values (d,) by name, constants included."""
        return {**self.fixed, **dict(zip(self.names, (float(v) for v in theta), strict=True))}

    @cached_property
    def blocks(self) -> list[np.ndarray]:
        """Indices of parameters that some experiment ties together: between blocks the posterior is a product."""
        adjacent = np.eye(self.dimension, dtype=bool)
        for experiment in self.experiments:
            own = {row.name for row in experiment.parameters} | set(experiment.masses)
            member = np.array([name in own for name in self.names])
            adjacent |= np.outer(member, member)
        count, label = connected_components(adjacent, directed=False)
        return [np.flatnonzero(label == i) for i in range(count)]

    @cached_property
    def numbers(self) -> dict[str, Any]:
        """Readings, priors and constants, on the device."""
        prior = {name: jnp.asarray(value) for name, value in self.priors.items()}
        fixed = {name: jnp.asarray(value) for name, value in self.fixed.items()}
        return {"arrays": self._arrays, "prior": prior, "fixed": fixed}

    def log_prior(self, u: Any) -> Any:
        """Normalised log prior density of u (d,), Jacobian included; scalar."""
        return density.log_prior(self.structure, self.numbers, u)

    def log_likelihood(self, u: Any) -> Any:
        """Sum over the experiments at u (d,); scalar."""
        return density.log_likelihood(self.structure, self.numbers, u)

    def __call__(self, u: Any) -> Any:
        """log p(u | data) up to the evidence, u (d,); -inf where it is not finite (an overdamped decay)."""
        return density.log_posterior(self.structure, self.numbers, u)

    def batch(self, u: Any) -> Any:
        """Compiled, (w, d) -> (w,)."""
        return density.batched_log_posterior(self.structure, self.numbers, u)

    def residuals(self, u: Any) -> Any:
        """All experiments' residuals and the priors', (n,): the least-squares part of -log posterior."""
        return density.residuals(self.structure, self.numbers, u)

    def prior_residuals(self, u: np.ndarray) -> np.ndarray:
        """(d,) (value - centre)/width: half their sum of squares is the parameter-dependent part of -log prior."""
        return np.asarray(density.prior_residuals(self.structure, self.priors, u, np))

    def plain_residuals(self, u: np.ndarray) -> np.ndarray:
        """The same residuals as ``residuals`` in NumPy, in the order of the experiments, nothing compiled."""
        values = self.mapping(self.theta(u))
        parts = [np.asarray(e.residuals(e.local(values), np)) for e in self.experiments]
        return np.concatenate([*parts, self.prior_residuals(u)])

    def starts(self) -> Mapping[str, Start]:
        """Start of every parameter: the mean (geometric where positive) of what the experiments propose."""
        proposed: dict[str, list[Start]] = {}
        for experiment in self.experiments:
            for name, start in experiment.starts().items():
                proposed.setdefault(name, []).append(start)
        merged = {}
        for row in self.parameters:
            if row.name in proposed:
                starts = proposed[row.name]
                centres = np.array([s.centre for s in starts])
                centre = np.exp(np.mean(np.log(centres))) if row.positive else np.mean(centres)
                merged[row.name] = Start(float(centre), min(s.spread for s in starts))
            else:  # a mass: its weighing; what only runs know: the middle of its prior
                prior = _prior(row)
                spread = np.log(prior.spread) if prior.kind == "lognormal" else prior.spread / prior.location
                merged[row.name] = Start(prior.location, min(spread, WIDEST_START))
        return merged

    def sample_prior(self, rng: np.random.Generator, size: int) -> dict[str, np.ndarray]:
        """``size`` draws of every parameter, SI."""
        return {row.name: _prior(row).sample(rng, size) for row in self.parameters}


def _prior(row: Parameter) -> Prior:
    if row.prior is None:
        raise ValueError(f"parameter {row.name} has no prior: the experiment that names it must supply one")
    return row.prior


def _override(row: Parameter, override: PriorOverride | None) -> Parameter:
    """The row with the prior of ``rig.toml``, if it states one."""
    if override is None:
        return row
    if override.scale is not None:
        prior = Prior("halfnormal", 0.0, override.scale)
    else:
        assert override.median is not None, "the schema asks for median and factor"
        assert override.factor is not None, "the schema asks for median and factor"
        prior = Prior("lognormal", override.median, override.factor)
    return row.named(row.of, prior)
