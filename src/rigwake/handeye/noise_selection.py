"""Whether the errors of the poses drift, when nobody said so.

Drift and jitter look alike from one step to the next if jitter lasts for a while. Over long strides they part:
the variance of `log(B^-1 X^-1 A X)` grows with the stride where trajectories drift, and stays where every pose
is fixed by itself (a board, GNSS), whatever the memory of its errors. Only that of its rotation is looked at over
long strides: a rotation that jitters moves the end of a stride by the way sailed.
"""

from __future__ import annotations

import numpy as np

from rigwake._types import Array
from rigwake.handeye.handeye_problem import HandeyeProblem, with_poses
from rigwake.handeye.handeye_result import HandeyeOptions
from rigwake.handeye.initial_mounting import with_worlds
from rigwake.handeye.likelihood import HandeyeEstimate, information_criterion, maximise
from rigwake.handeye.motions import residuals, steps_between

_LONGEST_WITHOUT_DRIFT = 20_000  # steps
_MOST_PIECES = 60  # segments of all members: each has a world of its own in the model of the poses
_STRIDES = 8  # that make up the recording, where its variance over a long stride is taken
_SATURATED = 0.5  # of the variance that independent errors of the increments would have reached
_STATIONARY = 1.000  # 5 % limit of the statistic for three series (Nyblom and Harvey 2000, table 1)


def without_drift(
    problem: HandeyeProblem, estimate: HandeyeEstimate, options: HandeyeOptions
) -> tuple[HandeyeProblem, HandeyeEstimate]:
    """The solution in the model of the poses where it explains the recording, else what was given.

    It does if it predicts better (BIC), or if its residuals, however long their memory, do not wander (see
    `wandering`).
    """
    pieces = sum(curve.segment_count for curve in problem.members)
    if len(estimate.valid) > _LONGEST_WITHOUT_DRIFT or pieces > _MOST_PIECES:
        return problem, estimate
    if not _saturates(problem, estimate):
        return problem, estimate
    as_poses, to_beat = with_poses(problem, options), information_criterion(problem, estimate)

    def explains(other: HandeyeEstimate) -> bool:
        return information_criterion(as_poses, other) < to_beat or _stays(other)

    other = maximise(as_poses, with_worlds(as_poses, estimate.mountings), options, worthwhile=explains)
    return (as_poses, other) if other.converged and explains(other) else (problem, estimate)


def _saturates(problem: HandeyeProblem, estimate: HandeyeEstimate) -> bool:
    """Whether rotations err less over a long stride than the errors of its steps would add up to."""
    stride = max(2, len(estimate.valid) // _STRIDES)
    reference, sampled = problem.sampled(estimate.mountings)
    for m, (member, mounting) in enumerate(zip(sampled, estimate.mountings, strict=True)):
        long = steps_between(reference, member, absolute=False, stride=stride)
        valid = estimate.valid[:, m]
        if not (long.valid.any() and valid.any()):
            return False
        over_stride = np.mean(residuals(long, mounting)[long.valid] ** 2, axis=0)[:3].sum()
        over_step = np.mean(estimate.residuals[m][valid] ** 2, axis=0)[:3].sum()
        if over_stride > _SATURATED * stride * over_step:
            return False
    return True


def _stays(estimate: HandeyeEstimate) -> bool:
    """No segment's residuals, of rotation or translation, wander."""
    for r, valid, segments in zip(estimate.residuals, estimate.valid.T, estimate.segments.T, strict=True):
        for segment in np.unique(segments[valid]):
            rows = r[valid & (segments == segment)]
            if any(wandering(rows[:, part]) > _STATIONARY for part in (slice(0, 3), slice(3, 6))):
                return False
    return True


def wandering(rows: Array) -> float:
    """How far sums of rows (N, 3) stray: the statistic of Nyblom and Harvey (2000), after Kwiatkowski et al. (1992).

    `tr(O^-1 sum_k S_k S_k^T) / N^2`, S the partial sums of the centred rows, O their long-run covariance
    (Bartlett's window over sqrt(N) rows). 0.5 on average for stationary rows of any short memory, of the order
    of sqrt(N) for a random walk.
    """
    n = len(rows)
    centred = rows - rows.mean(axis=0)
    window = int(np.sqrt(n))
    # Bartlett's estimate is the mean square of the sums over a sliding window
    sums = np.cumsum(np.pad(centred, ((window, window), (0, 0))), axis=0)
    windowed = sums[window:] - sums[:-window]
    long_run = windowed.T @ windowed / (n * window)
    partial = np.cumsum(centred, axis=0)
    return float(np.trace(np.linalg.lstsq(long_run, partial.T @ partial, rcond=None)[0]) / n**2)
