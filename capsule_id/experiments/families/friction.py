"""Shared declarations of friction experiments: eq. (1), the paper's fit, one panel, one rule on readings."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Values
from capsule_id.experiments.lint import lint_rows
from capsule_id.rig.domains import POSITIVE
from capsule_id.rig.entry import Entry
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import ColumnRule, GroundSettings
from capsule_id.views import Finding, Message, counted

if TYPE_CHECKING:
    from capsule_id.experiments.families.friction_experiment import FrictionExperiment
    from capsule_id.views import Comparison


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings(GroundSettings):
    """``direction``: towards the support spring ("forward") or away from it; it matters where mu_back is free."""

    direction: Literal["forward", "backward"] = "forward"


@dataclass(frozen=True, kw_only=True)
class PullSettings(SurfaceSettings):
    """``load_is``: whether stated normal forces on a slope come from weights, or press without weight; else None."""

    load_is: Literal["weight", "pressed"] | None = None


#: Column of the normal force of every trial, where it differs from trial to trial.
NORMAL_FORCE_COLUMN = ColumnRule("N", POSITIVE)


def check_normal_force(entry: Entry[Any]) -> None:
    """Require a force beside a column of normal forces, and refuse another statement of the normal force.

    Raises
    ------
    InputError
        At the entry or its setting.
    """
    columns = entry.table.columns
    if "normal_force" not in columns:
        return
    if "force" not in columns:
        raise entry.error(
            "", "the column normal_force needs the column force", " ".join(columns), "remove normal_force"
        )
    for key in ("normal_force", "N0"):
        if (*entry.path, key) in entry.document.keys:
            raise entry.error(
                key, f"{key} must not stand beside the column normal_force", "both", f"remove {key}", True
            )


def has_stated_load(table: Table[Any]) -> bool:
    """Whether pulls state their normal force, which then holds N0 too."""
    return isinstance(table.settings, PullSettings) and (
        "normal_force" in table.columns or getattr(table.settings, "normal_force", None) is not None
    )


def check_load(entry: Entry[Any]) -> None:
    """Require ``load_is`` where the normal force is stated on a slope: weights pull along the slope too.

    Raises
    ------
    InputError
        At the entry or its setting.
    """
    table = entry.table
    needed = has_stated_load(table) and "force" in table.columns and "slope" in table.settings.ground
    if needed and table.settings.load_is is None:
        rule = "load_is must say where a stated normal force on a slope comes from"
        remedy = (
            'write load_is = "weight" for weights on the capsule, or load_is = "pressed" for a force without weight'
        )
        raise entry.error("", rule, "none", remedy)
    if table.settings.load_is is not None and not needed:
        raise entry.error("load_is", "load_is needs a slope and a stated normal force", "no such", "remove it", True)


def lint_slides(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Warn where slides have few rows: constant friction has one unknown, another law mu and v_s."""
    return lint_rows(table, rig, 3 if rig.model.friction == "constant" else 5)


CAPTIONS = {
    "friction": "Counterpart of the paper's Fig. 2: coefficients as the paper reads them off, its curve, and ours."
}

#: A friction coefficient holds the viscous part as a force per weight.
MASSES_OF_FREE = {"viscous": ("m1", "m2")}

MESSAGES = {
    "friction.variants": Message(
        "friction law",
        ok=(
            "{name} explains the readings as well as the best of {count} friction laws, which is {factor:.2g} times as "
            "probable. The simplest law that does so is {simplest}: {line} in [model]"
        ),
        fail=(
            "{labels}: expected readings that {name} explains; found them {factor:.3g} times more probable under another "
            "friction law. Write in [model] of rig.toml: {line}"
        ),
        caption=(
            "Friction laws fitted to the friction experiments alone: posterior mean ± sd, largest log-likelihood, BIC and "
            "log marginal likelihood (differences from the best), p-value of residuals ordered by speed."
        ),
    ),
    "friction.order": Message(
        "friction against speed",
        ok="the residuals show no order in speed ({p:p})",
        fail=(
            "{labels}: expected residuals without order in speed; found neighbours of one sign under {name} ({p:p}). "
            "Compare the friction laws in the report, or repeat the readings at more speeds."
        ),
    ),
    "friction.one_surface": Message(
        "experiments agree",
        ok=(
            "tilts and slides agree on one surface: mu = {mu_tilts:.3f} from the tilts alone, {mu_slides:.3f} from the slides "
            "alone; a difference this large is expected from their errors with probability {p:.2g}"
        ),
        fail=(
            "{tilts} and {slides}: expected one surface; found mu = {mu_tilts:.3f} at rest and {mu_slides:.3f} by "
            "sliding ({p:p}). Measure both on the same surface, and read the tilt or pull at break-away. Static friction "
            "above sliding friction is no fault, but constant friction cannot show it: give the slides a column speed and "
            'state friction = "stribeck", or fit both in folders of their own.'
        ),
    ),
}


def friction_estimates(experiments: Sequence["FrictionExperiment"]) -> Values:
    """Estimate mu and v_s as in the paper: fit eq. (1) to the points of all friction experiments."""
    from capsule_id.experiments.families.friction_experiment import paper_friction_fit

    points = [e.paper_points() for e in experiments]
    speed, coefficient = (np.concatenate(parts) for parts in zip(*points, strict=True))
    return paper_friction_fit(speed, coefficient)


def friction_panels(
    experiments: Sequence["FrictionExperiment"], values: Values, draws: Sequence[Values]
) -> tuple["Comparison"]:
    """Return one panel for all friction experiments."""
    from capsule_id.experiments.families.friction_experiment import friction_comparison

    # Local values differ in scatters only. Merged, they contain mu and v_s if any experiment has both.
    points: list[Values] = [{k: v for e in experiments for k, v in e.local(p).items()} for p in (values, *draws)]
    return (friction_comparison(list(experiments), points[0], points[1:]),)


def check_scatter(tables: Sequence[Table[Any]]) -> None:
    """Reject equal readings without reading error: a scatter of 0 makes the posterior improper.

    Raises
    ------
    InputError
        If all readings are equal and no reading error is stated.
    """
    if len({tuple(table.columns) for table in tables}) != 1:
        return
    rows = np.concatenate([np.stack([c.values for c in t.columns.values()], axis=1) for t in tables])
    if len(rows) < 2 or np.any(rows != rows[0]):
        return
    if not any(column.reading_sd > 0.0 for table in tables for column in table.columns.values()):
        name = next(iter(tables[0].columns))
        rule = f"{tables[0].kind} readings that are all the same need their reading step"
        raise InputError(rule, counted(len(rows), "row"), f"state {name}_resolution", tables[0].file)
