"""IMU, GNSS and attitude from csv tables, for the folder formats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.geodesy import enu_from_lla
from rigwake.readers.csv_tables import Table, read_table
from rigwake.readers.streams import symmetric_psd, unit_quaternions, usable_rows
from rigwake.recording import AttitudeStream, Finding, GnssStream, ImuStream

Findings = tuple[Finding, ...]
_GYRO = (
    ("gyro_x", "gyro_y", "gyro_z"),
    ("w_rs_s_x", "w_rs_s_y", "w_rs_s_z"),
    ("wx", "wy", "wz"),
    ("angular_velocity_x", "angular_velocity_y", "angular_velocity_z"),
)
_ACCEL = (
    ("accel_x", "accel_y", "accel_z"),
    ("a_rs_s_x", "a_rs_s_y", "a_rs_s_z"),
    ("ax", "ay", "az"),
    ("linear_acceleration_x", "linear_acceleration_y", "linear_acceleration_z"),
)
_LLA = (("latitude", "longitude", "altitude"), ("lat", "lon", "alt"), ("lat", "lon", "height"))
_ENU_COVARIANCE = ("cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu")
_BODY_COVARIANCE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
UNKNOWN_GNSS_VARIANCE = 25.0


def _usable(table: Table, name: str, *columns: Array) -> tuple[NDArray[np.int64], Stamps, Findings]:
    """Rows with readable stamps and finite columns in the order of time, their stamps, and what was dropped.

    Raises InputError if there is none.
    """
    stamps = table.stamps_ns()
    readable = np.flatnonzero(stamps >= 0)
    kept, repaired = usable_rows(name, stamps[readable], *(column[readable] for column in columns))
    rows = readable[kept]
    if not len(rows):
        raise InputError(f"{table.path} holds no readable row.")
    unreadable = len(stamps) - len(readable) + table.dropped_rows
    if unreadable == 0:
        return rows, stamps[rows], repaired
    message = f"{unreadable} rows of {table.path.name} cannot be read; they were dropped."
    return rows, stamps[rows], (Finding("warning", name, message), *repaired)


def _symmetric(table: Table, columns: Sequence[str], rows: NDArray[np.int64]) -> Array:
    """(N, 3, 3) from the six columns of the upper triangle; zeros where they are not there."""
    if not all(column in table.columns for column in columns):
        return np.zeros((len(rows), 3, 3))
    return np.asarray(table.numbers(columns)[rows][:, _UPPER])


def read_imu_csv(path: Path, name: str) -> tuple[ImuStream, Findings]:
    """IMU samples (rad/s, m/s^2). Raises InputError if columns are missing or no row is usable."""
    table = read_table(path)
    gyro, accel = table.numbers(*_GYRO), table.numbers(*_ACCEL)
    rows, stamps, findings = _usable(table, name, gyro, accel)
    return ImuStream(name, stamps, gyro[rows], accel[rows], path.name), findings


def read_gnss_csv(path: Path, name: str) -> tuple[GnssStream, Findings]:
    """Satellite positions in the plane tangent at the first. Raises InputError as `read_imu_csv`."""
    table = read_table(path)
    lla = table.numbers(*_LLA)
    lla[np.abs(lla[:, 0]) > 90] = np.nan
    rows, stamps, findings = _usable(table, name, lla)
    origin = (float(lla[rows[0], 0]), float(lla[rows[0], 1]), float(lla[rows[0], 2]))
    velocity_columns = ("velocity_e", "velocity_n", "velocity_u")
    velocity = table.numbers(velocity_columns)[rows] if table.find(velocity_columns[0]) else None
    stream = GnssStream(
        name,
        stamps,
        enu_from_lla(lla[rows], origin),
        symmetric_psd(_symmetric(table, _ENU_COVARIANCE, rows), UNKNOWN_GNSS_VARIANCE),
        origin,
        velocity,
        path.name,
    )
    return stream, findings


def read_attitude_csv(path: Path, name: str) -> tuple[AttitudeStream, Findings]:
    """Attitude `qw qx qy qz` of the body in ENU, with covariances `cov_xx ... cov_zz` about body axes."""
    table = read_table(path)
    quat_wxyz = unit_quaternions(table.numbers(("qw", "qx", "qy", "qz")))
    rows, stamps, findings = _usable(table, name, quat_wxyz)
    rotations = so3.matrix_from_quat_wxyz(quat_wxyz[rows])
    covariances = symmetric_psd(_symmetric(table, _BODY_COVARIANCE, rows), np.radians(5.0) ** 2)
    return AttitudeStream(name, stamps, rotations, covariances, path.name), findings
