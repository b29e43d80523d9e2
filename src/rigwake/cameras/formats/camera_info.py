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

from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import CameraError

ROS_LENSES = ("pinhole", "rational", "kb4")
"""Models of lenses that ROS's own programs know."""

_SKEWED = {"plumb_bob": ("pinhole", 5), "rational_polynomial": ("rational", 8)}
# what drivers, simulators and calibration programs write for the same equations; compared without case, spaces,
# hyphens and underscores
_NAMES = {
    "plumb_bob": "plumbbob radtan radialtangential pinholeradtan brown brownconrady modifiedbrownconrady opencv none "
    "pinhole ideal perspective nodistortion rectilinear undistorted",
    "rational_polynomial": "rationalpolynomial rational fullopencv opencvrational pinholerational",
    "kb4": "equidistant equidistant4 equi fisheye opencvfisheye fisheyeopencv kannalabrandt kannalabrandt4 "
    "kannalabrandt8 kannalabrandtk3 fisheyekannalabrandtk3 kb kb4 kb8 pinholeequi pinholeequidistant",
    "mei": "mei omni omnidir omnidirectional omniradtan unified ucm cmei",
    "ds": "ds doublesphere dsnone",
    "eucm": "eucm extendedunified enhancedunified eucmnone",
    "fov": "fov atan pinholefov fieldofview",
    "kb23": "kb23 kannalabrandtfull kannalabrandt23",
    "scaramuzza": "scaramuzza ocam ocamcalib polynomialomni",
}
_KNOWN_NAMES = {alias: name for name, aliases in _NAMES.items() for alias in aliases.split()}
# lenses that ROS has no name for: how many numbers D holds, in the order of the model
_OTHER_LENSES = {"ds": 2, "eucm": 2, "fov": 1, "kb23": 19}


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
    wanted = "".join(letter for letter in distortion_model.lower() if letter not in " -_")
    name = _KNOWN_NAMES.get(wanted or "plumbbob", "")
    focal = [k[0], k[4], k[2], k[5]]
    if name == "kb4":
        return camera_from_params("kb4", [*focal, *_padded(d, 4, name)], *size, max_angle)
    if name == "mei":
        return camera_from_params("mei", [*focal, *_padded(d, 6, name)], *size, max_angle)
    if name in _OTHER_LENSES:
        return camera_from_params(name, [*focal, *_exactly(d, _OTHER_LENSES[name], name)], *size, max_angle)
    if name == "scaramuzza":
        return camera_from_params(name, [k[2], k[5], *d], *size, max_angle)
    if name not in _SKEWED:
        raise CameraError(
            f"The distortion model {distortion_model!r} is not known.",
            remedy=f"Known: {', '.join(_NAMES)}, and their usual other names. Give the camera's intrinsics in a file.",
        )
    if name == "plumb_bob" and len(d) >= 8 and np.any(d[5:8]):
        name = "rational_polynomial"  # some drivers leave the name at its default
    model, count = _SKEWED[name]
    return camera_from_params(model, [*focal, k[1], *_padded(d, count, name)], *size, max_angle)


def _exactly(coefficients: np.ndarray, count: int, name: str) -> list[float]:
    if len(coefficients) != count:
        raise CameraError(f"{name} takes {count} coefficients, the camera_info has {len(coefficients)}.")
    return [float(value) for value in coefficients]


def info_of_any_camera(camera: CameraModel) -> CameraInfo:
    """The CameraInfo of any lens: of one that ROS has no distortion model for under rigwake's name of the model.

    ROS's own programs refuse such a name rather than read it wrongly; `camera_from_info` reads it back. D holds
    the parameters after the focal length and centre, in the model's order.
    """
    if camera.model in ROS_LENSES:
        return info_from_camera(camera)
    p = camera.params.tolist()
    fx, fy, cx, cy, D = p[0], p[1], p[2], p[3], p[4:]
    if camera.model == "scaramuzza":
        cx, cy, D = p[0], p[1], p[2:]
        fx = fy = axis_focal_px(camera)
    K = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    return CameraInfo(camera.model, tuple(D), K, camera.width_px, camera.height_px)


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
            remedy="Convert it to kb4 or pinhole first (`rigwake.cameras.model_fitting`).",
        )
    name, D = forms[camera.model]
    K = (p[0], skew, p[2], 0.0, p[1], p[3], 0.0, 0.0, 1.0)
    return CameraInfo(name, tuple(D), K, camera.width_px, camera.height_px)


def _padded(coefficients: np.ndarray, count: int, name: str) -> list[float]:
    if np.any(coefficients[count:] != 0):
        raise CameraError(f"{name} takes {count} coefficients, the camera_info has {len(coefficients)}.")
    return [*coefficients[:count].tolist(), *[0.0] * (count - len(coefficients))]
