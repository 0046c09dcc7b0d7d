"""What reads without error and still deserves a word before a fit."""

from collections.abc import Iterator

from capsule_id.errors import InputError
from capsule_id.rig.filters import dominant_frequency, sampling_step
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.windows import decay_window

SAMPLES_PER_PERIOD = 20  # of a free decay; the highest sample is below the peak by up to 1 - cos(pi/20) = 1.2 %
FEWEST_PERIODS = 2  # of a free decay; with fewer, its damping rests on one peak
# Rows below which an experiment leaves its own scatter all but unknown: unknowns of its law, and three to spare
FEWEST_ROWS = {
    "static_friction": 4,
    "dynamic_friction": 5,
    "sliding_friction": 5,
    "motor_current": 5,
    "support_spring": 5,
}


def lint(rig: Rig) -> list[str]:
    """Findings of a rig that is valid, a line each, naming the experiment, what was seen and what to do.

    Parameters
    ----------
    rig : as ``read_rig`` returns it
    """
    findings = [
        f"{name}: no sd stated, so its value counts as exact; state the weighing error"
        for name, mass in (("m1", rig.m1), ("m2", rig.m2))
        if mass is not None and mass.sd == 0.0
    ]
    for table in rig.tables:
        findings += [f"{table.label}: {text}" for text in _lint_table(table)]
    by_content: dict[str, list[str]] = {}
    for table in rig.tables:
        by_content.setdefault(rig.files[table.file], []).append(table.label)
    for labels in by_content.values():
        if len(labels) > 1:
            findings.append(f"{' and '.join(labels)}: the same data; use each reading in one experiment only")
    return findings


def _lint_table(table: Table) -> Iterator[str]:
    """Findings of one experiment."""
    if table.kind == "free_vibration":
        yield from _lint_decay(table)
    fewest = FEWEST_ROWS.get(table.kind, 0)
    if len(table.rows) < fewest:
        yield f"{len(table.rows)} rows, which hardly tell the scatter; measure {fewest} or more"
    if table.kind in ("dynamic_friction", "motor_current", "support_spring") and "sd_ratio" not in table.settings:
        unstated = [name for name, column in table.columns.items() if column.reading_sd == 0.0]
        if unstated:
            yield f"no reading error stated for {' and '.join(unstated)}; add {unstated[0]}_sd"


def _lint_decay(table: Table) -> Iterator[str]:
    """Sampling and length of a free decay."""
    time, x_rel = decay_window(table)
    try:
        period = 1.0 / dominant_frequency(time, x_rel)
        step = sampling_step(time)
    except InputError as error:
        yield f"{error.rule} ({error.value}): the paper's estimate is left out; {error.remedy}"
        return
    if period / step < SAMPLES_PER_PERIOD:
        yield f"{period / step:.1f} samples per period, {SAMPLES_PER_PERIOD} or more are wanted; sample faster"
    if (time[-1] - time[0]) / period < FEWEST_PERIODS:
        yield f"{(time[-1] - time[0]) / period:.1f} periods, {FEWEST_PERIODS} or more are wanted; record for longer"
