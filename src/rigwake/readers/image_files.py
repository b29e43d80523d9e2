"""Cameras whose frames are image files or one video file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Stamps
from rigwake.errors import InputError
from rigwake.readers.images import ImageSize, checked_size, compressed_size, decode_compressed
from rigwake.recording import Frame

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v"})
_MAX_FILE_BYTES = 2**29


def natural_order(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    """Sort key under which `frame2.png` comes before `frame10.png`."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isascii() and part.isdigit() else (1, part) for part in parts], path.name


def image_files(folder: Path) -> list[Path]:
    """The image files directly in a folder, in natural order."""
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return sorted(found, key=natural_order)


def read_bytes(path: Path) -> bytes:
    """The content of an image file; InputError if it cannot be read or is absurdly large."""
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise InputError(f"{path.name} is larger than any image.")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}).") from error


@dataclass(frozen=True, eq=False)
class FileFrames:
    """One image file per frame. Images of another size than `size` are left out."""

    folder: Path
    names: tuple[str, ...]
    timestamps_ns: Stamps
    size: ImageSize

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`."""
        for index in indices:
            try:
                image = decode_compressed(read_bytes(self.folder / self.names[index]), colour=colour)
            except InputError:
                continue
            if image.shape[:2] == (self.size.height_px, self.size.width_px):
                yield Frame(int(index), int(self.timestamps_ns[index]), image)


def first_file_size(paths: Sequence[Path]) -> ImageSize:
    """Size of the first image whose header can be read, of some spread over the folder; InputError if none."""
    cause = "there are no images"
    for at in np.unique(np.linspace(0, max(len(paths) - 1, 0), 20).astype(int)) if paths else []:
        try:
            return compressed_size(read_bytes(paths[at]))
        except InputError as error:
            cause = error.cause
    raise InputError(f"No image can be read: {cause}")


@dataclass(frozen=True)
class VideoIndex:
    """Presentation times of the frames of a video, in units of `seconds_per_tick`, and their size."""

    ticks: tuple[int, ...]
    seconds_per_tick: float
    size: ImageSize

    def stamps_ns(self) -> Stamps:
        """Time of each frame since the first."""
        since_first = np.array(self.ticks, dtype=np.int64) - (self.ticks[0] if self.ticks else 0)
        return np.round(since_first * (self.seconds_per_tick * 1e9)).astype(np.int64)


def index_video(path: Path) -> VideoIndex:
    """Index a video from its packets, without decoding. Raises InputError if there is nothing to show."""
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path.name} holds no video.")
            stream = container.streams.video[0]
            size = checked_size(stream.codec_context.width, stream.codec_context.height)
            ticks = sorted({p.pts for p in container.demux(stream) if p.pts is not None})
            if not ticks or stream.time_base is None:
                raise InputError(f"{path.name} holds no frames.")
            return VideoIndex(tuple(ticks), float(stream.time_base), size)
    except av.error.FFmpegError as error:
        raise InputError(f"The video {path.name} cannot be read ({error}).") from error


@dataclass(frozen=True, eq=False)
class VideoFrames:
    """Frames of a video; runs of frames are decoded onwards from the keyframe before them."""

    path: Path
    index: VideoIndex
    timestamps_ns: Stamps

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`; a video that breaks off ends the frames."""
        layout = "bgr24" if colour else "gray"
        wanted = {self.index.ticks[index]: int(index) for index in indices}
        try:
            yield from self._decoded(wanted, layout)
        except av.error.FFmpegError:
            return  # the rest is damaged: left out, as `FrameSource` says

    def _decoded(self, wanted: dict[int, int], layout: str) -> Iterator[Frame]:
        with av.open(str(self.path)) as container:
            stream = container.streams.video[0]
            remaining = sorted(wanted)
            last_seen = -(2**62)
            while remaining:
                if remaining[0] - last_seen > self._seek_gap():
                    container.seek(remaining[0], stream=stream)
                for picture in container.decode(stream):
                    if picture.pts is None:
                        continue
                    last_seen = picture.pts
                    while remaining and remaining[0] < picture.pts:
                        remaining.pop(0)  # this frame could not be decoded
                    if remaining and picture.pts == remaining[0]:
                        remaining.pop(0)
                        index = wanted[picture.pts]
                        image = picture.to_ndarray(format=layout)
                        yield Frame(index, int(self.timestamps_ns[index]), image)
                    if not remaining or remaining[0] - last_seen > self._seek_gap():
                        break
                else:
                    return

    def _seek_gap(self) -> int:
        """Ticks beyond which seeking is cheaper than decoding onwards: some 60 frames."""
        ticks = self.index.ticks
        return 60 * max((ticks[-1] - ticks[0]) // max(len(ticks) - 1, 1), 1)
