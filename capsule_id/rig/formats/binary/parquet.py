"""Reads Parquet files: every column of real numbers. pyarrow, the reference implementation, decodes them."""

from pathlib import Path

from capsule_id.errors import InputError
from capsule_id.rig.formats.binary.arrays import export_of_arrays
from capsule_id.rig.formats.export import Export, Layout
from capsule_id.rig.formats.limits import complete, installed, refuse_large


def read_parquet(content: bytes, path: Path, layout: Layout) -> Export:
    """Read the columns of a Parquet file by name; empty cells are NaN.

    Parameters
    ----------
    content : the bytes of the file
    path : its name, for error lines
    layout : ``missing`` may hold "NaN"

    Raises
    ------
    InputError
        If pyarrow is not installed, or the file is damaged, too large, or has no column of numbers.
    """
    with installed("pyarrow", path):
        import pyarrow as pa
        from pyarrow import parquet

    with complete(path, "write it again"):
        file = parquet.ParquetFile(pa.BufferReader(content))
        schema = file.schema_arrow
        numeric = [
            field.name for field in schema if pa.types.is_floating(field.type) or pa.types.is_integer(field.type)
        ]
        # pyarrow makes room for the rows that a row group states.
        rows = [file.metadata.row_group(k).num_rows for k in range(file.metadata.num_row_groups)]
        if min(rows, default=0) < 0 or sum(rows) != file.metadata.num_rows:
            value = f"row groups of {sum(rows)} rows in a table of {file.metadata.num_rows}"
            raise InputError("a .parquet file must be complete", value, "write it again", path)
        refuse_large(8 * file.metadata.num_rows * len(numeric), path)
        table = file.read(columns=numeric, use_threads=False)
        arrays = {name: table.column(name).to_numpy() for name in table.column_names}
    return export_of_arrays(arrays, path, layout)
