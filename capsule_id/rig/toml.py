"""``rig.toml`` with places, and its single values: type, unit, domain, SI."""

import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from math import inf, isfinite, pi
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.model import PriorOverride, Quantity
from capsule_id.rig.units import UnitError, factor_to_si, scale

# domains: Intervals of admissible values.


@dataclass(frozen=True)
class Domain:
    """An interval of SI values; ``text`` continues "<name> must ..."."""

    text: str
    low: float = -inf
    high: float = inf
    low_allowed: bool = False

    def holds(self, values: np.ndarray | float) -> np.ndarray:
        """Whether each value lies inside, elementwise."""
        values = np.asarray(values)
        return ((values >= self.low) if self.low_allowed else (values > self.low)) & (values < self.high)


#: Magnitudes of quantities that a rig may have, SI: their squares and ratios stay far from the limits of float64.
SMALLEST, LARGEST = 1e-30, 1e30


def is_plausible(values: np.ndarray | float) -> np.ndarray:
    """Whether each value is 0 or has a magnitude between ``SMALLEST`` and ``LARGEST``, elementwise."""
    size = np.abs(values)
    return (size == 0.0) | ((size >= SMALLEST) & (size <= LARGEST))


ANY = Domain("be a finite number")
POSITIVE = Domain("be greater than 0", low=0.0)
NOT_NEGATIVE = Domain("be 0 or greater", low=0.0, low_allowed=True)
#: A share, both ends included: the bound lies a rounding error of unit conversion above 1.
SHARE = Domain("lie between 0 and 100 %", low=0.0, high=1.0 + 1e-12, low_allowed=True)
ABOVE_ONE = Domain("be greater than 1", low=1.0)
#: A number of drive periods; the simulation of more takes minutes for each trial.
PERIODS = Domain("lie between 1 and 100000", low=1.0, high=1e5 + 0.5, low_allowed=True)
INCLINE = Domain("lie between -90 and 90 deg", low=-pi / 2, high=pi / 2)
SLOPE_ANGLE = Domain("lie between 0 and 90 deg", low=0.0, high=pi / 2)


# toml document: ``rig.toml`` with places: tomllib reads the values, a scanner finds their lines and columns.


KeyPath = tuple[str | int, ...]
#: Largest rig.toml, characters, and deepest key. A rig needs a few thousand characters and six levels.
LARGEST_TEXT, DEEPEST_KEY = 1_000_000, 32

_SHALLOW = "write the plain tables"
_MULTILINE_BASIC = re.compile(r'"""(?:[^\\]|\\.)*?"""(?:"{0,2})', re.DOTALL)
_MULTILINE_LITERAL = re.compile(r"'''.*?'''(?:'{0,2})", re.DOTALL)
_BASIC = re.compile(r'"(?:[^"\\\n]|\\.)*"')
_LITERAL = re.compile(r"'[^'\n]*'")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BARE_VALUE = re.compile(r"[^,\]}#\n]+")
_BLANK = re.compile(r"(?:[ \t\n]|#[^\n]*)*")
_SPACES = re.compile(r"[ \t]*")


@dataclass(frozen=True)
class TomlDocument:
    """A parsed TOML file with the place of each key and value.

    Attributes
    ----------
    path : the file, as given by the user
    data : the content as tomllib returns it
    keys, values : offset of every key and value by key path, e.g. ("experiment", 0, "kind")
    text : the file's text with ``\\n`` line ends
    """

    path: Path
    data: dict[str, Any]
    keys: dict[KeyPath, int]
    values: dict[KeyPath, int]
    text: str

    def place(self, path: KeyPath, of_key: bool = False) -> tuple[int, int]:
        """Line and column (1-based characters) of the value (or key) at ``path``; of its nearest ancestor if absent."""
        first, second = (self.keys, self.values) if of_key else (self.values, self.keys)
        while path:
            offset = first.get(path, second.get(path))
            if offset is not None:
                return _line_and_column(self.text, offset)
            path = path[:-1]
        return 1, 1

    def error(self, path: KeyPath, rule: str, value: str, remedy: str, of_key: bool = False) -> InputError:
        """The error about the value (or key) at ``path``."""
        line, column = self.place(path, of_key)
        return InputError(rule, value, remedy, self.path, line, column)


def parse_toml(text: str, path: Path) -> TomlDocument:
    """Parse ``text`` (line ends ``\\n``) and locate every key and value.

    Raises
    ------
    InputError
        If it is not TOML 1.0, at the place that tomllib names.
    """
    if len(text) > LARGEST_TEXT:
        rule, remedy = (
            f"the file must hold at most {LARGEST_TEXT} characters",
            "write readings into tables of their own",
        )
        raise InputError(rule, str(len(text)), remedy, path, 1, 1)
    try:
        data = tomllib.loads(text)
        scanner = _Scanner(text)
        scanner.scan()
    except RecursionError:
        raise InputError("nesting must be shallow", "too many brackets", _SHALLOW, path, 1, 1) from None
    except ValueError as error:
        message = str(error)
        found = re.search(r"\(at line (\d+), column (\d+)\)", message)
        line, column = (int(found[1]), int(found[2])) if found else _line_and_column(text, len(text))
        what = message.split(" (at ")[0]
        raise InputError("the file must be valid TOML", what, "correct this line", path, line, column) from None
    deepest = max(scanner.keys, key=len, default=())
    if len(deepest) > DEEPEST_KEY:
        place = _line_and_column(text, scanner.keys[deepest])
        raise InputError("nesting must be shallow", f"a key of {len(deepest)} levels", _SHALLOW, path, *place)
    return TomlDocument(path, data, scanner.keys, scanner.values, text)


def _line_and_column(text: str, offset: int) -> tuple[int, int]:
    """1-based line and column of a character offset."""
    return text.count("\n", 0, offset) + 1, offset - (text.rfind("\n", 0, offset) + 1) + 1


class _Scanner:
    """Records the places in a text that tomllib has accepted; it checks nothing."""

    def __init__(self, text: str) -> None:
        self.text, self.position = text, 0
        self.keys: dict[KeyPath, int] = {}
        self.values: dict[KeyPath, int] = {}
        self.lengths: dict[KeyPath, int] = {}  # of arrays of tables

    def scan(self) -> None:
        """Read every statement: table header or key = value."""
        base: KeyPath = ()
        self.skip(_BLANK)
        while self.position < len(self.text):
            if self.text.startswith("[", self.position):
                base = self.header()
            else:
                self.key_value(base)
            self.skip(_BLANK)

    def skip(self, pattern: re.Pattern[str]) -> str:
        """Move behind a match of ``pattern`` and return its text, which may be empty."""
        match = pattern.match(self.text, self.position)
        if match is None:
            return ""
        self.position = match.end()
        return match[0]

    def header(self) -> KeyPath:
        """``[a.b]`` or ``[[a.b]]``; the path that the following keys belong to."""
        start = self.position
        is_array = self.text.startswith("[[", start)
        self.position += 2 if is_array else 1
        path: KeyPath = ()
        names = [name for name, _ in self.dotted_key()]
        for depth, name in enumerate(names):
            path = (*path, name)
            if is_array and depth == len(names) - 1:
                self.lengths[path] = self.lengths.get(path, 0) + 1
                self.keys.setdefault(path, start)
            if path in self.lengths:
                path = (*path, self.lengths[path] - 1)
        self.keys[path] = start
        self.position += 2 if is_array else 1
        return path

    def dotted_key(self) -> list[tuple[str, int]]:
        """``a."b c".d``: the names with their offsets."""
        parts = []
        while True:
            self.skip(_SPACES)
            offset = self.position
            if self.text[offset] in "\"'":
                token = self.skip(_BASIC if self.text[offset] == '"' else _LITERAL)
                parts.append((tomllib.loads(f"key = {token}")["key"], offset))
            else:
                parts.append((self.skip(_BARE_KEY), offset))
            self.skip(_SPACES)
            if not self.text.startswith(".", self.position):
                return parts
            self.position += 1

    def key_value(self, base: KeyPath) -> None:
        """``a.b = value``."""
        path = base
        for name, offset in self.dotted_key():
            path = (*path, name)
            self.keys.setdefault(path, offset)
        self.position += 1  # the equals sign
        self.value(path)

    def value(self, path: KeyPath) -> None:
        """A string, array, inline table or bare word."""
        self.skip(_SPACES)
        self.values[path] = self.position
        ahead = self.text[self.position : self.position + 3]
        if ahead == '"""' or ahead == "'''":
            self.skip(_MULTILINE_BASIC if ahead == '"""' else _MULTILINE_LITERAL)
        elif ahead[0] in "\"'":
            self.skip(_BASIC if ahead[0] == '"' else _LITERAL)
        elif ahead[0] == "[":
            self.items("]", path)
        elif ahead[0] == "{":
            self.items("}", path)
        else:
            self.skip(_BARE_VALUE)

    def items(self, closing: str, path: KeyPath) -> None:
        """The inside of an array or inline table."""
        self.position += 1
        index = 0
        self.skip(_BLANK)
        while not self.text.startswith(closing, self.position):
            if closing == "]":
                self.value((*path, index))
                index += 1
            else:
                self.key_value(path)
            self.skip(_BLANK)
            if self.text.startswith(",", self.position):
                self.position += 1
                self.skip(_BLANK)
        self.position += 1


# toml values: Reads single values of ``rig.toml``: type, unit, domain, SI. An error names the line and column of the
# value.


NAME_PATTERN = r"[A-Za-z0-9._-]+"
_DEVICE = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
#: No table of rig.toml, see ``refuse_unknown_keys``.
NOWHERE: Mapping[str, Collection[str]] = MappingProxyType({})
#: Units of masses and lengths. Positive ones are weighed or measured to better than half of their value.
WEIGHED = ("kg", "m", "m/s^2")
_LONGEST_SHOWN = 60  # characters of a faulty value in an error line
#: Other names of keys and words of ``rig.toml``.
_ALIASES = {
    "mass1": "m1", "mass_1": "m1", "rod_mass": "m1", "mass2": "m2", "mass_2": "m2", "capsule_mass": "m2", "gravity": "g",
    "uncertainty": "sd", "error": "sd", "sigma": "sd", "std": "sd", "stdev": "sd", "val": "value", "units": "unit",
    "type": "kind", "path": "file", "filename": "file", "title": "name", "na": "missing", "missing_values": "missing",
}  # fmt: skip


def shown(value: object) -> str:
    """A faulty value for an error line: printable and short."""
    try:
        text = str(value).lower() if isinstance(value, bool) else repr(value)
    except ValueError:  # Python refuses to write integers of thousands of digits
        text = "a very large number"
    return text if len(text) <= _LONGEST_SHOWN else text[:_LONGEST_SHOWN] + "…"


def closest(word: str, known: Collection[str]) -> str | None:
    """The word of ``known`` that ``word`` means: in another case or with hyphens, another name for it, or misspelt.

    None where no word is similar, or where a part of a similar one is another word: ``k2_back`` does not mean ``mu_back``.
    """
    parts = re.split(r"[_\W]+", word[:_LONGEST_SHOWN].lower())
    folded = {tuple(re.split(r"[_\W]+", one.lower())): one for one in reversed([*known])}
    folded |= {tuple(alias.split("_")): one for alias, one in _ALIASES.items() if one in known and alias not in known}
    joined = {"".join(each): one for each, one in folded.items()}
    same = [each for each in folded if len(each) == len(parts) and all(map(_similar, parts, each))]
    near = get_close_matches("_".join(parts), ["_".join(each) for each in same], n=1)
    return joined.get("".join(parts)) or (folded[tuple(near[0].split("_"))] if near else None)


def _similar(part: str, other: str) -> bool:
    return part == other or bool(get_close_matches(part, [other], cutoff=0.65))


def refuse_unknown_keys(
    document: TomlDocument,
    path: KeyPath,
    entry: dict[str, Any],
    known: Collection[str],
    elsewhere: Mapping[str, Collection[str]] = NOWHERE,
) -> None:
    """Raise at the first key of ``entry`` that is not ``known``; ``elsewhere``: keys of other tables, by table."""
    for key in entry:
        if key not in known:
            close, table = closest(key, known), next((name for name, keys in elsewhere.items() if key in keys), None)
            remedy = f"move it to {table}" if table else f"write {close}" if close else "remove it"
            remedy += f"; known: {' '.join(known)}"
            raise document.error((*path, key), "unknown key", shown(key), remedy, of_key=True)


def read_string(document: TomlDocument, path: KeyPath, value: object) -> str:
    """A non-empty string."""
    if not isinstance(value, str):
        raise document.error(path, f"{path[-1]} must be a string", shown(value), 'write it in quotes: "..."')
    if not value:
        raise document.error(path, f"{path[-1]} must not be empty", '""', "write a word between the quotes")
    return value


def read_bool(document: TomlDocument, path: KeyPath, value: object) -> bool:
    """true or false."""
    if not isinstance(value, bool):
        raise document.error(
            path, f"{path[-1]} must be true or false", shown(value), "write true or false without quotes"
        )
    return value


def read_name(document: TomlDocument, path: KeyPath, value: object) -> str:
    """A name. Results are written to a folder of that name; ``.``, ``..`` and the names of Windows' devices are refused."""
    name = read_string(document, path, value)
    if _DEVICE.fullmatch(name):
        rule = f"{path[-1]} must not be the name of a device of Windows"
        raise document.error(path, rule, shown(name), f'write e.g. "{name.split(".")[0]}-1"')
    if not re.fullmatch(NAME_PATTERN, name) or not name.strip("."):
        rule = f"{path[-1]} must be a name of letters, digits, dot, underscore and hyphen"
        raise document.error(path, rule, shown(name), 'write e.g. "rig-1"')
    return name


def read_table(document: TomlDocument, path: KeyPath, value: object, example: str) -> dict[str, Any]:
    """A TOML table."""
    if not isinstance(value, dict):
        raise document.error(path, f"{path[-1]} must be a table", shown(value), f"write {example}")
    return value


def read_quantity(
    document: TomlDocument, path: KeyPath, value: object, si: str, domain: Domain = POSITIVE, has_sd: bool = False
) -> Quantity:
    """``{ value = ..., sd = ..., unit = "..." }`` in SI; ``sd`` is refused unless ``has_sd``."""
    example = f'{{ value = ..., {"sd = ..., " if has_sd else ""}unit = "{si}" }}'
    entry = read_table(document, path, value, example)
    refuse_unknown_keys(document, path, entry, ("value", "sd", "unit") if has_sd else ("value", "unit"))
    factor = read_unit(document, path, entry, si)
    number = _read_scaled(document, path, entry, "value", factor, domain)
    sd = _read_scaled(document, path, entry, "sd", factor, NOT_NEGATIVE) if "sd" in entry else 0.0
    if si in WEIGHED and domain is POSITIVE and sd > 0.5 * number:
        rule = f"sd of {path[-1]} must be at most half of its value"
        raise document.error((*path, "sd"), rule, shown(entry["sd"]), "weigh or measure it, or leave it out")
    return Quantity(number, sd)


def read_choice(document: TomlDocument, path: KeyPath, value: object, choices: Sequence[str]) -> str:
    """One of ``choices``."""
    word = read_string(document, path, value)
    if word not in choices:
        known = " or ".join(f'"{choice}"' for choice in choices)
        raise document.error(path, f"{path[-1]} must be {known}", shown(word), f"write {known}")
    return word


def read_prior(document: TomlDocument, path: KeyPath, value: object, si: str, kind: str) -> PriorOverride:
    """``{ median, factor, unit }``, ``{ scale, unit }`` or ``{ mean, sd, unit }`` by the kind of the default prior.

    A unit of 1 is optional.
    """
    keys = {"halfnormal": ("scale", "unit"), "normal": ("mean", "sd", "unit")}.get(kind, ("median", "factor", "unit"))
    example = "{ " + ", ".join(f"{key} = ..." for key in keys[:-1]) + f', unit = "{si}" }}'
    entry = read_table(document, path, value, example)
    refuse_unknown_keys(document, path, entry, keys)
    factor = 1.0 if si == "1" and "unit" not in entry else read_unit(document, path, entry, si)
    if kind == "halfnormal":
        return PriorOverride(scale=_read_scaled(document, path, entry, "scale", factor, POSITIVE))
    if kind == "normal":
        mean = _read_scaled(document, path, entry, "mean", factor, ANY)
        return PriorOverride(mean=mean, sd=_read_scaled(document, path, entry, "sd", factor, POSITIVE))
    return PriorOverride(
        median=_read_scaled(document, path, entry, "median", factor, POSITIVE),
        factor=_read_scaled(document, path, entry, "factor", 1.0, ABOVE_ONE),
    )


def read_unit(document: TomlDocument, path: KeyPath, entry: dict[str, Any], si: str) -> float:
    """The factor of the entry's unit to SI."""
    if "unit" not in entry:
        raise document.error(
            path, f"{path[-1]} must have a unit", shown(entry), f'add unit = "{si}" or an equivalent unit'
        )
    unit = read_string(document, (*path, "unit"), entry["unit"])
    try:
        return factor_to_si(unit, si)
    except UnitError as error:
        raise document.error((*path, "unit"), error.rule, shown(unit), error.remedy) from None


def _read_scaled(
    document: TomlDocument, path: KeyPath, entry: dict[str, Any], key: str, factor: float, domain: Domain
) -> float:
    """The number at ``entry[key]`` times ``factor``, finite and inside ``domain``."""
    place = (*path, key)
    name = path[-1] if key == "value" else f"{key} of {path[-1]}"
    if key not in entry:
        raise document.error(path, f"{path[-1]} must have a {key}", shown(entry), f"add {key} = ...")
    number = entry[key]
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise document.error(place, f"{name} must be a number", shown(number), "write a number without quotes")
    try:
        scaled = scale(float(number), factor)
    except OverflowError:
        scaled = float("inf")
    if not isfinite(scaled):
        raise document.error(place, f"{name} must be a finite number", shown(number), "correct the value")
    if not is_plausible(scaled):
        zero = "be 0 or " if domain.holds(0.0) else ""
        rule = f"{name} must {zero}lie between {SMALLEST:g} and {LARGEST:g} in SI units"
        raise document.error(place, rule, shown(number), "correct the value or its unit")
    if not domain.holds(scaled):
        raise document.error(place, f"{name} must {domain.text}", shown(number), "correct the value")
    return scaled
