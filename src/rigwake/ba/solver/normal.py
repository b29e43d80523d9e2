"""Normal equations over states (an envelope) and shared parameters (a dense border), and their solution.

    [ A   B ] [x]   [a]      A: states, envelope;  B: states x shared;  C: shared
    [ B^T C ] [y] = [b]

Filled from two kinds of parts: factors that depend on columns directly, and camera frames after landmark
elimination, whose pose depends on columns through a Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from rigwake._kernels import njit
from rigwake._types import Array, Indices
from rigwake.ba.solver.envelope import Envelope, Factor, NotPositiveDefiniteError, cholesky
from rigwake.ba.solver.parameter_layout import ParameterLayout
from rigwake.ba.solver.schur import FrameEquations, FramePairs
from rigwake.ba.solver.state_motion import TimedPoses
from rigwake.parallel import over_ranges

_PORTION = 8_000_000  # numbers of a block that is held at a time


@dataclass(frozen=True, eq=False)
class Factors:
    """Linearised factors of one kind: whitened, robustly weighted residuals (n, m), their derivative
    (n, m, q) by `columns` (n, q) (-1 where held), and their (robust) cost."""

    residuals: Array
    jacobian: Array
    columns: Indices
    cost: float


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """See the module; `diagonal` (n_columns,) is the information before landmark elimination."""

    layout: ParameterLayout
    shape: Envelope
    states: Array
    border: Array
    corner: Array
    gradient: Array
    diagonal: Array

    @classmethod
    def zeros(cls, layout: ParameterLayout, shape: Envelope) -> NormalEquations:
        """Empty equations, with ones on the diagonal of held components (their step comes out zero)."""
        n, k = layout.n_state_columns, layout.n_columns - layout.n_state_columns
        empty = cls(
            layout,
            shape,
            np.zeros(shape.offsets[-1]),
            np.zeros((n, k)),
            np.zeros((k, k)),
            np.zeros(n + k),
            np.zeros(n + k),
        )
        empty.states[shape.diagonal()[layout.held[:n]]] = 1.0
        empty.diagonal[layout.held] = 1.0
        return empty

    def add_factors(self, factors: Factors) -> None:
        """Add `J^T J` and `-J^T r`."""
        blocks = np.einsum("nmi,nmj->nij", factors.jacobian, factors.jacobian)
        gradients = -np.einsum("nmi,nm->ni", factors.jacobian, factors.residuals)
        shape = self.shape
        _scatter_blocks(
            blocks,
            factors.columns,
            self.states,
            self.border,
            self.corner,
            shape.tile,
            shape.first,
            shape.offsets,
        )
        self._add_vectors(gradients, np.einsum("nii->ni", blocks), factors.columns)

    def add_frames(self, equations: FrameEquations, pairs: FramePairs, poses: TimedPoses) -> None:
        """Add reduced frames, whose tangents depend on states and shared parameters as `poses` says."""
        self._add_states(equations.blocks, pairs, poses)
        jacobian, columns = poses.chain(self.layout)
        # frames in portions: what couples all of them with all shared parameters would not fit into memory
        per_frame = 6 * max(self.layout.n_columns - self.layout.n_state_columns, 1)
        portion = max(_PORTION // per_frame, 1)
        for begin in range(0, len(columns), portion):
            rows = slice(begin, min(begin + portion, len(columns)))
            coupling = self._coupling_block(equations, pairs, poses, rows)
            _scatter_coupling(
                coupling, jacobian[rows], columns[rows], self.layout.n_state_columns, self.border, self.corner
            )
        gradients = np.einsum("fia,fi->fa", jacobian, equations.gradient)
        diagonals = np.einsum("fia,fi,fia->fa", jacobian, equations.diagonal, jacobian)
        self._add_vectors(gradients, diagonals, columns)
        self._add_extras(equations)

    def _add_states(self, blocks: Array, pairs: FramePairs, poses: TimedPoses) -> None:
        """Add `J_f^T S J_g` of every pair of frames and its transpose to the states."""
        first_columns, shape = poses.states * self.layout.state_dim, self.shape
        held = self.layout.held[first_columns][..., None, None]
        width = poses.by_states.shape[3]
        # whole vectors of the processor: the padding is multiplied, but not added
        by_states = np.pad(np.where(held, 0.0, poses.by_states), ((0, 0), (0, 0), (0, 0), (0, -width % 4)))

        def work(first: int, last: int) -> None:
            _scatter_states(
                first, last, blocks, pairs.row_starts, pairs.partners, first_columns, by_states, width,
                self.layout.n_state_columns, self.states, shape.tile, shape.first, shape.offsets,
            )  # fmt: skip

        over_ranges(_apart(pairs.bounds, poses.states), work)

    def _coupling_block(
        self, equations: FrameEquations, pairs: FramePairs, poses: TimedPoses, rows: slice
    ) -> Array:
        """(f, k, 6) what the shared parameters' steps do to the right-hand sides of these frames."""
        n = self.layout.n_state_columns
        coupling = np.zeros((rows.stop - rows.start, self.layout.n_columns - n, 6))

        def work(first: int, last: int) -> None:
            _scatter_shared(
                rows.start, first, last, equations.blocks, pairs.row_starts, pairs.partners, pairs.rows,
                pairs.column_starts, pairs.columns, poses.shared - n, poses.by_shared, coupling,
            )  # fmt: skip

        inner = pairs.bounds[(pairs.bounds > rows.start) & (pairs.bounds < rows.stop)]
        over_ranges(np.concatenate([[rows.start], inner, [rows.stop]]), work)
        with_extras = np.swapaxes(equations.with_extras[rows], 1, 2)
        coupling[:, self.layout.extras_start - n :] += with_extras
        return coupling

    def _add_extras(self, equations: FrameEquations) -> None:
        start = self.layout.extras_start
        own = slice(start - self.layout.n_state_columns, None)
        # frames have filled the columns of the extras; the matrix is symmetric
        self.corner[own, : own.start] += self.corner[: own.start, own].T
        self.corner[own, own] += equations.extras
        self.gradient[start:] += equations.extras_gradient
        self.diagonal[start:] += equations.extras_diagonal

    def _add_vectors(self, gradients: Array, diagonals: Array, columns: Indices) -> None:
        kept = columns >= 0
        size = self.layout.n_columns
        self.gradient[:] += np.bincount(columns[kept], gradients[kept], minlength=size)
        self.diagonal[:] += np.bincount(columns[kept], diagonals[kept], minlength=size)

    def damped(self, damping: float) -> NormalEquations:
        """Levenberg-Marquardt: `damping` times the diagonal before elimination is added."""
        n = self.layout.n_state_columns
        extra = damping * np.maximum(self.diagonal, 1e-12 * self.diagonal.max(initial=1e-12))
        states = self.states.copy()
        states[self.shape.diagonal()] += extra[:n]
        return replace(self, states=states, corner=self.corner + np.diag(extra[n:]))

    def factorise(self) -> ReducedEquations:
        """Eliminate the states; raises NotPositiveDefiniteError."""
        n = self.layout.n_state_columns
        factor = cholesky(self.shape, self.states)
        half = factor.forward(np.concatenate([self.border, self.gradient[:n, None]], axis=1))
        border, gradient = half[:, :-1], half[:, -1]
        lower = np.tril(self.corner)
        corner = lower + np.tril(lower, -1).T - border.T @ border
        return ReducedEquations(self, factor, border, gradient, corner)


@dataclass(frozen=True, eq=False)
class ReducedEquations:
    """Equations with the states eliminated: `shared` is the information of the shared parameters, with
    everything else unknown."""

    full: NormalEquations
    factor: Factor
    half_border: Array
    half_gradient: Array
    shared: Array

    def step(self) -> Array:
        """(n_columns,) solution; raises NotPositiveDefiniteError."""
        n = self.full.layout.n_state_columns
        right = self.full.gradient[n:] - self.half_border.T @ self.half_gradient
        try:
            shared = cho_solve(cho_factor(self.shared), right) if len(right) else right
        except np.linalg.LinAlgError as error:
            raise NotPositiveDefiniteError(str(error)) from error
        states = self.factor.backward((self.half_gradient - self.half_border @ shared)[:, None])[:, 0]
        return np.concatenate([states, shared])


@njit()
def _scatter_blocks(blocks, columns, states, border, corner, tile, first, offsets):  # type: ignore[no-untyped-def]
    """Add symmetric blocks (n, q, q) at `columns` (n, q) to the lower triangle; -1 is left out."""
    n, q = len(border), columns.shape[1]
    for m in range(len(blocks)):
        for a in range(q):
            for b in range(q):
                i, j = columns[m, a], columns[m, b]
                if j < 0 or i < j:
                    continue
                if i < n:
                    states[_position(i, j, n, tile, first, offsets)] += blocks[m, a, b]
                elif j < n:
                    border[j, i - n] += blocks[m, a, b]
                else:
                    corner[i - n, j - n] += blocks[m, a, b]


def _apart(bounds: Indices, states: Indices) -> Indices:
    """Those bounds between ranges of frames (or the next ones) that leave no two ranges a state (F, s) in common:
    frames are in time order, but their clocks may differ, and between states two are involved."""
    latest = np.maximum.accumulate(states.max(axis=1))
    earliest = np.minimum.accumulate(states.min(axis=1)[::-1])[::-1]
    clear = np.concatenate([np.flatnonzero(latest[:-1] < earliest[1:]) + 1, [len(states)]])
    return np.unique(np.concatenate([[0], clear[np.searchsorted(clear, bounds[1:])]]))


@njit(nogil=True)
def _position(i, j, n, tile, first, offsets):  # type: ignore[no-untyped-def]
    """Where row i, column j <= i lies in the values of an `Envelope`."""
    t = i // tile
    width = min(n, (t + 1) * tile) - first[t] * tile
    return offsets[t] + (i - t * tile) * width + j - first[t] * tile


@njit(nogil=True)
def _scatter_states(  # type: ignore[no-untyped-def]
    begin, end, blocks, row_starts, partners, columns, by_states, w, n, states, tile, first, offsets
):
    """Add `J_f^T S J_g` of every pair (f, g) and its transpose; partners of the same states are summed first."""
    neighbours, padded = by_states.shape[1], by_states.shape[3]
    right, product = np.empty((neighbours, 6, padded)), np.empty((padded, padded))
    for f in range(begin, end):
        pair, stop = row_starts[f], row_starts[f + 1]
        while pair < stop:
            of_state = columns[partners[pair]]
            right[:] = 0.0
            # frames between two states have as many: all of them must agree, not only the first
            while pair < stop and (columns[partners[pair]] == of_state).all():
                g = partners[pair]
                # a frame with itself comes once, and is added with its transpose
                fraction = 0.5 if g == f else 1.0
                for b in range(neighbours):
                    _add_product(fraction, blocks[pair], by_states[g, b], right[b])
                pair += 1
            for b in range(neighbours):
                for a in range(neighbours):
                    product[:] = 0.0
                    _add_product(1.0, by_states[f, a].T, right[b], product)
                    _add_symmetric(product, columns[f, a], of_state[b], w, n, states, tile, first, offsets)


@njit(nogil=True)
def _add_symmetric(product, row, column, w, n, states, tile, first, offsets):  # type: ignore[no-untyped-def]
    """Add a block (w, w) that starts at a row and column, and its transpose, to the lower triangle."""
    for i in range(w):
        if row >= column:
            at = _position(row + i, column, n, tile, first, offsets)
            for j in range(w):
                states[at + j] += product[i, j]
        if row <= column:
            at = _position(column + i, row, n, tile, first, offsets)
            for j in range(w):
                states[at + j] += product[j, i]


@njit(nogil=True)
def _scatter_coupling(coupling, jacobian, columns, n, border, corner):  # type: ignore[no-untyped-def]
    """Add `J_f^T c` of every frame and shared parameter that it has to do with."""
    for f in range(coupling.shape[0]):
        for k in range(coupling.shape[1]):
            c = coupling[f, k]
            if c[0] == 0 and c[1] == 0 and c[2] == 0 and c[3] == 0 and c[4] == 0 and c[5] == 0:
                continue
            for a in range(columns.shape[1]):
                column, total = columns[f, a], 0.0
                if column < 0:
                    continue
                for i in range(6):
                    total += jacobian[f, i, a] * c[i]
                if column < n:
                    border[column, k] += total
                else:
                    corner[column - n, k] += total


@njit(nogil=True)
def _scatter_shared(  # type: ignore[no-untyped-def]
    origin,
    begin,
    end,
    blocks,
    row_starts,
    partners,
    rows,
    column_starts,
    columns,
    shared,
    by_shared,
    coupling,
):
    """Add `(S B_g)^T` of every pair with g to `coupling` of f - origin, whichever of the two is later."""
    for f in range(begin, end):
        for pair in range(row_starts[f], row_starts[f + 1]):
            g = partners[pair]
            _add_columns(blocks[pair], by_shared[g], shared[g], coupling[f - origin])
        for slot in range(column_starts[f], column_starts[f + 1]):
            g = rows[columns[slot]]
            _add_columns(blocks[columns[slot]].T, by_shared[g], shared[g], coupling[f - origin])


@njit(nogil=True)
def _add_columns(S, B, columns, out):  # type: ignore[no-untyped-def]
    for a in range(len(columns)):
        for m in range(6):
            # most of B is zero: a camera's mounting moves it as it says
            if columns[a] >= 0 and B[m, a] != 0:
                for i in range(6):
                    out[columns[a], i] += S[i, m] * B[m, a]


@njit(nogil=True)
def _add_product(factor, a, b, out):  # type: ignore[no-untyped-def]
    """`out += factor a b`, row by row so that the inner loop is contiguous."""
    for i in range(out.shape[0]):
        for k in range(a.shape[1]):
            x = factor * a[i, k]
            for j in range(out.shape[1]):
                out[i, j] += x * b[k, j]
