"""Run the tests with every supported Python at hand; a table says what passed and what was skipped.

    python tests/matrix.py [WORDS OF PYTEST]

Each Python gets the newest versions that the bounds allow. The first one also gets the lowest of what is needed besides
the tests' own tools. Every environment is new.
"""

import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
#: Old versions announce changes of what they need in turn.
OLD = ("-W", "default::DeprecationWarning")
LOWER = re.compile(r"^([A-Za-z0-9_.-]+)(?:\[[^\]]*\])?>=([0-9.]+)")


def lowest(requirements: Sequence[str]) -> list[str]:
    """The lower bound of every requirement as a pin."""
    found = [LOWER.match(requirement) for requirement in requirements]
    return [f"{bound[1]}=={bound[2]}" for bound in found if bound]


def interpreter(version: str) -> str | None:
    """The interpreter of this version on the path, None where there is none that runs."""
    path = shutil.which(f"python{version}")
    if path is None:
        return None
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    done = subprocess.run([path, "-c", code], capture_output=True, text=True, check=False)
    return path if done.stdout.strip() == version else None


def outcome(python: str, pins: Sequence[str], words: Sequence[str]) -> tuple[bool, str]:
    """Install into a new environment and run the tests: whether they passed, and the last line of pytest or of pip."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        own = str(next(path for path in Path(folder).glob("*/python*") if path.name in ("python", "python.exe")))
        constraints = Path(folder) / "pins.txt"
        constraints.write_text("\n".join(pins), encoding="utf-8")
        install = [own, "-m", "pip", "install", "--quiet", "-c", str(constraints), f"{ROOT}[test]"]
        done = subprocess.run(install, capture_output=True, text=True, check=False)
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
            return False, f"not installed: {errors[0] if errors else 'see pip'}"
        done = subprocess.run(
            [own, "-m", "pytest", "-q", *words], cwd=ROOT, capture_output=True, text=True, check=False
        )
        lines = done.stdout.strip().splitlines() or done.stderr.strip().splitlines() or ["no output"]
        failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
        return done.returncode == 0, "\n".join([lines[-1], *failed])


def main(words: Sequence[str]) -> int:
    """Print a line per environment; 1 where tests failed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    pins = lowest([*project["dependencies"], *extras["formats"], *extras["maps"], *extras["compare"]])
    failed = False
    for version in PYTHONS:
        path = interpreter(version)
        runs = [("newest", [], words)]
        if version == PYTHONS[0]:
            runs.append(("lowest", pins, [*OLD, *words]))
        for name, own, asked in runs:
            passed, found = (True, "skipped, no such interpreter") if path is None else outcome(path, own, asked)
            failed |= not passed
            print(f"Python {version}, {name} versions: {found}", flush=True)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
