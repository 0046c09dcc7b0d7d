"""The repository: style, types, layers, sizes, and settings that all have an effect."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import capsule_id
from tests.cli_tools import ROOT

SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LARGEST_FILE = 1_000_000  # bytes
LONGEST_FUNCTION = 60  # lines
#: Places of one machine, and marks of unfinished work, taken apart so that this file does not hold them.
FORBIDDEN = [
    "/" + "work" + "/", "/" + "tmp" + "/", "/" + "root" + "/", "/" + "home" + "/", "/" + "opt" + "/", "file:" + "//",
    "index" + "-url", "find" + "-links", "pypi" + ".org", "TO" + "DO", "FIX" + "ME",
]  # fmt: skip


def tracked() -> list[Path]:
    """Files that git tracks or does not ignore."""
    words = ["git", "-C", str(ROOT), "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    return [ROOT / name for name in listed if (ROOT / name).is_file()]


def tool(*words: str) -> subprocess.CompletedProcess[str]:
    """Run a tool from the folder of the interpreter."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "PYRIGHT_PYTHON_IGNORE_WARNINGS": "1"}
    program = str(Path(sys.executable).parent / words[0])
    return subprocess.run([program, *words[1:]], cwd=ROOT, env=env, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "words",
    [
        ("ruff", "check", "--no-cache", "."),
        ("ruff", "format", "--no-cache", "--check", "."),
        pytest.param(("pyright", "--pythonpath", sys.executable), marks=pytest.mark.full),
        ("lint-imports", "--no-cache"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_tools_find_nothing(words: tuple[str, ...]) -> None:
    done = tool(*words)
    assert done.returncode == 0, done.stdout + done.stderr


def test_tools_would_find_something(tmp_path: Path) -> None:
    """Negative control: the same settings refuse a function without annotations and a wrong type."""
    (tmp_path / "bad.py").write_text('"""Bad."""\n\n\ndef half(x):\n    return x / 2\n\n\nn: int = "text"\n')
    config = str(ROOT / "pyproject.toml")
    assert "ANN" in tool("ruff", "check", "--no-cache", "--config", config, str(tmp_path)).stdout
    assert "reportAssignmentType" in tool("pyright", "--pythonpath", sys.executable, str(tmp_path / "bad.py")).stdout


def test_every_path_of_the_settings_exists() -> None:
    project, tools = SETTINGS["project"], SETTINGS["tool"]
    paths = [project["readme"], *project["license-files"], *tools["pytest"]["ini_options"]["testpaths"]]
    paths += [*tools["pytest"]["ini_options"]["pythonpath"], *tools["hatch"]["build"]["targets"]["wheel"]["packages"]]
    paths += tools["pyright"]["include"]
    assert [path for path in paths if not (ROOT / path).exists()] == []
    for entry in project["scripts"].values():
        module, function = entry.split(":")
        tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text(encoding="utf-8"))
        assert function in [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]


def test_the_layers_are_the_modules_and_packages_of_the_top_level() -> None:
    (contract,) = SETTINGS["tool"]["importlinter"]["contracts"]
    layers = {name.strip("() ") for layer in contract["layers"] for name in layer.split("|")}
    present = {
        f"capsule_id.{path.stem}"
        for path in (ROOT / "capsule_id").iterdir()
        if (path.suffix == ".py" and path.stem != "__init__") or (path / "__init__.py").exists()
    }
    assert layers == present


def test_dependencies_are_what_is_imported() -> None:
    """Every requirement is imported, and every import from outside the standard library is a requirement."""
    text = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "capsule_id").rglob("*.py"))
    found = {
        name.partition(".")[0]
        for path in (ROOT / "capsule_id").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [each.name for each in node.names])
    }
    imported = {"pillow" if name == "PIL" else name for name in found - sys.stdlib_module_names - {"capsule_id"}}
    # xarray writes through h5netcdf: it needs no import of ours.
    imported |= {"h5netcdf"} if 'engine="h5netcdf"' in text else set()
    imported = {{"nptdms": "npTDMS"}.get(name, name) for name in imported}
    extras = SETTINGS["project"]["optional-dependencies"]
    required, optional = (
        {re.split(r"[<>=\[]", line)[0] for line in lines}
        for lines in (SETTINGS["project"]["dependencies"], extras["maps"] + extras["formats"])
    )
    assert required - imported == set()
    assert imported - required == optional


def test_the_package_states_its_version_and_its_types() -> None:
    assert capsule_id.__version__ == SETTINGS["project"]["version"]
    assert (ROOT / "capsule_id" / "py.typed").is_file()


def test_functions_are_short() -> None:
    long = []
    for path in (path for path in tracked() if path.suffix == ".py"):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno >= LONGEST_FUNCTION:
                long.append(f"{path.name}: {node.name}")
    assert long == []


def test_nothing_large_and_nothing_of_one_machine() -> None:
    found = []
    for path in tracked():
        content = path.read_bytes()
        assert len(content) <= LARGEST_FILE, path
        text = content.decode("utf-8", errors="ignore")
        found += [f"{path.relative_to(ROOT)}: {word}" for word in FORBIDDEN if word in text]
    assert found == []


def test_public_functions_and_classes_say_what_they_are() -> None:
    silent = []
    for path in (ROOT / "capsule_id").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        nodes = [tree, *(n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef))]
        public = [n for n in nodes if not getattr(n, "name", "").startswith("_")]
        silent += [f"{path.name}: {getattr(n, 'name', '')}" for n in public if not ast.get_docstring(n)]
    assert silent == []
