"""IMU, GNSS and attitude from csv tables, for the folder formats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.readers.column_names import metres_per_unit
from rigwake.readers.csv_tables import Table, read_table
from rigwake.readers.gnss_fixes import gnss_stream_of_fixes
from rigwake.readers.imu_units import (
    accel_in_si,
    gyro_in_si,
    headerless_columns,
    inertial_columns,
    unit_words,
)
from rigwake.readers.streams import symmetric_psd, unit_quaternions, usable_rows
from rigwake.recording import AttitudeStream, Finding, GnssStream, ImuStream

Findings = tuple[Finding, ...]
_HEADERLESS_IMU = ("t", "first_x", "first_y", "first_z", "second_x", "second_y", "second_z")
_UNITS_OF_PLACES = ("", "_deg", "_rad", "_e7")
_LATITUDE_LONGITUDE = tuple(
    (f"{latitude}{unit}", f"{longitude}{unit}")
    for unit in _UNITS_OF_PLACES
    for latitude, longitude in (("latitude", "longitude"), ("lat", "lon"), ("lat", "lng"), ("lat", "long"))
)
_HEIGHT = tuple(
    f"{name}{unit}"
    for unit in ("", "_m", "_mm", "_cm", "_ft")
    for name in ("altitude", "alt", "height", "ellipsoidal_height", "hgt", "elevation", "h")
)
_RADIANS = ("rad", "radian", "radians")
_TEN_MILLIONTHS = ("1e-7 deg", "1e-7deg", "1e-7", "deg*1e-7", "deg*1e7", "dege7", "dege-7", "e7", "1e7 deg")
_ENU_COVARIANCE = ("cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu")
_BODY_COVARIANCE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def _usable(table: Table, name: str, *columns: Array) -> tuple[NDArray[np.int64], Stamps, Findings]:
    """Rows with readable stamps and finite columns in the order of time, their stamps, and what was dropped.

    Raises InputError if there is none.
    """
    stamps = table.stamps_ns()
    readable, dropped = _readable(table, name)
    kept, repaired = usable_rows(name, stamps[readable], *(column[readable] for column in columns))
    rows = readable[kept]
    if not len(rows):
        raise InputError(f"{table.path} holds no readable row.")
    return rows, stamps[rows], (*dropped, *repaired)


def _readable(table: Table, name: str) -> tuple[NDArray[np.int64], Findings]:
    """Rows with readable stamps, and how many are not."""
    stamps = table.stamps_ns()
    rows = np.flatnonzero(stamps >= 0)
    unreadable = len(stamps) - len(rows) + table.dropped_rows
    message = f"{unreadable} rows of {table.path.name} cannot be read; they were dropped."
    return rows, (Finding("warning", name, message),) if unreadable else ()


def _symmetric(table: Table, columns: Sequence[str], rows: NDArray[np.int64]) -> Array:
    """(N, 3, 3) from the six columns of the upper triangle; zeros where they are not there."""
    if not all(column in table.columns for column in columns):
        return np.zeros((len(rows), 3, 3))
    return np.asarray(table.numbers(columns)[rows][:, _UPPER])


def read_imu_csv(path: Path, name: str) -> tuple[ImuStream, Findings]:
    """IMU samples (rad/s, m/s^2). Raises InputError if columns are missing or no row is usable."""
    table = read_table(path, names=_HEADERLESS_IMU)
    gyro_columns, accel_columns, said = _inertial_columns(table, name)
    gyro, gyro_said = gyro_in_si(table.numbers(gyro_columns), _unit(table, gyro_columns[0]), name)
    accel, accel_said = accel_in_si(table.numbers(accel_columns), _unit(table, accel_columns[0]), name)
    rows, stamps, findings = _usable(table, name, gyro, accel)
    stream = ImuStream(name, stamps, gyro[rows], accel[rows], path.name)
    return stream, (*said, *gyro_said, *accel_said, *findings)


def _unit(table: Table, column: str) -> str:
    return unit_words(column, table.units[column])


def _inertial_columns(table: Table, name: str) -> tuple[tuple[str, ...], tuple[str, ...], Findings]:
    """Columns of gyroscope and accelerometer by name; without a header by the size of gravity."""
    if tuple(table.columns) == _HEADERLESS_IMU:
        values = table.numbers(_HEADERLESS_IMU)
        places = headerless_columns(values[np.isfinite(values).all(axis=1)]) if len(values) else None
        if places is None:
            raise InputError(
                f"{table.path} has no header line.", remedy="Name its columns in the first line."
            )
        gyro, accel = (tuple(_HEADERLESS_IMU[at] for at in place) for place in places)
        order = "gyroscope, accelerometer" if places[0][0] == 1 else "accelerometer, gyroscope"
        message = f"{table.path.name} has no header line: read as time, {order}, by the size of gravity."
        return gyro, accel, (Finding("warning", name, message),)
    found = inertial_columns(list(table.columns))
    if found is None:
        raise InputError(
            f"{table.path} lacks the columns gyro_x, gyro_y, gyro_z, accel_x, accel_y, accel_z.",
            remedy=f"It has {', '.join(table.columns)}; name them so.",
        )
    return *found, ()


def _places(table: Table, name: str) -> tuple[Array, Findings]:
    """(N, 3) latitude, longitude (degrees) and height (metres, NaN without one), whatever the units."""
    columns = next((pair for pair in _LATITUDE_LONGITUDE if all(n in table.columns for n in pair)), None)
    place = table.numbers(*_LATITUDE_LONGITUDE)
    assert columns is not None
    unit = table.units[columns[0]] or columns[0].rpartition("_")[2]
    findings: Findings = ()
    largest = float(np.nanmedian(np.abs(place[:, 0]))) if np.isfinite(place[:, 0]).any() else 0.0
    if unit in _RADIANS:
        place = np.degrees(place)
    elif unit in _TEN_MILLIONTHS or (largest > 1e5 and unit not in ("deg", "degrees", "°")):
        place = 1e-7 * place
        words = "latitude and longitude are in units of 1e-7 degrees, as u-blox has them: converted."
        findings = (Finding("note", name, words),)
    height = table.find(*_HEIGHT)
    if height is None:
        return np.column_stack([place, np.full(len(place), np.nan)]), findings
    named = height if not table.units[height] else f"{height} [{table.units[height]}]"
    return np.column_stack([place, metres_per_unit(named) * table.numbers((height,))]), findings


def read_gnss_csv(path: Path, name: str) -> tuple[GnssStream, Findings]:
    """Satellite positions in the plane tangent at the first. Raises InputError as `read_imu_csv`."""
    table = read_table(path)
    lla, said = _places(table, name)
    readable, dropped = _readable(table, name)
    velocity_columns = ("velocity_e", "velocity_n", "velocity_u")
    velocity = table.numbers(velocity_columns)[readable] if table.find(velocity_columns[0]) else None
    stream, findings = gnss_stream_of_fixes(
        name,
        table.stamps_ns()[readable],
        lla[readable],
        _symmetric(table, _ENU_COVARIANCE, readable),
        velocity_enu=velocity,
        topic=path.name,
    )
    return stream, (*said, *dropped, *findings)


def read_attitude_csv(path: Path, name: str) -> tuple[AttitudeStream, Findings]:
    """Attitude `qw qx qy qz` of the body in ENU, with covariances `cov_xx ... cov_zz` about body axes."""
    table = read_table(path)
    quat_wxyz = unit_quaternions(table.numbers(("qw", "qx", "qy", "qz")))
    rows, stamps, findings = _usable(table, name, quat_wxyz)
    rotations = so3.matrix_from_quat_wxyz(quat_wxyz[rows])
    covariances = symmetric_psd(_symmetric(table, _BODY_COVARIANCE, rows), np.radians(5.0) ** 2)
    return AttitudeStream(name, stamps, rotations, covariances, path.name), findings
