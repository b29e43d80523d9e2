"""One random sea, seen by the eye as animated height-field tiles and felt by the boat as a sum of waves.

Linear deep-water waves: `eta(x, t) = Re sum_j a_j exp(i (k_j . x - w_j t))`, `w^2 = g |k|`, where the `k_j` lie
on the grids of three periodic tiles (256, 37 and 5.3 m) that share out the wave numbers among themselves.
Amplitudes are Gaussian with variance `2 S(k) dk`; S is JONSWAP (Hasselmann et al. 1973) scaled to Hs, spread by
`cos^2s`. Source of the method: Tessendorf, *Simulating Ocean Water* (2001).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array
from rigwake.simulation.scenario import Sea

GRAVITY = 9.81
TILE_LENGTHS_M = (256.0, 37.3, 5.17)
TILE_CELLS = 256
_SHORTEST_M = 0.045


@dataclass(frozen=True, eq=False)
class WaveTile:
    """One periodic tile: length in metres, wave vectors and complex amplitudes on the FFT grid (n, n)."""

    length_m: float
    kx: Array
    ky: Array
    omega: Array
    amplitude: NDArray[np.complex128]

    @cached_property
    def _there_and_back(self) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """What turns with `exp(-i w t)` and with `exp(i w t)` in the spectrum of the (real) height, half plane."""
        half = self.amplitude.shape[1] // 2 + 1
        opposite = np.roll(self.amplitude[::-1, ::-1], 1, axis=(0, 1)).conj()
        return self.amplitude[:, :half] / 2, opposite[:, :half] / 2

    def surface(self, time_s: float) -> NDArray[np.float32]:
        """(n, n, 3): height, slope by x and slope by y; row = y, column = x, cell (0, 0) at the origin."""
        there, back = self._there_and_back
        half = there.shape[1]
        turned = np.exp(-1j * self.omega[:, :half] * time_s)
        spectrum = there * turned + back * turned.conj()
        stacked = np.stack([spectrum, 1j * self.kx[:, :half] * spectrum, 1j * self.ky[:, :half] * spectrum])
        fields = scipy.fft.irfft2(stacked.astype(np.complex64), s=self.amplitude.shape, norm="forward")
        return np.ascontiguousarray(np.moveaxis(fields, 0, -1), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class WaveField:
    """The sea: its tiles, from long to short waves."""

    tiles: tuple[WaveTile, ...]

    def components(self) -> tuple[Array, Array, NDArray[np.complex128]]:
        """Wave vectors (J, 2), angular frequencies (J,) and complex amplitudes (J,) of all tiles."""
        k = np.concatenate([np.stack([t.kx, t.ky], -1).reshape(-1, 2) for t in self.tiles])
        omega = np.concatenate([t.omega.ravel() for t in self.tiles])
        amplitude = np.concatenate([t.amplitude.ravel() for t in self.tiles])
        waves = amplitude != 0
        return k[waves], omega[waves], amplitude[waves]


def build_wave_field(sea: Sea, seed: int) -> WaveField:
    """Draw one sea. Its significant height is Hs in the mean over seeds."""
    rng = np.random.default_rng([seed, 101])
    bands = _bands()
    grids = [_grid(length) for length in TILE_LENGTHS_M]
    spectra = []
    for length, (kx, ky), (low, high) in zip(TILE_LENGTHS_M, grids, bands, strict=True):
        k = np.hypot(kx, ky)
        inside = (k >= low) & (k < high)
        variance = np.zeros_like(k)
        variance[inside] = directional_spectrum(kx[inside], ky[inside], sea) * (2 * np.pi / length) ** 2
        spectra.append(variance)
    total = sum(float(v.sum()) for v in spectra)
    scale = (sea.hs_m / 4) ** 2 / total if total > 0 else 0.0
    tiles = []
    for length, (kx, ky), variance in zip(TILE_LENGTHS_M, grids, spectra, strict=True):
        gauss = rng.standard_normal((2, *kx.shape))
        amplitude = np.sqrt(scale * variance) * (gauss[0] + 1j * gauss[1])
        tiles.append(WaveTile(length, kx, ky, np.sqrt(GRAVITY * np.hypot(kx, ky)), amplitude))
    return WaveField(tuple(tiles))


def directional_spectrum(kx: Array, ky: Array, sea: Sea) -> Array:
    """JONSWAP variance density over the wave-number plane, unscaled: (N,) for wave vectors (N,), k > 0.

    `S(w) w^-5 exp(-1.25 (wp/w)^4) gamma^r`, turned into wave numbers by `dw/dk / k`, times `cos^2s(theta)` over
    the half plane of the wave direction.
    """
    k = np.hypot(kx, ky)
    omega = np.sqrt(GRAVITY * k)
    peak = 2 * np.pi / sea.tp_s
    width = np.where(omega <= peak, 0.07, 0.09)
    enhancement = sea.gamma ** np.exp(-0.5 * ((omega - peak) / (width * peak)) ** 2)
    by_frequency = omega**-5.0 * np.exp(-1.25 * (peak / omega) ** 4) * enhancement
    direction = np.deg2rad(sea.direction_deg)
    along = (kx * np.cos(direction) + ky * np.sin(direction)) / k
    # short waves forget the wind: their spreading widens with frequency (Mitsuyasu 1975)
    exponent = np.maximum(sea.spreading * np.minimum(1, (peak / omega) ** 1.2), 0.8)
    spreading = np.where(along > 0, np.abs(along) ** (2 * exponent), 0) * np.sqrt(exponent)
    return np.asarray(by_frequency * spreading * omega / (2 * k) / k)


def _grid(length_m: float) -> tuple[Array, Array]:
    k = 2 * np.pi * np.fft.fftfreq(TILE_CELLS, length_m / TILE_CELLS)
    kx, ky = np.meshgrid(k, k)
    return kx, ky


def _bands() -> list[tuple[float, float]]:
    """Wave-number limits of the tiles: each hands over to the next where that one holds 6 waves across."""
    edges = [2 * np.pi / length * (1 if i == 0 else 6) for i, length in enumerate(TILE_LENGTHS_M)]
    edges[0] *= 0.5
    return list(zip(edges, [*edges[1:], 2 * np.pi / _SHORTEST_M], strict=True))


@dataclass(frozen=True, eq=False)
class SelfMaskResponse:
    """How a hull of this waterline rides the waves.

    The waterplane rectangle averages the surface (a raft fits it by least squares: short waves cancel), and
    heave, roll and pitch follow as damped oscillators with natural period `period_s` and damping ratio.
    """

    length_m: float
    beam_m: float
    period_s: tuple[float, float, float]  # heave, roll, pitch
    damping: tuple[float, float, float]


def raft_motion(field: WaveField, hull: SelfMaskResponse, times_s: Array, planar: Array) -> Array:
    """Least-squares plane of the sea under a rectangle: (N, 3) heave (m), roll, pitch (rad) in hull axes.

    planar: (N, 3) east, north, yaw of the hull at `times_s`. For one wave the fit is closed:
    heave `sinc(kx l) sinc(ky b)`, slope along x `(3/l) j1(kx l) sinc(ky b)` (l, b: half sizes, j1 spherical Bessel).
    """
    k, omega, amplitude = field.components()
    half_l, half_b = hull.length_m / 2, hull.beam_m / 2
    wavenumber = np.linalg.norm(k, axis=1)
    # what the smaller half size averages away cannot be felt: keep what carries all but 1e-3 of the slope
    coupling = np.abs(amplitude) * wavenumber * np.minimum(1, (wavenumber * half_b) ** -2.0)
    order = np.argsort(coupling)[::-1]
    power = np.cumsum(coupling[order] ** 2)
    if not len(power) or power[-1] == 0:
        return np.zeros((len(times_s), 3))
    kept = order[: int(np.searchsorted(power, power[-1] * (1 - 1e-3))) + 1][:1500]
    k, omega, amplitude = k[kept], omega[kept], amplitude[kept]
    result = np.empty((len(times_s), 3))
    _sum_raft(k, omega, amplitude, half_l, half_b, times_s, planar, result)
    return result


@njit()
def _sinc_and_j1(x: float) -> tuple[float, float]:
    """`sin(x) / x` and the spherical Bessel function j1 (`sin(x)/x^2 - cos(x)/x`)."""
    if abs(x) < 1e-2:
        return 1 - x * x / 6, x / 3 - x**3 / 30
    sinc = math.sin(x) / x
    return sinc, (sinc - math.cos(x)) / x


@njit()
def _sum_raft(
    k: Array,
    omega: Array,
    amplitude: NDArray[np.complex128],
    half_l: float,
    half_b: float,
    times_s: Array,
    planar: Array,
    result: Array,
) -> None:
    for n in range(len(times_s)):
        east, north, yaw = planar[n]
        c, s = math.cos(yaw), math.sin(yaw)
        heave = slope_x = slope_y = 0.0
        for j in range(len(omega)):
            phase = east * k[j, 0] + north * k[j, 1] - times_s[n] * omega[j]
            cp, sp = math.cos(phase), math.sin(phase)
            real = amplitude[j].real * cp - amplitude[j].imag * sp
            imag = amplitude[j].real * sp + amplitude[j].imag * cp
            sinc_l, bessel_l = _sinc_and_j1((c * k[j, 0] + s * k[j, 1]) * half_l)
            sinc_b, bessel_b = _sinc_and_j1((c * k[j, 1] - s * k[j, 0]) * half_b)
            heave += sinc_l * sinc_b * real
            slope_x -= bessel_l * sinc_b * imag
            slope_y -= bessel_b * sinc_l * imag
        result[n, 0] = heave
        # the bow rises (negative rotation about y) where the surface rises forward; port rises: positive roll
        result[n, 1] = slope_y * 3 / half_b
        result[n, 2] = -slope_x * 3 / half_l
