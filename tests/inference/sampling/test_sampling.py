"""The sampler on a Gaussian whose moments are known: z-tests in Monte Carlo standard errors, and what fails them."""

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtri

from capsule_id.inference import sampling as ensembles
from capsule_id.inference.marginal import uniform_at
from capsule_id.inference.moves import effective_sample_size, ensemble_time
from capsule_id.inference.proposal import affordable_rounds
from capsule_id.inference.result import Posterior
from capsule_id.inference.sampling import DEFAULT_BUDGET, DEFAULT_ESS, ENSEMBLES, LENGTH_IN_TAU, MAX_RHAT, sample
from tests.inference.stub import Gaussian

#: Largest |z| of the 16 numbers tested at once: false alarm in 1 of 1000.
LIMIT = 4.0
#: Effective size of most samples here.
SIZE = 4000.0
SD = np.array([1e-3, 0.05, 1.0, 20.0])
CORRELATION = np.array([[1.0, 0.95, 0.0, 0.3], [0.95, 1.0, 0.0, 0.3], [0.0, 0.0, 1.0, -0.5], [0.3, 0.3, -0.5, 1.0]])
KNOWN = Gaussian(np.array([5.0, -1.0, 0.0, 100.0]), CORRELATION * np.outer(SD, SD))


def draw(seed: int, budget: int = 20_000, store: Path | None = None, target: Gaussian = KNOWN) -> Posterior:
    """More draws than by default: the z-tests see smaller faults then."""
    return sample(target, seed, budget, store, ess=SIZE)


def scores(draws: np.ndarray, known: Gaussian) -> np.ndarray:
    """z of every mean, variance and correlation: the average of a function of the draws over its own MCSE.

    Each function has a known mean of 0 under ``known``; its effective sample size comes from its own autocorrelation.
    """
    sd = np.sqrt(np.diag(known.sigma))
    y = (draws - known.mean) / sd
    rows, columns = np.triu_indices(known.dimension, 1)
    products = y[..., rows] * y[..., columns] - (known.sigma / np.outer(sd, sd))[rows, columns]
    functions = np.concatenate([y, y**2 - 1.0, products], axis=-1)
    ess = effective_sample_size(functions, ensemble_time(functions))
    flat = functions.reshape(-1, functions.shape[-1])
    return np.mean(flat, axis=0) / (np.std(flat, axis=0) / np.sqrt(ess))


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    return draw(1)


def test_known_gaussian(posterior: Posterior) -> None:
    """Means, sds and correlations within ``LIMIT`` Monte Carlo standard errors."""
    assert posterior.converged
    assert np.max(np.abs(scores(posterior.draws, KNOWN))) < LIMIT
    assert np.all(posterior.rhat <= MAX_RHAT)
    assert np.all(posterior.draws.shape[1] > LENGTH_IN_TAU * posterior.tau)
    assert np.min([posterior.ess_bulk, posterior.ess_tail]) >= SIZE


def test_blocks_are_accepted_one_by_one() -> None:
    """Two independent pairs: right moments, and no longer correlated in time than either pair alone would be.

    Negative control: declared as blocks although they are tied together, the pairs come out independent.
    """
    tied = np.kron(np.eye(2), [[1.0, 0.9], [0.9, 1.0]])
    blocks = [np.array([0, 1]), np.array([2, 3])]
    target = Gaussian(np.arange(4.0), tied, blocks)
    found = draw(6, target=target)
    assert found.converged
    assert np.max(found.tau) < 3.0
    assert np.max(np.abs(scores(found.draws, target))) < LIMIT
    tied = tied + 0.05 * (tied == 0.0)
    found = draw(6, target=Gaussian(np.arange(4.0), tied, blocks))
    assert np.max(np.abs(scores(found.draws, Gaussian(np.arange(4.0), tied)))) > LIMIT


@pytest.mark.parametrize("fault", ["mean", "sd", "correlation"])
def test_a_wrong_gaussian_fails(posterior: Posterior, fault: str) -> None:
    """Negative controls: the same draws against moments that are off by ten standard errors of the mean."""
    error = 10.0 / np.sqrt(np.min(posterior.ess))
    mean, covariance = KNOWN.mean.copy(), KNOWN.sigma.copy()
    if fault == "mean":
        mean[1] += error * SD[1]
    elif fault == "sd":
        covariance[2] *= 1.0 + error
        covariance[:, 2] *= 1.0 + error
    else:
        covariance[2, 3] = covariance[3, 2] = (error - 0.5) * SD[2] * SD[3]
    assert np.max(np.abs(scores(posterior.draws, Gaussian(mean, covariance)))) > LIMIT


@pytest.mark.full
def test_scores_are_standard_normal() -> None:
    """The z-test is calibrated: 4 seeds give 56 scores with sd 1 (ensembles share nothing)."""
    z = np.concatenate([scores(draw(seed).draws, KNOWN) for seed in range(10, 14)])
    assert 0.7 < np.std(z) < 1.35
    assert np.max(np.abs(z)) < LIMIT


def test_seeds() -> None:
    """The same seed gives the same draws whatever NumPy's global state is, another seed others."""
    first = draw(3, budget=400)
    np.random.seed(99)  # noqa: NPY002
    np.testing.assert_array_equal(draw(3, budget=400).draws, first.draws)
    assert not np.array_equal(draw(4, budget=400).draws, first.draws)


def test_a_spent_budget_is_not_convergence() -> None:
    posterior = draw(1, budget=60)
    assert not posterior.converged
    assert posterior.draws.shape[0] == ENSEMBLES


@pytest.mark.full
def test_sampling_stops_at_the_effective_sample_size() -> None:
    """Five times the size needs more draws; both stop within one interval of checks."""
    little, much = (sample(KNOWN, 1, ess=ess) for ess in (DEFAULT_ESS, 5.0 * DEFAULT_ESS))
    sizes = [np.min([one.ess_bulk, one.ess_tail]) for one in (little, much)]
    assert little.converged
    assert much.converged
    assert sizes[0] >= DEFAULT_ESS
    assert 5.0 * DEFAULT_ESS <= sizes[1] < 7.0 * DEFAULT_ESS
    assert much.draws.shape[1] > little.draws.shape[1]


def test_log_density_belongs_to_the_draws(posterior: Posterior) -> None:
    flat = posterior.draws.reshape(-1, 4)
    np.testing.assert_allclose(posterior.lp.ravel(), KNOWN.parts(flat)[:, 0], rtol=1e-9, atol=1e-9)


class WithIsland(Gaussian):
    """Twelve sds from the maximum lie 2.9 % of the mass, which no short chain from the maximum visits."""

    SD, SHARE, PLACE, WIDTH = 0.05, 0.03, 0.6, 0.15

    def __init__(self) -> None:
        super().__init__(np.zeros(2), np.diag([self.SD**2, 0.1**2]))
        self.centre, self.covariance = self.mean, self.sigma

    def parts(self, v: np.ndarray) -> np.ndarray:
        island = np.log(self.SHARE / self.WIDTH) - 0.5 * ((v[:, 0] - self.PLACE) / self.WIDTH) ** 2
        near = -np.log(self.SD) - 0.5 * (v[:, 0] / self.SD) ** 2
        return (np.logaddexp(near, island) - 0.5 * (v[:, 1] / 0.1) ** 2)[:, None]


@pytest.mark.parametrize("seed", [1, 5])
def test_mass_far_from_the_maximum_is_sampled(seed: int) -> None:
    """A proposal without rounds of weighted draws found 0.7 % to 2.2 % of it, converged."""
    found = sample(WithIsland(), seed)
    assert found.converged
    assert np.mean(found.draws[..., 0] > 0.3) == pytest.approx(0.029, abs=0.006)


class WithScatter(Gaussian):
    """A further parameter that the sampler integrates out: normal about the first one, with sd ``OWN``."""

    OWN = 1e-3

    def __init__(self, mean: np.ndarray, sigma: np.ndarray) -> None:
        super().__init__(mean, sigma)
        self.names = (*self.names, "scatter")

    def factors(self, v: np.ndarray) -> np.ndarray:
        z = ndtri(uniform_at(v, 1))
        return np.stack([self.parts(v), self.parts(v) - 0.5 * z**2, v[:, :1] + self.OWN * z], axis=-1)

    def whole(self, located: np.ndarray, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.concatenate([located, factors[..., 0, 2:]], axis=-1), factors[..., 0, 1]


def test_a_walker_that_stays_keeps_its_scatters() -> None:
    """The joint draws have the joint distribution."""
    target = WithScatter(KNOWN.mean, KNOWN.sigma)
    posterior = draw(3, target=target)
    draws = posterior.draws
    z = (draws[..., -1] - draws[..., 0]) / target.OWN
    flat = draws[..., :-1].reshape(-1, target.dimension)
    np.testing.assert_allclose(posterior.lp.ravel(), target.parts(flat)[:, 0] - 0.5 * z.ravel() ** 2, atol=1e-9)
    stayed = np.all(draws[:, 1:, :, :-1] == draws[:, :-1, :, :-1], axis=-1)
    kept = draws[:, 1:, :, -1] == draws[:, :-1, :, -1]
    np.testing.assert_array_equal(stayed, kept)
    assert 0 < np.sum(stayed) < np.size(stayed)
    mean = np.append(KNOWN.mean, KNOWN.mean[0])
    joint = np.block([[KNOWN.sigma, KNOWN.sigma[:, :1]], [KNOWN.sigma[:1], KNOWN.sigma[:1, :1] + target.OWN**2]])
    assert np.max(np.abs(scores(draws, Gaussian(mean, joint)))) < LIMIT
    wrong = joint.copy()
    wrong[-1, -1] += 0.1 * joint[-1, -1]
    assert np.max(np.abs(scores(draws, Gaussian(mean, wrong)))) > LIMIT  # negative control


@pytest.mark.full
def test_interrupted_chains_go_on(tmp_path: Path) -> None:
    """Stopped after half the budget and taken up again: the draws stored before are kept, the whole still passes."""
    half = draw(5, budget=60, store=tmp_path / "chains.h5")
    whole = draw(5, store=tmp_path / "chains.h5")
    stored = half.draws.shape[1]
    np.testing.assert_array_equal(whole.draws[:, :stored], half.draws)
    assert whole.draws.shape[1] > stored
    assert whole.converged
    assert np.max(np.abs(scores(whole.draws, KNOWN))) < LIMIT


def test_progress_is_reported() -> None:
    seen: list[tuple[int, int, str]] = []
    sample(KNOWN, 1, 300, None, lambda *args: seen.append(args))
    assert seen[0] == (0, 1, "burn-in")
    assert all(0 <= done <= goal for done, goal, _ in seen)
    assert [done for done, _, _ in seen] == sorted(done for done, _, _ in seen)


def test_no_private_attribute_of_emcee_is_used() -> None:
    """Names with a leading underscore are read from ``self`` only."""
    found = [
        f"{path.name}:{node.lineno}: {node.attr}"
        for path in (Path(ensembles.__file__).with_name(f"{name}.py") for name in ("sampling", "moves", "proposal"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__")
        if not (isinstance(node.value, ast.Name) and node.value.id == "self")
    ]
    assert found == []


def test_the_pilot_is_bounded_by_the_work_of_an_evaluation() -> None:
    """Rounds of adaptation are added only where that is affordable."""
    assert [affordable_rounds(number) for number in (1.0, 10 * 2048.0, 1e9)] == [6, 10, 16]


def test_a_slow_density_gets_fewer_steps() -> None:
    """An evaluation counts as its readings and 2,500 more; the default steps of few readings end within 3e5 evaluations."""
    drawn = []
    for work in (1, 2500, 30_000):
        target = Gaussian(KNOWN.mean, KNOWN.sigma)
        target.work = work
        drawn.append(sample(target, 1, 200, ess=1e9).draws.shape[1])
    assert DEFAULT_BUDGET * ENSEMBLES * 32 <= 320_000
    assert drawn[1] / drawn[0] == pytest.approx(1e9 / (320_000 * 5000), rel=0.1)
    assert drawn[2] / drawn[0] == pytest.approx(1e9 / (320_000 * 32_500), rel=0.2)
