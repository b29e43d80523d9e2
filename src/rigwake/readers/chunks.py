"""Random access to the messages of chunked bag files (ROS 1 bag, MCAP), without reading what is not asked for.

Where chunks are not compressed a message, or only its first bytes, is read straight from the file.
"""

from __future__ import annotations

import bz2
import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import lz4.frame
import numpy as np
from numpy.typing import NDArray

from rigwake.errors import InputError
from rigwake.readers.channels import MAX_MESSAGE_BYTES
from rigwake.readers.clock_steps import set_back_rows
from rigwake.readers.zstandard_frames import ZstdError, unpack_zstd

Framing = Literal["ros1", "mcap"]

MAX_CHUNK_BYTES = 2**30
"""A chunk that claims to unpack to more is damage (recorders write 1 to 16 MB)."""

MAX_RATIO = 1000
"""What is packed tighter than this (beyond `FREE_BYTES` per file) is made to fill the memory, not recorded."""

FREE_BYTES = 2**28

_REFUSED = "beyond the limit"
_PEEK_BYTES = 512  # covers the record header of a message, and of an image its stamp and frame


class Chunk(NamedTuple):
    """Where a chunk's content lies in the file and how it is packed (`none`, `lz4`, `bz2`, `zstd`)."""

    position: int
    stored_bytes: int
    content_bytes: int
    compression: str
    crc: int = 0
    """CRC-32 of the content; 0 where the file states none."""


def within_budget(chunks: Sequence[Chunk]) -> tuple[list[Chunk], int]:
    """The chunks, of which those beyond the budget of unpacked bytes are refused, and how many those are.

    The budget of a file is `FREE_BYTES + MAX_RATIO * stored bytes`: a few kilobytes cannot ask for gigabytes.
    """
    budget = FREE_BYTES + MAX_RATIO * sum(min(c.stored_bytes, MAX_CHUNK_BYTES) for c in chunks)
    kept, refused = [], 0
    for chunk in chunks:
        tightest = FREE_BYTES // 4 + MAX_RATIO * chunk.stored_bytes
        if chunk.compression != "none":
            if chunk.content_bytes > min(budget, tightest):
                refused += 1
                chunk = chunk._replace(compression=_REFUSED)
            else:
                budget -= chunk.content_bytes
        kept.append(chunk)
    return kept, refused


def unpack(stored: bytes, chunk: Chunk) -> bytes:
    """The content of a chunk; never more than it declares.

    Raises InputError if it is damaged, too large or packed in an unknown way.
    """
    if chunk.content_bytes > MAX_CHUNK_BYTES or chunk.compression == _REFUSED:
        raise InputError(f"A chunk of {len(stored)} bytes claims to hold {chunk.content_bytes} bytes.")
    content = _unpacked(stored, chunk)
    if chunk.crc and zlib.crc32(content) != chunk.crc:
        raise InputError("A chunk does not match its checksum.")
    return content


def _unpacked(stored: bytes, chunk: Chunk) -> bytes:
    try:
        match chunk.compression:
            case "none":
                return stored
            case "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(stored, chunk.content_bytes))
            case "bz2":
                return bz2.BZ2Decompressor().decompress(stored, chunk.content_bytes)
            case "zstd":
                return unpack_zstd(stored, chunk.content_bytes)
    except (RuntimeError, OSError, EOFError, ValueError, ZstdError) as error:
        raise InputError(f"A chunk cannot be unpacked ({error}).") from error
    raise InputError(f"Chunk compression {chunk.compression!r} is unknown.")


def read_chunk(file: int, chunk: Chunk) -> bytes:
    """Read and unpack a whole chunk from an open file descriptor; InputError as in `unpack`."""
    if chunk.stored_bytes > MAX_CHUNK_BYTES:
        raise InputError(f"A chunk claims to take {chunk.stored_bytes} bytes.")
    return unpack(os.pread(file, chunk.stored_bytes, chunk.position), chunk)


@dataclass
class ChunkScan:
    """What one pass over a bag has gathered so far. entries: by connection or channel, (row of the chunk, entries).

    suspect_chunks: whose index contradicts itself or the chunk; they are walked through instead.
    """

    chunks: list[Chunk] = field(default_factory=list)
    entries: dict[int, list[tuple[int, NDArray[np.void]]]] = field(default_factory=dict)
    indexed_chunks: set[int] = field(default_factory=set)
    suspect_chunks: set[int] = field(default_factory=set)
    problems: list[str] = field(default_factory=list)

    def refuse_excess(self) -> None:
        """Refuse chunks that claim more than the file can pack."""
        self.chunks, refused = within_budget(self.chunks)
        if refused:
            self.problems.append(f"{refused} chunks claim to hold far more than the file can pack")

    def walk_unindexed(
        self,
        file: int,
        known: Collection[int],
        walk: Callable[[bytes], Mapping[int, list[tuple[int, ...]]]],
        entry: np.dtype[np.void],
    ) -> None:
        """Walk through chunks that have no index, and those with connections or channels that are not `known`.

        walk: from a chunk's content to the entries of its messages; may learn what is known.
        """
        unknown = {row for c, parts in self.entries.items() if c not in known for row, _ in parts}
        rebuilt = self.suspect_chunks | unknown
        self.indexed_chunks -= rebuilt
        for owner, parts in self.entries.items():
            self.entries[owner] = [part for part in parts if part[0] not in rebuilt]
        lost = []
        for row in sorted(set(range(len(self.chunks))) - self.indexed_chunks):
            try:
                walked = walk(read_chunk(file, self.chunks[row]))
            except InputError as error:
                lost.append(f"({row}: {error.cause.rstrip('.')})")
                continue
            for owner, found in walked.items():
                self.entries.setdefault(owner, []).append((row, np.array(found, entry)))
        if lost:
            self.problems.append(f"{len(lost)} of {len(self.chunks)} chunks are lost {lost[0]}")


def message_span(record: bytes, framing: Framing, owner: int | None = None) -> tuple[int, int]:
    """Start and length of the message within a message record; InputError where this is not one.

    owner: the connection (ROS 1) or channel (MCAP) that the message must be of; a damaged index may point at
    another's.
    """
    try:
        if framing == "ros1":
            (header_bytes,) = struct.unpack_from("<I", record, 0)
            if owner is not None and b"conn=" + struct.pack("<I", owner) not in record[: 4 + header_bytes]:
                raise InputError("An index entry points at a message of another topic.")
            (message_bytes,) = struct.unpack_from("<I", record, 4 + header_bytes)
            start = 8 + header_bytes
        else:
            opcode, record_bytes = struct.unpack_from("<BQ", record, 0)
            start, message_bytes = 31, record_bytes - 22
            if opcode != 0x05:
                raise InputError("An index entry does not point at a message.")
            if owner is not None and struct.unpack_from("<H", record, 9)[0] != owner:
                raise InputError("An index entry points at a message of another topic.")
    except struct.error as error:
        raise InputError("A message record is cut off.") from error
    if not 0 <= message_bytes <= MAX_MESSAGE_BYTES:
        raise InputError(f"A message claims to take {message_bytes} bytes.")
    return start, message_bytes


@dataclass(frozen=True, eq=False)
class ChunkedPayloads:
    """Messages by (chunk, offset): chunk_rows (N,) into `chunks`, offsets (N,) of their records therein.

    owners: (N,) the connection or channel that each message is of.
    """

    path: Path
    framing: Framing
    chunks: tuple[Chunk, ...]
    chunk_rows: NDArray[np.int32]
    offsets: NDArray[np.int64]
    owners: NDArray[np.int64]

    @property
    def is_packed(self) -> bool:
        """Whether any chunk is compressed."""
        return any(chunk.compression != "none" for chunk in self.chunks)

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """See `Payloads.read`; holds one unpacked chunk at a time."""
        file = os.open(self.path, os.O_RDONLY)
        try:
            held, content = -1, None
            for row in rows:
                chunk_row = int(self.chunk_rows[row])
                chunk = self.chunks[chunk_row]
                if chunk_row != held:
                    held, content = chunk_row, _content(file, chunk)
                yield self.message(file, content, int(row), limit_bytes)
        finally:
            os.close(file)

    def message(self, file: int, content: bytes | None, row: int, limit_bytes: int) -> bytes:
        """One message, from the content of its chunk if that was packed; empty if it cannot be read."""
        chunk, offset = self.chunks[int(self.chunk_rows[row])], int(self.offsets[row])
        where = chunk.position + offset
        record = (
            os.pread(file, _PEEK_BYTES, where) if content is None else content[offset : offset + _PEEK_BYTES]
        )
        try:
            start, message_bytes = message_span(record, self.framing, int(self.owners[row]))
        except InputError:
            return b""
        if offset + start + message_bytes > chunk.content_bytes:
            return b""
        wanted = min(message_bytes, limit_bytes)
        if start + wanted <= len(record):
            return record[start : start + wanted]
        if content is None:
            return os.pread(file, wanted, where + start)
        return content[offset + start : offset + start + wanted]


def payloads_in_order(
    path: Path,
    framing: Framing,
    chunks: Sequence[Chunk],
    parts: Sequence[tuple[int, int, NDArray[np.int64]]],
    times_ns: NDArray[np.int64],
) -> tuple[NDArray[np.int64], ChunkedPayloads]:
    """The times, and the messages, in the order of recording: that of their times, and of the file where the clock was
    set back while recording.

    parts: owner, chunk row and offsets (n,) of messages of one topic; times_ns: of all of them, part after part.
    """
    counts = [len(offsets) for _, _, offsets in parts]
    offsets = np.concatenate([np.empty(0, np.int64), *(offsets for _, _, offsets in parts)])
    chunk_rows = np.repeat([row for _, row, _ in parts], counts).astype(np.int32)
    owners = np.repeat([owner for owner, _, _ in parts], counts).astype(np.int64)
    order = np.lexsort((offsets, chunk_rows))
    if not len(set_back_rows(times_ns[order])):
        order = order[np.argsort(times_ns[order], kind="stable")]
    payloads = ChunkedPayloads(path, framing, tuple(chunks), chunk_rows[order], offsets[order], owners[order])
    return times_ns[order], payloads


def _content(file: int, chunk: Chunk) -> bytes | None:
    """What a packed chunk holds; None for one that is not packed and is read message by message."""
    if chunk.compression == "none":
        return None
    try:
        return read_chunk(file, chunk)
    except InputError:
        return b""  # its messages come out empty, and whoever decodes them counts them as damaged


def read_together(wanted: Sequence[tuple[ChunkedPayloads, int]]) -> list[list[bytes]]:
    """All messages of several channels of one file, each cut after its limit; every chunk is unpacked once.

    Otherwise a packed file would be unpacked again for every channel.
    """
    messages: list[list[bytes]] = [[b""] * len(payloads.offsets) for payloads, _ in wanted]
    if not wanted:
        return messages
    first = wanted[0][0]
    orders = [np.argsort(p.chunk_rows, kind="stable") for p, _ in wanted]
    ends = [
        np.searchsorted(p.chunk_rows[order], np.arange(-1, len(first.chunks)), side="right")
        for (p, _), order in zip(wanted, orders, strict=True)
    ]
    file = os.open(first.path, os.O_RDONLY)
    try:
        for chunk_row, chunk in enumerate(first.chunks):
            content = _content(file, chunk)
            for (payloads, limit), order, end, read in zip(wanted, orders, ends, messages, strict=True):
                for row in order[end[chunk_row] : end[chunk_row + 1]].tolist():
                    read[row] = payloads.message(file, content, row, limit)
    finally:
        os.close(file)
    return messages
