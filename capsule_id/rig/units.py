"""Converts a written unit to a factor to SI and checks its dimension; inside the package every number is SI.

pint parses and converts, with the registry of this file. pint's default registry takes 0.1 s to build, reads ``Ns`` as
a plural of ``N``, and treats the radian as a pure number. Here the angle is a dimension, so rad/s and Hz never mix.
A pattern admits only products of known symbols: pint alone reads ``m,s`` as ms and ``mms`` as mm.
"""

import re
from contextlib import suppress
from functools import cache
from typing import Any, TypeVar

import numpy as np

Values = TypeVar("Values", float, np.ndarray)

# The units of rig folders: symbol -> definition.
_DEFINITIONS = {
    "m": "[length]",
    "s": "[time]",
    "kg": "[mass]",
    "A": "[current]",
    "rad": "[angle]",
    "um": "1e-6 * m",
    "mm": "1e-3 * m",
    "cm": "1e-2 * m",
    "km": "1e3 * m",
    "in": "0.0254 * m",
    "mil": "2.54e-5 * m",
    "stamp": "1 * s",  # a date and a time of day, or one of them, as a column map reads it
    "ns": "1e-9 * s",
    "us": "1e-6 * s",
    "ms": "1e-3 * s",
    "min": "60 * s",
    "h": "3600 * s",
    "d": "86400 * s",
    "mg": "1e-6 * kg",
    "g": "1e-3 * kg",
    "lb": "0.45359237 * kg",
    "uA": "1e-6 * A",
    "mA": "1e-3 * A",
    "mrad": "1e-3 * rad",
    "deg": "0.017453292519943295 * rad",
    "rev": "6.283185307179586 * rad",
    "rpm": "0.10471975511965977 * rad / s",
    "Hz": "1 / s",
    "kHz": "1e3 / s",
    "N": "kg * m / s ** 2",
    "uN": "1e-6 * N",
    "mN": "1e-3 * N",
    "kN": "1e3 * N",
    "gf": "9.80665e-3 * N",
    "kgf": "9.80665 * N",
    "g_n": "9.80665 * m / s ** 2",
    "mg_n": "0.00980665 * m / s ** 2",
    "lbf": "4.4482216152605 * N",
    "Ns": "N * s",
    "percent": "0.01",
    "ppm": "1e-6",
}
# Other ways to write the same symbol.
_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "°": "deg", "⋅": "·", "%": "percent"})
# Other names of symbols and units, in lower case; an s at their end is left out.
_NAMES = {
    "sec": "s", "second": "s", "msec": "ms", "millisecond": "ms", "usec": "us", "microsecond": "us", "nsec": "ns",
    "nanosecond": "ns", "minute": "min", "meter": "m", "metre": "m", "millimeter": "mm", "millimetre": "mm",
    "micron": "um", "micrometer": "um", "micrometre": "um", "centimeter": "cm", "centimetre": "cm", "inch": "in",
    "mil": "mil", "thou": "mil",
    "inche": "in", "gram": "g", "gramme": "g", "kilogram": "kg", "kilo": "kg", "pound": "lb", "lb": "lb",
    "newton": "N", "amp": "A", "ampere": "A", "degree": "deg", "deg": "deg", "radian": "rad", "rad": "rad",
    "hertz": "Hz", "volt": "V", "millivolt": "mV", "sek": "s", "sekunden": "s", "seconde": "s", "segundo": "s",
    "secondi": "s", "metro": "m", "metri": "m", "grad": "deg", "grado": "deg", "gradi": "deg", "degré": "deg",
    "m/s2": "m/s^2", "m/s**2": "m/s^2", "count": "1", "-": "1",
}  # fmt: skip
_SYMBOL = re.compile("m?g_n|[A-Za-z]+")
_FACTOR = r"(?:(?:m?g_n|[A-Za-z]+)(?:\^-?[1-4]|⁻?[¹²³⁴])?|1)"
_GRAMMAR = re.compile(rf"{_FACTOR}(?:(?: ?[*/·] ?| ){_FACTOR})*")
_LONGEST = 40  # characters of a unit
# A unit that is written more often than the SI unit.
_EXAMPLES = {"m": "mm", "s": "ms", "kg": "g", "A": "mA", "rad": "deg", "m/s": "mm/s", "N/m": "kN/m"}


class UnitError(ValueError):
    """A unit that is unknown or has the wrong dimension; ``rule`` and ``remedy`` are parts of the error line."""

    def __init__(self, rule: str, remedy: str) -> None:
        super().__init__(f"{rule}, {remedy}")
        self.rule, self.remedy = rule, remedy


@cache
def _registry() -> Any:
    """The registry, made when the first unit is read: importing pint takes longer than reading a folder."""
    import pint

    registry: Any = pint.UnitRegistry(None)  # pyright: ignore[reportArgumentType]  (None: an empty one, by pint's manual)
    for symbol, definition in _DEFINITIONS.items():
        registry.define(f"{symbol} = {definition}")
    return registry


#: Written for a unit that a file does not state, and for times of day.
UNKNOWN, STAMP = "?", "stamp"
#: Units of the output of a sensor.
SIGNALS = ("V", "mV")


@cache
def factor_to_si(unit: str, si: str) -> float:
    """The factor from ``unit`` to the SI unit ``si``.

    Parameters
    ----------
    unit : as written in the file, e.g. ``kN/m``, ``N s/m``, ``m/s^2``, ``1``
    si : the SI unit wanted, e.g. ``N/m``; ``1`` for a pure number

    Raises
    ------
    UnitError
        If the unit is unknown or has another dimension.
    """
    remedy = f"write a unit such as {_EXAMPLES.get(si, si)}"
    if unit.strip() == UNKNOWN:
        raise UnitError("state the unit of the column, which the file does not say", remedy)
    written = unit.strip().translate(_SPELLINGS)
    if len(written) > _LONGEST or not _GRAMMAR.fullmatch(written):
        raise UnitError("a unit is a product of symbols, e.g. kN/m, N*s/m or m/s^2 (1: no unit)", remedy)
    for symbol in _SYMBOL.findall(written):
        if symbol not in _DEFINITIONS:
            if _known(symbol) in SIGNALS and si != "1":
                remedy += f" and the factor to it: columns = {{ ... = {{ from = 1, unit = ..., scale = ... }} }}, per {symbol}"
                raise UnitError(f"a reading in {symbol} needs the sensitivity of its sensor", remedy)
            meant = _SYMBOL.sub(lambda found: _known(found[0]), written)
            with suppress(UnitError):  # a proposal has the dimension wanted
                if meant != written and factor_to_si(meant, si):
                    remedy = f"write {meant}"
            raise UnitError(f"unknown unit symbol {symbol}", remedy)
    (factor, base), (_, wanted) = (_registry().get_base_units(each) for each in (written, si))
    if base != wanted:
        if written == "g" and si == "m/s^2":
            raise UnitError("g is the gram", "write g_n for standard gravity, 9.80665 m/s^2")
        raise UnitError(
            f"unit must have the dimension of {si}" if si != "1" else "unit must be 1 (a pure number)", remedy
        )
    return float(factor)


def symbol_named(text: str) -> str:
    """The symbol that another name means, such as ``seconds``; ``text`` itself where it is none."""
    return _NAMES.get(text.lower().removesuffix("s"), text)


def _known(symbol: str) -> str:
    """The symbol that another name, or the other case, means; ``symbol`` itself where it is none. M is the mega of MN."""
    name = symbol_named(symbol)
    same = [each for each in _DEFINITIONS if each.lower() == symbol.lower() and symbol[1:] and symbol[0] != "M"]
    return symbol if symbol in _DEFINITIONS else same[0] if name == symbol and len(same) == 1 else name


def scale(values: Values, factor: float) -> Values:
    """``values * factor``. It divides where 1/factor is whole, so that 9 ms and 0.009 s are the same float."""
    whole = round(1.0 / factor)
    return values / whole if whole > 1 and whole * factor == 1.0 else values * factor
