"""The hand-eye problem in numbers: trajectories on one clock, and what their noise is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from rigwake._types import Array
from rigwake.errors import UsageError
from rigwake.handeye.handeye_result import HandeyeOptions, NoiseModel
from rigwake.handeye.motions import Mounting, MountingLayout, Steps, steps_between
from rigwake.handeye.noise import noise_over_steps
from rigwake.handeye.resample import Sampled, TrajectoryCurve
from rigwake.trajectory import Trajectory


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
