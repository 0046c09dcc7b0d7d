"""The joint log-posterior as functions of (structure, numbers, u), so that compiled code is shared.

``Structure`` says which experiments there are and which entries of u each one reads; ``numbers`` holds the readings,
priors and constants. Two rigs with the same structure, as in a calibration study, share every compiled function.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import Experiment, Theta
from capsule_id.experiments.linear import LOG_2PI
from capsule_id.inference.target.compiling import COMPILE

#: Readings, priors and constants: a tree of arrays.
Numbers = Mapping[str, Any]


@dataclass(frozen=True)
class Group:
    """Experiments that differ only in numbers.

    Attributes
    ----------
    signature : of every member, see ``Experiment.signature``
    entries : symbol and, for every member, which entry of u it is (d: none, its value is 0)
    constants : symbols that are not sampled (g, masses stated as exact)
    first : the member whose code is traced
    """

    signature: Hashable
    entries: tuple[tuple[str, tuple[int, ...]], ...]
    constants: tuple[str, ...]
    first: Experiment = field(compare=False)


@dataclass(frozen=True)
class Structure:
    """Everything about a log-posterior that is not a number."""

    names: tuple[str, ...]
    positive: tuple[bool, ...]
    groups: tuple[Group, ...]


def make_groups(
    experiments: Sequence[Experiment], names: Sequence[str], fixed: Mapping[str, float]
) -> tuple[tuple[Group, ...], list[dict[str, Any]]]:
    """Groups in the order of their first members, and the stacked arrays of each."""
    members: dict[Hashable, list[Experiment]] = {}
    for experiment in experiments:
        members.setdefault(experiment.signature, []).append(experiment)
    groups, arrays = [], []
    for signature, group in members.items():
        first = group[0]
        own = [{row.symbol: row.name for row in e.parameters} for e in group]
        sampled = list(dict.fromkeys(s for table in own for s in table)) + [m for m in first.masses if m in names]
        entries = tuple((s, tuple(_entry(table.get(s, s), names) for table in own)) for s in sampled)
        groups.append(Group(signature, entries, tuple(sorted(fixed)), first))
        arrays.append(
            {a: jnp.asarray(np.stack([np.asarray(getattr(e, a), dtype=float) for e in group])) for a in first.ARRAYS}
        )
    return tuple(groups), arrays


def _entry(name: str, names: Sequence[str]) -> int:
    """Which entry of u; one past the last for what this member of a group lacks and others have."""
    return names.index(name) if name in names else len(names)


def pick(values: Any, entries: Sequence[int]) -> Any:
    """(members,) of the values (d,); 0 for what a member lacks."""
    return jnp.concatenate([values, jnp.zeros(1)])[jnp.array(entries)]


def constrain(structure: Structure, u: Any, xp: ModuleType = jnp) -> Any:
    """(..., d) values from u (..., d)."""
    positive = np.array(structure.positive)
    # The unused branch must stay finite, or its infinite derivative would spoil the gradient.
    return xp.where(positive, xp.exp(xp.where(positive, u, 0.0)), u)


def log_prior(structure: Structure, numbers: Numbers, u: Any) -> Any:
    """Normalised log prior density of u (d,), Jacobian included; scalar."""
    return jnp.sum(prior_terms(numbers["prior"], u, constrain(structure, u)))


def prior_terms(prior: Mapping[str, Any], u: Any, value: Any, xp: ModuleType = jnp) -> Any:
    """The same parameter by parameter: of u, constrained ``value``, shaped as the arrays of ``prior``."""
    z = (xp.where(prior["lognormal"], u, value) - prior["centre"]) / prior["width"]
    density = -0.5 * (z**2 + LOG_2PI) - xp.log(prior["width"]) + prior["constant"]
    return density + xp.where(prior["jacobian"], u, 0.0)


def prior_residuals(structure: Structure, prior: Mapping[str, Any], u: Any, xp: ModuleType = jnp) -> Any:
    """(d,) (value - centre)/width: half their sum of squares is the parameter-dependent part of -log prior."""
    value = xp.where(prior["lognormal"], u, constrain(structure, u, xp))
    return (value - prior["centre"]) / prior["width"]


def log_likelihood(structure: Structure, numbers: Numbers, u: Any) -> Any:
    """Sum over the experiments; scalar."""
    return sum(jnp.sum(part) for part in _per_group(lambda e, t: e.log_likelihood(t), structure, numbers, u))


def log_posterior(structure: Structure, numbers: Numbers, u: Any) -> Any:
    """log p(u | data) up to the evidence; -inf where it is not finite (an overdamped decay)."""
    value = log_prior(structure, numbers, u) + log_likelihood(structure, numbers, u)
    return jnp.where(jnp.isfinite(value), value, -jnp.inf)


@partial(jax.jit, static_argnums=0, compiler_options=COMPILE)
def batched_log_posterior(structure: Structure, numbers: Numbers, u: Any) -> Any:
    """(w, d) -> (w,)."""
    return jax.vmap(lambda v: log_posterior(structure, numbers, v))(u)


def residuals(structure: Structure, numbers: Numbers, u: Any) -> Any:
    """All experiments' residuals and the priors', (n,): the least-squares part of -log posterior."""
    parts = _per_group(lambda e, t: e.residuals(t), structure, numbers, u)
    return jnp.concatenate([*(jnp.ravel(part) for part in parts), prior_residuals(structure, numbers["prior"], u)])


class HeldResiduals(eqx.Module):
    """``residuals`` as a function of some entries of u (``free``), the others held at ``centre`` (d,)."""

    structure: Structure = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    numbers: Any
    centre: Any

    def __call__(self, v: Any) -> Any:
        return residuals(self.structure, self.numbers, self.centre.at[jnp.array(self.free)].set(v))


def _per_group(
    function: Callable[[Experiment, Theta], Any], structure: Structure, numbers: Numbers, u: Any
) -> list[Any]:
    """``function`` of every experiment, batched: one array (members, ...) per group."""
    values, results = constrain(structure, u), []
    for group, arrays in zip(structure.groups, numbers["arrays"], strict=True):
        constants = {name: numbers["fixed"][name] for name in group.constants}
        theta = {symbol: pick(values, entries) for symbol, entries in group.entries}

        def one(arrays: Any, theta: Any, constants: Any = constants, first: Experiment = group.first) -> Any:
            return function(first.with_arrays(arrays), {**theta, **constants})

        results.append(jax.vmap(one)(arrays, theta))
    return results
