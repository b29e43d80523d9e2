"""A long recording's tracking in stretches of time that are worked on side by side, and joined.

Where the stretches are cut depends on the recording and the setting alone: the tracks are the same wherever, and on
however many machines, they were made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rigwake._types import Array
from rigwake.recording import CameraStream
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.masks import CameraMask
from rigwake.tracking.picture_scale import octaves_to_skip
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracks import TrackingReport, Tracks

OVERLAP_S = (
    4.0  # a stretch begins so long before the one before ends, so that points are followed across the cut
)
_SAME_POINT_PX = 3.0

MapStretches = Callable[[Callable[["StretchJob"], Tracks], Sequence["StretchJob"]], Iterable[Tracks]]
"""Does the work on every stretch, in order: `map`, or a cluster."""


@dataclass(frozen=True, eq=False)
class StretchJob:
    """rows: (N,) of the stream's frames. up_cam: (N, 3) or None. octaves: the scale of the pictures, one for all."""

    stream: CameraStream
    options: TrackingOptions
    mask: CameraMask | None
    rows: NDArray[np.int64]
    up_cam: Array | None
    octaves: int


def stretch_rows(timestamps_ns: NDArray[np.int64], stretch_s: float) -> list[NDArray[np.int64]]:
    """Rows of every stretch of at least `stretch_s` (the last may be half as long again), with the overlap."""
    elapsed = (timestamps_ns - timestamps_ns[0]) * 1e-9 if len(timestamps_ns) else np.empty(0)
    count = max(round(float(elapsed[-1]) / stretch_s), 1) if len(elapsed) else 1
    edges = np.arange(1, count) * stretch_s
    first = np.concatenate([[0], np.searchsorted(elapsed, edges - OVERLAP_S)])
    last = np.concatenate([np.searchsorted(elapsed, edges), [len(elapsed)]])
    return [np.arange(a, b) for a, b in zip(first, last, strict=True)]


def track_stretch(job: StretchJob) -> Tracks:
    """Tracks of one stretch; their frames count from its beginning."""
    return track_camera(
        job.stream, job.options, job.mask, indices=job.rows, up_cam=job.up_cam, octaves=job.octaves
    )


def track_in_stretches(
    stream: CameraStream,
    options: TrackingOptions,
    mask: CameraMask | None = None,
    *,
    stretch_s: float,
    up_cam: Array | None = None,
    progress: Callable[[int], None] | None = None,
    map_stretches: MapStretches = map,
) -> Tracks:
    """As `track_camera`, in stretches of `stretch_s` seconds that overlap by a few.

    Where both of two stretches see a point in the overlap, the later one's observation is kept: the other would count
    the same evidence twice. progress: told the number of frames done, stretch by stretch.
    """
    parts = stretch_rows(stream.timestamps_ns, stretch_s)
    octaves = octaves_to_skip(stream, np.arange(len(stream))) if options.front_end == "klt" else 0
    jobs = [
        StretchJob(stream, options, mask, rows, None if up_cam is None else up_cam[rows], octaves)
        for rows in parts
    ]
    tracked: list[Tracks] = []
    for rows, tracks in zip(parts, map_stretches(track_stretch, jobs), strict=True):
        tracked.append(tracks)
        if progress is not None:
            progress(int(rows[-1]) + 1 if len(rows) else len(stream))
    return join_stretches(stream, parts, tracked)


def join_stretches(
    stream: CameraStream, parts: Sequence[NDArray[np.int64]], tracked: Sequence[Tracks]
) -> Tracks:
    """One value of all stretches; tracks of an earlier one end where the later one has the same point."""
    moved: list[Tracks] = []
    next_id = 0
    for rows, tracks in zip(parts, tracked, strict=True):
        offset = int(rows[0]) if len(rows) else 0
        whole = replace(
            tracks,
            timestamps_ns=stream.timestamps_ns,
            frame_indices=tracks.frame_indices + offset,
            track_ids=tracks.track_ids + next_id,
        )
        if moved:
            moved[-1] = moved[-1].take(~_repeated(moved[-1], whole))
        moved.append(whole)
        next_id = int(whole.track_ids.max(initial=next_id - 1)) + 1
    columns = {key: np.concatenate([getattr(part, key) for part in moved]) for key in _COLUMNS}
    joined = Tracks(stream.name, stream.timestamps_ns, **columns, report=_report(parts, tracked))
    often = np.bincount(joined.track_ids, minlength=1)[joined.track_ids] >= 2
    joined = joined.take(often)
    joined = joined.take(np.lexsort((joined.track_ids, joined.frame_indices)))
    assert joined.report is not None
    counted = replace(
        joined.report, tracks=len(np.unique(joined.track_ids)), observations=len(joined.frame_indices)
    )
    return replace(joined, report=counted)


_COLUMNS = ("frame_indices", "track_ids", "pixels", "bearings_cam", "std_px")


def _repeated(earlier: Tracks, later: Tracks) -> NDArray[np.bool_]:
    """(M,) which observations of the earlier stretch the later one has as well."""
    same = np.zeros(len(earlier), dtype=np.bool_)
    for frame in np.intersect1d(earlier.frame_indices, later.frame_indices):
        mine = np.flatnonzero(earlier.frame_indices == frame)
        theirs = later.pixels[later.frame_indices == frame]
        near, _ = cKDTree(theirs).query(earlier.pixels[mine], distance_upper_bound=_SAME_POINT_PX)
        same[mine] = np.isfinite(near)
    return same


def _report(parts: Sequence[NDArray[np.int64]], tracked: Sequence[Tracks]) -> TrackingReport:
    """What happened to the frames: scaled from all that were looked at, since those of an overlap were twice."""
    reports = [tracks.report for tracks in tracked if tracks.report is not None]
    frames, looked_at = int(parts[-1][-1]) + 1 if len(parts[-1]) else 0, sum(len(part) for part in parts)
    black, repeated, missing = (
        round(sum(getattr(report, key) for report in reports) * frames / max(looked_at, 1))
        for key in ("frames_black", "frames_repeated", "frames_missing")
    )
    seconds = sum(report.frames / max(report.frames_per_second, 1e-9) for report in reports)
    used = frames - black - repeated - missing
    return TrackingReport(frames, used, black, repeated, missing, 0, 0, frames / max(seconds, 1e-9))
