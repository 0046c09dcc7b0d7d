"""Priors against SciPy, their integrals and samples; the joint density is the sum of its parts."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment, ValuesBySymbol
from capsule_id.experiments.dynamic_friction import PUSH_SCATTER
from capsule_id.experiments.free_vibration.declaration import NOISE_SD
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.experiments.misfit import Misfit
from capsule_id.experiments.static_friction import TILT_SD
from capsule_id.experiments.transducer import SENSITIVITY
from capsule_id.inference.marginal import density_of, left_out
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import TABLE, Parameter, Prior, parameter
from capsule_id.synthetic import Truth, synthesize
from tests.capsule_cases import jit_quickly
from tests.inference.stub import Nothing, log_likelihood, log_prior, plain_residuals, rig_without_tables

PRIORS = {
    "lognormal": (Prior("lognormal", 0.3, 10.0), stats.lognorm(s=np.log(10.0) / stats.norm.ppf(0.975), scale=0.3)),
    "halfnormal": (Prior("halfnormal", 0.0, 0.05), stats.halfnorm(scale=0.05)),
    "weighing": (Prior("positive_normal", 0.11, 2e-4), stats.truncnorm(-550.0, np.inf, 0.11, 2e-4)),
    "poor weighing": (Prior("positive_normal", 0.1, 0.08), stats.truncnorm(-1.25, np.inf, 0.1, 0.08)),
    "normal": (Prior("normal", -0.2, 0.5), stats.norm(-0.2, 0.5)),
}
CASES = pytest.mark.parametrize(("prior", "reference"), PRIORS.values(), ids=PRIORS.keys())


def target_of(*priors: Prior) -> LogPosterior:
    """A posterior without data: x1, x2, ... with these priors."""
    return LogPosterior(rig_without_tables(), [Nothing([parameter("F_dry", f"x{i}", p) for i, p in enumerate(priors)])])


@CASES
def test_log_prior_against_scipy(prior: Prior, reference: Any) -> None:
    target, step = target_of(prior), 1e-4
    for theta in reference.ppf([0.001, 0.2, 0.5, 0.9, 0.999]):
        u = target.unconstrain(np.array([theta]))
        # d theta/du numerically, extrapolated (Richardson).
        slopes = [(target.theta(u + h) - target.theta(u - h)) / (2.0 * h) for h in (step, 2.0 * step)]
        slope = (4.0 * slopes[0] - slopes[1]) / 3.0
        expected = reference.logpdf(theta) + np.log(slope[0])
        assert log_prior(target, u) == pytest.approx(expected, rel=1e-10, abs=1e-10)


@CASES
def test_prior_integrates_to_one(prior: Prior, reference: Any) -> None:
    target = target_of(prior)
    ends = target.unconstrain(reference.ppf([[1e-13], [0.5], [1.0 - 1e-13]]))[:, 0]
    if prior.kind in ("halfnormal", "positive_normal"):  # a density of theta at 0: in u its tail falls like exp(u)
        ends[0] = min(ends[0], ends[1] - 35.0)
    mass = sum(
        integrate.quad(lambda u: float(np.exp(log_prior(target, np.array([u])))), a, b, limit=400, epsabs=1e-11)[0]
        for a, b in np.stack([np.linspace(ends[0], ends[2], 9)[:-1], np.linspace(ends[0], ends[2], 9)[1:]], axis=1)
    )
    assert mass == pytest.approx(1.0, abs=1e-8)


@CASES
def test_samples_follow_the_density(prior: Prior, reference: Any) -> None:
    """Kolmogorov–Smirnov at n = 20000; a prior of 1.1 times the width is told apart (negative control)."""
    x = target_of(prior).sample_prior(np.random.default_rng(12), 20000)["F_dry[x0]"]
    assert stats.kstest(x, reference.cdf).pvalue > 0.01
    centre = reference.median() if prior.kind != "halfnormal" else 0.0
    wider = centre * (x / centre) ** 1.1 if prior.kind == "lognormal" else centre + 1.1 * (x - centre)
    assert stats.kstest(wider, reference.cdf).pvalue < 1e-4


def test_a_shared_parameter_has_a_prior_that_covers_those_of_all_experiments() -> None:
    """Against SciPy's quantiles, in either order; a narrower prior would exclude a part (negative control)."""
    sizes = [Prior("lognormal", 0.3, 10.0), Prior("lognormal", 6.0, 10.0), Prior("lognormal", 0.5, 4.0)]
    for priors in (sizes, sizes[::-1]):
        target = LogPosterior(rig_without_tables(), [Nothing([parameter("F_dry", prior=prior)]) for prior in priors])
        found = cast(Prior, target.parameters[0].prior)
        low, high = (stats.lognorm(s=np.log(found.spread) / stats.norm.ppf(0.975), scale=found.location)).interval(0.95)
        assert (low, high) == (pytest.approx(0.03), pytest.approx(60.0))
    springs = [Prior("normal", 0.0, 2.0), Prior("normal", 0.0, 5.0)]
    target = LogPosterior(rig_without_tables(), [Nothing([parameter("k_cubic", prior=prior)]) for prior in springs])
    assert target.parameters[0].prior == springs[1]


def test_stated_priors_that_differ_are_refused_and_one_in_rig_toml_settles_it() -> None:
    own = [Nothing([parameter("P_on", prior=Prior("normal", *stated))]) for stated in ((1.0, 2.0), (3.0, 5.0))]
    with pytest.raises(
        InputError, match=r"share P_on must state one prior for it, normal 1, 2 and normal 3, 5 \(SI\), state"
    ):
        LogPosterior(rig_without_tables(), own)
    settled = Prior("normal", 2.0, 1.0)
    target = LogPosterior(replace(rig_without_tables(), priors={"P_on": settled}), own)
    assert target.parameters[0].prior == settled


def test_a_prior_in_rig_toml_holds_for_every_index_of_its_symbol() -> None:
    """Before: that of ``sensitivity`` was read and never used, and a value far outside it was trusted."""
    stated = Prior("lognormal", 50.0, 1.001)
    rows = [SENSITIVITY.named(of) for of in ("one", "other")]
    target = LogPosterior(replace(rig_without_tables(), priors={"sensitivity": stated}), [Nothing(rows)])
    assert [row.prior for row in target.parameters] == [stated, stated]
    springs = [parameter("k2", of, Prior("lognormal", 100.0, 10.0)) for of in ("one", "other")]
    target = LogPosterior(replace(rig_without_tables(), priors={"k2[one]": stated}), [Nothing(springs)])
    assert [row.prior == stated for row in target.parameters] == [True, False]


def test_joint_prior_is_the_sum() -> None:
    priors = [prior for prior, _ in PRIORS.values()]
    joint, singles = target_of(*priors), [target_of(prior) for prior in priors]
    u = joint.unconstrain(np.array([0.4, 0.03, 0.1101, 0.2, 0.3]))
    expected = sum(log_prior(t, u[i : i + 1]) for i, t in enumerate(singles))
    assert log_prior(joint, u) == pytest.approx(expected, rel=1e-13)
    residuals = joint.prior_residuals(u)
    moved = u + np.array([0.1, 0.0, 0.0, 0.0, 0.2])
    gain = 0.5 * np.sum(residuals**2) - 0.5 * np.sum(joint.prior_residuals(moved) ** 2)
    assert log_prior(joint, moved) - log_prior(joint, u) == pytest.approx(gain, rel=1e-10)


def test_default_priors_are_as_documented() -> None:
    """95 % of a log-normal within median/factor .. median*factor; scatters half-normal."""
    for row in default_registry().parameters.values():
        if row.prior is not None and row.prior.kind == "lognormal":
            x = row.prior.sample(np.random.default_rng(1), 40000)
            inside = np.abs(np.log(x / row.prior.location)) < np.log(row.prior.spread)
            assert np.mean(inside) == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / 40000))
    assert TABLE["v_s"].prior == Prior("lognormal", 0.3, 10.0)
    assert TABLE["mu"].prior == Prior("lognormal", 0.4, 5.0)
    assert TILT_SD.prior == Prior("halfnormal", 0.0, np.deg2rad(1.0))
    assert PUSH_SCATTER.prior == Prior("halfnormal", 0.0, 0.05)
    assert min(TABLE[s].prior.spread for s in ("k1", "c", "k2", "K")) >= 100.0  # type: ignore[union-attr]


def test_a_parameter_without_a_prior_is_refused() -> None:
    with pytest.raises(ValueError, match=r"noise_sd\[x\] has no prior"):
        LogPosterior(rig_without_tables(), [Nothing([NOISE_SD.named("x")])])


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> tuple[LogPosterior, tuple[Experiment, ...]]:
    folder = tmp_path_factory.mktemp("twin") / "rig"
    synthesize(folder, 4)
    rig = read_rig(folder)
    experiments = make_experiments(rig)
    return LogPosterior(rig, experiments), experiments


def at_truth(target: LogPosterior, factor: float = 1.0) -> np.ndarray:
    """u at the truth of the twin, noise at plausible values that differ from record to record."""
    known = Truth() | {"tilt_sd": 0.009, "push_scatter": 0.02}
    known |= {f"noise_sd[free_vibration_{i}]": s for i, s in ((1, 1.5e-5), (2, 2.1e-5), (3, 2.4e-5))}
    known |= {f"scatter[support_spring_{s}]": v for s, v in (("soft", 0.005), ("medium", 0.04), ("stiff", 0.1))}
    return target.unconstrain(np.array([known[name] * factor for name in target.names]))


@pytest.mark.full
@pytest.mark.parametrize("factor", [1.0, 1.03])
def test_log_posterior_is_the_sum_of_its_experiments(
    twin: tuple[LogPosterior, tuple[Experiment, ...]], factor: float
) -> None:
    """Records and springs evaluated together in batches, against each alone in NumPy; nine tables, unequal noise."""
    target, experiments = twin
    u = at_truth(target, factor)
    values = target.mapping(target.theta(u))
    assert len(experiments) == 9
    expected = sum(float(e.log_likelihood(e.local(values), np)) for e in experiments)
    assert log_likelihood(target, u) == pytest.approx(expected, rel=1e-11)


def test_residuals_by_both_routes(twin: tuple[LogPosterior, tuple[Experiment, ...]]) -> None:
    """Batched and plain residuals are the same numbers, in the order of the experiments."""
    # Every second table first: the members of a group no longer stand together.
    target = LogPosterior(twin[0].rig, [*twin[1][::2], *twin[1][1::2]])
    u = at_truth(target)
    batched = jit_quickly(lambda u: target.residuals(u))(u)
    np.testing.assert_allclose(batched, plain_residuals(target, u), rtol=1e-8, atol=1e-9)


def test_left_out_terms_are_the_same_compiled_and_one_by_one(
    twin: tuple[LogPosterior, tuple[Experiment, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of values together, and each experiment alone in NumPy; their own test stands with the likelihoods.

    The tilts take the way of experiments with motions, between the others.
    """
    target = LogPosterior(twin[0].rig, [*twin[1][::2], *twin[1][1::2]])
    (tilts,) = (e for e in target.experiments if e.kind == "static_friction")
    monkeypatch.setattr(type(tilts), "event_driven", True)
    theta = target.theta(np.stack([at_truth(target), at_truth(target, 1.02)]))
    for e, compiled in zip(target.experiments, left_out(target, theta), strict=True):
        alone = [e.left_out(e.local(target.mapping(row))) for row in theta]
        np.testing.assert_allclose(compiled, alone, rtol=1e-9, atol=1e-9)


def assert_same_jacobian(target: LogPosterior, u: np.ndarray) -> None:
    """One tangent per symbol gives the derivatives that forward mode gives with one per parameter of the rig."""
    at, plain = jnp.asarray(u), jit_quickly(lambda u: target.residuals(u))
    expected = np.asarray(jit_quickly(jax.jacfwd(lambda u: target.residuals(u)))(at))[:, target.located]
    residuals, jacobian = jit_quickly(lambda u: target.linearised(u))(at)
    np.testing.assert_allclose(residuals, plain(at), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(jacobian, expected, rtol=1e-11, atol=1e-11 * np.max(np.abs(expected)))
    assert np.all(np.any(expected != 0.0, axis=0))


def test_jacobian_by_both_routes(twin: tuple[LogPosterior, tuple[Experiment, ...]]) -> None:
    assert_same_jacobian(twin[0], at_truth(twin[0], 1.1))


class Products(Nothing):
    """Two residuals that depend on parameters which members of one group may lack."""

    factor: float

    def __init__(self, rows: Sequence[Parameter], factor: float) -> None:
        super().__init__(rows)
        self.factor = factor

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        raw = xp.stack([self.factor * theta["k1"] * theta["c"], theta["c"] * xp.exp(theta.get("lag", 0.0))])
        return (Misfit(raw, 1.0, 0.0, xp.zeros((2, 0))),)


def test_jacobian_where_a_member_of_a_group_lacks_a_parameter() -> None:
    k1, c, lag = parameter("k1"), parameter("c", prior=PRIORS["normal"][0]), PRIORS["normal"][0]
    rows = [[k1, c, parameter("lag", "a", lag)], [k1, c], [k1, c, parameter("lag", "b", lag)]]
    target = LogPosterior(rig_without_tables(), [Products(row, 1.0 + i) for i, row in enumerate(rows)])
    assert [len(group.members) for group in target.groups] == [3]
    assert_same_jacobian(target, np.linspace(0.3, 0.9, target.dimension))


def test_overdamped_decays_have_no_density(twin: tuple[LogPosterior, tuple[Experiment, ...]]) -> None:
    target, _ = twin
    u = at_truth(target)
    u[target.names.index("c")] = np.log(30.0)  # critical damping is 2 sqrt(k1 m1) = 25 N s/m
    assert float(density_of(target)(u[None])[0]) == -np.inf


@pytest.mark.full
def test_rigs_of_one_structure_do_not_share_numbers(tmp_path: Path) -> None:
    """Compiled code is shared between rigs; readings, priors and weighings must not be."""
    values: list[float] = []
    for seed in (1, 2):
        synthesize(tmp_path / f"rig{seed}", seed, Truth().with_values({"k1": 1300.0 + 50.0 * seed}))
        rig = read_rig(tmp_path / f"rig{seed}")
        target = LogPosterior(rig, make_experiments(rig))
        u = at_truth(target)
        local = target.mapping(target.theta(u))
        expected = sum(float(e.log_likelihood(e.local(local), np)) for e in target.experiments)
        found = log_likelihood(target, u)
        assert found == pytest.approx(expected, rel=1e-11)
        values.append(found)
    assert values[0] != pytest.approx(values[1], rel=1e-3)


def test_overrides_replace_priors() -> None:
    override = {"mu": Prior("lognormal", 0.5, 2.0), "tilt_sd": Prior("halfnormal", 0.0, 0.01)}
    target = LogPosterior(rig_without_tables(override), [Nothing([parameter("mu"), TILT_SD])])
    assert [row.prior for row in target.parameters] == [Prior("lognormal", 0.5, 2.0), Prior("halfnormal", 0.0, 0.01)]


def test_prior_sd_is_that_of_u() -> None:
    """What "informed" is measured against, by sampling; a weighing to first order."""
    for name in ("lognormal", "halfnormal", "weighing", "normal"):
        target = target_of(PRIORS[name][0])
        x = target.sample_prior(np.random.default_rng(3), 200000)["F_dry[x0]"]
        assert target.prior_sd[0] == pytest.approx(np.std(target.unconstrain(x[:, None])), rel=0.02)


def test_numpy_and_jax_agree_on_constraints() -> None:
    target = target_of(*(prior for prior, _ in PRIORS.values()))
    u = np.array([-1.0, -3.0, -2.2, -2.0, 0.1])
    np.testing.assert_allclose(target.unconstrain(target.theta(u)), u, rtol=1e-14)
    np.testing.assert_allclose(target.constrain(jnp.asarray(u)), target.theta(u), rtol=1e-14)
    assert list(target.positive) == [True, True, True, True, False]
