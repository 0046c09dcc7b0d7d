"""Rigs of the twin with a planted fault, in memory."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.read import read_rig
from capsule_id.synthetic import Truth, synthesize
from capsule_id.views import Finding
from tests.cli_tools import DATA

KINDS = default_registry()
Fault = Callable[[Rig, np.random.Generator], Rig]


def rig_of(folder: Path, seed: int) -> Rig:
    """A synthetic bench whose stiffness, damping, friction and mass differ from seed to seed."""
    rng = np.random.default_rng(seed)
    usual = {"k1": 0.3, "c": 0.3, "mu": 0.15, "m1": 0.2, "K": 0.3}
    truth = Truth().with_values({k: Truth()[k] * np.exp(sd * rng.standard_normal()) for k, sd in usual.items()})
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


def wrong_unit(rig: Rig, rng: np.random.Generator) -> Rig:
    """Multiply one mass or one column by 1000, or divide it by 1000."""
    factor = float(rng.choice([1e3, 1e-3]))
    place = int(rng.integers(len(rig.tables) + 1))
    if place == len(rig.tables):
        name = str(rng.choice(["m1", "m2"]))
        mass = getattr(rig, name)
        return replace(rig, **{name: replace(mass, value=factor * mass.value)})
    table = rig.tables[place]
    name = str(rng.choice([name for name in table.columns if name != "angle"] or ["angle"]))
    if name == "angle":
        factor = 1e-3
    return with_table(rig, place, with_values(table, **{name: factor * table[name]}))


def mislabelled(rig: Rig, rng: np.random.Generator) -> Rig:
    """Swap two columns, or turn the sign of one, of a forced run or of the pushes; numbers and units stay as written."""
    kind = str(rng.choice(["forced_run", "dynamic_friction"], p=[0.8, 0.2]))
    index = pick(rig, rng, kind)
    table = rig.tables[index]
    if kind == "dynamic_friction":
        return with_table(rig, index, swapped(table, "speed", "distance"))
    which = int(rng.integers(4))
    if which == 0:
        return with_table(rig, index, swapped(table, "x_rel", "acceleration_rod"))
    if which == 1:
        numbers = table["x_rel"] * table.columns["x_rel"].to_display
        return with_table(rig, index, with_values(table, acceleration_rod=numbers))
    if which == 2:
        return with_table(rig, index, with_values(table, x_rel=-table["x_rel"]))
    return with_table(rig, index, swapped(table, "x_rel", "current"))


def swapped(table: Table, one: str, other: str) -> Table:
    """The table with the numbers of two columns exchanged under their headers."""
    first, second = table.columns[one], table.columns[other]
    values = {
        one: second.values * second.to_display / first.to_display,
        other: first.values * first.to_display / second.to_display,
    }
    return with_values(table, **values)


def run_rig(folder: Path, seed: int) -> Rig:
    """The rig of ``data/`` with further noise on every channel of the runs."""
    del folder
    rig, rng = read_rig(DATA, KINDS), np.random.default_rng(seed)
    noise = {"x_rel": 1e-5, "x_capsule": 1e-5, "acceleration_rod": 0.5, "current": 5e-3}
    for index, table in enumerate(rig.tables):
        if not table.bench:
            noisy = {n: table[n] + sd * rng.standard_normal(len(table.rows)) for n, sd in noise.items()}
            rig = with_table(rig, index, with_values(table, **noisy))
    return rig
