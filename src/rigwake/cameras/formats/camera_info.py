"""ROS `sensor_msgs/CameraInfo` and camera models.

K is `[fx, skew, cx; 0, fy, cy; 0, 0, 1]`, row by row; R and P (rectification) are not part of the lens and
are ignored. The distortion models are those of `sensor_msgs/distortion_models.hpp`, and the names that simulators
and drivers use for lenses which ROS itself does not know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import CameraError

_SKEWED = {"plumb_bob": ("pinhole", 5), "rational_polynomial": ("rational", 8)}
_EQUIDISTANT = ("equidistant", "fisheye", "kannala_brandt")


@dataclass(frozen=True)
class CameraInfo:
    """The parts of a CameraInfo message that describe a lens: K has 9 values, row by row."""

    distortion_model: str
    D: tuple[float, ...]
    K: tuple[float, ...]
    width_px: int
    height_px: int


def camera_from_info(
    distortion_model: str,
    D: Sequence[float] | ArrayLike,
    K: Sequence[float] | ArrayLike,
    width_px: int,
    height_px: int,
    max_angle: float | None = None,
) -> CameraModel:
    """The lens that a CameraInfo describes.

    An empty distortion model or empty D means an ideal pinhole, `equidistant` apart, which is then the ideal
    equidistant lens. Raises CameraError for an uncalibrated message (K[0] = 0), a distortion model that is
    not known, or too many coefficients.
    """
    k, d = np.asarray(K, dtype=np.float64).ravel(), np.asarray(D, dtype=np.float64).ravel()
    if k.size != 9 or not k[0] > 0:
        raise CameraError(
            "The camera_info is not calibrated: its K holds no focal length.",
            remedy="Calibrate the camera with `rigwake intrinsics`, or give intrinsics in a file.",
        )
    size = int(width_px), int(height_px)
    name = distortion_model.strip().lower() or "plumb_bob"
    focal = [k[0], k[4], k[2], k[5]]
    if name in _EQUIDISTANT:
        return camera_from_params("kb4", [*focal, *_padded(d, 4, name)], *size, max_angle)
    if name == "mei":
        xi, k1, k2, p1, p2 = _padded(d, 5, name)
        return camera_from_params("mei", [*focal, xi, k1, k2, p1, p2, 0.0], *size, max_angle)
    if name not in _SKEWED:
        known = ", ".join([*_SKEWED, *_EQUIDISTANT, "mei"])
        raise CameraError(
            f"The distortion model {distortion_model!r} is not known.",
            remedy=f"Known: {known}. Give the camera's intrinsics in a file instead.",
        )
    if name == "plumb_bob" and len(d) == 8:
        name = "rational_polynomial"  # some drivers leave the name at its default
    model, count = _SKEWED[name]
    return camera_from_params(model, [*focal, k[1], *_padded(d, count, name)], *size, max_angle)


def info_from_camera(camera: CameraModel) -> CameraInfo:
    """The CameraInfo of a camera; CameraError if ROS has no distortion model for it."""
    p = camera.params.tolist()
    skew = p[4] if camera.model in ("pinhole", "rational") else 0.0
    forms = {
        "pinhole": ("plumb_bob", p[5:]),
        "rational": ("rational_polynomial", p[5:]),
        "kb4": ("equidistant", p[4:]),
    }
    if camera.model not in forms:
        raise CameraError(
            f"ROS camera_info has no form for a {camera.model} lens.",
            remedy="Convert it to kb4 or pinhole first (`rigwake.cameras.convert`).",
        )
    name, D = forms[camera.model]
    K = (p[0], skew, p[2], 0.0, p[1], p[3], 0.0, 0.0, 1.0)
    return CameraInfo(name, tuple(D), K, camera.width_px, camera.height_px)


def _padded(coefficients: np.ndarray, count: int, name: str) -> list[float]:
    if np.any(coefficients[count:] != 0):
        raise CameraError(f"{name} takes {count} coefficients, the camera_info has {len(coefficients)}.")
    return [*coefficients[:count].tolist(), *[0.0] * (count - len(coefficients))]
