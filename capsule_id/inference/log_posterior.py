"""The joint log-posterior of all experiments in an unconstrained space.

u = log(theta) for positive parameters, theta otherwise. log p(u | data) = sum of log-likelihoods + log prior density
of theta + log |d theta / du|: natural and normalised, linear nuisances integrated out.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import cached_property
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from capsule_id.experiments.base import Experiment, Start, Theta
from capsule_id.experiments.linear import LOG_2PI
from capsule_id.parameters import QUANTILE_975, Parameter, Prior, parameter
from capsule_id.rig.model import PriorOverride, Rig


class LogPosterior:
    """Experiments and priors, joined.

    Attributes
    ----------
    parameters : (d,) sampled parameters, masses first, then in the order in which experiments name them
    names : (d,)
    fixed : constants by name: g and the masses stated without an sd
    """

    def __init__(self, rig: Rig, experiments: Sequence[Experiment]) -> None:
        self.experiments = tuple(experiments)
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

    @property
    def dimension(self) -> int:
        return len(self.names)

    @cached_property
    def positive(self) -> np.ndarray:
        """(d,) which parameters are sampled through their logarithm."""
        return np.array([row.positive for row in self.parameters])

    @cached_property
    def scatter(self) -> np.ndarray:
        """(d,) which parameters are standard deviations: they scale residuals, they move no prediction."""
        return np.array([row.scatter for row in self.parameters])

    @cached_property
    def _priors(self) -> dict[str, np.ndarray]:
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
        width = self._priors["width"]
        sd = np.where(kinds == "positive_normal", width / np.where(location == 0.0, 1.0, location), width)
        return np.where(kinds == "halfnormal", np.pi / np.sqrt(8.0), sd)

    def constrain(self, u: Any) -> dict[str, Any]:
        """Parameter values by name, constants included, from u (d,)."""
        theta = jnp.where(self.positive, jnp.exp(u), u)
        return {**self.fixed, **{name: theta[i] for i, name in enumerate(self.names)}}

    def theta(self, u: np.ndarray) -> np.ndarray:
        """(..., d) constrained values from u (..., d), NumPy."""
        return np.where(self.positive, np.exp(u), u)

    def unconstrain(self, theta: np.ndarray) -> np.ndarray:
        """(..., d) u from constrained values (..., d), NumPy."""
        return np.where(self.positive, np.log(np.where(self.positive, theta, 1.0)), theta)

    def mapping(self, theta: np.ndarray) -> dict[str, float]:
        """Constrained values (d,) by name, constants included."""
        return {**self.fixed, **dict(zip(self.names, (float(v) for v in theta), strict=True))}

    def log_prior(self, u: Any) -> Any:
        """Normalised log prior density of u (d,), Jacobian included; scalar."""
        p = self._priors
        value = jnp.where(p["lognormal"] | ~self.positive, u, jnp.exp(u))
        z = (value - p["centre"]) / p["width"]
        density = -0.5 * (z**2 + LOG_2PI) - jnp.log(p["width"]) + p["constant"] + jnp.where(p["jacobian"], u, 0.0)
        return jnp.sum(density)

    def prior_residuals(self, u: Any, xp: ModuleType = jnp) -> Any:
        """(d,) (value - centre)/width: half their sum of squares is the parameter-dependent part of -log prior."""
        p = self._priors
        return (xp.where(p["lognormal"] | ~self.positive, u, xp.exp(u)) - p["centre"]) / p["width"]

    @cached_property
    def _groups(self) -> list[tuple[Experiment, ...]]:
        """Experiments that differ only in numbers, together: one traced graph for each group, however many records."""
        groups: dict[Hashable, list[Experiment]] = {}
        for experiment in self.experiments:
            groups.setdefault(experiment.signature, []).append(experiment)
        return [tuple(group) for group in groups.values()]

    def _per_group(self, function: Callable[[Experiment, Theta], Any], u: Any) -> list[Any]:
        """``function`` of every experiment, batched: one array (members, ...) per group."""
        values = self.constrain(u)
        results = []
        for group in self._groups:
            first = group[0]
            arrays = {name: np.stack([np.asarray(getattr(e, name)) for e in group]) for name in first.ARRAYS}
            local = [e.local(values) for e in group]
            theta = {name: jnp.stack([jnp.asarray(values[name]) for values in local]) for name in local[0]}
            results.append(jax.vmap(lambda a, t, first=first: function(first.with_arrays(a), t))(arrays, theta))
        return results

    def log_likelihood(self, u: Any) -> Any:
        """Sum over the experiments; scalar."""
        return sum(jnp.sum(part) for part in self._per_group(lambda e, theta: e.log_likelihood(theta), u))

    def __call__(self, u: Any) -> Any:
        """log p(u | data) up to the evidence; -inf where it is not finite (an overdamped decay)."""
        value = self.log_prior(u) + self.log_likelihood(u)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    @cached_property
    def batch(self) -> Any:
        """Jitted (w, d) -> (w,)."""
        return jax.jit(jax.vmap(self))

    def residuals(self, u: Any) -> Any:
        """All experiments' residuals and the priors', (n,): the least-squares part of -log posterior."""
        parts = self._per_group(lambda e, theta: e.residuals(theta), u)
        return jnp.concatenate([*(jnp.ravel(part) for part in parts), self.prior_residuals(u)])

    def plain_residuals(self, u: np.ndarray) -> np.ndarray:
        """The same residuals as ``residuals`` in NumPy, in the order of the experiments, nothing compiled."""
        values = self.mapping(self.theta(u))
        parts = [np.asarray(e.residuals(e.local(values), np)) for e in self.experiments]
        return np.concatenate([*parts, np.asarray(self.prior_residuals(u, np))])

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
            else:  # a mass: its weighing
                prior = _prior(row)
                merged[row.name] = Start(prior.location, prior.spread / prior.location)
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
    return parameter(row.symbol, row.of, prior)
