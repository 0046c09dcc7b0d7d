"""Readers of table files, by suffix. Each converts the bytes of a file to a ``RawTable`` in the file's units."""

from collections.abc import Callable, Mapping
from pathlib import Path

from capsule_id.rig.formats.csv import read_csv
from capsule_id.rig.formats.raw import RawTable

READERS: Mapping[str, Callable[[bytes, Path], RawTable]] = {".csv": read_csv, ".txt": read_csv, ".tsv": read_csv}
