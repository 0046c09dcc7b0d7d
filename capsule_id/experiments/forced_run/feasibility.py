"""Feasibility of a forced run: contact, motion of the capsule, sampling rate and length of the record.

The test uses settings, not readings, of a run that starts from rest. It runs before a fit with rough values of the
same folder (``experiments.rough_values``), and after a fit with fitted values.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from capsule_id.physics.drive import Excitation
from capsule_id.physics.forces import grazing_load, rod_acceleration, rod_on_capsule
from capsule_id.physics.model import CapsuleParameters, without_absent
from capsule_id.records.tones import stated_gap, stated_Omega, tone_at
from capsule_id.rig.filters import median_step
from capsule_id.rig.model import Table
from capsule_id.views import Facts, Finding

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


class Rest(NamedTuple):
    """A run that starts from rest: its table, values by symbol, drive, break-away force, N, and the rod on a held capsule.

    Attributes
    ----------
    grazing : amplitude of the drive at which the rod reaches the gap, N
    reached, touches : see ``held_rod``
    """

    table: Table
    theta: Mapping[str, float]
    drive: RunConditions
    F_b: float
    grazing: float
    reached: float
    touches: bool


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
    grazing = float(grazing_load(theta["m1"], theta["k1"], theta["c"], drive.G, drive.Omega))
    rest = Rest(table, theta, drive, F_b, grazing, *held_rod(theta, drive))
    found = ((code, detect(rest)) for code, detect in DETECTORS.items())
    return [Finding(code, "warn", facts, table.label) for code, facts in found if facts]


def no_contact(run: Rest) -> Facts:
    """The rod of a capsule that stays where it is does not reach the gap."""
    drive, k1, c = run.drive, run.theta["k1"], run.theta["c"]
    deflection = drive.P_d / float(grazing_load(run.theta["m1"], k1, c, 1.0, drive.Omega))
    force = deflection * float(np.hypot(k1, c * drive.Omega))
    if not drive.P_d < run.grazing < np.inf or force > run.F_b:
        return {}
    return {"Omega": drive.Omega, "gap_mm": 1e3 * drive.G, "needed": run.grazing, "P_d": drive.P_d}


def no_slip(run: Rest) -> Facts:
    """The rod does not push the capsule out of its place."""
    return {} if run.reached > run.F_b else {"force": run.reached, "F_b": run.F_b}


def sparse_contacts(run: Rest) -> Facts:
    """A contact has few samples; the shortest contact is that with a sliding capsule."""
    touch = contact_time(run.theta["m1"], run.theta["m2"], run.theta.get("k2", 0.0))
    samples, enough = touch / median_step(run.table["time"]), SAMPLES_PER_CONTACT
    if not (run.touches and run.drive.P_d >= run.grazing) or samples >= enough:
        return {}
    return {"contact_ms": 1e3 * touch, "samples": samples, "wanted": enough, "rate": enough / touch}


def short_record(run: Rest) -> Facts:
    """Few excitation periods are left after the transient."""
    time, decay = run.table["time"], DECAY_TIMES * 2.0 * run.theta["m1"] / run.theta["c"]
    period = 2.0 * np.pi / run.drive.Omega
    settled = (float(time[-1] - time[0]) - decay) / period
    if settled >= SETTLED_PERIODS:
        return {}
    seconds = decay + SETTLED_PERIODS * period
    return {"periods": max(settled, 0.0), "decay": decay, "wanted": SETTLED_PERIODS, "seconds": seconds}


#: Detectors of settings that do not determine the parameters, by code; each returns the facts, {} where there is no fault.
DETECTORS: Mapping[str, Callable[[Rest], Facts]] = {
    "runs.contact": no_contact,
    "runs.slip": no_slip,
    "runs.sampling": sparse_contacts,
    "runs.length": short_record,
}


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
