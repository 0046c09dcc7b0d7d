"""Groups of stacked experiments that differ only in numbers; each group is evaluated in one batch."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import Experiment, Unavailable


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
        self, residuals: Callable[..., Any], values: Any, rates: Any, located: np.ndarray
    ) -> tuple[Any, Any]:
        """Residuals (members, n) and their Jacobian (members, n, l) with respect to the ``located`` entries of u (l,).

        A tangent per symbol moves that parameter of all members at once: one member reads few of the entries.

        Parameters
        ----------
        residuals : (experiment, values by symbol) -> (n,)
        values, rates : (d,) constrained values and their derivatives with respect to u
        """
        column = np.full(len(rates) + 1, len(located))
        column[located] = np.arange(len(located))
        entries = {symbol: np.array(entry) for symbol, entry in self.entries}
        moved = [symbol for symbol, entry in entries.items() if np.any(column[entry] < len(located))]
        at = self.local(values)

        def along(direction: Any) -> tuple[Any, Any]:
            """Residuals, and their derivative along ``direction`` (symbols,)."""
            tangents = {s: jnp.broadcast_to(x, (len(self.members),)) for s, x in zip(moved, direction, strict=True)}

            def of_moved(own: dict[str, Any]) -> Any:
                return jax.vmap(residuals)(self.experiments, {**at, **own})

            return jax.jvp(of_moved, ({symbol: at[symbol] for symbol in moved},), (tangents,))

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
    own = [{row.symbol: row.name for row in e.parameters} for e in experiments]
    sampled = [*dict.fromkeys(s for table in own for s in table), *(m for m in first.masses if m in place)]
    entries = tuple((s, tuple(place.get(table.get(s, s), len(place)) for table in own)) for s in sampled)
    stacked = jax.tree.map(_stack, *experiments)
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


def _stack(*leaves: Any) -> jax.Array:
    return jnp.asarray(np.stack([np.asarray(leaf, dtype=float) for leaf in leaves]))
