"""The text of a file in blocks of whole lines."""

import codecs
import gzip
import io
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.limits import complete, refuse_large

#: The bytes of a file, or where they lie.
Content = bytes | Path
COMPRESSED = ".gz"
#: Bytes of a block, and bytes that are decompressed at a time.
BLOCK = 1 << 22
WINDOWS = "Windows-1252"
_CODECS = {"UTF-16": "utf-16", WINDOWS: "cp1252"}
_NOT_WINDOWS = re.compile(rb"[\x81\x8d\x8f\x90\x9d]")


class TextFile:
    """A text in UTF-8, in UTF-16 with a byte-order mark, or in Windows-1252, compressed where its name ends in ``.gz``.

    Attributes
    ----------
    path : its name, for error lines
    encoding : its encoding
    last : number of the last line that is read, counted from 1 (None: all are read)

    Raises
    ------
    InputError
        If the content is no text, at its line and character, or a compressed file is damaged or too large.
    """

    def __init__(self, content: Content, path: Path, last: int | None = None) -> None:
        self.path, self.last = path, last
        raw = _bytes_of(content, path)
        self.encoding = _encoding(raw, path)
        text = (
            raw.removeprefix(codecs.BOM_UTF8)
            if self.encoding == "UTF-8"
            else raw.decode(_CODECS[self.encoding]).encode()
        )
        self._text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text

    def blocks(self, first: int = 0) -> Iterator[tuple[int, bytes]]:
        """Blocks of lines from line ``first``, counted from 0: the number of their first line, and their text in UTF-8.

        Every line ends with a line feed, the last one too.
        """
        number = end = 0
        while end < len(self._text):
            begin, end = end, self._text.find(b"\n", end + BLOCK) + 1 or len(self._text)
            block = self._text[begin:end]
            text = block if block.endswith(b"\n") else block + b"\n"
            lines = occurrences("\n", text)
            if self.last is not None and number + lines > self.last:
                lines = self.last - number
                text = b"\n".join([*text.split(b"\n", lines)[:-1], b""]) if lines else b""
            if not lines:
                return
            if number + lines > first:
                yield max(number, first), text.split(b"\n", first - number)[-1] if first > number else text
            number += lines

    def lines(self, first: int = 0) -> Iterator[str]:
        """The lines from line ``first`` on, counted from 0."""
        for _, text in self.blocks(first):
            yield from lines_of(text)

    def line(self, number: int) -> str:
        """Line ``number``, counted from 0; "" where the file has none."""
        return next(self.lines(number), "")


def _bytes_of(content: Content, path: Path) -> bytes:
    """The bytes of a text, decompressed."""
    if path.suffix.lower() != COMPRESSED:
        return content if isinstance(content, bytes) else content.read_bytes()
    found = bytearray()
    with gzip.open(io.BytesIO(content) if isinstance(content, bytes) else content) as file:
        while True:
            with complete(path, "compress it again by gzip"):
                chunk = file.read(BLOCK)
            refuse_large(len(found) + len(chunk), path)
            if not chunk:
                return bytes(found)
            found += chunk


def _encoding(raw: bytes, path: Path) -> str:
    """The encoding of a text; Windows-1252 where it is no UTF-8 and begins with ASCII.

    Raises
    ------
    InputError
        At the first byte that is no text.
    """
    rule, binary = "the file must be text", ("a binary file (NUL byte)", "export it as text")
    marked = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if not marked and (nul := raw.find(b"\0")) >= 0:
        raise InputError(rule, *binary, path, *place_of_byte(raw[:nul], "utf-8"))
    codec = "utf-16" if marked else "utf-8"
    try:
        raw.decode(codec)
    except UnicodeDecodeError as error:
        fault = error.start
    else:
        return "UTF-16" if marked else "UTF-8"
    if marked:
        raise InputError(rule, "damaged UTF-16", "save it as UTF-8", path, *place_of_byte(raw[:fault], codec))
    wrong = fault if not raw[:fault].isascii() else None
    if wrong is None and (found := _NOT_WINDOWS.search(raw)):
        wrong = found.start()
    if wrong is not None:
        value = f"byte 0x{raw[wrong : wrong + 1].hex()}"
        raise InputError(
            "the file must be UTF-8 text", value, "save it as UTF-8", path, *place_of_byte(raw[:wrong], codec)
        )
    return WINDOWS


def occurrences(mark: str, text: bytes) -> int:
    """How often an ASCII character occurs; faster than ``count`` where it is frequent."""
    return int(np.count_nonzero(np.frombuffer(text, np.uint8) == ord(mark)))


def lines_of(text: bytes) -> list[str]:
    """The lines of a block, without line feeds."""
    return text[:-1].decode().split("\n")


def place_of_byte(before: bytes, codec: str = "utf-8") -> tuple[int, int]:
    """1-based line and character of a byte; the bytes ``before`` it may be invalid too."""
    lines = re.split(r"\r\n?|\n", before.decode(codec, "replace"))
    return len(lines), len(lines[-1]) + 1
