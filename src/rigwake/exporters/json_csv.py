"""Plain JSON (the calibration file's own schema) and CSV (one row per camera, for spreadsheets).

Both hold what is unobservable as null or as an empty cell, so that nothing has to be left out.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np

from rigwake._types import Array
from rigwake.atomic import write_text_atomic
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.calibration.yaml_file import calibration_from_dict, calibration_to_dict
from rigwake.errors import InputError
from rigwake.exporters.export_base import (
    ExportOptions,
    Notes,
    external_calibration,
    external_camera,
    read_json_file,
    read_text,
    transform_from_parts,
)
from rigwake.geometry.euler import yaw_pitch_roll
from rigwake.geometry.se3 import SE3

_QUATERNION, _POSITION = ("qw", "qx", "qy", "qz"), ("x_m", "y_m", "z_m")
_COLUMNS = (
    "camera",
    "rig_frame",
    *_POSITION,
    *_QUATERNION,
    *("yaw_deg", "pitch_deg", "roll_deg"),
    *("std_rotation_x_deg", "std_rotation_y_deg", "std_rotation_z_deg"),
    *("std_x_m", "std_y_m", "std_z_m"),
    *("time_offset_s", "time_offset_std_s", "topic"),
)


def write_json(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """The calibration file as JSON."""
    text = json.dumps(calibration_to_dict(calibration), indent=2, allow_nan=False)
    write_text_atomic(path, text + "\n")
    return []


def read_json(path: Path) -> Calibration:
    """What `write_json` wrote."""
    return calibration_from_dict(read_json_file(path), str(path))


def write_csv(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """One row per camera: rig_from_cam with its standard deviations (axes of the rig)."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for camera in calibration.cameras.values():
        writer.writerow(_row(camera, calibration.reference))
    write_text_atomic(path, table.getvalue())
    return []


def _row(camera: CalibratedCamera, reference: str) -> list[str]:
    rotation = camera.rig_from_cam.rotation
    known = bool(np.isfinite(rotation).all())
    quat_wxyz = camera.rig_from_cam.quat_wxyz if known else np.full(4, np.nan)
    angles_deg = np.rad2deg(yaw_pitch_roll(rotation)) if known else np.full(3, np.nan)
    numbers: list[float | None] = [
        *camera.rig_from_cam.translation,
        *quat_wxyz,
        *angles_deg,
        *camera.std_rotation_deg,
        *camera.std_translation_m,
        camera.time_offset_s,
        camera.time_offset_std_s,
    ]
    cells = ["" if value is None or not np.isfinite(value) else repr(float(value)) for value in numbers]
    return [_cell(camera.name), _cell(reference), *cells, _cell(camera.topic)]


def _cell(text: str) -> str:
    """Text that a spreadsheet will not take for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@") else text


def read_csv(path: Path) -> Calibration:
    """What `write_csv` wrote; empty cells are what is unobservable."""
    try:
        table = list(csv.DictReader(io.StringIO(read_text(path))))
    except csv.Error as error:
        raise InputError(f"{path} is not a table: {error}.") from error
    missing = {"camera", *_POSITION, *_QUATERNION} - set(table[0] if table else ())
    if missing:
        raise InputError(f"{path} lacks the columns {', '.join(sorted(missing))}.")
    cameras = [_camera(row, f"{path}: {row['camera']}") for row in table]
    frames = {row.get("rig_frame") or "rig" for row in table}
    if len(frames) > 1:
        raise InputError(f"{path}: the cameras refer to different frames: {', '.join(sorted(frames))}.")
    return external_calibration(frames.pop(), cameras, path)


def _numbers(row: dict[str, str], columns: tuple[str, ...], where: str) -> Array:
    try:
        return np.array([float(row[column]) if row[column] else np.nan for column in columns])
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {', '.join(columns)} must be numbers or empty.") from error


def _camera(row: dict[str, str], where: str) -> CalibratedCamera:
    quat_wxyz, position = _numbers(row, _QUATERNION, where), _numbers(row, _POSITION, where)
    if np.isfinite(quat_wxyz).all() and np.isfinite(position).all():
        rig_from_cam = transform_from_parts(quat_wxyz, position, where)
    elif np.isfinite(quat_wxyz).all():
        rig_from_cam = SE3(transform_from_parts(quat_wxyz, np.zeros(3), where).rotation, position)
    else:
        rig_from_cam = SE3(np.full((3, 3), np.nan), position)
    offset = row.get("time_offset_s")
    offset_s = float(_numbers(row, ("time_offset_s",), where)[0]) if offset else None
    return external_camera(row["camera"], rig_from_cam, time_offset_s=offset_s, topic=row.get("topic") or "")
