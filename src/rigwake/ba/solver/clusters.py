"""What errors that last along a track do to the shared parameters.

The information matrix takes every observation's error to be independent. Those of one landmark are not: a patch
that is drawn otherwise than its warp supposes errs the same way for seconds. The scores `u_l = G_l^T (I - H_l) r_l`
of whole landmarks (G: how its observations pull at the shared parameters, everything else adjusting to it) are
independent of each other, whatever happens within a track, and their scatter says how large the errors really are:

    sum_l u_l u_l^T   against   sum_l G_l^T (I - H_l) G_l,   H_l the hat matrix of the landmark's own position,

which would be equal if errors were independent with the assumed size.

Source: Liang and Zeger, *Longitudinal data analysis using generalized linear models*, Biometrika 73(1), 1986.
"""

from __future__ import annotations

import numpy as np

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
        by_frame = np.einsum("fia,fak->fik", jacobian[used], score[columns[used]])
        G = observations.by_frame[rows] @ by_frame[at]
        if observations.by_extras.shape[2]:
            extras = observations.extras[rows]
            index = np.where(extras >= 0, layout.extras_start + extras, n + k)
            G += observations.by_extras[rows] @ score[index]
        own = starts[first : last + 1] - rows.start
        own = own[:-1][np.diff(own) > 0]
        residuals = observations.residuals[rows]
        scores = np.add.reduceat(np.einsum("mik,mi->mk", G, residuals), own, axis=0)
        J = observations.by_landmark[rows]
        cross = np.add.reduceat(np.einsum("mia,mik->mak", J, G), own, axis=0)
        block = np.add.reduceat(np.einsum("mia,mib->mab", J, J), own, axis=0)
        block += _RIDGE * np.einsum("laa->l", block)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
        solved = np.linalg.solve(block, cross)
        taken = np.einsum("lak,laj->kj", cross, solved)
        # nothing at the optimum; a landmark that is not there yet would pull as if its residuals scattered so
        scores -= np.einsum(
            "lak,la->lk", solved, np.add.reduceat(np.einsum("mia,mi->ma", J, residuals), own, axis=0)
        )
        observed += scores.T @ scores
        predicted += np.einsum("mik,mij->kj", G, G, optimize=True) - taken
    return weight * observed, weight * predicted


def _chunks(starts: Indices, size: int | None = None) -> list[tuple[int, int]]:
    """Ranges of landmarks with about `size` (`_CHUNK`) observations each."""
    size = _CHUNK if size is None else size
    total, n = int(starts[-1]), len(starts) - 1
    cuts = np.unique(np.searchsorted(starts, np.arange(0, total + size, size)).clip(0, n))
    cuts = np.unique(np.append(cuts, [0, n]))
    return list(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))
