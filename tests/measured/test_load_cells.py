"""Two load cells in series under 0-10-20-30-40-30-20-10-0 lb, 10 Hz: one of each cell's drop-outs is left in.

Relabelled: counts as force, N, pounds as current, A; so K is in counts per pound. Rows are the samples of the plateaus,
without the seconds in which weights were added or taken off.
"""

from pathlib import Path

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.api import Fit
from tests.measured.folders import Entry, make_rig, note
from tests.measured.sources import load_cells

#: From and to, s after the first sample, and load, lb.
PLATEAUS = (
    (0.0, 15.0, 0), (18.0, 31.0, 10), (35.5, 48.0, 20), (55.0, 63.0, 30), (68.0, 75.0, 40), (78.5, 88.0, 30),
    (92.0, 101.0, 20), (105.0, 111.0, 10), (115.0, 133.0, 0),
)  # fmt: skip
DROPPED_OUT = -1e6  # counts; a drop-out reads -8.39e6
#: Cell, the drop-out that is left in, and its published slope, counts/lb. The first hangs on the 40 lb plateau and
#: tilts the whole line until it falls, the second on an empty scale.
CELLS = ((0, 731, 997.1), (0, 73, 997.1), (1, 94, 1003.7))


def _plateaus(cell: int, keep: int | None) -> tuple[np.ndarray, np.ndarray, int]:
    """Load, lb, and counts, (n,) each, and the row of the drop-out ``keep`` among them (-1: none)."""
    time, counts = load_cells()
    load = np.full(time.size, np.nan)
    for start, stop, pounds in PLATEAUS:
        load[(time > start) & (time < stop)] = pounds
    sound = counts[:, cell] > DROPPED_OUT
    rows = np.flatnonzero(np.isfinite(load) & (sound | (np.arange(time.size) == keep)))
    assert keep is None or (keep in rows and not sound[keep])
    return load[rows], counts[rows, cell], -1 if keep is None else int(np.searchsorted(rows, keep))


def _fit(folder: Path, load: np.ndarray, counts: np.ndarray) -> Fit:
    columns = {"current [A]": load, "force [N]": counts}
    return cid.fit(make_rig(folder, Entry("motor_current", "cell", columns)), budget=None)


@pytest.mark.full
@pytest.mark.parametrize(("cell", "keep", "slope"), CELLS)
def test_the_drop_out_is_flagged_and_the_slope_given_without_it(
    tmp_path: Path, cell: int, keep: int, slope: float
) -> None:
    load, counts, row = _plateaus(cell, keep)
    result = _fit(tmp_path, load, counts)
    (finding,) = [f for f in result.findings if f.level == "fail"]
    assert finding.code == "outliers"
    assert f"cell.csv line {row + 2} stands" in result.text(finding)
    line = note(result, "lines.slopes").frame.loc["cell"]
    assert line["without flagged rows"] == pytest.approx(slope, abs=0.6)
    assert line["± without"] == pytest.approx(0.2, abs=0.05)
    # With the drop-out the line is worthless, and looks it.
    assert line["all rows"] == pytest.approx(np.polyfit(load, counts, 1)[0], rel=1e-4)
    assert line["±"] > 500.0


@pytest.mark.full
@pytest.mark.parametrize(("cell", "slope"), [(0, 997.1), (1, 1003.7)])
def test_without_a_drop_out_the_calibration_is_clean(tmp_path: Path, cell: int, slope: float) -> None:
    load, counts, _ = _plateaus(cell, None)
    result = _fit(tmp_path, load, counts)
    assert result.clean
    K = result.summary.loc["K"]
    assert K["map"] == pytest.approx(slope, abs=0.6)
    assert K["map"] == pytest.approx(np.polyfit(load, counts, 1)[0], rel=1e-6)
    assert K["standard_error"] == pytest.approx(0.2, abs=0.05)
