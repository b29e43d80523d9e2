"""Whose rotation errors these are: the lever arm between two bodies tells.

An error of the reference's rotation moves the member by the lever arm p (the reference's origin in the member's
axes), an error of the member's own rotation does not. So a residual `r = [r_R, r_t]` whose rotation variance v is
to the fraction s the reference's, and whose translation variance is q by itself, has

    r_t | r_R ~ N(s p x r_R,  q along p,  q + s (1 - s) v |p|^2 across p).

Taking both sides to be equally noisy instead would, with a long arm, leave less than nothing for q where one of
them is the better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.stats import chi2

from rigwake._types import Array

_LOGIT_RANGE = 5.0  # shares of 0.7 to 99.3 %
_COARSE, _FINE = 11, 14  # shares tried, then steps of the golden section
_STEP = 2 * _LOGIT_RANGE / (_COARSE - 1)
_SCORINGS = 12  # steps towards the level of one share
_ROUNDS = 3  # of weights and levels
_LEAST = 1e-4  # level of translation, of all that moves
TRANSLATION_FLOOR = 1e-9  # m; nothing is known better than rounding allows
_MEDIAN = float(chi2.ppf(0.5, 3))
_LIMIT = float(chi2.ppf(0.999, 6))
_FAR = 3.0  # times the limit (in deviations) from where on an outlier counts no more than one at it
_GOLDEN = (math.sqrt(5.0) - 1) / 2


@dataclass(frozen=True)
class LeverArmLevels:
    """fraction: part of the rotation's variance that is the reference's. translation: its variance per axis, m^2."""

    fraction: float
    translation: float


def levels_by_lever_arm(
    residuals: Array, arm: Array, rotation: float, fraction: float | None = None
) -> LeverArmLevels:
    """Maximum likelihood of share and translation level, under the loss of the estimate itself.

    residuals: (N, 6). arm: (3,) p in metres. rotation: v, rad^2 per axis. fraction: if known from elsewhere.
    A weak prior, Beta(2, 2), decides where the arm is too short to tell. Outliers weigh as in Huber's loss up to
    `_FAR` times its limit, beyond that they count no more.
    """
    given = -1.0 if fraction is None else fraction
    found, level = _levels(
        np.ascontiguousarray(residuals), np.asarray(arm, dtype=np.float64), rotation, given
    )
    return LeverArmLevels(float(found), float(level))


@njit(cache=True)
def _levels(residuals: Array, arm: Array, v: float, given: float) -> tuple[float, float]:
    squares = _squares(residuals, arm)
    length2 = arm[0] * arm[0] + arm[1] * arm[1] + arm[2] * arm[2]
    # before anything is known an outlier is far by rotation, or by all of its translation
    moved = np.empty(len(squares))
    for k in range(len(squares)):
        moved[k] = squares[k, 1] + squares[k, 2]
    typical = np.median(moved) / _MEDIAN if len(moved) else 1.0
    fraction, q, arm_variance, means = 0.5, typical + TRANSLATION_FLOOR**2, 0.0, np.zeros(5)
    for _ in range(_ROUNDS):
        means = _weighted_means(squares, fraction, v, q, q + fraction * (1 - fraction) * arm_variance)
        arm_variance = v * length2
        fraction = given if given >= 0 else _fraction_of(_best_logit(means, arm_variance, len(squares)))
        q = _level(fraction, means, arm_variance)
    if given < 0:
        logit = math.log(fraction / (1 - fraction))
        fraction = _fraction_of(_refined(logit, means, arm_variance, len(squares)))
        q = _level(fraction, means, arm_variance)
    return fraction, q


@njit(cache=True)
def _squares(residuals: Array, arm: Array) -> Array:
    """(N, 5) of every residual: |r_R|^2, r_t^2 along the arm, across it, (p x r_R) . r_t, |p x r_R|^2."""
    length = math.sqrt(arm[0] * arm[0] + arm[1] * arm[1] + arm[2] * arm[2])
    ax, ay, az = (arm[0] / length, arm[1] / length, arm[2] / length) if length > 0 else (1.0, 0.0, 0.0)
    out = np.empty((len(residuals), 5))
    for k in range(len(residuals)):
        r = residuals[k]
        x, y, z = (
            arm[1] * r[2] - arm[2] * r[1],
            arm[2] * r[0] - arm[0] * r[2],
            arm[0] * r[1] - arm[1] * r[0],
        )
        along = (ax * r[3] + ay * r[4] + az * r[5]) ** 2
        out[k, 0] = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        out[k, 1] = along
        out[k, 2] = r[3] * r[3] + r[4] * r[4] + r[5] * r[5] - along
        out[k, 3] = x * r[3] + y * r[4] + z * r[5]
        out[k, 4] = x * x + y * y + z * z
    return out


@njit(cache=True)
def _weighted_means(squares: Array, fraction: float, turned: float, along: float, across: float) -> Array:
    """(5,) means over the residuals, outliers of these variances weighing less."""
    sums = np.zeros(5)
    for k in range(len(squares)):
        moved = squares[k, 2] - 2 * fraction * squares[k, 3] + fraction * fraction * squares[k, 4]
        weight = _weight(squares[k, 0] / turned + squares[k, 1] / along + moved / across)
        for j in range(5):
            sums[j] += weight * squares[k, j]
    for j in range(5):
        sums[j] /= max(len(squares), 1)
    return sums


@njit(cache=True)
def _weight(squared: float) -> float:
    """Huber's weight of a residual in a covariance, falling faster beyond `_FAR` times the limit."""
    ratio = _LIMIT / max(squared, 1e-300)
    if ratio >= 1:
        return 1.0
    return math.sqrt(ratio) if ratio * _FAR * _FAR > 1 else _FAR * ratio


@njit(cache=True)
def _across(fraction: float, means: Array) -> float:
    """Mean square per axis across the arm of what the fraction leaves."""
    return (means[2] - 2 * fraction * means[3] + fraction * fraction * means[4]) / 2


@njit(cache=True)
def _level(fraction: float, means: Array, arm_variance: float) -> float:
    """q that maximises the likelihood, by Fisher scoring."""
    least = _LEAST * (means[1] + means[2]) + TRANSLATION_FLOOR**2
    extra, across = fraction * (1 - fraction) * arm_variance, _across(fraction, means)
    q = max(means[1], least)
    for _ in range(_SCORINGS):
        a, b = 1 / (q * q), 2 / (q + extra) ** 2
        q = max((a * means[1] + b * (across - extra)) / (a + b), least)
    return q


@njit(cache=True)
def _cost(logit: float, means: Array, arm_variance: float, count: int) -> float:
    """Minus twice the logarithm of the likelihood and the prior per residual, at the best q."""
    fraction = _fraction_of(logit)
    q = _level(fraction, means, arm_variance)
    wide = q + fraction * (1 - fraction) * arm_variance
    cost = math.log(q) + means[1] / q + 2 * math.log(wide) + 2 * _across(fraction, means) / wide
    return cost - 2 * math.log(fraction * (1 - fraction)) / max(count, 1)


@njit(cache=True)
def _best_logit(means: Array, arm_variance: float, count: int) -> float:
    """The best of a grid of shares."""
    best, lowest = 0.0, math.inf
    for k in range(_COARSE):
        logit = k * _STEP - _LOGIT_RANGE
        cost = _cost(logit, means, arm_variance, count)
        if cost < lowest:
            best, lowest = logit, cost
    return best


@njit(cache=True)
def _refined(logit: float, means: Array, arm_variance: float, count: int) -> float:
    """Golden section about a value of the grid, so that the fraction does not jump when the residuals hardly move."""
    low, high = logit - _STEP, logit + _STEP
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = _cost(left, means, arm_variance, count), _cost(right, means, arm_variance, count)
    for _ in range(_FINE):
        if at_left < at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = _cost(left, means, arm_variance, count)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = _cost(right, means, arm_variance, count)
    return (low + high) / 2


@njit(cache=True)
def _fraction_of(logit: float) -> float:
    return 1 / (1 + math.exp(-logit))
