"""`calibrate_handeye`: from trajectories to mountings, with uncertainty; whether the errors of the poses drift.

Drift and jitter look alike from one step to the next if jitter lasts for a while. Over long strides they part:
the variance of `log(B^-1 X^-1 A X)` grows with the stride where trajectories drift, and stays where every pose
is fixed by itself (a board, GNSS), whatever the memory of its errors. Only that of its rotation is looked at over
long strides: a rotation that jitters moves the end of a stride by the way sailed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.calibration.rig_calibration import CalibratedCamera, UnobservableDirection
from rigwake.errors import EstimationError, UnobservableError
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import (
    HandeyeOptions,
    HandeyeProblem,
    HandeyeResult,
    pose_problem,
    require_one_body,
    with_poses,
)
from rigwake.handeye.initial_mounting import initial_mountings, thesis_handeye, with_worlds
from rigwake.handeye.likelihood import (
    USEFUL_LOG_SCALE,
    USEFUL_TIME_OFFSET,
    HandeyeEstimate,
    information_criterion,
    maximise,
)
from rigwake.handeye.motions import Mounting, longest_segments, residuals, steps_between
from rigwake.handeye.observability import covariance, unobservable_directions
from rigwake.handeye.relative_scale import RelativeScale, relative_scale, scale_covariance
from rigwake.sync import MIN_OVERLAP, estimate_time_offset
from rigwake.trajectory import Trajectory

_LONGEST_WITHOUT_DRIFT = 20_000  # steps
_MOST_PIECES = 60  # segments of all members: each has a world of its own in the model of the poses
_STRIDES = 8  # that make up the recording, where its variance over a long stride is taken
_SATURATED = 0.5  # of the variance that independent errors of the increments would have reached
# 5 and 1 % limits of the statistic for three series (Nyblom and Harvey 2000, table 1): errors that last for seconds
# come near the former without wandering. The latter holds where the poses are so many that a drift would exceed it
# (its statistic grows with the root of their number) and where variance does not grow with the stride either
_STATIONARY, _NOT_WANDERING = 1.000, 1.359
_MANY_POSES = 1000
_GROWS = (
    1.25  # variance of rotations from half a long stride to a whole: 2 for drift, 1 for errors of each pose
)


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
    stride = max(2, len(estimate.valid) // _STRIDES)
    half, whole = (_rotation_variance(problem, estimate, s) for s in (stride // 2, stride))
    per_step = [
        float(np.mean(r[v] ** 2, axis=0)[:3].sum()) if v.any() else 0.0 for r, v in _members(estimate)
    ]
    if not all(w <= _SATURATED * stride * one for w, one in zip(whole, per_step, strict=True)):
        return problem, estimate
    grows = any(w > _GROWS * h for h, w in zip(half, whole, strict=True))
    limit = _STATIONARY if grows or len(estimate.valid) < _MANY_POSES else _NOT_WANDERING
    as_poses, to_beat = with_poses(problem, options), information_criterion(problem, estimate)

    def explains(other: HandeyeEstimate) -> bool:
        return information_criterion(as_poses, other) < to_beat or _stays(other, limit)

    other = maximise(as_poses, with_worlds(as_poses, estimate.mountings), options, worthwhile=explains)
    return (as_poses, other) if other.converged and explains(other) else (problem, estimate)


def _members(estimate: HandeyeEstimate) -> Iterator[tuple[Array, NDArray[np.bool_]]]:
    """Residuals (N, 6) of every member, and which of them are known."""
    return zip(estimate.residuals, estimate.valid.T, strict=True)


def _rotation_variance(problem: HandeyeProblem, estimate: HandeyeEstimate, stride: int) -> list[float]:
    """By member, mean square by which rotations err over a stride; infinite where no stride is known."""
    reference, sampled = problem.sampled(estimate.mountings)
    found = []
    for member, mounting in zip(sampled, estimate.mountings, strict=True):
        long = steps_between(reference, member, absolute=False, stride=stride)
        r = residuals(long, mounting)[long.valid]
        found.append(float(np.mean(r**2, axis=0)[:3].sum()) if len(r) else float("inf"))
    return found


def _stays(estimate: HandeyeEstimate, limit: float) -> bool:
    """No segment's residuals, of rotation or translation, wander."""
    for r, valid, segments in zip(estimate.residuals, estimate.valid.T, estimate.segments.T, strict=True):
        for segment in np.unique(segments[valid]):
            rows = r[valid & (segments == segment)]
            if any(wandering(rows[:, part]) > limit for part in (slice(0, 3), slice(3, 6))):
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


_MOST_SEGMENTS = 60  # of a member: unknowns grow with them, and time with their square


def calibrate_handeye(
    reference: Trajectory, members: Sequence[Trajectory], options: HandeyeOptions | None = None
) -> HandeyeResult:
    """Where every member sits on the reference, from nothing but their trajectories.

    The trajectories may have any origin, rate and clock; members may be up to scale. All members are solved
    together, so that loops through them close exactly. Of a member in very many segments the longest are used.

    Raises UsageError (names, a reference up to scale), UnobservableError (nothing of a member is determined,
    or its clock cannot be aligned), EstimationError (no convergence).
    """
    options = options or HandeyeOptions()
    shortened = [longest_segments(member, _MOST_SEGMENTS) for member in members]
    members = [member for member, _ in shortened]
    offsets = [_time_offset(reference, member) if options.time_offset else None for member in members]
    problem = pose_problem(reference, members, options, [offset is not None for offset in offsets])
    start = initial_mountings(problem, [offset or 0.0 for offset in offsets])
    if options.method == "thesis":
        return _thesis_result(problem, start)
    estimate = maximise(problem, start, options)
    if problem.noise == "estimated":
        problem, estimate = without_drift(problem, estimate, options)
    if not estimate.converged:
        raise EstimationError(
            f"Hand-eye calibration did not settle within {options.max_iterations} steps.",
            consequence="The motion or the trajectories do not support the model.",
            remedy="Look at the trajectories: do they show one rigid body? Try --noise poses or increments.",
        )
    for member, mounting in zip(members, estimate.mountings, strict=True):
        require_one_body(reference, member, mounting.ref_from_member, mounting.time_offset_s)
    return _result(problem, estimate, options, [left_out for _, left_out in shortened])


def _time_offset(reference: Trajectory, member: Trajectory) -> float | None:
    """A first offset of the member's clock; None if it cannot be told but both clocks seem to be one."""
    try:
        return estimate_time_offset(reference, member).offset_s
    except UnobservableError:
        shared = min(reference.timestamps_ns[-1], member.timestamps_ns[-1]) - max(
            reference.timestamps_ns[0], member.timestamps_ns[0]
        )
        if shared * 1e-9 < MIN_OVERLAP * min(reference.duration_s, member.duration_s):
            raise
        return None


def _result(
    problem: HandeyeProblem, estimate: HandeyeEstimate, options: HandeyeOptions, left_out: Sequence[int]
) -> HandeyeResult:
    total = covariance(problem, estimate)
    reference = problem.reference.trajectory
    agreement = _scales(problem, estimate)
    if not problem.has_known_noise:
        total = total + scale_covariance(problem, estimate, options, agreement)
    rotations = problem.reference.increments[:, :3]
    members, raw, scales = {}, {}, {}
    columns = [at.start + i for at in problem.columns for i in range(6)]
    for m, (curve, layout, at) in enumerate(
        zip(problem.members, problem.layouts, problem.columns, strict=True)
    ):
        name, mounting = curve.trajectory.name, estimate.mountings[m]
        block = total[at, at]
        valid = estimate.valid[:, m]
        stds = np.sqrt(np.diag(block)[layout.scales])
        known = np.where(stds < USEFUL_LOG_SCALE, 1.0, np.nan)
        values = np.exp(mounting.log_scales[: layout.scale_count])
        scales[name] = np.stack([values * known, values * stds * known], axis=1)
        time_offset_std = float(np.sqrt(np.diag(block)[layout.time_offset].sum()))
        time_offset_known = layout.has_time_offset and time_offset_std < USEFUL_TIME_OFFSET
        raw[name] = mounting.ref_from_member
        single = layout.scale_count == 1
        members[name] = CalibratedCamera(
            name,
            mounting.ref_from_member,
            block[:6, :6],
            unobservable=_checked_directions(problem, m, mounting.ref_from_member, block, rotations),
            time_offset_s=mounting.time_offset_s if time_offset_known else None,
            time_offset_std_s=time_offset_std if time_offset_known else None,
            scale=float(scales[name][0, 0]) if single else None,
            scale_std=float(scales[name][0, 1]) if single else None,
            statistics={
                "steps": int(valid.sum()),
                "poses_left_out": left_out[m],
                "relative_scale": None if (found := agreement[m]) is None else [found.value, found.std],
            },
        )
    return HandeyeResult(
        reference.name,
        members,
        raw,
        total[np.ix_(columns, columns)],
        scales,
        _noise_words(problem),
        int(estimate.equations.used.sum()),
        int(np.sum(estimate.equations.weights < 1)),
        estimate.iterations,
        estimate.converged,
    )


def _scales(problem: HandeyeProblem, estimate: HandeyeEstimate) -> list[RelativeScale | None]:
    """How members that claim metres, and are believed, agree with the reference on them."""
    reference = problem.reference.trajectory
    return [
        None
        if layout.scale_count
        else relative_scale(reference, curve.trajectory, mounting.ref_from_member, mounting.time_offset_s)
        for curve, layout, mounting in zip(problem.members, problem.layouts, estimate.mountings, strict=True)
    ]


def _checked_directions(
    problem: HandeyeProblem, m: int, X: SE3, block: Array, rotations: Array
) -> tuple[UnobservableDirection, ...]:
    reference, name = problem.reference.trajectory.name, problem.members[m].trajectory.name
    found = unobservable_directions(reference, name, X, block[:6, :6], rotations)
    if len(found) == 6:
        raise UnobservableError(
            f"The motion determines nothing of how {name} sits on {reference}.",
            consequence="They stood still, or moved by less than the noise of their trajectories.",
            remedy="Record a minute of turning through at least 60 degrees, to both sides, in waves if possible.",
        )
    return found


def _noise_words(problem: HandeyeProblem) -> str:
    source = "as declared" if problem.has_known_noise else "levels learnt from the residuals"
    return f"{problem.noise}, {source}"


def _thesis_result(problem: HandeyeProblem, start: Sequence[Mounting]) -> HandeyeResult:
    reference, sampled = problem.sampled(start)
    raw, members = {}, {}
    unknown = np.full((6, 6), np.nan)
    parts = zip(problem.members, problem.layouts, sampled, start, strict=True)
    for curve, layout, member, mounting in parts:
        name = curve.trajectory.name
        both = (reference.segments >= 0) & (member.segments >= 0)
        raw[name] = thesis_handeye(reference.world_from_body[both], member.world_from_body[both])
        offset = mounting.time_offset_s if layout.has_time_offset else None
        members[name] = CalibratedCamera(name, raw[name], unknown, time_offset_s=offset)
    return HandeyeResult(
        problem.reference.trajectory.name,
        members,
        raw,
        np.full((6 * len(raw), 6 * len(raw)), np.nan),
        {name: np.zeros((0, 2)) for name in raw},
        "ignored",
        len(reference.segments),
        0,
        1,
        True,
    )
