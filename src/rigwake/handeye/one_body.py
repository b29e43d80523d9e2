"""Do two trajectories show one rigid body, in one unit? Checks that the estimate itself cannot make.

On one body every stride of the reference is the member's seen through the mounting; what is left over is small against
the strides themselves. Speeds of a body in one unit are alike, but for the lever arm.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

_STRIDES_S = (1.0, 4.0, 16.0)
_MOST_POSES = 4000
_FEWEST_STRIDES = 10
_LONGEST_GAP = 5.0  # median periods
_FEWEST_SPANS = 4
_UNRELATED = 0.55  # of the member's own turning: errors of odometry are a few per cent over some stride
_LEAST_TURN_RAD = np.radians(3.0)
_OTHER_UNIT = 5.0  # no lever arm makes speeds differ so much and always by the same factor
_STEADY_FACTOR = 1.3


def require_one_body(
    reference: Trajectory, member: Trajectory, ref_from_member: SE3, offset_s: float
) -> None:
    """Raises EstimationError if, over strides of any length, as much turning is left over as there is.

    offset_s: `t_ref = t_member + offset_s`. Says nothing where the member hardly turns.
    """
    left_over = []
    for stride_s in _STRIDES_S:
        strides = _strides(reference, member, offset_s, stride_s)
        if strides is None:
            continue
        a, b = strides
        predicted = ref_from_member.rotation.T @ a.rotation @ ref_from_member.rotation
        turn = np.linalg.norm(so3.log(b.rotation), axis=-1)
        rest = np.linalg.norm(so3.log(np.swapaxes(predicted, -1, -2) @ b.rotation), axis=-1)
        size = float(np.sqrt(np.mean(turn**2)))
        if size > _LEAST_TURN_RAD:
            left_over.append((float(np.median(rest)) / float(np.median(turn)), stride_s, size))
    if not left_over or min(left_over)[0] < _UNRELATED:
        return
    fraction, stride_s, size = min(left_over)
    raise EstimationError(
        f"{reference.name} and {member.name} do not move as one rigid body: over {stride_s:g} s they turn by "
        f"{np.degrees(size):.1f} deg, and {100 * fraction:.0f} % of that remains unexplained by any mounting.",
        consequence="No mounting is reported.",
        remedy="Are both of the same vessel and time? Check clocks (leave out --no-time-offset), the order of the "
        "quaternion (--columns) and the frames (--frame inverse, ned, left-handed).",
    )


def in_one_unit(reference: Trajectory, member: Trajectory) -> tuple[Trajectory, Finding | None]:
    """The member, its scale taken as unknown if its speed always differs from the reference's by one factor of 5 and
    more, and what was noticed. The clocks must be alike to some seconds; else nothing is noticed."""
    if not (reference.is_metric and member.is_metric):
        return member, None
    strides = _strides(reference, member, 0.0, _STRIDES_S[1])
    if strides is None:
        return member, None
    first, second = (np.linalg.norm(s.translation, axis=-1) for s in strides)
    moving = (
        (first > 0.5 * np.median(first)) & (second > 0.5 * np.median(second)) & (first > 0) & (second > 0)
    )
    if moving.sum() < _FEWEST_STRIDES:
        return member, None
    low, factor, high = np.percentile(second[moving] / first[moving], [25, 50, 75])
    if 1 / _OTHER_UNIT < factor < _OTHER_UNIT or high > low * _STEADY_FACTOR**2:
        return member, None
    message = (
        f"{member.name} moves {factor:.4g} times as fast as {reference.name}: millimetres beside metres? "
        "Its scale is estimated; the reference is taken to be in metres."
    )
    return replace(member, is_metric=False), Finding("warning", member.name, message)


def _strides(
    reference: Trajectory, member: Trajectory, offset_s: float, stride_s: float
) -> tuple[SE3, SE3] | None:
    """Motions of both over the same times; None if they share too few. Breaks of odometry are left out."""
    stride_ns, offset_ns = round(stride_s * 1e9), round(offset_s * 1e9)
    begin = max(reference.timestamps_ns[0] - offset_ns, member.timestamps_ns[0])
    end = min(reference.timestamps_ns[-1] - offset_ns, member.timestamps_ns[-1]) - stride_ns
    if end - begin < _FEWEST_SPANS * stride_ns:
        return None
    step = max((end - begin) // _MOST_POSES, stride_ns // 4)
    starts = np.arange(begin, end, step, dtype=np.int64)
    kept = _unbroken(member, starts, starts + stride_ns)
    kept &= _unbroken(reference, starts + offset_ns, starts + stride_ns + offset_ns)
    starts = starts[kept]
    if len(starts) < _FEWEST_STRIDES:
        return None
    return (
        _motions(reference, starts + offset_ns, stride_ns),
        _motions(member, starts, stride_ns),
    )


def _unbroken(trajectory: Trajectory, first: NDArray[np.int64], last: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether both ends lie between neighbouring poses, not within a gap, and in one segment."""
    ids, stamps = trajectory.segment_ids, trajectory.timestamps_ns
    assert ids is not None
    longest = _LONGEST_GAP * float(np.median(np.diff(stamps)))
    whole = np.ones(len(first), dtype=bool)
    for at in (first, last):
        after = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
        whole &= (stamps[after] - stamps[after - 1] <= longest) & (ids[after] == ids[after - 1])
    before = np.clip(np.searchsorted(stamps, first, side="right") - 1, 0, len(stamps) - 1)
    after = np.clip(np.searchsorted(stamps, last), 0, len(stamps) - 1)
    return np.asarray(whole & (ids[before] == ids[after]))


def _motions(trajectory: Trajectory, starts: NDArray[np.int64], stride_ns: int) -> SE3:
    poses = trajectory.world_from_body
    at_start = interpolate(trajectory.timestamps_ns, poses, starts)
    return at_start.inverse() * interpolate(trajectory.timestamps_ns, poses, starts + stride_ns)
