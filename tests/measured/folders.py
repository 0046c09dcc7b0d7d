"""Rig folders made of measured records."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.inference.result import Result
from capsule_id.rig.model import Rig
from capsule_id.views import ResultTable


@dataclass(frozen=True)
class Entry:
    """One [[experiment]]: kind, columns by header (``x_rel [m]``), and its further settings as TOML."""

    kind: str
    label: str
    columns: Mapping[str, np.ndarray]
    settings: Mapping[str, str] = field(default_factory=dict)


def quantity(value: float, unit: str, sd: float | None = None) -> str:
    """``{ value = ..., unit = ... }``."""
    middle = "" if sd is None else f"sd = {sd!r}, "
    return f'{{ value = {value!r}, {middle}unit = "{unit}" }}'


def make_rig(folder: Path, *entries: Entry, head: Mapping[str, str] | None = None) -> Rig:
    """Write a rig folder with ``entries`` and further lines ``head`` of [rig], and read it as ``fit-params`` does."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["[rig]", 'name = "measured"', *(f"{key} = {value}" for key, value in (head or {}).items())]
    for entry in entries:
        settings = "".join(f"{key} = {value}\n" for key, value in entry.settings.items())
        lines.append(f'\n[[experiment]]\nkind = "{entry.kind}"\nfile = "{entry.label}.csv"\n{settings}')
        rows = np.column_stack(list(entry.columns.values()))
        text = ",".join(entry.columns) + "\n" + "".join(",".join(repr(float(x)) for x in row) + "\n" for row in rows)
        (folder / f"{entry.label}.csv").write_text(text, encoding="utf-8")
    (folder / "rig.toml").write_text("\n".join(lines), encoding="utf-8")
    return read_rig(folder)


def note(result: Result, code: str) -> ResultTable:
    """The result's only table with this code."""
    (found,) = [table for table in result.notes if table.code == code]
    return found


def named_line(error: InputError) -> str:
    """The text of the line that an error names; "" where it names none."""
    lines = Path(error.file).read_text(encoding="utf-8").splitlines()
    return "" if error.line is None else lines[error.line - 1]
