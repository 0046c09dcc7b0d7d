"""What a log-posterior is made of: experiments, priors, coordinates u, residuals; ``marginal`` computes its densities."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse, stats

from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment, Start, Unavailable, ValuesBySymbol
from capsule_id.experiments.misfit import LOG_2PI
from capsule_id.parameters import QUANTILE_975, TABLE, Parameter, Prior, parameter, symbol_of
from capsule_id.rig.model import Rig

# scales: Scatters of which only the product with other parameters changes the motion.


class Scale(NamedTuple):
    """Indices of the scatter, of the parameters that it multiplies, and of those that balance a shift of all of these.

    The motion depends on scatter times factor, and on balance times exp(scatter times factor).
    """

    scatter: int
    factors: np.ndarray
    balance: np.ndarray


# priors: Prior densities of all parameters as arrays, so that their density is one expression.


class Priors(eqx.Module):
    """Normal densities of z = (value - centre)/width, one per parameter; every array is (d,).

    Attributes
    ----------
    lognormal : whether the value is u = log(theta); else it is theta
    centre, width : of the normal density
    constant : log of the normalisation factor of a truncated density
    jacobian : whether theta is sampled through its logarithm and has a prior density in theta: log |d theta/du| = u
    """

    lognormal: Any
    centre: Any
    width: Any
    constant: Any
    jacobian: Any

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        priors = [prior_of(row) for row in parameters]
        kinds = np.array([prior.kind for prior in priors])
        location = np.array([prior.location for prior in priors])
        spread = np.array([prior.spread for prior in priors])
        lognormal = kinds == "lognormal"
        with np.errstate(divide="ignore", invalid="ignore"):
            # The log-normal is a normal density of u; the others are normal densities of theta.
            centre = np.where(lognormal, np.log(location), location)
            width = np.where(lognormal, np.log(spread) / QUANTILE_975, spread)
        # Of a half-normal, whose location is 0, the restriction to positive values keeps a half.
        positive = np.isin(kinds, ["positive_normal", "halfnormal"])
        self.lognormal, self.centre, self.width = jnp.asarray(lognormal), jnp.asarray(centre), jnp.asarray(width)
        self.constant = jnp.asarray(np.where(positive, -stats.norm.logcdf(location / spread), 0.0))
        self.jacobian = jnp.asarray(np.array([row.positive for row in parameters]) & ~lognormal)

    def at(self, index: Any, xp: ModuleType = jnp) -> "Priors":
        """Return the priors at ``index``: arrays of the shape of ``index``, of ``xp``."""
        return jax.tree.map(lambda array: xp.asarray(array)[index], self)

    def terms(self, u: Any, value: Any, xp: ModuleType = jnp) -> Any:
        """Log-density of u for each parameter, Jacobian included; ``value`` is the constrained u."""
        z = self.residuals(u, value, xp)
        density = -0.5 * (z**2 + LOG_2PI) - xp.log(self.width) + self.constant
        return density + xp.where(self.jacobian, u, 0.0)

    def residuals(self, u: Any, value: Any, xp: ModuleType = jnp) -> Any:
        """(value - centre)/width for each parameter."""
        return (xp.where(self.lognormal, u, value) - self.centre) / self.width


def prior_of(row: Parameter) -> Prior:
    """Return the prior of ``row``.

    Raises
    ------
    ValueError
        If the row has no prior.
    """
    if row.prior is None:
        raise ValueError(f"parameter {row.name} has no prior: the experiment that names it must supply one")
    return row.prior


def prior_sd(row: Parameter) -> float:
    """Standard deviation of u under the row's prior (half-normal: pi/sqrt(8), that of its logarithm)."""
    prior = prior_of(row)
    if prior.kind == "lognormal":
        return float(np.log(prior.spread) / QUANTILE_975)
    if prior.kind == "halfnormal":
        return float(np.pi / np.sqrt(8.0))
    if prior.kind == "positive_normal":
        return prior.spread / prior.location
    return prior.spread


def stated_prior(rig: Rig, row: Parameter) -> Prior | None:
    """The prior that [prior] states for a parameter; of a bracketed name it holds the symbol alone, but for k2."""
    return rig.priors.get(row.name, rig.priors.get(row.symbol))


def covering_prior(name: str, priors: Sequence[Prior]) -> Prior:
    """Return the prior of a parameter that several experiments share, whatever their order.

    Log-normal priors: the narrowest one whose central 95 % contain those of all. Normal priors about one mean: the widest.

    Raises
    ------
    InputError
        If experiments state other priors that differ.
    """
    kinds, locations = {prior.kind for prior in priors}, {prior.location for prior in priors}
    if len(set(priors)) == 1:
        return priors[0]
    if kinds == {"lognormal"}:
        low = min(np.log(prior.location) - np.log(prior.spread) for prior in priors)
        high = max(np.log(prior.location) + np.log(prior.spread) for prior in priors)
        return Prior("lognormal", float(np.exp(0.5 * (low + high))), float(np.exp(0.5 * (high - low))))
    if kinds == {"normal"} and len(locations) == 1:
        return max(priors, key=lambda prior: prior.spread)
    row = TABLE.get(symbol_of(name))
    other = (
        f"state {name} in [prior]"
        if row is None or row.prior_can_be_stated
        else f"fit those with another {name} in folders of their own"
    )
    stated = " and ".join(dict.fromkeys(f"{prior.kind} {prior.location:g}, {prior.spread:g}" for prior in priors))
    raise InputError(
        f"experiments that share {name} must state one prior for it",
        f"{stated} (SI)",
        f"state the same in each of them, or {other}",
    )


# groups: Groups of stacked experiments that differ only in numbers; each group is evaluated in one batch.


#: Step of central differences: relative, or part of the prior's sd; k1 of 250 periods moves the phase by less than 1e-3.
DIFFERENCE = 1e-6


class Group(eqx.Module):
    """Stacked experiments of equal tree structure.

    Attributes
    ----------
    experiments : one experiment whose leaves have a leading axis (members, ...), on the device
    members : indices of these experiments in the log-posterior
    entries : symbol and, for every member, its index in u (d: the member lacks it, its value is 0)
    """

    experiments: Experiment
    members: tuple[int, ...] = eqx.field(static=True)
    entries: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)

    def local(self, values: Any, without: Sequence[str | None] = ()) -> dict[str, Any]:
        """Values (members,) by symbol, from the constrained values (d,); symbols in ``without`` are omitted."""
        padded = jnp.concatenate([values, jnp.zeros(1)])
        return {symbol: padded[jnp.array(entry)] for symbol, entry in self.entries if symbol not in without}

    def linearised(
        self, residuals: Callable[..., Any], values: Any, rates: Any, steps: Any, located: np.ndarray
    ) -> tuple[Any, Any]:
        """Residuals (members, n) and their Jacobian (members, n, l) with respect to the ``located`` entries of u (l,).

        A tangent per symbol moves that parameter of all members at once: one member reads few of the entries.

        Parameters
        ----------
        residuals : (experiment, values by symbol) -> (n,)
        values, rates : (d,) constrained values and their derivatives with respect to u
        steps : (d,) of central differences of the values, for experiments that are slow to differentiate
        """
        column = np.full(len(rates) + 1, len(located))
        column[located] = np.arange(len(located))
        entries = {symbol: np.array(entry) for symbol, entry in self.entries}
        moved = [symbol for symbol, entry in entries.items() if np.any(column[entry] < len(located))]
        at = self.local(values)

        def of_moved(own: dict[str, Any]) -> Any:
            return jax.vmap(residuals)(self.experiments, {**at, **own})

        def along(direction: Any) -> tuple[Any, Any]:
            """Residuals, and their derivative along ``direction`` (symbols,)."""
            tangents = {s: jnp.broadcast_to(x, (len(self.members),)) for s, x in zip(moved, direction, strict=True)}

            return jax.jvp(of_moved, ({symbol: at[symbol] for symbol in moved},), (tangents,))

        if self.experiments.slow_to_differentiate:
            step = jnp.concatenate([steps, jnp.ones(1)])[np.stack([entries[symbol] for symbol in moved])]
            sides = jnp.concatenate([jnp.zeros((1, len(moved))), jnp.eye(len(moved)), -jnp.eye(len(moved))])
            rows = jax.vmap(lambda side: of_moved({s: at[s] + side[k] * step[k] for k, s in enumerate(moved)}))(sides)
            found, (ahead, behind) = rows[0], jnp.split(rows[1:], 2)
            slopes = (ahead - behind) / (2.0 * step[:, :, None])
        else:
            found, slopes = jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(moved)))
        index = np.stack([entries[symbol] for symbol in moved])
        slopes = slopes * jnp.concatenate([rates, jnp.zeros(1)])[index][:, :, None]
        jacobian = jnp.zeros((*found.shape, len(located) + 1))
        jacobian = jacobian.at[np.arange(len(self.members)), :, column[index]].add(slopes)
        return found, jacobian[..., :-1]


def make_groups(experiments: Sequence[Experiment], names: Sequence[str]) -> tuple[Group, ...]:
    """Groups of ``experiments`` in the order of their first members; ``names`` (d,) of the entries of u."""
    members: dict[Hashable, list[int]] = {}
    for i, experiment in enumerate(experiments):
        _check_leaves(experiment)
        leaves, structure = jax.tree.flatten(experiment)
        members.setdefault((structure, *(np.shape(leaf) for leaf in leaves)), []).append(i)
    place = {name: i for i, name in enumerate(names)}
    return tuple(_group([experiments[i] for i in own], own, place) for own in members.values())


def _group(experiments: Sequence[Experiment], members: Sequence[int], place: Mapping[str, int]) -> Group:
    """One group; ``place`` of every name among the entries of u."""
    first = experiments[0]
    own = [e.names_by_key for e in experiments]
    sampled = [*dict.fromkeys(s for table in own for s in table), *(m for m in first.masses if m in place)]
    entries = tuple((s, tuple(place.get(table.get(s, s), len(place)) for table in own)) for s in sampled)
    stacked = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves).astype(float)), *experiments)
    # The stack has the static fields of its first member; no likelihood may read its table.
    object.__setattr__(stacked, "about", Unavailable())
    return Group(stacked, tuple(members), entries)


def _check_leaves(experiment: Experiment) -> None:
    """Refuse a leaf that is no number: a kind from another package may lack a static field.

    Raises
    ------
    TypeError
        At the first such field.
    """
    for path, leaf in jax.tree_util.tree_flatten_with_path(experiment)[0]:
        if np.asarray(leaf).dtype.kind not in "fiu":
            field = f"{type(experiment).__name__}{jax.tree_util.keystr(path)}"
            raise TypeError(f"{field} must be a number, found {leaf!r}: declare it with eqx.field(static=True)")


# log posterior: Joint log-posterior of all experiments in an unconstrained space.
#
# u = log(theta) for positive parameters, theta otherwise. log p(u | data) = sum of log-likelihoods + log prior density
# of theta + log |d theta / du|. All densities are natural and normalised; linear nuisances are integrated out.


#: An evaluation takes long above this ``LogPosterior.work``, in readings.
HEAVY = 30_000
#: Half the walkers of the smallest ensemble.
LEAST_HALF = 16
#: Largest dispersion of starts that come from a prior alone, natural-log units.
WIDEST_START = 0.3


def half_ensemble(dimension: int) -> int:
    """Half the walkers of an ensemble in so many dimensions: rows of one evaluation, which no walker leaves empty."""
    return max(LEAST_HALF, dimension)


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
            prior = stated_prior(rig, row)
            if others and prior is None:
                prior = covering_prior(name, [prior_of(one) for one in (row, *others)])
            rows.setdefault(name, row if prior is None else row.named(row.of, prior))
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
    def kinked(self) -> bool:
        """Whether scatters act together: residuals have kinks in the parameters there, and derivatives say little."""
        return any(e.has_joint_scatters for e in self.experiments)

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
        count, label = sparse.csgraph.connected_components(adjacent, directed=False)
        return [np.flatnonzero(label == i) for i in range(count)]

    def constrain(self, u: Any, xp: ModuleType = jnp) -> Any:
        """(..., d) values from u (..., d)."""
        # The unused branch must stay finite: an infinite derivative makes the gradient NaN.
        return xp.where(self.positive, xp.exp(xp.where(self.positive, u, 0.0)), u)

    def theta(self, u: np.ndarray) -> np.ndarray:
        """(..., d) constrained values from u (..., d), NumPy; inf where a search went too far."""
        with np.errstate(over="ignore"):
            return self.constrain(u, np)

    def unconstrain(self, theta: np.ndarray) -> np.ndarray:
        """(..., d) u from constrained values (..., d), NumPy."""
        return np.where(self.positive, np.log(np.where(self.positive, theta, 1.0)), theta)

    def mapping(self, theta: np.ndarray) -> dict[str, float]:
        """Constrained values (d,) by name, constants included."""
        return {**self.fixed, **dict(zip(self.names, (float(v) for v in theta), strict=True))}

    # -- densities and residuals --------------------------------------------------------------------------------------

    def residuals(self, u: Any) -> Any:
        """Residuals (n,) of all experiments, in their order, and priors: the least-squares part of -log posterior."""
        values = self.constrain(u)
        parts = [jax.vmap(self._residuals_of)(group.experiments, group.local(values)) for group in self.groups]
        return jnp.concatenate([self._in_order(parts), self.priors.residuals(u, values)])

    def linearised(self, u: Any) -> tuple[Any, Any]:
        """Residuals (n,) as in ``residuals``, and their Jacobian (n, l) with respect to the l located entries of u."""
        values, located = self.constrain(u), self.located
        rates: Any = jnp.where(self.positive, values, 1.0)
        steps = DIFFERENCE * jnp.where(self.positive, values, self.priors.width)
        pairs = [group.linearised(self._residuals_of, values, rates, steps, located) for group in self.groups]
        found, jacobians = (self._in_order(parts) for parts in zip(*pairs, strict=True))
        slopes = jnp.diag(jnp.where(self.priors.lognormal, 1.0, rates) / self.priors.width)[:, located]
        return jnp.concatenate([found, self.priors.residuals(u, values)]), jnp.concatenate([jacobians, slopes])

    def _in_order(self, parts: Sequence[Any]) -> Any:
        """Rows (n, ...) in the order of the experiments, from those of every group (members, m, ...)."""
        rows: dict[int, np.ndarray] = {}
        end = 0
        for group, part in zip(self.groups, parts, strict=True):
            for member in group.members:
                rows[member], end = np.arange(end, end + part.shape[1]), end + part.shape[1]
        joined = jnp.concatenate([part.reshape(-1, *part.shape[2:]) for part in parts])
        return joined[np.concatenate([rows[i] for i in range(len(rows))])]

    def _residuals_of(self, experiment: Experiment, theta: ValuesBySymbol) -> Any:
        return experiment.residuals({**theta, **self.constants})

    def residual_owners(self, u: np.ndarray) -> list[Experiment | None]:
        """(n,) experiment of every entry of ``residuals`` at u (d,); None: a prior."""
        values = self.mapping(self.theta(u))
        owners = [e for e in self.experiments for _ in range(np.size(e.residuals(e.local(values), np)))]
        return [*owners, *[None] * self.dimension]

    def prior_residuals(self, u: np.ndarray) -> np.ndarray:
        """(d,) (value - centre)/width: half their sum of squares is the parameter-dependent part of -log prior."""
        return self.priors.at(slice(None), np).residuals(u, self.theta(u), np)

    @property
    def work(self) -> int:
        """Time of an evaluation in units of that of one reading; 1 where it integrates motions of the capsule."""
        motions = any(e.event_driven for e in self.experiments)
        return 1 if motions else max(1, sum(e.work for e in self.experiments))

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
        usual = {name: start.centre for name, start in self.starts().items()} if any(own) else {}
        found = []
        for k in range(max(map(len, own), default=0)):
            values = {name: value for starts in own for name, value in (starts[k : k + 1] or [{}])[0].items()}
            found.append(self.unconstrain(np.array([values.get(name, usual[name]) for name in self.names])))
        return np.reshape(found, (-1, self.dimension))

    def sample_prior(self, rng: np.random.Generator, size: int) -> dict[str, np.ndarray]:
        """Return ``size`` prior draws of every parameter, SI."""
        return {row.name: prior_of(row).sample(rng, size) for row in self.parameters}
