"""Reference patches: what registration needs to know of them, computed once.

With T the samples of a patch, position p and affine warp A: the derivatives of T by p and A, the six photometric
directions (gain and bias, each varying linearly over the patch) projected out of them. See `registration`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import inlined, njit
from rigwake._tables import join_rows, take_rows
from rigwake._types import Array, Floats, Mask
from rigwake.tracking.interpolation import Coefficients, sample_with_gradient
from rigwake.tracking.small_solve import cholesky_solve

PHOTOMETRIC = 6  # b, b_x, b_y, g_x, g_y, g: the gain itself comes last
UNKNOWNS = 6  # two of the position, four of the warp
ROWS = UNKNOWNS + PHOTOMETRIC


@dataclass(frozen=True, eq=False)
class PatchShape:
    """Where a patch is sampled: offsets (K, 2) in pixels and the root of each sample's weight (K,).

    lower_right, lower_left: (K,) index of the neighbouring sample, -1 where there is none.
    """

    offsets: Floats
    root_weights: Floats
    lower_right: NDArray[np.int64]
    lower_left: NDArray[np.int64]

    @classmethod
    def disc(cls, radius_px: int) -> PatchShape:
        """Every other pixel (like the black squares of a chessboard) within `radius_px`, weighted down towards
        the rim by a Gaussian of that width. A lens blurs more than that spacing; all pixels tell no more."""
        reach = np.arange(-radius_px, radius_px + 1)
        y, x = (grid.ravel() for grid in np.meshgrid(reach, reach, indexing="ij"))
        distance = np.hypot(x, y)
        kept = (distance <= radius_px + 0.5) & ((x + y) % 2 == 0)
        x, y, distance = x[kept], y[kept], distance[kept]
        weight = np.exp(-0.5 * (distance / radius_px) ** 2)
        index = {(int(i), int(j)): k for k, (i, j) in enumerate(zip(x, y, strict=True))}
        return cls(
            np.stack([x, y], axis=1).astype(np.float32),
            np.sqrt(weight / weight.mean()).astype(np.float32),
            np.array([index.get((int(i) + 1, int(j) + 1), -1) for i, j in zip(x, y, strict=True)]),
            np.array([index.get((int(i) - 1, int(j) + 1), -1) for i, j in zip(x, y, strict=True)]),
        )


@dataclass(frozen=True, eq=False)
class References:
    """Reference patches, prepared: N patches of K samples.

    pattern: (N, 12, K) per sample the weighted derivatives of T by p and A, with the photometric directions
        projected out, and then these directions (orthonormal; what T adds to the others comes last).
    information: (N, 6, 6) Gauss-Newton matrix of p and A per unit of gain and noise.
    contrast: (N,) norm of what T adds to the other photometric directions.
    bias_responses: (N, 2, 6) how far the fitted position moves by unit bends of the patch, see `registration_bias`.
    """

    pattern: Floats
    information: Array
    contrast: Array
    bias_responses: Array

    def __len__(self) -> int:
        return len(self.contrast)

    def std_per_noise(self) -> Array:
        """(N,) standard deviation of a coordinate of the position per grey level of independent noise."""
        covariance = np.linalg.inv(self.information + np.eye(UNKNOWNS) * 1e-6)
        return np.asarray(np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2))

    def take(self, index: Mask | NDArray[np.int64]) -> References:
        """The chosen patches."""
        return take_rows(self, index)

    def join(self, other: References) -> References:
        """These patches, then the other ones."""
        return join_rows([self, other])


def make_references(coefficients: Coefficients, pixels: Array, shape: PatchShape) -> tuple[References, Mask]:
    """Reference patches about pixels (N, 2), and which of them (N,) lie inside the image and have texture."""
    n, n_samples = len(pixels), len(shape.offsets)
    pattern, information = np.zeros((n, ROWS, n_samples), np.float32), np.zeros((n, UNKNOWNS, UNKNOWNS))
    made = References(pattern, information, np.zeros(n), np.zeros((n, 2, 6)))
    good, samples = np.zeros(n, np.bool_), np.zeros((UNKNOWNS + PHOTOMETRIC + 6, n_samples))
    _make_references(
        coefficients, pixels, shape.offsets, shape.root_weights, samples, np.zeros((UNKNOWNS + 1, UNKNOWNS)),
        made.pattern, made.information, made.contrast, made.bias_responses, good,
    )  # fmt: skip
    return made, good


def registration_bias(references: References, warps: Array, second_order: Array) -> Array:
    """(N, 2) how far patches are found from where they are, because their warp is bent and an affine one is fitted.

    Perspective and lens move the sample at offset x from the patch's centre by `A x + b(x)`, b quadratic with the
    second derivatives `second_order` (N, 2, 3), by xx, xy and yy. In the patch's own pixels that is `A^-1 b(x)`; with G
    the slopes of the samples by position and warp, the fit answers with `(G^T G)^-1 G^T g`, g what `A^-1 b` does
    to them. A tenth of a pixel between cameras that look 90 degrees apart, in the same sense for all of them.
    """
    in_patch = np.linalg.solve(warps, second_order).reshape(-1, 6, 1)
    return np.asarray((warps @ references.bias_responses @ in_patch)[:, :, 0])


@njit(nogil=True, error_model="numpy")
def _make_references(  # type: ignore[no-untyped-def]
    coefficients, pixels, offsets, root_weights, samples, equations, pattern, information, contrast, bias_responses,
    good,
):  # fmt: skip
    """Fills the arrays from `pattern` on, which are zero; `samples` and `equations` are room to work in."""
    n_patches, n_samples = len(pixels), len(offsets)
    height, width = coefficients.shape
    slopes, basis = samples[:UNKNOWNS], samples[UNKNOWNS : UNKNOWNS + PHOTOMETRIC]
    bent, factor, answer = samples[UNKNOWNS + PHOTOMETRIC :], equations[:UNKNOWNS], equations[UNKNOWNS]
    reach = offsets[-1, 1]  # the last sample is the lowest one of a disc
    for n in range(n_patches):
        px, py = pixels[n, 0], pixels[n, 1]
        if not (px - reach >= 1 and py - reach >= 1 and px + reach < width - 2 and py + reach < height - 2):
            continue
        for k in range(n_samples):
            x, y, w = offsets[k, 0], offsets[k, 1], root_weights[k]
            value, by_x, by_y = sample_with_gradient(coefficients, px + x, py + y)
            basis[0, k], basis[1, k], basis[2, k] = w, w * x, w * y
            basis[3, k], basis[4, k], basis[5, k] = w * value * x, w * value * y, w * value
            slopes[0, k], slopes[1, k] = w * by_x, w * by_y
            slopes[2, k], slopes[3, k] = w * by_x * x, w * by_x * y
            slopes[4, k], slopes[5, k] = w * by_y * x, w * by_y * y
        _second_order_slopes(slopes, offsets, bent)
        contrast[n] = _orthonormalise(basis)
        if contrast[n] < 1.0:
            continue
        good[n] = True
        for i in range(UNKNOWNS):
            for j in range(PHOTOMETRIC):
                _project_out(slopes[i], basis[j])
        for i in range(UNKNOWNS):
            for j in range(UNKNOWNS):
                information[n, i, j] = _dot(slopes[i], slopes[j])
        _bias_response(information[n], slopes, bent, factor, answer, bias_responses[n])
        for k in range(n_samples):
            for i in range(ROWS):
                pattern[n, i, k] = slopes[i, k] if i < UNKNOWNS else basis[i - UNKNOWNS, k]


@inlined
def _second_order_slopes(slopes: Array, offsets: Floats, bent: Array) -> None:
    """Into `bent` (6, K): the samples' derivatives by second derivatives of x and of y by xx, xy and yy."""
    for k in range(len(offsets)):
        x, y = offsets[k, 0], offsets[k, 1]
        for i in range(2):
            bent[3 * i, k] = slopes[i, k] * x * x / 2
            bent[3 * i + 1, k] = slopes[i, k] * x * y
            bent[3 * i + 2, k] = slopes[i, k] * y * y / 2


@inlined
def _bias_response(
    information: Array, slopes: Array, bent: Array, factor: Array, answer: Array, bias_response: Array
) -> None:
    """Into `bias_response` (2, 6): the position fitted to what each of the bends does to the samples."""
    ridge = 0.0
    for i in range(UNKNOWNS):
        ridge += 1e-9 * information[i, i]
    for c in range(6):
        for i in range(UNKNOWNS):
            answer[i] = _dot(slopes[i], bent[c])
            for j in range(UNKNOWNS):
                factor[i, j] = information[i, j]
            factor[i, i] += ridge
        if cholesky_solve(factor, answer):
            bias_response[0, c], bias_response[1, c] = answer[0], answer[1]


@inlined
def _orthonormalise(basis: Array) -> float:
    """Gram-Schmidt in place; the norm of the last row before it was scaled, 0 if any row depends on others."""
    norm = 0.0
    for a in range(len(basis)):
        before = sqrt(_dot(basis[a], basis[a]))
        for _ in range(2):  # twice is enough (Kahan)
            for b in range(a):
                _project_out(basis[a], basis[b])
        norm = sqrt(_dot(basis[a], basis[a]))
        if norm <= 1e-6 * before or norm == 0.0:
            return 0.0
        for k in range(basis.shape[1]):
            basis[a, k] /= norm
    return norm


# as loops: operations on whole arrays take numba ten times as long to compile
@inlined
def _dot(a: Array, b: Array) -> float:
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@inlined
def _project_out(a: Array, unit: Array) -> None:
    """Take the part along a unit vector off, in place."""
    along = _dot(a, unit)
    for k in range(len(a)):
        a[k] -= along * unit[k]
