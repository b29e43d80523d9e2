"""Lenses in the settings files of ORB-SLAM2, ORB-SLAM3 and the forks that use their keys."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import CameraError

_RADTAN = ("k1", "k2", "p1", "p2")


def is_orbslam(plain: Mapping[Any, Any]) -> bool:
    """Whether these are the keys of such a file: `Camera.fx` or `Camera1.fx`."""
    return any(f"{camera}.fx" in plain for camera in ("Camera", "Camera1", "Camera2"))


def cameras_from_orbslam(plain: Mapping[str, Any]) -> dict[str, CameraModel]:
    """`cam0` (Camera or Camera1) and, if it has a lens of its own, `cam1` (Camera2).

    PinHole (k1 k2 p1 p2 k3), KannalaBrandt8 and Rectified; without `Camera.type`, as in ORB-SLAM2, it is PinHole.
    Raises CameraError for what is missing or another type.
    """
    first = "Camera1" if "Camera1.fx" in plain else "Camera"
    cameras = {"cam0": _lens(plain, first)}
    if "Camera2.fx" in plain:
        cameras["cam1"] = _lens(plain, "Camera2")
    return cameras


def _lens(plain: Mapping[str, Any], camera: str) -> CameraModel:
    kind = str(plain.get("Camera.type", "PinHole"))
    try:
        size = int(plain["Camera.width"]), int(plain["Camera.height"])
        focal = [_number(plain, f"{camera}.{name}") for name in ("fx", "fy", "cx", "cy")]
        if kind == "KannalaBrandt8":
            return camera_from_params(
                "kb4", [*focal, *(_number(plain, f"{camera}.k{i}") for i in range(1, 5))], *size
            )
        if kind in ("PinHole", "Rectified", "Pinhole"):
            distorted = kind != "Rectified"
            radtan = [_number(plain, f"{camera}.{n}", 0.0) if distorted else 0.0 for n in (*_RADTAN, "k3")]
            return camera_from_params("pinhole", [*focal, 0.0, *radtan], *size)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CameraError(f"The ORB-SLAM settings are not complete: {error!r}.") from error
    raise CameraError(f"ORB-SLAM's camera type {kind!r} is not known here.")


def _number(plain: Mapping[str, Any], key: str, default: float | None = None) -> float:
    return float(plain[key] if default is None else plain.get(key, default))
