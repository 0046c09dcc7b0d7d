"""Reads single values of ``rig.toml``: type, unit, domain, SI. An error names the line and column of the value."""

import re
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from math import isfinite
from types import MappingProxyType
from typing import Any

from capsule_id.rig.domains import ABOVE_ONE, ANY, LARGEST, NOT_NEGATIVE, POSITIVE, SMALLEST, Domain, is_plausible
from capsule_id.rig.model import PriorOverride, Quantity
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.units import UnitError, factor_to_si, scale

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
