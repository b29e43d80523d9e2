"""Loops over ranges on all cores, with the same result however many there are.

Work is cut into ranges that depend on the problem alone, and every range writes to places of its own: which thread
does which range changes nothing. The compiled loops release the interpreter (`nogil`).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np

from rigwake.bundle.problem import Indices
from rigwake.geometry.so3 import Array

_MOST_RANGES = 12  # enough to even out, on a handful of cores, that some take longer than others


def ranges(costs: Array | Indices, least: float) -> Indices:
    """Bounds of consecutive ranges of rows with about equal sums of `costs` (n,), none under `least`."""
    total = np.concatenate([[0.0], np.cumsum(costs)])
    parts = int(np.clip(total[-1] // least, 1, _MOST_RANGES))
    inner = np.searchsorted(total, total[-1] * np.arange(1, parts) / parts)
    return np.unique(np.concatenate([[0], inner, [len(costs)]])).astype(np.int64)


def over_ranges(bounds: Indices, work: Callable[[int, int], None]) -> None:
    """Call `work(first, last)` for every range; here if there is only one, else on the threads, which all such loops
    share: `work` must not call this again."""
    if len(bounds) <= 2:
        work(0, int(bounds[-1]))
        return
    list(_threads().map(work, bounds[:-1].tolist(), bounds[1:].tolist()))


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="bundle")
