"""The hand-eye problem: what is asked, the trajectories in numbers on one clock, their noise, and the answer.

`require_one_body` and `in_one_unit` check what the estimate itself cannot: on one body every stride of the reference is
the member's seen through the mounting; what is left over is small against the strides themselves. Speeds of a body in
one unit are alike, but for the lever arm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.calibration.rig_calibration import CalibratedCamera, Calibration
from rigwake.errors import EstimationError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.handeye.motions import Mounting, MountingLayout, Sampled, Steps, TrajectoryCurve, steps_between
from rigwake.handeye.noise import noise_over_steps
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

Method = Literal["ml", "thesis"]
NoiseModel = Literal["estimated", "increments", "poses"]


@dataclass(frozen=True)
class NoiseLevel:
    """Standard deviation per axis of one pose, or of one increment, of a trajectory (radians, metres)."""

    rotation_std: float
    translation_std: float


@dataclass(frozen=True)
class HandeyeOptions:
    """How to calibrate.

    method: `ml`, or the baseline `thesis`.
    noise: errors independent from increment to increment, from pose to pose, or `estimated`: drift and jitter
        in shares learnt from the residuals, or poses where these do not drift (see `joint_calibration`).
        None: as the covariances of the trajectories say, else `estimated`.
    levels: known noise by trajectory name, for trajectories that bring no covariances of their own. Unless
        every trajectory has covariances or a level, the noise is estimated from the residuals.
    time_offset: estimate the clock of every member. scale: also of members that claim to be metric.
    robust: down-weight steps that the noise cannot explain. max_gap_s: longest gap to bridge by
        interpolation (default ten median periods).
    """

    method: Method = "ml"
    noise: NoiseModel | None = None
    levels: Mapping[str, NoiseLevel] = field(default_factory=dict)
    time_offset: bool = True
    scale: bool = False
    robust: bool = True
    max_gap_s: float | None = None
    max_iterations: int = 50


@dataclass(frozen=True, eq=False)
class HandeyeResult:
    """Where the members sit, how sure that is, and how the estimate came about.

    reference: name. members: by name, parts that the motion left unobservable marked (see CalibratedCamera).
    ref_from_members: the raw estimates by name; along unobservable directions they are arbitrary.
    joint_covariance: (6 M, 6 M) right tangents of the members in order.
    scales: by name, one (scale, std) per segment that was scaled; NaN where unobservable.
    noise: what the likelihood assumed, in words.
    steps, down_weighted: how many steps in time entered, and how many of them as outliers.
    """

    reference: str
    members: Mapping[str, CalibratedCamera]
    ref_from_members: Mapping[str, SE3]
    joint_covariance: Array
    scales: Mapping[str, Array]
    noise: str
    steps: int
    down_weighted: int
    iterations: int
    converged: bool

    def calibration(self, provenance: Mapping[str, object] | None = None) -> Calibration:
        """The result as the one file that everything downstream reads."""
        return Calibration(
            self.reference, self.members, self.joint_covariance, provenance=dict(provenance or {})
        )


@dataclass(frozen=True, eq=False)
class HandeyeProblem:
    """One reference, M members, and the model of their noise.

    pace: index of the slowest trajectory (-1: the reference); all others are interpolated at its stamps.
    """

    reference: TrajectoryCurve
    members: tuple[TrajectoryCurve, ...]
    layouts: tuple[MountingLayout, ...]
    noise: NoiseModel
    has_known_noise: bool
    pace: int

    @property
    def absolute(self) -> bool:
        """Whether poses are compared, not increments."""
        return self.noise == "poses"

    @cached_property
    def columns(self) -> list[slice]:
        """Where the unknowns of every member stand among those of all."""
        ends = np.cumsum([0, *(layout.size for layout in self.layouts)]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    def times_s(self, mountings: Sequence[Mounting]) -> Array:
        """Times of the problem, seconds on the reference's clock after its first stamp."""
        if self.pace < 0:
            return self.reference.times_s
        curve = self.members[self.pace]
        return curve.times_s + self._shift(curve, mountings[self.pace])

    def _shift(self, member: TrajectoryCurve, mounting: Mounting) -> float:
        """What to add to the member's seconds to get the reference's."""
        return (member.start_ns - self.reference.start_ns) * 1e-9 + mounting.time_offset_s

    def sampled(self, mountings: Sequence[Mounting]) -> tuple[Sampled, list[Sampled]]:
        """The reference and every member at the common times."""
        times = self.times_s(mountings)
        members = [
            curve.at(times - self._shift(curve, mounting))
            for curve, mounting in zip(self.members, mountings, strict=True)
        ]
        return self.reference.at_poses if self.pace < 0 else self.reference.at(times), members

    def steps(self, mountings: Sequence[Mounting]) -> list[Steps]:
        """Every member paired with the reference."""
        reference, members = self.sampled(mountings)
        return [steps_between(reference, member, self.absolute) for member in members]

    def known_covariances(
        self, mountings: Sequence[Mounting], levels: dict[str, Array]
    ) -> tuple[Array, list[Array]]:
        """Covariances over the common steps: of the reference, and of every member in its own tangent."""
        times = self.times_s(mountings)
        reference = noise_over_steps(
            levels[self.reference.trajectory.name], self.reference, times, self.absolute
        )
        members = []
        for curve, mounting in zip(self.members, mountings, strict=True):
            own = times - self._shift(curve, mounting)
            covariance = noise_over_steps(levels[curve.trajectory.name], curve, own, self.absolute)
            if mounting.log_scales.any():
                unit = np.repeat([1.0, float(np.exp(mounting.log_scales.mean()))], 3)
                covariance = covariance * unit[:, None] * unit[None, :]
            members.append(covariance)
        return reference, members


def pose_problem(
    reference: Trajectory,
    members: Sequence[Trajectory],
    options: HandeyeOptions,
    has_time_offset: Sequence[bool],
) -> HandeyeProblem:
    """Choose unknowns, pace and noise model; `has_time_offset` says whose time offset is an unknown.

    Raises UsageError for no members, equal names or a reference without metric scale.
    """
    names = [reference.name, *(m.name for m in members)]
    if not members or len(set(names)) != len(names):
        raise UsageError(
            f"Hand-eye calibration needs a reference and at least one other, all of different names: {names}."
        )
    if not reference.is_metric:
        raise UsageError(
            f"The reference {reference.name} is only known up to scale.",
            consequence="Translations would have no unit.",
            remedy="Give a metric trajectory (stereo, inertial, GNSS) first; monocular ones after it.",
        )
    curves = [TrajectoryCurve.of(t, options.max_gap_s) for t in (reference, *members)]
    periods = [curve.period_s for curve in curves]
    slowest = int(np.argmax(periods))
    pace = slowest - 1 if periods[slowest] > 1.01 * periods[0] else -1
    noise = options.noise or _declared_noise([reference, *members])
    return _modelled(curves, pace, noise, options, has_time_offset)


def with_poses(problem: HandeyeProblem, options: HandeyeOptions) -> HandeyeProblem:
    """The same trajectories with errors that are independent from pose to pose."""
    curves, has_time_offset = (
        (problem.reference, *problem.members),
        [x.has_time_offset for x in problem.layouts],
    )
    return _modelled(curves, problem.pace, "poses", options, has_time_offset)


def _modelled(
    curves: Sequence[TrajectoryCurve],
    pace: int,
    noise: NoiseModel,
    options: HandeyeOptions,
    has_time_offset: Sequence[bool],
) -> HandeyeProblem:
    layouts = tuple(
        MountingLayout(
            curve.segment_count if noise == "poses" else 0,
            time_offset,
            curve.segment_count if options.scale or not curve.trajectory.is_metric else 0,
        )
        for curve, time_offset in zip(curves[1:], has_time_offset, strict=True)
    )
    known = noise != "estimated" and all(
        t.name in options.levels or (t.covariances is not None and t.covariance_kind == noise)
        for t in (curve.trajectory for curve in curves)
    )
    return HandeyeProblem(curves[0], tuple(curves[1:]), layouts, noise, known, pace)


def step_covariances(problem: HandeyeProblem, options: HandeyeOptions) -> dict[str, Array]:
    """(N, 6, 6) covariances of every trajectory's own poses or increments, by name."""
    found = {}
    for curve in (problem.reference, *problem.members):
        trajectory = curve.trajectory
        if trajectory.covariances is not None and trajectory.covariance_kind == problem.noise:
            found[trajectory.name] = trajectory.covariances
        else:
            level = options.levels[trajectory.name]
            variances = np.repeat([level.rotation_std**2, level.translation_std**2], 3)
            found[trajectory.name] = np.broadcast_to(np.diag(variances), (len(trajectory), 6, 6))
    return found


def _declared_noise(trajectories: Sequence[Trajectory]) -> NoiseModel:
    kinds = {t.covariance_kind if t.covariances is not None else None for t in trajectories}
    if len(kinds) == 1 and None not in kinds:
        return "increments" if "increments" in kinds else "poses"
    return "estimated"


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
        strides = strides_of_both(reference, member, offset_s, stride_s)
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
    strides = strides_of_both(reference, member, 0.0, _STRIDES_S[1])
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


def strides_of_both(
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
    kept = is_unbroken(member, starts, starts + stride_ns)
    kept &= is_unbroken(reference, starts + offset_ns, starts + stride_ns + offset_ns)
    starts = starts[kept]
    if len(starts) < _FEWEST_STRIDES:
        return None
    return (
        _motions(reference, starts + offset_ns, stride_ns),
        _motions(member, starts, stride_ns),
    )


def is_unbroken(
    trajectory: Trajectory, first: NDArray[np.int64], last: NDArray[np.int64]
) -> NDArray[np.bool_]:
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
