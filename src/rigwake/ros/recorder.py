"""Messages into a bag, byte for byte, from a thread of its own with bounded memory."""

from __future__ import annotations

import contextlib
import queue
import shutil
import threading
from collections import Counter, deque
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from rigwake.errors import HostError, InputError
from rigwake.readers.channels import Encoding
from rigwake.readers.rig_description import (
    MAX_TEXT_BYTES,
    RIG_TOPIC,
    RigDescription,
    description_of_text,
)
from rigwake.readers.ros_decoding import decode, typestore
from rigwake.ros.transport import CAMERA_INFO, STRING, TRANSFORMS, ReceivedMessage

_MOST_BYTES = 256 << 20  # that wait to be written
_LEAST_FREE = 1 << 30  # on the disk
_LOOK_EVERY = 200  # messages between two looks at the disk
_KEPT_STATIC = 64  # distinct messages on /tf_static


class BagRecorder:
    """One bag. `add` never waits; what the disk cannot take in time is dropped and counted.

    The bag has the suffix `.active` until `close`. opening: messages that every bag begins with (static transforms,
    lenses), stamped with the time of the first other message.
    """

    def __init__(
        self, path: Path, encoding: Encoding, opening: list[ReceivedMessage], least_free: int = _LEAST_FREE
    ) -> None:
        self.path, self.dropped, self.written = path, Counter[str](), 0
        self.fault = ""
        self._encoding, self._opening, self._least_free = encoding, opening, least_free
        self._active = path.with_name(path.name + ".active")
        self._queue: queue.SimpleQueue[ReceivedMessage | None] = queue.SimpleQueue()
        self._waiting, self._lock = 0, threading.Lock()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._check_disk()
        self._writer: Any = _writer(self._active, encoding)
        self._writer.open()
        self._connections: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._write_all, daemon=True, name="recorder")
        self._thread.start()

    def add(self, message: ReceivedMessage) -> None:
        """Put a message in line."""
        with self._lock:
            if self.fault or self._waiting + len(message.payload) > _MOST_BYTES:
                self.dropped[message.topic] += 1
                return
            self._waiting += len(message.payload)
        self._queue.put(message)

    def close(self) -> Path:
        """Write what waits and finish the bag; its path. Raises HostError if it could not be written."""
        self._queue.put(None)
        self._thread.join()
        with contextlib.suppress(OSError):
            self._writer.close()
            self._active.replace(self.path)
            if not self.fault:
                return self.path
        raise HostError(
            f"{self.path} is not whole: {self.fault or 'the disk took no more'}.",
            consequence=f"What was written before is in {self.path if self.path.exists() else self._active}.",
            remedy="Free some space, or record to another disk with --out.",
        )

    def _write_all(self) -> None:
        while (message := self._queue.get()) is not None:
            with self._lock:
                self._waiting -= len(message.payload)
            if self.fault:
                continue
            try:
                if not self._connections:
                    for one in self._opening:
                        self._write(one._replace(received_ns=message.received_ns))
                self._write(message)
                if self.written % _LOOK_EVERY == 0:
                    self._check_disk()
            except (OSError, HostError) as error:
                self.fault = str(error)

    def _write(self, message: ReceivedMessage) -> None:
        if message.topic not in self._connections:
            latched = {"latching": 1} if self._encoding == "ros1" and is_sent_once(message.topic) else {}
            self._connections[message.topic] = self._writer.add_connection(
                message.topic, message.message_type, typestore=typestore(self._encoding), **latched
            )
        self._writer.write(self._connections[message.topic], message.received_ns, message.payload)
        self.written += 1
        if self._encoding == "ros1":
            _forget_written(self._writer)

    def _check_disk(self) -> None:
        free = shutil.disk_usage(self.path.parent).free
        if free < self._least_free:
            raise HostError(
                f"Only {free / 2**20:.0f} MiB are free at {self.path.parent}.",
                consequence="Nothing more is recorded.",
                remedy="Free some space, or record to another disk with --out.",
            )


def _writer(path: Path, encoding: Encoding) -> Any:
    if encoding == "ros1":
        return Rosbag1Writer(path)
    return Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)


def _forget_written(writer: Any) -> None:
    """The writer keeps every message's place until the end, but of chunks on the disk it needs only their numbers."""
    if len(writer.chunks) > 1 and isinstance(next(iter(writer.chunks[-2].connections.values()), None), list):
        chunk = writer.chunks[-2]
        chunk.connections = {number: range(len(places)) for number, places in chunk.connections.items()}


def is_sent_once(topic: str) -> bool:
    """Whether silence on this topic is as it should be: it is latched."""
    return topic.endswith("/tf_static") or topic == RIG_TOPIC


class OpeningMessages:
    """Keeps what is sent once but belongs into every bag: static transforms, lenses, what a rig says of itself."""

    def __init__(self) -> None:
        self._static: deque[ReceivedMessage] = deque(maxlen=_KEPT_STATIC)
        self._infos: dict[str, ReceivedMessage] = {}

    def note(self, message: ReceivedMessage) -> None:
        """Keep it if it is of that kind."""
        if message.message_type == CAMERA_INFO or message.topic == RIG_TOPIC:
            self._infos[message.topic] = message
            return
        is_static = message.message_type == TRANSFORMS and message.topic.endswith("/tf_static")
        if is_static and all(message.payload != known.payload for known in self._static):
            self._static.append(message)

    def description(self) -> RigDescription:
        """What the rig says of itself, if it does."""
        message = self._infos.get(RIG_TOPIC)
        try:
            if message is not None and len(message.payload) <= MAX_TEXT_BYTES:
                return description_of_text(decode(message.payload, STRING, message.encoding).data)
        except InputError:
            return RigDescription()  # a calibration of the bag says what is wrong with it
        return RigDescription()

    def messages(self) -> list[ReceivedMessage]:
        """All that are kept."""
        return [*self._static, *self._infos.values()]
