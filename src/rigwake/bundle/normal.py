"""Normal equations over states (an envelope) and shared parameters (a dense border), and their solution.

    [ A   B ] [x]   [a]      A: states, envelope;  B: states x shared;  C: shared
    [ B^T C ] [y] = [b]

Filled from two kinds of parts: factors that depend on columns directly, and camera frames after landmark
elimination, whose pose depends on columns through a Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.linalg import cho_factor, cho_solve

from rigwake.bundle.envelope import Envelope, Factor, NotPositiveDefiniteError, cholesky
from rigwake.bundle.layout import Layout
from rigwake.bundle.motion import TimedPoses
from rigwake.bundle.problem import Indices
from rigwake.bundle.schur import FrameEquations, FramePairs
from rigwake.geometry.so3 import Array


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

    layout: Layout
    shape: Envelope
    states: Array
    border: Array
    corner: Array
    gradient: Array
    diagonal: Array

    @classmethod
    def zeros(cls, layout: Layout, shape: Envelope) -> NormalEquations:
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
        n, shape = self.layout.n_state_columns, self.shape
        held = self.layout.held[poses.states * self.layout.state_dim]
        by_states = np.where(held[..., None, None], 0.0, poses.by_states)
        # felt[f]: what the shared parameters' steps do to the right-hand side of frame f
        felt = np.zeros((len(poses.states), 6, self.layout.n_columns - n))
        _scatter_frame_pairs(
            equations.blocks,
            pairs.row_starts,
            pairs.partners,
            poses.states * self.layout.state_dim,
            by_states,
            poses.shared - n,
            poses.by_shared,
            felt,
            n,
            self.states,
            shape.tile,
            shape.first,
            shape.offsets,
        )
        felt[:, :, self.layout.extras_start - n :] += equations.with_extras
        jacobian, columns = poses.chain(self.layout)
        coupling = np.einsum("fia,fik->fak", jacobian, felt)
        is_state, is_shared = (columns >= 0) & (columns < n), columns >= n
        np.add.at(self.border, columns[is_state], coupling[is_state])
        np.add.at(self.corner, columns[is_shared] - n, coupling[is_shared])
        gradients = np.einsum("fia,fi->fa", jacobian, equations.gradient)
        diagonals = np.einsum("fia,fi,fia->fa", jacobian, equations.diagonal, jacobian)
        self._add_vectors(gradients, diagonals, columns)
        self._add_extras(equations)

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


@njit(cache=True)
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


@njit(cache=True)
def _position(i, j, n, tile, first, offsets):  # type: ignore[no-untyped-def]
    """Where row i, column j <= i lies in the values of an `Envelope`."""
    t = i // tile
    width = min(n, (t + 1) * tile) - first[t] * tile
    return offsets[t] + (i - t * tile) * width + j - first[t] * tile


@njit(cache=True)
def _scatter_frame_pairs(  # type: ignore[no-untyped-def]
    blocks,
    row_starts,
    partners,
    state_columns,
    by_states,
    shared,
    by_shared,
    felt,
    n,
    states,
    tile,
    first,
    offsets,
):
    """Add `J_f^T S J_g` of every pair (f, g) and its transpose to the states, and `S B_g` to `felt` of f."""
    neighbours, w, k = by_states.shape[1], by_states.shape[3], shared.shape[1]
    right, product = np.empty((6, w)), np.empty((w, w))
    for f in range(len(row_starts) - 1):
        for pair in range(row_starts[f], row_starts[f + 1]):
            g, S = partners[pair], blocks[pair]
            for a in range(k):
                if shared[g, a] >= 0:
                    for i in range(6):
                        for m in range(6):
                            felt[f, i, shared[g, a]] += S[i, m] * by_shared[g, m, a]
                if g != f and shared[f, a] >= 0:
                    for i in range(6):
                        for m in range(6):
                            felt[g, i, shared[f, a]] += S[m, i] * by_shared[f, m, a]
            for b in range(neighbours):
                column = state_columns[g, b]
                _multiply(S, by_states[g, b], right)
                for a in range(neighbours):
                    row = state_columns[f, a]
                    if f == g and row < column:
                        continue
                    _multiply_transposed(by_states[f, a], right, product)
                    for i in range(w):
                        for j in range(w):
                            value = product[i, j]
                            if row == column and f != g:
                                value += product[j, i]
                            if row >= column:
                                states[_position(row + i, column, n, tile, first, offsets) + j] += value
                            else:
                                states[_position(column + j, row, n, tile, first, offsets) + i] += value


@njit(cache=True)
def _multiply(a, b, out):  # type: ignore[no-untyped-def]
    """`a b`, row by row so that the inner loop is contiguous."""
    for i in range(out.shape[0]):
        out[i] = 0.0
        for k in range(a.shape[1]):
            factor = a[i, k]
            for j in range(out.shape[1]):
                out[i, j] += factor * b[k, j]


@njit(cache=True)
def _multiply_transposed(a, b, out):  # type: ignore[no-untyped-def]
    """`a^T b`."""
    for i in range(out.shape[0]):
        out[i] = 0.0
        for k in range(a.shape[0]):
            factor = a[k, i]
            for j in range(out.shape[1]):
                out[i, j] += factor * b[k, j]
