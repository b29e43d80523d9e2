"""Compiled statistics of residuals: robust variances, prediction errors, propagated covariances, lever-arm levels.

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
from numpy.typing import NDArray
from scipy.special import chdtri

from rigwake._kernels import njit
from rigwake._types import Array


@njit()
def innovations(rows: Array, rotation: float, translation: float) -> Array:
    """`e_k = row_k + theta e_(k-1)` along time over rows (N, 6, P), the first three with theta `rotation`."""
    out = rows.copy()
    for k in range(1, len(rows)):
        for a in range(6):
            theta = rotation if a < 3 else translation
            if theta != 0.0:
                for c in range(rows.shape[2]):
                    out[k, a, c] += theta * out[k - 1, a, c]
    return out


@njit()
def robust_mean(squared: Array, median_of_unit: float, limit: float) -> float:
    """Mean with outliers pulled in to `limit` times the scale that the median tells."""
    if len(squared) == 0:
        return 0.0
    highest = np.median(squared) / median_of_unit * limit
    total = 0.0
    for value in squared:
        total += min(value, highest)
    return total / len(squared)


@njit()
def squared_lengths(rows: Array, known: NDArray[np.bool_], first: int) -> Array:
    """`|r|^2` of the three columns from `first` on, of the known rows."""
    out, i = np.empty(known.sum()), 0
    for k in range(len(rows)):
        if known[k]:
            out[i] = rows[k, first] ** 2 + rows[k, first + 1] ** 2 + rows[k, first + 2] ** 2
            i += 1
    return out


@njit()
def prediction_errors(
    rows: Array, known: NDArray[np.bool_], thetas: Array, median_of_unit: float, limit: float
) -> Array:
    """(2, T) robust mean squares of the `innovations` of rows (N, 6) by theta: rotation, translation."""
    out = np.empty((2, len(thetas)))
    cells = rows.copy().reshape(len(rows), 6, 1)
    for i in range(len(thetas)):
        predicted = innovations(cells, thetas[i], thetas[i]).reshape(len(rows), 6)
        for part in range(2):
            out[part, i] = robust_mean(squared_lengths(predicted, known, 3 * part), median_of_unit, limit)
    return out


@njit()
def learnt_covariances(
    rows: Array, known: NDArray[np.bool_], by_axis: bool, floor: float, median_of_unit: float, limit: float
) -> Array:
    """(M, 2, 3, 3): covariances of rotation and of translation of residuals (N, 6 M); see `learnt_noise`."""
    count = known.shape[1]
    out = np.empty((count, 2, 3, 3))
    for m in range(count):
        valid = known[:, m].copy()
        for part in range(2):
            first = 6 * m + 3 * part
            _robust_covariance(rows, valid, first, by_axis, floor, median_of_unit, limit, out[m, part])
    return out


@njit()
def subtract_arm_variance(moved: Array, turned: Array, arm: Array, fraction: float, floor: float) -> Array:
    """Covariance (3, 3) of translations less what the fraction of the rotations' moves the arm by; no direction below
    a twentieth of the widest."""
    turn, arm_covariance, out = np.zeros((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        turn[k, j], turn[j, k] = arm[i], -arm[i]
    _sandwich(turn, turned, arm_covariance)
    values, vectors = np.linalg.eigh(moved - fraction * arm_covariance)
    least = 0.05 * max(values[2], 0.0) + floor
    for c in range(3):
        for i in range(3):
            for j in range(3):
                out[i, j] += max(values[c], least) * vectors[i, c] * vectors[j, c]
    return out


@njit()
def _sandwich(A: Array, covariance: Array, out: Array) -> None:
    """`out = A covariance A^T`, in loops: small, and quicker to compile than calls of BLAS."""
    p, q = A.shape
    left = np.zeros((p, q))
    for i in range(p):
        for j in range(q):
            for k in range(q):
                left[i, j] += A[i, k] * covariance[k, j]
    for i in range(p):
        for j in range(p):
            out[i, j] = 0.0
            for k in range(q):
                out[i, j] += left[i, k] * A[j, k]


@njit()
def _robust_covariance(
    rows: Array,
    known: NDArray[np.bool_],
    first: int,
    by_axis: bool,
    floor: float,
    median_of_unit: float,
    limit: float,
    out: Array,
) -> None:
    """Covariance (3, 3) about zero of three columns with outliers pulled in (Huber's proposal 2)."""
    squared = squared_lengths(rows, known, first)
    level = robust_mean(squared, median_of_unit, limit) / 3 + floor
    for i in range(3):
        for j in range(3):
            out[i, j] = level if i == j else 0.0
    for _ in range(2 if by_axis else 0):
        inverse = np.linalg.inv(out)
        for i in range(3):
            for j in range(3):
                out[i, j] = floor if i == j else 0.0
        for k in range(len(rows)):
            if known[k]:
                length = 0.0
                for i in range(3):
                    for j in range(3):
                        length += rows[k, first + i] * inverse[i, j] * rows[k, first + j]
                fraction = min(1.0, limit / max(length, 1e-300)) / len(squared)
                for i in range(3):
                    for j in range(3):
                        out[i, j] += fraction * rows[k, first + i] * rows[k, first + j]


@njit()
def split(R: Array, found: Array, fractions: Array) -> tuple[Array, Array]:
    """Covariances (M, 2, 3, 3) of the errors of both sides as the reference's (1, 6, 6), the mean of its `fractions`
    (2, M) in its own axes, and the members' (M, 1, 6, 6)."""
    count = len(R)
    reference, members, turned = np.zeros((1, 6, 6)), np.zeros((count, 1, 6, 6)), np.empty((3, 3))
    for m in range(count):
        for part in range(2):
            at, fraction = 3 * part, fractions[part, m]
            _sandwich(R[m], found[m, part], turned)
            for i in range(3):
                for j in range(3):
                    members[m, 0, at + i, at + j] = (1 - fraction) * found[m, part, i, j]
                    reference[0, at + i, at + j] += fraction / count * turned[i, j]
    return reference, members


@njit()
def propagated(R: Array, t: Array, reference: Array, members: Array, floor: Array) -> tuple[Array, Array]:
    """Covariances (n, 6 M, 6 M) of the residuals of M mountings and the part of the reference; see `known_noise`."""
    count = len(R)
    adjoints = np.zeros((6 * count, 6))  # of the inverse mountings
    for m in range(count):
        for i in range(3):
            for j in range(3):
                adjoints[6 * m + i, j] = adjoints[6 * m + 3 + i, 3 + j] = R[m, j, i]
                a, b = (j + 1) % 3, (j + 2) % 3
                adjoints[6 * m + 3 + i, j] = t[m, a] * R[m, b, i] - t[m, b] * R[m, a, i]  # -R^T hat(t)
    n, shared = len(reference), np.empty((6, 6))
    total, of_reference = np.empty((n, 6 * count, 6 * count)), np.empty((n, 6 * count, 6 * count))
    for k in range(n):
        for i in range(6):
            for j in range(6):
                shared[i, j] = reference[k, i, j] + (floor[i] if i == j else 0.0)
        _sandwich(adjoints, shared, of_reference[k])
        for i in range(6 * count):
            for j in range(6 * count):
                total[k, i, j] = of_reference[k, i, j]
        for m in range(count):
            both, arm = 0.0, 0.0
            for i in range(3):
                both += (reference[k, i, i] + members[m, k, i, i]) / 3
                arm += t[m, i] * t[m, i]
            second = both * both * arm / 8
            for i in range(6):
                for j in range(6):
                    total[k, 6 * m + i, 6 * m + j] += members[m, k, i, j]
                total[k, 6 * m + i, 6 * m + i] += floor[i] + (second if i >= 3 else 0.0)
    return total, of_reference


_LOGIT_RANGE = 5.0  # shares of 0.7 to 99.3 %
_COARSE, _FINE = 11, 14  # shares tried, then steps of the golden section
_STEP = 2 * _LOGIT_RANGE / (_COARSE - 1)
_SCORINGS = 12  # steps towards the level of one share
_ROUNDS = 3  # of weights and levels
_LEAST = 1e-4  # level of translation, of all that moves
TRANSLATION_FLOOR = 1e-9  # m; nothing is known better than rounding allows
_MEDIAN = float(chdtri(3, 0.5))
_LIMIT = float(chdtri(6, 0.001))
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


@njit()
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


@njit()
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


@njit()
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


@njit()
def _weight(squared: float) -> float:
    """Huber's weight of a residual in a covariance, falling faster beyond `_FAR` times the limit."""
    ratio = _LIMIT / max(squared, 1e-300)
    if ratio >= 1:
        return 1.0
    return math.sqrt(ratio) if ratio * _FAR * _FAR > 1 else _FAR * ratio


@njit()
def _across(fraction: float, means: Array) -> float:
    """Mean square per axis across the arm of what the fraction leaves."""
    return (means[2] - 2 * fraction * means[3] + fraction * fraction * means[4]) / 2


@njit()
def _level(fraction: float, means: Array, arm_variance: float) -> float:
    """q that maximises the likelihood, by Fisher scoring."""
    least = _LEAST * (means[1] + means[2]) + TRANSLATION_FLOOR**2
    extra, across = fraction * (1 - fraction) * arm_variance, _across(fraction, means)
    q = max(means[1], least)
    for _ in range(_SCORINGS):
        a, b = 1 / (q * q), 2 / (q + extra) ** 2
        q = max((a * means[1] + b * (across - extra)) / (a + b), least)
    return q


@njit()
def _cost(logit: float, means: Array, arm_variance: float, count: int) -> float:
    """Minus twice the logarithm of the likelihood and the prior per residual, at the best q."""
    fraction = _fraction_of(logit)
    q = _level(fraction, means, arm_variance)
    wide = q + fraction * (1 - fraction) * arm_variance
    cost = math.log(q) + means[1] / q + 2 * math.log(wide) + 2 * _across(fraction, means) / wide
    return cost - 2 * math.log(fraction * (1 - fraction)) / max(count, 1)


@njit()
def _best_logit(means: Array, arm_variance: float, count: int) -> float:
    """The best of a grid of shares."""
    best, lowest = 0.0, math.inf
    for k in range(_COARSE):
        logit = k * _STEP - _LOGIT_RANGE
        cost = _cost(logit, means, arm_variance, count)
        if cost < lowest:
            best, lowest = logit, cost
    return best


@njit()
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


@njit()
def _fraction_of(logit: float) -> float:
    return 1 / (1 + math.exp(-logit))
