"""Rotations: exponential, logarithm, quaternions and Jacobians, batched over leading axes.

Rotation vectors are `axis * angle` in radians. Quaternions are Hamilton, order `wxyz`, unit norm.
Source: Barfoot, *State Estimation for Robotics* (2017), chapter 7; Sola et al., *A micro Lie theory* (2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigwake._types import Array

_SMALL = 1e-4  # below this angle the closed forms lose digits, and three Taylor terms are exact to 1e-24


def hat(vectors: ArrayLike) -> Array:
    """Skew matrix with `hat(a) @ b = a x b`: (..., 3) -> (..., 3, 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _vee(matrices: Array) -> Array:
    """Twice the axial vector of the skew part: (..., 3, 3) -> (..., 3)."""
    skew = matrices - np.swapaxes(matrices, -1, -2)
    return np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)


def _sine(angle: Array) -> Array:
    """`sin(t)/t`, accurate through t = 0."""
    small, t2 = angle < _SMALL, angle * angle
    t = np.where(small, 1.0, angle)
    return np.where(small, 1 - t2 / 6 + t2 * t2 / 120, np.sin(t) / t)


def _cosine(angle: Array) -> Array:
    """`(1 - cos t)/t^2`, accurate through t = 0."""
    small, t2 = angle < _SMALL, angle * angle
    t = np.where(small, 1.0, angle)
    return np.where(small, 0.5 - t2 / 24 + t2 * t2 / 720, 2 * np.sin(t / 2) ** 2 / t**2)


def _sine_rest(angle: Array) -> Array:
    """`(t - sin t)/t^3`, accurate through t = 0."""
    small, t2 = angle < _SMALL, angle * angle
    t = np.where(small, 1.0, angle)
    return np.where(small, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (t - np.sin(t)) / t**3)


def exp(rotation_vectors: ArrayLike) -> Array:
    """Rotation matrices of rotation vectors (Rodrigues): (..., 3) -> (..., 3, 3)."""
    v = np.asarray(rotation_vectors, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)
    a, b, K = _sine(angle), _cosine(angle), hat(v)
    return np.asarray(np.eye(3) + a[..., None, None] * K + b[..., None, None] * (K @ K))


def log(rotations: ArrayLike) -> Array:
    """Rotation vectors of rotation matrices, angle in [0, pi]: (..., 3, 3) -> (..., 3)."""
    R = np.asarray(rotations, dtype=np.float64)
    trace = np.einsum("...ii->...", R)
    if np.all(trace > 0):  # below 120 degrees the real part is large: no need to look for a larger one
        w = 0.5 * np.sqrt(1 + trace)
        v = _vee(R) / (4 * w[..., None])
    else:
        q = quat_wxyz_from_matrix(R)
        w, v = q[..., 0], q[..., 1:]
    norm = np.linalg.norm(v, axis=-1)
    safe = np.where(norm < 1e-12, 1.0, norm)
    factor = np.where(norm < 1e-12, 2.0, 2 * np.arctan2(norm, w) / safe)
    return np.asarray(v * factor[..., None])


def right_jacobian(rotation_vectors: ArrayLike) -> Array:
    """`J_r` with `exp(v + d) ~ exp(v) exp(J_r d)`: (..., 3) -> (..., 3, 3)."""
    v = np.asarray(rotation_vectors, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)
    b, c, K = _cosine(angle), _sine_rest(angle), hat(v)
    return np.asarray(np.eye(3) - b[..., None, None] * K + c[..., None, None] * (K @ K))


def left_jacobian(rotation_vectors: ArrayLike) -> Array:
    """`J_l` with `exp(v + d) ~ exp(J_l d) exp(v)`, equal to `J_r(-v)`: (..., 3) -> (..., 3, 3)."""
    return right_jacobian(-np.asarray(rotation_vectors, dtype=np.float64))


def right_jacobian_inverse(rotation_vectors: ArrayLike) -> Array:
    """Inverse of `J_r`, for `log(R exp(d)) ~ log(R) + J_r^-1 d`: (..., 3) -> (..., 3, 3); angle < 2 pi."""
    v = np.asarray(rotation_vectors, dtype=np.float64)
    t = np.linalg.norm(v, axis=-1)
    small = t < 1e-2
    safe = np.where(small, 1.0, t)
    half = safe / 2
    # (1 - (t/2) cot(t/2)) / t^2; the series is exact to 1e-17 below 1e-2
    series = 1 / 12 + t**2 / 720 + t**4 / 30240 + t**6 / 1209600
    c = np.where(small, series, (1 - half / np.tan(half)) / safe**2)
    K = hat(v)
    return np.asarray(np.eye(3) + 0.5 * K + c[..., None, None] * (K @ K))


def left_jacobian_inverse(rotation_vectors: ArrayLike) -> Array:
    """Inverse of `J_l`: (..., 3) -> (..., 3, 3)."""
    return right_jacobian_inverse(-np.asarray(rotation_vectors, dtype=np.float64))


def matrix_from_quat_wxyz(quat_wxyz: ArrayLike) -> Array:
    """Rotation matrices of (normalised here) quaternions: (..., 4) -> (..., 3, 3)."""
    q = np.asarray(quat_wxyz, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, v = q[..., 0], q[..., 1:]
    K = hat(v)
    return np.asarray(np.eye(3) + 2 * w[..., None, None] * K + 2 * (K @ K))


def quat_wxyz_from_matrix(rotations: ArrayLike) -> Array:
    """Unit quaternions with `w >= 0` of rotation matrices: (..., 3, 3) -> (..., 4).

    All four quadratic forms are computed and the largest is used, so that no angle is ill-conditioned
    (Shepperd 1978).
    """
    R = np.asarray(rotations, dtype=np.float64)
    m = R.reshape(-1, 3, 3)
    d0, d1, d2 = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    s21, s02, s10 = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    p10, p20, p21 = m[:, 1, 0] + m[:, 0, 1], m[:, 2, 0] + m[:, 0, 2], m[:, 2, 1] + m[:, 1, 2]
    rows = np.stack(
        [
            np.stack([1 + d0 + d1 + d2, s21, s02, s10], -1),
            np.stack([s21, 1 + d0 - d1 - d2, p10, p20], -1),
            np.stack([s02, p10, 1 - d0 + d1 - d2, p21], -1),
            np.stack([s10, p20, p21, 1 - d0 - d1 + d2], -1),
        ],
        axis=1,
    )
    best = np.argmax(np.einsum("nii->ni", rows), axis=1)
    q = rows[np.arange(len(m)), best]
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    q *= np.where(q[:, :1] < 0, -1.0, 1.0)
    return np.asarray(q.reshape(*R.shape[:-2], 4))


def nearest_rotation(matrices: ArrayLike) -> Array:
    """The rotation nearest in Frobenius norm (SVD, determinant corrected): (..., 3, 3) -> (..., 3, 3)."""
    U, _, Vt = np.linalg.svd(np.asarray(matrices, dtype=np.float64))
    sign = np.ones(U.shape[:-1])
    sign[..., 2] = np.linalg.det(U @ Vt)
    return np.asarray((U * sign[..., None, :]) @ Vt)
