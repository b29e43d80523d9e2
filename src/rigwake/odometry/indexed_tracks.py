"""Tracks, indexed the two ways that odometry walks them: by frame and by track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Indices
from rigwake.cameras.protocol import CameraModel
from rigwake.tracks import Tracks


@dataclass(frozen=True, eq=False)
class IndexedTracks:
    """Observations of one camera, sorted by frame.

    tracks: where they came from, sorted; row k was row `given_rows[k]` of what was given.
    frame, track: (M,) row of the frame and number 0..T-1 of the track. track_ids: (T,) the tracks' own names.
    bearings: (M, 3). angle_std: (M,) standard deviation of a bearing per axis, radians. rad_per_px: (M,) angle of
    one pixel there.
    frame_starts: (F + 1,) rows of frame f are `frame_starts[f]:frame_starts[f + 1]`.
    by_track: (M,) rows sorted by track, then frame; track_starts: (T + 1,) bounds in `by_track`.
    """

    tracks: Tracks
    given_rows: Indices
    frame: Indices
    track: Indices
    track_ids: Indices
    bearings: Array
    angle_std: Array
    rad_per_px: Array
    frame_starts: Indices
    by_track: Indices
    track_starts: Indices

    @property
    def frames(self) -> int:
        """Number of frames, with or without observations."""
        return len(self.frame_starts) - 1

    def of_frame(self, frame: int) -> slice:
        """Rows of one frame."""
        return slice(int(self.frame_starts[frame]), int(self.frame_starts[frame + 1]))

    def rows_of_tracks(self, tracks: Indices) -> tuple[Indices, Indices]:
        """Rows of these tracks one after the other, and the (len + 1,) bounds of each."""
        lengths = self.track_starts[tracks + 1] - self.track_starts[tracks]
        bounds = np.concatenate([[0], np.cumsum(lengths)])
        within = np.arange(bounds[-1]) - np.repeat(bounds[:-1], lengths)
        return self.by_track[np.repeat(self.track_starts[tracks], lengths) + within], bounds

    def common(self, first: int, second: int) -> tuple[Indices, Indices]:
        """Rows of the tracks that both frames see, in the same order."""
        a, b = self.of_frame(first), self.of_frame(second)
        _, in_a, in_b = np.intersect1d(self.track[a], self.track[b], assume_unique=True, return_indices=True)
        return a.start + in_a, b.start + in_b


def radians_per_pixel(camera: CameraModel, bearings: Array) -> Array:
    """(M,) angle that one pixel spans in each direction: `|det(J J^T)|^(-1/4)`, J the derivative of the pixel by the
    unit bearing; pixels have the same area everywhere, angles per pixel do not."""
    J = camera.project_with_jacobians(bearings).d_point
    area = np.linalg.det(J @ np.swapaxes(J, -1, -2))
    typical = np.median(area[area > 0]) if (area > 0).any() else 1.0
    return np.asarray(np.where(area > 0, area, typical) ** -0.25)


def index_observations(tracks: Tracks, camera: CameraModel) -> IndexedTracks:
    """Index tracks by frame and by track, and turn pixel noise into bearing noise through the lens."""
    order = np.lexsort((tracks.track_ids, tracks.frame_indices))
    sorted_tracks = tracks.take(order)
    frame = sorted_tracks.frame_indices
    track_ids, track = np.unique(sorted_tracks.track_ids, return_inverse=True)
    rad_per_px = radians_per_pixel(camera, sorted_tracks.bearings_cam)
    by_track = np.lexsort((frame, track))
    return IndexedTracks(
        tracks=sorted_tracks,
        given_rows=order,
        frame=frame,
        track=track.astype(np.int64),
        track_ids=track_ids,
        bearings=np.ascontiguousarray(sorted_tracks.bearings_cam),
        angle_std=sorted_tracks.std_px * rad_per_px,
        rad_per_px=rad_per_px,
        frame_starts=np.searchsorted(frame, np.arange(len(tracks.timestamps_ns) + 1)),
        by_track=by_track,
        track_starts=np.searchsorted(track[by_track], np.arange(len(track_ids) + 1)),
    )
