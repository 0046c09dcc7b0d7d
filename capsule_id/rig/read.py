"""Reads a rig folder into a ``Rig``: ``rig.toml`` by the rules of the kinds, tables in SI, rules between tables."""

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from capsule_id.console import stop_if_interrupted
from capsule_id.errors import InputError, collecting, raise_all
from capsule_id.parameters import Parameter, Prior
from capsule_id.rig.formats.raw import TextFile
from capsule_id.rig.maps import MAP_KEYS
from capsule_id.rig.model import Column, Quantity, Rig, Table
from capsule_id.rig.schema import (
    RIG_QUANTITIES,
    TABLE_KEYS,
    Entry,
    KindRule,
    check_engine,
    check_masses,
    check_normal_forces,
    parameter_rows,
    read_confirmed,
    read_model,
    read_rules,
)
from capsule_id.rig.tables import read_table
from capsule_id.rig.toml import NAME_PATTERN, Node, closest, parse_toml, shown

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
    root, sha256 = _read_document(Path(folder))
    root.refuse_unknown(("rig", "model", "prior", "experiment"))
    if "rig" not in root:
        place = root.document.path, 1, 1
        raise InputError("rig.toml must have a table [rig]", "none", "add [rig] with a name", *place)
    head = root["rig"].table("[rig]")
    head.refuse_unknown(TABLE_KEYS["[rig]"], TABLE_KEYS)
    if "name" not in head:
        raise head.error("[rig] must have a name", "none", 'add name = "..."')
    name, synthetic = head["name"].name(), head.get("synthetic", False)
    synthetic.require(isinstance(synthetic.value, bool), "be true or false", "write true or false without quotes")
    faults: list[InputError] = []
    stated = {"g": Quantity(STANDARD_GRAVITY)}
    for key, rule in RIG_QUANTITIES.items():
        if key in head:
            with collecting(faults):
                stated[key] = head[key].quantity(rule.si, rule.domain, rule.has_sd)
    ground = {key: stated[key] for key in ("slope", "N0") if key in stated}
    tables, files = _read_experiments(root, kinds, ground, faults)
    raise_all(faults)
    model = read_model(root)
    check_masses(root, model, tables, kinds, set(stated))
    check_engine(root, model, tables)
    check_normal_forces(root, tables, stated)
    rows = [*parameter_rows(kinds).values(), *parameters]
    return Rig(
        name=name,
        synthetic=synthetic.value,
        m1=stated.get("m1"),
        m2=stated.get("m2"),
        g=stated["g"],
        priors=MappingProxyType(_read_priors(root, tables, rows)),
        tables=tables,
        files=MappingProxyType({"rig.toml": sha256, **files}),
        folder=root.document.path.parent,
        model=model,
        slope=stated.get("slope"),
        N0=stated.get("N0"),
        confirmed=read_confirmed(root, tables, stated),
    )


def _read_document(folder: Path) -> tuple[Node, str]:
    """``rig.toml``, parsed and located, and its sha256."""
    folder = folder.parent if folder.name == "rig.toml" and folder.is_file() else folder
    path = folder / "rig.toml"
    try:
        if not folder.is_dir():
            raise InputError(
                "the rig must be a folder",
                "a file" if folder.is_file() else "no such folder",
                "name a folder with a rig.toml",
                folder,
            )
        if not path.is_file():
            raise InputError(
                "a rig folder must contain a file rig.toml",
                "none",
                "run `capsule-id init DIR` for a commented one",
                path,
                1,
                1,
            )
        if not path.resolve().is_relative_to(folder.resolve()):
            raise InputError(
                "rig.toml must lie inside the folder, links followed", "a link", "copy the file here", path, 1, 1
            )
        content = path.read_bytes()
    except (OSError, RuntimeError) as error:  # RuntimeError: a loop of links
        raise InputError("rig.toml must be readable", str(error), "check path and permissions", path, 1, 1) from None
    document = parse_toml("\n".join(TextFile(content, path).lines()), path)
    return Node(document, (), document.data), hashlib.sha256(content).hexdigest()


def _read_priors(root: Node, tables: Sequence[Table], parameters: Sequence[Parameter]) -> dict[str, Prior]:
    """The entries of ``[prior]``, by parameter name; they may state the priors of ``parameters``."""
    entries = root.get("prior", {}).table("[prior]")
    rows = {row.symbol: row for row in parameters if row.prior_can_be_stated}
    known = ["k2[<spring>]" if symbol == "k2" else symbol for symbol in sorted(rows, key=lambda s: rows[s].scatter)]
    springs = sorted({table.settings.spring for table in tables if getattr(table.settings, "spring", None)})
    priors = {}
    for key in entries.value:
        node, spring = entries[key], re.fullmatch(rf"k2\[({NAME_PATTERN})\]", key)
        if spring and spring[1] not in springs:
            raise node.error(
                "a prior of k2 must name a spring of an experiment",
                spring[1],
                f"write {' or '.join(f'k2[{name}]' for name in springs)}" if springs else "remove it",
                of_key=True,
            )
        if not spring:
            replace(entries, value={key: node.value}).refuse_unknown(known)
        row = rows["k2" if spring else key]
        assert row.prior is not None, "its prior can be stated"
        priors[key] = node.prior(row.unit, row.prior)
    return priors


def _read_experiments(
    root: Node, kinds: Mapping[str, KindRule], ground: Mapping[str, Quantity], faults: list[InputError]
) -> tuple[tuple[Table, ...], dict[str, str]]:
    """Every ``[[experiment]]``, and the sha256 of every file read; the first error of each is appended to ``faults``."""
    entries = root.get("experiment", [])
    if not isinstance(entries.value, list) or not entries.value:
        raise entries.error(
            "a rig must have at least one [[experiment]]",
            shown(entries.value),
            'add [[experiment]] with kind = "..." and file = "..."',
        )
    tables: list[Table] = []
    files: dict[str, str] = {}
    for index, label in enumerate(_default_labels(entries.value)):
        stop_if_interrupted()
        entry = entries[index]
        with collecting(faults):
            table, sha256 = _read_experiment(entry.table("[[experiment]]"), kinds, ground, label)
            if table.label in [other.label for other in tables]:
                place = next(key for key in ("label", "file", "files") if key in entry)
                raise entry[place].error(
                    "labels must be unique", shown(table.label), 'give one of them a label of its own: label = "..."'
                )
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
    entry: Node, kinds: Mapping[str, KindRule], ground: Mapping[str, Quantity], label: str
) -> tuple[Table, Mapping[str, str]]:
    """One entry with its table, and the sha256 of its files; ``label`` where the entry states none."""
    if "kind" not in entry:
        raise entry.error("an experiment must have a kind", "none", 'add kind = "..."')
    word = entry["kind"].text()
    if word not in kinds:
        close = closest(word, kinds)
        raise entry["kind"].error(
            "unknown kind", shown(word), f'write "{close}"' if close else f"write one of {' '.join(kinds)}"
        )
    kind = kinds[word]
    rules, errors = kind.setting_rules, [column + suffix for column in kind.columns for suffix in _READING_ERRORS]
    entry.refuse_unknown(("kind", "file", "label", "reject", "clock", *MAP_KEYS, *rules, *errors), TABLE_KEYS)
    stated = read_rules(entry, rules)
    for key in kind.required:
        if key not in stated:
            raise entry.error(f"{kind.name} must have a {key}", "none", f"add {key} = ...")
    settings = kind.settings(**{**{key: value for key, value in ground.items() if key in rules}, **stated})
    label = entry["label"].name() if "label" in entry else label
    table, raw, sha256 = read_table(entry, kind, label, settings)
    for key in errors:
        if key in entry and (column := key.rsplit("_", 1)[0]) not in table.columns:
            raise entry[key].error(
                f"{key} needs a column {column}", f"columns {' '.join(table.columns)}", "remove it", of_key=True
            )
    columns = {key: _with_reading_error(entry, column, kind) for key, column in table.columns.items()}
    table = replace(table, columns=MappingProxyType(columns))
    for rule in kind.rules:
        rule(Entry(table, entry, raw))
    return table, sha256


def _with_reading_error(entry: Node, column: Column, kind: KindRule) -> Column:
    """The column with its stated sd and resolution."""
    smallest = SMALLEST_RELATIVE_ERROR * max(np.max(column.values), -np.min(column.values))
    stated: list[float | None] = []
    for key in (column.name + suffix for suffix in _READING_ERRORS):
        size = entry[key].quantity(kind.columns[column.name].si).value if key in entry else None
        if size is not None and size < smallest:
            raise entry[key].error(
                f"{key} must not be below {SMALLEST_RELATIVE_ERROR:g} of the largest reading ({smallest:.1g} in SI units)",
                f"{size:g}",
                "correct the value or its unit, or remove it",
            )
        stated.append(size)
    return replace(column, sd=stated[0], resolution=stated[1])
