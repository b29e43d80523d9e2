"""The node: records, calibrates, publishes the cameras' frames, watches topics and cameras. It knows no ROS itself."""

from __future__ import annotations

import contextlib
import json
import shutil
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rigwake.calibration import load_calibration
from rigwake.errors import HostError, RigwakeError
from rigwake.readers.ros_frames import IMAGE_TYPES
from rigwake.readers.ros_recording import is_read, names_in_role
from rigwake.readers.topics import camera_base
from rigwake.ros.child_command import ChildCommand
from rigwake.ros.node_outputs import camera_states, static_edges
from rigwake.ros.recorder import BagRecorder, OpeningMessages, is_sent_once
from rigwake.ros.topic_watch import TopicWatch
from rigwake.ros.transport import (
    COMPRESSED_IMAGE,
    IMAGE,
    STRING,
    TRANSFORMS,
    Answer,
    NodeStatus,
    ReceivedMessage,
    StatusLevel,
    Transport,
)

if TYPE_CHECKING:
    from rigwake.ros.surround_stream import SurroundStream

SURROUND = "surround"
_JUMP_NS = 1_000_000_000  # the clock ran back: a new bag begins
_DISCOVER_EVERY_S = 2.0
_STATUS_EVERY_S = 1.0


@dataclass(frozen=True)
class NodeOptions:
    """out: folder for bags and results. calibration: known at the start. topics: only these (all sensors by default).
    child_frame: name of a camera's frame. monitor_s: length of the pieces that the monitor judges (0: no monitor).
    surround_hz: surround pictures per second at most, while somebody looks (0: never).
    program: the command that calibrates and monitors, `rigwake` of this interpreter by default. calibrate_words:
    further options of `rigwake calibrate`."""

    out: Path
    calibration: Path | None = None
    topics: tuple[str, ...] = ()
    child_frame: str = "{name}_optical_frame"
    monitor_s: float = 0.0
    surround_hz: float = 5.0
    least_free: int = 1 << 30
    program: tuple[str, ...] = ()
    calibrate_words: tuple[str, ...] = ()


class RigwakeNode:
    """Serves `~record`, `~calibrate`; call `step` regularly, `close` at the end."""

    def __init__(self, transport: Transport, options: NodeOptions) -> None:
        self._transport, self._options = transport, options
        self._lock = threading.RLock()
        self._watches: dict[str, TopicWatch] = {}
        self._image_topics: list[str] = []
        self._opening = OpeningMessages()
        self._recorder: BagRecorder | None = None
        self._piece: BagRecorder | None = None  # what the monitor judges next
        self._piece_begun_s = 0.0
        self._bag: Path | None = None  # recorded last
        self._calibrating: ChildCommand | None = None
        self._monitoring: ChildCommand | None = None
        self._calibration: Path | None = None
        self._suffix = ".bag" if transport.encoding == "ros1" else ""
        self._last_ns = 0
        self._said = NodeStatus("calibration", StatusLevel.OK, "none yet")
        self._cameras: list[NodeStatus] = []
        self._recording_fault = ""
        self._jumps = 0
        self._discovered_s = self._told_s = float("-inf")
        self._surround: SurroundStream | None = None  # begins with the first who looks
        if options.calibration is not None:
            self._take(options.calibration)
        transport.serve_switch("record", self.record)
        transport.serve("calibrate", self.calibrate)

    # what comes in

    def step(self) -> None:
        """Look for new topics and publish the status, when it is time."""
        now = time.monotonic()
        if now - self._discovered_s >= _DISCOVER_EVERY_S:
            self._discovered_s = now
            self._discover()
        if now - self._told_s >= _STATUS_EVERY_S:
            self._told_s = now
            self._transport.publish_status(self.statuses(now))
            self._advance_monitor(now)
            self._look_for_viewers()

    def _discover(self) -> None:
        known = self._transport.topics()
        own = f"{self._transport.own_name()}/{SURROUND}/compressed"
        for topic, message_type in chosen_topics(known, self._options.topics).items():
            if topic not in self._watches and topic != own:
                if message_type in IMAGE_TYPES:
                    self._image_topics.append(topic)
                is_stamped = message_type not in (TRANSFORMS, STRING)
                self._watches[topic] = TopicWatch(
                    topic, is_stamped=is_stamped, is_sent_once=is_sent_once(topic)
                )
                self._transport.subscribe(topic, message_type, self._received)

    def _received(self, message: ReceivedMessage) -> None:
        if message.publisher and message.publisher == self._transport.own_name():
            return
        self._watches[message.topic].received(message.payload, message.encoding, time.monotonic())
        with self._lock:
            self._opening.note(message)
            if message.received_ns < self._last_ns - _JUMP_NS:
                self._jumped()
            self._last_ns = message.received_ns
            for recorder in (self._recorder, self._piece):
                if recorder is not None:
                    recorder.add(message)
        if self._surround is not None and message.message_type in IMAGE_TYPES:
            self._surround.note(message)

    def _jumped(self) -> None:
        """The clock ran back, as when a bag is played again: two times must not stand in one bag."""
        self._jumps += 1
        if self._recorder is not None:
            self._close_bag()
            try:
                self._open_bag()
            except (RigwakeError, OSError) as error:  # said on /diagnostics; messages go on coming
                self._recording_fault = str(error)
        if self._piece is not None:
            self._drop_piece()

    # services

    def record(self, on: bool) -> Answer:
        """Begin or end a bag."""
        with self._lock:
            if on == (self._recorder is not None):
                return True, f"{'already' if on else 'not'} recording"
            try:
                if on:
                    return True, f"recording to {self._open_bag()}"
                bag = self._close_bag()
                return bag is not None, f"recorded {bag}" if bag else self._recording_fault
            except (RigwakeError, OSError) as error:
                self._recording_fault = str(error)
                return False, str(error)

    def calibrate(self) -> Answer:
        """Calibrate what was recorded last, in a process of its own. Answers when that has begun."""
        with self._lock:
            if self._calibrating is not None:
                return False, f"already calibrating ({self._calibrating.progress}); see /diagnostics"
            if self._recorder is not None:
                self._close_bag()
            if self._bag is None:
                return False, self._recording_fault or "nothing was recorded: call ~record first"
            out = self._bag.with_name(self._bag.stem + "_calibration")
            words = ["calibrate", str(self._bag), "-o", str(out), "--force", *self._options.calibrate_words]
            try:
                self._calibrating = ChildCommand(
                    words, lambda code, said: self._calibrated(out, code, said), self._options.program
                )
            except OSError as error:
                return False, f"the process that calibrates cannot be started: {error}"
            self._said = NodeStatus("calibration", StatusLevel.OK, f"calibrating {self._bag.name}")
            return True, f"calibrating {self._bag}; progress is on /diagnostics, the result goes to {out}"

    def _calibrated(self, out: Path, code: int, words: str) -> None:
        with self._lock:
            self._calibrating = None
            if code in (0, 4):
                self._take(out / "calibration.yaml")
            else:
                self._said = NodeStatus(
                    "calibration", StatusLevel.ERROR, f"failed (exit code {code}): {words[-400:]}"
                )

    def _take(self, path: Path) -> None:
        """Publish a calibration's frames. A file that cannot be used is said on /diagnostics."""
        try:
            calibration = load_calibration(path)
            edges = static_edges(calibration, self._options.child_frame)
        except RigwakeError as error:
            self._said = NodeStatus("calibration", StatusLevel.ERROR, str(error))
            return
        self._calibration = path
        self._transport.publish_static(edges)
        missing = [
            name for name in calibration.cameras if self._frame(name) not in {child for _, child in edges}
        ]
        level = StatusLevel.WARN if missing else StatusLevel.OK
        words = f"{path}: {len(edges)} cameras on /tf_static"
        words += f"; partly unobservable and left out: {', '.join(missing)}" if missing else ""
        self._said = NodeStatus("calibration", level, words, {"reference": calibration.reference})

    def _frame(self, name: str) -> str:
        return self._options.child_frame.replace("{name}", name)

    # bags

    def _open_bag(self) -> Path:
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        folder, number = self._options.out, 0
        while any((path := folder / f"{stamp}_{number}{self._suffix}").parent.glob(f"{path.name}*")):
            number += 1
        self._recording_fault = ""
        self._recorder = self._recorder_at(path)
        return path

    def _recorder_at(self, path: Path) -> BagRecorder:
        return BagRecorder(
            path, self._transport.encoding, self._opening.messages(), least_free=self._options.least_free
        )

    def _close_bag(self) -> Path | None:
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return None
        try:
            path = recorder.close()
        except HostError as error:
            self._recording_fault = str(error)
            if not recorder.path.exists():
                return None
            path = recorder.path
        if recorder.written:
            self._bag = path
        return path

    # the monitor

    def _advance_monitor(self, now_s: float) -> None:
        """Record pieces, one after the other, and let a process judge each against the calibration."""
        with self._lock:
            if self._calibration is None or self._options.monitor_s <= 0:
                return
            if self._piece is None:
                if self._monitoring is None:
                    with contextlib.suppress(RigwakeError, OSError):
                        self._piece = self._recorder_at(
                            self._options.out / "monitor" / f"piece{self._suffix}"
                        )
                        self._piece_begun_s = now_s
                return
            if now_s - self._piece_begun_s < self._options.monitor_s:
                return
            piece, self._piece = self._piece, None
            try:
                bag = piece.close()
            except HostError as error:
                self._cameras = [NodeStatus("monitor", StatusLevel.ERROR, str(error))]
                return
            answer = bag.with_name("verdicts.json")
            self._monitoring = ChildCommand(
                ["monitor", str(self._calibration), str(bag), "--json", str(answer)],
                lambda code, words: self._monitored(bag, answer, code, words),
                self._options.program,
            )

    def _monitored(self, bag: Path, answer: Path, code: int, words: str) -> None:
        with self._lock:
            self._monitoring = None
            try:
                self._cameras = camera_states(json.loads(answer.read_text(encoding="utf-8")))
            except (OSError, ValueError, AttributeError, KeyError, TypeError):
                self._cameras = [
                    NodeStatus("monitor", StatusLevel.WARN, f"no verdict (exit code {code}): {words[-300:]}")
                ]
            answer.unlink(missing_ok=True)
            _remove(bag)

    def _drop_piece(self) -> None:
        piece, self._piece = self._piece, None
        if piece is not None:
            with contextlib.suppress(HostError):
                _remove(piece.close())

    # the surround view

    def _look_for_viewers(self) -> None:
        if self._options.surround_hz <= 0:
            return
        wanted = self._transport.listeners(SURROUND) > 0
        if self._surround is None:
            if not wanted:
                return
            from rigwake.ros.surround_stream import SurroundStream  # views are loaded when they are wanted

            self._surround = SurroundStream(
                self._camera_names,
                lambda *picture: self._transport.publish_jpeg(SURROUND, *picture),
                self._options.surround_hz,
            )
            self._surround.start()
        self._surround.want(wanted, self._calibration)

    def _camera_names(self) -> dict[str, str]:
        """By topic, as a bag of these topics would name them."""
        with self._lock:
            return names_in_role("camera", list(self._image_topics), self._opening.description())

    # what goes out

    def statuses(self, now_s: float) -> list[NodeStatus]:
        """Recording, calibration, every camera that the monitor judged, every topic."""
        with self._lock:
            said = self._said
            if self._calibrating is not None:
                said = NodeStatus(
                    "calibration", StatusLevel.OK, f"{said.message}: {self._calibrating.progress}"
                )
            entries = [self._recording_status(), said, *self._cameras]
            if self._surround is not None:
                entries.append(self._surround.status)
        return [*entries, *(watch.status(now_s) for watch in list(self._watches.values()))]

    def _recording_status(self) -> NodeStatus:
        recorder, jumps = self._recorder, {"clock_jumps": str(self._jumps)}
        if recorder is None:
            level = StatusLevel.ERROR if self._recording_fault else StatusLevel.OK
            return NodeStatus("recording", level, self._recording_fault or "off", jumps)
        dropped = sum(recorder.dropped.values())
        values = {"messages": str(recorder.written), "dropped": str(dropped), **jumps}
        if recorder.fault:
            return NodeStatus("recording", StatusLevel.ERROR, recorder.fault, values)
        words = f"{recorder.path.name}: {recorder.written} messages"
        if dropped:
            return NodeStatus(
                "recording", StatusLevel.WARN, f"{words}, {dropped} dropped: the disk is too slow", values
            )
        return NodeStatus("recording", StatusLevel.OK, words, values)

    def close(self) -> None:
        """Finish the bag and end the child processes."""
        for child in (self._calibrating, self._monitoring):
            if child is not None:
                child.end()
        if self._surround is not None:
            self._surround.stop()
        with self._lock:
            self._close_bag()
            self._drop_piece()
        self._transport.close()


def _remove(bag: Path) -> None:
    if bag.is_dir():
        shutil.rmtree(bag, ignore_errors=True)
    else:
        bag.unlink(missing_ok=True)


def chosen_topics(known: dict[str, str], only: Sequence[str]) -> dict[str, str]:
    """What is subscribed: all that the readers understand, so that a bag of the node gives what the topics gave; of a
    camera that is sent raw and compressed, the compressed one."""
    sensors = {topic: kind for topic, kind in known.items() if is_read(topic, kind)}
    if only:
        return {topic: kind for topic, kind in sensors.items() if topic in only}
    packed = {camera_base(topic) for topic, kind in sensors.items() if kind == COMPRESSED_IMAGE}
    return {
        topic: kind
        for topic, kind in sensors.items()
        if not (kind == IMAGE and camera_base(topic) in packed) and "/compressedDepth" not in topic
    }
