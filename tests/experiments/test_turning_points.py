"""Turning points of a decay, and records too short or too slowly sampled for a fit."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments import make_experiments
from capsule_id.experiments.free_vibration.points_checks import check_forces_of_points
from capsule_id.experiments.free_vibration.turning_points import TurningPoints
from capsule_id.experiments.registry import default_registry
from capsule_id.inference.fit.point_fit import point_fit
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.report.texts.messages import finding_text, messages_of
from capsule_id.rig.model import Quantity
from capsule_id.views import Finding
from tests.scipy_decay import scipy_decay

FORCES = {"k1": 9.6, "c": 0.12, "m1": 1.0}
NOISE, TIME_NOISE = 3e-3, 1e-3


def folder(path: Path, time: np.ndarray, x: np.ndarray, settings: str = "") -> Path:
    """A rig folder with one decay, columns in s and m."""
    path.mkdir(parents=True, exist_ok=True)
    entry = f'[[experiment]]\nkind = "free_vibration"\nfile = "decay.csv"\n{settings}\n'
    (path / "rig.toml").write_text(f'[rig]\nname = "d"\nm1 = {{ value = 1.0, unit = "kg" }}\n{entry}')
    rows = "".join(f"{t!r},{v!r}\n" for t, v in zip(time.tolist(), x.tolist(), strict=True))
    (path / "decay.csv").write_text(f"time [s],x_rel [m]\n{rows}")
    return path


def turning_points(both: bool, extra: dict[str, float], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Ten turning points of SciPy's decay, with errors of position and time."""
    rng = np.random.default_rng(seed)
    fine = np.linspace(0.0, 22.0, 220_001)
    x, rate, _ = scipy_decay(fine, FORCES | extra, 2.5, 0.0)
    turns = np.concatenate([[0], np.flatnonzero(np.diff(np.signbit(rate[1:]))) + 1])
    turns = turns[:10] if both else turns[:20:2]
    n = len(turns)
    return fine[turns] + 5.0 + TIME_NOISE * rng.standard_normal(n), x[turns] + NOISE * rng.standard_normal(n)


@pytest.mark.parametrize(("both", "extra"), [(False, {}), (True, {}), (True, {"F_dry": 0.3})], ids=str)
def test_ten_turning_points(tmp_path: Path, both: bool, extra: dict[str, float]) -> None:
    """k1, c and dry friction within 3.5 standard errors, which are of the size that the errors imply."""
    damping = 'damping = "dry"\n' if extra else ""
    settings = f'samples = "turning_points"\n{damping}'
    (own,) = make_experiments(read_rig(folder(tmp_path, *turning_points(both, extra, 3), settings)))
    fit = point_fit(LogPosterior(own.rig, [own]), 0)
    assert fit.agree
    for name, value in {**FORCES, **extra}.items():
        if name != "m1":
            error = fit.standard_errors[name]
            assert abs(fit.values[name] - value) < 3.5 * error
            assert error < 0.15 * value
    # Negative control: without dry friction c is wrong by many standard errors.
    if extra:
        (viscous,) = make_experiments(
            read_rig(folder(tmp_path, *turning_points(both, extra, 3), settings.split("damping")[0]))
        )
        wrong = point_fit(LogPosterior(own.rig, [viscous]), 0)
        assert wrong.values["c"] > 1.5 * FORCES["c"]


@pytest.mark.parametrize(
    ("time", "turning"),
    [
        (np.arange(12) * 2.0 * np.pi / np.sqrt(9.6), True),
        (np.linspace(0.0, 0.5, 60), False),
        (np.arange(14) / 0.494, False),
    ],
    ids=["one sample a period", "a quarter of a period", "sampled at the natural frequency"],
)
def test_a_record_that_does_not_swing_is_refused_with_its_place(
    tmp_path: Path, time: np.ndarray, turning: bool
) -> None:
    x = scipy_decay(time, FORCES, 2.5, 0.0)[0] + 2e-3 * np.random.default_rng(1).standard_normal(len(time))
    rig = cid.read_rig(folder(tmp_path, time, x))
    with pytest.raises(InputError, match="must pass its rest position at least 2 times") as refused:
        cid.fit(rig, budget=None)
    assert (refused.value.file, refused.value.line) == ("decay.csv", 2)
    if turning:
        # The remedy for rows that are turning points.
        result = cid.fit(cid.read_rig(folder(tmp_path, time, x, 'samples = "turning_points"')), budget=None)
        row = result.summary.loc["c"]
        assert abs(row["map"] - FORCES["c"]) < 4.0 * row["standard_error"]


def test_turning_points_have_no_drift(tmp_path: Path) -> None:
    time, x = turning_points(True, {}, 1)
    with pytest.raises(InputError, match="turning points have white noise and no drift"):
        read_rig(folder(tmp_path, time, x, 'samples = "turning_points"\ndrift = "linear"'))


def test_an_uneven_record_has_no_estimate_by_the_paper(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    time = np.sort(rng.uniform(0.0, 12.0, 200))
    x = scipy_decay(time, FORCES, 2.5, 0.0)[0] + NOISE * rng.standard_normal(200)
    result = cid.fit(cid.read_rig(folder(tmp_path, time, x)), budget=None)
    row = result.summary.loc["k1"]
    assert np.isnan(row["paper"])
    assert abs(row["map"] - FORCES["k1"]) < 4.0 * row["standard_error"]


def checked(both: bool, extra: dict[str, float], seed: int, path: Path, words: str = "") -> tuple[list[Finding], Any]:
    """Findings on forces and halves at the fit, and the experiment."""
    rig = read_rig(
        folder(path / f"{both}{seed}", *turning_points(both, extra, seed), f'samples = "turning_points"\n{words}')
    )
    (own,) = make_experiments(rig)
    values: Any = SimpleNamespace(values={**point_fit(LogPosterior(rig, [own]), 0).values, "m1": 1.0})
    return [f for check in own.checks for f in check([own], values)], own


def test_turning_points_without_misfit_pass(tmp_path: Path) -> None:
    """Sixteen tables, two findings each: at most one above 3 joint sds, none above 4."""
    found = [checked(both, {}, seed, tmp_path)[0] for both in (True, False) for seed in range(8)]
    assert all([one.code for one in each] == ["decays.forces", "decays.halves"] for each in found)
    assert sum(one.level != "ok" for each in found for one in each) <= 1
    assert all(one.level != "fail" for each in found for one in each)


@pytest.mark.parametrize(
    ("extra", "line"),
    [({"k_cubic": -0.3}, 'stiffness = "cubic"'), ({"F_dry": 0.3}, 'damping = ["viscous", "dry"]')],
    ids=str,
)
def test_a_force_that_is_missing_fails_and_the_line_mends_it(
    tmp_path: Path, extra: dict[str, float], line: str
) -> None:
    """Before: a softening spring was trusted, with a stiffness between those of the halves, twelve sds from either."""
    found, own = checked(True, extra, 2, tmp_path)
    assert (found[0].code, found[0].level, found[0].facts["line"]) == ("decays.forces", "fail", line)
    assert line in finding_text(found[0], messages_of(default_registry()))
    mended, _ = checked(True, extra, 2, tmp_path / "mended", line)
    assert [one.level for one in mended] == ["ok", "ok"]
    # A mass known to 20 % makes such a change small beside the quoted sds.
    uncertain = TurningPoints(own.table, replace(own.rig, m1=Quantity(1.0, 0.2)))
    values: Any = SimpleNamespace(values={**point_fit(LogPosterior(own.rig, [own]), 0).values, "m1": 1.0})
    assert check_forces_of_points([own], values)[0].level == "fail"
    assert check_forces_of_points([uncertain], values)[0].level == ("warn" if "k_cubic" in extra else "fail")


def test_turning_points_at_unequal_times_are_refused(tmp_path: Path) -> None:
    """Before: amplitudes of releases at 5 to 82 s gave a stiffness 138 times too small."""
    time, x = turning_points(True, {}, 1)
    time[6:] += 0.4 * np.median(np.diff(time))
    with pytest.raises(InputError, match="must follow each other by one time") as refused:
        cid.fit(cid.read_rig(folder(tmp_path, time, x, 'samples = "turning_points"')), budget=None)
    assert (refused.value.file, refused.value.line) == ("decay.csv", 8)
    # A turning point that was not read is no fault.
    time, x = turning_points(True, {}, 1)
    rig = cid.read_rig(folder(tmp_path / "missed", np.delete(time, 4), np.delete(x, 4), 'samples = "turning_points"'))
    assert len(make_experiments(rig)) == 1
