"""The chapters of even number, see ``test_notebooks.py``; another worker takes this file."""

from pathlib import Path

import pytest

from tests.notebook_tools import EVEN, compare_with_kept, run_short


@pytest.mark.parametrize("name", EVEN)
def test_a_notebook_runs_from_a_clean_copy(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_short(name, tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVEN)
def test_kept_outputs_are_what_the_code_prints(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compare_with_kept(name, tmp_path, monkeypatch)
