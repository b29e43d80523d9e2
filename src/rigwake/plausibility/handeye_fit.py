"""Whether trajectories show one rigid body, by a figure that is not learnt from the residuals; and if not, why not.

Over strides of a second the member moved by B and the reference by A; `log(B^-1 X^-1 A X)` is set against B itself. Of
good pairs a few percent are left, of wrong ones a fifth and more. What people confuse is tried: the order of the
quaternion, the direction of the transform, handedness, the unit of length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Stamps
from rigwake.errors import InputError, RigwakeError
from rigwake.geometry import so3
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, HandeyeResult
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.motions import longest_segment_ids
from rigwake.plausibility.values import SensorCheck
from rigwake.trajectory import Trajectory

MOTION_LEFT = "part of the motion that does not agree"
_STRIDE_S = 1.0
_FEWEST = 5
_DOUBTFUL, _WRONG = 0.1, 0.3  # of the motion; between them only what a hypothesis explains is wrong
_CLEARLY_BETTER = 0.3
_LEAST_SCALE, _SIGMAS = 0.1, 5.0  # less is the error of an odometry, which its covariance counts
_LEAST_TURN, _LEAST_WAY = np.deg2rad(0.5), 0.02  # radians, metres in a stride: less says nothing


@dataclass(frozen=True)
class HandeyeFit:
    """What is left of a member's motion, relative to the motion itself; NaN where it hardly moves so."""

    rotation: float
    translation: float

    @property
    def worst(self) -> float:
        """The larger of both."""
        known = [x for x in (self.rotation, self.translation) if np.isfinite(x)]
        return max(known, default=0.0)


def fit_of_handeye(reference: Trajectory, member: Trajectory, result: HandeyeResult) -> HandeyeFit:
    """How well one member's motion agrees with the reference's under a result."""
    camera, X = result.members[member.name], result.ref_from_members[member.name]
    offset_ns = round((camera.time_offset_s or 0.0) * 1e9)
    at = member.timestamps_ns + offset_ns
    inside = (at >= reference.timestamps_ns[0]) & (at <= reference.timestamps_ns[-1])
    rows = np.flatnonzero(inside)
    if len(rows) < 2:
        return HandeyeFit(np.nan, np.nan)
    starts, ends = stride_rows(member, rows, 0.99 * _STRIDE_S, 2 * _STRIDE_S)
    if len(starts) < _FEWEST:
        return HandeyeFit(np.nan, np.nan)
    here = scaled_poses(member, result)
    B = here[starts].inverse() * here[ends]
    left = left_over(reference, X, B, at[starts], at[ends])
    turned, turns = so3.log(left.rotation), so3.log(B.rotation)
    known = np.isfinite(left.translation).all(axis=1)
    return HandeyeFit(
        _ratio(turned, turns, _LEAST_TURN),
        _ratio(left.translation[known], B.translation[known], _LEAST_WAY if member.is_metric else 0.0),
    )


def stride_rows(
    member: Trajectory, rows: NDArray[np.intp], least_s: float, most_s: float, count: int | None = None
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last row, of those given, of strides within one segment that last `least_s` to `most_s`; count: not
    many more than so many, evenly."""
    stamps, ids = member.timestamps_ns[rows], member.segment_ids
    assert ids is not None
    ends = np.searchsorted(stamps, stamps + round(least_s * 1e9))
    starts = np.flatnonzero(ends < len(stamps))
    starts = starts[:: max(len(starts) // count, 1)] if count else starts
    ends = ends[starts]
    good = (ids[rows[starts]] == ids[rows[ends]]) & (stamps[ends] - stamps[starts] < most_s * 1e9)
    return rows[starts[good]], rows[ends[good]]


def left_over(
    reference: Trajectory, ref_from_member: SE3, strides: SE3, starts_ns: Stamps, ends_ns: Stamps
) -> SE3:
    """`B^-1 X^-1 A X` of the member's strides B that begin and end at these times on the reference's clock."""
    first, last = (
        interpolate(reference.timestamps_ns, reference.world_from_body, at) for at in (starts_ns, ends_ns)
    )
    return strides.inverse() * (ref_from_member.inverse() * (first.inverse() * last) * ref_from_member)


def scaled_poses(member: Trajectory, result: HandeyeResult) -> SE3:
    """The member's poses with the scale of each segment that was estimated; NaN translations of segments without."""
    scales, ids = result.scales.get(member.name), member.segment_ids
    poses = member.world_from_body
    if scales is None or not len(scales):
        return poses
    assert ids is not None
    kept = longest_segment_ids(member, len(scales))  # those that the estimate kept
    size = np.full(int(ids.max()) + 1, np.nan)
    size[kept] = scales[: len(kept), 0]
    return SE3(poses.rotation, poses.translation * size[ids][:, None])


def _ratio(left: Array, whole: Array, least: float) -> float:
    """Root mean square of four fifths of `left`, the smallest, over that of `whole`."""
    if len(whole) < _FEWEST:
        return np.nan
    size = float(np.sqrt(np.mean(np.sum(whole**2, axis=1))))
    squares = np.sort(np.sum(left**2, axis=1))
    return (
        float(np.sqrt(np.mean(squares[: max(int(0.8 * len(squares)), 1)]))) / size if size > least else np.nan
    )


def check_handeye(
    reference: Trajectory,
    members: Sequence[Trajectory],
    result: HandeyeResult,
    options: HandeyeOptions | None = None,
) -> tuple[SensorCheck, ...]:
    """One check per member; where it does not agree, with what makes it agree, if anything does."""
    checks = []
    for member in members:
        fit = fit_of_handeye(reference, member, result)
        sensor = f"trajectory {member.name}"
        note = _clock_note(member, result, options)
        if fit.worst <= _DOUBTFUL:
            checks.append(SensorCheck(sensor, True, fit.worst, _DOUBTFUL, note, quantity=MOTION_LEFT))
            continue
        cause = _cause(reference, member, fit, options)
        agrees = not cause and fit.worst <= _WRONG
        if agrees:
            checks.append(SensorCheck(sensor, True, fit.worst, _WRONG, note, quantity=MOTION_LEFT))
            continue
        what = "rotations" if not fit.translation > fit.rotation else "translations"
        words = f"its {what} do not fit {reference.name}: {100 * fit.worst:.0f} % of the motion is left"
        words += f"; {cause}." if cause else ", whatever the mounting and the time offset."
        remedy = (
            "Correct the file."
            if cause
            else "Check that both show the same body at the same time, and their clocks."
        )
        checks.append(SensorCheck(sensor, False, fit.worst, _WRONG, words, remedy, MOTION_LEFT))
    return tuple(checks)


def finding_of(check: SensorCheck) -> str:
    """What a check found, in words."""
    left = (
        f"{100 * check.statistic:.1f} % of its motion does not agree. "
        if check.quantity == MOTION_LEFT
        else ""
    )
    return f"{check.sensor}: {left}{check.hypothesis}".strip()


def explain_failure(
    reference: Trajectory,
    members: Sequence[Trajectory],
    error: RigwakeError,
    options: HandeyeOptions | None = None,
) -> RigwakeError:
    """The error of a hand-eye calibration that found nothing, or one that says what makes it find something."""
    for member in members:
        moved = [_moved(trajectory) for trajectory in (reference, member)]
        if not all(moved):
            continue  # one of them stood still: that is the reason
        cause = _cause(reference, member, HandeyeFit(1.0, np.nan), options)
        if cause or len(members) == 1:
            return InputError(
                f"trajectory {member.name}: its motion has nothing to do with that of {reference.name}"
                + (f"; {cause}." if cause else ", whatever the mounting."),
                consequence="No mounting follows from it.",
                remedy="Correct the file."
                if cause
                else "Check that both show the same body at the same time, and their clocks (--time-offset).",
            )
    return error


def _moved(trajectory: Trajectory) -> bool:
    """Whether a trajectory turned by more than 20 degrees from where it started."""
    R = trajectory.world_from_body.rotation
    return bool(np.linalg.norm(so3.log(R[0].T @ R), axis=1).max() > np.deg2rad(20))


def _clock_note(member: Trajectory, result: HandeyeResult, options: HandeyeOptions | None) -> str:
    wanted = options is None or options.time_offset
    if wanted and result.members[member.name].time_offset_s is None:
        return "its time offset could not be told from the motion; it was taken as zero."
    return ""


def _cause(
    reference: Trajectory, member: Trajectory, given: HandeyeFit, options: HandeyeOptions | None
) -> str:
    """What makes both agree, in words, or nothing."""
    best, cause = _CLEARLY_BETTER * given.worst, ""
    for words, changed in _suspicions(reference, member):
        try:
            result = calibrate_handeye(*changed, options)
            fit = fit_of_handeye(changed[0], changed[1][0], result)
        except (RigwakeError, ValueError, np.linalg.LinAlgError):
            continue
        if np.isfinite(given.translation) and not np.isfinite(fit.translation):
            continue  # a unit in which nothing moves any more explains nothing
        found = fit.worst
        if found < best:
            best, cause = found, f"{words}: then {100 * found:.1f} % is left"
    return cause or _scale_cause(reference, member, given, options)


def _scale_cause(
    reference: Trajectory, member: Trajectory, given: HandeyeFit, options: HandeyeOptions | None
) -> str:
    """The ratio of lengths that makes both agree, in words, or nothing."""
    options = options or HandeyeOptions()
    if options.scale or not member.is_metric:
        return ""
    try:
        result = calibrate_handeye(reference, [member], replace(options, scale=True))
    except (RigwakeError, ValueError, np.linalg.LinAlgError):
        return ""
    fit = fit_of_handeye(reference, member, result)
    scales = result.scales.get(member.name, np.zeros((0, 2)))
    if not len(scales) or not np.isfinite(fit.translation) or not fit.worst < _CLEARLY_BETTER * given.worst:
        return ""
    if not abs(scales[0, 0] - 1) > max(_LEAST_SCALE, _SIGMAS * scales[0, 1]):
        return ""
    return (
        f"its lengths are {1 / scales[0, 0]:.3f} times those of {reference.name} (--scale estimates that): "
        f"then {100 * fit.worst:.1f} % is left"
    )


def _suspicions(
    reference: Trajectory, member: Trajectory
) -> Iterator[tuple[str, tuple[Trajectory, list[Trajectory]]]]:
    whose = ((f"of {member.name}", 1), (f"of {reference.name}", 0))
    for words, change in _CONFUSIONS.items():
        for owner, which in whose:
            pair = [reference, member]
            pair[which] = _changed(pair[which], change)
            yield words.format(owner=owner), (pair[0], [pair[1]])


def _changed(trajectory: Trajectory, change: Callable[[SE3], SE3]) -> Trajectory:
    return replace(trajectory, world_from_body=change(trajectory.world_from_body), covariances=None)


def _reordered(poses: SE3) -> SE3:
    """Read as x y z w what was written as w x y z, undone."""
    wxyz = poses.quat_wxyz
    w, x, y, z = wxyz[:, 1], wxyz[:, 2], wxyz[:, 3], wxyz[:, 0]
    return SE3.from_quat_wxyz(np.stack([w, x, y, z], axis=1), poses.translation)


def _reordered_back(poses: SE3) -> SE3:
    """Read as w x y z what was written as x y z w, undone."""
    wxyz = poses.quat_wxyz
    return SE3.from_quat_wxyz(wxyz[:, [3, 0, 1, 2]], poses.translation)


def _mirrored(poses: SE3) -> SE3:
    flip = np.diag([1.0, -1.0, 1.0])
    return SE3(flip @ poses.rotation @ flip, poses.translation @ flip)


def _mirrored_positions(poses: SE3) -> SE3:
    return SE3(poses.rotation, poses.translation * np.array([1.0, -1.0, 1.0]))


_CONFUSIONS: dict[str, Callable[[SE3], SE3]] = {
    "the poses {owner} are inverse (body from world)": lambda poses: poses.inverse(),
    "the quaternions {owner} are in another order (w first)": _reordered,
    "the quaternions {owner} are in another order (w last)": _reordered_back,
    "the quaternions {owner} are conjugate": lambda p: SE3(np.swapaxes(p.rotation, 1, 2), p.translation),
    "the axes {owner} are left-handed": _mirrored,
    "the positions {owner} are in a left-handed world": _mirrored_positions,
    "the positions {owner} are in millimetres": lambda poses: SE3(poses.rotation, 1e-3 * poses.translation),
    "the positions {owner} are in centimetres": lambda poses: SE3(poses.rotation, 1e-2 * poses.translation),
    "the positions {owner} are in feet": lambda poses: SE3(poses.rotation, 0.3048 * poses.translation),
}
