"""Sentences of NMEA 0183 in a log of any kind: with clock times before them, TAG blocks, binary between them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rigwake.text_files import require_file

_MAX_LINE = 4096
_LONGEST = 512
_SENTENCE = re.compile(rb"[$!]([A-Z][A-Z0-9]{3,9}),([^$!*\r\n\x00]{0,%d})(?:\*([0-9A-Fa-f]{2}))?" % _LONGEST)
_TAG_TIME = re.compile(rb"\\[^\\]*?c:(\d{10,13})[^\\]*\\$")
_KNOWN = (b"GGA", b"RMC", b"GLL", b"GNS", b"ZDA", b"GST", b"HDT", b"THS", b"VTG", b"GSA", b"GSV", b"HDG")


@dataclass(frozen=True)
class Sentence:
    """Who says it (`GP`), what (`GGA`), and its fields; `is_whole` if its checksum, where it has one, is right.

    logged_s: seconds since 1970 of a TAG block before it."""

    talker: str
    kind: str
    fields: tuple[str, ...]
    is_whole: bool
    logged_s: int | None = None


def _sentences_of(line: bytes) -> Iterator[Sentence]:
    for match in _SENTENCE.finditer(line):
        address = match[1].decode("ascii")
        body = match[1] + b"," + match[2]
        is_whole = True
        if match[3] is not None:
            checksum = 0
            for byte in body:
                checksum ^= byte
            is_whole = checksum == int(match[3], 16)
        fields = tuple(field.strip() for field in match[2].decode("ascii", "replace").split(","))
        talker, kind = ("P", address[1:]) if address.startswith("P") else (address[:-3], address[-3:])
        tag = _TAG_TIME.search(line[: match.start()])
        yield Sentence(talker, kind, fields, is_whole, int(tag[1][:10]) if tag else None)


def sentences(path: Path) -> Iterator[Sentence]:
    """All sentences of a regular file, in order. Raises InputError if it is none, OSError as reading does."""
    require_file(path)
    with path.open("rb") as file:
        while line := file.readline(_MAX_LINE):
            if b"$" in line or b"!" in line:
                yield from _sentences_of(_without_zeros(line))


def _without_zeros(text: bytes) -> bytes:
    """Text of two bytes a character (UTF-16, as PowerShell redirects it) as one byte each; other bytes as they are."""
    return text.replace(b"\0", b"") if text.count(b"\0") > len(text) // 3 else text


def looks_like_nmea(start: bytes) -> bool:
    """Whether the first bytes of a file hold a sentence: one with a right checksum, or of a well-known kind."""
    for match in _SENTENCE.finditer(_without_zeros(start[:65536])):
        is_known = match[1][-3:] in _KNOWN
        if match[3] is None:
            if is_known and match[2].count(b",") >= 3 and match.start() == 0:
                return True
            continue
        found = next(_sentences_of(match[0]), None)
        if found is not None and found.is_whole and (is_known or match.start() == 0):
            return True
    return False
