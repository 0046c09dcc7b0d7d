"""Describes an export before it is used: channels, units, sampling, gaps, clipping, drop-outs, first and last rows."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Kind
from capsule_id.importing.entry import dimensions_of, entry_of, times_of_guess
from capsule_id.importing.guess import ANGULAR, guess
from capsule_id.records.clocks import estimate_clock
from capsule_id.records.faults.clipping import clipped_samples
from capsule_id.records.faults.duplicates import reading_step
from capsule_id.records.faults.timing import dropouts, find_gaps, frozen_samples
from capsule_id.rig.maps.columns import TIME
from capsule_id.rig.maps.headers import fits_name, name_and_unit, unit_of
from capsule_id.rig.maps.layout import FoundLayout, find_layout
from capsule_id.rig.units import UNKNOWN
from capsule_id.views import counted

_SHOWN_ROWS = 3
_SHOWN_COLUMNS = 20


def import_report(content: bytes, path: Path, kinds: Mapping[str, Kind]) -> list[str]:
    """The report of one file, line by line, the proposed entry of ``rig.toml`` last.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    dimensions = dimensions_of(kinds)
    found = find_layout(content, path, dimensions)
    rows = len(next(iter(found.columns.values())))
    size = f"{counted(rows, 'row')} of {counted(found.export.width, 'column')}"
    lines = [f"{path.name}: {size}, {len(found.columns)} with numbers"]
    guessed = guess(found, kinds)
    time = None
    if guessed is not None and TIME in guessed.columns:
        time = times_of_guess(found, guessed)
        known = guessed.columns[TIME].unit != UNKNOWN
        lines += _sampling(time[np.isfinite(time)]) if known else ["sampling: the file states no unit of its times"]
    elif found.rate is not None:
        lines.append(f"sampling: {found.rate:g} Hz, as the file states; it holds no times")
    for index in list(found.columns)[:_SHOWN_COLUMNS]:
        lines += _channel(found, index, dimensions, time is not None)
    if len(found.columns) > _SHOWN_COLUMNS:
        lines.append(counted(len(found.columns) - _SHOWN_COLUMNS, "more column"))
    lines += _rows(found, rows)
    text, _ = entry_of(content, path, path.name, kinds)
    return [*lines, "", text.rstrip()]


def clock_line(files: Mapping[Path, bytes], common: str, kinds: Mapping[str, Kind]) -> str:
    """The line ``clock = ...`` with sds that puts the second of two files on the clock of the first one.

    Parameters
    ----------
    files : two files with their bytes
    common : header of the signal that both hold

    Raises
    ------
    InputError
        If a file has no times or no such header, or the signals are not the same.
    """
    if len(files) < 2:
        rule, remedy = "--clock-of must name another file", "name the file of the other logger"
        raise InputError(rule, "the same file twice", remedy, next(iter(files)))
    records = []
    for path, content in files.items():
        found = find_layout(content, path, dimensions_of(kinds))
        guessed = guess(found, kinds)
        if guessed is None or TIME not in guessed.columns or guessed.columns[TIME].unit == UNKNOWN:
            raise InputError("a file must hold times with their unit", "none", "head them `time [s]`", path)
        index = next((index for index in found.columns if found.names[index] == common), None)
        if index is None:
            known = ", ".join(found.names[index] for index in found.columns)
            raise InputError(f"a file must have the column {common}", known, "name a column of both files", path)
        records += [times_of_guess(found, guessed), found.columns[index]]
    clock = estimate_clock(*records)
    offset = f'{{ value = {clock.offset:.9g}, sd = {clock.offset_sd:.2g}, unit = "s" }}'
    drift = f'{{ value = {1e6 * clock.drift:.6g}, sd = {1e6 * clock.drift_sd:.2g}, unit = "ppm" }}'
    return f"clock = {{ offset = {offset}, drift = {drift} }}  # {clock.explained:.1%} of the signal explained"


def _sampling(time: np.ndarray) -> Iterable[str]:
    """Rate, jitter and gaps of the times, (n,) s."""
    steps = np.diff(time)
    if len(steps) < 2 or not np.all(steps > 0.0):
        yield f"sampling: the times do not increase at {counted(int(np.sum(steps <= 0.0)), 'row')}"
        return
    step = float(np.median(steps))
    jitter = float(np.sqrt(np.mean((steps[steps < 1.5 * step] / step - 1.0) ** 2)))
    yield f"sampling: {1.0 / step:.6g} Hz from {time[0]:.6g} to {time[-1]:.6g} s, jitter {jitter:.2%} of a step (rms)"
    gaps = find_gaps(time)
    if gaps is not None:
        first = time[gaps.rows[0]]
        yield f"gaps: {len(gaps.rows)}, {counted(int(gaps.lost.sum()), 'sample')} lost, the first after {first:.6g} s"


def _channel(found: FoundLayout, index: int, dimensions: tuple[str, ...], record: bool) -> Iterable[str]:
    """Range, reading step and faults of one column."""
    values = found.columns[index]
    missing, values = int(np.sum(np.isnan(values))), values[np.isfinite(values)]
    name, text = name_and_unit(found.names[index], dimensions)
    # A lone g is a mass, unless the header says acceleration.
    masses = () if fits_name(name, "acceleration") > 0 else ("kg",)
    unit = unit_of(text or found.units[index], (*masses, *dimensions, *ANGULAR.values())) or "unit unknown"
    step = reading_step(values)
    line = f"column {index + 1} {name or 'without name'} [{unit}]: {values.min():.6g} to {values.max():.6g}"
    line += f", reading step {step:.3g}" if step else ""
    line += f", {missing} missing" if missing else ""
    faults = []
    if record and len(values) > 2 and np.ptp(values) > 0.0:
        for clipped in clipped_samples(values, np.inf):
            faults.append(f"{counted(len(clipped.rows), 'sample')} clipped at {clipped.level:g}")
        for what, rows in (("drop-out", dropouts(values)), ("frozen sample", frozen_samples(values))):
            if len(rows):
                faults.append(f"{counted(len(rows), what)}, the first in line {found.export.lines[rows[0]]}")
    yield "; ".join([line, *faults])


def _rows(found: FoundLayout, rows: int) -> Iterable[str]:
    """The first and last rows of numbers."""
    shown = [*range(min(_SHOWN_ROWS, rows)), *range(max(rows - _SHOWN_ROWS, _SHOWN_ROWS), rows)]
    for row in shown:
        cells = [f"{found.columns[index][row]:.6g}" for index in list(found.columns)[:_SHOWN_COLUMNS]]
        yield f"line {found.export.lines[row]}: {'  '.join(cells)}"
