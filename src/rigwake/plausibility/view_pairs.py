"""Pairs of pictures of one camera between which it turned, and least squares over the geometry of two views.

Whatever the scene, bearings of the same points in two pictures obey `b2^T [t]x R b1 = 0`. Every pair has unknowns of
its own (the direction t, and R unless a gyroscope tells it); the lens is common to all. The unknowns of a pair are
eliminated pair by pair, as points are in a bundle adjustment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rigwake._kernels import njit
from rigwake._types import Array, Indices, Mask, Stamps
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry import so3
from rigwake.geometry.interpolate import interpolate
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_PAIRS = 60
_LEAST_TURN, _MOST_TURN = np.deg2rad(8.0), np.deg2rad(35.0)
_LEAST_POINTS, _MOST_POINTS = 25, 150
_AXIS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class ViewPairs:
    """Pixels (K, 2) of both views, the pair of each, first rotations `second_from_first` (P, 3, 3) and directions
    (P, 3), and stamps (P,) of both views."""

    first: Array
    second: Array
    pair: Indices
    rotation: Array
    direction: Array
    first_ns: Stamps
    second_ns: Stamps

    def take(self, index: Indices) -> ViewPairs:
        """The chosen pairs (increasing indices)."""
        rows = np.flatnonzero(np.isin(self.pair, index))
        return ViewPairs(
            self.first[rows], self.second[rows], np.searchsorted(index, self.pair[rows]), self.rotation[index],
            self.direction[index], self.first_ns[index], self.second_ns[index],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class LitRays:
    """What a lens makes of pixels: bearings (K, 3), their derivatives by the pixels (K, 3, 2), those of projections by
    the lens's parameters (K, 2, P), and whether it has a ray for them (K,)."""

    bearings: Array
    by_pixels: Array
    d_params: Array
    seen: Mask


def rays_of(lens: CameraModel, pixels: Array) -> LitRays:
    """Rays of pixels (K, 2); where there is none, the axis."""
    bearings, seen = lens.unproject(pixels)
    return rays_at(lens, np.where(seen[:, None], bearings, _AXIS), seen)


def rays_at(lens: CameraModel, bearings: Array, seen: Mask) -> LitRays:
    """The rays of the pixels that bearings (K, 3) have in a lens."""
    projection = lens.project_with_jacobians(bearings)
    J = projection.d_point
    # at right angles to the bearing: its pseudo-inverse is the derivative the other way
    u, v = J[:, 0], J[:, 1]
    uu, uv, vv = (np.einsum("ki,ki->k", p, q)[:, None] for p, q in ((u, u), (u, v), (v, v)))
    area = uu * vv - uv**2
    seen = seen & projection.valid & (area[:, 0] > 1e-6)
    area = np.where(seen[:, None], area, 1.0)
    by_pixels = np.stack([(vv * u - uv * v) / area, (uu * v - uv * u) / area], axis=2)
    return LitRays(bearings, by_pixels, projection.d_params, seen)


def _no_pairs() -> ViewPairs:
    pixels, stamps = np.empty((0, 2)), np.empty(0, np.int64)
    return ViewPairs(pixels, pixels, stamps, np.empty((0, 3, 3)), np.empty((0, 3)), stamps, stamps)


def choose_pairs(tracks: Tracks, trajectory: Trajectory, *, within_segments: bool = True) -> ViewPairs:
    """Pairs of frames spread over time, as far apart as their turn and their common tracks allow.

    within_segments: only of frames in one segment of the trajectory."""
    order = np.lexsort((tracks.track_ids, tracks.frame_indices))
    frame, track, pixels = tracks.frame_indices[order], tracks.track_ids[order], tracks.pixels[order]
    starts = np.searchsorted(frame, np.arange(len(tracks.timestamps_ns) + 1))
    stamps, ids = tracks.timestamps_ns, trajectory.segment_ids
    assert ids is not None
    frames = np.flatnonzero(
        (stamps >= trajectory.timestamps_ns[0]) & (stamps <= trajectory.timestamps_ns[-1])
    )
    if len(frames) < 3:
        return _no_pairs()
    poses = interpolate(trajectory.timestamps_ns, trajectory.world_from_body, stamps[frames])
    segment = ids[np.clip(np.searchsorted(trajectory.timestamps_ns, stamps[frames]), 0, len(ids) - 1)]
    rate = 1e9 / float(np.median(np.diff(stamps)))
    reach = np.unique(np.round(rate * np.array([2.5, 1.8, 1.2, 0.8, 0.5])).astype(int))[::-1]
    chosen: list[tuple[Array, Array, Array, Array, Stamps]] = []
    for a in np.unique(np.linspace(0, len(frames) - 2, _PAIRS).astype(int)):
        for step in reach[reach > 0]:
            b = a + step
            if b >= len(frames) or (within_segments and segment[a] != segment[b]):
                continue
            turn = poses.rotation[b].T @ poses.rotation[a]
            if not _LEAST_TURN <= np.linalg.norm(so3.log(turn)) <= _MOST_TURN:
                continue
            one, two = (slice(starts[f], starts[f + 1]) for f in (frames[a], frames[b]))
            _, i, j = np.intersect1d(track[one], track[two], assume_unique=True, return_indices=True)
            if len(i) < _LEAST_POINTS:
                continue
            some = np.linspace(0, len(i) - 1, min(len(i), _MOST_POINTS)).astype(int)
            way = poses.rotation[b].T @ (poses.translation[a] - poses.translation[b])
            way = way / max(float(np.linalg.norm(way)), 1e-12)
            ends = np.array([stamps[frames[a]], stamps[frames[b]]])
            chosen.append((pixels[one][i[some]], pixels[two][j[some]], turn, way, ends))
            break
    if not chosen:
        return _no_pairs()
    first, second, turns, ways, stamped = zip(*chosen, strict=True)
    pair = np.repeat(np.arange(len(chosen)), [len(f) for f in first])
    first_ns, second_ns = np.array(stamped, dtype=np.int64).T
    return ViewPairs(
        np.concatenate(first),
        np.concatenate(second),
        pair,
        np.array(turns),
        np.array(ways),
        first_ns,
        second_ns,
    )


def direction_of_pairs(pairs: ViewPairs, a: Array, b: Array, R: Array) -> Array:
    """(P, 3) directions at right angles to what the rotations (P, 3, 3) leave of bearings (K, 3), robustly."""
    normals = np.cross(b, np.einsum("kij,kj->ki", R[pairs.pair], a))
    starts = np.searchsorted(pairs.pair, np.arange(len(R)))
    weights, t = np.ones(len(normals)), np.zeros((len(R), 3))
    for _ in range(5):
        moments = np.add.reduceat(
            weights[:, None, None] * normals[:, :, None] * normals[:, None, :], starts, axis=0
        )
        t = np.linalg.eigh(moments)[1][:, :, 0]
        off = np.abs(np.einsum("ki,ki->k", normals, t[pairs.pair]))
        weights = 1 / (1 + (off / max(1.5 * float(np.median(off)), 1e-9)) ** 2)
    return np.asarray(t)


def tangents(t: Array) -> Array:
    """(P, 3, 2) bases of the planes at right angles to unit vectors (P, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(t), axis=1)]
    first = np.cross(t, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(t, first)], axis=-1)


def sampson_distances(a: Array, b: Array, R: Array, t: Array, pair: Indices) -> Array:
    """(K,) signed Sampson distances, radians; see `geometry.two_view.sampson_angles`."""
    E = (so3.hat(t) @ R)[pair]
    row = np.einsum("kij,kj->ki", E, a)
    column = np.einsum("kji,kj->ki", E, b)
    e = np.einsum("ki,ki->k", b, row)
    squares = np.einsum("ki,ki->k", row, row) + np.einsum("ki,ki->k", column, column) - 2 * e**2
    return np.asarray(e / np.sqrt(np.maximum(squares, 1e-12)))


def pixel_distances(a: LitRays, b: LitRays, R: Array, t: Array, pair: Indices) -> Array:
    """(K,) signed Sampson distances in pixels: by how much both pixels together must move to fit the geometry.

    In angles a lens that is too long has smaller errors, whatever it sees; in pixels it has not.
    """
    E = np.ascontiguousarray(so3.hat(t) @ R)
    return np.asarray(_pixel_distances(E, pair, a.bearings, a.by_pixels, b.bearings, b.by_pixels))


@njit(nogil=True)
def _pixel_distances(E: Array, pair: Indices, a: Array, by_a: Array, b: Array, by_b: Array) -> Array:
    found = np.empty(len(pair))
    for k in range(len(pair)):
        M = E[pair[k]]
        e, squares = 0.0, 1e-18
        row, column = np.zeros(3), np.zeros(3)
        for i in range(3):
            for j in range(3):
                row[i] += M[i, j] * a[k, j]
                column[j] += b[k, i] * M[i, j]
        for i in range(3):
            e += b[k, i] * row[i]
        for m in range(2):
            g, h = 0.0, 0.0
            for i in range(3):
                g += column[i] * by_a[k, i, m]
                h += row[i] * by_b[k, i, m]
            squares += g * g + h * h
        found[k] = e / np.sqrt(squares)
    return found


def eliminate_pairs(
    pairs: ViewPairs, error: Array, J_pose: Array, J_lens: Array, weights: Array, damping: float
) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Reduced information (L, L) and right-hand side (L,) of the lens, and poses' steps for a step of the lens.

    error (K,), derivatives by the pair's own unknowns (K, D) and by the lens (K, L), weights (K,)."""
    starts = np.searchsorted(pairs.pair, np.arange(len(pairs.rotation)))

    def summed(x: Array) -> Array:
        return np.add.reduceat(x, starts, axis=0)

    w = weights[:, None, None]
    A = summed(w * J_pose[:, :, None] * J_pose[:, None, :])
    B = summed(w * J_pose[:, :, None] * J_lens[:, None, :])
    C = (w * J_lens[:, :, None] * J_lens[:, None, :]).sum(axis=0)
    g_pose = -summed(weights[:, None] * J_pose * error[:, None])
    g_lens = -(weights[:, None] * J_lens * error[:, None]).sum(axis=0)
    diagonal = np.einsum("pii->pi", A)
    A = A + np.eye(A.shape[1]) * (damping * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True))[:, None, :]
    inverse = np.linalg.inv(A)
    reduced = C - np.einsum("pki,pkl,plj->ij", B, inverse, B)
    right = g_lens - np.einsum("pki,pkl,pl->i", B, inverse, g_pose)

    def back(step_lens: Array) -> Array:
        return np.einsum("pkl,pl->pk", inverse, g_pose - B @ step_lens)

    return reduced, right, back


def scatter_covariance(
    pairs: ViewPairs, error: Array, J_pose: Array, J_lens: Array, weights: Array, reduced: Array
) -> Array:
    """Covariance (L, L) of the lens by the scatter of the pairs' scores, neighbouring pairs counted as one."""
    starts = np.searchsorted(pairs.pair, np.arange(len(pairs.rotation)))
    w = weights[:, None, None]
    A = np.add.reduceat(w * J_pose[:, :, None] * J_pose[:, None, :], starts, axis=0)
    B = np.add.reduceat(w * J_pose[:, :, None] * J_lens[:, None, :], starts, axis=0)
    g_pose = np.add.reduceat(weights[:, None] * J_pose * error[:, None], starts, axis=0)
    g_lens = np.add.reduceat(weights[:, None] * J_lens * error[:, None], starts, axis=0)
    trace = np.einsum("pii->p", A)[:, None, None]
    scores = g_lens - np.einsum(
        "pki,pkl,pl->pi", B, np.linalg.inv(A + 1e-9 * trace * np.eye(A.shape[1])), g_pose
    )
    groups = np.add.reduceat(scores, np.arange(0, len(scores), 3), axis=0)
    inverse = np.linalg.pinv(reduced, hermitian=True)
    return np.asarray(inverse @ (groups.T @ groups) @ inverse)


def moved_pairs(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    """Rotations and directions after a step (P, 5) of both."""
    step = np.clip(step, -0.3, 0.3)
    return so3.exp(step[:, :3]) @ R, moved_directions(t, step[:, 3:])


def moved_directions(t: Array, step: Array) -> Array:
    """(P, 3) directions after a step (P, 2) along their `tangents`."""
    direction = t + np.einsum("pij,pj->pi", tangents(t), np.clip(step, -0.3, 0.3))
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))
