"""The point fit by stages: closed forms first, runs cut where they must be, then everything together.

experiments -> bench fit (closed forms) -> runs whose start is forgotten too late are cut -> LogPosterior -> joint fit
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from capsule_id.experiments import make_experiments, paper_estimates, select_tables
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.forced_run.experiment import ForcedRun
from capsule_id.experiments.forced_run.parts import parts_of
from capsule_id.experiments.forced_run.restart import better_start, restarted
from capsule_id.inference.checks.run_checks import LARGEST_GROWTH, growth
from capsule_id.inference.fit.joint_fit import joint_fit
from capsule_id.inference.fit.point_fit import point_fit
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.sampling.ensembles import sample
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.inference.target.marginal import MarginalPosterior, compile_ahead
from capsule_id.rig.model import Rig
from capsule_id.views import Finding

#: emcee steps of the bench's own sample, which shows what the runs add and whether they agree.
BENCH_BUDGET = 1000
#: Fits, each after kinds of start that the one before found wrong have been put right.
ROUNDS = 3
#: A part of a cut record may amplify an error of its start this much, and is no shorter than so many periods.
PART_GROWTH, PART_PERIODS = 30.0, 2.0


@dataclass(frozen=True)
class BenchFit:
    """What the closed forms tell by themselves; None where there are none, or nothing was sampled."""

    fit: PointFit | None = None
    sample: Posterior | None = None


@dataclass(frozen=True)
class PointStage:
    """Where the point fit stands: ``target`` holds the experiments as they were fitted, records possibly cut."""

    target: LogPosterior
    fit: PointFit
    bench: BenchFit
    findings: tuple[Finding, ...] = ()


def fit_points(rig: Rig, experiments: Sequence[Experiment], seed: int, sampled: bool) -> PointStage:
    """Fit ``experiments``.

    Parameters
    ----------
    seed : of the starts, and of the bench's own sample
    sampled : a sample will follow: its compilation begins, and the bench gets one of its own
    """
    closed = [e for e in experiments if not e.event_driven]
    with ThreadPoolExecutor(1) if sampled else nullcontext() as pool:
        if len(closed) == len(experiments):
            target = LogPosterior(rig, experiments)
            _compile(pool, target)
            return PointStage(target, point_fit(target, seed), BenchFit())
        bench, known = BenchFit(), _rough(rig)
        if closed:
            alone = LogPosterior(rig, closed)
            fit = point_fit(alone, seed)
            own = sample(MarginalPosterior(alone, fit), seed, BENCH_BUDGET) if sampled else None
            bench, known = BenchFit(fit, own), dict(fit.values)
        experiments, findings = cut_unpredictable(rig, experiments, known)
        target, joint, wavering = _fit_with_right_starts(rig, experiments, known, seed, pool)
    return PointStage(target, joint, bench, (*findings, *wavering))


def _fit_with_right_starts(
    rig: Rig,
    experiments: Sequence[Experiment],
    known: Mapping[str, float],
    seed: int,
    pool: Executor | None,
) -> tuple[LogPosterior, PointFit, list[Finding]]:
    """The joint fit, again from where it ended as long as it finds a start of a run wrong; and what is left of that."""
    target, first = LogPosterior(rig, experiments), None
    for remaining in reversed(range(ROUNDS)):
        _compile(pool, target)
        joint = joint_fit(target, known, seed, first)
        corrected = correct_starts(target, joint)
        if corrected is None:
            return target, joint, []
        if remaining:
            target, first = LogPosterior(rig, corrected[0]), corrected[1]
    doubtful = [a.label for a, b in zip(target.experiments, corrected[0], strict=True) if a is not b]
    text = (
        f"{', '.join(doubtful)}: expected one kind of start to fit; after {ROUNDS} fits the record still speaks for "
        'another: state start = "stuck" or "moving", or cut the record where the capsule is clearly at rest'
    )
    return target, joint, [Finding("start of a run", "fail", text, doubtful[0])]


def _compile(pool: Executor | None, target: LogPosterior) -> None:
    """In another thread; what goes wrong in it comes up again where its result is used."""
    if pool is not None:
        pool.submit(compile_ahead, target)


def _rough(rig: Rig) -> dict[str, float]:
    """The paper's estimates of what the rig's bench tables tell, fitted or not."""
    return paper_estimates(make_experiments(rig, "bench")) if select_tables(rig, "bench") else {}


def cut_unpredictable(
    rig: Rig, experiments: Sequence[Experiment], known: Mapping[str, float]
) -> tuple[list[Experiment], list[Finding]]:
    """``experiments`` with every run in parts that amplifies an error of its start too much, and what was done.

    Parameters
    ----------
    known : estimates by name; whatever is missing stands where a fit would start
    """
    values = _values(rig, experiments, known)
    kept: list[Experiment] = []
    findings: list[Finding] = []
    for e in experiments:
        parts = [e]
        if isinstance(e, ForcedRun) and not e.settled:
            factor = growth(e, e.local(values))
            if not factor <= LARGEST_GROWTH:
                parts = [ForcedRun(table, rig) for table in parts_of(e.table, _part_length(e, factor))]
        if len(parts) > 1:
            seconds = (e.table["time"][-1] - e.table["time"][0]) / len(parts)
            text = (
                f"{e.label}: an error of the initial state grows {factor:.2g} times over the record where the fit starts, "
                f"so it was cut into {len(parts)} parts of {seconds:.2g} s, each with an initial state of its own; "
                'segment = { value = ..., unit = "s" } states another length'
            )
            findings.append(Finding("runs predictable", "warn", text, e.label))
        kept += parts
    return kept, findings


def correct_starts(target: LogPosterior, fit: PointFit) -> tuple[list[Experiment], dict[str, float]] | None:
    """Starts put right that the whole record speaks against at ``fit``: the experiments, and values by name to go on from.

    None: all stand.
    """
    values, experiments = target.mapping(target.theta(fit.u)), list(target.experiments)
    for i, e in enumerate(target.experiments):
        if isinstance(e, ForcedRun) and e.start_is_open and "x_capsule" in e.channels:
            better = better_start(e, e.local(values))
            if better is not None:
                experiments[i] = restarted(e, better["capsule_start"])
                values |= {f"{symbol}[{e.label}]": value for symbol, value in better.items()}
    return None if experiments == list(target.experiments) else (experiments, values)


def _values(rig: Rig, experiments: Sequence[Experiment], known: Mapping[str, float]) -> dict[str, float]:
    """Where a fit would start, by name, but for what is known."""
    rough = LogPosterior(rig, experiments)
    return {**rough.fixed, **{name: start.centre for name, start in rough.starts().items()}, **known}


def _part_length(run: ForcedRun, factor: float) -> float:
    """s over which errors grow about ``PART_GROWTH`` times."""
    shortest = PART_PERIODS * 2.0 * np.pi / run.Omega
    duration = float(run.time[-1] - run.time[0])
    if not np.isfinite(factor):
        return shortest
    return max(shortest, duration * np.log(PART_GROWTH) / np.log(factor))
