"""The free-vibration estimator stands at the Cramér–Rao bound; the logarithmic decrement does not."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import bench
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.free_vibration.models import fold
from capsule_id.experiments.statistics import autocorrelation, ljung_box
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.target import LogPosterior
from capsule_id.precision import COMPILE_QUICKLY

TIME = np.arange(1000) / 2000.0  # s: half a second at 2 kHz, as in the twin
RELEASE, NOISE = 2e-3, 2e-5  # m: 1 % noise
TRUTH = np.log([bench.K1, bench.C, NOISE])
#: Newton steps of the replicates; the last one moves no replicate by more than 1e-9 of an sd.
STEPS = 6


def record(values: np.ndarray) -> FreeVibration:
    columns = [bench.column("time", TIME), bench.column("x_rel", values)]
    table = bench.table("free_vibration", columns, "decay")
    return FreeVibration(table, bench.rig(table))


def replicates(count: int, seed: int) -> np.ndarray:
    """(count, n) records of one decay."""
    noise = np.random.default_rng(seed).standard_normal((count, len(TIME)))
    return bench.released(TIME, RELEASE) + NOISE * noise


def cramer_rao() -> np.ndarray:
    """Least relative sd of k1 and c: the full five-parameter information, from complex-step derivatives.

    Unknown are ln k1, ln c and the three coefficients of both solutions and the offset.
    """

    def model(log_k1: complex, log_c: complex) -> np.ndarray:
        k1, c = np.exp(log_k1), np.exp(log_c)
        gamma = c / (2.0 * bench.M1)
        omega = np.sqrt(k1 / bench.M1 - gamma**2)
        a, b = (
            RELEASE,
            RELEASE * bench.C / (2 * bench.M1) / np.sqrt(bench.K1 / bench.M1 - (bench.C / 2 / bench.M1) ** 2),
        )
        return np.exp(-gamma * TIME) * (a * np.cos(omega * TIME) + b * np.sin(omega * TIME))

    tiny = 1e-30j
    columns = [model(TRUTH[0] + tiny, TRUTH[1]).imag / 1e-30, model(TRUTH[0], TRUTH[1] + tiny).imag / 1e-30]
    gamma, omega = bench.C / (2 * bench.M1), np.sqrt(bench.K1 / bench.M1 - (bench.C / (2 * bench.M1)) ** 2)
    columns += [np.exp(-gamma * TIME) * f(omega * TIME) for f in (np.cos, np.sin)]
    j = np.stack([*columns, np.ones(len(TIME))], axis=1) / NOISE
    scale = np.linalg.norm(j, axis=0)
    return (np.sqrt(np.diag(np.linalg.inv((j / scale).T @ (j / scale)))) / scale)[:2]


@partial(jax.jit, compiler_options=COMPILE_QUICKLY)
def _newton(first: FreeVibration, values: Any, folded: Any) -> tuple[Any, Any]:
    """Maxima (count, 3) of the package's log-likelihood of each record in ln k1, ln c, ln noise; standard errors."""

    def one(record: tuple[Any, Any]) -> tuple[Any, Any]:
        own = eqx.tree_at(lambda e: (e.values, e.folded, e.width), first, (*record, 10.0 * jnp.ptp(record[0])))

        def log_likelihood(v: Any) -> Any:
            k1, c, noise = jnp.exp(v)
            return own.log_likelihood({"k1": k1, "c": c, "noise_sd": noise, "m1": bench.M1, "g": bench.G})

        def step(_: int, state: tuple[Any, Any]) -> tuple[Any, Any]:
            v, _ = state
            hessian = jax.hessian(log_likelihood)(v)
            return v - jnp.linalg.solve(hessian, jax.grad(log_likelihood)(v)), hessian

        v, hessian = jax.lax.fori_loop(0, STEPS, step, (jnp.asarray(TRUTH), jnp.eye(3)))
        return v, jnp.sqrt(jnp.diag(jnp.linalg.inv(-hessian)))

    return jax.lax.map(one, (values, folded), batch_size=200)


FIRST = record(replicates(1, 0)[0])


@dataclass(frozen=True)
class Replication:
    """Estimates and standard errors of ln k1, ln c, ln noise, (count, 3) each."""

    estimates: np.ndarray
    errors: np.ndarray

    def ratio(self) -> np.ndarray:
        """sd of the estimates of ln k1 and ln c over the Cramér–Rao bound."""
        return np.std(self.estimates[:, :2], axis=0, ddof=1) / cramer_rao()

    def pulls(self) -> np.ndarray:
        """(count, 2) (estimate - truth)/standard error."""
        return ((self.estimates - TRUTH) / self.errors)[:, :2]


def replicate(count: int, seed: int) -> Replication:
    values = replicates(count, seed)
    folded = np.stack([fold(v) for v in values])
    v, errors = _newton(FIRST, values, folded)
    return Replication(np.asarray(v), np.asarray(errors))


def decrement_sd(count: int, seed: int) -> np.ndarray:
    """sd of ln k1 and ln c by the paper's estimator on the smoothed records, over the Cramér–Rao bound."""
    found = [record(values).paper_decrement() for values in replicates(count, seed)]
    assert all(d is not None for d in found)
    estimates = np.log([(d.k1, d.c) for d in found if d is not None])
    return np.std(estimates, axis=0, ddof=1) / cramer_rao()


@pytest.mark.full
def test_replicates() -> None:
    """A small version of the next test: bounds of 4 standard errors of an sd and of a mean."""
    count = 600
    replication = replicate(count, 1)
    assert np.all(np.abs(replication.ratio() - 1.0) < 4.0 / np.sqrt(2.0 * count))
    assert np.all(np.abs(np.mean(replication.pulls(), axis=0)) < 4.0 / np.sqrt(count))
    assert np.all(np.abs(np.std(replication.pulls(), axis=0) - 1.0) < 4.0 / np.sqrt(2.0 * count))


@pytest.mark.slow
def test_cramer_rao_bound() -> None:
    replication = replicate(5000, 2)
    pulls = replication.pulls()
    print(f"sd / bound {replication.ratio()}, pull mean {pulls.mean(axis=0)}, sd {pulls.std(axis=0)}")
    assert np.all(np.abs(replication.ratio() - 1.0) < 0.05)
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 0.05)
    assert np.all(np.abs(np.std(pulls, axis=0) - 1.0) < 0.05)


@pytest.mark.full
def test_logarithmic_decrement_is_far_off_the_bound() -> None:
    """Negative control: what the bound would have to be widened to for the paper's estimator to pass."""
    ratio = decrement_sd(150, 3)
    print(f"logarithmic decrement: sd / bound {ratio}")
    assert np.all(ratio > 2.0)


def test_point_fit_finds_the_same_maximum() -> None:
    """The replicates stop where the package's own fit of one record stops (its priors move it by 1e-3 of an sd)."""
    values = replicates(1, 4)
    one = record(values[0])
    fit = point_fit(LogPosterior(one.rig, [one]), seed=0)
    replication = replicate(1, 4)
    assert fit.agree
    np.testing.assert_allclose((fit.u - replication.estimates[0]) / replication.errors[0], 0.0, atol=5e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), replication.errors[0], rtol=5e-3)


def test_autocorrelation_and_ljung_box() -> None:
    """Against the definition, and p uniform on white noise: 5 % of replicates below 0.05; coloured noise is seen."""
    rng = np.random.default_rng(6)
    r = rng.standard_normal(300) + 0.3
    d = r - r.mean()
    expected = [np.sum(d[k:] * d[: 300 - k]) / np.sum(d**2) for k in range(1, 6)]
    np.testing.assert_allclose(autocorrelation(r, 5), expected, rtol=1e-12)
    p = np.array([ljung_box(rng.standard_normal(1000))[1] for _ in range(2000)])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / 2000))
    coloured = np.convolve(rng.standard_normal(1002), [1.0, 0.5, 0.0], mode="valid")
    assert ljung_box(coloured)[1] < 1e-10
