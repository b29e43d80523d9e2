"""Camera files: this project's YAML, and whatever else users have, told apart by their content."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from rigwake.atomic import write_text_atomic
from rigwake.cameras.formats.camera_dicts import (
    camera_from_basalt,
    camera_from_colmap,
    camera_from_kalibr,
    camera_to_basalt,
    camera_to_colmap,
    camera_to_kalibr,
)
from rigwake.cameras.formats.ocamcalib import camera_from_ocamcalib, camera_to_ocamcalib
from rigwake.cameras.formats.opencv_yaml import (
    camera_from_camodocal,
    camera_from_opencv,
    camera_to_camodocal,
    camera_to_opencv,
)
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_dict, camera_to_dict
from rigwake.cameras.slam_lenses import cameras_from_orbslam, is_orbslam
from rigwake.errors import CameraError, InputError, UsageError
from rigwake.text_files import read_text_file
from rigwake.yaml_input import parse_yaml

Cameras = dict[str, CameraModel]

_MAX_FILE_BYTES = 20_000_000
HEADER = """\
# Cameras by name, as rigwake knows them: docs/cameras.md tells the equation and the parameters of every model.
# Pixel (0, 0) is the centre of the top-left pixel. max_angle_deg: where the lens ends, if that is known.
"""


def read_cameras(path: Path | str, *, fisheye: bool | None = None) -> Cameras:
    """Cameras by name, from any of the known files.

    Known: this project's YAML, Kalibr camchains (and EuRoC's sensor.yaml), OpenCV, ROS and CamOdoCal YAML,
    ORB-SLAM settings,
    OCamCalib's text, Basalt's JSON, COLMAP's cameras.txt. A file of one camera names it by its own name, or
    by the file's stem. fisheye: what an OpenCV file with four coefficients means, if it does not say.
    Raises InputError for a file that cannot be read or is none of these, CameraError for a lens that is not
    known.
    """
    file = Path(path)
    text = read_text_file(file, _MAX_FILE_BYTES)
    try:
        cameras = _parse(text, file.stem, fisheye)
    except CameraError as error:
        raise CameraError(
            f"{file.name}: {error.cause}", consequence=error.consequence, remedy=error.remedy
        ) from error
    if not cameras:
        raise InputError(
            f"{file} holds no camera that is known here.",
            remedy="docs/cameras.md lists the formats that can be read.",
        )
    return cameras


def read_camera(path: Path | str, name: str | None = None, *, fisheye: bool | None = None) -> CameraModel:
    """The one camera of a file, or the one of this name; UsageError lists what is there."""
    cameras = read_cameras(path, fisheye=fisheye)
    if name is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if name is None or name not in cameras:
        wanted = "one camera is wanted" if name is None else f"there is no camera {name!r}"
        raise UsageError(f"{path}: {wanted}.", remedy=f"It has: {', '.join(cameras)}.")
    return cameras[name]


def _parse(text: str, stem: str, fisheye: bool | None) -> Cameras:
    if text.lstrip().startswith("#") and "#polynomial coefficients" in text:
        return {stem: camera_from_ocamcalib(text)}
    if text.lstrip().startswith("{"):
        return _from_basalt(text)
    colmap = _from_colmap(text)
    if colmap:
        return colmap
    try:
        plain = parse_yaml(text, "its text")
    except InputError as error:
        raise CameraError(error.cause) from error
    if not isinstance(plain, Mapping):
        return {}
    if is_orbslam(plain):
        return cameras_from_orbslam(plain)
    if "model_type" in plain:
        return {str(plain.get("camera_name") or stem): camera_from_camodocal(plain)}
    if "camera_model" in plain:
        return {stem: camera_from_kalibr(plain)}
    if "model" in plain and "params" in plain:
        return {stem: camera_from_dict(plain)}
    if any(key in plain for key in ("camera_matrix", "K", "Camera_Matrix", "intrinsic_matrix")):
        return {str(plain.get("camera_name") or stem): camera_from_opencv(plain, fisheye=fisheye)}
    entries = plain.get("cameras", plain)
    return _from_entries(entries) if isinstance(entries, Mapping) else {}


def _from_entries(entries: Mapping[Any, Any]) -> Cameras:
    cameras: Cameras = {}
    for name, entry in entries.items():
        if not isinstance(entry, Mapping):
            continue
        nested = entry.get("camera", entry)  # a calibration file keeps the lens under `camera`
        if isinstance(nested, Mapping) and "model" in nested and "params" in nested:
            cameras[str(name)] = camera_from_dict(nested)
        elif "camera_model" in entry:
            cameras[str(name)] = camera_from_kalibr(entry)
    return cameras


def _from_basalt(text: str) -> Cameras:
    try:
        content = json.loads(text)["value0"]
        pairs = list(zip(content["intrinsics"], content["resolution"], strict=True))
    except (ValueError, KeyError, TypeError) as error:
        raise CameraError(f"This JSON is not a Basalt calibration: {error!r}.") from error
    return {f"cam{i}": camera_from_basalt(entry, size) for i, (entry, size) in enumerate(pairs)}


def _from_colmap(text: str) -> Cameras:
    """Cameras of a COLMAP cameras.txt, or nothing if any line is not of its form."""
    cameras: Cameras = {}
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5 or not words[0].isdigit() or not words[1].replace("_", "").isalnum():
            return {}
        try:
            size, params = (int(words[2]), int(words[3])), [float(word) for word in words[4:]]
        except ValueError:
            return {}
        cameras[words[0]] = camera_from_colmap(words[1], params, *size)
    return cameras


def _single(cameras: Cameras) -> CameraModel:
    if len(cameras) != 1:
        raise UsageError(
            "This format holds one camera per file.", remedy=f"Choose one of {', '.join(cameras)}."
        )
    return next(iter(cameras.values()))


def _yaml(plain: Any) -> str:
    return yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)


def _colmap_text(cameras: Cameras) -> str:
    rows = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for i, camera in enumerate(cameras.values(), start=1):
        model, params = camera_to_colmap(camera)
        rows.append(f"{i} {model} {camera.width_px} {camera.height_px} {' '.join(map(repr, params))}")
    return "\n".join(rows) + "\n"


def _basalt_text(cameras: Cameras) -> str:
    entries = [camera_to_basalt(camera) for camera in cameras.values()]
    sizes = [[camera.width_px, camera.height_px] for camera in cameras.values()]
    return json.dumps({"value0": {"intrinsics": entries, "resolution": sizes}}, indent=2) + "\n"


def cameras_to_text(cameras: Mapping[str, CameraModel]) -> str:
    """This project's YAML of cameras by name."""
    return HEADER + _yaml({"cameras": {name: camera_to_dict(camera) for name, camera in cameras.items()}})


WRITERS: dict[str, Callable[[Cameras], str]] = {
    "rigwake": cameras_to_text,
    "kalibr": lambda cameras: _yaml(
        {f"cam{i}": camera_to_kalibr(camera) for i, camera in enumerate(cameras.values())}
    ),
    "opencv": lambda cameras: camera_to_opencv(_single(cameras)),
    "camodocal": lambda cameras: camera_to_camodocal(_single(cameras), next(iter(cameras))),
    "ocamcalib": lambda cameras: camera_to_ocamcalib(_single(cameras)),
    "basalt": _basalt_text,
    "colmap": _colmap_text,
}


def write_cameras(path: Path | str, cameras: Mapping[str, CameraModel], file_format: str = "rigwake") -> None:
    """Write cameras in one of the `WRITERS`' formats, atomically; those of one camera per file refuse more."""
    if file_format not in WRITERS:
        raise UsageError(
            f"There is no camera format {file_format!r}.", remedy=f"Known: {', '.join(WRITERS)}."
        )
    write_text_atomic(path, WRITERS[file_format](dict(cameras)))
