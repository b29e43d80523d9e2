"""CamOdoCal: a folder with `extrinsic.txt` and one `NAME_calib.yaml` per camera.

`extrinsic.txt` holds per camera its name, the three rows of the 3 x 4 matrix that maps camera to odometry
axes, and a blank line. Source: camodocal, `CameraSystem::writePosesToTextFile`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rigwake.calibration import Calibration
from rigwake.cameras.formats.opencv_yaml import camera_from_camodocal, camera_to_camodocal
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError
from rigwake.exporters.export_base import (
    ODOMETRY,
    ExportOptions,
    Notes,
    external_calibration,
    external_camera,
    file_stem,
    read_text,
    read_yaml_file,
    transform_from_matrix,
    write_files,
)
from rigwake.exporters.lenses import write_lens

EXTRINSICS = "extrinsic.txt"
_LENSES = ("kb4", "mei", "pinhole")


def write_camodocal(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """The folder; cameras without a lens get no `NAME_calib.yaml`."""
    more: Notes = []
    lines: list[str] = []
    files: dict[Path, str] = {}
    for name, camera in calibration.cameras.items():
        if camera.model is not None:
            text, _, lens_notes = write_lens(
                camera.model,
                lambda lens, name=name: camera_to_camodocal(lens, name),  # type: ignore[misc]
                _LENSES,
                options.max_fit_error_px,
                name,
            )
            files[path / _file_name(name)] = text
            more += lens_notes
        matrix = camera.rig_from_cam.matrix[:3]
        lines += [name, *(" ".join(repr(float(x)) for x in row) for row in matrix), ""]
    files[path / EXTRINSICS] = "\n".join(lines) + "\n"
    return [*more, *write_files(files), f"camera to {calibration.reference}, which CamOdoCal calls odometry"]


def read_camodocal(path: Path) -> Calibration:
    """The cameras of an `extrinsic.txt` (or its folder), with the lenses that stand beside it."""
    path = path / EXTRINSICS if path.is_dir() else path
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    if not lines or len(lines) % 4:
        raise InputError(f"{path}: {len(lines)} lines, but a camera is a name and three rows.")
    cameras = []
    for start in range(0, len(lines), 4):
        name = lines[start]
        matrix = [row.split() for row in lines[start + 1 : start + 4]]
        if any(len(row) != 4 for row in matrix):
            raise InputError(f"{path}: {name}: a row must hold four numbers.")
        cameras.append(
            external_camera(name, transform_from_matrix(matrix, f"{path}: {name}"), _lens(path.parent, name))
        )
    return external_calibration(ODOMETRY, cameras, path)


def _file_name(camera: str) -> str:
    return f"{file_stem(camera)}_calib.yaml"


def _lens(folder: Path, name: str) -> CameraModel | None:
    file = folder / _file_name(name)
    if not file.is_file():
        return None
    content = read_yaml_file(file)
    if not isinstance(content, Mapping):
        raise InputError(f"{file} holds no lens.")
    return camera_from_camodocal(content)
