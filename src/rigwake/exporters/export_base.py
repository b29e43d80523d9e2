"""What all export formats share: options, what may be written, and calibrations read from files of other tools."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rigwake import __version__
from rigwake._types import Array
from rigwake.atomic import write_text_atomic
from rigwake.calibration import CalibratedCamera, Calibration, UnobservableDirection
from rigwake.calibration.rig_calibration import AXIS_NAMES
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError, UnobservableError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.geometry.so3 import nearest_rotation
from rigwake.text_files import read_text_file
from rigwake.yaml_input import read_yaml

IMU = "imu"
ODOMETRY, REF = "odometry", "ref"
UNNAMED_FRAMES = (ODOMETRY, REF)
"""What CamOdoCal and mrcal call the frame of the rig, whichever it is."""
Notes = list[str]
"""What the user must know about the file that was written: conversions, cameras left out."""


@dataclass(frozen=True)
class ExportedImuNoise:
    """Continuous-time noise of an IMU, as in Kalibr's imu.yaml: densities, random walks, rate in Hz."""

    accel_density: float
    accel_walk: float
    gyro_density: float
    gyro_walk: float
    rate_hz: float
    topic: str = ""


@dataclass(frozen=True)
class ExportOptions:
    """What a user may choose.

    parent_frame, child_frame: names of ROS frames; default the reference and `{name}_optical_frame`.
    imu: noise of the IMU, for the formats that hold it.
    max_fit_error_px: largest departure (px, anywhere in the image) of a lens that had to be converted.
    """

    parent_frame: str = ""
    child_frame: str = "{name}_optical_frame"
    imu: ExportedImuNoise | None = None
    max_fit_error_px: float = 0.5


def observable_part(calibration: Calibration, allow_unobservable: bool) -> tuple[Calibration, Notes]:
    """The cameras that are fully determined, and a note for each that is not.

    Raises UnobservableError if a camera is unobservable (unless allowed), or if none is.
    """
    lost = {name: camera for name, camera in calibration.cameras.items() if not camera.is_observable}
    words = [f"{name}: {', '.join(d.words for d in camera.unobservable)}" for name, camera in lost.items()]
    if lost and not allow_unobservable:
        remedies = sorted({d.remedy for camera in lost.values() for d in camera.unobservable if d.remedy})
        raise UnobservableError(
            f"unobservable: {'; '.join(words)}.",
            consequence="Other programs would take a placeholder for a measurement, so nothing is written.",
            remedy=f"{'; '.join(remedies) or 'Record more motion'}. "
            "Or give --allow-unobservable, which leaves such cameras out.",
        )
    kept = {name: camera for name, camera in calibration.cameras.items() if name not in lost}
    if not kept:
        raise UnobservableError(
            f"unobservable: {'; '.join(words)}.",
            consequence="No camera is left to export.",
            remedy="The formats json and csv hold the parts that are determined.",
        )
    notes = [f"left out, unobservable: {line}" for line in words]
    return replace(calibration, cameras=kept, joint_covariance=None), notes


def header(calibration: Calibration, notes: Iterable[str] = ()) -> list[str]:
    """Comment lines (without the comment sign) for the head of a file: origin, frame, what was left out."""
    lines = [f"written by rigwake {__version__}; the rig frame is {calibration.reference}", *notes]
    return [" ".join(line.split()) for line in lines]  # a line break in a name must not end the comment


def require_reference(calibration: Calibration, wanted: str, format_name: str) -> None:
    """Raises UsageError unless the cameras refer to this frame."""
    if calibration.reference != wanted:
        raise UsageError(
            f"{format_name} holds cameras relative to the {wanted}; this calibration refers to "
            f"{calibration.reference}.",
            remedy=f"Calibrate with --reference {wanted}.",
        )


def require_lenses(calibration: Calibration, format_name: str) -> dict[str, CameraModel]:
    """The lens of every camera; UsageError names those that have none."""
    lenses = {name: camera.model for name, camera in calibration.cameras.items()}
    missing = [name for name, model in lenses.items() if model is None]
    if missing:
        raise UsageError(
            f"{format_name} holds intrinsics, but the calibration has no lens for {', '.join(missing)}.",
            remedy="Export to ros-static-tf, urdf, json or csv, which hold transforms alone.",
        )
    return {name: model for name, model in lenses.items() if model is not None}


def refer_to_camera(calibration: Calibration, name: str) -> Calibration:
    """The same rig seen from one of its cameras, as transforms only (covariances are NaN)."""
    cam_from_rig = calibration.camera(name).rig_from_cam.inverse()
    cameras = {
        other: replace(
            camera,
            rig_from_cam=SE3.identity() if other == name else cam_from_rig * camera.rig_from_cam,
            covariance=np.full((6, 6), np.nan),
        )
        for other, camera in calibration.cameras.items()
    }
    return Calibration(name, cameras, provenance=calibration.provenance)


def file_stem(camera: str) -> str:
    """A camera's name as part of a file name; UsageError if it cannot be one."""
    if not re.fullmatch(r"\w[\w.\-]*", camera):
        raise UsageError(
            f"The camera name {camera!r} cannot be a file name.",
            remedy="Rename it in the calibration file to letters, digits, _, - and dots.",
        )
    return camera


def external_calibration(reference: str, cameras: Iterable[CalibratedCamera], path: Path) -> Calibration:
    """A calibration read from another program's file; InputError if it names no or equal cameras."""
    by_name: dict[str, CalibratedCamera] = {}
    for camera in cameras:
        if camera.name in by_name:
            raise InputError(f"{path} names the camera {camera.name!r} twice.")
        by_name[camera.name] = camera
    if not by_name:
        raise InputError(f"{path} holds no camera.")
    return Calibration(reference, by_name, provenance={"imported_from": path.name})


def external_camera(
    name: str,
    rig_from_cam: SE3,
    model: CameraModel | None = None,
    time_offset_s: float | None = None,
    topic: str = "",
) -> CalibratedCamera:
    """A camera read from another program's file: without covariance, since those files hold none.

    NaN in `rig_from_cam` stands for what is unobservable.
    """
    lost = np.isnan([*rig_from_cam.rotation[:, 0], *rig_from_cam.translation])
    return CalibratedCamera(
        name,
        rig_from_cam,
        np.full((6, 6), np.nan),
        tuple(
            UnobservableDirection(np.eye(6)[axis], f"{AXIS_NAMES[axis]} of {name}")
            for axis in np.flatnonzero(lost)
        ),
        time_offset_s=time_offset_s,
        model=model,
        topic=topic,
    )


def transform_from_matrix(matrix: object, where: str) -> SE3:
    """A transform of a 3 x 4 or 4 x 4 matrix in a file; InputError if it is not a rigid motion."""
    try:
        m = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: a matrix holds something that is not a number.") from error
    if m.shape not in ((3, 4), (4, 4)) or not np.isfinite(m).all():
        raise InputError(f"{where}: a transform must be 3 x 4 or 4 x 4 and finite, it has shape {m.shape}.")
    rotation = nearest_rotation(m[:3, :3])
    if np.abs(rotation - m[:3, :3]).max() > 1e-3:
        raise InputError(f"{where}: the 3 x 3 block is not a rotation.", remedy="Check the file.")
    # files with few digits are projected onto rotations; those of full precision stay to the last digit
    return SE3(m[:3, :3] if np.abs(rotation - m[:3, :3]).max() < 1e-14 else rotation, m[:3, 3])


def transform_from_parts(quat_wxyz: object, translation: object, where: str) -> SE3:
    """A transform of a quaternion and a translation in a file; InputError if they are none."""
    try:
        q = np.array(quat_wxyz, dtype=np.float64)
        t = np.array(translation, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: a transform holds something that is not a number.") from error
    finite = q.shape == (4,) and t.shape == (3,) and np.isfinite(q).all() and np.isfinite(t).all()
    if not finite or abs(np.linalg.norm(q) - 1) > 1e-3:
        raise InputError(f"{where}: a transform needs a unit quaternion and three finite coordinates.")
    return SE3.from_quat_wxyz(q, t)


def rows(matrix: Array) -> list[list[float]]:
    """Rows of a matrix as plain floats."""
    return [[float(x) for x in row] for row in matrix]


class _IndentedDumper(yaml.SafeDumper):
    """Sequences are indented below their key, which cv::FileStorage insists on."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        """Never without indentation."""
        super().increase_indent(flow, False)


def yaml_text(content: object, comments: Iterable[str], first_line: str = "") -> str:
    """YAML of plain values with full precision, innermost lists on one line, after a header."""
    body = yaml.dump(
        content,
        Dumper=_IndentedDumper,
        sort_keys=False,
        default_flow_style=None,
        width=4096,
        allow_unicode=True,
    )
    lead = [first_line] if first_line else []
    return "\n".join([*lead, *(f"# {line}" for line in comments), body])


def write_files(files: Mapping[Path, str]) -> Notes:
    """Write several files, once all of them exist as text, so that a refusal leaves nothing behind.

    Notes name files of the same kind in these folders that are not part of what is written.
    """
    for path, text in files.items():
        write_text_atomic(path, text)
    kinds = {(path.parent, path.suffix) for path in files}
    strangers = sorted(f for folder, suffix in kinds for f in folder.glob(f"*{suffix}") if f not in files)
    return [f"{file} was there before and is not part of this calibration" for file in strangers]


def read_text(path: Path) -> str:
    """The text of a small file; InputError if it cannot be read or is larger than any calibration."""
    return read_text_file(path, _LARGEST_BYTES)


def read_json_file(path: Path) -> Any:
    """The content of a JSON file; InputError if it is none."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not JSON: {error}.") from error


def read_yaml_file(path: Path) -> Any:
    """The content of a YAML file, with OpenCV's header or without; InputError if it is none."""
    return read_yaml(path)


_LARGEST_BYTES = 100 * 1024 * 1024  # mrcal keeps its optimisation inputs in the file
