"""A first camera and first board poses, without any guess from the user.

Every focal length of a geometric grid is tried with an equidistant lens centred in the image; for each, the
board's pose in each view follows linearly from the bearings. The focal length whose poses explain the corners
best wins, and is refined together with the centre and two coefficients of a `kb4` lens, which comes close to
narrow and wide lenses alike. Other models start from their best approximation of it over the angles that the
corners reach.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake.cameras.model_fitting import convert_camera
from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.cameras.models.lens import Lens
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_class
from rigwake.errors import EstimationError
from rigwake.geometry.se3 import SE3, stack
from rigwake.intrinsics.board_adjustment import BoardEstimate, Corners, adjust, residuals
from rigwake.intrinsics.board_observations import BoardObservations, BoardView
from rigwake.intrinsics.board_pose import board_pose

_FOCAL_STEPS = 24
_FOCAL_RANGE = (0.12, 4.0)  # times the longer image side: from a lens of 270 deg to a long telephoto
_SWEEP_VIEWS = 12  # more views do not change which focal length wins


@dataclass(frozen=True, eq=False)
class BoardInitialGuess:
    """A first estimate and the views (indices) whose pose could be found."""

    estimate: BoardEstimate
    views: tuple[int, ...]


def initialise(observations: BoardObservations, model: str) -> BoardInitialGuess:
    """A first estimate with a camera of this model.

    Raises EstimationError if no focal length explains the views.
    """
    target = camera_class(model)
    simple = _equidistant_lens(observations)
    start = _with_poses(simple, observations)
    corners = stacked(observations.take(list(start.views)))
    # the centre and focal length first, then the distortion: from far away, distortion would absorb them
    estimate = start.estimate
    for names in (("fx", "fy"), ("fx", "fy", "cx", "cy"), ("fx", "fy", "cx", "cy", "k1", "k2")):
        free = np.array([name in names for name in simple.param_names])
        estimate, _ = adjust(estimate, corners, free, sigma_px=2.0, max_steps=15)
    camera = _as_model(estimate.camera, target, estimate, corners)
    return BoardInitialGuess(BoardEstimate(camera, estimate.cam_from_board), start.views)


def _as_model(
    simple: CameraModel, target: type[Lens], estimate: BoardEstimate, corners: Corners
) -> CameraModel:
    """The simple lens in another model, fitted as far off the axis as the corners reach."""
    if simple.model == target.model:
        return simple
    _, valid = residuals(estimate, corners)
    moved = estimate.cam_from_board[corners.view_index]
    rays = np.einsum("nij,nj->ni", moved.rotation, corners.points_board) + moved.translation
    angles = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])[valid]
    reach = min(float(angles.max()) * 1.02, simple.max_angle) if len(angles) else None
    converted = convert_camera(simple, target.model, reach).camera
    return target(tuple(converted.params.tolist()), simple.width_px, simple.height_px)


def _equidistant_lens(observations: BoardObservations) -> Lens:
    """The equidistant lens of the focal length that explains the views best."""
    longer = max(observations.width_px, observations.height_px)
    centre = (observations.width_px - 1) / 2, (observations.height_px - 1) / 2
    picked = np.linspace(0, len(observations.views) - 1, _SWEEP_VIEWS).round().astype(int)
    sample = observations.take(np.unique(picked))
    best, best_error = None, np.inf
    for focal in np.geomspace(*_FOCAL_RANGE, _FOCAL_STEPS) * longer:
        values = KannalaBrandt4.nominal_values(float(focal), *centre)
        candidate = KannalaBrandt4(values, observations.width_px, observations.height_px)
        error = float(np.median([_view_error(candidate, view) for view in sample.views]))
        if error < best_error:
            best, best_error = candidate, error
    if best is None:
        raise EstimationError(
            "No focal length explains the views of the board.",
            consequence="Not one view's corners fit a flat board.",
            remedy="Check the board's layout and size, and that it is flat.",
        )
    return best


def view_pose(camera: CameraModel, view: BoardView) -> SE3 | None:
    """The board's pose in one view from its bearings, or None if the lens sees too few of its corners."""
    bearings, valid = camera.unproject(view.pixels)
    if valid.sum() < 0.7 * len(view):
        return None
    return board_pose(view.points_board[valid], bearings[valid])


def _view_error(camera: CameraModel, view: BoardView) -> float:
    """Median distance in pixels after the linear pose, infinite if there is none."""
    cam_from_board = view_pose(camera, view)
    if cam_from_board is None:
        return np.inf
    projected, valid = camera.project(cam_from_board * view.points_board)
    distances = np.where(valid, np.linalg.norm(projected - view.pixels, axis=1), np.inf)
    return float(np.median(distances))


def _with_poses(camera: CameraModel, observations: BoardObservations) -> BoardInitialGuess:
    poses = [view_pose(camera, view) for view in observations.views]
    found = tuple(i for i, pose in enumerate(poses) if pose is not None)
    if not found:
        raise EstimationError("The board's pose could not be found in any view.")
    return BoardInitialGuess(
        BoardEstimate(camera, stack([pose for pose in poses if pose is not None])), found
    )


def stacked(observations: BoardObservations) -> Corners:
    """All corners of all views, all used."""
    counts = [len(view) for view in observations.views]
    return Corners(
        np.concatenate([view.points_board for view in observations.views]),
        np.concatenate([view.pixels for view in observations.views]),
        np.repeat(np.arange(len(counts)), counts),
        np.ones(sum(counts), dtype=np.bool_),
    )
