"""What a further test would add: information against closed forms, ranking, refusals, plans before any measurement."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from scipy import integrate

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.inference import planning
from capsule_id.inference.least_squares import linearised
from capsule_id.inference.planning import Candidate, Plan, next_tests, planned
from capsule_id.inference.result import Result
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import Instrument, ModelChoices, Quantity, Rig
from capsule_id.synthetic import PAPER, Truth, synthesize
from tests.cli_tools import DATA
from tests.experiments import bench
from tests.forced_runs import table

#: Posterior sds of the logarithms.
SD = {"m1": 2e-3, "m2": 1e-3, "k1": 2e-3, "c": 3e-3, "mu": 9e-3, "v_s": 8e-2, "K": 1e-2}
REGISTRY = default_registry()


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """The bench of a synthetic rig with one spring."""
    folder = tmp_path_factory.mktemp("twin") / "twin"
    truth = {name: value for name, value in PAPER.items() if name not in ("k2[medium]", "k2[stiff]")}
    synthesize(folder, 3, Truth(truth), "twin")
    return read_rig(folder)


def result_of(rig: Rig, friction: str = "eq. (1)", seed: int = 0) -> Result:
    """A fit of ``rig`` whose posterior is log-normal about the truth, parameter by parameter."""
    starts = {name: start.centre for name, start in LogPosterior(rig, make_experiments(rig, "bench")).starts().items()}
    centre = {name: PAPER.get(name, start) for name, start in starts.items()}
    sd = np.array([SD.get(name, 0.1) for name in centre])
    z = np.random.default_rng(seed).standard_normal((4, 50, 30, len(centre)))
    value = np.array(list(centre.values()))
    physical, sds = [name for name in centre if name in PAPER], dict(zip(centre, value * sd, strict=True))
    known = {
        "posterior": SimpleNamespace(names=tuple(centre), draws=value * np.exp(sd * z)),
        "summary": pd.DataFrame({"value": centre, **dict.fromkeys(("sd", "sd_unwidened"), sds)}).loc[physical],
        "provenance": SimpleNamespace(friction=friction, experiments="bench"),
    }
    return cast(Any, SimpleNamespace(rig=rig, registry=REGISTRY, fixed={}, **known))


def template(rig: Rig, kind: str) -> Any:
    return next(e for e in make_experiments(rig, "bench") if e.kind == kind)


def information(e: Any, values: dict[str, float], names: list[str], like: Any = None) -> np.ndarray:
    """``like``: the experiment that gives the starts of what ``values`` lack."""
    starts = {name: start.centre for name, start in LogPosterior(e.rig, [like or e]).starts().items()}
    return Candidate(e, "", 1, 1.0, 1.0, starts, {}).information([values], names)[0]


def test_a_line_tells_its_slope_as_the_closed_form_says(rig: Rig) -> None:
    e = template(rig, "support_spring")
    x, k2 = e.table["deflection"], PAPER["k2[soft]"]
    variance = e.table.columns["force"].sd ** 2 + (k2 * e.table.columns["deflection"].sd) ** 2
    expected = k2**2 * np.sum((x - x.mean()) ** 2) / variance
    assert information(e, PAPER, ["k2[soft]"]).item() == pytest.approx(expected, rel=2e-3)


def test_pushes_of_one_speed_tell_one_combination_of_mu_and_v_s(rig: Rig) -> None:
    """Against SciPy: the distance by quadrature of u/(g mu(u)), its derivatives by differences."""
    e = template(rig, "dynamic_friction").with_readings({}, np.zeros(4, int))
    speed, scatter = float(e.table["speed"][0]), 0.015

    def friction(u: float, mu: float, v_s: float) -> float:
        return mu * 0.5 * (1.0 + np.exp(-u / v_s))

    def distance(mu: float, v_s: float) -> float:
        return integrate.quad(lambda u: u / (9.81 * friction(u, mu, v_s)), 0.0, speed)[0]

    mu, v_s = PAPER["mu"], PAPER["v_s"]
    d, h = distance(mu, v_s), 1e-4
    slope = np.array([-d, (distance(mu, v_s * (1.0 + h)) - distance(mu, v_s * (1.0 - h))) / (2.0 * h)])
    carried = speed / (9.81 * friction(speed, mu, v_s)) * e.table.columns["speed"].sd
    variance = carried**2 + e.table.columns["distance"].sd ** 2 + (scatter * d) ** 2
    found = information(e, {**PAPER, "push_scatter": scatter}, ["mu", "v_s"])
    # The variance depends on the parameters too: a part of the derivative of a residual whose mean is 0.
    assert found == pytest.approx(4.0 * np.outer(slope, slope) / variance, rel=2e-2)
    assert np.linalg.svd(found)[1][1] < 1e-6 * np.trace(found)


@pytest.mark.full
def test_a_settled_run_tells_what_the_likelihood_of_a_run_does() -> None:
    """Against the Jacobian that the fit uses, with gains and a delay that the settings state."""
    whole = read_rig(DATA)
    table = whole.cut("run_2", stop=0.3).tables[-3]
    assert table.label == "run_2"
    stated = {"start": "settled", "x_rel_gain_sd": 0.02, "acceleration_rod_gain_sd": 0.1, "x_rel_delay_sd": 1e-5}
    table = replace(table, settings=replace(table.settings, **stated))
    read: Any = make_experiments(replace(whole, tables=(table,)), "runs")[0]
    starts = LogPosterior(read.rig, [read]).starts()
    known = {**{name: start.centre for name, start in starts.items()}, **PAPER}
    # Without residuals the derivatives of the nuisances' effects do not matter.
    seen = zip(read.names, read.predict(read.local(known), np), strict=True)
    columns = {name: replace(table.columns[name], values=np.asarray(values)) for name, values in seen}
    table = replace(table, columns={**table.columns, **columns})
    e: Any = make_experiments(replace(whole, tables=(table,)), "runs")[0]
    target = LogPosterior(e.rig, [e])
    names = ["m1", "m2", "k1", "c", "mu", "v_s", "K", "k2[stiff]"]
    found = Candidate(e, "", 1, 1.0, 1.0, known, {}).information([known], names)[0]
    u = target.unconstrain(np.array([known[name] for name in target.names]))
    slope = linearised(target, u)[1][: -target.dimension]
    order = [target.names[i] for i in target.located]
    held = np.isin(order, names)
    # By least squares: what the own parameters, with their priors, leave of the columns of the others.
    prior = np.diag(1.0 / target.prior_sd[target.located])[~held]
    whole_slope = np.vstack([slope, prior])
    own = whole_slope[:, ~held]
    rest = whole_slope[:, held] - own @ np.linalg.lstsq(own, whole_slope[:, held])[0]
    expected = rest.T @ rest
    place = [names.index(name) for name in order if name in names]
    assert np.linalg.norm(found[np.ix_(place, place)] - expected) < 0.01 * np.linalg.norm(expected)
    free = replace(table, settings=replace(table.settings, x_rel_gain_sd=None, acceleration_rod_gain_sd=None))
    sharper: Any = make_experiments(replace(whole, tables=(free,)), "runs")[0]
    more = Candidate(sharper, "", 1, 1.0, 1.0, known, {}).information([known], names)[0]
    assert more[names.index("K"), names.index("K")] > 1.05 * found[names.index("K"), names.index("K")]


def row_of(plan: Plan, what: str) -> Any:
    return plan.table[plan.table["what"] == what].iloc[0]


@pytest.mark.parametrize("label", ["run_1", "stiff"])
def test_a_part_of_a_run_leaves_the_drive_of_a_new_run_as_unknown_as_the_whole_does(
    monkeypatch: pytest.MonkeyPatch, label: str
) -> None:
    """Before: phase, amplitude and gap of the old record counted as those of the new run, which told more than they can.

    A run may have the name of its spring; then its k2 counted as new.
    """
    own = replace(table(1, samples=400), label=label)
    part = ForcedRun(own, bench.rig(own)).parts(0.2)[0]
    assert part.label != part.shares_noise == own.label
    target = LogPosterior(part.rig, [part])
    names = [target.names[i] for i in target.located]
    monkeypatch.setattr(Candidate, "_of_run", lambda _, target, draws: [np.eye(len(names))])
    (found,) = Candidate(part, "", 1, 1.0, 1.0, {}, {}).information([{}], names)
    own = replace(part.table, settings=replace(part.table.settings, segment=0.2))
    gained = ForcedRun(replace(own, settings=replace(own.settings, x_rel_gain_sd=0.02)), part.rig).parts(0.1)[0]
    lines = planning.lines_of(gained, REGISTRY["forced_run"])
    assert "x_rel_gain_sd = { value = 0.02" in lines
    assert "x_rel_instrument" not in lines
    known = {name for name, diagonal in zip(names, np.diag(found), strict=True) if diagonal > 0.0}
    assert known == {"k1", "c", "mu", "v_s", "K", "k2[stiff]", "m1", "m2"} & set(names)


def test_the_best_test_is_one_that_reads_the_target(rig: Rig) -> None:
    result = result_of(rig)
    plan = next_tests(result, ["K"], minutes=10)
    assert plan.table.iloc[0]["kind"] == "motor_current"
    assert plan.table["K, ratio"].is_monotonic_increasing
    row = row_of(plan, "as motor_current")
    assert row["tests"] == "20"
    sample = np.log(result.posterior.draws.reshape(-1, len(result.posterior.names)))  # type: ignore[union-attr]
    variance = np.var(sample[:, result.posterior.names.index("K")])  # type: ignore[union-attr]
    e = template(rig, "motor_current").with_readings({}, np.resize(np.arange(8), 20))
    expected = 1.0 / np.sqrt(1.0 + variance * information(e, PAPER, ["K"]).item())
    assert row["K, ratio"] == pytest.approx(expected, rel=0.05)
    assert row["sd of K"] == pytest.approx(plan.today["K"] * row["K, ratio"])
    # Decays read nothing of K. Twice the time never harms.
    assert not plan.table["kind"].str.contains("free_vibration").any()
    assert re.search(r"\d+ choices that change these sds by less than 1 %", plan.left_out[-1])
    assert next_tests(result, ["K"], minutes=20).table.iloc[0]["K, ratio"] < plan.table.iloc[0]["K, ratio"]


def test_a_parameter_without_a_number_has_the_sd_of_its_sample(rig: Rig) -> None:
    """Before: "nan (x 0.42)"."""
    result = result_of(rig)
    expected = next_tests(result, ["K"], minutes=10).table["sd of K"]
    result.summary.loc["K", "sd"] = np.nan
    assert next_tests(result, ["K"], minutes=10).table["sd of K"].tolist() == expected.tolist()


def test_one_level_tells_nothing_of_a_slope_beside_a_free_intercept(rig: Rig) -> None:
    plan = next_tests(result_of(rig), ["K"], minutes=10)
    # Such a table would be refused, so it is no candidate; its information must be that of none.
    assert not plan.table["what"].str.fullmatch(r"as motor_current, current [\d.]+ A").any()
    whole = template(rig, "motor_current")
    assert information(whole.with_readings({}, np.full(20, 7)), PAPER, ["K"], whole).item() * SD["K"] ** 2 < 0.05
    assert plan.table.iloc[0]["what"] == "as motor_current, current 0.25 and 2 A"


def test_records_count_as_often_as_they_fit_into_the_time(rig: Rig) -> None:
    """The precision of c grows in proportion to the number of decays, and with the square of their amplitude."""
    result = result_of(rig)
    one, ten = (next_tests(result, ["c"], minutes=minutes) for minutes in (3, 30))
    what = "as free_vibration_1"
    gains = [float(row_of(plan, what)["c, ratio"]) ** -2 - 1.0 for plan in (one, ten)]
    assert [row_of(plan, what)["tests"] for plan in (one, ten)] == ["1", "10"]
    assert gains[1] > 2.0 * gains[0]
    smaller = float(row_of(one, f"{what}, 0.5 x its amplitude")["c, ratio"]) ** -2 - 1.0
    assert 2.8 < gains[0] / smaller < 4.0


def test_tests_that_change_nothing_are_not_proposed(rig: Rig) -> None:
    """Before: pushes for K, "x 1.00", in all rows."""
    with pytest.raises(InputError, match=r"must change the sd of a target by 1 % or more, [0-9]+ choices below that"):
        next_tests(result_of(rig), ["K"], minutes=0.6)


def test_kinds_share_the_time_where_both_help(rig: Rig) -> None:
    plan = next_tests(result_of(rig), ["c", "v_s"], minutes=30)
    assert " + " in plan.table.iloc[0]["kind"]
    # Half the decays tell less of c than all of them in the whole time.
    pair = plan.table[plan.table["kind"] == "free_vibration + dynamic_friction"].iloc[0]
    assert pair["tests"].startswith("5 + ")
    assert pair["c, ratio"] > 1.02 * plan.table.loc[plan.table["kind"] == "free_vibration", "c, ratio"].min()
    assert {"motor_current", "support_spring"}.isdisjoint(" + ".join(plan.table["kind"].head(3)).split(" + "))
    assert 'kind = "dynamic_friction"' in plan.lines()
    assert "speed_sd = { value = 0.005" in plan.lines()


def test_what_the_rig_lacks_is_a_candidate(rig: Rig) -> None:
    without = rig.without("static_friction")
    plan = next_tests(result_of(without), ["mu"], minutes=30)
    assert any(members[0].template.kind == "static_friction" for members in plan.options)
    assert row_of(plan, "static_friction as in the synthetic rig")["mu, ratio"] < 0.9


def test_minutes_of_the_plan_count(rig: Rig) -> None:
    slow = replace(rig, plan={"minutes": {"push": 10.0, "free_vibration": 100.0}})
    plan = next_tests(result_of(slow), ["v_s"], minutes=30)
    assert row_of(plan, "as dynamic_friction")["tests"] == "3"
    assert plan.left_out[0] == "free_vibration_1 (100 min)"


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"targets": ["k2[hard]"]}, "a target must be a parameter of the fit"),
        ({"targets": ["m1"]}, "a target must be a parameter of the fit"),
        ({"minutes": 0.1}, "a test must fit into the time"),
        ({"draws": 10**6}, "draws must lie between 1 and the sample's"),
    ],
)
def test_what_cannot_be_planned_is_refused(rig: Rig, options: dict[str, Any], rule: str) -> None:
    with pytest.raises(InputError, match=rule):
        next_tests(result_of(rig), **options)


def test_another_friction_law_is_refused(rig: Rig) -> None:
    with pytest.raises(InputError, match=r"this computes with eq\. \(1\)"):
        next_tests(result_of(rig, friction="my law"))


def folder_with(tmp_path: Path, plan: str) -> Path:
    masses = 'm1 = { value = 110, sd = 0.2, unit = "g" }\nm2 = { value = 530, sd = 0.5, unit = "g" }\n'
    (tmp_path / "rig.toml").write_text(f'[rig]\nname = "planned"\n{masses}\n[plan]\n{plan}\n', encoding="utf-8")
    return tmp_path


def test_a_plan_says_what_will_be_known(tmp_path: Path) -> None:
    frame, minutes = planned(folder_with(tmp_path, "tests = { tilt = 6, free_vibration = 2 }"), REGISTRY, draws=3)
    assert minutes == 12.0
    assert frame.loc[["mu", "k1", "c"], "known"].str.startswith("bounded").all()
    assert "v_s" not in frame.index
    few, _ = planned(folder_with(tmp_path, "tests = { push = 1 }"), REGISTRY, draws=3)
    many, _ = planned(folder_with(tmp_path, "tests = { push = 200 }"), REGISTRY, draws=3)
    assert few.loc["v_s", "sd / value"] > 2.0 * many.loc["v_s", "sd / value"]


def test_the_tests_of_all_springs_are_those_of_the_plan(tmp_path: Path) -> None:
    """12 deflections of three springs are 4 of each; one reading of a line tells nothing of its slope."""
    three, _ = planned(folder_with(tmp_path, "tests = { deflection = 12 }"), REGISTRY, draws=2)
    prior = '[prior]\n"k2[soft]" = { median = 2.4, factor = 3, unit = "kN/m" }'
    one, _ = planned(folder_with(tmp_path, f"tests = {{ deflection = 4 }}\n{prior}"), REGISTRY, draws=2)
    assert three.loc["k2[soft]", "sd / value"] == pytest.approx(one.loc["k2[soft]", "sd / value"], rel=0.15)
    single, _ = planned(folder_with(tmp_path, "tests = { current = 1 }"), REGISTRY, draws=2)
    assert single.loc["K", "known"] == "flat"


def test_a_slope_of_the_track_counts(tmp_path: Path) -> None:
    level, _ = planned(folder_with(tmp_path, "tests = { push = 10 }"), REGISTRY, draws=2)
    text = (tmp_path / "rig.toml").read_text(encoding="utf-8")
    stated = text.replace("\n[plan]", 'slope = { value = 0, sd = 2, unit = "deg" }\n[plan]')
    # What is confirmed may name an experiment, whose file may not be there yet.
    confirmed = stated.replace("[rig]", '[rig]\nconfirmed = ["pushes.speed"]')
    (tmp_path / "rig.toml").write_text(confirmed, encoding="utf-8")
    sloping, _ = planned(tmp_path, REGISTRY, draws=2)
    assert sloping.loc["mu", "sd / value"] > 1.2 * level.loc["mu", "sd / value"]


def test_the_lines_leave_out_what_belongs_to_the_old_record_or_to_the_rig(rig: Rig) -> None:
    """Before: a second slope of the one track, and a new decay cut to the times of the old one (k1 = 60 for 1420 N/m)."""
    decay = template(rig.cut("free_vibration_1", start=0.02, stop=0.2), "free_vibration")
    assert (decay.table.settings.start, decay.table.settings.stop) != (None, None)
    assert not re.search("^(start|stop) =", planning.lines_of(decay, REGISTRY["free_vibration"]), re.MULTILINE)
    for of_rig, of_table, printed in ((0.01, 0.01, False), (0.01, 0.02, True), (None, 0.02, True)):
        push = next(table for table in rig.tables if table.kind == "dynamic_friction")
        push = replace(push, settings=replace(push.settings, slope=Quantity(of_table, 1e-3)))
        whole = replace(rig, tables=(push,), slope=None if of_rig is None else Quantity(of_rig, 1e-3))
        lines = planning.lines_of(template(whole, "dynamic_friction"), REGISTRY["dynamic_friction"])
        assert ("slope =" in lines) == printed


def test_what_the_tests_of_the_rig_measure_may_be_free(rig: Rig) -> None:
    """Before: an error about a file that is gone, with a remedy that changes the model."""
    free = replace(rig, model=ModelChoices(free=("viscous", "lag")))
    (push,) = planning.twins(PAPER, free, [REGISTRY["dynamic_friction"]], REGISTRY, 0)
    assert "viscous" in push.names_by_key


def test_the_lines_name_the_instrument(rig: Rig) -> None:
    e = template(rig, "motor_current")
    cell = Instrument("cell", "N", {"gain": Quantity(0.0, 0.03)})
    columns = {**e.table.columns, "force": replace(e.table.columns["force"], instrument=cell)}
    read = type(e).make(replace(e.table, columns=columns), rig, e.friction)[0]
    assert 'force_instrument = "cell"' in planning.lines_of(read, REGISTRY["motor_current"])


@pytest.mark.parametrize(
    ("plan", "rule"),
    [
        ("tests = { run = 2 }", "must be whole numbers up to 1000 of bench tests that the synthetic rig has, run = 2"),
        ("tests = { push = 0.5 }", "must be whole numbers"),
        ("tests = { push = 1e9 }", "must be whole numbers up to 1000"),
        ("minutes = { push = 2 }", r"no tests, add e\.g\. tests = \{ push = 10, free_vibration = 3 \} to \[plan\]"),
        ("tests = { psh = 2 }", "unknown key"),
        ("tests = { push = -2 }", "push of tests must be greater than 0"),
        ("hours = 2", "unknown key"),
    ],
)
def test_a_plan_that_cannot_be_made_is_refused(tmp_path: Path, plan: str, rule: str) -> None:
    with pytest.raises(InputError, match=rule):
        planned(folder_with(tmp_path, plan), REGISTRY)
