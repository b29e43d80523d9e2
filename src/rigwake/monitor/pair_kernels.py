"""Epipolar residuals of tracks over a second, and what they say about a camera's mounting: compiled loops.

With bearings `u1`, `u2` in rig axes, `v = R u2`, and the camera's way `w = (R - I) p + t` (p: its place on the rig),
the residual is `e = u1 . (w x v)`, over its standard deviation s (Sampson),
`s^2 = std1^2 |w x v|^2 + std2^2 |u1 x w|^2`. Derivatives of e, in rig axes:

    mounting turned by d      u1 x n + u2 x R^T (u1 x w)       n = w x v, m = v x u1
    mounting moved by d       (R - I)^T m
    rig turned by f (left)    v x (u1 x w) + R p x m
    rig moved by t            m
    clock later by s          the last two along the rig's own motion

and s changes with all of them, too. Left out, noise would pull every way towards zero (Kanatani, *Renormalization for
unbiased estimation*, 1993).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rigwake._kernels import njit
from rigwake._types import Array, Indices

MOUNTING = 7  # unknowns of a camera: rotation, translation, clock
LOSS_STDS = 3.0
COLUMNS = 14  # the seven, the rig's rotation and velocity, the residual

_options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


@njit(**_options)
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(**_options)
def _times(R: Array, a: Array, transposed: bool, out: Array) -> None:
    for i in range(3):
        out[i] = 0.0
        for j in range(3):
            out[i] += (R[j, i] if transposed else R[i, j]) * a[j]


@njit(**_options)
def _by_way(way: Array, u1: Array, v: Array, variance1: float, variance2: float, out: Array) -> None:
    """Half the derivative of s^2 by the way of the camera."""
    along1 = u1[0] * way[0] + u1[1] * way[1] + u1[2] * way[2]
    along2 = v[0] * way[0] + v[1] * way[1] + v[2] * way[2]
    for j in range(3):
        out[j] = variance1 * (way[j] - along2 * v[j]) + variance2 * (way[j] - along1 * u1[j])


@njit(**_options)
def _residual(
    u1: Array, v: Array, way: Array, variance1: float, variance2: float, m: Array, by_way: Array
) -> tuple[float, float]:
    """Residual over its standard deviation, and that one's inverse; `m`, and the derivative by the way."""
    n0 = way[1] * v[2] - way[2] * v[1]
    n1 = way[2] * v[0] - way[0] * v[2]
    n2 = way[0] * v[1] - way[1] * v[0]
    k0 = u1[1] * way[2] - u1[2] * way[1]
    k1 = u1[2] * way[0] - u1[0] * way[2]
    k2 = u1[0] * way[1] - u1[1] * way[0]
    e = u1[0] * n0 + u1[1] * n1 + u1[2] * n2
    variance = (n0 * n0 + n1 * n1 + n2 * n2) * variance1 + (k0 * k0 + k1 * k1 + k2 * k2) * variance2
    scale = 1 / np.sqrt(max(variance, 1e-24))
    _cross(v, u1, m)
    _by_way(way, u1, v, variance1, variance2, by_way)
    for j in range(3):
        by_way[j] = (m[j] - e * scale * scale * by_way[j]) * scale
    return e * scale, scale


@njit(**_options)
def pair_residuals(
    first: Array, second: Array, std: Array, pair: Indices, rotation: Array, way: Array, out: Array
) -> None:
    """Residuals (N,) over their standard deviations.

    first, second: (N, 3) bearings in rig axes; std: (N, 2) radians; rotation: (P, 3, 3); way: (P, 3).
    """
    v, m, by_way = np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(pair)):
        p = pair[i]
        _times(rotation[p], second[i], False, v)
        out[i], _ = _residual(first[i], v, way[p], std[i, 0] ** 2, std[i, 1] ** 2, m, by_way)


@njit(**_options)
def accumulate_velocity(
    first: Array,
    second: Array,
    std: Array,
    pair: Indices,
    rotation: Array,
    way: Array,
    by_velocity: Array,
    slot: Indices,
    width: Array,
    H: Array,
    g: Array,
) -> None:
    """Add to the normal equations (S, 3, 3) and (S, 3) of the slots' velocities, `H step = -g`.

    slot, width: (P,) of each pair its slot, and its noise in units of what its tracks predict; the loss is
    Geman and McClure's at three times that.
    """
    v, m, by_way, row = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(pair)):
        p = pair[i]
        _times(rotation[p], second[i], False, v)
        r, _ = _residual(first[i], v, way[p], std[i, 0] ** 2, std[i, 1] ** 2, m, by_way)
        _times(by_velocity[p], by_way, True, row)
        w = 1 / (1 + (r / (LOSS_STDS * width[p])) ** 2) ** 2 / width[p] ** 2
        for j in range(3):
            g[slot[p], j] += w * r * row[j]
            for q in range(3):
                H[slot[p], j, q] += w * row[j] * row[q]


@njit(**_options)
def accumulate(
    first: Array,
    second: Array,
    std: Array,
    weight: Array,
    pair: Indices,
    rotation: Array,
    way: Array,
    by_velocity: Array,
    place: Array,
    turning: Array,
    drift: Array,
    turning_first: Array,
    products: Array,
    rows: Array,
) -> None:
    """Add the products (P, 14, 14) of all derivatives and the residual, weighted; and leave the rows (N, 14).

    place: (P, 3) of the pair's camera on the rig. The last column is the residual with its sign turned: normal
    equations `H x = g` have `g` in it.
    """
    v, n, m, k = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    a, b, c, row = np.empty(3), np.empty(3), np.empty(3), np.empty(COLUMNS)
    for i in range(len(pair)):
        p = pair[i]
        R, u1, u2 = rotation[p], first[i], second[i]
        _times(R, u2, False, v)
        _cross(way[p], v, n)
        _cross(v, u1, m)
        _cross(u1, way[p], k)
        e = u1[0] * n[0] + u1[1] * n[1] + u1[2] * n[2]
        variance = (n[0] ** 2 + n[1] ** 2 + n[2] ** 2) * std[i, 0] ** 2
        variance += (k[0] ** 2 + k[1] ** 2 + k[2] ** 2) * std[i, 1] ** 2
        scale = 1 / np.sqrt(max(variance, 1e-24))
        along1 = u1[0] * way[p, 0] + u1[1] * way[p, 1] + u1[2] * way[p, 2]
        along2 = v[0] * way[p, 0] + v[1] * way[p, 1] + v[2] * way[p, 2]
        change = e * scale**2
        by_u1, by_v = change * along1 * std[i, 1] ** 2, change * along2 * std[i, 0] ** 2
        _cross(u1, n, a)
        _times(R, k, True, b)
        _cross(u2, b, c)
        # of s: -(v.w) R^T (v x w), where v x w = -n, and -(u1.w) (u1 x w)
        _times(R, n, True, b)
        for j in range(3):
            row[j] = a[j] + c[j] - by_v * b[j] + by_u1 * k[j]
        _by_way(way[p], u1, v, std[i, 0] ** 2, std[i, 1] ** 2, b)
        for j in range(3):
            m[j] -= change * b[j]
        _times(R, m, True, b)
        for j in range(3):
            row[3 + j] = b[j] - m[j]
        _cross(v, k, a)
        _times(R, place[p], False, b)
        _cross(b, m, c)
        row[6] = 0.0
        for j in range(3):
            row[7 + j] = a[j] + c[j] - by_v * n[j]
            row[6] += row[7 + j] * turning[p, j]
        # the translation is way - (R - I) place
        for j in range(3):
            b[j] = way[p, j] - b[j] + place[p, j]
        _cross(turning_first[p], b, c)
        for j in range(3):
            row[6] += m[j] * (drift[p, j] - c[j])
            row[10 + j] = 0.0
            for q in range(3):
                row[10 + j] += m[q] * by_velocity[p, q, j]
        row[13] = -e
        for j in range(COLUMNS):
            row[j] *= scale
            rows[i, j] = row[j]
        for j in range(COLUMNS):
            for q in range(j + 1):
                products[p, j, q] += weight[i] * row[j] * row[q]


@njit(**_options)
def sum_by(index: Indices, values: Array, weight: Array, out: Array) -> None:
    """Add `weight * values` (N, K) to the rows `index` (N,) of `out`."""
    for i in range(len(index)):
        for j in range(values.shape[1]):
            out[index[i], j] += weight[i] * values[i, j]


@njit(**_options)
def times(matrices: Array, vectors: Array) -> Array:
    """(M, 3) products of matrices (M, 3, 3) and vectors (M, 3)."""
    out = np.empty((len(vectors), 3))
    for i in range(len(vectors)):
        for j in range(3):
            out[i, j] = (
                matrices[i, j, 0] * vectors[i, 0]
                + matrices[i, j, 1] * vectors[i, 1]
                + matrices[i, j, 2] * vectors[i, 2]
            )
    return out


@njit(**_options)
def cross(first: Array, second: Array) -> Array:
    """(M, 3) cross products."""
    out = np.empty((len(first), 3))
    for i in range(len(first)):
        _cross(first[i], second[i], out[i])
    return out


@njit(**_options)
def sum_products(sector: Indices, values: Array, weight: Array, out: Array) -> None:
    """Add the products of `values` (N, K) with themselves, weighted, to `out` (S, K, K) by sector (N,)."""
    for i in range(len(sector)):
        for j in range(values.shape[1]):
            for q in range(values.shape[1]):
                out[sector[i], j, q] += weight[i] * values[i, j] * values[i, q]
