"""What the functions of `rigwake.api` take: paths or values, topics, lens files, callbacks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rigwake.errors import InputError

if TYPE_CHECKING:
    from rigwake.calibration import Calibration
    from rigwake.readers.topics import TopicMap
    from rigwake.recording import Recording
    from rigwake.trajectory import Trajectory

FilePath = Path | str


def silent(name: str, what: str, fraction: float) -> None:
    """Progress that nobody asked for."""


def open_recording(
    path: FilePath,
    *,
    topics: Mapping[str, str] | None = None,
    camera_files: Mapping[str, FilePath] | None = None,
) -> Recording:
    """Open a ROS bag, MCAP file, or folder; images are read when they are used. Raises InputError."""
    from rigwake.readers.open import open_recording as read

    return read(path, topic_map(topics, camera_files))


def load_calibration(path: FilePath) -> Calibration:
    """Read a `calibration.yaml`, or a file of any format that `export` writes. Raises InputError."""
    from rigwake.exporters import read_calibration

    return read_calibration(path)


def topic_map(
    topics: Mapping[str, str] | None, camera_files: Mapping[str, FilePath] | None
) -> TopicMap | None:
    """The choice of topics and lens files, None where nothing was chosen."""
    from rigwake.readers.topics import TopicMap

    if not topics and not camera_files:
        return None
    assignments = [f"{sensor}={topic}" for sensor, topic in (topics or {}).items()]
    files = [f"{camera}={file}" for camera, file in (camera_files or {}).items()]
    return TopicMap.from_options(assignments, None, files)


def opened(recording: FilePath | Recording) -> Recording:
    """The recording, opened where its path is given."""
    return open_recording(recording) if isinstance(recording, str | Path) else recording


def calibration_of(calibration: FilePath | Calibration | Trajectory) -> Calibration:
    """The calibration, read where its path is given. Raises InputError."""
    from rigwake.calibration import Calibration

    if isinstance(calibration, str | Path):
        return load_calibration(calibration)
    if not isinstance(calibration, Calibration):
        raise InputError("A calibration is wanted, or the path of one.")
    return calibration


def trajectory_of(trajectory: FilePath | Trajectory | Calibration) -> Trajectory:
    """The trajectory, read where its path is given. Raises InputError."""
    from rigwake.readers.trajectories import read_trajectory
    from rigwake.trajectory import Trajectory

    if isinstance(trajectory, str | Path):
        return read_trajectory(trajectory).trajectory
    if not isinstance(trajectory, Trajectory):
        raise InputError("A trajectory is wanted, or the path of one.")
    return trajectory
