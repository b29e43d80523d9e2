"""Rigid transforms `a_from_b`, batched over leading axes.

The one tangent convention of the project: a tangent vector is `[rotation, translation]` (radians, metres)
and perturbs from the **right**, `a_from_b * SE3.exp(delta)`: `delta` is expressed in frame b. A covariance
of `a_from_b` is the covariance of this `delta`.

Source: Barfoot, *State Estimation for Robotics* (2017), chapter 7, with rotation and translation swapped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from rigwake._types import Array
from rigwake.geometry import so3


@dataclass(frozen=True, eq=False)
class SE3:
    """Rigid transforms `p_a = rotation @ p_b + translation`.

    rotation: (..., 3, 3) orthonormal with determinant 1; translation: (..., 3) metres, in frame a.
    `a_from_b * b_from_c` composes, `a_from_b * points_b` (an array (..., 3)) maps points.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        if rotation.shape[-2:] != (3, 3) or translation.shape != rotation.shape[:-1]:
            raise ValueError(
                "SE3 wants rotation (..., 3, 3) and translation (..., 3), "
                f"got {rotation.shape} and {translation.shape}"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls, shape: tuple[int, ...] = ()) -> SE3:
        """Identity transforms of the given batch shape."""
        return cls(np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy(), np.zeros((*shape, 3)))

    @classmethod
    def from_quat_wxyz(cls, quat_wxyz: ArrayLike, translation: ArrayLike) -> SE3:
        """From quaternions (..., 4), normalised here, and translations (..., 3)."""
        return cls(so3.matrix_from_quat_wxyz(quat_wxyz), np.asarray(translation, dtype=np.float64))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> SE3:
        """From homogeneous matrices (..., 3|4, 4); the rotation is taken as it stands."""
        m = np.asarray(matrix, dtype=np.float64)
        return cls(m[..., :3, :3], m[..., :3, 3])

    @classmethod
    def exp(cls, tangent: ArrayLike) -> SE3:
        """Exponential of tangents `[rotation, translation]`: (..., 6) -> transforms (...)."""
        xi = np.asarray(tangent, dtype=np.float64)
        phi, rho = xi[..., :3], xi[..., 3:]
        return cls(so3.exp(phi), np.einsum("...ij,...j->...i", so3.left_jacobian(phi), rho))

    def log(self) -> Array:
        """Tangents `[rotation, translation]` with `SE3.exp(x.log()) = x`: (..., 6)."""
        phi = so3.log(self.rotation)
        rho = np.einsum("...ij,...j->...i", so3.left_jacobian_inverse(phi), self.translation)
        return np.concatenate([phi, rho], axis=-1)

    @property
    def shape(self) -> tuple[int, ...]:
        """Batch shape; `()` for a single transform."""
        return self.translation.shape[:-1]

    @property
    def quat_wxyz(self) -> Array:
        """Unit quaternions, w >= 0: (..., 4)."""
        return so3.quat_wxyz_from_matrix(self.rotation)

    @property
    def matrix(self) -> Array:
        """Homogeneous matrices (..., 4, 4)."""
        m = np.zeros((*self.shape, 4, 4))
        m[..., :3, :3], m[..., :3, 3], m[..., 3, 3] = self.rotation, self.translation, 1.0
        return m

    def inverse(self) -> SE3:
        """`b_from_a` of `a_from_b`."""
        Rt = np.swapaxes(self.rotation, -1, -2)
        return SE3(Rt, -np.einsum("...ij,...j->...i", Rt, self.translation))

    @overload
    def __mul__(self, other: SE3) -> SE3: ...
    @overload
    def __mul__(self, other: Array) -> Array: ...
    def __mul__(self, other: SE3 | Array) -> SE3 | Array:
        if isinstance(other, SE3):
            rotation = self.rotation @ other.rotation
            moved = np.einsum("...ij,...j->...i", self.rotation, other.translation) + self.translation
            return SE3(rotation, moved)
        return np.asarray(np.einsum("...ij,...j->...i", self.rotation, other) + self.translation)

    def __getitem__(self, index: Any) -> SE3:
        return SE3(self.rotation[index], self.translation[index])

    def __len__(self) -> int:
        if not self.shape:
            raise TypeError("a single SE3 has no length")
        return self.shape[0]

    def retract(self, delta: ArrayLike) -> SE3:
        """`self * SE3.exp(delta)`: the perturbation every Jacobian and covariance refers to."""
        return self * SE3.exp(delta)

    def local(self, other: SE3) -> Array:
        """`delta` with `self.retract(delta) = other`: (..., 6)."""
        return (self.inverse() * other).log()

    def adjoint(self) -> Array:
        """`Ad` with `x * exp(d) = exp(Ad d) * x`: (..., 6, 6)."""
        ad = np.zeros((*self.shape, 6, 6))
        ad[..., :3, :3] = ad[..., 3:, 3:] = self.rotation
        ad[..., 3:, :3] = so3.hat(self.translation) @ self.rotation
        return ad

    def normalised(self) -> SE3:
        """The same transforms with rotations projected back onto SO(3)."""
        return SE3(so3.nearest_rotation(self.rotation), self.translation)


def stack(transforms: list[SE3] | tuple[SE3, ...]) -> SE3:
    """Transforms of equal batch shape stacked along a new first axis."""
    return SE3(np.stack([x.rotation for x in transforms]), np.stack([x.translation for x in transforms]))


def _coupling(tangent: Array) -> Array:
    """The block Q of the left Jacobian (Barfoot eq. 7.86), by its series for small angles."""
    P, r = so3.hat(tangent[..., :3]), so3.hat(tangent[..., 3:])
    t = np.linalg.norm(tangent[..., :3], axis=-1)[..., None, None]
    small = t < 5e-2
    s = np.where(small, 1.0, t)
    t2 = t * t
    c1 = np.where(small, 1 / 6 - t2 / 120 + t2**2 / 5040 - t2**3 / 362880, (s - np.sin(s)) / s**3)
    c2 = np.where(
        small, 1 / 24 - t2 / 720 + t2**2 / 40320 - t2**3 / 3628800, (s**2 / 2 + np.cos(s) - 1) / s**4
    )
    c3 = np.where(
        small,
        1 / 120 - t2 / 2520 + t2**2 / 120960 - t2**3 / 9979200,
        (2 * s + s * np.cos(s) - 3 * np.sin(s)) / (2 * s**5),
    )
    Pr, rP = P @ r, r @ P
    PrP = Pr @ P
    return np.asarray(
        0.5 * r + c1 * (Pr + rP + PrP) + c2 * (P @ Pr + rP @ P - 3 * PrP) + c3 * (PrP @ P + P @ PrP)
    )


def left_jacobian(tangent: ArrayLike) -> Array:
    """`J_l` with `exp(x + d) ~ exp(J_l d) * exp(x)`: (..., 6) -> (..., 6, 6)."""
    xi = np.asarray(tangent, dtype=np.float64)
    J = np.zeros((*xi.shape, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = so3.left_jacobian(xi[..., :3])
    J[..., 3:, :3] = _coupling(xi)
    return J


def right_jacobian(tangent: ArrayLike) -> Array:
    """`J_r` with `exp(x + d) ~ exp(x) * exp(J_r d)`: (..., 6) -> (..., 6, 6)."""
    return left_jacobian(-np.asarray(tangent, dtype=np.float64))


def right_jacobian_inverse(tangent: ArrayLike) -> Array:
    """Inverse of `J_r`, for `(x * exp(d)).log() ~ x.log() + J_r^-1 d`: (..., 6) -> (..., 6, 6)."""
    xi = -np.asarray(tangent, dtype=np.float64)
    inv = so3.left_jacobian_inverse(xi[..., :3])
    J = np.zeros((*xi.shape, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = inv
    J[..., 3:, :3] = -inv @ _coupling(xi) @ inv
    return J


def covariance_in_axes_of_a(a_from_b: SE3, covariance: Array) -> Array:
    """A right-tangent covariance of `a_from_b`, re-expressed about and along the axes of frame a.

    The result is the covariance of `[log(R_est R_true^T), t_est - t_true]`: what a person reads off as
    "rotation about, and offset along, the axes of the rig". (..., 6, 6) -> (..., 6, 6).
    """
    B = np.zeros((*a_from_b.shape, 6, 6))
    B[..., :3, :3] = B[..., 3:, 3:] = a_from_b.rotation
    return np.asarray(B @ covariance @ np.swapaxes(B, -1, -2))
