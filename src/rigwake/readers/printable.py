"""Texts of untrusted recordings, made harmless for terminals and as names of files."""

from __future__ import annotations

import unicodedata

_LONGEST_TEXT = 300
_LONGEST_NAME = 100
_NOT_IN_FILE_NAMES = frozenset('/\\:*?"<>|')


def printable(text: str) -> str:
    """The text without control, formatting and surrogate characters (each becomes `?`), cut at 300 characters.

    A terminal obeys escape sequences, so what a recording names itself never reaches one unchanged.
    """
    if text.isascii() and text.isprintable() and len(text) <= _LONGEST_TEXT:
        return text
    kept = "".join(
        "?" if unicodedata.category(letter)[0] == "C" else letter for letter in text[:_LONGEST_TEXT]
    )
    return kept if len(text) <= _LONGEST_TEXT else f"{kept[:-1]}…"


def is_plain_name(name: str) -> bool:
    """Whether a sensor's name is fit to name a file: nothing that leads elsewhere, hides or is too long."""
    return (
        0 < len(name.encode("utf-8", "replace")) <= _LONGEST_NAME
        and not name.startswith((".", "-", "~"))
        and printable(name) == name
        and not _NOT_IN_FILE_NAMES.intersection(name)
    )


def plain_name(name: str) -> str:
    """The nearest name that `is_plain_name` accepts."""
    changed = "".join("_" if letter in _NOT_IN_FILE_NAMES else letter for letter in printable(name))
    changed = changed.lstrip(".-~").encode("utf-8", "replace")[:_LONGEST_NAME].decode("utf-8", "ignore")
    return changed or "sensor"
