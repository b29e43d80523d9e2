"""COLMAP: a folder with `rig_config.json` and `cameras.txt`.

One camera is the reference sensor, without pose; the others have `cam_from_rig`, where rig means that camera.
COLMAP's pixel (0, 0) is the corner of the image, so principal points are shifted by half a pixel.
Source: https://colmap.github.io/rigs.html and `colmap/scene/rig.cc`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.cameras.formats.camera_dicts import camera_from_colmap, camera_to_colmap
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError
from rigwake.exporters.export_base import (
    ExportOptions,
    Notes,
    external_calibration,
    external_camera,
    header,
    read_json_file,
    read_text,
    refer_to_camera,
    require_lenses,
    transform_from_parts,
    write_files,
)
from rigwake.exporters.lenses import write_lens
from rigwake.geometry.se3 import SE3

RIG = "rig_config.json"
CAMERAS = "cameras.txt"
_LENSES = ("kb4", "rational", "pinhole")


def write_colmap(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """The folder; images of a camera are expected under `NAME/`."""
    lenses = require_lenses(calibration, "COLMAP")
    first = next(iter(lenses))
    seen_from_first = refer_to_camera(calibration, first)
    entries: list[dict[str, Any]] = []
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    more = [f"relative to {first}: COLMAP's rig frame is that of one camera, not {calibration.reference}"]
    if calibration.reference == first:
        more = []
    for number, (name, lens) in enumerate(lenses.items(), start=1):
        (model, params), written, lens_notes = write_lens(
            lens, camera_to_colmap, _LENSES, options.max_fit_error_px, name
        )
        more += lens_notes
        if model == "OPENCV_FISHEYE" and written.max_angle > np.pi / 2:
            more.append(
                f"{name}: COLMAP's OPENCV_FISHEYE is wrong beyond 90 degrees off the axis; mask what lies there"
            )
        entry: dict[str, Any] = {"image_prefix": f"{name}/"}
        if name == first:
            entry["ref_sensor"] = True
        else:
            cam_from_rig = seen_from_first.cameras[name].rig_from_cam.inverse()
            entry["cam_from_rig_rotation"] = [float(x) for x in cam_from_rig.quat_wxyz]
            entry["cam_from_rig_translation"] = [float(x) for x in cam_from_rig.translation]
        entries.append({**entry, "camera_model_name": model, "camera_params": params})
        values = " ".join(repr(float(p)) for p in params)
        lines.append(f"{number} {model} {written.width_px} {written.height_px} {values}")
    comments = [f"# {line}" for line in header(calibration, notes + more)]
    files = {
        path / RIG: json.dumps([{"cameras": entries}], indent=2, allow_nan=False) + "\n",
        path / CAMERAS: "\n".join([*comments, *lines]) + "\n",
    }
    return [*more, *write_files(files)]


def read_colmap(path: Path) -> Calibration:
    """The first rig of a rig config (or of its folder); image sizes come from a `cameras.txt` beside it."""
    path = path / RIG if path.is_dir() else path
    try:
        entries = read_json_file(path)[0]["cameras"]
        sizes = _image_sizes(path.parent / CAMERAS)
        if sizes and len(sizes) != len(entries):
            raise InputError(f"{path}: {len(entries)} cameras, but {len(sizes)} in {CAMERAS}.")
        cameras = [_camera(entry, sizes[k] if sizes else None, path) for k, entry in enumerate(entries)]
        references = [c.name for c, e in zip(cameras, entries, strict=True) if e.get("ref_sensor")]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is not a rig config of COLMAP: {type(error).__name__}: {error}.") from error
    if len(references) != 1:
        raise InputError(f"{path}: {len(references)} reference sensors, exactly one is needed.")
    return external_calibration(references[0], cameras, path)


def _camera(entry: Any, size: tuple[int, int] | None, path: Path) -> CalibratedCamera:
    name = str(entry["image_prefix"]).strip("/")
    rig_from_cam = SE3.identity()
    if not entry.get("ref_sensor"):
        cam_from_rig = transform_from_parts(
            entry["cam_from_rig_rotation"], entry["cam_from_rig_translation"], f"{path}: {name}"
        )
        rig_from_cam = cam_from_rig.inverse()
    model: CameraModel | None = None
    if size is not None and "camera_model_name" in entry:
        model = camera_from_colmap(str(entry["camera_model_name"]), entry["camera_params"], *size)
    return external_camera(name, rig_from_cam, model)


def _image_sizes(path: Path) -> list[tuple[int, int]]:
    """Widths and heights of `cameras.txt`, in the order of the camera ids; empty without the file."""
    if not path.is_file():
        return []
    table = [line.split() for line in read_text(path).splitlines() if line.strip() and line[0] != "#"]
    return [(int(row[2]), int(row[3])) for row in sorted(table, key=lambda row: int(row[0]))]
