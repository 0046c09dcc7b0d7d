"""Effects of the parameters on the readings of a decay, and of forces that the fitted model lacks."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lsim

from capsule_id.experiments.clock import stretch
from capsule_id.experiments.free_vibration.decay_models import viscous_state
from capsule_id.experiments.free_vibration.readings.noise import whiten
from capsule_id.experiments.free_vibration.settings import DAMPING, FURTHER

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: Step of difference quotients, in natural units of each parameter.
STEP = 1e-5
#: Points per period, and fewest points, of the responses to further forces.
RESPONSE_POINTS, FEWEST_POINTS = 60, 200


def whitened(e: "FreeVibration", theta: Mapping[str, float], columns: np.ndarray) -> np.ndarray:
    """Columns (n,) or (n, q) in the coordinates where noise and drift of ``e`` are white."""
    table = np.reshape(columns, (e.n, -1))
    if e.model.whitened:
        table = np.asarray(whiten(e.times, table, e.model, theta))
    else:
        table = table / np.reshape(e.relative_sd, (-1, 1))
    return np.reshape(table, columns.shape)


def sensitivities(
    e: "FreeVibration", theta: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Residuals (n,), design of the linear nuisances (n, p), and derivatives of the residuals by symbol, (n,) each."""
    raw, design = e.unwhitened(theta, np)
    nuisances = np.linalg.lstsq(whitened(e, theta, design), whitened(e, theta, raw), rcond=None)[0]
    left, units, moved = raw - design @ nuisances, _units(e, theta), {}
    for name in ("k1", "c", *e.model.symbols, *(() if e.closed else ("amplitude", "turning_time"))):
        other, basis = e.unwhitened({**theta, name: theta[name] + STEP * units[name]}, np)
        moved[name] = (other - basis @ nuisances - left) / (STEP * units[name])
    return left, design, moved


def further_sensitivities(e: "FreeVibration", theta: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Derivatives (n,) of the residuals with respect to the forces that the model of ``e`` lacks, at zero force."""
    if e.closed:
        return {name: -response for name, response in force_responses(e, theta).items()}
    full = e.with_model(replace(e.model, damping=tuple(DAMPING), cubic=True))
    names = e.model.absent
    known = {**theta, **dict.fromkeys(names, 0.0)}
    raw, units = full.unwhitened(known, np)[0], _units(e, theta)
    return {
        name: (full.unwhitened({**known, name: STEP * units[name]}, np)[0] - raw) / (STEP * units[name])
        for name in names
    }


def force_responses(e: "FreeVibration", theta: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Responses (n,) of the readings of a viscous decay to F_dry, c_q and k_cubic of unit size, SI, by symbol.

    They are linear, for small forces, and start at rest: the nuisances of the decay contain any other start.
    """
    raw, design = e.unwhitened(theta, np)
    parts = np.linalg.lstsq(whitened(e, theta, design), whitened(e, theta, raw), rcond=None)[0]
    m1, k1, c = theta["m1"], theta["k1"], theta["c"]
    time = e.time * stretch(e.clock_rate, theta)
    length = float(time[-1])
    points = max(FEWEST_POINTS, int(RESPONSE_POINTS * length * np.sqrt(k1 / m1) / (2.0 * np.pi)))
    grid = np.linspace(0.0, length, points)
    x, rate = viscous_state(grid, theta, parts, e.order)
    system = ([1.0 / m1], [1.0, c / m1, k1 / m1])
    found = {}
    for name, force in zip(FURTHER, (np.sign(rate), rate * np.abs(rate), x**3), strict=True):
        response = -lsim(system, force, grid)[1]
        for _ in range(e.order):
            response = np.gradient(response, grid[1])
        found[name] = np.interp(time, grid, response)
    return found


def _units(e: "FreeVibration", theta: Mapping[str, float]) -> dict[str, float]:
    """Natural units of the parameters of a decay, SI."""
    size, k1, m1 = e.largest_deflection, theta["k1"], theta["m1"]
    units = {"k1": k1, "c": theta["c"], "F_dry": k1 * size, "c_q": m1 / size, "k_cubic": k1 / size**2}
    return units | {"amplitude": size, "turning_time": float(np.sqrt(m1 / k1))}
