"""`adjustment.npz` of a calibration's folder: sensors over time and landmarks, as the bundle adjustment left them."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import InputError

_LARGEST_BYTES = 64 * 1024 * 1024  # unpacked; what a calibration writes has a few hundred thousand
_MOST_LANDMARKS = 4000


@dataclass(frozen=True, eq=False)
class SensorSeries:
    """A quantity with three axes over time: seconds since the recording's first state (n,), values (n, 3), standard
    deviations (n, 3) or None where it has none of its own. count: of how many rows these are a sample."""

    at_s: Array
    values: Array
    std: Array | None
    count: int


@dataclass(frozen=True, eq=False)
class LandmarkCloud:
    """Landmarks (n, 3) in metres of the world of `trajectories/rig.tum`, and by name the camera that saw each first.

    shown, placed, in_all: these; those whose distance the views tell; those of the adjustment.
    """

    points_world: Array
    cameras: tuple[str, ...]
    placed: int
    in_all: int


@dataclass(frozen=True, eq=False)
class AdjustmentRecord:
    """What the file holds; None where the adjustment had no such sensor. Rig axes, metres, radians; GNSS in ENU."""

    gyro_bias: SensorSeries | None = None
    accel_bias: SensorSeries | None = None
    imu_turn: SensorSeries | None = None
    imu_speed: SensorSeries | None = None
    gnss_off: SensorSeries | None = None
    gnss_lasting: SensorSeries | None = None
    landmarks: LandmarkCloud | None = None


def read_adjustment(path: Path) -> AdjustmentRecord:
    """The file as values; InputError if it is damaged, too large, or contradicts itself."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _LARGEST_BYTES:
            raise InputError(f"{path.name} is too large ({size} bytes unpacked).")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        starts = [
            int(arrays[name][0]) for name in arrays if name.endswith("timestamps_ns") and len(arrays[name])
        ]
        start = min(starts, default=0)
        return AdjustmentRecord(
            _series(arrays, "bias", "gyro_bias", start),
            _series(arrays, "bias", "accel_bias", start),
            _series(arrays, "imu", "imu_turn", start),
            _series(arrays, "imu", "imu_speed", start),
            _series(arrays, "gnss", "gnss_off", start, "gnss_std"),
            _series(arrays, "gnss", "gnss_lasting", start),
            _cloud(arrays),
        )
    except InputError:
        raise
    except Exception as error:  # of damaged bytes, numpy and zipfile make almost any error
        raise InputError(f"{path.name} cannot be read: {type(error).__name__}: {error}.") from error


def _series(
    arrays: Mapping[str, np.ndarray], sensor: str, name: str, start_ns: int, std_name: str = ""
) -> SensorSeries | None:
    if name not in arrays or not len(arrays[name]):
        return None
    stamps: Stamps = arrays[f"{sensor}_timestamps_ns"].astype(np.int64)
    std = arrays.get(std_name or f"{name}_std")
    shapes = {arrays[name].shape, *(() if std is None else (std.shape,))}
    if stamps.ndim != 1 or shapes != {(len(stamps), 3)}:
        raise InputError(f"adjustment.npz: the arrays of {name} disagree in length: {sorted(shapes)}.")
    if not np.isfinite(arrays[name]).all() or (std is not None and not (np.isfinite(std) & (std > 0)).all()):
        raise InputError(f"adjustment.npz: not all values of {name} are finite.")
    count = int(arrays.get(f"{sensor}_count", np.array(len(stamps))))
    return SensorSeries(np.asarray((stamps - start_ns) * 1e-9), arrays[name].astype(np.float64), std, count)


def _cloud(arrays: Mapping[str, np.ndarray]) -> LandmarkCloud | None:
    if "landmarks_world" not in arrays:
        return None
    points, indices = arrays["landmarks_world"].astype(np.float64), arrays["landmark_cameras"]
    if indices.ndim != 1 or points.shape != (len(indices), 3):
        raise InputError("adjustment.npz: landmarks and their cameras disagree in length.")
    names = [str(name) for name in arrays["camera_names"].tolist()]
    in_all, placed = (int(x) for x in arrays["landmark_counts"])
    kept = np.flatnonzero(np.isfinite(points).all(axis=1) & (indices >= 0) & (indices < len(names)))
    kept = kept[:: max(1, -(-len(kept) // _MOST_LANDMARKS))]
    if not len(kept):
        return None
    return LandmarkCloud(points[kept], tuple(names[int(k)] for k in indices[kept]), placed, in_all)
