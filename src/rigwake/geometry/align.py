"""Alignment of one set of positions with another: SE(3), Sim(3) or about the vertical only.

Source: Umeyama, *Least-squares estimation of transformation parameters between two point patterns*,
IEEE TPAMI 13(4), 1991; for yaw only, the closed form of Zhang and Scaramuzza, IROS 2018.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rigwake._types import Array
from rigwake.errors import EstimationError
from rigwake.geometry.se3 import SE3

AlignmentKind = Literal["se3", "sim3", "yaw"]


@dataclass(frozen=True, eq=False)
class Alignment:
    """`points_target ~ scale * rotation @ points_source + translation`, as `target_from_source` and `scale`."""

    target_from_source: SE3
    scale: float = 1.0

    def apply(self, world_from_body: SE3) -> SE3:
        """Transforms given in the source's world and unit, expressed in the target's."""
        R = self.target_from_source.rotation
        scaled = self.scale * world_from_body.translation
        return SE3(R @ world_from_body.rotation, scaled @ R.T + self.target_from_source.translation)


def align_points(points_source: Array, points_target: Array, kind: AlignmentKind = "se3") -> Alignment:
    """Least-squares alignment of (N, 3) points with (N, 3) points.

    Raises EstimationError when the points do not determine it: fewer than 3, or (nearly) on one line; for
    `yaw`, fewer than 2 or all above each other.
    """
    source, target = np.asarray(points_source, float), np.asarray(points_target, float)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"alignment wants two (N, 3) arrays, got {source.shape} and {target.shape}")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    covariance = (target - mean_target).T @ (source - mean_source) / len(source)
    rotation, scale = (
        (_yaw_rotation(covariance), 1.0) if kind == "yaw" else _umeyama(covariance, source, kind == "sim3")
    )
    return Alignment(SE3(rotation, mean_target - scale * rotation @ mean_source), scale)


def _umeyama(covariance: Array, source: Array, with_scale: bool) -> tuple[Array, float]:
    U, D, Vt = np.linalg.svd(covariance)
    if len(source) < 3 or D[1] < 1e-12 * max(D[0], 1e-300) or D[0] == 0:
        raise EstimationError(
            f"{len(source)} positions on one line or in one place do not determine an alignment.",
            remedy="Align with `yaw`, or use a stretch with a turn.",
        )
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    rotation = (U * sign) @ Vt
    variance = float(np.mean(np.sum((source - source.mean(axis=0)) ** 2, axis=1)))
    return rotation, float((D * sign).sum() / variance) if with_scale else 1.0


def _yaw_rotation(covariance: Array) -> Array:
    sine, cosine = covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1]
    if np.hypot(sine, cosine) < 1e-15:
        raise EstimationError("Positions all above each other do not determine a heading.")
    angle = np.arctan2(sine, cosine)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
