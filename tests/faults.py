"""Thirty one-line faults, drawn by a seed from the code of the package: which tier of the tests finds them.

``python -m tests.faults list`` prints the faults, ``python -m tests.faults run TABLE`` runs the tests against each of
them, stops each run at its first failure, and keeps a line of JSON per run in TABLE, with which a later call goes on.
"""

import argparse
import ast
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
SEED, NUMBER = 20261127, 30
#: Parts of the package that the faults are drawn from, in turn.
PARTS = {
    "physics": ("physics/**/*.py",),
    "likelihood": ("inference/*.py", "experiments/**/*.py"),
    "checks": ("inference/checks/*.py", "records/*.py", "experiments/**/checks.py", "experiments/**/lint.py"),
    "readers": ("rig/**/*.py", "importing.py"),
}
TIERS = {"core": "not full and not slow and not benchmark", "full": "full and not slow and not benchmark"}


@dataclass(frozen=True)
class Fault:
    """A line of a file of ``capsule_id`` before and after."""

    operator: str
    part: str
    path: str
    line: int
    before: str
    after: str


def sign(node: ast.AST) -> ast.AST | None:
    """a + b becomes a − b, and the reverse."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub) and not _is_text(node):
        return ast.BinOp(node.left, ast.Sub() if isinstance(node.op, ast.Add) else ast.Add(), node.right)
    return None


def twice(node: ast.AST) -> ast.AST | None:
    """a b becomes 2 a b."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult) and not _is_text(node):
        return ast.BinOp(ast.BinOp(ast.Constant(2), ast.Mult(), node.left), ast.Mult(), node.right)
    return None


def dropped(node: ast.AST) -> ast.AST | None:
    """a + b becomes a."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub) and not _is_text(node):
        return node.left
    return None


def bound(node: ast.AST) -> ast.AST | None:
    """< becomes <=, > becomes >=, and the reverse."""
    other = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in other:
        return ast.Compare(node.left, [other[type(node.ops[0])]()], node.comparators)
    return None


def index(node: ast.AST) -> ast.AST | None:
    """x[k] becomes x[k + 1] or, for k from 1 on and for -1, the neighbour towards the middle."""
    if not isinstance(node, ast.Subscript) or not isinstance(node.ctx, ast.Load):
        return None
    try:
        k = ast.literal_eval(node.slice)
    except ValueError:
        return None
    if not isinstance(k, int) or isinstance(k, bool):
        return None
    return ast.Subscript(node.value, ast.Constant(1 if k == 0 else k - 1), ast.Load())


OPERATORS: dict[str, Callable[[ast.AST], ast.AST | None]] = {
    "sign": sign, "factor 2": twice, "dropped term": dropped, "bound": bound, "index": index,
}  # fmt: skip


def _is_text(node: ast.BinOp) -> bool:
    """Whether a sum or product is one of strings or lists, as far as it shows."""
    shown = (ast.JoinedStr, ast.List, ast.Tuple, ast.ListComp, ast.Dict, ast.Set)
    return any(
        isinstance(part, shown) or (isinstance(part, ast.Constant) and isinstance(part.value, str))
        for part in ast.walk(node)
    )


@cache
def _expressions(path: Path) -> tuple[str, list[ast.expr]]:
    """Text of a file, and its expressions of one line outside annotations."""
    text = path.read_text(encoding="utf-8")
    nodes = list(ast.walk(ast.parse(text)))
    hints = [getattr(node, name, None) for node in nodes for name in ("annotation", "returns")]
    silent = {id(one) for hint in hints if hint is not None for one in ast.walk(hint)}
    known = [node for node in nodes if isinstance(node, ast.expr) and id(node) not in silent]
    return text, [node for node in known if node.lineno == node.end_lineno]


def sites(tree: Path, part: str, operator: str) -> Iterator[Fault]:
    """Every place of a part where an operator acts within one line."""
    files = {path for pattern in PARTS[part] for path in (tree / "capsule_id").glob(pattern)}
    if part == "likelihood":  # the checks have a part of their own
        files -= {path for pattern in PARTS["checks"] for path in (tree / "capsule_id").glob(pattern)}
    for path in sorted(files):
        text, nodes = _expressions(path)
        lines = text.splitlines()
        for node in nodes:
            changed = OPERATORS[operator](node)
            if changed is None:
                continue
            raw = lines[node.lineno - 1].encode()
            wanted = f"({ast.unparse(ast.fix_missing_locations(changed))})".encode()
            after = raw[: node.col_offset] + wanted + raw[node.end_col_offset :]
            where = str(path.relative_to(tree))
            yield Fault(operator, part, where, node.lineno, raw.decode(), after.decode())


def drawn(tree: Path = ROOT, seed: int = SEED, number: int = NUMBER) -> list[Fault]:
    """The faults of a seed, in turn over operators and parts; of one place there is one fault at most."""
    rng, found = np.random.default_rng(seed), list[Fault]()
    pairs = [(part, operator) for operator in OPERATORS for part in PARTS]
    places = cache(lambda part, operator: list(sites(tree, part, operator)))
    for i in range(number):
        taken = {(one.path, one.line) for one in found}
        known = [one for one in places(*pairs[i % len(pairs)]) if (one.path, one.line) not in taken]
        found.append(known[int(rng.integers(len(known)))])
    return found


def planted(tree: Path, fault: Fault) -> None:
    """Write a fault into ``tree``."""
    path = tree / fault.path
    lines = path.read_text(encoding="utf-8").split("\n")
    assert lines[fault.line - 1] == fault.before
    lines[fault.line - 1] = fault.after
    path.write_text("\n".join(lines), encoding="utf-8")


def near(fault: Fault) -> list[str]:
    """The files of tests that name the module of a fault: they run first, since one failure of a tier is enough."""
    module = fault.path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    files = (ROOT / "tests").rglob("test_*.py")
    return sorted(str(path.relative_to(ROOT)) for path in files if module in path.read_text(encoding="utf-8"))


def tested(fault: Fault, tier: str) -> dict[str, object]:
    """Run a tier of the tests of a copy of the tree with a fault until the first failure."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "capsule-id"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(tree)], check=True)
        if (ROOT.parent / "shared").is_dir():
            (Path(folder) / "shared").symlink_to(ROOT.parent / "shared")
        planted(tree, fault)
        shutil.rmtree(tree / ".git")  # the tests of the project would name the changed line
        begin = time.monotonic()
        words = [sys.executable, "-m", "pytest", "-x", "-q", "-m", TIERS[tier], "--deselect", "tests/test_project.py"]
        for files in filter(None, (near(fault), ["tests"])):
            done = subprocess.run(
                [*words, *files], cwd=tree, env={**os.environ, "PYTHONPATH": str(tree)}, capture_output=True, text=True
            )
            if done.returncode == 1:
                break
        named = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return {
            **asdict(fault), "tier": tier, "found": done.returncode == 1, "code": done.returncode,
            "by": named[:1], "seconds": round(time.monotonic() - begin),
        }  # fmt: skip


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list")
    run = commands.add_parser("run")
    run.add_argument("table", type=Path)
    run.add_argument("--tiers", nargs="+", default=list(TIERS), choices=TIERS)
    asked = parser.parse_args(words)
    faults = drawn()
    if asked.command == "list":
        for fault in faults:
            print(f"{fault.operator}, {fault.part}: {fault.path}:{fault.line}\n- {fault.before}\n+ {fault.after}")
        return
    known = [json.loads(line) for line in asked.table.read_text().splitlines()] if asked.table.exists() else []
    done = {(one["path"], one["line"], one["after"], one["tier"]): one["found"] for one in known}
    for fault in faults:
        for tier in asked.tiers:
            key = (fault.path, fault.line, fault.after)
            if (*key, tier) in done or any(done.get((*key, other)) for other in TIERS):
                continue
            row = tested(fault, tier)
            done[(*key, tier)] = bool(row["found"])
            with asked.table.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            print(
                f"{tier}: {'found' if row['found'] else 'NOT FOUND'} {fault.path}:{fault.line} {row['by']}", flush=True
            )


if __name__ == "__main__":
    main()
