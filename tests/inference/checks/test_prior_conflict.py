"""A prior or weighing that the data contradict fails; each remedy in its text is applied and helps."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.checks.posterior import conflicts
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior
from capsule_id.rig.model import Rig
from capsule_id.synthetic import synthesize
from tests.experiments.bench import column, rig, table
from tests.measured.folders import Entry, make_rig

FACTOR = 1.05
WIDTH = np.log(FACTOR) / stats.norm.ppf(0.975)
CURRENT = np.linspace(0.5, 2.0, 6)
FORCE_SD = 0.05


def calibration(rng: np.random.Generator, median: float, K: float) -> SampledFit:
    """A motor with exact currents and stated errors, and a prior of K."""
    force = K * CURRENT + FORCE_SD * rng.standard_normal(6)
    columns = [column("force", force, FORCE_SD), column("current", CURRENT, 1e-9)]
    known = rig(table("motor_current", columns), priors={"K": Prior("lognormal", median, FACTOR)})
    target = LogPosterior(known, make_experiments(known))
    fit = point_fit(target, 0, 1)
    return SampledFit(target, fit, None, {**target.fixed, **fit.values})


def test_the_distance_is_that_of_prior_and_least_squares() -> None:
    fitted = calibration(np.random.default_rng(0), 2.0, 2.2)
    (experiment,) = fitted.experiments
    slope, covariance = np.polyfit(CURRENT, experiment.observed, 1, w=np.full(6, 1.0 / FORCE_SD), cov="unscaled")
    value, sd = slope[0], np.sqrt(covariance[0, 0])
    found = conflicts(fitted)["K"]
    assert (found["value"], found["sd"]) == pytest.approx((value, sd), rel=0.08)  # curvature of the logarithm
    assert found["z"] == pytest.approx(np.log(value / 2.0) / np.hypot(sd / value, WIDTH), rel=0.08)


@pytest.mark.full
def test_the_distance_is_standard_normal_where_prior_and_data_agree() -> None:
    rng = np.random.default_rng(1)
    z = [conflicts(calibration(rng, 2.0, 2.0 * np.exp(WIDTH * rng.standard_normal())))["K"]["z"] for _ in range(60)]
    assert stats.kstest(z, "norm").pvalue > 1e-3
    assert max(np.abs(z)) < 3.5


def twin(prior: str = "") -> Callable[[Path], Rig]:
    """The decays of the default bench with one line of [prior]."""

    def make(folder: Path) -> Rig:
        synthesize(folder, 3)
        file = folder / "rig.toml"
        head, *entries = file.read_text().split("\n[[experiment]]")
        decays = [entry for entry in entries if "free_vibration" in entry]
        file.write_text("\n[[experiment]]".join([f"{head}\n[prior]\n{prior}\n", *decays]))
        return cid.read_rig(folder)

    return make


MOTOR = Entry(
    "motor_current", "motor", {"current [A]": CURRENT, "force [N]": 2.0 * CURRENT + 0.03 * np.cos(5.0 * CURRENT)}
)
TILT = Entry("static_friction", "tilt", {"angle [deg]": np.array([33.1, 33.6, 33.4, 32.9])})


def tilts(angle: float, prior: str = "") -> Callable[[Path], Rig]:
    entry = Entry("static_friction", "tilt", {"angle [deg]": angle * np.array([1.0, 1.1, 0.9, 1.0])})
    return _with_prior(entry, prior)


def pushes(prior: str = "") -> Callable[[Path], Rig]:
    """Distances in km under the label mm."""
    distance = 1e-6 * np.array([14.0, 30.0, 55.0, 90.0, 140.0])
    columns = {"speed [m/s]": np.array([0.3, 0.5, 0.7, 0.9, 1.1]), "distance [mm]": distance}
    return _with_prior(Entry("dynamic_friction", "push", columns), prior)


def _with_prior(entry: Entry, prior: str) -> Callable[[Path], Rig]:
    def make(folder: Path) -> Rig:
        made = make_rig(folder, entry)
        if not prior:
            return made
        file = folder / "rig.toml"
        file.write_text(file.read_text().replace("\n[[experiment]]", f"\n[prior]\n{prior}\n[[experiment]]", 1))
        return cid.read_rig(folder)

    return make


def fit(make: Callable[[Path], Rig], folder: Path, budget: int | None = None) -> tuple[Fit, list[str]]:
    """The fit, and the texts of its conflicts."""
    result = cid.fit(make(folder), budget=budget)
    return result, [result.text(f) for f in result.findings if f.code == "priors.conflict" and f.level == "fail"]


K1_WRONG = 'k1 = { median = 1000, factor = 1.01, unit = "N/m" }'


@pytest.mark.full
def test_a_wrong_prior_that_moves_a_weighing_fails_without_and_with_a_sample(tmp_path: Path) -> None:
    for name, budget in (("point", None), ("sample", 2_000)):
        result, texts = fit(twin(K1_WRONG), tmp_path / name, budget)
        assert any("[prior] k1" in text and "free_vibration_1" in text for text in texts)
        assert any("[rig] m1" in text for text in texts)
        assert not result.clean
        assert {name for name in ("k1", "c", "m1") if result.summary.at[name, "trust"] == "not trusted"} == {
            "k1",
            "c",
            "m1",
        }
    assert fit(twin(), tmp_path / "removed")[1] == []


@pytest.mark.parametrize(
    ("entry", "prior", "right"),
    [
        (MOTOR, 'K = { median = 2, factor = 3, unit = "mN/A" }', 'K = { median = 2, factor = 3, unit = "N/A" }'),
        (TILT, 'mu = { median = 66, factor = 1.5, unit = "1" }', 'mu = { median = 0.66, factor = 1.5, unit = "1" }'),
    ],
)
def test_a_prior_in_a_wrong_unit_fails_and_in_the_right_one_passes(
    tmp_path: Path, entry: Entry, prior: str, right: str
) -> None:
    result, (text,) = fit(_with_prior(entry, prior), tmp_path / "wrong")
    assert result.trust == "not trusted"
    assert "Check value and unit of [prior]" in text
    assert fit(_with_prior(entry, right), tmp_path / "right")[1] == []


@pytest.mark.full
@pytest.mark.parametrize("rows", [tilts, pushes], ids=["tilts of 1e-9 degrees", "pushes in km"])
def test_readings_that_the_default_prior_excludes_fail(
    tmp_path: Path, rows: Callable[..., Callable[[Path], Rig]]
) -> None:
    make = tilts(1e-9) if rows is tilts else pushes()
    result, texts = fit(make, tmp_path / "default")
    assert result.trust == "not trusted"
    (text,) = [text for text in texts if "the default prior of mu" in text]
    if rows is pushes:
        # A wrong unit explains them: no prior is proposed before rig.toml confirms the units.
        assert "Check the units in" in text
        assert "[prior]" not in text
        confirmed = replace(make(tmp_path / "again"), confirmed=("push.speed", "push.distance"))
        (text,) = [text for text in fit(lambda folder: confirmed, tmp_path)[1] if "the default prior of mu" in text]
        # The prior that the text proposes is accepted and ends the conflict.
        proposed = re.findall(r"write in \[prior\] (mu = \{.*?\})", text)[0]
        # Speeds of km/s scatter more than usual ones, too.
        assert not any("prior of mu " in text for text in fit(pushes(proposed), tmp_path / "stated")[1])


def scattered(degrees: float, prior: str = "") -> Callable[[Path], Rig]:
    """Ten tilts whose scatter is exactly ``degrees``."""
    z = np.random.default_rng(2).standard_normal(10)
    angle = 24.0 + degrees * (z - np.mean(z)) / np.std(z, ddof=1)
    return _with_prior(Entry("static_friction", "tilts", {"angle [deg]": angle}), prior)


def test_a_scatter_far_above_its_default_prior_is_not_trusted(tmp_path: Path) -> None:
    """Before: trusted, with an sd 30 % short of that of the mean; a warning named the prior."""
    result, (text,) = fit(scattered(3.7), tmp_path / "default")
    assert "the default prior of tilt_sd" in text
    assert result.summary.at["mu", "trust"] == "not trusted"
    proposed = re.findall(r"write in \[prior\] (tilt_sd = \{.*?\})", text)[0]
    stated, texts = fit(scattered(3.7, proposed), tmp_path / "stated")
    assert texts == []
    of_mean = np.deg2rad(3.7) / np.sqrt(10.0) / np.cos(np.deg2rad(24.0)) ** 2
    assert stated.summary.at["mu", "sd"] == pytest.approx(of_mean, rel=0.15)
    assert result.summary.at["mu", "sd"] < 0.8 * of_mean
    # negative control: a usual scatter
    assert fit(scattered(1.0), tmp_path / "usual")[1] == []


def test_a_stated_prior_of_a_scatter_that_pulls_is_still_named(tmp_path: Path) -> None:
    result, texts = fit(scattered(1.8, 'tilt_sd = { scale = 0.55, unit = "deg" }'), tmp_path)
    assert texts == []
    (tails,) = [finding for finding in result.findings if finding.code == "priors.tails"]
    assert (tails.level, tails.facts["names"]) == ("warn", "tilt_sd")
