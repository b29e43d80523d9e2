"""How sure the bundle adjustment is: covariances of shared parameters and states, and what is unobservable.

The information of the shared parameters, with every state and landmark unknown beside them, is the reduced
matrix `S = C - B^T A^-1 B` of `normal.py`, taken without damping. Scaled by the information each parameter
would have if everything else were known, its eigenvalues are comparable numbers between 0 and 1: the fraction
that is left once nothing else is known. Where (next to) none is left, the direction is unobservable: an exact
symmetry of the problem, such as turning the rig's axes when only GNSS ties them to the world. A pseudo-inverse
or a damped inverse would print a number there; this module prints none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dtrtri

from rigwake._types import Array, Mask
from rigwake.ba.solver.clusters import clustered_scatter
from rigwake.ba.solver.envelope import Factor, NotPositiveDefiniteError
from rigwake.ba.solver.levenberg_marquardt import equations_of, linearised, structure_of
from rigwake.ba.solver.normal import ReducedEquations
from rigwake.ba.solver.parameter_layout import OwnedParameter, ParameterLayout
from rigwake.ba.solver.rig_problem import RigProblem, SolverOptions
from rigwake.errors import EstimationError, UsageError
from rigwake.parallel import one_blas_thread

_LEAST_FRACTION = (
    1e-9  # of the information left; below, rounding speaks (sigma > 3e4 times the conditional one)
)
_LEAST_NEGATIVE = -1e-6  # shares below are no rounding
_ROUNDING = 1e-12  # added to the states' scaled diagonal, so that a free gauge of theirs can be eliminated
_TOUCHED = 1e-5  # a quantity whose (unit) direction has more than this of an unobservable one is unobservable


@dataclass(frozen=True, eq=False)
class RigCovariance:
    """Covariance of a problem's free shared parameters at its optimum.

    layout: their columns (from `layout.n_state_columns` on). information: (k, k) reduced information.
    scale: (k,) inverse roots of the information that each has when all else is known. fractions: (k,) eigenvalues
    of the scaled information, increasing. directions: (k, k) eigenvectors as columns, in scaled parameters.
    state_covariances: (N, d, d) of the states' own components, or None if they were not asked for; held
    components are zero, and unobservable directions of shared parameters count as held. excess: (g, g) what
    errors that last along tracks add, in whitened determined directions (see `clusters.py`), or None.
    """

    layout: ParameterLayout
    information: Array
    scale: Array
    fractions: Array
    directions: Array
    state_covariances: Array | None = None
    excess: Array | None = None

    @property
    def observable(self) -> Mask:
        """(k,) which columns of `directions` have information."""
        return np.asarray(self.fractions >= _LEAST_FRACTION)

    @property
    def unobservable(self) -> Array:
        """(u, k) unit directions, in the parameters' own units, that nothing in the problem determines."""
        raw = (self.scale[:, None] * self.directions[:, ~self.observable]).T
        return np.asarray(raw / np.linalg.norm(raw, axis=1, keepdims=True))

    def of(self, rows: Array) -> tuple[Array, Mask]:
        """Covariance (q, q) of the quantities `rows @ parameters`, rows (q, k), and which are determined (q,).

        Rows and columns of unobservable quantities are NaN.
        """
        observable = ~self.touched(rows).any(axis=1)
        half = self.spread(rows)
        covariance = half @ half.T
        covariance[~observable] = np.nan
        covariance[:, ~observable] = np.nan
        return covariance, np.asarray(observable)

    def touched(self, rows: Array) -> Mask:
        """(q, u) which quantities `rows @ parameters` each unobservable direction has a part in, beyond rounding."""
        components = (np.atleast_2d(rows) * self.scale) @ self.directions
        sizes = np.maximum(np.linalg.norm(components, axis=1), 1e-300)
        return np.asarray(np.abs(components[:, ~self.observable]) > _TOUCHED * sizes[:, None])

    def spread(self, rows: Array) -> Array:
        """(q, g) root of the covariance of `rows @ parameters` (q, k), determined directions only."""
        good = self.observable
        half = (np.atleast_2d(rows) * self.scale) @ self.directions[:, good] / np.sqrt(self.fractions[good])
        if self.excess is None:
            return np.asarray(half)
        return np.asarray(half @ np.linalg.cholesky(np.eye(len(self.excess)) + self.excess))

    def rows_of(self, owner: str, parameter: str) -> Array:
        """(w, k) rows that select a parameter: `("front", "rig_from_cam")`, `("antenna", "position_rig")`.

        Raises UsageError if it is not among the free ones.
        """
        block = self.layout.shared.get((owner, parameter))
        if block is None:
            known = ", ".join(f"{a}.{b}" for a, b in self.layout.shared)
            raise UsageError(
                f"{owner}.{parameter} was not estimated.", remedy=f"Free were: {known or 'none'}."
            )
        return np.eye(len(self.scale))[
            block.start - self.layout.n_state_columns : block.stop - self.layout.n_state_columns
        ]

    def parameter(self, owner: str, parameter: str) -> tuple[Array, Mask]:
        """Covariance and verdict per component of one shared parameter; a transform's is its right tangent."""
        return self.of(self.rows_of(owner, parameter))


def covariance_of(
    problem: RigProblem,
    options: SolverOptions | None = None,
    *,
    states: bool = False,
    clustered: bool = False,
    prior_spreads: Mapping[OwnedParameter, Array] | None = None,
) -> RigCovariance:
    """Covariances at the values of a problem, which should be its optimum (`solution.problem`).

    options: those of the solve: weights of robust losses count. states: also the marginal covariances of all
    states (by selected inversion). clustered: widen the shared parameters' by errors that last along tracks.
    prior_spreads: by
    shared parameter, how much larger (w, w) the scatter of its prior's scores really is than its information says.
    Raises EstimationError if a state has no information at all.
    """
    wanted = options or SolverOptions()
    with one_blas_thread():
        structure = structure_of(problem)
        linear = linearised(problem, structure, wanted)
        equations, _ = equations_of(linear, structure, damping=0.0)
        try:
            reduced = equations.damped(_ROUNDING).factorise()
        except NotPositiveDefiniteError as error:
            raise EstimationError(
                f"The states of the bundle adjustment are unobservable ({error}).",
                remedy="Tie every state by observations, an IMU or pose measurements, and hold the gauge.",
            ) from error
        n = structure.layout.n_state_columns
        scale = 1 / np.sqrt(np.maximum(equations.diagonal[n:], np.finfo(float).tiny ** 0.5))
        fractions, directions = np.linalg.eigh(reduced.shared * np.outer(scale, scale))
        if len(fractions) and fractions[0] < _LEAST_NEGATIVE:
            raise EstimationError(
                f"The information of the rig has a negative eigenvalue ({fractions[0]:.1e} of the scaled matrix).",
                consequence="No least-squares problem has one: the covariance would be wrong.",
                remedy="Please report this with the recording; other settings of `adjustment` may avoid it.",
            )
        found = RigCovariance(structure.layout, reduced.shared, scale, fractions, directions)
        if states:
            found = replace(found, state_covariances=_of_states(found, reduced))
        surplus = np.zeros_like(found.information)
        if clustered:
            observed, predicted = clustered_scatter(linear.observations, linear.poses, found.layout, reduced)
            surplus = observed - predicted
        if clustered or prior_spreads:
            excess = _excess(found, surplus)
            for (owner, parameter), spread in (prior_spreads or {}).items():
                # apart from the others: it is positive and may be larger by many orders
                own = found.rows_of(owner, parameter)
                excess = excess + _excess(found, own.T @ spread @ own)
            found = replace(found, excess=excess)
        return found


def _excess(found: RigCovariance, surplus: Array) -> Array:
    """The positive part of a surplus of information (k, k), in whitened determined directions (g, g)."""
    half = found.scale[:, None] * found.directions[:, found.observable]
    half = half / np.sqrt(found.fractions[found.observable])
    values, vectors = np.linalg.eigh(half.T @ surplus @ half)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _of_states(found: RigCovariance, reduced: ReducedEquations) -> Array:
    """(N, d, d) marginals: `A^-1 + (A^-1 B) cov (A^-1 B)^T`, diagonal blocks."""
    layout = found.layout
    n, d = layout.n_states, layout.state_dim
    blocks = _inverse_blocks(reduced.factor, d)
    response = reduced.factor.backward(reduced.half_border)
    good = found.observable
    spread = response @ (found.scale[:, None] * found.directions[:, good] / np.sqrt(found.fractions[good]))
    spread = spread.reshape(n, d, -1)
    blocks += spread @ np.swapaxes(spread, 1, 2)
    held = layout.held[: n * d].reshape(n, d)
    blocks[held[:, :, None] | held[:, None, :]] = 0.0
    return blocks


def _inverse_blocks(factor: Factor, size: int) -> Array:
    """(n / size, size, size) diagonal blocks of the inverse, by the recursion of Takahashi et al. (1973):

    `Z_ij = -sum_k Z_ik L_kj L_jj^-1` for i > j and `Z_jj = L_jj^-T L_jj^-1 - sum_k (L_kj L_jj^-1)^T Z_kj`,
    over the tiles k > j of column j, from the last column backwards; only tiles inside the envelope are needed.
    """
    shape, tile, first = factor.shape, factor.shape.tile, factor.shape.first
    inverse: dict[tuple[int, int], Array] = {}
    blocks = np.empty((shape.n // size, size, size))
    for j in reversed(range(len(first))):
        below = [i for i in range(j + 1, len(first)) if first[i] <= j] if j + 1 < len(first) else []
        corner = shape.rows(factor.values, j)[:, (j - first[j]) * tile :]
        unit, _ = dtrtri(corner, lower=1)
        unit = np.tril(unit)
        ratios = [
            shape.rows(factor.values, k)[:, (j - first[k]) * tile :][:, : len(corner)] @ unit for k in below
        ]
        own = unit.T @ unit
        for i in below:
            total = np.zeros((min(tile, shape.n - i * tile), len(corner)))
            for k, ratio in zip(below, ratios, strict=True):
                total -= (inverse[i, k] if i >= k else inverse[k, i].T) @ ratio
            inverse[i, j] = total
        for k, ratio in zip(below, ratios, strict=True):
            own -= ratio.T @ inverse[k, j]
        inverse[j, j] = own
        for s in range(len(corner) // size):
            blocks[j * tile // size + s] = own[s * size : (s + 1) * size, s * size : (s + 1) * size]
    return blocks
