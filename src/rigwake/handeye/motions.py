"""The hand-eye equations: residuals and Jacobians of one member against the reference.

With `X = ref_from_member`, the reference's motion A and the member's motion B over the same step obey
`A X = X B`. The measured motions are `A exp(a)` and `B exp(b)` with small errors a, b, so that

    r = log(B^-1 Y^-1 A X) = Ad(X^-1) a - b        (to first order; Y = X)

is pure noise, whatever the motion was. For absolute poses the same holds with the poses themselves in place
of the motions and `Y = world_ref_from_world_member`, an unknown of its own. Both are one problem here.

The Jacobian of r contains the measured motion, hence its errors: taken as it stands, it would pull weakly
excited directions towards zero and feign information (errors in variables). It is therefore evaluated at the
motion that both sides agree on, `C = X^-1 A exp(-g) X` with g the share of r that A is to blame for; its
error is then independent of r (profile likelihood over the true motions).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake.geometry.se3 import SE3
from rigwake.geometry.so3 import Array, hat
from rigwake.handeye.resample import Sampled, small_adjoint


@dataclass(frozen=True, eq=False)
class Mounting:
    """The unknowns of one member: `ref_from_member`, gauges (poses only), clock and scales, one per segment.

    worlds: G `world_ref_from_world_member`, one per segment, or None when increments are compared.
    """

    ref_from_member: SE3
    worlds: SE3 | None
    time_offset_s: float
    log_scales: Array

    def retract(self, step: Array, layout: Layout) -> Mounting:
        """The unknowns after a step in the order of `layout`."""
        worlds = self.worlds
        if worlds is not None:
            worlds = worlds.retract(step[layout.worlds].reshape(-1, 6))
        clock = float(step[layout.clock].sum())
        log_scales = self.log_scales.copy()
        log_scales[: layout.scale_count] += step[layout.scales]
        return Mounting(
            self.ref_from_member.retract(step[:6]), worlds, self.time_offset_s + clock, log_scales
        )


@dataclass(frozen=True)
class Layout:
    """Where the unknowns of one member stand in its columns: mounting, worlds, clock, scales."""

    world_count: int
    has_clock: bool
    scale_count: int

    @property
    def worlds(self) -> slice:
        """Six columns per world gauge."""
        return slice(6, 6 + 6 * self.world_count)

    @property
    def clock(self) -> slice:
        """The time offset, if estimated."""
        return slice(self.worlds.stop, self.worlds.stop + self.has_clock)

    @property
    def scales(self) -> slice:
        """One logarithm of a scale per segment, if estimated."""
        return slice(self.clock.stop, self.clock.stop + self.scale_count)

    @property
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


def steps_between(reference: Sampled, member: Sampled, absolute: bool) -> Steps:
    """Pair two sampled trajectories, as poses (`absolute`) or as motions from each time to the next."""
    valid = (reference.segments >= 0) & (member.segments >= 0)
    if absolute:
        zero = np.zeros_like(member.twists)
        return Steps(
            reference.world_from_body, member.world_from_body, zero, member.twists, valid, member.segments
        )
    unbroken = (np.diff(reference.segments) == 0) & (np.diff(member.segments) == 0)
    return Steps(
        _motions(reference.world_from_body),
        _motions(member.world_from_body),
        member.twists[:-1],
        member.twists[1:],
        valid[:-1] & valid[1:] & unbroken,
        member.segments[1:],
    )


def _motions(world_from_body: SE3) -> SE3:
    return world_from_body[:-1].inverse() * world_from_body[1:]


@dataclass(frozen=True, eq=False)
class Linearised:
    """Jacobians (N, 6, size) of the residuals, zero where not valid, and (N, 6, 6) Ad(C^-1)."""

    jacobians: Array
    adjoints: Array


def residuals(steps: Steps, mounting: Mounting) -> Array:
    """`log(B^-1 Y^-1 A X)` of every step, zero where not valid: (N, 6)."""
    r = (_scaled(steps, mounting).inverse() * _reference_in_member(steps, mounting)).log()
    return np.where(steps.valid[:, None], r, 0.0)


def linearise(steps: Steps, mounting: Mounting, layout: Layout, reference_errors: Array) -> Linearised:
    """Jacobians at `mounting`.

    reference_errors: (N, 6) estimated errors of the reference, in the member's tangent: `Ad(X^-1) a`.
    """
    agreed = _reference_in_member(steps, mounting) * SE3.exp(-reference_errors)
    Rt = np.swapaxes(agreed.rotation, -1, -2)
    body_translation = np.einsum("nij,nj->ni", Rt, agreed.translation)
    adjoints = agreed.inverse().adjoint()
    J = np.zeros((len(adjoints), 6, layout.size))
    if layout.world_count:
        J[:, :, :6] = np.eye(6)
        for world in range(layout.world_count):
            here = steps.segments == world
            J[here, :, 6 + 6 * world : 12 + 6 * world] = -adjoints[here]
    else:
        J[:, :, :6] = np.eye(6) - adjoints
    if layout.has_clock:
        scales = np.exp(mounting.log_scales)[steps.segments, None]
        after, before = steps.twists_after.copy(), steps.twists_before.copy()
        after[:, 3:] *= scales
        before[:, 3:] *= scales
        J[:, :, layout.clock.start] = after - np.einsum("nij,nj->ni", adjoints, before)
    for segment in range(layout.scale_count):
        here = steps.segments == segment
        J[here, 3:, layout.scales.start + segment] = -body_translation[here]
    J[~steps.valid] = 0
    return Linearised(J, adjoints)


def _scaled(steps: Steps, mounting: Mounting) -> SE3:
    if not mounting.log_scales.any():
        return steps.member
    scales = np.exp(mounting.log_scales)[steps.segments, None]
    return SE3(steps.member.rotation, steps.member.translation * scales)


def _reference_in_member(steps: Steps, mounting: Mounting) -> SE3:
    """`C = Y^-1 A X`, the reference's motion as the member should have seen it."""
    X = mounting.ref_from_member
    if mounting.worlds is None:
        return X.inverse() * steps.reference * X
    return mounting.worlds.inverse()[steps.segments] * steps.reference * X


def feigned_information(
    steps: Steps,
    linear: Linearised,
    layout: Layout,
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
    covariance, W = (x if len(x) == 1 else x[thinned] for x in (errors, weights))
    values, vectors = np.linalg.eigh(covariance)
    # six independent errors per step, first axis
    error = np.moveaxis(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :], 2, 0)
    segments = steps.segments[some]
    moved = small_adjoint(error) @ linear.adjoints[some]
    dJ = np.zeros((6, len(some), 6, layout.size))
    if not layout.world_count:
        dJ[..., :6] = moved
    for world in range(layout.world_count):
        dJ[..., 6 + 6 * world : 12 + 6 * world] = np.where((segments == world)[:, None, None], moved, 0.0)
    for segment in range(layout.scale_count):
        column = layout.scales.start + segment
        way = linear.jacobians[some, 3:, column]
        turned = error[..., 3:] + (hat(error[..., :3]) @ way[:, :, None])[..., 0]
        dJ[..., 3:, column] = -np.where((segments == segment)[:, None], turned, 0.0)
    WdJ = W @ dJ
    total = dJ.reshape(-1, layout.size).T @ WdJ.reshape(-1, layout.size)
    return total * (len(chosen) / len(some))
