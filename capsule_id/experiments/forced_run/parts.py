"""Multiple shooting: division of a record into parts, each with its own initial state.

Where a motion amplifies small errors, one initial state cannot predict a whole record. It can predict a part of a few
periods. All parts share gap, drive, noise and delays.
"""

from dataclasses import replace

import numpy as np

from capsule_id.experiments.forced_run.start_state.rough import PARABOLA_SAMPLES
from capsule_id.rig.model import Table
from capsule_id.rig.schema import SHORTEST_RECORD

#: Separator between record label and number in the label of a part. File names do not contain it.
PART_MARK = "~"
#: Largest shift of a cut towards smooth motion, as a fraction of a part's length.
LEEWAY = 0.3


def parts_of(table: Table, seconds: float) -> list[Table]:
    """Divide the record into parts of about ``seconds``; return [``table``] if it is not longer."""
    time = table["time"]
    count = max(1, min(round((time[-1] - time[0]) / seconds), len(time) // SHORTEST_RECORD))
    if count == 1:
        return [table]
    edges = _edges(table, count)
    return [_part(table, i, slice(*edges[i : i + 2])) for i in range(count)]


def _edges(table: Table, count: int) -> list[int]:
    """First samples of ``count`` parts, and the end.

    The state at a first sample comes from a parabola through the next samples. A cut therefore avoids samples where a
    contact begins or ends, or where the capsule sticks or slips.
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
    """(n,) residual of a parabola through the samples from each one on, summed over positions, in units of noise."""
    time, n = table["time"], PARABOLA_SAMPLES
    total = np.zeros(len(time))
    # One projection serves all samples. It is approximate for uneven sampling, which suffices to choose a cut.
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
    columns = {name: replace(column, values=column.values[rows]) for name, column in table.columns.items()}
    return replace(table, label=f"{table.label}{PART_MARK}{index + 1}", columns=columns, rows=table.rows[rows])
