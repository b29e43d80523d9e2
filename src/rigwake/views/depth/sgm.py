"""Semi-global matching in a picture that goes all around: its left and right edge are neighbours (compiled).

Source of the method: Hirschmueller (2008), *Stereo Processing by Semiglobal Matching and Mutual Information*. The path
along a row is a ring without a beginning: it is followed until it repeats itself, so that nothing depends on where the
picture was cut open.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array, Floats

_FAST = {"nnan", "ninf", "nsz", "reassoc"}  # costs are finite integers: minima may be taken in any order
_LAPS = 3  # a ring that has not repeated itself by then is left as it is
_LARGE = np.float32(1e9)


@njit(nogil=True, fastmath=_FAST)
def _least(values: Array) -> float:
    least = values[0]
    for d in range(1, len(values)):
        least = min(least, values[d])
    return least


@njit(nogil=True, fastmath=_FAST)
def _step(cost: Any, previous: Array, following: Array, p1: Any, p2: Any) -> None:
    """One pixel further along a path. previous, following: (D + 2,) with a large value at both ends."""
    count = len(cost)
    least = _least(previous[1 : count + 1])
    for d in range(count):
        beside = min(previous[d], previous[d + 2]) + p1
        best = min(min(previous[d + 1], least + p2), beside)
        following[d + 1] = np.float32(cost[d]) + best - least


@njit(nogil=True)
def _is_same(a: Array, b: Array) -> bool:
    for d in range(len(a)):  # noqa: SIM110 (compiled)
        if a[d] != b[d]:
            return False
    return True


@njit(nogil=True)
def _around(cost: Any, direction: int, p1: Any, p2: Any, paths: Array) -> None:
    """Path costs (W, D + 2) around a row of costs (W, D)."""
    columns, count = cost.shape
    state = np.full(count + 2, _LARGE, np.float32)
    fresh = np.full(count + 2, _LARGE, np.float32)
    state[1 : count + 1] = 0
    for lap in range(_LAPS):
        for k in range(columns):
            c = k if direction > 0 else columns - 1 - k
            _step(cost[c], state, fresh, p1, p2)
            if lap > 0 and _is_same(fresh, paths[c]):
                return
            paths[c] = fresh
            state[:] = fresh


@njit(nogil=True)
def _summed_down(cost: Any, p1: Any, p2: Any) -> Any:
    """(H, W, D) sums of the paths around the rows, both ways, and of the path down the columns."""
    rows, columns, count = cost.shape
    total = np.empty((rows, columns, count), np.float32)
    right = np.full((columns, count + 2), _LARGE, np.float32)
    left, above, here = right.copy(), right.copy(), right.copy()
    above[:, 1 : count + 1] = 0
    for r in range(rows):
        _around(cost[r], 1, p1, p2, right)
        _around(cost[r], -1, p1, p2, left)
        for c in range(columns):
            _step(cost[r, c], above[c], here[c], p1, p2)
            for d in range(count):
                total[r, c, d] = right[c, d + 1] + left[c, d + 1] + here[c, d + 1]
        above, here = here, above
    return total


@njit(nogil=True)
def _chosen(sums: Array) -> tuple[float, float]:
    """The level of the least of (D,) sums, between levels, and the least of the others over it (1: as good)."""
    count, best = len(sums), 0
    for d in range(1, count):
        if sums[d] < sums[best]:
            best = d
    second = _LARGE
    for d in range(count):
        if abs(d - best) > 1 and sums[d] < second:
            second = sums[d]
    level = float(best)
    if 0 < best < count - 1:
        before, at, after = sums[best - 1], sums[best], sums[best + 1]
        # the lesser slope is the steeper one beside a minimum of absolute differences
        steep = max(before - at, after - at)
        if steep > 0:
            level += 0.5 * (before - after) / steep
    return level, second / max(sums[best], 1.0)


@njit(nogil=True)
def _matched_up(cost: Any, total: Array, p1: Any, p2: Any, level: Array, ratio: Array) -> None:
    """Add the path up the columns to the sums and choose."""
    rows, columns, count = cost.shape
    below = np.full((columns, count + 2), _LARGE, np.float32)
    here = below.copy()
    below[:, 1 : count + 1] = 0
    for r in range(rows - 1, -1, -1):
        for c in range(columns):
            _step(cost[r, c], below[c], here[c], p1, p2)
            for d in range(count):
                total[r, c, d] += here[c, d + 1]
            level[r, c], ratio[r, c] = _chosen(total[r, c])
        below, here = here, below


def match_around(cost: NDArray[np.uint8], p1: float = 12.0, p2: float = 60.0) -> tuple[Floats, Floats]:
    """Levels (H, W), fractions of one, that cost least along four paths, and (H, W) by how much any other costs more
    (a ratio, 1 and more).

    cost: (H, W, D) of D levels in a picture whose first column follows its last. p1, p2: of a change by one level and
    of any larger one from a pixel to the next.
    """
    level, ratio = np.empty(cost.shape[:2], np.float32), np.empty(cost.shape[:2], np.float32)
    cost = np.ascontiguousarray(cost)
    steps = np.float32(p1), np.float32(p2)
    _matched_up(cost, _summed_down(cost, *steps), *steps, level, ratio)
    return level, ratio
