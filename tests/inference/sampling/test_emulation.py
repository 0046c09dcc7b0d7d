"""Delayed acceptance: the exact density is sampled although the emulator is wrong; emulators of a progression."""

from copy import copy
from pathlib import Path
from types import ModuleType
from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.progression.density import Emulator, RunEmulator, _cosine
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference import moves
from capsule_id.inference import sampling as emulation
from capsule_id.inference import sampling as ensembles
from capsule_id.inference.marginal import MarginalPosterior
from capsule_id.inference.moves import Ensemble, initial_state
from capsule_id.inference.proposal import block_proposal
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling import DELAYED, Emulation, ExactMotions, Places, sample
from capsule_id.inference.target import LogPosterior, Scale
from tests.inference.sampling.test_sampling import LIMIT, scores
from tests.inference.stub import Gaussian
from tests.inference.three_settings import THETA, three_settings

MEAN, SIGMA = np.array([1.0, -2.0, 0.5]), np.array([[1.0, 0.6, 0.0], [0.6, 2.0, 0.0], [0.0, 0.0, 0.5]])
BLOCKS = [np.array([0, 1]), np.array([2])]


class Emulable(Gaussian):
    """A known density whose emulator is half an sd off, and a tenth too narrow."""

    can_be_emulated = True
    work = 1

    def emulated(self, v: np.ndarray, motions: list[np.ndarray]) -> Gaussian:
        assert len(v) == len(motions[0])
        return Gaussian(self.mean + 0.5 * np.sqrt(np.diag(self.sigma)), 0.81 * self.sigma, self.blocks)


def draw() -> Posterior:
    return sample(Emulable(MEAN, SIGMA, BLOCKS), 2, 20_000)


@pytest.mark.full
def test_a_wrong_emulator_does_not_change_the_posterior(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ensembles, "DELAYED_STEPS", 3)
    found = draw()
    assert found.converged
    assert next(iter(found.moves)) == DELAYED
    assert np.max(np.abs(scores(found.draws, Gaussian(MEAN, SIGMA)))) < LIMIT

    # Negative control: proposals are accepted without regard to the density that they come from.
    accept = moves.accept
    monkeypatch.setattr(moves, "accept", lambda *args: accept(*args[:5], np.zeros_like(args[5]), args[6]))
    assert np.max(np.abs(scores(draw().draws, Gaussian(MEAN, SIGMA)))) > LIMIT


def in_tail(v: np.ndarray) -> np.ndarray:
    """(w,) whether v (w, 3) lies in a tail that holds a tenth of the density."""
    return v[:, 0] > MEAN[0] + 1.3 * np.sqrt(SIGMA[0, 0])


class Tail(Gaussian):
    """A known density, far too small in a tail that holds a tenth of it."""

    def __init__(self) -> None:
        super().__init__(MEAN, SIGMA, BLOCKS)

    def parts(self, v: np.ndarray) -> np.ndarray:
        parts = super().parts(v)
        parts[:, 0] -= 12.0 * in_tail(v)
        return parts


class Learner(Gaussian):
    """A known density whose emulator misses its tail, until it learns places about walkers that stay there.

    The first ``rounds`` emulators never learn it.
    """

    can_be_emulated = True
    work = 1

    def __init__(self, rounds: int) -> None:
        super().__init__(MEAN, SIGMA, BLOCKS)
        self.rounds, self.made = rounds, 0

    def emulated(self, v: np.ndarray, motions: list[np.ndarray]) -> Gaussian:
        self.made += 1
        # The last places are those about the walkers: those of 32 walkers in 3 states.
        learnt = self.made > self.rounds and np.mean(in_tail(v[-96:])) > 0.1
        return Gaussian(MEAN, SIGMA, BLOCKS) if learnt else Tail()


@pytest.mark.full
def test_an_emulator_learns_where_walkers_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until the autocorrelation times are short. Negative controls: without corrections, or without an effect of them.

    In the first 60 steps of this seed several walkers enter the tail, in those of others one or none.
    """
    monkeypatch.setattr(emulation, "DRAWS", 256)

    def piloted(rounds: int, corrections: int = ensembles.CORRECTIONS) -> tuple[float, int]:
        monkeypatch.setattr(ensembles, "CORRECTIONS", corrections)
        target = Learner(rounds)
        return ensembles.pilot(target, 7).tau, target.made

    longest, rounds = piloted(10**9, corrections=0)
    assert longest > ensembles.GOOD_TAU
    longest, made = piloted(10**9)
    assert longest > ensembles.GOOD_TAU
    assert made == rounds + 3
    longest, made = piloted(rounds)
    assert longest < ensembles.GOOD_TAU
    assert made == rounds + 1


@pytest.mark.full
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


def hyperbola(v: np.ndarray, sd: float = 0.01) -> np.ndarray:
    """(w, 2) a half-normal scale, v[0] its logarithm, z of two sessions, and the logarithm of mu, v[3], N(0, 1).

    The friction of both sessions is known: mu exp(scale z) is exp(0.12) and exp(0.09) within ``sd``.
    """
    scale = np.exp(v[:, :1])
    known = ((v[:, 3:4] + scale * v[:, 1:3] - [0.12, 0.09]) / sd) ** 2
    sessions = 0.5 * np.sum(v[:, 1:3] ** 2 + known, axis=1)
    return np.stack(
        [v[:, 0] - 0.5 * (scale[:, 0] / 0.1) ** 2 - sessions - 0.5 * v[:, 3] ** 2, -0.5 * v[:, 4] ** 2], axis=1
    )


def moments() -> tuple[float, float]:
    """Mean of the logarithm of the scale and variance of that of mu, by quadrature over the scale."""
    t = np.linspace(np.log(1e-4), np.log(1.0), 4001)
    scale = np.exp(t)
    # Given scale and mu, z ~ N(0, 1) and a normal reading of mu + scale z: the reading is N(mu, scale^2 + sd^2).
    sd2, y = scale**2 + 0.01**2, np.array([0.12, 0.09])
    precision = 1.0 + 2.0 / sd2
    mean = np.sum(y) / sd2 / precision
    log_density = t - 0.5 * (scale / 0.1) ** 2 - np.log(sd2) - 0.5 * np.log(precision)
    log_density += 0.5 * precision * mean**2 - 0.5 * np.sum(y**2) / sd2
    weight = np.exp(log_density - np.max(log_density))
    weight /= np.sum(weight)
    return float(t @ weight), float(weight @ (1.0 / precision + mean**2) - (weight @ mean) ** 2)


@pytest.mark.full
def test_rescaling_keeps_the_posterior_and_follows_a_hyperbola(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a wrong emulator, against quadrature. Negative controls: no such steps, and no Jacobian."""
    blocks, scales = [np.arange(4), np.array([4])], [Scale(0, np.array([1, 2]), np.array([3]))]
    walk = moves.RandomWalk(blocks, np.diag([0.01, 0.01, 0.01, 1e-4, 1.0]))
    random = np.random.RandomState(1)
    centre = np.array([np.log(0.05), 0.0, 0.0, 0.105, 0.0])
    start = initial_state(centre + 0.01 * random.standard_normal((64, 5)), random)

    def wrong(v: np.ndarray) -> np.ndarray:
        return hyperbola(v, 0.012)

    def sample(rescales: bool) -> tuple[float, float, float]:
        """Error of the mean of log scale in standard errors; variance of log mu over the exact one, and that of its means."""
        rescaling = [(moves.DelayedMove(wrong, moves.Rescaling(blocks, scales), 5), 0.5)]
        both = [(moves.DelayedMove(wrong, walk, 5), 0.5), *(rescaling if rescales else [])]
        chain = Ensemble(hyperbola, start, both).run(1500).chain[300:]
        means, (mean, variance) = np.mean(chain, axis=0), moments()
        far = (np.mean(means[:, 0]) - mean) / (np.std(means[:, 0]) / np.sqrt(len(means)))
        return float(far), float(np.var(chain[:, :, 3]) / variance), float(np.var(means[:, 3]) / variance)

    far, variance, of_means = sample(rescales=True)
    assert abs(far) < LIMIT
    assert variance == pytest.approx(1.0, abs=0.2)
    # A mean over independent draws has a variance of 1/1200; without these steps each walker stays on its part.
    assert sample(rescales=False)[2] > 3.0 * of_means
    accept = moves.accept
    monkeypatch.setattr(moves, "accept", lambda *args: accept(*args[:5], 0.0 * args[5], args[6]))
    assert abs(sample(rescales=True)[0]) > LIMIT


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


@pytest.mark.full
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
