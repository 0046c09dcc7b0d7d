"""Comparison of models: what is fitted, tables, recommendation, and what is refused first."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from scipy.stats import multivariate_normal, norm

from capsule_id.api import read_rig
from capsule_id.cli import fit_params
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference import compare
from capsule_id.inference import prediction as leave_out
from capsule_id.inference.compare import Choice, _choose, _Variant, compare_models, compare_points
from capsule_id.inference.prediction import LeftOut, WeightedDraws
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import ModelChoices, Rig
from capsule_id.synthetic import RobotDesign, synthesize_robot
from tests.experiments import bench
from tests.inference.three_settings import PERIODS, THETA, three_settings


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return three_settings(tmp_path_factory.mktemp("robot") / "rig")


def draws_near_the_truth(target: LogPosterior, *_: object) -> WeightedDraws:
    """Equal weights, one block."""
    own = {"trial_sd": 1e-3, "discrepancy": 2e-4, "session_1": THETA["session_1"]}
    truth = np.array([THETA.get(name, own.get(name.split("[")[0])) for name in target.names])
    u = target.unconstrain(truth) + 0.01 * np.random.default_rng(0).standard_normal((40, target.dimension))
    values = [target.mapping(theta) for theta in target.theta(u)]
    nothing = cast(Any, None)
    block = dict.fromkeys(target.names, 0)
    weight, size = np.zeros((40, 1)), np.zeros((2, 1))
    return WeightedDraws(target, nothing, nothing, weight, size, block, np.arange(40), values)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws near the true values stand for the adapted proposals."""
    monkeypatch.setattr(compare, "joint_fit", lambda *_: None)
    for module in (compare, leave_out):
        monkeypatch.setattr(module, "weighted_draws", draws_near_the_truth)


@pytest.mark.full
@pytest.mark.usefixtures("drawn")
def test_a_comparison_of_a_robot(rig: Rig) -> None:
    """The truth has the lag of 8 ms."""
    seen = list[tuple[int, int, str]]()
    choice = compare_models(rig, ["lag"], default_registry(), 0, lambda *step: seen.append(step))
    assert seen == [(0, 4, "as stated"), (1, 4, "no lag"), (2, 4, "as stated"), (3, 4, "no lag")]
    assert list(choice.table.index) == ["as stated", "no lag"]
    assert choice.table.loc["no lag", "difference"] < -2.0
    assert choice.table["log_evidence"].tolist() == pytest.approx([0.0, 0.0])
    assert list(choice.predictions.index) == [
        f"{t} ms, duty 30 %, {n} periods" for t, n in ((60, 67), (80, 50), (100, 40))
    ]
    assert "direction is right in 3 of 3 settings" in choice.text


@pytest.mark.full
@pytest.mark.usefixtures("drawn")
def test_two_progressions_are_named_in_the_predictions(rig: Rig) -> None:
    """The variants leave out the settings of both, one at a time."""
    (table,) = rig.tables
    both = replace(rig, tables=(replace(table, label="first"), replace(table, label="second")))
    choice = compare_models(both, ["lag"])
    assert len(choice.predictions) == 6
    assert set(choice.predictions.index.get_level_values(0)) == {"first", "second"}
    assert choice.table.loc["as stated", "elpd"] > choice.table.loc["no lag", "elpd"]


@pytest.mark.full
@pytest.mark.usefixtures("drawn")
def test_the_models_that_the_readings_demand_are_compared(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a fit takes them from ``second_models``: here a stand-in leaves out one setting."""
    monkeypatch.setattr(compare, "second_models", lambda made, _: ([cast(Progression, e).without(0) for e in made], []))
    assert len(compare_models(rig, ["lag"]).predictions) == 2


def variant(parameters: int, density: list[float], shape: float = 0.3, refits: int = 0) -> _Variant:
    """A variant of one progression with these densities of its settings."""
    nothing = cast(Any, None)
    left_out = [LeftOut(one, shape, np.zeros(1), nothing) for one in density]
    return _Variant(parameters, nothing, ((nothing, left_out),), (0.0, 0.1), refits)


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of predictions, their number of settings."""
    monkeypatch.setattr(compare, "left_out_predictions", lambda _, own, __: pd.DataFrame({"density": [own[0].density]}))


@pytest.mark.usefixtures("tables")
def test_the_simplest_variant_within_two_standard_errors_is_recommended() -> None:
    fitted = {
        "best": variant(5, [1.0, 1.2, 0.9, 1.1]),
        "as good": variant(4, [0.9, 1.3, 0.9, 1.0]),
        "wrong": variant(3, [-3.0, -2.5, -3.1, -2.9]),
    }
    choice: Choice = _choose(fitted, dict.fromkeys(fitted, ModelChoices(free=("lag",))), 0)
    assert list(choice.table.index) == ["best", "as good", "wrong"]
    assert choice.recommended == "as good"
    assert choice.predictions["density"].tolist() == [0.9]
    assert 'free = ["lag"]' in choice.line
    difference = np.array(fitted["as good"].density) - np.array(fitted["best"].density)
    assert choice.table.loc["as good", "se"] == pytest.approx(2.0 * np.std(difference, ddof=1))


@pytest.mark.usefixtures("tables")
def test_an_uncertain_comparison_says_so() -> None:
    fitted = {"one": variant(5, [1.0, 1.2, 0.9]), "other": variant(4, [0.0, -np.inf, 0.1], np.inf, 1)}
    choice = _choose(fitted, dict.fromkeys(fitted, ModelChoices()), 0)
    assert choice.recommended == "one"
    assert "few draws determine it (shape above 0.7): other." in choice.line
    assert "uncertain" not in _choose({"one": fitted["one"]}, {"one": ModelChoices()}, 0).line


@pytest.mark.usefixtures("tables")
@pytest.mark.parametrize(("behind", "shape", "refits"), [(0.5, 0.8, 2), (9.0, 0.8, 0), (9.0, np.inf, 2)])
def test_variants_are_refitted_unless_they_are_hopeless(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, behind: float, shape: float, refits: int
) -> None:
    """Two of four settings have a large shape. A variant far behind keeps it and is named, unless its density is unknown."""
    density = {"ratio": [1.0, 1.2, 0.9, 1.1], "other": [1.0 - behind, 1.2 - 1.2 * behind, 0.9 - behind, 1.1 - behind]}

    def fitted(rig: Rig, *_: object) -> _Variant:
        own = variant(5, density["ratio" if "lag" in rig.model.free else "other"])
        ((nothing, left_out),) = own.left_out
        return replace(
            own, left_out=((nothing, [replace(left_out[k], shape=shape if k > 1 else 0.3) for k in range(4)]),)
        )

    asked = list[int]()

    def again(_: object, __: object, setting: int, ___: int) -> LeftOut:
        asked.append(setting)
        return LeftOut(0.8, 0.4, np.zeros(1), cast(Any, None))

    monkeypatch.setattr(compare, "_fit_variant", fitted)
    monkeypatch.setattr(compare, "leave_setting_out", again)
    choice = compare_models(rig, ["lag"])
    assert choice.table.loc["as stated", "refits"] == 2
    assert choice.table.loc["no lag", "refits"] == refits
    assert asked == [2, 3] * (1 + refits // 2)
    assert "uncertain" not in choice.line
    assert ("Far behind, and therefore not fitted again without their settings: no lag." in choice.line) == (
        refits == 0
    )


def a_point_fit(maximum: Mapping[str, float]) -> Callable[..., Any]:
    """In place of ``joint_fit``: the maximum by friction law and free parameters, sds of 0.1."""

    def fit(target: LogPosterior, *_: object) -> Any:
        choices = target.rig.model
        best = maximum.get(" ".join([choices.friction, *choices.free]), 0.0)
        covariance = 0.01 * np.eye(target.dimension)
        maxima, stalled = np.array([best - 7.0, best]), np.array([True, False])
        return SimpleNamespace(log_posterior=maxima, stalled=stalled, covariance=covariance)

    return fit


def test_points_are_compared_by_the_normal_approximation(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """One more parameter with an sd of 0.1 must raise the log-posterior by 1.38 to leave the evidence as it is."""
    monkeypatch.setattr(compare, "joint_fit", a_point_fit({"stribeck ratio lag": 10.0, "stribeck ratio": 3.0}))
    seen = list[tuple[int, int, str]]()
    choice = compare_points(rig, ["lag"], default_registry(), 0, lambda *step: seen.append(step))
    assert seen == [(0, 2, "as stated"), (1, 2, "no lag")]
    assert choice.recommended == "as stated"
    own = choice.table.loc["as stated"]
    normal = multivariate_normal(np.zeros(int(own["parameters"])), 0.01)
    assert own["converged"]
    assert own["log_evidence"] == pytest.approx(10.0 - float(normal.logpdf(normal.mean)))
    per_parameter = -float(norm(0.0, 0.1).logpdf(0.0))
    assert choice.table.loc["no lag", "difference"] == pytest.approx(-7.0 - per_parameter)
    assert "Rejected: no lag (-5.6)." in choice.text
    assert 'free = ["ratio", "lag"]' in choice.line
    assert "This comparison is rough" in choice.text


def test_the_simplest_variant_with_nearly_the_best_evidence_is_recommended(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compare, "joint_fit", a_point_fit({"stribeck ratio lag": 10.0, "stribeck ratio": 9.0}))
    choice = compare_points(rig, ["lag"])
    assert choice.recommended == "no lag"
    assert "Rejected" not in choice.text


def test_the_command_compares_by_points_where_nothing_is_to_be_sampled(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("compare_points", "compare_models"):
        monkeypatch.setattr(compare, name, lambda *_, name=name: SimpleNamespace(text=name))
    for words, called in (([], "compare_models"), (["--no-sample"], "compare_points")):
        assert fit_params([str(rig.folder), "--compare", "lag", "--quiet", *words]) == 0
        assert capsys.readouterr().out.strip() == called


def test_a_law_that_the_readings_of_a_slide_cannot_have_is_not_compared(rig: Rig) -> None:
    """Before: slides without a speed counted as break-away, and a viscous force was scaled with the load of each row."""
    force = np.array([1.3, 2.7, 3.9])
    slide = bench.table("sliding_friction", [bench.column("force", force), bench.column("normal_force", 2.0 * force)])
    flat = replace(rig, tables=(*rig.tables, slide), model=ModelChoices(friction="constant"))
    assert "eq. (1)" in compare._variants(replace(flat, tables=rig.tables), ["friction"], None)[0]
    names = set(compare._variants(flat, ["friction"], None)[0])
    assert names == {"as stated", "direction"} & names
    assert "as stated" in names


def test_a_variant_that_no_experiment_measures_is_not_compared(rig: Rig) -> None:
    """Before: an error after the first fit, about a [model] that rig.toml does not have."""
    (progression,) = rig.tables
    columns = {("P_d" if name == "P_on" else name): c for name, c in progression.columns.items() if name != "duty"}
    own = {"drive": "harmonic", "P_on": None, "lag": None}
    own |= {} if "P_d" in columns else {"P_d": progression.settings.P_on}
    table = replace(progression, columns=columns, settings=replace(progression.settings, **own))
    harmonic = replace(rig, tables=(table,), model=ModelChoices())
    with pytest.raises(InputError, match="--compare needs a variant that the rig can show, lag"):
        compare._variants(harmonic, ["lag"], None)
    names = compare._variants(harmonic, ["friction", "lag"], None)[0]
    assert len(names) > 1
    assert not any("lag" in model.free for model in names.values())


@pytest.mark.full
def test_too_few_settings_are_named(tmp_path: Path) -> None:
    synthesize_robot(tmp_path / "rig", 1, RobotDesign(PERIODS[:2], np.full(2, 0.3)))
    with pytest.raises(InputError, match="needs 3 settings or more in progression, 2 settings"):
        compare_models(read_rig(tmp_path / "rig"), ["lag"])
    with pytest.raises(InputError, match="needs 3 settings or more"):
        compare_points(read_rig(tmp_path / "rig"), ["lag"])
