"""Makes an export of named arrays: the form of every format without lines."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.export import Export, Layout

#: A matrix this many times as wide as high holds its channels in rows.
WIDE = 10


def refuse_line(layout: Layout, path: Path) -> None:
    """Refuse the keys of text files.

    Raises
    ------
    InputError
        If ``layout`` states ``data_from_line``, ``data_to_line`` or ``decimal``.
    """
    for key in ("data_from_line", "data_to_line", "decimal"):
        if (value := getattr(layout, key)) is not None:
            raise InputError(f"a {path.suffix} file has no {key}", f"{key} = {value}", f"remove {key}", path)


def export_of_arrays(
    arrays: Mapping[str, np.ndarray], path: Path, layout: Layout, units: Mapping[str, str] | None = None
) -> Export:
    """The columns of named arrays: every vector, and every column of a matrix, ``data(:,2)`` for the second.

    A matrix far wider than high holds its channels in rows: ``data(2,:)`` for the second.

    Parameters
    ----------
    arrays : real numbers; arrays that are empty or have more than two dimensions are left out
    path : of the file, for error lines
    layout : ``missing`` may hold "NaN"
    units : by name of an array, as the file states them; a second row of headers

    Raises
    ------
    InputError
        If there is no column.
    """
    refuse_line(layout, path)
    columns, stated = {}, []
    for name, array in arrays.items():
        if array.size and name.isprintable() and array.ndim in (1, 2):
            own = {name: array.ravel()}
            if array.ndim == 2 and 1 not in array.shape:
                rows = array.shape[1] > WIDE * array.shape[0]
                form = "({},:)" if rows else "(:,{})"
                own = {name + form.format(i + 1): one for i, one in enumerate(array if rows else array.T)}
            columns |= own
            stated += [(units or {}).get(name, "")] * len(own)
    if not columns:
        raise InputError(
            f"a {path.suffix} file must hold real numeric vectors", "none", "export the readings as vectors", path
        )
    names = tuple(columns)

    def values(column: int) -> np.ndarray:
        found = columns[names[column]].astype(np.float64)
        refused = ~np.isfinite(found) & ~(np.isnan(found) & ("NaN" in layout.missing))
        if refused.any():
            row = int(np.argmax(refused))
            remedy = 'add "NaN" to missing = [...] to drop its row' if np.isnan(found[row]) else "correct the value"
            raise InputError(f"{names[column]} must be finite", f"{found[row]}", remedy, path, *place(row, column))
        return found

    def place(row: int | None, column: int) -> tuple[int, int]:
        return 1 if row is None else row + 1, column + 1

    longest = max(vector.size for vector in columns.values())
    headers = (names, tuple(stated)) if any(stated) else (names,)
    return Export(path, headers, len(names), np.arange(1, longest + 1), values, place)
