"""A first mounting from relative motions, in closed form, whatever the motion was like.

Several candidates are computed and the one that explains the motions best starts the likelihood:

- turning about more than one axis: Kabsch on rotation vectors, `log R_A = R_X log R_B` (Park and Martin 1994);
- turning about one axis only (a vehicle on a plane): the rotation about that axis follows from the
  translations, `t_A = R_X t_B + (I - R_A) t_X`, linear in its cosine and sine;
- hardly turning: Kabsch on rotation vectors and translations together.

Translation and scales then follow linearly. Directions without information stay at zero.

`thesis_handeye` is the baseline: a classical linear solution on absolute poses, refined by a bounded trust region.

1. Rotation: null vector of the stacked `(I9 - R_A (x) R_B) vec(R_X) = 0`, scaled to determinant one.
2. Translation: pseudo-inverse of the stacked `(R_A - I) t_X = R_X t_B - t_A`.
3. Refinement of quaternion and translation with bounds (`scipy.optimize.least_squares`, `trf`) on the
   entries of `A X - X B`.

A and B are the poses relative to the first one, treated as if their errors were independent: which they
are not for odometry. It has no covariance and does not say what is unobservable: this is what `ml` improves on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rigwake._types import Array
from rigwake.errors import UnobservableError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye import kernels
from rigwake.handeye.handeye_problem import HandeyeProblem
from rigwake.handeye.motions import Mounting, MountingLayout, Sampled

MIN_STEPS = 4
_WEAK = 1e-3  # of the best excited direction: left at zero here, the likelihood decides
_MAX_MOTIONS = 5000


@dataclass(frozen=True, eq=False)
class _Motions:
    reference: SE3
    member: SE3
    segments: NDArray[np.int64]

    @cached_property
    def levers(self) -> Array:
        """`I - R_A`: (N, 3, 3)."""
        return np.asarray(np.eye(3) - self.reference.rotation)


def initial_mountings(problem: HandeyeProblem, offsets_s: list[float]) -> list[Mounting]:
    """A start for every member. Raises UnobservableError when a member shares too few steps."""
    blank = [
        Mounting(SE3.identity(), None, offset, np.zeros(curve.segment_count))
        for offset, curve in zip(offsets_s, problem.members, strict=True)
    ]
    reference, members = problem.sampled(blank)
    return [
        _initial(problem, m, reference, members[m], blank[m].time_offset_s)
        for m in range(len(problem.members))
    ]


def _initial(
    problem: HandeyeProblem, m: int, reference: Sampled, member: Sampled, offset_s: float
) -> Mounting:
    layout, name = problem.layouts[m], problem.members[m].trajectory.name
    shared = int(np.sum((reference.segments >= 0) & (member.segments >= 0)))
    if shared <= MIN_STEPS:
        raise UnobservableError(
            f"{problem.reference.trajectory.name} and {name} share {shared} poses in time.",
            consequence="That cannot determine a mounting.",
            remedy="Record both at once, for longer; check that their clocks overlap.",
        )
    strides = sorted({1, max(1, shared // 12)})
    motions = [
        x for stride in strides if len((x := _motions(reference, member, stride)).segments) >= MIN_STEPS
    ]
    if not motions:
        raise UnobservableError(
            f"{name} is too broken up: hardly two neighbouring poses without a gap between.",
            remedy="Record with fewer interruptions, or allow longer gaps.",
        )
    judge = motions[-1]
    candidates = [c for x in motions for c in _candidates(x, layout, problem.members[m].segment_count)]
    X, scales = min(candidates, key=lambda c: _misfit(judge, *c))
    return Mounting(X, _worlds(reference, member, X, scales, layout), offset_s, np.log(scales))


def _motions(reference: Sampled, member: Sampled, stride: int) -> _Motions:
    start, end = slice(None, -stride), slice(stride, None)
    usable = (
        (reference.segments[start] >= 0)
        & (reference.segments[start] == reference.segments[end])
        & (member.segments[start] >= 0)
        & (member.segments[start] == member.segments[end])
    )
    index = np.flatnonzero(usable)
    index = index[:: max(1, len(index) // _MAX_MOTIONS)]

    def between(world_from_body: SE3) -> SE3:
        return SE3(*kernels.motions(world_from_body.rotation, world_from_body.translation, index, stride))

    return _Motions(
        between(reference.world_from_body), between(member.world_from_body), member.segments[index]
    )


def _candidates(motions: _Motions, layout: MountingLayout, segments: int) -> Iterator[tuple[SE3, Array]]:
    rotations_a, rotations_b = (
        kernels.rotation_vectors(x.rotation) for x in (motions.reference, motions.member)
    )
    by_turning = _kabsch(rotations_a, rotations_b)
    yield _with_translation(motions, by_turning, layout, segments)
    yield _with_translation(motions, _turned_about_axis(motions, by_turning, rotations_b), layout, segments)
    way_a, way_b = motions.reference.translation, motions.member.translation
    size_a, size_b = np.linalg.norm(way_a), np.linalg.norm(way_b)
    if size_a > 0 and size_b > 0:
        # in units in which turning and moving weigh alike
        turning = max(float(np.linalg.norm(rotations_a)), 1e-12)
        both_a = np.vstack([rotations_a / turning, way_a / size_a])
        both_b = np.vstack([rotations_b / turning, way_b / size_b])
        yield _with_translation(motions, _kabsch(both_a, both_b), layout, segments)


def _kabsch(a: Array, b: Array) -> Array:
    """R that minimises `sum |a - R b|^2`."""
    return so3.nearest_rotation(a.T @ b)


def _turned_about_axis(motions: _Motions, rotation: Array, rotations_b: Array) -> Array:
    """`rotation` turned about the main axis of turning so that the translations agree best."""
    axis = rotation @ np.linalg.eigh(rotations_b.T @ rotations_b)[1][:, -1]
    way = motions.member.translation @ rotation.T
    along = (way @ axis)[:, None] * axis
    across, quarter = way - along, way @ so3.hat(axis).T
    columns = np.stack([across, quarter, along], axis=2)
    system = np.concatenate([columns, motions.levers], axis=2).reshape(-1, 6)
    solution = _least_squares(system, motions.reference.translation.ravel(), _lever_noise(motions, rotation))
    return so3.exp(axis * np.arctan2(solution[1], solution[0])) @ rotation


def _with_translation(
    motions: _Motions, rotation: Array, layout: MountingLayout, segments: int
) -> tuple[SE3, Array]:
    """Translation and scales of a given rotation by linear least squares."""
    lever = motions.levers
    way = motions.member.translation @ rotation.T
    noise = _lever_noise(motions, rotation)
    scales = np.ones(segments)
    if not layout.scale_count:
        right = (motions.reference.translation - way).ravel()
        return SE3(rotation, _least_squares(lever.reshape(-1, 3), right, noise)), scales
    by_segment = np.zeros((*way.shape, segments))
    by_segment[np.arange(len(way)), :, motions.segments] = way
    sizes = np.linalg.norm(by_segment, axis=(0, 1))
    ratio = np.linalg.norm(motions.reference.translation) / max(float(np.linalg.norm(sizes)), 1e-300)
    present = sizes > 0
    unit = np.where(present, ratio, 1.0)
    system = np.concatenate([lever, by_segment[:, :, present] * unit[present]], axis=2)
    right = motions.reference.translation.ravel()
    solution = _least_squares(system.reshape(-1, system.shape[2]), right, noise)
    # a scale cannot be negative; such a candidate fits badly and loses
    scales[present] = np.maximum(solution[3:], 1e-3) * unit[present]
    return SE3(rotation, solution[:3]), scales


def _lever_noise(motions: _Motions, rotation: Array) -> float:
    """Singular values of the stacked levers `I - R_A` up to here may be noise alone.

    What the rotations of both sides disagree by tells it. Taken at its word, it would put the member hundreds
    of metres away when the vehicle does not turn.
    """
    A, B, R = motions.reference, motions.member, np.ascontiguousarray(rotation)
    return float(kernels.disagreement(A.rotation, B.rotation, R))


def _least_squares(system: Array, right: Array, noise: float) -> Array:
    """The solution along the singular directions that stand out of `noise`, zero along the others."""
    squares, V = np.linalg.eigh(system.T @ system)
    values = np.sqrt(np.maximum(squares, 0.0))
    kept = values > max(noise, _WEAK * float(values[-1]))
    V, squares = V[:, kept], squares[kept]
    return np.asarray(V @ ((right @ system @ V) / squares))


def _misfit(motions: _Motions, X: SE3, scales: Array) -> float:
    """How badly `A X = X B` holds: the likelihood of noise of unknown levels, up to constants."""
    A, B = motions.reference, motions.member
    turned, moved = kernels.misfit(
        A.rotation,
        A.translation,
        B.rotation,
        B.translation,
        scales[motions.segments],
        np.ascontiguousarray(X.rotation),
        X.translation,
    )
    return float(np.log(turned + 1e-20) + np.log(moved + 1e-20))


def with_worlds(problem: HandeyeProblem, mountings: Sequence[Mounting]) -> list[Mounting]:
    """The mountings with those gauges between the worlds that fit them best, where `problem` has any."""
    reference, members = problem.sampled(mountings)
    return [
        replace(x, worlds=_worlds(reference, member, x.ref_from_member, np.exp(x.log_scales), layout))
        for x, member, layout in zip(mountings, members, problem.layouts, strict=True)
    ]


def _worlds(reference: Sampled, member: Sampled, X: SE3, scales: Array, layout: MountingLayout) -> SE3 | None:
    """`world_ref_from_world_member` of every segment as a mean over its poses."""
    if not layout.world_count:
        return None
    body = reference.world_from_body * X
    rotations, translations = [], []
    for segment in range(layout.world_count):
        here = (member.segments == segment) & (reference.segments >= 0)
        moved = member.world_from_body
        products = body.rotation[here] @ np.swapaxes(moved.rotation[here], -1, -2)
        R = so3.nearest_rotation(products.sum(axis=0)) if here.any() else np.eye(3)
        offset = body.translation[here] - float(scales[segment]) * moved.translation[here] @ R.T
        rotations.append(R)
        translations.append(np.asarray(offset.mean(axis=0)) if here.any() else np.zeros(3))
    return SE3(np.stack(rotations), np.stack(translations))


_TRANSLATION_BOUND = 100.0  # metres around the linear solution


def thesis_handeye(reference_poses: SE3, member_poses: SE3) -> SE3:
    """`ref_from_member` from N synchronous poses of both."""
    A = reference_poses[0].inverse() * reference_poses[1:]
    B = member_poses[0].inverse() * member_poses[1:]
    linear = linear_handeye(A, B)
    start = np.concatenate([linear.quat_wxyz, linear.translation])
    reach = np.concatenate([np.ones(4) + 1e-9, np.full(3, _TRANSLATION_BOUND)])
    low = np.concatenate([-reach[:4], linear.translation - reach[4:]])
    high = np.concatenate([reach[:4], linear.translation + reach[4:]])

    def misfit(unknowns: Array) -> Array:
        X = SE3.from_quat_wxyz(unknowns[:4], unknowns[4:])
        left, right = A * X, X * B
        return np.concatenate(
            [(left.rotation - right.rotation).ravel(), (left.translation - right.translation).ravel()]
        )

    found = least_squares(misfit, start, bounds=(low, high), method="trf").x
    return SE3.from_quat_wxyz(found[:4], found[4:])


def linear_handeye(A: SE3, B: SE3) -> SE3:
    """Steps 1 and 2 for motions with `A X = X B`."""
    n = len(A)
    kronecker = np.einsum("nij,nkl->nikjl", A.rotation, B.rotation).reshape(n, 9, 9)
    _, _, Vt = np.linalg.svd((np.eye(9) - kronecker).reshape(-1, 9), full_matrices=False)
    V = Vt[-1].reshape(3, 3)
    determinant = np.linalg.det(V)
    R = so3.nearest_rotation(V * np.sign(determinant) / max(abs(determinant), 1e-300) ** (1 / 3))
    left = (A.rotation - np.eye(3)).reshape(-1, 3)
    right = (B.translation @ R.T - A.translation).ravel()
    return SE3(R, np.linalg.pinv(left) @ right)
