"""The calibration file: YAML, versioned, written atomically; its schema is docs/calibration_file.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rigwake import __version__
from rigwake._types import Array
from rigwake.atomic import write_text_atomic
from rigwake.calibration.rig_calibration import (
    AXIS_NAMES,
    CalibratedCamera,
    Calibration,
    KnownOffset,
    UnobservableDirection,
)
from rigwake.cameras.registry import camera_from_dict, camera_to_dict
from rigwake.errors import InputError
from rigwake.geometry.se3 import SE3
from rigwake.yaml_input import read_yaml

SCHEMA_VERSION = 1
_ROUNDING = 1e-4  # a correlation matrix may be so much negative by rounded digits
_TOUCHED = 0.02
_REMEDY = "The file is damaged or was edited: export or calibrate again."
_HEADER = f"""\
# A calibrated camera rig, written by rigwake {__version__}. Schema: docs/calibration_file.md
# a_from_b maps coordinates in b to coordinates in a: p_rig = rig_from_cam * p_cam.
# Metres, seconds, degrees where a name says so; quaternions w x y z; t_rig = t_cam + time_offset_s.
# Camera axes: x right, y down, z forward. null: the motion did not determine it.
"""


def plain(value: Any) -> Any:
    """Plain YAML and JSON values: arrays to lists, NaN and infinities to null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _transform_to_dict(a_from_b: SE3) -> dict[str, Any]:
    known = bool(np.isfinite(a_from_b.rotation).all())
    return {
        "quat_wxyz": a_from_b.quat_wxyz if known else None,
        "translation_m": a_from_b.translation,
    }


def _camera_to_dict(camera: CalibratedCamera) -> dict[str, Any]:
    content: dict[str, Any] = {
        "rig_from_cam": _transform_to_dict(camera.rig_from_cam),
        "std_rig_axes": {
            "rotation_deg": camera.std_rotation_deg,
            "translation_m": camera.std_translation_m,
        },
        "time_offset_s": camera.time_offset_s,
        "time_offset_std_s": camera.time_offset_std_s,
        "scale": camera.scale,
        "scale_std": camera.scale_std,
        "undetermined": [
            {"words": d.words, "remedy": d.remedy, "direction_rig_axes": d.direction}
            for d in camera.unobservable
        ],
        "known_offsets": [
            {"direction_rig_axes": k.direction_rig, "value_m": k.value_m, "std_m": k.std_m}
            for k in camera.known_offsets
        ],
        "camera": None if camera.model is None else camera_to_dict(camera.model),
        "topic": camera.topic,
        "covariance_cam_axes": camera.covariance,
        "statistics": camera.statistics,
    }
    return content


def calibration_to_dict(calibration: Calibration) -> dict[str, Any]:
    """Plain values as they stand in the file (and in JSON)."""
    content = {
        "rigwake_calibration": SCHEMA_VERSION,
        "reference": calibration.reference,
        "cameras": {name: _camera_to_dict(camera) for name, camera in calibration.cameras.items()},
        "antenna": None
        if calibration.antenna_rig is None
        else {"position_rig_m": calibration.antenna_rig, "covariance": calibration.antenna_covariance},
        "joint_covariance": calibration.joint_covariance,
        "checks": calibration.checks,
        "provenance": calibration.provenance,
    }
    return dict(plain(content))


def save_calibration(calibration: Calibration, path: Path | str) -> None:
    """Write the calibration file atomically."""
    body = yaml.dump(
        calibration_to_dict(calibration),
        Dumper=yaml.CSafeDumper,
        sort_keys=False,
        default_flow_style=None,
        width=110,
        allow_unicode=True,
    )
    write_text_atomic(path, _HEADER + body)


def _floats(value: Any, shape: tuple[int, ...], where: str) -> Array:
    """A float array of this shape; null becomes NaN."""
    try:
        array = np.array(value, dtype=object)
        array[array == None] = np.nan  # noqa: E711  elementwise
        array = array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} must hold numbers or null, it holds {value!r}.") from error
    if array.shape != shape:
        raise InputError(f"{where} must have shape {shape}, it has {array.shape}.")
    return np.asarray(array)


def _optional_float(content: Mapping[str, Any], key: str, where: str) -> float | None:
    value = content.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: {key} must be a number or null, it is {value!r}.")
    return float(value)


def _finite(value: Any, shape: tuple[int, ...], where: str) -> Array:
    array = _floats(value, shape, where)
    if not np.isfinite(array).all():
        raise InputError(f"{where} must hold finite numbers, it holds {value!r}.")
    return array


def _covariance(value: Any, size: int, where: str) -> Array:
    """A covariance in which null marks what is unobservable. InputError if the rest is none."""
    matrix = _floats(value, (size, size), where)
    known = np.isfinite(np.diag(matrix))
    part = matrix[np.ix_(known, known)]
    if (
        np.isinf(matrix).any()
        or not np.isfinite(part).all()
        or np.abs(part - part.T).max(initial=0) > 1e-6 * np.abs(part).max(initial=0)
    ):
        raise InputError(f"{where}: the covariance is not symmetric and finite.", remedy=_REMEDY)
    scale = np.sqrt(np.maximum(np.diag(part), 1e-300))
    if (np.diag(part) < 0).any() or np.linalg.eigvalsh(part / np.outer(scale, scale)).min(
        initial=0
    ) < -_ROUNDING:
        raise InputError(f"{where}: the covariance is not positive.", remedy=_REMEDY)
    return matrix


def _null_axes(
    name: str, rig_from_cam: SE3, unobservable: tuple[UnobservableDirection, ...]
) -> list[UnobservableDirection]:
    """A direction for every axis that is null although no entry of `unobservable` touches it."""
    lost = np.isnan([*rig_from_cam.rotation[:, 0], *rig_from_cam.translation])
    touched = np.array([np.abs(d.direction) > _TOUCHED for d in unobservable]).reshape(-1, 6).any(axis=0)
    return [
        UnobservableDirection(np.eye(6)[axis], f"{AXIS_NAMES[axis]} of {name}")
        for axis in np.flatnonzero(lost & ~touched)
    ]


def _camera_from_dict(name: str, content: Mapping[str, Any], where: str) -> CalibratedCamera:
    where = f"{where}: cameras.{name}"
    transform = content["rig_from_cam"]
    quat, translation = transform["quat_wxyz"], _floats(transform["translation_m"], (3,), where)
    if quat is None:
        rig_from_cam = SE3(np.full((3, 3), np.nan), translation)
    else:
        quat_wxyz = _floats(quat, (4,), where)
        norm = np.linalg.norm(quat_wxyz)
        if not abs(norm - 1) < 1e-3:
            raise InputError(f"{where}: quat_wxyz has norm {norm:.4g}, not 1.")
        rig_from_cam = SE3.from_quat_wxyz(quat_wxyz, translation)
    covariance = content.get("covariance_cam_axes")
    unobservable = tuple(
        UnobservableDirection(
            _finite(d["direction_rig_axes"], (6,), where), str(d["words"]), str(d.get("remedy", ""))
        )
        for d in content.get("undetermined") or ()
    )
    return CalibratedCamera(
        name=name,
        rig_from_cam=rig_from_cam,
        covariance=np.full((6, 6), np.nan) if covariance is None else _covariance(covariance, 6, where),
        unobservable=(*unobservable, *_null_axes(name, rig_from_cam, unobservable)),
        known_offsets=tuple(
            KnownOffset(_floats(k["direction_rig_axes"], (3,), where), float(k["value_m"]), float(k["std_m"]))
            for k in content.get("known_offsets") or ()
        ),
        time_offset_s=_optional_float(content, "time_offset_s", where),
        time_offset_std_s=_optional_float(content, "time_offset_std_s", where),
        scale=_optional_float(content, "scale", where),
        scale_std=_optional_float(content, "scale_std", where),
        model=None if content.get("camera") is None else camera_from_dict(content["camera"]),
        topic=str(content.get("topic") or ""),
        statistics=content.get("statistics") or {},
    )


def calibration_from_dict(content: Any, where: str = "calibration") -> Calibration:
    """The calibration of plain values; raises InputError that names what is missing or wrong."""
    if not isinstance(content, Mapping) or "rigwake_calibration" not in content:
        raise InputError(
            f"{where} is not a rigwake calibration: the key rigwake_calibration is missing.",
            remedy="Give the calibration.yaml that `rigwake calibrate` or `rigwake handeye -o` wrote.",
        )
    version = content["rigwake_calibration"]
    if version != SCHEMA_VERSION:
        raise InputError(
            f"{where} has schema version {version!r}; this rigwake reads version {SCHEMA_VERSION}.",
            remedy="Update rigwake, or calibrate again.",
        )
    try:
        cameras = {
            str(name): _camera_from_dict(str(name), camera, where)
            for name, camera in content["cameras"].items()
        }
        antenna = content.get("antenna")
        joint, size = content.get("joint_covariance"), 6 * len(cameras)
        spread = None if antenna is None else antenna.get("covariance")
        return Calibration(
            reference=str(content["reference"]),
            cameras=cameras,
            joint_covariance=None if joint is None else _covariance(joint, size, where),
            antenna_rig=None if antenna is None else _floats(antenna["position_rig_m"], (3,), where),
            antenna_covariance=None if spread is None else _covariance(spread, 3, where),
            checks=content.get("checks") or {},
            provenance=content.get("provenance") or {},
        )
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{where} is damaged: {type(error).__name__}: {error}.",
            remedy="Compare it with docs/calibration_file.md.",
        ) from error


def load_calibration(path: Path | str) -> Calibration:
    """Read a calibration file, or that of the folder that `calibrate` leaves; raises InputError that names what is
    missing or wrong."""
    kept = Path(path) / "calibration.yaml"
    path = kept if kept.is_file() else path
    return calibration_from_dict(read_yaml(path), str(path))
