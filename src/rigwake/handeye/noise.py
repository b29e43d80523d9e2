"""What the residuals' noise is: known from both sides, or learnt from the residuals themselves.

For M members against one reference the residuals of a step are `r_m = Ad(X_m^-1) a - b_m`: the reference's
error a is common to all of them. Their joint covariance S (6 M, 6 M) is `Sa + diag(Sb)` with
`Sa_mn = Ad(X_m^-1) Cov(a) Ad(X_n^-1)^T`; members see each other through its off-diagonal blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rigwake.geometry.se3 import SE3
from rigwake.geometry.so3 import Array, hat
from rigwake.handeye import kernels
from rigwake.handeye.resample import Curve

ROTATION_FLOOR = 1e-9  # rad; nothing is known better than rounding allows
TRANSLATION_FLOOR = 1e-9  # m
FLOOR = np.repeat([ROTATION_FLOOR**2, TRANSLATION_FLOOR**2], 3)
OUTLIER_PROBABILITY = 1e-3
_CHI2_MEDIAN, _CHI2_LIMIT = float(chi2.ppf(0.5, 3)), float(chi2.ppf(1 - OUTLIER_PROBABILITY, 3))


@dataclass(frozen=True, eq=False)
class StepNoise:
    """Covariances of stacked residuals: S and the reference's part Sa, (1 or N, 6 M, 6 M)."""

    total: Array
    of_reference: Array

    def restricted(self, chosen: NDArray[np.int64], rows: NDArray[np.int64]) -> StepNoise:
        """For the steps `chosen` and the members whose stacked rows are `rows`."""
        pick = np.ix_(np.arange(1) if len(self.total) == 1 else chosen, rows, rows)
        return StepNoise(self.total[pick], self.of_reference[pick])

    def inverse(self) -> Array:
        """S^-1, after scaling to unit diagonal (rotation and translation differ by many decades)."""
        scale = 1 / np.sqrt(np.einsum("nii->ni", self.total))
        normalised = self.total * scale[:, :, None] * scale[:, None, :]
        return np.asarray(np.linalg.inv(normalised) * scale[:, :, None] * scale[:, None, :])


def known_noise(mountings: Sequence[SE3], reference: Array, members: Sequence[Array]) -> StepNoise:
    """Propagate Cov(a) (N, 6, 6) and Cov(b_m) (N, 6, 6) into the residuals.

    The products of both rotation errors with the lever arm are of second order, but without them exact
    translations beside noisy rotations would be believed beyond what the first order is true to.
    """
    stacked = np.concatenate([X.inverse().adjoint() for X in mountings], axis=0)  # (6 M, 6)
    of_reference = stacked @ (reference + np.diag(FLOOR)) @ stacked.T
    total = of_reference.copy()
    for m, covariance in enumerate(members):
        block = slice(6 * m, 6 * m + 6)
        total[:, block, block] += covariance + np.diag(FLOOR)
        both = np.trace(reference[:, :3, :3] + covariance[:, :3, :3], axis1=1, axis2=2) / 3
        arm = float(np.sum(mountings[m].translation ** 2))
        total[:, range(6 * m + 3, 6 * m + 6), range(6 * m + 3, 6 * m + 6)] += (both**2 * arm / 8)[:, None]
    return StepNoise(total, of_reference)


def learnt_noise(
    mountings: Sequence[SE3], residuals: Array, known: NDArray[np.bool_], by_axis: bool
) -> StepNoise:
    """Noise from residuals (N, 6 M), `known` (N, M) where they are valid.

    Each trajectory gets a covariance (3, 3) for rotation and one for translation. With `by_axis` they are
    free (a camera before a board knows its roll several times better than its tilt), else the same for all
    axes: errors of odometry grow with the motion (a wrong scale, a misaligned gyroscope), a free covariance
    would take them for noise and bend the estimate after them. One member cannot tell whose error it is:
    then both sides are equally noisy.
    """
    count = len(mountings)
    rotation, translation = [], []
    for m, X in enumerate(mountings):
        r = residuals[known[:, m], 6 * m : 6 * m + 6]
        turned = _robust_covariance(r[:, :3], by_axis)
        # an error of the reference's rotation moves the member by the lever arm
        arm = hat(X.inverse().translation)
        moved = _robust_covariance(r[:, 3:], by_axis) - arm @ turned @ arm.T / 2
        rotation.append(turned)
        translation.append(_positive(moved) if by_axis else _positive_level(moved) * np.eye(3))
    members = [np.zeros((1, 6, 6)) for _ in range(count)]
    reference = np.zeros((1, 6, 6))
    for first, found in ((0, rotation), (3, translation)):
        shares = _shares_of_reference(residuals, known, mountings, first)
        block = slice(first, first + 3)
        for m, X in enumerate(mountings):
            members[m][0, block, block] = (1 - shares[m]) * found[m]
            reference[0, block, block] += shares[m] / count * (X.rotation @ found[m] @ X.rotation.T)
    return known_noise(mountings, reference, members)


def _positive_level(covariance: Array) -> float:
    """Mean variance of (3, 3), not below what rounding allows."""
    return max(float(np.trace(covariance)) / 3, 0.0) + TRANSLATION_FLOOR**2


def _positive(covariance: Array) -> Array:
    """(3, 3) with no direction below a twentieth of the widest."""
    values, vectors = np.linalg.eigh(covariance)
    kept = np.maximum(values, 0.05 * max(values[-1], 0.0) + TRANSLATION_FLOOR**2)
    return np.asarray((vectors * kept) @ vectors.T)


def _shares_of_reference(
    residuals: Array, known: NDArray[np.bool_], mountings: Sequence[SE3], first: int
) -> Array:
    """How much of every member's variance (three rows from `first`) is the reference's: what two share."""
    axes = [residuals[:, 6 * m + first : 6 * m + first + 3] @ X.rotation.T for m, X in enumerate(mountings)]
    own = [_robust_mean(np.sum(r[known[:, m]] ** 2, axis=1)) for m, r in enumerate(axes)]
    shared = [
        float(np.mean(np.sum((r * other)[known[:, m] & known[:, n]], axis=1)))
        for m, r in enumerate(axes)
        for n, other in enumerate(axes[:m])
        if (known[:, m] & known[:, n]).sum() > 30
    ]
    if not shared:
        return np.full(len(mountings), 0.5)
    return np.clip(np.mean(shared) / np.maximum(own, 1e-300), 0.1, 0.9)


def _robust_covariance(rows: Array, by_axis: bool) -> Array:
    """Covariance (3, 3) about zero with outliers pulled in (Huber's proposal 2)."""
    floor = ROTATION_FLOOR**2 * np.eye(3)
    covariance = _robust_mean(np.sum(rows**2, axis=1)) / 3 * np.eye(3) + floor
    if not by_axis:
        return np.asarray(covariance)
    for _ in range(2):
        squared = np.einsum("ni,ij,nj->n", rows, np.linalg.inv(covariance), rows)
        pulled = rows * np.sqrt(np.minimum(1.0, _CHI2_LIMIT / np.maximum(squared, 1e-300)))[:, None]
        covariance = pulled.T @ pulled / max(len(rows), 1) + floor
    return np.asarray(covariance)


def _robust_mean(squared_lengths: Array) -> float:
    """Mean of `|r|^2` (three Gaussian rows) with the outliers pulled in: starts from the median."""
    return float(kernels.robust_mean(squared_lengths, _CHI2_MEDIAN, _CHI2_LIMIT))


def robust_mean_square(rows: Array) -> float:
    """Mean of `|r|^2` of rows (N, 3), outliers pulled in, never below what rounding allows."""
    return _robust_mean(np.sum(rows**2, axis=1)) + ROTATION_FLOOR**2


@cache
def _outlier_limit(dimension: int) -> float:
    return float(chi2.ppf(1 - OUTLIER_PROBABILITY, dimension))


def robust_weights(squared: Array, dimension: int) -> Array:
    """Huber weights that touch one in a thousand steps of Gaussian noise."""
    return np.asarray(np.sqrt(np.minimum(1.0, _outlier_limit(dimension) / np.maximum(squared, 1e-300))))


@dataclass(frozen=True)
class Jitter:
    """Prediction errors of increments that hold a random walk (drift) and white noise of the poses (jitter).

    Such increments are a moving average `r_k = e_k - theta e_(k-1)` with white e: theta is 0 without jitter
    and nears 1 without drift. The filter recovers e. One theta for rotation and one for translation, the
    same for all axes, so that nothing depends on the choice of axes.
    """

    rotation: float = 0.0
    translation: float = 0.0

    def apply(self, rows: Array) -> Array:
        """Filter residuals (N, 6) or Jacobians (N, 6, P) along time."""
        if self.rotation == 0 and self.translation == 0:
            return rows
        cells = np.ascontiguousarray(rows).reshape(len(rows), 6, -1)
        return kernels.innovations(cells, self.rotation, self.translation).reshape(rows.shape)


_ENOUGH_STEPS = 20_000
_THETAS = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.86, 0.9, 0.93, 0.95, 0.965, 0.975, 0.98)


def fit_jitter(residuals: Array, valid: NDArray[np.bool_]) -> Jitter:
    """The filter with the smallest prediction errors (conditional least squares), per part of (N, 6).

    Theta stays so far from 1 that the filter settles within a tenth of the data. The first 20 000 steps are
    enough to tell.
    """
    residuals, valid = residuals[:_ENOUGH_STEPS], valid[:_ENOUGH_STEPS]
    thetas = [theta for theta in _THETAS if theta <= max(0.0, 1 - 10 / max(valid.sum(), 1))]
    cells, best = np.ascontiguousarray(residuals)[:, :, None], []
    errors = np.array([_squared_innovations(cells, theta)[valid] for theta in thetas])
    for part in range(2):
        means = [_robust_mean(np.ascontiguousarray(squared[:, part])) for squared in errors]
        best.append(thetas[int(np.argmin(means))])
    return Jitter(*best)


def _squared_innovations(cells: Array, theta: float) -> Array:
    """(N, 2) squared lengths of rotation and translation."""
    return np.asarray((kernels.innovations(cells, theta, theta) ** 2).reshape(-1, 2, 3).sum(axis=2))


def noise_over_steps(covariances: Array, curve: Curve, times_s: Array, absolute: bool) -> Array:
    """Covariances of a trajectory's poses, or of its motions between neighbouring `times_s`: (., 6, 6).

    Increments add up along the way (their small rotation between is neglected); a step that covers part of
    an increment gets that part of its covariance.
    """
    n = len(curve.times_s)
    flat = covariances.reshape(n, 36)
    left = np.clip(np.searchsorted(curve.times_s, times_s + 1e-6) - 1, 0, n - 2)
    alpha = np.clip((times_s - curve.times_s[left]) / np.diff(curve.times_s)[left], 0.0, 1.0)[:, None]
    if absolute:
        at = flat[left] * (1 - alpha) + flat[left + 1] * alpha
        return np.asarray(at.reshape(-1, 6, 6))
    summed = np.cumsum(np.vstack([np.zeros(36), flat[1:]]), axis=0)
    reached = summed[left] + alpha * flat[left + 1]
    return np.diff(reached, axis=0).reshape(-1, 6, 6)
