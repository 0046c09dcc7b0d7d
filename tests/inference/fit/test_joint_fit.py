"""Bench and runs fitted together, small: against the truth, against SciPy, and what smoothing would have done."""

import itertools
import signal
import threading
import time
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy import optimize

from capsule_id.console import stop_if_interrupted
from capsule_id.errors import InputError
from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference import joint_fit as joint_starts
from capsule_id.inference import joint_fit as module
from capsule_id.inference.checks.posterior import check_starts
from capsule_id.inference.joint_fit import (
    LEAST_INCREASE,
    STARTS,
    _better_point,
    _descend,
    _is_converged,
    _suffice,
    choose_starts,
    joint_fit,
    scatter_modes,
    weigh,
)
from capsule_id.inference.least_squares import Solver, linearised, rows_of
from capsule_id.inference.marginal import MarginalPosterior
from capsule_id.inference.point_fit import at_another_maximum
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.result import PointFit
from capsule_id.inference.sampling import laplace_proposal
from capsule_id.inference.tables import check_engine, smoothing_shift
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.rig.model import ModelChoices, Quantity
from tests.experiments import bench
from tests.forced_runs import TRUTH, recorded, table
from tests.inference.fit.nist_strd import solve
from tests.inference.three_settings import three_settings

#: What a bench would tell: every shared parameter within 2 %.
KNOWN = ("k1", "c", "mu", "v_s", "K", "k2[stiff]")


@cache
def fitted(
    engine: Literal["exact", "smooth"] = "exact", widths: Smoothing | None = None
) -> tuple[LogPosterior, PointFit]:
    """Half a second of the second run, beside priors as wide as a bench leaves them, started 1 % off.

    ``widths`` : of the smoothed engine, where they are not the certified ones
    """
    own = table(1, samples=500)
    priors = {name: Prior("lognormal", TRUTH[name], 1.04) for name in KNOWN}
    rig = bench.rig(own, m1=Quantity(bench.M1, 2e-4), m2=Quantity(bench.M2, 5e-4), priors=priors)
    rig = replace(rig, model=ModelChoices(engine=engine))
    run = ForcedRun(own, rig)
    target = LogPosterior(rig, [run if widths is None else run.with_smoothing(widths)])
    rough = {name: 1.01 * TRUTH[name] for name in KNOWN}
    return target, joint_fit(target, rough, 0)


def test_starts_agree_and_the_truth_lies_within_the_errors() -> None:
    target, fit = fitted()
    assert fit.agree
    assert not fit.stalled.any()
    truth = recorded()[1].truth
    known = {name: TRUTH[name] for name in KNOWN} | {"G[run_2]": truth.G, "I_d[run_2]": truth.current_amplitude}
    sd = np.sqrt(np.diag(fit.covariance))
    z = {name: (fit.values[name] / value - 1.0) / sd[target.names.index(name)] for name, value in known.items()}
    assert max(map(abs, z.values())) < 3.5, z


def test_shares_of_the_variance_tell_run_and_priors_apart() -> None:
    """The share of a prior is the ratio of variances, posterior over prior, where no other input reads the parameter."""
    target, fit = fitted()
    variance = dict(zip(target.names, np.diag(fit.covariance), strict=True))
    for name in ("k1", "c"):
        shares = fit.shares[name]
        prior = variance[name] / target.prior_sd[target.names.index(name)] ** 2
        assert shares[f"prior of {name}"] == pytest.approx(prior, rel=1e-3)
        assert sum(shares.values()) == pytest.approx(1.0)
    assert max(fit.shares["G[run_2]"].items(), key=lambda item: item[1])[0] == "run_2"


def test_the_likeliest_candidates_about_a_wrong_bench_lead_to_the_maximum() -> None:
    """Friction 30 % too low; over whole records the descent from there ends elsewhere (test_run_studies.py)."""
    target, fit = fitted()
    rough = {name: TRUTH[name] * (0.7 if name == "mu" else 1.0) for name in KNOWN}
    starts = choose_starts(target, rough, 0, {})
    value = weigh(target, starts)
    assert starts[STARTS - 1, target.names.index("mu")] == pytest.approx(np.log(0.7 * TRUTH["mu"]))
    assert np.all(np.delete(value, STARTS - 1) > value[STARTS - 1] + 1e4)
    assert value[0] >= value[1]
    ends = np.stack([_descend(target, start).u for start in starts[:2]])
    np.testing.assert_allclose(weigh(target, ends), np.max(fit.log_posterior), atol=0.1)


@pytest.mark.full
def test_where_motions_have_kinks_candidates_descend_before_they_are_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The starts are the ends of descents, also of worse candidates. A descent that lowers the log-posterior is undone."""
    rig = three_settings(tmp_path / "rig")
    target = LogPosterior(rig, make_experiments(rig))
    lag, seen, risen = np.array(target.names) == "lag", list[float](), (1, 2, 20)

    def descended(_: LogPosterior, u: np.ndarray, most: int) -> Any:
        assert most == joint_starts.FIRST_STEPS
        seen.append(float(u[lag][0]))
        reached = float(len(seen)) if len(seen) in risen else -100.0
        return SimpleNamespace(x=np.where(lag, reached, u)[target.located][None])

    monkeypatch.setattr(joint_starts, "descended", descended)
    monkeypatch.setattr(joint_starts, "weigh", lambda _, u: u[:, lag][:, 0])
    starts = choose_starts(target, {}, 0, {})
    assert len(seen) >= 2 * joint_starts.CONTENDERS
    others = sorted((x for i, x in enumerate(seen, 1) if i not in risen), reverse=True)
    np.testing.assert_array_equal(starts[:, lag][:, 0], [*sorted(risen, reverse=True), *others][: len(starts)])


@pytest.mark.parametrize(("pull", "converged"), [(0.1, True), (0.5, False)])
def test_a_minimum_on_a_kink_is_one_unless_much_is_left_to_gain(pull: float, converged: bool) -> None:
    """2500 residuals that rise with |x|, and whose mean would have it below zero: no derivative vanishes at x = 0."""
    noise = np.random.default_rng(0).standard_normal(2500)
    noise += (pull - np.sum(noise) / 50.0) / 50.0
    residual = Partial(lambda noise, v: noise + jnp.abs(v[0]) / 50.0, jnp.asarray(noise))
    fit = solve(residual, np.array([[3.0]]), Solver(heavy=True))
    assert fit.x[0, 0] == pytest.approx(0.0, abs=1e-3)
    assert fit.stalled[0]
    assert _is_converged(fit) is converged


def test_ends_are_one_maximum_where_the_posterior_cannot_tell() -> None:
    """The best, one beside it, a dent, a point on its slope, and one as high, but two sd away."""
    u = np.array([[0.0, 0.0], [0.04, 0.0], [0.5, 0.0], [0.5, 0.0], [2.0, 0.0]])
    value = np.array([10.0, 9.9, 9.95, 9.8, 9.99])
    assert at_another_maximum(u, value, np.ones(2)).tolist() == [False, False, False, True, True]


@pytest.mark.full
def test_starts_go_on_until_two_ends_describe_the_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive that is 2.5 rad late cannot be fitted: two such starts of the first three prove nothing.

    Two searches run side by side: the fourth start would do, and the sixth is not tried.
    """
    target, fit = fitted()
    good = np.where(target.scatter, fit.starts[0], fit.u)
    late = good + 2.5 * (np.array(target.names) == "phase[run_2]")
    starts = np.stack([good, late, late, good, good, good])
    monkeypatch.setattr(module, "choose_starts", lambda *_: starts)
    again = joint_fit(target, {}, 0)
    assert again.at_other_maximum.tolist() == [False, True, True, False, False]
    assert check_starts(again)[0].level == "warn"


def test_starts_end_where_enough_of_them_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Model error leaves excess noise in every end; four ends at one maximum then suffice, and three do not."""
    target, fit = fitted()
    good = _descend(target, fit.u)
    lower = replace(good, value=good.value - 1.0)
    growing = itertools.count(2)
    monkeypatch.setattr(module, "_excess_noise", lambda *_: next(growing))
    assert _suffice(target, [good] * 4, good.value)
    assert not _suffice(target, [good, good, good, lower, lower], good.value)
    assert not _suffice(target, [lower] * 4 + [good], good.value)


def test_starts_end_where_the_data_are_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three ends with one misfit: it is that of the data. (Before: eight starts, minutes.) Wrong maxima have different ones."""
    target, fit = fitted()
    good = _descend(target, fit.u)
    ends = [replace(good, value=good.value - 10.0 * i) for i in range(4)]
    for excess, enough in (
        ((180.1, 180.4, 180.0), True),
        ((180.1, 240.0, 180.0), False),
        ((180.1, 90.0, 180.0, 181.0), False),
    ):
        found = iter(excess)
        monkeypatch.setattr(module, "_excess_noise", lambda *_, found=found: next(found))
        assert _suffice(target, ends[: len(excess)], good.value) == enough


def test_a_move_of_one_parameter_leads_out_of_a_side_maximum_and_not_out_of_the_maximum() -> None:
    target, fit = fitted()
    end = _descend(target, fit.u)
    assert _better_point(target, end) is None
    off = end.u + 40.0 * np.sqrt(np.diag(fit.covariance)) * (np.array(target.names) == "mu")
    better = cast(np.ndarray, _better_point(target, replace(end, u=off)))
    assert np.flatnonzero(better != off).tolist() == [target.names.index("mu")]
    assert weigh(target, better[None])[0] > weigh(target, off[None])[0] + LEAST_INCREASE


@pytest.mark.full
def test_a_start_that_is_not_finite_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    target, fit = fitted()
    nowhere = np.where(np.array(target.names) == "c", 300.0, fit.u)
    assert not np.isfinite(_descend(target, nowhere).value)
    monkeypatch.setattr(module, "choose_starts", lambda *_: nowhere[None])
    with pytest.raises(InputError, match="every motion is finite"):
        joint_fit(target, {}, 0)


def test_scipy_finds_the_same_minimum() -> None:
    """From two starts: at one of them ours, at the other a dent beside it.

    A contact that moves over a sample gives the likelihood a kink, and so minima side by side whose log-posteriors
    differ by less than a tenth: to the posterior they are one.
    """
    target, fit = fitted()
    located = target.located
    at = partial(linearised, target, fit.u)
    sd = np.sqrt(np.diag(fit.covariance))[located]
    ours = 0.5 * float(np.sum(at(fit.u[located])[0] ** 2))
    distances = []
    for seed in (0, 1):
        start = fit.u[located] + 0.5 * sd * np.random.default_rng(seed).standard_normal(len(located))
        found = optimize.least_squares(
            lambda v: at(v)[0], start, lambda v: at(v)[1], x_scale="jac",
            ftol=1e-15, xtol=1e-12, gtol=1e-15,
        )  # fmt: skip
        assert found.cost == pytest.approx(ours, abs=0.1)
        distances.append(np.max(np.abs(found.x - fit.u[located]) / sd))
        # The covariance is that of SciPy's Jacobian there.
        expected = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
        np.testing.assert_allclose(sd, expected, rtol=0.1)
    assert min(distances) < 1e-3
    assert max(distances) < 1.0


@pytest.mark.full
def test_the_differences_of_runs_are_their_derivatives_in_forward_mode() -> None:
    """Per standard deviation of each parameter, 1e-5 of a residual's. Control: over 10 % of k1 they are not."""
    target, fit = fitted()
    sd = np.sqrt(np.diag(fit.covariance))[target.located]
    exact = np.asarray(jax.jit(jax.jacfwd(lambda u: target.residuals(u)))(jnp.asarray(fit.u)))[:, target.located] * sd
    np.testing.assert_allclose(linearised(target, fit.u)[1] * sd, exact, atol=1e-5)
    k1 = target.names.index("k1")
    step = 0.1 * (np.arange(target.dimension) == k1)
    ends = np.asarray(rows_of(target, jnp.asarray(np.stack([fit.u + step, fit.u - step]))))
    column = list(target.located).index(k1)
    assert np.max(np.abs((ends[0] - ends[1]) / 0.2 * sd[column] - exact[:, column])) > 1e-3


def test_scatters_stand_at_their_conditional_maxima() -> None:
    target, fit = fitted()
    for i, mode in scatter_modes(target, fit.u).items():
        assert fit.u[i] == pytest.approx(mode, abs=1e-3)
        around = np.repeat(fit.u[None], 3, axis=0)
        around[:, i] = mode + np.array([-0.1, 0.0, 0.1])
        low, top, high = weigh(target, around)
        assert top > max(low, high)


def sampled_of(engine: Literal["exact", "smooth"], widths: Smoothing | None = None) -> SampledFit:
    target, fit = fitted(engine, widths)
    return SampledFit(target, fit, None, {**target.fixed, **fit.values})


@pytest.mark.slow
def test_both_engines_give_one_fit_within_the_certificate() -> None:
    (exact, own), (smooth, other) = fitted(), fitted("smooth")
    assert check_engine(sampled_of("exact")) == []
    shift, sd = smoothing_shift(smooth, other, None)
    difference = (own.u - other.u)[smooth.located]
    assert exact.names == smooth.names
    assert np.max(np.abs(difference) / sd) < 0.2
    np.testing.assert_allclose(difference / sd, shift / sd, atol=0.1)
    (finding,) = check_engine(sampled_of("smooth"))
    assert (finding.level, finding.parameters) == ("ok", ())
    assert finding.facts["largest"] < 0.2


@pytest.mark.slow
def test_a_wide_smoothing_fails_its_certificate_and_moves_the_fit() -> None:
    """The negative control of the test above."""
    wide = Smoothing(velocity=1e-2)
    (finding,) = check_engine(sampled_of("smooth", wide))
    assert finding.level == "fail"
    assert finding.facts["largest"] > 1.0
    (_, own), (target, other) = fitted(), fitted("smooth", wide)
    sd = np.sqrt(np.diag(own.covariance))
    assert np.max(np.abs(own.u - other.u)[target.located] / sd[target.located]) > 1.0


@pytest.mark.full
def test_smoothing_left_wide_is_wrong_by_many_sd_and_the_certified_widths_are_not() -> None:
    target, fit = fitted()
    certified, sd = smoothing_shift(target, fit, Smoothing())
    wide, _ = smoothing_shift(target, fit, Smoothing(velocity=1e-2))
    assert np.max(np.abs(wide) / sd) > 10.0
    assert np.max(np.abs(wide) / sd) > 5.0 * np.max(np.abs(certified) / sd)


@pytest.mark.usefixtures("interrupts")
def test_ctrl_c_in_python_stops_the_searches_that_run_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the command's flag. Before: both searches went on to their ends."""
    target, fit = fitted()
    first, steps = _descend(target, fit.u), list[float]()

    def search(_: LogPosterior, start: np.ndarray, limit: float) -> Any:
        if not np.isfinite(limit):
            return first
        for _step in range(600):
            stop_if_interrupted()
            steps.append(time.monotonic())
            if len(steps) == 20:
                signal.pthread_kill(cast(int, threading.main_thread().ident), signal.SIGINT)
            time.sleep(0.02)
        return first

    monkeypatch.setattr(module, "_search", search)
    with pytest.raises(KeyboardInterrupt):
        joint_fit(target, {}, 0, starts=np.stack([fit.u] * 3))
    assert len(steps) < 200
    stop_if_interrupted()  # the flag of that fit is not left behind


@pytest.mark.parametrize("wait", [(0.0, 0.1), (0.1, 0.0)])
def test_searches_side_by_side_keep_their_order(monkeypatch: pytest.MonkeyPatch, wait: tuple[float, float]) -> None:
    target, fit = fitted()
    first = _descend(target, fit.u)
    starts = fit.u + np.arange(3)[:, None]

    def search(_: LogPosterior, start: np.ndarray, limit: float) -> Any:
        number = int(np.argmin(np.max(np.abs(starts - start)[:, target.located], axis=1)))
        time.sleep(0.0 if number == 0 else wait[number - 1])
        return replace(first, value=first.value - number)

    monkeypatch.setattr(module, "_search", search)
    again = joint_fit(target, {}, 0, starts=starts)
    assert (again.log_posterior[0] - again.log_posterior).tolist() == pytest.approx([0.0, 1.0, 2.0])


def test_only_blocks_with_a_motion_are_large() -> None:
    """The bench alone keeps components that draw terms that may be absent from their priors, however many it has."""
    target, fit = fitted()
    alone = LogPosterior(target.rig, [e for e in target.experiments if not e.event_driven])
    own = [target.names.index(name) for name in alone.names]
    at = replace(fit, names=alone.names, u=fit.u[own], covariance=fit.covariance[np.ix_(own, own)])
    for density, large in ((MarginalPosterior(target, fit), True), (MarginalPosterior(alone, at), False)):
        assert any(density.event_driven) == large
        assert any(laplace_proposal(density)[1]) == large
