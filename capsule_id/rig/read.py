"""Reads a rig folder into a ``Rig``: ``rig.toml`` by the rules of the kinds, tables in SI, rules between tables."""

import hashlib
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path, PureWindowsPath
from types import MappingProxyType
from typing import Any
from unicodedata import normalize

import numpy as np

from capsule_id.console import stop_if_interrupted
from capsule_id.errors import InputError, collecting, raise_all
from capsule_id.parameters import ROUNDING, TABLE_1, Parameter, Prior
from capsule_id.rig.formats import EXPORTS, READERS, suffix_of
from capsule_id.rig.formats.layouts import units_of_header
from capsule_id.rig.formats.raw import Export, Layout, RawTable, TextFile
from capsule_id.rig.formats.text import is_stamp
from capsule_id.rig.guess import find_layout, fits_name, proposal, refuse_no_readings
from capsule_id.rig.maps import (
    LAYOUT,
    MAP_KEYS,
    apply_map,
    clock_of,
    on_reference,
    read_map,
    refuse_idle_errors,
    without_stated_errors,
)
from capsule_id.rig.model import Column, Quantity, Rig, Settings, Table
from capsule_id.rig.plateaus import Plateaus, read_plateaus, readings_of_plateaus, without_outliers
from capsule_id.rig.schema import (
    RIG_QUANTITIES,
    RIG_WORDS,
    SPRINGS_AND_GAPS,
    TABLE_KEYS,
    ColumnRule,
    Entry,
    KindRule,
    NameRule,
    check_engine,
    check_masses,
    check_normal_forces,
    parameter_rows,
    read_confirmed,
    read_model,
    read_plan,
    read_rules,
)
from capsule_id.rig.times import Record, records_of, remedy_of_order
from capsule_id.rig.toml import LARGEST, NAME_PATTERN, SMALLEST, Node, is_plausible, parse_toml, remedy_for, shown
from capsule_id.rig.units import STAMP, UnitError, factor_to_si, scale
from capsule_id.views import Finding

# folder: ``rig.toml`` and the rules between its entries.


_READING_ERRORS = ("_sd", "_resolution", "_instrument")


def read_rig(
    folder: str | Path, kinds: Mapping[str, KindRule], parameters: Sequence[Parameter] = (), planned: bool = False
) -> Rig:
    """Read and check a rig folder.

    Parameters
    ----------
    folder : holds ``rig.toml`` and the tables that it names; or the path of ``rig.toml``
    kinds : the kinds of experiments that it may have, by name
    parameters : further rows that ``[prior]`` may state, those of a friction law
    planned : leave out the experiments, whose files may not be there yet

    Returns
    -------
    Rig
        In SI units, arrays read-only, settings with their defaults filled in.

    Raises
    ------
    InputError
        At a fault: file, line and column, the rule, the value found, the remedy. Several are a ``FolderError``: those of
        rig.toml, and of every experiment the first one in its files. What depends on faulty parts is not judged.
    """
    root, sha256 = _read_document(Path(folder))
    root.refuse_unknown(("rig", "model", "prior", "instrument", "experiment", "plan"))
    if "rig" not in root:
        raise InputError("rig.toml must have a table [rig]", "none", "add [rig] with a name", root.document.path, 1, 1)
    faults = list[InputError]()
    words, stated = _read_head(root["rig"].table("[rig]"), faults)
    ground = {key: stated[key] for key in ("slope", "N0") if key in stated}
    tables, files = ((), {}) if planned else _read_experiments(root, kinds, ground, faults)
    rows = (*parameter_rows(kinds).values(), *parameters)
    with collecting(faults):
        priors = _read_priors(root, None if planned else tables, rows, faults)
    with collecting(faults):
        model = read_model(root)
    with collecting(faults):
        plan = read_plan(root, kinds)
    raise_all(faults)
    check_masses(root, model, tables, kinds, set(stated))
    check_engine(root, model, tables)
    check_normal_forces(root, tables, stated)
    return Rig(
        name=words["name"],
        synthetic=words.get("synthetic", False),
        m1=stated.get("m1"),
        m2=stated.get("m2"),
        g=stated["g"],
        priors=MappingProxyType(priors),
        tables=tables,
        files=MappingProxyType({"rig.toml": sha256, **files}),
        folder=root.document.path.parent,
        model=model,
        slope=stated.get("slope"),
        N0=stated.get("N0"),
        confirmed=() if planned else read_confirmed(root, tables, stated),
        plan=plan,
    )


def _read_head(head: Node, faults: list[InputError]) -> tuple[dict[str, Any], dict[str, Quantity]]:
    """Words and quantities of [rig]; errors are appended to ``faults``."""
    words, stated = dict[str, Any](), {"g": Quantity(TABLE_1["g"])}
    with collecting(faults):
        head.refuse_unknown(TABLE_KEYS["[rig]"], TABLE_KEYS)
        if "name" not in head:
            raise head.error("[rig] must have a name", "none", 'add name = "..."')
    with collecting(faults):
        words = read_rules(head, RIG_WORDS)
    for key, rule in RIG_QUANTITIES.items():
        if key in head:
            with collecting(faults):
                stated[key] = head[key].quantity(rule.si, rule.domain, rule.has_sd)
    return words, stated


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


def _read_priors(
    root: Node, tables: Sequence[Table] | None, parameters: Sequence[Parameter], faults: list[InputError]
) -> dict[str, Prior]:
    """The entries of ``[prior]``, by parameter name; they may state the priors of ``parameters``.

    Errors are appended to ``faults``. Where there are some, or no ``tables`` are read, a spring may be missing.
    """
    entries = root.get("prior", {}).table("[prior]")
    rows = {row.symbol: row for row in parameters if row.prior_can_be_stated}
    known = ["k2[<spring>]" if symbol == "k2" else symbol for symbol in sorted(rows, key=lambda s: rows[s].scatter)]
    springs = sorted(
        {
            name
            for table in tables or ()
            for key, _ in SPRINGS_AND_GAPS
            if (name := getattr(table.settings, key, None)) is not None
        }
    )
    priors, whole = dict[str, Prior](), tables is not None and not faults
    for key in entries.value:
        node, spring = entries[key], re.fullmatch(rf"k2\[({NAME_PATTERN})\]", key)
        with collecting(faults):
            if spring and spring[1] not in springs and whole:
                raise node.error(
                    "a prior of k2 must name a spring of an experiment",
                    spring[1],
                    f"write {' or '.join(f'k2[{name}]' for name in springs)}" if springs else "remove it",
                    of_key=True,
                )
            if key.startswith("k2") and not spring:
                name = f'"k2[{springs[0] if springs else "soft"}]"'
                raise node.error("a prior of k2 must name a spring of an experiment", key, f"write {name}", of_key=True)
            if not spring:
                replace(entries, value={key: node.value}).refuse_unknown(known)
            if any(getattr(getattr(table.settings, key, None), "sd", 0.0) for table in tables or ()):
                rule = f"the prior of {key} is that of the experiments, which state it"
                raise node.error(rule, "both", f"remove it from [prior], or {key} from the experiments", of_key=True)
            row = rows["k2" if spring else key]
            assert row.prior is not None, "its prior can be stated"
            priors[key] = node.prior(row.unit, row.prior)
    return priors


def _read_experiments(
    root: Node, kinds: Mapping[str, KindRule], ground: Mapping[str, Quantity], faults: list[InputError]
) -> tuple[tuple[Table, ...], dict[str, str]]:
    """Every ``[[experiment]]``, and the sha256 of every file read; errors are appended to ``faults``."""
    entries = root.get("experiment", [])
    if not isinstance(entries.value, list) or not entries.value:
        none = entries.error(
            "a rig must have at least one [[experiment]]",
            shown(entries.value),
            'add [[experiment]] with kind = "..." and file = "..."',
        )
        raise_all([*faults, none])
    tables: list[Table] = []
    files: dict[str, str] = {}
    for index, label in enumerate(_default_labels(entries.value)):
        stop_if_interrupted()
        entry = entries[index]
        with collecting(faults):
            found, sha256 = _read_experiment(entry.table("[[experiment]]"), kinds, ground, label)
            if same := {table.label for table in found}.intersection(other.label for other in tables):
                raise entry[next(key for key in ("label", "file", "files") if key in entry)].error(
                    "labels must be unique", shown(min(same)), 'give one of them a label of its own: label = "..."'
                )
            tables += [replace(table, entry=index) for table in found]
            files |= sha256
    if not faults:
        refuse_idle_errors(root, tables)
    return tuple(tables), files


def _default_labels(entries: Sequence[Any]) -> list[str]:
    """The name of the first file of each entry, with what tells it from those of others: its folders, its suffix."""
    paths = []
    for entry in entries:
        stated = {} if not isinstance(entry, dict) or "label" in entry else entry
        files = stated.get("files")
        name = files[0] if isinstance(files, list) and files else stated.get("file")
        paths.append(Path(os.path.normpath(name)) if isinstance(name, str) else Path())
    alike = {path: {other for other in paths if other.stem == path.stem} for path in paths}
    folders = [path.parent.parts if len({other.parent for other in alike[path]}) > 1 else () for path in paths]
    names = [path.name if sum(o.parent == path.parent for o in alike[path]) > 1 else path.stem for path in paths]
    return ["_".join((*folder, name)) for folder, name in zip(folders, names, strict=True)]


def _read_experiment(
    entry: Node, kinds: Mapping[str, KindRule], ground: Mapping[str, Quantity], label: str
) -> tuple[list[Table], Mapping[str, str]]:
    """One entry with its tables, one for each record, and the sha256 of its files; ``label`` where the entry states none."""
    if "kind" not in entry:
        raise entry.error("an experiment must have a kind", "none", 'add kind = "..."')
    word = entry["kind"].text()
    if word not in kinds:
        raise entry["kind"].error(
            "unknown kind", shown(word), remedy_for(word, kinds, f"write one of {' '.join(kinds)}")
        )
    kind = kinds[word]
    rules, errors = kind.setting_rules, [column + suffix for column in kind.columns for suffix in _READING_ERRORS]
    entry.refuse_unknown(("kind", "file", "label", "reject", "clock", *MAP_KEYS, *rules, *errors), TABLE_KEYS)
    faults, stated = list[InputError](), dict[str, Any]()
    with collecting(faults):
        stated = read_rules(entry, {**rules, "label": NameRule()})
    faults += [
        entry.error(f"{kind.name} must have a {key}", "none", f"add {key} = ...")
        for key in kind.required
        if key not in entry
    ]
    label, settings = stated.pop("label", label), Settings()
    if not faults:
        settings = kind.settings(**{**{key: value for key, value in ground.items() if key in rules}, **stated})
    with collecting(faults):
        read, sha256 = read_tables(entry, kind, label, settings)
    raise_all(faults)
    tables = list[Table]()
    for table, raw in read:
        for key in errors:
            if key in entry and (column := key.rsplit("_", 1)[0]) not in table.columns:
                raise entry[key].error(
                    f"{key} needs a column {column}", f"columns {' '.join(table.columns)}", "remove it", of_key=True
                )
        columns = {
            key: without_stated_errors(entry, _with_reading_error(entry, column, kind), kind)
            for key, column in table.columns.items()
        }
        tables.append(replace(table, columns=MappingProxyType(columns)))
        for rule in kind.rules:
            rule(Entry(tables[-1], entry, raw))
    return tables, sha256


def _with_reading_error(entry: Node, column: Column, kind: KindRule) -> Column:
    """The column with its stated sd and resolution."""
    # Below it rounding exceeds the error.
    smallest = ROUNDING * max(np.max(column.values), -np.min(column.values))
    stated: list[float | None] = []
    for key in (f"{column.name}_sd", f"{column.name}_resolution"):
        size = entry[key].quantity(kind.columns[column.name].si).value if key in entry else None
        if size is not None and size < smallest:
            raise entry[key].error(
                f"{key} must not be below {ROUNDING:g} of the largest reading ({smallest:.1g} in SI units)",
                f"{size:g}",
                "correct the value or its unit, or remove it",
            )
        stated.append(size)
    return replace(column, sd=stated[0], resolution=stated[1])


# tables: Reads the files of one experiment: path check, bytes, hash, column map, columns in SI.


_A_TRIAL = "a row per trial"


def table_path(node: Node) -> Path:
    """The path of the table that ``node`` names, a regular file inside the rig folder.

    Raises
    ------
    InputError
        At the ``file`` key of ``rig.toml``.
    """
    folder, name = node.document.path.parent, node.text()
    remedy = "put the file into the rig folder and write its path relative to that folder"
    if Path(name).is_absolute() or PureWindowsPath(name).drive or not name.isprintable():
        raise node.error("file must be a path relative to the rig folder", shown(name), remedy)
    file = folder / name
    try:
        inside = file.resolve().is_relative_to(folder.resolve())
        exists, regular = file.exists(), file.is_file()
    except (OSError, RuntimeError, ValueError) as error:
        raise node.error("file must be a readable file", f"{shown(name)} ({error})", remedy) from None
    beside = file.parent.glob("*") if inside and not exists else ()
    tables = [p.relative_to(folder).as_posix() for p in beside if suffix_of(p) in EXPORTS]
    for holds, rule, cure in (
        (inside, "lie inside the rig folder, links followed", remedy),
        (exists, "exist", remedy_for(name, tables, "correct the name or add the file")),
        (regular, "be a regular file", "name a table, not a folder or device"),
        (suffix_of(file) in EXPORTS, f"be a table of a known kind ({' '.join(EXPORTS)})", "export it as CSV"),
    ):
        if not holds:
            raise node.error(f"file must {rule}", shown(name), cure)
    return file


def read_tables(
    entry: Node, kind: KindRule, label: str, settings: Settings
) -> tuple[list[tuple[Table, RawTable]], dict[str, str]]:
    """The tables of an experiment, one for each record, by its column map if it has one.

    Their columns are checked, still without reading errors. Also each table as written, without its numbers, and the
    sha256 of the bytes read by the names of the files.

    Raises
    ------
    InputError
        At a key of ``rig.toml`` or at a place in a file.
    """
    files: dict[str, Path] = {}
    contents: dict[str, bytes] = {}
    nodes = _file_nodes(entry)
    for node in nodes:
        file, name = table_path(node), node.value
        if file in files.values():
            raise node.error("files must be named once", shown(name), "remove the second one")
        try:
            files[name], contents[name] = file, file.read_bytes()
        except OSError as error:
            raise node.error(
                "file must be readable", f"{shown(name)} ({error.strerror})", "check its permissions"
            ) from None
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    first = files[nodes[0].value]
    plateaus, seen = read_plateaus(entry, kind), list[Finding]()
    column_map = read_map(entry, kind, partial(_proposal, first, kind))
    if column_map is None:
        parts = [("", _read_plain(nodes[0], first, contents.pop(nodes[0].value), kind))]
        encodings = {nodes[0].value: parts[0][1].encoding}
    else:
        # Plateaus replace the time by the column of their levels.
        names = tuple(column_map.sources)
        if plateaus is not None:
            names = (*(name for name in names if name != "time"), plateaus[0])
        _check_names(names, kind, lambda name, *text: entry["columns"].error(*text))
        exports = {
            name: EXPORTS[suffix_of(file)](contents.pop(name), file, column_map.layout) for name, file in files.items()
        }
        for export in exports.values():
            refuse_no_readings(export, column_map.layout)
        parts = apply_map(entry, list(exports.values()), column_map)
        encodings = {name: export.encoding for name, export in exports.items()}
        for name, export in exports.items():
            if "sheet" in entry and not export.sheet:
                raise entry["sheet"].error("sheet needs a workbook (.xlsx)", shown(name), "remove sheet", of_key=True)
            if export.others and "sheet" not in entry:
                facts = {"file": name, "sheet": export.sheet, "others": ", ".join(map(repr, export.others))}
                seen.append(Finding("readings.sheets", "ok", facts))
        del exports
    if column_map is not None and any(source.unit == STAMP for source in column_map.sources.values()):
        rows = sum(len(raw.rows) for _, raw in parts)
        seen.append(Finding("times.stamps", "ok", {"file": nodes[0].value, "rows": rows}))
    tables = list[tuple[Table, RawTable]]()
    for own, here, raw in _parted(entry, label, settings, parts):
        tables += _records(entry, kind, own, here, raw, plateaus, () if tables else tuple(seen))
    return [(replace(table, encodings=encodings), written) for table, written in tables], hashes


def _parted(
    entry: Node, label: str, settings: Settings, parts: Sequence[tuple[str, RawTable]]
) -> Iterable[tuple[str, Settings, RawTable]]:
    """Label, settings and rows of each part of an experiment, by its text in the column ``split_by``.

    The direction is backward where the text says so.

    Raises
    ------
    InputError
        If the texts are those of surfaces, which one fit of friction cannot have.
    """
    ends = [
        re.sub("[^A-Za-z0-9._-]+", "_", normalize("NFKD", name).encode("ascii", "ignore").decode()) for name, _ in parts
    ]
    ends = ends if len({*ends}) == len(ends) else [str(k + 1) for k in range(len(ends))]
    for end, (name, raw) in zip(ends, parts, strict=True):
        directed = bool(name) and "direction" in vars(settings)
        if directed and fits_name(split := entry["split_by"].text(), "surface") > 0:
            rule = "one fit has one surface: the rows of one alone may be used"
            remedy = f'write where = {{ "{split}" = "{name}" }} in place of split_by'
            raise entry["split_by"].error(rule, split, remedy, of_key=True)
        backward = directed and fits_name(name, "backward") > 0
        here = replace(settings, **{"direction": "backward"}) if backward else settings
        yield f"{label}_{end}" if name else label, here, raw


def _records(
    entry: Node,
    kind: KindRule,
    label: str,
    settings: Settings,
    raw: RawTable,
    plateaus: Plateaus | None,
    findings: tuple[Finding, ...],
) -> list[tuple[Table, RawTable]]:
    """The tables of the records in ``raw``, SI, without outliers, and each as written, without its numbers.

    The first one has ``findings`` on the file.
    """
    nodes, tables = _file_nodes(entry), []
    increasing = "time" in raw.names and "time" in kind.columns and plateaus is None and len(nodes) == 1
    records = records_of(raw, nodes[0].value) if increasing else [Record(raw)]
    records = [part for record in records for part in _divided(entry, kind, settings, record)]
    labels = [label] if len(records) == 1 else [f"{label}_{k + 1}" for k in range(len(records))]
    for own, record in zip(labels, records, strict=True):
        one, drift = record.raw, record.drift
        if (clock := clock_of(entry)) is not None:
            one, stated = on_reference(clock, one)
            drift = replace(stated, sd=float(np.hypot(stated.sd, drift.sd)))
        if "reject" in entry:
            one = without_outliers(entry["reject"], one, _times)
        if plateaus is not None:
            one = readings_of_plateaus(entry["plateaus"], one, _times(one), plateaus)
        one.rows.flags.writeable = False
        columns = {column: _to_si(one, index, kind.columns[column]) for index, column in enumerate(one.names)}
        dropped = one.lost, one.other, one.rejected
        table = Table(kind.name, own, nodes[0].value, columns, settings, one.rows, kind.bench, *dropped, drift=drift)
        tables.append((replace(table, findings=(*findings, *record.findings)), replace(one, columns=())))
        findings = ()
    return tables


def _divided(entry: Node, kind: KindRule, settings: Settings, record: Record) -> list[Record]:
    """The parts of a record, by the rule of its kind; the finding names the times of each, and those of none."""
    raw = record.raw
    if kind.divide is None or "time" not in raw.names or not isinstance(settings, kind.settings):
        return [record]
    columns = {name: _to_si(raw, index, kind.columns[name]).values for index, name in enumerate(raw.names)}
    owners = kind.divide(entry, columns, settings)
    if owners is None:
        return [record]
    edges = [0, *(1 + np.flatnonzero(np.diff(owners))), len(owners)]
    spans = [
        (owners[a] >= 0, f"{columns['time'][a]:.6g} to {columns['time'][b - 1]:.6g} s") for a, b in pairwise(edges)
    ]
    used, left = (", ".join(text for own, text in spans if own == kept) for kept in (True, False))
    parts = raw.divided(owners)
    facts = {"file": _file_nodes(entry)[0].value, "records": len(parts), "used": used, "left": left or "nothing"}
    done = Finding("times.parts", "ok", facts)
    return [Record(part, record.drift, () if k else (*record.findings, done)) for k, part in enumerate(parts)]


def read_settings(path: Path, kind: KindRule, without: str) -> dict[str, Column]:
    """Columns of a file with the settings of new experiments: those of ``kind`` without the reading ``without``.

    Raises
    ------
    InputError
        At a place in the file.
    """
    if not path.is_file() or path.suffix.lower() not in READERS:
        raise InputError("the settings must be a table", "no such table", f"name a file of {' '.join(READERS)}", path)
    columns = {name: rule for name, rule in kind.columns.items() if name != without}
    sets = tuple(tuple(name for name in names if name != without) for names in kind.sets)
    raw = READERS[path.suffix.lower()](path.read_bytes(), path)
    if len(raw.lost):
        raise InputError("settings must have no missing cell", "one", "fill it", path, int(raw.lost[0]), 1)
    _check_names(raw.names, replace(kind, columns=columns, sets=sets), partial(raw.error, None))
    return {name: _to_si(raw, index, columns[name]) for index, name in enumerate(raw.names)}


def _file_nodes(entry: Node) -> list[Node]:
    """The files of an experiment."""
    if "files" not in entry:
        if "file" not in entry:
            raise entry.error("an experiment must have a file", "none", 'add file = "..."')
        return [entry["file"]]
    node = entry["files"]
    if "file" in entry:
        raise node.error("an experiment has file or files", "both", "remove file", of_key=True)
    files = isinstance(node.value, list) and bool(node.value)
    node.require(files, "be a list of files", 'write files = ["...", "..."]')
    return [node[index] for index in range(len(node.value))]


def _read_plain(node: Node, file: Path, content: bytes, kind: KindRule) -> RawTable:
    """A file with the column names of the kind; an error about its header proposes a column map."""
    suffix = suffix_of(file)
    if suffix not in READERS:
        raise node.error(f"a {suffix} file needs a column map", "no columns", f"add {_proposal(file, kind, Layout())}")
    try:
        raw = READERS[suffix](content, file)
        _check_names(raw.names, kind, partial(raw.error, None))
        export = Export(file, (raw.names,), len(raw.names), raw.rows, raw.columns.__getitem__, raw.place, cells=list)
        refuse_no_readings(export, Layout(columns=raw.names))
    except InputError as error:
        stamp = is_stamp(error.value.strip("'"))
        keys = not stamp and any(f"{key} = " in error.remedy for key in LAYOUT)
        if not (keys or stamp or error.line == 1) or _A_TRIAL in error.remedy:
            raise
        remedy = f"; or add {_proposal(file, kind, Layout())} to the experiment, and no other column is read"
        if keys:
            units = enumerate(units_of_header(TextFile(content, file))[1].items(), 1)
            columns = ", ".join(f'{name} = {{ from = {k}, unit = "{unit}" }}' for k, (name, unit) in units)
            remedy = f", in the experiment with columns = {{ {columns} }}"
        raise InputError(error.rule, error.value, error.remedy + remedy, file, error.line, error.column) from None
    return raw


def _proposal(file: Path, kind: KindRule, layout: Layout) -> str:
    """The column map that reads a file as ``kind``."""
    found, first = None, ""
    with suppress(InputError):
        found = find_layout(file.read_bytes(), file, sorted({rule.si for rule in kind.columns.values()}))
        if found.layout.data_from_line != layout.data_from_line is None:
            first = f"data_from_line = {found.layout.data_from_line} and "
    return first + proposal(kind, found)


def _times(raw: RawTable) -> np.ndarray:
    """The times of a record, (n,) s, increasing."""
    return _to_si(raw, raw.names.index("time"), ColumnRule("s", increasing=True)).values


def _check_names(names: Sequence[str], kind: KindRule, error: Callable[[str, str, str, str], InputError]) -> None:
    """Refuse unknown columns, a wrong set of columns, and a table without a channel where the kind has channels.

    ``error`` makes the error about a column from rule, value and remedy.
    """
    sets = ", or ".join(" and ".join(columns) for columns in kind.sets)
    for name in names:
        if name not in kind.columns:
            if name == "time":
                raise error(
                    name,
                    f"{kind.name} must be a table of trials",
                    "a record against time",
                    f"read {sets} off the record, {_A_TRIAL}, and repeat the trial; plateaus reads steps of one record",
                )
            remedy = remedy_for(name, kind.columns, "remove it", "rename it to {}")
            raise error(
                name, f"unknown column in {kind.name}", shown(name), f"{remedy}; known: {' '.join(kind.columns)}"
            )
    stated = {name for name in names if name not in (*kind.channels, *kind.optional)}
    if stated not in [set(columns) for columns in kind.sets]:
        raise error(names[0], f"{kind.name} must have the columns {sets}", " and ".join(names), "add or remove columns")
    if kind.channels and not set(kind.channels).intersection(names):
        raise error(
            names[0],
            f"{kind.name} must have a channel beside {' and '.join(sorted(stated))}",
            " ".join(names),
            f"add one of {' '.join(kind.channels)}",
        )


def _to_si(raw: RawTable, index: int, rule: ColumnRule) -> Column:
    """Column ``index`` in SI; its values obey ``rule``."""
    name, unit, written = raw.names[index], raw.units[index], raw.columns[index]
    try:
        factor = factor_to_si(unit, rule.si)
    except UnitError as error:
        raise raw.error(None, name, f"{name}: {error.rule}", shown(unit), error.remedy) from None
    with np.errstate(over="ignore"):
        values = written if factor == 1.0 else scale(written, factor)
    _check_values(raw, index, rule, values)
    if rule.varies and np.ptp(values) == 0.0:
        one = len(values) == 1
        raise raw.error(
            0 if one else None,
            name,
            *(f"{name} must vary over the rows", "one row", "add rows")
            if one
            else (
                f"{name} must not be constant",
                f"{written[0]:g} {unit} in every row",
                "check the sensor and the export",
            ),
        )
    values.flags.writeable = False
    return Column(name, unit, 1.0 / factor, values)


def _check_values(raw: RawTable, index: int, rule: ColumnRule, values: np.ndarray) -> None:
    """Refuse a value of column ``index`` outside its domain, or out of order, (n,) SI."""
    name, unit = raw.names[index], raw.units[index]
    signed = [c for own, c in zip(raw.names, raw.columns, strict=True) if own != "normal_force"]
    # Sliding and pulls; a single sign may be a slip of the pen.
    directed = name in ("speed", "force") and np.sum(values < 0.0) > 1
    correct = (
        f"where the sign is the direction, move the rows with {name} < 0 to a file of their own without the minus signs, "
        'in an experiment of the same kind with direction = "backward"'
        if directed and all(np.array_equal(np.sign(c), np.sign(values)) for c in signed)
        else "correct the value or delete the row"
    )
    magnitude = f"be 0 or lie between {SMALLEST:g} and {LARGEST:g} in SI units"
    checks: list[tuple[Callable[[], np.ndarray], str, str | None]] = [
        (lambda: np.isfinite(values) & rule.domain.holds(values), rule.domain.text, correct),
        (lambda: is_plausible(values), magnitude, "correct the value or the unit of the column"),
        (lambda: np.diff(values, prepend=-np.inf) > 0.0, "increase from row to row", None),
    ]
    for holds, text, remedy in checks[: 2 + rule.increasing]:
        if not (good := holds()).all():
            row = int(np.argmin(good))
            if remedy is None:
                same = raw.place(row, index)[0] == raw.place(row - 1, index)[0]
                in_files = "name the files in the order of time, or make an experiment of each"
                remedy = remedy_of_order(raw, index) if same else in_files
            raise raw.error(row, name, f"{name} must {text}", f"{raw.columns[index][row]:g} {unit}", remedy)
