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

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import inlined, njit
from rigwake._types import Array, Floats, Mask
from rigwake.parallel import over_ranges, ranges
from rigwake.tracking.interpolation import Coefficients, sample
from rigwake.tracking.klt import SUMS_IN_ANY_ORDER
from rigwake.tracking.references import PHOTOMETRIC, ROWS, UNKNOWNS, PatchShape, References
from rigwake.tracking.small_solve import cholesky_solve, position_spread

Entries = tuple[float, float, float, float]
"""Of a 2x2 matrix, row by row."""

_MIN_GAIN = 0.05  # a patch with less of its first contrast has gone dark
_MIN_VARIANCE = 0.25  # grey levels^2: rounding to whole grey levels alone leaves 1/12 in each image
_LEAST_PATCHES = 50  # that are worth a thread
_CONVERGED_PX = 0.015  # a step leaves about a fifth of the error: what remains is far below the noise


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


def register(
    coefficients: Coefficients,
    references: References,
    shape: PatchShape,
    pixels: Array,
    predicted_warps: Array,
    *,
    warp_prior_std: float,
    noise_variance: float = np.inf,
    max_shift_px: float = 3.0,
    iterations: int = 8,
) -> Registration:
    """Find reference patches in an image, starting at `pixels` (N, 2) and `predicted_warps` (N, 2, 2).

    warp_prior_std: how far each entry of the warp may stray from the prediction, in px per px.
    noise_variance: of residuals, grey levels^2, beyond which they are taken for misfit and not for noise: a patch
        that does not fit yet must not lean on its prediction for that.
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
            noise_variance, max_shift_px, iterations, pixels, warps, found, correlation, variance, spread, lag_sums,
        )  # fmt: skip

    over_ranges(ranges(np.ones(n), _LEAST_PATCHES), work)
    std_px = np.sqrt(spread * variance * _noise_bandwidth(lag_sums[found]))
    return Registration(pixels, warps, found, correlation, std_px, np.sqrt(variance))


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


# what it calls is inlined for the reason given in `_kernels.py`
@njit(nogil=True, fastmath=SUMS_IN_ANY_ORDER, error_model="numpy")
def _register(  # type: ignore[no-untyped-def]
    first, last, coefficients, pattern, information, contrast, offsets, root_weights, lower_right, lower_left,
    warp_precision, noise_variance, max_shift_px, iterations, pixels, warps, found, correlation, variance, spread,
    lag_sums,
):  # fmt: skip
    """Moves `pixels` and `warps` of a range of patches; the arrays after them, which are zero, are filled."""
    n_samples = pattern.shape[2]
    freedom = n_samples - PHOTOMETRIC - 2
    values, sums = np.empty(n_samples, np.float32), np.empty(ROWS, np.float32)
    matrix, step = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    for n in range(first, last):
        start_x, start_y = pixels[n, 0], pixels[n, 1]
        prediction_from_patch = _inverse(_entries(warps[n]))
        for _ in range(iterations):
            power = _correlate(
                coefficients, pattern[n], offsets, root_weights, pixels[n], warps[n], values, sums
            )
            gain = sums[ROWS - 1] / contrast[n]
            if power < 0 or gain < _MIN_GAIN:
                break
            variance[n] = max(power / freedom, _MIN_VARIANCE)
            correlation[n] = sums[ROWS - 1] / sqrt(sums[ROWS - 1] ** 2 + power)
            if found[n]:  # converged in the step before: these are the final residuals
                spread[n] = position_spread(matrix)
                _neighbour_products(values, pattern[n], sums, lower_right, lower_left, lag_sums[n])
                break
            strayed = _product(prediction_from_patch, _entries(warps[n]))
            weight = warp_precision * min(variance[n], noise_variance)
            _normal_equations(gain, information[n], sums, weight, strayed, matrix, step)
            moved = _step(matrix, step, pixels[n], warps[n])
            shift = max(abs(pixels[n, 0] - start_x), abs(pixels[n, 1] - start_y))
            if moved < 0 or shift > max_shift_px:
                break
            found[n] = moved < _CONVERGED_PX
        found[n] = found[n] and spread[n] > 0


@inlined
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
    level = coefficients[int(y0), int(x0)]  # any constant would do: it keeps float32 sums exact
    power = np.float32(0.0)
    for k in range(len(offsets)):
        x = x0 + a * offsets[k, 0] + b * offsets[k, 1]
        y = y0 + c * offsets[k, 0] + d * offsets[k, 1]
        values[k] = root_weights[k] * (sample(coefficients, x, y) - level)
        power += values[k] * values[k]
    for i in range(ROWS):
        total = np.float32(0.0)
        for k in range(len(values)):
            total += values[k] * pattern[i, k]
        sums[i] = total
        if i >= UNKNOWNS:
            power -= total * total
    return max(float(power), 0.0)


@inlined
def _normal_equations(
    gain: float, information: Array, sums: Floats, weight: float, strayed: Entries, matrix: Array, step: Array
) -> None:
    """Gauss-Newton on the patch plus the prior `strayed = 1` of the given weight."""
    for i in range(UNKNOWNS):
        step[i] = gain * sums[i]
        for j in range(UNKNOWNS):
            matrix[i, j] = gain * gain * information[i, j]
    for i in range(4):
        matrix[2 + i, 2 + i] += weight
        step[2 + i] += weight * (strayed[i] - (1.0 if i in (0, 3) else 0.0))


@inlined
def _entries(a: Array) -> Entries:
    """Of a 2x2 matrix, row by row: as numbers, not arrays, small products compile and run sooner."""
    return a[0, 0], a[0, 1], a[1, 0], a[1, 1]


@inlined
def _inverse(a: Entries) -> Entries:
    determinant = a[0] * a[3] - a[1] * a[2]
    return a[3] / determinant, -a[1] / determinant, -a[2] / determinant, a[0] / determinant


@inlined
def _product(a: Entries, b: Entries) -> Entries:
    return (
        a[0] * b[0] + a[1] * b[2],
        a[0] * b[1] + a[1] * b[3],
        a[2] * b[0] + a[3] * b[2],
        a[2] * b[1] + a[3] * b[3],
    )


@inlined
def _step(matrix: Array, step: Array, pixel: Array, warp: Array) -> float:
    """Solve for the template's increment and compose its inverse with the warp (in place); pixels moved,
    negative if it cannot be done. `matrix` is left as its Cholesky factor."""
    if not cholesky_solve(matrix, step):
        return -1.0
    a, b, c, d = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    if not 0.2 < a * d - b * c < 5.0:
        return -1.0
    composed = _product(_entries(warp), _inverse((a, b, c, d)))
    for i in range(4):
        warp[i // 2, i % 2] = composed[i]
    dx, dy = composed[0] * step[0] + composed[1] * step[1], composed[2] * step[0] + composed[3] * step[1]
    pixel[0] -= dx
    pixel[1] -= dy
    return sqrt(dx * dx + dy * dy)


@inlined
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
        for i in range(UNKNOWNS, ROWS):
            values[k] -= sums[i] * pattern[i, k]
    for k in range(len(values)):
        lag_sums[0] += values[k] * values[k]
        if lower_right[k] >= 0:
            lag_sums[1] += values[k] * values[lower_right[k]]
        if lower_left[k] >= 0:
            lag_sums[2] += values[k] * values[lower_left[k]]
