"""A coil spring loaded by hand, ten masses: the fifth is mis-recorded. Nothing but units is changed: mass times g is force."""

from pathlib import Path
from typing import cast

import numpy as np
import pytest
from scipy import stats

import capsule_id as cid
from capsule_id.api import Fit
from tests.measured.folders import Entry, make_rig, note, quantity
from tests.measured.sources import coil_spring

#: Line 1 of the table is its header, so the fifth row stands on line 6, here and in the authors' file.
LINE = 6


def _fit(folder: Path, budget: int | None = None, leave_out: int | None = None, **settings: str) -> Fit:
    deflection, mass = coil_spring()
    keep = np.arange(deflection.size) != (-1 if leave_out is None else leave_out)
    columns = {"deflection [cm]": deflection[keep], "force [N]": 9.81e-3 * mass[keep]}
    rig = make_rig(folder, Entry("support_spring", "coil", columns, {"spring": '"coil"', **settings}))
    return cid.fit(rig, budget=budget)


# The masses are weighed to 0.01 g and the deflection is read to 1 mm: 1e-4 N against 0.29 mm.
@pytest.mark.full
@pytest.mark.parametrize(("settings", "with_it"), [({}, 26.37), ({"sd_ratio": quantity(0.34, "N/m")}, 27.08)])
def test_the_mis_recorded_mass_is_flagged_by_its_line_and_kept(
    tmp_path: Path, settings: dict[str, str], with_it: float
) -> None:
    result = _fit(tmp_path, **settings)
    (finding,) = [f for f in result.findings if f.level == "fail"]
    assert (finding.code, finding.experiment) == ("outliers", "coil")
    assert f"coil.csv line {LINE} stands" in result.text(finding)
    assert "Nothing was dropped" in result.text(finding)
    row = note(result, "lines.slopes").frame.loc["coil"]
    assert row["all rows"] == pytest.approx(with_it, abs=0.05)
    assert row["without flagged rows"] == pytest.approx(26.3, abs=0.1)
    (panel,) = result.comparisons
    (points,) = panel.points
    assert np.flatnonzero(cast(np.ndarray, points.flagged)).tolist() == [LINE - 2]
    assert points.x.size == 10


def test_the_slopes_are_those_of_ordinary_lines(tmp_path: Path) -> None:
    deflection, mass = coil_spring()
    force, x = 9.81e-3 * mass, 1e-2 * deflection
    without = np.delete(np.arange(10), LINE - 2)
    plain = note(_fit(tmp_path / "a"), "lines.slopes").frame.loc["coil"]
    assert plain["all rows"] == pytest.approx(stats.linregress(x, force).slope, rel=1e-6)
    assert plain["without flagged rows"] == pytest.approx(stats.linregress(x[without], force[without]).slope, rel=1e-6)
    # All the error in the deflection: the line the other way round, as the authors fit it.
    turned = note(_fit(tmp_path / "b", sd_ratio=quantity(1e-4, "N/m")), "lines.slopes").frame.loc["coil"]
    assert turned["all rows"] == pytest.approx(1.0 / stats.linregress(force, x).slope, rel=1e-4)


def test_without_the_row_nothing_is_flagged(tmp_path: Path) -> None:
    result = _fit(tmp_path, leave_out=LINE - 2)
    assert result.clean


@pytest.mark.full
def test_the_posterior_is_the_textbook_one(tmp_path: Path) -> None:
    deflection, mass = coil_spring()
    line = stats.linregress(1e-2 * deflection, 9.81e-3 * mass)
    result = _fit(tmp_path, budget=20_000)
    assert [f.level for f in result.findings if f.code == "chains.converged"] == ["ok"]
    k2 = result.summary.loc["k2[coil]"]
    # Student's t with n - 2 degrees of freedom, but for the broad priors of k2 and of the scatter.
    assert k2["median"] == pytest.approx(line.slope, abs=0.1 * line.stderr)
    half = stats.t.ppf(0.975, 8) * line.stderr
    assert k2["upper"] - k2["lower"] == pytest.approx(2.0 * half, rel=0.06)
