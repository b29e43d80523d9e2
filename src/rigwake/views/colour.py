"""Gains per camera and channel, and one vignetting curve, from what two cameras see of the same far things.

Where cameras a and b see the same thing, `I_a = L v(s_a) / g_a` and `I_b = L v(s_b) / g_b`, with the radiance L, the
vignetting `v(s) = exp(k1 s + k2 s^2 + k3 s^3)` at the squared relative angle s off the axis, and the gains g that undo
differences of exposure. The logarithm of the ratio is linear in `log g` and k. Only what is above the horizon is used:
water mirrors different things to different cameras. The gauge: gains have the geometric mean 1 in every channel.
Source: Goldman and Chen, *Vignette and Exposure Calibration and Compensation*, ICCV 2005.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._tables import join_rows
from rigwake._types import Array, Floats, Image
from rigwake.views.attitude import LevelAttitude
from rigwake.views.strips import StripGrid, camera_strips
from rigwake.views.surface import Shell
from rigwake.views.surround_rig import SurroundRig

VIGNETTING_TERMS = 3
_GRID = StripGrid(step_deg=1.5, top_deg=60.0, rows=39)  # ends just above the horizon
_FAR_M = 60.0
_DARKEST, _BRIGHTEST = 12, 240  # grey levels: beyond, a sensor is not linear
_RIM = 0.95  # of the lens's half field: beyond, the smoothing reaches over its edge
_LOUD = 0.1  # residuals (log) beyond this count less and less: parallax, lens flare
_VIGNETTING_STD = 0.3  # prior, of each coefficient
_GAIN_STD = 0.5  # prior, of each log gain


@dataclass(frozen=True, eq=False)
class ColourModel:
    """log_gains: (C, 3) per camera and BGR channel. vignetting: (3,) k1, k2, k3. samples: how many were used."""

    log_gains: Array
    vignetting: Array
    samples: int = 0

    @property
    def gains(self) -> Floats:
        """(C, 3) factors that bring the cameras to one exposure."""
        return np.exp(self.log_gains).astype(np.float32)

    def shading(self, relative_angle: Array) -> Array:
        """Factors that undo vignetting at angles off the axis, relative to the lens's half field of view."""
        s = np.minimum(np.asarray(relative_angle) ** 2, 1.1)
        return np.asarray(np.exp(-sum(k * s ** (i + 1) for i, k in enumerate(self.vignetting))))


@dataclass(frozen=True, eq=False)
class ColourSamples:
    """What pairs of cameras saw of the same directions.

    first, second: (N,) camera indices. log_ratio: (N, 3) log of the first's over the second's BGR value.
    s_first, s_second: (N,) squared relative angles off the axis.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    log_ratio: Array
    s_first: Array
    s_second: Array

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def joined(cls, parts: Sequence[ColourSamples]) -> ColourSamples:
        """All samples of several frame sets."""
        return join_rows(parts)


def colour_samples(
    images: Mapping[str, Image],
    rig: SurroundRig,
    attitude: LevelAttitude,
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
) -> ColourSamples:
    """Samples of one frame set, from the overlaps above the horizon."""
    blurred = {n: cv2.blur(image, (9, 9)) for n, image in images.items()}
    strips = camera_strips(blurred, rig, attitude, Shell(_FAR_M), _GRID, masks)
    parts = [_pair(a, b, rig) for a, b in combinations(strips, 2)]
    if not parts:
        empty, none = np.zeros(0, np.int64), np.zeros(0)
        return ColourSamples(empty, empty, np.zeros((0, 3)), none, none)
    return ColourSamples.joined(parts)


def _pair(
    a: tuple[int, Image, NDArray[np.float32]], b: tuple[int, Image, NDArray[np.float32]], rig: SurroundRig
) -> ColourSamples:
    (i, first, quality_a), (j, second, quality_b) = a, b
    good = quality_a > np.cos(_RIM * half_field(rig, i))
    good &= quality_b > np.cos(_RIM * half_field(rig, j))
    for picture in (first, second):
        good &= (picture.min(axis=2) > _DARKEST) & (picture.max(axis=2) < _BRIGHTEST)
    ratio = np.log(first[good].astype(np.float64)) - np.log(second[good].astype(np.float64))
    count = len(ratio)
    return ColourSamples(
        np.full(count, i),
        np.full(count, j),
        ratio.reshape(-1, 3),
        (np.arccos(np.clip(quality_a[good], -1, 1)) / half_field(rig, i)) ** 2,
        (np.arccos(np.clip(quality_b[good], -1, 1)) / half_field(rig, j)) ** 2,
    )


def half_field(rig: SurroundRig, camera: int) -> float:
    """Angle off the axis (radians) that vignetting is counted in: where the lens ends, or the image's corner."""
    model = rig.models[camera]
    corners = np.array([[0.0, 0], [model.width_px - 1.0, model.height_px - 1.0]])
    bearings, valid = model.unproject(corners)
    seen = float(np.arccos(np.clip(bearings[valid, 2], -1, 1)).max()) if valid.any() else np.pi
    return min(seen, model.max_angle, np.deg2rad(100.0))


def fit_colour(samples: ColourSamples, cameras: int, known: ColourModel | None = None) -> ColourModel:
    """Least squares of log ratios, robust (Cauchy weights), with weak priors.

    known: keeps its vignetting and estimates the gains alone. Cameras without samples keep the gain 1 (or `known`'s).
    """
    terms = 0 if known is not None else VIGNETTING_TERMS
    ratio = samples.log_ratio
    powers = np.stack(
        [samples.s_second ** (t + 1) - samples.s_first ** (t + 1) for t in range(VIGNETTING_TERMS)], axis=1
    )
    if known is not None:
        ratio = ratio + (powers @ known.vignetting)[:, None]
    size = 3 * cameras + terms
    unknowns: Array = np.zeros(size)
    prior = np.concatenate([np.full(3 * cameras, _GAIN_STD**-2), np.full(terms, _VIGNETTING_STD**-2)])
    start = np.zeros(size) if known is None else known.log_gains.ravel()
    for _ in range(6):
        information, right = np.diag(prior), prior * start
        for channel in range(3):
            # log I_a - log I_b = (v_a - v_b) - (g_a - g_b)
            A = np.zeros((len(samples), size))
            rows = np.arange(len(samples))
            A[rows, 3 * samples.first + channel] = -1.0
            A[rows, 3 * samples.second + channel] = 1.0
            A[:, 3 * cameras :] = -powers[:, :terms]
            residual = ratio[:, channel] - A @ unknowns
            weight = 1 / (1 + (residual / _LOUD) ** 2)
            information = information + (A * weight[:, None]).T @ A / _LOUD**2
            right = right + A.T @ (weight * ratio[:, channel]) / _LOUD**2
        unknowns = np.asarray(np.linalg.solve(information, right), dtype=np.float64)
    log_gains = unknowns[: 3 * cameras].reshape(cameras, 3)
    log_gains = log_gains - log_gains.mean(axis=0)
    vignetting = unknowns[3 * cameras :] if known is None else known.vignetting
    return ColourModel(log_gains, vignetting, len(samples))


@dataclass
class GainSmoother:
    """Gains frame by frame, smoothed over time: exposure changes must not make the picture flicker.

    time_constant_s: of the exponential mean.
    """

    model: ColourModel
    time_constant_s: float = 1.0
    _last_ns: int | None = field(default=None)

    def update(
        self, images: Mapping[str, Image], rig: SurroundRig, attitude: LevelAttitude, timestamp_ns: int
    ) -> ColourModel:
        """The colour model at this time; unchanged if the pictures have no overlap to compare."""
        samples = colour_samples(images, rig, attitude)
        if len(samples) < 20:
            return self.model
        new = fit_colour(samples, len(rig), self.model)
        gap_s = np.inf if self._last_ns is None else max((timestamp_ns - self._last_ns) * 1e-9, 0.0)
        fraction = 1.0 - np.exp(-gap_s / self.time_constant_s) if np.isfinite(gap_s) else 0.5
        log_gains = (1 - fraction) * self.model.log_gains + fraction * new.log_gains
        self.model = ColourModel(log_gains, self.model.vignetting, new.samples)
        self._last_ns = timestamp_ns
        return self.model
