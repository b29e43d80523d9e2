"""Whether a mounting and a time offset stay what they are for a whole recording.

Hand-eye calibration finds one mounting and one time offset. Where a body was moved halfway or where its clock runs at
another rate, one value for all is wrong; robust weights hide it.
Over strides of seconds the residual `log(B^-1 X^-1 A X)` is linear in a small change of the mounting (six numbers), of
the time offset and of the scale; normal equations per block of ten seconds tell how these change. Noise is the
scatter between blocks, near and far apart, so that slow drift counts; a change between halves does not widen it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._robust import robust_std
from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeResult, is_unbroken
from rigwake.plausibility.handeye_fit import left_over, scaled_poses, stride_rows
from rigwake.plausibility.values import SensorCheck
from rigwake.trajectory import Trajectory

_STRIDE_S = 2.0
_BLOCK_S = 10.0
_FEWEST_BLOCKS = 4
_FEWEST_STRIDES = 8
_MOST_STRIDES = 6000  # enough for an hour; more only repeats them
_SHIFT_S = 0.01  # of the time offset, for its derivative
_HUBER = 1.5
_OFFSET, _SCALE = 6, 7
# what one block may tell nothing about keeps these deviations: metres, radians, seconds, of one
_PRIOR_STD = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5, 1.0, 1.0])
_CHI2_CHANGE = 60.0  # six degrees of freedom, many splits, and drift of odometry lasts longer than a block
_SIGMAS = 6.0
_NEXT_BLOCKS = 3  # on each side of a split
_SUDDEN = 5.0  # times what is usual between blocks next to each other
_LEAST_TURN_DEG = 0.3
_LEAST_SHIFT_M = 0.1
_LEAST_RATE = 2e-4  # of one: clocks of computers keep 1e-4
_PRIOR_RATE_STD = 0.01
_LEAST_WAY_M = 0.05  # of a stride, by the reference, while the member is frozen


@dataclass(frozen=True)
class _StrideResiduals:
    """Residual twists (N, 6), translation first, of strides, their derivatives (N, 6, 8), the member's own motion
    (N, 6), and their times (N,), seconds from its start."""

    residuals: Array
    jacobian: Array
    motion: Array
    times_s: Array


@dataclass(frozen=True)
class _BlockEquations:
    """Normal equations per block: H (K, 8, 8), g (K, 8), middle times (K,) in seconds from the start."""

    H: Array
    g: Array
    times_s: Array


def check_steadiness(
    reference: Trajectory, member: Trajectory, result: HandeyeResult
) -> tuple[SensorCheck, ...]:
    """What of one member does not stay the same during its recording; empty where everything does, or where the
    recording is too short to tell (four blocks of ten seconds)."""
    strides = _strides(reference, member, result)
    if strides is None:
        return ()
    frozen = _check_frozen(strides, reference, member)
    blocks = _blocks(strides)
    if len(blocks.times_s) < _FEWEST_BLOCKS:
        return tuple(c for c in (frozen,) if c)
    variance = _variance_between_blocks(blocks)
    found = (
        frozen,
        _check_rate(blocks, variance, reference, member),
        _check_change(blocks, variance, member),
    )
    return tuple(check for check in found if check)


def _strides(reference: Trajectory, member: Trajectory, result: HandeyeResult) -> _StrideResiduals | None:
    camera, X = result.members[member.name], result.ref_from_members[member.name]
    if not np.isfinite(X.matrix).all():
        return None
    shift_ns = round(_SHIFT_S * 1e9)
    at = member.timestamps_ns + round((camera.time_offset_s or 0.0) * 1e9)
    inside = (at >= reference.timestamps_ns[0] + shift_ns) & (at <= reference.timestamps_ns[-1] - shift_ns)
    rows = np.flatnonzero(inside)
    starts, ends = stride_rows(member, rows, _STRIDE_S, 1.5 * _STRIDE_S, _MOST_STRIDES)
    for moved_ns in (-shift_ns, shift_ns):  # poses of the reference within a gap are a guess
        whole = is_unbroken(reference, at[starts] + moved_ns, at[ends] + moved_ns)
        starts, ends = starts[whole], ends[whole]
    if len(starts) < _FEWEST_STRIDES:
        return None
    here = scaled_poses(member, result)
    B = here[starts].inverse() * here[ends]

    def residuals(moved_ns: int) -> Array:
        left = left_over(reference, X, B, at[starts] + moved_ns, at[ends] + moved_ns)
        return np.concatenate([left.translation, so3.log(left.rotation)], axis=1)

    around = residuals(0)
    by_offset = (residuals(shift_ns) - residuals(-shift_ns)) / (2 * _SHIFT_S)
    jacobian = _derivatives(B, by_offset)
    if not member.is_metric:
        jacobian[:, :3], around[:, :3] = 0.0, 0.0
    known = np.isfinite(around).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    times = (member.timestamps_ns[starts] - member.timestamps_ns[0]) * 1e-9
    motion = np.concatenate([B.translation, so3.log(B.rotation)], axis=1)
    if known.sum() < _FEWEST_STRIDES:
        return None
    return _StrideResiduals(
        around[known], jacobian[known], np.where(np.abs(motion) < 1e-7, 0.0, motion)[known], times[known]
    )


def _derivatives(B: SE3, by_offset: Array) -> Array:
    """What residuals become per metre and radian of the mounting, second of time offset, and one of scale; (N, 6, 8).

    With `X exp(xi)` in place of X the residual loses `(Ad(B^-1) - 1) xi`.
    """
    R_T = np.swapaxes(B.rotation, 1, 2)
    J = np.zeros((len(R_T), 6, 8))
    J[:, :3, :3] = J[:, 3:, 3:6] = R_T - np.eye(3)
    J[:, :3, 3:6] = -R_T @ so3.hat(B.translation)
    J[:, :, _OFFSET] = -by_offset
    J[:, :3, _SCALE] = np.einsum("nij,nj->ni", R_T, B.translation)
    return J


def _blocks(strides: _StrideResiduals) -> _BlockEquations:
    """Normal equations per block, with Huber's weights around the fit of all."""
    r, J = strides.residuals, strides.jacobian
    change = np.zeros(8)
    for _ in range(4):
        left = r - J @ change
        std = np.repeat([max(robust_std(left[:, :3]), 1e-6), max(robust_std(left[:, 3:]), 1e-7)], 3)
        if not left[:, :3].any():
            std[:3] = np.inf
        size = np.linalg.norm(left / std, axis=1) / np.sqrt(6)
        weight = np.minimum(1.0, _HUBER / np.maximum(size, 1e-9))
        white_J, white_r = J / std[:, None], r / std
        H = np.einsum("n,nij,nik->jk", weight, white_J, white_J) + np.diag(_PRIOR_STD**-2)
        change = np.linalg.solve(H, np.einsum("n,nij,ni->j", weight, white_J, white_r))
    number = (strides.times_s // _BLOCK_S).astype(np.int64)
    kinds, block = np.unique(number, return_inverse=True)
    H_blocks, g_blocks = np.zeros((len(kinds), 8, 8)), np.zeros((len(kinds), 8))
    np.add.at(H_blocks, block, weight[:, None, None] * (np.swapaxes(white_J, 1, 2) @ white_J))
    np.add.at(g_blocks, block, weight[:, None] * np.einsum("nij,ni->nj", white_J, white_r))
    return _BlockEquations(H_blocks, g_blocks, np.asarray((kinds + 0.5) * _BLOCK_S))


def _variance_between_blocks(blocks: _BlockEquations) -> float:
    """By how much blocks differ more than independent residuals would let them: the largest of medians over pairs 1, 2,
    4 .. blocks apart. Drift that lasts shows in pairs far apart; of a change between halves, pairs on one side of it
    are the most."""
    lags = [lag for lag in (1, 2, 4, 8, 16, 32) if lag <= len(blocks.g) // 4] or [1]
    return max([1.0, *(_variance_at(blocks, lag) for lag in lags)])


def _variance_at(blocks: _BlockEquations, lag: int) -> float:
    prior = np.diag(_PRIOR_STD**-2)
    apart = []
    for first in range(len(blocks.g) - lag):
        two = [first, first + lag]
        alone = sum(_gain(H + prior, g) for H, g in zip(blocks.H[two], blocks.g[two], strict=True))
        together = _gain(blocks.H[two].sum(axis=0) + 2 * prior, blocks.g[two].sum(axis=0))
        apart.append((alone - together) / 8)
    return float(np.median(apart))


def _gain(H: Array, g: Array) -> float:
    """By how much the best parameters lower the sum of squares."""
    return float(g @ np.linalg.solve(H, g))


def _solve(H: Array, g: Array, variance: float) -> tuple[Array, Array]:
    """Parameters and their covariance."""
    covariance = np.linalg.inv(H + np.diag(_PRIOR_STD**-2) / variance)
    return covariance @ g, np.asarray(variance * covariance)


def _check_frozen(strides: _StrideResiduals, reference: Trajectory, member: Trajectory) -> SensorCheck | None:
    """Exactly the same pose again and again, while the reference moves."""
    held = ~strides.motion.any(axis=1) & (np.linalg.norm(strides.residuals[:, :3], axis=1) > _LEAST_WAY_M)
    times = strides.times_s[held]
    if len(times) < 2 or times[-1] - times[0] < _STRIDE_S:
        return None
    gaps = np.flatnonzero(np.diff(times) > _STRIDE_S)
    bounds = np.concatenate([[-1], gaps, [len(times) - 1]])
    longest = int(np.argmax(times[bounds[1:]] - times[bounds[:-1] + 1]))
    start, end = times[bounds[longest] + 1], times[bounds[longest + 1]] + _STRIDE_S
    return SensorCheck(
        f"trajectory {member.name}",
        False,
        float(end - start),
        _STRIDE_S,
        f"its pose is exactly the same from {start:.1f} to {end:.1f} s after its start, while {reference.name} moves.",
        "Leave these rows out.",
        "time without a new pose, s",
    )


def _check_rate(
    blocks: _BlockEquations, variance: float, reference: Trajectory, member: Trajectory
) -> SensorCheck | None:
    """A ninth parameter: seconds of time offset per second."""
    at = blocks.times_s - blocks.times_s.mean()
    design = np.tile(np.eye(8, 9), (len(at), 1, 1))
    design[:, _OFFSET, 8] = at
    H = np.einsum("kia,kij,kjb->ab", design, blocks.H, design)
    g = np.einsum("kia,ki->a", design, blocks.g)
    H += np.diag(np.append(_PRIOR_STD, _PRIOR_RATE_STD) ** -2) / variance
    rate = float(np.linalg.solve(H, g)[8])
    std = float(np.sqrt(variance * np.linalg.inv(H)[8, 8]))
    if abs(rate) < max(_LEAST_RATE, _SIGMAS * std):
        return None
    return SensorCheck(
        f"trajectory {member.name}",
        False,
        rate,
        _LEAST_RATE,
        f"its clock runs {abs(rate):.2%} {'slower' if rate > 0 else 'faster'} than that of {reference.name}.",
        "Correct its time stamps.",
        "rate of its clock against the reference's",
    )


def _check_change(blocks: _BlockEquations, variance: float, member: Trajectory) -> SensorCheck | None:
    """The split into before and after that explains most, if it explains more than chance and than drift of the
    odometry, and all at once. The scale may differ on both sides."""
    varied = np.array([*range(6), _SCALE])
    rest, _ = _solve(blocks.H.sum(axis=0), blocks.g.sum(axis=0), variance)
    H = blocks.H[:, varied[:, None], varied]
    g = blocks.g[:, varied] - blocks.H[:, varied, _OFFSET] * rest[_OFFSET]
    prior = np.diag(_PRIOR_STD[varied] ** -2)
    H_before, g_before = np.cumsum(H, axis=0), np.cumsum(g, axis=0)
    H_after, g_after = H_before[-1] - H_before + prior, g_before[-1] - g_before
    whole = _gain(H_before[-1] + prior, g_before[-1])
    H_before = H_before + prior
    splits = range(1, len(g) - 2)
    gains = [_gain(H_before[k], g_before[k]) + _gain(H_after[k], g_after[k]) - whole for k in splits]
    if not gains or max(gains) / variance < _CHI2_CHANGE:
        return None
    k = splits[int(np.argmax(gains))]
    if not _is_sudden(H, g, prior, k):
        return None
    apart = np.linalg.solve(H_after[k], g_after[k]) - np.linalg.solve(H_before[k], g_before[k])
    std = np.sqrt(variance * np.diag(np.linalg.inv(H_before[k]) + np.linalg.inv(H_after[k])))
    clear = np.where(np.abs(apart) > _SIGMAS * std, apart, 0.0)
    turned, moved = float(np.degrees(np.linalg.norm(clear[3:6]))), float(np.linalg.norm(clear[:3]))
    words = [f"turned by {turned:.1f} deg"] * (turned > _LEAST_TURN_DEG)
    words += [f"moved by {moved:.2f} m"] * (moved > _LEAST_SHIFT_M)
    if not words:
        return None
    when = 0.5 * (blocks.times_s[k] + blocks.times_s[k + 1])
    return SensorCheck(
        f"trajectory {member.name}",
        False,
        max(gains) / variance,
        _CHI2_CHANGE,
        f"its body {' and '.join(words)} on the rig, about {when:.0f} s after the start.",
        f"Calibrate the parts before and after {when:.0f} s separately.",
        "change of the mounting, chi-square",
    )


def _is_sudden(H: Array, g: Array, prior: Array, k: int) -> bool:
    """Whether the blocks next to a split differ far more than those next to other places do: drift changes little by
    little, everywhere."""
    width = min(_NEXT_BLOCKS, (len(g) - 2) // 3)
    if width < 1:
        return False

    def apart(split: int) -> float:
        sides = (slice(split - width + 1, split + 1), slice(split + 1, split + 1 + width))
        alone = sum(_gain(H[side].sum(axis=0) + prior, g[side].sum(axis=0)) for side in sides)
        both = slice(sides[0].start, sides[1].stop)
        return max(alone - _gain(H[both].sum(axis=0) + 2 * prior, g[both].sum(axis=0)), 0.0)

    splits = range(width - 1, len(g) - width)
    elsewhere = [apart(split) for split in splits if abs(split - k) >= width]
    return k in splits and len(elsewhere) > 1 and apart(k) > _SUDDEN**2 * float(np.median(elsewhere))
