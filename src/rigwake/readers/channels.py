"""Channels: the messages of one topic in any bag format, indexed once and read by row.

A bag reader returns `BagIndex`; nothing above it knows the container. Payloads can be pickled (they reopen
their file), so that cameras are worked on in parallel.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from rigwake._types import Stamps
from rigwake.errors import InputError
from rigwake.readers.clock_steps import set_back_rows
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
    """Messages of several connections or files in one order: row i is row `part_rows[i]` of `parts[part_of[i]]`."""

    parts: tuple[Payloads, ...]
    part_of: Stamps
    part_rows: Stamps

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """See `Payloads.read`; runs of rows of one part are read together."""
        wanted = np.fromiter(rows, dtype=np.int64)
        part_of = self.part_of[wanted]
        for run in np.split(np.arange(len(wanted)), np.flatnonzero(np.diff(part_of)) + 1):
            if len(run):
                part = self.parts[int(part_of[run[0]])]
                yield from part.read(self.part_rows[wanted[run]], limit_bytes)


@dataclass(frozen=True, eq=False)
class HeldPayloads:
    """Messages, or their beginnings, held in memory."""

    messages: Sequence[bytes]

    def read(self, rows: Iterable[int], limit_bytes: int = MAX_MESSAGE_BYTES) -> Iterator[bytes]:
        """See `Payloads.read`."""
        return (self.messages[row][:limit_bytes] for row in rows)


def joined(channels: Sequence[Channel], *, of_files: bool = False) -> tuple[Channel, ...]:
    """One channel per (topic, type), in the order of recording.

    Connections of several publishers and files of a split bag (of_files, in their order) are merged by the time of
    recording; messages of one publisher, and those files, stay in their order where the clock was set back.
    """
    groups: dict[tuple[str, str], list[Channel]] = {}
    for channel in channels:
        groups.setdefault((channel.topic, channel.message_type), []).append(channel)
    return tuple(_join(group, of_files) for group in groups.values())


def _join(group: Sequence[Channel], of_files: bool) -> Channel:
    times = np.concatenate([c.log_times_ns for c in group])
    if (len(group) == 1 or of_files) and len(set_back_rows(times)):
        order = np.arange(len(times))
    else:
        order = np.argsort(times, kind="stable")
    if len(group) == 1 and (np.diff(order) == 1).all():
        return group[0]
    part_of = np.repeat(np.arange(len(group)), [len(c) for c in group])
    part_rows = np.concatenate([np.arange(len(c)) for c in group])
    return replace(
        max(group, key=len),
        log_times_ns=times[order],
        payloads=JoinedPayloads(tuple(c.payloads for c in group), part_of[order], part_rows[order]),
    )


def require_regular_file(path: Path) -> None:
    """InputError for a pipe, a socket or a device: reading it would block for ever, or never end."""
    if not path.is_file():
        raise InputError(f"{path.name} is not a file.", remedy="Give a file or a folder.")


def standard_type_name(message_type: str) -> str:
    """`sensor_msgs/msg/Imu`, which ROS 1 writes without the middle part."""
    return message_type.replace("/", "/msg/") if message_type.count("/") == 1 else message_type
