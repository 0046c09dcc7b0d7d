"""Findings on decays and rigs, and the remedies of their texts, applied to the case that raised them."""

import re
from dataclasses import replace
from pathlib import Path
from typing import cast

import bench
import numpy as np
import pytest

import capsule_id as cid
from capsule_id.experiments.free_vibration.lint import lint_decay
from capsule_id.experiments.free_vibration.models import decay as rubbed
from capsule_id.experiments.friction_model import FrictionModel, other_laws
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.experiments.lint import lint
from capsule_id.parameters import TABLE, Parameter, Prior
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.rig.read import read_rig
from capsule_id.views import Finding

KINDS = default_registry()


def found(rig: Rig, *codes: str) -> list[Finding]:
    """The findings with one of these codes."""
    return [finding for finding in lint(rig, KINDS, rig.tables) if finding.code in codes]


def text(finding: Finding) -> str:
    return finding_text(finding, messages_of(KINDS))


def write(folder: Path, time: np.ndarray, values: np.ndarray, settings: str = "", prior: str = "") -> Path:
    """A rig folder with one decay, m."""
    folder.mkdir(exist_ok=True)
    rows = "".join(f"{t:.7g},{1e3 * x:.7g}\n" for t, x in zip(time, values, strict=True))
    (folder / "decay.csv").write_text("time [s],x_rel [mm]\n" + rows, encoding="utf-8")
    entry = f'[[experiment]]\nkind = "free_vibration"\nfile = "decay.csv"\n{settings}\n'
    head = '[rig]\nname = "a"\nm1 = { value = 110, sd = 0.2, unit = "g" }\n'
    (folder / "rig.toml").write_text(head + prior + entry, encoding="utf-8")
    return folder


def decay(time: np.ndarray, seed: int) -> np.ndarray:
    return bench.released(time, 2e-3) + 2e-5 * np.random.default_rng(seed).standard_normal(len(time))


@pytest.mark.full
def test_the_line_that_names_the_release_makes_the_fit_clean(tmp_path: Path) -> None:
    time = np.arange(3600) / 2000.0
    rng = np.random.default_rng(0)
    rest = 2e-5 * rng.standard_normal(2600)
    values = np.concatenate([rest, decay(time[:1000], 1)])
    rig = read_rig(write(tmp_path / "rig", time, values), KINDS)
    (finding,) = found(rig, "decays.release")
    assert finding.level == "warn"
    assert "state an earlier start" in text(finding)
    (line,) = re.findall(r"start = \{.*?\}", text(finding))
    uncut = cid.fit(rig, budget=None)
    result = cid.fit(read_rig(write(tmp_path / "rig", time, values, line), KINDS), budget=None)
    assert (uncut.clean, result.clean) == (True, True)
    assert uncut.summary["map"].equals(result.summary["map"])
    # Negative control: a stated start before the rest is kept, and fails.
    kept = read_rig(write(tmp_path / "kept", time, values, 'start = { value = 0.0, unit = "s" }'), KINDS)
    (failed,) = found(kept, "decays.release")
    assert failed.level == "fail"
    assert line in text(failed)
    k1, c = (result.summary.loc[name] for name in ("k1", "c"))
    assert abs(k1["map"] - bench.K1) < 4.0 * k1["standard_error"]
    assert abs(c["map"] - bench.C) < 4.0 * c["standard_error"]


@pytest.mark.full
def test_a_push_before_the_release_is_left_out(tmp_path: Path) -> None:
    """A hand raises the rod for 25 ms, from 70 % of the deflection. Fitted too, that shifts c by many sds."""
    time = np.arange(1000) / 2000.0
    raised = 2e-3 * np.cos(np.linspace(-np.arccos(0.7), 0.0, 50, endpoint=False))
    values = np.concatenate([raised + 2e-5 * np.random.default_rng(5).standard_normal(50), decay(time[:950], 1)])
    rig = read_rig(write(tmp_path / "rig", time, values), KINDS)
    (finding,) = found(rig, "decays.release")
    assert finding.level == "warn"
    assert "slow approach" in text(finding)
    assert "earlier start" not in text(finding)
    (line,) = re.findall(r"start = \{.*?\}", text(finding))
    stated = read_rig(write(tmp_path / "stated", time, values, line), KINDS)
    assert found(stated, "decays.release") == []
    result = cid.fit(rig, budget=None)
    assert result.clean
    for name, true in (("k1", bench.K1), ("c", bench.C)):
        assert abs(result.summary.loc[name, "map"] - true) < 4.0 * result.summary.loc[name, "standard_error"]
    # Negative control: with the push, the record is not called clean.
    kept = read_rig(write(tmp_path / "kept", time, values, 'start = { value = 0.0, unit = "s" }'), KINDS)
    assert not cid.fit(kept, budget=None).clean


@pytest.mark.full
def test_the_line_that_names_a_second_excitation_ends_the_decay_there(tmp_path: Path) -> None:
    time = np.arange(2000) / 2000.0
    values = np.concatenate([decay(time[:800], 1), decay(time[:1200], 2)])
    (finding,) = found(read_rig(write(tmp_path / "rig", time, values), KINDS), "decays.second")
    (line,) = re.findall(r"stop = \{.*?\}", text(finding))
    rig = read_rig(write(tmp_path / "rig", time, values, line), KINDS)
    assert found(rig, "decays.second", "decays.release", "readings.jump") == []
    assert cid.fit(rig, budget=None).clean


def coarse(rate: float) -> Table:
    """A lightly damped decay of 18 Hz sampled at ``rate`` Hz for 2 s."""
    time = np.arange(round(2.0 * rate)) / rate
    values = bench.released(time, 2e-3, c=0.3) + 1e-5 * np.random.default_rng(3).standard_normal(len(time))
    return bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", values)])


@pytest.mark.full
@pytest.mark.parametrize("rate", [25.0, 20.0, 17.0, 40.0])
def test_an_aliased_decay_fails_unless_a_prior_excludes_the_aliases(rate: float) -> None:
    rig = bench.rig(coarse(rate))
    (finding,) = found(rig, "decays.alias")
    assert finding.level == "fail"
    assert "Sample faster" in text(finding)
    true = bench.K1 * (1.0 - 1e-3)
    stiffnesses = [finding.facts["k1"], *map(float, finding.facts["k1s"].split(", "))]
    assert min(abs(np.log(k1 / true)) for k1 in stiffnesses) < 0.1
    # The remedy: a prior that holds the frequency found, and no other.
    narrow = {"k1": Prior("lognormal", finding.facts["k1"], finding.facts["alone"])}
    assert found(bench.rig(coarse(rate), priors=narrow), "decays.alias") == []
    # A prior that holds an alias instead does not make the frequency found right.
    if abs(np.log(finding.facts["k1"] / bench.K1)) > 0.5:
        (again,) = found(bench.rig(coarse(rate), priors={"k1": Prior("lognormal", bench.K1, 1.2)}), "decays.alias")
        assert again.level == "fail"


def slow(per_period: float) -> Table:
    """A slow pendulum, 0.35 Hz: k1 = 0.53 N/m."""
    time = np.arange(0.0, 30.0, 1.0 / (per_period * 0.35))
    values = bench.released(time, 20e-3, k1=bench.M1 * (2.0 * np.pi * 0.35) ** 2, c=0.01)
    values = values + 1e-4 * np.random.default_rng(3).standard_normal(len(time))
    return bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", values)])


@pytest.mark.full
def test_a_pendulum_whose_k1_lies_outside_its_default_prior_is_not_called_aliased() -> None:
    """Before: a record with 90 samples per period failed, because k1 = 0.5 N/m is less than 1.5 N/m."""
    assert found(bench.rig(slow(150.0)), "decays.alias") == []
    rig = bench.rig(slow(40.0))
    (finding,) = found(rig, "decays.alias")
    assert (finding.level, finding.parameters) == ("warn", ("k1",))
    ((median, factor),) = re.findall(r"k1 = \{ median = ([0-9.]+), factor = ([0-9]+),", text(finding))
    stated = {"k1": Prior("lognormal", float(median), float(factor))}
    assert found(bench.rig(slow(40.0), priors=stated), "decays.alias") == []
    # Negative control: a stated prior that the record contradicts.
    (against,) = found(bench.rig(slow(150.0), priors={"k1": Prior("lognormal", bench.K1, 10.0)}), "decays.alias")
    assert against.level == "fail"


@pytest.mark.full
def test_another_default_prior_moves_no_check(monkeypatch: pytest.MonkeyPatch) -> None:
    """(Before: the default prior of k1 was read as a bound of physics.)"""
    rigs = [bench.rig(table) for table in (coarse(25.0), coarse(40.0), coarse(1000.0), slow(40.0), slow(150.0))]
    before = [found(rig, "decays.alias", "decays.sampling") for rig in rigs]
    assert [bool(findings) for findings in before] == [True, True, False, True, False]
    for median in (1e-2, 1e7):
        other = replace(TABLE["k1"], prior=Prior("lognormal", median, 1.5))
        monkeypatch.setitem(cast(dict[str, Parameter], TABLE), "k1", other)
        assert [found(rig, "decays.alias", "decays.sampling") for rig in rigs] == before


@pytest.mark.full
def test_uneven_sampling_and_fast_sampling_have_no_aliases() -> None:
    assert found(bench.rig(coarse(1000.0)), "decays.alias") == []
    table = coarse(60.0)
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0.0, 2.0, 120))
    values = bench.released(time, 2e-3, c=0.3)
    uneven = replace(table, columns={"time": bench.column("time", time), "x_rel": bench.column("x_rel", values)})
    assert found(bench.rig(uneven), "decays.alias") == []


def test_a_mass_in_the_wrong_unit_is_named_with_the_unit_meant() -> None:
    (finding,) = found(bench.rig(m1=Quantity(110.0, 0.2)), "readings.magnitude")
    assert finding.level == "warn"
    assert "m1 of [rig] is 110 kg" in text(finding)
    assert "If the number is in g, write that unit." in text(finding)
    assert found(bench.rig(m1=Quantity(0.11, 0.2)), "readings.magnitude") == []


@pytest.mark.full
def test_times_in_milliseconds_labelled_seconds_are_named() -> None:
    time = np.arange(1000) / 2000.0
    table = bench.table("free_vibration", [bench.column("time", 1e3 * time), bench.column("x_rel", decay(time, 5))])
    (finding,) = found(bench.rig(table), "decays.magnitude")
    assert "If the times are in ms, write that unit." in text(finding)


def test_pushes_with_swapped_columns_are_named() -> None:
    speed = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    distance = speed**2 / (2.0 * 9.81 * 0.5)
    right = bench.table("dynamic_friction", [bench.column("speed", speed), bench.column("distance", distance)])
    wrong = bench.table("dynamic_friction", [bench.column("speed", distance), bench.column("distance", speed)])
    assert found(bench.rig(right), "pushes.power") == []
    (finding,) = found(bench.rig(wrong), "pushes.power")
    assert "the power 0.5 ±" in text(finding)


@pytest.mark.full
def test_decays_of_one_rig_have_one_frequency() -> None:
    time = np.arange(1000) / 2000.0

    def recorded(label: str, scale: float) -> Table:
        columns = [bench.column("time", scale * time), bench.column("x_rel", decay(time, 5))]
        return bench.table("free_vibration", columns, label)

    assert found(bench.rig(recorded("a", 1.0), recorded("b", 1.1)), "decays.frequency") == []
    (finding,) = found(bench.rig(recorded("a", 1.0), recorded("b", 60.0)), "decays.frequency")
    assert (finding.level, finding.experiment) == ("fail", "b")
    assert "The ratio is near 60 (min and s)." in text(finding)


def test_a_hold_before_a_decay_is_no_frequency_and_hides_no_scale() -> None:
    """Before: a second decay "1.6 times" the first one, "not trusted", and k2 of a spring 3380 times k1."""
    time = np.arange(-2.0, 0.5, 1.0 / 2000.0)
    x = np.where(time < 0.0, bench.released(np.zeros(1), 2e-3), bench.released(np.maximum(time, 0.0), 2e-3))
    x += 4e-6 * np.random.default_rng(5).standard_normal(len(time))
    held, later = (
        bench.table(
            "free_vibration", [bench.column("time", time[a:] - time[a]), bench.column("x_rel", x[a:])], f"from_{a}"
        )
        for a in (0, 3800)
    )
    assert found(bench.rig(held, later), "decays.frequency") == []

    def spring(factor: float, wrong: float = 1.0) -> Table:
        deflection = np.array([1e-4, 2e-4, 3e-4])
        columns = [
            bench.column("deflection", wrong * deflection),
            bench.column("force", factor * bench.K1 * deflection),
        ]
        return bench.table("support_spring", columns, "soft", spring="soft")

    for factor in (1.0, 250.0):
        assert found(bench.rig(held, spring(factor)), "readings.magnitude") == []
        for wrong in (1e-3, 1e3):
            assert found(bench.rig(held, spring(factor, wrong)), "readings.magnitude") != []


@pytest.mark.full
def test_a_rod_that_friction_holds_after_one_swing_needs_a_larger_release() -> None:
    """F_dry is 0.35 of the spring's force at the first release, and 0.07 of it at the second."""
    time = np.arange(250) / 500.0
    forces = {"k1": bench.K1, "c": 1.0, "m1": bench.M1, "F_dry": 0.35 * bench.K1 * 2e-3}
    one, larger = (
        bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", x)])
        for x in (np.asarray(rubbed(time, forces, release, 0.0, 30).x_rel) for release in (2e-3, 1e-2))
    )
    with pytest.raises(cid.InputError, match="release it at once, from a larger deflection"):
        KINDS["free_vibration"].check([one])
    KINDS["free_vibration"].check([larger])


@pytest.mark.full
def test_a_spike_is_no_loss_of_samples_and_its_row_can_be_deleted() -> None:
    time = np.arange(1200) / 400.0
    clean = bench.released(time, 4e-3, c=0.6) + 1.5e-5 * np.random.default_rng(13).standard_normal(1200)

    def found(time: np.ndarray, x: np.ndarray) -> list[Finding]:
        table = bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", x)])
        return [f for f in lint_decay(table, bench.rig(table)) if f.level == "fail"]

    spoiled = clean + 2e-3 * (np.arange(1200) == 500)
    ((finding,), lost) = found(time, spoiled), found(time[:1187], np.delete(clean, slice(60, 73)))
    assert (finding.code, finding.facts["line"]) == ("readings.spike", 502)
    assert finding_text(finding, messages_of(default_registry())).endswith("Delete its row.")
    assert found(np.delete(time, 500), np.delete(spoiled, 500)) == []
    # Negative control: lost samples are no spike.
    assert [f.code for f in lost] == ["readings.jump"]


@pytest.mark.full
@pytest.mark.parametrize("begin", [0, 40, 300])
def test_the_line_that_names_a_burst_of_noise_leaves_it_out(begin: int) -> None:
    """A hand that still shakes the rig, or a rattle. Before: "samples were lost"."""
    time = np.arange(1500) / 900.0
    rng = np.random.default_rng(5)
    values = bench.released(time, 4e-3, c=0.6) + 2e-5 * rng.standard_normal(1500)
    values[begin : begin + 40] += 4e-4 * rng.standard_normal(40)

    def faults(rows: slice) -> list[Finding]:
        columns = [bench.column("time", time[rows]), bench.column("x_rel", values[rows])]
        table = bench.table("free_vibration", columns)
        return [f for f in lint_decay(table, bench.rig(table)) if f.level == "fail"]

    (finding,) = faults(slice(None))
    assert finding.code == "readings.burst"
    key, value = finding.facts["key"], finding.facts["value"]
    assert f"{key} = {{ value = {value:.10g}" in text(finding)
    assert key == ("stop" if begin == 300 else "start")
    kept = time <= value if key == "stop" else time >= value
    assert np.sum(kept) > 250
    assert faults(slice(int(np.argmax(kept)), int(np.argmax(kept)) + int(np.sum(kept)))) == []


@pytest.mark.full
@pytest.mark.parametrize("stated", [(), ("stiffness",), ("damping", "noise")])
def test_remedies_name_only_the_words_that_the_entry_states(tmp_path: Path, stated: tuple[str, ...]) -> None:
    """Before: "remove damping, stiffness, drift and noise from its entry" of an entry without any of them."""
    values = {"damping": "viscous", "stiffness": "linear", "noise": "white"}
    lines = "\n".join(f'{word} = "{values[word]}"' for word in stated)
    time = np.arange(400) / 2000.0
    (e,) = make_experiments(read_rig(write(tmp_path / "rig", time, decay(time, 1), lines), KINDS))
    white = {"record": "a", "Q": 99.0, "lags": 20, "p": 1e-9, **e.noise_facts()}
    coloured = text(Finding("residuals.white", "fail", white, "a"))
    start = white["start"]
    assert 0.0 < start < time[-1]
    assert f'write start = {{ value = {start:.10g}, unit = "s" }} in its entry' in coloured
    left = np.abs(e.values[e.time >= start])
    assert 0.4 < np.max(left) / np.max(np.abs(e.values)) < 0.52
    halves = {
        "label": "a",
        "name": "k1",
        "first": 1.0,
        "second": 2.0,
        "z": 9.0,
        "unit": "N/m",
        "model": "viscous damping",
    }
    apart = text(Finding("decays.halves", "fail", {**halves, "stated": white["stated"]}, "a"))
    for word in ("damping", "stiffness", "drift", "noise"):
        assert (word in coloured.partition("or remove ")[2].partition(" from its entry")[0]) == (word in stated)
    assert ("Remove stiffness from its entry, or state start" in apart) == ("stiffness" in stated)
    assert ("State start and stop" in apart) == ("stiffness" not in stated)
    # Where the model holds a cubic spring, the amplitude is no cause any more: before, it was named, with the time.
    halves = {**halves, "model": "viscous damping, cubic spring", "stated": ()}
    in_time = text(Finding("decays.halves", "fail", halves, "a"))
    assert "The stiffness changes with the time" in in_time
    assert "State start" not in in_time


@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("noise", ["white", "ar1"])
def test_the_remedy_of_a_run_names_other_laws_and_no_noise_that_is_stated(constant: bool, noise: str) -> None:
    """Before: "state noise = ar1" where it is stated, and "check friction law" without a line to write."""
    model = FrictionModel(constant=constant)
    facts = {"record": "run", "Q": 99.0, "lags": 20, "p": 1e-9, "model": "capsule", "noise": noise, "law": model.name}
    advice = text(Finding("residuals.white", "fail", {**facts, "other_laws": other_laws(model)}, "run"))
    assert ('remove noise = "white"' in advice) == (noise == "white")
    assert ('compare it with friction = "constant" or free = ["ratio"] in [model]' in advice) == (not constant)
    assert 'free = ["ratio"]' not in "".join(other_laws(FrictionModel(free=("ratio",))))


@pytest.mark.parametrize("spring", [False, True])
@pytest.mark.parametrize("code", ["residuals.white", "runs.repeated"])
def test_the_remedy_of_a_run_names_a_spring_only_where_the_run_has_one(code: str, spring: bool) -> None:
    """Before: "check spring and gap" for a shaken frame, and "p = 0" where a probability underflows."""
    facts = {
        "record": "run",
        "Q": 99.0,
        "F": 9.0,
        "lags": 20,
        "p": 0.0,
        "model": "capsule",
        "noise": None,
        "spring": spring,
    }
    advice = text(Finding(code, "fail", {**facts, "law": "", "other_laws": ()}, "run"))
    assert ("spring" in advice) == ("gap" in advice) == spring
    assert "p < 1e-10" in advice
