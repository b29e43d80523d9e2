"""OpenCV: a folder with one FileStorage YAML per camera, its lens and `rig_from_cam` (4 x 4).

The lens stands there as OpenCV and ROS write it; `rig_frame`, `camera_name`, `rig_from_cam` and `time_offset_s`
are added. Lenses of four coefficients say by `fisheye_model` which model is meant.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rigwake._types import Array
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.cameras.formats.opencv_yaml import camera_from_opencv, camera_to_opencv
from rigwake.errors import InputError
from rigwake.exporters.export_base import (
    ExportOptions,
    Notes,
    external_calibration,
    external_camera,
    file_stem,
    header,
    read_yaml_file,
    require_lenses,
    transform_from_matrix,
    write_files,
)
from rigwake.exporters.lenses import write_lens

_LENSES = ("kb4", "rational", "pinhole")
_MARK = "rig_from_cam"


def write_opencv(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """The folder, `NAME.yaml` per camera."""
    more: Notes = []
    files: dict[Path, str] = {}
    comments = [f"# {line}" for line in header(calibration, notes)]
    for name, lens in require_lenses(calibration, "OpenCV").items():
        text, _, lens_notes = write_lens(lens, camera_to_opencv, _LENSES, options.max_fit_error_px, name)
        more += lens_notes
        camera = calibration.cameras[name]
        lines = [
            text.rstrip("\n"),
            *comments,
            "# p_rig = rig_from_cam * p_cam",
            f'camera_name: "{file_stem(name)}"',
            f'rig_frame: "{_quoted(calibration.reference)}"',
            f'topic: "{_quoted(camera.topic)}"',
            f"{_MARK}: {_matrix(camera.rig_from_cam.matrix)}",
        ]
        if camera.time_offset_s is not None:
            lines.append(f"time_offset_s: {camera.time_offset_s!r}")
        files[path / f"{file_stem(name)}.yaml"] = "\n".join(lines) + "\n"
    return [*more, *write_files(files)]


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _matrix(matrix: Array) -> str:
    listed = ", ".join(repr(float(x)) for x in matrix.ravel())
    rows, cols = matrix.shape
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {listed} ]"


def is_opencv_rig(text: str) -> bool:
    """Whether an OpenCV YAML file also says where the camera sits."""
    return f"\n{_MARK}:" in text


def read_opencv(path: Path) -> Calibration:
    """One such file, or all of a folder."""
    files = sorted(path.glob("*.yaml")) if path.is_dir() else [path]
    cameras: list[CalibratedCamera] = []
    frames: set[str] = set()
    for file in files:
        content = read_yaml_file(file)
        if not isinstance(content, Mapping) or _MARK not in content:
            raise InputError(f"{file} does not hold {_MARK}.")
        matrix = content[_MARK]
        try:
            values = [float(x) for x in matrix["data"]]
            rows = [values[4 * k : 4 * k + 4] for k in range(int(matrix["rows"]))]
            offset = content.get("time_offset_s")
            offset_s = None if offset is None else float(offset)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{file}: {_MARK} is no matrix: {type(error).__name__}: {error}.") from error
        frames.add(str(content.get("rig_frame", "rig")))
        cameras.append(
            external_camera(
                str(content.get("camera_name", file.stem)),
                transform_from_matrix(rows, str(file)),
                camera_from_opencv(content),
                offset_s,
                str(content.get("topic", "")),
            )
        )
    if len(frames) > 1:
        raise InputError(f"{path}: the cameras refer to different frames: {', '.join(sorted(frames))}.")
    return external_calibration(next(iter(frames), "rig"), cameras, path)
