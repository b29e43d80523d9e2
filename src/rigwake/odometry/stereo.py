"""Stereo odometry: a second camera at a known place gives the scale, frame by frame and for the whole path.

Points of the first camera's tracks are found again in the second camera's image of the same moment, along the
epipolar great circle; both rays give the point in metres, and PnP on such points the motion. One adjustment of all
frames, with both cameras' observations, ends it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import (
    BundleCamera,
    Landmarks,
    Observations,
    RigProblem,
    SolverOptions,
    States,
)
from rigwake.errors import EstimationError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.geometry.triangulation import triangulate_rays
from rigwake.geometry.two_view import sampson_angles
from rigwake.odometry.indexed_tracks import index_observations, radians_per_pixel
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.odometry.visual_map import VisualMap
from rigwake.recording import CameraStream
from rigwake.tracking.klt import follow, pyramid
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_STD_PX = 0.3  # of a match between the two cameras, which is not registered as finely as a track
_WINDOW_PX, _LEVELS = 21, 4  # of the search
_CHAIN_STD_PX = 0.5
_MIN_DISPARITY_STDS = (
    15.0  # a point is placed if its disparity is so sure: nearer ones only would bias the scale
)
_SOLVER = SolverOptions(loss="cauchy", loss_scale=2.0, tolerance=1e-6, max_iterations=40)


@dataclass(frozen=True, eq=False)
class StereoMatches:
    """Where the second camera sees what the first one tracks: M rows like those of the tracks, NaN where not.

    pixels, bearings_cam: (M, 2), (M, 3) in the second camera. angle: (M,) from the epipolar circle, radians.
    """

    pixels: Array
    bearings_cam: Array
    angle: Array


def match_stereo(
    tracks: Tracks, first: CameraStream, second: CameraStream, second_from_first: SE3, *, gate_px: float = 1.0
) -> StereoMatches:
    """Follow every observation of the first camera into the second's image of the same stamp.

    The start of the search is where the point would be at infinity; a match must lie within `gate_px` of its
    epipolar circle and lead back to where it came from. Raises UsageError without models or common stamps.
    """
    if first.model is None or second.model is None:
        raise UsageError("Stereo odometry needs the intrinsics of both cameras.")
    pixels = np.full((len(tracks), 2), np.nan)
    rows_of = np.searchsorted(tracks.frame_indices, np.arange(len(tracks.timestamps_ns) + 1))
    common, in_first, in_second = np.intersect1d(
        first.timestamps_ns, second.timestamps_ns, assume_unique=True, return_indices=True
    )
    if not len(common):
        raise UsageError(
            f"{first.name} and {second.name} have no images with the same stamp.",
            remedy="Stereo odometry needs synchronised cameras.",
        )
    frame_of = {int(stamp): frame for frame, stamp in enumerate(tracks.timestamps_ns)}
    pairs = zip(first.frames(in_first), second.frames(in_second), strict=True)
    for one, other in pairs:
        frame = frame_of.get(one.timestamp_ns)
        if frame is None:
            continue
        rows = slice(int(rows_of[frame]), int(rows_of[frame + 1]))
        far, valid = second.model.project(tracks.bearings_cam[rows] @ second_from_first.rotation.T)
        landed, believed = _follow(one.image, other.image, tracks.pixels[rows], far, valid)
        pixels[rows][believed] = landed[believed]
    bearings, seen = second.model.unproject(pixels)
    unit = SE3(
        second_from_first.rotation,
        second_from_first.translation / np.linalg.norm(second_from_first.translation),
    )
    angle = np.full(len(tracks), np.inf)
    angle[seen] = sampson_angles(unit, tracks.bearings_cam[seen], bearings[seen])
    wrong = ~(angle <= gate_px * _gate(second, bearings, seen))
    pixels[wrong], bearings[wrong] = np.nan, np.nan
    return StereoMatches(pixels, bearings, angle)


def _gate(camera: CameraStream, bearings: Array, seen: NDArray[np.bool_]) -> Array:
    assert camera.model is not None
    out = np.zeros(len(bearings))
    out[seen] = radians_per_pixel(camera.model, bearings[seen])
    return out


def _follow(
    image: Image, other: Image, pixels: Array, far: Array, valid: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """Pyramidal Lucas-Kanade from one camera to the other, on contrast-normalised images, checked backwards."""
    equalise = cv2.createCLAHE(2.0, (8, 8)).apply
    start = np.where(valid[:, None], far, pixels)
    one, two = (pyramid(np.asarray(equalise(i), np.uint8), _WINDOW_PX, _LEVELS) for i in (image, other))
    landed, believed = follow(one, two, pixels, start, window_px=_WINDOW_PX, max_forward_backward_px=0.5)
    return landed, believed & valid


def estimate_stereo(
    tracks: Tracks,
    first: CameraStream,
    second: CameraStream,
    second_from_first: SE3,
    options: OdometryOptions | None = None,
) -> Trajectory:
    """Metric trajectory of the first camera, in its own first frame as the world.

    second_from_first: the pair's known mounting, metres. Raises EstimationError where a frame does not see enough
    points in both cameras, or the pair has no length.
    """
    options = options or OdometryOptions()
    if not np.linalg.norm(second_from_first.translation) > 0:
        raise EstimationError("The two cameras are in one place: they do not give a scale.")
    assert first.model is not None
    order = np.lexsort((tracks.track_ids, tracks.frame_indices))
    tracks = tracks.take(order)
    matches = match_stereo(tracks, first, second, second_from_first)
    # before bundle adjustment, points are as uncertain as their disparity, and pixels must not be trusted beyond that
    loose = replace(tracks, std_px=np.maximum(tracks.std_px, _CHAIN_STD_PX))
    visual_map = VisualMap(index_observations(loose, first.model), options)
    _chain(visual_map, matches, second_from_first)
    return _adjusted(visual_map, tracks, matches, first, second, second_from_first)


def _chain(visual_map: VisualMap, matches: StereoMatches, second_from_first: SE3) -> None:
    """Place frame after frame by PnP on points that both cameras saw in a frame before it."""
    observations = visual_map.observations
    rng = np.random.default_rng(visual_map.options.seed)
    visual_map.place(0, SE3.identity(), 0)
    _add_points(visual_map, matches, second_from_first, 0)
    motion = SE3.identity()
    for frame in range(1, observations.frames):
        before = visual_map.world_from_cam(frame - 1)
        located = visual_map.locate(frame, 0, before * motion, rng)
        if located is None:
            raise EstimationError(
                f"{observations.tracks.camera}: frame {frame} does not see enough points that both cameras saw.",
                remedy="Use monocular odometry, or a pair with more common view.",
            )
        world_from_cam = located[0].world_from_cam
        motion = before.inverse() * world_from_cam
        visual_map.place(frame, world_from_cam, 0, located[0].covariance)
        _add_points(visual_map, matches, second_from_first, frame)


def _add_points(visual_map: VisualMap, matches: StereoMatches, second_from_first: SE3, frame: int) -> None:
    """Points of the tracks that this frame sees in both cameras, have none yet, and whose disparity fixes one."""
    observations = visual_map.observations
    rows = np.arange(*observations.of_frame(frame).indices(len(observations.frame)))
    rows = rows[np.isfinite(matches.angle[rows]) & np.isfinite(matches.bearings_cam[rows]).all(axis=1)]
    rows = rows[visual_map.point_segment[observations.track[rows]] < 0]
    first_from_second = second_from_first.inverse()
    origins = np.zeros((2 * len(rows), 3))
    origins[1::2] = first_from_second.translation
    directions = np.empty_like(origins)
    directions[0::2] = observations.bearings[rows]
    directions[1::2] = matches.bearings_cam[rows] @ first_from_second.rotation.T
    found = triangulate_rays(origins, directions, np.arange(0, 2 * len(rows) + 1, 2))
    good = found.accepted(0.0, np.inf)
    good &= found.max_parallax > _MIN_DISPARITY_STDS * _STD_PX * observations.rad_per_px[rows]
    tracks = observations.track[rows[good]]
    visual_map.points[tracks] = visual_map.world_from_cam(frame) * found.points[good]
    visual_map.point_segment[tracks] = 0


def _adjusted(
    visual_map: VisualMap,
    tracks: Tracks,
    matches: StereoMatches,
    first: CameraStream,
    second: CameraStream,
    second_from_first: SE3,
) -> Trajectory:
    """All frames and points together, seen by both cameras, whose places on the rig are held."""
    assert first.model is not None
    assert second.model is not None
    observations = visual_map.observations
    rows = np.flatnonzero(visual_map.point_segment[observations.track] == 0)
    rows = rows[visual_map.agree(rows, visual_map.points[observations.track[rows]], tolerance=2.0)]
    both = rows[np.isfinite(matches.bearings_cam[rows]).all(axis=1)]
    used, landmark = np.unique(observations.track[np.concatenate([rows, both])], return_inverse=True)
    stamps = tracks.timestamps_ns
    points = visual_map.points[used]
    fixed = np.zeros(observations.frames, dtype=bool)
    fixed[0] = True
    problem = RigProblem(
        States(stamps, visual_map.world_from_cam(np.arange(observations.frames)), fixed=fixed),
        (
            BundleCamera(first.name, first.model, SE3.identity()),
            BundleCamera(second.name, second.model, second_from_first.inverse()),
        ),
        Landmarks.from_points(points, np.zeros(3)),
        Observations(
            np.repeat([0, 1], [len(rows), len(both)]),
            stamps[observations.frame[np.concatenate([rows, both])]],
            landmark.astype(np.int64),
            np.concatenate([tracks.pixels[rows], matches.pixels[both]]),
            np.concatenate([tracks.std_px[rows], np.full(len(both), _STD_PX)]),
        ),
    )
    solution = solve(problem, _SOLVER)
    return Trajectory(tracks.camera, stamps, solution.problem.states.world_from_rig)
