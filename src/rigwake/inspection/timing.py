"""Rates, jitter and gaps of a sensor, from its stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Stamps

GAP_PERIODS = 1.6
"""Two stamps further apart than this many median periods enclose dropped samples."""


@dataclass(frozen=True)
class Timing:
    """Timing of one sensor; rates and jitter are NaN where there are fewer than three samples.

    jitter_ms: standard deviation of the period, gaps left out. dropped: samples that the gaps would have held.
    """

    samples: int
    start_ns: int
    end_ns: int
    rate_hz: float
    jitter_ms: float
    gaps: int
    longest_gap_s: float
    dropped: int

    @property
    def duration_s(self) -> float:
        """Seconds between the first and the last sample."""
        return (self.end_ns - self.start_ns) * 1e-9


def timing(timestamps_ns: Stamps) -> Timing:
    """Measure increasing stamps."""
    n = len(timestamps_ns)
    start, end = (int(timestamps_ns[0]), int(timestamps_ns[-1])) if n else (0, 0)
    if n < 3:
        return Timing(n, start, end, float("nan"), float("nan"), 0, 0.0, 0)
    periods = periods_s(timestamps_ns)
    median = float(np.median(periods))
    gaps = periods > GAP_PERIODS * median
    dropped = int(np.sum(np.round(periods[gaps] / median) - 1))
    longest = float(periods[gaps].max()) if gaps.any() else 0.0
    jitter_ms = 1e3 * float(np.std(periods[~gaps]))
    return Timing(n, start, end, 1 / median, jitter_ms, int(gaps.sum()), longest, dropped)


def periods_s(timestamps_ns: Stamps) -> Array:
    """(N-1,) seconds between neighbouring stamps."""
    return np.asarray(np.diff(timestamps_ns) * 1e-9)
