"""Cameras whose frames are one video file."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import av.error
import av.logging
import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image, Stamps
from rigwake.errors import InputError
from rigwake.readers.images import ImageSize, checked_size
from rigwake.recording import Frame
from rigwake.text_files import require_file

_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,mpegts,mpeg,asf"
# PyAV passes on what damaged files make FFmpeg say; its own wrappers stumble over some of it
_UNREADABLE = (av.error.FFmpegError, UnicodeDecodeError, AttributeError, ValueError, IndexError)
_LEAST_FRACTION, _LONGEST_TAIL_S = 0.99, 0.5
_WORTH_A_JUMP = 8
_TURNS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_CLOCKWISE}


@dataclass(frozen=True)
class VideoIndex:
    """The frames of a video in the order in which they are shown.

    ticks: their times in units of `seconds_per_tick`. keyframes: ticks from which decoding may start. by_order: the
    container does not say when a picture is shown (AVI with B-frames): the n-th that is decoded is the n-th, and ticks
    are those of the packets in the order of decoding. rotation_deg: counter-clockwise turn that the file asks players
    for. missing: what the header announces and is not there, in words. packet_ticks: sorted ticks of all packets, also
    where `ticks` are chosen or ordered otherwise.
    """

    ticks: tuple[int, ...]
    seconds_per_tick: float
    size: ImageSize
    keyframes: tuple[int, ...] = ()
    by_order: bool = False
    rotation_deg: int = 0
    missing: str = ""
    packet_ticks: tuple[int, ...] = ()

    def stamps_ns(self) -> Stamps:
        """Time of each frame since the first."""
        since_first = np.array(self.ticks, dtype=np.int64) - (self.ticks[0] if self.ticks else 0)
        return np.round(since_first * (self.seconds_per_tick * 1e9)).astype(np.int64)


def _opened(path: Path) -> Any:
    """The container of a regular local file: no name is taken for an address, no playlist is followed."""
    require_file(path)
    options = {"format_whitelist": _FORMATS, "protocol_whitelist": "file"}
    return av.open(f"file:{path.absolute()}", options=options)


def index_video(path: Path) -> VideoIndex:
    """Index a video from its packets and first frame. Raises InputError if there is nothing to show."""
    try:
        with _opened(path) as container:
            if not container.streams.video:
                raise InputError(f"{path.name} holds no video.")
            stream = container.streams.video[0]
            size = checked_size(stream.codec_context.width, stream.codec_context.height)
            stored = [p for p in container.demux(stream) if p.pts is not None or p.dts is not None or p.size]
            packets = [(p.pts, p.dts, p.is_keyframe) for p in stored if p.size and not p.is_discard]
            if not packets or stream.time_base is None:
                raise InputError(f"{path.name} holds no frames.")
            is_avi = container.format.name == "avi"
            by_order = (is_avi and bool(stream.codec_context.has_b_frames)) or any(
                p[0] is None for p in packets
            )
            at = [p[1] if by_order else p[0] for p in packets]
            if any(tick is None for tick in at):
                at = list(range(len(packets)))
            missing = _missing(stream, container, len(stored), max(at) - min(at))
            keyframes = {tick for tick, (_, _, is_key) in zip(at, packets, strict=True) if is_key}
            base = float(stream.time_base)
        ticks = tuple(sorted(set(at)))
        return VideoIndex(
            ticks, base, size, tuple(sorted(keyframes)), by_order, _rotation(path), missing, ticks
        )
    except _UNREADABLE as error:
        raise InputError(f"The video {path.name} cannot be read ({error}).") from error


def _rotation(path: Path) -> int:
    """Degrees counter-clockwise by which the first frame is to be turned for showing. InputError if none decodes."""
    with _opened(path) as container:
        for picture in container.decode(video=0):
            return int(getattr(picture, "rotation", 0)) % 360
    raise InputError(f"No frame of {path.name} can be decoded.")


def _missing(stream: Any, container: Any, found: int, span: int) -> str:
    """How many frames, or how much time, the header announces beyond what is there."""
    if stream.frames and found < _LEAST_FRACTION * stream.frames:
        return f"the header announces {stream.frames} frames, {found} are there"
    duration_s = float(container.duration or 0) * 1e-6
    there_s = span * float(stream.time_base) * (1 + 1 / max(found - 1, 1))
    longest_tail_s = max(_LONGEST_TAIL_S, 5 * there_s / found)
    if not stream.frames and duration_s - there_s > longest_tail_s:
        return f"the header announces {duration_s:.3g} s, {there_s:.3g} s are there"
    return ""


@dataclass(frozen=True, eq=False)
class VideoFrames:
    """Frames of a video; runs of frames are decoded onwards from the keyframe before them. turned_deg: each is turned
    counter-clockwise by so much."""

    path: Path
    index: VideoIndex
    timestamps_ns: Stamps
    turned_deg: int = 0

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`; a video that breaks off ends the frames."""
        layout = "bgr24" if colour else "gray"
        wanted = {self.index.ticks[index]: int(index) for index in indices}
        decoded = self._by_order(wanted) if self.index.by_order else self._by_tick(wanted)
        try:
            for index, picture in decoded:
                image: Image = picture.to_ndarray(format=layout)
                if self.turned_deg:
                    image = cv2.rotate(image, _TURNS[self.turned_deg])
                yield Frame(index, int(self.timestamps_ns[index]), image)
        except (*_UNREADABLE, InputError):
            return  # the rest is damaged: left out, as `FrameSource` says

    def _by_tick(self, wanted: dict[int, int]) -> Iterator[tuple[int, Any]]:
        """Jumps to keyframes, unless a jump misses its frame: then all that is left is decoded from the start."""
        remaining = sorted(wanted, reverse=True)
        with _opened(self.path) as container:
            for picture in self._with_jumps(container, remaining):
                yield wanted[picture.pts], picture
        if remaining:
            with _opened(self.path) as container:
                for picture in container.decode(video=0):
                    while remaining and picture.pts is not None and remaining[-1] < picture.pts:
                        remaining.pop()  # this frame could not be decoded
                    if not remaining:
                        return
                    if picture.pts == remaining[-1]:
                        yield wanted[remaining.pop()], picture

    def _with_jumps(self, container: Any, remaining: list[int]) -> Iterator[Any]:
        """Pictures of the ticks at the end of `remaining`, which are taken off it; ends at a jump that misses."""
        stream = container.streams.video[0]
        last_seen = -(2**62)
        sought: int | None = None  # a seek that does not lead to its frame is not tried again
        while remaining:
            jumped = remaining[-1] != sought and self._is_jump_worth(last_seen, remaining[-1])
            if jumped:
                sought = remaining[-1]
                container.seek(sought, stream=stream)
            for picture in container.decode(stream):
                if picture.pts is None:
                    continue
                if jumped and picture.pts > remaining[-1]:
                    return
                jumped = False
                last_seen = max(last_seen, picture.pts)
                while remaining and remaining[-1] < picture.pts:
                    remaining.pop()  # this frame could not be decoded
                if remaining and picture.pts == remaining[-1]:
                    remaining.pop()
                    yield picture
                if not remaining:
                    return
                if remaining[-1] != sought and self._is_jump_worth(last_seen, remaining[-1]):
                    break
            else:
                return

    def _is_jump_worth(self, last_seen: int, tick: int) -> bool:
        """Whether the keyframe before a tick lies many frames ahead: else decoding onwards is cheaper."""
        at = bisect_right(self.index.keyframes, tick)
        if not at:
            return False
        ticks = self.index.packet_ticks
        skipped = bisect_right(ticks, self.index.keyframes[at - 1]) - bisect_right(ticks, last_seen)
        return skipped > _WORTH_A_JUMP

    def _by_order(self, wanted: dict[int, int]) -> Iterator[tuple[int, Any]]:
        """Decodes from the start; what is lost on the way shows in the packets that went in."""
        rank = {tick: at for at, tick in enumerate(self.index.packet_ticks)}
        last = max((rank[tick] for tick in wanted), default=-1)
        by_rank = {rank[tick]: index for tick, index in wanted.items()}
        at, before = -1, None
        with _opened(self.path) as container:
            for picture in container.decode(video=0):
                packet = rank.get(picture.dts)
                step = 1 if packet is None or before is None else max(packet - before, 1)
                at, before = at + step, packet if packet is not None else before
                if packet is None:
                    before = None
                if at in by_rank:
                    yield by_rank[at], picture
                if at >= last:
                    return
