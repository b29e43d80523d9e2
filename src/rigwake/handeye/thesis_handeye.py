"""The baseline: a classical linear solution on absolute poses, refined by a bounded trust-region search.

1. Rotation: null vector of the stacked `(I9 - R_A (x) R_B) vec(R_X) = 0`, scaled to determinant one.
2. Translation: pseudo-inverse of the stacked `(R_A - I) t_X = R_X t_B - t_A`.
3. Refinement of quaternion and translation with bounds (`scipy.optimize.least_squares`, `trf`) on the
   entries of `A X - X B`.

A and B are the poses relative to the first one, treated as if their errors were independent: which they
are not for odometry. No covariance, no verdict on what the motion determines: this is what `ml` improves on.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3

_TRANSLATION_BOUND = 100.0  # metres around the linear solution


def thesis_handeye(reference_poses: SE3, member_poses: SE3) -> SE3:
    """`ref_from_member` from N synchronous poses of both."""
    A = reference_poses[0].inverse() * reference_poses[1:]
    B = member_poses[0].inverse() * member_poses[1:]
    linear = linear_handeye(A, B)
    start = np.concatenate([linear.quat_wxyz, linear.translation])
    reach = np.concatenate([np.ones(4) + 1e-9, np.full(3, _TRANSLATION_BOUND)])
    low = np.concatenate([-reach[:4], linear.translation - reach[4:]])
    high = np.concatenate([reach[:4], linear.translation + reach[4:]])

    def misfit(unknowns: Array) -> Array:
        X = SE3.from_quat_wxyz(unknowns[:4], unknowns[4:])
        left, right = A * X, X * B
        return np.concatenate(
            [(left.rotation - right.rotation).ravel(), (left.translation - right.translation).ravel()]
        )

    found = least_squares(misfit, start, bounds=(low, high), method="trf").x
    return SE3.from_quat_wxyz(found[:4], found[4:])


def linear_handeye(A: SE3, B: SE3) -> SE3:
    """Steps 1 and 2 for motions with `A X = X B`."""
    n = len(A)
    kronecker = np.einsum("nij,nkl->nikjl", A.rotation, B.rotation).reshape(n, 9, 9)
    _, _, Vt = np.linalg.svd((np.eye(9) - kronecker).reshape(-1, 9), full_matrices=False)
    V = Vt[-1].reshape(3, 3)
    determinant = np.linalg.det(V)
    R = so3.nearest_rotation(V * np.sign(determinant) / max(abs(determinant), 1e-300) ** (1 / 3))
    left = (A.rotation - np.eye(3)).reshape(-1, 3)
    right = (B.translation @ R.T - A.translation).ravel()
    return SE3(R, np.linalg.pinv(left) @ right)
