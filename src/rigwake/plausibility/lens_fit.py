"""A lens against its own tracks: focal length and principal point from the geometry of two views.

Whatever the scene, bearings of the same points in two images obey `b2^T [t]x R b1 = 0`. A lens that is wrong breaks
this over a wide field as soon as the camera turns. Over pairs of frames, each with a rotation and a direction of its
own, three numbers of the lens are estimated: pixels are moved by `c + (p - c - d) / s` about the principal point c
before the lens given turns them into bearings, so that s = 1 and d = 0 belong to a lens that is right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._robust import robust_std
from rigwake._types import Array
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.plausibility.view_pairs import (
    ViewPairs,
    choose_pairs,
    eliminate_pairs,
    moved_pairs,
    sampson_distances,
    scatter_covariance,
    tangents,
)
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_FEWEST_PAIRS = 8
_FEWEST_OF_A_THIRD = 15
_ROUNDS = 12
_STEP_PX = 0.05
_REPEATS = 4
_SCALE_STD = 0.2


@dataclass(frozen=True, eq=False)
class LensFit:
    """What the tracks say of a lens.

    scale: focal length by the tracks over that given. shift_px: (2,) principal point by the tracks less that given.
    covariance: (3, 3) of `[scale, shift]`, by the scatter over pairs of frames. rms_px: of the epipolar distances with
    the lens given, and `refined_rms_px` with the better one. pairs: of frames.
    """

    scale: float
    shift_px: Array
    covariance: Array
    rms_px: float
    refined_rms_px: float
    pairs: int


def fit_lens(
    tracks: Tracks,
    model: CameraModel,
    trajectory: Trajectory,
    *,
    unbiased: bool = False,
    scale_std: float = _SCALE_STD,
) -> LensFit:
    """Focal scale and shift of the principal point that the tracks ask for.

    trajectory: of the camera by its own odometry, which says between which frames it turned, and how.
    unbiased: with few tracks in a pair, their noise pulls the lens one way; the same noise is then added once more,
    and what it does is taken off (simulation and extrapolation, Cook and Stefanski 1994).
    scale_std: how well the focal scale is known to be one already.
    Raises EstimationError where fewer than 8 pairs of frames share enough tracks over a turn of 8 degrees.
    """
    pairs = choose_pairs(tracks, trajectory)
    if len(pairs.rotation) < _FEWEST_PAIRS:
        raise EstimationError(
            f"{tracks.camera}: only {len(pairs.rotation)} pairs of images show the same points after a turn.",
            consequence="Its lens cannot be checked.",
        )
    fit = _minimise(pairs, model, scale_std)
    return _without_bias(fit, pairs, model, scale_std) if unbiased else fit


def focal_growth(tracks: Tracks, model: CameraModel, trajectory: Trajectory) -> tuple[float, float] | None:
    """Focal length in the last third of the pairs of images over that in the first, less one, and its deviation.

    None where a third has fewer than 15 pairs: the scatter of fewer does not tell their deviation.
    """
    pairs = choose_pairs(tracks, trajectory)
    third = len(pairs.rotation) // 3
    if third < _FEWEST_OF_A_THIRD:
        return None
    ends = [np.arange(third), np.arange(len(pairs.rotation) - third, len(pairs.rotation))]
    first, last = (_minimise(pairs.take(index), model, _SCALE_STD) for index in ends)
    std = float(np.sqrt(first.covariance[0, 0] + last.covariance[0, 0]))
    return last.scale / first.scale - 1, std


def _without_bias(fit: LensFit, pairs: ViewPairs, model: CameraModel, scale_std: float) -> LensFit:
    rng = np.random.default_rng(0)
    noisy = []
    for _ in range(_REPEATS):
        first, second = (p + rng.normal(0, fit.refined_rms_px, p.shape) for p in (pairs.first, pairs.second))
        noisy.append(_minimise(replace(pairs, first=first, second=second), model, scale_std))
    scale, shift = float(np.mean([f.scale for f in noisy])), np.mean([f.shift_px for f in noisy], axis=0)
    pulled = np.concatenate([[fit.scale - scale], fit.shift_px - shift])
    # what was taken off is itself uncertain
    covariance = fit.covariance * (1 + 1 / _REPEATS) + np.diag((0.5 * pulled) ** 2)
    return replace(fit, scale=2 * fit.scale - scale, shift_px=2 * fit.shift_px - shift, covariance=covariance)


def _bearings(model: CameraModel, pixels: Array, centre: Array, lens: Array) -> Array:
    """(K, 3) by the lens moved by `[log scale, shift]`; NaN where it has no ray."""
    moved = centre + (pixels - centre - lens[1:]) * np.exp(-float(lens[0]))
    return np.asarray(model.unproject(moved)[0])


def _minimise(pairs: ViewPairs, model: CameraModel, scale_std: float) -> LensFit:
    """Gauss-Newton on Sampson distances with Cauchy's loss; the poses of the pairs are eliminated pair by pair."""
    centre = model.project(np.array([[0.0, 0.0, 1.0]]))[0][0]
    focal = _pixels_per_radian(model, centre)
    R, t, lens = pairs.rotation.copy(), pairs.direction.copy(), np.zeros(3)
    steps = np.array([_STEP_PX / focal, _STEP_PX, _STEP_PX])
    damping, given_rms = 1e-3, np.nan
    scale = np.nan
    cost_before, state = np.inf, (R, t, lens)
    for done in range(_ROUNDS):
        error, J_pose, J_lens = _linearise(pairs, model, centre, R, t, lens, steps)
        size = robust_std(error)
        if done == 0:
            size *= 3  # the start is still in the residuals
        scale = max(size, 1e-7)
        weights = 1 / (1 + (error / (2 * scale)) ** 2)
        cost = float(np.sum(np.log1p((error / 1e-3) ** 2)))
        if cost > cost_before * (1 + 1e-9):
            R, t, lens = state
            damping *= 10
            cost_before = np.inf
            continue
        state, cost_before = (R, t, lens), cost
        if done <= 3:
            given_rms = robust_std(error)
        reduced, right, back = eliminate_pairs(pairs, error, J_pose, J_lens, weights, damping)
        prior = (scale**2) / np.array([scale_std, 0.2 * focal, 0.2 * focal]) ** 2
        if done < 3:  # poses first, with the lens given
            step_lens: Array = np.zeros(3)
        else:
            step_lens = np.asarray(
                np.linalg.solve(reduced + np.diag(prior), right - prior * lens), dtype=np.float64
            )
            damping = max(damping / 10, 1e-9)
        step_pose = back(step_lens)
        lens = lens + np.clip(
            step_lens, -0.1 * np.array([1, focal, focal]), 0.1 * np.array([1, focal, focal])
        )
        R, t = moved_pairs(R, t, step_pose)
        if done > 4 and np.abs(step_lens / steps).max() < 0.05:
            break
    error, J_pose, J_lens = _linearise(pairs, model, centre, R, t, lens, steps)
    weights = 1 / (1 + (error / (2 * scale)) ** 2)
    reduced, _, _ = eliminate_pairs(pairs, error, J_pose, J_lens, weights, 1e-9)
    covariance = scatter_covariance(pairs, error, J_pose, J_lens, weights, reduced)
    covariance[0] *= np.exp(lens[0])
    covariance[:, 0] *= np.exp(lens[0])
    refined = robust_std(error)
    return LensFit(
        float(np.exp(lens[0])), lens[1:].copy(), covariance, given_rms * focal, refined * focal, len(R)
    )


def _pixels_per_radian(model: CameraModel, centre: Array) -> float:
    small = np.array([[1e-3, 0.0, 1.0], [0.0, 1e-3, 1.0]])
    return float(np.mean(np.linalg.norm(model.project(small)[0] - centre, axis=1)) / 1e-3)


def _linearise(
    pairs: ViewPairs, model: CameraModel, centre: Array, R: Array, t: Array, lens: Array, steps: Array
) -> tuple[Array, Array, Array]:
    """Distances (K,) and their derivatives by pose (K, 5) and lens (K, 3), numerically; zero where not valid."""
    a, b = (_bearings(model, p, centre, lens) for p in (pairs.first, pairs.second))
    valid = np.asarray(np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1))
    a, b = np.where(valid[:, None], a, 1.0), np.where(valid[:, None], b, 1.0)
    error = sampson_distances(a, b, R, t, pairs.pair)
    bases, h = tangents(t), 1e-6
    by_pose = np.empty((len(error), 5))
    for k in range(5):
        if k < 3:
            moved = sampson_distances(a, b, so3.exp(h * np.eye(3)[k]) @ R, t, pairs.pair)
        else:
            moved = sampson_distances(a, b, R, t + h * bases[:, :, k - 3], pairs.pair)
        by_pose[:, k] = (moved - error) / h
    by_lens = np.empty((len(error), 3))
    for k in range(3):
        off = lens + steps * np.eye(3)[k]
        a2, b2 = (_bearings(model, p, centre, off) for p in (pairs.first, pairs.second))
        good = np.asarray(np.isfinite(a2).all(axis=1) & np.isfinite(b2).all(axis=1))
        valid &= good
        moved = sampson_distances(
            np.where(good[:, None], a2, a), np.where(good[:, None], b2, b), R, t, pairs.pair
        )
        by_lens[:, k] = (moved - error) / steps[k]
    keep = valid[:, None]
    return np.where(valid, error, 0.0), np.where(keep, by_pose, 0.0), np.where(keep, by_lens, 0.0)
