"""From light to a stored picture: lens blur, vignetting, exposure, tone curve, noise, JPEG."""

from __future__ import annotations

import math

import cv2
import numpy as np

from rigwake._types import Floats, Image
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError
from rigwake.simulation.compiled import loop
from rigwake.simulation.scenario import ImageNoise

_EXPOSURE = 0.62
_DRIFT_PERIOD_S = 23.0


def tone_curve() -> Floats:
    """Grey values of linear light 0..16 in 4096 even steps of its square root: the filmic curve of Narkowicz (2015),
    *ACES Filmic Tone Mapping Curve*, then gamma 2.2."""
    x = (np.arange(4096) / 4095 * 4.0) ** 2 * _EXPOSURE
    display = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    return np.asarray(255 * np.clip(display, 0, 1) ** (1 / 2.2), np.float32)


_TONE = tone_curve()


def vignetting(model: CameraModel, loss: float) -> Floats:
    """Relative light (H, W) at each pixel: 1 on the axis, `1 - loss` at the edge of the field of view, falling with
    the square of the angle."""
    u, v = np.meshgrid(
        np.arange(model.width_px, dtype=np.float64), np.arange(model.height_px, dtype=np.float64)
    )
    rays, valid = model.unproject(np.stack([u.ravel(), v.ravel()], 1))
    angle = np.arccos(np.clip(np.where(valid, rays[:, 2], 1.0), -1, 1))
    return np.asarray(1 - loss * (angle / model.max_angle) ** 2, np.float32).reshape(u.shape)


def develop(
    light: Floats,
    noise: ImageNoise,
    vignette: Floats,
    time_s: float,
    phase: float,
    rng: np.random.Generator,
) -> Image:
    """An 8-bit BGR picture (H, W, 3) of linear RGB light (H, W, 3).

    The exposure is `gain (1 + gain_drift sin(..))`, wandering over 23 s from a phase of the camera's own.
    """
    if noise.blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), noise.blur_px, borderType=cv2.BORDER_REPLICATE)
    gain = noise.gain * (1 + noise.gain_drift * np.sin(2 * np.pi * time_s / _DRIFT_PERIOD_S + phase))
    grain = rng.standard_normal(light.shape, dtype=np.float32)
    picture = np.empty(light.shape, np.uint8)
    _expose(np.ascontiguousarray(light), vignette, gain, _TONE, grain, noise.read_std**2, noise.shot, picture)
    return picture


@loop
def _expose(
    light: Floats,
    vignette: Floats,
    gain: float,
    tone: Floats,
    grain: Floats,
    read_variance: float,
    shot: float,
    picture: Image,
) -> None:
    """Grey values (H, W, 3) BGR of light (H, W, 3) RGB, with `grain` (unit variance) as noise."""
    height, width, _ = light.shape
    for y in range(height):
        for x in range(width):
            for channel in range(3):
                exposed = light[y, x, channel] * vignette[y, x] * gain
                grey = tone[int(math.sqrt(min(max(exposed, 0.0), 15.9)) * (4095 / 4))]
                grey += grain[y, x, channel] * math.sqrt(read_variance + shot * grey)
                picture[y, x, 2 - channel] = int(min(max(grey + 0.5, 0.0), 255.0))


def encode(picture: Image, quality: int, colour: bool) -> bytes:
    """JPEG bytes of a BGR picture, grey if not `colour`."""
    stored = picture if colour else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    done, buffer = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise EstimationError(
            "OpenCV could not encode a picture as JPEG.", remedy="Check the installation of OpenCV."
        )
    return bytes(buffer)
