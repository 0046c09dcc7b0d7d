"""Frozen values of a rig folder: SI units, float64, read-only arrays."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from capsule_id.errors import InputError
from capsule_id.parameters import ROUNDING, STEP_SD, Prior
from capsule_id.views import Finding, counted


@dataclass(frozen=True)
class Quantity:
    """A stated value with its standard deviation, SI. An ``sd`` of 0 means exact; it is the default."""

    value: float
    sd: float = 0.0


#: Fewest samples of a record: six unknowns of a free decay (k1, c, amplitude, phase, offset, noise) and two more.
SHORTEST_RECORD = 8
#: A clock that agrees with true time.
NO_DRIFT = Quantity(0.0)


@dataclass(frozen=True)
class ModelChoices:
    """The choices of ``[model]``.

    Attributes
    ----------
    friction : "stribeck": eq. (1); "constant": the same friction at every speed, ratio = 1 and no v_s
    free : symbols of the optional parameters that a fit samples
    reaction : what takes up the reaction of the drive: "ground", as in the paper, or "capsule", as for a coil inside it
    engine : what integrates the capsule model: "exact" (event-driven) or "smooth" (smoothed, with the certified widths)
    """

    friction: Literal["stribeck", "constant"] = "stribeck"
    free: tuple[str, ...] = ()
    reaction: Literal["ground", "capsule"] = "ground"
    engine: Literal["exact", "smooth"] = "exact"

    @property
    def share_of_reaction(self) -> float:
        """Share of the drive's force that pushes the capsule back, 1."""
        return 1.0 if self.reaction == "capsule" else 0.0


@dataclass(frozen=True)
class Instrument:
    """What a column was read with: reading = (1 + gain) truth + offset, SI.

    Columns of one instrument share its stated ``errors``, by symbol. ``unit`` is that of the offset. A clock states the
    ``drift`` of its table.
    """

    name: str
    unit: str = "1"
    errors: Mapping[str, Quantity] = field(default_factory=dict)

    def value(self, symbol: str) -> float:
        """Stated value of an error, SI; 0 where it is not stated."""
        return self.errors.get(symbol, NO_DRIFT).value


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes
    ----------
    name : the column's name in the file, e.g. ``x_rel``
    unit : the unit written in the file, e.g. ``mm`` (only for display)
    to_display : multiply SI by this to get the file's unit
    values : (n,) SI, read-only, without the stated gain and offset of its instrument
    sd : stated reading error, SI (None: not stated)
    resolution : stated reading step, SI (None: not stated)
    instrument : what it was read with (None: not stated)
    """

    name: str
    unit: str
    to_display: float
    values: np.ndarray
    sd: float | None = None
    resolution: float | None = None
    instrument: Instrument | None = None

    @property
    def reading_sd(self) -> float:
        """Stated error and the rounding error of the reading step, step/sqrt(12), added in quadrature; SI."""
        return float(np.hypot(self.sd or 0.0, (self.resolution or 0.0) * STEP_SD))

    @property
    def rounding_sd(self) -> float:
        """Rounding error of a reading, SI: of the stated step, or of the last digit."""
        return (self.resolution or self.unstated_step) * STEP_SD

    @property
    def unstated_step(self) -> float:
        """Step of the last decimal digit of the values in their unit, at most 1 of it; SI.

        0 beyond ten decimals, and where an error or a reading step is stated. It is not the spacing of the levels, which
        may be chosen, such as known weights.
        """
        if self.sd is not None or self.resolution is not None:
            return 0.0
        gain, offset = (self.instrument.value(symbol) if self.instrument else 0.0 for symbol in ("gain", "offset"))
        values = ((1.0 + gain) * self.values + offset) * self.to_display
        error = ROUNDING * float(np.max(np.abs(values), initial=0.0))
        digits = (10.0**-k for k in range(11) if np.max(np.abs(values - np.round(values, k))) <= error)
        return next(digits, 0.0) / self.to_display / (1.0 + gain)


@dataclass(frozen=True)
class Settings:
    """Settings of one experiment. Every kind has a subclass; numbers are SI, None is an absent setting."""


S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Table(Generic[S]):
    """One ``[[experiment]]`` of the folder: its columns and its settings.

    Attributes
    ----------
    kind : name of its kind, as in ``rig.toml``
    label : unique within the rig: as stated, else the file's name without suffix
    file : path relative to the folder, of the first file
    columns : by name
    settings : of its kind, checked, defaults filled in
    rows : (n,) 1-based line number of every row in the file, read-only; findings name rows by it. Of a table from
        files put one below the other: 1-based number of the row
    bench : its kind is a bench test; else a forced run
    lost : (k,) numbers, as in ``rows``, of the rows of the files that are dropped for a missing cell
    other : number of rows dropped, outside ``where``
    rejected : rows dropped as outliers, by the rule ``reject``
    encodings : of its texts, by file
    drift : of the clock of its times against true time, 1; the times are read with its value
    findings : what was done to its times
    entry : index of its ``[[experiment]]``, which may hold several records
    """

    kind: str
    label: str
    file: str
    columns: Mapping[str, Column]
    settings: S
    rows: np.ndarray
    bench: bool = True
    lost: np.ndarray = field(default_factory=partial(np.empty, 0, int))
    other: int = 0
    rejected: int = 0
    encodings: Mapping[str, str] = field(default_factory=dict)
    drift: Quantity = NO_DRIFT
    findings: tuple[Finding, ...] = ()
    entry: int = 0

    def __getitem__(self, name: str) -> np.ndarray:
        """Values of column ``name``, (n,) SI."""
        return self.columns[name].values

    @property
    def missing(self) -> int:
        """Number of rows dropped for a missing cell."""
        return len(self.lost)

    def __repr__(self) -> str:
        columns = ", ".join(f"{column.name} [{column.unit}]" for column in self.columns.values())
        return f"<{self.kind} {self.label}: {counted(len(self.rows), 'row')} of {columns}>"


@dataclass(frozen=True)
class Rig:
    """A whole rig folder, read and checked.

    Attributes
    ----------
    m1, m2 : masses, kg (None: not stated)
    g : m/s^2
    priors : stated densities, SI, by parameter name (``k1``, ``k2[L60]``, ``tilt_sd``, ...)
    tables : in the order of ``rig.toml``
    files : sha256 of every file read, by relative path
    model : the choices of ``[model]``
    slope, N0 : slope of the track, rad, and pressing force, N, of experiments that state no other (None: not stated)
    confirmed : names of masses, columns and settings whose unusual values are right: ``m1``, ``decay_1.x_rel``; "friction":
        the law of ``model`` holds, so that its values are judged where the readings do not tell it from others
    plan : "minutes" of one further test and number of "tests", by the word for one test
    """

    name: str
    synthetic: bool
    m1: Quantity | None
    m2: Quantity | None
    g: Quantity
    priors: Mapping[str, Prior]
    tables: tuple[Table[Any], ...]
    files: Mapping[str, str]
    folder: Path
    model: ModelChoices = ModelChoices()
    slope: Quantity | None = None
    N0: Quantity | None = None
    confirmed: tuple[str, ...] = ()
    plan: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __repr__(self) -> str:
        kinds = Counter(table.kind for table in self.tables)
        tables = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
        return f"<Rig {self.name}{', synthetic' if self.synthetic else ''}: {tables}>"

    def mass(self, symbol: Literal["m1", "m2"]) -> float:
        """Stated mass, kg, for a kind whose ``masses`` contain ``symbol``.

        ``read_rig`` refuses a folder without it.
        """
        stated: Quantity | None = getattr(self, symbol)
        assert stated is not None, f"the kind of experiment must list {symbol} in its masses"
        return stated.value

    @property
    def has_runs(self) -> bool:
        """Whether any table is a forced run."""
        return any(not table.bench for table in self.tables)

    def without(self, label: str) -> "Rig":
        """The rig without the experiment ``label``, such as ``rig.without("run_2")``.

        Raises
        ------
        InputError
            If the rig has no such experiment, or no other one.
        """
        unwanted = self._labelled(label)
        if len(self.tables) == 1:
            raise InputError("a rig must keep an experiment", f"{label} is its only one", "keep it")
        kept = tuple(table for table in self.tables if table is not unwanted)
        gone = {unwanted.file, *unwanted.encodings} - {file for one in kept for file in (one.file, *one.encodings)}
        return replace(self, tables=kept, files={file: own for file, own in self.files.items() if file not in gone})

    def cut(self, label: str, start: float | None = None, stop: float | None = None) -> "Rig":
        """The rig with the record ``label`` from ``start`` to ``stop`` alone, such as ``rig.cut("run_1", stop=2.0)``.

        A free vibration then has this ``start`` and ``stop`` as if ``rig.toml`` stated them. The state that ``start``
        states for the first sample of a forced run ("stuck", "moving") does not hold for another sample: "auto".

        Parameters
        ----------
        start, stop : s, both included, on the clock of the record; None: its first and last sample

        Raises
        ------
        InputError
            If the rig has no such experiment, it is no record, or fewer than 8 of its samples are left.
        """
        table = self._labelled(label)
        records = ", ".join(one.label for one in self.tables if "time" in one.columns)
        if "time" not in table.columns:
            raise InputError("cut takes a record", f"{label} has no column time", f"choose from {records or 'none'}")
        time, settings = table["time"], table.settings
        windowed = hasattr(settings, "stop")
        if windowed:
            start, stop = settings.start if start is None else start, settings.stop if stop is None else stop
        low, high = -np.inf if start is None else start, np.inf if stop is None else stop
        inside = (time >= low) & (time <= high)
        if (left := int(np.count_nonzero(inside))) < SHORTEST_RECORD:
            span = f"choose times between {time[0]:g} and {time[-1]:g} s"
            rule = f"at least {SHORTEST_RECORD} samples must lie between start and stop"
            raise InputError(rule, f"{counted(left, 'sample')} of {label}", span)
        if windowed:
            table = replace(table, settings=replace(settings, start=start, stop=stop))
        else:
            if not inside[0] and getattr(settings, "start", "") in ("stuck", "moving"):
                settings = replace(settings, start="auto")
            columns = {name: replace(one, values=_frozen(one.values[inside])) for name, one in table.columns.items()}
            table = replace(table, columns=columns, rows=_frozen(table.rows[inside]), settings=settings)
        return replace(self, tables=tuple(table if one.label == label else one for one in self.tables))

    def _labelled(self, label: str) -> Table[Any]:
        """The experiment ``label``."""
        for table in self.tables:
            if table.label == label:
                return table
        known = ", ".join(table.label for table in self.tables)
        raise InputError("the label must be that of an experiment of the rig", repr(label), f"choose from {known}")


def _frozen(values: np.ndarray) -> np.ndarray:
    """``values``, read-only."""
    values.setflags(write=False)
    return values
