"""Kalibr camchain, and the same file as OpenVINS reads it.

Kalibr: `T_cam_imu` maps the IMU's axes to the camera's, `T_cn_cnm1` the previous camera's to this one's,
`t_imu = t_cam + timeshift_cam_imu`. OpenVINS: `T_imu_cam`, the inverse, after a `%YAML:1.0` header.
Sources: kalibr's wiki "yaml formats"; OpenVINS' `kalibr_imucam_chain.yaml` and `InertialInitializer` options.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rigwake.atomic import write_text_atomic
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.cameras.formats.camera_dicts import camera_from_kalibr, camera_to_kalibr
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError, InputError
from rigwake.exporters.export_base import (
    IMU,
    ExportOptions,
    Notes,
    external_calibration,
    external_camera,
    header,
    read_yaml_file,
    require_lenses,
    require_reference,
    rows,
    transform_from_matrix,
    yaml_text,
)
from rigwake.exporters.lenses import write_lens
from rigwake.geometry.se3 import SE3
from rigwake.readers.topics import sensor_names

_CAMERA_KEYS = {"T_cam_imu", "T_imu_cam", "T_cn_cnm1", "camera_model"}
_KALIBR_LENSES = ("kb4", "mei", "ds", "eucm", "pinhole")
_OPENVINS_LENSES = ("kb4", "pinhole")


def write_kalibr(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """A camchain; without IMU as reference the cameras are chained to each other only."""
    entries, more = _entries(calibration, options, "Kalibr", camera_to_kalibr, _KALIBR_LENSES)
    if calibration.reference != IMU:
        more.append(f"no T_cam_imu: the cameras refer to {calibration.reference}, not to an IMU")
    previous: SE3 | None = None
    for entry, camera in zip(entries.values(), calibration.cameras.values(), strict=True):
        entry["cam_overlaps"] = []
        cam_from_rig = camera.rig_from_cam.inverse()
        if previous is not None:
            entry["T_cn_cnm1"] = rows((cam_from_rig * previous).matrix)
        if calibration.reference == IMU:
            entry["T_cam_imu"] = rows(cam_from_rig.matrix)
            if camera.time_offset_s is not None:
                entry["timeshift_cam_imu"] = camera.time_offset_s
        previous = camera.rig_from_cam
    write_text_atomic(path, yaml_text(entries, header(calibration, notes + more)))
    return more


def write_openvins(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """OpenVINS' `kalibr_imucam_chain.yaml`."""
    require_reference(calibration, IMU, "OpenVINS")
    entries, more = _entries(calibration, options, "OpenVINS", _openvins_lens, _OPENVINS_LENSES)
    for entry, camera in zip(entries.values(), calibration.cameras.values(), strict=True):
        entry["T_imu_cam"] = rows(camera.rig_from_cam.matrix)
        entry["cam_overlaps"] = []
        if camera.time_offset_s is not None:
            entry["timeshift_cam_imu"] = camera.time_offset_s
    write_text_atomic(path, yaml_text(entries, header(calibration, notes + more), "%YAML:1.0"))
    return more


def _openvins_lens(camera: CameraModel) -> dict[str, Any]:
    entry = camera_to_kalibr(camera)
    if entry["camera_model"] != "pinhole" or entry["distortion_model"] not in ("radtan", "equidistant"):
        raise CameraError(f"OpenVINS has no form for a {camera.model} lens.")
    return entry


def _entries(
    calibration: Calibration,
    options: ExportOptions,
    format_name: str,
    write: Callable[[CameraModel], dict[str, Any]],
    lenses: tuple[str, ...],
) -> tuple[dict[str, dict[str, Any]], Notes]:
    """`cam0: {lens, rostopic}, cam1: ...`; the camera's own name stands under a key that others ignore."""
    entries: dict[str, dict[str, Any]] = {}
    notes: Notes = []
    for number, (name, lens) in enumerate(require_lenses(calibration, format_name).items()):
        entry, _, more = write_lens(lens, write, lenses, options.max_fit_error_px, name)
        topic = calibration.cameras[name].topic
        entries[f"cam{number}"] = {"camera_name": name, **entry, "rostopic": topic or f"/{name}/image_raw"}
        notes += more
    return entries, notes


def read_kalibr(path: Path) -> Calibration:
    """A camchain of Kalibr or OpenVINS; the reference is the IMU, or without it the first camera."""
    content = read_yaml_file(path)
    if not isinstance(content, Mapping):
        raise InputError(f"{path} is not a camchain.")
    keys = camchain_keys(content)
    entries = [content[key] for key in keys]
    if not all(isinstance(entry, Mapping) for entry in entries):
        raise InputError(f"{path}: a camera of the camchain is not a mapping.")
    names = _names(keys, entries)
    reference, placed = _placed(keys, entries, path)
    cameras: list[CalibratedCamera] = []
    for key, name, entry, rig_from_cam in zip(keys, names, entries, placed, strict=True):
        shift = entry.get("timeshift_cam_imu")
        cameras.append(
            external_camera(
                name,
                rig_from_cam,
                camera_from_kalibr(entry) if "intrinsics" in entry else None,
                None if shift is None else _number(shift, f"{path}: {key}: timeshift_cam_imu"),
                str(entry.get("rostopic", "")),
            )
        )
    return external_calibration(reference or (names[0] if names else ""), cameras, path)


def camchain_keys(content: Mapping[Any, Any]) -> list[Any]:
    """The keys of the cameras: cam0, cam1, ... in the order of their numbers, else all that look like cameras."""
    numbered = [k for k in content if re.fullmatch(r"cam\d{1,9}", str(k))]
    if numbered:
        return sorted(numbered, key=lambda k: int(str(k)[3:]))
    return [k for k, e in content.items() if isinstance(e, Mapping) and not _CAMERA_KEYS.isdisjoint(e)]


def _placed(keys: list[Any], entries: list[Mapping[str, Any]], path: Path) -> tuple[str, list[SE3]]:
    """IMU (or empty: the first camera) as reference, and `rig_from_cam` of all.

    One camera's place relative to the IMU is enough: `T_cn_cnm1` leads on from it in both directions.
    """
    links = [
        transform_from_matrix(entry["T_cn_cnm1"], f"{path}: {key}: T_cn_cnm1")
        if "T_cn_cnm1" in entry
        else None
        for key, entry in zip(keys, entries, strict=True)
    ]
    known = [_to_imu(entry, f"{path}: {key}") for key, entry in zip(keys, entries, strict=True)]
    reference = IMU if any(x is not None for x in known) else ""
    if not reference and known:
        known[0] = SE3.identity()
    for at in range(1, len(known)):
        before, link = known[at - 1], links[at]
        if known[at] is None and before is not None and link is not None:
            known[at] = before * link.inverse()
    for at in range(len(known) - 1, 0, -1):
        after, link = known[at], links[at]
        if known[at - 1] is None and after is not None and link is not None:
            known[at - 1] = after * link
    lost = [str(key) for key, x in zip(keys, known, strict=True) if x is None]
    if lost:
        raise InputError(
            f"{path}: {', '.join(lost)} has neither T_cam_imu (T_imu_cam) nor T_cn_cnm1 to a camera that has."
        )
    return reference, [x for x in known if x is not None]


def _to_imu(entry: Mapping[str, Any], where: str) -> SE3 | None:
    if "T_imu_cam" in entry:
        return transform_from_matrix(entry["T_imu_cam"], where)
    return transform_from_matrix(entry["T_cam_imu"], where).inverse() if "T_cam_imu" in entry else None


def _names(keys: list[Any], entries: list[Mapping[str, Any]]) -> list[str]:
    """The file's own names, else short names of the topics, else cam0, cam1, ..."""
    topics = [str(entry.get("rostopic", "")) for entry in entries]
    if all(topics) and len(set(topics)) == len(topics):
        short = sensor_names(topics, "camera")
        keys = [short[topic] for topic in topics]
    return [str(entry.get("camera_name", key)) for key, entry in zip(keys, entries, strict=True)]


def _number(value: Any, where: str) -> float:
    try:
        number = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} must be a number, it is {value!r}.") from error
    if not math.isfinite(number):
        raise InputError(f"{where} must be a finite number, it is {value!r}.")
    return number
