"""Sub-pixel registration of image patches against reference patches.

A reference patch T is seen again in an image I as

    I(p + A x) = T(x) (g + g_x x + g_y y) + b + b_x x + b_y y + noise,   x in the patch,

with position p, affine warp A, and a gain and a bias that may each vary linearly over the patch: vignetting,
exposure and haze do that, and a plain gain is not enough beside a bright sky. p and A are found by Gauss-Newton
with inverse composition (Baker and Matthews, *Lucas-Kanade 20 years on*, IJCV 56, 2004): all derivatives are
those of T, computed once, with the six photometric directions projected out. A Gaussian prior ties A to a
predicted warp, so that patches which do not show their own deformation follow the geometry.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import sqrt

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from rigwake.cameras.base import Mask
from rigwake.geometry.so3 import Array
from rigwake.threads import over_ranges, ranges
from rigwake.tracking.interpolation import Coefficients, sample, sample_with_gradient
from rigwake.tracking.klt import SUMS_IN_ANY_ORDER
from rigwake.tracking.small_solve import cholesky_solve, position_spread

Floats = NDArray[np.float32]

_PHOTOMETRIC = 6  # b, b_x, b_y, g_x, g_y, g: the gain itself comes last
_UNKNOWNS = 6  # two of the position, four of the warp
_ROWS = _UNKNOWNS + _PHOTOMETRIC
_MIN_GAIN = 0.05  # a patch with less of its first contrast has gone dark
_MIN_VARIANCE = 0.25  # grey levels^2: rounding to whole grey levels alone leaves 1/12 in each image
_LEAST_PATCHES = 50  # that are worth a thread
_CONVERGED_PX = 0.015  # a step leaves about a fifth of the error: what remains is far below the noise


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
    pulls: (N, 2, 6) how far the fitted position moves by unit bends of the patch, see `drawn_by_bend`.
    """

    pattern: Floats
    information: Array
    contrast: Array
    pulls: Array

    def __len__(self) -> int:
        return len(self.contrast)

    def std_per_noise(self) -> Array:
        """(N,) standard deviation of a coordinate of the position per grey level of independent noise."""
        covariance = np.linalg.inv(self.information + np.eye(_UNKNOWNS) * 1e-6)
        return np.asarray(np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2))

    def take(self, index: Mask) -> References:
        """The chosen patches."""
        return References(*(getattr(self, f.name)[index] for f in fields(self)))

    def join(self, other: References) -> References:
        """These patches, then the other ones."""
        return References(
            *(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self))
        )


@dataclass(frozen=True, eq=False)
class Registration:
    """Where reference patches were found again.

    pixels: (N, 2). warps: (N, 2, 2) `A`. found: (N,) False where a patch left the image or diverged.
    correlation: (N,) of the patch with its reference, 1 where they agree but for gain and bias.
    std_px: (N,) predicted standard deviation of a coordinate, from the residuals, how they are correlated
    between neighbouring samples, and the texture. noise: (N,) RMS of the residuals, grey levels.
    """

    pixels: Array
    warps: Array
    found: Mask
    correlation: Array
    std_px: Array
    noise: Array


def make_references(coefficients: Coefficients, pixels: Array, shape: PatchShape) -> tuple[References, Mask]:
    """Reference patches about pixels (N, 2), and which of them (N,) lie inside the image and have texture."""
    made = _make_references(coefficients, pixels, shape.offsets, shape.root_weights)
    return References(*made[:4]), made[4]


def register(
    coefficients: Coefficients,
    references: References,
    shape: PatchShape,
    pixels: Array,
    predicted_warps: Array,
    *,
    warp_prior_std: float,
    max_shift_px: float = 3.0,
    iterations: int = 8,
) -> Registration:
    """Find reference patches in an image, starting at `pixels` (N, 2) and `predicted_warps` (N, 2, 2).

    warp_prior_std: how far each entry of the warp may stray from the prediction, in px per px.
    max_shift_px: a patch that moves further from its start has diverged.
    """
    n = len(references)
    pixels = np.ascontiguousarray(pixels, dtype=np.float64).copy()
    warps = np.ascontiguousarray(predicted_warps, dtype=np.float64).copy()
    found, lag_sums = np.zeros(n, np.bool_), np.zeros((n, 3))
    correlation, variance, spread = np.zeros(n), np.zeros(n), np.zeros(n)

    def work(first: int, last: int) -> None:
        _register(
            first, last, coefficients, references.pattern, references.information, references.contrast,
            shape.offsets, shape.root_weights, shape.lower_right, shape.lower_left, 1.0 / warp_prior_std**2,
            max_shift_px, iterations, pixels, warps, found, correlation, variance, spread, lag_sums,
        )  # fmt: skip

    over_ranges(ranges(np.ones(n), _LEAST_PATCHES), work)
    std_px = np.sqrt(spread * variance * _noise_bandwidth(lag_sums[found]))
    return Registration(pixels, warps, found, correlation, std_px, np.sqrt(variance))


def drawn_by_bend(references: References, warps: Array, bends: Array) -> Array:
    """(N, 2) how far patches are found from where they are, because their warp is bent and an affine one is fitted.

    Perspective and lens move the sample at offset x from the patch's centre by `A x + b(x)`, b quadratic with the
    second derivatives `bends` (N, 2, 3), by xx, xy and yy. In the patch's own pixels that is `A^-1 b(x)`; with G
    the slopes of the samples by position and warp, the fit answers with `(G^T G)^-1 G^T g`, g what `A^-1 b` does
    to them. A tenth of a pixel between cameras that look 90 degrees apart, in the same sense for all of them.
    """
    in_patch = np.linalg.solve(warps, bends).reshape(-1, 6, 1)
    return np.asarray((warps @ references.pulls @ in_patch)[:, :, 0])


def _noise_bandwidth(lag_sums: Array) -> float:
    """How much more a smooth pattern suffers from the residuals than if neighbours were independent.

    lag_sums: (N, 3) sums of squared residuals and of products with two neighbours. For a
    separable first-order process with neighbour correlation r per axis the factor is (1 + r) / (1 - r) each.
    """
    power, across, down = lag_sums.sum(axis=0)
    if power <= 0:
        return 1.0
    rho = np.clip(np.array([across, down]) / power, 0.0, 0.9)
    return float(np.prod((1 + rho) / (1 - rho)))


@njit(cache=True, nogil=True)
def _make_references(
    coefficients: Coefficients, pixels: Array, offsets: Floats, root_weights: Floats
) -> tuple[Floats, Array, Array, Array, Mask]:
    n_patches, n_samples = len(pixels), len(offsets)
    height, width = coefficients.shape
    pattern = np.zeros((n_patches, _ROWS, n_samples), np.float32)
    information = np.zeros((n_patches, _UNKNOWNS, _UNKNOWNS))
    contrast = np.zeros(n_patches)
    pulls = np.zeros((n_patches, 2, 6))
    good = np.zeros(n_patches, np.bool_)
    slopes, basis = np.zeros((_UNKNOWNS, n_samples)), np.zeros((_PHOTOMETRIC, n_samples))
    bent = np.zeros((6, n_samples))
    reach = np.abs(offsets).max()
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
        _bend_slopes(slopes, offsets, bent)
        contrast[n] = _orthonormalise(basis)
        if contrast[n] < 1.0:
            continue
        good[n] = True
        for i in range(_UNKNOWNS):
            for j in range(_PHOTOMETRIC):
                slopes[i] -= np.dot(slopes[i], basis[j]) * basis[j]
        information[n] = slopes @ slopes.T
        ridge = 1e-9 * np.trace(information[n]) * np.eye(_UNKNOWNS)
        pulls[n] = np.linalg.solve(information[n] + ridge, slopes @ bent.T)[:2]
        pattern[n, :_UNKNOWNS] = slopes
        pattern[n, _UNKNOWNS:] = basis
    return pattern, information, contrast, pulls, good


@register_jitable
def _bend_slopes(slopes: Array, offsets: Floats, bent: Array) -> None:
    """Into `bent` (6, K): the samples' derivatives by second derivatives of x and of y by xx, xy and yy."""
    for k in range(len(offsets)):
        x, y = offsets[k, 0], offsets[k, 1]
        for i in range(2):
            bent[3 * i, k] = slopes[i, k] * x * x / 2
            bent[3 * i + 1, k] = slopes[i, k] * x * y
            bent[3 * i + 2, k] = slopes[i, k] * y * y / 2


@register_jitable
def _orthonormalise(basis: Array) -> float:
    """Gram-Schmidt in place; the norm of the last row before it was scaled, 0 if any row depends on others."""
    norm = 0.0
    for a in range(len(basis)):
        before = sqrt(np.dot(basis[a], basis[a]))
        for _ in range(2):  # twice is enough (Kahan)
            for b in range(a):
                basis[a] -= np.dot(basis[a], basis[b]) * basis[b]
        norm = sqrt(np.dot(basis[a], basis[a]))
        if norm <= 1e-6 * before or norm == 0.0:
            return 0.0
        basis[a] /= norm
    return norm


# what it calls is inlined for the reason given in `klt.py`
@njit(cache=True, nogil=True, fastmath=SUMS_IN_ANY_ORDER)
def _register(  # type: ignore[no-untyped-def]
    first, last, coefficients, pattern, information, contrast, offsets, root_weights, lower_right, lower_left,
    warp_precision, max_shift_px, iterations, pixels, warps, found, correlation, variance, spread, lag_sums,
):  # fmt: skip
    """Moves `pixels` and `warps` of a range of patches; the arrays after them, which are zero, are filled."""
    n_samples = pattern.shape[2]
    freedom = n_samples - _PHOTOMETRIC - 2
    values, sums = np.empty(n_samples, np.float32), np.empty(_ROWS, np.float32)
    matrix, step = np.empty((_UNKNOWNS, _UNKNOWNS)), np.empty(_UNKNOWNS)
    for n in range(first, last):
        start_x, start_y = pixels[n, 0], pixels[n, 1]
        prediction_from_patch = _inverse(warps[n])
        for _ in range(iterations):
            power = _correlate(
                coefficients, pattern[n], offsets, root_weights, pixels[n], warps[n], values, sums
            )
            gain = sums[_ROWS - 1] / contrast[n]
            if power < 0 or gain < _MIN_GAIN:
                break
            variance[n] = max(power / freedom, _MIN_VARIANCE)
            correlation[n] = sums[_ROWS - 1] / sqrt(sums[_ROWS - 1] ** 2 + power)
            if found[n]:  # converged in the step before: these are the final residuals
                spread[n] = position_spread(matrix)
                _neighbour_products(values, pattern[n], sums, lower_right, lower_left, lag_sums[n])
                break
            strayed = _product(prediction_from_patch, warps[n])
            _normal_equations(gain, information[n], sums, warp_precision * variance[n], strayed, matrix, step)
            moved = _step(matrix, step, pixels[n], warps[n])
            shift = max(abs(pixels[n, 0] - start_x), abs(pixels[n, 1] - start_y))
            if moved < 0 or shift > max_shift_px:
                break
            found[n] = moved < _CONVERGED_PX
        found[n] = found[n] and spread[n] > 0


@register_jitable(inline="always")
def _correlate(
    coefficients: Coefficients,
    pattern: Floats,
    offsets: Floats,
    root_weights: Floats,
    pixel: Array,
    warp: Array,
    values: Floats,
    sums: Floats,
) -> float:
    """Sample a warped patch into `values` and its products with the pattern into `sums`; returns the power that
    the photometric directions do not explain, negative if the patch leaves the image."""
    height, width = coefficients.shape
    x0, y0 = np.float32(pixel[0]), np.float32(pixel[1])
    a, b = np.float32(warp[0, 0]), np.float32(warp[0, 1])
    c, d = np.float32(warp[1, 0]), np.float32(warp[1, 1])
    reach = offsets[-1, 1]  # the last sample is the lowest one of a disc
    across, down = (abs(a) + abs(b)) * reach, (abs(c) + abs(d)) * reach
    if not (x0 - across >= 1 and y0 - down >= 1 and x0 + across < width - 2 and y0 + down < height - 2):
        return -1.0
    level = sample(coefficients, x0, y0)  # any constant would do: it keeps float32 sums exact
    power = np.float32(0.0)
    for k in range(len(offsets)):
        x = x0 + a * offsets[k, 0] + b * offsets[k, 1]
        y = y0 + c * offsets[k, 0] + d * offsets[k, 1]
        values[k] = root_weights[k] * (sample(coefficients, x, y) - level)
        power += values[k] * values[k]
    for i in range(_ROWS):
        total = np.float32(0.0)
        for k in range(len(values)):
            total += values[k] * pattern[i, k]
        sums[i] = total
        if i >= _UNKNOWNS:
            power -= total * total
    return max(float(power), 0.0)


@register_jitable(inline="always")
def _normal_equations(
    gain: float, information: Array, sums: Floats, weight: float, strayed: Array, matrix: Array, step: Array
) -> None:
    """Gauss-Newton on the patch plus the prior `strayed = 1` of the given weight."""
    for i in range(_UNKNOWNS):
        step[i] = gain * sums[i]
        for j in range(_UNKNOWNS):
            matrix[i, j] = gain * gain * information[i, j]
    for i in range(4):
        matrix[2 + i, 2 + i] += weight
        step[2 + i] += weight * (strayed[i // 2, i % 2] - (1.0 if i in (0, 3) else 0.0))


@register_jitable(inline="always")
def _inverse(a: Array) -> Array:
    """Of a 2x2 matrix: for so few numbers a call of LAPACK costs more than the work."""
    determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    return np.array([[a[1, 1], -a[0, 1]], [-a[1, 0], a[0, 0]]]) / determinant


@register_jitable(inline="always")
def _product(a: Array, b: Array) -> Array:
    """Of two 2x2 matrices."""
    out = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j]
    return out


@register_jitable(inline="always")
def _step(matrix: Array, step: Array, pixel: Array, warp: Array) -> float:
    """Solve for the template's increment and compose its inverse with the warp (in place); pixels moved,
    negative if it cannot be done. `matrix` is left as its Cholesky factor."""
    if not cholesky_solve(matrix, step):
        return -1.0
    increment = np.array([[1.0 + step[2], step[3]], [step[4], 1.0 + step[5]]])
    determinant = increment[0, 0] * increment[1, 1] - increment[0, 1] * increment[1, 0]
    if not 0.2 < determinant < 5.0:
        return -1.0
    warp[:] = _product(warp, _inverse(increment))
    dx = warp[0, 0] * step[0] + warp[0, 1] * step[1]
    dy = warp[1, 0] * step[0] + warp[1, 1] * step[1]
    pixel[0] -= dx
    pixel[1] -= dy
    return sqrt(dx * dx + dy * dy)


@register_jitable(inline="always")
def _neighbour_products(
    values: Floats,
    pattern: Floats,
    sums: Floats,
    lower_right: NDArray[np.int64],
    lower_left: NDArray[np.int64],
    lag_sums: Array,
) -> None:
    """Turn `values` into residuals; their squares and products with neighbours are summed up."""
    for k in range(len(values)):
        for i in range(_UNKNOWNS, _ROWS):
            values[k] -= sums[i] * pattern[i, k]
    for k in range(len(values)):
        lag_sums[0] += values[k] * values[k]
        if lower_right[k] >= 0:
            lag_sums[1] += values[k] * values[lower_right[k]]
        if lower_left[k] >= 0:
            lag_sums[2] += values[k] * values[lower_left[k]]
