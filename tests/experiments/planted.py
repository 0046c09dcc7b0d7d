"""Rigs of the twin with a planted fault, in memory."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from capsule_id.experiments.lint import lint
from capsule_id.experiments.registry import default_registry
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.read import read_rig
from capsule_id.synthetic import Truth, synthesize
from capsule_id.views import Finding

KINDS = default_registry()
Fault = Callable[[Rig, np.random.Generator], Rig]


def rig_of(folder: Path, seed: int) -> Rig:
    """A synthetic bench whose stiffness, damping, friction and mass differ from seed to seed."""
    rng = np.random.default_rng(seed)
    usual = {"k1": 0.3, "c": 0.3, "mu": 0.15, "m1": 0.2, "K": 0.3}
    truth = Truth().with_values({k: Truth().flat()[k] * np.exp(sd * rng.standard_normal()) for k, sd in usual.items()})
    synthesize(folder / f"rig{seed}", seed, truth)
    return read_rig(folder / f"rig{seed}", KINDS)


def named(rig: Rig) -> tuple[Finding, ...]:
    """What the lint of the whole rig finds, without hints on what is not stated."""
    hints = ("masses.exact", "readings.errors", "readings.few")
    return tuple(found for found in lint(rig, KINDS, rig.tables) if found.code not in hints)


def with_table(rig: Rig, index: int, table: Table) -> Rig:
    """The rig with one table replaced; its file is another one."""
    tables = list(rig.tables)
    tables[index] = table
    return replace(rig, tables=tuple(tables), files={**rig.files, table.file: f"changed {table.file}"})


def with_values(table: Table, **values: np.ndarray) -> Table:
    """The table with other values in some columns; all of one length."""
    columns = {
        name: column if name not in values else replace(column, values=values[name])
        for name, column in table.columns.items()
    }
    return replace(table, columns=columns, rows=np.arange(2, 2 + len(next(iter(columns.values())).values)))


def pick(rig: Rig, rng: np.random.Generator, kind: str = "") -> int:
    """Index of a random table, of ``kind`` where stated."""
    return int(rng.choice([i for i, table in enumerate(rig.tables) if kind in ("", table.kind)]))


def duplicate(rig: Rig, rng: np.random.Generator) -> Rig:
    """Copy a table under another name, in other units, or half of its rows into another place of it."""
    index = pick(rig, rng)
    table = rig.tables[index]
    if rng.random() < 0.5:
        other = replace(table, label="again", file="again.csv")
        return replace(rig, tables=(*rig.tables, other), files={**rig.files, "again.csv": "other bytes"})
    n = len(table.rows)
    part = slice(0, max(2, n // 3))
    values = {name: np.concatenate([column.values, column.values[part]]) for name, column in table.columns.items()}
    if "time" in values:
        time = values["time"]
        time[n:] = time[n - 1] + (np.arange(len(time) - n) + 1) * (time[1] - time[0])
    return with_table(rig, index, with_values(table, **values))


def clip(rig: Rig, rng: np.random.Generator) -> Rig:
    """Clip a decay at 95 % of the peak of its first swing."""
    index = pick(rig, rng, "free_vibration")
    table = rig.tables[index]
    limit = 0.95 * np.max(np.abs(table["x_rel"]))
    return with_table(rig, index, with_values(table, x_rel=np.clip(table["x_rel"], -limit, limit)))


def rest(rig: Rig, rng: np.random.Generator) -> Rig:
    """Start the recording at a random time before the release, the rod at rest or held."""
    index = pick(rig, rng, "free_vibration")
    table = rig.tables[index]
    x, time = table["x_rel"], table["time"]
    before = int(rng.integers(200, 6000))
    quiet = rng.choice([0.0, 1.0]) * x[0] + 0.01 * np.max(np.abs(x)) * rng.standard_normal(before)
    values = np.concatenate([quiet, x])
    return with_table(rig, index, with_values(table, x_rel=values, time=np.arange(len(values)) * (time[1] - time[0])))


def lose(rig: Rig, rng: np.random.Generator) -> Rig:
    """Lose 20 to 60 samples of a decay within its first one and a half periods, with and without a gap in the times."""
    index = pick(rig, rng, "free_vibration")
    table = rig.tables[index]
    start, lost = int(rng.integers(40, 160)), int(rng.integers(20, 60))
    kept = {name: np.delete(column.values, slice(start, start + lost)) for name, column in table.columns.items()}
    if rng.random() < 0.5:
        kept["time"] = table["time"][: len(kept["time"])]
    return with_table(rig, index, with_values(table, **kept))
