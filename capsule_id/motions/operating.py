"""Diagrams for draws of the parameters: how probable each motion is, how fast, and where to operate best.

    draws over values -> settled motions (value, draw) -> bands: probabilities, quantiles, best operating point

Draws are arrays of leaves; this module does not depend on where they come from.
"""

from dataclasses import asdict
from typing import TYPE_CHECKING

import jax
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.motions.response import SETTLING, Settling
from capsule_id.motions.sweep import SUMMARY, compute, dataset_of, grid_of, sweep_points
from capsule_id.physics.batches import lanes_of
from capsule_id.physics.drive import PeriodicDrive
from capsule_id.physics.model import CapsuleParameters

if TYPE_CHECKING:
    from pathlib import Path

    from distributed import Client

QUANTILES = (0.025, 0.5, 0.975)


def draws_diagram(
    p: CapsuleParameters,
    e: PeriodicDrive,
    over: str,
    values: ArrayLike,
    *,
    settling: Settling = SETTLING,
    progress: OnProgress | None = None,
    store: "Path | None" = None,
    client: "Client | None" = None,
) -> xr.Dataset:
    """Settled motions from rest at every value for every draw: a Dataset over (<over>, draw).

    Parameters
    ----------
    p, e : leaves () or (draws,), at least one with draws
    over, values : the quantity that is varied, (n,), SI (f in Hz)
    store, client : see ``sweep.compute``

    Eight arguments: four state the diagram, the others are options by name.

    Raises
    ------
    InputError
        A quantity that does not exist, no leaf with draws, values that are no list of finite numbers.
    """
    grid = grid_of({over: values})
    if not any(np.ndim(leaf) for leaf in jax.tree.leaves((p, e))):
        raise InputError("a posterior band needs draws", "every leaf is one number", "use diagram, or give arrays")
    drawn, _, _ = lanes_of((p, e), np.zeros(1))
    n, draws = len(grid[over]), len(np.asarray(drawn[0].m1))
    p, e = jax.tree.map(lambda leaf: np.tile(leaf, n), drawn)
    points = sweep_points(p, e, {over: np.repeat(grid[over], draws)})
    seen = compute(points, settling, SUMMARY, progress=progress, store=store, client=client)
    about = {**asdict(settling), "method": "rest", "model": "exact", "semantics": "stick-slip"}
    return dataset_of(seen, grid, (over, "draw"), (n, draws), about).assign_coords(draw=np.arange(draws))


def bands(seen: xr.Dataset, objective: str = "mean_velocity") -> xr.Dataset:
    """Probabilities and quantiles over the draws, at each value and at the best operating point.

    Parameters
    ----------
    seen : from ``draws_diagram``
    objective : the quantity to maximise: "mean_velocity" (forward), or "efficiency"

    Returns a Dataset with

    probability (label, <over>) : share of the draws with this label, "failed" among them: over labels it sums to 1
    <objective>_quantiles (quantile, <over>) : 2.5 %, 50 % and 97.5 % over the draws that have not failed
    best (draw), best_<objective> (draw) : for each draw the value with the largest objective, and that objective
    best_quantiles, best_<objective>_quantiles (quantile) : the same over the draws
    chosen () : the value whose *mean* over the draws is largest, that is, what to set when the parameters are not
        known better; chosen_<objective>_quantiles (quantile) : what it gives

    Raises
    ------
    InputError
        An objective that does not exist, draws of which every one failed at some value or at all of them.
    """
    if objective not in ("mean_velocity", "efficiency"):
        raise InputError("the objective is mean_velocity or efficiency", objective, "choose one of them")
    over = str(next(name for name in seen.dims if name != "draw"))
    axis, label, goal = seen[over].to_numpy(), seen["label"].to_numpy(), seen[objective].to_numpy()
    failed = label == "failed"
    if failed.all(axis=0).any() or failed.all(axis=1).any():
        raise InputError("every value and every draw needs a run that is complete", "all failed", "look at status")
    names = _by_share(label)
    probability = np.stack([(label == name).mean(axis=1) for name in names])
    goal = np.where(failed, np.nan, goal)
    at = np.nanargmax(goal, axis=0)
    best, best_goal = axis[at], goal[at, np.arange(goal.shape[1])]
    chosen = int(np.argmax(np.nanmean(goal, axis=1)))
    value, unit = dict(seen[over].attrs), seen[objective].attrs["units"]
    about = {"units": unit, "long_name": seen[objective].attrs["long_name"]}
    per_draw = "with the largest objective, of each draw"
    return xr.Dataset(
        {
            "probability": (
                ("label", over),
                probability,
                {"units": "1", "long_name": "posterior probability of the motion"},
            ),
            f"{objective}_quantiles": (("quantile", over), np.nanquantile(goal, QUANTILES, axis=1), about),
            "best": ("draw", best, value | {"long_name": f"{value['long_name']} {per_draw}"}),
            f"best_{objective}": ("draw", best_goal, about),
            "best_quantiles": ("quantile", np.quantile(best, QUANTILES), value),
            f"best_{objective}_quantiles": ("quantile", np.quantile(best_goal, QUANTILES), about),
            "chosen": ((), axis[chosen], value | {"long_name": "value whose objective is largest in the mean"}),
            f"chosen_{objective}_quantiles": ("quantile", np.nanquantile(goal[chosen], QUANTILES), about),
        },
        {over: (over, axis, value), "label": names, "quantile": list(QUANTILES)},
        {**seen.attrs, "objective": objective, "draws": goal.shape[1]},
    )


def _by_share(label: np.ndarray) -> list[str]:
    """The labels that occur, the most frequent first."""
    names, counts = np.unique(label, return_counts=True)
    return [str(name) for name in names[np.argsort(-counts, kind="stable")]]
