"""Test whether one initial state predicts the motion of a whole record."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.checks.context import Fitted
from capsule_id.physics.drive import Drive
from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Status, simulate
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun

#: Largest growth factor of an initial error within the record, dimensionless. Above it one initial state cannot fit it.
LARGEST_GROWTH = 1e3
#: Target growth factor of an initial error within a part, dimensionless; shortest part, excitation periods.
PART_GROWTH, PART_PERIODS = 30.0, 2.0


def growth(run: "ForcedRun", theta: ValuesBySymbol) -> float:
    """Largest growth factor of a small initial error at the end of the record, dimensionless.

    Positions are scaled by the amplitude of the motion, velocities by amplitude times Omega.
    """
    size = np.array([1.0, run.Omega, run.Omega]) * run.rough.length
    motion = run.motion(theta, np)
    start = np.array([float(motion.x_rel[0]), float(motion.Y1[0] - motion.Y2[0]), float(motion.Y2[0])])
    derivative = np.asarray(_derivative_of_end(*run.capsule(theta), run.law(theta), run.time[[0, -1]], start))
    return float(np.linalg.norm(derivative * size / size[:, None], 2))


@jax.jit
def _derivative_of_end(
    p: CapsuleParameters, e: Drive, law: FrictionLaw, times: jax.Array, start: jax.Array
) -> jax.Array:
    """(3, 3) of (x_rel, its rate, Y2) at the last of ``times`` with respect to the same at the first."""

    def end(state: jax.Array) -> jax.Array:
        t = simulate(p, e, times, (state[0], state[1] + state[2], 0.0, state[2]), friction=law)
        return jnp.stack([t.X1[-1] - t.X2[-1], t.Y1[-1] - t.Y2[-1], t.Y2[-1]])

    return jax.jacfwd(end)(start)


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
