"""Kalibr camchain, and the same file as OpenVINS reads it.

Kalibr: `T_cam_imu` maps the IMU's axes to the camera's, `T_cn_cnm1` the previous camera's to this one's,
`t_imu = t_cam + timeshift_cam_imu`. OpenVINS: `T_imu_cam`, the inverse, after a `%YAML:1.0` header.
Sources: kalibr's wiki "yaml formats"; OpenVINS' `kalibr_imucam_chain.yaml` and `InertialInitializer` options.
"""

from __future__ import annotations

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
    keys = sorted((k for k in content if re.fullmatch(r"cam\d+", str(k))), key=lambda k: int(str(k)[3:]))
    entries = [content[key] for key in keys]
    if not all(isinstance(entry, Mapping) for entry in entries):
        raise InputError(f"{path}: a camera of the camchain is not a mapping.")
    names = _names(keys, entries)
    to_imu = [("T_cam_imu" in e) or ("T_imu_cam" in e) for e in entries]
    if any(to_imu) and not all(to_imu):
        raise InputError(f"{path}: only some of the cameras have T_cam_imu or T_imu_cam.")
    cameras: list[CalibratedCamera] = []
    for key, name, entry in zip(keys, names, entries, strict=True):
        rig_from_cam = _rig_from_cam(entry, cameras[-1] if cameras else None, all(to_imu), f"{path}: {key}")
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
    return external_calibration(IMU if any(to_imu) else names[0] if names else "", cameras, path)


def _names(keys: list[Any], entries: list[Mapping[str, Any]]) -> list[str]:
    """The file's own names, else short names of the topics, else cam0, cam1, ..."""
    topics = [str(entry.get("rostopic", "")) for entry in entries]
    if all(topics) and len(set(topics)) == len(topics):
        short = sensor_names(topics, "camera")
        keys = [short[topic] for topic in topics]
    return [str(entry.get("camera_name", key)) for key, entry in zip(keys, entries, strict=True)]


def _rig_from_cam(
    entry: Mapping[str, Any], previous: CalibratedCamera | None, to_imu: bool, where: str
) -> SE3:
    if "T_imu_cam" in entry:
        return transform_from_matrix(entry["T_imu_cam"], where)
    if to_imu:
        return transform_from_matrix(entry["T_cam_imu"], where).inverse()
    if previous is None:
        return SE3.identity()
    if "T_cn_cnm1" not in entry:
        raise InputError(f"{where} has neither T_cam_imu nor T_cn_cnm1.")
    return previous.rig_from_cam * transform_from_matrix(entry["T_cn_cnm1"], where).inverse()


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where} must be a number, it is {value!r}.")
    return float(value)
