"""Likelihood of forced runs: the motor drives the capsule (paper, sections 3 and 4)."""

from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from capsule_id.errors import InputError
from capsule_id.experiments.base import Start, ValuesBySymbol, axis_label, band, clock_parameters, stated_rate, stretch
from capsule_id.experiments.capsule_experiment import CapsuleForward
from capsule_id.experiments.checks import autocorrelation
from capsule_id.experiments.context import Fitted, RunRecord
from capsule_id.experiments.forced_run.checks import (
    check_feasible,
    check_predictable,
    check_repeated,
    predictable_parts,
)
from capsule_id.experiments.forced_run.declaration import CAPSULE_START, CORRELATION, CURRENT_AMPLITUDE, NOISE
from capsule_id.experiments.forced_run.start_state import (
    PARABOLA_SAMPLES,
    AboutRun,
    RunStart,
    corrected_start,
    rough_start,
)
from capsule_id.experiments.friction_model import EQUATION_1, NORMAL_FORCE, FrictionModel, ground_of, ground_parameters
from capsule_id.experiments.misfit import NUISANCE_WIDTH, Misfit, innovations
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.physics.drive import Drive, Excitation
from capsule_id.physics.forces import equilibrium, rod_acceleration
from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Trajectory
from capsule_id.records.motion import MeasuredMotion, fit_mean_velocity, measured_motion
from capsule_id.records.tones import stated_gap, stated_Omega
from capsule_id.records.view import view_record
from capsule_id.rig.filters import choose_window, sampling_step, savitzky_golay, window_samples
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import SHORTEST_RECORD
from capsule_id.views import Comparison, Curve, Facts, Finding, Points, ResultTable

# parts: Multiple shooting: division of a record into parts, each with its own initial state.
#
# Where a motion amplifies small errors, one initial state cannot predict a whole record. It can predict a part of a few
# periods. All parts share gap, drive, noise and delays.


#: Separator between record label and number in the label of a part. File names do not contain it.
PART_MARK = "~"
#: Largest shift of a cut towards smooth motion, as a fraction of a part's length.
LEEWAY = 0.3


def parts_of(table: Table, seconds: float) -> list[Table]:
    """Divide the record into parts of about ``seconds``; return [``table``] if it is not longer."""
    time = table["time"]
    count = max(1, min(round((time[-1] - time[0]) / seconds), len(time) // SHORTEST_RECORD))
    if count == 1:
        return [table]
    edges = _edges(table, count)
    return [_part(table, i, slice(*edges[i : i + 2])) for i in range(count)]


def _edges(table: Table, count: int) -> list[int]:
    """First samples of ``count`` parts, and the end.

    The state at a first sample comes from a parabola through the next samples. A cut therefore avoids samples where a
    contact begins or ends, or where the capsule sticks or slips.
    """
    samples = len(table["time"])
    length, rough = samples / count, _roughness(table)
    edges = [0]
    for i in range(1, count):
        first, last = (int((i + side * LEEWAY) * length) for side in (-1.0, 1.0))
        window = rough[max(first, edges[-1] + SHORTEST_RECORD) : last + 1]
        edges.append(
            max(first, edges[-1] + SHORTEST_RECORD) + int(np.argmin(window)) if len(window) else int(i * length)
        )
    return [*edges, samples]


def _roughness(table: Table) -> np.ndarray:
    """(n,) residual of a parabola through the samples from each one on, summed over positions, in units of noise."""
    time, n = table["time"], PARABOLA_SAMPLES
    total = np.zeros(len(time))
    # One projection serves all samples. It is approximate for uneven sampling, which suffices to choose a cut.
    design = np.vander(np.arange(n) - 0.5 * (n - 1), 3)
    rest = np.eye(n) - design @ np.linalg.pinv(design)
    for name in ("x_rel", "x_capsule"):
        if name in table.columns and len(time) >= n:
            windows = np.lib.stride_tricks.sliding_window_view(table[name], n)
            miss = np.sqrt(np.sum((windows @ rest) ** 2, axis=1))
            total[: len(miss)] += miss / max(float(np.median(miss)), 1e-300)
            total[len(miss) :] = np.inf
    return total


def _part(table: Table, index: int, rows: slice) -> Table:
    columns = {name: replace(column, values=column.values[rows]) for name, column in table.columns.items()}
    return replace(table, label=f"{table.label}{PART_MARK}{index + 1}", columns=columns, rows=table.rows[rows])


# nuisances: Parameters of a forced run with their priors and starting values.


#: Default prior of a channel's noise, without reading error: log-normal, median 1 % of its range, factor 100.
NOISE_MEDIAN, NOISE_FACTOR = 0.01, 100.0
#: Default prior of the current's amplitude: log-normal about half its range.
AMPLITUDE_FACTOR = 3.0
#: sd of the normal prior of the drive's phase, rad; wide but proper.
PHASE_WIDTH = np.pi


def run_parameters(run: "ForcedRun", ranges: np.ndarray) -> tuple[Parameter, ...]:
    """Return the parameters sampled for ``run``; ``ranges`` (channels,) of its readings, SI."""
    of, whole, settings = run.label, run.about.record, run.table.settings
    rows = [parameter("k1"), parameter("c"), *run.friction.parameters, *ground_parameters(run.table, run.rig)]
    free = ("k_cubic",) if run.spring is None else ("k_cubic", "c2")
    rows += [parameter(symbol) for symbol in free if symbol in run.rig.model.free]
    rows += clock_parameters(run.table, run.rig)
    if run.spring is not None:
        rows.append(parameter("k2", run.spring))
    if not run.gap_known:
        rows.append(parameter("G", whole, Prior("positive_normal", settings.gap.value, settings.gap.sd)))
    if run.driven_by_current:
        amplitude = 0.5 * float(np.ptp(run.table["current"]))
        rows += [parameter("K"), CURRENT_AMPLITUDE.named(whole, Prior("lognormal", amplitude, AMPLITUDE_FACTOR))]
    elif not run.drive_known:
        rows.append(parameter("P_d", whole, Prior("positive_normal", run.drive, run.drive_sd)))
    if "current" in run.inputs:
        rows.append(parameter("K"))
    if settings.P_on is not None and settings.P_on.sd > 0.0:
        rows.append(parameter("P_on", prior=Prior("normal", settings.P_on.value, settings.P_on.sd)))
    if settings.lag is not None and settings.lag.sd > 0.0:
        rows.append(parameter("lag", prior=Prior("positive_normal", settings.lag.value, settings.lag.sd)))
    elif settings.drive == "pulses" and settings.lag is None and "lag" in run.rig.model.free:
        rows.append(parameter("lag"))
    if run.has_phase and not run.prescribed:
        rows.append(parameter("phase", whole, Prior("normal", 0.0, PHASE_WIDTH)))
    length = NUISANCE_WIDTH * run.rough.length
    if not run.settled:
        rows.append(parameter("x_start", of, Prior("normal", 0.0, length)))
        if not run.prescribed:
            rows.append(parameter("y_start", of, Prior("normal", 0.0, run.Omega * length)))
    if run.moves:
        rows.append(CAPSULE_START.named(of, Prior("normal", 0.0, run.Omega * length)))
    for name, scale in zip(run.channels, ranges.tolist(), strict=True):
        rows.append(NOISE[name].named(whole, Prior("lognormal", NOISE_MEDIAN * scale, NOISE_FACTOR)))
    if run.coloured:
        rows += [CORRELATION[name].named(whole) for name in run.channels]
    return tuple(rows)


def run_starts(run: "ForcedRun") -> dict[str, Start]:
    """Starts of the nuisances from the record; other parameters start at bench estimates or prior centres."""
    rough, of = run.rough, run.label
    starts = _starts_of_record(run) if run.about.leads else {}
    if not run.settled:
        starts[f"x_start[{of}]"] = Start(rough.x_rel, 0.03 * rough.length)
        starts[f"y_start[{of}]"] = Start(rough.rate, 0.03 * run.Omega * rough.length)
    if run.moves:
        starts[f"capsule_start[{of}]"] = Start(rough.capsule_rate, 0.03 * run.Omega * rough.length)
    return starts


def _starts_of_record(run: "ForcedRun") -> dict[str, Start]:
    rough, of = run.rough, run.about.record
    starts = {f"phase[{of}]": Start(rough.phase, 0.02)}
    if not run.gap_known:
        starts[f"G[{of}]"] = Start(run.gap, 0.5 * run.table.settings.gap.sd / run.gap)
    if run.driven_by_current:
        starts[f"I_d[{of}]"] = Start(rough.amplitude, 0.005)
    elif not run.drive_known:
        starts[f"P_d[{of}]"] = Start(run.drive, 0.5 * run.drive_sd / run.drive)
    for name, noise in rough.noise.items():
        starts[f"noise_{name}[{of}]"] = Start(noise, 0.1)
    if run.coloured:
        starts |= {f"ar1_{name}[{of}]": Start(0.0, 0.1) for name in run.channels}
    return starts


def stated_sds(settings: Any, channels: Sequence[str], nuisance: str) -> tuple[np.ndarray, tuple[bool, ...]]:
    """Stated sd of a gain or delay by channel, and whether it is stated."""
    sds = [getattr(settings, f"{name}_{nuisance}_sd") for name in channels]
    return np.array([sd or 0.0 for sd in sds]), tuple(sd is not None for sd in sds)


# tables: Tables of forced runs: nondimensional groups and predicted motion.


#: Draws at which velocities are computed, and errors of a record's velocity drawn for each.
VELOCITY_DRAWS, ERRORS = 50, 200


def scaled_groups(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[ResultTable]:
    """Return the paper's nondimensional groups, mean and sd over the posterior draws; [] without a sample.

    Lengths are scaled by F_b/k1, forces by F_b, times by 1/Omega0. Omega0 = sqrt(k1/m1); F_b is the break-away force.
    """
    if not fit.draws:
        return []
    columns: dict[str, list[float]] = {}
    for values in fit.draws:
        for run in runs:
            for name, value in _groups(run, run.local(values)).items():
                columns.setdefault(name, []).append(value)
    rows = {name: [np.mean(column), np.std(column, ddof=1)] for name, column in columns.items()}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["mean", "sd"]).rename_axis("group")
    return [ResultTable("runs.groups", frame)]


def _groups(run: "ForcedRun", theta: ValuesBySymbol) -> dict[str, float]:
    p, e = run.capsule(theta)
    m1, m2, k1, k2, c, G = (float(leaf) for leaf in (p.m1, p.m2, p.k1, p.k2, p.c, p.G))  # pyright: ignore[reportArgumentType]
    Omega0, F_b = np.sqrt(k1 / m1), float(run.law(theta).forward(0.0))
    length, of = F_b / k1, run.label
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
    }


def predicted_motion(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[ResultTable]:
    """Contacts and mean velocity of the capsule over the record: observed, point fit, 95 % interval of a new record.

    Both velocities come from the estimator of ``capsule_id.records.motion``, the model's at the sample times.
    """
    rows = {}
    for run in runs:
        best = run.motion(run.local(fit.values), np)
        local = [run.local(draw) for draw in fit.draws[:VELOCITY_DRAWS]]
        stacked = {name: np.array([theta[name] for theta in local]) for name in (local[0] if local else {})}
        sample = run.motion(stacked, np) if local else None
        seen = measured_motion(run.table)
        row: dict[str, object] = {
            "motion of the record": seen.label,
            "probability": seen.probability,
            "contacts, model": int(best.contacts),
        }
        if sample is not None:
            low, high = int(np.min(sample.contacts)), int(np.max(sample.contacts))
            row["contacts, draws"] = f"{low}" if low == high else f"{low} to {high}"
        row |= _velocities(run, seen, np.asarray(best.X2), None if sample is None else np.asarray(sample.X2))
        rows[run.label] = row
    frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("run")
    return [ResultTable("runs.motion", frame)]


def _velocities(
    run: "ForcedRun", seen: MeasuredMotion, best: np.ndarray, sample: np.ndarray | None
) -> dict[str, object]:
    """Mean velocity of the model, band of a new record, and the record's own with its standard error.

    Parameters
    ----------
    best, sample : X2 of the point fit (n,) and of the draws (draws, n), m
    """
    evidence = seen.evidence
    period = evidence.repeat.period if evidence.repeat else None

    def velocity(place: np.ndarray) -> float:
        return 1e3 * fit_mean_velocity(run.time, place, 2.0 * np.pi / evidence.Omega, period).velocity

    found = evidence.mean_velocity
    sd = 0.0 if found is None or not np.isfinite(found.velocity_sd) else 1e3 * found.velocity_sd
    row: dict[str, object] = {"mean velocity, model, mm/s": velocity(best)}
    if sample is not None:
        error = sd * np.random.default_rng(0).standard_normal((ERRORS, 1))
        low, high = np.quantile(error + np.array([velocity(place) for place in sample]), [0.025, 0.975])
        row["95 % band, mm/s"] = f"{low:.4g} to {high:.4g}"
    if found is not None:
        row["mean velocity, record, mm/s"] = f"{1e3 * found.velocity:.4g} ± {sd:.2g}"
    return row


# panels: Plot data of a forced run: every channel with its residuals, and the phase portrait.


#: Channels that depend on the motion; the current is the drive itself.
SHOWN = {"x_rel": "x_rel", "x_capsule": "capsule", "acceleration_rod": "rod's acceleration"}
#: Largest number of posterior draws for a band; number of lags of an autocorrelation.
BAND_DRAWS, LAGS = 50, 60
#: Polynomial order of the Savitzky–Golay filter for the measured phase portrait.
PORTRAIT_ORDER = 3


def run_comparisons(run: "ForcedRun", theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
    """Return a panel per channel (prediction, 95 % band, residuals, autocorrelation), then the phase portrait.

    ``theta`` is the point fit. Bands use at most ``BAND_DRAWS`` of ``draws`` and exclude the noise.
    """
    predicted = run.predict(theta, np)
    scaled = run.scaled(theta, np)
    stacked = {name: np.array([draw[name] for draw in draws[:BAND_DRAWS]]) for name in (draws[0] if draws else {})}
    bands = run.predict(stacked, np) if draws else []
    panels = []
    for i, name in enumerate(run.channels):
        if name not in SHOWN:
            continue
        column, part = run.table.columns[name], scaled[i]
        residuals, nuisance = part.at_nuisance_mean(np)
        fitted = run.values[i] - part.raw + part.design @ nuisance
        # The band represents the uncertainty of the motion: offset and gain of a draw hardly differ from the fit.
        shift = fitted - predicted[i]
        lower, upper = band((bands[i] + shift) * column.to_display) if draws else (None, None)
        panels.append(
            Comparison(
                run.kind,
                f"{run.label}_{name}",
                f"{run.label}: {SHOWN[name]}",
                "time [s]",
                axis_label(column),
                (Points(run.label, run.time, run.values[i] * column.to_display),),
                (Curve("this fit", run.time, fitted * column.to_display, lower, upper),),
                run.time,
                np.asarray(residuals),
                autocorrelation(np.asarray(residuals), min(LAGS, len(run.time) // 4)),
                1.96 / float(np.sqrt(len(run.time))),
            )
        )
    if "x_rel" in run.channels:
        panels += _portrait(run, theta)
    return tuple(panels)


def _portrait(run: "ForcedRun", theta: ValuesBySymbol) -> list[Comparison]:
    """Phase portrait, rate of x_rel by Savitzky–Golay against x_rel; [] for a record sampled unevenly."""
    index = run.channels.index("x_rel")
    values, unit = run.values[index], run.table.columns["x_rel"].to_display
    motion = run.motion(theta, np)
    offset = run.scaled(theta, np)[index].at_nuisance_mean(np)[1][0] * run.widths[index]
    x, y = np.asarray(motion.x_rel) + offset, np.asarray(motion.Y1 - motion.Y2)
    try:
        window = choose_window(run.time, values, PORTRAIT_ORDER)
        recorded, fitted = (_filtered(run.time, column, window) for column in (values, x))
    except InputError:
        return []
    p, _ = run.capsule(theta)
    lines = []
    if run.spring is not None:
        gap = (float(p.G) + offset) * unit  # pyright: ignore[reportArgumentType]
        ends = np.array([y.min(), y.max()])
        lines.append(Curve("support spring", np.array([gap, gap]), ends, role="paper"))
    return [
        Comparison(
            "phase_portrait",
            f"{run.label}_phase_portrait",
            f"{run.label}: phase portrait",
            axis_label(run.table.columns["x_rel"]),
            "rate of x_rel [m/s]",
            (Points("record, Savitzky–Golay", recorded[0] * unit, recorded[1]),),
            (
                Curve("this fit", x * unit, y),
                Curve("this fit through the same filter", fitted[0] * unit, fitted[1], role="alternative"),
                *lines,
            ),
        )
    ]


def _filtered(time: np.ndarray, values: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed value and rate, without the half window at both ends, where the derivative is inaccurate."""
    half = window_samples(window, sampling_step(time)) // 2
    inside = slice(half, len(time) - half)
    value, rate = (savitzky_golay(time, values, window, PORTRAIT_ORDER, derivative=n) for n in (0, 1))
    return value[inside], rate[inside]


def filtered_record(run: "ForcedRun", theta: ValuesBySymbol) -> RunRecord | None:
    """The record through the paper's filter, and its drive; None where x_rel is not recorded, or not evenly."""
    _, e = run.capsule(theta)
    try:
        view = view_record(run.table, K=theta["K"] if run.driven_by_current else None)
    except InputError:
        return None
    return RunRecord(run.label, view, np.asarray(e.force_at(run.time)))


# second fit: Second fits of a run, where the residuals of the first one are correlated: starts of coloured noise, and
# tables.
#
# A real sensor filters, and no model is exact, so that residuals of dense samples are hardly ever white. White
# noise then gives intervals that are far too short.


#: Largest lag-1 correlation of the noise at which a fit starts.
LARGEST_CORRELATION = 0.99


def coloured_starts(run: "ForcedRun", theta: ValuesBySymbol) -> dict[str, float]:
    """Starts of the AR(1) noise of ``run`` by name, SI, from the residuals of a fit with white noise."""
    values = {}
    for name, (_, residuals) in zip(run.channels, run.records(theta), strict=True):
        rho = float(np.clip(autocorrelation(residuals, 1)[0], 0.0, LARGEST_CORRELATION))
        values[f"ar1_{name}[{run.about.record}]"] = float(np.arctanh(rho))
        values[f"noise_{name}[{run.about.record}]"] = theta[f"noise_{name}"] * float(np.sqrt(1.0 - rho**2))
    return values


def second_fit_table(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[ResultTable]:
    """Tables of the second fits of runs: coloured noise, and other friction laws; [] without one."""
    del runs
    found = {finding.code: finding.facts for finding in fit.findings}
    tables = {"runs.second_fit": "fits", "runs.laws": "laws"}
    return [
        ResultTable(code, pd.DataFrame(found[code][rows]).set_index("fit"))
        for code, rows in tables.items()
        if code in found
    ]


# experiment: Likelihood of forced runs: the motor drives the capsule (paper, sections 3 and 4).
#
#     theta -> capsule model from the first sample on -> channels -> misfit of each channel
#
# The recorded channels (x_rel, x_capsule, acceleration_rod, current) are independent given the motion. Each has its own
# noise, and an offset that enters linearly and is integrated out. A gain and, to first order, a delay are integrated
# out too where their sd is stated. X2 = 0 at the first sample, because the offset of x_capsule is free.


#: Excitation periods from rest after which the motion counts as periodic (start = "settled").
SETTLING_PERIODS = 40


class ForcedRun(CapsuleForward):
    """One record of the driven capsule.

    The setting ``start`` in rig.toml selects the initial state: "stuck" (capsule at rest and held: Y2 = 0), "moving"
    (Y2 sampled too), "settled" (the periodic motion reached from rest), or "auto". "auto" estimates stuck or moving
    from the record.

    The drive is K times the recorded current, whose amplitude and phase are sampled. Without a current it is the
    stated P_d. Where both exist, P_d is a second reading of the same amplitude.

    Each part of a record (``parts``) has its own initial state and offsets. All parts share gap, drive, noise and
    delays.

    Attributes
    ----------
    time, values : (n,) s and (channels, n) SI
    widths : (channels,) sds of the offsets' priors, SI
    gain_sd, delay_sd : (channels,) stated, 1 and s
    reading_variance : (channels,) stated, SI
    moves : factor of ``capsule_start``, 0 or 1, so that one program computes runs of both kinds
    normal_force : stated, N; 0 where it is the weight
    first : time of the first sample of the whole record, s
    clock_rate, middle : 1 + the stated drift of the clock, and the middle of the whole record, s; None: an exact clock
    reaction : share of the drive's force that pushes the capsule back, 1
    """

    about: AboutRun = eqx.field(static=True)
    time: np.ndarray
    values: np.ndarray
    Omega: float
    gap: float
    drive: float
    drive_sd: float
    widths: np.ndarray
    gain_sd: np.ndarray
    delay_sd: np.ndarray
    reading_variance: np.ndarray
    moves: float
    normal_force: float
    clock_rate: float | None
    middle: float | None
    first: float
    channels: tuple[str, ...] = eqx.field(static=True)
    settled: bool = eqx.field(static=True)
    gap_known: bool = eqx.field(static=True)
    drive_known: bool = eqx.field(static=True)
    normal_force_stated: bool = eqx.field(static=True)
    has_gain: tuple[bool, ...] = eqx.field(static=True)
    has_delay: tuple[bool, ...] = eqx.field(static=True)
    coloured: bool = eqx.field(static=True)
    second_reading: bool = eqx.field(static=True)
    reaction: float = eqx.field(static=True)

    #: Whether the record prescribes the motion of the rod.
    prescribed: ClassVar[bool] = False
    #: Whether the phase of the drive is a parameter, and channels that are inputs, not readings.
    has_phase: ClassVar[bool] = True
    inputs: ClassVar[tuple[str, ...]] = ()
    time_series = True
    checks = (check_feasible, check_predictable, check_repeated)
    tables = (second_fit_table, predicted_motion, scaled_groups)

    def __init__(
        self,
        table: Table,
        rig: Rig,
        friction: FrictionModel = EQUATION_1,
        part_of: str | None = None,
        leads: bool = True,
        capsule_rate: float | None = None,
        coloured: bool = False,
    ) -> None:
        """Make one record, or a part of one.

        Parameters
        ----------
        part_of : label of the record; None: the table is a whole record
        leads : False for later parts of a record. The kind of their initial state is estimated again. A P_d that is a
            second reading of the current's amplitude counts in the first part only.
        capsule_rate : speed of the capsule at the first sample, m/s, 0 for stuck; None: as stated, or estimated
        coloured : whether the noise is AR(1), also where the settings leave it open
        """
        self.read_drive(table)
        settings, gap = table.settings, stated_gap(table)
        self.friction, self.smoothing, self.ground = friction, None, ground_of(table)
        self.reaction = rig.model.share_of_reaction
        self.channels = tuple(name for name in NOISE if name in table.columns and name not in self.inputs)
        self.time = table["time"]
        self.clock_rate = stated_rate(table)
        whole = next((other for other in rig.tables if other.label == part_of), table)["time"]
        self.first = float(whole[0])
        self.middle = None if self.clock_rate is None else 0.5 * float(whole[0] + whole[-1])
        self.values = np.stack([table[name] for name in self.channels])
        self.Omega = stated_Omega(table)
        self.gap, self.gap_known = gap.value, gap.sd == 0.0
        drive = settings.P_d if leads or not self.driven_by_current else None
        self.drive, self.drive_sd = (0.0, 0.0) if drive is None else (drive.value, drive.sd)
        self.drive_known = drive is None or drive.sd == 0.0
        self.normal_force_stated = settings.normal_force is not None
        self.normal_force = settings.normal_force or 0.0
        reading_sd = np.array([table.columns[name].reading_sd for name in self.channels])
        self.reading_variance = reading_sd**2
        # A constant channel has zero range, so its scale is the reading error, or 1e-9 in SI units.
        ranges = np.maximum(np.ptp(self.values, axis=1), np.maximum(reading_sd, 1e-9))
        self.widths = NUISANCE_WIDTH * ranges
        self.gain_sd, self.has_gain = stated_sds(settings, self.channels, "gain")
        self.delay_sd, self.has_delay = stated_sds(settings, self.channels, "delay")
        self.second_reading = self.driven_by_current and self.drive_sd > 0.0
        self.coloured = coloured or settings.noise == "ar1"
        rough = self.first_state(table).at_rate(capsule_rate)
        is_open = settings.start == "auto" or not leads
        start = rough.kind if is_open else settings.start
        self.settled = start == "settled"
        self.moves = float(start == "moving")
        self.about = AboutRun(table, rig, (), part_of or table.label, leads, start, is_open, rough)
        self.about = replace(self.about, parameters=run_parameters(self, ranges))

    def read_drive(self, table: Table) -> None:
        """Set the fields that a subclass has besides those of this class; ``__init__`` calls it first."""

    def first_state(self, table: Table) -> RunStart:
        """Starting values from the record."""
        return rough_start(table["time"], {name: table[name] for name in self.channels}, self.Omega)

    @classmethod
    def make(cls, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> "tuple[ForcedRun, ...]":
        """Make a run, or its parts where ``segment`` is stated."""
        run, seconds = cls(table, rig, friction), table.settings.segment
        return (run,) if seconds is None else run.parts(seconds)

    def parts(self, seconds: float) -> "tuple[ForcedRun, ...]":
        """Divide the record into parts of about ``seconds``; return the run itself if it is not longer."""
        tables = parts_of(self.table, seconds)
        made = (self._remade(table, self.about.leads and i == 0) for i, table in enumerate(tables))
        return tuple(made) if len(tables) > 1 else (self,)

    def restarted(self, capsule_rate: float) -> "ForcedRun":
        """Return the same record with this capsule speed at the first sample, m/s; 0: stuck."""
        return self._remade(self.table, self.about.leads, capsule_rate)

    def with_friction(self, friction: FrictionModel) -> "ForcedRun":
        return self._remade(self.table, self.about.leads, self.rough.capsule_rate, friction=friction)

    def _remade(self, table: Table, leads: bool, rate: float | None = None, **changed: Any) -> "ForcedRun":
        own = {"friction": self.friction, "part_of": self.about.record, "coloured": self.coloured, **changed}
        return type(self)(table, self.rig, leads=leads, capsule_rate=rate, **own).with_smoothing(self.smoothing)

    def noise_facts(self) -> Facts:
        noise = "ar1" if self.coloured else self.table.settings.noise
        return {**super().noise_facts(), "noise": noise, "spring": self.spring is not None}

    @property
    def shares_noise(self) -> str:
        return self.about.record

    def with_coloured_noise(self, theta: ValuesBySymbol) -> "tuple[ForcedRun, dict[str, float]] | None":
        if self.coloured or self.table.settings.noise is not None:
            return None
        leads, rate = self.about.leads, self.rough.capsule_rate
        return self._remade(self.table, leads, rate, coloured=True), coloured_starts(self, theta)

    @property
    def excitation_period(self) -> float | None:
        return 2.0 * np.pi / self.Omega

    @property
    def rough(self) -> RunStart:
        return self.about.rough

    @property
    def spring(self) -> str | None:
        return self.table.settings.spring

    @property
    def driven_by_current(self) -> bool:
        return "current" in self.channels

    @property
    def observed(self) -> np.ndarray:
        """Readings channel by channel, then the stated P_d where the current is recorded too, SI."""
        return np.concatenate([*self.values, [self.drive]] if self.second_reading else self.values)

    @property
    def scatters(self) -> tuple[str | None, ...]:
        own: tuple[str | None, ...] = tuple(f"noise_{name}" for name in self.channels)
        return (*own, None) if self.second_reading else own

    def starts(self) -> dict[str, Start]:
        return run_starts(self)

    # -- the motion and its recorded channels -----------------------------------------------------------------------

    def law(self, theta: ValuesBySymbol) -> FrictionLaw:
        return super().law({**theta, NORMAL_FORCE: self.normal_force} if self.normal_force_stated else theta)

    def capsule(self, theta: ValuesBySymbol) -> tuple[CapsuleParameters, Drive]:
        """Return parameters and drive of this run; leaves as in ``theta``."""
        stated: Any = self.drive if self.drive_known else theta.get("P_d")
        force = theta["K"] * theta["I_d"] if self.driven_by_current else stated
        return self.with_spring(theta), Excitation(force, self.Omega, theta["phase"], self.reaction)

    def with_spring(self, theta: ValuesBySymbol) -> CapsuleParameters:
        """Parameters at ``theta`` with the support spring of this run; k2 = 0 where there is none."""
        return self.parameters_of(theta, theta.get("k2", 0.0), self.gap if self.gap_known else theta["G"])

    def true_time(self, theta: ValuesBySymbol) -> Any:
        """Times of the samples (..., n), s, with the drift of the clock at ``theta``."""
        if self.middle is None:
            return self.time
        # About the middle of the record the drift is nearly independent of the phase.
        return self.middle + jnp.multiply.outer(stretch(self.clock_rate, theta), self.time - self.middle)

    def motion(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Trajectory:
        """Simulate the motion at the samples (n,), X2 = 0 at the first."""
        p, e = self.capsule(theta)
        time = self.true_time(theta)
        if self.settled:
            early = time[..., :1] - SETTLING_PERIODS * 2.0 * np.pi / self.Omega
            rest = (equilibrium(p), 0.0, 0.0, 0.0) if "slope" in self.ground else None
            run = self.simulated(theta, p, e, xp.concatenate([early, time], axis=-1), rest)
            settled = {name: getattr(run, name)[1:] for name in ("times", "X1", "Y1", "X2", "Y2")}
            X2 = settled["X2"][0]
            return replace(run, **settled | {"X1": settled["X1"] - X2, "X2": settled["X2"] - X2})
        Y2 = self.moves * theta.get("capsule_start", 0.0) + 0.0 * theta["x_start"]
        initial = (theta["x_start"], theta.get("y_start", 0.0) + Y2, 0.0, Y2)
        return self.simulated(theta, p, e, time, initial)

    def predict(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> list[Any]:
        """Predict noise-free channels (n,), without offsets and gains, in the order of ``channels``.

        Concrete values in ``theta`` may have a batch axis (draws,); the result is then (draws, n).
        """
        run = self.motion(theta, xp)
        x_rel, rate = xp.asarray(run.X1 - run.X2), xp.asarray(run.Y1 - run.Y2)

        seen: list[Any] = []
        for name in self.channels:
            if name == "x_rel":
                seen.append(x_rel)
            elif name == "x_capsule":
                seen.append(xp.asarray(run.X2))
            elif name == "acceleration_rod":
                seen.append(self.acceleration(theta, x_rel, rate, xp))
            else:
                # A batch axis of the leaves precedes the axis of the samples.
                e, I_d = jax.tree.map(lambda leaf: xp.asarray(leaf)[..., None], (self.capsule(theta)[1], theta["I_d"]))
                assert isinstance(e, Excitation), "a current belongs to a harmonic drive"
                seen.append(I_d * e.cosine(self.true_time(theta)))
        return seen

    def acceleration(self, theta: ValuesBySymbol, x_rel: Any, rate: Any, xp: ModuleType) -> Any:
        """Acceleration of the rod at the samples, m/s^2, from x_rel (..., n), m, and its rate."""
        p, e = jax.tree.map(lambda leaf: xp.asarray(leaf)[..., None], self.capsule(theta))
        return rod_acceleration(p, e, self.true_time(theta), x_rel, rate)

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        parts = []
        for i, (name, seen) in enumerate(zip(self.channels, self.predict(theta, xp), strict=True)):
            columns = [self.widths[i] * xp.ones(len(self.time))]
            if self.has_gain[i]:
                columns.append(self.gain_sd[i] * seen)
            if self.has_delay[i]:
                # First order in the delay suffices, because the delay is shorter than a sampling step.
                columns.append(-self.delay_sd[i] * xp.gradient(seen) / xp.gradient(xp.asarray(self.time)))
            raw, design = self.values[i] - seen, xp.stack(columns, axis=1)
            if self.coloured:
                parts.append(innovations(raw, self.reading_variance[i], design, xp.tanh(theta[f"ar1_{name}"]), xp))
            else:
                parts.append(Misfit(raw, self.reading_variance[i], 1.0, design))
        if self.second_reading:
            raw = self.drive - theta["K"] * theta["I_d"]
            parts.append(Misfit(xp.reshape(raw, (1,)), self.drive_sd**2, 0.0, xp.zeros((1, 0))))
        return tuple(parts)

    # -- interface to the fit, the checks and the report -------------------------------------------------------------

    def predictable_parts(self, theta: ValuesBySymbol) -> "tuple[tuple[ForcedRun, ...], list[Finding]]":
        return predictable_parts(self, theta)

    def corrected_start(self, theta: ValuesBySymbol) -> "tuple[ForcedRun, dict[str, float]] | None":
        return corrected_start(self, theta)

    def excess_noise(self, theta: ValuesBySymbol) -> float:
        # A record alone does not determine the level of coloured noise.
        if self.coloured:
            return 0.0
        shown = [max(self.rough.noise[name], self.table.columns[name].reading_sd) for name in self.channels]
        return max(float(theta[f"noise_{name}"]) / sd for name, sd in zip(self.channels, shown, strict=True))

    def record_view(self, theta: ValuesBySymbol) -> RunRecord | None:
        return filtered_record(self, theta)

    def records(self, theta: ValuesBySymbol) -> list[tuple[str, np.ndarray]]:
        parts = zip(self.channels, self.scaled(theta, np), strict=False)  # a second reading of P_d is no record
        return [(f"{self.label} {name}", np.asarray(part.at_nuisance_mean(np)[0])) for name, part in parts]

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        return self.comparisons(theta, draws)[0]

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        return run_comparisons(self, theta, draws)
