"""What errors that last along a track do to the shared parameters.

The information matrix takes every observation's error to be independent. Those of one landmark are not: a patch
that is drawn otherwise than its warp supposes errs the same way for seconds. The scores `u_l = G_l^T r_l` of whole
landmarks (G: how its observations pull at the shared parameters, everything else adjusting to it) are independent of
each other, whatever happens within a track, and their scatter says how large the errors really are:

    sum_l u_l u_l^T   against   sum_l G_l^T (I - H_l) G_l,   H_l the hat matrix of the landmark's own position,

which would be equal if errors were independent with the assumed size.

Source: Liang and Zeger, *Longitudinal data analysis using generalized linear models*, Biometrika 73(1), 1986.
"""

from __future__ import annotations

import numpy as np

from rigwake._kernels import njit
from rigwake._types import Array, Indices
from rigwake.ba.solver.normal import ReducedEquations
from rigwake.ba.solver.parameter_layout import ParameterLayout
from rigwake.ba.solver.schur import LinearObservations
from rigwake.ba.solver.state_motion import TimedPoses

_CHUNK = 20_000  # landmarks' observations at a time, to bound memory
_MOST, _SAMPLED = 150_000, 2_000  # observations: of more than these, evenly spread samples of this size do
_RIDGE = 1e-9


def clustered_scatter(
    observations: LinearObservations, poses: TimedPoses, layout: ParameterLayout, reduced: ReducedEquations
) -> tuple[Array, Array]:
    """Scatter (k, k) of the landmarks' scores on the k shared parameters, and what independence would give."""
    n, k = layout.n_state_columns, layout.n_columns - layout.n_state_columns
    response = reduced.factor.backward(reduced.half_border)
    score = np.concatenate(
        [-response, np.eye(k), np.zeros((1, k))]
    )  # the last row serves columns that are held
    jacobian, columns = poses.chain(layout)
    observed, predicted = np.zeros((k, k)), np.zeros((k, k))
    starts = observations.landmark_starts
    chunks, weight = _chunks(starts), 1.0
    if starts[-1] > _MOST:
        # the scatter of some ten thousand landmarks tells enough; all cost as many times the shared parameters squared
        small = _chunks(starts, _SAMPLED)
        chunks = small[:: int(np.ceil(starts[-1] / _MOST))]
        weight = float(starts[-1]) / sum(int(starts[last] - starts[first]) for first, last in chunks)
    for first, last in chunks:
        rows = slice(starts[first], starts[last])
        if rows.start == rows.stop:
            continue
        # of the frames at hand alone: for all of them at once it would not fit into memory
        used, at = np.unique(observations.frames[rows], return_inverse=True)
        by_frame = np.einsum("fia,fak->fik", jacobian[used], score[columns[used]], optimize=True)
        G, scores, taken = _pulls(
            starts[first : last + 1] - rows.start, at, by_frame, observations.by_frame[rows],
            observations.by_landmark[rows], observations.by_extras[rows],
            np.where(observations.extras[rows] >= 0, layout.extras_start - n + observations.extras[rows], -1),
            observations.residuals[rows],
        )  # fmt: skip
        observed += scores.T @ scores
        predicted += G.T @ G - taken.T @ taken
    return weight * observed, weight * predicted


@njit(nogil=True)
def _pulls(starts, at, by_frame, Jf, Jl, Je, extras, residuals):  # type: ignore[no-untyped-def]
    """How observations pull at the shared parameters: G (2 m, k), the landmarks' scores (l, k), and what G loses to
    the landmarks' own positions, as rows (3 l, k) of a root."""
    k, count = by_frame.shape[2], len(starts) - 1
    G, scores, taken = np.zeros((2 * len(at), k)), np.zeros((count, k)), np.zeros((3 * count, k))
    block = np.empty((3, 3))
    for landmark in range(count):
        block[:] = 0.0
        cross = taken[3 * landmark : 3 * landmark + 3]
        for m in range(starts[landmark], starts[landmark + 1]):
            for r in range(2):
                row = G[2 * m + r]
                for i in range(6):
                    x = Jf[m, r, i]
                    for c in range(k):
                        row[c] += x * by_frame[at[m], i, c]
                for a in range(extras.shape[1]):
                    if extras[m, a] >= 0:
                        row[extras[m, a]] += Je[m, r, a]
                for c in range(k):
                    scores[landmark, c] += residuals[m, r] * row[c]
                for i in range(3):
                    x = Jl[m, r, i]
                    for j in range(3):
                        block[i, j] += x * Jl[m, r, j]
                    for c in range(k):
                        cross[i, c] += x * row[c]
        _solve_root(block, cross)
    return G, scores, taken


@njit(nogil=True)
def _solve_root(block, cross):  # type: ignore[no-untyped-def]
    """`L^-1 cross` in place, L the Cholesky factor of the block with a ridge, which is left in its place."""
    ridge = _RIDGE * (block[0, 0] + block[1, 1] + block[2, 2]) + 1e-300
    for i in range(3):
        block[i, i] += ridge
    for i in range(3):
        for j in range(i + 1):
            total = block[i, j]
            for q in range(j):
                total -= block[i, q] * block[j, q]
            block[i, j] = np.sqrt(max(total, ridge)) if i == j else total / block[j, j]
        for q in range(i):
            for c in range(cross.shape[1]):
                cross[i, c] -= block[i, q] * cross[q, c]
        for c in range(cross.shape[1]):
            cross[i, c] /= block[i, i]


def _chunks(starts: Indices, size: int | None = None) -> list[tuple[int, int]]:
    """Ranges of landmarks with about `size` (`_CHUNK`) observations each."""
    size = _CHUNK if size is None else size
    total, n = int(starts[-1]), len(starts) - 1
    cuts = np.unique(np.searchsorted(starts, np.arange(0, total + size, size)).clip(0, n))
    cuts = np.unique(np.append(cuts, [0, n]))
    return list(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))
