"""Viscous decays of any damping: the search for them, what is refused, and models that contain others."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.errors import InputError
from capsule_id.experiments.base import Fitted
from capsule_id.experiments.free_vibration import decrement
from capsule_id.experiments.free_vibration.decrement import (
    decay_frequency,
    likelihood_gain,
    viscous_fit,
)
from capsule_id.experiments.free_vibration.experiment import FreeVibration, check_aliases
from capsule_id.experiments.free_vibration.screening import Screening
from capsule_id.experiments.free_vibration.second_fit import open_models, rank
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.inference.sampling import DEFAULT_BUDGET
from tests.experiments import bench, random_decays
from tests.experiments.test_second_fit import SPRING_FORCE, record
from tests.scipy_decay import scipy_decay


def viscous(time: np.ndarray, k1: float, c: float, m1: float) -> np.ndarray:
    """(n,) unit release from rest, from the roots of the characteristic polynomial."""
    slow, fast = np.roots([m1, c, k1]).astype(complex)
    if abs(slow - fast) < 1e-6 * abs(slow):
        return np.real((1.0 - slow * time) * np.exp(slow * time))
    return np.real((fast * np.exp(slow * time) - slow * np.exp(fast * time)) / (fast - slow))


def folder(path: Path, time: np.ndarray, x: np.ndarray, m1: float, entry: str = "") -> Path:
    """A rig folder with one decay; x in m."""
    path.mkdir(parents=True, exist_ok=True)
    (path / "rig.toml").write_text(
        f'[rig]\nname = "decay"\nm1 = {{ value = {m1}, sd = {1e-6 * m1}, unit = "kg" }}\n'
        f'[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n{entry}\n'
    )
    rows = (f"{t:.9g},{1e3 * value:.9g}\n" for t, value in zip(time, x, strict=True))
    (path / "d.csv").write_text("time [s],x_rel [mm]\n" + "".join(rows))
    return path


def twin(
    ratio: float, seed: int, samples: int = 500, noise: float = 0.005
) -> tuple[np.ndarray, np.ndarray, float, float, float]:
    """Time, x_rel, k1, c, m1 of a random viscous decay, released at rest at its first sample."""
    rng = np.random.default_rng([int(100 * ratio), seed])
    m1, omega = 10 ** rng.uniform(-1.3, 0.3), 2.0 * np.pi * 10 ** rng.uniform(-0.3, 1.3)
    k1, c = m1 * omega**2, 2.0 * ratio * omega * m1
    time = np.linspace(0.0, rng.uniform(1.0, 4.0) * max(1.0, ratio) * 2.0 * np.pi / omega, samples)
    size = 10 ** rng.uniform(-3.5, -2.0)
    return time, size * (viscous(time, k1, c, m1) + noise * rng.standard_normal(samples)), k1, c, m1


def test_the_periods_of_a_strongly_damped_decay_are_counted(tmp_path: Path) -> None:
    """Fourteen periods of damping ratio 0.6, whose spectrum has no peak. (Before: "1 period", and an alias at 1 N/m.)"""
    rng, omega = np.random.default_rng(8), 20.0
    time = np.linspace(0.0, 14.0 * 2.0 * np.pi / omega, 1000)
    x = 1e-3 * (viscous(time, omega**2, 1.2 * omega, 1.0) + 0.005 * rng.standard_normal(len(time)))
    assert decay_frequency(time, x) == pytest.approx(omega / (2.0 * np.pi), rel=0.03)
    rig, kinds = cid.read_rig(folder(tmp_path / "rig", time, x, 1.0)), default_registry()
    found = lint(rig, kinds, rig.tables)
    assert "decays.length" not in {finding.code for finding in found}


@pytest.mark.full
@pytest.mark.parametrize("samples", [12, 40, 500])
def test_the_search_finds_a_decay_of_any_damping(samples: int) -> None:
    """60 decays of 0.7 to 40 periods: the residuals are those of the noise. (Before: rough values from zero crossings.)"""
    rng = np.random.default_rng(samples)
    for _ in range(60):
        ratio, omega = 10 ** rng.uniform(-2.5, 0.4), 2.0 * np.pi * 10 ** rng.uniform(-1.0, 2.0)
        periods = min(rng.uniform(0.7, 40.0), samples / 5.0, 2.0 / ratio, 2.0 / min(ratio, 1.0 / ratio))
        time = np.linspace(0.0, periods * 2.0 * np.pi / omega, samples)
        noise = 10 ** rng.uniform(-3.0, -1.5)
        x = viscous(time, omega**2, 2.0 * ratio * omega, 1.0) + rng.uniform(-1.0, 1.0)
        found = viscous_fit(time, x + noise * rng.standard_normal(samples))
        assert np.std(found.left) < 1.3 * noise
        rough = found.decrement(1.0)
        assert np.isfinite([rough.k1, rough.c, rough.Omega_o, *rough.times, *rough.peaks]).all()


def test_the_rough_values_name_the_last_turning_point_before_the_record() -> None:
    time = np.linspace(0.0, 1.0, 200) + 0.05
    found = viscous_fit(time, viscous(time, 400.0, 8.0, 1.0)).decrement(1.0)
    assert (found.k1, found.c) == pytest.approx((400.0, 8.0), rel=1e-6)
    assert (found.times[0], found.peaks[0]) == pytest.approx((-0.05, 1.0), rel=1e-6)


def check(path: Path) -> None:
    rig = cid.read_rig(path)
    default_registry()["free_vibration"].check(rig.tables)


@pytest.mark.full
def test_friction_that_ends_the_first_stroke_is_named_and_damping_is_not(tmp_path: Path) -> None:
    """20 rods that dry friction holds are refused by name; 20 viscous ones, most of which never swing, are accepted."""
    rng = np.random.default_rng(7)
    for i in range(20):
        omega, samples, m1 = 2.0 * np.pi * 10 ** rng.uniform(-0.5, 1.5), int(rng.choice([100, 200, 500])), 0.3
        time = np.linspace(0.0, rng.uniform(0.8, 3.0) * 2.0 * np.pi / omega, samples)
        k1, c = m1 * omega**2, 2.0 * rng.uniform(0.0, 0.5) * omega * m1
        held = scipy_decay(time, {"k1": k1, "c": c, "m1": m1, "F_dry": rng.uniform(0.35, 0.8) * k1}, 1.0, 0.0)[0]
        x = 1e-2 * (held + 10 ** rng.uniform(-3.0, -2.0) * rng.standard_normal(samples))
        with pytest.raises(InputError, match="dry friction holds the rod"):
            check(folder(tmp_path / f"held_{i}", time, x, m1))
        time, x, _, _, m1 = twin(rng.uniform(0.65, 2.0), i)
        check(folder(tmp_path / f"viscous_{i}", time, x, m1))


@pytest.mark.full
def test_one_exponential_gives_no_stiffness(tmp_path: Path) -> None:
    """Amplitudes of turning points that are read as a record, or a rod so damped that its first motion is not recorded."""
    time = np.arange(12.0)
    x = 1e-3 * (np.exp(-0.3 * time) + 1e-3 * np.random.default_rng(1).standard_normal(12))
    with pytest.raises(InputError, match='state samples = "turning_points"'):
        check(folder(tmp_path / "peaks", time, x, 0.1))
    check(folder(tmp_path / "stated", time, x, 0.1, 'samples = "turning_points"'))
    dense = np.linspace(0.0, 3.0, 300)
    swinging = viscous(dense, 9.0, 9.0, 1.0)
    assert likelihood_gain(viscous_fit(dense, swinging, 1), viscous_fit(dense, swinging)) > 100.0


@pytest.mark.full
def test_further_forces_of_a_rod_that_does_not_swing_are_refused(tmp_path: Path) -> None:
    time, x, _, _, m1 = twin(1.2, 0)
    with pytest.raises(InputError, match="further forces need a damping ratio below"):
        check(folder(tmp_path / "dry", time, x, m1, 'damping = ["viscous", "dry"]'))
    check(folder(tmp_path / "viscous", time, x, m1, 'damping = "viscous"'))


VISCOUS_LINEAR = 'damping = "viscous"\nstiffness = "linear"\nnoise = "white"\ndrift = "none"'


@pytest.mark.parametrize(("ratio", "words"), [pytest.param(0.6, "", marks=pytest.mark.full), (1.0, VISCOUS_LINEAR)])
def test_a_strongly_damped_decay_is_fitted(tmp_path: Path, ratio: float, words: str) -> None:
    """(Before: k1 = 5.5 ± 6.0 for 987 with a clean verdict at 0.6, refused at 1.0.)"""
    time, x, k1, c, m1 = twin(ratio, 1)
    result = cid.fit(cid.read_rig(folder(tmp_path, time, x, m1, words)), budget=None)
    assert [f.code for f in result.findings if f.level == "fail"] == []
    for name, truth in (("k1", k1), ("c", c)):
        row = result.summary.loc[name]
        assert abs(float(row["value"]) - truth) < 3.0 * float(row["sd"])
        assert float(row["sd"]) < 0.1 * truth
    assert np.isnan(result.summary.loc["k1", "paper"])


def test_the_interval_of_a_decay_that_does_not_swing_holds_forces_that_it_cannot_show(tmp_path: Path) -> None:
    """A cubic spring at ratio 0.9, whose residuals are white. (Before: k1 38 % too large, 23 sd off, and trusted.)"""
    time, _, k1, c, m1 = twin(0.9, 1)
    forces = {"k1": k1, "c": c, "m1": m1, "k_cubic": 0.3 * k1}
    x = 1e-3 * (scipy_decay(time, forces, 1.0, 0.0)[0] + 0.005 * np.random.default_rng(1).standard_normal(len(time)))
    open_words = cid.fit(cid.read_rig(folder(tmp_path / "open", time, x, m1)), budget=None)
    for name, truth in (("k1", k1), ("c", c)):
        row = open_words.summary.loc[name]
        assert abs(row["value"] - truth) < 2.0 * row["sd"]
        assert row["sd"] > 5.0 * row["sd_unwidened"]
        (found,) = (f for f in open_words.findings if f.code == "decays.hidden" and f.facts["name"] == name)
        assert found.facts["low"] < truth < found.facts["high"]
        assert "The quoted interval holds that." in open_words.text(found)
    # Who states the words answers for them; and what the interval holds is what was wrong before.
    stated = cid.fit(cid.read_rig(folder(tmp_path / "stated", time, x, m1, VISCOUS_LINEAR)), budget=None)
    assert "sd_unwidened" not in stated.summary or np.isnan(stated.summary.at["k1", "sd_unwidened"])
    assert abs(stated.summary.at["k1", "value"] - k1) > 10.0 * stated.summary.at["k1", "sd"]


@pytest.mark.parametrize(("seed", "remedy"), [(1, False), (3, True), (4, True)])
@pytest.mark.full
def test_a_hold_that_the_readings_do_not_show_is_held_by_the_interval(tmp_path: Path, seed: int, remedy: bool) -> None:
    """Released, caught again at 0.6 of the amplitude, held a quarter of a period; noise 2 %. A part of the hold stays in.

    (Before: k1 = 25.2 ± 1.1 for 39.5, and trusted.)
    """
    rng, k1, c = np.random.default_rng(seed), (2.0 * np.pi) ** 2, 2.32 * np.pi
    time = np.arange(150) / 40.0
    last = 0.6 * viscous(np.maximum(time - 0.5, 0.0), k1, c, 1.0)
    x = np.where(time < 0.25, viscous(time, k1, c, 1.0), last) + 0.02 * rng.standard_normal(len(time))
    result = cid.fit(cid.read_rig(folder(tmp_path, time, 1e-3 * x, 1.0)), budget=None)
    for name, truth in (("k1", k1), ("c", c)):
        (found,) = (f for f in result.findings if f.code == "decays.held" and f.facts["name"] == name)
        assert found.facts["low"] < truth < found.facts["high"]
        assert result.summary.at[name, "sd"] > 3.0 * result.summary.at[name, "sd_unwidened"]
    # The remedy, with the instant of the release that the bench knows.
    stated = cid.fit(
        cid.read_rig(folder(tmp_path / "stated", time, 1e-3 * x, 1.0, 'start = { value = 0.5, unit = "s" }')),
        budget=None,
    )
    assert "decays.held" not in {f.code for f in stated.findings}
    assert abs(stated.summary.at["k1", "value"] - k1) < 3.0 * stated.summary.at["k1", "sd"]


@pytest.mark.full
def test_a_known_release_leaves_the_interval_as_it_is(tmp_path: Path) -> None:
    """Control: noise 0.5 %, after a hold and without one."""
    k1, c = (2.0 * np.pi) ** 2, 1.6 * np.pi
    for hold in (0.0, 0.6):
        time = np.arange(int(60 * (hold + 4.0))) / 60.0
        x = viscous(np.maximum(time - hold, 0.0), k1, c, 1.0) + 0.005 * np.random.default_rng(1).standard_normal(
            len(time)
        )
        result = cid.fit(cid.read_rig(folder(tmp_path / str(hold), time, 1e-3 * x, 1.0)), budget=None)
        assert [f.level for f in result.findings if f.code == "decays.held"] == ["ok"]
        assert abs(result.summary.at["k1", "value"] - k1) < 3.0 * result.summary.at["k1", "sd"]


def test_a_small_change_counts_where_a_decay_does_not_swing(tmp_path: Path) -> None:
    """A clean decay of ratio 0.9, whose c further forces may change by less than 20 %: the interval holds that too."""
    time, x, k1, c, m1 = twin(0.9, 4)
    result = cid.fit(cid.read_rig(folder(tmp_path, time, x, m1)), budget=None)
    found = {f.facts["name"]: f.facts for f in result.findings if f.code == "decays.hidden"}
    assert found.keys() == {"k1", "c"}
    assert 0.8 * c < found["c"]["low"] < c < found["c"]["high"] < 1.2 * c
    assert found["k1"]["low"] < k1 < found["k1"]["high"]


def asked(path: Path) -> str:
    """The line of ``[prior]`` for which a check of the rig folder asks, "" where it asks for none."""
    rig, kinds = cid.read_rig(path), default_registry()
    others = [found.facts["other"] for found in lint(rig, kinds, rig.tables) if found.code == "decays.sampling"]
    return next((found[0] for other in others if (found := re.search("k1 = {.*}", other))), "")


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.3, 0.6, 0.9, 1.0, 1.5])
def test_decays_of_any_damping_are_covered(tmp_path: Path, ratio: float) -> None:
    """20 twins, sampled: at most 2 are not trusted, and of the others 95 % intervals of k1 and c hold the truth in 17.

    Where even samples have an alias inside the default prior of k1, the line for which the check asks is stated.
    """
    inside, untrusted, lines = {"k1": 0, "c": 0}, 0, 0
    for seed in range(20):
        time, x, k1, c, m1 = twin(ratio, seed)
        path = folder(tmp_path / str(seed), time, x, m1)
        if line := asked(path):
            lines += 1
            with (path / "rig.toml").open("a") as file:
                file.write(f"[prior]\n{line}\n")
        try:
            rows = cid.fit(cid.read_rig(path), seed=seed).summary.loc[["k1", "c"]]
        except InputError:  # 1 of 300 seems to be held by dry friction
            untrusted += 1
            continue
        if set(rows["trust"]) != {"trusted"}:
            untrusted += 1
            continue
        for (name, row), truth in zip(rows.iterrows(), (k1, c), strict=True):
            inside[name] += bool(row["lower"] <= truth <= row["upper"])
            print(ratio, seed, name, row["lower"], truth, row["upper"])
    print(ratio, inside, untrusted, lines)
    assert untrusted <= 2
    assert min(inside.values()) >= 17 - untrusted


@pytest.mark.full
def test_a_richer_model_is_never_worse_than_one_that_it_contains() -> None:
    """A decay with dry friction, ranked under every sum of forces; (before: richer models ended above nested ones)."""
    screenings = [Screening(record(0.0, {"F_dry": 0.02 * SPRING_FORCE}))]
    forces, _ = open_models(record(0.0))
    ranked = rank(screenings, forces)
    pairs = [(one, other) for one in ranked for other in ranked if one.model.terms < other.model.terms]
    assert len(pairs) == 19
    for one, other in pairs:
        assert other.fits[0][0].noise <= one.fits[0][0].noise * (1.0 + 1e-9)
    # Every fit keeps the values of the fits that it contains, from which the quoted fit starts too.
    assert [len(one.fits[0][0].nested) for one in sorted(ranked, key=lambda one: len(one.model.terms))] == [
        0,
        1,
        1,
        1,
        3,
        3,
        3,
        7,
    ]


def test_a_drift_larger_than_the_motion_is_no_model() -> None:
    """A slow motion by hand of twenty times the decay: no drift takes up the motion that is left."""
    slow = 400.0 * np.sin(np.linspace(0.0, 2.0, 250))
    screening = Screening(record(slow))
    models = [model for model in open_models(record(slow))[1] if model.drift == "gp"]
    ranked = rank([screening], models)
    assert all(np.isinf(one.bic) for one in ranked if screening.drowned(one.fits[0][1]))
    assert any(np.isinf(one.bic) for one in ranked)
    # Control: a small drift is a model.
    small = Screening(record(slow / 100.0))
    assert all(np.isfinite(one.bic) for one in rank([small], models))


@pytest.mark.full
@pytest.mark.parametrize("seed", [10, 17, 32, *(pytest.param(s, marks=pytest.mark.slow) for s in (6, 74, 107, 118))])
def test_a_random_decay_ends_with_a_verdict_or_is_refused(tmp_path: Path, seed: int) -> None:
    outcome(tmp_path, seed, None)


@pytest.mark.full
@pytest.mark.parametrize(
    "seed",
    [1021, *(pytest.param(s, marks=pytest.mark.slow) for s in (1039, 1057, 1071, 1076, 1078, 1083, 1113, 1123, 1131))],
)
def test_a_random_decay_is_sampled_to_its_verdict(tmp_path: Path, seed: int) -> None:
    """Three readings left for the paper's estimate, and readings without noise (before: a warning, an internal failure).

    Also draws and fits far off, whose squares, pivots and responses leave the range of numbers.
    """
    outcome(tmp_path, seed, DEFAULT_BUDGET)


def outcome(path: Path, seed: int, budget: int | None) -> str:
    """Fit the record ``seed``; it must not end in an error, in a warning, or with numbers that are not finite."""
    rig = random_decays.write(path, seed)
    try:
        result = cid.fit(cid.read_rig(rig), budget=budget)
    except InputError as error:
        return f"refused: {error}"
    given = result.summary.loc[result.summary["trust"] != "not trusted", ["value", "sd"]].to_numpy(float)
    assert np.isfinite(given).all()
    assert not np.isinf(result.summary[["value", "sd"]].to_numpy(float)).any()
    return " ".join(result.summary["trust"])


@pytest.mark.slow
def test_a_thousand_random_decays_end_with_a_verdict(tmp_path: Path) -> None:
    counts: dict[str, int] = {}
    for seed in range(1000):
        words = outcome(tmp_path / str(seed), seed, None).split(":")[0]
        counts[words] = counts.get(words, 0) + 1
    print(json.dumps(counts))
    assert sum(counts.values()) == 1000


@pytest.mark.slow
def test_random_decays_are_sampled(tmp_path: Path) -> None:
    words = [outcome(tmp_path / str(seed), seed, DEFAULT_BUDGET) for seed in range(1000, 1150)]
    assert len(words) == 150


@pytest.mark.full
def test_readings_without_noise_end_with_a_verdict(tmp_path: Path) -> None:
    """k1/m1 of more digits than a covariance holds. (Before: a matrix that is not positive definite.)"""
    time, k1, c, m1 = np.arange(200) / 2000.0, 53946.0, 4.4, 0.11
    rig = folder(tmp_path, time, 1e-3 * viscous(time, k1, c, m1), m1)
    np.savez(tmp_path / "d.npz", time=time, x=viscous(time, k1, c, m1))
    text = re.sub("sd = [^,]*", "sd = 1e-4", (rig / "rig.toml").read_text()).replace("d.csv", "d.npz")
    columns = '{ time = { from = "time", unit = "s" }, x_rel = { from = "x", unit = "mm" } }'
    (rig / "rig.toml").write_text(f"{text}columns = {columns}\n")
    row = cid.fit(cid.read_rig(rig)).summary.loc["k1"]
    assert row["value"] == pytest.approx(k1, abs=3.0 * row["sd"])
    assert row["sd"] == pytest.approx(k1 * 1e-4 / m1, rel=0.15)


def test_m1_is_not_the_mass_of_the_record(tmp_path: Path) -> None:
    """Negative control of the coverage: a mass 10 % off moves k1 out of its interval."""
    time, x, k1, _, m1 = twin(0.6, 1)
    summary = cid.fit(cid.read_rig(folder(tmp_path, time, x, 1.1 * m1)), budget=None).summary
    assert abs(summary.loc["k1", "value"] - k1) > 5.0 * summary.loc["k1", "sd"]


@pytest.mark.full
def test_a_step_after_rest_is_no_clipped_record_and_its_rounding_no_wrong_model(tmp_path: Path) -> None:
    """Readings in steps of 10 um of rest, then of a decay that comes to rest. Before: clipped, or an sd times 167."""
    time, k1, c, m1 = np.arange(600) / 1000.0, 245.062, 5.192, 0.11
    step = np.where(time < 0.1, 0.0, 1.0 - viscous(np.maximum(time - 0.1, 0.0), k1, c, m1))
    noise = 0.7e-6 * np.random.default_rng(1).standard_normal(len(time))
    x = 1e-5 * np.round((8e-3 * step + noise) / 1e-5)
    result = cid.fit(cid.read_rig(folder(tmp_path / "a", time, x, m1)), budget=None)
    assert [f.code for f in result.findings if f.level == "fail"] == []
    assert result.summary.at["k1", "value"] == pytest.approx(k1, abs=3.0 * float(result.summary.at["k1", "sd"]))
    assert float(result.summary.at["k1", "sd"]) < 0.01 * k1
    # Negative control: peaks that end at a limit are clipped.
    clipped = folder(tmp_path / "b", time, np.minimum(x, 8.5e-3), m1)
    again = cid.fit(cid.read_rig(clipped), budget=None)
    assert "readings.clipped" in [f.code for f in again.findings if f.level == "fail"]


def test_the_rest_of_an_overdamped_decay_is_not_clipped(tmp_path: Path) -> None:
    """Steps of 10 um without noise. (Before: clipped at its lower limit, with a start at the last sample as remedy.)"""
    time, k1, c, m1 = np.arange(1000) / 2000.0, 0.11 * (36.0 * np.pi) ** 2, 2.4 * 0.11 * 36.0 * np.pi, 0.11
    x = 1e-5 * np.round(2e-3 * viscous(time, k1, c, m1) / 1e-5)
    rig, kinds = cid.read_rig(folder(tmp_path / "rest", time, x, m1)), default_registry()
    assert [found.code for found in lint(rig, kinds, rig.tables) if found.level == "fail"] == []
    # Control: the peak after a blow is clipped, and its rest lies at the other limit.
    struck = -np.gradient(viscous(time, k1, c, m1))
    struck = 1e-5 * np.round(2e-3 * np.minimum(struck / np.max(struck), 0.7) / 1e-5)
    rig = cid.read_rig(folder(tmp_path / "blow", time, struck, m1))
    assert "readings.clipped" in {found.code for found in lint(rig, kinds, rig.tables)}


@pytest.mark.full
def test_no_start_is_proposed_that_leaves_too_few_samples(tmp_path: Path) -> None:
    """Swings with clipped peaks, whose last clipped sample stands before 3 samples, or before 11."""
    time = np.arange(1050) / 1000.0
    swings = np.minimum(np.cos(20.0 * np.pi * time), 0.9)
    last = int(np.flatnonzero(swings == 0.9)[-1])
    for end, cut in ((last + 4, "Record again."), (last + 12, "start = ")):
        rig, kinds = cid.read_rig(folder(tmp_path / str(end), time[:end], 1e-3 * swings[:end], 0.1)), default_registry()
        (found,) = (one for one in lint(rig, kinds, rig.tables) if one.code == "readings.clipped")
        assert cut in found.facts["cut"]


def test_the_alias_of_even_samples_is_told_for_the_records_that_have_it() -> None:
    """Before: the alias of the lower sampling rate for both records, the other of which excludes it."""
    records = []
    for label, rate in (("slow", 100.0), ("fast", 400.0), ("slow_too", 100.0)):
        time = np.arange(0.0, 1.0, 1.0 / rate)
        columns = [bench.column("time", time), bench.column("x_rel", bench.released(time, 2e-3))]
        table = replace(bench.table("free_vibration", columns), label=label)
        records.append(FreeVibration(table, bench.rig(table)))
    (found,) = check_aliases(records, cast(Fitted, SimpleNamespace(values={"k1": bench.K1, "m1": bench.M1})))
    assert found.facts["labels"] == "slow, slow_too"
    frequency = np.sqrt(bench.K1 / bench.M1) / (2.0 * np.pi)
    assert found.facts["other"] == pytest.approx(100.0 - frequency)


@pytest.mark.parametrize(
    ("seed", "lost"), [(1, range(90, 110)), pytest.param(3, range(60, 90), marks=pytest.mark.full)]
)
def test_a_strongly_damped_decay_has_no_jump(tmp_path: Path, seed: int, lost: range) -> None:
    """(Before: "it jumps by 0.49 of its amplitude", because the spectrum has its peak at half the frequency.)"""
    time, x, *_, m1 = twin(0.9, seed)
    rig, kinds = cid.read_rig(folder(tmp_path / "whole", time, x, m1)), default_registry()
    assert "readings.jump" not in {found.code for found in lint(rig, kinds, rig.tables)}
    # Control: samples are lost.
    kept = np.delete(np.arange(len(x)), lost)
    rig = cid.read_rig(folder(tmp_path / "lost", time[: len(kept)], x[kept], m1))
    assert "readings.jump" in {found.code for found in lint(rig, kinds, rig.tables)}


@pytest.mark.full
def test_a_blow_on_an_overdamped_rod_has_no_jump(tmp_path: Path) -> None:
    """Before: "it jumps" in all of them, because the rod is 3.7 times as fast at the blow as its period says."""
    time, kinds = np.arange(240) / 40.0, default_registry()
    motion = decrement.viscous_basis(time, (2.0 * np.pi) ** 2, 8.0 * np.pi, 1.0, np)[:, 1]
    for seed in range(4):
        x = motion / np.max(motion) + 0.005 * np.random.default_rng(seed).standard_normal(len(time))
        rig = cid.read_rig(folder(tmp_path / str(seed), time, x, 1.0))
        assert "readings.jump" not in {one.code for one in lint(rig, kinds, rig.tables)}


def test_a_light_decay_is_known_by_a_hundred_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: the search for a strong damping took 15 ms of every record of 400 samples, a third of a check."""
    sizes = list[int]()
    basis = decrement.viscous_basis
    monkeypatch.setattr(decrement, "viscous_basis", lambda *a: (found := basis(*a), sizes.append(found.size))[0])
    time = np.linspace(0.0, 0.157, 400)
    x = viscous(time, 120.0**2, 7.2, 1.0) + 0.004 * np.random.default_rng(0).standard_normal(400)
    assert decay_frequency(time, x) == pytest.approx(19.1, rel=0.05)
    assert 0 < sum(sizes) < 80_000


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.full)])
def test_a_clean_decay_in_coarse_digits_passes(tmp_path: Path, seed: int) -> None:
    """Digits of three times the noise. Before: the first half period was "louder", and each later start as well."""
    time, rng = np.arange(2000) * 5e-4, np.random.default_rng(seed)
    x = -1.92e-3 * viscous(time, 1420.0, 3.9, 0.11) + 3e-6 * rng.standard_normal(2000)
    result = cid.fit(folder(tmp_path, time, np.round(x, 5), 0.11), budget=None)
    assert list(result.failed) == []
    # k1 follows the square of a clock, c the clock.
    assert result.summary["largest_error"][["k1", "c"]].tolist() == ["2 %: clock", "1 %: clock"]
    rows = result.summary.loc[["k1", "c"]]
    assert np.all(np.abs(rows["value"] - [1420.0, 3.9]) < 4.0 * rows["sd"])


@pytest.mark.parametrize(("start", "found"), [(2.0, set()), (0.8, {"readings.repeated"})])
def test_one_record_may_hold_two_entries(tmp_path: Path, start: float, found: set[str]) -> None:
    """As the guide says. Before: "the same content, remove one of the two"; the control: parts that share readings."""
    time = np.arange(3000) * 1e-3
    x = np.concatenate([viscous(time[:1500], 1420.0, 1.0, 0.11)] * 2)
    x += 1e-3 * np.random.default_rng(0).standard_normal(3000)
    first = 'start = { value = 0, unit = "s" }\nstop = { value = 1.4, unit = "s" }\n'
    second = '[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\nlabel = "second"\n'
    second += f'start = {{ value = {start}, unit = "s" }}'
    rig = cid.read_rig(folder(tmp_path, time, 1e-3 * x, 0.11, first + second))
    codes = {finding.code for finding in lint(rig, default_registry(), rig.tables)}
    assert {code for code in codes if code.startswith("readings.repeated")} == found
