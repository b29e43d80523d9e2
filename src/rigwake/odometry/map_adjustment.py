"""Bundle adjustment of the visual map: of a window while it grows, of everything when it has grown."""

from __future__ import annotations

import numpy as np

from rigwake._types import Indices, Mask
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import (
    BundleCamera,
    DistanceMeasurement,
    Landmarks,
    Observations,
    RigProblem,
    SolverOptions,
    States,
)
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError
from rigwake.geometry.se3 import SE3
from rigwake.odometry.visual_map import VisualMap

_ALL = SolverOptions(loss="cauchy", loss_scale=2.0, tolerance=1e-4, max_iterations=12)
_WINDOW = SolverOptions(loss="cauchy", loss_scale=2.0, tolerance=1e-3, max_iterations=6)


def adjust_all(visual_map: VisualMap, camera: CameraModel, segment: int, *, keyframes_only: bool) -> None:
    """Adjust all frames (or keyframes) and points of a segment; one frame and one distance are held."""
    chosen = visual_map.segment == segment
    if keyframes_only:
        chosen &= visual_map.keyframe
    frames = np.flatnonzero(chosen)
    held = np.zeros(len(frames), dtype=bool)
    held[0] = True
    _adjust(visual_map, camera, segment, frames, held, _ALL)


def adjust_window(visual_map: VisualMap, camera: CameraModel, segment: int, newest: int) -> None:
    """Adjust the newest keyframe and its neighbours; as many keyframes beyond them are held where they are."""
    width = visual_map.options.window
    keyframes = np.flatnonzero((visual_map.segment == segment) & visual_map.keyframe)
    near = keyframes[np.argsort(np.abs(keyframes - newest), kind="stable")[: 2 * width]]
    frames = np.sort(near)
    anchors = near[width:] if len(near) > width + 1 else near[-2:]
    _adjust(visual_map, camera, segment, frames, np.isin(frames, anchors), _WINDOW)


def _adjust(
    visual_map: VisualMap,
    camera: CameraModel,
    segment: int,
    frames: Indices,
    held: Mask,
    options: SolverOptions,
) -> None:
    rows = _rows_of(visual_map, segment, frames)
    if len(rows) == 0:
        return
    tracks, landmark = np.unique(visual_map.observations.track[rows], return_inverse=True)
    problem = _problem(visual_map, camera, frames, held, rows, tracks, landmark)
    try:
        solution = solve(problem, options)
    except EstimationError:
        return  # the map stays as it was: PnP and triangulation alone carry on
    states = solution.problem.states.world_from_rig
    visual_map.rotation[frames], visual_map.centre[frames] = states.rotation, states.translation
    visual_map.points[tracks] = solution.problem.landmarks.points_world


def _rows_of(visual_map: VisualMap, segment: int, frames: Indices) -> Indices:
    """Observations that take part: of these frames, of points at least two of them see, within twice the gate."""
    observations = visual_map.observations
    slices = [np.arange(*observations.of_frame(int(f)).indices(len(observations.frame))) for f in frames]
    rows = np.concatenate(slices)
    rows = rows[visual_map.point_segment[observations.track[rows]] == segment]
    rows = rows[visual_map.agree(rows, visual_map.points[observations.track[rows]], tolerance=2.0)]
    counts = np.bincount(observations.track[rows], minlength=len(visual_map.points))
    return rows[counts[observations.track[rows]] >= 2]


def _problem(
    visual_map: VisualMap,
    camera: CameraModel,
    frames: Indices,
    held: Mask,
    rows: Indices,
    tracks: Indices,
    landmark: Indices,
) -> RigProblem:
    observations = visual_map.observations
    given = observations.tracks
    first_row = np.full(len(tracks), len(rows))
    np.minimum.at(first_row, landmark, np.arange(len(rows)))
    anchors = visual_map.centre[observations.frame[rows[first_row]]]
    stamps = given.timestamps_ns
    return RigProblem(
        States(stamps[frames], visual_map.world_from_cam(frames), fixed=held),
        (BundleCamera(given.camera, camera, SE3.identity()),),
        Landmarks.from_points(visual_map.points[tracks], anchors),
        Observations(
            np.zeros(len(rows), dtype=np.int64),
            stamps[observations.frame[rows]],
            landmark.astype(np.int64),
            given.pixels[rows],
            given.std_px[rows],
        ),
        distances=_scale(visual_map, frames, held),
    )


def _scale(visual_map: VisualMap, frames: Indices, held: Mask) -> tuple[DistanceMeasurement, ...]:
    """Holds the unit of length where a single held frame does not: at the frame farthest from it."""
    if held.sum() > 1:
        return ()
    origin = int(np.flatnonzero(held)[0])
    distances = np.linalg.norm(visual_map.centre[frames] - visual_map.centre[frames[origin]], axis=1)
    farthest = int(np.argmax(distances))
    length = float(distances[farthest])
    return (DistanceMeasurement(origin, farthest, length, 1e-4 * length),) if length > 0 else ()
