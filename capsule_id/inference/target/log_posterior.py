"""Joint log-posterior of all experiments in an unconstrained space.

u = log(theta) for positive parameters, theta otherwise. log p(u | data) = sum of log-likelihoods + log prior density
of theta + log |d theta / du|. All densities are natural and normalised; linear nuisances are integrated out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse.csgraph import connected_components

from capsule_id.experiments.base import Experiment, Start, ValuesBySymbol
from capsule_id.inference.target.compiling import COMPILE
from capsule_id.inference.target.groups import Group, make_groups
from capsule_id.inference.target.priors import Priors, covering_prior, override, prior_of, prior_sd
from capsule_id.inference.target.scales import Scale
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.rig.model import Rig

#: Largest dispersion of starts that come from a prior alone, natural-log units.
WIDEST_START = 0.3


@dataclass(frozen=True)
class Origin:
    """Inputs of a log-posterior that no compiled program reads; all instances compare as equal.

    Attributes
    ----------
    rig, experiments : as given
    parameters : (d,) sampled parameters, masses first, then in the order of the experiments
    fixed : constants by name: g and the masses stated without an sd
    """

    rig: Rig = field(compare=False)
    experiments: tuple[Experiment, ...] = field(compare=False)
    parameters: tuple[Parameter, ...] = field(compare=False)
    fixed: Mapping[str, float] = field(compare=False)


class LogPosterior(eqx.Module):
    """Log-posterior of experiments and priors, as a frozen tree of arrays.

    Log-posteriors of equal structure share compiled methods, for instance in a calibration study over many rigs.

    Attributes
    ----------
    names : (d,) of the sampled parameters
    groups : the experiments, stacked
    priors : of the parameters
    constants : by name, () each
    """

    origin: Origin = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    are_positive: tuple[bool, ...] = eqx.field(static=True)
    are_scatters: tuple[bool, ...] = eqx.field(static=True)
    groups: tuple[Group, ...]
    priors: Priors
    constants: dict[str, jax.Array]

    def __init__(self, rig: Rig, experiments: Sequence[Experiment]) -> None:
        fixed = {"g": rig.g.value}
        rows: dict[str, Parameter] = {}
        for symbol, mass in (("m1", rig.m1), ("m2", rig.m2)):
            if mass is not None and mass.sd > 0.0:
                rows[symbol] = parameter(symbol, prior=Prior("positive_normal", mass.value, mass.sd))
            elif mass is not None:
                fixed[symbol] = mass.value
        offered: dict[str, list[Parameter]] = {}
        for experiment in experiments:
            for row in experiment.parameters:
                offered.setdefault(row.name, []).append(row)
        for name, (row, *others) in offered.items():
            if others and name not in rig.priors:
                row = row.named(row.of, covering_prior(name, [prior_of(one) for one in (row, *others)]))
            rows.setdefault(name, override(row, rig.priors.get(name)))
        self.origin = Origin(rig, tuple(experiments), tuple(rows.values()), fixed)
        self.names = tuple(rows)
        self.are_positive = tuple(row.positive for row in rows.values())
        self.are_scatters = tuple(row.scatter for row in rows.values())
        self.groups = make_groups(experiments, self.names)
        self.priors = Priors(self.parameters)
        self.constants = {name: jnp.asarray(value) for name, value in fixed.items()}

    # -- parameters -------------------------------------------------------------------------------------------------

    @property
    def rig(self) -> Rig:
        return self.origin.rig

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        return self.origin.experiments

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.origin.parameters

    @property
    def fixed(self) -> Mapping[str, float]:
        return self.origin.fixed

    @property
    def dimension(self) -> int:
        return len(self.names)

    @property
    def positive(self) -> np.ndarray:
        """(d,) whether each parameter is sampled through its logarithm."""
        return np.array(self.are_positive, dtype=bool)

    @property
    def scatter(self) -> np.ndarray:
        """(d,) whether each parameter is a standard deviation, which scales residuals but changes no prediction."""
        return np.array(self.are_scatters, dtype=bool)

    @property
    def integrated(self) -> np.ndarray:
        """(d,) whether each parameter is the one scatter of some readings, which the sampler integrates out."""
        alone = {row.name for e in self.experiments for row in e.parameters if row.scatter and row.symbol in e.scatters}
        return np.array([name in alone for name in self.names])

    @property
    def located(self) -> np.ndarray:
        """Indices of the parameters that change a prediction."""
        return np.flatnonzero(~self.scatter)

    @property
    def scaled(self) -> list[Scale]:
        """Each scatter of which only the product with other parameters changes the motion."""
        scaled, balanced = dict[str, set[str]](), dict[str, set[str]]()
        for e in self.experiments:
            for name, own in e.scaled_by.items():
                scaled.setdefault(name, set()).update(own)
                balanced.setdefault(name, set()).update(e.balanced)

        def indices(names: set[str]) -> np.ndarray:
            return np.flatnonzero(np.isin(self.names, sorted(names)))

        return [
            Scale(self.names.index(name), indices(own), indices(balanced[name])) for name, own in scaled.items() if own
        ]

    @property
    def prior_sd(self) -> np.ndarray:
        """(d,) sd of u under the prior."""
        return np.array([prior_sd(row) for row in self.parameters])

    @property
    def blocks(self) -> list[np.ndarray]:
        """Indices of the parameters of each block; the posterior is a product over blocks without common data."""
        adjacent = np.eye(self.dimension, dtype=bool)
        for experiment in self.experiments:
            own = {row.name for row in experiment.parameters} | set(experiment.masses)
            member = np.array([name in own for name in self.names])
            adjacent |= np.outer(member, member)
        count, label = connected_components(adjacent, directed=False)
        return [np.flatnonzero(label == i) for i in range(count)]

    def constrain(self, u: Any, xp: ModuleType = jnp) -> Any:
        """(..., d) values from u (..., d)."""
        # The unused branch must stay finite: an infinite derivative makes the gradient NaN.
        return xp.where(self.positive, xp.exp(xp.where(self.positive, u, 0.0)), u)

    def theta(self, u: np.ndarray) -> np.ndarray:
        """(..., d) constrained values from u (..., d), NumPy."""
        return self.constrain(u, np)

    def unconstrain(self, theta: np.ndarray) -> np.ndarray:
        """(..., d) u from constrained values (..., d), NumPy."""
        return np.where(self.positive, np.log(np.where(self.positive, theta, 1.0)), theta)

    def mapping(self, theta: np.ndarray) -> dict[str, float]:
        """Constrained values (d,) by name, constants included."""
        return {**self.fixed, **dict(zip(self.names, (float(v) for v in theta), strict=True))}

    # -- densities and residuals --------------------------------------------------------------------------------------

    def log_prior(self, u: Any) -> Any:
        """Normalised log prior density of u (d,), Jacobian included; scalar."""
        return jnp.sum(self.priors.terms(u, self.constrain(u)))

    def log_likelihood(self, u: Any) -> Any:
        """Sum of the log-likelihoods of the experiments at u (d,); scalar."""
        return sum(jnp.sum(part) for part in self._per_group(lambda e, theta: e.log_likelihood(theta), u))

    def __call__(self, u: Any) -> Any:
        """log p(u | data) up to the evidence, u (d,); -inf where it is not finite (an overdamped decay)."""
        value = self.log_prior(u) + self.log_likelihood(u)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    def batch(self, u: Any) -> Any:
        """Compiled log-posterior of a batch, (w, d) -> (w,). Fits use ``marginal.density_of``."""
        return _batch(self, u)

    def residuals(self, u: Any) -> Any:
        """Residuals (n,) of all experiments and priors: the least-squares part of -log posterior."""
        parts = self._per_group(lambda e, theta: e.residuals(theta), u)
        return jnp.concatenate([*(jnp.ravel(part) for part in parts), self.priors.residuals(u, self.constrain(u))])

    def linearised(self, u: Any) -> tuple[Any, Any]:
        """Residuals (n,) as in ``residuals``, and their Jacobian (n, l) with respect to the l located entries of u."""
        values, located = self.constrain(u), self.located
        rates = jnp.where(self.positive, values, 1.0)

        def one(experiment: Experiment, theta: ValuesBySymbol) -> Any:
            return experiment.residuals({**theta, **self.constants})

        parts = [group.linearised(one, values, rates, located) for group in self.groups]
        slopes = jnp.diag(self.priors.rates(rates))[:, located]
        residuals = [*(jnp.ravel(part) for part, _ in parts), self.priors.residuals(u, values)]
        return jnp.concatenate(residuals), jnp.concatenate([*(j.reshape(-1, len(located)) for _, j in parts), slopes])

    def residual_owners(self, u: np.ndarray) -> list[Experiment | None]:
        """(n,) experiment of every entry of ``residuals`` at u (d,); None: a prior."""
        values, owners = self.mapping(self.theta(u)), []
        for group in self.groups:
            first = self.experiments[group.members[0]]
            size = len(first.residuals(first.local(values), np))
            owners += [self.experiments[i] for i in group.members for _ in range(size)]
        return [*owners, *[None] * self.dimension]

    def prior_residuals(self, u: np.ndarray) -> np.ndarray:
        """(d,) (value - centre)/width: half their sum of squares is the parameter-dependent part of -log prior."""
        return self.priors.at(slice(None), np).residuals(u, self.theta(u), np)

    def plain_residuals(self, u: np.ndarray) -> np.ndarray:
        """Residuals as in ``residuals``, by NumPy without compilation, in the order of the experiments."""
        values = self.mapping(self.theta(u))
        parts = [np.asarray(e.residuals(e.local(values), np)) for e in self.experiments]
        return np.concatenate([*parts, self.prior_residuals(u)])

    def _per_group(self, function: Callable[[Experiment, ValuesBySymbol], Any], u: Any) -> list[Any]:
        """Evaluate ``function`` for every experiment, batched: one array (members, ...) per group."""
        values = self.constrain(u)

        def one(experiment: Experiment, theta: ValuesBySymbol) -> Any:
            return function(experiment, {**theta, **self.constants})

        return [jax.vmap(one)(group.experiments, group.local(values)) for group in self.groups]

    # -- starts and prior samples ---------------------------------------------------------------------------------

    def starts(self) -> Mapping[str, Start]:
        """Start of every parameter: the mean (geometric where positive) of the starts of the experiments."""
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
            else:  # masses: the measured value; others: the prior median
                prior = prior_of(row)
                spread = np.log(prior.spread) if prior.kind == "lognormal" else prior_sd(row)
                merged[row.name] = Start(prior.median, float(min(spread, WIDEST_START)))
        return merged

    def nested_starts(self) -> np.ndarray:
        """(k, d) u of starts at fits of simpler models of the readings; a parameter without one has its usual start."""
        own = [experiment.nested_starts() for experiment in self.experiments]
        usual = {name: start.centre for name, start in self.starts().items()}
        found = []
        for k in range(max(map(len, own), default=0)):
            values = {name: value for starts in own for name, value in (starts[k : k + 1] or [{}])[0].items()}
            found.append(self.unconstrain(np.array([values.get(name, usual[name]) for name in self.names])))
        return np.reshape(found, (-1, self.dimension))

    def sample_prior(self, rng: np.random.Generator, size: int) -> dict[str, np.ndarray]:
        """Return ``size`` prior draws of every parameter, SI."""
        return {row.name: prior_of(row).sample(rng, size) for row in self.parameters}


@partial(jax.jit, compiler_options=COMPILE)
def _batch(target: LogPosterior, u: Any) -> Any:
    return jax.vmap(target)(u)


class HeldResiduals(eqx.Module):
    """``LogPosterior.residuals`` as a function of the located entries of u; the others are fixed at ``centre``."""

    target: LogPosterior
    centre: Any

    def __call__(self, v: Any) -> Any:
        return self.target.residuals(self._whole(v))

    def linearised(self, v: Any) -> tuple[Any, Any]:
        """Residuals (n,) and their Jacobian (n, l) at v (l,)."""
        return self.target.linearised(self._whole(v))

    def _whole(self, v: Any) -> Any:
        return self.centre.at[jnp.array(self.target.located)].set(v)
