"""Work on all cores, with the same result however many there are.

What one thread does depends on its part of the input alone, and goes to places of its own or comes back in order:
which thread does which part changes nothing. The compiled loops release the interpreter (`nogil`).
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Result = TypeVar("Result")

_MOST_RANGES = 12  # enough to even out, on a handful of cores, that some take longer than others
_AHEAD = 8  # results that wait for those before them
_here = threading.local()


def ranges(costs: NDArray[Any], least: float) -> NDArray[np.int64]:
    """Bounds of consecutive ranges of rows with about equal sums of `costs` (n,), none under `least`."""
    total = np.concatenate([[0.0], np.cumsum(costs)])
    parts = int(np.clip(total[-1] // least, 1, _MOST_RANGES))
    inner = np.searchsorted(total, total[-1] * np.arange(1, parts) / parts)
    return np.unique(np.concatenate([[0], inner, [len(costs)]])).astype(np.int64)


def over_ranges(bounds: NDArray[np.int64], work: Callable[[int, int], None]) -> None:
    """Call `work(first, last)` for every range; here if there is only one, else on the threads, which all such loops
    share. Within one of these threads, the ranges follow one another."""
    if len(bounds) <= 2:
        work(int(bounds[0]), int(bounds[-1]))
        return
    first, last = bounds[:-1].tolist(), bounds[1:].tolist()
    list(map(work, first, last) if _on_a_thread() else _threads().map(work, first, last))


def in_order(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """`work(item)` of every item, in the order of the items, some computed ahead on the threads."""
    if _on_a_thread():
        yield from map(work, items)
        return
    waiting: deque[Future[Result]] = deque()
    for item in items:
        waiting.append(_threads().submit(work, item))
        if len(waiting) > _AHEAD:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def one_blas_thread() -> AbstractContextManager[Any]:
    """Within it BLAS uses one thread: many small products are done sooner, and two of them can run side by side."""
    return _libraries().limit(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    # looks through all that is loaded, which takes as long as a small adjustment
    return ThreadpoolController()


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="rigwake", initializer=_mark_thread)


def _mark_thread() -> None:
    _here.on_a_thread = True


def _on_a_thread() -> bool:
    return getattr(_here, "on_a_thread", False)
