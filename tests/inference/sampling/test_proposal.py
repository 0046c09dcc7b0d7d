"""Proposal densities against quadrature, and the posterior of two terms that replace each other."""

import emcee
import numpy as np
import pytest
from scipy import stats

from capsule_id.inference import proposal as coordinates
from capsule_id.inference import proposal as refinement
from capsule_id.inference.moves import Ensemble, effective_sample_size, ensemble_time, initial_state
from capsule_id.inference.proposal import (
    BlockProposal,
    Coordinates,
    Mixture,
    Transported,
    _Rounds,
    block_proposal,
    coordinates_of,
    effective_size,
    refined,
    tempered,
)
from capsule_id.inference.sampling import pilot, sample
from tests.inference.stub import Gaussian

#: Normal prior of the logarithms of both terms: centre, width.
CENTRE, WIDTH = 1.0, 3.5
#: The readings give the sum of the terms, and the second term alone less well: value and sd of each.
SUM, SUM_SD, SECOND, SECOND_SD = 1.0, 0.02, 0.75, 0.3


class TwoTerms(Gaussian):
    """Log-density of the logarithms of two positive terms whose sum is known."""

    def __init__(self) -> None:
        super().__init__(np.log([0.25, 0.75]), np.diag([0.5, 0.1]))
        self.normal_priors = np.array([[CENTRE, CENTRE], [WIDTH, WIDTH]])

    def parts(self, v: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            theta = np.exp(v)
        prior = np.sum(stats.norm.logpdf(v, CENTRE, WIDTH), axis=1)
        readings = stats.norm.logpdf(np.sum(theta, axis=1), SUM, SUM_SD) + stats.norm.logpdf(
            theta[:, 1], SECOND, SECOND_SD
        )
        return (prior + readings)[:, None]

    def exact(self) -> np.ndarray:
        """(4,) means and sds of both logarithms by quadrature over the first logarithm and the sum."""
        u = np.linspace(CENTRE - 6.0 * WIDTH, np.log(SUM + 8.0 * SUM_SD), 6001)
        total = np.linspace(SUM - 8.0 * SUM_SD, SUM + 8.0 * SUM_SD, 801)
        second = total - np.exp(u)[:, None]
        inside = second > 1e-12
        other = np.log(np.where(inside, second, 1.0))
        v = np.stack([np.broadcast_to(u[:, None], other.shape), other], axis=-1).reshape(-1, 2)
        # At a fixed first term the second logarithm changes by d(sum)/second.
        weights = np.where(inside, np.exp(self.parts(v)[:, 0].reshape(other.shape) - other), 0.0)
        weights = (weights / np.sum(weights)).ravel()
        mean = weights @ v
        return np.concatenate([mean, np.sqrt(weights @ (v - mean) ** 2)])


def mixture(linear: bool = True) -> Mixture:
    """Components in theta and in u, and one that draws the first parameter from its prior; the second follows it."""
    shear = np.array([[0.0, 0.0], [0.4, 0.0]])
    shape = Coordinates(
        np.array([linear, False]), (0,), np.array([-1.0, 0.0]), np.array([2.0, 1.0]), np.array([0.5, 0.0]), shear
    )
    if linear:
        return Mixture(np.array([0.6, 0.3]), np.array([[0.04, 0.05], [0.05, 0.25]]), coordinates=shape)
    return Mixture(np.array([-0.6, 0.3]), np.array([[0.25, 0.1], [0.1, 0.25]]), coordinates=shape)


@pytest.mark.parametrize("linear", [True, False])
def test_draws_have_the_density(linear: bool) -> None:
    """Weights of a known normal density average to 1. Negative control: without the parts drawn from the prior."""
    proposal, rng = mixture(linear), np.random.RandomState(0)
    u = proposal.draw(rng, 100_000)
    u = np.where(np.isfinite(u), u, -1e3)
    known = stats.norm.logpdf(u[:, 0], -0.7, 0.5) + stats.norm.logpdf(u[:, 1], 0.3, 0.4)
    weights = np.exp(known - proposal.log_density(u))
    error = np.std(weights) / np.sqrt(len(weights))
    assert error < 0.01
    assert abs(np.mean(weights) - 1.0) < 4.0 * error
    terms = proposal.components(u)[: len(coordinates.WEIGHTS)]  # the subset without parameters from priors is the first
    weights = np.exp(known - np.logaddexp.reduce(terms, axis=0))
    assert abs(np.mean(weights) - 1.0) > 8.0 * np.std(weights) / np.sqrt(len(weights))


@pytest.mark.full
def test_two_terms_that_replace_each_other() -> None:
    """Means and sds of the logarithms within 4 Monte Carlo standard errors of quadrature; one term may be absent."""
    target = TwoTerms()
    found = sample(target, 1)
    assert found.converged
    mean, sd = np.split(target.exact(), 2)
    y = (found.draws - mean) / sd
    functions = np.concatenate([y, y**2 - 1.0], axis=-1)
    ess = effective_sample_size(functions, ensemble_time(functions))
    z = np.mean(functions, axis=(0, 1, 2)) / (np.std(functions, axis=(0, 1, 2)) / np.sqrt(ess))
    assert sd[0] > 1.0, "the first term is not seen to be different from zero"
    assert np.max(np.abs(z)) < 4.0


@pytest.mark.full
def test_the_coordinates_make_the_proposal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: with one component in u alone the chain takes more than three times as long."""
    target = TwoTerms()
    good = pilot(target, 2)
    monkeypatch.setattr(coordinates, "BENT", np.inf)
    monkeypatch.setattr(coordinates, "WEAK", np.inf)
    monkeypatch.setattr(refinement, "ROUNDS", refinement.SINGLE)
    poor = pilot(target, 2)
    assert poor.tau > 3.0 * good.tau


def test_coordinates_are_those_closest_to_normal() -> None:
    """Terms on a line go to theta; normal logarithms stay, and so does a parameter without a normal prior."""
    rng = np.random.default_rng(0)
    first = rng.uniform(0.05, 0.95, 4000)
    sample_of = np.log(np.stack([first, 1.0 - first + 0.01 * rng.standard_normal(4000) ** 2], axis=1))
    prior = np.full((2, 2), 1.0)
    assert np.all(coordinates_of(sample_of, prior).linear)
    assert not np.any(coordinates_of(0.5 * rng.standard_normal((4000, 2)), prior).linear)
    assert not np.any(coordinates_of(sample_of, np.full((2, 2), np.nan)).linear)


#: Changes of five logarithms with a term that may be absent, and their sds beside it.
FOLLOW, BESIDE = np.array([-1.0, 0.5, -0.2, 0.1, 2.0]), 0.01


def absent_term(u: np.ndarray) -> np.ndarray:
    """Log-density (n, 1) of the logarithm of a term that may be absent, and of five that change with the term itself."""
    theta = np.exp(np.minimum(u[:, :1], 50.0))
    others = np.sum(stats.norm.logpdf(u[:, 1:], theta * FOLLOW, BESIDE), axis=1, keepdims=True)
    return stats.norm.logpdf(u[:, :1], -4.0, 2.5) + stats.norm.logpdf(theta, 0.0, 0.3) + others


def test_others_follow_the_theta_of_a_term_that_may_be_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: without the slopes on theta the largest waiting time is more than ten times as long."""
    rng = np.random.default_rng(0)
    first = -4.0 + 2.5 * rng.standard_normal((20_000, 1))
    first = first[rng.uniform(size=first.shape) < np.exp(-0.5 * (np.exp(np.minimum(first, 50.0)) / 0.3) ** 2)][:, None]
    others = np.exp(first) * FOLLOW + BESIDE * rng.standard_normal((len(first), 5))
    exact = np.concatenate([first, others], axis=1)
    prior = np.full((2, 6), np.nan)
    prior[:, 0] = -4.0, 2.5
    assert coordinates_of(exact, prior).shear[1:, 0] == pytest.approx(FOLLOW, abs=0.01)

    def longest_wait() -> float:
        start = block_proposal([np.arange(6)], np.append(-4.0, np.zeros(5)), np.diag([4.0, *[0.01] * 5]))
        proposal = refined(absent_term, start, prior, np.random.RandomState(0), [False])
        return float(np.max(absent_term(exact) - proposal.log_density(exact)))

    good = longest_wait()
    monkeypatch.setattr(coordinates, "_shear", lambda values, weak: np.zeros((values.shape[1], weak.shape[1])))
    poor = longest_wait()
    assert poor > good + np.log(10.0), (poor, good)


def test_refinement_finds_a_posterior_from_a_poor_start() -> None:
    """A funnel in five dimensions: the effective size per draw rises to more than a tenth, from less than a hundredth."""

    def funnel(u: np.ndarray) -> np.ndarray:
        scale = np.exp(0.7 * u[:, :1])
        return np.sum(stats.norm.logpdf(u[:, 1:], 0.0, scale), axis=1, keepdims=True) + stats.norm.logpdf(u[:, :1])

    def share(proposal: BlockProposal) -> float:
        u = proposal.draw(np.random.RandomState(1), 20_000)
        return effective_size((funnel(u) - proposal.log_density(u))[:, 0]) / 20_000

    first = block_proposal([np.arange(5)], np.full(5, 0.8), 0.05 * np.eye(5))
    better = refined(funnel, first, np.full((2, 5), np.nan), np.random.RandomState(0), [False])
    assert share(first) < 0.01
    assert share(better) > 0.1


def test_draws_of_all_rounds_are_weighted_by_the_densities_of_all_rounds() -> None:
    """Weights of a normalised density average to 1. Negative control: weighted by the density of the last round alone."""

    def log_density(u: np.ndarray) -> np.ndarray:
        return np.sum(stats.norm.logpdf(u, 1.5, [1.0, 0.55]), axis=1)

    rng, number = np.random.RandomState(0), 20_000
    rounds = _Rounds(Mixture(np.zeros(2), np.eye(2)), np.full((2, 2), np.nan), False)
    for _ in range(3):
        u = rounds.proposals[-1].draw(rng, number)
        rounds.add(u, log_density(u))
        rounds.next(False, rng)
    weights = 3.0 * np.exp(rounds.log_weights)
    assert abs(np.mean(weights) - 1.0) < 4.0 * np.std(weights) / np.sqrt(3 * number)
    first = rounds.proposals[0].draw(rng, number)
    alone = np.exp(log_density(first) - rounds.proposals[2].log_density(first))
    assert abs(np.mean(alone) - 1.0) > 0.1


@pytest.mark.parametrize("kept", [True, False])
def test_a_first_proposal_that_is_good_enough_is_kept_on_request(kept: bool) -> None:
    first = block_proposal([np.arange(2)], np.zeros(2), np.eye(2), [True])
    found = refined(
        lambda u: np.sum(stats.norm.logpdf(u), axis=1, keepdims=True),
        first,
        np.full((2, 2), np.nan),
        np.random.RandomState(0),
        [kept],
    )
    assert (found.densities[0] is first.densities[0]) == kept


#: Correlations of ten parameters.
MIXED = np.eye(10) + 0.3 * np.random.default_rng(0).standard_normal((10, 10))


def bent(u: np.ndarray) -> np.ndarray:
    """Log-density (n, 1), normalised: every second of ten coordinates bends and widens with the one before."""
    z = u @ np.linalg.inv(MIXED)
    location, scale = np.zeros_like(z), np.ones_like(z)
    location[:, 1::2], scale[:, 1::2] = 0.4 * (z[:, ::2] ** 2 - 1.0), np.exp(0.2 * z[:, ::2])
    parts = stats.norm.logpdf(z, location, scale)
    return np.sum(parts, axis=1, keepdims=True) - np.linalg.slogdet(MIXED)[1]


def bent_draws() -> np.ndarray:
    """Exact draws of ``bent``."""
    z = np.random.default_rng(1).standard_normal((20_000, 10))
    z[:, 1::2] = 0.4 * (z[:, ::2] ** 2 - 1.0) + np.exp(0.2 * z[:, ::2]) * z[:, 1::2]
    return z @ MIXED


def test_a_map_describes_a_bent_block() -> None:
    """Five bends at once, from exact draws. Negative control: the same Student densities without the map."""
    exact, share = bent_draws(), {}
    straight = Mixture(np.mean(exact, axis=0), np.cov(exact.T))
    for name, found in {"map": Transported(exact, np.full(len(exact), 1.0 / len(exact))), "straight": straight}.items():
        u = found.draw(np.random.RandomState(1), 50_000)
        weights = np.exp(bent(u)[:, 0] - found.log_density(u))
        assert np.mean(weights) == pytest.approx(1.0, abs=4.0 * np.std(weights) / np.sqrt(len(u)))
        share[name] = np.mean(weights) ** 2 / np.mean(weights**2)
    assert share["map"] > 0.4, share
    assert share["straight"] < 0.5 * share["map"], share


@pytest.mark.full
def test_a_large_block_that_its_first_proposal_misses_gets_a_map(monkeypatch: pytest.MonkeyPatch) -> None:
    first = block_proposal([np.arange(10)], np.zeros(10), 0.4 * MIXED.T @ MIXED, [True])
    exact, waits = bent_draws(), dict[bool, float]()
    for mapped in (True, False):
        if not mapped:  # negative control: one centre in all rounds, as in blocks with too many parameters for a map
            monkeypatch.setattr(refinement, "LARGEST_MAP", 0)
        found = refined(bent, first, np.full((2, 10), np.nan), np.random.RandomState(0), [True])
        u = found.draw(np.random.RandomState(1), 20_000)
        assert effective_size((bent(u) - found.log_density(u))[:, 0]) > 0.1 * len(u)
        # Steps that a chain waits at the draws in the tails, as many as the weight there.
        waits[mapped] = float(np.quantile(bent(exact) - found.log_density(exact), 0.98))
    assert waits[True] < waits[False] + np.log(0.75), waits


def hardly_seen(u: np.ndarray) -> np.ndarray:
    """Log-density (n, 1) of nine coordinates; the last is the logarithm of a term that may be absent."""
    others = np.sum(stats.norm.logpdf(u[:, :8]), axis=1)
    return (others + stats.norm.logpdf(u[:, 8], 0.0, 4.6) + stats.norm.logpdf(np.exp(u[:, 8]), 1.0, 0.35))[:, None]


def test_a_large_block_with_a_term_that_may_be_absent_does_not_keep_its_laplace_approximation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A chain waits in the tail as many steps as the weight there."""
    first = block_proposal([np.arange(9)], np.zeros(9), np.diag([1.0] * 8 + [0.35**2]), [True])
    tail = np.zeros((30, 9))
    tail[:, 8] = np.linspace(-6.0, -1.0, 30)
    waits = dict[bool, float]()
    for adapted in (True, False):
        if not adapted:  # negative control: the share of effective draws that was enough before
            monkeypatch.setattr(refinement, "EXCELLENT", refinement.ENOUGH)
        found = refined(hardly_seen, first, np.full((2, 9), np.nan), np.random.RandomState(0), [True])
        u = found.draw(np.random.RandomState(1), 20_000)
        scale = np.mean(np.exp(hardly_seen(u) - found.log_density(u)))
        waits[adapted] = float(np.max(np.exp(hardly_seen(tail) - found.log_density(tail)))) / scale
    assert waits[True] < 5.0, waits
    assert waits[False] > 10.0 * waits[True], waits


def test_weights_of_a_hopeless_start_are_cut_to_the_best_draws() -> None:
    log_weights = -1e9 * np.random.default_rng(0).uniform(size=1000)
    weights = tempered(log_weights, 40.0)
    assert np.sum(weights > 0.0) == 40
    assert np.min(log_weights[weights > 0.0]) > np.max(log_weights[weights == 0.0])
    assert effective_size(np.log(np.maximum(weights, 1e-300))) == pytest.approx(40.0)
    # Draws without a density never count.
    few = np.where(np.arange(1000) < 10, log_weights, -np.inf)
    assert np.array_equal(np.flatnonzero(tempered(few, 40.0)), np.arange(10))


@pytest.mark.parametrize("edge", [1.2, 2.6])
def test_a_start_with_hardly_a_draw_inside_the_domain_waits_for_more(edge: float) -> None:
    """Three draws of the first round determine no covariance, and a later round may have none inside."""

    def corner(u: np.ndarray) -> np.ndarray:
        inside = np.all(u > edge, axis=1, keepdims=True)
        return np.where(inside, np.sum(stats.norm.logpdf(u, edge + 0.8, 0.3), axis=1, keepdims=True), -np.inf)

    first = block_proposal([np.arange(3)], np.zeros(3), 0.6 * np.eye(3))
    drawn = first.draw(np.random.RandomState(0), refinement.DRAWS)
    assert 0 < np.sum(np.isfinite(corner(drawn))) < (0.02 if edge < 2.0 else 0.002) * refinement.DRAWS
    found = refined(corner, first, np.full((2, 3), np.nan), np.random.RandomState(0), [False])
    u = found.draw(np.random.RandomState(1), 20_000)
    assert effective_size((corner(u) - found.log_density(u))[:, 0]) > 0.3 * len(u)


def test_a_posterior_without_mass_near_the_start_is_said_so() -> None:
    first = block_proposal([np.arange(2)], np.zeros(2), np.eye(2))
    prior, rng = np.full((2, 2), np.nan), np.random.RandomState(0)
    with pytest.raises(RuntimeError, match="no finite log-posterior near the point fit"):
        refined(lambda u: np.full((len(u), 1), -np.inf), first, prior, rng, [False])


def test_a_block_that_one_centre_does_not_fit_gets_a_map_late() -> None:
    """After the rounds with one centre, also where it was good enough in all of them."""
    for good in (True, False):
        rng = np.random.RandomState(0)
        rounds = _Rounds(Mixture(np.zeros(1), np.eye(1)), np.full((2, 1), np.nan), False)
        for own in [good] * refinement.SINGLE + [False]:
            u = rounds.proposals[-1].draw(rng, 1000)
            rounds.add(u, stats.norm.logpdf(u[:, 0]))
            rounds.next(own, rng)
        assert [type(one) for one in rounds.proposals] == [Mixture] * (1 + refinement.SINGLE) + [Transported]


def test_ensembles_do_not_share_moves() -> None:
    """emcee's moves keep numbers of the ensemble that they work for, and ensembles run side by side."""
    used = list[emcee.moves.StretchMove]()  # the objects: an id may be given again

    class Recording(emcee.moves.StretchMove):
        def propose(self, model: object, state: emcee.State) -> object:
            used.append(self)
            return super().propose(model, state)

    moves = [(Recording(), 1.0)]
    known = Gaussian(np.zeros(2), np.eye(2))
    for seed in (0, 1):
        rng = np.random.RandomState(seed)
        Ensemble(known.parts, initial_state(rng.standard_normal((8, 2)), rng), moves).run(2)
    assert len(set(map(id, used))) == 2
    assert moves[0][0] not in used


def test_a_place_beyond_the_squares_of_floats_has_no_density() -> None:
    assert Mixture(np.zeros(2), np.eye(2)).log_density(np.full((1, 2), 1e200)).tolist() == [-np.inf]
