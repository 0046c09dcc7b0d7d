"""Shared declarations of calibration lines: rule on reading errors, the paper's straight line, lint."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from capsule_id.experiments.kind import Values
from capsule_id.experiments.lint import lint_reading_errors, lint_rows
from capsule_id.rig.entry import Entry
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Finding, Message

if TYPE_CHECKING:
    from capsule_id.experiments.families.line_experiment import Line

MESSAGES = {
    "lines.rise": Message(
        "linearity",
        fail="{name} is positive, but the line falls: {slope:.3g} {unit}. Check the signs of {x} and {y}.",
    ),
    "lines.straight": Message(
        "linearity",
        ok="no bend in {number:# calibration line}",
        fail=(
            "expected a straight line; a parabola departs from it by {departure:.1%} of the range at mid range "
            "({p:p}), so {name} depends on where it is read. Use the part of the range that the runs use."
        ),
    ),
    "lines.replicates": Message(
        "repeated readings",
        ok="the means of repeated readings lie on {number:# calibration line}",
        fail=(
            "expected the means of repeated readings on the line; they deviate by {deviation:.1f} sd of a reading "
            "({p:p}), so {name} has errors that repetition does not show. Set {x} anew before each reading, and check "
            "for hysteresis."
        ),
    ),
    "lines.two_rows": Message(
        "scatter of calibration lines",
        warn=(
            "two readings show nothing of their own scatter, so the sd of {name} follows from an assumed one. State {y}_sd, "
            "or measure more rows."
        ),
    ),
    "lines.step": Message(
        "scatter of calibration lines",
        warn=(
            "the readings lie closer to the line than their step, so the sd of {name} follows from the step of their digits, "
            "{step:g} {unit}. State {y}_resolution or {y}_sd."
        ),
    ),
    "lines.slopes": Message(
        "Calibration lines",
        caption=(
            "Slopes by generalised least squares. The ordinary line is the paper's estimate. Flagged rows are shown, not "
            "dropped."
        ),
    ),
}


def line_estimates(experiments: Sequence["Line"]) -> Values:
    """Return the slopes of ordinary straight lines, by name; the mean over tables."""
    slopes: dict[str, list[float]] = {}
    for e in experiments:
        slopes.setdefault(e.slope.name, []).append(e.ordinary_line()[0])
    return {name: float(np.mean(values)) for name, values in slopes.items()}


def refuse_idle_sd_ratio(entry: Entry[Any]) -> None:
    """Reject ``sd_ratio`` where both reading errors are stated, because they already define the ratio.

    Raises
    ------
    InputError
        If ``sd_ratio`` and both reading errors are stated.
    """
    columns = entry.table.columns
    if entry.table.settings.sd_ratio is not None and all(column.sd is not None for column in columns.values()):
        one, other = (f"{name}_sd" for name in sorted(columns, key=lambda name: name != "force"))
        rule = f"state sd_ratio or both of {one} and {other}"
        raise entry.error("sd_ratio", rule, "all three", "remove sd_ratio", of_key=True)


def lint_line(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report few rows and missing reading errors."""
    yield from lint_rows(table, rig, 5)
    if table.settings.sd_ratio is None:
        yield from lint_reading_errors(table, rig)
