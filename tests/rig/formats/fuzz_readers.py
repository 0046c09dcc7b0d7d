"""Coverage-guided fuzzing of one reader: ``python -m tests.rig.formats.fuzz_readers .lvm CORPUS -max_total_time=1800``.

It needs the package atheris. Half of the mutations of an archive (.xlsx, .npz, .csv.gz) are of what it holds, packed
again: a changed byte of compressed data ends at its checksum. Every input reads, or ends in an ``InputError``; libFuzzer
stops at any other exception, at an input that takes longer than ``-timeout``, and above ``-rss_limit_mb``. Inputs that
were found so are kept in ``test_damaged_files.py``.
"""

import gzip
import io
import random
import sys
import warnings
import zipfile
from pathlib import Path

import atheris
import numpy as np

with atheris.instrument_imports(include=["capsule_id.rig", "nptdms", "openpyxl"]):
    import nptdms  # noqa: F401  (imported here to be instrumented)
    import openpyxl  # noqa: F401

    from capsule_id.errors import InputError
    from capsule_id.rig.formats import EXPORTS, READERS
    from capsule_id.rig.formats.raw import Layout

from tests.rig.formats.writers import WRITERS

TIME = np.arange(6) * 0.25
COLUMNS = {"t": TIME, "x": np.round(np.cos(TIME), 3)}


def refuse_control_characters(error: InputError) -> None:
    if not str(error).isprintable():
        raise ValueError(f"an error line with control characters: {error!r}")


def read_all(suffix: str, content: bytes) -> bool:
    """Read a file with every column, and as a plain table; whether its layout is valid."""
    path = Path(f"f{suffix}")
    if suffix in READERS:
        try:
            READERS[suffix](content, path)
        except InputError as error:
            refuse_control_characters(error)
    try:
        export = EXPORTS[suffix](content, path, Layout(missing=("NaN", "")))
        for column in range(min(export.width, 50)):
            export.values(column)
            export.place(None, column)
            export.place(len(export.lines) - 1, column)
    except InputError as error:
        refuse_control_characters(error)
        return False
    return True


def members_of(content: bytes) -> dict[str, bytes]:
    """What a zip or gzip holds, by name; {} where it is damaged or neither."""
    try:
        if content.startswith(b"\x1f\x8b"):
            return {"": gzip.decompress(content)}
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # zipfile reports damage in many ways
        return {}


def mutate_inside(content: bytes, limit: int, seed: int) -> bytes:
    """Mutate one member of an archive and pack it again; every second time, and elsewhere, the bytes themselves."""
    rng = random.Random(seed)
    members = members_of(content) if rng.random() < 0.5 else {}
    if members:
        name = rng.choice(list(members))
        members[name] = atheris.Mutate(members[name][:limit], limit)
        packed = io.BytesIO()
        if name:
            with zipfile.ZipFile(packed, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
                for own, member in members.items():
                    archive.writestr(own, member)
        else:
            packed.write(gzip.compress(members[name], 1))
        if len(packed.getvalue()) <= limit:
            return packed.getvalue()
    return atheris.Mutate(content, limit)


def main() -> None:
    """Fuzz the reader of the suffix in the first argument; the second is a folder, filled with seeds if it is empty."""
    suffix, folder = sys.argv[1], Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    if not any(folder.iterdir()):
        for number, (own, write) in enumerate(WRITERS.values()):
            if own == suffix:
                (folder / f"seed{number}").write_bytes(write(COLUMNS))
    warnings.simplefilter("error")
    packed = {"custom_mutator": mutate_inside} if suffix in (".xlsx", ".npz", ".csv.gz") else {}
    atheris.Setup(
        [sys.argv[0], str(folder), *sys.argv[3:]], lambda content: read_all(suffix, content) and None, **packed
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
