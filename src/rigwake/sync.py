"""Time offset between two trajectories of one rigid body by correlating their speeds of rotation.

The angular speed `|w|` is the same for every body that is bolted to the rig, whatever its mounting, origin
and scale, so that the lag of the highest correlation aligns two clocks without any calibration (the standard
first step of hand-eye tools; Furrer et al., *Evaluation of combined time-offset estimation and hand-eye
calibration on robotic datasets*, 2018).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from rigwake._types import Array
from rigwake.errors import UnobservableError
from rigwake.geometry import so3
from rigwake.trajectory import Trajectory

Spectrum = NDArray[np.complex128]

MIN_OVERLAP = 0.3  # of the shorter trajectory: a short overlap correlates by chance
MIN_CORRELATION = 0.5


@dataclass(frozen=True)
class TimeOffset:
    """`t_reference = t_member + offset_s`, the correlation there (1 is perfect) and the shared seconds."""

    offset_s: float
    correlation: float
    overlap_s: float


def angular_speed(trajectory: Trajectory, stride: int = 1) -> tuple[Array, Array]:
    """Mid times (N - stride,), seconds since the first pose, and angular speeds, rad/s, from each pose to the one
    `stride` later; NaN across segments."""
    R = trajectory.world_from_body.rotation
    times, ids = trajectory.times_s, trajectory.segment_ids
    assert ids is not None
    angle = np.linalg.norm(so3.log(np.swapaxes(R[:-stride], -1, -2) @ R[stride:]), axis=-1)
    speed = np.asarray(angle / (times[stride:] - times[:-stride]))
    speed[ids[stride:] != ids[:-stride]] = np.nan
    return (times[:-stride] + times[stride:]) / 2, speed


def estimate_time_offset(reference: Trajectory, member: Trajectory) -> TimeOffset:
    """The offset of `member`'s clock, to a fraction of a sample, for clocks that may be any time apart.

    Both speeds are resampled to one grid, and the normalised correlation of every lag with enough overlap is
    computed by FFT; a parabola through the peak refines it.

    Raises UnobservableError if the rotation does not vary enough to tell the lag.
    """
    periods = [float(np.median(np.diff(t.timestamps_ns))) * 1e-9 for t in (reference, member)]
    step, longest = min(periods), max(periods)
    # over the same time in both: from one pose to the next a fast trajectory turns by less than its noise
    strides = [
        max(1, min(round(longest / p), (len(t) - 1) // 4))
        for p, t in zip(periods, (reference, member), strict=True)
    ]
    step = max(step, max(reference.duration_s, member.duration_s) / 200_000)  # bounds memory
    (a, known_a), (b, known_b) = (
        _resampled_speed(t, step, n) for t, n in zip((reference, member), strides, strict=True)
    )
    lags, score, shared = _normalised_correlation(a, known_a, b, known_b)
    # likelihood of independent samples: a high correlation counts by how long it holds
    best = int(np.argmax(-shared * np.log1p(-(np.clip(score, 0.0, 1 - 1e-9) ** 2))))
    if not score[best] >= MIN_CORRELATION:
        raise UnobservableError(
            f"The angular speeds of {reference.name} and {member.name} do not match at any time offset "
            f"(best correlation {max(score[best], 0.0):.2f}).",
            consequence="Their clocks cannot be aligned.",
            remedy="Record turns of varying speed, or declare the clocks synchronous (--no-time-offset).",
        )
    shift = 0.0
    if 0 < best < len(score) - 1 and np.isfinite(score[best - 1 : best + 2]).all():
        before, peak, after = score[best - 1 : best + 2]
        curvature = before - 2 * peak + after
        shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    starts = int(reference.timestamps_ns[0]) - int(member.timestamps_ns[0])
    offset = starts * 1e-9 + (lags[best] + shift) * step
    return TimeOffset(float(offset), float(score[best]), float(shared[best] * step))


def _resampled_speed(trajectory: Trajectory, step_s: float, stride: int) -> tuple[Array, Array]:
    """Angular speed on a grid from the first pose on, and 1 where it is known, 0 in gaps."""
    times, speed = angular_speed(trajectory, stride)
    known = np.isfinite(speed)
    grid = np.arange(0.0, trajectory.duration_s + step_s / 2, step_s)
    if known.sum() < 2:
        return np.zeros_like(grid), np.zeros_like(grid)
    # an odometry that lost and found itself jumps: unclipped, that would outweigh all true turning
    rank = int(0.9 * (known.sum() - 1))
    speed = np.minimum(speed, 1.5 * np.partition(speed[known], rank)[rank])
    at = times[known]
    after = np.clip(np.searchsorted(at, grid), 1, len(at) - 1)
    spacing = at[after] - at[after - 1]
    inside = spacing <= 3 * max(step_s, float(np.median(np.diff(times))))
    return np.interp(grid, at, speed[known]), inside.astype(np.float64)


def _normalised_correlation(
    a: Array, known_a: Array, b: Array, known_b: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """Pearson correlation of `a[i + lag]` with `b[i]` at every lag, -inf where they overlap too little, and
    how many samples they share there."""
    size = next_fast_len(len(a) + len(b) - 1, real=True)
    lags = np.arange(-(len(b) - 1), len(a), dtype=np.int64)

    def correlate(x: Spectrum, y: Spectrum) -> Array:
        full = irfft(x * np.conj(y), size)
        return np.asarray(full[lags])  # negative lags wrap around

    def centred(x: Array, known: Array) -> tuple[Array, float]:
        x = (x - np.sum(x * known) / max(known.sum(), 1.0)) * known
        return x, float(np.sum(x * x) / max(known.sum(), 1.0))

    (a, variation_a), (b, variation_b) = centred(a, known_a), centred(b, known_b)
    F_a, F_b, F_known_a, F_known_b = (rfft(x, size) for x in (a, b, known_a, known_b))
    n = np.maximum(np.round(correlate(F_known_a, F_known_b)), 1.0)
    sum_a, sum_b = correlate(F_a, F_known_b), correlate(F_known_a, F_b)
    covariance = correlate(F_a, F_b) - sum_a * sum_b / n
    variance_a = correlate(rfft(a * a, size), F_known_b) - sum_a**2 / n
    variance_b = correlate(F_known_a, rfft(b * b, size)) - sum_b**2 / n
    # lags whose overlap holds hardly any variation correlate by rounding and chance
    usable = n >= MIN_OVERLAP * min(known_a.sum(), known_b.sum())
    for variance, variation in ((variance_a, variation_a), (variance_b, variation_b)):
        usable &= (variance > 1e-2 * variation * n) & (variation > 1e-12)
    product = np.sqrt(np.where(usable, variance_a * variance_b, 1.0))
    return lags, np.where(usable, covariance / product, -np.inf), n
