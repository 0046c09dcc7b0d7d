"""Delayed acceptance: the exact density is sampled although the emulator is wrong; emulators of a progression."""

from copy import copy
from pathlib import Path
from types import ModuleType
from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.experiments import make_experiments
from capsule_id.experiments.emulator import Emulator, _cosine
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.experiments.progression.run_emulator import RunEmulator
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling import ensembles, moves
from capsule_id.inference.sampling.emulation import Emulation, ExactMotions, Places
from capsule_id.inference.sampling.ensemble import Ensemble, initial_state
from capsule_id.inference.sampling.ensembles import DELAYED, sample
from capsule_id.inference.sampling.proposal import block_proposal
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.inference.target.marginal import MarginalPosterior
from tests.inference.sampling.test_sampling import LIMIT, scores
from tests.inference.stub import Gaussian
from tests.inference.three_settings import THETA, three_settings

MEAN, SIGMA = np.array([1.0, -2.0, 0.5]), np.array([[1.0, 0.6, 0.0], [0.6, 2.0, 0.0], [0.0, 0.0, 0.5]])
BLOCKS = [np.array([0, 1]), np.array([2])]


class Emulable(Gaussian):
    """A known density whose emulator is half an sd off, and a tenth too narrow."""

    can_be_emulated = True

    def emulated(self, v: np.ndarray, motions: list[np.ndarray]) -> Gaussian:
        assert len(v) == len(motions[0])
        return Gaussian(self.mean + 0.5 * np.sqrt(np.diag(self.sigma)), 0.81 * self.sigma, self.blocks)


def draw() -> Posterior:
    return sample(Emulable(MEAN, SIGMA, BLOCKS), 2, 20_000)


def test_a_wrong_emulator_does_not_change_the_posterior(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ensembles, "DELAYED_STEPS", 3)
    found = draw()
    assert found.converged
    assert next(iter(found.moves)) == DELAYED
    assert np.max(np.abs(scores(found.draws, Gaussian(MEAN, SIGMA)))) < LIMIT

    # Negative control: proposals are accepted without regard to the density that they come from.
    accept = moves.accept
    monkeypatch.setattr(moves, "accept", lambda *args: accept(*args[:4], np.zeros_like(args[4]), args[5]))
    assert np.max(np.abs(scores(draw().draws, Gaussian(MEAN, SIGMA)))) > LIMIT


def test_short_walks_keep_the_exact_posterior() -> None:
    """Alone, with the wrong emulator. Negative control: the emulated posterior itself."""
    wrong, exact = (
        Emulable(MEAN, SIGMA, BLOCKS).emulated(np.empty((0, 3)), [np.empty((0, 1))]),
        Gaussian(MEAN, SIGMA, BLOCKS),
    )
    random = np.random.RandomState(0)
    start = initial_state(random.multivariate_normal(MEAN, SIGMA, 64), random)
    walk = moves.RandomWalk(BLOCKS, 0.5 * SIGMA)
    for density, agrees in ((exact, True), (wrong, False)):
        ensemble = Ensemble(density.parts, start, [(moves.DelayedMove(wrong.parts, walk, 4), 1.0)]).run(3000)
        four = np.stack(np.split(ensemble.chain, 4, axis=1))
        assert (np.max(np.abs(scores(four, exact))) < LIMIT) == agrees
        assert 0.2 < np.mean(ensemble.acceptance) <= 1.0


def hyperbola(v: np.ndarray) -> np.ndarray:
    """(w, 2) a half-normal scale, v[0] its logarithm, and z of two sessions, of which the product with it is known."""
    scale = np.exp(v[:, 0])
    sessions = np.sum(v[:, 1:3] ** 2 + ((scale[:, None] * v[:, 1:3] - [0.12, 0.09]) / 0.01) ** 2, axis=1)
    return np.stack([v[:, 0] - 0.5 * (scale / 0.1) ** 2 - 0.5 * sessions, -0.5 * v[:, 3] ** 2], axis=1)


def test_rescaling_keeps_the_posterior_and_follows_a_hyperbola(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against quadrature over the scale. Negative control: no Jacobian."""
    t = np.linspace(np.log(1e-3), np.log(2.0), 4001)
    scale = np.exp(t)[:, None]
    # z ~ N(0, 1) and scale z ~ N(m, 0.01^2): the density of m is normal.
    sd = np.hypot(0.01, scale)
    log_density = (
        t - 0.5 * (scale[:, 0] / 0.1) ** 2 - np.sum(0.5 * (np.array([[0.12, 0.09]]) / sd) ** 2 + np.log(sd), axis=1)
    )
    weight = np.exp(log_density - np.max(log_density))
    mean = np.sum(t * weight) / np.sum(weight)
    blocks = [np.arange(3), np.array([3])]
    walk = moves.RandomWalk(blocks, np.diag([0.01, 0.01, 0.01, 1.0]))
    random = np.random.RandomState(1)
    start = initial_state(np.array([np.log(0.1), 1.2, 0.9, 0.0]) + 0.01 * random.standard_normal((64, 4)), random)

    def far(rescales: bool) -> float:
        """Distance of the mean of the logarithm from quadrature, in standard errors by four parts of the walkers."""
        rescaling = [(moves.DelayedMove(hyperbola, moves.Rescaling(blocks, [(0, np.array([1, 2]))]), 5), 0.5)]
        both = [(moves.DelayedMove(hyperbola, walk, 5), 0.5), *(rescaling if rescales else [])]
        ensemble = Ensemble(hyperbola, start, both).run(600)
        means = np.mean(ensemble.chain[100:, :, 0], axis=0)
        return float((np.mean(means) - mean) / (np.std(means) / np.sqrt(len(means))))

    assert abs(far(rescales=True)) < LIMIT
    accept = moves.accept
    monkeypatch.setattr(moves, "accept", lambda *args: accept(*args[:4], 0.0 * args[4], args[5]))
    assert abs(far(rescales=True)) > LIMIT


def test_an_emulator_follows_a_function_and_leaves_out_what_is_not_known() -> None:
    rng = np.random.default_rng(0)

    def motions(draws: list[dict[str, float]]) -> np.ndarray:
        k, p = (np.array([draw[name] for draw in draws]) for name in ("k", "p"))
        return np.stack([np.sin(np.log(k) + p), np.log(k) * p], axis=1)

    draws = [{"k": float(np.exp(a)), "p": float(b)} for a, b in rng.standard_normal((600, 2))]
    known = motions(draws)
    known[:50] = np.nan
    emulator = Emulator({"k": True, "p": False}, draws, known)
    new = [{"k": float(np.exp(a)), "p": float(b)} for a, b in 0.7 * rng.standard_normal((40, 2))]
    found = np.array([emulator(one) for one in new])
    errors = np.std(found - motions(new), axis=0) / np.std(motions(new), axis=0)
    assert np.all(errors < 0.04)


@pytest.mark.parametrize("xp", [np, jnp])
def test_the_waves_are_cosines(xp: ModuleType) -> None:
    x = np.linspace(-300.0, 300.0, 10_001)
    np.testing.assert_allclose(_cosine(xp.asarray(x), xp), np.cos(x), rtol=0.0, atol=1e-8)


def test_the_posterior_of_a_progression_is_emulated_near_its_draws(tmp_path: Path) -> None:
    """Motions and log-densities of new draws; parameters of the scatters have no part in the emulator."""
    rig = three_settings(tmp_path / "rig")
    target = LogPosterior(rig, make_experiments(rig))
    u = target.unconstrain(np.array([THETA[name.partition("[")[0]] for name in target.names]))
    none = np.zeros((1, target.dimension))
    sd = np.where(np.isin(target.names, ("m1", "m2")), 1e-3, 0.02)
    flags = np.zeros((2, 1), dtype=bool)
    fit = PointFit(target.names, u, {}, np.diag(sd**2), {}, none, none, np.zeros(1), *flags)
    exact = MarginalPosterior(target, fit)
    assert exact.can_be_emulated
    v = exact.centre + np.random.default_rng(0).standard_normal((760, exact.dimension)) * sd[: exact.dimension]
    (motions,) = exact.motions(v)
    emulated = exact.emulated(v[:600], [motions[:600]])
    (e,) = emulated.target.experiments
    emulator = cast(RunEmulator, cast(Progression, e).emulator)
    # Each session that is a parameter has inputs of its own; all others have their sd.
    for part, own in zip(emulator.parts, ("session_sd", "session_1"), strict=True):
        assert {"k1", "mu", "P_on", "lag", own} <= set(part.symbols)
        assert (
            len({"session_sd", "session_1", "trial_scatter", "trial_sd", "discrepancy", "g"} & set(part.symbols)) == 1
        )
    # The exact density is untouched, and no longer that of the emulator.
    known, found = exact.parts(v[600:]), emulated.parts(v[600:])
    assert not np.array_equal(known, found)
    assert np.std(found - known) < 0.1 * np.std(known)
    # Its sums have fewer nodes, not too few.
    fine, coarse = copy(emulated), copy(emulated)
    fine.grid, coarse.grid = exact.grid, exact.grid.coarser(5)
    assert emulated.grid.nodes < exact.grid.nodes
    assert np.max(np.abs(fine.parts(v[600:]) - found)) < 0.02
    assert np.max(np.abs(coarse.parts(v[600:]) - found)) > 0.02
    assert np.std(exact.emulated(v[:600], [motions[:600][::-1]]).parts(v[600:]) - known) > 0.5 * np.std(known)


def test_a_place_without_emulated_density_stays() -> None:
    """Both densities are -inf there, their ratio is no number; the step warns of nothing and accepts nothing."""

    def nowhere(v: np.ndarray) -> np.ndarray:
        return np.full((len(v), 1), -np.inf)

    exact = Gaussian(MEAN, SIGMA)
    random = np.random.RandomState(0)
    proposal = block_proposal(exact.blocks, MEAN, SIGMA)
    start = initial_state(proposal.draw(random, 8), random)
    ensemble = Ensemble(exact.parts, start, [(moves.DelayedMove(nowhere, moves.BlockMove(proposal), 2), 1.0)]).run(3)
    np.testing.assert_array_equal(ensemble.state.coords, start.coords)


def test_draws_go_on_from_the_start() -> None:
    """As many as wanted, of the emulated density; the first ones are the start."""
    target = Gaussian(MEAN, SIGMA, BLOCKS)
    random = np.random.RandomState(0)
    proposal = block_proposal(target.blocks, MEAN, SIGMA)
    start = Places(random.multivariate_normal(MEAN, SIGMA, 500))
    found = Emulation(target, ExactMotions(start.v, []), proposal, start).draw(1500, random)
    assert found.shape == (1500, 3)
    np.testing.assert_array_equal(found[:500], start.v)
    # Successive chains have random numbers of their own.
    first, second = found[500:1000], found[1000:]
    assert not np.any(np.all(first == second, axis=1))
    assert np.max(np.abs([np.corrcoef(a, b)[0, 1] for a, b in zip(first.T, second.T, strict=True)])) < 0.2
    np.testing.assert_allclose(np.cov(found[500:].T), SIGMA, atol=0.25)
