"""Reads names and units from headers, as loggers, spreadsheets and students write them."""

import re
import unicodedata
from collections.abc import Mapping, Sequence

from capsule_id.rig.units import UnitError, factor_to_si

#: Words for a column of a kind, without accents, by its name; a column is always known by its own name too.
WORDS: Mapping[str, tuple[str, ...]] = {
    "time": ("time", "t", "zeit", "messzeit", "temps", "tiempo", "tempo", "elapsed", "timestamp", "clock", "value"),
    "x_rel": (
        "relative",
        "displacement",
        "disp",
        "deflection",
        "position",
        "pos",
        "x",
        "weg",
        "laser",
        "auslenkung",
        "desplazamiento",
        "deplacement",
        "spostamento",
        "amplitude",
        "amplitudes",
        "peak",
        "ausschlag",
    ),
    "x_capsule": ("capsule", "kapsel", "housing"),
    "x_base": ("base", "shaker"),
    "acceleration_rod": ("acceleration", "acc", "accel", "accelerometer", "beschleunigung", "a"),
    "velocity": ("velocity", "speed", "v", "geschwindigkeit"),
    "acceleration": ("acceleration", "acc", "accel", "accelerometer", "beschleunigung", "a"),
    "current": ("current", "strom", "i", "courant", "amps", "coil"),
    "force": ("force", "kraft", "f", "load", "friction", "weight", "pull", "fs", "fk", "fr"),
    "normal_force": ("normal", "normalkraft", "fn"),
    "angle": ("angle", "tilt", "winkel", "inclination", "incline", "slope", "neigung", "steigung", "theta", "alpha"),
    "height": ("height", "hoehe", "hohe", "h"),
    "length": ("length", "laenge", "lange", "l", "board"),
    "speed": ("speed", "velocity", "v", "v0", "geschwindigkeit", "vitesse"),
    "distance": ("distance", "travel", "slide", "strecke", "weg", "x", "d", "displacement"),
    "deflection": ("deflection", "displacement", "disp", "compression", "extension", "verformung", "weg", "x"),
    "coefficient": ("coefficient", "mu", "reibwert"),
    "period": ("period", "t", "periode"),
    "duty": ("duty", "tau"),
    "periods": ("periods", "n", "cycles"),
    "session": ("session", "day"),
    "reading": ("reading", "counts", "adc", "raw", "cell"),
}
#: Fewest letters of a word that can end a compound.
SHORTEST_HEAD = 5
#: Units of headers that state none: names that programs give to their columns.
UNITS_OF_NAMES: Mapping[str, str] = {"X_Value": "s"}
#: Other ways to write a unit.
SPELLINGS: Mapping[str, str] = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "sek": "s", "sekunden": "s", "msec": "ms", "usec": "us",
    "millimeter": "mm", "millimetre": "mm", "meter": "m", "metre": "m", "m/s2": "m/s^2", "m/s**2": "m/s^2",
    "newton": "N", "amp": "A", "amps": "A", "ampere": "A", "degree": "deg", "degrees": "deg", "grad": "deg",
    "counts": "1", "count": "1", "-": "1",
}  # fmt: skip
_BRACKETS = re.compile(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*")
_INSIDE = re.compile(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*(\S.*)")
_SEPARATED = re.compile(r"(.*?)(?:\s+/\s*|\s*,\s+|\s+in\s+)([^\s/,]\S*)")


def unit_of(text: str, dimensions: Sequence[str]) -> str | None:
    """The unit that ``text`` writes, if it has one of the ``dimensions`` (SI units); else None."""
    text = text.strip()
    written = SPELLINGS.get(text.lower(), text)
    for si in dimensions:
        # A lone g beside an acceleration is standard gravity.
        candidate = "g_n" if written in ("g", "G") and si == "m/s^2" else written
        try:
            factor_to_si(candidate, si)
        except UnitError:
            continue
        return candidate
    return None


def name_and_unit(header: str, dimensions: Sequence[str]) -> tuple[str, str | None]:
    """Name and text of the unit of a header; None where it states none.

    ``dimensions`` are the SI units that columns may have. A suffix such as ``_mm`` or ``/mm`` counts only if it is such a
    unit, and so do brackets before further words, as in ``Force (N) Run 5``.
    """
    if header in UNITS_OF_NAMES:
        return header, UNITS_OF_NAMES[header]
    for pattern in (_BRACKETS, _SEPARATED):
        found = pattern.fullmatch(header)
        if found:
            return found[1], next(group for group in found.groups()[1:] if group is not None).strip()
    if unit_of(header, dimensions) is not None:
        return header, None
    found = _INSIDE.fullmatch(header)
    if found and unit_of(text := found[2] or found[3] or "", dimensions) is not None:
        return f"{found[1]} {found[4]}", text.strip()
    for mark in ("_", "/"):
        parts = header.split(mark)
        for k in range(1, len(parts)):
            suffix = mark.join(parts[k:])
            if unit_of(suffix, dimensions) is not None:
                return mark.join(parts[:k]), suffix
    return header, None


def fits_name(name: str, column: str) -> int:
    """3 for the name of the column itself, 2 for one of its words, 1 for a compound that ends with one, 0 for another name.

    ``Federkraft`` ends with ``kraft``.
    """
    # Letters without their accents.
    bare = "".join(
        mark for mark in unicodedata.normalize("NFKD", name.strip().lower()) if not unicodedata.combining(mark)
    )
    if re.sub(r"[\W_]+", "_", bare) == column.lower():
        return 3
    words = re.split(r"[\W_]+", bare)
    known = WORDS.get(column, ())
    if any(word in words for word in known):
        return 2
    heads = tuple(word for word in known if len(word) >= SHORTEST_HEAD)
    return 1 if any(word.endswith(heads) for word in words) else 0


def is_units_row(row: Sequence[str], dimensions: Sequence[str]) -> bool:
    """Whether at least half of the cells of a header row are units; empty cells do not count."""
    cells = [cell for cell in row if cell.strip(" []()")]
    units = [cell for cell in cells if unit_of(cell.strip(" []()"), dimensions) is not None]
    return bool(cells) and 2 * len(units) >= len(cells)
