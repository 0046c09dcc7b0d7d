"""Reads ``[model]`` of ``rig.toml``, and checks choices of [rig] and of an experiment that depend on each other."""

from collections.abc import Iterable, Mapping, Sequence
from math import cos
from typing import Any, get_args, get_type_hints

from capsule_id.parameters import TABLE
from capsule_id.rig.model import ModelChoices, Quantity, Table
from capsule_id.rig.schema import TABLE_KEYS, GroundSettings, KindRule
from capsule_id.rig.toml_document import KeyPath, TomlDocument
from capsule_id.rig.toml_values import closest, read_choice, read_table, refuse_unknown_keys, shown

#: Words that ``free`` may hold.
OPTIONAL = tuple(symbol for symbol, row in TABLE.items() if row.optional)


def read_model(document: TomlDocument) -> ModelChoices:
    """Return the choices of ``[model]``; the defaults where it is absent.

    Raises
    ------
    InputError
        If a key or word is unknown or repeated, or a free parameter has no effect in the chosen law.
    """
    head = read_table(document, ("model",), document.data.get("model", {}), "[model]")
    refuse_unknown_keys(document, ("model",), head, TABLE_KEYS["[model]"], TABLE_KEYS)
    choices: dict[str, str] = {}
    for key in ("friction", "reaction"):
        words = get_args(get_type_hints(ModelChoices)[key])
        choices[key] = read_choice(document, ("model", key), head.get(key, words[0]), words)
    constant = choices["friction"] == "constant"
    free = head.get("free", [])
    path = ("model", "free")
    if not isinstance(free, list):
        raise document.error(path, "free must be a list of words", shown(free), f'write free = ["{OPTIONAL[0]}"]')
    for index, word in enumerate(free):
        if word not in OPTIONAL:
            near = closest(word, OPTIONAL) if isinstance(word, str) else None
            remedy = f"write {near}" if near else f"write some of {' '.join(OPTIONAL)}"
            raise document.error(path, "free must name optional parameters", shown(word), remedy)
        if word in free[:index]:
            raise document.error(path, "free must name each parameter once", shown(word), "remove the second one")
    if constant and "ratio" in free:
        remedy = 'remove "ratio" from free, or remove friction = "constant"'
        raise document.error(path, "constant friction has no ratio", shown("ratio"), remedy)
    in_order = tuple(symbol for symbol in OPTIONAL if symbol in free)
    return ModelChoices(free=in_order, **choices)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]


def read_confirmed(document: TomlDocument, tables: Sequence[Table[Any]], stated: Iterable[str]) -> tuple[str, ...]:
    """Return the names in ``confirmed`` of [rig]; ``stated``: the quantities of [rig].

    Raises
    ------
    InputError
        If it is no list of names of [rig], or of columns and settings of experiments.
    """
    path, names = ("rig", "confirmed"), document.data["rig"].get("confirmed", [])
    known = [*stated, *(f"{t.label}.{name}" for t in tables for name in (*t.columns, *vars(t.settings)))]
    if not isinstance(names, list):
        raise document.error(path, "confirmed must be a list of names", shown(names), 'write confirmed = ["m1"]')
    for name in names:
        if name not in known:
            near = closest(name, known) if isinstance(name, str) else None
            rule = "confirmed must name quantities of [rig], or LABEL.COLUMN or LABEL.SETTING of experiments"
            raise document.error(path, rule, shown(name), f"write {near}" if near else "remove it")
    return tuple(names)


def check_masses_of_free(
    document: TomlDocument,
    model: ModelChoices,
    tables: Sequence[Table],
    kinds: Mapping[str, KindRule],
    stated: set[str],
) -> None:
    """Refuse a free parameter whose unit an experiment converts by a mass that [rig] does not state.

    Raises
    ------
    InputError
        At the word in ``free``; it names the experiment and the missing mass.
    """
    for symbol in model.free:
        for table in tables:
            for mass in kinds[table.kind].masses_of_free.get(symbol, ()):
                if mass not in stated:
                    rule = f"free {symbol} needs {mass}, because {table.label} gives friction without the weight"
                    remedy = f'add {mass} = {{ value = ..., sd = ..., unit = "kg" }} to [rig], or remove "{symbol}"'
                    raise document.error(("model", "free"), rule, f"no {mass} in [rig]", remedy)


def place_of(document: TomlDocument, path: KeyPath, key: str) -> KeyPath:
    """The key path where ``key`` of the entry at ``path`` is stated: the entry itself, or [rig]."""
    return (*path, key) if (*path, key) in document.keys else ("rig", key)


def check_normal_forces(document: TomlDocument, tables: Sequence[Table[Any]], stated: Mapping[str, Quantity]) -> None:
    """Refuse a pressing force that lifts the capsule off the ground; ``stated``: g and the stated masses.

    Raises
    ------
    InputError
        At the first N0 with (m1 + m2) g cos(slope) + N0 <= 0.
    """
    mass = sum(stated[name].value for name in ("m1", "m2") if name in stated)
    for index, table in enumerate(tables):
        settings = table.settings
        if not isinstance(settings, GroundSettings) or settings.N0 is None or "m2" not in stated:
            continue
        slope = 0.0 if settings.slope is None else settings.slope.value
        N = mass * stated["g"].value * cos(slope) + settings.N0.value
        if N <= 0.0:
            rule = f"the normal force (m1 + m2) g cos(slope) + N0 of {table.label} must be positive"
            place = place_of(document, ("experiment", index), "N0")
            raise document.error(place, rule, f"{N:.3g} N", "raise N0; N0 > 0 presses the capsule down")
