"""Forces that a short decay cannot exclude: limits against SciPy, the finding, its remedy, and no false alarms.

Twin of a measured pendulum from 3.2 s on: dry friction beside the viscous, in a few periods. It is fitted as viscous.
"""

import re
import tomllib
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.experiments.base import refit
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.free_vibration.hidden_terms import (
    Hidden,
    changing_motions,
    check_changing,
    check_hidden_terms,
    force_responses,
    hidden_terms,
    left_by,
)
from capsule_id.experiments.free_vibration.lint import MESSAGES
from capsule_id.experiments.free_vibration.readings import DecayModel
from capsule_id.experiments.free_vibration.record import Screened
from capsule_id.experiments.free_vibration.screening import Screening
from capsule_id.experiments.free_vibration.second_fit import open_models, second_models
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.statistics import further_columns
from capsule_id.inference.least_squares import linearised
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.views import Finding
from tests.cli_tools import DATA
from tests.experiments import bench
from tests.inference.stub import plain_jacobian, plain_residuals
from tests.scipy_decay import scipy_decay

RELEASE, NOISE = 2e-3, 4e-5
VISCOUS = {"k1": bench.K1, "m1": bench.M1, "c": 0.8}
#: The peaks lose as much to dry friction as to viscous damping, when the amplitude is half the release.
DRY = {**VISCOUS, "c": 0.4, "F_dry": 0.04}
PERIOD = 2.0 * np.pi * float(np.sqrt(bench.M1 / bench.K1))
#: Of the last turning point before the record.
TURNING_TIME = -0.1 * PERIOD
SHORT, LONG = 4.0, 16.0
SEED = 1


def decay_table(periods: float, forces: dict[str, float], seed: int = SEED, **settings: object) -> Table:
    """A record of so many periods, 30 samples a period."""
    time = np.linspace(0.0, periods * PERIOD, int(30 * periods))
    x = scipy_decay(time, forces, RELEASE, TURNING_TIME)[0] + NOISE * np.random.default_rng(seed).standard_normal(
        len(time)
    )
    return bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", x)], "decay", **settings)


def viscous_fit(table: Table) -> tuple[FreeVibration, dict[str, float]]:
    """The record under the stated model, and the values of its fit."""
    record = cast(FreeVibration, make_experiments(bench.rig(table))[0])
    start = {"m1": bench.M1, "k1": bench.K1, "c": 0.8, record.scatters[0]: NOISE}
    found = {name: value for name, (value, _) in refit(record, start, []).items()}
    return record, {**start, **found, f"noise_sd[{record.label}]": NOISE}


def findings(table: Table) -> list[Finding]:
    """The findings on further forces at a viscous fit."""
    record, values = viscous_fit(table)
    return check_hidden_terms([record], SimpleNamespace(values=values))  # type: ignore[arg-type]  # pyright: ignore


@pytest.fixture(scope="module")
def short() -> Fit:
    return cid.fit(bench.rig(decay_table(SHORT, DRY)), budget=None)


@pytest.mark.full
def test_a_short_record_with_dry_friction_is_not_clean_and_wrong(short: Fit) -> None:
    assert [f.code for f in short.findings if f.level == "fail"] == ["decays.hidden"]
    row = short.summary.loc["c"]
    # This is what the check is for: by its own sd the value is far off.
    assert (row["value"] - DRY["c"]) / row["sd"] > 8.0
    assert (row["trust"], short.summary.loc["k1", "trust"]) == ("not trusted", "not judged")
    (finding,) = [f for f in short.findings if f.code == "decays.hidden"]
    assert finding.facts["low"] < DRY["c"] < finding.facts["high"]
    assert finding.facts["largest"][0] > DRY["F_dry"]
    assert "dry friction" in short.text(finding)


def with_the_remedy(short: Fit) -> Rig:
    """The rig with the line that the finding states."""
    (finding,) = [f for f in short.findings if f.code == "decays.hidden"]
    line = cast("re.Match[str]", re.search(r"or write (damping = \[.*?\])", short.text(finding)))[1]
    return bench.rig(decay_table(SHORT, DRY, damping=tuple(tomllib.loads(line)["damping"])))


@pytest.mark.full
def test_the_remedy_in_the_text_gives_an_error_that_contains_the_truth(short: Fit) -> None:
    fit = cid.fit(with_the_remedy(short), budget=None)
    assert fit.clean
    for name in ("c", "F_dry"):
        row = fit.summary.loc[name]
        assert abs(row["value"] - DRY[name]) < 2.0 * row["sd"]


@pytest.mark.slow
def test_with_the_remedy_c_is_trusted_and_covered(short: Fit) -> None:
    fit = cid.fit(with_the_remedy(short))
    row = fit.summary.loc["c"]
    assert row["trust"] == "trusted"
    assert row["lower"] < DRY["c"] < row["upper"]


def test_the_jacobian_of_decays_with_further_forces_is_that_by_numpy() -> None:
    """Two records in one group, both with dry friction and a cubic spring; derivatives come from differences."""
    words = {"damping": ("viscous", "dry"), "stiffness": "cubic"}
    table = decay_table(SHORT, DRY, **words)
    rig = bench.rig(table, replace(decay_table(SHORT, DRY, seed=2, **words), label="second"))
    target = LogPosterior(rig, make_experiments(rig))
    assert [len(group.members) for group in target.groups] == [2]
    starts = target.starts()
    u = target.unconstrain(np.array([starts[name].centre for name in target.names])) + 1e-3 * target.positive
    residuals, jacobian = linearised(target, u)
    expected = plain_jacobian(target, u)
    np.testing.assert_allclose(residuals, plain_residuals(target, u), rtol=1e-9, atol=1e-9)
    size = np.max(np.abs(expected), axis=0)
    np.testing.assert_allclose(jacobian / size, expected / size, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_the_default_prior_of_a_force_follows_the_size_of_the_rig(scale: float) -> None:
    """One median for all rigs preferred no dry friction in a measured pendulum: c = 0.44 ± 0.04 where it is 0.21."""
    table = decay_table(SHORT, DRY, damping=("viscous", "dry", "quadratic"))
    columns = {**table.columns, "x_rel": replace(table.columns["x_rel"], values=scale * table["x_rel"])}
    (record,) = make_experiments(bench.rig(replace(table, columns=columns)))
    median = {row.symbol: row.prior.location for row in record.parameters if row.symbol in ("F_dry", "c_q")}
    assert median["F_dry"] == pytest.approx(0.05 * bench.K1 * scale * RELEASE, rel=0.1)
    assert median["c_q"] == pytest.approx(0.05 * bench.M1 / (scale * RELEASE), rel=0.1)


@pytest.mark.full
def test_records_of_unequal_size_share_a_prior_that_follows_both() -> None:
    """Before, the first record alone set the scale; one in a hundred in size excluded what the other one showed."""
    table = decay_table(SHORT, DRY, damping=("viscous", "dry"))
    small = {**table.columns, "x_rel": replace(table.columns["x_rel"], values=1e-2 * table["x_rel"])}
    pair = [table, replace(table, columns=small, label="small")]
    found = []
    for tables in (pair, pair[::-1]):
        rig = bench.rig(*tables)
        target = LogPosterior(rig, make_experiments(rig))
        found.append(target.parameters[target.names.index("F_dry")].prior)
    assert found[0] == found[1]
    shared = cast(Prior, found[0])
    assert shared.location == pytest.approx(0.1 * 0.05 * bench.K1 * RELEASE, rel=0.1)
    assert shared.spread == pytest.approx(1000.0, rel=0.1)


def test_on_a_slope_no_cubic_spring_is_proposed() -> None:
    """A slope shifts the rest position, where a cubic spring is no longer odd; rig.toml refuses the two together."""
    slope = Quantity(np.radians(5.0), 0.0)
    for settings, offered in ({}, True), ({"slope": slope}, False):
        record = cast(FreeVibration, make_experiments(bench.rig(decay_table(SHORT, DRY, **settings)))[0])
        assert any(model.cubic for model in open_models(record)[0]) is offered
    facts = {"name": "k1", "unit": "N/m", "value": 1.0, "low": 0.5, "high": 1.5, "labels": ["decay"], "swings": True}
    both = {"symbols": ["F_dry", "k_cubic"], "largest": [1.0, 2.0]}
    alone = {"symbols": ["k_cubic"], "largest": [2.0]}
    write = MESSAGES["decays.hidden"].fail
    assert callable(write)
    level = write({**facts, **both, "offers_cubic": True})
    assert 'or write damping = ["viscous", "dry"] and stiffness = "cubic" in' in level
    sloping = write({**facts, **both, "offers_cubic": False})
    assert 'stiffness = "cubic"' not in sloping
    assert 'or write damping = ["viscous", "dry"] in the experiment' in sloping
    last = write({**facts, **alone, "offers_cubic": False})
    assert "write stiffness = " in last
    assert "Record more periods with less noise, or release from smaller deflections. If" in last


@pytest.mark.full
def test_the_longer_record_in_the_text_names_dry_friction() -> None:
    records = cast(list[FreeVibration], make_experiments(bench.rig(decay_table(LONG, DRY))))
    ((record,), (finding,)) = second_models(records)
    assert (finding.code, record.model.symbols) == ("decays.second_fit", ("F_dry",))
    found = cast(Screened, record.about.screened)
    for name in ("c", "F_dry"):
        assert abs(found.values[name] - DRY[name]) < 3.0 * found.errors[name]


def test_stated_words_count_as_known() -> None:
    assert findings(decay_table(SHORT, DRY, damping=("viscous",), stiffness="linear")) == []


@pytest.mark.full
def test_viscous_records_raise_a_finding_where_they_are_short_only() -> None:
    levels = {
        periods: [[f.level for f in findings(decay_table(periods, VISCOUS, seed))] for seed in range(10)]
        for periods in (SHORT, LONG)
    }
    assert levels == {SHORT: [["fail"]] * 10, LONG: [["ok"]] * 10}


@pytest.mark.full
def test_the_records_of_data_exclude_further_forces() -> None:
    rig = cid.read_rig(DATA)
    records = [e for e in make_experiments(rig, "bench") if isinstance(e, FreeVibration)]
    values = {"m1": rig.mass("m1"), "k1": 1422.0, "c": 3.88, **{f"noise_sd[{e.label}]": 2e-5 for e in records}}
    (found,) = check_hidden_terms(records, SimpleNamespace(values=values))  # type: ignore[arg-type]  # pyright: ignore
    assert found.level == "ok"


@pytest.mark.full
@pytest.mark.parametrize("name", ["F_dry", "c_q", "k_cubic"])
def test_estimate_error_and_slope_of_a_further_force_are_those_of_a_fit_of_both(name: str) -> None:
    """Independent route: SciPy's fit of SciPy's motion with the force as an unknown."""
    force = {"F_dry": 0.004, "c_q": 1.0, "k_cubic": 1e7}[name]
    table = decay_table(8.0, {**VISCOUS, name: force})
    record, values = viscous_fit(table)
    found = hidden_terms([record], values)[name]
    time, scale = table["time"], np.array([bench.K1, 0.8, force, RELEASE, TURNING_TIME, NOISE])

    def residuals(z: np.ndarray) -> np.ndarray:
        k1, c, extra, release, turning_time, offset = z * scale
        x = scipy_decay(time, {**VISCOUS, "k1": k1, "c": c, name: extra}, release, turning_time)[0]
        return (table["x_rel"] - x - offset) / NOISE

    end = least_squares(residuals, [1.0, 1.0, 1.0, 1.0, 1.0, 0.0], diff_step=1e-5)
    covariance = np.linalg.inv(end.jac.T @ end.jac) * np.outer(scale, scale)
    sd = float(np.sqrt(covariance[2, 2]))
    assert found.sd == pytest.approx(sd, rel=0.15)
    assert found.estimate == pytest.approx(end.x[2] * force, abs=0.5 * sd)
    for i, other in enumerate(("k1", "c")):
        assert found.slopes[other] * sd == pytest.approx(covariance[i, 2] / sd, abs=0.15 * np.sqrt(covariance[i, i]))


@pytest.mark.full
def test_the_clock_of_a_record_stretches_its_further_forces() -> None:
    """A clock that loses 1 % shows the same forces. Negative control: at times as read F_dry looks different."""
    table = decay_table(60.0, VISCOUS)
    time = table.columns["time"]
    slow = {**table.columns, "time": replace(time, values=time.values / 1.01)}
    drifting = replace(table, columns=slow, drift=Quantity(0.0, 0.02))
    found = []
    for each in (table, drifting):
        (record,) = cast(list[FreeVibration], make_experiments(bench.rig(each)))
        values = {"m1": bench.M1, "k1": bench.K1, "c": 0.8, "noise_sd[decay]": NOISE, "clock_drift[decay]": 0.01}
        found.append(hidden_terms([record], values))
    one, other = found
    for name in ("F_dry", "c_q", "k_cubic"):
        assert other[name].sd == pytest.approx(one[name].sd, rel=0.02)
        assert other[name].slopes["c"] == pytest.approx(one[name].slopes["c"], rel=0.05)


def test_the_limit_of_a_force_far_below_zero_is_small() -> None:
    for ratio in (-20.0, -50.0, -1e6):
        low, high = Hidden(ratio, 1.0, {}, {}).limits(False)
        assert low == 0.0
        assert 0.0 < high < 0.2


def test_the_f_test_of_one_column_is_the_t_test_of_a_slope() -> None:
    """Against ``scipy.stats.linregress``, with so few readings that the degrees of freedom decide."""
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((2, 7))
    found = stats.linregress(x, y)
    F, p, (effect,) = further_columns(np.ones((7, 1)), x[:, None], y)
    assert pytest.approx((found.slope / found.stderr) ** 2, rel=1e-9) == F
    assert p == pytest.approx(found.pvalue, rel=1e-9)
    assert np.sign(effect) == np.sign(found.slope)
    # A column that is a multiple of another counts once, and too few readings tell nothing.
    assert further_columns(np.ones((7, 1)), np.stack([x, 2.0 * x], axis=1), y)[1] == pytest.approx(p, rel=1e-6)
    assert np.isnan(further_columns(np.ones((3, 1)), rng.standard_normal((3, 2)), y[:3])[1])


def test_a_fit_far_off_shows_no_force() -> None:
    """A stiffness with millions of swings between two readings (before: an array larger than the memory)."""
    table = decay_table(SHORT, VISCOUS)
    record = FreeVibration(table, bench.rig(table))
    noise = record.scatters[0]
    responses = force_responses(record, {**VISCOUS, "k1": 1e24, "c": 0.0, noise: NOISE})
    assert [np.any(response) for response in responses.values()] == [False] * 3
    assert np.any(force_responses(record, {**VISCOUS, noise: NOISE})["F_dry"])


#: s, N s/m in the middle of it, and N: the motion falls by a factor of 300.
CHANGE_TIME, C_MIDDLE, RUBBING = np.linspace(0.0, 0.32, 400), 3.9, 5e-3


def growing(growth: float, release: float = RELEASE, symbol: str = "c") -> np.ndarray:
    """(3, n) x_rel, its rate and its acceleration by SciPy, of a c or k1 that grows linearly by ``growth`` of its mean."""
    time = CHANGE_TIME

    def rates(t: float | np.ndarray, s: np.ndarray) -> list[np.ndarray]:
        part = {symbol: 1.0 + growth * (t / time[-1] - 0.5)}
        return [s[1], -(C_MIDDLE * part.get("c", 1.0) * s[1] + bench.K1 * part.get("k1", 1.0) * s[0]) / bench.M1]

    state = solve_ivp(rates, (0.0, time[-1]), [release, 0.0], t_eval=time, rtol=1e-11, atol=1e-16, method="DOP853").y
    return np.stack([*state, rates(time, state)[1]])


@pytest.mark.parametrize(("symbol", "growth"), [("c", -0.4), ("c", 0.4), ("k1", -0.2), ("k1", 0.2)])
def test_the_motion_of_a_c_or_k1_that_changes_is_that_by_scipy(symbol: str, growth: float) -> None:
    theta = {"k1": bench.K1, "m1": bench.M1, "c": C_MIDDLE}
    parts = None
    for order, expected in enumerate(growing(growth, symbol=symbol)):
        columns = changing_motions(CHANGE_TIME, theta, {symbol: growth}, CHANGE_TIME[-1], order)
        parts = np.linalg.lstsq(columns, expected)[0] if parts is None else parts
        np.testing.assert_allclose(columns @ parts, expected, rtol=0.0, atol=2e-5 * np.ptp(expected))


def changing_findings(
    *motions: np.ndarray, noise: float, words: tuple[str, ...], seed: int = 0, **settings: object
) -> list[Finding]:
    """The findings on a c that changes, of records with white noise, at their joint fit with these forces."""
    tables = []
    for i, x in enumerate(motions):
        x = x + noise * np.random.default_rng(seed + i).standard_normal(len(x))
        columns = [bench.column("time", CHANGE_TIME), bench.column("x_rel", x)]
        tables.append(bench.table("free_vibration", columns, f"decay_{i}", **settings))
    made = cast(list[FreeVibration], make_experiments(bench.rig(*tables)))
    records = [e.with_model(DecayModel(words)) for e in made]
    near = {"k1": bench.K1, "c": C_MIDDLE, "F_dry": RUBBING}
    fits = [(each := Screening(e)).fit(e.model, each.scaled(near))[0] for e in records]
    values = {name: fits[-1].values[name] for name in ("m1", "k1", "c", *records[0].model.symbols)}
    for e, own in zip(records, fits, strict=True):
        values |= {row.name: own.values.get(row.symbol, own.noise) for row in e.parameters if row.name not in values}
    moved = [name for name in values if name != "m1" and not name.startswith("noise")]
    scale = np.array([1e-3 if name.startswith("turning") else values[name] for name in moved])

    def joint(z: np.ndarray) -> dict[str, float]:
        return {**values, **dict(zip(moved, [values[name] for name in moved] + z * scale, strict=True))}

    def left(z: np.ndarray) -> np.ndarray:
        return np.concatenate([left_by(e, e.local(joint(z))) for e in records]) / noise

    values = joint(least_squares(left, np.zeros(len(moved)), diff_step=1e-5, x_scale="jac").x)
    return check_changing(records, SimpleNamespace(values=values))  # type: ignore[arg-type]  # pyright: ignore


def rubbed(release: float) -> np.ndarray:
    """x_rel of a decay with dry friction by SciPy."""
    return scipy_decay(CHANGE_TIME, {"k1": bench.K1, "m1": bench.M1, "c": C_MIDDLE, "F_dry": RUBBING}, release, 0.0)[0]


def test_dry_friction_that_a_change_of_c_explains_as_well_is_not_judged() -> None:
    """Before: dry friction of 2.2 ± 0.25 mN and c = 3.83 ± 0.01 trusted, of a rig without it whose c grew to 4.6."""
    (finding,) = changing_findings(growing(0.3)[0], noise=4e-5, words=("dry",))
    assert (finding.level, finding.parameters, finding.facts["decided"]) == ("warn", ("c", "F_dry"), False)
    text = MESSAGES[finding.code].text(finding.level, finding.facts)
    assert "tell dry friction from a c that changes with time; they do not" in text
    assert finding.facts["middle"] == pytest.approx(C_MIDDLE, rel=0.05)
    # The words that the text names count as known.
    line = cast("re.Match[str]", re.search(r"write (damping = \[.*?\])", text))[1]
    stated = tuple(tomllib.loads(line)["damping"])
    assert changing_findings(growing(0.3)[0], noise=4e-5, words=("dry",), damping=stated) == []


def test_another_amplitude_tells_dry_friction_from_a_change_of_c() -> None:
    (finding,) = changing_findings(rubbed(RELEASE), noise=2e-5, words=("dry",), seed=3)
    assert "Add records of 3 times this amplitude" in MESSAGES[finding.code].text(finding.level, finding.facts)
    assert changing_findings(rubbed(RELEASE), rubbed(3.0 * RELEASE), noise=2e-5, words=("dry",), seed=3) == []
    # Of a rig whose c changes they tell that, and stated words do not hide it.
    both = growing(0.3)[0], growing(0.3, 3.0 * RELEASE)[0]
    (named,) = changing_findings(*both, noise=2e-5, words=("dry",), damping=("viscous", "dry"))
    assert (named.facts["decided"], named.parameters) == (True, ("c", "F_dry"))
    assert named.facts["growth"] == pytest.approx(0.3, abs=3.0 * named.facts["error"])
    assert "c changes with time" in MESSAGES[named.code].text(named.level, named.facts)


@pytest.mark.parametrize(("symbol", "growth"), [("c", 0.2), ("c", -0.2), ("k1", 0.15), ("k1", -0.15)])
def test_a_viscous_decay_shows_a_change_of_c_or_k1_where_there_is_one(symbol: str, growth: float) -> None:
    """Before: k1 up to 5 sd off and trusted, of a spring that warms up."""
    (finding,) = changing_findings(growing(growth, symbol=symbol)[0], noise=2e-5, words=())
    assert finding.parameters == (symbol,)
    assert finding.facts["growth"] == pytest.approx(growth, abs=3.0 * finding.facts["error"])
    text = MESSAGES[finding.code].text(finding.level, finding.facts)
    assert f"{symbol} changes with time" in text or f"a {symbol} that changes with time" in text


def test_no_decay_of_constant_c_and_k1_shows_a_change() -> None:
    """Negative control."""
    for seed in range(10):
        assert changing_findings(growing(0.0)[0], noise=2e-5, words=(), seed=seed) == []
