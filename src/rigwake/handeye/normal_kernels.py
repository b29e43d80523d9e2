"""Compiled normal equations: weights, information, scores, and the information that noise adds spuriously."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array

_TILE = 2048  # steps at a time: fits the cache


@njit()
def inverted(total: Array, of_reference: Array) -> tuple[Array, Array, Array]:
    """Of covariances (n, p, p): `S^-1`, `Sa S^-1` and `Sa - Sa S^-1 Sa`. S is scaled to unit diagonal to be
    inverted (rotation and translation differ by many decades)."""
    p = total.shape[1]
    inverses, gains, left = np.empty_like(total), np.empty_like(total), np.empty_like(total)
    scale, normalised = np.empty(p), np.empty((p, p))
    for k in range(len(total)):
        for i in range(p):
            scale[i] = 1 / math.sqrt(total[k, i, i])
        for i in range(p):
            for j in range(p):
                normalised[i, j] = total[k, i, j] * scale[i] * scale[j]
        inverse = np.linalg.inv(normalised)
        for i in range(p):
            for j in range(p):
                inverses[k, i, j] = inverse[i, j] * scale[i] * scale[j]
        np.dot(of_reference[k], inverses[k], gains[k])
        np.dot(gains[k], of_reference[k], left[k])
        for i in range(p):
            for j in range(p):
                left[k, i, j] = of_reference[k, i, j] - left[k, i, j]
    return inverses, gains, left


@njit()
def weigh(
    residuals: Array,
    filtered: Array,
    steps: NDArray[np.int64],
    rows: NDArray[np.int64],
    inverse: Array,
    gain: Array,
    limit: float,
    weights: Array,
    reference_errors: Array,
) -> Array:
    """`rho S^-1 r` of the filtered residuals of the steps: (n, p); inverse, blame (1 or n, p, p).

    Huber's weights rho (beyond `limit`) are written to `weights`. What noise cannot explain (an outlier, or a
    poor start) is not the reference's error either: `rho blame r` goes to `reference_errors`.
    """
    weighted = np.zeros((len(steps), len(rows)))
    for i in range(len(steps)):
        k, w = steps[i], i if len(inverse) > 1 else 0
        squared = 0.0
        for a in range(len(rows)):
            for b in range(len(rows)):
                weighted[i, a] += inverse[w, a, b] * filtered[k, rows[b]]
            squared += weighted[i, a] * filtered[k, rows[a]]
        rho = math.sqrt(min(1.0, limit / max(squared, 1e-300)))
        weights[k] = rho
        for a in range(len(rows)):
            weighted[i, a] *= rho
            error = 0.0
            for b in range(len(rows)):
                error += gain[w, a, b] * residuals[k, rows[b]]
            reference_errors[k, rows[a]] = rho * error
    return weighted


@njit()
def add_information(
    Jm: Array,
    Jn: Array,
    W: Array,
    first: tuple[int, int],
    weights: Array,
    steps: NDArray[np.int64],
    out: Array,
    at: tuple[int, int],
) -> None:
    """Add `sum_k rho_k Jm_k^T W_k Jn_k` over the steps to `out`, from row and column `at` on.

    W: (1 or len(steps), p, p), of which the 6 x 6 block from row and column `first` on.
    """
    p, q, block = Jm.shape[2], Jn.shape[2], np.empty((6, 6))
    for start in range(0, len(steps), _TILE):
        chosen = steps[start : start + _TILE]
        n = len(chosen)
        right = _tile(Jn, chosen, weights)
        left = right if at[0] == at[1] else _tile(Jm, chosen, weights)
        if len(W) == 1:
            for a in range(6):
                for b in range(6):
                    block[a, b] = W[0, first[0] + a, first[1] + b]
            weighted = np.dot(block, right.reshape(6, n * q))
        else:
            weighted = np.zeros((6, n * q))
            for i in range(n):
                for a in range(6):
                    for b in range(6):
                        for c in range(i * q, i * q + q):
                            weighted[a, c] += (
                                W[start + i, first[0] + a, first[1] + b] * right[b, i, c - i * q]
                            )
        total = np.dot(left.reshape(6 * n, p).T, weighted.reshape(6 * n, q))
        for r in range(p):
            for c in range(q):
                out[at[0] + r, at[1] + c] += total[r, c]


@njit()
def _tile(J: Array, steps: NDArray[np.int64], weights: Array) -> Array:
    """(6, n, P): `sqrt(rho) J` of the steps, rows first, so that one product of matrices serves all of them."""
    out = np.empty((6, len(steps), J.shape[2]))
    for i in range(len(steps)):
        k = steps[i]
        factor = math.sqrt(weights[k])
        for a in range(6):
            for c in range(J.shape[2]):
                out[a, i, c] = factor * J[k, a, c]
    return out


@njit()
def add_scores(J: Array, weighted: Array, first: int, steps: NDArray[np.int64], out: Array, at: int) -> None:
    """`out[k] += J_k^T weighted_i` for the i-th of the steps k; weighted from column `first` on, out from `at` on."""
    for i in range(len(steps)):
        k = steps[i]
        for a in range(6):
            for c in range(J.shape[2]):
                out[k, at + c] += J[k, a, c] * weighted[i, first + a]


@njit()
def spurious(
    covariances: Array,
    weights: Array,
    adjoints: Array,
    ways: Array,
    segments: NDArray[np.int64],
    steps: NDArray[np.int64],
    world_count: int,
    scale_start: int,
    size: int,
    scale_count: int,
) -> Array:
    """`sum E[dJ^T W dJ]` over the steps, for errors of `covariances`, like `weights` (1 or len(steps), 6, 6).

    An error e changes the columns of the frame by `ad(e) Ad(C^-1)` and that of a scale by
    `ad(e) [0, way] - [0, e_t]`: both are `D(e) Z`, Z (7, 7) from the step alone.
    """
    total, units = np.zeros((size, size)), _error_units()
    columns, M = np.empty(7, dtype=np.int64), np.empty((7, 7))
    alike = len(covariances) == 1 and len(weights) == 1
    start = 0
    while start < len(steps):
        end, s = start + 1, segments[steps[start]]
        while alike and end < len(steps) and segments[steps[end]] == s:
            end += 1
        if start == 0 or not alike:
            c, w = start if len(covariances) > 1 else 0, start if len(weights) > 1 else 0
            M = _spread(units, covariances[c], weights[w])
        here = _carried_by_steps(M, adjoints, ways, steps[start:end])
        for c in range(6):
            columns[c] = c if world_count == 0 else 6 + 6 * s + c
        columns[6] = scale_start + s
        used = 7 if s < scale_count else 6
        for r in range(used):
            for c in range(used):
                total[columns[r], columns[c]] += here[r, c]
        start = end
    return total


@njit()
def _carried_by_steps(M: Array, adjoints: Array, ways: Array, steps: NDArray[np.int64]) -> Array:
    """`sum_k Z_k^T M Z_k` (7, 7), `Z = [[Ad(C^-1), [0, way]], [0, 1]]`."""
    n = len(steps)
    Z = np.zeros((7, n, 7))
    for i in range(n):
        for r in range(6):
            for c in range(6):
                Z[r, i, c] = adjoints[steps[i], r, c]
        for r in range(3):
            Z[3 + r, i, 6] = ways[steps[i], r]
        Z[6, i, 6] = 1.0
    MZ = np.dot(M, Z.reshape(7, 7 * n))
    return np.dot(Z.reshape(7 * n, 7).T, MZ.reshape(7 * n, 7))


@njit()
def _error_units() -> Array:
    """(6, 7, 6): `D(e)^T`, `D(e) = [ad(e), -[0, e_t]]`, of the six unit errors."""
    units = np.zeros((6, 7, 6))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for first, second in ((0, 0), (0, 3), (3, 0)):  # ad has hat(rotation) twice, and hat(translation)
            units[first + i, second + j, first + second + k] = 1.0
            units[first + i, second + k, first + second + j] = -1.0
        units[3 + i, 6, 3 + i] = -1.0
    return units


@njit()
def _spread(units: Array, covariance: Array, W: Array) -> Array:
    """`E[D(e)^T W D(e)]` (7, 7) over errors e of the covariance."""
    mixed = np.dot(covariance, units.reshape(6, 42)).reshape(6, 7, 6)
    weighted = np.dot(units.reshape(42, 6), W).reshape(6, 7, 6)
    total = np.zeros((7, 7))
    for e in range(6):
        for r in range(7):
            for c in range(7):
                for i in range(6):
                    total[r, c] += weighted[e, r, i] * mixed[e, c, i]
    return total


@njit()
def split_observable(
    information: Array, spurious: Array, required_ratio: float, rounding: float
) -> tuple[Array, Array, Array]:
    """See `information.split_observable`: basis (P, q), genuine (q,), rest (P, P - q).

    The matrix is scaled to unit diagonal first: only then are its small eigenvalues those of the motion and
    not of rounding, for the unknowns differ by many decades.
    """
    size = len(information)
    scale = np.zeros(size)
    for i in range(size):
        if information[i, i] > 0:
            scale[i] = 1 / math.sqrt(information[i, i])
    normalised, absent = np.empty((size, size)), 0
    for i in range(size):
        for j in range(size):
            normalised[i, j] = information[i, j] * scale[i] * scale[j]
    values, vectors = np.linalg.eigh(normalised)
    while absent < size and values[absent] <= rounding:  # in ascending order
        absent += 1
    present = size - absent
    whitened, genuine = np.empty((size, present)), np.empty(0)
    for i in range(size):
        for c in range(present):
            whitened[i, c] = vectors[i, absent + c] * scale[i] / math.sqrt(values[absent + c])
    if present > 0:
        within = np.eye(present) - np.dot(whitened.T, np.dot(spurious, whitened))
        genuine, turned = np.linalg.eigh(within)
        whitened = np.dot(whitened, turned)
    first = 0
    while first < present and genuine[first] <= required_ratio * (1 - genuine[first]):
        first += 1
    rest = np.empty((size, absent + first))
    for i in range(size):
        for c in range(absent):
            rest[i, c] = vectors[i, c] * (scale[i] if scale[i] > 0 else 1.0)
        for c in range(first):
            rest[i, absent + c] = whitened[i, c]
    return whitened[:, first:].copy(), genuine[first:].copy(), rest


@njit()
def bounded_step(basis: Array, scores: Array, limits: Array) -> tuple[Array, float]:
    """The Gauss-Newton step in the whitened `basis`, no unknown beyond its limit, and its length in whitened units."""
    gradient, step = np.zeros(len(basis)), np.zeros(len(basis))
    for k in range(len(scores)):
        for i in range(len(basis)):
            gradient[i] += scores[k, i]
    squared, shorten = 0.0, 1.0
    for c in range(basis.shape[1]):
        coefficient = 0.0
        for i in range(len(basis)):
            coefficient -= basis[i, c] * gradient[i]
        squared += coefficient * coefficient
        for i in range(len(basis)):
            step[i] += coefficient * basis[i, c]
    for i in range(len(basis)):
        shorten = min(shorten, limits[i] / max(abs(step[i]), 1e-300))
    for i in range(len(basis)):
        step[i] *= shorten
    return step, math.sqrt(squared)
