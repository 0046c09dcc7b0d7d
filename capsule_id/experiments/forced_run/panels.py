"""Plot data of a forced run: every channel with its residuals, and the phase portrait."""

from typing import TYPE_CHECKING

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.base import ValuesBySymbol, axis_label, band
from capsule_id.experiments.checks.context import RunRecord
from capsule_id.experiments.checks.series import autocorrelation
from capsule_id.records.view import view_record
from capsule_id.rig.filters import choose_window, sampling_step, savitzky_golay, window_samples
from capsule_id.views import Comparison, Curve, Points

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun

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
