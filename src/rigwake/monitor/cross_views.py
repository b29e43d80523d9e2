"""Points that two cameras see: what one camera tracked, found again by another, at the same time or a second apart.

A point's bearing `u` at its first sighting, and its inverse range `q` from the second that its own camera followed it,
say where the other camera sees it: along `d = u + q (a - b)` from b (a, b: the cameras' places in rig axes at the first
sighting). What is seen there is off by two angles:

- across the epipolar plane of a, b and u: it needs no range. At the same time it needs no motion of the rig either, and
  tells two cameras against each other even at standstill: the cue `overlap`.
- within that plane: it needs the range, and is what tells rotations about the vertical where points, cameras and
  way all lie level and every epipolar plane with them. This, and all sightings at other times: the cue `landmarks`.

Both compare the rims of two pictures, where lens models are worst. An offset of three angles per pair of cameras, which
stays as it is, is therefore unknown beside the cameras' changes: three more columns for each pair (`offset_columns`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._robust import MAD_TO_STD
from rigwake._types import Array, Indices, Mask
from rigwake.geometry import so3
from rigwake.monitor.block_motion import BlockMotion
from rigwake.monitor.pair_kernels import MOUNTING, cross, sum_by, times
from rigwake.monitor.rig_motion import PairMotion, RigMotion
from rigwake.monitor.score import BlockScores
from rigwake.rig import Rig
from rigwake.tracks import CrossViews

_SAME_TIME_S = 0.02
_LOSS_STDS = 4.0
_FEWEST_ROWS = 40
_INVERSE_RANGE, _INVERSE_RANGE_STD = (
    0.03,
    0.05,
)  # 1/m, of what is tracked from a boat, before its own track tells
_LEAST_WAY_M = 0.25
_VELOCITY_STD, _SLOT_NS = (
    0.1,
    0.5e9,
)  # m/s, of what epipolar planes say over an open bay; sightings that share it
_BIAS_STD = 3e-3  # rad/s, that the gyro may be off in the first blocks over an open bay
_BEHIND = 0.5  # what is off by more (radians) is another point
_TURN, _SHIFT = 1e-5, 1e-4  # of numeric derivatives: radians; metres, seconds, m/s


def offset_columns(cameras: int) -> Indices:
    """(C, C) where the first of a pair's three offsets stands in the scores, alike for both orders; -1 for itself."""
    table = np.full((cameras, cameras), -1, dtype=np.int64)
    first, second = np.triu_indices(cameras, 1)
    table[first, second] = table[second, first] = MOUNTING * cameras + 3 * np.arange(len(first))
    return table


@dataclass(frozen=True, eq=False)
class _LinkedViews:
    """M second views, and how the rig moves from the first sighting to the later one of the same camera, and to the
    other camera's. velocity: (M, 3), level axes. lag_s: (M,). moving: (M,) whether the rig's way is known.
    """

    views: CrossViews
    later: PairMotion
    other: PairMotion
    velocity: Array
    lag_s: Array
    moving: Mask


@dataclass(frozen=True, eq=False)
class _Mounts:
    """Rotation (M, 3, 3) and place (M, 3) of each view's source camera, and of its target."""

    source_turn: Array
    source_place: Array
    target_turn: Array
    target_place: Array


def score_cross_views(
    views: CrossViews, rig: Rig, motion: RigMotion, found: BlockMotion | None, block: BlockScores
) -> tuple[BlockScores, BlockScores]:
    """Scores of one block by the cues `overlap` and `landmarks`.

    views: that begin in the block. found: the rig's velocities there, None where it made no way. block: the scores by
    ego-motion, whose conditions are kept.
    """
    seen = _motions(views, rig, motion, found)
    mounts = _mounts(seen.views, rig)
    residual, std = _residuals(seen, mounts)
    jacobian = _jacobian(seen, mounts)
    across = np.abs(seen.lag_s) < _SAME_TIME_S
    inside = seen.moving & (np.abs(residual).max(axis=1) < _BEHIND)
    lag = np.abs(seen.lag_s)[:, None]
    std = np.sqrt(std**2 + (motion.gyro_noise**2 * lag))
    parts = []
    bias_std = _BIAS_STD if found is None else max(found.bias.std, _BIAS_STD)
    for rows in (
        (np.flatnonzero(across & (np.abs(residual[:, 0]) < _BEHIND)), np.empty(0, dtype=np.int64)),
        (np.flatnonzero(inside & ~across), np.flatnonzero(inside)),
    ):
        use = np.concatenate([2 * rows[0], 2 * rows[1] + 1])
        parts.append(_scored(use, residual.ravel(), std.ravel(), jacobian, seen.views, block, bias_std))
    return parts[0], parts[1]


def _motions(views: CrossViews, rig: Rig, motion: RigMotion, found: BlockMotion | None) -> _LinkedViews:
    offsets = {name: camera.time_offset_s for name, camera in rig.cameras.items()}
    first, later, other = views.rig_times_ns(offsets)
    lag = (other - first) * 1e-9
    if found is None:
        reference, velocity, bias = first, np.zeros((len(first), 3)), np.zeros(3)
        moving = np.zeros(len(first), dtype=bool)
    else:
        at, moving = found.slot_at(first)
        reference, velocity, bias = found.priors.slots.reference_ns[at], found.velocity[at], found.bias.value
    ways = [motion.between(first, end, reference, bias) for end in (later, other)]
    return _LinkedViews(views, ways[0], ways[1], velocity, np.asarray(lag, dtype=np.float64), moving)


def _mounts(views: CrossViews, rig: Rig) -> _Mounts:
    turns = np.stack([rig.camera(name).rig_from_cam.rotation for name in views.cameras])
    places = np.stack([rig.camera(name).rig_from_cam.translation for name in views.cameras])
    return _Mounts(turns[views.source], places[views.source], turns[views.target], places[views.target])


def _residuals(seen: _LinkedViews, mounts: _Mounts) -> tuple[Array, Array]:
    """Angles (M, 2) across and within the epipolar plane, and their standard deviations, radians."""
    velocity = seen.velocity
    views = seen.views
    u = times(mounts.source_turn, views.first)
    rotation, by_velocity, known = seen.later.rotation, seen.later.by_velocity, seen.later.known
    after = times(rotation, times(mounts.source_turn, views.later))
    way = times(by_velocity, velocity) + known
    way += times(rotation, mounts.source_place) - mounts.source_place
    inverse_range, range_std = inverse_ranges(u, after, way, views.std, seen.moving)
    rotation, by_velocity, known = seen.other.rotation, seen.other.by_velocity, seen.other.known
    place = times(rotation, mounts.target_place) + known
    place += times(by_velocity, velocity)
    there = times(rotation, times(mounts.target_turn, views.seen))
    base = mounts.source_place - place
    normal = cross(base, u)
    across = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(across, 1e-9)
    towards = u + inverse_range[:, None] * base
    length = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    inplane = cross(normal, towards / length)
    residual = np.stack([(normal * there).sum(axis=1), (inplane * there).sum(axis=1)], axis=1)
    ahead = (towards * there).sum(axis=1)
    residual[ahead < 0] = np.pi
    noise = views.std[:, 0] ** 2 + views.std[:, 2] ** 2
    by_range = (across / length**2)[:, 0] * range_std
    return residual, np.sqrt(np.stack([noise, noise + by_range**2], axis=1))


def inverse_ranges(u: Array, after: Array, way: Array, std: Array, moving: Mask) -> tuple[Array, Array]:
    """(M,) 1/m and standard deviations: from the track's parallax, and what is usual.

    u, after: (M, 3) bearings of the first and the later sighting, way: (M, 3) between them, all in rig axes at the
    first. std: (M, 2) or more, radians. moving: (M,) whether the way is known.
    """
    normal = cross(u, after)
    side = np.linalg.norm(way - (way * u).sum(axis=1, keepdims=True) * u, axis=1)
    forward = (cross(way, after) * normal).sum(axis=1)
    known = moving & (side > _LEAST_WAY_M) & (np.abs(forward) > 1e-12)
    measured = (normal**2).sum(axis=1) / np.where(known, forward, 1.0)
    measured_std = np.where(known, np.hypot(std[:, 0], std[:, 1]) / np.maximum(side, 1e-6), 1e3)
    weight, usual = measured_std**-2.0, _INVERSE_RANGE_STD**-2.0
    total = weight + usual
    return (measured * weight + _INVERSE_RANGE * usual) / total, total**-0.5


def _jacobian(seen: _LinkedViews, mounts: _Mounts) -> Array:
    """(M, 2, 19): by rotation and place of the source, of the target, the target's clock, the rig's velocity and the
    gyro's bias; numeric."""
    changed: list[tuple[float, _LinkedViews, _Mounts]] = []
    for turn, place in (("source_turn", "source_place"), ("target_turn", "target_place")):
        for axis in np.eye(3):
            turned = so3.exp(_TURN * axis) @ getattr(mounts, turn)
            changed.append((_TURN, seen, replace(mounts, **{turn: turned})))
        for axis in np.eye(3):
            changed.append((_SHIFT, seen, replace(mounts, **{place: getattr(mounts, place) + _SHIFT * axis})))
    changed.append((_SHIFT, _later(seen, _SHIFT), mounts))
    changed += [(_SHIFT, replace(seen, velocity=seen.velocity + _SHIFT * axis), mounts) for axis in np.eye(3)]
    for axis in np.eye(3):
        later, other = (_biased(way, _TURN * axis) for way in (seen.later, seen.other))
        changed.append((_TURN, replace(seen, later=later, other=other), mounts))
    at = _residuals(seen, mounts)[0]
    return np.stack([(_residuals(by, on)[0] - at) / step for step, by, on in changed], axis=2)


def _later(seen: _LinkedViews, seconds: float) -> _LinkedViews:
    """As if the other camera had seen it later, the rig going on as it goes over the track's second."""
    other, span = seen.other, ((seen.views.later_ns - seen.views.first_ns) * 1e-9)[:, None]
    turned = so3.exp(so3.log(seen.later.rotation) / span * seconds)
    more = times(seen.later.by_velocity, seen.velocity) / span * seconds
    return replace(seen, other=replace(other, rotation=other.rotation @ turned, known=other.known + more))


def _biased(way: PairMotion, bias: Array) -> PairMotion:
    return replace(way, rotation=so3.exp(way.by_bias @ bias) @ way.rotation)


def _scored(
    use: Indices,
    residual: Array,
    std: Array,
    jacobian: Array,
    views: CrossViews,
    block: BlockScores,
    bias_std: float,
) -> BlockScores:
    """Normal equations from rows `use` of residuals (2M,), errors of velocity and gyro bias eliminated."""
    cameras = len(block.cameras)
    mounts = MOUNTING * cameras
    size = mounts + 3 * (cameras * (cameras - 1) // 2)
    nothing = replace(
        block,
        H=np.zeros((1, size, size)),
        g=np.zeros((1, size)),
        rows=np.zeros((1, cameras), dtype=np.int64),
        inflation=np.ones((1, cameras)),
        noise=np.ones((1, cameras)),
    )
    if len(use) < _FEWEST_ROWS:
        return nothing
    view = use // 2
    whitened = residual[use] / std[use]
    scale = max(MAD_TO_STD * float(np.median(np.abs(whitened))), 0.5)
    weight = 1 / (1 + (whitened / (_LOSS_STDS * scale)) ** 2) / scale**2
    _, slot = np.unique(np.round(views.first_ns[view] / _SLOT_NS), return_inverse=True)
    total = size + 3 * (int(slot.max()) + 2)
    J = np.zeros((len(use), total))
    by_parts = jacobian.reshape(-1, jacobian.shape[2])[use] / std[use, None]
    row = np.arange(len(use))[:, None]
    J[row, MOUNTING * views.source[view][:, None] + np.arange(6)] = by_parts[:, :6]
    J[row, MOUNTING * views.target[view][:, None] + np.arange(6)] = by_parts[:, 6:12]
    J[row[:, 0], MOUNTING * views.target[view] + 6] = by_parts[:, 12]
    J[row[:, 0], MOUNTING * views.source[view] + 6] -= by_parts[:, 12]
    offset = offset_columns(cameras)[views.source[view], views.target[view]]
    sign = np.where(views.target[view] > views.source[view], 1.0, -1.0)[:, None]
    J[row, offset[:, None] + np.arange(3)] = sign * by_parts[:, 6:9]
    J[row, size + 3 * slot[:, None] + np.arange(3)] = by_parts[:, 13:16]
    J[:, total - 3 :] = by_parts[:, 16:]
    H = (J * weight[:, None]).T @ J
    g = -J.T @ (weight * whitened)
    unknown = np.repeat([_VELOCITY_STD, bias_std], [total - size - 3, 3])
    H[range(size, total), range(size, total)] += unknown**-2.0
    gain = np.linalg.solve(H[size:, size:], np.column_stack([H[size:, :size], g[size:]]))
    reduced = H[:size, :size] - H[:size, size:] @ gain[:, :size]
    left = whitened + J[:, size:] @ gain[:, size]
    counts = np.bincount(views.source[view], minlength=cameras)
    counts = counts + np.bincount(views.target[view], minlength=cameras)
    return replace(
        nothing,
        H=((reduced + reduced.T) / 2)[None],
        g=(g[:size] - H[:size, size:] @ gain[:, size])[None],
        rows=counts[None],
        inflation=np.full((1, cameras), _inflation(J[:, :mounts], left, weight, views.cluster[view])),
        noise=np.full((1, cameras), scale),
    )


def _inflation(J: Array, whitened: Array, weight: Array, cluster: Indices) -> float:
    """Variance of the scores over what independent sightings would give, from all sightings of a track together."""
    turns = np.arange(J.shape[1]) % MOUNTING < 3
    J = J[:, turns]
    _, number = np.unique(cluster, return_inverse=True)
    by_track = np.zeros((int(number.max()) + 1, J.shape[1]))
    sum_by(number, J * whitened[:, None], weight, by_track)
    by_track -= by_track.mean(axis=0)
    values, vectors = np.linalg.eigh((J * weight[:, None]).T @ J)
    kept = values > 1e-6 * values[-1]
    spread = np.square(by_track @ vectors[:, kept]).sum(axis=0) / values[kept]
    return max(float(spread.mean()), 1.0)
