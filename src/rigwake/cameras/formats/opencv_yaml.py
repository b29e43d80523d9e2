"""YAML files of OpenCV's FileStorage, of ROS's `camera_calibration` and of CamOdoCal.

All are read by the loader of `yaml_input`, which knows `!!opencv-matrix`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.cameras.formats.camera_info import camera_from_info, info_from_camera
from rigwake.cameras.models.scaramuzza import Scaramuzza
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import CameraError


def _first(plain: Mapping[str, Any], *names: str) -> Any:
    for name in names:
        if name in plain:
            return plain[name]
    raise CameraError(f"The file lacks {' or '.join(names)}.")


def _numbers(matrix: Any) -> Array:
    """Values of `{rows, cols, data}`, a list, or a list of lists."""
    content = matrix.get("data") if isinstance(matrix, Mapping) else matrix
    try:
        return np.asarray(content, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise CameraError(f"A matrix of the file does not hold numbers: {content!r}.") from error


def camera_from_opencv(
    plain: Mapping[str, Any], *, fisheye: bool | None = None, max_angle: float | None = None
) -> CameraModel:
    """The lens of an OpenCV or ROS calibration file, as plain values.

    The file's own `distortion_model` or `fisheye_model` decides between pinhole and fisheye. Where it is
    silent, `fisheye` must: CameraError if the four coefficients could be either.
    """
    K = _numbers(_first(plain, "camera_matrix", "K", "Camera_Matrix", "intrinsic_matrix"))
    D = _numbers(_first(plain, "distortion_coefficients", "dist_coeffs", "D", "Distortion_Coefficients"))
    width_px, height_px = _size(plain)
    name = plain.get("distortion_model")
    if name is None:
        declared = plain.get("fisheye_model", fisheye)
        if declared is None and len(D) == 4:
            raise CameraError(
                "The file holds four distortion coefficients and does not say of which model.",
                consequence="They could be k1 k2 p1 p2 of a pinhole or k1..k4 of a fisheye.",
                remedy="Add `distortion_model: equidistant` or `distortion_model: plumb_bob` to the file.",
            )
        name = "equidistant" if declared else "rational_polynomial" if len(D) > 5 else "plumb_bob"
    return camera_from_info(str(name), D, K, width_px, height_px, max_angle)


def _size(plain: Mapping[str, Any]) -> tuple[int, int]:
    try:
        if "resolution" in plain:
            width_px, height_px = (int(value) for value in _numbers(plain["resolution"]))
            return width_px, height_px
        return (
            int(_first(plain, "image_width", "image_Width", "width")),
            int(_first(plain, "image_height", "image_Height", "height")),
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise CameraError(f"The file does not hold the size of the image: {error}.") from error


def camera_to_opencv(camera: CameraModel) -> str:
    """A FileStorage text with K, D, the size and the distortion model (pinhole, rational and kb4 lenses)."""
    info = info_from_camera(camera)

    def matrix(rows: int, values: tuple[float, ...]) -> str:
        listed = ", ".join(repr(float(value)) for value in values)
        return f"!!opencv-matrix\n   rows: {rows}\n   cols: {len(values) // rows}\n   dt: d\n   data: [ {listed} ]"

    return (
        "%YAML:1.0\n---\n"
        f"image_width: {camera.width_px}\nimage_height: {camera.height_px}\n"
        f"camera_matrix: {matrix(3, info.K)}\n"
        f"distortion_model: {info.distortion_model}\n"
        f"fisheye_model: {int(camera.model == 'kb4')}\n"
        f"distortion_coefficients: {matrix(1, info.D)}\n"
    )


_CAMODOCAL_MEI = ("xi",), ("k1", "k2", "p1", "p2"), ("gamma1", "gamma2", "u0", "v0")
_CAMODOCAL_KB = ("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0")


def camera_from_camodocal(plain: Mapping[str, Any], max_angle: float | None = None) -> CameraModel:
    """The lens of a CamOdoCal file: KANNALA_BRANDT, MEI, PINHOLE or SCARAMUZZA."""
    kind = str(plain.get("model_type", "")).upper()
    try:
        size = int(plain["image_width"]), int(plain["image_height"])
        groups = {
            group: {str(name): float(value) for name, value in content.items()}
            for group, content in plain.items()
            if str(group).endswith("_parameters") and isinstance(content, Mapping)
        }
        if kind == "KANNALA_BRANDT":
            p = groups["projection_parameters"]
            return camera_from_params(
                "kb4", [p[n] for n in (*_CAMODOCAL_KB[4:], *_CAMODOCAL_KB[:4])], *size, max_angle
            )
        if kind in ("MEI", "PINHOLE"):
            p, d = groups["projection_parameters"], groups["distortion_parameters"]
            coefficients = [d[n] for n in _CAMODOCAL_MEI[1]]
            if kind == "PINHOLE":
                params = [p["fx"], p["fy"], p["cx"], p["cy"], 0.0, *coefficients, 0.0]
                return camera_from_params("pinhole", params, *size, max_angle)
            xi = groups["mirror_parameters"]["xi"]
            params = [*(p[n] for n in _CAMODOCAL_MEI[2]), xi, *coefficients, 0.0]
            return camera_from_params("mei", params, *size, max_angle)
        if kind == "SCARAMUZZA":
            return _scaramuzza_from_camodocal(groups, size, max_angle)
    except (KeyError, TypeError, ValueError) as error:
        raise CameraError(f"The CamOdoCal file is not complete: {error!r}.") from error
    raise CameraError(f"CamOdoCal's model {kind!r} is not known here.")


def _scaramuzza_from_camodocal(
    groups: Mapping[str, Mapping[str, float]], size: tuple[int, int], max_angle: float | None
) -> CameraModel:
    """CamOdoCal has `u = C x + D y + cx`, `v = E x + y + cy`; scaling x, y by C brings it to our form."""
    poly, affine = groups["poly_parameters"], groups["affine_parameters"]
    C, D, E = affine["ac"], affine["ad"], affine["ae"]
    a = [poly[f"p{i}"] * C ** (1 - i) for i in range(len(poly))]
    values = [affine["cx"], affine["cy"], 1 / C, E / C, D / C, *a]
    return camera_from_params("scaramuzza", values, *size, max_angle)


def camera_to_camodocal(camera: CameraModel, name: str = "camera") -> str:
    """A CamOdoCal file of a kb4, mei (without k3), pinhole (without skew and k3) or Scaramuzza lens."""
    p = dict(zip(camera.param_names, camera.params.tolist(), strict=True))
    if (p.get("k3", 0.0) != 0 and camera.model != "kb4") or p.get("skew", 0.0) != 0:
        raise CameraError(f"CamOdoCal has no form for a {camera.model} lens with k3 or skew.")
    distortion = {n: p.get(n, 0.0) for n in _CAMODOCAL_MEI[1]}
    groups: dict[str, dict[str, float]]
    if camera.model == "kb4":
        order = ("k1", "k2", "k3", "k4", "fx", "fy", "cx", "cy")
        kind, groups = (
            "KANNALA_BRANDT",
            {"projection_parameters": {n: p[o] for n, o in zip(_CAMODOCAL_KB, order, strict=True)}},
        )
    elif camera.model == "mei":
        focal = {n: p[o] for n, o in zip(_CAMODOCAL_MEI[2], ("fx", "fy", "cx", "cy"), strict=True)}
        kind, groups = (
            "MEI",
            {
                "mirror_parameters": {"xi": p["xi"]},
                "distortion_parameters": distortion,
                "projection_parameters": focal,
            },
        )
    elif camera.model == "pinhole":
        kind, groups = (
            "PINHOLE",
            {
                "distortion_parameters": distortion,
                "projection_parameters": {n: p[n] for n in ("fx", "fy", "cx", "cy")},
            },
        )
    elif isinstance(camera, Scaramuzza):
        kind, groups = "SCARAMUZZA", _scaramuzza_to_camodocal(camera)
    else:
        raise CameraError(f"CamOdoCal has no form for a {camera.model} lens.", remedy="Convert it first.")
    lines = ["%YAML:1.0", "---", f"model_type: {kind}", f"camera_name: {name}"]
    lines += [f"image_width: {camera.width_px}", f"image_height: {camera.height_px}"]
    for group, content in groups.items():
        lines += [f"{group}:", *(f"   {key}: {value!r}" for key, value in content.items())]
    return "\n".join(lines) + "\n"


def _scaramuzza_to_camodocal(camera: Scaramuzza) -> dict[str, dict[str, float]]:
    cx, cy, c, d, e, *a = camera.values
    # the inverse of the scaling in `_scaramuzza_from_camodocal`: C = 1 / c
    scaled = {f"p{i}": value * c ** (1 - i) for i, value in enumerate(a)}
    inverse = camera.inverse_polynomial(19) * c
    return {
        "poly_parameters": scaled,
        "inv_poly_parameters": {f"p{i}": float(value) for i, value in enumerate(inverse)},
        "affine_parameters": {"ac": 1 / c, "ad": e / c, "ae": d / c, "cx": cx, "cy": cy},
    }
