"""Every likelihood equals a sum of SciPy densities, with the integrated nuisances in the covariance."""

from dataclasses import replace
from typing import Any

import bench
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from capsule_id.experiments import base
from capsule_id.experiments.base import BLOCKS, MOST_TERMS, Experiment, ValuesBySymbol
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.kind import make_experiments
from capsule_id.rig.model import Table
from tests.scipy_decay import scipy_decay

MASSES = {"m1": bench.M1, "m2": bench.M2, "g": bench.G}
RNG = np.random.default_rng(41)
CURRENT = np.linspace(0.2, 2.0, 9)
FORCE = 2.0 * CURRENT + 0.1 + 0.05 * RNG.standard_normal(9)
UNIFORM = np.arange(160) / 1000.0
UNEVEN = np.sort(RNG.uniform(0.0, 0.16, 160))


def make(table: Table) -> Experiment:
    (experiment,) = make_experiments(bench.rig(table))
    return experiment


def coefficient(speed: np.ndarray, mu: float, v_s: float) -> np.ndarray:
    return 0.5 * mu * (1.0 + np.exp(-speed / v_s))


def wide(sd: np.ndarray, columns: np.ndarray, observed: np.ndarray) -> Any:
    """SciPy's normal density of ``observed``: noise ``sd``, nuisances ``columns`` with sd ten times the range."""
    width = 10.0 * np.ptp(observed)
    return stats.multivariate_normal(np.zeros(len(observed)), np.diag(sd**2) + width**2 * columns @ columns.T)


def assert_log_likelihood(experiment: Experiment, theta: dict[str, float], expected: float) -> None:
    """Both routes: NumPy, and JAX with the fast path where there is one."""
    assert float(experiment.log_likelihood(theta, np)) == pytest.approx(expected, rel=1e-10)
    assert float(experiment.log_likelihood(theta, jnp)) == pytest.approx(expected, rel=1e-10)


def test_tilts() -> None:
    angle = np.deg2rad([33.1, 33.9, 32.7, 33.4])
    experiment = make(bench.table("static_friction", [bench.column("angle", angle, 2e-3, 5e-3)]))
    sd = np.sqrt(0.01**2 + 2e-3**2 + 5e-3**2 / 12.0)
    expected = stats.norm.logpdf(angle, np.arctan(0.66), sd).sum()
    assert_log_likelihood(experiment, {"mu": 0.66, "tilt_sd": 0.01, **MASSES}, expected)


@pytest.mark.parametrize("length_is", ["board", "base"])
def test_tilts_by_height_and_length(length_is: str) -> None:
    height, length = np.array([0.331, 0.329, 0.30]), np.array([0.6, 0.6, 0.55])
    columns = [bench.column("height", height, 1e-3), bench.column("length", length, 2e-3)]
    experiment = make(bench.table("static_friction", columns, length_is=length_is))
    # Errors of both readings through the derivatives of the angle: the sd differs from trial to trial.
    if length_is == "board":
        other = np.sqrt(length**2 - height**2)
        angle, by_height, by_length = np.arcsin(height / length), 1.0 / other, height / (length * other)
    else:
        square = length**2 + height**2
        angle, by_height, by_length = np.arctan(height / length), length / square, height / square
    sd = np.sqrt(0.008**2 + (by_height * 1e-3) ** 2 + (by_length * 2e-3) ** 2)
    expected = stats.norm.logpdf(angle, np.arctan(0.6), sd).sum()
    assert_log_likelihood(experiment, {"mu": 0.6, "tilt_sd": 0.008, **MASSES}, expected)


def test_pushes() -> None:
    speed, distance = np.array([0.15, 0.3, 0.5, 1.0]), np.array([1.9e-3, 9e-3, 0.026, 0.12])
    columns = [bench.column("speed", speed, 5e-3), bench.column("distance", distance, 3e-4)]
    experiment = make(bench.table("dynamic_friction", columns))
    mu, v_s, scatter = 0.63, 0.35, 0.02
    slide = [
        integrate.quad(lambda u: u / (bench.G * coefficient(u, mu, v_s)), 0.0, v, epsabs=0.0, epsrel=1e-13)[0]
        for v in speed
    ]
    slope = speed / (bench.G * coefficient(speed, mu, v_s))
    sd = np.sqrt(3e-4**2 + (slope * 5e-3) ** 2 + (scatter * np.array(slide)) ** 2)
    expected = stats.norm.logpdf(distance, slide, sd).sum()
    assert_log_likelihood(experiment, {"mu": mu, "v_s": v_s, "push_scatter": scatter, **MASSES}, expected)


@pytest.mark.parametrize("quantity", ["force", "coefficient"])
def test_steady_sliding(quantity: str) -> None:
    speed = np.array([0.05, 0.2, 0.6])
    weight = (bench.M1 + bench.M2) * bench.G if quantity == "force" else 1.0
    values = weight * np.array([0.6, 0.49, 0.37])
    columns = [bench.column("speed", speed, 0.01), bench.column(quantity, values, 0.004 * weight)]
    experiment = make(bench.table("sliding_friction", columns))
    mu, v_s, scatter = 0.64, 0.28, 0.03
    mean = weight * coefficient(speed, mu, v_s)
    slope = weight * mu / (2.0 * v_s) * np.exp(-speed / v_s)
    sd = np.sqrt((0.004 * weight) ** 2 + (slope * 0.01) ** 2 + (scatter * mean) ** 2)
    expected = stats.norm.logpdf(values, mean, sd).sum()
    assert_log_likelihood(experiment, {"mu": mu, "v_s": v_s, "sliding_scatter": scatter, **MASSES}, expected)


@pytest.mark.parametrize(
    ("force_sd", "current_sd", "ratio", "force_variance", "current_variance"),
    [
        (1.0, 0.5, None, 1.0, 0.5**2),
        (None, None, 3.0, 1.2**2, (1.2 / 3.0) ** 2),
        (None, None, None, 1.2**2, 0.0),
        (0.7, None, None, 0.7**2 + 1.2**2, 0.0),
    ],
    ids=["both sds", "ratio", "none", "one sd"],
)
def test_lines(
    force_sd: float | None,
    current_sd: float | None,
    ratio: float | None,
    force_variance: float,
    current_variance: float,
) -> None:
    """Errors as large as the range: SciPy's covariance of the wide intercept is then still well conditioned.

    The density of a force is multiplied by the length along the line, in units of the errors, that a current covers.
    """
    variance = force_variance + 2.1**2 * current_variance
    columns = [bench.column("force", FORCE, force_sd), bench.column("current", CURRENT, current_sd)]
    experiment = make(bench.table("motor_current", columns, sd_ratio=ratio))
    sd = np.sqrt(variance) * np.ones(9)
    expected = wide(sd, np.ones((9, 1)), FORCE).logpdf(FORCE - np.mean(FORCE) - 2.1 * (CURRENT - np.mean(CURRENT)))
    expected += 9 * np.log(np.sqrt(variance / force_variance))
    assert_log_likelihood(experiment, {"K": 2.1, "scatter": 1.2, **MASSES}, expected)


def test_support_spring() -> None:
    deflection = np.linspace(0.0, 1e-3, 11)
    force = 2420.0 * deflection + 0.01 * np.sin(np.arange(11))
    columns = [bench.column("deflection", deflection), bench.column("force", force, None, 2.0)]
    experiment = make(bench.table("support_spring", columns, spring="soft"))
    sd = np.sqrt(1.5**2 + 2.0**2 / 12.0) * np.ones(11)
    expected = wide(sd, np.ones((11, 1)), force).logpdf(
        force - np.mean(force) - 2400.0 * (deflection - np.mean(deflection))
    )
    assert_log_likelihood(experiment, {"k2": 2400.0, "scatter": 1.5, **MASSES}, expected)


def basis(time: np.ndarray, k1: float, c: float) -> np.ndarray:
    """(n, 3) release at rest, a blow at rest, both of unit size, and the offset, from the complex exponential."""
    root = -c / (2 * bench.M1) + 1j * np.sqrt(k1 / bench.M1 - (c / (2 * bench.M1)) ** 2)
    z = np.exp(root * time)
    return np.stack(
        [z.real - root.real / root.imag * z.imag, abs(root) / root.imag * z.imag, np.ones(len(time))], axis=1
    )


def record(time: np.ndarray, *damping: str, sd: float | None = None, **settings: str) -> FreeVibration:
    noise = 2e-5 * np.random.default_rng(5).standard_normal(len(time))
    columns = [bench.column("time", time), bench.column("x_rel", bench.released(time, 2e-3) + 1e-4 + noise, sd)]
    table = bench.table("free_vibration", columns, damping=damping, **settings)
    return FreeVibration(table, bench.rig(table))


@pytest.mark.parametrize("time", [UNIFORM, UNEVEN], ids=["fast path", "uneven"])
def test_decay_against_scipy(time: np.ndarray) -> None:
    """Noise as large as the record: SciPy's covariance of the wide nuisances is then still well conditioned."""
    experiment = record(time, sd=1e-3)
    assert bool(experiment.folded.size) == (time is UNIFORM)
    sd = np.hypot(2e-3, 1e-3) * np.ones(len(time))
    expected = wide(sd, basis(experiment.time, 1450.0, 3.5), experiment.values).logpdf(experiment.values)
    assert_log_likelihood(experiment, {"k1": 1450.0, "c": 3.5, "noise_sd": 2e-3, **MASSES}, expected)


@pytest.mark.parametrize("time", [UNIFORM, UNEVEN], ids=["fast path", "uneven"])
def test_decay_at_its_true_noise(time: np.ndarray) -> None:
    """1 % noise, where that covariance loses digits: the same density by orthogonal factors of [A; I]."""
    experiment = record(time)
    noise_sd, n = 2e-5, len(time)
    # Readings whose error is not stated have 18 bits of their range.
    sd = np.hypot(noise_sd, np.ptp(experiment.values) * 2.0**-18 / np.sqrt(12.0))
    a = 10.0 * np.ptp(experiment.values) / sd * basis(experiment.time, 1430.0, 3.8)
    y = np.concatenate([experiment.values / sd, np.zeros(3)])
    q, r = np.linalg.qr(np.concatenate([a, np.eye(3)]))
    square = np.sum((y - q @ (q.T @ y)) ** 2)
    log_det = 2.0 * np.sum(np.log(np.abs(np.diag(r))))
    expected = -0.5 * (n * np.log(2.0 * np.pi) + log_det + square) - n * np.log(sd)
    assert_log_likelihood(experiment, {"k1": 1430.0, "c": 3.8, "noise_sd": noise_sd, **MASSES}, expected)


@pytest.mark.full
@pytest.mark.parametrize("damping", [("dry",), ("dry", "quadratic")], ids=str)
def test_decay_by_the_integrator(damping: tuple[str, ...]) -> None:
    experiment = record(UNIFORM, *damping)
    forces = {"k1": 1430.0, "c": 3.8, "m1": bench.M1, "F_dry": 0.02} | ({"c_q": 5.0} if "quadratic" in damping else {})
    theta = {**forces, "noise_sd": 1e-3, "amplitude": 1.9e-3, "turning_time": -0.001}
    x = experiment.side * scipy_decay(UNIFORM, forces, 1.9e-3, -0.001)[0]
    assert experiment.half_cycles >= 6  # the record's length, in half cycles of 28 ms
    expected = wide(1e-3 * np.ones(160), np.ones((160, 1)), experiment.values).logpdf(experiment.values - x)
    assert_log_likelihood(experiment, {**MASSES, **theta}, expected)


def covariance(time: np.ndarray, noise: str, drift: str, theta: dict[str, float]) -> np.ndarray:
    """(n, n) of noise and drift, whose innovations have the geometric mean variance 1: by the kernels' definitions."""
    lag = np.abs(time[:, None] - time[None])
    own = np.zeros_like(lag) if noise == "white" else np.exp(-lag / theta["noise_time"])
    own = own + {"white": 1.0, "ar1": 0.0, "arma": theta["white_ratio"] ** 2}[noise] * np.eye(len(time))
    if drift == "gp":
        scaled = np.sqrt(3.0) * lag / theta["drift_time"]
        own = own + theta["drift_ratio"] ** 2 * (1.0 + scaled) * np.exp(-scaled)
    return own / np.exp(np.linalg.slogdet(own)[1] / len(time))


@pytest.mark.parametrize("time", [UNIFORM, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize(
    ("noise", "drift"), [("white", "linear"), ("ar1", "none"), ("arma", "linear"), ("white", "gp"), ("arma", "gp")]
)
def test_coloured_noise_and_drift(time: np.ndarray, noise: str, drift: str) -> None:
    experiment = record(time, "viscous", noise=noise, drift=drift)
    shape = {"noise_time": 0.004, "white_ratio": 0.7, "drift_ratio": 3.0, "drift_time": 0.1}
    theta = {"k1": 1430.0, "c": 3.8, "noise_sd": 1e-3, **shape, **MASSES}
    assert {row.symbol for row in experiment.parameters} - {"k1", "c", "noise_sd"} == {
        *(["noise_time"] if noise != "white" else []),
        *(["white_ratio"] if noise == "arma" else []),
        *(["drift_ratio", "drift_time"] if drift == "gp" else []),
    }
    own = basis(experiment.time, 1430.0, 3.8)
    if drift == "linear":
        own = np.column_stack([own, experiment.time / experiment.time[-1] - 0.5])
    width = 10.0 * np.ptp(experiment.values)
    whole = 1e-6 * covariance(experiment.time, noise, drift, theta) + width**2 * own @ own.T
    expected = stats.multivariate_normal(np.zeros(len(time)), whole).logpdf(experiment.values)
    assert_log_likelihood(experiment, theta, expected)


def test_ar1_innovations() -> None:
    """Evenly sampled, the Ornstein–Uhlenbeck process is AR(1): innovations e_i - rho e_(i-1), the first one aside."""
    experiment = record(UNIFORM, "viscous", noise="ar1")
    theta = {"k1": 1430.0, "c": 3.8, "noise_sd": 1e-3, "noise_time": 0.004, **MASSES}
    raw, design = experiment.unwhitened(theta, np)
    e = raw - design @ experiment.nuisance_mean(theta)
    found = np.asarray(experiment.residuals(theta, np))[: len(e)]
    expected = e[1:] - np.exp(-1e-3 / 0.004) * e[:-1]
    np.testing.assert_allclose(found[1:] / found[1], expected / expected[0], rtol=1e-8)


def test_a_wrong_width_is_seen() -> None:
    """Negative control: nuisances twice as wide move the density by far more than the bound of these tests."""
    experiment = record(UNIFORM)
    theta = {"k1": 1430.0, "c": 3.8, "noise_sd": 2e-5, **MASSES}
    before = float(experiment.log_likelihood(theta, np))
    wider = eqx.tree_at(lambda e: e.width, experiment, 2.0 * experiment.width)
    assert float(wider.log_likelihood(theta, np)) == pytest.approx(before - 3.0 * np.log(2.0), abs=2e-3)


class TestLeftOut:
    """Densities of readings given all others, and replicates."""

    THETA = {"k1": 1430.0, "c": 3.8, "noise_sd": 5e-5, **MASSES}  # noqa: RUF012

    def test_it_is_the_conditional_of_the_dense_normal_density(self) -> None:
        """log p(block | rest) = log p(y) - log p(rest), with the covariance written out."""
        experiment = record(UNIFORM)
        misfit = experiment.misfit(self.THETA)
        # Without the record's wide nuisances, whose dense covariance is nearly singular.
        narrow = replace(misfit, design=misfit.design / 100.0)
        covariance = np.diag(narrow.sd**2) + narrow.design @ narrow.design.T
        joint = stats.multivariate_normal(cov=covariance).logpdf(narrow.raw)
        found = narrow.left_out(experiment.blocks(experiment.n))
        assert len(found) == BLOCKS
        edges = [*experiment.blocks(experiment.n), experiment.n]
        for k in (0, 1, 30, BLOCKS - 1):
            rest = np.delete(np.arange(experiment.n), np.arange(edges[k], edges[k + 1]))
            given = stats.multivariate_normal(cov=covariance[np.ix_(rest, rest)]).logpdf(narrow.raw[rest])
            assert found[k] == pytest.approx(joint - given, rel=1e-7)
        # Negative control: the density of the block alone is another.
        own = np.arange(edges[0], edges[1])
        alone = stats.multivariate_normal(cov=covariance[np.ix_(own, own)]).logpdf(narrow.raw[own])
        assert abs(alone - found[0]) > 0.1

    def test_a_row_of_a_table_is_a_term(self) -> None:
        experiment = record(UNIFORM)
        rows = experiment.misfit(self.THETA).left_out(np.arange(experiment.n))
        whole = experiment.misfit(self.THETA).left_out(np.array([0]))
        assert whole[0] == pytest.approx(float(experiment.log_likelihood(self.THETA, np)), rel=1e-9)
        assert rows.shape == (experiment.n,)

    def test_a_long_table_has_stretches_of_rows(self, monkeypatch: pytest.MonkeyPatch) -> None:
        experiment = record(UNIFORM)
        monkeypatch.setattr(type(experiment), "time_series", False)
        assert len(experiment.blocks(experiment.n)) == min(experiment.n, MOST_TERMS)
        monkeypatch.setattr(base, "MOST_TERMS", 7)
        assert len(experiment.blocks(experiment.n)) == 7
        assert np.max(np.diff(experiment.blocks(experiment.n))) <= -(-experiment.n // 7)

    def test_replicates_scatter_by_the_noise(self) -> None:
        experiment = record(UNIFORM)
        drawn = np.array([experiment.replicate(self.THETA, np.random.default_rng(seed)) for seed in range(400)])
        misfit = experiment.misfit(self.THETA)
        mean = experiment.observed - misfit.sd * misfit.at_nuisance_mean(np)[0]
        z = (np.mean(drawn, axis=0) - mean) / misfit.sd * np.sqrt(400)
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.2)
        assert np.mean(np.std(drawn, axis=0) / misfit.sd) == pytest.approx(1.0, abs=0.03)


def test_predictive_p_counts_replicates() -> None:
    """The closed tail of chi-square against replicates drawn and compared one by one."""
    experiment = record(UNIFORM)
    rng = np.random.default_rng(9)
    draws: list[ValuesBySymbol] = [{"k1": 1420.0, "c": 3.89, "noise_sd": s, **MASSES} for s in (1.8e-5, 2e-5, 2.2e-5)]
    exceed = []
    for theta in draws:
        misfit = experiment.misfit(theta)
        b = np.linalg.lstsq(misfit.design, misfit.raw, rcond=None)[0]
        observed = np.sum(((misfit.raw - misfit.design @ b) / misfit.sd) ** 2)
        exceed.append(np.mean(np.sum(rng.standard_normal((4000, 160)) ** 2, axis=1) > observed + 3.0))
    found = experiment.predictive_p(draws * 200, rng)
    assert found == pytest.approx(np.mean(exceed), abs=0.03)
    assert experiment.predictive_p([], rng) is None
