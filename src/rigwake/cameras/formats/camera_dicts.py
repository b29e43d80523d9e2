"""Lens parameters in the fields of Kalibr, Basalt and COLMAP, and back.

Each pair of functions maps a camera to the plain values of one camera in that tool's file; poses are not
handled here. CameraError says so where a tool has no form for a lens: convert it first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import CameraError

_KALIBR_DISTORTION = {"radtan": "pinhole", "radial-tangential": "pinhole", "equidistant": "kb4", "fov": "fov"}
_COLMAP_PIXEL_SHIFT = 0.5  # COLMAP's (0, 0) is the corner of the top-left pixel, here it is its centre


def _no_form(tool: str, camera: CameraModel, reason: str = "") -> CameraError:
    return CameraError(
        f"{tool} has no form for this {camera.model} lens{reason}.",
        remedy="Convert it first (`rigwake.cameras.model_fitting.convert_camera`).",
    )


def _named(camera: CameraModel) -> dict[str, float]:
    return dict(zip(camera.param_names, camera.params.tolist(), strict=True))


def _without(tool: str, camera: CameraModel, *names: str) -> dict[str, float]:
    """The parameters by name, of which those called `names` must be zero."""
    values = _named(camera)
    present = [name for name in names if values[name] != 0]
    if present:
        raise _no_form(tool, camera, f" with {', '.join(present)}")
    return values


def _pick(values: Mapping[str, float], names: str) -> list[float]:
    return [values[name] for name in names.split()]


def camera_to_kalibr(camera: CameraModel) -> dict[str, Any]:
    """`camera_model`, `intrinsics`, `distortion_model`, `distortion_coeffs`, `resolution` of a camchain."""
    if camera.model == "pinhole":
        values = _without("Kalibr", camera, "skew", "k3")
        kind = "pinhole", "fx fy cx cy", "radtan", "k1 k2 p1 p2"
    elif camera.model == "mei":
        values = _without("Kalibr", camera, "k3")
        kind = "omni", "xi fx fy cx cy", "radtan", "k1 k2 p1 p2"
    else:
        values = _named(camera)
        forms = {
            "kb4": ("pinhole", "fx fy cx cy", "equidistant", "k1 k2 k3 k4"),
            "fov": ("pinhole", "fx fy cx cy", "fov", "w"),
            "eucm": ("eucm", "alpha beta fx fy cx cy", "none", ""),
            "ds": ("ds", "xi alpha fx fy cx cy", "none", ""),
        }
        if camera.model not in forms:
            raise _no_form("Kalibr", camera)
        kind = forms[camera.model]
    return {
        "camera_model": kind[0],
        "intrinsics": _pick(values, kind[1]),
        "distortion_model": kind[2],
        "distortion_coeffs": _pick(values, kind[3]),
        "resolution": [camera.width_px, camera.height_px],
    }


def camera_from_kalibr(plain: Mapping[str, Any], max_angle: float | None = None) -> CameraModel:
    """The lens of one camera of a Kalibr camchain, an OpenVINS file or an EuRoC `sensor.yaml`."""
    try:
        kind, distortion = str(plain["camera_model"]), str(plain.get("distortion_model", "none"))
        values = [float(value) for value in plain["intrinsics"]]
        coefficients = plain.get("distortion_coeffs", plain.get("distortion_coefficients")) or []
        extra = [float(value) for value in coefficients] if distortion != "none" else []
        width_px, height_px = (int(value) for value in plain["resolution"])
    except (KeyError, TypeError, ValueError) as error:
        raise CameraError(f"This is not a camera of a Kalibr camchain: {error!r}.") from error
    if len(values) < 4:
        raise CameraError(f"Kalibr's {kind} camera has {len(values)} intrinsics, at least 4 are needed.")
    own, focal = values[:-4], values[-4:]
    name = kind
    if kind == "pinhole":
        name = "pinhole" if distortion == "none" else _KALIBR_DISTORTION.get(distortion, "")
    if name == "pinhole":
        params = [*focal, 0.0, *extra, *[0.0] * (5 - len(extra))]
    elif name == "omni" and distortion in ("radtan", "none"):
        name, params = "mei", [*focal, *own, *(extra or [0.0] * 4), 0.0]
    elif name in ("kb4", "fov") or (name in ("eucm", "ds") and not extra):
        params = [*focal, *own, *extra]
    else:
        raise CameraError(f"Kalibr's {kind} camera with {distortion} distortion is not known here.")
    return camera_from_params(name, params, width_px, height_px, max_angle)


_BASALT = {
    "kb4": ("kb4", "fx fy cx cy k1 k2 k3 k4"),
    "ds": ("ds", "fx fy cx cy xi alpha"),
    "eucm": ("eucm", "fx fy cx cy alpha beta"),
    "fov": ("fov", "fx fy cx cy w"),
    "rational": ("pinhole-radtan8", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
}


def camera_to_basalt(camera: CameraModel) -> dict[str, Any]:
    """An entry of Basalt's `intrinsics`: `camera_type` and `intrinsics`; the size stands in `resolution`."""
    if camera.model == "pinhole":
        values = _without("Basalt", camera, "skew")
        names = ["k1", "k2", "p1", "p2", "k3"]
        if not any(values[name] for name in names):
            return {"camera_type": "pinhole", "intrinsics": {n: values[n] for n in ("fx", "fy", "cx", "cy")}}
        values |= {"k4": 0.0, "k5": 0.0, "k6": 0.0}
        kind, order = _BASALT["rational"]
    elif camera.model in _BASALT:
        kind, order = _BASALT[camera.model]
        values = _without("Basalt", camera, "skew") if camera.model == "rational" else _named(camera)
    else:
        raise _no_form("Basalt", camera)
    intrinsics = {name: values[name] for name in order.split()}
    if kind == "pinhole-radtan8":
        intrinsics["rpmax"] = float(np.tan(camera.max_angle))
    return {"camera_type": kind, "intrinsics": intrinsics}


def camera_from_basalt(
    plain: Mapping[str, Any], resolution: Sequence[int], max_angle: float | None = None
) -> CameraModel:
    """The lens of an entry of Basalt's `intrinsics` and its `resolution` `[width, height]`."""
    try:
        kind = str(plain["camera_type"])
        values = {str(name): float(value) for name, value in plain["intrinsics"].items()}
        size = int(resolution[0]), int(resolution[1])
        if kind == "pinhole":
            return camera_from_params(
                "pinhole", [*_pick(values, "fx fy cx cy"), *[0.0] * 6], *size, max_angle
            )
        for model, (name, order) in _BASALT.items():
            if name == kind:
                params = _pick(values, order)
                if model == "rational":
                    params.insert(4, 0.0)
                return camera_from_params(model, params, *size, max_angle)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise CameraError(f"This is not an entry of Basalt's intrinsics: {error!r}.") from error
    raise CameraError(f"Basalt's camera type {kind!r} is not known here.")


# COLMAP's model -> ours, and where each of our parameters stands in COLMAP's list (None: zero)
_COLMAP: dict[str, tuple[str, tuple[int | None, ...]]] = {
    "SIMPLE_PINHOLE": ("pinhole", (0, 0, 1, 2, *[None] * 6)),
    "PINHOLE": ("pinhole", (0, 1, 2, 3, *[None] * 6)),
    "SIMPLE_RADIAL": ("pinhole", (0, 0, 1, 2, None, 3, *[None] * 4)),
    "RADIAL": ("pinhole", (0, 0, 1, 2, None, 3, 4, *[None] * 3)),
    "OPENCV": ("pinhole", (0, 1, 2, 3, None, 4, 5, 6, 7, None)),
    "FULL_OPENCV": ("rational", (0, 1, 2, 3, None, 4, 5, 6, 7, 8, 9, 10, 11)),
    "SIMPLE_RADIAL_FISHEYE": ("kb4", (0, 0, 1, 2, 3, None, None, None)),
    "RADIAL_FISHEYE": ("kb4", (0, 0, 1, 2, 3, 4, None, None)),
    "OPENCV_FISHEYE": ("kb4", (0, 1, 2, 3, 4, 5, 6, 7)),
    "FOV": ("fov", (0, 1, 2, 3, 4)),
}


def camera_to_colmap(camera: CameraModel) -> tuple[str, list[float]]:
    """COLMAP's model name and parameters; its pixel centres lie at + 0.5."""
    values = _without("COLMAP", camera, "skew") if camera.model in ("pinhole", "rational") else _named(camera)
    if camera.model == "pinhole" and values["k3"] == 0:
        name = "OPENCV"
    elif camera.model in ("pinhole", "rational"):
        name, values = "FULL_OPENCV", {**values, **{k: values.get(k, 0.0) for k in ("k4", "k5", "k6")}}
    elif camera.model in ("kb4", "fov"):
        name = {"kb4": "OPENCV_FISHEYE", "fov": "FOV"}[camera.model]
    else:
        raise _no_form("COLMAP", camera)
    places = _COLMAP[name][1]
    params = [0.0] * (1 + max(place for place in places if place is not None))
    for value, place in zip(values.values(), places, strict=True):
        if place is not None:
            params[place] = value
    params[2] += _COLMAP_PIXEL_SHIFT
    params[3] += _COLMAP_PIXEL_SHIFT
    return name, params


def camera_from_colmap(
    model: str, params: Sequence[float], width_px: int, height_px: int, max_angle: float | None = None
) -> CameraModel:
    """The lens of a line of COLMAP's `cameras.txt`."""
    if model not in _COLMAP:
        raise CameraError(
            f"COLMAP's model {model} is not known here.", remedy=f"Known: {', '.join(_COLMAP)}."
        )
    name, places = _COLMAP[model]
    wanted = 1 + max(place for place in places if place is not None)
    if len(params) != wanted:
        raise CameraError(f"COLMAP's {model} takes {wanted} parameters, got {len(params)}.")
    values = [0.0 if place is None else float(params[place]) for place in places]
    values[2] -= _COLMAP_PIXEL_SHIFT
    values[3] -= _COLMAP_PIXEL_SHIFT
    return camera_from_params(name, values, width_px, height_px, max_angle)
