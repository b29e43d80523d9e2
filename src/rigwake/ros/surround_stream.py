"""The surround view of the newest pictures, drawn only while somebody looks at it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import cv2

from rigwake._types import Image
from rigwake.errors import RigwakeError
from rigwake.readers.ros_decoding import read_header
from rigwake.readers.ros_frames import image_of_message
from rigwake.ros.transport import NodeStatus, ReceivedMessage, StatusLevel
from rigwake.views.frames import FrameSet, FrameWatch
from rigwake.views.levelling import Leveller
from rigwake.views.live import paired
from rigwake.views.present import Decoration, Presenter
from rigwake.views.projections import CylinderView
from rigwake.views.rig_sources import read_rig_source
from rigwake.views.surface import SHELL_M, FixedSurface, Shell
from rigwake.views.surround_rig import surround_rig
from rigwake.views.surround_view import SurroundView

_KEPT = 6  # encoded pictures of one camera that wait for the others
_QUALITY = 80
_JUMP_NS = 1_000_000_000  # stamps ran back: what was kept belongs to another time
_WAIT_S = 0.5
_WIDTH_PX, _HEIGHT_PX, _TOP_DEG, _BOTTOM_DEG = 1600, 500, 32.0, -42.0

SendJpeg = Callable[[int, str, bytes], None]
"""Told the time (rig clock, nanoseconds), the reference frame, and the encoded picture."""


class SurroundPainter:
    """Draws panoramas of one calibration from messages with images. Not for several threads at once.

    Raises InputError or UsageError for a calibration that no view can be drawn with.
    """

    def __init__(self, calibration: Path) -> None:
        source = read_rig_source(calibration)
        self.reference = source.rig.reference
        self._rig = surround_rig(source.rig)
        self._leveller = Leveller(self._rig, "levelled by the horizon in the pictures")
        self._surfaces = FixedSurface(Shell(SHELL_M))
        projection = CylinderView(_WIDTH_PX, _HEIGHT_PX, _TOP_DEG, _BOTTOM_DEG)
        self._presenter = Presenter(SurroundView(self._rig, projection), Decoration())
        self._watches = {name: FrameWatch() for name in self._rig.names}
        self._last_ns: int | None = None

    def newest(self, messages: Mapping[str, list[tuple[int, ReceivedMessage]]]) -> FrameSet | None:
        """The frame set of the newest time that all cameras have reached; None if it was drawn before or is empty.

        messages: stamps and images by camera, oldest first. Only the images of the frame set are decoded.
        """
        pictures = {
            name: [(stamp, partial(_image_of, message)) for stamp, message in kept]
            for name, kept in messages.items()
        }
        latest = max((kept[-1][0] for kept in messages.values() if kept), default=0)
        faults = {name: "not received" for name in self._rig.names if not messages.get(name)}
        frames = paired(self._rig, pictures, faults, latest, self._watches)
        if frames is None or frames.is_missing.all() or frames.timestamp_ns == self._last_ns:
            return None
        self._last_ns = frames.timestamp_ns
        return frames

    def jpeg(self, frames: FrameSet) -> bytes:
        """The panorama of a frame set; sectors of missing cameras are hatched."""
        images = frames.images(self._rig)
        attitude = self._leveller.at(frames.timestamp_ns, images)
        surface = self._surfaces.surface(images, self._rig, attitude, frames.timestamp_ns)
        picture = self._presenter.picture(frames, attitude, surface)
        _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        return bytes(encoded.tobytes())


def _image_of(message: ReceivedMessage) -> Image:
    return image_of_message(message.payload, message.message_type, message.encoding, colour=True)


class SurroundStream(threading.Thread):
    """Keeps the newest encoded images while somebody looks, and sends a panorama of them, `rate_hz` at most.

    names: which camera an image topic is, asked anew as topics come.
    """

    def __init__(self, names: Callable[[], Mapping[str, str]], send: SendJpeg, rate_hz: float) -> None:
        super().__init__(daemon=True, name="surround")
        self._names, self._send, self._period_s = names, send, 1.0 / rate_hz
        self._kept: dict[str, deque[tuple[int, ReceivedMessage]]] = {}
        self._lock, self._news, self._stopped = threading.Lock(), threading.Event(), threading.Event()
        self._calibration: Path | None = None
        self._is_wanted = False
        self.status = NodeStatus("surround", StatusLevel.OK, "nobody looks")

    def want(self, wanted: bool, calibration: Path | None) -> None:
        """Whether somebody looks, and what to draw with. The calibration is read again when it changes."""
        with self._lock:
            self._calibration = calibration
            if not wanted:
                self._kept.clear()
                self.status = NodeStatus("surround", StatusLevel.OK, "nobody looks")
            elif calibration is None:
                self.status = NodeStatus("surround", StatusLevel.WARN, "there is no calibration yet")
            self._is_wanted = wanted and calibration is not None

    def note(self, message: ReceivedMessage) -> None:
        """Another image. Kept encoded, and only while somebody looks."""
        if not self._is_wanted:
            return
        header = read_header(message.payload[:256], message.encoding)
        if header is None:
            return
        with self._lock:
            kept = self._kept.setdefault(message.topic, deque(maxlen=_KEPT))
            if kept and header.stamp_ns < kept[-1][0] - _JUMP_NS:
                self._kept = {message.topic: (kept := deque(maxlen=_KEPT))}
            kept.append((header.stamp_ns, message))
        self._news.set()

    def stop(self) -> None:
        """End the thread, and wait until it has."""
        self._stopped.set()
        self._news.set()
        if self.is_alive():
            self.join(10.0)

    def run(self) -> None:
        """Draw until stopped. What goes wrong is said in `status`, and tried again with the next image."""
        painter: SurroundPainter | None = None
        made_for: tuple[Path, int] | None = None
        while not self._stopped.is_set():
            if not self._news.wait(_WAIT_S):
                continue
            self._news.clear()
            begun = time.monotonic()
            with self._lock:
                calibration = self._calibration if self._is_wanted else None
                kept = {topic: list(messages) for topic, messages in self._kept.items()}
            if calibration is None:
                continue
            try:
                state = (calibration, calibration.stat().st_mtime_ns)
                if painter is None or made_for != state:
                    painter, made_for = SurroundPainter(calibration), state
                self._draw(painter, kept, begun)
            except (RigwakeError, OSError) as error:
                self.status = NodeStatus("surround", StatusLevel.ERROR, str(error))
            except Exception as error:  # whatever a picture holds, the next one is tried
                words = f"a fault of the program, please report it: {type(error).__name__}: {error}"
                self.status = NodeStatus("surround", StatusLevel.ERROR, words)
            self._stopped.wait(max(self._period_s - (time.monotonic() - begun), 0.0))

    def _draw(
        self, painter: SurroundPainter, kept: Mapping[str, list[tuple[int, ReceivedMessage]]], begun: float
    ) -> None:
        names = self._names()
        frames = painter.newest({names[topic]: found for topic, found in kept.items() if topic in names})
        if frames is None:
            return
        self._send(frames.timestamp_ns, painter.reference, painter.jpeg(frames))
        missing = "; ".join(f"{name}: {why}" for name, why in frames.missing.items())
        level = StatusLevel.WARN if missing else StatusLevel.OK
        words = f"drawn in {time.monotonic() - begun:.2f} s"
        self.status = NodeStatus("surround", level, f"{words}; missing: {missing}" if missing else words)
