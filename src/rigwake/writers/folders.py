"""Plain folders from a `Recording`."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from rigwake.errors import UsageError
from rigwake.geometry import so3
from rigwake.geometry.geodesy import lla_from_enu
from rigwake.readers.printable import plain_name
from rigwake.readers.rig_description import RIG_FILE
from rigwake.recording import AttitudeStream, CameraStream, Finding, GnssStream, ImuStream, Recording
from rigwake.writers.encoded_images import ImageEncoding, encoded_images, file_suffix, lossy_remark
from rigwake.writers.rig_text import describe, yaml_text
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


def write_folder(
    recording: Recording, path: Path, image_encoding: ImageEncoding = "jpeg"
) -> tuple[Finding, ...]:
    """Write a plain folder as `readers.folder` reads it; returns what it cannot hold."""
    if image_encoding == "raw":
        raise UsageError("Folders hold encoded images.", remedy="Choose png, which loses nothing, or jpeg.")
    findings = [f for camera in recording.cameras.values() for f in lossy_remark(camera, image_encoding)]
    places: dict[tuple[str, str], str] = {}
    with new_folder(Path(path)) as folder:
        for camera in recording.cameras.values():
            places["cameras", camera.name] = plain_name(camera.name)
            images = folder / plain_name(camera.name)
            write_csv(
                images / "timestamps.csv",
                "timestamp_ns,filename",
                write_images(camera, images, image_encoding),
            )
        for imu in recording.imus.values():
            write_imu(imu, folder / _table_name("imu", imu.name))
        for gnss in recording.gnss.values():
            write_gnss(gnss, folder / _table_name("gnss", gnss.name))
        for attitude in recording.attitudes.values():
            write_attitude(attitude, folder / _table_name("attitude", attitude.name))
        for kind in ("imu", "gnss", "attitude"):
            streams: Mapping[str, object] = {
                "imu": recording.imus,
                "gnss": recording.gnss,
                "attitude": recording.attitudes,
            }[kind]
            key = {"imu": "imus", "gnss": "gnss", "attitude": "attitudes"}[kind]
            places |= {(key, name): Path(_table_name(kind, name)).stem for name in streams}
        write_trajectories(recording, folder, places)
        content = describe(recording, places, transforms=True)
        if content:
            (folder / RIG_FILE).write_text(yaml_text(content), encoding="utf-8")
    return tuple(findings)


def write_trajectories(recording: Recording, folder: Path, places: dict[tuple[str, str], str]) -> None:
    """`poses/*.tum` and `truth/*.tum`; notes the name of each file."""
    for kind, trajectories in (("poses", recording.poses), ("truth", recording.true_trajectories)):
        for name, trajectory in trajectories.items():
            (folder / kind).mkdir(exist_ok=True)
            places[kind, name] = plain_name(name)
            write_tum(trajectory, folder / kind / f"{plain_name(name)}.tum")


def _table_name(kind: str, name: str) -> str:
    name = plain_name(name)
    return f"{name}.csv" if name.split("_")[0] == kind else f"{kind}_{name}.csv"


def write_images(camera: CameraStream, folder: Path, image_encoding: ImageEncoding) -> list[tuple[int, str]]:
    """Image files named by their stamps; returns (stamp, name) of those written."""
    folder.mkdir(parents=True)
    names = []
    for stamp, encoded in encoded_images(camera, image_encoding):
        name = f"{stamp}{file_suffix(encoded)}"
        (folder / name).write_bytes(encoded)
        names.append((stamp, name))
    return names


def write_csv(path: Path, header: str, rows: Iterable[Sequence[object]]) -> None:
    """A csv file; floats with as many digits as bring them back exactly."""
    lines = (",".join(str(cell) for cell in row) for row in rows)
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


def write_imu(imu: ImuStream, path: Path, header: str = IMU_HEADER) -> None:
    """A csv file of gyro (rad/s) and accelerometer (m/s^2) samples."""
    values = np.hstack([imu.gyro, imu.accel]).tolist()
    write_csv(path, header, ([t, *row] for t, row in zip(imu.timestamps_ns.tolist(), values, strict=True)))


def write_gnss(gnss: GnssStream, path: Path) -> None:
    """A csv file of positions with covariances, and velocities where they are known."""
    header = "timestamp_ns,latitude,longitude,altitude,cov_ee,cov_en,cov_eu,cov_nn,cov_nu,cov_uu"
    columns = [lla_from_enu(gnss.position_enu, gnss.origin_lla), gnss.covariances[:, *_UPPER]]
    if gnss.velocity_enu is not None:
        header += ",velocity_e,velocity_n,velocity_u"
        columns.append(gnss.velocity_enu)
    values = np.hstack(columns).tolist()
    write_csv(path, header, ([t, *row] for t, row in zip(gnss.timestamps_ns.tolist(), values, strict=True)))


def write_attitude(attitude: AttitudeStream, path: Path) -> None:
    """A csv file of orientations with covariances."""
    header = "timestamp_ns,qw,qx,qy,qz,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
    quat_wxyz = so3.quat_wxyz_from_matrix(attitude.world_from_body)
    values = np.hstack([quat_wxyz, attitude.covariances[:, *_UPPER]]).tolist()
    stamps = attitude.timestamps_ns.tolist()
    write_csv(path, header, ([t, *row] for t, row in zip(stamps, values, strict=True)))
