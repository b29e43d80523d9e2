"""Times in text: exact integer nanoseconds, and the unit where nobody names it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from decimal import Decimal, InvalidOperation

import numpy as np

from rigwake._types import Array, Stamps

NS_PER_UNIT = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
_UNIT_WORDS = {
    "ns": ("ns", "nsec", "nsecs", "nanosec", "nanosecs", "nanosecond", "nanoseconds"),
    "us": ("us", "usec", "usecs", "µs", "μs", "microsec", "microsecond", "microseconds"),
    "ms": ("ms", "msec", "msecs", "millisec", "millisecond", "milliseconds"),
    "s": ("s", "sec", "secs", "second", "seconds"),
}
UNIT_OF_WORD = {word: unit for unit, words in _UNIT_WORDS.items() for word in words}
_YEAR_1990_S, _YEAR_2103_S = 6.3e8, 4.2e9
_LONGEST_STEP_S = 1e5
# Without a date the step tells: 2 ms to 2 s between samples, in the unit in which it is 2 to 2000
_SMALLEST_STEP = {"ns": 2e6, "us": 2e3, "ms": 2.0}
_NO_NUMBER = re.compile(
    r"[-+]?nan(\(\w*\))?|[-+]?1\.#(qnan|snan|ind|inf)\d*|null|none|n/?a|nil|<?missing>?", re.IGNORECASE
)
_DATE = re.compile(
    r"(\d{4}[-/]\d\d[-/]\d\d[T ]\d\d:\d\d:\d\d)([.,]\d{1,12})?\s*(Z|[-+]\d\d:?\d\d)?", re.ASCII
)
_LARGEST_NS = Decimal(2**62)


def unit_of_times(values: Array) -> str:
    """`s`, `ms`, `us` or `ns`: the unit in which these times are dates of today, else have steps of sensors.

    values: (N,) floats, NaN where unreadable. The median decides, so that a clock set on the way does not.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return "s"
    size = float(np.median(np.abs(finite)))
    steps = np.abs(np.diff(finite))
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for unit, factor in NS_PER_UNIT.items():
        per_second = 1e9 / factor
        is_date = _YEAR_1990_S <= size / per_second < _YEAR_2103_S
        if is_date and step / per_second < _LONGEST_STEP_S:
            return unit
    if step == 0.0:
        return "ns" if size >= 1e17 else "us" if size >= 1e14 else "ms" if size >= 1e11 else "s"
    is_whole = bool((finite == np.round(finite)).all())
    for unit, smallest in _SMALLEST_STEP.items():
        if step >= smallest * (1.0 if is_whole or unit != "ms" else 5.0):
            return unit
    return "s"


def plain_number(cell: str) -> str:
    """A cell as a number that Python reads: a date as seconds since 1970 (UTC where it names no zone), the many words
    for "no number" as nan; anything else as it is."""
    if not cell or _NO_NUMBER.fullmatch(cell):
        return "nan"
    found = _DATE.fullmatch(cell)
    if found is None:
        return cell
    try:
        zone = "+00:00" if found[3] in (None, "Z") else found[3]
        whole = datetime.fromisoformat(f"{found[1].replace(' ', 'T').replace('/', '-')}{zone}")
    except ValueError:
        return cell
    return f"{round(whole.timestamp())}{(found[2] or '').replace(',', '.')}"


def decimal_or_none(cell: str) -> Decimal | None:
    """The exact number in a cell; None if it is none, not finite or absurdly large."""
    try:
        value = Decimal(cell.strip())
    except (InvalidOperation, ValueError):
        return None
    return value if value.is_finite() and abs(value.adjusted()) < 30 else None


def unit_of_cells(values: Sequence[Decimal | None]) -> str:
    """`unit_of_times` of exact numbers."""
    return unit_of_times(np.array([np.nan if v is None else float(v) for v in values], dtype=np.float64))


def stamps_from_text(cells: Sequence[str], unit: str = "") -> Stamps:
    """Integer nanoseconds of times in text; unreadable or absurd ones are -1. Without a unit see `unit_of_times`."""
    plain = [plain_number(cell.strip()) for cell in cells]
    values = [decimal_or_none(cell) for cell in plain]
    is_date = any(
        before != after and after != "nan" for before, after in zip(map(str.strip, cells), plain, strict=True)
    )
    factor = NS_PER_UNIT["s" if is_date else unit or unit_of_cells(values)]
    stamps = (None if value is None else value * factor for value in values)
    exact = [-1 if ns is None or not 0 <= ns < _LARGEST_NS else round(ns) for ns in stamps]
    return np.array(exact, dtype=np.int64)
