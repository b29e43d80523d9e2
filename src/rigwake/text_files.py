"""Text files of strangers: regular files only, bounded in size, in any of the usual encodings."""

from __future__ import annotations

import codecs
from pathlib import Path

from rigwake.errors import InputError

MAX_TEXT_BYTES = 2**30
_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),  # what PowerShell's `>` writes
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def require_file(path: Path, max_bytes: int | None = None) -> Path:
    """The path, if it is a regular file of at most this size; InputError otherwise.

    A pipe would block for ever and a device never end, so neither is opened.
    """
    try:
        if not path.is_file():
            exists = path.exists()
            raise InputError(
                f"{path} is not a regular file." if exists else f"There is no file {path}.",
                remedy="Give a file: folders, pipes and devices are not read here."
                if exists
                else "Check the path.",
            )
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        raise InputError(f"{path!s:.200} cannot be read ({error}).") from error
    if max_bytes is not None and size > max_bytes:
        raise InputError(f"{path} has {size} bytes; such a file is read up to {max_bytes} bytes.")
    return path


def read_text_file(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a regular file: UTF-8, UTF-16 with its mark, else Latin-1 (degree signs in headers).

    Raises InputError if it cannot be read, is larger than `max_bytes` or is not text (holds NUL).
    """
    require_file(path, max_bytes)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from error
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS if content.startswith(mark)), "utf-8")
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        if encoding != "utf-8" or _looks_binary(content):
            raise InputError(f"{path} is not a readable text file: {error}.") from error
        text = content.decode("latin-1")
    if "\0" in text:
        raise InputError(f"{path} is not a readable text file: it holds NUL characters.")
    return text


def _looks_binary(content: bytes) -> bool:
    """Control characters, or more bytes beyond ASCII than a Latin-1 header has."""
    start = content[:65536]
    beyond = sum(byte >= 0x80 for byte in start)
    controls = sum(byte < 32 and byte not in b"\t\n\r\f" for byte in start)
    return controls > 0 or beyond > max(8, len(start) // 100)
