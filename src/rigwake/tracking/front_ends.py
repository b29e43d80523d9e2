"""From a camera's images to its tracks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image, Mask
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import UsageError
from rigwake.recording import CameraStream, Frame
from rigwake.tracking.descriptor_front_end import DescriptorFrontEnd
from rigwake.tracking.klt_front_end import KltFrontEnd, Observed
from rigwake.tracking.masks import CameraMask, lens_mask, shrunk
from rigwake.tracking.picture_scale import octaves_to_skip
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracking.water import HorizonMask
from rigwake.tracks import TrackingReport, Tracks

_MIN_CONTRAST = 2.0  # grey levels: an image with less standard deviation shows nothing


def track_camera(
    stream: CameraStream,
    options: TrackingOptions | None = None,
    mask: CameraMask | None = None,
    *,
    indices: NDArray[np.int64] | None = None,
    up_cam: Array | None = None,
    octaves: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Tracks:
    """Follow points through the images of one camera.

    stream: must have a model, which turns pixels into bearings and predicts how patches deform.
    mask: regions without static scene points (`lens_mask`, `find_self_mask`, `mask_from_file`); what the lens does not
        show is left out in any case.
    indices: which frames of the stream to use (all by default). octaves: how often pictures are halved first (by
    default as soft ones need it). progress: told the number of frames done.
    The same input gives the same tracks. Raises UsageError if the camera has no model.
    """
    options = options or TrackingOptions()
    if stream.model is None:
        raise UsageError(
            f"camera {stream.name} has no intrinsics.",
            consequence="Pixels cannot be turned into bearings.",
            remedy="Give a model for it, or calibrate one with `rigwake intrinsics`.",
        )
    chosen = np.arange(len(stream)) if indices is None else np.asarray(indices)
    if octaves is None:
        octaves = octaves_to_skip(stream, chosen) if options.front_end == "klt" else 0
    usable = _static_region(stream, options, mask, options.patch_radius_px * 2**octaves)
    front_end = _front_end(stream.model, options, octaves)
    last_ns: int | None = None
    horizon = None if up_cam is None else HorizonMask(stream.model)
    run = _TrackingRun()
    row_of_index = {int(index): row for row, index in enumerate(chosen)}
    started = time.perf_counter()
    for done, (frame, prepared) in enumerate(_ahead(stream.frames(chosen), front_end.prepare)):
        kind = run.judge(frame.image)
        if kind == "usable":
            row = row_of_index[frame.index]
            if last_ns is not None and (frame.timestamp_ns - last_ns) * 1e-9 > options.max_gap_s:
                front_end.forget()
            above, high = usable, None
            if up_cam is not None and horizon is not None and np.isfinite(up_cam[row]).all():
                above = usable & ~horizon.below(up_cam[row])
                high = horizon.high(up_cam[row])
            run.add(row, front_end.step(prepared, above, high))
            last_ns = frame.timestamp_ns
        if progress is not None:
            progress(done + 1)
    return run.tracks(stream, chosen, time.perf_counter() - started)


def _ahead(frames: Iterator[Frame], prepare: Callable[[Image], Prepared]) -> Iterator[tuple[Frame, Prepared]]:
    """The frames, each read, decoded and prepared while the one before is worked on."""

    def read() -> tuple[Frame, Prepared] | None:
        frame = next(frames, None)
        return None if frame is None else (frame, prepare(frame.image))

    with ThreadPoolExecutor(1) as reader:
        upcoming = reader.submit(read)
        while (found := upcoming.result()) is not None:
            upcoming = reader.submit(read)
            yield found


Prepared = TypeVar("Prepared")


class FrontEnd(Protocol[Prepared]):
    """Follows points through consecutive images of one camera."""

    def prepare(self, image: Image) -> Prepared:
        """What does not depend on the images before: may be called ahead of `step`, on another thread."""

    def forget(self) -> None:
        """Start anew: the next image does not continue the last one."""

    def step(self, now: Prepared, usable: Mask, high: Mask | None = None) -> Observed:
        """Observations in the next image; `usable` (H, W) says where points may be, `high` where most is sky."""


def _front_end(model: CameraModel, options: TrackingOptions, octaves: int) -> FrontEnd[Any]:
    return KltFrontEnd(model, options, octaves) if options.front_end == "klt" else DescriptorFrontEnd(options)


def _static_region(
    stream: CameraStream, options: TrackingOptions, mask: CameraMask | None, reach_px: int
) -> Mask:
    """Where points may be in every frame; patches reach so far about them."""
    usable = lens_mask(stream).usable
    if mask is not None:
        usable &= mask.usable
    # a patch that reaches over the edge of the lens or the hull would hold on to it
    usable = shrunk(usable, reach_px)
    if options.region_of_interest is not None:
        x, y, width, height = options.region_of_interest
        within = np.zeros_like(usable)
        within[max(y, 0) : max(y + height, 0), max(x, 0) : max(x + width, 0)] = True
        usable &= within
    return usable


@dataclass
class _TrackingRun:
    """What has been observed so far, and what happened to the frames."""

    rows: list[NDArray[np.int64]] = field(default_factory=list)
    seen: list[Observed] = field(default_factory=list)
    black: int = 0
    repeated: int = 0
    shown: set[bytes] = field(default_factory=set)

    def judge(self, image: Image) -> str:
        """Whether a frame is `usable`, `black` or a `repeated` copy of one before: noise makes no picture twice."""
        coarse = image[::4, ::4]
        if float(coarse.std()) < _MIN_CONTRAST:
            self.black += 1
            return "black"
        known = blake2b(coarse.tobytes(), digest_size=16).digest()
        if known in self.shown:
            self.repeated += 1
            return "repeated"
        self.shown.add(known)
        return "usable"

    def add(self, row: int, observed: Observed) -> None:
        """Keep the observations of the frame that is row `row` of the tracks' stamps."""
        self.rows.append(np.full(len(observed[0]), row, dtype=np.int64))
        self.seen.append(observed)

    def tracks(self, stream: CameraStream, chosen: NDArray[np.int64], elapsed_s: float) -> Tracks:
        """Everything seen, as one value; points seen only once are left out."""
        assert stream.model is not None
        ids = np.concatenate([np.empty(0, np.int64), *(s[0] for s in self.seen)])
        pixels = np.concatenate([np.empty((0, 2)), *(s[1] for s in self.seen)])
        std_px = np.concatenate([np.empty(0), *(s[2] for s in self.seen)])
        rows = np.concatenate([np.empty(0, np.int64), *self.rows])
        bearings, valid = stream.model.unproject(pixels)
        lengths = np.bincount(ids, minlength=1)
        keep = valid & (lengths[ids] >= 2)
        report = TrackingReport(
            frames=len(chosen),
            frames_used=len(self.seen),
            frames_black=self.black,
            frames_repeated=self.repeated,
            frames_missing=len(chosen) - len(self.seen) - self.black - self.repeated,
            tracks=int(np.count_nonzero(lengths >= 2)),
            observations=int(keep.sum()),
            frames_per_second=len(chosen) / max(elapsed_s, 1e-9),
        )
        return Tracks(
            stream.name,
            stream.timestamps_ns[chosen],
            rows[keep],
            ids[keep],
            pixels[keep],
            bearings[keep],
            std_px[keep],
            report,
        )
