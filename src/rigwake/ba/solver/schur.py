"""Landmark elimination: from observations to a least squares problem over camera frames.

Every observation depends on one camera frame (6 unknowns: the right tangent of `world_from_cam` at that
image), one landmark (3) and possibly a few extras of its camera (intrinsics, line delay). Landmarks are
eliminated on this level, where blocks are smallest; what a frame's pose depends on (states, extrinsics, time
offset) enters afterwards by the chain rule (`normal.py`).

Source: Triggs et al., *Bundle adjustment - a modern synthesis* (2000), section 6.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._kernels import njit
from rigwake._types import Array, Indices
from rigwake.parallel import over_ranges, ranges

_NO_INFORMATION = 1e-100  # of a landmark's direction: its inverse would overflow
_LEAST_INFORMATION = (
    1e-10  # added to a landmark's scaled (unit diagonal) block: parallax too small to place it
)


_LEAST_OBSERVATIONS, _LEAST_MEETINGS = 10_000, 50_000  # that are worth a thread


@dataclass(frozen=True, eq=False)
class LinearObservations:
    """Whitened, robustly weighted observations `r + J d`, sorted by landmark and then by frame.

    landmark_starts: (L + 1,) first observation of each landmark. frames: (M,). residuals: (M, 2). by_frame:
    (M, 2, 6). by_landmark: (M, 2, 3). by_extras: (M, 2, e) into extras columns `extras` (M, e), -1 where
    there is none.
    """

    landmark_starts: Indices
    frames: Indices
    residuals: Array
    by_frame: Array
    by_landmark: Array
    by_extras: Array
    extras: Indices


@dataclass(frozen=True, eq=False)
class FramePairs:
    """Which frames share landmarks, as rows of a lower triangle: frame f meets
    `partners[row_starts[f]:row_starts[f + 1]]`, increasing, itself last. Later frames meet g in the pairs
    `columns[column_starts[g]:column_starts[g + 1]]`, of the rows `rows` (P,). Its observations are
    `observations[observation_starts[f]:observation_starts[f + 1]]`, of the landmarks `landmarks` (M,).
    bounds: ranges of frames with about equal work (`threads.py`)."""

    row_starts: Indices
    partners: Indices
    rows: Indices
    column_starts: Indices
    columns: Indices
    observation_starts: Indices
    observations: Indices
    landmarks: Indices
    bounds: Indices


@dataclass(frozen=True, eq=False)
class FrameEquations:
    """Normal equations over frames and extras after elimination, right-hand sides `-J^T r` included.

    blocks: (P, 6, 6) per pair of `FramePairs` (later frame's rows). gradient: (F, 6). diagonal: (F, 6) of the
    frames' own information before elimination. with_extras: (F, 6, Q). extras: (Q, Q), extras_gradient (Q,),
    extras_diagonal (Q,) before elimination. landmark_inverse: (L, 3, 3), landmark_gradient: (L, 3).
    """

    blocks: Array
    gradient: Array
    diagonal: Array
    with_extras: Array
    extras: Array
    extras_gradient: Array
    extras_diagonal: Array
    landmark_inverse: Array
    landmark_gradient: Array


def frame_pairs(landmark_starts: Indices, frames: Indices, n_frames: int) -> FramePairs:
    """Pairs of frames that share a landmark; `frames` (M,) as in `LinearObservations`."""
    order = np.argsort(frames, kind="stable")
    starts = np.searchsorted(frames[order], np.arange(n_frames + 1))
    landmark_of = np.repeat(np.arange(len(landmark_starts) - 1), np.diff(landmark_starts))
    sorted_landmarks = landmark_of[order]
    counts = np.zeros(n_frames, dtype=np.int64)
    _count_or_list(landmark_starts, frames, starts, sorted_landmarks, counts, np.empty(0, np.int64))
    row_starts = np.concatenate([[0], np.cumsum(counts)])
    partners = np.empty(row_starts[-1], dtype=np.int64)
    _count_or_list(landmark_starts, frames, starts, sorted_landmarks, row_starts[:-1].copy(), partners)
    rows = np.repeat(np.arange(n_frames), counts)
    later = np.flatnonzero(partners < rows)
    columns = later[np.argsort(partners[later], kind="stable")]
    column_starts = np.searchsorted(partners[columns], np.arange(n_frames + 1))
    # an observation meets those of the same landmark in this and earlier frames
    met = np.bincount(frames, np.arange(len(frames)) - landmark_starts[landmark_of] + 1.0, n_frames)
    bounds = ranges(met + counts, _LEAST_MEETINGS)
    return FramePairs(
        row_starts, partners, rows, column_starts, columns, starts, order, sorted_landmarks, bounds
    )


@njit()
def _count_or_list(landmark_starts, frames, frame_starts, landmarks, cursor, partners):  # type: ignore[no-untyped-def]
    """Count (empty `partners`) or list, from `cursor` on, the partners of every frame, itself included."""
    n_frames = len(frame_starts) - 1
    seen = np.full(n_frames, -1, dtype=np.int64)
    for f in range(n_frames):
        begin = cursor[f]
        seen[f] = f
        if len(partners):
            partners[cursor[f]] = f
        cursor[f] += 1
        for k in range(frame_starts[f], frame_starts[f + 1]):
            landmark = landmarks[k]
            for m in range(landmark_starts[landmark], landmark_starts[landmark + 1]):
                g = frames[m]
                if g >= f:
                    break
                if seen[g] != f:
                    seen[g] = f
                    if len(partners):
                        partners[cursor[f]] = g
                    cursor[f] += 1
        if len(partners):
            partners[begin : cursor[f]].sort()


def eliminate_landmarks(
    observations: LinearObservations, pairs: FramePairs, n_extras: int, damping: float
) -> FrameEquations:
    """Schur complement of the landmarks, each damped by `damping` times its own diagonal."""
    n_frames, n_landmarks = len(pairs.row_starts) - 1, len(observations.landmark_starts) - 1
    equations = FrameEquations(
        np.zeros((len(pairs.partners), 6, 6)),
        np.zeros((n_frames, 6)),
        np.zeros((n_frames, 6)),
        np.zeros((n_frames, 6, n_extras)),
        np.zeros((n_extras, n_extras)),
        np.zeros(n_extras),
        np.zeros(n_extras),
        np.zeros((n_landmarks, 3, 3)),
        np.zeros((n_landmarks, 3)),
    )
    o, e = observations, equations
    coupling, extras_coupling = np.empty((len(o.frames), 3, 6)), np.zeros((n_landmarks, n_extras, 3))

    def landmarks(first: int, last: int) -> None:
        _sum_up_landmarks(
            first, last, o.landmark_starts, o.residuals, o.by_frame, o.by_landmark, o.by_extras, o.extras,
            damping, coupling, extras_coupling, e.landmark_inverse, e.landmark_gradient,
        )  # fmt: skip

    def frames(first: int, last: int) -> None:
        _sum_up_frames(
            first, last, pairs.row_starts, pairs.observation_starts, pairs.observations, o.residuals,
            o.by_frame, o.by_extras, o.extras, e.blocks, e.gradient, e.diagonal, e.with_extras,
        )  # fmt: skip
        _subtract_landmarks(
            first, last, o.landmark_starts, o.frames, pairs.row_starts, pairs.partners,
            pairs.observation_starts, pairs.observations, pairs.landmarks, coupling, extras_coupling,
            e.landmark_inverse, e.landmark_gradient, e.blocks, e.gradient, e.with_extras,
        )  # fmt: skip

    over_ranges(ranges(np.diff(o.landmark_starts), _LEAST_OBSERVATIONS), landmarks)
    over_ranges(pairs.bounds, frames)
    if n_extras:
        _sum_up_extras(o.residuals, o.by_extras, o.extras, e.extras, e.extras_gradient, e.extras_diagonal)
        by_inverse = extras_coupling @ e.landmark_inverse
        e.extras_gradient[:] -= np.einsum("lqi,li->q", by_inverse, e.landmark_gradient)
        e.extras[:] -= np.tensordot(by_inverse, extras_coupling, axes=([0, 2], [0, 2]))
    return equations


@njit(nogil=True)
def _invert_damped(V, damping, out):  # type: ignore[no-untyped-def]
    """Inverse of the symmetric 3x3 `V + damping diag(V)`, by its adjugate after scaling to unit diagonal."""
    s = np.empty(3)
    for i in range(3):
        s[i] = 1 / np.sqrt(V[i, i]) if V[i, i] > _NO_INFORMATION else 0.0
    d = 1 + damping + _LEAST_INFORMATION
    a, b, c = V[0, 1] * s[0] * s[1], V[0, 2] * s[0] * s[2], V[1, 2] * s[1] * s[2]
    c00, c01, c02 = d * d - c * c, b * c - a * d, a * c - b * d
    det = d * c00 + a * c01 + b * c02
    det = max(det, _LEAST_INFORMATION * _LEAST_INFORMATION)
    out[0, 0], out[1, 1], out[2, 2] = c00 / det, (d * d - b * b) / det, (d * d - a * a) / det
    out[0, 1], out[0, 2], out[1, 2] = c01 / det, c02 / det, (a * b - c * d) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    for i in range(3):
        for j in range(3):
            out[i, j] *= s[i] * s[j]


@njit(nogil=True)
def _sum_up_landmarks(  # type: ignore[no-untyped-def]
    first, last, starts, r, Jf, Jl, Je, extras, damping, coupling, extras_coupling, inverses, gradient
):
    """Landmarks' inverse blocks, gradients, and how their observations couple them with frames and extras."""
    width, V = extras.shape[1], np.empty((3, 3))
    for landmark in range(first, last):
        g, We = gradient[landmark], extras_coupling[landmark]
        V[:] = 0.0
        for m in range(starts[landmark], starts[landmark + 1]):
            for i in range(3):
                g[i] -= Jl[m, 0, i] * r[m, 0] + Jl[m, 1, i] * r[m, 1]
                for j in range(3):
                    V[i, j] += Jl[m, 0, i] * Jl[m, 0, j] + Jl[m, 1, i] * Jl[m, 1, j]
                for j in range(6):
                    coupling[m, i, j] = Jl[m, 0, i] * Jf[m, 0, j] + Jl[m, 1, i] * Jf[m, 1, j]
            for a in range(width):
                q = extras[m, a]
                if q >= 0:
                    for i in range(3):
                        We[q, i] += Je[m, 0, a] * Jl[m, 0, i] + Je[m, 1, a] * Jl[m, 1, i]
        if starts[landmark + 1] > starts[landmark]:
            _invert_damped(V, damping, inverses[landmark])


@njit(nogil=True)
def _sum_up_frames(  # type: ignore[no-untyped-def]
    first, last, row_starts, observation_starts, observations, r, Jf, Je, extras, blocks, gradient, diagonal,
    with_extras,
):  # fmt: skip
    """`J^T J` and `-J^T r` of the frames' own observations."""
    width = extras.shape[1]
    for f in range(first, last):
        block = blocks[row_starts[f + 1] - 1]
        for slot in range(observation_starts[f], observation_starts[f + 1]):
            m = observations[slot]
            for i in range(6):
                x, y = Jf[m, 0, i], Jf[m, 1, i]
                gradient[f, i] -= x * r[m, 0] + y * r[m, 1]
                diagonal[f, i] += x * x + y * y
                for j in range(6):
                    block[i, j] += x * Jf[m, 0, j] + y * Jf[m, 1, j]
                for a in range(width):
                    if extras[m, a] >= 0:
                        with_extras[f, i, extras[m, a]] += x * Je[m, 0, a] + y * Je[m, 1, a]


@njit(nogil=True)
def _sum_up_extras(r, Je, extras, corner, gradient, diagonal):  # type: ignore[no-untyped-def]
    """`J^T J` and `-J^T r` of the extras."""
    for m in range(len(r)):
        for a in range(extras.shape[1]):
            q = extras[m, a]
            if q < 0:
                continue
            x, y = Je[m, 0, a], Je[m, 1, a]
            gradient[q] -= x * r[m, 0] + y * r[m, 1]
            diagonal[q] += x * x + y * y
            for b in range(extras.shape[1]):
                if extras[m, b] >= 0:
                    corner[q, extras[m, b]] += x * Je[m, 0, b] + y * Je[m, 1, b]


@njit(nogil=True)
def _subtract_landmarks(  # type: ignore[no-untyped-def]
    first, last, starts, frames, row_starts, partners, observation_starts, observations, landmarks, coupling,
    extras_coupling, inverses, landmark_gradient, blocks, gradient, with_extras,
):  # fmt: skip
    """Subtract `W V^-1 W^T`, frame by frame, so that the blocks of a frame's row stay in the cache."""
    WV, n_extras = np.empty((6, 3)), extras_coupling.shape[1]
    for f in range(first, last):
        for slot in range(observation_starts[f], observation_starts[f + 1]):
            m, landmark = observations[slot], landmarks[slot]
            inverse, g, We = inverses[landmark], landmark_gradient[landmark], extras_coupling[landmark]
            for i in range(6):
                for j in range(3):
                    total = 0.0
                    for k in range(3):
                        total += coupling[m, k, i] * inverse[k, j]
                    WV[i, j] = total
                gradient[f, i] -= WV[i, 0] * g[0] + WV[i, 1] * g[1] + WV[i, 2] * g[2]
                for q in range(n_extras):
                    # lenses of cameras that do not see the landmark
                    if We[q, 0] == 0.0 and We[q, 1] == 0.0 and We[q, 2] == 0.0:
                        continue
                    with_extras[f, i, q] -= WV[i, 0] * We[q, 0] + WV[i, 1] * We[q, 1] + WV[i, 2] * We[q, 2]
            begin = starts[landmark]
            row = partners[row_starts[f] : row_starts[f + 1]]
            pair = np.searchsorted(row, frames[begin])
            for k in range(begin, m + 1):
                while row[pair] != frames[k]:
                    pair += 1
                W, block = coupling[k], blocks[row_starts[f] + pair]
                for i in range(6):
                    x, y, z = WV[i, 0], WV[i, 1], WV[i, 2]
                    for j in range(6):
                        block[i, j] -= x * W[0, j] + y * W[1, j] + z * W[2, j]


def landmark_steps(
    observations: LinearObservations, equations: FrameEquations, frame_step: Array, extras_step: Array
) -> Array:
    """(L, 3) steps of the landmarks that go with steps of the frames (F, 6) and the extras (Q,)."""
    o = observations
    moved = np.einsum("mij,mj->mi", o.by_frame, frame_step[o.frames])
    if len(extras_step):
        per_row = np.where(o.extras >= 0, extras_step[o.extras], 0.0)
        moved += np.einsum("mij,mj->mi", o.by_extras, per_row)
    coupling = np.einsum("mij,mi->mj", o.by_landmark, moved)
    n = len(o.landmark_starts) - 1
    owner = np.repeat(np.arange(n), np.diff(o.landmark_starts))
    coupled = np.stack([np.bincount(owner, coupling[:, k], minlength=n) for k in range(3)], axis=1)
    return np.einsum("lij,lj->li", equations.landmark_inverse, equations.landmark_gradient - coupled)
