"""``rig.toml`` with places: tomllib reads the values, a scanner finds their lines and columns."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capsule_id.errors import InputError

KeyPath = tuple[str | int, ...]
#: Largest rig.toml, characters, and deepest key. A rig needs a few thousand characters and six levels.
LARGEST_TEXT, DEEPEST_KEY = 1_000_000, 32

_SHALLOW = "write the plain tables"
_MULTILINE_BASIC = re.compile(r'"""(?:[^\\]|\\.)*?"""(?:"{0,2})', re.DOTALL)
_MULTILINE_LITERAL = re.compile(r"'''.*?'''(?:'{0,2})", re.DOTALL)
_BASIC = re.compile(r'"(?:[^"\\\n]|\\.)*"')
_LITERAL = re.compile(r"'[^'\n]*'")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BARE_VALUE = re.compile(r"[^,\]}#\n]+")
_BLANK = re.compile(r"(?:[ \t\n]|#[^\n]*)*")
_SPACES = re.compile(r"[ \t]*")


@dataclass(frozen=True)
class TomlDocument:
    """A parsed TOML file with the place of each key and value.

    Attributes
    ----------
    path : the file, as given by the user
    data : the content as tomllib returns it
    keys, values : offset of every key and value by key path, e.g. ("experiment", 0, "kind")
    text : the file's text with ``\\n`` line ends
    """

    path: Path
    data: dict[str, Any]
    keys: dict[KeyPath, int]
    values: dict[KeyPath, int]
    text: str

    def place(self, path: KeyPath, of_key: bool = False) -> tuple[int, int]:
        """Line and column (1-based characters) of the value (or key) at ``path``; of its nearest ancestor if absent."""
        first, second = (self.keys, self.values) if of_key else (self.values, self.keys)
        while path:
            offset = first.get(path, second.get(path))
            if offset is not None:
                return _line_and_column(self.text, offset)
            path = path[:-1]
        return 1, 1

    def error(self, path: KeyPath, rule: str, value: str, remedy: str, of_key: bool = False) -> InputError:
        """The error about the value (or key) at ``path``."""
        line, column = self.place(path, of_key)
        return InputError(rule, value, remedy, self.path, line, column)


def parse_toml(text: str, path: Path) -> TomlDocument:
    """Parse ``text`` (line ends ``\\n``) and locate every key and value.

    Raises
    ------
    InputError
        If it is not TOML 1.0, at the place that tomllib names.
    """
    if len(text) > LARGEST_TEXT:
        rule, remedy = (
            f"the file must hold at most {LARGEST_TEXT} characters",
            "write readings into tables of their own",
        )
        raise InputError(rule, str(len(text)), remedy, path, 1, 1)
    try:
        data = tomllib.loads(text)
        scanner = _Scanner(text)
        scanner.scan()
    except RecursionError:
        raise InputError("nesting must be shallow", "too many brackets", _SHALLOW, path, 1, 1) from None
    except ValueError as error:
        message = str(error)
        found = re.search(r"\(at line (\d+), column (\d+)\)", message)
        line, column = (int(found[1]), int(found[2])) if found else _line_and_column(text, len(text))
        what = message.split(" (at ")[0]
        raise InputError("the file must be valid TOML", what, "correct this line", path, line, column) from None
    deepest = max(scanner.keys, key=len, default=())
    if len(deepest) > DEEPEST_KEY:
        place = _line_and_column(text, scanner.keys[deepest])
        raise InputError("nesting must be shallow", f"a key of {len(deepest)} levels", _SHALLOW, path, *place)
    return TomlDocument(path, data, scanner.keys, scanner.values, text)


def _line_and_column(text: str, offset: int) -> tuple[int, int]:
    """1-based line and column of a character offset."""
    return text.count("\n", 0, offset) + 1, offset - (text.rfind("\n", 0, offset) + 1) + 1


class _Scanner:
    """Records the places in a text that tomllib has accepted; it checks nothing."""

    def __init__(self, text: str) -> None:
        self.text, self.position = text, 0
        self.keys: dict[KeyPath, int] = {}
        self.values: dict[KeyPath, int] = {}
        self.lengths: dict[KeyPath, int] = {}  # of arrays of tables

    def scan(self) -> None:
        """Read every statement: table header or key = value."""
        base: KeyPath = ()
        self.skip(_BLANK)
        while self.position < len(self.text):
            if self.text.startswith("[", self.position):
                base = self.header()
            else:
                self.key_value(base)
            self.skip(_BLANK)

    def skip(self, pattern: re.Pattern[str]) -> str:
        """Move behind a match of ``pattern`` and return its text, which may be empty."""
        match = pattern.match(self.text, self.position)
        if match is None:
            return ""
        self.position = match.end()
        return match[0]

    def header(self) -> KeyPath:
        """``[a.b]`` or ``[[a.b]]``; the path that the following keys belong to."""
        start = self.position
        is_array = self.text.startswith("[[", start)
        self.position += 2 if is_array else 1
        path: KeyPath = ()
        names = [name for name, _ in self.dotted_key()]
        for depth, name in enumerate(names):
            path = (*path, name)
            if is_array and depth == len(names) - 1:
                self.lengths[path] = self.lengths.get(path, 0) + 1
                self.keys.setdefault(path, start)
            if path in self.lengths:
                path = (*path, self.lengths[path] - 1)
        self.keys[path] = start
        self.position += 2 if is_array else 1
        return path

    def dotted_key(self) -> list[tuple[str, int]]:
        """``a."b c".d``: the names with their offsets."""
        parts = []
        while True:
            self.skip(_SPACES)
            offset = self.position
            if self.text[offset] in "\"'":
                token = self.skip(_BASIC if self.text[offset] == '"' else _LITERAL)
                parts.append((tomllib.loads(f"key = {token}")["key"], offset))
            else:
                parts.append((self.skip(_BARE_KEY), offset))
            self.skip(_SPACES)
            if not self.text.startswith(".", self.position):
                return parts
            self.position += 1

    def key_value(self, base: KeyPath) -> None:
        """``a.b = value``."""
        path = base
        for name, offset in self.dotted_key():
            path = (*path, name)
            self.keys.setdefault(path, offset)
        self.position += 1  # the equals sign
        self.value(path)

    def value(self, path: KeyPath) -> None:
        """A string, array, inline table or bare word."""
        self.skip(_SPACES)
        self.values[path] = self.position
        ahead = self.text[self.position : self.position + 3]
        if ahead == '"""' or ahead == "'''":
            self.skip(_MULTILINE_BASIC if ahead == '"""' else _MULTILINE_LITERAL)
        elif ahead[0] in "\"'":
            self.skip(_BASIC if ahead[0] == '"' else _LITERAL)
        elif ahead[0] == "[":
            self.items("]", path)
        elif ahead[0] == "{":
            self.items("}", path)
        else:
            self.skip(_BARE_VALUE)

    def items(self, closing: str, path: KeyPath) -> None:
        """The inside of an array or inline table."""
        self.position += 1
        index = 0
        self.skip(_BLANK)
        while not self.text.startswith(closing, self.position):
            if closing == "]":
                self.value((*path, index))
                index += 1
            else:
                self.key_value(path)
            self.skip(_BLANK)
            if self.text.startswith(",", self.position):
                self.position += 1
                self.skip(_BLANK)
        self.position += 1
