"""``rig.toml`` with places, and its single values: type, unit, domain, SI."""

import re
import sys
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import count
from math import inf, isfinite, pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.errors import InputError, raise_all
from capsule_id.parameters import ROUNDING, Prior
from capsule_id.rig.model import Quantity
from capsule_id.rig.units import UnitError, factor_to_si, scale

# domains: Intervals of admissible values.


@dataclass(frozen=True)
class Domain:
    """An interval of SI values, with both ends where it is ``closed``; ``text`` continues "<name> must ...".

    ``whole``: it holds whole numbers alone.
    """

    text: str
    low: float = -inf
    high: float = inf
    closed: bool = False
    whole: bool = False

    def holds(self, values: np.ndarray | float) -> np.ndarray:
        """Whether each value lies inside, elementwise."""
        values = np.asarray(values)
        ends = (values == self.low) | (values == self.high)
        inside = ((values > self.low) & (values < self.high)) | (ends & self.closed & np.isfinite(values))
        return inside & (values == np.round(values)) if self.whole else inside


#: Magnitudes of quantities that a rig may have, SI: their squares and ratios stay far from the limits of float64.
LARGEST = 1e30
SMALLEST = 1.0 / LARGEST


def is_plausible(values: np.ndarray | float) -> np.ndarray:
    """Whether each value is 0 or has a magnitude between ``SMALLEST`` and ``LARGEST``, elementwise."""
    size = np.abs(values)
    return (size == 0.0) | ((size >= SMALLEST) & (size <= LARGEST))


ANY = Domain("be a finite number")
POSITIVE = Domain("be greater than 0", low=0.0)
NOT_NEGATIVE = Domain("be 0 or greater", low=0.0, closed=True)
#: A share, both ends included: the bound lies a rounding error of unit conversion above 1.
SHARE = Domain("lie between 0 and 100 %", low=0.0, high=1.0 + ROUNDING, closed=True)
#: A part of a whole, neither none of it nor all.
PART = Domain("lie between 0 and 100 %, both excluded", low=0.0, high=1.0)
ABOVE_ONE = Domain("be greater than 1", low=1.0)
#: A number of drive periods; the simulation of more takes minutes for each trial.
PERIODS = Domain("be a whole number between 1 and 100000", low=1.0, high=1e5, closed=True, whole=True)
INCLINE = Domain("lie between -90 and 90 deg", low=-pi / 2, high=pi / 2)
SLOPE_ANGLE = Domain("lie between 0 and 90 deg", low=0.0, high=pi / 2)


# toml document: ``rig.toml`` with places: tomllib reads the values, a scanner finds their lines and columns.


KeyPath = tuple[str | int, ...]
#: Largest rig.toml, characters, and deepest key. A rig needs a few thousand characters and six levels.
LARGEST_TEXT, DEEPEST_KEY = 1_000_000, 32

_SHALLOW = "write the plain tables"
_STRING = r""""(?:[^"\\\n]|\\.)*"|'[^'\n]*'"""
_MULTILINE = r""""{3}(?:[^\\]|\\.)*?"{3}(?:"{0,2})|'{3}.*?'{3}(?:'{0,2})"""
_KEY = re.compile(rf"{_STRING}|[A-Za-z0-9_-]+")
_VALUE = re.compile(rf"(?s:{_MULTILINE})|{_STRING}|[^,\]}}#\n]+")
_NOTHING = r"(?:[ \t\n]|#[^\n]*)*"
_BLANK, _COMMA, _OPEN = (re.compile(form + _NOTHING) for form in ("", rf"{_NOTHING},?", r"[\[{]"))
_HEADER, _END, _DOT, _EQUALS = (re.compile(rf"[ \t]*{form}[ \t]*") for form in (r"\[\[?", r"\]\]?", r"\.", "="))
_CLOSE = re.compile(r"[\]}]")


def parse_toml(text: str, path: Path) -> "TomlDocument":
    """Parse ``text`` (line ends ``\\n``) and locate every key and value.

    Raises
    ------
    InputError
        If it is not TOML 1.0, at the place that tomllib names.
    """
    if len(text) > LARGEST_TEXT:
        raise InputError(
            f"the file must hold at most {LARGEST_TEXT} characters",
            str(len(text)),
            "write readings into tables of their own",
            path,
            1,
            1,
        )

    def number(written: str) -> float:
        """A float; one that a float64 cannot hold is refused where it first stands."""
        value = float(written.replace("_", ""))
        if value == 0.0 and re.search("[1-9]", re.split("[eE]", written)[0]):
            raise InputError(
                "a number must be one that float64 holds",
                written,
                "write 0: float64 begins at 5e-324",
                path,
                *_line_and_column(text, text.index(written)),
            )
        return value

    try:
        document = TomlDocument(path, text, tomllib.loads(text, parse_float=number))
    except RecursionError:
        raise InputError("nesting must be shallow", "too many brackets", _SHALLOW, path, 1, 1) from None
    except InputError:
        raise
    except ValueError as error:
        message = str(error)
        found = re.search(r"\(at line (\d+), column (\d+)\)", message)
        line, column = (int(found[1]), int(found[2])) if found else _line_and_column(text, len(text))
        raise InputError(
            "the file must be valid TOML", message.split(" (at ")[0], "correct this line", path, line, column
        ) from None
    deepest = max(document.keys, key=len, default=())
    if len(deepest) > DEEPEST_KEY:
        raise InputError(
            "nesting must be shallow",
            f"a key of {len(deepest)} levels",
            _SHALLOW,
            path,
            *document.place(deepest, of_key=True),
        )
    return document


def _line_and_column(text: str, offset: int) -> tuple[int, int]:
    """1-based line and column of a character offset."""
    return text.count("\n", 0, offset) + 1, offset - (text.rfind("\n", 0, offset) + 1) + 1


class TomlDocument:
    """A text that tomllib has accepted, with the place of each key and value; the scan for them checks nothing.

    Attributes
    ----------
    path : the file, as given by the user
    text : of the file, with ``\\n`` line ends
    data : the content as tomllib returns it
    keys, values : offset of every key and value by key path, e.g. ("experiment", 0, "kind")
    """

    def __init__(self, path: Path, text: str, data: dict[str, Any]) -> None:
        self.path, self.text, self.data, self.position = path, text, data, 0
        self.keys: dict[KeyPath, int] = {}
        self.values: dict[KeyPath, int] = {}
        self.scan()

    def place(self, path: KeyPath, of_key: bool = False) -> tuple[int, int]:
        """Line and column (1-based characters) of the value (or key) at ``path``; of its nearest ancestor if absent."""
        known = self.values | self.keys if of_key else self.keys | self.values
        ancestors = (path[:length] for length in range(len(path), 0, -1))
        return _line_and_column(self.text, next((known[one] for one in ancestors if one in known), 0))

    def skip(self, pattern: re.Pattern[str]) -> str:
        """Move behind a match of ``pattern`` and return its text, which may be empty."""
        start, match = self.position, pattern.match(self.text, self.position)
        self.position = start if match is None else match.end()
        return self.text[start : self.position]

    def scan(self) -> None:
        """Read every statement: ``[a.b]``, ``[[a.b]]`` or key = value."""
        base, last = KeyPath(), dict[KeyPath, KeyPath]()  # last: the table that a path of an array of tables means
        self.skip(_BLANK)
        while (start := self.position) < len(self.text):
            if brackets := self.skip(_HEADER):
                path = KeyPath()
                for name, _ in self.dotted_key():
                    path = (*last.get(path, path), name)
                if brackets.startswith("[["):
                    self.keys.setdefault(path, start)
                    last[path] = (*path, int(last[path][-1]) + 1 if path in last else 0)
                base = last.get(path, path)
                self.keys[base] = start
                self.skip(_END)
            else:
                self.key_value(base)
            self.skip(_BLANK)

    def dotted_key(self) -> list[tuple[str, int]]:
        """``a."b c".d``: the names with their offsets."""
        parts = []
        while not parts or self.skip(_DOT):
            offset, token = self.position, self.skip(_KEY)
            parts.append((tomllib.loads(f"key = {token}")["key"] if token[0] in "\"'" else token, offset))
        return parts

    def key_value(self, path: KeyPath) -> None:
        """``a.b = value``."""
        for name, offset in self.dotted_key():
            path = (*path, name)
            self.keys.setdefault(path, offset)
        self.skip(_EQUALS)
        self.value(path)

    def value(self, path: KeyPath) -> None:
        """A string, array, inline table or bare word."""
        self.values[path] = self.position
        bracket = self.skip(_OPEN)
        if not bracket:
            self.skip(_VALUE)
            return
        for index in count():
            if self.skip(_CLOSE):
                return
            if bracket[0] == "[":
                self.value((*path, index))
            else:
                self.key_value(path)
            self.skip(_COMMA)


# toml values: Reads single values of ``rig.toml``: type, unit, domain, SI. An error names the line and column of the
# value.


NAME_PATTERN = r"[A-Za-z0-9._-]+"
_DEVICE = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
#: Largest finite number; whole numbers of TOML may be larger.
LARGEST_NUMBER = sys.float_info.max
#: Units of masses and lengths. Positive ones are weighed or measured to better than half of their value.
WEIGHED = ("kg", "m", "m/s^2")
#: Keys of the error of a quantity: its sd, half the width of a rectangle, or an expanded error with its factor k.
ERRORS = ("sd", "half_width", "expanded", "k")
_LONGEST_SHOWN = 60  # characters of a faulty value in an error line
#: Other names of keys and words of ``rig.toml``.
_ALIASES = {
    "mass1": "m1", "mass_1": "m1", "rod_mass": "m1", "mass2": "m2", "mass_2": "m2", "capsule_mass": "m2", "gravity": "g",
    "uncertainty": "sd", "error": "sd", "sigma": "sd", "std": "sd", "stdev": "sd", "val": "value", "units": "unit",
    "type": "kind", "path": "file", "filename": "file", "title": "name", "name": "label", "column": "from",
    "header": "from", "na": "missing", "missing_values": "missing",
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
    folded = {
        **{tuple(re.split(r"[_\W]+", one.lower())): one for one in reversed([*known])},
        **{tuple(alias.split("_")): one for alias, one in _ALIASES.items() if one in known and alias not in known},
    }
    joined = {"".join(each): one for each, one in folded.items()}
    same = [
        each
        for each in folded
        if len(each) == len(parts)
        and all(get_close_matches(one, [other], cutoff=0.65) for one, other in zip(parts, each, strict=True))
    ]
    near = get_close_matches("_".join(parts), ["_".join(each) for each in same], n=1)
    return joined.get("".join(parts)) or (folded[tuple(near[0].split("_"))] if near else None)


def remedy_for(word: str, known: Collection[str], otherwise: str, form: str = 'write "{}"') -> str:
    """The remedy for a word that is not ``known``: the closest one in its ``form``, or ``otherwise``."""
    close = closest(word, known)
    return form.format(close) if close else otherwise


def is_number(value: object) -> bool:
    """Whether a value of TOML is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER


def is_count(value: object) -> bool:
    """Whether a value of TOML is a whole number, 1 or more."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


#: Keys of a prior with their domains, by the kind of its density. The factor has no unit.
PRIOR_KEYS: Mapping[str, Mapping[str, Domain]] = {
    "lognormal": {"median": POSITIVE, "factor": ABOVE_ONE},
    "halfnormal": {"scale": POSITIVE},
    "normal": {"mean": ANY, "sd": POSITIVE},
}


@dataclass(frozen=True)
class Node:
    """A value of ``rig.toml`` at its place.

    Its methods return the value as one of a type; each raises ``InputError`` at the place of what is wrong. The texts of
    their errors name the last key of ``path``.

    Attributes
    ----------
    document, path : the file, and the key path
    value : as tomllib returns it
    """

    document: TomlDocument
    path: KeyPath
    value: Any

    @property
    def key(self) -> str:
        """The last key of the path."""
        return str(self.path[-1])

    def __contains__(self, key: str) -> bool:
        return isinstance(self.value, dict) and key in self.value

    def __getitem__(self, key: str | int) -> "Node":
        return Node(self.document, (*self.path, key), self.value[key])

    def get(self, key: str, default: Any) -> "Node":
        """The value of ``key``; ``default`` in its place where it is not stated."""
        return Node(self.document, (*self.path, key), self.value.get(key, default))

    def error(self, rule: str, value: str, remedy: str, of_key: bool = False) -> InputError:
        """The error about the value, or about its key."""
        return InputError(rule, value, remedy, self.document.path, *self.document.place(self.path, of_key))

    def require(self, holds: bool, rule: str, remedy: str) -> None:
        """Raise where the value does not hold; ``rule`` continues "<key> must ..."."""
        if not holds:
            raise self.error(f"{self.key} must {rule}", shown(self.value), remedy)

    def required(self, key: str, remedy: str) -> "Node":
        """The value of a key that a table must have."""
        self.require(key in self, f"have a {key}", remedy)
        return self[key]

    def refuse_unknown(self, known: Collection[str], elsewhere: Mapping[str, Collection[str]] | None = None) -> None:
        """Raise at the keys of a table that are not ``known``; ``elsewhere``: keys of other tables, by table."""
        faults: list[InputError] = []
        for key in self.value:
            if key not in known:
                table = next((name for name, keys in (elsewhere or {}).items() if key in keys), None)
                remedy = remedy_for(key, known, f"move it to {table}" if table else "remove it", "write {}")
                faults.append(
                    self[key].error("unknown key", shown(key), f"{remedy}; known: {' '.join(known)}", of_key=True)
                )
        raise_all(faults)

    def table(self, example: str, known: Collection[str] = ()) -> "Node":
        """The value itself, a table with keys that are ``known``; (): they are not checked."""
        self.require(isinstance(self.value, dict), "be a table", f"write {example}")
        if known:
            self.refuse_unknown(known)
        return self

    def text(self) -> str:
        """A non-empty string."""
        self.require(isinstance(self.value, str), "be a string", 'write it in quotes: "..."')
        if not self.value:
            raise self.error(f"{self.key} must not be empty", '""', "write a word between the quotes")
        return self.value

    def name(self) -> str:
        """A name. Results are written to a folder of that name; ``.``, ``..`` and names of Windows' devices are refused."""
        name = self.text()
        device, valid = _DEVICE.fullmatch(name), re.fullmatch(NAME_PATTERN, name) and name.strip(".")
        self.require(not device, "not be the name of a device of Windows", f'write e.g. "{name.split(".")[0]}-1"')
        self.require(bool(valid), "be a name of letters, digits, dot, underscore and hyphen", 'write e.g. "rig-1"')
        return name

    def choice(self, choices: Sequence[str]) -> str:
        """One of ``choices``."""
        known = " or ".join(f'"{choice}"' for choice in choices)
        self.require(self.text() in choices, f"be {known}", f"write {known}")
        return self.value

    def unit(self, si: str) -> float:
        """The factor to SI of the unit that a table states."""
        stated = self.required("unit", f'add unit = "{si}" or an equivalent unit')
        try:
            return factor_to_si(stated.text(), si)
        except UnitError as error:
            raise stated.error(error.rule, shown(stated.value), error.remedy) from None

    def quantity(self, si: str, domain: Domain = POSITIVE, has_sd: bool = False) -> Quantity:
        """``{ value = ..., sd = ..., unit = "..." }`` in SI; ``sd`` is refused unless ``has_sd``."""
        example = f'{{ value = ..., {"sd = ..., " if has_sd else ""}unit = "{si}" }}'
        factor = self.table(example, ("value", *(ERRORS if has_sd else ()), "unit")).unit(si)
        number = self.number("value", factor, domain)
        error = self._error(factor) if has_sd else None
        if error and si in WEIGHED and domain is POSITIVE and error[1] > 0.5 * number:
            rule, stated = f"sd of {self.key} must be at most half of its value", self[error[0]]
            raise stated.error(rule, shown(stated.value), "weigh or measure it, or leave it out")
        return Quantity(number, error[1] if error else 0.0)

    def _error(self, factor: float) -> tuple[str, float] | None:
        """The key that states an error, and its sd, SI: an expanded error is k sds, half the width of a rectangle is
        sqrt(3) sds (JCGM 100:2008, 4.3.3 and 4.3.7); None: no error is stated.
        """
        words = [word for word in ("sd", "half_width", "expanded") if word in self]
        if words[1:]:
            raise self[words[1]].error("state an error once", " and ".join(words), f"remove {words[1]}", of_key=True)
        if "k" in self and words != ["expanded"]:
            raise self["k"].error("k belongs to an expanded error", "no expanded", "add expanded = ...", of_key=True)
        if not words:
            return None
        sds = {"sd": 1.0, "half_width": sqrt(3.0)}.get(words[0]) or self.number("k", 1.0, POSITIVE)
        return words[0], self.number(words[0], factor, NOT_NEGATIVE) / sds

    def prior(self, si: str, default: Prior) -> Prior:
        """``{ median, factor, unit }``, ``{ scale, unit }`` or ``{ mean, sd, unit }``, by the kind of the default prior.

        A unit of 1 is optional.
        """
        keys = PRIOR_KEYS[default.kind]
        self.table(f'{{ {"".join(f"{key} = ..., " for key in keys)}unit = "{si}" }}', (*keys, "unit"))
        factor = 1.0 if si == "1" and "unit" not in self else self.unit(si)
        stated = [self.number(key, 1.0 if key == "factor" else factor, domain) for key, domain in keys.items()]
        location, spread = (0.0, *stated)[-2:]
        return replace(default, location=location, spread=spread)

    def number(self, key: str, factor: float, domain: Domain) -> float:
        """The number of ``key`` times ``factor``, finite and inside ``domain``."""
        stated, name = self.required(key, f"add {key} = ..."), self.key if key == "value" else f"{key} of {self.key}"
        number, zero = stated.value, "be 0 or " if domain.holds(0.0) else ""
        real = isinstance(number, int | float) and not isinstance(number, bool)
        scaled = scale(float(number), factor) if real and abs(number) <= LARGEST_NUMBER else inf
        magnitude = f"{zero}lie between {SMALLEST:g} and {LARGEST:g} in SI units"
        for holds, rule, remedy in (
            (real, "be a number", "write a number without quotes"),
            (isfinite(scaled), "be a finite number", "correct the value"),
            (is_plausible(scaled), magnitude, "correct the value or its unit"),
            (domain.holds(scaled), domain.text, "correct the value"),
        ):
            if not holds:
                raise stated.error(f"{name} must {rule}", shown(number), remedy)
        return scaled
