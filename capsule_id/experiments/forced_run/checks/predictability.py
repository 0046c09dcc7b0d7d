"""Test whether one initial state predicts the motion of a whole record."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.checks.context import Fitted
from capsule_id.physics.model import Status
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun

#: Largest growth factor of an initial error within the record, dimensionless. Above it one initial state cannot fit it.
LARGEST_GROWTH = 1e3
#: Target growth factor of an initial error within a part, dimensionless; shortest part, excitation periods.
PART_GROWTH, PART_PERIODS = 30.0, 2.0

#: Initial errors of the difference quotients, relative to the motion; factors up to this are read off; instants of a
#: record at which they are read.
STEP, MEASURABLE, INSTANTS = 1e-11, 1e8, 8


def growth(run: "ForcedRun", theta: ValuesBySymbol) -> float:
    """Largest growth factor of a small initial error at the end of the record, dimensionless; inf where it is not finite.

    Positions are scaled by the amplitude of the motion, velocities by amplitude times Omega. Central differences come
    from one batch of runs, because exact derivatives take ten times as long to compile. A factor above ``MEASURABLE``
    within the record is extrapolated from there, because differences cannot outgrow the motion. Below 1e-3: rounding.
    """
    size = np.array([1.0, run.Omega, run.Omega]) * run.rough.length
    motion = run.motion(theta, np)
    start = np.array([float(motion.x_rel[0]), float(motion.Y1[0] - motion.Y2[0]), float(motion.Y2[0])])
    x_rel, rate, Y2 = np.concatenate([start + STEP * np.diag(size), start - STEP * np.diag(size)]).T
    time = np.asarray(run.true_time(theta))
    instants = np.linspace(time[0], time[-1], INSTANTS + 1)[1:]
    # As many samples as the record has: then one compiled program serves all batches of its motions.
    times = np.union1d(time, instants)
    t = run.simulated(theta, *run.capsule(theta), times, (x_rel, rate + Y2, np.zeros(6), Y2))
    states = np.stack([t.x_rel, t.Y1 - t.Y2, t.Y2], axis=-1)[:, np.searchsorted(times, instants)]
    states = states / (2.0 * STEP * size)
    if not np.isfinite(states).all():
        return float("inf")
    factors = np.linalg.norm(np.swapaxes(states[:3] - states[3:], 0, 1), 2, axis=(1, 2))
    last = int(np.argmax(factors > MEASURABLE)) if np.any(factors > MEASURABLE) else INSTANTS - 1
    with np.errstate(over="ignore"):
        return float(factors[last] ** (INSTANTS / (last + 1)))


def predictable_parts(run: "ForcedRun", theta: ValuesBySymbol) -> "tuple[tuple[ForcedRun, ...], list[Finding]]":
    """Divide ``run`` where it amplifies errors of its initial state too much at ``theta``; also return findings."""
    if run.settled:
        return (run,), []
    factor = growth(run, theta)
    if factor <= LARGEST_GROWTH:
        return (run,), []
    parts = run.parts(_part_length(run, factor))
    if len(parts) == 1:
        return parts, []
    seconds = (run.time[-1] - run.time[0]) / len(parts)
    facts = {"growth": factor, "parts": len(parts), "seconds": seconds}
    return parts, [Finding("runs.cut", "warn", facts, run.label)]


def _part_length(run: "ForcedRun", factor: float) -> float:
    """Duration over which errors grow about ``PART_GROWTH`` times, s."""
    shortest = PART_PERIODS * 2.0 * np.pi / run.Omega
    duration = float(run.time[-1] - run.time[0])
    if not np.isfinite(factor):
        return shortest
    return max(shortest, duration * np.log(PART_GROWTH) / np.log(factor))


def check_predictable(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[Finding]:
    """Check that the motion of every run is predictable over its record, and complete."""
    findings = []
    for run in runs:
        local = run.local(fit.values)
        status = Status(int(run.motion(local, np).status))
        if status is Status.GRAZING:
            findings.append(Finding("runs.grazing", "warn", {"status": status.sentence}, run.label))
        factor = growth(run, local)
        if not factor < LARGEST_GROWTH:
            findings.append(Finding("runs.predictable", "fail", {"growth": factor}, run.label))
    return findings or [Finding("runs.predictable", "ok", {"number": len(runs), "limit": LARGEST_GROWTH})]
