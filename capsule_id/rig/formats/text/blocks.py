"""The text of a file in blocks of whole lines, so that memory does not grow with the file."""

import codecs
import gzip
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from capsule_id.errors import InputError
from capsule_id.rig.formats.limits import complete, refuse_large
from capsule_id.rig.formats.text.decode import place_of_byte

#: The bytes of a file, or where they lie.
Content = bytes | Path
COMPRESSED = ".gz"
#: Characters of a block, and bytes that are read at a time.
BLOCK = 1 << 22
WINDOWS = "Windows-1252"
_CODECS = {"UTF-8": "utf-8-sig", "UTF-16": "utf-16", WINDOWS: "cp1252"}
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
        self._content, self.path, self.last = content, path, last
        self._compressed = path.suffix.lower() == COMPRESSED
        self._has_feeds = False
        self.encoding = self._find_encoding()

    def blocks(self, first: int = 0) -> Iterator[tuple[int, bytes]]:
        """Blocks of lines from line ``first``, counted from 0: the number of their first line, and their text in UTF-8.

        Every line ends with a line feed, the last one too.
        """
        number = 0
        for block in self._utf8() if self.encoding == "UTF-8" and self._has_feeds else self._decoded():
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

    def _open(self) -> BinaryIO:
        """The bytes of the text."""
        stored = io.BytesIO(self._content) if isinstance(self._content, bytes) else self._content
        if self._compressed:
            return cast(BinaryIO, gzip.open(stored))
        return stored.open("rb") if isinstance(stored, Path) else stored

    def _chunks(self) -> Iterator[tuple[int, bytes]]:
        """The bytes of the text, and the place of the first one of each chunk."""
        offset = 0
        with self._open() as file:
            while True:
                if self._compressed:
                    with complete(self.path, "compress it again by gzip"):
                        chunk = file.read(BLOCK)
                    refuse_large(offset + len(chunk), self.path)
                else:
                    chunk = file.read(BLOCK)
                if not chunk:
                    return
                yield offset, chunk
                offset += len(chunk)

    def _utf8(self) -> Iterator[bytes]:
        """Blocks that end with a line feed, but for the last one, of a text in UTF-8; it is not decoded."""
        with self._open() as file:
            if file.read(len(codecs.BOM_UTF8)) != codecs.BOM_UTF8:
                file.seek(0)
            while text := file.read(BLOCK):
                text += file.readline()
                yield text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text

    def _decoded(self) -> Iterator[bytes]:
        """Blocks of whole lines of a text in another encoding, or with carriage returns alone between its lines."""
        with self._open() as raw, io.TextIOWrapper(raw, _CODECS[self.encoding]) as file:
            while text := file.read(BLOCK):
                yield (text + file.readline()).encode()

    def _find_encoding(self) -> str:
        """The encoding, by one pass through the file; Windows-1252 where it is no UTF-8 and begins with ASCII."""
        beginning = next(self._chunks(), (0, b""))[1]
        marked = beginning.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        decoder, fault, end = codecs.getincrementaldecoder("utf-16" if marked else "utf-8")(), None, 0
        for offset, chunk in self._chunks():
            if not marked and (nul := chunk.find(b"\0")) >= 0:
                self._refuse(offset + nul, "the file must be text", "a binary file (NUL byte)", "export it as text")
            end, self._has_feeds = offset + len(chunk), self._has_feeds or b"\n" in chunk
            waiting = len(decoder.getstate()[0])
            if fault is None and (marked or waiting or not chunk.isascii()):
                fault = _fault(decoder, chunk, offset - waiting)
        if fault is None and (waiting := len(decoder.getstate()[0])):
            fault = end - waiting
        if marked and fault is not None:
            self._refuse(fault, "the file must be text", "damaged UTF-16", "save it as UTF-8", "utf-16")
        return "UTF-16" if marked else "UTF-8" if fault is None else self._windows(fault)

    def _windows(self, fault: int) -> str:
        """Windows-1252, for a text that is ASCII before the byte ``fault``, which is no UTF-8."""
        for offset, chunk in self._chunks():
            wrong = fault if not chunk[: max(fault - offset, 0)].isascii() else None
            if wrong is None and (found := _NOT_WINDOWS.search(chunk)):
                wrong = offset + found.start()
            if wrong is not None:
                self._refuse(wrong, "the file must be UTF-8 text", None, "save it as UTF-8")
        return WINDOWS

    def _refuse(self, offset: int, rule: str, value: str | None, remedy: str, codec: str = "utf-8") -> None:
        """Raise at a byte; ``value`` None names the byte, ``codec`` decodes the bytes before it."""
        with self._open() as file:
            before, byte = file.read(offset), file.read(1)
        raise InputError(rule, value or f"byte 0x{byte.hex()}", remedy, self.path, *place_of_byte(before, codec))


def occurrences(mark: str, text: bytes) -> int:
    """How often an ASCII character occurs; faster than ``count`` where it is frequent."""
    return int(np.count_nonzero(np.frombuffer(text, np.uint8) == ord(mark)))


def lines_of(text: bytes) -> list[str]:
    """The lines of a block, without line feeds."""
    return text[:-1].decode().split("\n")


def _fault(decoder: codecs.IncrementalDecoder, chunk: bytes, offset: int) -> int | None:
    """Place of the first byte that ``decoder`` refuses, None where there is none; it waits for bytes at ``offset``."""
    try:
        decoder.decode(chunk)
    except UnicodeDecodeError as error:
        return offset + error.start
    return None
