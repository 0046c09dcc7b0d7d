"""Reads MATLAB files up to version 7 by SciPy: every real numeric variable is a column, of a matrix every column."""

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.export import Export, Layout


def read_mat(content: bytes, path: Path, layout: Layout) -> Export:
    """Read the vectors of a MATLAB file by name; column 2 of a matrix ``data`` is called ``data(:,2)``.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : ``missing`` may hold "NaN"; the rest does not apply

    Raises
    ------
    InputError
        If it is no MATLAB file up to version 7, or has no numeric variable.
    """
    if layout.data_from_line is not None:
        remedy = "remove data_from_line"
        raise InputError("a MATLAB file has no lines", f"data_from_line = {layout.data_from_line}", remedy, path)
    columns = _vectors(_variables(content, path))
    if not columns:
        raise InputError("a MATLAB file must hold numeric vectors", "none", "save the readings as vectors", path)
    names = tuple(columns)

    def values(column: int) -> np.ndarray:
        found = columns[names[column]]
        refused = ~np.isfinite(found) & ~(np.isnan(found) & ("NaN" in layout.missing))
        if refused.any():
            row = int(np.argmax(refused))
            remedy = 'add "NaN" to missing = [...] to drop its row' if np.isnan(found[row]) else "correct the value"
            raise InputError(f"{names[column]} must be finite", f"{found[row]}", remedy, path, *place(row, column))
        return found

    def place(row: int | None, column: int) -> tuple[int, int]:
        return 1 if row is None else row + 1, column + 1

    longest = max(vector.size for vector in columns.values())
    return Export(path, (names,), len(names), np.arange(1, longest + 1), values, place)


def _variables(content: bytes, path: Path) -> dict[str, Any]:
    """The variables by name, as SciPy returns them."""
    from scipy.io import loadmat  # 0.2 s to import

    try:
        with warnings.catch_warnings(action="ignore"):
            return loadmat(io.BytesIO(content))
    except NotImplementedError:
        remedy = "save it by save(..., '-v7')"
        raise InputError("a MATLAB file must have version 7 or earlier", "version 7.3", remedy, path) from None
    except Exception as error:  # on damaged files SciPy raises errors of many types
        remedy = "save it again by save(..., '-v7')"
        raise InputError("a MATLAB file must be readable", f"{error}"[:60], remedy, path) from None


def _vectors(variables: dict[str, Any]) -> dict[str, np.ndarray]:
    """Every real vector and every column of a real matrix, float64, by name."""
    columns = {}
    for name, value in variables.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub" or value.ndim != 2 or not value.size:
            continue
        matrix = value.astype(np.float64)
        if 1 in matrix.shape:
            columns[name] = matrix.ravel()
        else:
            columns |= {f"{name}(:,{i + 1})": column for i, column in enumerate(matrix.T)}
    return columns
