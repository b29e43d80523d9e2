"""Cameras at one height, for as long as nothing tells better.

On calm water a vessel turns about one axis, and nothing that one camera sees tells how high it sits: left free,
heights wander by metres. Landmarks seen by one camera are then looked for in others' images where they are not. Held
near one height, which is what decks do, they are found, and tell the heights themselves; then nothing is held.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake._types import Array
from rigwake.ba.solver.covariance import RigCovariance, covariance_of
from rigwake.ba.solver.rig_problem import BundleCamera, PosePrior, RigProblem
from rigwake.geometry.se3 import SE3

_UNKNOWN_M = 0.2  # a height less sure than this is held: landmarks would be looked for a degree away
_HELD_STD_M = 0.5


def with_height_prior(problem: RigProblem) -> RigProblem:
    """The problem with cameras whose height over the others is hardly known held near the height of the rig's origin.

    Unchanged where all heights are known to `_UNKNOWN_M`, or better by a prior.
    """
    up_rig = _up(problem)
    covariance = covariance_of(problem)
    cameras = tuple(
        _held(camera, up_rig) if _height_std(covariance, camera, up_rig) > _UNKNOWN_M else camera
        for camera in problem.cameras
    )
    return replace(problem, cameras=cameras) if cameras != problem.cameras else problem


def restore_priors(problem: RigProblem, before: RigProblem) -> RigProblem:
    """The problem with the priors that its cameras had before."""
    cameras = tuple(
        replace(camera, rig_from_cam_prior=former.rig_from_cam_prior)
        for camera, former in zip(problem.cameras, before.cameras, strict=True)
    )
    return replace(problem, cameras=cameras)


def _up(problem: RigProblem) -> Array:
    """(3,) the direction of up, averaged over the states, in rig axes."""
    up = problem.states.world_from_rig.rotation[:, 2].mean(axis=0)
    return np.asarray(up / np.linalg.norm(up))


def _height_std(covariance: RigCovariance, camera: BundleCamera, up_rig: Array) -> float:
    """Standard deviation of the camera's offset along up; infinite where nothing determines it."""
    if "rig_from_cam" not in camera.free:
        return 0.0
    along = up_rig @ camera.rig_from_cam.rotation @ covariance.rows_of(camera.name, "rig_from_cam")[3:]
    spread, observable = covariance.of(along)
    return float(np.sqrt(spread[0, 0])) if observable[0] else np.inf


def _held(camera: BundleCamera, up_rig: Array) -> BundleCamera:
    """The camera held near the rig's own height, unless it is known to sit elsewhere."""
    row = np.concatenate([np.zeros(3), up_rig @ camera.rig_from_cam.rotation]) / _HELD_STD_M
    known = camera.rig_from_cam_prior
    if known is not None and row @ known.information @ row * _HELD_STD_M**2 > 1 / _HELD_STD_M**2:
        return camera
    offset = camera.rig_from_cam.translation
    level = SE3(camera.rig_from_cam.rotation, offset - (up_rig @ offset) * up_rig)
    return replace(camera, rig_from_cam_prior=PosePrior(level, np.outer(row, row)))
