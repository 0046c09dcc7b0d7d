"""Friction against load: a normal force in every row, sliding without a speed, and what does not go with them."""

import re
import warnings
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np
import pytest

import capsule_id as cid
from capsule_id import cli
from capsule_id.api import Fit
from capsule_id.errors import InputError
from capsule_id.experiments.friction import FrictionExperiment
from capsule_id.experiments.friction_variants import candidates
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.checks.settings import trend
from capsule_id.rig.model import Rig
from tests.measured.folders import Entry, make_rig, named_line, quantity

LOAD = np.repeat([5.458, 9.382, 54.51, 103.6], 6)
CONSTANT = 'friction = "constant"'


def rig(folder: Path, entry: Entry, model: str = CONSTANT) -> Rig:
    with suppress(InputError):  # without ``model``
        make_rig(folder, entry)
    toml = folder / "rig.toml"
    toml.write_text(f"{toml.read_text()}\n[model]\n{model}\n")
    return cid.read_rig(folder)


def table(
    kind: str, mu: float, further: dict[str, np.ndarray] | None = None, settings: dict[str, str] | None = None
) -> Entry:
    force = mu * LOAD * (1.0 + 0.03 * np.random.default_rng(3).standard_normal(len(LOAD)))
    return Entry(kind, "table", {"force [N]": force, "normal_force [N]": LOAD, **(further or {})}, settings or {})


@pytest.mark.full
@pytest.mark.parametrize("kind", ["static_friction", "sliding_friction"])
def test_forces_at_several_loads_give_one_coefficient(tmp_path: Path, kind: str) -> None:
    """Before: one experiment for each load, and no experiment for sliding without a speed."""
    result = cid.fit(rig(tmp_path, table(kind, 0.21)), budget=None)
    row = result.summary.loc["mu"]
    assert row["map"] == pytest.approx(0.21, abs=4.0 * row["standard_error"])
    assert row["standard_error"] == pytest.approx(0.21 * 0.03 / np.sqrt(len(LOAD)), rel=0.5)
    assert row["paper"] == pytest.approx(0.21, rel=0.02)
    assert result.clean
    assert [f for f in result.findings if f.code.startswith("friction.")] == []


def test_loads_with_speeds_are_those_of_one_coefficient(tmp_path: Path) -> None:
    speed = {"speed [m/s]": np.geomspace(0.01, 0.5, len(LOAD))}
    entry = table("sliding_friction", 0.21, speed)
    columns = {"speed [m/s]": speed["speed [m/s]"], "coefficient [1]": entry.columns["force [N]"] / LOAD}
    one = cid.fit(rig(tmp_path / "force", entry), budget=None).summary.loc["mu"]
    other = cid.fit(rig(tmp_path / "ratio", Entry("sliding_friction", "table", columns)), budget=None).summary.loc["mu"]
    assert one["map"] == pytest.approx(other["map"], rel=1e-6)
    assert one["standard_error"] == pytest.approx(other["standard_error"], rel=1e-3)


def test_a_law_that_depends_on_speed_needs_it_and_the_remedy_works(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sliding readings without a speed") as caught:
        make_rig(tmp_path, table("sliding_friction", 0.21))
    assert CONSTANT in caught.value.remedy
    assert named_line(caught.value) == "[[experiment]]"
    rig(tmp_path, table("sliding_friction", 0.21), CONSTANT)
    with pytest.raises(InputError, match="sliding readings without a speed"):
        rig(tmp_path / "viscous", table("sliding_friction", 0.21), f'{CONSTANT}\nfree = ["viscous"]')


@pytest.mark.parametrize(
    ("settings", "rule"),
    [
        ({"normal_force": quantity(6.0, "N")}, "must not stand beside"),
        ({"N0": quantity(6.0, "N")}, "must not stand beside"),
    ],
)
def test_two_normal_forces_are_refused(tmp_path: Path, settings: dict[str, str], rule: str) -> None:
    with pytest.raises(InputError, match=rule):
        make_rig(tmp_path, table("static_friction", 0.21, settings=settings))


def test_a_normal_force_needs_a_force(tmp_path: Path) -> None:
    columns = {"speed [m/s]": LOAD / 100.0, "coefficient [1]": 0.2 + LOAD / 1000.0, "normal_force [N]": LOAD}
    with pytest.raises(InputError, match="needs the column force"):
        make_rig(tmp_path, Entry("sliding_friction", "table", columns))


def experiment(
    folder: Path, entry: Entry, model: str = CONSTANT, head: dict[str, str] | None = None
) -> FrictionExperiment:
    with suppress(InputError):  # without ``model``
        make_rig(folder, entry, head=head)
    toml = folder / "rig.toml"
    toml.write_text(f"{toml.read_text()}\n[model]\n{model}\n")
    (made,) = make_experiments(cid.read_rig(folder))
    return cast(FrictionExperiment, made)


@pytest.mark.parametrize("kind", ["static_friction", "sliding_friction"])
def test_the_error_of_the_normal_force_counts(tmp_path: Path, kind: str) -> None:
    """Its sd was read and ignored."""
    rng, sd = np.random.default_rng(4), 0.3
    true = np.repeat(LOAD, 40)
    columns = {"force [N]": 0.21 * true, "normal_force [N]": true + sd * rng.standard_normal(len(true))}
    made = experiment(tmp_path, Entry(kind, "table", columns, {"normal_force_sd": quantity(sd, "N")}))
    (misfit,) = made.misfits({"mu": 0.21}, np)
    spread = np.std(misfit.raw / np.sqrt(misfit.fixed_variance))
    assert spread == pytest.approx(1.0, rel=4.0 / np.sqrt(2.0 * len(true)))
    speed, coefficient = made.paper_points()
    relative, _ = made.point_errors()
    assert np.std((coefficient / 0.21 - 1.0) / relative) == pytest.approx(1.0, rel=0.1)
    assert np.all(speed == 0.0)


def test_no_law_is_proposed_that_is_refused(tmp_path: Path) -> None:
    """A viscous part and a normal force of every row: the comparison took the weight for it."""
    head = {name: quantity(0.5, "kg", 0.01) for name in ("m1", "m2")}
    speed = {"speed [m/s]": np.geomspace(0.01, 0.5, len(LOAD))}
    entry = table("sliding_friction", 0.21, speed)
    made = experiment(tmp_path / "row", entry, head=head)
    assert not any("viscous" in model.free for model in candidates([made]))
    weighed = Entry(entry.kind, entry.label, {name: x for name, x in entry.columns.items() if "normal" not in name})
    made = experiment(tmp_path / "weight", weighed, head=head)
    assert any("viscous" in model.free for model in candidates([made]))


def at_loads(folder: Path, mu: tuple[float, ...], order: np.ndarray) -> Fit:
    """Pulls at four loads with these coefficients and 3 % scatter, in an order of the rows."""
    rng = np.random.default_rng(4)
    force = np.repeat(mu, 6) * LOAD * (1.0 + 0.03 * rng.standard_normal(len(LOAD)))
    entry = Entry("static_friction", "table", {"force [N]": force[order], "normal_force [N]": LOAD[order]})
    return cid.fit(rig(folder, entry), budget=None)


@pytest.mark.full
def test_a_coefficient_that_changes_with_the_load_is_named_in_any_order(tmp_path: Path) -> None:
    """Before: trusted where the rows are shuffled, which the finding on their order had proposed."""
    shuffled = np.random.default_rng(0).permutation(len(LOAD))
    for name, order in (("sorted", np.arange(len(LOAD))), ("shuffled", shuffled)):
        result = at_loads(tmp_path / name, (0.32, 0.31, 0.28, 0.38), order)
        (found,) = [f for f in result.findings if f.level == "fail"]
        assert found.code == "trials.loads"
        assert "0.32 at 5.46 N" in result.text(found)
        assert "at 104 N" in result.text(found)
        assert result.summary.at["mu", "trust"] == "not trusted"
        # The coefficients at the loads have an sd of 0.04; the scatter of the trials alone would give 0.003.
        assert result.summary.at["mu", "sd"] > 0.012
    # The remedy: the rows of one load.
    one = {"force [N]": 0.28 * LOAD[12:18], "normal_force [N]": LOAD[12:18]}
    one["force [N]"] = one["force [N]"] * (1.0 + 0.03 * np.random.default_rng(5).standard_normal(6))
    assert cid.fit(rig(tmp_path / "one", Entry("static_friction", "table", one)), budget=None).clean


def test_a_constant_force_beside_the_friction_is_fitted_by_the_words_of_its_finding(tmp_path: Path) -> None:
    """F0 + mu N: one pull at each of six loads; before, only the mean ratio could be quoted, 30 % above the slope."""
    load = np.linspace(50.0, 200.0, 6)
    force = 35.0 + 1.15 * load * (1.0 + 0.01 * np.random.default_rng(8).standard_normal(6))
    read = rig(tmp_path, Entry("static_friction", "table", {"force [N]": force, "normal_force [N]": load}))
    first = cid.fit(read, budget=None)
    (found,) = [f for f in first.findings if f.code == "trials.loads"]
    assert found.level == "fail"
    text = first.text(found)
    line = re.search(r"(offset = \{.*?\})", text)
    assert line is not None
    toml = tmp_path / "rig.toml"
    own = toml.read_text().replace("[model]", 'force_instrument = "cell"\n[model]')
    toml.write_text(f'{own}\n[[instrument]]\nname = "cell"\n{line[1]}\n')
    second = cid.fit(cid.read_rig(tmp_path), budget=None)
    row = second.summary.loc["mu"]
    slope = np.polyfit(load, force, 1, w=1.0 / load)[0]
    assert row["map"] == pytest.approx(slope, rel=0.01)
    assert abs(row["map"] - 1.15) < 3.0 * row["standard_error"] < 0.1
    assert second.clean
    assert second.nuisances.loc["offset[cell]", "map"] == pytest.approx(35.0, abs=5.0)
    # The control: a coefficient that falls to a level is no constant force.
    (folder := tmp_path / "control").mkdir()
    bent = load * np.where(load < 100.0, 1.8, 1.2)
    read = rig(folder, Entry("static_friction", "table", {"force [N]": bent, "normal_force [N]": load}))
    assert not cid.fit(read, budget=None).clean


def test_a_trend_with_the_load_is_named_where_every_trial_has_its_own() -> None:
    rng = np.random.default_rng(1)
    load = np.geomspace(5.0, 100.0, 12)

    def p(power: float, seed: int) -> float:
        own = np.random.default_rng(seed)
        return trend(power * np.log(load) + 0.05 * own.standard_normal(12), load)

    assert p(0.1, 0) < 0.002
    assert np.mean([p(0.0, int(seed)) < 0.05 for seed in rng.integers(0, 10**6, 200)]) < 0.09


@pytest.mark.full
def test_two_loads_with_few_rows_and_loads_on_a_slope(tmp_path: Path) -> None:
    rng, load = np.random.default_rng(2), np.repeat([6.0, 60.0], 5)
    force = np.repeat([0.35, 0.28], 5) * load * (1.0 + 0.02 * rng.standard_normal(10))
    shuffled = rng.permutation(10)
    columns = {"force [N]": force[shuffled], "normal_force [N]": load[shuffled]}
    few = cid.fit(rig(tmp_path / "few", Entry("static_friction", "table", columns)), budget=None)
    assert [f.code for f in few.findings if f.level == "fail"] == ["trials.loads"]
    # The weight along a slope is no friction.
    along = 0.6 * 9.81 * np.sin(np.deg2rad(20.0))
    columns = {"force [N]": force + along, "normal_force [N]": load}
    with suppress(InputError):  # the weight along the slope needs the masses
        pressed = {"slope": quantity(20.0, "deg"), "load_is": '"pressed"'}
        make_rig(tmp_path / "slope", Entry("static_friction", "table", columns, pressed))
    toml = tmp_path / "slope" / "rig.toml"
    masses = '[rig]\nm1 = { value = 0.1, sd = 0.001, unit = "kg" }\nm2 = { value = 0.5, sd = 0.001, unit = "kg" }\n'
    toml.write_text(toml.read_text().replace("[rig]\n", masses) + f"\n[model]\n{CONSTANT}\n")
    found = [f for f in cid.fit(cid.read_rig(toml.parent), budget=None).findings if f.code == "trials.loads"]
    assert found[0].facts["means"][0][1] == pytest.approx(0.35, rel=0.03)


@pytest.mark.full
@pytest.mark.parametrize("kind", ["static_friction", "sliding_friction"])
@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_weights_pull_along_a_slope(tmp_path: Path, kind: str, direction: str) -> None:
    """Before: every load pulled along the slope as capsule and rod do, and mu was wrong without a word."""
    slope, mu, sd = np.deg2rad(7.0), 0.35, 0.2
    rng, sign = np.random.default_rng(6), -1.0 if direction == "backward" else 1.0
    force = LOAD * (mu * (1.0 + 0.01 * rng.standard_normal(len(LOAD))) + sign * np.tan(slope))
    settings = {"slope": quantity(7.0, "deg"), "direction": f'"{direction}"', "load_is": '"weight"'}
    entry = Entry(kind, "table", {"force [N]": force, "normal_force [N]": LOAD}, settings)
    result = cid.fit(rig(tmp_path / "weight", entry), budget=None)
    row = result.summary.loc["mu"]
    assert row["map"] == pytest.approx(mu, abs=4.0 * row["standard_error"])
    assert row["standard_error"] < 0.003
    assert row["paper"] == pytest.approx(mu, rel=0.01)
    assert result.clean
    # The error of the normal force counts in the weight along the slope too.
    read = np.repeat(LOAD, 40) + sd * rng.standard_normal(40 * len(LOAD))
    columns = {"force [N]": np.repeat(LOAD, 40) * (mu + sign * np.tan(slope)), "normal_force [N]": read}
    made = experiment(
        tmp_path / "sd", Entry(kind, "table", columns, {**settings, "normal_force_sd": quantity(sd, "N")})
    )
    (misfit,) = made.misfits({"mu": mu, "slope": slope}, np)
    assert np.std(misfit.raw / np.sqrt(misfit.fixed_variance)) == pytest.approx(1.0, rel=0.1)
    relative, _ = made.point_errors()
    assert np.std((made.paper_points()[1] / mu - 1.0) / relative) == pytest.approx(1.0, rel=0.1)
    # Negative control: as a force without weight, beside capsule and rod.
    masses = '[rig]\nm1 = { value = 0.1, unit = "kg" }\nm2 = { value = 0.5, unit = "kg" }\n'
    toml = tmp_path / "weight" / "rig.toml"
    toml.write_text(toml.read_text().replace("[rig]\n", masses).replace('"weight"', '"pressed"'))
    other = cid.fit(cid.read_rig(toml.parent), budget=None)
    assert not other.clean
    assert abs(other.summary.at["mu", "map"] - mu) > 0.05


@pytest.mark.parametrize("kind", ["static_friction", "sliding_friction"])
def test_a_load_on_a_slope_must_say_where_it_comes_from(tmp_path: Path, kind: str) -> None:
    slope = {"slope": quantity(5.0, "deg")}
    with pytest.raises(InputError, match="load_is must say") as caught:
        rig(tmp_path / "none", table(kind, 0.3, settings=slope))
    assert 'load_is = "weight"' in caught.value.remedy
    rig(tmp_path / "stated", table(kind, 0.3, settings={**slope, "load_is": '"weight"'}))
    with pytest.raises(InputError, match="load_is needs a slope"):
        rig(tmp_path / "level", table(kind, 0.3, settings={"load_is": '"weight"'}))


@pytest.mark.parametrize("kind", ["static_friction", "sliding_friction"])
@pytest.mark.parametrize("sd", ["", ", sd = 0.1"])
def test_a_stated_normal_force_holds_the_N0_of_the_rig(tmp_path: Path, kind: str, sd: str) -> None:
    """Before: internal failure, KeyError m1."""
    make = rig(tmp_path, table(kind, 0.3)).folder / "rig.toml"
    make.write_text(make.read_text().replace("[rig]\n", f'[rig]\nN0 = {{ value = 2, unit = "N"{sd} }}\n'))
    result = cid.fit(cid.read_rig(tmp_path), budget=None)
    assert result.summary.at["mu", "map"] == pytest.approx(0.3, abs=0.01)
    assert list(result.summary.index) == ["mu"]


@pytest.mark.parametrize("kind", ["static_friction", "sliding_friction"])
def test_forces_below_the_weight_along_the_slope_are_refused(tmp_path: Path, kind: str) -> None:
    """Loads that press, taken for weights (before: internal failure, starts must be finite)."""
    settings = {"slope": quantity(20.0, "deg"), "load_is": '"weight"'}
    made = rig(tmp_path, table(kind, 0.3, settings=settings))
    with pytest.raises(InputError, match="must exceed the weight along the slope") as caught:
        make_experiments(made)
    assert "load_is" in caught.value.remedy
    assert cli.fit_params([str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()


def test_equal_readings_at_one_load_hide_no_other_load(tmp_path: Path) -> None:
    """Before: no finding, and warnings of SciPy, because one load had no variance of its own."""
    ratio = np.array([0.292, 0.292, 0.292, 0.280, 0.281, 0.282, 0.269, 0.270, 0.271, 0.259, 0.260, 0.261])
    load = np.repeat([6.0, 8.0, 10.0, 12.2], 3)
    order = np.random.default_rng(1).permutation(len(load))
    entry = Entry("static_friction", "table", {"force [N]": (ratio * load)[order], "normal_force [N]": load[order]})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = cid.fit(rig(tmp_path, entry), budget=None)
    assert "trials.loads" in {finding.code for finding in result.findings if finding.level == "fail"}
    # negative control: the same coefficients at other loads
    mixed = np.random.default_rng(3).permutation(load)
    entry = Entry("static_friction", "table", {"force [N]": ratio * mixed, "normal_force [N]": mixed})
    result = cid.fit(rig(tmp_path / "mixed", entry), budget=None)
    assert "trials.loads" not in {finding.code for finding in result.findings if finding.level == "fail"}
