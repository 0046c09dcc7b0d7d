"""Usual magnitudes of the quantities of a rig, and the unit that was meant where a number lies outside."""

from collections.abc import Mapping

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
#: Units that are mistaken for each other, the likeliest first.
_ALTERNATIVES: Mapping[str, tuple[str, ...]] = {
    "kg": ("g", "kg", "mg"),
    "m": ("mm", "m", "um", "cm"),
    "s": ("ms", "s", "us", "min"),
    "N": ("N", "mN", "kN", "gf", "kgf"),
    "A": ("A", "mA", "uA"),
    "m/s": ("m/s", "mm/s", "cm/s"),
    "m/s^2": ("m/s^2", "mm/s^2", "g_n"),
    "rad": ("rad", "deg", "mrad"),
    "rad/s": ("rad/s", "rpm", "rev/s"),
    "Hz": ("Hz", "kHz"),
}


def unit_meant(value: float, to_display: float, si: str, usual: tuple[float, float]) -> str:
    """Return the likeliest unit in which the written number would be usual; "" where there is none.

    Parameters
    ----------
    value : SI
    to_display : multiply SI by this to get the number as written
    si : unit of the quantity
    usual : lowest and highest usual value, SI
    """
    for unit in _ALTERNATIVES.get(si, ()):
        if usual[0] <= value * to_display * factor_to_si(unit, si) <= usual[1]:
            return unit
    return ""
