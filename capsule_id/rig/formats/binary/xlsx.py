"""Reads Excel workbooks: the first sheet with numbers, as the text table that it would be saved to."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.limits import complete, installed, refuse_large
from capsule_id.rig.formats.text.any_layout import read_text

#: Most cells of a sheet; one takes 50 bytes in the file, and a few hundred while it is read.
MOST_CELLS = 2_000_000


def read_xlsx(content: bytes, path: Path, layout: Layout) -> Export:
    """Read a sheet with titles, headers and rows of units in the same way as a text export.

    Places are the row and the column of the sheet. A formula counts by the value that the workbook holds for it.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : as for text; ``data_from_line`` and ``data_to_line`` are rows of the sheet

    Raises
    ------
    InputError
        If openpyxl is not installed, the file is damaged or too large, or the rows of numbers are not found.
    """
    with installed("openpyxl", path):
        import openpyxl

    with complete(path, "save it again"):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            refuse_large(sum(member.file_size for member in archive.infolist()), path)
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True, keep_links=False)
        sheets = (_rows(sheet, path) for sheet in book.worksheets)
        rows = next((rows for rows in sheets if any(isinstance(cell, float) for row in rows for cell in row)), [])
    width = max((k + 1 for row in rows for k, cell in enumerate(row) if cell != ""), default=0)
    lines = ["" if not any(row) else "\t".join((*_texts(row, width), "")) for row in rows]
    try:
        export = read_text("\n".join(lines).encode(), path, layout)
    except InputError as error:
        raise _in_sheet(error, lines) from None

    def values(column: int) -> np.ndarray:
        try:
            return export.values(column)
        except InputError as error:
            raise _in_sheet(error, lines) from None

    return replace(export, values=values, place=lambda row, column: (export.place(row, column)[0], column + 1))


def _rows(sheet: Any, path: Path) -> list[list[float | str]]:
    """The cells of a sheet; numbers as float, empty cells as ""."""
    if not hasattr(sheet, "reset_dimensions"):  # a sheet that holds only a chart
        return []
    sheet.reset_dimensions()  # the stated size of a sheet can be far larger than the sheet
    rows, cells = [], 0
    for row in sheet.iter_rows(values_only=True):
        cells += len(row)
        if cells > MOST_CELLS:
            raise InputError(
                f"a sheet must have at most {MOST_CELLS} cells", "more", "export the record as CSV or Parquet", path
            )
        rows.append([_cell(cell) for cell in row])
    return rows


def _cell(cell: object) -> float | str:
    """A number as float; anything else as one line of text."""
    if isinstance(cell, int | float) and not isinstance(cell, bool):
        return float(cell)
    return "" if cell is None else " ".join(str(cell).split())


def _texts(row: list[float | str], width: int) -> list[str]:
    """The cells of a row as text, ``width`` of them."""
    texts = [repr(cell) if isinstance(cell, float) else str(cell) for cell in row[:width]]
    return texts + [""] * (width - len(texts))


def _in_sheet(error: InputError, lines: list[str]) -> InputError:
    """The error with the column of the sheet instead of the character of the line."""
    if error.line is None or error.line > len(lines):
        return error
    column = lines[error.line - 1][: (error.column or 1) - 1].count("\t") + 1
    return InputError(error.rule, error.value, error.remedy, error.file, error.line, column)
