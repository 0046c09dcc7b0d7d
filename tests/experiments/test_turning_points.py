"""Turning points of a decay, and records too short or too slowly sampled for a fit."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.experiment import halves, later_start
from capsule_id.experiments.free_vibration.hidden_terms import check_held
from capsule_id.experiments.free_vibration.readings import DecayModel
from capsule_id.experiments.free_vibration.turning_points import TurningPoints, fitted, screened
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.experiments.lint import lint
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.target import LogPosterior
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.rig.model import Column, Quantity
from capsule_id.views import Finding
from tests.experiments import bench
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


@pytest.mark.full
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


@pytest.mark.full
def test_times_without_scatter_have_the_error_of_their_digits(tmp_path: Path) -> None:
    """Times that are multiples of one period, as computed from it: without an error the maximum had no end."""
    _, x = turning_points(False, {}, 3)
    period = 2.03
    settings, texts = 'samples = "turning_points"\n', []
    for stated in ("", 'time_resolution = { value = 0.01, unit = "s" }\n', 'time_sd = { value = 5, unit = "ms" }\n'):
        path = folder(tmp_path / str(len(texts)), np.round(period * np.arange(10), 2), x, settings + stated)
        result = cid.fit(read_rig(path), 0, budget=None)
        assert [f.level for f in result.findings if f.code == "starts.agree"] == ["ok"]
        assert result.summary.loc["k1", "sd"] > 9.6 * 0.01 / np.sqrt(12.0) / (9.0 * period)
        texts.append([result.text(f) for f in result.findings if f.code == "decays.step"])
    # The remedies of the text, followed, end the finding.
    assert texts[1:] == [[], []]
    assert "time_resolution or time_sd" in texts[0][0]
    assert "0.01 s" in texts[0][0]


@pytest.mark.full
@pytest.mark.parametrize(
    ("time", "turning"),
    [
        (np.arange(12) * 2.0 * np.pi / np.sqrt(9.6), True),
        (np.arange(14) / 0.494, False),
    ],
    ids=["one sample a period", "sampled at the natural frequency"],
)
def test_a_record_of_amplitudes_alone_is_refused_with_its_place(
    tmp_path: Path, time: np.ndarray, turning: bool
) -> None:
    x = scipy_decay(time, FORCES, 2.5, 0.0)[0] + 2e-3 * np.random.default_rng(1).standard_normal(len(time))
    rig = cid.read_rig(folder(tmp_path, time, x))
    with pytest.raises(InputError, match=r"one exponential in 1[24] samples, which gives c/k1 alone") as refused:
        cid.fit(rig, budget=None)
    assert (refused.value.file, refused.value.line) == ("decay.csv", 2)
    if turning:
        # The remedy for rows that are turning points.
        result = cid.fit(cid.read_rig(folder(tmp_path, time, x, 'samples = "turning_points"')), budget=None)
        row = result.summary.loc["c"]
        assert abs(row["map"] - FORCES["c"]) < 4.0 * row["standard_error"]


@pytest.mark.full
def test_a_quarter_of_a_period_is_fitted_and_not_trusted(tmp_path: Path) -> None:
    """A viscous decay alone gives a number, and no further force can be excluded. (Before: refused.)"""
    time = np.linspace(0.0, 0.5, 60)
    x = scipy_decay(time, FORCES, 2.5, 0.0)[0] + 2e-3 * np.random.default_rng(1).standard_normal(len(time))
    result = cid.fit(cid.read_rig(folder(tmp_path, time, x)), budget=None)
    row = result.summary.loc["k1"]
    assert abs(row["map"] - FORCES["k1"]) < 3.0 * row["standard_error"]
    assert row["trust"] == "not trusted"
    assert "decays.hidden" in {f.code for f in result.findings if f.level == "fail"}


def test_turning_points_have_no_drift(tmp_path: Path) -> None:
    time, x = turning_points(True, {}, 1)
    with pytest.raises(InputError, match="turning points have white noise and no drift"):
        read_rig(folder(tmp_path, time, x, 'samples = "turning_points"\ndrift = "linear"'))


@pytest.mark.full
def test_an_uneven_record_has_no_estimate_by_the_paper(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    time = np.sort(rng.uniform(0.0, 12.0, 200))
    x = scipy_decay(time, FORCES, 2.5, 0.0)[0] + NOISE * rng.standard_normal(200)
    result = cid.fit(cid.read_rig(folder(tmp_path, time, x)), budget=None)
    row = result.summary.loc["k1"]
    assert np.isnan(row["paper"])
    assert abs(row["map"] - FORCES["k1"]) < 4.0 * row["standard_error"]


def table_of(both: bool, extra: dict[str, float], seed: int, path: Path, words: str = "") -> TurningPoints:
    """The experiment of ten turning points, under the model that ``words`` state."""
    points = turning_points(both, extra, seed)
    rig = read_rig(folder(path / f"{both}{seed}", *points, f'samples = "turning_points"\n{words}'))
    return cast(TurningPoints, make_experiments(rig)[0])


def checked(e: TurningPoints) -> list[Finding]:
    """Findings of all checks at the fit."""
    theta = fitted(e)
    values: Any = SimpleNamespace(values={"m1": 1.0, **{row.name: theta[row.symbol] for row in e.parameters}})
    return [finding for check in e.checks for finding in check([e], values)]


@pytest.mark.full
def test_the_fit_of_one_table_is_the_point_fit(tmp_path: Path) -> None:
    e = table_of(True, {"F_dry": 0.3}, 3, tmp_path, 'damping = "dry"')
    fit, theta = point_fit(LogPosterior(e.rig, [e]), 0), fitted(e)
    for symbol in ("k1", "c", "F_dry"):
        assert theta[symbol] == pytest.approx(fit.values[symbol], abs=0.3 * fit.standard_errors[symbol])


@pytest.mark.full
def test_turning_points_without_misfit_pass(tmp_path: Path) -> None:
    """Sixteen tables: at most one finding above 3 joint sds, none above 4, and none demands another model."""
    tables = [table_of(both, {}, seed, tmp_path) for both in (True, False) for seed in range(8)]
    found = [checked(e) for e in tables]
    assert all([one.code for one in each] == ["decays.forces", "decays.halves", "decays.hidden"] for each in found)
    assert sum(one.level != "ok" for each in found for one in each) <= 1
    assert all(one.level != "fail" for each in found for one in each)
    assert TurningPoints.second_models(tables) == (tables, [])


@pytest.mark.full
@pytest.mark.parametrize(
    ("extra", "line"),
    [
        ({"k_cubic": -0.3}, 'stiffness = "cubic"'),
        ({"F_dry": 0.3}, 'damping = ["viscous", "dry"]'),
        ({"c_q": 0.1}, 'damping = ["viscous", "quadratic"]'),
    ],
    ids=str,
)
def test_a_force_that_is_missing_is_added_or_named(tmp_path: Path, extra: dict[str, float], line: str) -> None:
    """Before: a softening spring was trusted, with a stiffness between those of the halves, twelve sds from either."""
    own = table_of(True, extra, 2, tmp_path)
    found = checked(own)
    assert (found[0].code, found[0].level, found[0].facts["line"]) == ("decays.forces", "fail", line)
    assert line in finding_text(found[0], messages_of(default_registry()))
    # The line mends it, and the second fit adds the same force by itself.
    mended = table_of(True, extra, 2, tmp_path / "mended", line)
    ((second,), (named,)) = TurningPoints.second_models([own])
    assert (named.code, second.model) == ("decays.second_fit", mended.model)
    assert line in finding_text(named, messages_of(default_registry()))
    assert [one.level for one in checked(mended)[:2]] == ["ok", "ok"]
    stated, quoted = named.facts["alternatives"]
    assert (stated["fit"], quoted["fit"]) == ("stated", "quoted")
    assert stated["BIC"] > 10.0 > quoted["BIC"] == 0.0
    truth, own_fit = FORCES | extra, screened(second, second.model)
    for symbol in ("k1", "c", *extra):
        assert abs(own_fit.values[symbol] - truth[symbol]) < 4.0 * own_fit.errors[symbol]
    # Words that are stated stay as they are.
    kept = table_of(True, extra, 2, tmp_path / "kept", 'damping = ["viscous"]\nstiffness = "linear"')
    assert TurningPoints.second_models([kept]) == ([kept], [])
    # A mass known to 20 % makes such a change small beside the quoted sds.
    uncertain = TurningPoints(own.table, replace(own.rig, m1=Quantity(1.0, 0.2)))
    assert checked(uncertain)[0].level == ("warn" if "k_cubic" in extra else "fail")


@pytest.mark.full
def test_a_force_that_another_one_replaces_is_not_chosen(tmp_path: Path) -> None:
    """Amplitudes a period apart show quadratic damping by 5 sds, and a cubic spring as much: neither is adopted alone."""
    tables = [table_of(False, {"c_q": 0.1}, seed, tmp_path) for seed in range(10)]
    chosen, _ = TurningPoints.second_models(tables[:1])
    models = [TurningPoints.second_models([e])[0][0].model for e in tables]
    assert chosen[0].model == models[0]
    assert {model.name for model in models} <= {"viscous damping", "viscous + quadratic damping"}
    # What is not adopted fails.
    kept = [e for e, model in zip(tables, models, strict=True) if not model.symbols]
    assert kept
    assert all(checked(e)[0].level == "fail" for e in kept)


@pytest.mark.parametrize(("offset", "name"), [(0.12, "rest position"), (-0.12, "F_dry")])
def test_amplitudes_from_another_place_than_the_rest_position_are_no_force(
    tmp_path: Path, offset: float, name: str
) -> None:
    """Before: quadratic damping was adopted, c was 24 sds off, and all checks passed."""
    time, x = turning_points(False, {}, 1)
    (own,) = make_experiments(read_rig(folder(tmp_path, time, x + offset, 'samples = "turning_points"')))
    e = cast(TurningPoints, own)
    assert TurningPoints.second_models([e]) == ([e], [])
    forces = checked(e)[0]
    assert (forces.level, forces.facts["name"]) == ("fail", name)
    text = finding_text(forces, messages_of(default_registry()))
    found = "a rest position at 0.1" if name == "rest position" else "Amplitudes must be counted from the rest position"
    assert found in text


@pytest.mark.parametrize(("matters", "doubted"), [(True, ("k1", "c")), (False, ())])
def test_halves_that_differ_leave_what_matters_unjudged(matters: bool, doubted: tuple[str, ...]) -> None:
    e: Any = SimpleNamespace(label="a", model=DecayModel(), model_name="", stated_words=(), local=lambda values: values)
    (found,) = halves(lambda e, theta: {"c": (1.0, 2.0, 3.5, matters)})([e], cast(Any, SimpleNamespace(values={})))
    assert (found.level, found.parameters) == ("warn", doubted)


def test_a_zero_that_is_hardly_seen_leaves_c_unjudged(tmp_path: Path) -> None:
    """Before: a finding about no parameter, and c trusted beside it."""
    time, x = turning_points(False, {}, 1)
    table = folder(tmp_path, time, x + 0.05, 'samples = "turning_points"')
    (own,) = make_experiments(read_rig(table))
    forces = checked(cast(TurningPoints, own))[0]
    assert (forces.level, forces.parameters) == ("warn", ("k1", "c"))
    # The zero moves c most, and the sentence beside the numbers says so. Before: the clock, by 1 %.
    assert cid.fit(table, budget=None).summary["largest_error"]["c"].endswith(": zero of x_rel")


def test_a_cubic_spring_that_the_slope_refuses_is_not_replaced_by_damping(tmp_path: Path) -> None:
    """Before: quadratic damping was adopted, and k1 was 18 sds off with all checks passed."""
    rng = np.random.default_rng(1)
    time, x = turning_points(True, {"k_cubic": -0.3}, 1)
    settings = 'samples = "turning_points"\nslope = { value = 10, unit = "deg" }'
    (own,) = make_experiments(read_rig(folder(tmp_path, time + 2e-2 * rng.standard_normal(10), x, settings)))
    e = cast(TurningPoints, own)
    assert TurningPoints.second_models([e]) == ([e], [])
    assert checked(e)[0].level == "fail"


def test_small_and_stiff_motions_are_fitted(tmp_path: Path) -> None:
    """Before: internal failure, a difference step of k_cubic that changed nothing."""
    time, x = turning_points(True, {}, 1)
    settings = 'samples = "turning_points"\nstiffness = "cubic"'
    (own,) = make_experiments(read_rig(folder(tmp_path, 7e-3 * (time - time[0]), 1.2e-4 * x, settings)))
    theta = fitted(cast(TurningPoints, own))
    assert theta["k1"] == pytest.approx(FORCES["k1"] / 7e-3**2, rel=5e-3)


@pytest.mark.full
def test_a_table_that_cannot_exclude_dry_friction_does_not_give_c(tmp_path: Path) -> None:
    """Six turning points of a weak decay; before, c was trusted."""
    rng = np.random.default_rng(0)
    fine = np.linspace(0.0, 22.0, 220_001)
    x, rate, _ = scipy_decay(fine, FORCES | {"c": 0.03, "F_dry": 0.08}, 2.5, 0.0)
    turns = np.concatenate([[0], np.flatnonzero(np.diff(np.signbit(rate[1:]))) + 1])[:8]
    time = fine[turns] + TIME_NOISE * rng.standard_normal(len(turns))
    settings = 'samples = "turning_points"'
    (own,) = make_experiments(
        read_rig(folder(tmp_path, time, x[turns] + 3.0 * NOISE * rng.standard_normal(len(turns)), settings))
    )
    e = cast(TurningPoints, own)
    assert TurningPoints.second_models([e])[1] == []
    (found,) = [one for one in checked(e) if one.code == "decays.hidden" and one.parameters == ("c",)]
    assert found.level == "fail"
    assert "F_dry" in found.facts["symbols"]
    assert found.facts["low"] < 0.03 < found.facts["high"]
    # The quoted value alone is wrong by many sds.
    assert fitted(e)["c"] - 0.03 > 4.0 * screened(e, e.model).errors["c"]


def test_turning_points_at_unequal_times_are_refused(tmp_path: Path) -> None:
    """Before: amplitudes of releases at 5 to 82 s gave a stiffness 138 times too small."""
    time, x = turning_points(True, {}, 1)
    time[6:] += 0.4 * np.median(np.diff(time))
    with pytest.raises(InputError, match="must follow each other by one time") as refused:
        cid.fit(cid.read_rig(folder(tmp_path, time, x, 'samples = "turning_points"')), budget=None)
    assert (refused.value.file, refused.value.line) == ("decay.csv", 8)
    # Nor may one be entered twice: before, k1 was a third too large.
    time, x = turning_points(True, {}, 1)
    twice = np.insert(time, 5, time[4] + 1e-4), np.insert(x, 5, x[4])
    with pytest.raises(InputError, match="must follow each other by one time"):
        cid.fit(cid.read_rig(folder(tmp_path / "twice", *twice, 'samples = "turning_points"')), budget=None)
    # A turning point that was not read is no fault.
    time, x = turning_points(True, {}, 1)
    rig = cid.read_rig(folder(tmp_path / "missed", np.delete(time, 4), np.delete(x, 4), 'samples = "turning_points"'))
    assert len(make_experiments(rig)) == 1


def _viscous_turns(release: float, one_side: bool = False) -> list[Column]:
    """Turning points of a viscous decay of the bench from ``release``, m, with small errors."""
    rng, gamma = np.random.default_rng(2), bench.C / (2.0 * bench.M1)
    step = np.pi / np.sqrt(bench.K1 / bench.M1 - gamma**2)
    index = np.arange(16)[:: 1 + one_side]
    x = release * np.exp(-gamma * index * step) * (-1.0) ** index
    return [
        bench.column("time", index * step + 1e-5 * rng.standard_normal(len(index))),
        bench.column("x_rel", x + 2e-6 * rng.standard_normal(len(index))),
    ]


@pytest.mark.parametrize("one_side", [False, True])
@pytest.mark.parametrize(
    ("settings", "code"),
    [({"capsule": "free"}, "decays.slip"), ({"gap_back": Quantity(1e-3)}, "decays.contact"), ({}, "")],
)
def test_slip_and_contact_of_turning_points(settings: dict[str, Any], code: str, one_side: bool) -> None:
    """Before: neither was looked at, and the numbers were trusted."""
    table = bench.table("free_vibration", _viscous_turns(4e-3, one_side), samples="turning_points", **settings)
    tilts = bench.table("static_friction", [bench.column("angle", np.arctan(0.4) + 0.005 * np.array([-1.0, 0.0, 1.0]))])
    result = cid.fit(bench.rig(table, tilts), budget=None)
    found = {finding.code for finding in result.findings if finding.level == "fail"}
    assert found & {"decays.slip", "decays.contact"} == ({code} if code else set())


@pytest.mark.parametrize("samples", ["turning_points", "record"])
def test_a_free_capsule_without_a_test_of_friction_is_not_judged(samples: str) -> None:
    """Before: nothing was said, and c was trusted 11 sd off where the capsule had slipped."""
    time = np.arange(400) / 1000.0
    record = [bench.column("time", time), bench.column("x_rel", bench.released(time, 4e-3))]
    noise = 2e-6 * np.random.default_rng(0).standard_normal(400)
    record[1] = bench.column("x_rel", bench.released(time, 4e-3) + noise)
    columns = _viscous_turns(4e-3) if samples == "turning_points" else record
    result = cid.fit(bench.rig(bench.table("free_vibration", columns, samples=samples, capsule="free")), budget=None)
    (slip,) = [finding for finding in result.findings if finding.code == "decays.slip"]
    assert (slip.level, {"k1", "c"} <= set(slip.parameters)) == ("warn", True)
    assert "Add a test of static friction" in result.text(slip)


def test_amplitudes_of_one_side_have_no_frequency_of_a_record() -> None:
    """Before: a record beside them was not trusted, its frequency 700 times theirs."""
    time = np.arange(400) / 1000.0
    record = [bench.column("time", time), bench.column("x_rel", bench.released(time, 2e-3))]
    turns = bench.table("free_vibration", _viscous_turns(2e-3, one_side=True), "turns", samples="turning_points")
    rig = bench.rig(turns, bench.table("free_vibration", record, "record"))
    codes = {finding.code for finding in lint(rig, default_registry(), rig.tables)}
    assert "decays.frequency" not in codes


def test_the_errors_of_readings_are_said_of_what_these_alone_inform() -> None:
    """A record beside them informs c too, and what a zero of its sensor does there is not known."""
    time = np.arange(400) / 1000.0
    x = bench.released(time, 2e-3) + 1e-3 * np.random.default_rng(4).standard_normal(400)
    turns = bench.table("free_vibration", _viscous_turns(2e-3, one_side=True), "turns", samples="turning_points")
    record = bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", x)], "record")
    said = [
        cid.fit(bench.rig(*tables), budget=None).summary["largest_error"]["c"] for tables in ([turns], [turns, record])
    ]
    assert said[0].endswith(": zero of x_rel")
    assert said[1] == "1 %: clock"


def test_amplitudes_of_one_side_need_a_word_on_how_they_were_read() -> None:
    """Before: |x_rel| of every swing, as maxima of a spring four times as stiff, gave k1 trusted without a word."""
    period = 2.0 * np.pi / float(np.sqrt(bench.K1 / bench.M1 - (bench.C / (2.0 * bench.M1)) ** 2))
    for one_side in (False, True):
        rig = bench.rig(bench.table("free_vibration", _viscous_turns(2e-3, one_side), samples="turning_points"))
        label = rig.tables[0].label
        said = [found for found in lint(rig, default_registry(), rig.tables) if found.code == "decays.one_side"]
        assert [(found.level, found.parameters) for found in said] == [("warn", ("k1",))] * one_side
        for found in said:
            assert found.facts["period"] == pytest.approx(period, rel=1e-3)
            assert f'confirmed = ["{label}.samples"]' in finding_text(found, messages_of(default_registry()))
        stated = replace(rig, confirmed=(f"{label}.samples",))
        assert not [found for found in lint(stated, default_registry(), rig.tables) if found.code == "decays.one_side"]


def test_a_stated_hum_is_no_release() -> None:
    """Before: the hum beside the first swing was taken for rest, or for a second excitation, stated or not."""
    rng, time = np.random.default_rng(0), np.arange(1000) / 2000.0
    x = bench.released(time, 2e-3, 1500.0, 2.0) + 5e-5 * np.cos(2.0 * np.pi * 50.02 * time + 1.0)
    columns = [bench.column("time", time), bench.column("x_rel", x + 1e-5 * rng.standard_normal(1000))]
    codes = {}
    for hum in (None, 50.02):
        rig = bench.rig(bench.table("free_vibration", columns, hum=hum))
        codes[hum] = {finding.code for finding in lint(rig, default_registry(), rig.tables) if finding.level != "ok"}
    assert "decays.release" in codes[None]
    assert codes[50.02] == {"masses.exact"}


def test_instants_keep_their_digits() -> None:
    """Times since 1970. Before: the printed start was rounded to a whole second."""
    begin, rest = 1.7e9 + 0.37, np.arange(200) / 1000.0
    time = np.append(rest, 0.2 + np.arange(600) / 1000.0)
    x = np.append(np.full(200, 2e-3), bench.released(np.arange(600) / 1000.0, 2e-3))
    x += 2e-6 * np.random.default_rng(0).standard_normal(800)
    rig = bench.rig(bench.table("free_vibration", [bench.column("time", begin + time), bench.column("x_rel", x)]))
    kinds = default_registry()
    (found,) = [finding for finding in lint(rig, kinds, rig.tables) if finding.code == "decays.release"]
    text = finding_text(found, messages_of(kinds))
    (start,) = re.findall(r"start = \{ value = ([0-9.]+)", text)
    assert 0.0 <= float(start) - (begin + 0.2) < 0.01


def test_channels_have_different_names() -> None:
    """Before: two records of one label shared one noise, and one was lost from posterior.nc."""
    time = np.arange(400) / 1000.0
    both = [bench.column(name, bench.released(time, 2e-3)) for name in ("x_rel", "velocity")]
    tables = [bench.table("free_vibration", [bench.column("time", time), *both], "a")]
    tables += [bench.table("free_vibration", [bench.column("time", time), both[0]], "a_velocity")]
    with pytest.raises(InputError, match="different names"):
        make_experiments(bench.rig(*tables))


def _held(columns: int = 1) -> list[Column]:
    """A rod that is held for 0.2 s at 2 mm and let go: x_rel, and the velocity as a second column."""
    rng, t = np.random.default_rng(0), np.arange(600) / 1000.0
    x = np.append(np.full(200, 2e-3), bench.released(t, 2e-3))
    both = {"x_rel": x + 2e-6 * rng.standard_normal(800), "velocity": np.gradient(x, 1e-3)}
    return [bench.column("time", np.arange(800) / 1000.0), *(bench.column(*one) for one in [*both.items()][:columns])]


@pytest.mark.parametrize(("forward", "doubted"), [("closed", ()), ("capsule", ("k1", "c"))])
def test_the_capsule_model_needs_the_instant_of_the_release(forward: str, doubted: tuple[str, ...]) -> None:
    """Before: the record began with a capsule that moved already, and c was 1.5 sd off, trusted."""
    rig = bench.rig(bench.table("free_vibration", _held(), capsule="free", forward=forward))
    (found,) = [f for f in lint(rig, default_registry(), rig.tables) if f.code == "decays.release"]
    assert found.parameters == doubted
    assert (found.facts["start"] <= 0.2) is bool(doubted)


def test_lines_that_releases_refuses_are_not_printed() -> None:
    """``releases`` takes no start."""
    table = bench.table("free_vibration", _held())
    starts = []
    for releases in (None, "all"):
        own = replace(table, settings=replace(table.settings, releases=releases, start=0.21))
        (e,) = make_experiments(bench.rig(own))
        starts.append(later_start(cast(Any, e))["start"])
    assert starts == [0.262, None]  # behind half of the largest amplitude


def test_a_stated_start_holds_for_all_channels_of_a_file() -> None:
    """Before: the second channel was judged, and the line to add was there already."""
    for start, codes in ((None, {"decays.held"}), (0.21, set())):
        rig = bench.rig(bench.table("free_vibration", _held(2), "a", start=start))
        records = cast(Any, make_experiments(rig))
        values = {"k1": bench.K1, "c": bench.C, "m1": bench.M1}
        values |= {row.name: 2e-6 for e in records for row in e.parameters if row.name not in values}
        fit = cast(Any, SimpleNamespace(values=values))
        assert {finding.code for finding in check_held(records, fit)} == codes
