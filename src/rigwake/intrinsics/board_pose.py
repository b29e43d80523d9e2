"""Where a flat board stands, from the bearings that see its corners, in front of the lens or behind it."""

from __future__ import annotations

import numpy as np

from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3


def board_pose(points_board: Array, bearings_cam: Array) -> SE3 | None:
    """`cam_from_board` of a flat board (z = 0), or None if the corners do not determine it.

    A bearing is parallel to `H (x, y, 1)` with `H = [r1 r2 t]` up to scale: `b x H (x, y, 1) = 0` is linear
    in H, whose null vector is found by SVD on centred, scaled board coordinates. Its sign follows from the
    bearings themselves (`b . H (x, y, 1) > 0`), so that no half space is assumed. Source: Zhang, *A Flexible
    New Technique for Camera Calibration*, PAMI 22(11), 2000, on the unit sphere.
    """
    centre = points_board[:, :2].mean(axis=0)
    spread = np.linalg.norm(points_board[:, :2] - centre, axis=1).mean()
    if not spread > 0:
        return None
    flat = np.column_stack([(points_board[:, :2] - centre) / spread, np.ones(len(points_board))])
    # rows of (b x) H m for all points: (N, 3, 9)
    rows = np.einsum("nij,nk->nijk", so3.hat(bearings_cam), flat).reshape(-1, 9)
    _, singular, Vt = np.linalg.svd(rows.T @ rows)
    if singular[7] <= 1e-12 * singular[0]:
        return None
    H = Vt[8].reshape(3, 3)
    along = np.einsum("ni,ni->n", bearings_cam, flat @ H.T)
    H = H * np.sign(np.median(along)) / np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1]))
    rotation = so3.nearest_rotation(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    translation = H[:, 2] * spread - rotation[:, :2] @ centre
    return SE3(rotation, translation) if np.isfinite(translation).all() else None
