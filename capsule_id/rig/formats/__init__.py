"""Readers of table files, by suffix. Each turns the bytes of a file into a ``RawTable``; units come later."""

from collections.abc import Callable, Mapping
from pathlib import Path

from capsule_id.rig.formats.csv import read_csv
from capsule_id.rig.formats.raw import RawTable

READERS: Mapping[str, Callable[[bytes, Path], RawTable]] = {".csv": read_csv, ".txt": read_csv, ".tsv": read_csv}
