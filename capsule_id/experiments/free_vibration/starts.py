"""Starting points of a fit of free decays."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from capsule_id.experiments.base import Start
from capsule_id.experiments.free_vibration.decrement import UNKNOWNS, Decrement, equilibrium, viscous_fit
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.records.noise import noise_level

#: Latest first turning point after the first sample, in half periods.
LATEST_TURNING_POINT = 0.1
#: Log-normal priors of dry friction and quadratic damping: median relative to k1 x and m1/x, and factor.
FURTHER_MEDIAN, FURTHER_FACTOR = 0.05, 100.0
#: Start of a term that a simpler model lacks, relative to its usual start.
ABSENT = 1e-4

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration


def further_parameters(symbols: Sequence[str], k1: float, m1: float, size: float) -> list[Parameter]:
    """Rows of the forces in ``symbols``, SI, with priors relative to what the rod feels at its largest deflection ``size``.

    A prior far below that would prefer the absence of a force that the record does not exclude, and the c beside it.
    """
    priors = {
        "F_dry": Prior("lognormal", FURTHER_MEDIAN * k1 * size, FURTHER_FACTOR),
        "c_q": Prior("lognormal", FURTHER_MEDIAN * m1 / size, FURTHER_FACTOR),
        "k_cubic": Prior("normal", 0.0, k1 / size**2),
    }
    return [parameter(symbol, prior=priors[symbol]) for symbol in symbols]


def decay_starts(e: "FreeVibration") -> dict[str, Start]:
    """Start of every parameter of the record ``e``, from its paper's estimate or the values of a screening.

    A viscous decay without drift starts at its least-squares fit, whose residuals show the noise at any sampling rate.
    """
    rough, noise = e.rough_decrement(), noise_level(e.values)
    if e.about.screened is not None:
        noise = e.about.screened.noise / float(np.mean(e.relative_sd))
    elif e.closed and e.model.drift == "none":
        fit = viscous_fit(e.time, e.values)
        rough, noise = fit.decrement(e.mass), min(noise, float(np.sqrt(np.sum(fit.left**2) / max(e.n - UNKNOWNS, 1))))
    # A phase error of the start over the decay leads the fit to a side lobe, a local maximum.
    ringing = min(e.time[-1], 4.0 * e.mass / rough.c)
    spread = min(0.3, 1.0 / (rough.Omega_o * ringing))
    noise = max(noise, 1e-4 * float(np.ptp(e.values)))
    starts = {
        "k1": Start(rough.k1, spread),
        "c": Start(rough.c, 0.3),
        e.channel.noise.named(e.label).name: Start(noise, 0.2),
    }
    if not e.closed:
        time, peak = first_turning_point(e)
        size = abs(peak)
        forces = {
            "F_dry": Start(0.02 * rough.k1 * size, 0.3),
            "c_q": Start(0.5 * rough.c / (rough.Omega_o * size), 0.3),
            "k_cubic": Start(0.0, 0.01 * rough.k1 / size**2),
        }
        rough_damping = e.rough_damping(e.model.symbols)
        forces |= {
            name: Start(max(rough_damping.get(name, 0.0), 0.2 * forces[name].centre), 0.2) for name in ("F_dry", "c_q")
        }
        starts |= {symbol: forces[symbol] for symbol in e.model.symbols}
        starts["c"] = Start(max(rough_damping.get("c", rough.c), 0.1 * rough.c), 0.2)
        starts[f"amplitude[{e.label}]"] = Start(size, 0.05)
        starts[f"turning_time[{e.label}]"] = Start(time, 0.05 / rough.Omega_o)
    known = {} if e.about.screened is None else e.about.screened.values
    for row in e.parameters:
        if row.symbol in known:
            value = known[row.symbol]
            near = starts.get(row.name, Start(value, 0.1))
            # An absent term is no starting point of a logarithm.
            floor = 1e-3 * near.centre if row.positive else -np.inf
            starts[row.name] = Start(max(value, floor), 0.3 * near.spread)
    return starts


def nested_starts(e: "FreeVibration") -> list[dict[str, float]]:
    """Values by name, SI, of the fits of simpler models of the record ``e``; an absent term is far below its usual start."""
    if e.about.screened is None:
        return []
    usual = {name: start.centre for name, start in decay_starts(e).items()}
    return [
        {
            row.name: max(values[row.symbol], ABSENT * usual[row.name]) if row.positive else values[row.symbol]
            for row in e.parameters
            if row.symbol in values and row.name in usual
        }
        for values in e.about.screened.nested
    ]


def first_turning_point(e: "FreeVibration") -> tuple[float, float]:
    """Rough time, s, and signed x_rel, m, of the last turning point before the record, or at its first samples."""
    rough = e.rough_decrement()
    half_period = np.pi / rough.Omega_o
    # A velocity peaks a quarter of a period before the turning point.
    first = float(rough.times[0]) + (0.5 * half_period if e.order == 1 else 0.0)
    back = int(np.ceil(first / half_period - LATEST_TURNING_POINT))
    growth = rough.first_ratio**back
    peak = e.channel.deflection(rough.Omega_o) * float(rough.peaks[0])
    return first - back * half_period, peak * (-1.0) ** back * growth


def starts_of_motion(e: "FreeVibration", rough: Decrement) -> dict[str, Start]:
    """Starts of x_rel and its rate at the first sample."""
    size = abs(float(rough.peaks[0]))
    rate = np.polyfit(e.time[:5], e.values[:5], 1)[0]
    return {
        f"x_start[{e.label}]": Start(float(e.values[0] - equilibrium(e.values)), 0.02 * size),
        f"y_start[{e.label}]": Start(float(rate), 0.05 * rough.Omega_o * size),
    }
