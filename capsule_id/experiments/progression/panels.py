"""Predictions of progressions and their panels: mean velocity against period, for every duty and amplitude."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from capsule_id.experiments.base import ValuesBySymbol, band
from capsule_id.experiments.progression.density.outliers import SHARE, TIMES
from capsule_id.views import Comparison, Curve, Points

if TYPE_CHECKING:
    from capsule_id.experiments.progression.experiment import Progression

#: Symbols of the scatters.
SCATTERS = ("session_sd", "trial_scatter", "trial_sd", "discrepancy")
#: Draws of a band.
BAND_DRAWS = 200
#: Seed of the sessions and trials of a band.
BAND_SEED = 0


def new_trials(
    e: "Progression", draws: Sequence[ValuesBySymbol], settings: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """(draws, rows) displacement, m, of a new trial in a new session at each row of ``settings`` (rows, 4).

    Each row has a session, a discrepancy and a trial of its own.
    """
    time = settings[:, 0] * settings[:, 1]
    z = rng.standard_normal((3, len(draws), len(settings)))
    own = {name: np.array([draw[name] for draw in draws])[:, None] for name in SCATTERS}
    X2 = e.displacements_of_draws(draws, own["session_sd"] * z[0], settings)
    variance = e.reading_variance + own["trial_sd"] ** 2 + (own["trial_scatter"] * X2) ** 2
    if e.heavy:
        variance = np.where(rng.uniform(size=variance.shape) < SHARE, TIMES**2, 1.0) * variance
    return X2 + own["discrepancy"] * time * z[1] + np.sqrt(variance) * z[2]


def progression_panels(e: "Progression", theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
    """One panel per duty and amplitude: trials, the point fit, and the band of a new trial in a new session."""
    settings = e.settings
    speed = 1e3 / e.time
    centre = np.asarray(e.displacements(theta, np.zeros(len(settings)), settings)) * speed
    chosen = draws[:: max(1, len(draws) // BAND_DRAWS)]
    trials = new_trials(e, chosen, settings, np.random.default_rng(BAND_SEED)) if chosen else np.empty((0, 0))
    lower, upper = band(trials * speed if chosen else trials)
    panels = speed_panels(e, settings, centre, (lower, upper), "this fit, 95 % band of a new trial")
    residuals = np.asarray(e.residuals(theta, np))[: e.n]
    rows = [_rows_of(e, group) for group in _groups(settings)]
    period = e.setting @ (1e3 * settings[:, 0])
    return tuple(
        replace(panel, residual_x=period[own], residuals=residuals[own])
        for panel, own in zip(panels, rows, strict=True)
    )


def speed_panels(
    e: "Progression",
    settings: np.ndarray,
    centre: np.ndarray,
    limits: tuple[np.ndarray | None, np.ndarray | None],
    label: str,
) -> tuple[Comparison, ...]:
    """One panel per duty and amplitude of ``settings`` (rows, 4): mean velocity against period, and the trials there.

    Parameters
    ----------
    centre, limits : (rows,) mean velocity and the limits of its band, mm/s
    label : of the curve
    """
    speed, panels = 1e3 / e.time, []
    for group in _groups(settings):
        own = np.flatnonzero(np.all(settings[:, 2:] == group, axis=1))
        own = own[np.argsort(settings[own, 0], kind="stable")]
        lower, upper = (None if limit is None else limit[own] for limit in limits)
        rows = _rows_of(e, group)
        trials = Points(e.label, (e.setting @ (1e3 * e.settings[:, 0]))[rows], (e.distance * (e.setting @ speed))[rows])
        amplitude = {"column": f", {group[1]:g} N", "current": f", {group[1]:g} A"}.get(e.amplitude_from, "")
        duty = f", duty {100.0 * group[0]:g} %" if e.drive == "pulses" else ""
        panels.append(
            Comparison(
                "progression",
                e.label,
                f"{e.label}{duty}{amplitude}: mean velocity",
                "period [ms]",
                "mean velocity [mm/s]",
                (trials,) if len(rows) else (),
                (Curve(label, 1e3 * settings[own, 0], centre[own], lower, upper),),
            )
        )
    return tuple(panels)


def _groups(settings: np.ndarray) -> np.ndarray:
    """(groups, 2) duty and amplitude."""
    return np.unique(settings[:, 2:], axis=0)


def _rows_of(e: "Progression", group: np.ndarray) -> np.ndarray:
    """Rows of the trials with the duty and amplitude of ``group``."""
    own = np.flatnonzero(np.all(e.settings[:, 2:] == group, axis=1))
    return np.flatnonzero(e.setting[:, own].any(axis=1))
