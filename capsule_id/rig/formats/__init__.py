"""Readers of table files, by suffix, each from the bytes of a file.

``READERS`` take tables with a header ``name [unit]`` per column. ``EXPORTS`` take files of any layout, whose columns
``rig.toml`` maps. Text tables may be compressed: ``.csv.gz``.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from capsule_id.rig.formats.binary import (
    OCTAVE,
    read_hdf5,
    read_mat,
    read_npz,
    read_octave,
    read_parquet,
    read_tdms,
    read_xlsx,
)
from capsule_id.rig.formats.layouts import read_csv, read_lvm, read_text
from capsule_id.rig.formats.raw import COMPRESSED, Export, Layout


def _unless_octave(read: Callable[[bytes, Path, Layout], Export], content: bytes, path: Path, layout: Layout) -> Export:
    """A file that Octave may have written, whatever its suffix, or one for ``read``."""
    return (read_octave if content.startswith(OCTAVE) else read)(content, path, layout)


TEXTS = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".dat", ".log", ".asc"), partial(_unless_octave, read_text)),
    ".lvm": read_lvm,
}


def suffix_of(path: Path) -> str:
    """The suffix that decides the reader, in small letters: ``.csv``, ``.csv.gz``."""
    last = path.suffix.lower()
    return Path(path.stem).suffix.lower() + last if last == COMPRESSED else last


READERS = dict.fromkeys((suffix + end for suffix in (".csv", ".txt", ".tsv") for end in ("", COMPRESSED)), read_csv)
EXPORTS: Mapping[str, Callable[[bytes, Path, Layout], Export]] = {
    **TEXTS,
    **{suffix + COMPRESSED: read for suffix, read in TEXTS.items()},
    ".mat": partial(_unless_octave, read_mat),
    ".npz": read_npz,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".parquet": read_parquet,
    ".xlsx": read_xlsx,
    ".tdms": read_tdms,
}
