"""Joint refinement of one camera's parameters and of the board's pose in every view.

The normal equations have the shape of an arrow: each view's six unknowns meet only the camera's. Views are
eliminated by the Schur complement, so that the cost grows with the number of views, not with its cube.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Mask
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3

_HUBER = 2.0  # in standard deviations: 95 % efficient for a two-dimensional normal residual
_INVALID_PX = 200.0  # what a corner costs that the lens cannot see, so that steps which regain it are taken


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of all views, one after the other.

    points_board (N, 3), pixels (N, 2), view_index (N,) non-decreasing, used (N,): false for outliers.
    """

    points_board: Array
    pixels: Array
    view_index: NDArray[np.int64]
    used: Mask

    @property
    def slices(self) -> list[slice]:
        """Rows of each view."""
        ends = np.cumsum(np.bincount(self.view_index)).tolist()
        return [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]


@dataclass(frozen=True, eq=False)
class BoardEstimate:
    """A camera and the board's poses `cam_from_board` (V,)."""

    camera: CameraModel
    cam_from_board: SE3


@dataclass(frozen=True, eq=False)
class BoardNormalEquations:
    """Blocks of `J^T W J`: camera (P, P), coupling (V, P, 6), views (V, 6, 6), and of `J^T W r` likewise."""

    camera: Array
    coupling: Array
    views: Array
    camera_gradient: Array
    view_gradients: Array

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """The Schur complement on the camera, its right-hand side, and `views^-1 coupling^T` (V, 6, P)."""
        diagonal = np.einsum("vii->vi", self.views)
        views = self.views + damping * np.einsum("vi,ij->vij", diagonal + 1e-12, np.eye(6))
        right = np.concatenate([np.swapaxes(self.coupling, 1, 2), self.view_gradients[..., None]], axis=2)
        solved: Array = np.linalg.solve(views, right)
        camera = self.camera + damping * np.diag(np.diag(self.camera) + 1e-12)
        S: Array = camera - np.einsum("vpi,viq->pq", self.coupling, solved[..., :-1])
        g: Array = self.camera_gradient - np.einsum("vpi,vi->p", self.coupling, solved[..., -1])
        return S, g, solved

    def step(self, damping: float) -> tuple[Array, Array]:
        """Steps of the camera's free parameters (P,) and of the poses (V, 6)."""
        S, g, solved = self.reduced(damping)
        camera = np.asarray(-np.linalg.solve(S, g), dtype=np.float64)
        return camera, -solved[..., -1] - np.einsum("vip,p->vi", solved[..., :-1], camera)


def residuals(estimate: BoardEstimate, corners: Corners) -> tuple[Array, Mask]:
    """Projected minus observed pixels (N, 2), zero where not valid, and validity (N,)."""
    projected, valid = estimate.camera.project(_points_cam(estimate, corners))
    return np.where(valid[:, None], projected - corners.pixels, 0.0), valid


def _points_cam(estimate: BoardEstimate, corners: Corners) -> Array:
    moved = estimate.cam_from_board[corners.view_index]
    return np.asarray(np.einsum("nij,nj->ni", moved.rotation, corners.points_board) + moved.translation)


def cost_of(estimate: BoardEstimate, corners: Corners, sigma_px: float | None) -> float:
    """Half the sum of squares, or Huber's loss where `sigma_px` is given, over used corners."""
    r, valid = residuals(estimate, corners)
    norms = np.where(valid, np.linalg.norm(r, axis=1), _INVALID_PX)[corners.used]
    if sigma_px is None:
        return float(0.5 * np.sum(norms**2))
    knee = _HUBER * sigma_px
    return float(np.sum(np.where(norms <= knee, 0.5 * norms**2, knee * (norms - 0.5 * knee))))


def linearise(
    estimate: BoardEstimate, corners: Corners, free: Mask, sigma_px: float | None
) -> BoardNormalEquations:
    """Normal equations of the (robust) least squares at the estimate.

    With `X = R P + t`, a right perturbation of `cam_from_board` moves X by `R (v - P x w)`.
    """
    J_camera, J_view, r = _jacobians(estimate, corners, free)
    if sigma_px is not None:
        weights = np.minimum(1.0, _HUBER * sigma_px / np.maximum(np.linalg.norm(r, axis=1), 1e-12))
        root = np.sqrt(weights)[:, None, None]
        J_camera, J_view, r = J_camera * root, J_view * root, r * root[..., 0]
    slices, count = corners.slices, int(free.sum())
    flat = J_camera.reshape(2 * len(r), count)
    coupling, views = np.empty((len(slices), count, 6)), np.empty((len(slices), 6, 6))
    view_gradients = np.empty((len(slices), 6))
    for v, rows in enumerate(slices):
        J6, JP, rv = J_view[rows].reshape(-1, 6), flat[2 * rows.start : 2 * rows.stop], r[rows].ravel()
        views[v], coupling[v], view_gradients[v] = J6.T @ J6, JP.T @ J6, J6.T @ rv
    return BoardNormalEquations(flat.T @ flat, coupling, views, flat.T @ r.ravel(), view_gradients)


def camera_sensitivities(estimate: BoardEstimate, corners: Corners, free: Mask) -> tuple[Array, Array]:
    """Jacobians (N, 2, P) of the residuals by the free camera parameters once the poses follow, and the residuals
    (N, 2); zero for corners that are not used."""
    J_camera, J_view, r = _jacobians(estimate, corners, free)
    follow = linearise(estimate, corners, free, None).reduced()[2][:, :, :-1]
    return np.asarray(J_camera - J_view @ follow[corners.view_index]), r


def _jacobians(estimate: BoardEstimate, corners: Corners, free: Mask) -> tuple[Array, Array, Array]:
    """Of the residuals (N, 2) by free camera parameters (N, 2, P) and by the pose (N, 2, 6), and the residuals
    themselves; zero for corners that are not used or not seen."""
    projection = estimate.camera.project_with_jacobians(_points_cam(estimate, corners))
    counts = (corners.used & projection.valid)[:, None, None]
    by_translation = projection.d_point @ estimate.cam_from_board.rotation[corners.view_index]
    by_rotation = -by_translation @ so3.hat(corners.points_board)
    J_view = np.concatenate([by_rotation, by_translation], axis=2)
    r = projection.pixels - corners.pixels
    return (
        np.where(counts, projection.d_params[:, :, free], 0.0),
        np.where(counts, J_view, 0.0),
        np.where(counts[..., 0], r, 0.0),
    )


def _moved(
    estimate: BoardEstimate, free: Mask, camera_step: Array, view_steps: Array
) -> BoardEstimate | None:
    values = estimate.camera.params
    values[free] += camera_step
    try:
        camera = estimate.camera.with_params(values)
    except CameraError:  # the step left what the model can be: a shorter one is tried next
        return None
    return BoardEstimate(camera, estimate.cam_from_board.retract(view_steps))


def adjust(
    estimate: BoardEstimate, corners: Corners, free: Mask, sigma_px: float | None = None, max_steps: int = 50
) -> tuple[BoardEstimate, bool]:
    """Levenberg-Marquardt over the free camera parameters and all poses; and whether it converged.

    sigma_px: expected standard deviation of a pixel coordinate: residuals beyond twice that count linearly
    (Huber); None for plain least squares.
    """
    cost, damping = cost_of(estimate, corners, sigma_px), 1e-4
    for _ in range(max_steps):
        equations = linearise(estimate, corners, free, sigma_px)
        while True:
            try:
                candidate = _moved(estimate, free, *equations.step(damping))
            except np.linalg.LinAlgError:  # singular without more damping
                candidate = None
            candidate_cost = np.inf if candidate is None else cost_of(candidate, corners, sigma_px)
            if candidate_cost <= cost:
                break
            damping *= 8
            if damping > 1e10:
                return estimate, True  # no direction improves any more
        assert candidate is not None
        gain, cost, estimate = cost - candidate_cost, candidate_cost, candidate
        damping = max(damping / 8, 1e-12)
        if gain <= 1e-10 * cost + 1e-20:
            return estimate, True
    return estimate, False
