"""Decoding of ROS messages from untrusted bytes.

Only the standard definitions are used: those that a bag carries are never compiled, so a bag cannot bring
code, and a topic whose definition differs from the standard is refused by its digest.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.readers.channels import MAX_MESSAGE_BYTES, Channel, Encoding, standard_type_name
from rigwake.readers.printable import printable
from rigwake.recording import Finding

HEADER_BYTES = 256
"""Enough of a message to read its stamp and frame."""

MAX_SENSOR_BYTES = 2**14
"""A message of a sensor other than a camera that is larger is damage."""


@cache
def typestore(encoding: Encoding) -> Typestore:
    """The standard message definitions for this encoding."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        if name not in store.fielddefs:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", name))
    return store


def has_standard_type(channel: Channel) -> bool:
    """Whether the type is a standard one and, where the bag tells, defined as in the standard."""
    return is_standard_type(channel.message_type, channel.type_digest, channel.encoding)


def is_standard_type(message_type: str, digest: str = "", encoding: Encoding = "ros1") -> bool:
    """The same of a type's name, and the md5 of its definition where that is known."""
    store, name = typestore(encoding), standard_type_name(message_type)
    if name not in store.fielddefs:
        return False
    if encoding != "ros1" or digest in ("", "*"):
        return True
    return store.generate_msgdef(name)[1] == digest


@cache
def _types_by_digest() -> dict[str, str]:
    store = typestore("ros1")
    packages = ("sensor_msgs/", "tf2_msgs/", "nav_msgs/", "geometry_msgs/")
    names = [name for name in store.fielddefs if name.startswith(packages)]
    digests = [store.generate_msgdef(name)[1] for name in names]
    counts = Counter(digests)
    return {digest: name for name, digest in zip(names, digests, strict=True) if counts[digest] == 1}


def type_of_digest(digest: str) -> str | None:
    """The standard message of this md5 sum of its definition, if it is the only one (ROS 1)."""
    return _types_by_digest().get(digest)


def decode(payload: bytes, message_type: str, encoding: Encoding) -> Any:
    """The message; InputError if the bytes are not one of this type."""
    store = typestore(encoding)
    try:
        if encoding == "ros1":
            return store.deserialize_ros1(payload, message_type)
        return store.deserialize_cdr(payload, message_type)
    except (SerdeError, ValueError, IndexError, struct.error, AssertionError, TypeError) as error:
        raise InputError(f"A {message_type} is damaged ({error}).") from error


def decode_all(channel: Channel, limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[tuple[int, Any]]:
    """Row and message of every message of the channel that can be decoded; one that is longer cannot."""
    for row, payload in enumerate(channel.payloads.read(range(len(channel)), limit_bytes)):
        try:
            yield row, decode(payload, channel.message_type, channel.encoding)
        except InputError:
            continue  # the caller sees by the count how many are missing


class Header(NamedTuple):
    """A std_msgs/Header, and where in the message it ends."""

    stamp_ns: int
    frame_id: str
    end: int


def read_header(payload: bytes, encoding: Encoding) -> Header | None:
    """The header that a stamped message begins with; None if it is damaged."""
    start = (
        4  # ROS 1: the sequence number; CDR: the encapsulation, of which bit 0 of byte 1 is the endianness
    )
    order = ">" if encoding == "cdr" and len(payload) > 1 and payload[1] & 1 == 0 else "<"
    try:
        seconds, nanoseconds, frame_bytes = struct.unpack_from(f"{order}III", payload, start)
        end = start + 12 + frame_bytes
        frame = payload[start + 12 : end]
    except struct.error:
        return None
    if end > len(payload) or nanoseconds >= 10**9:
        return None
    name = printable(frame.rstrip(b"\0").decode("utf-8", "replace"))
    return Header(seconds * 10**9 + nanoseconds, name.lstrip("/"), end)  # tf2 knows no leading slash


class StampedRows(NamedTuple):
    """Rows of a channel with a readable header: stamps (header, or bag time as fallback) and frame."""

    rows: Stamps
    timestamps_ns: Stamps
    frame_id: str
    findings: tuple[Finding, ...]


def stamped_rows(sensor: str, channel: Channel, payloads: Iterable[bytes] | None = None) -> StampedRows:
    """Stamps of all messages of a channel from their first bytes.

    Where no header holds a time (all zero) the time of recording is used instead, and said so.
    """
    if payloads is None:
        payloads = channel.payloads.read(range(len(channel)), HEADER_BYTES)
    headers = [read_header(payload, channel.encoding) for payload in payloads]
    good = [row for row, header in enumerate(headers) if header is not None]
    stamps = np.array([header.stamp_ns for header in headers if header is not None], dtype=np.int64)
    rows = np.array(good, dtype=np.int64)
    findings = []
    if len(good) < len(headers):
        message = f"{len(headers) - len(good)} of {len(headers)} messages are damaged; they were dropped."
        findings.append(Finding("warning", sensor, message))
    if len(stamps) and (stamps == 0).all():
        stamps = channel.log_times_ns[rows]
        findings.append(
            Finding("warning", sensor, "headers hold no time; the time of recording is used instead.")
        )
    elif (unstamped := int((stamps == 0).sum())) > 0:
        rows, stamps = rows[stamps > 0], stamps[stamps > 0]
        findings.append(
            Finding("warning", sensor, f"{unstamped} messages have a zero stamp; they were dropped.")
        )
    frame = next((header.frame_id for header in headers if header is not None), "")
    return StampedRows(rows, stamps, frame, tuple(findings))


def whole_payloads(channel: Channel) -> list[bytes]:
    """All messages of a sensor; one of `MAX_SENSOR_BYTES` or more is damage, and empty."""
    payloads = channel.payloads.read(range(len(channel)), MAX_SENSOR_BYTES)
    return [payload if len(payload) < MAX_SENSOR_BYTES else b"" for payload in payloads]


def trailing_doubles(payloads: Sequence[bytes], count: int, encoding: Encoding) -> Array:
    """(N, count) the last `count` float64 of each message, NaN where it is too short.

    Messages that end in fixed-size numbers (Imu, Odometry) are read this way without decoding each field.
    """
    size = 8 * count
    swapped = encoding == "cdr" and bool(payloads) and len(payloads[0]) > 1 and payloads[0][1] & 1 == 0
    gap = np.full(count, np.nan, dtype=">f8" if swapped else "<f8").tobytes()
    tails = b"".join(payload[-size:] if len(payload) >= size else gap for payload in payloads)
    return np.frombuffer(tails, dtype=">f8" if swapped else "<f8").reshape(-1, count).astype(np.float64)
