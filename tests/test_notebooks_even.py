"""The chapters of even number, see ``test_notebooks.py``; another worker takes this file."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from jupyter_client.manager import AsyncKernelManager

from tests.notebook_tools import EVEN, compare_with_kept, run_short, running_kernel


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AsyncKernelManager]:
    """One kernel for all chapters of this file: to start it and load JAX takes longer than most chapters."""
    with running_kernel(tmp_path_factory.mktemp("ipython")) as manager:
        yield manager


@pytest.mark.full
@pytest.mark.parametrize("name", EVEN)
def test_a_notebook_runs_from_a_clean_copy(name: str, tmp_path: Path, kernel: AsyncKernelManager) -> None:
    run_short(name, tmp_path, kernel)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVEN)
def test_kept_outputs_are_what_the_code_prints(name: str, tmp_path: Path) -> None:
    compare_with_kept(name, tmp_path)
