"""Reads a rig folder into a ``Rig``: ``rig.toml`` by the rules of the kinds, tables in SI, rules between tables."""

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from capsule_id.console import stop_if_interrupted
from capsule_id.errors import InputError, collecting, raise_all
from capsule_id.parameters import Parameter
from capsule_id.rig.formats.text import TextFile
from capsule_id.rig.maps import MAP_KEYS
from capsule_id.rig.model import Column, PriorOverride, Quantity, Rig, Settings, Table
from capsule_id.rig.schema import (
    RIG_QUANTITIES,
    TABLE_KEYS,
    KindRule,
    check_engine,
    check_masses_of_free,
    check_normal_forces,
    parameter_rows,
    read_confirmed,
    read_model,
)
from capsule_id.rig.tables import Entry, TableFile, read_experiment_files
from capsule_id.rig.toml import (
    NAME_PATTERN,
    KeyPath,
    TomlDocument,
    closest,
    parse_toml,
    read_bool,
    read_name,
    read_prior,
    read_quantity,
    read_string,
    read_table,
    refuse_unknown_keys,
    shown,
)

STANDARD_GRAVITY = 9.81  # m/s^2, the paper's value, exact where the folder states none
_READING_ERRORS = ("_sd", "_resolution")
#: Smallest stated reading error relative to the largest reading; below it rounding exceeds the error.
SMALLEST_RELATIVE_ERROR = 1e-12


def read_rig(folder: str | Path, kinds: Mapping[str, KindRule], parameters: Sequence[Parameter] = ()) -> Rig:
    """Read and check a rig folder.

    Parameters
    ----------
    folder : holds ``rig.toml`` and the tables that it names; or the path of ``rig.toml``
    kinds : the kinds of experiments that it may have, by name
    parameters : further rows that ``[prior]`` may state, those of a friction law

    Returns
    -------
    Rig
        In SI units, arrays read-only, settings with their defaults filled in.

    Raises
    ------
    InputError
        At the first fault: file, line and column, the rule, the value found, the remedy. Where several quantities of
        [rig] or experiments have faults, at the first one of each (``FolderError``).
    """
    document, sha256 = _read_document(Path(folder))
    data = document.data
    refuse_unknown_keys(document, (), data, ("rig", "model", "prior", "experiment"))
    if "rig" not in data:
        raise InputError("rig.toml must have a table [rig]", "none", "add [rig] with a name", document.path, 1, 1)
    head = read_table(document, ("rig",), data["rig"], "[rig]")
    refuse_unknown_keys(document, ("rig",), head, TABLE_KEYS["[rig]"], TABLE_KEYS)
    if "name" not in head:
        raise document.error(("rig",), "[rig] must have a name", "none", 'add name = "..."')
    name = read_name(document, ("rig", "name"), head["name"])
    synthetic = read_bool(document, ("rig", "synthetic"), head.get("synthetic", False))
    faults: list[InputError] = []
    stated = {"g": Quantity(STANDARD_GRAVITY)}
    for key, rule in RIG_QUANTITIES.items():
        if key in head:
            with collecting(faults):
                stated[key] = read_quantity(document, ("rig", key), head[key], rule.si, rule.domain, rule.has_sd)
    ground = {key: stated[key] for key in ("slope", "N0") if key in stated}
    tables, files = _read_experiments(document, kinds, ground, faults)
    raise_all(faults)
    model = read_model(document)
    _check_masses(document, tables, kinds, set(stated))
    check_masses_of_free(document, model, tables, kinds, set(stated))
    check_engine(document, model, tables)
    check_normal_forces(document, tables, stated)
    return Rig(
        name=name,
        synthetic=synthetic,
        m1=stated.get("m1"),
        m2=stated.get("m2"),
        g=stated["g"],
        priors=MappingProxyType(_read_priors(document, tables, [*parameter_rows(kinds).values(), *parameters])),
        tables=tables,
        files=MappingProxyType({"rig.toml": sha256, **files}),
        folder=document.path.parent,
        model=model,
        slope=stated.get("slope"),
        N0=stated.get("N0"),
        confirmed=read_confirmed(document, tables, stated),
    )


def _read_document(folder: Path) -> tuple[TomlDocument, str]:
    """``rig.toml``, parsed and located, and its sha256."""
    folder = folder.parent if folder.name == "rig.toml" and folder.is_file() else folder
    path = folder / "rig.toml"
    try:
        if not folder.is_dir():
            value = "a file" if folder.is_file() else "no such folder"
            raise InputError("the rig must be a folder", value, "name a folder with a rig.toml", folder)
        if not path.is_file():
            remedy = "run `capsule-id init DIR` for a commented one"
            raise InputError("a rig folder must contain a file rig.toml", "none", remedy, path, 1, 1)
        if not path.resolve().is_relative_to(folder.resolve()):
            raise InputError(
                "rig.toml must lie inside the folder, links followed", "a link", "copy the file here", path, 1, 1
            )
        content = path.read_bytes()
    except (OSError, RuntimeError) as error:  # RuntimeError: a loop of links
        raise InputError("rig.toml must be readable", str(error), "check path and permissions", path, 1, 1) from None
    return parse_toml("\n".join(TextFile(content, path).lines()), path), hashlib.sha256(content).hexdigest()


def _check_masses(
    document: TomlDocument, tables: Sequence[Table], kinds: Mapping[str, KindRule], stated: set[str]
) -> None:
    """Refuse an experiment whose masses [rig] does not state."""
    for index, table in enumerate(tables):
        for mass in kinds[table.kind].masses(table):
            if mass not in stated:
                remedy = f'add {mass} = {{ value = ..., sd = ..., unit = "kg" }} to [rig]'
                raise document.error(
                    ("experiment", index, "kind"), f"{table.kind} needs {mass}", f"no {mass} in [rig]", remedy
                )


def _read_priors(
    document: TomlDocument, tables: Sequence[Table], parameters: Sequence[Parameter]
) -> dict[str, PriorOverride]:
    """The entries of ``[prior]``, by parameter name; they may state the priors of ``parameters``."""
    entries = read_table(document, ("prior",), document.data.get("prior", {}), "[prior]")
    rows = {row.symbol: row for row in parameters if row.prior_can_be_stated}
    known = ["k2[<spring>]" if symbol == "k2" else symbol for symbol in sorted(rows, key=lambda s: rows[s].scatter)]
    priors = {}
    for key, value in entries.items():
        path = ("prior", key)
        spring = re.fullmatch(rf"k2\[({NAME_PATTERN})\]", key)
        if spring:
            _check_prior_of_spring(document, path, spring[1], tables)
        elif key not in known:
            refuse_unknown_keys(document, ("prior",), {key: value}, known)
        row = rows["k2" if spring else key]
        assert row.prior is not None, "its prior can be stated"
        priors[key] = read_prior(document, path, value, row.unit, row.prior.kind)
    return priors


def _check_prior_of_spring(document: TomlDocument, path: KeyPath, spring: str, tables: Sequence[Table]) -> None:
    """Refuse a prior of k2[spring] without an experiment with that spring."""
    springs = sorted({table.settings.spring for table in tables if getattr(table.settings, "spring", None)})
    if spring not in springs:
        remedy = f"write {' or '.join(f'k2[{name}]' for name in springs)}" if springs else "remove it"
        raise document.error(path, "a prior of k2 must name a spring of an experiment", spring, remedy, of_key=True)


def _read_experiments(
    document: TomlDocument, kinds: Mapping[str, KindRule], ground: Mapping[str, Quantity], faults: list[InputError]
) -> tuple[tuple[Table, ...], dict[str, str]]:
    """Every ``[[experiment]]``, and the sha256 of every file read; the first error of each is appended to ``faults``."""
    entries = document.data.get("experiment", [])
    if not isinstance(entries, list) or not entries:
        remedy = 'add [[experiment]] with kind = "..." and file = "..."'
        raise document.error(("experiment",), "a rig must have at least one [[experiment]]", shown(entries), remedy)
    tables: list[Table] = []
    files: dict[str, str] = {}
    labels = _default_labels(entries)
    for index, entry in enumerate(entries):
        stop_if_interrupted()
        path: KeyPath = ("experiment", index)
        with collecting(faults):
            read_table(document, path, entry, "[[experiment]]")
            table, sha256 = _read_experiment(document, path, entry, kinds, ground, labels[index])
            for other in tables:
                if other.label == table.label:
                    place = next(key for key in ("label", "file", "files") if key in entry)
                    remedy = 'give one of them a label of its own: label = "..."'
                    raise document.error((*path, place), "labels must be unique", shown(table.label), remedy)
            tables.append(table)
            files |= sha256
    return tuple(tables), files


def _default_labels(entries: Sequence[Any]) -> list[str]:
    """The name of the first file of each entry, with its folders where several folders have a file of that name."""
    paths = []
    for entry in entries:
        stated = {} if not isinstance(entry, dict) or "label" in entry else entry
        files = stated.get("files")
        name = files[0] if isinstance(files, list) and files else stated.get("file")
        paths.append(Path(os.path.normpath(name)) if isinstance(name, str) else Path())
    folders = {path.stem: {other.parent for other in paths if other.stem == path.stem} for path in paths}
    return ["_".join((*path.parent.parts, path.stem)) if len(folders[path.stem]) > 1 else path.stem for path in paths]


def _read_experiment(
    document: TomlDocument,
    path: KeyPath,
    entry: dict[str, Any],
    kinds: Mapping[str, KindRule],
    ground: Mapping[str, Quantity],
    label: str,
) -> tuple[Table, Mapping[str, str]]:
    """One entry with its table, and the sha256 of its files; ``label`` where the entry states none."""
    if "kind" not in entry:
        raise document.error(path, "an experiment must have a kind", "none", 'add kind = "..."')
    word = read_string(document, (*path, "kind"), entry["kind"])
    if word not in kinds:
        close = closest(word, kinds)
        remedy = f'write "{close}"' if close else f"write one of {' '.join(kinds)}"
        raise document.error((*path, "kind"), "unknown kind", shown(word), remedy)
    kind = kinds[word]
    errors = [column + suffix for column in kind.columns for suffix in _READING_ERRORS]
    known = ("kind", "file", "label", "reject", "clock", *MAP_KEYS, *kind.setting_rules, *errors)
    refuse_unknown_keys(document, path, entry, known, TABLE_KEYS)
    settings = _read_settings(document, path, entry, kind, ground)
    file = read_experiment_files(document, path, entry, kind)
    name = next(iter(file.sha256))
    label = read_name(document, (*path, "label"), entry["label"]) if "label" in entry else label
    columns = {key: _with_reading_error(document, path, entry, column, kind) for key, column in file.columns.items()}
    _refuse_reading_errors_without_column(document, path, entry, errors, file)
    dropped = file.missing, file.other, file.rejected, file.encodings, file.drift
    table = Table(word, label, name, MappingProxyType(columns), settings, file.raw.rows, kind.bench, *dropped)
    for rule in kind.rules:
        rule(Entry(table, document, path, file))
    return table, file.sha256


def _read_settings(
    document: TomlDocument, path: KeyPath, entry: dict[str, Any], kind: KindRule, ground: Mapping[str, Quantity]
) -> Settings:
    """The entry's settings, defaults filled in; ``ground`` are those of [rig]."""
    rules = kind.setting_rules
    stated = {key: rule.read(document, (*path, key), entry[key]) for key, rule in rules.items() if key in entry}
    for key in kind.required:
        if key not in stated:
            raise document.error(path, f"{kind.name} must have a {key}", "none", f"add {key} = ...")
    shared = {key: value for key, value in ground.items() if key in rules}
    return kind.settings(**{**shared, **stated})


def _with_reading_error(
    document: TomlDocument, path: KeyPath, entry: dict[str, Any], column: Column, kind: KindRule
) -> Column:
    """The column with its stated sd and resolution."""
    stated: dict[str, float | None] = {}
    for suffix in _READING_ERRORS:
        key, si = column.name + suffix, kind.columns[column.name].si
        stated[suffix] = read_quantity(document, (*path, key), entry[key], si).value if key in entry else None
        if (size := stated[suffix]) is None:
            continue
        smallest = SMALLEST_RELATIVE_ERROR * max(np.max(column.values), -np.min(column.values))
        if size < smallest:
            rule = f"{key} must not be below {SMALLEST_RELATIVE_ERROR:g} of the largest reading ({smallest:.1g} in SI units)"
            raise document.error((*path, key), rule, f"{size:g}", "correct the value or its unit, or remove it")
    return Column(column.name, column.unit, column.to_display, column.values, stated["_sd"], stated["_resolution"])


def _refuse_reading_errors_without_column(
    document: TomlDocument, path: KeyPath, entry: dict[str, Any], keys: list[str], file: TableFile
) -> None:
    """Refuse reading errors of columns that the file does not have."""
    for key in keys:
        column = key.rsplit("_", 1)[0]
        if key in entry and column not in file.columns:
            value = " ".join(file.columns)
            raise document.error(
                (*path, key), f"{key} needs a column {column}", f"columns {value}", "remove it", of_key=True
            )
