"""Choice of the model: variants, densities of settings left out, evidence, predictions."""

from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from capsule_id.errors import InputError
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference import prediction as leave_out
from capsule_id.inference.compare import variants_of
from capsule_id.inference.marginal import density_of
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.prediction import (
    LARGEST_SHAPE,
    WeightedDraws,
    _bridge,
    leave_settings_out,
    left_out_predictions,
    log_evidence,
    predictions_text,
    smoothed_weights,
    weighted_draws,
)
from capsule_id.inference.proposal import block_proposal
from capsule_id.inference.sampling import Emulation, ExactMotions, Places
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import ModelChoices, Rig
from tests.experiments import bench
from tests.inference.stub import Gaussian
from tests.inference.three_settings import THETA, three_settings


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return three_settings(tmp_path_factory.mktemp("robot") / "rig")


def test_each_word_varies_its_own_choice(rig: Rig) -> None:
    found = variants_of(rig, ["friction", "reaction", "lag"])
    assert list(found) == [
        "as stated", "constant friction", "eq. (1)", "viscous part", "direction", "reaction on the ground", "no lag",
    ]  # fmt: skip
    assert found["as stated"] == ModelChoices("stribeck", ("ratio", "lag"), "capsule")
    assert found["constant friction"].free == ("lag",)
    assert found["no lag"].free == ("ratio",)
    assert found["reaction on the ground"].reaction == "ground"
    with pytest.raises(InputError, match="--compare takes some of friction,reaction,lag,cubic, lagg"):
        variants_of(rig, ["lagg"])


@pytest.mark.full
def test_a_setting_left_out_has_the_conditional_density(rig: Rig) -> None:
    """p(y_b | y_rest) = p(y) / p(y_rest); the rest is also the experiment without the setting."""
    (e,) = cast(list[Progression], make_experiments(rig))
    draws = [THETA, {**THETA, "mu": 1.02 * THETA["mu"]}]
    found, motions = e.densities_of_settings(draws), e.motions_of_draws([THETA])
    np.testing.assert_allclose(np.sum(found, axis=1), [float(e.log_likelihood(draw)) for draw in draws], rtol=1e-6)
    assert abs(np.diff(np.sum(found, axis=1))[0]) > 0.1
    for setting in range(len(e.settings)):
        smaller = e.without(setting)
        assert smaller.n == e.n - 3
        np.testing.assert_allclose(e.motions_without(motions, setting), smaller.motions_of_draws([THETA]), rtol=1e-9)
        own = float(e.log_likelihood(THETA) - smaller.log_likelihood(THETA))
        np.testing.assert_allclose(found[0, setting], own, rtol=1e-6)


class Readings:
    """Readings y_b ~ N(theta, 1), each a setting of its own; the posterior of theta under a flat prior is normal."""

    parameters = (SimpleNamespace(name="theta"),)
    settings, label = np.zeros((6, 1)), "readings"
    distance = np.array([0.4, -0.9, 0.3, 2.9, 0.2, 0.9]) * 1e-3
    setting, time = np.eye(6), np.ones(6)

    def without(self, setting: int) -> "Readings":
        smaller = Readings()
        smaller.distance = np.delete(self.distance, setting)
        return smaller

    def local(self, values: dict[str, float]) -> dict[str, float]:
        return values

    def densities_of_settings(self, draws: list[dict[str, float]]) -> np.ndarray:
        theta = np.array([draw["theta"] for draw in draws])
        return stats.norm.logpdf(1e3 * self.distance, theta[:, None])

    def new_trials(self, draws: list[dict[str, float]], settings: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        theta = np.array([draw["theta"] for draw in draws])
        return 1e-3 * (theta[:, None] + rng.standard_normal((len(draws), len(settings))))

    def setting_names(self) -> list[str]:
        return list("abcdef")


def readings_and_draws(number: int) -> tuple[Any, WeightedDraws]:
    """Draws of a wide Student proposal, weighted by the posterior of theta."""
    e, rng = Readings(), np.random.default_rng(0)
    theta = 0.3 + 0.8 * rng.standard_t(6.0, number)
    posterior = stats.norm.logpdf(theta, 1e3 * np.mean(e.distance), 6.0**-0.5)
    log_weight = posterior - stats.t.logpdf(theta, 6.0, 0.3, 0.8) + 7.0
    values = [{"theta": one} for one in theta]
    nothing = cast(Any, None)
    size = np.zeros((2, 1))
    return e, WeightedDraws(
        nothing, nothing, nothing, log_weight[:, None], size, {"theta": 0}, np.arange(number), values
    )


def test_readings_left_out_have_their_predictive_density() -> None:
    """In closed form N(mean of the others, 1 + 1/5). Negative control: with the reading itself the density is higher."""
    e, draws = readings_and_draws(20_000)
    y = 1e3 * e.distance
    others = (np.sum(y) - y) / 5.0
    exact = stats.norm.logpdf(y, others, np.sqrt(1.2))
    found = leave_settings_out(e, draws)
    assert [one.density for one in found] == pytest.approx(exact, abs=0.02)
    assert max(one.shape for one in found) < LARGEST_SHAPE
    with_it = stats.norm.logpdf(y, np.mean(y), np.sqrt(7.0 / 6.0))
    assert np.max(np.abs(with_it - exact)) > 0.3

    table = left_out_predictions(e, found, 0)
    reach = 1.96 * np.sqrt(1.2)
    assert table["predicted [mm/s]"].to_numpy() == pytest.approx(others, abs=0.06)
    assert table["upper [mm/s]"].to_numpy() == pytest.approx(others + reach, abs=0.12)
    inside = np.abs(y - others) < reach
    assert table["inside"].tolist() == inside.astype(int).tolist()
    beyond = np.maximum(np.abs(y - others) - reach, 0.0)
    assert table["score [mm/s]"].to_numpy() == pytest.approx(2.0 * reach + 40.0 * beyond, abs=0.25)
    assert predictions_text(table) == (
        "Each setting is predicted by all others: the direction is right in 2 of 3 settings above 0.5 mm/s, and the "
        "95 % band holds 5 of 6 trials."
    )


@pytest.mark.parametrize(("log_weight", "reliable"), [(-8.0, True), (0.0, False)])
def test_draws_without_a_density_have_no_weight(log_weight: float, reliable: bool) -> None:
    """Where they held 1/400 of it before, the shape says that the density of the setting is not known."""
    _, draws = readings_and_draws(2000)
    without = np.arange(2000) < 5
    weights = np.where(without, log_weight, 0.1 * np.random.default_rng(0).standard_normal(2000))
    found = leave_out._left_out(weights, np.where(without, np.nan, -1.0), draws, -1.0)
    assert found.density == pytest.approx(-1.0)
    assert np.all(found.log_weight[:5] == -np.inf)
    assert (found.shape <= LARGEST_SHAPE) == reliable
    nothing = leave_out._left_out(np.zeros(2000), np.full(2000, np.nan), draws, -1.0)
    assert (nothing.density, nothing.shape) == (-np.inf, np.inf)


def test_a_refit_without_a_reading_gives_its_predictive_density(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws of the posterior without the reading need no division by its density.

    The first proposal is too narrow; the next adaptation begins with what the first one found.
    """
    e, draws = readings_and_draws(4000)
    draws = replace(draws, target=cast(Any, SimpleNamespace(rig=None, experiments=[e])))
    y = 1e3 * e.distance
    asked, firsts = list[list[Any]](), list[Any]()

    def posterior(_: object, experiments: list[Any]) -> list[Any]:
        asked.append(experiments)
        return experiments

    def drawn(experiments: list[Any], _: object, __: object, first: Any, ___: object) -> WeightedDraws:
        firsts.append(first)
        width = 0.1 if len(firsts) == 1 else 0.6
        theta = 0.2 + width * np.random.default_rng(1).standard_t(6.0, 20_000)
        left = 1e3 * experiments[0].distance
        weight = stats.norm.logpdf(theta, np.mean(left), len(left) ** -0.5) - stats.t.logpdf(theta, 6.0, 0.2, width)
        values = [{"theta": one} for one in theta]
        found = cast(Any, "adapted")
        return replace(draws, log_weight=weight[:, None], inside=np.arange(20_000), values=values, drawn_from=found)

    monkeypatch.setattr(leave_out, "LogPosterior", posterior)
    monkeypatch.setattr(leave_out, "weighted_draws", drawn)
    found = leave_out.leave_setting_out(draws, e, 3, 0)
    assert firsts == [None, "adapted"]
    assert len(asked) == 1
    assert len(asked[0][0].distance) == 5
    assert found.density == pytest.approx(stats.norm.logpdf(y[3], (np.sum(y) - y[3]) / 5.0, np.sqrt(1.2)), abs=0.02)


def test_a_draw_without_a_density_does_not_spoil_the_predictions() -> None:
    e, draws = readings_and_draws(2000)
    table = left_out_predictions(e, leave_settings_out(e, draws), 0)
    draws.values[5] = {"theta": np.nan}
    again = left_out_predictions(e, leave_settings_out(e, draws), 0)
    for name in ("predicted [mm/s]", "lower [mm/s]", "upper [mm/s]"):
        assert again[name].to_numpy() == pytest.approx(table[name].to_numpy(), abs=0.1)


@pytest.mark.parametrize("outside", [0, 500])
def test_the_evidence_is_that_of_the_closed_form(outside: int) -> None:
    """A normal posterior times e^7. Negative control: draws of the proposal in place of those of the posterior."""
    weights = readings_and_draws(4000)[1].log_weight[:, 0]
    rng = np.random.default_rng(1)
    value, error = log_evidence(rng.permutation(np.append(weights, np.full(outside, -np.inf))), rng)
    exact = 7.0 + np.log(4000 / (4000 + outside))
    assert error < 0.05
    assert abs(value - exact) < 4.0 * max(error, 0.01)
    assert abs(_bridge(weights[:2000], weights[2000:]) - 7.0) > 0.1


@pytest.mark.full
def test_the_evidence_of_a_bench_test_is_that_of_quadrature() -> None:
    """Draws of the adapted proposal of two springs, each a block of its own; by sums over stiffness and scatter."""
    force = np.array([1.0, 2.1, 2.9, 4.2, 4.8, 6.1])
    columns = bench.column("deflection", 1e-4 * np.arange(1.0, 7.0)), bench.column("force", force)
    other = columns[0], bench.column("force", 3.0 * force + np.array([0.1, -0.1, 0.0, 0.2, -0.2, 0.1]))
    tables = [
        bench.table("support_spring", own, label, spring=label) for own, label in ((columns, "soft"), (other, "stiff"))
    ]
    rig = bench.rig(*tables)
    target = LogPosterior(rig, make_experiments(rig))
    fit, density = point_fit(target, 0), density_of(target)
    draws = weighted_draws(target, fit, 0)
    assert draws.log_weight.shape == (leave_out.PROPOSED_DRAWS, 2)
    assert draws.block == {"k2[soft]": 0, "k2[stiff]": 1}
    rng, total = np.random.default_rng(0), 0.0
    for block in target.blocks:
        grid = np.meshgrid(*(fit.u[i] + np.linspace(-12.0, 12.0, 401) * fit.covariance[i, i] ** 0.5 for i in block))
        u = np.repeat(fit.u[None], grid[0].size, axis=0)
        u[:, block] = np.stack([each.ravel() for each in grid], axis=1)
        cell = np.prod([24.0 / 400.0 * fit.covariance[i, i] ** 0.5 for i in block])
        total += np.logaddexp.reduce(density(u)) + np.log(cell)
    exact = total - density(fit.u[None])[0]
    found, errors = np.array([log_evidence(own, rng) for own in draws.log_weight.T]).T
    assert np.sum(found) == pytest.approx(exact, abs=4.0 * np.linalg.norm(errors) + 0.01)


def test_the_evidence_of_an_emulated_posterior_is_that_of_the_closed_form() -> None:
    """The integral of each block; the density at the mean stands for its unknown constant."""
    mean, sigma, blocks = np.array([1.0, -2.0, 0.5]), np.diag([1.0, 2.0, 0.5]), [np.array([0, 1]), np.array([2])]
    target = Gaussian(mean, sigma, blocks)
    wide = block_proposal(blocks, mean + 0.3, 1.5 * sigma)
    emulated = Emulation(cast(Any, target), ExactMotions(mean[None], []), wide, Places(mean[None]))
    value, error = leave_out._log_normalisation(emulated, np.random.RandomState(0))
    sizes = np.array([0.5 * np.linalg.slogdet(2.0 * np.pi * sigma[np.ix_(b, b)])[1] for b in blocks])
    assert np.all(error < 0.05)
    assert np.all(np.abs(value - target.parts(mean[None])[0] - sizes) < 4.0 * np.maximum(error, 0.01))


def test_motions_that_are_known_serve_a_setting_left_out(rig: Rig) -> None:
    """The refit begins with the motions of all other settings and the proposal of all."""
    target = LogPosterior(rig, make_experiments(rig))
    (e,) = target.experiments
    motions = np.arange(10.0).reshape(2, 5)  # setting 1 has a session of its own, and three runs
    nothing = cast(Any, None)
    emulated = Emulation(nothing, ExactMotions(np.zeros((2, 3)), [motions]), cast(Any, "proposal"), nothing)
    draws = replace(readings_and_draws(3)[1], target=target, drawn_from=emulated)
    first, known = leave_out._without(draws, cast(Progression, e), 1)
    assert first == "proposal"
    np.testing.assert_array_equal(cast(ExactMotions, known).motions[0], motions[:, [0, 4]])


def test_no_evidence_where_few_draws_are_inside() -> None:
    value, error = log_evidence(np.append(np.zeros(10), np.full(90, -np.inf)), np.random.default_rng(0))
    assert np.isnan(value)
    assert np.isnan(error)


def test_weights_are_smoothed_as_by_arviz() -> None:
    old = getattr(import_module("arviz"), "psislw", None)  # ArviZ 0.2x takes weights, 1 takes their inverses
    new = None if old else import_module("arviz_stats.base").array_stats.psislw
    rng = np.random.default_rng(4)
    for heavy in (0.2, 0.5, 0.9, 3.0):
        log_weight = heavy * rng.exponential(size=1500)
        found, shape = smoothed_weights(log_weight)
        expected, known = map(np.asarray, old(log_weight) if old else new(-log_weight))
        near = 1e-9 if old else 0.1  # ArviZ 1 takes another size of the tail
        np.testing.assert_allclose(found, expected, atol=near)
        assert shape == pytest.approx(float(known), abs=near)
        assert (shape < LARGEST_SHAPE) == (heavy < 0.6)
    assert smoothed_weights(np.zeros(100))[1] == np.inf  # no tail
