"""A forced run: its likelihood against SciPy's densities, its start, its kinds of initial state."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from capsule_id.experiments.forced_run.declaration import SETTLING_PERIODS
from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.forced_run.start_state import rough_start
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior
from capsule_id.physics.simulation import simulate
from capsule_id.rig.model import Instrument, Quantity
from tests.experiments import bench
from tests.forced_runs import NOISE, SAMPLES, channels, make, recorded, table, theta
from tests.inference.stub import log_likelihood


def density(observed: np.ndarray, predicted: np.ndarray, covariance: np.ndarray, gain_sd: float = 0.0) -> float:
    """SciPy's normal log-density: noise ``covariance``, an offset of sd ten times the range, a gain."""
    one, width = np.ones(len(observed)), 10.0 * np.ptp(observed)
    full = covariance + width**2 * np.outer(one, one) + gain_sd**2 * np.outer(predicted, predicted)
    spread = stats.Covariance.from_cholesky(np.linalg.cholesky(full))
    return float(stats.multivariate_normal(predicted, spread).logpdf(observed))


@pytest.mark.full
@pytest.mark.parametrize("number", [0, 1])
def test_channels_are_independent_normal_densities_with_offsets_integrated_out(number: int) -> None:
    run = make(number)
    observed = [recorded()[number].channels[name][:SAMPLES] for name in run.names]
    expected = sum(
        density(y, seen, NOISE[f"noise_{name}"] ** 2 * np.eye(SAMPLES))
        for name, y, seen in zip(run.names, observed, channels(number), strict=True)
    )
    assert float(run.log_likelihood(theta(number), np)) == pytest.approx(expected, rel=1e-9)
    assert float(run.log_likelihood(theta(number), jnp)) == pytest.approx(expected, rel=1e-9)


def test_a_gain_is_integrated_out_where_it_is_asked_for() -> None:
    run = make(0, x_rel_gain_sd=0.02, start="moving", without=("acceleration_rod", "x_capsule"))
    covariance = [NOISE["noise_x_rel"] ** 2 * np.eye(SAMPLES), NOISE["noise_current"] ** 2 * np.eye(SAMPLES)]
    seen = [channels(0)[0], channels(0)[3]]
    observed = [recorded()[0].channels[name][:SAMPLES] for name in ("x_rel", "current")]
    parts = [density(y, s, v, g) for y, s, v, g in zip(observed, seen, covariance, (0.02, 0.0), strict=True)]
    assert float(run.log_likelihood(theta(0), np)) == pytest.approx(sum(parts), rel=1e-9)
    assert float(
        make(0, start="moving", without=("acceleration_rod", "x_capsule")).log_likelihood(theta(0), np)
    ) != pytest.approx(sum(parts), rel=1e-6)


def test_the_gain_of_an_instrument_is_a_parameter_of_the_fit() -> None:
    own = table(0, start="moving", without=("acceleration_rod", "x_capsule"))
    lvdt = Instrument("lvdt", "m", {"gain": Quantity(0.02, 0.01)})
    own = replace(own, columns={**own.columns, "x_rel": replace(own.columns["x_rel"], instrument=lvdt)})
    run, values = ForcedRun(own, bench.rig(own)), {**theta(0), "gain[lvdt]": 0.021}
    assert [row.prior for row in run.parameters if row.name == "gain[lvdt]"] == [Prior("normal", 0.02, 0.01)]
    # The readings are without the stated gain of 0.02.
    seen, noise = [channels(0)[0] * 1.021 / 1.02, channels(0)[3]], (NOISE["noise_x_rel"], NOISE["noise_current"])
    observed = [recorded()[0].channels[name][:SAMPLES] for name in ("x_rel", "current")]
    parts = [density(y, s, sd**2 * np.eye(SAMPLES)) for y, s, sd in zip(observed, seen, noise, strict=True)]
    assert float(run.log_likelihood(values, np)) == pytest.approx(sum(parts), rel=1e-9)
    assert float(run.log_likelihood({**values, "gain[lvdt]": 0.02}, np)) != pytest.approx(sum(parts), rel=1e-6)
    assert run.unstated_errors("k1") == {"clock", "gain"}


def test_coloured_noise_is_a_stationary_first_order_process() -> None:
    run = make(0, noise="ar1", start="moving", without=("acceleration_rod", "x_capsule"))
    rho = {"ar1_x_rel": 0.6, "ar1_current": -0.3}
    lag = np.abs(np.subtract.outer(np.arange(SAMPLES), np.arange(SAMPLES)))
    observed = [recorded()[0].channels[name][:SAMPLES] for name in ("x_rel", "current")]
    parts = [
        density(y, seen, noise**2 / (1.0 - r**2) * r**lag)
        for y, seen, noise, r in zip(
            observed, (channels(0)[0], channels(0)[3]), (1.1e-5, 4.8e-3), rho.values(), strict=True
        )
    ]
    values = theta(0) | {name: np.arctanh(r) for name, r in rho.items()}
    assert float(run.log_likelihood(values, np)) == pytest.approx(sum(parts), rel=1e-9)


def test_a_stated_drive_beside_the_current_is_a_second_reading() -> None:
    stated = make(0, P_d=Quantity(4.1, 0.1))
    more = float(stated.log_likelihood(theta(0), np)) - float(make(0).log_likelihood(theta(0), np))
    assert more == pytest.approx(float(stats.norm.logpdf(4.1, 4.0, 0.1)), abs=1e-6)
    assert stated.n == make(0).n + 1


def test_without_a_current_the_drive_is_the_stated_one() -> None:
    run = make(0, start="moving", without=("current",), P_d=Quantity(4.0, 0.05))
    names = [row.name for row in run.parameters]
    assert "P_d[run_1]" in names
    assert not {"K", "I_d[run_1]"} & set(names)
    assert np.allclose(run.predict(theta(0), np)[0], channels(0)[0], rtol=0, atol=1e-13)


@pytest.mark.full
def test_runs_of_both_kinds_of_start_are_one_group_and_add_up() -> None:
    tables = [table(0), table(1)]
    rig = bench.rig(*tables)
    runs = [ForcedRun(own, rig) for own in tables]
    assert [run.moves for run in runs] == [1.0, 0.0]
    target = LogPosterior(rig, runs)
    assert len(target.groups) == 1
    rng = np.random.default_rng(0)
    centre = {name: start.centre for name, start in target.starts().items()}
    u = target.unconstrain(np.array([centre[name] for name in target.names]))
    u = u + 1e-3 * np.abs(u) * rng.standard_normal(len(u))
    values = target.mapping(target.theta(u))
    expected = sum(float(run.log_likelihood(run.local(values), np)) for run in runs)
    assert log_likelihood(target, u) == pytest.approx(expected, rel=1e-10)


def test_a_settled_run_starts_on_the_motion_that_it_settles_on_from_rest() -> None:
    run = make(1, start="settled")
    values, truth = theta(1), recorded()[1].truth
    assert not {"x_start[run_2]", "y_start[run_2]"} & {row.name for row in run.parameters}
    p, e = run.capsule(values)
    T = 2.0 * np.pi / truth.Omega
    t = simulate(p, e, np.concatenate([[-SETTLING_PERIODS * T], run.time]))
    assert np.allclose(run.predict(values, np)[0], np.asarray(t.X1 - t.X2)[1:], rtol=0, atol=1e-13)
    assert float(run.motion(values, np).X2[0]) == 0.0
    # The recorded run is itself settled: the same motion, up to what is left of the transient.
    assert np.max(np.abs(run.predict(values, np)[0] - channels(1)[0])) < 1e-6


@pytest.mark.parametrize("number", range(4))
def test_the_record_tells_where_the_fit_may_start(number: int) -> None:
    run, truth = recorded()[number], recorded()[number].truth
    rough = rough_start(run.time, run.channels, truth.Omega)
    assert bool(rough.capsule_rate) == bool(truth.Y2)
    assert abs(np.angle(np.exp(1j * (rough.phase - truth.phase)))) < 1e-3
    assert rough.amplitude == pytest.approx(truth.current_amplitude, rel=1e-3)
    assert rough.x_rel - truth.x_rel == pytest.approx(truth.offsets["x_rel"], abs=4e-5)
    assert rough.rate == pytest.approx(truth.Y1 - truth.Y2, abs=0.06)
    assert rough.capsule_rate == pytest.approx(truth.Y2, abs=0.01)
    for name, sd in truth.noise_sd.items():
        assert rough.noise[name] == pytest.approx(sd, rel=0.25)


@pytest.mark.full
def test_draws_are_predicted_in_one_batch() -> None:
    run = make(0)
    values = [theta(0), theta(0) | {"k2": 1.05 * theta(0)["k2"], "phase": theta(0)["phase"] + 0.01}]
    stacked = {name: np.array([v[name] for v in values]) for name in values[0]}
    together = run.predict(stacked, np)
    for i, one in enumerate(values):
        for batch, alone in zip(together, run.predict(one, np), strict=True):
            assert np.allclose(batch[i], alone, rtol=1e-12, atol=1e-12)
