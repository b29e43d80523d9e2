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
from scipy.special import chdtri

from rigwake._types import Array
from rigwake.geometry.se3 import SE3
from rigwake.handeye import noise_kernels, normal_kernels
from rigwake.handeye.motions import TrajectoryCurve
from rigwake.handeye.noise_kernels import TRANSLATION_FLOOR, levels_by_lever_arm

ROTATION_FLOOR = 1e-9  # rad; nothing is known better than rounding allows
FLOOR = np.repeat([ROTATION_FLOOR**2, TRANSLATION_FLOOR**2], 3)
OUTLIER_PROBABILITY = 1e-3
_UNIT = np.eye(3)
_ENOUGH_COMMON = 30  # steps of two members, to tell what they share
_Pairs = list[tuple[int, int, NDArray[np.bool_]]]
_CHI2_MEDIAN, _CHI2_LIMIT = float(chdtri(3, 0.5)), float(chdtri(3, OUTLIER_PROBABILITY))


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
        """S^-1; Sa S^-1, the fraction of a residual that is the reference's; what that leaves of Sa."""
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
    would take them for noise and bend the estimate after them. Whose errors they are is told by what members
    share; with one member by the lever arm, for rotations, while translations count half for each side.
    """
    R, t = np.array([X.rotation for X in mountings]), np.array([X.translation for X in mountings])
    found = noise_kernels.learnt_covariances(
        residuals, known, by_axis, ROTATION_FLOOR**2, _CHI2_MEDIAN, _CHI2_LIMIT
    )
    fractions, pairs = np.full((2, len(R)), 0.5), _pairs(known)
    turn = _shared_rotation(residuals, mountings, pairs) if pairs else 0.0
    for m, X in enumerate(mountings):
        r, arm = residuals[known[:, m], 6 * m : 6 * m + 6], -X.translation @ X.rotation
        known_fraction = _fraction(turn, found[m, 0], 0.01) if pairs else None
        levels = levels_by_lever_arm(r, arm, float(np.trace(found[m, 0])) / 3, known_fraction)
        fractions[0, m] = levels.fraction
        found[m, 1] = (
            noise_kernels.subtract_arm_variance(
                found[m, 1], found[m, 0], arm, levels.fraction, TRANSLATION_FLOOR**2
            )
            if by_axis
            else levels.translation * _UNIT
        )
    if pairs:
        way = _shared_translation(residuals, mountings, pairs, fractions[0], turn)
        fractions[1] = [_fraction(way, own, 0.1) for own in found[:, 1]]
    return StepNoise(*noise_kernels.propagated(R, t, *noise_kernels.split(R, found, fractions), FLOOR))


def _fraction(shared: float, own: Array, least: float) -> float:
    """Part of a covariance (3, 3) that is the reference's, from the mean of `r_m . r_n` of pairs of members."""
    return float(np.clip(shared / max(float(np.trace(own)), 1e-300), least, 1 - least))


def _pairs(known: NDArray[np.bool_]) -> _Pairs:
    """Members m > n with more than `_ENOUGH_COMMON` common steps, and which those are."""
    both = ((m, n, known[:, m] & known[:, n]) for m in range(known.shape[1]) for n in range(m))
    return [pair for pair in both if pair[2].sum() > _ENOUGH_COMMON]


def _shared_rotation(residuals: Array, mountings: Sequence[SE3], pairs: _Pairs) -> float:
    """Mean of `r_R,m . r_R,n` over pairs of members, in the axes of the reference: its |a_R|^2."""
    rows = [residuals[:, 6 * m : 6 * m + 3] @ X.rotation.T for m, X in enumerate(mountings)]
    return _mean_product(rows, np.zeros((len(rows), 3)), pairs)


def _shared_translation(
    residuals: Array, mountings: Sequence[SE3], pairs: _Pairs, fractions: Array, turn: float
) -> float:
    """The same of translations, less what the reference's rotation, `turn` its |a_R|^2, moves both by.

    Most of that is what the fraction of the rotation residuals explains, and is taken off each member first.
    """
    rows, left = [], []
    for m, (X, fraction) in enumerate(zip(mountings, fractions, strict=True)):
        r = residuals[:, 6 * m : 6 * m + 6]
        rows.append((r[:, 3:] - fraction * np.cross(X.inverse().translation, r[:, :3])) @ X.rotation.T)
        left.append((1 - fraction) * X.translation)
    return _mean_product(rows, np.array(left), pairs, 2 / 3 * turn)


def _mean_product(rows: Sequence[Array], arms: Array, pairs: _Pairs, by_arms: float = 0.0) -> float:
    """Mean of `row_m . row_n - by_arms arm_m . arm_n` over pairs, outliers pulled in."""
    products = [
        float(np.mean(np.sum(_pulled_in(rows[m][both]) * _pulled_in(rows[n][both]), axis=1)))
        - by_arms * float(arms[m] @ arms[n])
        for m, n, both in pairs
    ]
    return float(np.mean(products))


def _pulled_in(rows: Array) -> Array:
    """Rows (N, 3) with outliers shortened to where they begin."""
    squared = np.sum(rows**2, axis=1)
    farthest = np.median(squared) / _CHI2_MEDIAN * _CHI2_LIMIT
    return np.asarray(rows * np.sqrt(np.minimum(1.0, farthest / np.maximum(squared, 1e-300)))[:, None])


def robust_mean_square(rows: Array, known: NDArray[np.bool_], first: int) -> float:
    """Mean of `|r|^2` (three Gaussian columns from `first` on) of the known rows, the outliers pulled in, never
    below what rounding allows."""
    squared = noise_kernels.squared_lengths(rows, known, first)
    return float(noise_kernels.robust_mean(squared, _CHI2_MEDIAN, _CHI2_LIMIT)) + ROTATION_FLOOR**2


@cache
def outlier_limit(dimension: int) -> float:
    """Squared length that one in a thousand Gaussian vectors exceeds: Huber weights fall off from there."""
    return float(chdtri(dimension, OUTLIER_PROBABILITY))


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


def noise_over_steps(covariances: Array, curve: TrajectoryCurve, times_s: Array, absolute: bool) -> Array:
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
