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
from rigwake.geometry.so3 import Array
from rigwake.handeye import noise_kernels, normal_kernels
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
        if len(self.total) == 1 and len(rows) == self.total.shape[1]:
            return self
        pick = np.ix_(np.arange(1) if len(self.total) == 1 else chosen, rows, rows)
        return StepNoise(self.total[pick], self.of_reference[pick])

    def inverse(self) -> tuple[Array, Array, Array]:
        """S^-1; Sa S^-1, the share of a residual that is the reference's; what that leaves of Sa."""
        return normal_kernels.inverted(self.total, self.of_reference)


def known_noise(mountings: Sequence[SE3], reference: Array, members: Sequence[Array]) -> StepNoise:
    """Propagate Cov(a) (N, 6, 6) and Cov(b_m) (N, 6, 6) into the residuals.

    The products of both rotation errors with the lever arm are of second order, but without them exact
    translations beside noisy rotations would be believed beyond what the first order is true to.
    """
    R, t = np.array([X.rotation for X in mountings]), np.array([X.translation for X in mountings])
    return StepNoise(*noise_kernels.propagated(R, t, reference, np.stack(members), FLOOR))


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
    R, t = np.array([X.rotation for X in mountings]), np.array([X.translation for X in mountings])
    found = noise_kernels.learnt_covariances(
        R, t, residuals, known, by_axis, ROTATION_FLOOR**2, _CHI2_MEDIAN, _CHI2_LIMIT
    )
    found[:, 1] = _positive(found[:, 1]) if by_axis else _positive_levels(found[:, 1])
    shares = np.array([_shares_of_reference(residuals, known, mountings, first) for first in (0, 3)])
    return StepNoise(*noise_kernels.propagated(R, t, *noise_kernels.split(R, found, shares), FLOOR))


def _positive_levels(covariances: Array) -> Array:
    """Mean variances of (M, 3, 3), not below what rounding allows, on the diagonal."""
    levels = np.maximum(np.einsum("mii->m", covariances) / 3, 0.0) + TRANSLATION_FLOOR**2
    return np.asarray(levels[:, None, None] * np.eye(3))


def _positive(covariances: Array) -> Array:
    """(M, 3, 3) with no direction below a twentieth of the widest."""
    values, vectors = np.linalg.eigh(covariances)
    kept = np.maximum(values, 0.05 * np.maximum(values[:, 2:], 0.0) + TRANSLATION_FLOOR**2)
    return np.asarray((vectors * kept[:, None, :]) @ np.swapaxes(vectors, -1, -2))


def _shares_of_reference(
    residuals: Array, known: NDArray[np.bool_], mountings: Sequence[SE3], first: int
) -> Array:
    """How much of every member's variance (three rows from `first`) is the reference's: what two share."""
    if len(mountings) == 1:
        return np.full(1, 0.5)
    axes = [residuals[:, 6 * m + first : 6 * m + first + 3] @ X.rotation.T for m, X in enumerate(mountings)]
    own = [_robust_mean(r, known[:, m]) for m, r in enumerate(axes)]
    shared = [
        float(np.mean(np.sum((r * other)[known[:, m] & known[:, n]], axis=1)))
        for m, r in enumerate(axes)
        for n, other in enumerate(axes[:m])
        if (known[:, m] & known[:, n]).sum() > 30
    ]
    if not shared:
        return np.full(len(mountings), 0.5)
    return np.clip(np.mean(shared) / np.maximum(own, 1e-300), 0.1, 0.9)


def _robust_mean(rows: Array, known: NDArray[np.bool_], first: int = 0) -> float:
    """Mean of `|r|^2` (three Gaussian columns from `first` on) with the outliers pulled in: starts from the median."""
    squared = noise_kernels.squared_lengths(rows, known, first)
    return float(noise_kernels.robust_mean(squared, _CHI2_MEDIAN, _CHI2_LIMIT))


def robust_mean_square(rows: Array, known: NDArray[np.bool_], first: int) -> float:
    """Mean of `|r|^2` of three columns of the known rows, outliers pulled in, never below what rounding allows."""
    return _robust_mean(rows, known, first) + ROTATION_FLOOR**2


@cache
def outlier_limit(dimension: int) -> float:
    """Squared length that one in a thousand Gaussian vectors exceeds: Huber weights fall off from there."""
    return float(chi2.ppf(1 - OUTLIER_PROBABILITY, dimension))


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
        return noise_kernels.innovations(cells, self.rotation, self.translation).reshape(rows.shape)


_ENOUGH_STEPS = 20_000
_THETAS = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.86, 0.9, 0.93, 0.95, 0.965, 0.975, 0.98)


def fit_jitter(residuals: Array, valid: NDArray[np.bool_]) -> Jitter:
    """The filter with the smallest prediction errors (conditional least squares), per part of (N, 6).

    Theta stays so far from 1 that the filter settles within a tenth of the data. The first 20 000 steps are
    enough to tell.
    """
    residuals, valid = residuals[:_ENOUGH_STEPS], valid[:_ENOUGH_STEPS]
    thetas = [theta for theta in _THETAS if theta <= max(0.0, 1 - 10 / max(valid.sum(), 1))]
    errors = noise_kernels.prediction_errors(residuals, valid, np.array(thetas), _CHI2_MEDIAN, _CHI2_LIMIT)
    rotation, translation = np.argmin(errors, axis=1)
    return Jitter(thetas[rotation], thetas[translation])


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
