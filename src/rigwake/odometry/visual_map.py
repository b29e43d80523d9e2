"""The map under construction: poses of frames, points of tracks, and which observations agree with them.

This is the one mutable object of visual odometry; only `monocular` and `adjust` write to it.
"""

from __future__ import annotations

import numpy as np

from rigwake._types import Array, Indices, Mask
from rigwake.errors import EstimationError
from rigwake.geometry.pnp import AbsolutePose, absolute_pose, bearing_angles, refined
from rigwake.geometry.ransac import Budget
from rigwake.geometry.se3 import SE3
from rigwake.geometry.triangulation import triangulate_rays
from rigwake.odometry.indexed_tracks import IndexedTracks
from rigwake.odometry.odometry_options import OdometryOptions


class VisualMap:
    """Poses and points of one camera in one unit of length per segment.

    rotation (F, 3, 3), centre (F, 3): `world_from_cam`; segment: (F,), -1 where a frame has no pose;
    keyframe: (F,) frames that carry the map while it grows: their poses are adjusted, points come from them.
    points: (T, 3), NaN where a track has none; point_segment: (T,). inlier: (M,) observations that agree.
    """

    def __init__(self, observations: IndexedTracks, options: OdometryOptions) -> None:
        self.observations = observations
        self.options = options
        frames, tracks = observations.frames, len(observations.track_ids)
        self.rotation = np.tile(np.eye(3), (frames, 1, 1))
        self.centre = np.zeros((frames, 3))
        self.covariance = np.full((frames, 6, 6), np.inf)
        self.segment = np.full(frames, -1, dtype=np.int64)
        self.keyframe = np.zeros(frames, dtype=bool)
        self.points = np.full((tracks, 3), np.nan)
        self.point_segment = np.full(tracks, -1, dtype=np.int64)
        self.inlier = np.zeros(len(observations.frame), dtype=bool)

    def world_from_cam(self, frames: int | Indices) -> SE3:
        """Poses of frames."""
        return SE3(self.rotation[frames], self.centre[frames])

    def place(self, frame: int, world_from_cam: SE3, segment: int, covariance: Array | None = None) -> None:
        """Give a frame its pose."""
        self.rotation[frame], self.centre[frame] = world_from_cam.rotation, world_from_cam.translation
        self.segment[frame] = segment
        if covariance is not None:
            self.covariance[frame] = covariance

    def known_rows(self, frame: int, segment: int) -> Indices:
        """Rows of a frame whose track has a point in this segment."""
        rows = np.arange(*self.observations.of_frame(frame).indices(len(self.observations.frame)))
        return rows[self.point_segment[self.observations.track[rows]] == segment]

    def locate(
        self, frame: int, segment: int, predicted: SE3 | None, rng: np.random.Generator
    ) -> tuple[AbsolutePose, Indices] | None:
        """The frame's pose from the points it sees, with the rows used; None if they do not fix it.

        The predicted pose is refined first; only if too few points agree with that is the pose searched for.
        """
        rows = self.known_rows(frame, segment)
        if len(rows) < self.options.min_inliers:
            return None
        points = self.points[self.observations.track[rows]]
        bearings = self.observations.bearings[rows]
        gates = self.options.gate_px * self.observations.rad_per_px[rows]
        noise = {"max_angles": gates, "angle_stds": self.observations.angle_std[rows]}
        pose = None
        if predicted is not None:
            pose = refined(predicted, points, bearings, **noise)
        if pose is None or pose.inliers.mean() < 0.6:
            try:
                searched = absolute_pose(
                    points, bearings, **noise, rng=rng, budget=Budget(min_trials=20, max_trials=200)
                )
            except EstimationError:
                searched = None
            if searched is not None and (pose is None or searched.inliers.sum() > pose.inliers.sum()):
                pose = searched
        if pose is None:
            return None
        enough = pose.inliers.sum() >= self.options.min_inliers
        fraction = pose.inliers.mean() >= self.options.min_inlier_fraction
        return (pose, rows) if enough and fraction else None

    def triangulate(self, segment: int, tracks: Indices, *, keyframes_only: bool) -> None:
        """(Re-)triangulate these tracks from the placed frames of the segment, or its keyframes alone.

        Twice: observations that disagree with the first point do not take part in the second.
        """
        min_views = 2 if keyframes_only else 3
        tracks = tracks[(self.point_segment[tracks] < 0) | (self.point_segment[tracks] == segment)]
        observations, options = self.observations, self.options
        rows, bounds = observations.rows_of_tracks(tracks)
        group = np.repeat(np.arange(len(tracks)), np.diff(bounds))
        used = self.segment == segment
        if keyframes_only:
            used &= self.keyframe
        taking_part = used[observations.frame[rows]]
        rows, group = rows[taking_part], group[taking_part]
        accepted = np.zeros(len(tracks), dtype=bool)
        points = np.full((len(tracks), 3), np.nan)
        for _ in range(2):
            starts = np.searchsorted(group, np.arange(len(tracks) + 1))
            frames = observations.frame[rows]
            directions = np.einsum("nij,nj->ni", self.rotation[frames], observations.bearings[rows])
            found = triangulate_rays(self.centre[frames], directions, starts)
            points = found.points
            stds = np.zeros(len(tracks))
            np.maximum.at(stds, group, observations.angle_std[rows])
            counts = np.diff(starts)
            accepted = (
                found.ahead & (found.max_parallax > options.min_parallax_stds * stds) & (counts >= min_views)
            )
            accepted &= np.isfinite(points).all(axis=1)
            agree = accepted[group]
            agree[agree] = self.agree(rows[agree], points[group[agree]])
            kept = np.bincount(group[agree], minlength=len(tracks))
            accepted &= kept >= np.maximum(min_views, 0.5 * counts)
            if agree.all():
                break
            rows, group = rows[agree], group[agree]
        self._store(tracks, accepted, points, segment)

    def inlier_rms_px(self) -> float:
        """Root mean square distance of the inliers from their predictions, as pixels at the place they are seen."""
        rows = np.flatnonzero(self.inlier)
        if len(rows) == 0:
            return 0.0
        angles = self._angles(rows, self.points[self.observations.track[rows]])
        return float(np.sqrt(np.mean((angles / self.observations.rad_per_px[rows]) ** 2)))

    def agree(self, rows: Indices, points: Array, tolerance: float = 1.0) -> Mask:
        """Whether observations see these points (one per row) within `tolerance` gates."""
        gates = tolerance * self.options.gate_px * self.observations.rad_per_px[rows]
        return np.asarray(self._angles(rows, points) <= gates)

    def _angles(self, rows: Indices, points: Array) -> Array:
        frames = self.observations.frame[rows]
        seen = np.einsum("nji,nj->ni", self.rotation[frames], points - self.centre[frames])
        angles = bearing_angles(SE3.identity(), seen, self.observations.bearings[rows])
        # a point that an adjustment has pulled into the camera is in no direction
        return np.where(np.any(seen != 0.0, axis=1), angles, np.inf)

    def _store(self, tracks: Indices, accepted: Mask, points: Array, segment: int) -> None:
        had_point = self.point_segment[tracks] == segment
        lost = tracks[~accepted & had_point]
        self.points[lost], self.point_segment[lost] = np.nan, -1
        self.points[tracks[accepted]] = points[accepted]
        self.point_segment[tracks[accepted]] = segment

    def judge(self, segment: int) -> None:
        """Mark which observations of the segment agree with poses and points; drop points that few support."""
        observations = self.observations
        self.inlier[self.segment[observations.frame] == segment] = False
        rows = np.flatnonzero(
            (self.segment[observations.frame] == segment)
            & (self.point_segment[observations.track] == segment)
        )
        self.inlier[rows] = self.agree(rows, self.points[observations.track[rows]])
        support = np.bincount(observations.track[rows][self.inlier[rows]], minlength=len(self.points))
        seen = np.bincount(observations.track[rows], minlength=len(self.points))
        weak = (self.point_segment == segment) & ((support < 3) | (support < 0.5 * seen))
        self.points[weak], self.point_segment[weak] = np.nan, -1
        self.inlier[rows] &= ~weak[observations.track[rows]]
