"""Monocular visual odometry, offline: start where the view is best, grow both ways, adjust."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rigwake._types import Array, Indices
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError
from rigwake.geometry.se3 import SE3
from rigwake.geometry.two_view import rotation_compensated_parallax
from rigwake.odometry.indexed_tracks import index_observations
from rigwake.odometry.map_adjustment import adjust_all, adjust_window
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.odometry.result import OdometryCounts, OdometryLandmarks, OdometryResult
from rigwake.odometry.start_pair import choose_start, start_points
from rigwake.odometry.visual_map import VisualMap
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_MIN_SEGMENT = 5  # frames
_WIDE = 4.0  # times the gate, where poses are only nearly right


def estimate_monocular(
    tracks: Tracks,
    camera: CameraModel,
    options: OdometryOptions | None = None,
    *,
    rotations: Array | None = None,
    progress: Callable[[int], None] | None = None,
) -> OdometryResult:
    """The camera's motion and a map of points from tracks alone, up to scale.

    A map is started from the two frames with the best parallax and grown forwards and backwards frame by frame
    (PnP on bearings), with new points and a windowed adjustment at keyframes, an adjustment of everything whenever
    the map has grown, and one at the end. Where tracking breaks, another segment is started, with its own
    origin and unit of length.

    rotations: (F, 3, 3) `gyro_world_from_cam` at every frame of the tracks, if an IMU tells.
    Raises EstimationError if no two frames allow a start anywhere.
    """
    options = options or OdometryOptions()
    started = time.perf_counter()
    observations = index_observations(tracks, camera)
    builder = _Builder(VisualMap(observations, options), camera, rotations, progress)
    failure = builder.build()
    if not (builder.map.segment >= 0).any():
        raise failure or EstimationError(f"{tracks.camera}: there are no frames.")
    return builder.result(time.perf_counter() - started)


def readjust(
    tracks: Tracks,
    camera: CameraModel,
    frame_indices: Indices,
    world_from_cam: SE3,
    options: OdometryOptions | None = None,
) -> OdometryResult:
    """The map and the path of these frames from poses that are nearly right, such as those of a closed loop.

    Points are triangulated from the given poses, first with a wide gate, and all is adjusted in one segment.
    """
    options = options or OdometryOptions()
    started = time.perf_counter()
    wide = replace(options, gate_px=_WIDE * options.gate_px)
    builder = _Builder(VisualMap(index_observations(tracks, camera), wide), camera, None, None)
    for k, frame in enumerate(frame_indices.tolist()):
        builder.map.place(frame, world_from_cam[k], 0)
    interval = max(round(0.5 * options.keyframe_interval_s * 1e9), 1)
    stamps = tracks.timestamps_ns[frame_indices]
    _, spaced = np.unique((stamps - stamps[0]) // interval, return_index=True)
    builder.map.keyframe[frame_indices[spaced]] = True
    builder.segments = 1
    builder.finish(0)
    builder.map.options = options
    builder.finish(0)
    return builder.result(time.perf_counter() - started)


class _Builder:
    """Grows a map segment by segment."""

    def __init__(
        self,
        visual_map: VisualMap,
        camera: CameraModel,
        rotations: Array | None,
        progress: Callable[[int], None] | None,
    ) -> None:
        self.map = visual_map
        self.camera = camera
        self.options = visual_map.options
        self.rotations = rotations
        self.progress = progress
        self.rng = np.random.default_rng(self.options.seed)
        self.adjusted_keyframes = 2
        self.segments = 0

    def build(self) -> EstimationError | None:
        """Start segments in every gap until none can be started; returns the last reason why."""
        failure = None
        gaps = [(0, self.map.observations.frames - 1)]
        while gaps:
            first, last = gaps.pop(0)
            if last - first + 1 < _MIN_SEGMENT:
                continue
            try:
                placed_first, placed_last = self._segment(first, last)
            except EstimationError as error:
                failure = error
                continue
            gaps += [(first, placed_first - 1), (placed_last + 1, last)]
        return failure

    def _segment(self, first: int, last: int) -> tuple[int, int]:
        """Build one segment inside first..last; the range of frames it covers."""
        pair = choose_start(self.map.observations, first, last, self.options, self.rng, self.rotations)
        segment, self.segments = self.segments, self.segments + 1
        self.map.keyframe[[pair.first, pair.second]] = True
        self.map.place(pair.first, SE3.identity(), segment)
        self.map.place(pair.second, pair.view.second_from_first.inverse(), segment)
        tracks, points = start_points(self.map.observations, pair)
        self.map.points[tracks], self.map.point_segment[tracks] = points, segment
        self._grow(range(pair.first + 1, pair.second), segment, pair.first)
        adjust_all(self.map, self.camera, segment, keyframes_only=True)
        self._grow(range(pair.second + 1, last + 1), segment, pair.second)
        self._grow(range(pair.first - 1, first - 1, -1), segment, pair.first)
        self.finish(segment)
        placed = np.flatnonzero(self.map.segment == segment)
        return int(placed[0]), int(placed[-1])

    def _grow(self, frames: range, segment: int, last_keyframe: int) -> None:
        """Place frame after frame until too many in a row cannot be placed."""
        previous, lost = last_keyframe, 0
        for frame in frames:
            if not self._place(frame, segment, previous):
                lost += len(self.map.known_rows(frame, segment)) > 0
                if lost > self.options.max_lost:
                    return
                continue
            previous, lost = frame, 0
            if self._is_keyframe(frame, segment, last_keyframe):
                last_keyframe = frame
                self.map.keyframe[frame] = True
                seen = self.map.observations.track[self.map.observations.of_frame(frame)]
                self.map.triangulate(
                    segment, seen[self.map.point_segment[seen] != segment], keyframes_only=True
                )
                self._adjust(frame, segment)

    def _adjust(self, newest: int, segment: int) -> None:
        """The window around the newest keyframe, or all keyframes if the map has grown enough."""
        keyframes = int(((self.map.segment == segment) & self.map.keyframe).sum())
        if keyframes > self.options.global_growth * self.adjusted_keyframes:
            adjust_all(self.map, self.camera, segment, keyframes_only=True)
            self.adjusted_keyframes = keyframes
        else:
            adjust_window(self.map, self.camera, segment, newest)

    def finish(self, segment: int) -> None:
        """Adjust keyframes, place every frame anew, then (if wanted) adjust all frames together."""
        self._triangulate_all(segment, keyframes_only=True)
        adjust_all(self.map, self.camera, segment, keyframes_only=True)
        self.map.judge(segment)
        self._place_again(segment)
        self._triangulate_all(segment, keyframes_only=False)
        if self.options.adjust_all_frames:
            adjust_all(self.map, self.camera, segment, keyframes_only=False)
        self.map.judge(segment)

    def _place_again(self, segment: int) -> None:
        """Refine every frame of the segment's span against the present map; some that were lost are found."""
        placed = np.flatnonzero(self.map.segment == segment)
        for frame in range(placed[0], placed[-1] + 1):
            if self.map.segment[frame] not in (-1, segment):
                continue
            nearest = int(placed[np.argmin(np.abs(placed - frame))])
            located = self.map.locate(frame, segment, self.map.world_from_cam(nearest), self.rng)
            if located is not None:
                self.map.place(frame, located[0].world_from_cam, segment, located[0].covariance)

    def _triangulate_all(self, segment: int, keyframes_only: bool) -> None:
        observations = self.map.observations
        rows = self.map.segment[observations.frame] == segment
        self.map.triangulate(segment, np.unique(observations.track[rows]), keyframes_only=keyframes_only)

    def _place(self, frame: int, segment: int, neighbour: int) -> bool:
        located = self.map.locate(frame, segment, self._predict(frame, neighbour), self.rng)
        if located is None:
            return False
        self.map.place(frame, located[0].world_from_cam, segment, located[0].covariance)
        if self.progress is not None:
            self.progress(int((self.map.segment >= 0).sum()))
        return True

    def _predict(self, frame: int, neighbour: int) -> SE3:
        """Constant velocity from the placed neighbour and the one before it; rotation by the gyro, if any."""
        step = 1 if frame > neighbour else -1
        start = self.map.world_from_cam(neighbour)
        earlier = neighbour - step
        stamps = self.map.observations.tracks.timestamps_ns
        motion = SE3.identity()
        if 0 <= earlier < len(stamps) and self.map.segment[earlier] == self.map.segment[neighbour]:
            ratio = (stamps[frame] - stamps[neighbour]) / (stamps[neighbour] - stamps[earlier])
            tangent = self.map.world_from_cam(earlier).local(start) * float(np.clip(ratio, 0.0, 5.0))
            motion = SE3.exp(tangent)
        if self.rotations is not None:
            turned = self.rotations[neighbour].T @ self.rotations[frame]
            motion = SE3(turned, motion.translation)
        return start * motion

    def _is_keyframe(self, frame: int, segment: int, last_keyframe: int) -> bool:
        observations = self.map.observations
        stamps = observations.tracks.timestamps_ns
        if abs(int(stamps[frame] - stamps[last_keyframe])) >= self.options.keyframe_interval_s * 1e9:
            return True
        before = len(self.map.known_rows(last_keyframe, segment))
        now = len(self.map.known_rows(frame, segment))
        if now < self.options.keyframe_fraction * before:
            return True
        a, b = observations.common(last_keyframe, frame)
        if len(a) < self.options.min_inliers:
            return True
        R = self.map.rotation[frame].T @ self.map.rotation[last_keyframe]
        parallax = rotation_compensated_parallax(R, observations.bearings[a], observations.bearings[b])
        return bool(np.median(parallax) > np.deg2rad(self.options.keyframe_parallax_deg))

    def result(self, seconds: float) -> OdometryResult:
        """Freeze the map."""
        return _result(self.map, self.segments, seconds)


def _result(visual_map: VisualMap, segments: int, seconds: float) -> OdometryResult:
    observations = visual_map.observations
    tracks: Tracks = observations.tracks
    placed = np.flatnonzero(visual_map.segment >= 0)
    in_time = np.cumsum(np.r_[0, np.diff(visual_map.segment[placed]) != 0])
    trajectory = Trajectory(
        tracks.camera,
        tracks.timestamps_ns[placed],
        visual_map.world_from_cam(placed),
        is_metric=False,
        segment_ids=in_time,
    )
    number_in_time = dict(zip(visual_map.segment[placed].tolist(), in_time.tolist(), strict=True))
    with_point = np.flatnonzero(visual_map.point_segment >= 0)
    landmarks = OdometryLandmarks(
        observations.track_ids[with_point],
        visual_map.points[with_point],
        np.array([number_in_time[s] for s in visual_map.point_segment[with_point].tolist()], dtype=np.int64),
    )
    inliers = np.zeros(len(tracks), dtype=bool)
    inliers[observations.given_rows] = visual_map.inlier
    observed = np.diff(observations.frame_starts) > 0
    counts = OdometryCounts(
        frames=observations.frames,
        placed=len(placed),
        keyframes=int(visual_map.keyframe.sum()),
        segments=segments,
        lost=int((observed & (visual_map.segment < 0)).sum()),
        empty=int((~observed).sum()),
        landmarks=len(landmarks),
        observations=len(observations.frame),
        inliers=int(inliers.sum()),
        inlier_rms_px=visual_map.inlier_rms_px(),
        seconds=seconds,
    )
    return OdometryResult(trajectory, placed, landmarks, inliers, counts)
