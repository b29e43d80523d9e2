"""Channels: the messages of one topic in any bag format, indexed once and read by row.

A bag reader returns `BagIndex`; nothing above it knows the container. Payloads can be pickled (they reopen
their file), so that cameras are worked on in parallel.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from rigwake._types import Stamps
from rigwake.recording import Finding

Encoding = Literal["ros1", "cdr"]

MAX_MESSAGE_BYTES = 512 * 2**20
"""A message that claims to be larger is damage: a raw colour image of 13 000 x 13 000 pixels still fits."""


class Payloads(Protocol):
    """The serialised messages of one channel."""

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """The messages of these rows, in this order, cut after `limit_bytes`; an unreadable one is empty."""


@dataclass(frozen=True, eq=False)
class Channel:
    """One topic of a bag.

    message_type: `package/msg/Name`. type_digest: md5 of the definition (ROS 1) or empty.
    log_times_ns: (N,) when each message was recorded, in the order of the rows of `payloads`.
    """

    topic: str
    message_type: str
    encoding: Encoding
    log_times_ns: Stamps
    payloads: Payloads
    type_digest: str = ""

    def __len__(self) -> int:
        return len(self.log_times_ns)


@dataclass(frozen=True, eq=False)
class BagIndex:
    """What a bag holds: its kind (`ros1 bag`, `mcap`, ...), its channels, and what was damaged."""

    kind: str
    channels: tuple[Channel, ...]
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, eq=False)
class JoinedPayloads:
    """Several connections, or several files of a split bag, one after the other."""

    parts: tuple[Payloads, ...]
    first_rows: tuple[int, ...]

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """See `Payloads.read`; runs of rows of one part are read together."""
        wanted = np.fromiter(rows, dtype=np.int64)
        part_of = np.searchsorted(self.first_rows, wanted, side="right") - 1
        for run in np.split(np.arange(len(wanted)), np.flatnonzero(np.diff(part_of)) + 1):
            if len(run):
                part = int(part_of[run[0]])
                yield from self.parts[part].read(wanted[run] - self.first_rows[part], limit_bytes)


@dataclass(frozen=True, eq=False)
class HeldPayloads:
    """Messages, or their beginnings, held in memory."""

    messages: Sequence[bytes]

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """See `Payloads.read`."""
        return (self.messages[row][:limit_bytes] for row in rows)


def joined(channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """One channel per (topic, type): connections of several publishers and files of a split bag are merged."""
    groups: dict[tuple[str, str], list[Channel]] = {}
    for channel in channels:
        groups.setdefault((channel.topic, channel.message_type), []).append(channel)
    return tuple(_join(group) for group in groups.values())


def _join(group: Sequence[Channel]) -> Channel:
    if len(group) == 1:
        return group[0]
    first_rows = np.cumsum([0, *(len(c) for c in group[:-1])])
    return replace(
        group[0],
        log_times_ns=np.concatenate([c.log_times_ns for c in group]),
        payloads=JoinedPayloads(tuple(c.payloads for c in group), tuple(int(row) for row in first_rows)),
    )


def standard_type_name(message_type: str) -> str:
    """`sensor_msgs/msg/Imu`, which ROS 1 writes without the middle part."""
    return message_type.replace("/", "/msg/") if message_type.count("/") == 1 else message_type
