"""R-hat, autocorrelation time and effective sample size: against arviz, and against chains with known answers."""

from typing import Any

import arviz
import emcee
import numpy as np
import pytest

from capsule_id.inference.moves import (
    bulk_and_tail_size,
    effective_sample_size,
    ensemble_time,
    geyer_size,
    integrated_time,
    pooled_time,
    split_rhat,
)


def autoregressive(rho: float, shape: tuple[int, int, int, int], seed: int) -> np.ndarray:
    """(ensemble, draw, walker, d) independent chains of x' = rho x + noise, sd 1, from their stationary law."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(shape)
    x = np.empty(shape)
    x[:, 0] = noise[:, 0]
    for i in range(1, shape[1]):
        x[:, i] = rho * x[:, i - 1] + np.sqrt(1.0 - rho**2) * noise[:, i]
    return x


@pytest.mark.parametrize("draws", [200, 201])
def test_split_rhat_of_single_chains_is_arviz(draws: int) -> None:
    """One walker: the classic split R-hat."""
    x = autoregressive(0.6, (4, draws, 1, 3), 1)
    x[0, ..., 1] += 0.5
    expected = [float(arviz.rhat(x[:, :, 0, i], method="split")) for i in range(3)]
    np.testing.assert_allclose(split_rhat(x), expected, rtol=1e-10)


def test_split_rhat_of_pooled_walkers_is_arviz() -> None:
    """The walkers of each half pooled into one chain: arviz on those chains, unsplit."""
    x = autoregressive(0.5, (4, 80, 16, 2), 2)
    halves = np.concatenate([x[:, :40], x[:, 40:]]).reshape(8, -1, 2)
    expected = [float(arviz.rhat(halves[..., i], method="identity")) for i in range(2)]
    np.testing.assert_allclose(split_rhat(x), expected, rtol=1e-10)


def test_rhat_sees_a_shifted_ensemble() -> None:
    """One of four ensembles off by half an sd fails at 1.01; the same chains unshifted pass."""
    x = autoregressive(0.5, (4, 200, 64, 2), 3)
    assert np.all(split_rhat(x) < 1.01)
    shifted = x.copy()
    shifted[2, ..., 0] += 0.5
    assert split_rhat(shifted)[0] > 1.02
    assert split_rhat(shifted)[1] < 1.01


def test_rhat_sees_a_drift() -> None:
    """All ensembles drift together by one sd over the run: only the split sees it."""
    x = autoregressive(0.5, (4, 200, 64, 1), 4) + np.linspace(0.0, 1.5, 200)[None, :, None, None]
    assert split_rhat(x)[0] > 1.02


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_integrated_time_and_ess(rho: float) -> None:
    """(1 + rho)/(1 - rho), and arviz's effective sample size of the walkers as chains (they are independent here)."""
    x = autoregressive(rho, (4, 600, 32, 2), 5)
    tau = ensemble_time(x)
    # Sokal (1997): relative variance 2 (2M + 1)/n, here of 8 x 600 x 32 draws and M = 5 tau.
    known = (1.0 + rho) / (1.0 - rho)
    bound = 4.0 * np.sqrt(2.0 * (10.0 * known + 1.0) / x.size)
    assert np.mean(tau) == pytest.approx(known, rel=bound)
    ess = effective_sample_size(x, tau)
    chains = x.transpose(0, 2, 1, 3).reshape(128, 600, 2)
    expected = [float(arviz.ess(chains[..., i], method="mean")) for i in range(2)]
    np.testing.assert_allclose(ess, expected, rtol=0.1)


def test_diagnostics_of_huge_draws_are_those_of_small_ones() -> None:
    """Draws up to 1e150 of a parameter that no reading bounds. (Before: an overflow.)"""
    x = autoregressive(0.5, (2, 100, 8, 2), 10)
    huge = np.ldexp(x, (520, -520))
    for of in (split_rhat, integrated_time, geyer_size):
        np.testing.assert_array_equal(of(huge), of(x))


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_bulk_and_tail_sizes_are_those_of_arviz(rho: float) -> None:
    """Independent walkers as chains, normal and with heavy tails."""
    x = autoregressive(rho, (4, 800, 32, 2), 8)
    x[..., 1] = np.sign(x[..., 1]) * x[..., 1] ** 4
    chains = x.transpose(0, 2, 1, 3).reshape(128, 800, 2)
    standard_error = np.sqrt(4.0 * (10.0 * (1.0 + rho) / (1.0 - rho) + 1.0) / x.size)  # Sokal (1997), M = 5 tau
    methods: Any = ({"method": "bulk"}, {"method": "tail", "prob": (0.05, 0.95)})
    expected = [[float(arviz.ess(chains[..., i], **method)) for i in range(2)] for method in methods]
    np.testing.assert_allclose(bulk_and_tail_size(x), expected, rtol=3.0 * standard_error)


def test_a_walker_that_hardly_moves_costs_effective_draws() -> None:
    """Each walker keeps to its own place: the pooled draws look right, their effective sizes are small."""
    x = autoregressive(0.5, (4, 150, 32, 1), 9)
    own = np.random.default_rng(10).standard_normal((4, 1, 32, 1))
    kept = np.sqrt(0.5) * (x + own)
    assert np.std(kept) == pytest.approx(1.0, abs=0.1)
    assert np.all(bulk_and_tail_size(x) > 4000.0)
    assert np.all(bulk_and_tail_size(kept) < 1000.0)


def test_the_time_is_known_to_a_fifth_from_twenty_times() -> None:
    """Standard error of ``ensemble_time`` at the length that convergence requires, with the fewest walkers."""
    times = [ensemble_time(autoregressive(0.8, (1, 180, 32, 1), seed))[0, 0] for seed in range(60)]
    assert np.mean(times) == pytest.approx(9.0, rel=0.1)
    assert np.std(times) < 0.2 * 9.0


def test_each_walkers_own_mean_would_understate() -> None:
    """Negative control: about walkers' own means (emcee's estimator) a chain of 50 tau loses a fifth of its tau."""
    x = autoregressive(0.8, (8, 450, 64, 1), 6)
    theirs = np.mean([emcee.autocorr.integrated_time(chain, tol=0, quiet=True) for chain in x])
    assert theirs == pytest.approx(0.8 * 9.0, rel=0.06)
    assert np.mean(ensemble_time(x)) == pytest.approx(9.0, rel=0.06)


def test_ess_predicts_the_error_of_a_mean() -> None:
    """Over 400 repeats the mean of a chain scatters by sd/sqrt(ESS); the raw number of draws promises far too much."""
    means, promised = [], []
    for seed in range(400):
        x = autoregressive(0.8, (2, 300, 8, 1), seed)
        means.append(np.mean(x))
        promised.append(1.0 / np.sqrt(effective_sample_size(x, ensemble_time(x))[0]))
    seen = np.std(means)
    assert seen == pytest.approx(np.mean(promised), rel=4.0 / np.sqrt(2 * 400))
    assert seen > 2.5 / np.sqrt(x.size)


def test_ensembles_that_disagree_have_a_long_pooled_time() -> None:
    """White draws about four means. Negative control: about one mean, and each ensemble alone."""
    draws = np.random.default_rng(0).standard_normal((4, 200, 32, 1))
    apart = draws + 2.0 * np.arange(4)[:, None, None, None]
    assert pooled_time(draws)[0] < 1.5
    assert np.max(ensemble_time(apart)) < 1.5
    assert 20.0 * pooled_time(apart)[0] > draws.shape[1]
