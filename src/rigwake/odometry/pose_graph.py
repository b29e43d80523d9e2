"""Pose-graph optimisation in Sim(3): spreads what a loop reveals, scale drift included, over the path.

A similarity `a_from_b` maps `x_b` to `scale * rotation @ x_b + translation`. The graph's residual of an edge is
`log(measured^-1 (a_from_i)^-1 a_from_j)` in the chart (rotation vector, translation, log of scale); steps are right
perturbations in the same chart.

Source: Strasdat, Montiel and Davison, *Scale drift-aware large scale monocular SLAM*, RSS 2010.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from rigwake._types import Array, Indices
from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3

_MAX_STEPS = 50
_CONVERGED = 1e-9
_ROBUST_STDS = 3.0


@dataclass(frozen=True, eq=False)
class Similarities:
    """N similarities: rotation (N, 3, 3), translation (N, 3), scale (N,)."""

    rotation: Array
    translation: Array
    scale: Array

    @classmethod
    def from_transforms(cls, transforms: SE3) -> Similarities:
        """Those of scale one."""
        return cls(transforms.rotation, transforms.translation, np.ones(len(transforms)))

    @classmethod
    def exp(cls, tangents: Array) -> Similarities:
        """From the chart: (N, 7) rotation vector, translation, log of scale."""
        return cls(so3.exp(tangents[:, :3]), tangents[:, 3:6], np.exp(tangents[:, 6]))

    def log(self) -> Array:
        """(N, 7), the inverse of `exp`."""
        parts = so3.log(self.rotation), self.translation, np.log(self.scale)[:, None]
        return np.concatenate(parts, axis=1)

    def inverse(self) -> Similarities:
        """`b_from_a` of `a_from_b`."""
        back = np.swapaxes(self.rotation, -1, -2)
        turned = np.einsum("nij,nj->ni", back, self.translation)
        return Similarities(back, -turned / self.scale[:, None], 1.0 / self.scale)

    def __mul__(self, other: Similarities) -> Similarities:
        """`a_from_b * b_from_c`."""
        moved = np.einsum("nij,nj->ni", self.rotation, other.translation) * self.scale[:, None]
        return Similarities(
            self.rotation @ other.rotation, moved + self.translation, self.scale * other.scale
        )

    def __getitem__(self, rows: Indices | slice) -> Similarities:
        return Similarities(self.rotation[rows], self.translation[rows], self.scale[rows])

    def __len__(self) -> int:
        return len(self.scale)


@dataclass(frozen=True, eq=False)
class Edges:
    """E measured relations: first, second (E,) nodes; first_from_second; std (E, 7) of the residual.

    robust: (E,) edges whose weight falls (Cauchy) where they contradict the rest: recognised places may be wrong.
    """

    first: Indices
    second: Indices
    first_from_second: Similarities
    std: Array
    robust: NDArray[np.bool_]


def optimise_pose_graph(
    world_from_node: Similarities, edges: Edges
) -> tuple[Similarities, NDArray[np.bool_]]:
    """Nodes that agree best with all edges, by Gauss-Newton; the first node of the largest connected part is held.

    Returns the nodes and which of the N belong to that part; the others stay as they were.
    Raises EstimationError where the graph does not converge.
    """
    count = len(world_from_node)
    links = csr_matrix((np.ones(len(edges.first)), (edges.first, edges.second)), shape=(count, count))
    _, part = connected_components(links, directed=False)
    member = part == np.argmax(np.bincount(part))
    column = np.full(count, -1, dtype=np.int64)
    free = np.flatnonzero(member)[1:]
    column[free] = np.arange(len(free))
    inside = member[edges.first]
    edges = Edges(
        edges.first[inside],
        edges.second[inside],
        edges.first_from_second[np.flatnonzero(inside)],
        edges.std[inside],
        edges.robust[inside],
    )
    nodes = world_from_node
    for _ in range(_MAX_STEPS):
        step = _step(nodes, edges, column, len(free))
        tangents = np.zeros((count, 7))
        tangents[free] = step.reshape(-1, 7)
        nodes = nodes * Similarities.exp(tangents)
        if not np.isfinite(step).all():
            break
        if np.abs(step).max(initial=0.0) < _CONVERGED:
            return nodes, member
    raise EstimationError(
        "The pose graph of the recognised places does not converge.",
        consequence="The path stays as it was.",
        remedy="Look at the recognised places: some of them may be wrong.",
    )


def _step(nodes: Similarities, edges: Edges, column: Indices, free: int) -> Array:
    """One Gauss-Newton step, (7 * free,)."""
    error, by_first, by_second = linearised(nodes, edges)
    white = error / edges.std
    square = np.sum(white**2, axis=1)
    weight = np.where(edges.robust, 1.0 / (1.0 + square / (7 * _ROBUST_STDS**2)), 1.0)
    scaling = np.sqrt(weight)[:, None] / edges.std
    rows = 7 * np.arange(len(error))[:, None, None] + np.arange(7)[None, :, None]
    values, at_rows, at_columns = [], [], []
    for jacobian, nodes_of in ((by_first, edges.first), (by_second, edges.second)):
        kept = column[nodes_of] >= 0
        columns = 7 * column[nodes_of][:, None, None] + np.arange(7)[None, None, :]
        at_rows.append(np.broadcast_to(rows, jacobian.shape)[kept].ravel())
        at_columns.append(np.broadcast_to(columns, jacobian.shape)[kept].ravel())
        values.append((jacobian * scaling[:, :, None])[kept].ravel())
    J = csr_matrix(
        (np.concatenate(values), (np.concatenate(at_rows), np.concatenate(at_columns))),
        shape=(7 * len(error), 7 * free),
    )
    if free == 0:
        return np.empty(0)
    return np.asarray(spsolve((J.T @ J).tocsc(), -J.T @ (error * scaling).ravel())).ravel()


def linearised(nodes: Similarities, edges: Edges) -> tuple[Array, Array, Array]:
    """Residuals (E, 7) and their derivatives (E, 7, 7) by right perturbations of the first and second nodes."""
    measured = edges.first_from_second
    off = measured.inverse() * nodes[edges.first].inverse() * nodes[edges.second]
    error = off.log()
    back = np.swapaxes(measured.rotation, -1, -2)
    unrotate = so3.right_jacobian_inverse(error[:, :3])
    inverse_scale = 1.0 / measured.scale
    by_first = np.zeros((len(error), 7, 7))
    by_first[:, :3, :3] = -unrotate @ np.swapaxes(off.rotation, -1, -2) @ back
    by_first[:, 3:6, :3] = so3.hat(off.translation) @ back + inverse_scale[:, None, None] * back @ so3.hat(
        measured.translation
    )
    by_first[:, 3:6, 3:6] = -inverse_scale[:, None, None] * back
    turned = np.einsum("nij,nj->ni", back, measured.translation) * inverse_scale[:, None]
    by_first[:, 3:6, 6] = -(off.translation + turned)
    by_first[:, 6, 6] = -1.0
    by_second = np.zeros_like(by_first)
    by_second[:, :3, :3] = unrotate
    by_second[:, 3:6, 3:6] = off.scale[:, None, None] * off.rotation
    by_second[:, 6, 6] = 1.0
    return error, by_first, by_second
