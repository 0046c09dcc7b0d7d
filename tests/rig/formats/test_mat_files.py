"""MATLAB files: read as SciPy reads them, and damaged ones end in a clean error."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from capsule_id.errors import InputError, collecting
from capsule_id.rig.formats.binary import read_mat
from capsule_id.rig.formats.raw import Layout

PATH = Path("m.mat")


def mat_file(compressed: bool) -> bytes:
    """Variables of every type that is a column, and of types that are none."""
    t = np.arange(7)
    content = io.BytesIO()
    variables = {
        "double": t / 3.0,
        "single": (t / 3.0).astype(np.float32)[:, None],
        "one": 4.5,
        "small": np.array([[1, -2, 3]], np.int8),
        "large": t.astype(np.uint64) << 40,
        "logical": t > 3,
        "matrix": np.arange(6.0).reshape(2, 3),
        "text": "text",
        "complex": 1j * t,
        "record": {"a": t, "note": "text", "deep": {"rows": np.arange(44.0).reshape(2, 22)}, "empty": []},
        "runs": np.array([(t + 0.5,), (t + 1.5,)], [("x", object)]),
        "cell": np.array([t, "a"], object),
        "empty": np.zeros((0, 1)),
        "cube": np.zeros((2, 2, 2)),
    }
    savemat(content, variables, do_compression=compressed)
    return content.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
def test_numbers_are_those_that_scipy_reads(compressed: bool) -> None:
    content = mat_file(compressed)
    export, expected = read_mat(content, PATH, Layout()), loadmat(io.BytesIO(content))
    (names,) = export.headers
    vectors = ["double", "single", "one", "small", "large", "logical"]
    matrix = ("matrix(:,1)", "matrix(:,2)", "matrix(:,3)")
    structs = ("record.a", "record.deep.rows(1,:)", "record.deep.rows(2,:)", "runs(1).x", "runs(2).x")
    assert names == (*vectors, *matrix, *structs)
    for index, name in enumerate(vectors):
        np.testing.assert_array_equal(export.values(index), expected[name].ravel().astype(float))
    for column in range(3):
        np.testing.assert_array_equal(export.values(6 + column), expected["matrix"][:, column])
    np.testing.assert_array_equal(export.values(9), np.arange(7.0))
    np.testing.assert_array_equal(export.values(11), np.arange(22.0, 44.0))
    np.testing.assert_array_equal(export.values(13), np.arange(7.0) + 1.5)


@pytest.mark.full
@pytest.mark.parametrize("compressed", [False, True])
def test_a_changed_or_missing_byte_reads_or_is_refused(compressed: bool) -> None:
    """SciPy's reader ends its process on some of these files: each is read in a process of its own."""
    content = mat_file(compressed)
    positions, refused = range(0, len(content), 127), 0
    for position in positions:
        changed = bytearray(content)
        changed[position] ^= 0x5B
        for damaged in (bytes(changed), content[:position]):
            faults: list[InputError] = []
            with collecting(faults):
                export = read_mat(damaged, PATH, Layout(missing=("NaN",)))
                for column in range(export.width):
                    export.values(column)
            assert all(str(fault).isprintable() for fault in faults)
            refused += len(faults)
    assert refused > len(positions) // 2


def test_a_large_array_of_structs_without_fields_ends_in_a_clean_line() -> None:
    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    parts = [element(6, struct.pack("<II", 2, 0)), element(5, struct.pack("<ii", 2**30, 2**30)), element(1, b"none")]
    parts += [element(5, struct.pack("<i", 32)), element(1, b"")]
    with pytest.raises(InputError, match="must be complete"):
        read_mat(mat_file(False) + element(14, b"".join(parts)), PATH, Layout())
