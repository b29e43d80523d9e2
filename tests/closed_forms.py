"""The classical closed forms of `A X = X B`, for comparison: what users of other tools know.

Each takes N motions of the reference (A) and of the member (B) and returns `X = ref_from_member`. They weigh
all motions alike and know neither noise nor clocks nor scale; use `calibrate_handeye` for results.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3


def park_martin(A: SE3, B: SE3) -> SE3:
    """Rotation by `M = sum b a^T`, `R = (M^T M)^-1/2 M^T` on rotation vectors (Park and Martin 1994)."""
    M = so3.log(B.rotation).T @ so3.log(A.rotation)
    values, vectors = np.linalg.eigh(M.T @ M)
    root = (vectors / np.sqrt(np.maximum(values, 1e-300))) @ vectors.T
    return _with_translation(so3.nearest_rotation(root @ M.T), A, B)


def horaud_dornaika(A: SE3, B: SE3) -> SE3:
    """Rotation as the unit quaternion that minimises `sum |q_a q - q q_b|^2` (Horaud and Dornaika 1995)."""
    qa, qb = A.quat_wxyz, B.quat_wxyz
    return _with_translation(_rotation_of_null(_quaternion_system(qa, qb).reshape(-1, 4)), A, B)


def tsai_lenz(A: SE3, B: SE3) -> SE3:
    """Rotation from `skew(p_a + p_b) p' = p_b - p_a` on modified Rodrigues vectors (Tsai and Lenz 1989)."""
    pa, pb = 2 * A.quat_wxyz[:, 1:], 2 * B.quat_wxyz[:, 1:]
    p = np.linalg.lstsq(so3.hat(pa + pb).reshape(-1, 3), (pb - pa).ravel(), rcond=None)[0]
    p = 2 * p / np.sqrt(1 + p @ p)
    square = p @ p
    R = (1 - square / 2) * np.eye(3) + 0.5 * (np.outer(p, p) + np.sqrt(max(4 - square, 0.0)) * so3.hat(p))
    return _with_translation(so3.nearest_rotation(R), A, B)


def andreff(A: SE3, B: SE3) -> SE3:
    """Rotation and translation in one linear system over `vec(R)` and t (Andreff et al. 1999)."""
    n = len(A)
    system = np.zeros((n, 12, 12))
    system[:, :9, :9] = np.eye(9) - np.einsum("nij,nkl->nikjl", A.rotation, B.rotation).reshape(n, 9, 9)
    system[:, 9:, :9] = np.einsum("ij,nk->nijk", np.eye(3), B.translation).reshape(n, 3, 9)
    system[:, 9:, 9:] = np.eye(3) - A.rotation
    right = np.concatenate([np.zeros((n, 9)), A.translation], axis=1)
    solution = np.linalg.lstsq(system.reshape(-1, 12), right.ravel(), rcond=None)[0]
    V = solution[:9].reshape(3, 3)
    return _with_translation(so3.nearest_rotation(V), A, B)


def daniilidis(A: SE3, B: SE3) -> SE3:
    """Rotation and translation together by dual quaternions (Daniilidis 1999)."""
    qa, qb = A.quat_wxyz, B.quat_wxyz
    da, db = _dual_part(qa, A.translation), _dual_part(qb, B.translation)
    # screw congruence: the vector parts carry all constraints, (5) of the paper
    real, dual = _quaternion_system(qa, qb)[:, 1:], _quaternion_system(da, db)[:, 1:]
    top = np.concatenate([real, np.zeros_like(real)], axis=2)
    bottom = np.concatenate([dual, real], axis=2)
    _, _, Vt = np.linalg.svd(np.concatenate([top, bottom], axis=1).reshape(-1, 8), full_matrices=False)
    (u1, v1), (u2, v2) = (Vt[6, :4], Vt[6, 4:]), (Vt[7, :4], Vt[7, 4:])
    candidates = []
    for s in np.roots([u1 @ v1, u1 @ v2 + u2 @ v1, u2 @ v2]):
        ratio = float(np.real(s))
        candidates.append((ratio**2 * (u1 @ u1) + 2 * ratio * (u1 @ u2) + u2 @ u2, ratio))
    length, ratio = max(candidates)
    q, d = ((ratio * x1 + x2) / np.sqrt(length) for x1, x2 in ((u1, u2), (v1, v2)))
    conjugate = q * np.array([1.0, -1, -1, -1])
    return SE3.from_quat_wxyz(q, 2 * (_left(d[None])[0] @ conjugate)[1:])


CLOSED_FORMS: dict[str, Callable[[SE3, SE3], SE3]] = {
    "Tsai-Lenz 1989": tsai_lenz,
    "Park-Martin 1994": park_martin,
    "Horaud-Dornaika 1995": horaud_dornaika,
    "Andreff 1999": andreff,
    "Daniilidis 1999": daniilidis,
}


def _with_translation(rotation: Array, A: SE3, B: SE3) -> SE3:
    """`(R_A - I) t = R t_B - t_A` in least squares."""
    right = (B.translation @ rotation.T - A.translation).ravel()
    left = (A.rotation - np.eye(3)).reshape(-1, 3)
    return SE3(rotation, np.asarray(np.linalg.lstsq(left, right, rcond=None)[0], dtype=np.float64))


def _left(q: Array) -> Array:
    """`L(q) p = q p`: (N, 4) -> (N, 4, 4)."""
    return _product_matrix(q, 1.0)


def _product_matrix(q: Array, sign: float) -> Array:
    M = np.zeros((len(q), 4, 4))
    M[:, 0, 0] = q[:, 0]
    M[:, 0, 1:], M[:, 1:, 0] = -q[:, 1:], q[:, 1:]
    M[:, 1:, 1:] = q[:, :1, None] * np.eye(3) + sign * so3.hat(q[:, 1:])
    return M


def _quaternion_system(a: Array, b: Array) -> Array:
    """`(L(a) - R(b)) q`, zero for `a q = q b`: (N, 4, 4)."""
    return _left(a) - _product_matrix(b, -1.0)


def _rotation_of_null(system: Array) -> Array:
    return so3.matrix_from_quat_wxyz(np.linalg.svd(system, full_matrices=False)[2][-1])


def _dual_part(q: Array, translation: Array) -> Array:
    pure = np.concatenate([np.zeros((len(q), 1)), translation], axis=1)
    return np.asarray(0.5 * (_left(pure) @ q[:, :, None])[:, :, 0])
