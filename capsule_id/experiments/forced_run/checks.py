"""Checks of a forced run: feasibility, predictability by one initial state, residuals that repeat with the excitation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.integrate import solve_ivp

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.checks import LEVEL
from capsule_id.experiments.context import Fitted
from capsule_id.physics.drive import Excitation
from capsule_id.physics.forces import grazing_load, rod_acceleration, rod_on_capsule
from capsule_id.physics.model import CapsuleParameters, Status, without_absent
from capsule_id.records.tones import stated_gap, stated_Omega, tone_at
from capsule_id.rig.filters import median_step
from capsule_id.rig.model import Table
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun


# feasibility: Feasibility of a forced run: contact, motion of the capsule, sampling rate and length of the record.
#
# The test uses settings, not readings, of a run that starts from rest. It runs before a fit with rough values of
# the same folder (``rough_values.py``), and after a fit with fitted values.


#: Smallest number of samples per contact with the support spring that resolves an impact.
SAMPLES_PER_CONTACT = 10
#: Smallest number of excitation periods of periodic motion in a record, after the transient.
SETTLED_PERIODS = 8
#: Duration of the transient in units of 2 m1/c; exp(-4) = 2 % of it remains.
DECAY_TIMES = 4.0
#: Simulated excitation periods of the rod on a held capsule, relative tolerance, and largest number of steps imposed to
#: resolve contacts. The limit bounds the effort for drives of extremely long period.
HELD_PERIODS, HELD_TOLERANCE, HELD_STEPS = 12, 1e-6, 20_000
#: Largest simulated duration of the rod on a held capsule, in units of 2 m1/c.
HELD_DECAYS = 50.0


@dataclass(frozen=True)
class RunConditions:
    """Angular frequency and amplitude of the drive, and the gap, of one run, SI; infinite without a spring."""

    Omega: float
    P_d: float
    G: float


def stated_conditions(table: Table, K: float) -> RunConditions:
    """Conditions of a forced run; P_d as stated, else ``K`` (N/A) times the current's amplitude at Omega."""
    Omega, stated = stated_Omega(table), table.settings.P_d
    P_d = K * tone_at(table["time"], table["current"], Omega)[0] if stated is None else stated.value
    return RunConditions(Omega, P_d, stated_gap(table).value)


def check_feasible(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[Finding]:
    """Check that the settings of every run allow it to determine its parameters, at the point fit."""
    findings = []
    # The rule for contact and slip of a run from rest holds on level ground.
    for run in (run for run in runs if not run.ground):
        theta = run.local(fit.values)
        p, e = run.capsule(theta)
        assert isinstance(e, Excitation), "only runs with a harmonic force declare this check"
        conditions = RunConditions(run.Omega, float(e.P_d), float(p.G))  # pyright: ignore[reportArgumentType]
        F_b = float(run.law(theta).forward(0.0))
        findings += feasibility(run.table, theta, F_b, conditions)
    return findings


def feasibility(
    table: Table, theta: Mapping[str, float], F_b: float, conditions: RunConditions | None = None
) -> list[Finding]:
    """Return findings of level ``warn`` on the settings of one forced run; none where they are feasible.

    Parameters
    ----------
    table : a ``forced_run``
    theta : values by symbol, SI: m1, m2, k1, c, k2 (of this run's spring, if any), and K where P_d is not stated
    F_b : break-away force, N
    conditions : None: as stated
    """
    drive = conditions or stated_conditions(table, theta.get("K", np.nan))
    reached, touches = held_rod(theta, drive)
    without_contact = drive.P_d / float(grazing_load(theta["m1"], theta["k1"], theta["c"], 1.0, drive.Omega))
    grazing = float(grazing_load(theta["m1"], theta["k1"], theta["c"], drive.G, drive.Omega))
    linear_force = without_contact * float(np.hypot(theta["k1"], theta["c"] * drive.Omega))
    findings = []
    if drive.P_d < grazing < np.inf and linear_force <= F_b:
        facts = {"Omega": drive.Omega, "gap_mm": 1e3 * drive.G, "needed": grazing, "P_d": drive.P_d}
        findings.append(Finding("runs.contact", "warn", facts, table.label))
    if reached <= F_b:
        findings.append(Finding("runs.slip", "warn", {"force": reached, "F_b": F_b}, table.label))
    return [*findings, *_sampling(table, theta, touches and drive.P_d >= grazing), *_length(table, theta, drive)]


def held_rod(theta: Mapping[str, float], drive: RunConditions) -> tuple[float, bool]:
    """Largest force |f| of the rod on a capsule held at rest, N, and whether the rod touches the spring.

    The rod starts from rest. A capsule at rest sticks while |f| <= F_b, so the test for its motion is exact.
    """
    m1, k1, c, k2 = (float(theta.get(name, 0.0)) for name in ("m1", "k1", "c", "k2"))
    capsule = CapsuleParameters(m1=m1, m2=np.inf, k1=k1, k2=k2, c=c, mu=np.inf, v_s=np.inf, G=drive.G)
    held, e = without_absent(capsule, Excitation(drive.P_d, drive.Omega))

    def rate(t: float, state: np.ndarray) -> list[float]:
        x, y = state
        return [y, float(rod_acceleration(held, e, t, x, y))]

    period = 2.0 * np.pi / drive.Omega
    # The drive begins at its peak. After the transient of a slow drive the force never exceeds that maximum.
    span = min(HELD_PERIODS * period, HELD_DECAYS * 2.0 * m1 / c)
    touch = max(0.25 * contact_time(m1, float("inf"), k2), span / HELD_STEPS)
    step = min(period / 40.0, touch)
    run = solve_ivp(rate, (0.0, span), [0.0, 0.0], "LSODA", rtol=HELD_TOLERANCE, atol=1e-10, max_step=step)
    return float(np.max(np.abs(rod_on_capsule(held, *run.y)))), bool(np.max(run.y[0]) >= drive.G)


def contact_time(m1: float, m2: float, k2: float) -> float:
    """Half a period of the rod on the support spring, pi sqrt(m*/k2), s; m* is the reduced mass (m1 for infinite m2).

    Infinite without a spring, k2 = 0.
    """
    return float(np.pi * np.sqrt(1.0 / ((1.0 / m1 + 1.0 / m2) * k2))) if k2 > 0.0 else np.inf


def _sampling(table: Table, theta: Mapping[str, float], touches: bool) -> list[Finding]:
    """Check the number of samples per contact; the shortest contact is that with a sliding capsule."""
    step = median_step(table["time"])
    touch = contact_time(theta["m1"], theta["m2"], theta.get("k2", 0.0))
    if not touches or touch / step >= SAMPLES_PER_CONTACT:
        return []
    facts = {
        "contact_ms": 1e3 * touch,
        "samples": touch / step,
        "wanted": SAMPLES_PER_CONTACT,
        "rate": SAMPLES_PER_CONTACT / touch,
    }
    return [Finding("runs.sampling", "warn", facts, table.label)]


def _length(table: Table, theta: Mapping[str, float], drive: RunConditions) -> list[Finding]:
    """Check the number of excitation periods after the transient."""
    time, start = table["time"], DECAY_TIMES * 2.0 * theta["m1"] / theta["c"]
    period = 2.0 * np.pi / drive.Omega
    settled = (float(time[-1] - time[0]) - start) / period
    if settled >= SETTLED_PERIODS:
        return []
    facts = {
        "periods": max(settled, 0.0),
        "decay": start,
        "wanted": SETTLED_PERIODS,
        "seconds": start + SETTLED_PERIODS * period,
    }
    return [Finding("runs.length", "warn", facts, table.label)]


# predictability: Test whether one initial state predicts the motion of a whole record.


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
    run = run.with_smoothing(None)  # the steps of the smoothed engine hide so small an error
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


# repeated: Test whether the residuals of a run repeat with the excitation.
#
# Noise does not know the phase of the drive. An error of the model, such as a wrong friction law, repeats with every
# period of a periodic motion. Coloured noise can hide it from a test of whiteness: it is slow beside the samples.


#: Largest number of harmonics of the excitation; fewest samples of a period for each of them.
HARMONICS, SAMPLES_PER_HARMONIC = 10, 4
#: Fewest whole periods of a record: in fewer ones a slow error of the noise looks like a repeated one.
FEWEST_PERIODS = 4


def check_repeated(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[Finding]:
    """Check that the residuals of no record repeat with the excitation."""
    tests = [
        (run, label, *found)
        for run in runs
        for label, residuals in run.records(run.local(fit.values))
        if (found := repetition(run, residuals)) is not None
    ]
    findings = []
    for run, label, F, p in tests:
        if p * len(tests) < LEVEL:
            facts = {"record": label, "F": F, "p": p, **run.noise_facts()}
            findings.append(Finding("runs.repeated", "fail", facts, run.label))
    if findings or not tests:
        return findings
    return [Finding("runs.repeated", "ok", {"p": min(p for *_, p in tests)})]


def repetition(run: "ForcedRun", residuals: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """F statistic of the harmonics of the excitation in ``residuals``, and its p-value; None for a short record."""
    assert run.cycles is not None, "a run has an excitation"
    cycles = run.cycles
    periods = float(cycles[-1] - cycles[0])
    number = min(HARMONICS, int(len(cycles) / periods / SAMPLES_PER_HARMONIC))
    freedom = len(cycles) - 2 * number - 1
    if periods < FEWEST_PERIODS or number < 1 or freedom < 1:
        return None
    angle = 2.0 * np.pi * np.outer(cycles, np.arange(1, number + 1))
    design = np.column_stack([np.ones(len(cycles)), np.cos(angle), np.sin(angle)])
    rest = residuals - design @ np.linalg.lstsq(design, residuals, rcond=None)[0]
    own, whole = float(np.sum(rest**2)), float(np.sum((residuals - np.mean(residuals)) ** 2))
    F = (whole - own) / (2 * number) / max(own / freedom, np.finfo(float).tiny)
    return F, float(stats.f.sf(F, 2 * number, freedom))
