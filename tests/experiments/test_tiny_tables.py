"""Tables of two or three rows, readings exactly on a line, absurd stated errors: an answer or a refusal, within seconds."""

from pathlib import Path
from time import monotonic

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.errors import InputError
from tests.measured.folders import Entry, make_rig, named_line, quantity

#: Longest fit, s; two to nine on an idle core.
BOUND = 60.0
X11 = np.linspace(0.0, 1.0, 11)
ROWS = {
    "two rows": ([0.0, 1.0], [0.0, 2.0], "lines.two_rows"),
    "three on a line": ([0.0, 1.0, 2.0], [0.0, 2.0, 4.0], "lines.step"),
    "eleven on a line": (X11, 2.0 * X11, "lines.step"),
}


def spring(folder: Path, name: str, **settings: str) -> Entry:
    x, y, _ = ROWS[name]
    columns = {"deflection [mm]": np.array(x), "force [N]": np.array(y)}
    return Entry("support_spring", "spring", columns, {"spring": '"a"', **settings})


def motor(rows: int, **settings: str) -> Entry:
    current = np.array([0.5, 2.0, 1.0])[:rows]
    return Entry("motor_current", "motor", {"current [A]": current, "force [N]": 2.0 * current}, settings)


def fit(folder: Path, entry: Entry, budget: int | None = None) -> Fit:
    start = monotonic()
    result = cid.fit(make_rig(folder, entry), budget=budget)
    assert monotonic() - start < BOUND
    return result


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=pytest.mark.full) if one == "eleven on a line" else one for one in ROWS]
)
def test_a_line_without_scatter_is_not_judged_and_the_remedy_ends_that(tmp_path: Path, name: str) -> None:
    code = ROWS[name][2]
    result = fit(tmp_path / "plain", spring(tmp_path, name))
    (found,) = [f for f in result.findings if f.code.startswith("lines.") and f.level != "ok"]
    assert (found.code, found.level, found.parameters) == (code, "warn", ("k2[a]",))
    row = result.summary.loc["k2[a]"]
    assert row["trust"] == "not judged"
    # Readings to 1 N or 0.1 N leave an sd of this size, not of 1e-9.
    assert row["sd"] > 0.01 * row["value"]
    for remedy in ("force_sd", "force_resolution")[: 1 if code == "lines.two_rows" else 2]:
        assert remedy in result.text(found)
        stated = fit(tmp_path / remedy, spring(tmp_path, name, **{remedy: quantity(0.05, "N")}))
        assert [f for f in stated.findings if f.code == code] == []


@pytest.mark.full
@pytest.mark.parametrize("rows", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_sample_of_a_tiny_table_ends_within_seconds(tmp_path: Path, rows: int) -> None:
    result = fit(tmp_path, motor(rows), 20_000)
    K = result.summary.loc["K"]
    assert result.clean
    assert K["trust"] == "not judged"
    assert K["value"] == pytest.approx(2.0, abs=K["sd"])
    assert K["sd"] > 0.1


def test_the_step_is_not_used_where_readings_scatter_or_their_error_is_stated(tmp_path: Path) -> None:
    """Negative control."""
    force = 2.0 * X11 + 0.2 * (-1.0) ** np.arange(11)
    columns = {"deflection [mm]": X11, "force [N]": np.round(force, 1)}
    result = fit(tmp_path, Entry("support_spring", "spring", columns, {"spring": '"a"'}))
    assert [f.code for f in result.findings if f.code == "lines.step"] == []


def test_chosen_levels_are_no_reading_step(tmp_path: Path) -> None:
    """Known weights of 10 lb each are far apart, but each is known to its last digit."""
    force = 44.482216 * np.array([0.0, 1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0, 0.0])
    current = force / 4.46 + 1e-3 * np.random.default_rng(1).standard_normal(9)
    result = fit(tmp_path, Entry("motor_current", "cell", {"current [A]": current, "force [N]": force}, {}))
    assert [f.code for f in result.findings if f.code == "lines.step"] == []
    K = result.summary.loc["K"]
    assert K["trust"] != "not trusted"
    assert K["sd"] < 0.01
    assert K["value"] == pytest.approx(4.46, abs=4.0 * K["sd"])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"force_sd": quantity(1e-300, "N"), "current_sd": quantity(1e-3, "A")}, "force_sd must lie between"),
        ({"force_sd": quantity(1e300, "N")}, "force_sd must lie between"),
        ({"force_sd": quantity(1e-20, "N")}, "force_sd must not be below 1e-12 of the largest reading"),
        ({"sd_ratio": quantity(1e300, "N/A")}, "sd_ratio must lie between"),
        ({"sd_ratio": quantity(1e-300, "N/A")}, "sd_ratio must lie between"),
    ],
)
def test_an_absurd_stated_error_is_refused_at_its_place(tmp_path: Path, settings: dict[str, str], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make_rig(tmp_path, motor(3, **settings))
    assert named_line(caught.value).startswith(f"{words.split()[0]} = ")
    assert "correct the value or its unit" in caught.value.remedy


def test_absurd_masses_and_readings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="m1 must lie between"):
        make_rig(tmp_path / "mass", motor(3), head={"m1": quantity(1e-320, "g")})
    push = {"speed [m/s]": np.array([0.5]), "distance [mm]": np.array([1e-300])}
    with pytest.raises(InputError, match="distance must be 0 or lie between"):
        make_rig(tmp_path / "push", Entry("dynamic_friction", "push", push))
