"""The hand-eye equations: residuals and Jacobians of one member against the reference.

With `X = ref_from_member`, the reference's motion A and the member's motion B over the same step obey
`A X = X B`. The measured motions are `A exp(a)` and `B exp(b)` with small errors a, b, so that

    r = log(B^-1 Y^-1 A X) = Ad(X^-1) a - b        (to first order; Y = X)

is pure noise, whatever the motion was. For absolute poses the same holds with the poses themselves in place
of the motions and `Y = world_ref_from_world_member`, an unknown of its own. Both are one problem here.

The Jacobian of r contains the measured motion, hence its errors: taken as it stands, it would pull weakly
excited directions towards zero and add spurious information (errors in variables). It is therefore evaluated at the
motion that both sides agree on, `C = X^-1 A exp(-g) X` with g the fraction of r that A is to blame for; its
error is then independent of r (profile likelihood over the true motions).

A trajectory as a function of time (cubic interpolation on SE(3)) stands first: its samples make the steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.geometry.se3 import SE3
from rigwake.handeye import kernels, normal_kernels
from rigwake.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Sampled:
    """Where a trajectory is at N asked times.

    world_from_body: N transforms. twists: (N, 6) body velocities `[rad/s, m/s]`.
    segments: (N,) int, -1 where the trajectory says nothing (outside it, inside a gap or between segments).
    """

    world_from_body: SE3
    twists: Array
    segments: NDArray[np.int64]

    @cached_property
    def motions(self) -> SE3:
        """`V_k^-1 V_k+1` from each time to the next: N - 1 transforms."""
        return self.motions_over(1)

    def motions_over(self, stride: int) -> SE3:
        """`V_k^-1 V_k+stride`: N - stride transforms."""
        V, starts = self.world_from_body, np.arange(len(self.segments) - stride)
        return SE3(*kernels.motions(V.rotation, V.translation, starts, stride))


@dataclass(frozen=True, eq=False)
class TrajectoryCurve:
    """A trajectory prepared for repeated interpolation.

    Between neighbouring poses j and j+1 the body follows `V_j exp(f(a))`, f the cubic Hermite polynomial in
    the tangent space at V_j with the velocities of both poses (Catmull-Rom); it passes through every pose.

    world_from_body: the poses. start_ns: the stamp that `times_s` counts from.
    increments: (N-1, 6) `log(V_j^-1 V_j+1)`.
    """

    trajectory: Trajectory
    world_from_body: SE3
    start_ns: int
    times_s: Array
    increments: Array
    twists: Array
    period_s: float
    max_gap_s: float

    @classmethod
    def of(cls, trajectory: Trajectory, max_gap_s: float | None = None) -> TrajectoryCurve:
        """Prepare `trajectory`; gaps longer than `max_gap_s` (default: 10 median periods) are not bridged."""
        times = trajectory.times_s
        # contiguous copies: the kernels are compiled for one layout only
        poses = SE3(trajectory.world_from_body.rotation.copy(), trajectory.world_from_body.translation.copy())
        increments = kernels.tangents(
            *kernels.motions(poses.rotation, poses.translation, np.arange(len(times) - 1), 1)
        )
        steps = np.diff(times)
        period = float(np.median(steps))
        longest = 10 * period if max_gap_s is None else max_gap_s
        return cls(
            trajectory,
            poses,
            int(trajectory.timestamps_ns[0]),
            times,
            increments,
            _node_twists(increments, steps),
            period,
            longest,
        )

    @property
    def segment_count(self) -> int:
        """Number of segments, counted from 0 to the highest id."""
        assert self.trajectory.segment_ids is not None
        return int(self.trajectory.segment_ids.max()) + 1

    @cached_property
    def at_poses(self) -> Sampled:
        """At its own stamps."""
        assert self.trajectory.segment_ids is not None
        return Sampled(self.world_from_body, self.twists, self.trajectory.segment_ids)

    def at(self, times_s: Array) -> Sampled:
        """Interpolate at `times_s`, seconds after `start_ns`; a tenth of a period past either end is allowed.

        Times within a nanosecond of a pose are that pose.
        """
        assert self.trajectory.segment_ids is not None
        poses = self.world_from_body
        rotation, translation, twists, segments = kernels.sample(
            self.times_s,
            poses.rotation,
            poses.translation,
            self.increments,
            self.twists,
            self.trajectory.segment_ids,
            times_s,
            self.max_gap_s,
            0.1 * self.period_s,
        )
        return Sampled(SE3(rotation, translation), twists, segments)


def _node_twists(increments: Array, steps: Array) -> Array:
    """Body velocities at the poses from both neighbouring increments (one-sided at the ends)."""
    speed = increments / steps[:, None]
    twists = np.empty((len(steps) + 1, 6))
    twists[0], twists[-1] = speed[0], speed[-1]
    before, after = steps[:-1, None], steps[1:, None]
    twists[1:-1] = (speed[:-1] * after + speed[1:] * before) / (before + after)
    return twists


def longest_segment_ids(trajectory: Trajectory, most: int) -> NDArray[np.int64]:
    """Numbers of the `most` longest segments, in their order in time."""
    assert trajectory.segment_ids is not None
    counts = np.bincount(trajectory.segment_ids)
    present = np.flatnonzero(counts)
    return np.sort(present[np.argsort(-counts[present], kind="stable")[:most]])


def longest_segments(trajectory: Trajectory, most: int) -> tuple[Trajectory, int]:
    """The trajectory with its `most` longest segments, numbered from 0, and how many poses of others were left out.

    Every segment brings unknowns of its own (scale, world); of those that last for a few poses hardly more is left.
    """
    ids = trajectory.segment_ids
    assert ids is not None
    kept = longest_segment_ids(trajectory, most)
    if np.isin(ids, kept).all():
        return trajectory, 0
    rows = np.flatnonzero(np.isin(ids, kept))
    covariances = None if trajectory.covariances is None else trajectory.covariances[rows]
    # covariances of increments stay true: within a segment nothing is thinned
    shorter = replace(
        trajectory,
        timestamps_ns=trajectory.timestamps_ns[rows],
        world_from_body=trajectory.world_from_body[rows],
        covariances=covariances,
        segment_ids=np.searchsorted(kept, ids[rows]),
    )
    return shorter, len(trajectory) - len(rows)


@dataclass(frozen=True, eq=False)
class Mounting:
    """The unknowns of one member: `ref_from_member`, gauges (poses only), clock and scales, one per segment.

    worlds: G `world_ref_from_world_member`, one per segment, or None when increments are compared.
    """

    ref_from_member: SE3
    worlds: SE3 | None
    time_offset_s: float
    log_scales: Array

    def retract(self, step: Array, layout: MountingLayout) -> Mounting:
        """The unknowns after a step in the order of `layout`."""
        worlds = self.worlds
        if worlds is not None:
            worlds = retracted(worlds, step[layout.worlds].reshape(-1, 6))
        time_offset = float(step[layout.time_offset].sum())
        log_scales = self.log_scales.copy()
        log_scales[: layout.scale_count] += step[layout.scales]
        X = retracted(self.ref_from_member[None], step[None, :6])[0]
        return Mounting(X, worlds, self.time_offset_s + time_offset, log_scales)


def retracted(transforms: SE3, deltas: Array) -> SE3:
    """`transforms.retract(deltas)`, compiled, for N transforms."""
    parts = (transforms.rotation, transforms.translation, deltas)
    return SE3(*kernels.retracted(*(np.ascontiguousarray(part) for part in parts)))


@dataclass(frozen=True)
class MountingLayout:
    """Where the unknowns of one member stand in its columns: mounting, worlds, clock, scales."""

    world_count: int
    has_time_offset: bool
    scale_count: int

    @cached_property
    def worlds(self) -> slice:
        """Six columns per world gauge."""
        return slice(6, 6 + 6 * self.world_count)

    @cached_property
    def time_offset(self) -> slice:
        """The time offset, if estimated."""
        return slice(self.worlds.stop, self.worlds.stop + self.has_time_offset)

    @cached_property
    def scales(self) -> slice:
        """One logarithm of a scale per segment, if estimated."""
        return slice(self.time_offset.stop, self.time_offset.stop + self.scale_count)

    @cached_property
    def size(self) -> int:
        """Number of unknowns."""
        return self.scales.stop


@dataclass(frozen=True, eq=False)
class Steps:
    """What both sides say about N steps in time, before any unknown enters.

    reference, member: motions (increments) or poses, the member's in its own unit. twists_before,
    twists_after: (N, 6) body velocities of the member at the start (zero for poses) and the end.
    valid: (N,) steps that both sides know. segments: (N,) index of the member's segment.
    """

    reference: SE3
    member: SE3
    twists_before: Array
    twists_after: Array
    valid: NDArray[np.bool_]
    segments: NDArray[np.int64]


def steps_between(reference: Sampled, member: Sampled, absolute: bool, stride: int = 1) -> Steps:
    """Pair two sampled trajectories, as poses (`absolute`) or as motions from each time to the `stride`-th next."""
    valid = (reference.segments >= 0) & (member.segments >= 0)
    if absolute:
        zero = np.zeros_like(member.twists)
        return Steps(
            reference.world_from_body, member.world_from_body, zero, member.twists, valid, member.segments
        )
    start, end = slice(None, -stride), slice(stride, None)
    unbroken = (reference.segments[start] == reference.segments[end]) & (
        member.segments[start] == member.segments[end]
    )
    return Steps(
        reference.motions if stride == 1 else reference.motions_over(stride),
        member.motions if stride == 1 else member.motions_over(stride),
        member.twists[start],
        member.twists[end],
        valid[start] & valid[end] & unbroken,
        member.segments[end],
    )


@dataclass(frozen=True, eq=False)
class Linearised:
    """Of N steps, zero where not valid: Jacobians (N, 6, size) of the residuals; (N, 6, 6) Ad(C^-1) of the
    agreed motions C, and their translations (N, 3) in the moved frame, `R_C^T t_C`."""

    jacobians: Array
    adjoints: Array
    ways: Array


def residuals(steps: Steps, mounting: Mounting) -> Array:
    """`log(B^-1 Y^-1 A X)` of every step, zero where not valid: (N, 6)."""
    A, B = steps.reference, steps.member
    return kernels.residuals(
        A.rotation,
        A.translation,
        B.rotation,
        B.translation,
        np.exp(mounting.log_scales),
        steps.segments,
        steps.valid,
        *_frames(mounting),
    )


def linearise(
    steps: Steps, mounting: Mounting, layout: MountingLayout, reference_errors: Array
) -> Linearised:
    """Jacobians at `mounting`.

    reference_errors: (N, 6) estimated errors of the reference, in the member's tangent: `Ad(X^-1) a`.
    """
    A = steps.reference
    adjoints, ways = kernels.agreed_motions(
        A.rotation,
        A.translation,
        steps.segments,
        steps.valid,
        *_frames(mounting),
        np.ascontiguousarray(reference_errors),
    )
    J = kernels.jacobians(
        adjoints,
        ways,
        steps.twists_before,
        steps.twists_after,
        np.exp(mounting.log_scales),
        steps.segments,
        steps.valid,
        layout.world_count,
        layout.has_time_offset,
        layout.scale_count,
    )
    return Linearised(J, adjoints, ways)


def _frames(mounting: Mounting) -> tuple[Array, Array, Array, Array]:
    """Y of every segment (or the one for all) and X, as contiguous rotations and translations."""
    X = mounting.ref_from_member
    Y = X[None] if mounting.worlds is None else mounting.worlds
    parts = (Y.rotation, Y.translation, X.rotation, X.translation)
    R, t, R_X, t_X = (np.ascontiguousarray(part) for part in parts)
    return R, t, R_X, t_X


def spurious_information(
    steps: Steps,
    linear: Linearised,
    layout: MountingLayout,
    chosen: NDArray[np.int64],
    errors: Array,
    weights: Array,
) -> Array:
    """Information that the errors of the agreed motions add to `J^T W J` by themselves: (size, size).

    `E[dJ^T W dJ]` summed over the steps `chosen`, dJ the first-order effect of an error of covariance
    `errors` in the member's tangent, W `weights` (both (1 or n, 6, 6)). Evaluated on some 100 of the steps.
    """
    thinned = slice(None, None, max(1, len(chosen) // 100))
    some = chosen[thinned]
    covariances, W = (np.ascontiguousarray(x if len(x) == 1 else x[thinned]) for x in (errors, weights))
    total = normal_kernels.spurious(
        covariances,
        W,
        linear.adjoints,
        linear.ways,
        steps.segments,
        np.ascontiguousarray(some),
        layout.world_count,
        layout.scales.start,
        layout.size,
        layout.scale_count,
    )
    return total * (len(chosen) / len(some))
