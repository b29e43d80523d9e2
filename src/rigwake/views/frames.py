"""Frame sets: of every camera the frame nearest a time, and why one is missing."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError, UsageError
from rigwake.geometry.interpolate import nearest_indices
from rigwake.parallel import in_order
from rigwake.recording import CameraStream, Frame, Recording
from rigwake.views.surround_rig import SurroundRig

_BLACK = 6.0  # grey levels: darker than a night with any light in it
_FROZEN = 3  # so many equal pictures in a row are one picture
_LENS_DIFFERENCE = 0.03  # of the width: lenses that differ more are two lenses
_SAMPLE = 16  # every so many pixels are compared


@dataclass(frozen=True, eq=False)
class FrameSet:
    """One picture of every camera of a rig, taken at about the same time.

    timestamp_ns: rig clock. stack: (C, Hmax, Wmax, 3) BGR uint8, in the order of `names`; zero where missing.
    missing: why a camera is missing, by name. offsets_s: (C,) how much later than `timestamp_ns` each was taken (NaN if
    missing).
    """

    timestamp_ns: int
    names: tuple[str, ...]
    stack: NDArray[np.uint8]
    missing: Mapping[str, str]
    offsets_s: NDArray[np.float64]

    @property
    def is_missing(self) -> NDArray[np.bool_]:
        """(C,) which cameras are missing."""
        return np.array([name in self.missing for name in self.names])

    def images(self, rig: SurroundRig) -> dict[str, Image]:
        """The pictures that are there, by name, in their own sizes."""
        return {
            name: self.stack[index, : model.height_px, : model.width_px]
            for index, (name, model) in enumerate(zip(rig.names, rig.models, strict=True))
            if name not in self.missing
        }


@dataclass
class FrameWatch:
    """Finds pictures that are black or frozen. Keeps a digest of the last pictures of one camera."""

    _last: deque[int] = field(default_factory=lambda: deque(maxlen=_FROZEN))
    _last_stamp: int | None = None

    def fault(self, image: Image, timestamp_ns: int) -> str:
        """Why a picture must not be shown; empty if it may be."""
        sample = np.ascontiguousarray(image[::_SAMPLE, ::_SAMPLE])
        if timestamp_ns != self._last_stamp:
            self._last.append(hash(sample.tobytes()))
            self._last_stamp = timestamp_ns
        if float(np.percentile(sample, 98)) < _BLACK:
            return "black"
        if len(self._last) == _FROZEN and len(set(self._last)) == 1:
            return "frozen"
        return ""


def require_fit(rig: SurroundRig, recording: Recording) -> dict[str, CameraStream]:
    """Streams by the rig's camera names. UsageError, with the table of both, if they do not belong together.

    A camera of the rig that the recording lacks is left out of the result, unless the recording has one that the rig
    does not know: then names differ and nobody can tell which is which.
    """
    streams = {n: recording.cameras[n] for n in rig.names if n in recording.cameras}
    strangers = [n for n in recording.cameras if n not in rig.names]
    lacking = [n for n in rig.names if n not in streams]
    faults = []
    if not streams or (lacking and strangers):
        faults.append(f"No camera of the recording is called {', '.join(lacking)}.")
    for index, name in enumerate(rig.names):
        stream, model = streams.get(name), rig.models[index]
        if stream is None:
            continue
        if (stream.width_px, stream.height_px) != (model.width_px, model.height_px):
            faults.append(
                f"{name}: its pictures are {stream.width_px} x {stream.height_px}, "
                f"its calibrated lens is {model.width_px} x {model.height_px}."
            )
        elif stream.model is not None and (apart := lens_distance_px(model, stream.model)) > (
            _LENS_DIFFERENCE * model.width_px
        ):
            faults.append(
                f"{name}: its lens in the recording differs from the calibrated one by {apart:.0f} px."
            )
    if faults:
        raise UsageError(
            " ".join(faults),
            consequence="The calibration does not fit the recording.\n" + _table(rig, recording),
            remedy="Give the calibration of this vessel, or say which camera is which: --topic camera.NAME=TOPIC.",
        )
    return streams


def lens_distance_px(first: CameraModel, second: CameraModel) -> float:
    """Median distance between the pixels in which two lenses show the same directions, over the image."""
    u = np.linspace(0, first.width_px - 1, 15)
    v = np.linspace(0, first.height_px - 1, 11)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    bearings, valid = first.unproject(pixels)
    other, also = second.project(np.where(valid[:, None], bearings, [0.0, 0.0, 1.0]))
    both = valid & also
    if not both.any():
        return np.inf
    return float(np.median(np.linalg.norm(other[both] - pixels[both], axis=1)))


def _table(rig: SurroundRig, recording: Recording) -> str:
    lines = ["calibration:"]
    lines += [
        f"  {n}: {m.width_px} x {m.height_px}, {m.model}" for n, m in zip(rig.names, rig.models, strict=True)
    ]
    lines.append("recording:")
    for name, stream in recording.cameras.items():
        lens = stream.model.model if stream.model is not None else "lens unknown"
        lines.append(f"  {name}: {stream.width_px} x {stream.height_px}, {lens}")
    return "\n".join([*lines, *(["  no camera"] if not recording.cameras else [])])


def output_times(streams: Mapping[str, CameraStream], rig: SurroundRig) -> NDArray[np.int64]:
    """Times (rig clock) of the frames of the camera that has most of them."""
    name = max(streams, key=lambda n: len(streams[n]))
    return streams[name].timestamps_ns + _offset_ns(rig, name)


def frame_sets(
    streams: Mapping[str, CameraStream], rig: SurroundRig, times_ns: Sequence[int] | NDArray[np.int64]
) -> Iterator[FrameSet]:
    """Frame sets at increasing times (rig clock); frames are paired by corrected time.

    A camera whose nearest frame is off by more than half its period, black, frozen or cannot be decoded is marked as
    missing. Raises InputError if the pictures of a camera change their size.
    """
    times = np.asarray(times_ns, dtype=np.int64)
    plans = {name: _plan(stream, times - _offset_ns(rig, name)) for name, stream in streams.items()}
    readers = {name: _Reader(streams[name], plans[name][0]) for name in streams}
    watches = {name: FrameWatch() for name in streams}
    shape = (len(rig), max(m.height_px for m in rig.models), max(m.width_px for m in rig.models), 3)
    for k, time in enumerate(times.tolist()):
        stack = np.zeros(shape, dtype=np.uint8)
        missing: dict[str, str] = {}
        offsets = np.full(len(rig), np.nan)
        wanted = [(readers[name], int(plans[name][0][k])) for name in streams]
        frames = dict(zip(streams, in_order(_read, wanted), strict=True))
        for index, name in enumerate(rig.names):
            if name not in streams:
                missing[name] = "not in the recording"
                continue
            nearest, late_s, period_s = plans[name][0][k], plans[name][1][k], plans[name][2]
            frame = frames[name]
            if abs(late_s) > 0.5 * period_s:
                missing[name] = f"{'late' if late_s > 0 else 'early'} by {abs(late_s):.2f} s"
            elif frame is None:
                missing[name] = f"picture {nearest} cannot be decoded"
            else:
                require_size(name, frame.image, rig.models[index].width_px, rig.models[index].height_px)
                if fault := watches[name].fault(frame.image, frame.timestamp_ns):
                    missing[name] = fault
                else:
                    offsets[index] = late_s
                    place(stack[index], frame.image)
        yield FrameSet(time, rig.names, stack, missing, offsets)


def require_size(name: str, image: Image, width_px: int, height_px: int) -> None:
    """InputError if a picture is not of the size of its lens."""
    if image.shape[:2] != (height_px, width_px):
        raise InputError(
            f"{name}: a picture is {image.shape[1]} x {image.shape[0]}, its lens {width_px} x {height_px}.",
            consequence="Its pixels have no known directions.",
            remedy="Record with one picture size, or calibrate this size.",
        )


def place(target: NDArray[np.uint8], image: Image) -> None:
    """Copy a grey or BGR picture into the upper left of (Hmax, Wmax, 3)."""
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    target[: image.shape[0], : image.shape[1]] = colour


def _offset_ns(rig: SurroundRig, name: str) -> int:
    return round(rig.time_offsets_s[rig.names.index(name)] * 1e9)


def _plan(
    stream: CameraStream, at_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], float]:
    """Index of the nearest frame per time, how much later it was taken, and the stream's period (seconds)."""
    stamps = stream.timestamps_ns
    if len(stamps) == 0:
        return np.zeros(len(at_ns), np.int64), np.full(len(at_ns), np.inf), 1.0
    nearest = nearest_indices(stamps, at_ns)
    period = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else np.inf
    late_s = np.asarray((stamps[nearest] - at_ns) * 1e-9, dtype=np.float64)
    return nearest, late_s, period


class _Reader:
    """Frames of one stream in order; a frame that is asked for again is kept."""

    def __init__(self, stream: CameraStream, indices: NDArray[np.int64]) -> None:
        self._frames = stream.frames(np.unique(indices), colour=True) if len(stream) else iter(())
        self._frame: Frame | None = None

    def read(self, index: int) -> Frame | None:
        while self._frame is None or self._frame.index < index:
            following = next(self._frames, None)
            if following is None:
                break
            self._frame = following
        return self._frame if self._frame is not None and self._frame.index == index else None


def _read(wanted: tuple[_Reader, int]) -> Frame | None:
    reader, index = wanted
    return reader.read(index)
