"""Multiple shooting: a record cut into parts, each with an initial state of its own.

Where a motion amplifies small errors, one initial state cannot predict a whole record; parts of a few periods can be
predicted. Gap, drive, noise and delays stay the record's.
"""

from dataclasses import replace

import numpy as np

from capsule_id.experiments.forced_run.start import PARABOLA_SAMPLES
from capsule_id.rig.model import Table
from capsule_id.rig.schema import SHORTEST_RECORD

#: Labels of parts: the record's, this mark (no label in rig.toml has it), a number.
PART_MARK = "~"
#: A cut may move by this share of a part's length to where the motion is smooth.
LEEWAY = 0.3


def parts_of(table: Table, seconds: float) -> list[Table]:
    """The record in parts of about ``seconds``; [``table``] where it is no longer than that.

    A part that starts in the middle of the record may start in motion: its kind of start is found anew. Of a P_d that
    is a second reading of the current's amplitude the first part keeps the only copy.
    """
    time = table["time"]
    count = max(1, min(round((time[-1] - time[0]) / seconds), len(time) // SHORTEST_RECORD))
    if count == 1:
        return [table]
    edges = _edges(table, count)
    return [_part(table, i, slice(*edges[i : i + 2])) for i in range(count)]


def _edges(table: Table, count: int) -> list[int]:
    """First samples of ``count`` parts, and the end.

    The state at a first sample is read off a parabola through the samples that follow, so that a cut falls where no
    contact begins or ends and the capsule neither stops nor sets off within them.
    """
    samples = len(table["time"])
    length, rough = samples / count, _roughness(table)
    edges = [0]
    for i in range(1, count):
        first, last = (int((i + side * LEEWAY) * length) for side in (-1.0, 1.0))
        window = rough[max(first, edges[-1] + SHORTEST_RECORD) : last + 1]
        edges.append(
            max(first, edges[-1] + SHORTEST_RECORD) + int(np.argmin(window)) if len(window) else int(i * length)
        )
    return [*edges, samples]


def _roughness(table: Table) -> np.ndarray:
    """(n,) by how much the samples from each on miss a parabola, summed over the places, each in its own noise."""
    time, n = table["time"], PARABOLA_SAMPLES
    total = np.zeros(len(time))
    # Even samples: the same projection everywhere; for uneven ones nearly so, which is enough to choose by.
    design = np.vander(np.arange(n) - 0.5 * (n - 1), 3)
    rest = np.eye(n) - design @ np.linalg.pinv(design)
    for name in ("x_rel", "x_capsule"):
        if name in table.columns and len(time) >= n:
            windows = np.lib.stride_tricks.sliding_window_view(table[name], n)
            miss = np.sqrt(np.sum((windows @ rest) ** 2, axis=1))
            total[: len(miss)] += miss / max(float(np.median(miss)), 1e-300)
            total[len(miss) :] = np.inf
    return total


def _part(table: Table, index: int, rows: slice) -> Table:
    settings = replace(table.settings, segment=None)
    if index > 0:
        settings = replace(settings, start="auto", P_d=None if "current" in table.columns else settings.P_d)
    columns = {name: replace(column, values=column.values[rows]) for name, column in table.columns.items()}
    label = f"{table.label}{PART_MARK}{index + 1}"
    return replace(table, label=label, columns=columns, settings=settings, rows=table.rows[rows])


def record_of(table: Table) -> str:
    """Label of the record that ``table`` is, or is a part of."""
    return table.label.split(PART_MARK)[0]


def leads(table: Table) -> bool:
    """Whether it is a whole record, or the first part of one."""
    return PART_MARK not in table.label or table.label == f"{record_of(table)}{PART_MARK}1"
