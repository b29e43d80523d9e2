"""Views as video files: H.264 in MP4, marked as a sphere where they are one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from rigwake._types import Image
from rigwake.atomic import atomic_path
from rigwake.errors import UsageError
from rigwake.views.sphere_metadata import mark_video

_TIME_BASE = Fraction(1, 90_000)


class VideoWriter:
    """Writes pictures with their times into one video stream."""

    def __init__(self, container: Any, width_px: int, height_px: int, rate_hz: float) -> None:
        self._container = container
        self._stream = container.add_stream(
            "libx264", rate=Fraction(max(rate_hz, 0.1)).limit_denominator(1000)
        )
        self._stream.width, self._stream.height = width_px, height_px
        self._stream.pix_fmt = "yuv420p"
        self._stream.time_base = _TIME_BASE
        self._stream.codec_context.time_base = _TIME_BASE
        self._stream.options = {"preset": "ultrafast", "crf": "21"}
        self._first_ns: int | None = None
        self._last = -1

    def write(self, picture: Image, timestamp_ns: int) -> None:
        """Append a (H, W, 3) BGR picture; times must not decrease."""
        if self._first_ns is None:
            self._first_ns = timestamp_ns
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")
        frame.time_base = _TIME_BASE
        self._last = max(round((timestamp_ns - self._first_ns) * 90_000 / 1e9), self._last + 1)
        frame.pts = self._last
        self._container.mux(self._stream.encode(frame))

    def finish(self) -> None:
        """Write what the encoder still holds."""
        self._container.mux(self._stream.encode(None))


@contextmanager
def video_file(
    path: Path, width_px: int, height_px: int, rate_hz: float, is_sphere: bool
) -> Iterator[VideoWriter]:
    """A video file that is whole or not there. Raises UsageError for odd sizes, which H.264 cannot hold."""
    if width_px % 2 or height_px % 2:
        raise UsageError(
            f"A video of {width_px} x {height_px} cannot be encoded.", remedy="Give an even --size."
        )
    with atomic_path(path) as temporary:
        with av.open(str(temporary), "w", format="mp4") as container:
            writer = VideoWriter(container, width_px, height_px, rate_hz)
            yield writer
            writer.finish()
        if is_sphere:
            mark_video(temporary)
