"""The notebooks run from a clean copy, end with an assertion, show a figure, and their stored outputs are current.

The chapters of odd number run here, the others in ``test_notebooks_even.py``.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
from jupyter_client.manager import AsyncKernelManager
from nbclient.exceptions import CellExecutionError

from tests.notebook_tools import (
    FOLDER,
    LONGEST_CELL,
    NAMES,
    ODD,
    code,
    compare_with_kept,
    ends_with_an_assertion,
    execute,
    figures,
    not_public,
    outputs,
    read,
    run_short,
    running_kernel,
)

LARGEST, LARGEST_TOGETHER = 600_000, 3_000_000  # bytes


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AsyncKernelManager]:
    """One kernel for all chapters of this file: to start it and load JAX takes longer than most chapters."""
    with running_kernel(tmp_path_factory.mktemp("ipython")) as manager:
        yield manager


def test_the_chapters_are_numbered_and_small() -> None:
    assert [name[:3] for name in NAMES] == sorted({f"{name[:2]}_" for name in NAMES})
    sizes = [(FOLDER / f"{name}.ipynb").stat().st_size for name in NAMES]
    assert max(sizes) < LARGEST
    assert sum(sizes) < LARGEST_TOGETHER


@pytest.mark.parametrize("name", NAMES)
def test_what_a_notebook_keeps_is_whole(name: str) -> None:
    """Every code cell ran once, in order, without errors or warnings; there are figures and a final assertion."""
    notebook = read(name)
    assert [cell.execution_count for cell in code(notebook)] == list(range(1, len(code(notebook)) + 1))
    assert outputs(notebook, "error") == []
    assert [out.text for out in outputs(notebook, "stream") if out.name != "stdout"] == []
    assert figures(notebook) >= 1
    assert ends_with_an_assertion(notebook)
    assert notebook.cells[0].source.startswith(f"# {int(name[:2])}. ")


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_uses_public_names_in_short_cells(name: str) -> None:
    notebook = read(name)
    assert not_public(notebook) == []
    assert max(len(cell.source.splitlines()) for cell in code(notebook)) <= LONGEST_CELL


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("from capsule_id.report.figures.style import BLUE", "capsule_id.report.figures.style"),
        ("import capsule_id.motions as motions", "capsule_id.motions"),
        ("import capsule_id", "capsule_id as None"),
        ("cid.report.write.table_frame(result)", "cid.report"),
        ("import seaborn as sns", "seaborn"),
    ],
)
def test_what_is_not_public_would_be_noticed(line: str, found: str) -> None:
    """Negative control."""
    notebook = read(NAMES[1])
    code(notebook)[-1].source += f"\n{line}"
    assert found in not_public(notebook)


@pytest.mark.full
@pytest.mark.parametrize("name", ODD)
def test_a_notebook_runs_from_a_clean_copy(name: str, tmp_path: Path, kernel: AsyncKernelManager) -> None:
    run_short(name, tmp_path, kernel)


@pytest.mark.slow
@pytest.mark.parametrize("name", ODD)
def test_kept_outputs_are_what_the_code_prints(name: str, tmp_path: Path) -> None:
    compare_with_kept(name, tmp_path)


def test_a_wrong_headline_would_be_noticed(tmp_path: Path, kernel: AsyncKernelManager) -> None:
    """Negative control: the assertion of the last cell fails for another number."""
    notebook = read(next(name for name in NAMES if name.startswith("01")))
    first, last = notebook.cells[0], code(notebook)[-1]
    assert ends_with_an_assertion(notebook)
    last.source = 'coverage = {"raw": 0.95, "filtered": 0.95}\n' + last.source
    notebook.cells = [first, last]
    with pytest.raises(CellExecutionError, match="AssertionError"):
        execute(notebook, tmp_path, kernel)
    last.source = last.source.replace("assert ", "bool")
    assert not ends_with_an_assertion(notebook)
