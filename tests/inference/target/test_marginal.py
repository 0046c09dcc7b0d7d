"""Scatters integrated out: against adaptive quadrature in NumPy, and drawn back from their conditional densities."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from scipy import integrate, optimize, stats

import tests.experiments.bench as bench
from capsule_id.api import read_rig
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.curvature import hessian
from capsule_id.inference.marginal import (
    HEAVY,
    MarginalPosterior,
    _layout,
    conditional,
    density_of,
    terms_of,
    uniform_at,
)
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Parameter, Prior
from capsule_id.rig.model import Rig
from capsule_id.synthetic import Truth, synthesize
from tests.inference.stub import log_posterior

WALKERS, OVERDISPERSION = 6, 2.0
#: Largest error of a log-integral.
LIMIT = 1e-8
ROUGH = {"tilt_sd": 0.009, "push_scatter": 0.02, "sliding_scatter": 0.02}


def log_prior(row: Parameter, u: float) -> float:
    """Log-density of u = log(value), by SciPy."""
    prior = cast(Prior, row.prior)
    location, spread = prior.location, prior.spread
    if prior.kind == "lognormal":
        return float(stats.norm.logpdf(u, np.log(location), np.log(spread) / stats.norm.ppf(0.975)))
    if prior.kind == "halfnormal":
        return float(stats.halfnorm.logpdf(np.exp(u), scale=spread) + u)
    return float(stats.truncnorm.logpdf(np.exp(u), -location / spread, np.inf, location, spread) + u)


def total(marginal: MarginalPosterior, v: np.ndarray) -> np.ndarray:
    """(w,) sum of its parts."""
    return np.sum(marginal.parts(v), axis=1)


def log_integral(density: Callable[[float], float], near: float) -> float:
    """log of the integral of exp(density(u)) over the real line, piece by piece about its maximum."""
    coarse = near + np.linspace(-12.0, 12.0, 97)
    start = coarse[np.argmax([density(u) for u in coarse])]
    found = optimize.minimize_scalar(lambda u: -density(u), bracket=(start - 0.3, start, start + 0.3), tol=1e-6)
    top, at = -found.fun, found.x
    width = 1e-3
    while density(at + width) > top - 0.5:
        width *= 1.5
    ends = at + width * np.array([-2000.0, -200.0, -50.0, -12.0, -4.0, -1.0, 0.0, 1.0, 3.0, 6.0, 12.0, 50.0, 200.0])
    ends = np.concatenate([[at - 45.0], ends[np.abs(ends - at) < 45.0], [at + 45.0]])
    pieces = [
        integrate.quad(lambda u: np.exp(density(u) - top), a, b, epsabs=1e-13, epsrel=1e-11, limit=200)[0]
        for a, b in pairwise(ends)
    ]
    return top + float(np.log(np.sum(pieces)))


def by_quadrature(target: LogPosterior, u: np.ndarray) -> float:
    """The integrated log-posterior at u, its scatters near which to integrate; every likelihood in NumPy."""
    total = sum(log_prior(row, x) for row, x, s in zip(target.parameters, u, target.scatter, strict=True) if not s)
    values = target.mapping(target.theta(u))
    readers: dict[str, list[Experiment]] = {}
    for experiment in target.experiments:
        own = [row.name for row in experiment.parameters if row.scatter]
        if own:
            readers.setdefault(own[0], []).append(experiment)
        else:
            total += float(experiment.log_likelihood(experiment.local(values), np))
    for name, experiments in readers.items():
        row = target.parameters[target.names.index(name)]

        def density(x: float, row: Parameter = row, experiments: list[Experiment] = experiments) -> float:
            moved = values | {row.name: np.exp(x)}
            return log_prior(row, x) + sum(float(e.log_likelihood(e.local(moved), np)) for e in experiments)

        total += log_integral(density, u[target.names.index(name)])
    return total


def approximate(target: LogPosterior, known: dict[str, float]) -> PointFit:
    """The Laplace approximation at ``known``, which need not be a maximum."""
    u = target.unconstrain(np.array([known[name] for name in target.names]))
    scale = np.full(target.dimension, 1e-3)
    for _ in range(3):
        root = np.linalg.cholesky(
            np.linalg.inv(-hessian(terms_of(target), u, scale, np.flatnonzero(target.integrated)))
        )
        scale = np.sqrt(np.sum(root**2, axis=1))
    none = np.zeros((1, target.dimension))
    return PointFit(target.names, u, {}, root @ root.T, {}, none, none, np.zeros(1), *np.zeros((2, 1), dtype=bool))


def twin(folder: Path, seed: int) -> tuple[LogPosterior, dict[str, float]]:
    synthesize(folder, seed)
    rig = read_rig(folder)
    target = LogPosterior(rig, make_experiments(rig))
    known = Truth() | ROUGH
    known |= {f"noise_sd[free_vibration_{i}]": s for i, s in ((1, 2e-5), (2, 3e-5), (3, 1e-5))}
    known |= {f"scatter[support_spring_{s}]": v for s, v in (("soft", 0.005), ("medium", 0.04), ("stiff", 0.1))}
    return target, known


def coarse() -> tuple[LogPosterior, dict[str, float]]:
    """Readings whose stated errors leave hardly any scatter, two tables that share one, and three pushes."""
    rng, mu, v_s = np.random.default_rng(4), 0.66, 0.3
    time = np.arange(400) / 1000.0
    step = 2e-4
    record = step * np.round(bench.released(time, 2e-3) / step)
    current = np.linspace(0.0, 2.0, 7)
    speed = np.linspace(0.2, 1.0, 4)
    coefficient = 0.5 * mu * (1.0 + np.exp(-speed / v_s))
    tables = [
        bench.table(
            "free_vibration", [bench.column("time", time), bench.column("x_rel", record, resolution=step)]
        ),
        bench.table("static_friction", [bench.column("angle", np.arctan(mu) + 0.01 * rng.standard_normal(2))], "a"),
        bench.table("static_friction", [bench.column("angle", np.arctan(mu) + 0.01 * rng.standard_normal(3), 0.02)], "b"),
        bench.table(
            "sliding_friction",
            [
                bench.column("speed", speed, 0.05),
                bench.column("coefficient", coefficient * (1.0 + 0.03 * rng.standard_normal(4))),
            ],
        ),
        bench.table(
            "motor_current",
            [
                bench.column("force", 2.0 * current + 0.05 * rng.standard_normal(7), resolution=0.05),
                bench.column("current", current + 0.02 * rng.standard_normal(7), resolution=0.02),
            ],
            sd_ratio=2.0,
        ),
    ]  # fmt: skip
    rig: Rig = bench.rig(*tables)
    known = {"k1": bench.K1, "c": bench.C, "mu": mu, "v_s": v_s, "K": 2.0} | ROUGH
    known |= {"noise_sd[free_vibration]": 2e-5, "scatter[motor_current]": 0.05}
    return LogPosterior(rig, make_experiments(rig)), known


@pytest.fixture(scope="module", params=["twin", pytest.param("coarse", marks=pytest.mark.full)])
def marginal(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> MarginalPosterior:
    target, known = coarse() if request.param == "coarse" else twin(tmp_path_factory.mktemp("rig") / "rig", 4)
    return MarginalPosterior(target, approximate(target, known))


def walkers(marginal: MarginalPosterior, number: int) -> np.ndarray:
    """Overdispersed draws from the Laplace approximation where there is a posterior."""
    z = np.random.default_rng(1).standard_normal((10 * number, marginal.dimension))
    v = marginal.centre + OVERDISPERSION * z @ np.linalg.cholesky(marginal.covariance).T
    return v[np.isfinite(total(marginal, v))][:number]


@pytest.mark.parametrize("number", [2, pytest.param(WALKERS, marks=pytest.mark.full)])
def test_integrals_against_adaptive_quadrature(marginal: MarginalPosterior, number: int) -> None:
    v = walkers(marginal, number)
    whole, _ = marginal.restore(v, 0)
    expected = [by_quadrature(marginal.target, u) for u in whole]
    np.testing.assert_allclose(total(marginal, v), expected, rtol=0.0, atol=LIMIT)


@pytest.mark.full
def test_too_few_nodes_fail(marginal: MarginalPosterior) -> None:
    """Negative control: a quarter of the nodes over the same window."""
    v, grid = walkers(marginal, 64), marginal.grid
    good = total(marginal, v)
    try:
        marginal.grid = replace(grid, step=4.0 * grid.step, nodes=grid.nodes // 4)
        assert np.max(np.abs(total(marginal, v) - good)) > 100.0 * LIMIT
    finally:
        marginal.grid = grid


@pytest.mark.full
def test_restored_scatters_follow_their_conditional_density(marginal: MarginalPosterior) -> None:
    """4000 draws at one walker against the distribution function summed on a fine grid of the joint posterior."""
    target = marginal.target
    v = walkers(marginal, 1)[0]
    u, lp = marginal.restore(np.tile(v, (4000, 1)), 7)
    np.testing.assert_array_equal(u[:, ~target.scatter], np.tile(v, (4000, 1)))
    np.testing.assert_allclose(lp[:64], log_posterior(target, u[:64]), rtol=0.0, atol=1e-7)
    for j in np.flatnonzero(target.scatter):
        low, high = np.min(u[:, j]) - 1.0, np.max(u[:, j]) + 1.0
        fine = np.linspace(low, high, 4096)
        moved = np.tile(u[0], (4096, 1))
        moved[:, j] = fine
        log_density = density_of(target)(moved)
        cumulated = integrate.cumulative_simpson(np.exp(log_density - np.max(log_density)), x=fine, initial=0.0)
        rank = np.interp(u[:, j], fine, cumulated / cumulated[-1])
        assert stats.kstest(rank, "uniform").pvalue > 1e-3, target.names[j]
        # Negative control: one twentieth of an sd off.
        off = np.interp(u[:, j] + 0.1 * np.std(u[:, j]), fine, cumulated / cumulated[-1])
        assert stats.kstest(off, "uniform").pvalue < 1e-3, target.names[j]


def test_the_density_of_the_fit_is_the_plain_one_and_compiles_nothing(marginal: MarginalPosterior) -> None:
    """In batches as large as the sampler's the program of the integrated posterior serves."""
    target, v = marginal.target, walkers(marginal, marginal.rows)
    u, density = marginal.restore(v, 5)[0], density_of(target)
    programs = conditional._cache_size()
    found = density(u)
    assert conditional._cache_size() == programs
    np.testing.assert_allclose(found, log_posterior(target, u), rtol=0.0, atol=LIMIT)
    # Negative control: scatters in another order.
    u[:, target.scatter] = u[:, target.scatter][:, ::-1]
    assert np.max(np.abs(density(u) - found)) > 100.0 * LIMIT
    u[:, target.names.index("c")] = np.log(30.0)
    assert np.all(density(u) == -np.inf)


def test_blocks_add_up(marginal: MarginalPosterior) -> None:
    """A step in one block changes its part and no other."""
    v = walkers(marginal, 2)
    before, after = marginal.parts(v[:1])[0], v[:1].copy()
    for i, block in enumerate(marginal.blocks):
        after[:, block] = v[1:, block]
        now = marginal.parts(after)[0]
        assert now[i] != before[i]
        np.testing.assert_allclose(np.delete(now, i), np.delete(before, i), rtol=1e-14)
        after[:, block] = v[:1, block]
    assert sorted(np.concatenate(marginal.blocks).tolist()) == list(range(marginal.dimension))


def test_no_density_where_decays_are_overdamped(marginal: MarginalPosterior) -> None:
    v = marginal.centre.copy()
    v[[name for name, s in zip(marginal.names, marginal.target.scatter, strict=True) if not s].index("c")] = np.log(
        30.0
    )
    assert total(marginal, v[None])[0] == -np.inf


@pytest.mark.full
def test_rigs_of_one_structure_share_compiled_code(tmp_path: Path) -> None:
    sizes, values = [], []
    for seed in (1, 2):
        target, known = twin(tmp_path / f"rig{seed}", seed)
        marginal = MarginalPosterior(target, approximate(target, known))
        values.append(total(marginal, marginal.centre[None])[0])
        sizes.append(conditional._cache_size())
    assert sizes[0] == sizes[1]
    assert abs(values[0] - values[1]) > 1.0


def test_nothing_to_integrate_out() -> None:
    """All errors stated: the marginal posterior is the posterior."""
    current = np.linspace(0.0, 2.0, 7)
    columns = [bench.column("force", 2.0 * current, 0.05), bench.column("current", current, 0.02)]
    rig = bench.rig(bench.table("motor_current", columns))
    target = LogPosterior(rig, make_experiments(rig))
    marginal = MarginalPosterior(target, approximate(target, {"K": 2.0}))
    u = np.log(np.array([[1.9], [2.0], [2.1]]))
    np.testing.assert_allclose(total(marginal, u), log_posterior(target, u), rtol=1e-12)
    whole, lp = marginal.whole(u, marginal.factors(u))
    np.testing.assert_array_equal(whole, u)
    np.testing.assert_allclose(lp, total(marginal, u), rtol=1e-13)


def test_factors_are_the_parts_with_a_draw_of_the_scatters(marginal: MarginalPosterior) -> None:
    """Each place has one draw of its scatters, which differs from that of the next place."""
    target, v = marginal.target, walkers(marginal, 64)
    factors = marginal.factors(v)
    np.testing.assert_allclose(factors[..., 0], marginal.parts(v), rtol=0.0, atol=LIMIT)
    u, lp = marginal.whole(v, factors)
    np.testing.assert_array_equal(u[:, ~target.scatter], v)
    np.testing.assert_allclose(lp, log_posterior(target, u), rtol=0.0, atol=1e-7)
    np.testing.assert_array_equal(marginal.factors(v[::-1]), factors[::-1])
    assert len(np.unique(u[:, target.scatter], axis=0)) == len(v)


def test_numbers_of_a_place_are_uniform_and_independent() -> None:
    """Also where places differ in the last digit only; equal places have equal numbers."""
    v = 1.0 + 2.0**-52 * np.arange(4000.0)[:, None]
    found = uniform_at(np.hstack([v, v]), 3)
    for column in found.T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    pairs = np.corrcoef(np.hstack([found[:-1], found[1:]]), rowvar=False)
    assert np.max(np.abs(pairs - np.eye(6))) < 4.0 / np.sqrt(4000.0)
    np.testing.assert_array_equal(uniform_at(np.hstack([v, v])[7:8], 3), found[7:8])


def test_a_heavy_table_without_scatters_has_a_density() -> None:
    current = np.linspace(0.25, 2.0, HEAVY + 1)
    columns = [bench.column("force", 2.0 * current, 0.03), bench.column("current", current, 0.01)]
    rig = bench.rig(bench.table("motor_current", columns))
    target = LogPosterior(rig, make_experiments(rig))
    u = np.log([[2.0], [2.002]])
    np.testing.assert_allclose(density_of(target)(u), log_posterior(target, u), rtol=1e-9)


@pytest.mark.full
def test_rows_of_many_readings_are_evaluated_few_at_a_time() -> None:
    """Before: eight whatever their length, 50 MB in each thread for 100,000 pushes."""
    temporary = []
    for n in (HEAVY, 4 * HEAVY):
        speed = np.linspace(0.1, 1.0, n)
        columns = [bench.column("speed", speed, 0.005), bench.column("distance", 0.1 * speed**2, 3e-4)]
        rig = bench.rig(bench.table("dynamic_friction", columns))
        target = LogPosterior(rig, make_experiments(rig))
        layout = _layout(target)
        v, start = np.zeros((16, len(layout.located))), np.zeros((16, len(layout.scatter)))
        program = conditional.lower(layout, target, v, start, start + 1.0, np.full(len(layout.scatter), -np.inf))
        temporary.append(program.compile().memory_analysis().temp_size_in_bytes)
    assert temporary[1] < 1.5 * temporary[0]
