"""How numbers, units and parameter names are set: one rule each, for every table and figure."""

import math
import re
import unicodedata

MISSING = "–"

# Outside these magnitudes a number in bare SI units is hard to read, and the unit takes a decimal prefix instead.
_PREFIX_ABOVE, _PREFIX_BELOW = 1e7, 1e-2
_PREFIXES = {9: "G", 6: "M", 3: "k", 0: "", -3: "m", -6: "µ", -9: "n", -12: "p"}
# "1" has no prefix, "kg" has one already, and "m^2" with a prefix would mean the square of the prefixed unit.
_PREFIXABLE = re.compile(r"(N|m|s|A|rad|Hz|J|W|V)(?![A-Za-z^0-9²³])")

_NAME = re.compile(r"(?P<base>[A-Za-z]+?)(?:_?(?P<index>\d+|(?<=_)[A-Za-z0-9]+))?(?:\[(?P<label>.*)\])?")


# A longer name of a spring or an experiment would push the axis off the picture.
_LONGEST_LABEL = 24


def decimals_for(sd: float) -> int | None:
    """Decimal places (negative: places before the point) that leave two significant digits of ``sd``.

    None where ``sd`` gives no guidance (zero, NaN or infinite).
    """
    if not math.isfinite(sd) or sd <= 0:
        return None
    # Formatting first: 0.0996 is 0.10 with two digits, one place fewer than its logarithm says.
    return 1 - int(f"{sd:.1e}".partition("e")[2])


def fixed(value: float, decimals: int | None) -> str:
    """``value`` with so many decimals; six significant digits where ``decimals`` is None; a dash for NaN."""
    if math.isnan(value):
        return MISSING
    if math.isinf(value) or decimals is None:
        return f"{value:.6g}"
    if decimals <= 0:
        return f"{round(value, decimals):.0f}"
    return f"{value:.{decimals}f}"


def prefix_for(unit: str, magnitude: float) -> tuple[float, str]:
    """Factor and unit that bring ``magnitude`` into a readable range: (1e6, "µm") for 2e-5 m, else (1.0, unit)."""
    size = abs(magnitude)
    readable = size == 0 or not math.isfinite(size) or _PREFIX_BELOW <= size < _PREFIX_ABOVE
    if readable or not _PREFIXABLE.match(unit):
        return 1.0, unit
    power = min(max(3 * math.floor(math.log10(size) / 3), min(_PREFIXES)), max(_PREFIXES))
    return 10.0**-power, _PREFIXES[power] + unit


def symbol_parts(name: str) -> tuple[str, str, str]:
    """Split a parameter name as the paper sets it: symbol, index, label.

    ``k2[soft]`` -> ("k", "2", "soft"); ``mu`` -> ("μ", "", ""); ``v_s`` -> ("v", "s", "").
    Names that are words (``tilt_sd``) stay whole: ("tilt_sd", "", "").
    """
    match = _NAME.fullmatch(name)
    if match is None:
        base, bracket, label = name.partition("[")
        return base, "", label.removesuffix("]") if bracket else ""
    base, index, label = match["base"], match["index"] or "", match["label"] or ""
    try:
        base = unicodedata.lookup(f"GREEK {'CAPITAL' if base[0].isupper() else 'SMALL'} LETTER {base}")
    except KeyError:
        if len(base) > 1:
            return name.partition("[")[0], "", label
    return base, index, label


def plain_symbol(name: str) -> str:
    """The name for a figure, in Unicode and without markup: ``k₂ soft``, ``μ``, ``vₛ``, ``tilt_sd``."""
    base, index, label = symbol_parts(name)
    small = index.translate(str.maketrans("0123456789s", "₀₁₂₃₄₅₆₇₈₉ₛ"))
    if index and small.isascii():
        small = f"_{index}"
    short = label if len(label) <= _LONGEST_LABEL else label[: _LONGEST_LABEL - 1] + "…"
    return f"{base}{small} {short}".rstrip()
