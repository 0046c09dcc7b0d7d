"""Decodes a text in UTF-8 and locates the first byte that is not text."""

import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from pathlib import Path

from capsule_id.errors import InputError


def decode(content: bytes, path: Path) -> str:
    """UTF-8 or, with its byte-order mark, UTF-16 text: with ``\\n`` line ends, without the mark.

    Raises
    ------
    InputError
        If the content is not UTF-8 or holds a NUL byte, at its line and character.
    """
    if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        content = content.decode("utf-16", "replace").encode()
    nul = content.find(b"\0")
    if nul >= 0:
        place, remedy = place_of_byte(content[:nul]), "export it as text"
        raise InputError("the file must be text", "a binary file (NUL byte)", remedy, path, *place)
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        place = place_of_byte(error.object[: error.start])  # error.object: the bytes after the byte-order mark
        value = f"byte 0x{error.object[error.start]:02x}"
        raise InputError("the file must be UTF-8 text", value, "save it as UTF-8", path, *place) from None


def place_of_byte(before: bytes, codec: str = "utf-8") -> tuple[int, int]:
    """1-based line and character of a byte; the bytes ``before`` it may be invalid too."""
    lines = re.split(r"\r\n?|\n", before.decode(codec, "replace"))
    return len(lines), len(lines[-1]) + 1
