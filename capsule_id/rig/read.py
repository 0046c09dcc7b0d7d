"""A rig folder becomes a ``Rig``: ``rig.toml`` against the schema, tables through the door, then the cross rules."""

import hashlib
import re
from pathlib import Path
from types import MappingProxyType
from typing import Any

from capsule_id.errors import InputError
from capsule_id.rig.loose_settings import loose
from capsule_id.rig.model import Column, PriorOverride, Quantity, Rig, Table
from capsule_id.rig.rules import check_experiment, check_masses, check_prior_springs
from capsule_id.rig.schema import (
    HALF_NORMAL_PRIORS,
    KINDS,
    LOG_NORMAL_PRIORS,
    NAME_PATTERN,
    POSITIVE,
    RIG_QUANTITIES,
    ChoiceRule,
    KindRule,
    QuantityRule,
)
from capsule_id.rig.settings import (
    read_bool,
    read_name,
    read_prior,
    read_quantity,
    read_setting,
    read_string,
    read_table,
    refuse_unknown_keys,
    shown,
)
from capsule_id.rig.tables import TableFile, read_table_file
from capsule_id.rig.text import decode
from capsule_id.rig.toml_document import KeyPath, TomlDocument, parse_toml

STANDARD_GRAVITY = 9.81  # m/s^2, the paper's value, exact where the folder states none
_READING_ERRORS = ("_sd", "_resolution")


def read_rig(folder: str | Path) -> Rig:
    """Read and check a rig folder.

    Parameters
    ----------
    folder : holds ``rig.toml`` and the tables that it names

    Returns
    -------
    Rig
        In SI units, arrays read-only, settings with their defaults filled in.

    Raises
    ------
    InputError
        At the first fault: file, line and column, the rule, the value found, the remedy.
    """
    folder = Path(folder)
    document, sha256 = _read_document(folder)
    data = document.data
    refuse_unknown_keys(document, (), data, ("rig", "prior", "experiment"))
    if "rig" not in data:
        raise InputError("rig.toml must have a table [rig]", "none", "add [rig] with a name", document.path, 1, 1)
    head = read_table(document, ("rig",), data["rig"], "[rig]")
    refuse_unknown_keys(document, ("rig",), head, ("name", "synthetic", *RIG_QUANTITIES))
    if "name" not in head:
        raise document.error(("rig",), "[rig] must have a name", "none", 'add name = "..."')
    name = read_name(document, ("rig", "name"), head["name"])
    synthetic = read_bool(document, ("rig", "synthetic"), head.get("synthetic", False))
    stated = {
        key: read_quantity(document, ("rig", key), head[key], rule)
        for key, rule in RIG_QUANTITIES.items()
        if key in head
    }
    tables, files = _read_experiments(document)
    check_masses(document, tables, set(stated))
    return Rig(
        name=name,
        synthetic=synthetic,
        m1=stated.get("m1"),
        m2=stated.get("m2"),
        g=stated.get("g", Quantity(STANDARD_GRAVITY)),
        priors=MappingProxyType(_read_priors(document, tables)),
        tables=tables,
        files=MappingProxyType({"rig.toml": sha256, **files}),
        folder=folder,
    )


def _read_document(folder: Path) -> tuple[TomlDocument, str]:
    """``rig.toml``, parsed and located, and its sha256."""
    path = folder / "rig.toml"
    try:
        if not folder.is_dir():
            raise InputError("the rig must be a folder", "no such folder", "name a folder with a rig.toml", folder)
        if not path.is_file():
            remedy = "run `capsule-id init DIR` for a commented one"
            raise InputError("a rig folder must contain a file rig.toml", "none", remedy, path, 1, 1)
        if not path.resolve().is_relative_to(folder.resolve()):
            raise InputError(
                "rig.toml must lie inside the folder, links followed", "a link", "copy it here", path, 1, 1
            )
        content = path.read_bytes()
    except (OSError, RuntimeError) as error:  # RuntimeError: a loop of links
        raise InputError("rig.toml must be readable", str(error), "check path and permissions", path, 1, 1) from None
    return parse_toml(decode(content, path), path), hashlib.sha256(content).hexdigest()


def _read_priors(document: TomlDocument, tables: tuple[Table, ...]) -> dict[str, PriorOverride]:
    """``[prior]``."""
    entries = read_table(document, ("prior",), document.data.get("prior", {}), "[prior]")
    priors = {}
    known = [key for key in LOG_NORMAL_PRIORS if key != "k2"] + ["k2[<spring>]", *HALF_NORMAL_PRIORS]
    for key, value in entries.items():
        path = ("prior", key)
        spring = re.fullmatch(rf"k2\[({NAME_PATTERN})\]", key)
        if spring:
            check_prior_springs(document, path, spring[1], tables)
        elif key not in known:
            refuse_unknown_keys(document, ("prior",), {key: value}, known)
        is_scatter = key in HALF_NORMAL_PRIORS
        si = HALF_NORMAL_PRIORS[key] if is_scatter else LOG_NORMAL_PRIORS["k2" if spring else key]
        priors[key] = read_prior(document, path, value, si, is_scatter)
    return priors


def _read_experiments(document: TomlDocument) -> tuple[tuple[Table, ...], dict[str, str]]:
    """Every ``[[experiment]]``, and the sha256 of every table read."""
    entries = document.data.get("experiment", [])
    if not isinstance(entries, list) or not entries:
        remedy = 'add [[experiment]] with kind = "..." and file = "..."'
        raise document.error(("experiment",), "a rig must have at least one [[experiment]]", shown(entries), remedy)
    tables: list[Table] = []
    files: dict[str, str] = {}
    for index, entry in enumerate(entries):
        path: KeyPath = ("experiment", index)
        read_table(document, path, entry, "[[experiment]]")
        table, sha256 = _read_experiment(document, path, entry)
        for other in tables:
            if other.label == table.label:
                place = "label" if "label" in entry else "file"
                remedy = 'give one of them a label of its own: label = "..."'
                raise document.error((*path, place), "labels must be unique", shown(table.label), remedy)
        tables.append(table)
        files[table.file] = sha256
    return tuple(tables), files


def _read_experiment(document: TomlDocument, path: KeyPath, entry: dict[str, Any]) -> tuple[Table, str]:
    """One entry with its table."""
    for key in ("kind", "file"):
        if key not in entry:
            raise document.error(path, f"an experiment must have a {key}", "none", f'add {key} = "..."')
    kind = read_string(document, (*path, "kind"), entry["kind"])
    if kind not in KINDS:
        raise document.error((*path, "kind"), "unknown kind", shown(kind), f"write one of {' '.join(KINDS)}")
    rule = KINDS[kind]
    errors = [column + suffix for column in rule.columns for suffix in _READING_ERRORS]
    refuse_unknown_keys(document, path, entry, ("kind", "file", "label", *rule.settings, *errors))
    settings = _read_settings(document, path, entry, kind, rule)
    name = read_string(document, (*path, "file"), entry["file"])
    file = read_table_file(document, (*path, "file"), name, kind, rule)
    label = read_name(document, (*path, "label"), entry["label"]) if "label" in entry else Path(name).stem
    columns = {key: _with_reading_error(document, path, entry, column, rule) for key, column in file.columns.items()}
    _refuse_idle_reading_errors(document, path, entry, errors, file)
    table = Table(kind, label, name, MappingProxyType(columns), loose(kind, settings), file.raw.rows)
    check_experiment(document, path, table, file)
    return table, file.sha256


def _read_settings(
    document: TomlDocument, path: KeyPath, entry: dict[str, Any], kind: str, rule: KindRule
) -> dict[str, object]:
    """The entry's settings, defaults filled in."""
    settings: dict[str, object] = {}
    for key, setting in rule.settings.items():
        if key in entry:
            settings[key] = read_setting(document, (*path, key), entry[key], setting)
        elif key in rule.required:
            raise document.error(path, f"{kind} must have a {key}", "none", f"add {key} = ...")
        elif isinstance(setting, ChoiceRule) and setting.has_default:
            settings[key] = setting.choices[0]
    return settings


def _with_reading_error(
    document: TomlDocument, path: KeyPath, entry: dict[str, Any], column: Column, rule: KindRule
) -> Column:
    """The column with its stated sd and resolution."""
    stated: dict[str, float | None] = {}
    for suffix in _READING_ERRORS:
        key = column.name + suffix
        quantity_rule = QuantityRule(rule.columns[column.name].si, POSITIVE)
        stated[suffix] = (
            read_quantity(document, (*path, key), entry[key], quantity_rule).value if key in entry else None
        )
    return Column(column.name, column.unit, column.to_display, column.values, stated["_sd"], stated["_resolution"])


def _refuse_idle_reading_errors(
    document: TomlDocument, path: KeyPath, entry: dict[str, Any], keys: list[str], file: TableFile
) -> None:
    """A reading error of a column that the file does not have is a slip, not a wish."""
    for key in keys:
        column = key.rsplit("_", 1)[0]
        if key in entry and column not in file.columns:
            value = " ".join(file.columns)
            raise document.error(
                (*path, key), f"{key} needs a column {column}", f"columns {value}", "remove it", of_key=True
            )
