"""All formats by name; which of them a file is."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rigwake.calibration import Calibration, load_calibration
from rigwake.cameras.slam_lenses import is_orbslam
from rigwake.errors import InputError, UsageError
from rigwake.exporters.basalt import read_basalt, write_basalt
from rigwake.exporters.camodocal import EXTRINSICS, read_camodocal, write_camodocal
from rigwake.exporters.colmap import RIG, read_colmap, write_colmap
from rigwake.exporters.export_base import (
    ExportOptions,
    Notes,
    observable_part,
    read_json_file,
    read_text,
    read_yaml_file,
)
from rigwake.exporters.json_csv import read_csv, read_json, write_csv, write_json
from rigwake.exporters.kalibr import camchain_keys, read_kalibr, write_kalibr, write_openvins
from rigwake.exporters.mrcal import SUFFIX, read_mrcal, write_mrcal
from rigwake.exporters.opencv import is_opencv_rig, read_opencv, write_opencv
from rigwake.exporters.ros_tf import read_ros_static_tf, write_ros_static_tf
from rigwake.exporters.slam_settings import is_vins, read_orbslam, read_vins
from rigwake.exporters.urdf import read_urdf, write_urdf

Writer = Callable[[Calibration, Path, ExportOptions, Notes], Notes]
Reader = Callable[[Path], Calibration]


@dataclass(frozen=True)
class ExportFormat:
    """One format: what it is, its usual file (a folder if it ends in `/`), how it is written and read.

    holds_null: it can say "unobservable", so that nothing need be left out.
    """

    what: str
    usual_file: str
    write: Writer
    read: Reader
    holds_null: bool = False


FORMATS: Mapping[str, ExportFormat] = {
    "kalibr": ExportFormat("Kalibr camchain", "camchain.yaml", write_kalibr, read_kalibr),
    "openvins": ExportFormat(
        "OpenVINS camera chain", "kalibr_imucam_chain.yaml", write_openvins, read_kalibr
    ),
    "basalt": ExportFormat("Basalt calibration", "calibration.json", write_basalt, read_basalt),
    "camodocal": ExportFormat("CamOdoCal folder", "camodocal/", write_camodocal, read_camodocal),
    "colmap": ExportFormat("COLMAP rig and cameras", "colmap/", write_colmap, read_colmap),
    "mrcal": ExportFormat("mrcal camera models", "mrcal/", write_mrcal, read_mrcal),
    "opencv": ExportFormat("OpenCV FileStorage YAML", "opencv/", write_opencv, read_opencv),
    "ros-static-tf": ExportFormat(
        "ROS static transforms: .launch, .launch.py, .bag, .mcap",
        "cameras.launch.py",
        write_ros_static_tf,
        read_ros_static_tf,
    ),
    "urdf": ExportFormat("URDF joints; .xacro: a macro", "cameras.urdf", write_urdf, read_urdf),
    "json": ExportFormat("the calibration file as JSON", "calibration.json", write_json, read_json, True),
    "csv": ExportFormat("one row per camera", "calibration.csv", write_csv, read_csv, True),
}


_READ_ONLY: Mapping[str, Reader] = {"vins": read_vins, "orb-slam": read_orbslam}
_CAMCHAIN = re.compile(r"^(%YAML|[\w\"']+:\s*$|[\w.]+:\s)", re.MULTILINE)


def export_calibration(
    calibration: Calibration,
    name: str,
    path: Path | str,
    options: ExportOptions | None = None,
    *,
    allow_unobservable: bool = False,
) -> Notes:
    """Write a calibration in another program's format; returns what the user must know about the result.

    A camera that is not fully determined is never given made-up numbers: UnobservableError, or with
    `allow_unobservable` the camera is left out (JSON and CSV hold null instead). Raises UsageError for an unknown
    format or one that cannot hold this calibration, CameraError for a lens that no model of the format fits.
    """
    if name not in FORMATS:
        raise UsageError(f"There is no format {name!r}.", remedy=f"Known: {', '.join(FORMATS)}.")
    chosen = FORMATS[name]
    notes: Notes = []
    if not chosen.holds_null:
        calibration, notes = observable_part(calibration, allow_unobservable)
    return [*notes, *chosen.write(calibration, Path(path), options or ExportOptions(), notes)]


def read_calibration(path: Path | str) -> Calibration:
    """A calibration in any known format, recognised by its content; InputError says what was expected."""
    path = Path(path)
    if (path / "calibration.yaml").is_file():  # the folder that `rigwake calibrate` leaves
        path = path / "calibration.yaml"
    name = _recognise(path)
    if name in _READ_ONLY:
        return _READ_ONLY[name](path)
    return load_calibration(path) if name == "rigwake" else FORMATS[name].read(path)


def _recognise(path: Path) -> str:
    if not path.exists():
        raise InputError(f"There is no {path}.", remedy="Check the path.")
    if path.is_dir():
        return _recognise_folder(path)
    suffixes = {SUFFIX: "mrcal", ".urdf": "urdf", ".csv": "csv", ".bag": "ros-static-tf"}
    suffixes |= {".launch": "ros-static-tf", ".py": "ros-static-tf", ".mcap": "ros-static-tf"}
    suffix = path.suffix.lower()
    if suffix in suffixes:
        return suffixes[suffix]
    if suffix == ".json":
        return _recognise_json(path)
    return (
        "camodocal" if suffix == ".txt" and not _CAMCHAIN.search(read_text(path)) else _recognise_yaml(path)
    )


def _recognise_folder(path: Path) -> str:
    if (path / EXTRINSICS).is_file():
        return "camodocal"
    if (path / RIG).is_file():
        return "colmap"
    if any(path.glob(f"*{SUFFIX}")):
        return "mrcal"
    if (path / "metadata.yaml").is_file():
        return "ros-static-tf"
    if any(is_opencv_rig(read_text(file)) for file in path.glob("*.yaml")):
        return "opencv"
    raise InputError(f"{path} is no folder of calibrations that rigwake knows.")


def _recognise_json(path: Path) -> str:
    content = read_json_file(path)
    if isinstance(content, Mapping) and "value0" in content:
        return "basalt"
    return "colmap" if isinstance(content, list) else "json"


def _recognise_yaml(path: Path) -> str:
    if is_opencv_rig(read_text(path)):
        return "opencv"
    content = read_yaml_file(path)
    if isinstance(content, Mapping) and "rigwake_calibration" not in content:
        if is_vins(content):
            return "vins"
        if is_orbslam(content):
            return "orb-slam"
        if camchain_keys(content):
            return "kalibr"
    return "rigwake"  # whose reader says best what is wrong with any other YAML
