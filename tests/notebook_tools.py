"""Reads, inspects and runs notebooks. Their tests are in two files, because a worker takes a whole file."""

import ast
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path

import nbformat
from jupyter_client.manager import AsyncKernelManager
from jupyter_core.utils import run_sync
from nbclient import NotebookClient
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell

import capsule_id as cid
from tests.cli_tools import ROOT

FOLDER = ROOT / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
ODD = [name for name in NAMES if int(name[:2]) % 2 == 1]
EVEN = [name for name in NAMES if name not in ODD]
SECONDS = 600  # of one cell
#: Instead of the cell with the tag ``parameters``: the same study, smaller. Notebooks without such a cell run as they are.
SHORT = {
    "01": "RECORDS = 60",
    "02": "RECORDS = 60",
    "03": "STEPS = 1500",
    "04": "CALIBRATIONS = 1500",
    "05": "WIDTHS = 2",
    "06": "RUNS, SAMPLES = (1,), 1700",
    "07": "K2_POINTS, F_POINTS, P_D_POINTS = 55, 17, 31",
    "08": "DRAWS, POINTS = 100, 16",
    "09": 'SETTINGS, ESS, WORDS = 5, 1000, ["lag"]',
}
#: A short study ends before the first cell with this tag, whose smallest version takes minutes.
LONG = "minutes"
#: Chapters that compile large programs and run them for milliseconds: their short studies are not optimised.
NOT_OPTIMISED = {"06"}
#: First cell in a kernel that has run another notebook.
CLEAN = """%reset -f
%cd -q {folder}
import matplotlib.pyplot as plt
plt.close("all")
plt.rcdefaults()
%matplotlib inline
del plt"""
#: Second cell. A compiled program in memory serves later notebooks too, whatever the option says then.
OPTIMISED = """import jax
if jax.config.read("jax_disable_most_optimizations"):
    jax.clear_caches()
jax.config.update("jax_disable_most_optimizations", {quickly})
del jax"""
LONGEST_CELL = 25  # lines
#: What notebooks import besides the standard library. Of this package they import its public names.
LIBRARIES = {"numpy", "scipy", "pandas", "matplotlib.pyplot", "jax", "emcee", "arviz"}
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


def not_public(notebook: NotebookNode) -> list[str]:
    """What the code takes from inside the package, or from a library that notebooks do not use."""
    nodes = [node for cell in code(notebook) for node in ast.walk(ast.parse(cell.source))]
    inside = {
        f"cid.{node.attr}"
        for node in nodes
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "cid"
    }
    own = {f"cid.{name}" for name in cid.__all__}
    return sorted((inside - own) | {module for node in nodes for module in _modules(node) if not _allowed(module)})


def _modules(node: ast.AST) -> Iterator[str]:
    """The modules that an import statement names; ``capsule_id as cid`` with its new name."""
    if isinstance(node, ast.Import):
        yield from (f"{n.name} as {n.asname}" if n.name == "capsule_id" else n.name for n in node.names)
    elif isinstance(node, ast.ImportFrom):
        yield str(node.module)


def _allowed(module: str) -> bool:
    """Whether a notebook may import it."""
    first = module.split(".")[0]
    return module == "capsule_id as cid" or first in sys.stdlib_module_names or bool({module, first} & LIBRARIES)


def shorten(notebook: NotebookNode, values: str) -> None:
    """Put ``values`` into the cell of parameters; they must assign the same names."""
    (cell,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    assert values.split("=")[0] == cell.source.split("=")[0]
    cell.source = values


def execute(notebook: NotebookNode, folder: Path, kernel: AsyncKernelManager, quickly: bool = False) -> None:
    """Run a notebook in a copy of ``notebooks/`` beside a copy of ``data/``, as a checkout has them.

    The kernel may have run other notebooks: names and figures of theirs are removed first.

    quickly : XLA does not optimise the programs
    """
    for part in ("notebooks", "data"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("results"))  # computed anew
    for cell in code(notebook):
        cell.outputs, cell.execution_count = [], None
    own = [CLEAN.format(folder=str(folder / "notebooks")), OPTIMISED.format(quickly=quickly)]
    notebook.cells[:0] = [new_code_cell(text) for text in own]
    client = NotebookClient(notebook, kernel, timeout=SECONDS)
    try:
        client.execute()
    finally:
        if client.kc is not None:
            client.kc.stop_channels()
        del notebook.cells[: len(own)]


@contextmanager
def running_kernel(folder: Path) -> Iterator[AsyncKernelManager]:
    """A kernel that takes the package from this checkout; ``folder`` receives IPython's own files."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    manager = AsyncKernelManager(kernel_name="python3")
    run_sync(manager.start_kernel)(env={**os.environ, "PYTHONPATH": path, "IPYTHONDIR": str(folder)})
    try:
        yield manager
    finally:
        run_sync(manager.shutdown_kernel)(now=True)


def run_short(name: str, folder: Path, kernel: AsyncKernelManager) -> None:
    """A notebook with a smaller study runs to its end or to its first ``LONG`` cell, with all figures, without warnings."""
    notebook = read(name)
    notebook.cells = list(takewhile(lambda cell: LONG not in cell.metadata.get("tags", []), notebook.cells))
    if name[:2] in SHORT:
        shorten(notebook, SHORT[name[:2]])
    kept = figures(notebook)
    execute(notebook, folder, kernel, quickly=name[:2] in NOT_OPTIMISED)
    assert figures(notebook) == kept
    assert [out.text for out in outputs(notebook, "stream") if out.name != "stdout"] == []


def compare_with_kept(name: str, folder: Path) -> None:
    """In a kernel of its own, at full size, the text is the same.

    The numbers differ only in the last digits between machines.
    """
    notebook = read(name)
    expected = printed(notebook)
    with running_kernel(folder / "ipython") as kernel:
        execute(notebook, folder, kernel)
    assert NUMBER.sub("#", printed(notebook)) == NUMBER.sub("#", expected)
    pairs = zip(NUMBER.findall(printed(notebook)), NUMBER.findall(expected), strict=True)
    # Differences of rounding (a balance of 1e-11, a disagreement of 1e-7) may be anything of that size.
    far = [(a, b) for a, b in pairs if abs(float(a) - float(b)) > 0.02 * abs(float(b)) + 1e-5]
    assert far == []
