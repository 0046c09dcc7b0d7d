"""README is correct: its commands run, its tables are those of the package."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from capsule_id.experiments.registry import default_registry
from tests.cli_tools import DATA, ROOT, environment

README = (ROOT / "README.md").read_text(encoding="utf-8")
KINDS = default_registry()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def set_up_commands() -> list[list[str]]:
    """The two fenced commands at the start of README, each split at &&."""
    return [[part.strip() for part in block.split("&&")] for block in re.findall(r"```sh\n(.*?)\n```", README)[:2]]


def rows(header: str) -> dict[str, list[str]]:
    """The table of README whose header line is ``header``: cells by the first one."""
    lines = README.split(header + "\n", 1)[1].splitlines()[1:]
    table = lines[: lines.index("") if "" in lines else None]
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table]
    return {first.strip("`| "): [cell.strip("| ") for cell in rest] for first, *rest in cells}


def test_the_two_commands_set_up_and_run() -> None:
    fit, test = set_up_commands()
    venv = "python3 -m venv .venv"
    assert fit == [venv, ".venv/bin/pip install .", ".venv/bin/fit-params data/"]
    assert test == [venv, ".venv/bin/pip install '.[test]'", ".venv/bin/python -m pytest"]
    assert "fit-params" in PROJECT["scripts"]
    assert "test" in PROJECT["optional-dependencies"]


def test_the_installed_command_reads_the_folder_that_readme_names(tmp_path: Path) -> None:
    """Tests the entry point; the main job tests its numbers."""
    (tmp_path / "data").symlink_to(DATA)
    command = set_up_commands()[0][-1].replace(".venv/bin", str(Path(sys.executable).parent))
    done = subprocess.run(
        [*command.split(), "--experiments", "bench", "--no-sample", "--quiet"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    report = re.findall(r"`(results/\S+/report\.html)`", README)[0]
    assert (tmp_path / report).is_file()


def test_the_parameter_table_is_the_packages() -> None:
    expected = {symbol: [row.unit, row.meaning, row.describe_prior()] for symbol, row in KINDS.parameters.items()}
    assert rows("| symbol | unit | meaning | default prior |") == expected


def test_the_kinds_of_experiments_are_the_packages() -> None:
    table = rows("| kind | columns | informs |")
    assert list(table) == list(KINDS)
    for kind, (columns, informs) in table.items():
        assert set(re.findall(r"`(\w+) \[", columns)) == set(KINDS[kind].columns)
        assert informs == KINDS[kind].informs


def test_every_path_that_readme_names_exists() -> None:
    named = set(re.findall(r"`((?:capsule_id|data)/[\w/.]*)`", README))
    assert len(named) >= 8
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_the_exit_codes_are_those_of_the_command() -> None:
    from capsule_id import cli

    assert set(rows("| exit code | meaning |")) == {"0", "3", *map(str, (cli.BAD_INPUT, cli.INTERNAL, cli.INTERRUPTED))}


def test_the_examples_in_python_give_what_they_say(capsys: pytest.CaptureFixture[str]) -> None:
    """The motion, then a friction law that goes on from it."""
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict[str, object] = {"__name__": "readme"}
    for block in blocks:
        exec(block, names)
        (promised,) = re.findall(r"print\(.*\)  # (\S+)", block)
        assert capsys.readouterr().out.split() == [promised]
    assert len(blocks) == 2
