"""Readers of table files, by suffix, each from the bytes of a file.

``READERS`` take tables with a header ``name [unit]`` per column. ``EXPORTS`` take files of any layout, whose columns
``rig.toml`` maps. Text tables may be compressed: ``.csv.gz``.
"""

import gzip
import io
from collections.abc import Callable, Mapping
from pathlib import Path

from capsule_id.rig.formats.binary.hdf5 import read_hdf5
from capsule_id.rig.formats.binary.mat import read_mat
from capsule_id.rig.formats.binary.npz import read_npz
from capsule_id.rig.formats.binary.parquet import read_parquet
from capsule_id.rig.formats.binary.tdms import read_tdms
from capsule_id.rig.formats.binary.xlsx import read_xlsx
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.limits import LARGEST_CONTENT, complete, refuse_large
from capsule_id.rig.formats.raw import RawTable
from capsule_id.rig.formats.text.any_layout import read_text
from capsule_id.rig.formats.text.csv import read_csv
from capsule_id.rig.formats.text.lvm import read_lvm

COMPRESSED = ".gz"
_TEXTS: Mapping[str, Callable[[bytes, Path, Layout], Export]] = {
    ".csv": read_text,
    ".txt": read_text,
    ".tsv": read_text,
    ".dat": read_text,
    ".lvm": read_lvm,
}
_TABLES: Mapping[str, Callable[[bytes, Path], RawTable]] = {".csv": read_csv, ".txt": read_csv, ".tsv": read_csv}


def suffix_of(path: Path) -> str:
    """The suffix that decides the reader, in small letters: ``.csv``, ``.csv.gz``."""
    last = path.suffix.lower()
    return Path(path.stem).suffix.lower() + last if last == COMPRESSED else last


def unpack(content: bytes, path: Path) -> bytes:
    """The text in a ``.gz`` file.

    Raises
    ------
    InputError
        If the file is damaged, or larger than the limit.
    """
    with complete(path, "compress it again by gzip"), gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
        text = file.read(LARGEST_CONTENT + 1)
    refuse_large(len(text), path)
    return text


READERS: Mapping[str, Callable[[bytes, Path], RawTable]] = {
    **_TABLES,
    **{
        suffix + COMPRESSED: lambda content, path, read=read: read(unpack(content, path), path)
        for suffix, read in _TABLES.items()
    },
}
EXPORTS: Mapping[str, Callable[[bytes, Path, Layout], Export]] = {
    **_TEXTS,
    **{
        suffix + COMPRESSED: lambda content, path, layout, read=read: read(unpack(content, path), path, layout)
        for suffix, read in _TEXTS.items()
    },
    ".mat": read_mat,
    ".npz": read_npz,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".parquet": read_parquet,
    ".xlsx": read_xlsx,
    ".tdms": read_tdms,
}
