"""Random access to the messages of chunked bag files (ROS 1 bag, MCAP), without reading what is not asked for.

Where chunks are not compressed a message, or only its first bytes, is read straight from the file.
"""

from __future__ import annotations

import bz2
import io
import os
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from rigwake.errors import InputError
from rigwake.readers.channels import MAX_MESSAGE_BYTES

Framing = Literal["ros1", "mcap"]

MAX_CHUNK_BYTES = 2**30
"""A chunk that claims to unpack to more is damage (recorders write 1 to 16 MB)."""

_PEEK_BYTES = 512  # covers the record header of a message, and of an image its stamp and frame


class Chunk(NamedTuple):
    """Where a chunk's content lies in the file and how it is packed (`none`, `lz4`, `bz2`, `zstd`)."""

    position: int
    stored_bytes: int
    content_bytes: int
    compression: str


def unpack(stored: bytes, chunk: Chunk) -> bytes:
    """The content of a chunk; never more than it declares.

    Raises InputError if it is damaged, too large or packed in an unknown way.
    """
    if chunk.content_bytes > MAX_CHUNK_BYTES:
        raise InputError(f"A chunk claims to hold {chunk.content_bytes} bytes.")
    try:
        match chunk.compression:
            case "none":
                return stored
            case "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(stored, chunk.content_bytes))
            case "bz2":
                return bz2.BZ2Decompressor().decompress(stored, chunk.content_bytes)
            case "zstd":
                with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(stored)) as reader:
                    return bytes(reader.read(chunk.content_bytes))
    except (RuntimeError, OSError, EOFError, ValueError, zstandard.ZstdError) as error:
        raise InputError(f"A chunk cannot be unpacked ({error}).") from error
    raise InputError(f"Chunk compression {chunk.compression!r} is unknown.")


def read_chunk(file: int, chunk: Chunk) -> bytes:
    """Read and unpack a whole chunk from an open file descriptor; InputError as in `unpack`."""
    if chunk.stored_bytes > MAX_CHUNK_BYTES:
        raise InputError(f"A chunk claims to take {chunk.stored_bytes} bytes.")
    return unpack(os.pread(file, chunk.stored_bytes, chunk.position), chunk)


def message_span(record: bytes, framing: Framing) -> tuple[int, int]:
    """Start and length of the message within a message record; InputError where this is not one."""
    try:
        if framing == "ros1":
            (header_bytes,) = struct.unpack_from("<I", record, 0)
            (message_bytes,) = struct.unpack_from("<I", record, 4 + header_bytes)
            start = 8 + header_bytes
        else:
            opcode, record_bytes = struct.unpack_from("<BQ", record, 0)
            start, message_bytes = 31, record_bytes - 22
            if opcode != 0x05:
                raise InputError("An index entry does not point at a message.")
    except struct.error as error:
        raise InputError("A message record is cut off.") from error
    if not 0 <= message_bytes <= MAX_MESSAGE_BYTES:
        raise InputError(f"A message claims to take {message_bytes} bytes.")
    return start, message_bytes


@dataclass(frozen=True, eq=False)
class ChunkedPayloads:
    """Messages by (chunk, offset): chunk_rows (N,) into `chunks`, offsets (N,) of their records therein."""

    path: Path
    framing: Framing
    chunks: tuple[Chunk, ...]
    chunk_rows: NDArray[np.int32]
    offsets: NDArray[np.int64]

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
                yield _message(file, chunk, content, int(self.offsets[row]), self.framing, limit_bytes)
        finally:
            os.close(file)


def _content(file: int, chunk: Chunk) -> bytes | None:
    """What a packed chunk holds; None for one that is not packed and is read message by message."""
    if chunk.compression == "none":
        return None
    try:
        return read_chunk(file, chunk)
    except InputError:
        return b""  # its messages come out empty, and whoever decodes them counts them as damaged


def _message(
    file: int, chunk: Chunk, content: bytes | None, offset: int, framing: Framing, limit_bytes: int
) -> bytes:
    where = chunk.position + offset
    peek = slice(offset, offset + _PEEK_BYTES)
    record = os.pread(file, _PEEK_BYTES, where) if content is None else content[peek]
    try:
        start, message_bytes = message_span(record, framing)
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


def read_together(wanted: Sequence[tuple[ChunkedPayloads, int]]) -> list[list[bytes]]:
    """All messages of several channels of one file, each cut after its limit; every chunk is unpacked once.

    Otherwise a packed file would be unpacked again for every channel.
    """
    messages: list[list[bytes]] = [[] for _ in wanted]
    if not wanted:
        return messages
    first = wanted[0][0]
    ends = [np.searchsorted(p.chunk_rows, np.arange(len(p.chunks)), side="right") for p, _ in wanted]
    file = os.open(first.path, os.O_RDONLY)
    try:
        for chunk_row, chunk in enumerate(first.chunks):
            content = _content(file, chunk)
            for (payloads, limit), end, read in zip(wanted, ends, messages, strict=True):
                offsets = payloads.offsets[len(read) : end[chunk_row]]
                read += [_message(file, chunk, content, int(at), first.framing, limit) for at in offsets]
    finally:
        os.close(file)
    return messages
