"""Compiled statistics of residuals: robust variances, prediction errors, propagated covariances."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rigwake._types import Array


@njit(cache=True)
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


@njit(cache=True)
def robust_mean(squared: Array, median_of_unit: float, limit: float) -> float:
    """Mean with outliers pulled in to `limit` times the scale that the median tells."""
    if len(squared) == 0:
        return 0.0
    highest = np.median(squared) / median_of_unit * limit
    total = 0.0
    for value in squared:
        total += min(value, highest)
    return total / len(squared)


@njit(cache=True)
def squared_lengths(rows: Array, known: NDArray[np.bool_], first: int) -> Array:
    """`|r|^2` of the three columns from `first` on, of the known rows."""
    out, i = np.empty(known.sum()), 0
    for k in range(len(rows)):
        if known[k]:
            out[i] = rows[k, first] ** 2 + rows[k, first + 1] ** 2 + rows[k, first + 2] ** 2
            i += 1
    return out


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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
