"""What a camera's odometry had to do without: missing images, gaps of the IMU, outages of GNSS, things that moved."""

from __future__ import annotations

import numpy as np

from rigwake._types import Indices, Mask, Stamps
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry.se3 import SE3
from rigwake.geometry.triangulation import triangulate_rays
from rigwake.odometry.indexed_tracks import radians_per_pixel
from rigwake.odometry.result import OdometryResult
from rigwake.recording import GnssStream, ImuStream
from rigwake.tracks import Tracks

_GAP_INTERVALS = 3.5  # a gap is so many times the usual interval: single samples may be late
_MOVING_FRACTION = 0.02  # of the tracks of a map, which otherwise fit nearly all
_MOVING_VIEWS = 5
_MOVING_PX = 3.0


def bridged(
    tracks: Tracks,
    camera: CameraModel,
    visual: OdometryResult | None = None,
    imu: ImuStream | None = None,
    gnss: GnssStream | None = None,
) -> tuple[str, ...]:
    """One line for each thing that was missing within the camera's time, or contradicted the rest; none if nothing."""
    lines = list(frames_not_tracked(tracks))
    stamps = tracks.timestamps_ns
    lines += _gaps("images", stamps, stamps)
    lines += _gaps("IMU samples", imu.timestamps_ns, stamps) if imu is not None else []
    lines += _gaps("GNSS fixes", gnss.timestamps_ns, stamps) if gnss is not None else []
    if visual is not None:
        lines += _moving(tracks, camera, visual)
    return tuple(lines)


def frames_not_tracked(tracks: Tracks) -> tuple[str, ...]:
    """One line for each kind of frame that was given but not tracked, with their number; none if all were."""
    if tracks.report is None:
        return ()
    counts = {
        "black or empty": tracks.report.frames_black,
        "repeated": tracks.report.frames_repeated,
        "unreadable": tracks.report.frames_missing,
    }
    return tuple(f"{n} {kind} {_plural('frame', n)} bridged" for kind, n in counts.items() if n)


def _gaps(what: str, stamps: Stamps, span: Stamps) -> list[str]:
    """Intervals without stamps inside the span, against the usual interval."""
    inside = stamps[(stamps >= span[0]) & (stamps <= span[-1])]
    if len(inside) < 3:
        return [f"hardly any {what} during the camera's recording"] if what != "images" else []
    intervals = np.diff(inside)
    at = np.flatnonzero(intervals > _GAP_INTERVALS * np.median(intervals))
    if not len(at):
        return []
    longest = at[np.argmax(intervals[at])]
    return [
        f"{len(at)} {_plural('gap', len(at))} in the {what} bridged, the longest of {intervals[longest] * 1e-9:.1f} s "
        f"at {(inside[longest] - span[0]) * 1e-9:.1f} s"
    ]


def _moving(tracks: Tracks, camera: CameraModel, visual: OdometryResult) -> list[str]:
    """Tracks long enough to judge that belong to nothing that stands still."""
    path = visual.trajectory
    assert path.segment_ids is not None
    rows = np.flatnonzero(np.isin(tracks.frame_indices, visual.frame_indices))
    at = np.searchsorted(visual.frame_indices, tracks.frame_indices[rows])
    # a track that spans two segments is two: their worlds differ
    name = np.stack([path.segment_ids[at], tracks.track_ids[rows]], axis=1)
    order = np.lexsort((name[:, 1], name[:, 0]))
    rows, at = rows[order], at[order]
    _, track = np.unique(name[order], axis=0, return_inverse=True)
    judged = np.bincount(track) >= _MOVING_VIEWS
    unsupported = judged & (np.bincount(track, weights=visual.inliers[rows]) == 0)
    taken = unsupported[track]
    moving = _fits_nothing_standing(
        tracks, camera, path.world_from_body, rows[taken], at[taken], track[taken]
    )
    fraction = moving.sum() / max(int(judged.sum()), 1)
    if fraction < _MOVING_FRACTION:
        return []
    frames = tracks.frame_indices[rows[taken][moving[np.unique(track[taken], return_inverse=True)[1]]]]
    first, last = np.percentile((tracks.timestamps_ns[frames] - tracks.timestamps_ns[0]) * 1e-9, [5, 95])
    return [
        f"{moving.sum()} tracks ({100 * fraction:.0f} %) fit no standing point and were left out, mostly between "
        f"{first:.1f} and {last:.1f} s: water, or something that moves"
    ]


def _fits_nothing_standing(
    tracks: Tracks, camera: CameraModel, world_from_cam: SE3, rows: Indices, at: Indices, track: Indices
) -> Mask:
    """For each of these tracks in turn (rows sorted by track), whether neither a point nor a direction explains it."""
    _, number = np.unique(track, return_inverse=True)
    count = int(number.max()) + 1 if len(number) else 0
    bearings = tracks.bearings_cam[rows]
    poses = world_from_cam[at]
    directions = np.einsum("nij,nj->ni", poses.rotation, bearings)
    starts = np.searchsorted(number, np.arange(count + 1))
    points = triangulate_rays(poses.translation, directions, starts).points
    mean = np.stack([np.bincount(number, weights=axis, minlength=count) for axis in directions.T], axis=1)
    gates = _MOVING_PX * radians_per_pixel(camera, bearings) if count else np.empty(0)
    fits = np.zeros(count, dtype=bool)
    for toward in (points[number] - poses.translation, mean[number]):
        sine = np.linalg.norm(np.cross(directions, toward), axis=1)
        near = np.arctan2(sine, np.sum(directions * toward, axis=1)) <= gates
        fits |= np.bincount(number, weights=near, minlength=count) > 0.5 * np.diff(starts)
    return ~fits


def _plural(word: str, count: int) -> str:
    return word if count == 1 else word + "s"
