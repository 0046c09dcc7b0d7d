"""Forced runs by drive, and what the report says of them: checks, tables and panels."""

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from capsule_id.errors import InputError
from capsule_id.experiments.base import LEVEL, Fitted, Start, ValuesBySymbol, axis_label, band, stacked, stretch
from capsule_id.experiments.forced_run.declaration import SETTLING_PERIODS, SQUARE
from capsule_id.experiments.forced_run.experiment import LARGEST_GROWTH, CapsuleRun, before_samples, growth
from capsule_id.experiments.forced_run.start_state import RunStart, rough_start, slides
from capsule_id.experiments.friction_model import EQUATION_1, NORMAL_FORCE
from capsule_id.experiments.kind import Estimate
from capsule_id.experiments.statistics import autocorrelation, further_columns, judged
from capsule_id.parameters import ENDS
from capsule_id.physics.drives import Pulses, RecordedDrive, RodMotion
from capsule_id.physics.forces import FrictionLaw, downhill, grazing_load, rod_on_capsule
from capsule_id.physics.model import (
    CapsuleParameters,
    Drive,
    Excitation,
    Status,
    Trajectory,
    rod_acceleration,
    without_absent,
)
from capsule_id.records.motion import fit_mean_velocity, measured_motion
from capsule_id.records.periods import FEWEST_PERIODS
from capsule_id.records.tones import FEWEST_IN_PERIOD, relative_position, stated_gap, stated_Omega, tone_at
from capsule_id.records.view import FILTER_ORDER, PASS_BAND_MULTIPLE, SMALLEST_RATE_GAIN, RunRecord, view_record
from capsule_id.rig.filters import (
    dominant_frequency,
    longest_window,
    median_step,
    sampling_step,
    savitzky_golay,
    window_samples,
)
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison, Curve, Facts, Finding, Points, ResultTable

# feasibility: Contact, motion of the capsule, sampling rate and length of the record.
#
# The test uses settings, not readings, of a run that starts from rest. It runs before a fit with rough values of the
# same folder (``experiments.rough_values``), and after a fit with fitted values.


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


def feasibility(
    table: Table, theta: Mapping[str, float], F_b: float, P_d: float | None = None, G: float | None = None
) -> list[Finding]:
    """Return findings of level ``warn`` on the settings of one forced run; none where they are feasible.

    Parameters
    ----------
    table : a ``forced_run``
    theta : values by symbol, SI: m1, m2, k1, c, k2 (of this run's spring, if any), K where P_d is not stated, and reaction,
        the share of the drive's force that pushes the capsule back (default 0)
    F_b : break-away force, N
    P_d, G : amplitude of the drive, N, and gap, m, infinite without a spring; None: as stated, P_d else ``K`` (N/A) times
        the current's amplitude at Omega
    """
    m1, k1, c, time, Omega = theta["m1"], theta["k1"], theta["c"], table["time"], stated_Omega(table)
    G = stated_gap(table).value if G is None else G
    if P_d is None:
        stated = table.settings.P_d
        P_d = stated.value if stated else theta["K"] * tone_at(time, table["current"], Omega)[0]
    found: dict[str, Facts] = {}
    # The rod of a capsule that stays where it is does not reach the gap.
    grazing, per_length = (float(grazing_load(m1, k1, c, length, Omega)) for length in (G, 1.0))
    # The force on the capsule per length of the rod's motion: of spring and damper, less the drive's where it reacts there.
    push = m1 * Omega**2 if theta.get("reaction") else float(np.hypot(k1, c * Omega))
    if P_d < grazing < np.inf and P_d / per_length * push <= F_b:
        found["runs.contact"] = {"Omega": Omega, "gap_mm": 1e3 * G, "needed": grazing, "P_d": P_d}
    # The rod does not push the capsule out of its place.
    reached, touches = held_rod(theta, P_d, Omega, G)
    if not reached > F_b:
        found["runs.slip"] = {"force": reached, "F_b": F_b}
    # A contact has few samples; the shortest contact is that with a sliding capsule.
    touch, enough = contact_time(m1, theta["m2"], theta.get("k2", 0.0)), SAMPLES_PER_CONTACT
    samples = touch / median_step(time)
    if touches and P_d >= grazing and samples < enough:
        found["runs.sampling"] = {
            "contact_ms": 1e3 * touch,
            "samples": samples,
            "wanted": enough,
            "rate": enough / touch,
        }
    # Few excitation periods are left after the transient.
    period, wanted = 2.0 * np.pi / Omega, SETTLED_PERIODS
    decay = 0.0 if table.settings.start == "settled" else DECAY_TIMES * 2.0 * m1 / c
    periods = (float(time[-1] - time[0]) - decay) / period
    if not periods >= wanted:
        found["runs.length"] = {
            "periods": max(periods, 0.0),
            "decay": decay,
            "wanted": wanted,
            "seconds": decay + wanted * period,
        }
    return [Finding(code, "warn", facts, table.label) for code, facts in found.items()]


def held_rod(theta: Mapping[str, float], P_d: float, Omega: float, G: float) -> tuple[float, bool]:
    """Largest force of the rod, and of the drive where it reacts there, on a capsule held at rest, N; whether the rod
    touches the spring.

    The rod starts from rest. A capsule at rest sticks while this force is at most F_b, so the test for its motion is exact.
    """
    own = {name: float(theta.get(name, 0.0)) for name in ("m1", "k1", "c", "k2", "k_cubic", "c2")}
    m1, c, k2 = own["m1"], own["c"], own["k2"]
    capsule = CapsuleParameters(**own, m2=np.inf, mu=np.inf, v_s=np.inf, G=G)
    held, e = without_absent(capsule, Excitation(P_d, Omega))

    def rate(t: float, state: np.ndarray) -> list[float]:
        x, y = state
        return [y, float(rod_acceleration(held, e, t, x, y))]

    period = 2.0 * np.pi / Omega
    # The drive begins at its peak. After the transient of a slow drive the force never exceeds that maximum.
    span = min(HELD_PERIODS * period, HELD_DECAYS * 2.0 * m1 / c)
    touch = max(0.25 * contact_time(m1, float("inf"), k2), span / HELD_STEPS)
    step = min(period / 40.0, touch)
    run = solve_ivp(rate, (0.0, span), [0.0, 0.0], "LSODA", rtol=HELD_TOLERANCE, atol=1e-10, max_step=step)
    force = rod_on_capsule(held, *run.y) - theta.get("reaction", 0.0) * P_d * np.cos(Omega * run.t)
    return float(np.max(np.abs(force))), bool(np.max(run.y[0]) >= G)


def contact_time(m1: float, m2: float, k2: float) -> float:
    """Half a period of the rod on the support spring, pi sqrt(m*/k2), s; m* is the reduced mass (m1 for infinite m2).

    Infinite without a spring, k2 = 0.
    """
    return float(np.pi * np.sqrt(1.0 / ((1.0 / m1 + 1.0 / m2) * k2))) if k2 > 0.0 else np.inf


def lint_feasibility(table: Table, rig: Rig, estimate: Estimate) -> list[Finding]:
    """Report quantities that the run cannot measure, at rough values."""
    settings = table.settings
    if settings.drive != "harmonic" or settings.ground or settings.spring_back is not None:
        return []
    names = {symbol: symbol for symbol in ("k1", "c", "mu") + (("K",) if settings.P_d is None else ())}
    names |= {} if settings.spring is None else {"k2": f"k2[{settings.spring}]"}
    values = {symbol: estimate(name) for symbol, name in names.items()}
    guessed = [names[symbol] for symbol, (_, measured) in values.items() if not measured]
    theta = {"m1": rig.mass("m1"), "m2": rig.mass("m2"), "g": rig.g.value, "reaction": rig.model.share_of_reaction}
    theta |= {symbol: value for symbol, (value, _) in values.items()}
    normal = {} if settings.normal_force is None else {NORMAL_FORCE: settings.normal_force}
    findings = feasibility(table, theta, float(EQUATION_1.force({**theta, **normal}).forward(0.0)))
    if findings and guessed:
        findings.append(Finding("runs.rough", "warn", {"names": ", ".join(guessed)}, table.label))
    return findings


def check_feasible(runs: Sequence[CapsuleRun], fit: Fitted) -> list[Finding]:
    """Check that the settings of every run allow it to determine its parameters, at the point fit."""
    findings = []
    # The rule for contact and slip of a run from rest holds on level ground, with a spring in front of the rod.
    for run in (run for run in runs if not run.ground and run.table.settings.spring_back is None):
        theta = run.local(fit.values)
        (p, e), law = run.capsule(theta), run.law(theta)
        F_b = min(float(law.forward(0.0)), float(law.backward(0.0)))
        P_d, G = (float(x) for x in (e.P_d, p.G))  # pyright: ignore
        findings += feasibility(run.table, {**theta, "reaction": run.reaction}, F_b, P_d, G)
    return findings


# predictability: Test whether one initial state predicts the motion of a whole record.


def check_predictable(runs: Sequence[CapsuleRun], fit: Fitted) -> list[Finding]:
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


#: Largest number of harmonics of the excitation.
HARMONICS = 10


def check_repeated(runs: Sequence[CapsuleRun], fit: Fitted) -> list[Finding]:
    """Check that the residuals of no record repeat with the excitation."""
    cases = [
        (run.label, found[1], {"record": label, "F": found[0], "p": found[1], **run.noise_facts()})
        for run in runs
        for label, residuals in run.records(run.local(fit.values))
        if (found := repetition(run, residuals)) is not None
    ]
    return judged("runs.repeated", cases, LEVEL, {"p": min((p for _, p, _ in cases), default=1.0)})


def repetition(run: CapsuleRun, residuals: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """F statistic of the harmonics of the excitation in ``residuals``, and its p-value; None for a short record."""
    cycles = run.cycles
    periods = float(cycles[-1] - cycles[0])
    number = min(HARMONICS, int(len(cycles) / periods / FEWEST_IN_PERIOD))
    # In fewer periods a slow error of the noise looks like a repeated one.
    if periods < FEWEST_PERIODS or number < 1:
        return None
    angle = 2.0 * np.pi * np.outer(cycles, np.arange(1, number + 1))
    harmonics = np.column_stack([np.cos(angle), np.sin(angle)])
    return further_columns(np.ones((len(cycles), 1)), harmonics, residuals)[:2]


# tables: Tables of forced runs: nondimensional groups and predicted motion.


#: Largest number of posterior draws for a band; errors of a record's velocity drawn for each.
BAND_DRAWS, ERRORS = 50, 200


def scaled_groups(runs: Sequence[CapsuleRun], fit: Fitted) -> list[ResultTable]:
    """Return the paper's nondimensional groups, mean and sd over the posterior draws; [] without a sample.

    Lengths are scaled by F_b/k1, forces by F_b, times by 1/Omega0. Omega0 = sqrt(k1/m1); F_b is the break-away force.
    """
    columns: dict[str, list[float]] = {}
    for name, value in (item for v in fit.draws for run in runs for item in _groups(run, run.local(v)).items()):
        columns.setdefault(name, []).append(value)
    rows = {name: [np.mean(column), np.std(column, ddof=1)] for name, column in columns.items()}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["mean", "sd"]).rename_axis("group")
    return [ResultTable("runs.groups", frame)] if rows else []


def _groups(run: CapsuleRun, theta: ValuesBySymbol) -> dict[str, float]:
    p, e = run.capsule(theta)
    m1, m2, k1, k2, c, G = (float(leaf) for leaf in (p.m1, p.m2, p.k1, p.k2, p.c, p.G))  # pyright: ignore[reportArgumentType]
    Omega0, F_b = np.sqrt(k1 / m1), float(run.law(theta).forward(0.0))
    length, of, behind = F_b / k1, run.label, run.table.settings.spring_back
    scales = {"N": ("F_b", F_b), "m/s": ("(Omega0 F_b/k1)", Omega0 * length)}
    own = [(row.symbol, *scales[row.unit]) for row in run.friction.parameters if row.unit in scales]
    return {
        "Omega0, rad/s": Omega0,
        "zeta": c / (2.0 * m1 * Omega0),
        "m2/m1": m2 / m1,
        **{f"{symbol} / {scale}": theta[symbol] / value for symbol, scale, value in own},
        f"Omega/Omega0 [{of}]": run.Omega / Omega0,
        f"P_d/F_b [{of}]": float(e.P_d) / F_b,  # pyright: ignore
        **({f"k2/k1 [{run.spring}]": k2 / k1, f"G k1/F_b [{of}]": G / length} if run.spring is not None else {}),
        **(
            {f"k2/k1 [{behind}]": float(p.k2_back) / k1, f"G_back k1/F_b [{of}]": float(p.G_back) / length}  # pyright: ignore
            if behind is not None
            else {}
        ),
    }


def predicted_motion(runs: Sequence[CapsuleRun], fit: Fitted) -> list[ResultTable]:
    """Contacts and mean velocity of the capsule over the record: observed, point fit, 95 % interval of a new record.

    Both velocities come from the estimator of ``capsule_id.records.motion``, the model's at the sample times.
    """
    rows = {run.label: _motion_row(run, fit) for run in runs}
    return [ResultTable("runs.motion", pd.DataFrame.from_dict(rows, orient="index").rename_axis("run"))]


def _motion_row(run: CapsuleRun, fit: Fitted) -> dict[str, object]:
    """Motion of one record: its label, contacts, and mean velocities with the band of a new record."""
    best, seen = run.motion(run.local(fit.values), np), measured_motion(run.table)
    local = [run.local(draw) for draw in fit.draws[:BAND_DRAWS]]
    sample = run.motion(stacked(local), np) if local else None
    evidence, found = seen.evidence, seen.evidence.mean_velocity
    period = evidence.repeat.period if evidence.repeat else None

    def velocity(place: np.ndarray) -> float:
        return 1e3 * fit_mean_velocity(run.time, place, 2.0 * np.pi / evidence.Omega, period).velocity

    sd = 0.0 if found is None or not np.isfinite(found.velocity_sd) else 1e3 * found.velocity_sd
    row: dict[str, object] = {"motion of the record": seen.label, "probability": seen.probability}
    row["contacts, model"] = int(best.contacts)
    if sample is not None:
        low, high = int(np.min(sample.contacts)), int(np.max(sample.contacts))
        row["contacts, draws"] = f"{low}" if low == high else f"{low} to {high}"
    row["mean velocity, model, mm/s"] = velocity(np.asarray(best.X2))
    if sample is not None:
        error = sd * np.random.default_rng(0).standard_normal((ERRORS, 1))
        velocities = error + np.array([velocity(place) for place in np.asarray(sample.X2)])
        row["95 % band, mm/s"] = "{:.4g} to {:.4g}".format(*np.quantile(velocities, ENDS))
    if found is not None:
        row["mean velocity, record, mm/s"] = f"{1e3 * found.velocity:.4g} ± {sd:.2g}"
    return row


# panels: Plot data of a forced run: every channel with its residuals, and the phase portrait.


#: Channels that depend on the motion; the current is the drive itself.
SHOWN = {"x_rel": "x_rel", "x_capsule": "capsule", "acceleration_rod": "rod's acceleration"}


def _portrait(run: CapsuleRun, theta: ValuesBySymbol) -> list[Comparison]:
    """Phase portrait: the record and the fitted motion through one filter; [] for a record sampled unevenly.

    The filter passes the oscillation of the closed contact at the fit, so that contacts show.
    """
    index, column = run.names.index("x_rel"), run.table.columns["x_rel"]
    unit, p = column.to_display, run.capsule(theta)[0]
    offset = run.scaled(theta, np)[index].at_nuisance_mean(np)[1][0] * run.channels[index].width
    sides = column.values, np.asarray(run.motion(theta, np).x_rel) + offset
    try:
        step, fastest = sampling_step(run.time), PASS_BAND_MULTIPLE * dominant_frequency(run.time, sides[1])
        if {run.spring, run.table.settings.spring_back} != {None} and "m1" in theta:
            stiffest = p.k1 + np.maximum(p.k2, p.k2_back)  # pyright: ignore[reportArgumentType]
            fastest = max(fastest, float(np.sqrt(stiffest / p.m1)) / (2.0 * np.pi))  # pyright: ignore[reportArgumentType]
        window = longest_window(fastest * step, len(run.time), FILTER_ORDER, SMALLEST_RATE_GAIN, derivative=1)
        recorded, fitted = (_filtered(run.time, side, window * step) for side in sides)
    except InputError:
        return []
    curves = [Curve("this fit", fitted[0] * unit, fitted[1])]
    stops = (run.spring, "support spring", p.G), (run.table.settings.spring_back, "back spring", -p.G_back)
    for name, of, stop in (one for one in stops if one[0] is not None):
        place = np.full(2, (float(stop) + offset) * unit)  # pyright: ignore[reportArgumentType]
        ends, role = np.array([fitted[1].min(), fitted[1].max()]), "paper" if of == "support spring" else "alternative"
        curves.append(Curve(f"{of} {name}", place, ends, role=role))
    label, points = f"{run.label}_phase_portrait", Points("record", recorded[0] * unit, recorded[1])
    axes = axis_label(column), "rate of x_rel, m/s"
    return [Comparison("phase_portrait", label, f"{run.label}: phase portrait", *axes, (points,), tuple(curves))]


def _filtered(time: np.ndarray, values: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed value and rate, without the half window at both ends, where the derivative is inaccurate."""
    half = window_samples(window, sampling_step(time)) // 2
    inside = slice(half, len(time) - half)
    value, rate = (savitzky_golay(time, values, window, FILTER_ORDER, derivative=n) for n in (0, 1))
    return value[inside], rate[inside]


# runs: Runs by drive. What the paper's protocol and figures take from a harmonic force is left out of the others.


class OtherRun(CapsuleRun):
    """A run with any drive: the checks, tables and panels that need no harmonic force."""

    checks = (check_predictable, check_repeated)
    tables = (predicted_motion,)

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        """Return a panel per channel (prediction, 95 % band, residuals, autocorrelation), then the phase portrait.

        ``theta`` is the point fit. Bands use at most ``BAND_DRAWS`` of ``draws`` and exclude the noise.
        """
        bands = self.predict(stacked(draws[:BAND_DRAWS]), np) if draws else [None] * len(self.channels)
        panels = []
        for channel, part, seen, drawn in zip(
            self.channels, self.scaled(theta, np), self.predict(theta, np), bands, strict=False
        ):
            if channel.name not in SHOWN:
                continue
            column, unit = self.table.columns[channel.name], self.table.columns[channel.name].to_display
            residuals, nuisance = (np.asarray(x) for x in part.at_nuisance_mean(np))
            fitted = channel.values - part.raw + part.design @ nuisance
            # The band represents the uncertainty of the motion: offset and gain of a draw hardly differ from the fit.
            limits = (None, None) if drawn is None else band((drawn + (fitted - seen)) * unit)
            panels.append(
                Comparison(
                    self.kind,
                    f"{self.label}_{channel.name}",
                    f"{self.label}: {SHOWN[channel.name]}",
                    "time, s",
                    axis_label(column),
                    (Points(self.label, self.time, channel.values * unit),),
                    (Curve("this fit", self.time, fitted * unit, *limits),),
                    residuals,
                    autocorrelation(residuals),
                )
            )
        return (*panels, *(_portrait(self, theta) if "x_rel" in self.names else []))


class ForcedRun(OtherRun):
    """A run with a harmonic force."""

    checks = (check_feasible, *OtherRun.checks)
    tables = (*OtherRun.tables, scaled_groups)

    def record_view(self, theta: ValuesBySymbol) -> RunRecord | None:
        """The record through the paper's filter, and its drive; None where x_rel is not recorded, or not evenly."""
        try:
            view = view_record(self.table, K=theta["K"] if "current" in self.names else None)
        except InputError:
            return None
        return RunRecord(self.label, view, np.asarray(self.capsule(theta)[1].force_at(self.time)))


class RecordedRun(OtherRun):
    """One record whose drive is K times the recorded current, linear between the samples.

    The current is taken as recorded: its noise and the phase shift of its filter act as a force on the rod. Noise of
    standard deviation s at n samples per period changes the amplitude of a tone by about s sqrt(2/n), which the noise
    levels of the other channels absorb. An offset of the current is a constant force.

    Attributes
    ----------
    current : (n,) A
    """

    current: np.ndarray

    inputs = ("current",)

    def read_drive(self, table: Table, rig: Rig) -> None:
        self.current = table["current"]

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        force = jnp.multiply.outer(jnp.asarray(theta["K"]), self.current)
        return self.parameters_of(theta), RecordedDrive(self.true_time(theta), force, self.reaction)

    def acceleration(self, theta: ValuesBySymbol, x_rel: Any, rate: Any, xp: ModuleType) -> Any:
        p, K = before_samples((self.parameters_of(theta), theta["K"]), xp)
        return (K * self.current - rod_on_capsule(p, x_rel, rate) - downhill(p, p.m1)) / p.m1


class PulseRun(OtherRun):
    """One record driven by pulses, or a square wave, of stated period, which act since long before the first sample.

    Attributes
    ----------
    off : force between the pulses over that of a pulse, -1 of a square wave
    """

    off: float

    def read_drive(self, table: Table, rig: Rig) -> None:
        self.off = -1.0 if table.settings.drive == SQUARE else 0.0

    def starts(self) -> dict[str, Start]:
        """A pulse begins half the duty, and the delay by its lag, before the force is largest.

        Its phase counts from the first sample.
        """
        starts, of = super().starts(), f"phase[{self.about.record}]"
        s = self.table.settings
        turn = self.Omega * self.first + np.pi * (self.exact.get("duty", 0.5) + (s.P_on.value < 0.0))
        turn += 0.0 if s.lag is None else np.arctan(self.Omega * s.lag.value)
        if of in starts:
            starts[of] = Start(float(np.angle(np.exp(1j * (starts[of].centre + turn)))), starts[of].spread)
        return starts

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        own = {"lag": 0.0, "duty": 0.5, **self.exact, **theta}
        wave = own["P_on"], 2.0 * np.pi / self.Omega, own["duty"], self.off * own["P_on"]
        return self.parameters_of(theta), Pulses(*wave, phase=own["phase"], lag=own["lag"], reaction=self.reaction)

    def drive_time(self, times: Any) -> Any:
        # A lag forgets its start in a few periods.
        return times - self.first + SETTLING_PERIODS * 2.0 * np.pi / self.Omega

    def simulated(
        self, theta: ValuesBySymbol, p: CapsuleParameters, e: Drive, times: ArrayLike, initial: Any = None
    ) -> Trajectory:
        return super().simulated(theta, p, e, self.drive_time(jnp.asarray(times)), initial)


# base run: Runs whose record prescribes the motion of the rod: a shaken base, or a position-controlled inner mass.
#
#     x_base -> X1(t) -> capsule model -> x_capsule, x_rel
#
# Only the equation of the capsule is left. X1 is the cubic spline through x_base, whose own noise is neglected. The
# zeros of x_base and x_capsule are independent, so the extension of the rod's spring at the first sample is
# sampled.


#: Dispersion of the starts of k1, c and mu about their estimates from the record, natural logarithm.
SPREAD = {"k1": 0.05, "c": 0.5, "mu": 0.1}


class BaseRun(OtherRun):
    """One record of a capsule on a spring whose other end moves as recorded.

    Attributes
    ----------
    base, base_rate : (n,) X1 relative to the first sample, m, and its velocity, m/s
    """

    base: np.ndarray
    base_rate: np.ndarray

    prescribed = True

    def read_drive(self, table: Table, rig: Rig) -> None:
        motion = RodMotion.through(table["time"], table["x_base"] - table["x_base"][0])
        self.base, self.base_rate = np.asarray(motion.X1), np.asarray(motion.Y1)

    @property
    def masses(self) -> tuple[str, ...]:
        # The rod's mass acts through the normal force alone.
        return ("m2",) if NORMAL_FORCE in self.exact or self.rig.m1 is None else ("m1", "m2")

    def first_state(self, table: Table) -> RunStart:
        relative = relative_position(table)
        assert relative is not None, "the reader requires x_capsule or x_rel beside x_base"
        # Friction is about as strong in both directions, so the spring is unextended near the mean.
        seen = {name: table[name] for name in self.names} | {"x_rel": relative[0] - np.mean(relative[0])}
        return rough_start(table["time"], seen, self.Omega)

    def starts(self) -> dict[str, Start]:
        """Starts as of any run, and those of spring, damper and friction from the slides of the record."""
        starts, relative = super().starts(), relative_position(self.table)
        if relative is None or self.rig.m2 is None or self.spring is not None:
            return starts
        r = relative[0] - np.mean(relative[0])
        found = slides(self.time, r, self.table["x_base"] - relative[0], 2.0 * np.pi / self.Omega, self.rig.m2.value)
        if found is None:
            return starts
        m1 = 0.0 if self.rig.m1 is None else self.rig.m1.value
        masses = {"m1": m1, "m2": self.rig.m2.value, "g": self.rig.g.value}
        per_mu = self.law({**masses, **self.stated_ground, "mu": 1.0, "mu_back": 1.0}).forward(found["speed"])
        values = {"k1": found["k1"], "c": found["c"], "mu": found["friction"] / float(per_mu)}
        starts |= {name: Start(value, SPREAD[name]) for name, value in values.items()}
        at_first = f"x_start[{self.label}]"
        return starts | {at_first: Start(float(r[0]) + found["extension"], starts[at_first].spread)}

    def law(self, theta: ValuesBySymbol) -> FrictionLaw:
        return super().law({"m1": 0.0, **theta})

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Any]:
        X1, time = jnp.add.outer(theta["x_start"], self.base), self.true_time(theta)
        rate = jnp.multiply.outer(1.0 / stretch(self.clock and self.clock[0], theta), self.base_rate)
        return self.parameters_of({"m1": 0.0, **theta}), RodMotion(time, X1, rate)
