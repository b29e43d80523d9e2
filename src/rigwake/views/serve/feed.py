"""Where the live page gets its scenes from: the newest only, whoever is slow."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from rigwake.errors import RigwakeError
from rigwake.views.attitude import LevelAttitude
from rigwake.views.frames import FrameSet, frame_sets
from rigwake.views.prepare import SurroundSetup
from rigwake.views.surface import Surface

_MOST_LATE_S = 1.0


@dataclass(frozen=True, eq=False)
class LiveScene:
    """One frame set with its attitude and surface. number: counts up. taken_s: time of day when it was taken."""

    number: int
    frames: FrameSet
    attitude: LevelAttitude
    surface: Surface
    taken_s: float


class Newest:
    """Holds the newest scene. Threads put, anybody may look."""

    def __init__(self) -> None:
        self._scene: LiveScene | None = None
        self._listeners: list[Callable[[], None]] = []
        self.error = ""

    def put(self, frames: FrameSet, attitude: LevelAttitude, surface: Surface, taken_s: float) -> None:
        """Replace the scene and tell the listeners."""
        number = 1 if self._scene is None else self._scene.number + 1
        self._scene = LiveScene(number, frames, attitude, surface, taken_s)
        for listener in self._listeners:
            listener()

    def fail(self, words: str) -> None:
        """Say why no more scenes will come."""
        self.error = words
        for listener in self._listeners:
            listener()

    def get(self) -> LiveScene | None:
        """The newest scene, None before the first."""
        return self._scene

    def listen(self, listener: Callable[[], None]) -> None:
        """Call `listener` (from any thread) whenever there is news."""
        self._listeners.append(listener)


class RecordingFeed(threading.Thread):
    """Plays a recording in real time, over and over. Frame sets are skipped where decoding cannot keep up."""

    def __init__(self, setup: SurroundSetup, newest: Newest) -> None:
        super().__init__(daemon=True, name="recording feed")
        self._setup, self._newest = setup, newest
        self._stopped = threading.Event()
        self._step = 1

    def stop(self) -> None:
        """End the thread soon."""
        self._stopped.set()

    def run(self) -> None:
        """Play until stopped."""
        try:
            while not self._stopped.is_set():
                self._play_once()
        except RigwakeError as error:
            self._newest.fail(str(error))

    def _play_once(self) -> None:
        setup = self._setup
        times = setup.times_ns()[:: self._step]
        start = time.monotonic()
        for frames in frame_sets(setup.streams, setup.rig, times):
            due = start + float(frames.timestamp_ns - times[0]) * 1e-9
            if self._stopped.wait(max(due - time.monotonic(), 0.0)):
                return
            taken = time.time()
            attitude = setup.attitude_at(frames)
            self._newest.put(frames, attitude, setup.surface_at(frames, attitude), taken)
            if time.monotonic() - due > _MOST_LATE_S:  # start again, coarser
                self._step = min(self._step + 1, 20)
                return
        if len(times) == 1:  # a single moment: nothing new will come
            self._stopped.wait(1.0)
