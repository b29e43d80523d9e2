"""File names that are times: all usual forms, told from counters.

1700000000033333333.png  1700000000033.png  1700000000.033333.png      ns, us, ms, s since 1970
front_1700000000033333333.png  000012_1700000000.033.png               with words and counters about them
1700000000-033333333.png  1700000000_33333.png                         seconds and a part of a second
20231114T221320.033Z.png  2023-11-14_22-13-20-033333.png               dates (taken as UTC)
0000000033333333.png  0.033333.png                                     since the start
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal

import numpy as np

from rigwake._types import Stamps
from rigwake.readers.stamp_units import NS_PER_UNIT, unit_of_times

_DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[T_ .-]{0,2}(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)"
    r"(?:[.,](\d{1,9})|[-_s]?(\d{3,9}))?(?!\d)"
)
_DECIMAL = re.compile(r"(?<![\d.])(\d{1,12})\.(\d{1,12})(?![\d.])")
_SECONDS_AND_PART = re.compile(r"(?<!\d)(\d{9,10})[-_](\d{1,9})(?!\d)")
_DIGITS = re.compile(r"\d+")
_SMALLEST_STEP = 1000  # of whole numbers: counters rise by less
_LEAST_FRACTION = 0.9


def stamps_of_names(stems: Sequence[str]) -> tuple[list[int], Stamps] | None:
    """Which of the names (without suffix) are times, and these in nanoseconds; None if the names are no times.

    Nine of ten names must have the form, be different and not mere counters.
    """
    for form in (_dated, _decimal_seconds, _seconds_and_part, _whole_numbers):
        found = form(stems)
        kept = [at for at, stamp in enumerate(found) if stamp is not None]
        stamps = np.array([stamp for stamp in found if stamp is not None], dtype=np.int64)
        if (
            len(kept) >= _LEAST_FRACTION * len(stems)
            and len(np.unique(stamps)) >= _LEAST_FRACTION * len(kept) > 0
        ):
            return kept, stamps
    return None


def _dated(stems: Sequence[str]) -> list[int | None]:
    return [_date_ns(match) if (match := _DATE.search(stem)) else None for stem in stems]


def _date_ns(match: re.Match[str]) -> int | None:
    try:
        moment = datetime(*(int(match[i]) for i in range(1, 7)), tzinfo=UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return None
    return int(moment.timestamp()) * 10**9 + int((match[7] or match[8] or "0").ljust(9, "0"))


def _decimal_seconds(stems: Sequence[str]) -> list[int | None]:
    matches = [list(_DECIMAL.finditer(stem)) for stem in stems]
    numbers = [Decimal(f"{m[-1][1]}.{m[-1][2]}") if m else None for m in matches]
    values = np.array([np.nan if n is None else float(n) for n in numbers])
    finite = values[np.isfinite(values)]
    if not len(finite) or not (np.diff(np.sort(finite)) > 0).any():
        return [None] * len(stems)
    factor = NS_PER_UNIT[unit_of_times(np.sort(finite))]
    return [None if n is None or n * factor >= 2**62 else round(n * factor) for n in numbers]


def _seconds_and_part(stems: Sequence[str]) -> list[int | None]:
    """A part of varying length counts nanoseconds (longest 7 to 9 digits) or microseconds; of one length it is a
    fraction."""
    matches = [_SECONDS_AND_PART.search(stem) for stem in stems]
    lengths = {len(m[2]) for m in matches if m}
    longest = max(lengths, default=0)
    whole = longest if len(lengths) == 1 else 9 if longest > 6 else 6 if longest > 3 else 3
    return [
        int(m[1]) * 10**9 + int(m[2]) * 10 ** (9 - whole)
        if m and 6e8 < int(m[1]) < 4.2e9 and int(m[2]) < 10**whole
        else None
        for m in matches
    ]


def _whole_numbers(stems: Sequence[str]) -> list[int | None]:
    """The group of digits that is a date of today, else the one whose steps are those of a clock."""
    groups = [[int(digits) for digits in _DIGITS.findall(stem)[:8] if len(digits) < 25] for stem in stems]
    count = max(set(map(len, groups)), key=[len(g) for g in groups].count, default=0)
    best: tuple[bool, list[int | None]] | None = None
    for place in range(count):
        values = [group[place] if len(group) == count else None for group in groups]
        known = np.sort(np.array([float(v) for v in values if v is not None]))
        steps = np.diff(np.unique(known))
        if not len(steps):
            continue
        unit = unit_of_times(known)
        is_today = known[len(known) // 2] * NS_PER_UNIT[unit] > 6e17
        if not is_today and (np.median(steps) < _SMALLEST_STEP or unit == "s"):
            continue
        if is_today and unit == "s" and np.median(steps) < 1:
            continue
        stamps = [
            None if v is None or v * NS_PER_UNIT[unit] >= 2**62 else v * NS_PER_UNIT[unit] for v in values
        ]
        if best is None or (is_today and not best[0]):
            best = is_today, stamps
    return best[1] if best is not None else [None] * len(stems)
