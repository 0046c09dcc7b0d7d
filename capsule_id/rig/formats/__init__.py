"""Readers of table files, by suffix, each from the bytes of a file.

``READERS`` take tables with a header ``name [unit]`` per column. ``EXPORTS`` take files of any layout, whose columns
``rig.toml`` maps.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from capsule_id.rig.formats.csv import read_csv
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.mat import read_mat
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.formats.text import read_text

READERS: Mapping[str, Callable[[bytes, Path], RawTable]] = {".csv": read_csv, ".txt": read_csv, ".tsv": read_csv}
EXPORTS: Mapping[str, Callable[[bytes, Path, Layout], Export]] = {
    ".csv": read_text,
    ".txt": read_text,
    ".tsv": read_text,
    ".mat": read_mat,
}
