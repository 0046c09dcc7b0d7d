"""The notebooks: they run from a clean copy, end with an assertion, show a figure, and what they keep is not stale."""

import os
import re
import shutil
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbformat import NotebookNode

from tests.cli_tools import ROOT

FOLDER = ROOT / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
LARGEST, LARGEST_TOGETHER = 600_000, 3_000_000  # bytes
SECONDS = 600  # of one cell
#: Instead of the cell with the tag ``parameters``: the same study, smaller. Notebooks without such a cell run as they are.
SHORT = {
    "01": "RECORDS = 100",
    "02": "RECORDS = 60",
    "03": "STEPS = 1500",
    "04": "CALIBRATIONS = 1500",
    "05": "WIDTHS = 3",
    "07": "K2_POINTS, F_POINTS, P_D_POINTS = 55, 17, 31",
}
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def read(name: str) -> NotebookNode:
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


def code(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook: NotebookNode, kind: str) -> list[NotebookNode]:
    return [out for cell in code(notebook) for out in cell.outputs if out.output_type == kind]


def figures(notebook: NotebookNode) -> int:
    shown = [*outputs(notebook, "display_data"), *outputs(notebook, "execute_result")]
    return sum("image/png" in out.data for out in shown)


def printed(notebook: NotebookNode) -> str:
    return "".join(out.text for out in outputs(notebook, "stream") if out.name == "stdout")


def ends_with_an_assertion(notebook: NotebookNode) -> bool:
    return bool(re.search(r"(?m)^assert ", code(notebook)[-1].source))


def shorten(notebook: NotebookNode, values: str) -> None:
    """Put ``values`` into the cell of parameters; they must assign the names that stand there."""
    (cell,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    assert values.split("=")[0] == cell.source.split("=")[0]
    cell.source = values


def execute(notebook: NotebookNode, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a notebook in a copy of ``notebooks/`` beside a copy of ``data/``, as a checkout has them."""
    for part in ("notebooks", "data"):
        shutil.copytree(ROOT / part, folder / part)
    for cell in code(notebook):
        cell.outputs, cell.execution_count = [], None
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("IPYTHONDIR", str(folder / "ipython"))
    where = {"metadata": {"path": str(folder / "notebooks")}}
    NotebookClient(notebook, kernel_name="python3", timeout=SECONDS, resources=where).execute()


def test_the_chapters_are_numbered_and_small() -> None:
    assert [name[:3] for name in NAMES] == sorted({f"{name[:2]}_" for name in NAMES})
    sizes = [(FOLDER / f"{name}.ipynb").stat().st_size for name in NAMES]
    assert max(sizes) < LARGEST
    assert sum(sizes) < LARGEST_TOGETHER


@pytest.mark.parametrize("name", NAMES)
def test_what_a_notebook_keeps_is_whole(name: str) -> None:
    """Every code cell was run, in order, once; none failed or complained; there are figures, and an assertion at the end."""
    notebook = read(name)
    assert [cell.execution_count for cell in code(notebook)] == list(range(1, len(code(notebook)) + 1))
    assert outputs(notebook, "error") == []
    assert [out.text for out in outputs(notebook, "stream") if out.name != "stdout"] == []
    assert figures(notebook) >= 1
    assert ends_with_an_assertion(notebook)
    assert notebook.cells[0].source.startswith(f"# {int(name[:2])}. ")


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_from_a_clean_copy(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = read(name)
    if name[:2] in SHORT:
        shorten(notebook, SHORT[name[:2]])
    kept = figures(notebook)
    execute(notebook, tmp_path, monkeypatch)
    assert figures(notebook) == kept
    assert [out.text for out in outputs(notebook, "stream") if out.name != "stdout"] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_kept_outputs_are_what_the_code_prints(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At full size: the same words, and the same numbers but for the last digits of another machine."""
    notebook = read(name)
    expected = printed(notebook)
    execute(notebook, tmp_path, monkeypatch)
    assert NUMBER.sub("#", printed(notebook)) == NUMBER.sub("#", expected)
    pairs = zip(NUMBER.findall(printed(notebook)), NUMBER.findall(expected), strict=True)
    # Differences of rounding (a balance of 1e-11, a disagreement of 1e-7) may be anything of that size.
    far = [(a, b) for a, b in pairs if abs(float(a) - float(b)) > 0.02 * abs(float(b)) + 1e-5]
    assert far == []


def test_a_wrong_headline_would_be_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The negative control: the assertion of a last cell fails where the number is another one."""
    notebook = read(NAMES[0])
    first, last = notebook.cells[0], code(notebook)[-1]
    assert ends_with_an_assertion(notebook)
    last.source = 'coverage = {"raw": 0.95, "filtered": 0.95}\n' + last.source
    notebook.cells = [first, last]
    with pytest.raises(CellExecutionError, match="AssertionError"):
        execute(notebook, tmp_path, monkeypatch)
    last.source = last.source.replace("assert ", "bool")
    assert not ends_with_an_assertion(notebook)
