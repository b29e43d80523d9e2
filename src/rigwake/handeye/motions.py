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
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.geometry.se3 import SE3
from rigwake.handeye import kernels, normal_kernels
from rigwake.handeye.resample import Sampled


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
