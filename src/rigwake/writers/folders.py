"""Plain folders from a `Recording`."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_to_dict
from rigwake.errors import UsageError
from rigwake.geometry import so3
from rigwake.geometry.geodesy import lla_from_enu
from rigwake.geometry.se3 import SE3
from rigwake.recording import AttitudeStream, CameraStream, Finding, GnssStream, ImuStream, Recording
from rigwake.rig import Rig
from rigwake.writers.ros_encoding import encode_image
from rigwake.writers.rosbag import is_grey
from rigwake.writers.trajectory_writer import write_tum

IMU_HEADER = "timestamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
_UPPER = np.triu_indices(3)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path`, renamed to it on success. UsageError if `path` exists."""
    if path.exists():
        raise UsageError(f"{path} exists.", remedy="Choose another name, or remove it first.")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}-"))
    try:
        temporary.chmod(0o755)
        yield temporary
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_folder(recording: Recording, path: Path, image_encoding: str = "jpeg") -> tuple[Finding, ...]:
    """Write a plain folder as `readers.folder` reads it; returns what it cannot hold."""
    suffix = _suffix(image_encoding)
    with new_folder(Path(path)) as folder:
        for camera in recording.cameras.values():
            names = write_images(camera, folder / camera.name, suffix, image_encoding)
            write_csv(folder / camera.name / "timestamps.csv", "timestamp_ns,filename", names)
        for imu in recording.imus.values():
            write_imu(imu, folder / _table_name("imu", imu.name))
        for gnss in recording.gnss.values():
            _write_gnss(gnss, folder / _table_name("gnss", gnss.name))
        for attitude in recording.attitudes.values():
            _write_attitude(attitude, folder / _table_name("attitude", attitude.name))
        for kind, trajectories in (("poses", recording.poses), ("truth", recording.true_trajectories)):
            for name, trajectory in trajectories.items():
                (folder / kind).mkdir(exist_ok=True)
                write_tum(trajectory, folder / kind / f"{name.replace('/', '_')}.tum")
        _write_rig(recording, folder / "rig.yaml")
    if recording.static_transforms:
        return (Finding("note", "tf_static", "transforms are not written into folders."),)
    return ()


def _suffix(image_encoding: str) -> str:
    if image_encoding == "raw":
        raise UsageError("Folders hold encoded images.", remedy="Choose png, which loses nothing, or jpeg.")
    return ".jpg" if image_encoding == "jpeg" else ".png"


def _table_name(kind: str, name: str) -> str:
    return f"{name}.csv" if name.split("_")[0] == kind else f"{kind}_{name}.csv"


def write_images(
    camera: CameraStream, folder: Path, suffix: str, image_encoding: str
) -> list[tuple[int, str]]:
    """Image files named by their stamps; returns (stamp, name) of those written."""
    folder.mkdir(parents=True)
    names = []
    for frame in camera.frames(colour=not is_grey(camera)):
        name = f"{frame.timestamp_ns}{suffix}"
        (folder / name).write_bytes(encode_image(frame.image, image_encoding))
        names.append((frame.timestamp_ns, name))
    return names


def write_csv(path: Path, header: str, rows: Iterable[Sequence[object]]) -> None:
    """A csv file; floats with as many digits as bring them back exactly."""
    lines = (",".join(str(cell) for cell in row) for row in rows)
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


def write_imu(imu: ImuStream, path: Path, header: str = IMU_HEADER) -> None:
    """A csv file of gyro (rad/s) and accelerometer (m/s^2) samples."""
    values = np.hstack([imu.gyro, imu.accel]).tolist()
    write_csv(path, header, ([t, *row] for t, row in zip(imu.timestamps_ns.tolist(), values, strict=True)))


def _write_gnss(gnss: GnssStream, path: Path) -> None:
    header = "timestamp_ns,latitude,longitude,altitude,cov_ee,cov_en,cov_eu,cov_nn,cov_nu,cov_uu"
    columns = [lla_from_enu(gnss.position_enu, gnss.origin_lla), gnss.covariances[:, *_UPPER]]
    if gnss.velocity_enu is not None:
        header += ",velocity_e,velocity_n,velocity_u"
        columns.append(gnss.velocity_enu)
    values = np.hstack(columns).tolist()
    write_csv(path, header, ([t, *row] for t, row in zip(gnss.timestamps_ns.tolist(), values, strict=True)))


def _write_attitude(attitude: AttitudeStream, path: Path) -> None:
    header = "timestamp_ns,qw,qx,qy,qz,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
    quat_wxyz = so3.quat_wxyz_from_matrix(attitude.world_from_body)
    values = np.hstack([quat_wxyz, attitude.covariances[:, *_UPPER]]).tolist()
    stamps = attitude.timestamps_ns.tolist()
    write_csv(path, header, ([t, *row] for t, row in zip(stamps, values, strict=True)))


def _write_rig(recording: Recording, path: Path) -> None:
    """Lenses, and the true rig where it is known."""
    models = {name: camera.model for name, camera in recording.cameras.items()}
    content = rig_to_dict(models, recording.true_rig)
    if content["cameras"]:
        text = "# a_from_b maps coordinates in b to coordinates in a; metres; quaternions w x y z\n"
        path.write_text(text + yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def rig_to_dict(models: dict[str, CameraModel | None], rig: Rig | None) -> dict[str, Any]:
    """Plain values of `rig.yaml`, as `readers.rig_file` reads them."""
    cameras: dict[str, dict[str, Any]] = {
        name: {"camera": camera_to_dict(model)} for name, model in models.items() if model is not None
    }
    content: dict[str, Any] = {"cameras": cameras}
    if rig is None:
        return content
    for name, camera in rig.cameras.items():
        entry = cameras.setdefault(
            name, {} if camera.model is None else {"camera": camera_to_dict(camera.model)}
        )
        entry |= {
            "rig_from_cam": _transform(camera.rig_from_cam),
            "time_offset_s": float(camera.time_offset_s),
        }
        if camera.topic:
            entry["topic"] = camera.topic
    content["reference"] = rig.reference
    if rig.antenna_rig is not None:
        content["antenna_rig_m"] = [float(x) for x in rig.antenna_rig]
    if rig.rig_from_imu is not None:
        content["rig_from_imu"] = _transform(rig.rig_from_imu)
    return content


def _transform(a_from_b: SE3) -> dict[str, list[float]]:
    return {"quat_wxyz": a_from_b.quat_wxyz.tolist(), "translation_m": a_from_b.translation.tolist()}
