"""Usual magnitudes of the quantities of a rig, and the unit that was meant where a number lies outside."""

from collections.abc import Mapping

import numpy as np

from capsule_id.rig.units import factor_to_si

#: Usual magnitudes by SI unit: lowest and highest largest value of a column, or value of a setting. Each interval spans
#: less than a factor 1000 to either side of a rig of the paper's size, so that a wrong prefix leaves it.
USUAL: Mapping[str, tuple[float, float]] = {
    "kg": (2e-3, 50.0),
    "m": (2e-4, 0.9),
    "N": (0.1, 900.0),
    "A": (0.02, 90.0),
    "m/s": (5e-3, 20.0),
    "m/s^2": (0.1, 3000.0),
    "rad": (0.03, 1.57),
    "rad/s": (0.3, 3000.0),
    "Hz": (0.05, 500.0),
    "1": (0.01, 10.0),
}
#: Units that are mistaken for each other.
_ALTERNATIVES: Mapping[str, tuple[str, ...]] = {
    "kg": ("kg", "g", "mg"),
    "m": ("m", "mm", "um", "cm"),
    "s": ("s", "ms", "us", "min"),
    "N": ("N", "mN", "kN", "gf", "kgf"),
    "A": ("A", "mA", "uA"),
    "m/s": ("m/s", "mm/s", "cm/s"),
    "m/s^2": ("m/s^2", "mm/s^2", "g_n"),
    "rad": ("rad", "deg", "mrad"),
    "rad/s": ("rad/s", "rpm", "rev/s"),
    "Hz": ("Hz", "kHz"),
}


def unit_meant(value: float, to_display: float, si: str, usual: tuple[float, float]) -> str:
    """Return the unit in which the written number would be usual; "" where there is none.

    Parameters
    ----------
    value : SI
    to_display : multiply SI by this to get the number as written
    si : unit of the quantity
    usual : lowest and highest usual value, SI
    """
    centre = np.log(usual[0] * usual[1]) / 2.0
    distances = {
        unit: abs(np.log(value * to_display * factor_to_si(unit, si)) - centre) for unit in _ALTERNATIVES.get(si, ())
    }
    half = np.log(usual[1] / usual[0]) / 2.0
    near = {unit: distance for unit, distance in distances.items() if distance <= half}
    return min(near, key=lambda unit: near[unit]) if near else ""
