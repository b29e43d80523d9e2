"""Intrinsic calibration: from corners to a camera, its covariance, and what was left out and why."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array, Indices, Mask
from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_class
from rigwake.errors import EstimationError, UnobservableError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.intrinsics.board_adjustment import (
    BoardEstimate,
    Corners,
    adjust,
    camera_sensitivities,
    linearise,
    residuals,
)
from rigwake.intrinsics.board_observations import BoardObservations
from rigwake.intrinsics.initial_guess import initialise, stacked

MIN_VIEWS = 3
_ROBUST_ROUNDS = 4
_OUTLIER_SIGMAS = 5.0  # one in 270 000 good corners lies beyond
_OUTLIER_VIEW = 3.0  # a view whose median residual is that many times the typical view's
_MEDIAN_OF_RAYLEIGH = 1.1774  # median length of a 2-D normal vector of unit standard deviation
_PARALLEL = np.deg2rad(4.0)
_POOR_FIT_PX = 3.0
_FOCAL_TOLERANCE = 0.02
_RANK_TOLERANCE = 1e-11
_NULL_FRACTION = 1e-3
_LEAST_FREEDOM = 0.05  # of a direction that a single view determines nearly alone: its residuals say nothing


@dataclass(frozen=True, eq=False)
class IntrinsicCalibration:
    """A calibrated camera: answer and uncertainty.

    camera: the lens. covariance: (P, P) of `camera.params`; zero for fixed parameters, infinite on the
    diagonal of unobservable ones. fixed, unobservable: names of parameters. cam_from_board: pose per kept view.
    view_names: kept views. residuals_px: (N, 2) projected minus observed, corners (N): what was seen, with
    `used` false for dropped corners. sigma_px: standard deviation of a pixel coordinate, from the residuals.
    rms_px: root mean square distance of used corners. dropped_views: names and reasons.
    max_observed_angle: radians off the axis of the farthest used corner. widening: by what the covariance is
    larger than with independent corners, because errors are shared within views and by the board's corners.
    axis_focal_std_px: standard deviation of the pixels per radian at the axis.
    """

    camera: CameraModel
    covariance: Array
    fixed: tuple[str, ...]
    unobservable: tuple[str, ...]
    cam_from_board: SE3
    view_names: tuple[str, ...]
    corners: Corners
    residuals_px: Array
    sigma_px: float
    rms_px: float
    dropped_views: tuple[tuple[str, str], ...]
    max_observed_angle: float
    widening: float
    axis_focal_std_px: float
    converged: bool

    @property
    def stds(self) -> dict[str, float]:
        """Standard deviation by parameter name; zero if fixed, infinite if unobservable."""
        values = np.sqrt(np.diag(self.covariance)).tolist()
        return dict(zip(self.camera.param_names, values, strict=True))

    @property
    def dropped_corners(self) -> int:
        """Corners left out of kept views."""
        return int((~self.corners.used).sum())


def calibrate(
    observations: BoardObservations,
    model: str,
    *,
    fix: Iterable[str] = (),
    free: Iterable[str] = (),
    max_angle: float | None = None,
) -> IntrinsicCalibration:
    """Camera of this model from views of a board, without an initial guess.

    fix, free: names of parameters to hold at their starting values, or to estimate although they are fixed by
    default. max_angle: where the lens ends (radians), if known.

    Raises EstimationError if there are too few views or the board does not fit, UnobservableError if the
    views cannot tell the focal length, UsageError for unknown parameter names, CameraError for an unknown
    model or a max_angle that the result cannot represent.
    """
    if len(observations.views) < MIN_VIEWS:
        raise _too_few_views(observations)
    start = initialise(observations, model)
    mask = _free_mask(start.estimate.camera, fix, free)
    used = observations.take(list(start.views))
    failed = set(range(len(observations.views))) - set(start.views)
    dropped = [(observations.views[i].name, "no pose explains its corners") for i in sorted(failed)]
    _refuse_parallel(start.estimate.cam_from_board)
    estimate, corners, used, outliers = _robust(start.estimate, used, mask)
    if len(used.views) < MIN_VIEWS:
        raise _too_few_views(used)
    estimate, converged = adjust(estimate, corners, mask, max_steps=100)
    result = _summary(estimate, corners, mask, used, tuple(dropped + outliers), converged)
    if max_angle is not None:
        result = replace(result, camera=_limited(result.camera, max_angle))
    _refuse_poor_fit(result)
    _refuse_unknown_focal(result)
    return result


def _too_few_views(observations: BoardObservations) -> EstimationError:
    return EstimationError(
        f"The board was found in {len(observations.views)} usable views; {MIN_VIEWS} are the least, 20 are good.",
        consequence="A single view cannot tell a longer lens from a farther board.",
        remedy="Record more images, with the board tilted and in every part of the image.",
    )


def _free_mask(camera: CameraModel, fix: Iterable[str], free: Iterable[str]) -> Mask:
    fixed = (set(camera_class(camera.model).fixed_by_default) | set(fix)) - set(free)
    unknown = (set(fix) | set(free)) - set(camera.param_names)
    if unknown:
        raise UsageError(
            f"{camera.model} has no parameter {', '.join(sorted(unknown))}.",
            remedy=f"It has: {', '.join(camera.param_names)}.",
        )
    return np.array([name not in fixed for name in camera.param_names])


def _refuse_parallel(cam_from_board: SE3) -> None:
    normals = cam_from_board.rotation[:, :, 2]
    spread = np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))
    if spread < _PARALLEL:
        raise UnobservableError(
            f"All views show the board at the same tilt, within {np.rad2deg(spread):.1f} deg.",
            consequence="A longer focal length and a farther board look alike then.",
            remedy="Tilt the board by 30 to 45 deg in different directions and record again.",
        )


def _robust(
    estimate: BoardEstimate, observations: BoardObservations, free: Mask
) -> tuple[BoardEstimate, Corners, BoardObservations, list[tuple[str, str]]]:
    """Rounds of Huber's loss with the noise re-estimated; then outlier views and corners are left out."""
    corners, sigma = stacked(observations), 2.0
    for _ in range(_ROBUST_ROUNDS):
        estimate, _ = adjust(estimate, corners, free, sigma_px=sigma, max_steps=40)
        sigma = _noise(estimate, corners)
    lengths = _lengths(estimate, corners)
    medians = np.array([np.median(lengths[rows]) for rows in corners.slices])
    typical = float(np.median(medians))
    keep = np.flatnonzero(medians <= _OUTLIER_VIEW * typical)
    outliers = [
        (observations.views[v].name, f"median residual {medians[v]:.2f} px, typical is {typical:.2f} px")
        for v in np.flatnonzero(medians > _OUTLIER_VIEW * typical)
    ]
    kept = observations.take(keep)
    estimate = BoardEstimate(estimate.camera, estimate.cam_from_board[keep])
    corners = stacked(kept)
    estimate, _ = adjust(estimate, corners, free, sigma_px=sigma, max_steps=40)
    sigma = _noise(estimate, corners)
    inliers = _lengths(estimate, corners) <= _OUTLIER_SIGMAS * sigma
    return estimate, replace(corners, used=inliers), kept, outliers


def _lengths(estimate: BoardEstimate, corners: Corners) -> Array:
    r, valid = residuals(estimate, corners)
    return np.where(valid, np.linalg.norm(r, axis=1), np.inf)


def _noise(estimate: BoardEstimate, corners: Corners) -> float:
    """Robust standard deviation of a pixel coordinate; never below what a float image can tell."""
    return max(float(np.median(_lengths(estimate, corners))) / _MEDIAN_OF_RAYLEIGH, 1e-6)


def _summary(
    estimate: BoardEstimate,
    corners: Corners,
    free: Mask,
    observations: BoardObservations,
    dropped: tuple[tuple[str, str], ...],
    converged: bool,
) -> IntrinsicCalibration:
    r, valid = residuals(estimate, corners)
    used = corners.used & valid
    squares = float(np.sum(r[used] ** 2))
    unknowns = int(free.sum()) + 6 * len(observations.views)
    if 2 * used.sum() <= unknowns:
        raise EstimationError(f"{used.sum()} corners cannot determine {unknowns} unknowns.")
    variance = squares / (2 * used.sum() - unknowns)
    corners = replace(corners, used=used)
    information = _Information.of(linearise(estimate, corners, free, None).reduced()[0], variance)
    widening = _shared_errors(information, *camera_sensitivities(estimate, corners, free), corners)
    information = replace(information, variance=variance * widening)
    block, lost = information.covariance()
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = block
    focal_gradient = _axis_focal_gradient(estimate.camera, free, information.scale)
    names = estimate.camera.param_names
    moved = estimate.cam_from_board[corners.view_index]
    rays = np.einsum("nij,nj->ni", moved.rotation, corners.points_board) + moved.translation
    angles = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    return IntrinsicCalibration(
        camera=estimate.camera,
        covariance=covariance,
        fixed=tuple(name for name, is_free in zip(names, free, strict=True) if not is_free),
        unobservable=tuple(np.array(names)[free][lost].tolist()),
        axis_focal_std_px=information.std_along(focal_gradient),
        cam_from_board=estimate.cam_from_board,
        view_names=tuple(view.name for view in observations.views),
        corners=corners,
        residuals_px=r,
        sigma_px=float(np.sqrt(variance)),
        rms_px=float(np.sqrt(squares / used.sum())),
        dropped_views=dropped,
        max_observed_angle=float(angles[used].max()),
        widening=widening,
        converged=converged,
    )


@dataclass(frozen=True, eq=False)
class _Information:
    """Eigenvectors of the camera's information, scaled to unit diagonal; directions that the views do not
    determine (its null space) are told apart."""

    scale: Array
    eigenvalues: Array
    vectors: Array
    variance: float

    @classmethod
    def of(cls, information: Array, variance: float) -> _Information:
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        return cls(scale, *np.linalg.eigh(information / np.outer(scale, scale)), variance)

    @property
    def known(self) -> Mask:
        """(P,) which eigenvectors are determined."""
        return np.asarray(self.eigenvalues > _RANK_TOLERANCE)

    def covariance(self) -> tuple[Array, Mask]:
        """Covariance with an infinite diagonal where a parameter reaches into the null space, and which."""
        known = self.known
        inverse = (self.vectors[:, known] / self.eigenvalues[known]) @ self.vectors[:, known].T
        block = self.variance * inverse / np.outer(self.scale, self.scale)
        lost = (self.vectors[:, ~known] ** 2).sum(axis=1) > _NULL_FRACTION
        block[lost, :] = 0.0
        block[:, lost] = 0.0
        block[lost, lost] = np.inf
        return block, lost

    def std_along(self, gradient: Array) -> float:
        """Standard deviation of a function of the parameters; infinite if the null space moves it."""
        along = (gradient / self.scale) @ self.vectors
        if np.sum(along[~self.known] ** 2) > _NULL_FRACTION * np.sum(along**2):
            return float(np.inf)
        return float(np.sqrt(self.variance * np.sum(along[self.known] ** 2 / self.eigenvalues[self.known])))


def _shared_errors(
    information: _Information, jacobians: Array, residuals_px: Array, corners: Corners
) -> float:
    """How much larger the variance of the camera's parameters is than independent corners make it, at least 1.

    The scatter of the scores' sums over views (blur, what the model misses) and over the board's corners (a board
    that is not flat, a print that is not to scale), less what single corners explain: the two-way cluster-robust
    covariance of Cameron, Gelbach and Miller (2011), as a mean over all determined directions.
    """
    known = information.known
    whitening = information.vectors[:, known] / np.sqrt(information.eigenvalues[known] * information.variance)
    whitened = (jacobians[corners.used] / information.scale) @ whitening
    scores = np.einsum("nap,na->np", whitened, residuals_px[corners.used])
    corner = np.unique(corners.points_board, axis=0, return_inverse=True)[1].ravel()
    scatter = -float(np.sum(scores**2))
    for cluster in (corners.view_index[corners.used], corner[corners.used]):
        scatter += _scatter_of_sums(whitened, scores, cluster, information.variance)
    return max(scatter / scores.shape[1], 1.0)


def _scatter_of_sums(whitened: Array, scores: Array, cluster: Indices, variance: float) -> float:
    """Sum of the squared sums of scores (N, P) over each cluster, each made larger by what the fit took from it.

    A view that holds a large part of all information pulls the estimate towards its own errors, so that its residuals
    are too small: its score has the covariance `A - A A`, not `A`, its part of the whitened information. Multiplying
    by `(I - A)^-1/2` undoes that (CR2 of Bell and McCaffrey, 2002).
    """
    total = 0.0
    for one in np.unique(cluster):
        rows = cluster == one
        J = whitened[rows].reshape(-1, scores.shape[1])
        part, vectors = np.linalg.eigh(J.T @ J * variance)
        along = vectors.T @ scores[rows].sum(axis=0)
        total += float(np.sum(along**2 / np.maximum(1.0 - part, _LEAST_FREEDOM)))
    return total


def _axis_focal_gradient(camera: CameraModel, free: Mask, scale: Array) -> Array:
    """Derivative of `axis_focal_px` by the free parameters, by central differences."""
    gradient = np.zeros(len(scale))
    for k, index in enumerate(np.flatnonzero(free)):
        step = np.zeros(len(free))
        step[index] = 1e-2 / scale[k]  # moves no pixel by more than a hundredth
        longer = axis_focal_px(camera.with_params(camera.params + step))
        shorter = axis_focal_px(camera.with_params(camera.params - step))
        gradient[k] = (longer - shorter) / (2 * step[index])
    return gradient


def _limited(camera: CameraModel, max_angle: float) -> CameraModel:
    return camera_class(camera.model)(
        tuple(camera.params.tolist()), camera.width_px, camera.height_px, max_angle
    )


def _refuse_poor_fit(result: IntrinsicCalibration) -> None:
    if result.sigma_px > _POOR_FIT_PX:
        raise EstimationError(
            f"The best {result.camera.model} lens leaves residuals of {result.sigma_px:.1f} px.",
            consequence="Either the board is not what was said, or this model does not fit the lens.",
            remedy="Check the board's columns, rows, size and spacing; try another --model.",
        )


def _refuse_unknown_focal(result: IntrinsicCalibration) -> None:
    focal = axis_focal_px(result.camera)
    std = result.axis_focal_std_px
    if not std <= _FOCAL_TOLERANCE * focal:
        raise UnobservableError(
            f"The views do not determine the focal length: {focal:.0f} px, give or take {std:.0f} px.",
            consequence="It was found to no better than 2 %: any use of it would be a guess.",
            remedy="Add views with the board tilted by 30 to 45 deg, close, and in the image's corners.",
        )
