"""Reads TDMS files of LabVIEW by npTDMS: every channel of numbers, scaled, and the times of waveforms."""

import io
import logging
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.rig.formats.binary.arrays import export_of_arrays
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.limits import complete, installed, refuse_large

#: Name of the column of times of a waveform, which the file holds as an offset and an increment.
TIME = "wf_time"
#: Most scales of a channel.
MOST_SCALES = 1000
_SCALES = "NI_Number_Of_Scales"


def read_tdms(content: bytes, path: Path, layout: Layout) -> Export:
    """Read the channels of a TDMS file by name, ``group/channel`` where two groups have a channel of that name.

    ``wf_time`` holds the times of waveforms, s, from their offset and increment; ``wf_time(<channel>)`` those of
    each channel where channels have different clocks. Without these properties there is no such column.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : ``missing`` may hold "NaN"

    Raises
    ------
    InputError
        If npTDMS is not installed, or the file is damaged, too large, or has no channel of numbers.
    """
    with installed("npTDMS", path):
        import nptdms
        from nptdms.log import log_manager

    log_manager.set_level(logging.CRITICAL)  # its remarks on damaged files go to standard error otherwise
    arrays: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    clocks: dict[str, tuple[float, float, int]] = {}
    with complete(path, "export it again, or as text"), nptdms.TdmsFile.open(io.BytesIO(content)) as file:
        groups = file.groups()
        everything = [channel for group in groups for channel in group.channels()]
        for properties in (file.properties, *(each.properties for each in (*groups, *everything))):
            scales: Any = properties.get(_SCALES, 0)
            if not 0 <= scales <= MOST_SCALES:  # npTDMS makes a list of so many elements
                raise ValueError(f"{scales} scales of a channel")
        channels = [channel for channel in everything if channel.dtype.kind in "fiu"]
        refuse_large(8 * sum(len(channel) for channel in channels), path)
        names = [channel.name for channel in channels]
        for channel in channels:
            unique = names.count(channel.name) == 1
            name = channel.name if unique else f"{channel.group_name}/{channel.name}"
            arrays[name] = np.asarray(channel[:])
            units[name] = str(channel.properties.get("unit_string", ""))
            if (clock := _clock(channel)) is not None:
                clocks[name] = (*clock, len(channel))
    common = len(set(clocks.values())) == 1
    for name, (offset, increment, samples) in clocks.items():
        times = TIME if common else f"{TIME}({name})"
        arrays[times], units[times] = offset + increment * np.arange(samples), "s"
    return export_of_arrays(arrays, path, layout, units)


def _clock(channel: Any) -> tuple[float, float] | None:
    """Offset and increment of a waveform, s; None where the file states none."""
    increment, offset = (channel.properties.get(key) for key in ("wf_increment", "wf_start_offset"))
    if not isinstance(increment, int | float) or not np.isfinite(increment) or increment <= 0.0:
        return None
    return (float(offset) if isinstance(offset, int | float) and np.isfinite(offset) else 0.0), float(increment)
