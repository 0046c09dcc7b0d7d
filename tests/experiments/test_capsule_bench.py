"""Bench tests through the capsule model: what the closed forms give where those are right, the truth where they are not."""

from dataclasses import replace
from functools import cache
from typing import Literal, cast

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

import capsule_id as cid
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.capsule_experiment import CapsuleDecay, CapsuleForward, CapsulePushes
from capsule_id.experiments.dynamic_friction import DynamicFriction
from capsule_id.experiments.free_vibration.experiment import FreeVibration, check_free_decay
from capsule_id.experiments.friction import unit_law
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.inference.point_stage import SampledFit, fit_points
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior
from capsule_id.physics.forces import slide_distance
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.rig.model import ModelChoices, Quantity, Table
from tests.experiments import bench
from tests.scipy_capsule import simulate_scipy

MU, V_S = 0.66, 0.3
TRUTH = {"m1": bench.M1, "m2": bench.M2, "k1": bench.K1, "c": bench.C, "mu": MU, "v_s": V_S, "g": bench.G}
TIME = np.arange(400) / 1000.0
SPEEDS = np.array([0.1, 0.2, 0.5, 1.0])
NOISE = 2e-5


def decay(release: float, forward: str, **settings: object) -> Table:
    """A free capsule, released from ``release`` m, by SciPy; the same noise every time."""
    q = TRUTH | {"k2": 0.0, "G": 1e3, "P_d": 0.0, "Omega": 1.0} | {k: v for k, v in settings.items() if k == "k2"}
    gap = settings.get("gap")
    q |= {"G": gap.value} if isinstance(gap, Quantity) else {}
    states, _ = simulate_scipy(q, TIME, 1e-10, 1e-13, start=np.array([release, 0.0, 0.0, 0.0]))  # type: ignore[arg-type]
    x = states[:, 0] - states[:, 2] + NOISE * np.random.default_rng(1).standard_normal(len(TIME))
    columns = [bench.column("time", TIME), bench.column("x_rel", x)]
    own = {name: value for name, value in settings.items() if name != "k2"}
    return bench.table("free_vibration", columns, capsule="free", forward=forward, **own)


def pushes(forward: str, speeds: np.ndarray = SPEEDS) -> Table:
    """Pushes of a capsule whose rod rings, by SciPy, read without error."""
    q = TRUTH | {"k2": 0.0, "G": 1e3, "P_d": 0.0, "Omega": 1.0}
    ends = np.array([0.0, 2.0])
    ways = [simulate_scipy(q, ends, 1e-10, 1e-13, start=np.array([0.0, v, 0.0, v]))[0][-1, 2] for v in speeds]
    columns = [bench.column("speed", speeds), bench.column("distance", ways, sd=1e-5)]
    return bench.table("dynamic_friction", columns, forward=forward)


@cache
def fitted(release: float, forward: str) -> SampledFit:
    known = {"mu": Prior("lognormal", MU, 1.02), "v_s": Prior("lognormal", V_S, 1.1)}
    table = decay(release, forward)
    rig = bench.rig(table, priors=known)
    return fit_points(LogPosterior(rig, make_experiments(rig)), default_registry(), 0, sampled=False)


def estimate(stage: SampledFit, name: str) -> tuple[float, float]:
    return stage.fit.values[name], stage.fit.standard_errors[name]


def test_forward_chooses_the_room() -> None:
    for forward, rooms in (("capsule", [CapsuleDecay, CapsulePushes]), ("closed", [FreeVibration, DynamicFriction])):
        rig = bench.rig(decay(2e-3, forward), pushes(forward))
        assert [type(e) for e in make_experiments(rig)] == rooms


def test_terms_that_are_free_act_in_decays_and_pushes_too() -> None:
    """Before: runs sampled them, and a decay or push of the same rod kept 0."""
    gap = {"spring": "soft", "gap": Quantity(1e-3)}
    rig = replace(
        bench.rig(decay(2e-3, "capsule", **gap), pushes("capsule")), model=ModelChoices(free=("k_cubic", "c2"))
    )
    released, pushed = make_experiments(rig)
    assert {"k_cubic", "c2"} <= {row.name for row in released.parameters}
    assert {"k_cubic"} == {"k_cubic", "c2"} & {row.name for row in pushed.parameters}
    assert cast(CapsuleForward, released).parameters_of({**TRUTH, "k_cubic": 1e8, "c2": 3.0}).c2 == 3.0
    assert cast(CapsuleForward, pushed).parameters_of({**TRUTH, "k_cubic": 1e8}).k_cubic == 1e8


@pytest.mark.parametrize("engine", ["exact", "smooth"])
def test_the_model_chooses_the_engine(engine: Literal["exact", "smooth"]) -> None:
    rig = replace(bench.rig(decay(2e-3, "capsule"), pushes("capsule")), model=ModelChoices(engine=engine))
    for e in make_experiments(rig):
        assert cast(CapsuleForward, e).smoothing == (None if engine == "exact" else Smoothing())


@pytest.mark.full
def test_a_small_release_gives_what_the_closed_form_gives() -> None:
    """2 mm is below F_b/k1 = 2.9 mm: the capsule stays where it is."""
    for name in ("k1", "c"):
        (closed, sd), (capsule, own_sd) = (estimate(fitted(2e-3, forward), name) for forward in ("closed", "capsule"))
        assert capsule == pytest.approx(closed, abs=0.02 * sd)
        assert own_sd == pytest.approx(sd, rel=0.02)


@pytest.mark.full
def test_a_large_release_biases_the_closed_form_only() -> None:
    """5 mm: the capsule slips at once and takes energy with it."""
    assert fitted(5e-3, "capsule").fit.agree
    for name, truth in (("k1", bench.K1), ("c", bench.C)):
        value, sd = estimate(fitted(5e-3, "capsule"), name)
        assert abs(value - truth) < 3.5 * sd
    closed, sd = estimate(fitted(5e-3, "closed"), "c")
    assert abs(closed - bench.C) > 5.0 * sd


@pytest.mark.full
@pytest.mark.parametrize(("release", "doubted"), [(6e-3, {"c", "c_q", "k_cubic"}), (2e-3, set())])
def test_a_slip_that_looks_like_a_further_force_is_named(release: float, doubted: set[str]) -> None:
    """The capsule counts as held, and tilts give mu. (Before: c 6 sd off, and a quadratic damping, both trusted.)"""
    table = decay(release, "closed")
    table = replace(table, settings=replace(table.settings, capsule="held"))
    tilts = bench.table(
        "static_friction", [bench.column("angle", np.arctan(MU) + 0.005 * np.array([-1.0, 0.0, 1.0, 0.5]))]
    )
    result = cid.fit(bench.rig(table, tilts), budget=None)
    found = {name for finding in result.findings if finding.code == "decays.slip" for name in finding.parameters}
    assert found == doubted
    assert all(result[name].trust != "trusted" for name in doubted)
    # By the sd without the error of the model, which the failed check adds.
    own_sd = result.summary.at["c", "standard_error"]
    assert (found == set()) == (abs(result["c"].value - bench.C) < 3.0 * own_sd)


@pytest.mark.full
def test_a_record_that_hits_the_spring_is_described() -> None:
    """A release of 2.3 mm, spring at 1 mm: no free decay, and no lint either, for the model has the spring."""
    table = decay(2.3e-3, "capsule", gap=Quantity(1e-3), spring="soft", k2=2420.0)
    e = CapsuleDecay(table, bench.rig(table))
    theta = TRUTH | {"k2": 2420.0, "x_start": 2.3e-3, "y_start": 0.0, "noise_sd": NOISE}
    rest = np.asarray(e.residuals(theta, np))[: e.n]
    assert np.std(rest) == pytest.approx(1.0, rel=0.1)
    # Neither the slip nor the hit is a fault: both are in the model, and in none of the closed form.
    assert e.checks == ()
    assert check_free_decay in FreeVibration.checks
    assert np.std(np.asarray(e.residuals(theta | {"k2": 0.0}, np))[: e.n]) > 3.0


def test_a_decay_is_drawn_with_the_curve_of_the_capsule_model() -> None:
    """Before: the design of the closed form, and no report."""
    e = CapsuleDecay(decay(4e-3, "capsule"), bench.rig())
    (panel,) = e.comparisons(TRUTH | {"x_start": 4e-3, "y_start": 0.0, "noise_sd": NOISE}, [])
    (points,), (curve,) = panel.points, panel.curves
    assert np.std(points.y - curve.y) == pytest.approx(NOISE, rel=0.1)


@pytest.mark.full
def test_a_ringing_rod_shortens_the_slide() -> None:
    """By 11 % at 0.1 m/s and 3 % at 0.2 m/s; a rod that is stiff to its capsule is a locked one."""
    e = CapsulePushes(pushes("capsule"), bench.rig())
    np.testing.assert_allclose(np.asarray(e.predict(TRUTH, e.readings)), e.observed, rtol=1e-7)
    locked = slide_distance(unit_law(MU, V_S), 1.0 / bench.G, SPEEDS)
    assert np.round(100.0 * (e.observed / locked - 1.0)[:2]).tolist() == [-11.0, -3.0]
    stiff = np.asarray(e.predict(TRUTH | {"k1": 1e7, "c": 1e3}, e.readings))
    np.testing.assert_allclose(stiff, locked, rtol=1e-4)


def test_pushes_read_by_the_closed_form_are_biased() -> None:
    """All else known, mu of slow, ringing pushes is high by the closed form, right by the capsule model."""
    mu = {}
    for forward in ("closed", "capsule"):
        e = make_experiments(bench.rig(pushes(forward, SPEEDS[:2])))[0]

        def miss(mu: float, e: Experiment = e) -> float:
            return -float(e.log_likelihood(TRUTH | {"mu": mu, "push_scatter": 1e-3}, np))

        mu[forward] = float(minimize_scalar(miss, bounds=(0.5, 0.9), method="bounded").x)  # type: ignore[attr-defined]
    assert mu["capsule"] == pytest.approx(MU, rel=1e-4)
    assert mu["closed"] > 1.03 * MU


@pytest.mark.full
def test_the_smoothed_model_converges_to_the_exact_one() -> None:
    e = CapsulePushes(pushes("capsule"), bench.rig())
    exact = np.asarray(e.predict(TRUTH, e.readings))
    errors = [
        np.max(np.abs(np.asarray(e.with_smoothing(Smoothing(velocity=v)).predict(TRUTH, e.readings)) / exact - 1.0))
        for v in (4e-3, 1e-3)
    ]
    assert errors[1] < 0.5 * errors[0] < 0.05


def test_scipy_is_the_closed_form_without_slip() -> None:
    """The reference itself: a held rod by plain integration."""
    run = solve_ivp(
        lambda t, y: (y[1], -(bench.K1 * y[0] + bench.C * y[1]) / bench.M1), (0.0, 0.2), (2e-3, 0.0), "DOP853",
        t_eval=TIME[:200], rtol=1e-11, atol=1e-14,
    )  # fmt: skip
    np.testing.assert_allclose(run.y[0], bench.released(TIME[:200], 2e-3), atol=1e-12)
