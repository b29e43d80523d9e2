"""The cheapest cut of columns into water, obstacles and sky, by dynamic programming over all cuts (compiled)."""

from __future__ import annotations

from typing import Any

import numpy as np

from rigwake._kernels import njit
from rigwake._types import Array

_PIECE_COST = 5.0  # nats per piece: rows of one column are far from independent
_BEHIND_COST = 3.0  # water seen behind an obstacle, over its top
_OVERHEAD_COST = 6.0  # an obstacle above the sky
_SLACK_ROWS = 2  # waves and errors of the attitude carry water above the horizon


@njit(nogil=True)
def _spread(w: float, wv: float, wvv: float) -> float:
    """Half the weighted squared deviation from the mean, of sums of weights, values and squares."""
    return 0.5 * max(wvv - wv * wv / w, 0.0) if w > 0 else 0.0


@njit(nogil=True)
def cut_columns(
    cost: Array,
    weight: Array,
    value: Array,
    contact: Array,
    contact_std: Array,
    lowest: Any,
    highest: Any,
    horizon: int,
) -> tuple[Any, Any]:
    """The cheapest cut of every column (first axis). cost: (C, 3, R). weight, value: (C, R) of matched inverse
    distances. contact, contact_std: (C, R + 1) inverse distance of a foot at each row edge. Rows `highest` to `lowest`
    (excluded) are cut.

    Returns counts (C,) and (C, R, 4): bottom, top, kind, whether it stands in water.
    """
    columns, _, rows = cost.shape
    counts = np.zeros(columns, np.int64)
    cut = np.zeros((columns, rows, 4))
    for c in range(columns):
        if lowest[c] > highest[c]:
            sums = _sums_below(cost[c], weight[c], value[c], lowest[c], highest[c])
            best, start, before = _best_below(
                sums, contact[c], contact_std[c], lowest[c], highest[c], horizon
            )
            counts[c] = _read_cut(best, start, before, lowest[c], highest[c], cut[c])
    return counts, cut


@njit(nogil=True)
def _sums_below(cost: Array, weight: Array, value: Array, low: int, high: int) -> Array:
    """(6, R + 1) sums over the rows below an edge (edge r is the upper side of row r): costs of the three kinds,
    weights, weighted values and squares."""
    sums = np.zeros((6, len(weight) + 1))
    for r in range(low - 1, high - 1, -1):
        for k in range(3):
            sums[k, r] = sums[k, r + 1] + cost[k, r]
        sums[3, r] = sums[3, r + 1] + weight[r]
        sums[4, r] = sums[4, r + 1] + weight[r] * value[r]
        sums[5, r] = sums[5, r + 1] + weight[r] * value[r] ** 2
    return sums


@njit(nogil=True)
def _best_below(
    sums: Array, contact: Array, contact_std: Array, low: int, high: int, horizon: int
) -> tuple[Any, Any, Any]:
    """(3, R + 1) each: the least cost of everything below an edge if its highest piece is of a kind, the lower edge of
    that piece, and the kind of the piece under it (-1: none)."""
    shape = (3, sums.shape[1])
    best, start, before = np.full(shape, np.inf), np.zeros(shape, np.int64), np.full(shape, -1, np.int64)
    for r in range(low - 1, high - 1, -1):
        for e in range(r + 1, low + 1):  # the piece from edge e up to edge r
            first = e == low
            water, obstacle, sky = best[0, e], best[1, e], best[2, e]
            if r >= horizon - _SLACK_ROWS:
                below = 0.0 if first else obstacle + _BEHIND_COST
                total = below + _PIECE_COST + sums[0, r] - sums[0, e]
                if total < best[0, r]:
                    best[0, r], start[0, r], before[0, r] = total, e, (-1 if first else 1)
            dw, dwv, dwvv = sums[3, r] - sums[3, e], sums[4, r] - sums[4, e], sums[5, r] - sums[5, e]
            shared = _PIECE_COST + sums[1, r] - sums[1, e]
            loose = shared + _spread(dw, dwv, dwvv)
            below, kind = (0.0, -1) if first else (obstacle, 1)
            if not first and sky + _OVERHEAD_COST < below:
                below, kind = sky + _OVERHEAD_COST, 2
            if below + loose < best[1, r]:
                best[1, r], start[1, r], before[1, r] = below + loose, e, kind
            if not first and water < best[1, r]:
                cw = 1 / contact_std[e] ** 2
                cv = contact[e]
                total = water + shared + _spread(dw + cw, dwv + cw * cv, dwvv + cw * cv * cv)
                if total < best[1, r]:
                    best[1, r], start[1, r], before[1, r] = total, e, 0
            if e <= horizon + _SLACK_ROWS:
                below, kind = (0.0, -1) if first else (min(water, obstacle), 0 if water < obstacle else 1)
                total = below + _PIECE_COST + sums[2, r] - sums[2, e]
                if total < best[2, r]:
                    best[2, r], start[2, r], before[2, r] = total, e, kind
    return best, start, before


@njit(nogil=True)
def _read_cut(best: Array, start: Any, before: Any, low: int, high: int, cut: Array) -> int:
    """Fill in the pieces of a column (R, 4), from the bottom up; their number."""
    kind = int(np.argmin(best[:, high]))
    r, n = high, 0
    while kind >= 0 and r < low:
        e, under = start[kind, r], before[kind, r]
        stands = 1.0 if kind == 1 and under == 0 else 0.0
        cut[n, 0], cut[n, 1], cut[n, 2], cut[n, 3] = e, r, kind, stands
        r, kind, n = e, under, n + 1
    cut[:n] = cut[:n][::-1].copy()
    return n
