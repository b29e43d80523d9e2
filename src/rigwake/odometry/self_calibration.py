"""Distortion and principal point refined from one camera's own motion.

A lens that is described half a pixel wrong looks well in every image and still ruins monocular scale: in a turn the
scale is handed on by points that cross the whole image, and a systematic error of their bearings is the same in
every frame. KITTI's rectified images are a known case (Cvisic, Markovic and Petrovic, *Recalibrating the KITTI
Dataset Camera Setup for Improved Odometry Accuracy*, 2021).

The focal length is held: how far a camera turns tells it only where it turns full circle; over less it trades
against distortion and takes the rotations along.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import (
    BundleCamera,
    DistanceMeasurement,
    Landmarks,
    Observations,
    RigProblem,
    SolverOptions,
    States,
    VectorPrior,
)
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import RigwakeError
from rigwake.geometry.se3 import SE3
from rigwake.odometry.result import OdometryResult
from rigwake.tracks import Tracks

_FOCAL = frozenset({"fx", "fy", "f", "a0"})
_PRIOR_PX = 1.0  # each parameter alone is believed to be so right, over the pixels that were observed
_MAX_FRAMES = 150
_MIN_GAIN = 0.03  # of the cost, under which the lens is right as given
_MIN_LATER_GAIN = 0.01
_MAX_ROUNDS = 4
_MIN_VIEWS = 3
_HELD_STD = 1e-9
_SOLVER = SolverOptions(loss="cauchy", loss_scale=2.0, tolerance=1e-5, max_iterations=20)
# centre and decentring creep along a valley
_LENS_SOLVER = replace(_SOLVER, tolerance=1e-7, max_iterations=60)


@dataclass(frozen=True, eq=False)
class RefinedLens:
    """A lens that explains the tracks better than the one given.

    tracks: the given ones, with bearings by this lens. shift_px: root mean square by which it moves what was
    observed. gain: fraction of the bundle adjustment's cost that it took away.
    """

    camera: CameraModel
    tracks: Tracks
    shift_px: float
    gain: float


def estimate_refining_lens(
    tracks: Tracks, camera: CameraModel, estimate: Callable[[Tracks, CameraModel], OdometryResult]
) -> tuple[OdometryResult, RefinedLens | None]:
    """Odometry and, where the lens given does not fit, a better lens: in turns, until it changes no more.

    estimate: odometry from tracks and their camera. A wrong lens bends the path, and a bent path hides how wrong
    the lens is: hence several rounds.
    """
    visual, lens = estimate(tracks, camera), None
    for _ in range(_MAX_ROUNDS):
        now = (tracks, camera) if lens is None else (lens.tracks, lens.camera)
        min_gain = _MIN_GAIN if lens is None else _MIN_LATER_GAIN
        better = refine_lens(*now, visual, believed=camera, min_gain=min_gain)
        if better is None:
            break
        gain = better.gain if lens is None else 1 - (1 - lens.gain) * (1 - better.gain)
        lens = replace(better, gain=gain, shift_px=_shift_px(camera, better.tracks))
        visual = estimate(lens.tracks, lens.camera)
    return visual, lens


def refine_lens(
    tracks: Tracks,
    camera: CameraModel,
    visual: OdometryResult,
    *,
    believed: CameraModel | None = None,
    min_gain: float = _MIN_GAIN,
) -> RefinedLens | None:
    """Distortion and principal point estimated with motion and points of the longest segment.

    None where that lowers the bundle adjustment's cost by less than `min_gain`, or where it cannot be estimated.
    Every free parameter has a prior about the lens `believed` (`camera`, unless given): alone, it moves the observed
    pixels by one (root mean square).
    """
    problem = _problem(tracks, camera, visual)
    if problem is None:
        return None
    try:
        held = solve(problem, _SOLVER).report.final_cost
        solution = solve(_with_free_lens(problem, believed or camera), _LENS_SOLVER)
        refined = solution.problem.cameras[0].model
        bearings, seen = refined.unproject(tracks.pixels)
    except RigwakeError:  # a lens beyond its bounds, or too little to adjust: the one given stays
        return None
    gain = 1.0 - solution.report.final_cost / held
    if gain < min_gain or not seen.all():
        return None
    seen_anew = replace(tracks, bearings_cam=bearings)
    return RefinedLens(refined, seen_anew, _shift_px(camera, seen_anew), float(gain))


def _shift_px(camera: CameraModel, tracks: Tracks) -> float:
    """Root mean square by which this camera would see the bearings of the tracks elsewhere than they were seen."""
    moved, valid = camera.project(tracks.bearings_cam)
    return float(np.sqrt(np.mean(np.sum((moved[valid] - tracks.pixels[valid]) ** 2, axis=1))))


def _problem(tracks: Tracks, camera: CameraModel, visual: OdometryResult) -> RigProblem | None:
    """Evenly spread frames of the longest segment, what they see, and the lens held."""
    path = visual.trajectory
    assert path.segment_ids is not None
    longest = int(np.argmax(np.bincount(path.segment_ids)))
    members = np.flatnonzero(path.segment_ids == longest)
    members = members[:: -(-len(members) // _MAX_FRAMES)]
    frames = visual.frame_indices[members]
    ids = visual.landmarks.track_ids[visual.landmarks.segment_ids == longest]
    points = visual.landmarks.points_world[visual.landmarks.segment_ids == longest]
    rows = np.flatnonzero(
        visual.inliers & np.isin(tracks.frame_indices, frames) & np.isin(tracks.track_ids, ids)
    )
    owner = np.searchsorted(ids, tracks.track_ids[rows])
    enough = np.bincount(owner, minlength=len(ids))[owner] >= _MIN_VIEWS
    rows, owner = rows[enough], owner[enough]
    if len(members) < _MIN_VIEWS or not len(rows):
        return None
    used, first, landmark = np.unique(owner, return_index=True, return_inverse=True)
    poses = path.world_from_body[members]
    at = np.searchsorted(frames, tracks.frame_indices[rows])
    span = np.linalg.norm(poses.translation - poses.translation[0], axis=1)
    farthest = int(np.argmax(span))
    if not span[farthest] > 0:
        return None
    fixed = np.zeros(len(members), dtype=bool)
    fixed[0] = True
    stamps = tracks.timestamps_ns[frames]
    return RigProblem(
        States(stamps, poses, fixed=fixed),
        (BundleCamera(tracks.camera, camera, SE3.identity()),),
        Landmarks.from_points(points[used], poses.translation[at[first]]),
        Observations(
            np.zeros(len(rows), dtype=np.int64),
            stamps[at],
            landmark,
            tracks.pixels[rows],
            tracks.std_px[rows],
        ),
        distances=(DistanceMeasurement(0, farthest, float(span[farthest]), 1e-4 * float(span[farthest])),),
    )


def _with_free_lens(problem: RigProblem, believed: CameraModel) -> RigProblem:
    """The same with distortion and principal point free, each believed to be as in `believed` within one pixel."""
    camera = problem.cameras[0]
    lens = camera.model
    bearings, seen = lens.unproject(problem.observations.pixels)
    effect = lens.project_with_jacobians(bearings[seen]).d_params
    px_per_unit = np.sqrt(np.mean(np.sum(effect**2, axis=1), axis=0))
    held = _FOCAL | set(getattr(lens, "fixed_by_default", ()))
    std = np.array(
        [
            _PRIOR_PX / px if name not in held and px > 0 else _HELD_STD
            for name, px in zip(lens.param_names, px_per_unit, strict=True)
        ]
    )
    prior = VectorPrior.from_std(believed.params, std)
    return replace(
        problem, cameras=(replace(camera, free=frozenset({"intrinsics"}), intrinsics_prior=prior),)
    )
