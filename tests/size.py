"""Size of the package: statements, files, imports, characters, tuned numbers and import circles.

``python -m tests.size [TREE]`` prints the figures of ``TREE/capsule_id``, by folder with ``--folders``, and the tuned
numbers with ``--numbers``.
"""

import argparse
import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Factors of units stand here.
UNITS = "capsule_id.rig.units"
#: Numbers that nobody chose.
PLAIN = {0.0, 1.0, 2.0}
SILENT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}

Body = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Module:
    """One file: its dotted name, its text and its tree."""

    name: str
    text: str
    tree: ast.Module

    @property
    def docstrings(self) -> list[ast.Expr]:
        bodies = [node for node in ast.walk(self.tree) if isinstance(node, Body)]
        firsts = [node.body[0] for node in bodies if node.body and ast.get_docstring(node, clean=False) is not None]
        return [first for first in firsts if isinstance(first, ast.Expr)]

    @property
    def statements(self) -> int:
        """Number of statements without docstrings."""
        return sum(isinstance(node, ast.stmt) for node in ast.walk(self.tree)) - len(self.docstrings)

    @property
    def imports(self) -> int:
        return sum(isinstance(node, ast.Import | ast.ImportFrom) for node in ast.walk(self.tree))

    @property
    def characters(self) -> int:
        """Number of characters of the code without docstrings, comments and white space."""
        silent = {(node.lineno, node.col_offset) for node in self.docstrings}
        tokens = tokenize.generate_tokens(io.StringIO(self.text).readline)
        return sum(
            len("".join(token.string.split()))
            for token in tokens
            if token.type not in SILENT and token.start not in silent
        )

    @property
    def tuned(self) -> list[tuple[int, float]]:
        """Line and value of the numbers in constants, tables, defaults and comparisons; powers of ten are factors there."""
        places = list[ast.expr | None]()
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Module | ast.ClassDef):
                places += [one.value for one in node.body if isinstance(one, ast.Assign | ast.AnnAssign | ast.Expr)]
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                places += [*node.args.defaults, *node.args.kw_defaults]
            elif isinstance(node, ast.Compare):
                places += [node.left, *node.comparators]
        numbers = [number for place in places if place is not None for number in _numbers(place)]
        found = {(node.lineno, node.col_offset): (node.lineno, float(node.value)) for node in numbers}  # type: ignore
        return sorted(pair for pair in found.values() if pair[1] not in PLAIN)


def _numbers(place: ast.expr) -> Iterator[ast.Constant]:
    """Numbers of an expression, without those of indices."""
    indices = {id(one) for node in ast.walk(place) if isinstance(node, ast.Subscript) for one in ast.walk(node.slice)}
    for node in ast.walk(place):
        known = isinstance(node, ast.Constant) and isinstance(node.value, int | float)
        if known and not isinstance(node.value, bool) and id(node) not in indices:
            yield node


def modules(tree: Path) -> list[Module]:
    """The modules of ``tree/capsule_id``."""
    found = []
    for path in sorted((tree / "capsule_id").rglob("*.py")):
        name = ".".join(path.relative_to(tree).with_suffix("").parts).removesuffix(".__init__")
        text = path.read_text(encoding="utf-8")
        found.append(Module(name, text, ast.parse(text)))
    return found


def imported(module: Module, known: set[str]) -> set[str]:
    """Modules of the package that a module names anywhere: in functions and under TYPE_CHECKING too."""
    found = set[str]()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names} & known
            found |= inner or {node.module} & known
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & known
    return found - {module.name}


def circles(found: list[Module]) -> list[list[str]]:
    """Groups of modules that reach each other by imports."""
    known = {module.name for module in found}
    edges = {module.name: imported(module, known) for module in found}

    def reached(name: str) -> set[str]:
        seen, ahead = set[str](), [name]
        while ahead:
            new = edges[ahead.pop()] - seen
            seen |= new
            ahead += new
        return seen

    after = {name: reached(name) for name in edges}
    groups = {
        frozenset({other for other in after[name] if name in after[other]}) for name in edges if name in after[name]
    }
    return sorted(sorted(group) for group in groups)


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tree", nargs="?", type=Path, default=ROOT)
    parser.add_argument("--folders", action="store_true", help="statements and files by folder")
    parser.add_argument("--numbers", action="store_true", help="every tuned number with its place")
    asked = parser.parse_args(words)
    found = modules(asked.tree)
    statements, imports = (sum(getattr(module, what) for module in found) for what in ("statements", "imports"))
    tuned = [(module.name, *pair) for module in found if module.name != UNITS for pair in module.tuned]
    round_trips = circles(found)
    print(f"statements {statements}, files {len(found)}")
    print(f"imports {imports} ({imports / statements:.1%})")
    print(f"characters per statement {sum(module.characters for module in found) / statements:.1f}")
    print(f"tuned numbers {len(tuned)}")
    print(f"circles {len(round_trips)}" + "".join(f"\n  {', '.join(group)}" for group in round_trips))
    if asked.folders:
        count = Counter[str]()
        for module in found:
            count[".".join(module.name.split(".")[:2])] += module.statements
        print("\n".join(f"{number:6d} {name}" for name, number in sorted(count.items())))
    if asked.numbers:
        print("\n".join(f"{name}:{line} {value:g}" for name, line, value in tuned))


if __name__ == "__main__":
    main()
