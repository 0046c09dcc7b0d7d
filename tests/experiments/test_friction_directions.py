"""Backward sliding, pulls until slip, and many tilts: recovery of known values, bounded time, located errors."""

import time
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

import capsule_id as cid
from capsule_id.errors import InputError
from capsule_id.experiments.friction import friction_panels
from capsule_id.experiments.kind import make_experiments
from capsule_id.physics.forces import CoulombStribeck
from tests.measured.folders import Entry, make_rig, named_line, quantity

LAW = CoulombStribeck(0.66, 1.0, 0.3, mu_back=0.45)
MASSES = {"m1": quantity(0.11, "kg"), "m2": quantity(0.53, "kg")}


def slides(label: str, backward: bool, seed: int) -> Entry:
    """12 points of ``LAW`` with 1 % scatter."""
    speed = np.geomspace(0.02, 1.0, 12)
    coefficient = (LAW.backward if backward else LAW.forward)(speed)
    noisy = coefficient * (1.0 + 0.01 * np.random.default_rng(seed).standard_normal(12))
    settings = {"direction": '"backward"'} if backward else {}
    return Entry("sliding_friction", label, {"speed [m/s]": speed, "coefficient [1]": noisy}, settings)


def with_model(folder: Path, *entries: Entry, model: str) -> cid.Fit:
    make_rig(folder, *entries)
    toml = folder / "rig.toml"
    toml.write_text(f"{toml.read_text()}\n[model]\n{model}\n")
    return cid.fit(cid.read_rig(folder), budget=None)


@pytest.mark.full
def test_two_directions_are_told_apart(tmp_path: Path) -> None:
    """One coefficient for both directions fails and names the line; with it both values are recovered."""
    entries = slides("forth", False, 0), slides("back", True, 1)
    alike = with_model(tmp_path / "alike", *entries, model="")
    (found,) = [f for f in alike.findings if f.code == "friction.variants"]
    assert (found.level, found.facts["line"]) == ("fail", 'free = ["mu_back"]')
    result = with_model(tmp_path / "parted", *entries, model=found.facts["line"])
    for name in ("mu", "mu_back"):
        row = result.summary.loc[name]
        assert row["map"] == pytest.approx(getattr(LAW, name), abs=4.0 * row["standard_error"]), name
        assert row["standard_error"] < 0.02
    assert result.clean
    assert len([curve for curve in result.comparisons[0].curves if curve.role == "ours"]) == 2


def test_mu_back_without_backward_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'an experiment must measure mu_back.*with direction = "backward"'):
        with_model(tmp_path, slides("forth", False, 0), model='free = ["mu_back"]')


def pulls(stated: bool) -> Entry:
    force = 0.6 * 0.64 * 9.81 * (1.0 + 0.02 * np.array([0.3, -1.1, 0.8, -0.2, 0.6]))
    settings = {"normal_force": quantity(0.64 * 9.81, "N")} if stated else {}
    return Entry("static_friction", "pull", {"force [N]": force}, settings)


@pytest.mark.full
@pytest.mark.parametrize("stated", [False, True])
def test_pulls_until_slip(tmp_path: Path, stated: bool) -> None:
    rig = make_rig(tmp_path, pulls(stated), head={} if stated else MASSES)
    row = cid.fit(rig, budget=None).summary.loc["mu"]
    assert row["map"] == pytest.approx(0.6, abs=0.02)
    assert row["paper"] == pytest.approx(0.6, abs=0.01)
    assert 0.003 < row["standard_error"] < 0.02


def test_a_pull_without_a_normal_force_names_the_missing_mass(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="static_friction needs m1") as caught:
        make_rig(tmp_path, pulls(False))
    assert named_line(caught.value) == 'kind = "static_friction"'
    make_rig(tmp_path / "again", pulls(False), head=MASSES)


@pytest.mark.full
def test_sufficient_statistics_are_those_of_all_tilts(tmp_path: Path) -> None:
    angle = np.random.default_rng(0).normal(33.0, 0.5, 300)
    (e,) = make_experiments(make_rig(tmp_path, Entry("static_friction", "tilts", {"angle [deg]": angle})))
    theta = {"mu": 0.64, "tilt_sd": 0.01, "g": 9.81}
    (misfit,) = e.misfits(theta, np)
    assert float(e.log_likelihood(theta)) == pytest.approx(float(misfit.log_density(0.01, np)), rel=1e-12)


@pytest.mark.full
def test_ten_thousand_tilts_take_seconds(tmp_path: Path) -> None:
    angle = np.random.default_rng(0).normal(33.0, 0.5, 10_000)
    rig = make_rig(tmp_path, Entry("static_friction", "tilts", {"angle [deg]": angle}))
    begin = time.process_time()
    row = cid.fit(rig, budget=None).summary.loc["mu"]
    assert time.process_time() - begin < 20.0
    assert np.rad2deg(np.arctan(row["map"])) == pytest.approx(33.0, abs=0.02)


def test_the_picture_shows_pushes_on_the_law_and_as_the_paper_reads_them(tmp_path: Path) -> None:
    """Slides without scatter, by SciPy: their points stand on the law, and as v²/(2gd) above it, on a curve of its own."""
    speed, law = np.array([0.2, 0.5, 1.0]), CoulombStribeck(0.66, 1.0, 0.3)
    distance = [quad(lambda u: u / (9.81 * float(law.forward(u))), 0.0, v)[0] for v in speed]
    columns = {"speed [m/s]": speed, "distance [mm]": 1e3 * np.array(distance)}
    made = make_experiments(make_rig(tmp_path, Entry("dynamic_friction", "push", columns, {}), head=MASSES))
    (panel,) = friction_panels(made, {"mu": 0.66, "v_s": 0.3, "g": 9.81, "push_scatter": 0.05}, [])  # pyright: ignore[reportArgumentType]
    points, curves = ({one.label: one for one in group} for group in (panel.points, panel.curves))
    np.testing.assert_allclose(points["push"].y, law.forward(speed), rtol=1e-4)
    mean = points["push, read as v²/(2gd)"].y
    np.testing.assert_allclose(mean, speed**2 / (2.0 * 9.81 * np.array(distance)), rtol=1e-6)
    drawn = curves["this fit, read as v²/(2gd)"]
    np.testing.assert_allclose(np.interp(speed, drawn.x, drawn.y), mean, rtol=1e-3)
    assert np.all(mean > 1.05 * points["push"].y)
