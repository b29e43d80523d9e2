"""Index of an MCAP file (ROS 1 or ROS 2 profile), read in one pass over its record headers.

The pass does not need the summary at the end, so a file that was never closed, or was cut off, yields what it
still holds. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigwake.errors import InputError
from rigwake.readers.channels import (
    MAX_MESSAGE_BYTES,
    BagIndex,
    Channel,
    Encoding,
    joined,
    require_regular_file,
    standard_type_name,
)
from rigwake.readers.chunks import Chunk, ChunkScan, payloads_in_order
from rigwake.readers.printable import printable
from rigwake.recording import Finding

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
_STATISTICS = 0x0B
_ENCODINGS: dict[str, Encoding] = {"ros1": "ros1", "cdr": "cdr"}
_COMPRESSIONS = {"": "none", "lz4": "lz4", "zstd": "zstd"}
_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])
_CHECKED_BYTES = 2**29  # of chunks that are not packed; checking all of a long recording would take minutes
_MAX_SMALL_RECORD = 2**24  # schemas, channels and indices; messages and chunks are not read whole


class _ChannelRecord(NamedTuple):
    schema_id: int
    topic: str
    encoding: str


@dataclass
class _McapScan(ChunkScan):
    """What the pass has gathered so far; messages outside chunks belong to one chunk that is the file."""

    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, _ChannelRecord] = field(default_factory=dict)
    loose: dict[int, list[tuple[int, ...]]] = field(default_factory=dict)
    stated_messages: int | None = None


def index_mcap(path: Path) -> BagIndex:
    """Index an MCAP file; damage is reported in `findings`. InputError if it is no MCAP file."""
    require_regular_file(path)
    file = os.open(path, os.O_RDONLY)
    try:
        if os.pread(file, len(MAGIC), 0) != MAGIC:
            raise InputError(f"{path.name} is not an MCAP file.")
        file_bytes = os.fstat(file).st_size
        scan = _McapScan()
        _scan_records(file, file_bytes, scan)
        scan.refuse_excess()
        _check_plain_chunks(file, scan)
        scan.walk_unindexed(file, scan.channels, lambda content: _walk_chunk(content, scan), _ENTRY)
    finally:
        os.close(file)
    scan.chunks.append(Chunk(0, file_bytes, file_bytes, "none"))
    for channel, loose in scan.loose.items():
        entry = (len(scan.chunks) - 1, np.array(loose, _ENTRY))
        scan.entries.setdefault(channel, []).append(entry)
    found = sum(len(entries) for parts in scan.entries.values() for _, entries in parts)
    if scan.stated_messages not in (None, found):
        scan.problems.append(f"The file counts {scan.stated_messages} messages, {found} were found")
    channels, other = _channels(path, scan)
    if scan.suspect_chunks:
        scan.problems.append(f"The index of {len(scan.suspect_chunks)} chunks is damaged")
    findings = [Finding("error", "", f"{problem}; what could be read is kept.") for problem in scan.problems]
    return BagIndex("mcap", joined(channels), (*findings, *other))


def _scan_records(file: int, file_bytes: int, scan: _McapScan) -> None:
    position, operation = len(MAGIC), 0
    while position < file_bytes and operation != _FOOTER:
        try:
            start = os.pread(file, 64, position)
            operation, content_bytes = _record_head(start)
            content = position + 9
            if content + content_bytes > file_bytes:
                if operation == _CHUNK:
                    _add_chunk(start[9:], content, file_bytes - content, scan)
                raise InputError("a record runs past the end of the file")
            if operation == _CHUNK:
                _add_chunk(start[9:], content, content_bytes, scan)
            elif operation == _MESSAGE:
                _add_loose(start[9:], position, scan.loose)
            elif operation == _STATISTICS and len(start) >= 17:
                (scan.stated_messages,) = struct.unpack_from("<Q", start, 9)
            elif operation in (_SCHEMA, _CHANNEL, _MESSAGE_INDEX):
                if content_bytes > _MAX_SMALL_RECORD:
                    raise InputError(f"a record claims {content_bytes} bytes")
                _add_small(operation, os.pread(file, content_bytes, content), scan)
            if operation == _FOOTER:
                _check_summary(file, position, start, content_bytes, scan)
        except InputError as error:
            scan.problems.append(f"The file is cut off or damaged at byte {position} ({error.cause})")
            return
        position = content + content_bytes
    if operation != _FOOTER:
        scan.problems.append("The file has no footer: it was not closed")


def _check_summary(file: int, footer: int, start: bytes, content_bytes: int, scan: _McapScan) -> None:
    """Compare the summary with its checksum; what a damaged one says of channels is forgotten."""
    if content_bytes < 20 or len(start) < 29:
        raise InputError("the footer is cut off")
    summary, _, crc = struct.unpack_from("<QQI", start, 9)
    if not crc or not summary or not 0 <= footer - summary <= _MAX_SMALL_RECORD:
        return
    if zlib.crc32(os.pread(file, footer - summary + 25, summary)) != crc:
        scan.problems.append("The summary does not match its checksum")
        scan.channels.clear()
        scan.schemas.clear()


def _check_plain_chunks(file: int, scan: _McapScan) -> None:
    """Compare chunks that are not packed with their checksums, up to a total of bytes; packed ones are
    compared when they are unpacked."""
    budget = _CHECKED_BYTES
    for row, chunk in enumerate(scan.chunks):
        if chunk.compression != "none" or not chunk.crc:
            continue
        budget -= chunk.stored_bytes
        if budget < 0:
            return
        if zlib.crc32(os.pread(file, chunk.stored_bytes, chunk.position)) != chunk.crc:
            scan.suspect_chunks.add(row)
            scan.problems.append(f"Chunk {row} does not match its checksum: some of its messages are damaged")


def _record_head(start: bytes) -> tuple[int, int]:
    if len(start) < 9:
        raise InputError("a record is cut off")
    operation, content_bytes = struct.unpack_from("<BQ", start)
    if operation == 0:
        raise InputError("a record has no type")
    return operation, content_bytes


def _add_chunk(start: bytes, content: int, stored_bytes: int, scan: _McapScan) -> None:
    # start time, end time, unpacked size, crc, compression (string), packed size, records
    if len(start) < 32:
        raise InputError("a chunk is cut off")
    unpacked, crc, name_bytes = struct.unpack_from("<QII", start, 16)
    if name_bytes > 8 or 40 + name_bytes > len(start):
        raise InputError("a chunk header is damaged")
    name = start[32 : 32 + name_bytes].decode("ascii", "replace")
    head = 40 + name_bytes
    compression = _COMPRESSIONS.get(name, name)
    if compression == "none":
        unpacked = min(unpacked, stored_bytes - head)
    scan.chunks.append(Chunk(content + head, stored_bytes - head, unpacked, compression, crc))


def _add_loose(start: bytes, position: int, loose: dict[int, list[tuple[int, ...]]]) -> None:
    if len(start) < 22:
        raise InputError("a message is cut off")
    channel, _, log_time = struct.unpack_from("<HIQ", start)
    loose.setdefault(channel, []).append((log_time, position))


def _add_small(operation: int, content: bytes, scan: _McapScan) -> None:
    try:
        (number,) = struct.unpack_from("<H", content)
        if operation == _SCHEMA:
            scan.schemas[number] = _string(content, 2)[0]
        elif operation == _CHANNEL:
            (schema_id,) = struct.unpack_from("<H", content, 2)
            topic, end = _string(content, 4)
            scan.channels[number] = _ChannelRecord(schema_id, topic, _string(content, end)[0])
        else:
            (index_bytes,) = struct.unpack_from("<I", content, 2)
            if not scan.chunks:
                raise InputError("a message index stands before any chunk")
            entries, row = np.empty(0, _ENTRY), len(scan.chunks) - 1
            if 6 + index_bytes == len(content) and index_bytes % _ENTRY.itemsize == 0:
                entries = np.frombuffer(content, _ENTRY, offset=6)
            known = any(other == row for other, _ in scan.entries.get(number, [])[-1:])
            if (
                known
                or (entries["offset"] >= scan.chunks[row].content_bytes).any()
                or 6 + index_bytes != len(content)
            ):
                scan.suspect_chunks.add(row)
            scan.entries.setdefault(number, []).append((row, entries))
            scan.indexed_chunks.add(row)
    except struct.error as error:
        raise InputError("a record is cut off") from error


def _string(content: bytes, at: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", content, at)
    if at + 4 + size > len(content):
        raise InputError("a text runs past the end of its record")
    return content[at + 4 : at + 4 + size].decode("utf-8", "replace"), at + 4 + size


def _walk_chunk(content: bytes, scan: _McapScan) -> dict[int, list[tuple[int, ...]]]:
    """Entries of its messages, by their owner; what describes the owners is added to the scan."""
    found: dict[int, list[tuple[int, ...]]] = {}
    at = 0
    while at < len(content):
        try:
            operation, record_bytes = _record_head(content[at : at + 9])
            end = at + 9 + record_bytes
            if end > len(content) or record_bytes > MAX_MESSAGE_BYTES:
                break  # the message that was being written when the file was cut
            if operation in (_SCHEMA, _CHANNEL):
                _add_small(operation, content[at + 9 : end], scan)
            elif operation == _MESSAGE:
                _add_loose(content[at + 9 : at + 31], at, found)
        except InputError:
            break
        at = end
    return found


def _channels(path: Path, scan: _McapScan) -> tuple[list[Channel], list[Finding]]:
    """One channel per topic, type and encoding, in the order of recording; and those of other encodings."""
    other: list[Finding] = []
    groups: dict[tuple[str, str, Encoding], list[int]] = {}
    for number, (schema_id, topic, encoding_name) in scan.channels.items():
        encoding = _ENCODINGS.get(encoding_name)
        if encoding is None:
            words = f"messages are encoded as {printable(encoding_name)!r}, not as ROS messages; left out."
            other.append(Finding("note", printable(topic), f"{printable(topic)}: {words}"))
            continue
        message_type = standard_type_name(scan.schemas.get(schema_id, ""))
        if schema_id not in scan.schemas:
            words = f"{printable(topic)}: what type its messages are is missing from the file; left out."
            other.append(Finding("error", printable(topic), words))
        groups.setdefault((topic, message_type, encoding), []).append(number)
    channels = []
    for (topic, message_type, encoding), numbers in groups.items():
        found = [(owner, row, e) for owner in numbers for row, e in scan.entries.get(owner, [])]
        entries = np.concatenate([np.empty(0, _ENTRY), *(part for _, _, part in found)])
        # a damaged offset points nowhere
        parts = [(owner, row, np.minimum(e["offset"], 2**62).astype(np.int64)) for owner, row, e in found]
        times_ns = np.minimum(entries["time"], 2**62).astype(np.int64)
        stamps, payloads = payloads_in_order(path, "mcap", scan.chunks, parts, times_ns)
        channels.append(Channel(topic, message_type, encoding, stamps, payloads))
    return channels, other
