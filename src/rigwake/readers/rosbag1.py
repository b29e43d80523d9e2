"""Index of a ROS 1 bag (format 2.0), read in one pass over its record headers.

The pass does not need the index at the end of the file, so a bag that was never closed, or was cut off,
yields what it still holds. Format: http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigwake.errors import InputError
from rigwake.readers.channels import BagIndex, Channel, joined, require_regular_file, standard_type_name
from rigwake.readers.chunks import Chunk, ChunkScan, payloads_in_order
from rigwake.readers.ros_decoding import is_standard_type, type_of_digest
from rigwake.recording import Finding

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _INDEX, _CHUNK, _CONNECTION = 2, 4, 5, 7
_MAX_HEADER_BYTES = 2**20  # message definitions are the largest headers, some ten kilobytes
_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])


class Record(NamedTuple):
    """Fields of a record's header, and where its data lies."""

    fields: dict[str, bytes]
    data_position: int
    data_bytes: int

    @property
    def operation(self) -> int:
        """What kind of record this is; InputError if it does not say."""
        return self.number("op", "<B")

    def number(self, name: str, layout: str) -> int:
        """An integer field; InputError if it is missing or of another size."""
        try:
            return int(struct.unpack(layout, self.fields[name])[0])
        except (KeyError, struct.error) as error:
            raise InputError(f"a record lacks its field {name!r}") from error


@dataclass
class _BagScan(ChunkScan):
    """What the pass has gathered so far."""

    connections: dict[int, tuple[str, str, str]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def index_rosbag1(path: Path) -> BagIndex:
    """Index a ROS 1 bag; damage is reported in `findings`. InputError if it is no such bag or encrypted."""
    require_regular_file(path)
    file = os.open(path, os.O_RDONLY)
    try:
        if os.pread(file, len(MAGIC), 0) != MAGIC:
            raise InputError(f"{path.name} is not a ROS 1 bag of format 2.0.")
        scan = _BagScan()
        _scan_records(file, os.fstat(file).st_size, scan)
        scan.refuse_excess()
        scan.walk_unindexed(file, scan.connections, lambda content: _walk_chunk(content, scan), _ENTRY)
        if scan.suspect_chunks:
            scan.problems.append(f"The index of {len(scan.suspect_chunks)} chunks is damaged")
    finally:
        os.close(file)
    findings = tuple(
        Finding("error", "", f"{problem}; what could be read is kept.") for problem in scan.problems
    )
    remarks = tuple(Finding("note", "", f"{remark}.") for remark in scan.remarks)
    return BagIndex("ros1 bag", joined(_channels(path, scan)), (*findings, *remarks))


def _scan_records(file: int, file_bytes: int, scan: _BagScan) -> None:
    position = len(MAGIC)
    while position < file_bytes:
        try:
            record = parse_record(os.pread(file, 4096, position), position, file)
            operation = record.operation
            if record.data_position + record.data_bytes > file_bytes:
                if operation == _CHUNK:
                    _add_chunk(record, file_bytes - record.data_position, scan)
                raise InputError("a record runs past the end of the file")
            if operation == _CHUNK:
                _add_chunk(record, record.data_bytes, scan)
            elif operation == _INDEX:
                _add_index(file, record, scan)
            elif operation == _CONNECTION:
                _add_connection(os.pread(file, record.data_bytes, record.data_position), record, scan)
        except InputError as error:
            scan.problems.append(f"The bag is cut off or damaged at byte {position} ({error.cause})")
            return
        position = record.data_position + record.data_bytes


def parse_record(start: bytes, position: int, file: int | None = None) -> Record:
    """The record whose first bytes are `start`, at `position` of the file (or of a chunk).

    A header longer than `start` is read from `file`. Raises InputError if it is cut off or not a record.
    """
    if len(start) < 8:
        raise InputError("a record is cut off")
    (header_bytes,) = struct.unpack_from("<I", start, 0)
    if header_bytes > _MAX_HEADER_BYTES:
        raise InputError(f"a record header claims {header_bytes} bytes")
    if 8 + header_bytes > len(start) and file is not None:
        start = os.pread(file, 8 + header_bytes, position)
    if 8 + header_bytes > len(start):
        raise InputError("a record header is cut off")
    (data_bytes,) = struct.unpack_from("<I", start, 4 + header_bytes)
    fields = parse_fields(start[4 : 4 + header_bytes])
    return Record(fields, position + 8 + header_bytes, data_bytes)


def parse_fields(header: bytes) -> dict[str, bytes]:
    """The `name=value` fields of a header; InputError if they do not fill it."""
    fields, at = {}, 0
    while at + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, at)
        name, separator, value = header[at + 4 : at + 4 + size].partition(b"=")
        at += 4 + size
        if not separator or at > len(header):
            raise InputError("a record header is damaged")
        fields[name.decode("ascii", "replace")] = value
    return fields


def _add_chunk(record: Record, stored_bytes: int, scan: _BagScan) -> None:
    compression = record.fields.get("compression", b"").decode("ascii", "replace")
    content_bytes = record.number("size", "<I")
    if compression == "none":
        content_bytes = min(content_bytes, stored_bytes)
    scan.chunks.append(Chunk(record.data_position, stored_bytes, content_bytes, compression))


def _add_index(file: int, record: Record, scan: _BagScan) -> None:
    if not scan.chunks:
        raise InputError("an index stands before any chunk")
    chunk_row = len(scan.chunks) - 1
    try:
        connection, count = record.number("conn", "<I"), record.number("count", "<I")
    except InputError:
        connection, count = -1, -1
    entries = np.empty(0, _ENTRY)
    if count * _ENTRY.itemsize == record.data_bytes:
        entries = np.frombuffer(os.pread(file, record.data_bytes, record.data_position), _ENTRY)
    known = any(row == chunk_row for row, _ in scan.entries.get(connection, [])[-1:])
    past_end = (entries["offset"] >= scan.chunks[chunk_row].content_bytes).any()
    if known or past_end or not len(entries):
        scan.suspect_chunks.add(chunk_row)
    scan.entries.setdefault(connection, []).append((chunk_row, entries))
    scan.indexed_chunks.add(chunk_row)


def _add_connection(details: bytes, record: Record, scan: _BagScan) -> None:
    """A connection's topic, type and digest. They stand twice in a bag: where those differ one is damaged."""
    fields = parse_fields(details)
    texts = [
        raw.decode("utf-8", "replace")
        for raw in (record.fields.get("topic", b""), fields.get("type", b""), fields.get("md5sum", b""))
    ]
    inner = fields.get("topic", record.fields.get("topic", b"")).decode("utf-8", "replace")
    if inner != texts[0] and record.number("conn", "<I") not in scan.connections:
        # the name after remapping may differ from the one that was advertised: worth a word, not an error
        scan.remarks.append(f"A connection of {texts[0]} calls itself {inner}")
    by_digest = type_of_digest(texts[2])
    if by_digest is not None and not is_standard_type(texts[1]):
        scan.problems.append(
            f"{texts[0]}: the type {texts[1]} is not known, but has the checksum of {by_digest}"
        )
        texts[1] = by_digest
    number, described = record.number("conn", "<I"), (texts[0], texts[1], texts[2])
    former = scan.connections.setdefault(number, described)
    if former != described:
        problem = (
            f"A connection is described as {former[0]} ({former[1]}) and as {described[0]} ({described[1]})"
        )
        scan.problems.append(problem)
        if is_standard_type(described[1], described[2]) and not is_standard_type(former[1], former[2]):
            scan.connections[number] = described


def _walk_chunk(content: bytes, scan: _BagScan) -> dict[int, list[tuple[int, ...]]]:
    """Entries of its messages, by their owner; what describes the owners is added to the scan."""
    found: dict[int, list[tuple[int, ...]]] = {}
    at = 0
    while at < len(content):
        try:
            record = parse_record(content[at : at + 4096], at)
            end = record.data_position + record.data_bytes
            if end > len(content):
                break  # the message that was being written when the file was cut
            if record.operation == _CONNECTION:
                _add_connection(content[record.data_position : end], record, scan)
            elif record.operation == _MESSAGE:
                stamp = record.number("time", "<Q")
                entry = (stamp & 0xFFFFFFFF, stamp >> 32, at)
                found.setdefault(record.number("conn", "<I"), []).append(entry)
        except InputError:
            break
        at = end
    return found


def _channels(path: Path, scan: _BagScan) -> list[Channel]:
    """One channel per topic and type, whatever the number of publishers, in the order of recording."""
    groups: dict[tuple[str, str, str], list[int]] = {}
    for connection, described in scan.connections.items():
        groups.setdefault(described, []).append(connection)
    channels = []
    for (topic, message_type, digest), connections in groups.items():
        found = [(owner, row, e) for owner in connections for row, e in scan.entries.get(owner, [])]
        entries = np.concatenate([np.empty(0, _ENTRY), *(part for _, _, part in found)])
        parts = [(owner, row, part["offset"].astype(np.int64)) for owner, row, part in found]
        times_ns = entries["sec"].astype(np.int64) * 10**9 + entries["nsec"]
        stamps, payloads = payloads_in_order(path, "ros1", scan.chunks, parts, times_ns)
        channels.append(Channel(topic, standard_type_name(message_type), "ros1", stamps, payloads, digest))
    return channels
