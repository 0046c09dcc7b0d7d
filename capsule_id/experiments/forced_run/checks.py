"""What the report says of fitted runs: feasible settings, predictable and repeating motions; tables and panels."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from capsule_id.errors import InputError
from capsule_id.experiments.base import ValuesBySymbol, axis_label, band
from capsule_id.experiments.checks import LEVEL, autocorrelation
from capsule_id.experiments.context import Fitted, RunRecord
from capsule_id.experiments.forced_run.experiment import LARGEST_GROWTH, CapsuleRun, growth
from capsule_id.experiments.forced_run.feasibility import RunConditions, feasibility
from capsule_id.physics.drive import Excitation
from capsule_id.physics.model import Status
from capsule_id.records.motion import fit_mean_velocity, measured_motion
from capsule_id.records.view import view_record
from capsule_id.rig.filters import choose_window, sampling_step, savitzky_golay, window_samples
from capsule_id.views import Comparison, Curve, Finding, Points, ResultTable


def check_feasible(runs: Sequence[CapsuleRun], fit: Fitted) -> list[Finding]:
    """Check that the settings of every run allow it to determine its parameters, at the point fit."""
    findings = []
    # The rule for contact and slip of a run from rest holds on level ground.
    for run in (run for run in runs if not run.ground):
        theta = run.local(fit.values)
        p, e = run.capsule(theta)
        assert isinstance(e, Excitation), "only runs with a harmonic force declare this check"
        conditions = RunConditions(run.Omega, float(e.P_d), float(p.G))  # pyright: ignore[reportArgumentType]
        findings += feasibility(run.table, theta, float(run.law(theta).forward(0.0)), conditions)
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


#: Largest number of harmonics of the excitation; fewest samples of a period for each of them.
HARMONICS, SAMPLES_PER_HARMONIC = 10, 4
#: Fewest whole periods of a record: in fewer ones a slow error of the noise looks like a repeated one.
FEWEST_PERIODS = 4


def check_repeated(runs: Sequence[CapsuleRun], fit: Fitted) -> list[Finding]:
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


def repetition(run: CapsuleRun, residuals: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """F statistic of the harmonics of the excitation in ``residuals``, and its p-value; None for a short record."""
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


# tables: Tables of forced runs: nondimensional groups and predicted motion.


#: Draws at which velocities are computed, and errors of a record's velocity drawn for each.
VELOCITY_DRAWS, ERRORS = 50, 200


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


def predicted_motion(runs: Sequence[CapsuleRun], fit: Fitted) -> list[ResultTable]:
    """Contacts and mean velocity of the capsule over the record: observed, point fit, 95 % interval of a new record.

    Both velocities come from the estimator of ``capsule_id.records.motion``, the model's at the sample times.
    """
    rows = {run.label: _motion_row(run, fit) for run in runs}
    return [ResultTable("runs.motion", pd.DataFrame.from_dict(rows, orient="index").rename_axis("run"))]


def _motion_row(run: CapsuleRun, fit: Fitted) -> dict[str, object]:
    """Motion of one record: its label, contacts, and mean velocities with the band of a new record."""
    best, seen = run.motion(run.local(fit.values), np), measured_motion(run.table)
    local = [run.local(draw) for draw in fit.draws[:VELOCITY_DRAWS]]
    sample = run.motion(_stacked(local), np) if local else None
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
        row["95 % band, mm/s"] = "{:.4g} to {:.4g}".format(*np.quantile(velocities, [0.025, 0.975]))
    if found is not None:
        row["mean velocity, record, mm/s"] = f"{1e3 * found.velocity:.4g} ± {sd:.2g}"
    return row


def _stacked(draws: Sequence[ValuesBySymbol]) -> dict[str, np.ndarray]:
    """(draws,) values by symbol."""
    return {name: np.array([draw[name] for draw in draws]) for name in draws[0]}


# panels: Plot data of a forced run: every channel with its residuals, and the phase portrait.


#: Channels that depend on the motion; the current is the drive itself.
SHOWN = {"x_rel": "x_rel", "x_capsule": "capsule", "acceleration_rod": "rod's acceleration"}
#: Largest number of posterior draws for a band; number of lags of an autocorrelation.
BAND_DRAWS, LAGS = 50, 60
#: Polynomial order of the Savitzky–Golay filter for the measured phase portrait.
PORTRAIT_ORDER = 3


def run_comparisons(run: CapsuleRun, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
    """Return a panel per channel (prediction, 95 % band, residuals, autocorrelation), then the phase portrait.

    ``theta`` is the point fit. Bands use at most ``BAND_DRAWS`` of ``draws`` and exclude the noise.
    """
    bands = run.predict(_stacked(draws[:BAND_DRAWS]), np) if draws else [None] * len(run.channels)
    panels = []
    for channel, part, seen, drawn in zip(
        run.channels, run.scaled(theta, np), run.predict(theta, np), bands, strict=False
    ):
        if channel.name not in SHOWN:
            continue
        column, unit = run.table.columns[channel.name], run.table.columns[channel.name].to_display
        residuals, nuisance = (np.asarray(x) for x in part.at_nuisance_mean(np))
        fitted = channel.values - part.raw + part.design @ nuisance
        # The band represents the uncertainty of the motion: offset and gain of a draw hardly differ from the fit.
        limits = (None, None) if drawn is None else band((drawn + (fitted - seen)) * unit)
        panels.append(
            Comparison(
                run.kind,
                f"{run.label}_{channel.name}",
                f"{run.label}: {SHOWN[channel.name]}",
                "time [s]",
                axis_label(column),
                (Points(run.label, run.time, channel.values * unit),),
                (Curve("this fit", run.time, fitted * unit, *limits),),
                run.time,
                residuals,
                autocorrelation(residuals, min(LAGS, len(run.time) // 4)),
                1.96 / float(np.sqrt(len(run.time))),
            )
        )
    return (*panels, *(_portrait(run, theta) if "x_rel" in run.names else []))


def _portrait(run: CapsuleRun, theta: ValuesBySymbol) -> list[Comparison]:
    """Phase portrait, rate of x_rel by Savitzky–Golay against x_rel; [] for a record sampled unevenly."""
    index, column = run.names.index("x_rel"), run.table.columns["x_rel"]
    values, unit = column.values, column.to_display
    motion = run.motion(theta, np)
    offset = run.scaled(theta, np)[index].at_nuisance_mean(np)[1][0] * run.channels[index].width
    x, y = np.asarray(motion.x_rel) + offset, np.asarray(motion.Y1 - motion.Y2)
    try:
        window = choose_window(run.time, values, PORTRAIT_ORDER)
        recorded, fitted = (_filtered(run.time, side, window) for side in (values, x))
    except InputError:
        return []
    curves = [
        Curve("this fit", x * unit, y),
        Curve("this fit through the same filter", fitted[0] * unit, fitted[1], role="alternative"),
    ]
    if run.spring is not None:
        gap = (float(run.capsule(theta)[0].G) + offset) * unit  # pyright: ignore[reportArgumentType]
        ends = np.array([y.min(), y.max()])
        curves.append(Curve("support spring", np.array([gap, gap]), ends, role="paper"))
    label, points = f"{run.label}_phase_portrait", Points("record, Savitzky–Golay", recorded[0] * unit, recorded[1])
    axes = axis_label(column), "rate of x_rel [m/s]"
    return [Comparison("phase_portrait", label, f"{run.label}: phase portrait", *axes, (points,), tuple(curves))]


def _filtered(time: np.ndarray, values: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed value and rate, without the half window at both ends, where the derivative is inaccurate."""
    half = window_samples(window, sampling_step(time)) // 2
    inside = slice(half, len(time) - half)
    value, rate = (savitzky_golay(time, values, window, PORTRAIT_ORDER, derivative=n) for n in (0, 1))
    return value[inside], rate[inside]


def filtered_record(run: CapsuleRun, theta: ValuesBySymbol) -> RunRecord | None:
    """The record through the paper's filter, and its drive; None where x_rel is not recorded, or not evenly."""
    _, e = run.capsule(theta)
    try:
        view = view_record(run.table, K=theta["K"] if run.driven_by_current else None)
    except InputError:
        return None
    return RunRecord(run.label, view, np.asarray(e.force_at(run.time)))
