"""Geographic coordinates (WGS84) to and from a local tangent plane, in closed form by way of geocentric coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigwake._types import Array

Lla = tuple[float, float, float]

_EQUATOR_M = 6_378_137.0
_FLATTENING = 1 / 298.257223563
_POLE_M = _EQUATOR_M * (1 - _FLATTENING)
_ECCENTRICITY_2 = _FLATTENING * (2 - _FLATTENING)
_LATITUDE_ROUNDS = 4  # each gains three digits and more, as long as heights are below some 1000 km


def enu_from_lla(lla: ArrayLike, origin_lla: Lla) -> Array:
    """East, north, up (N, 3) in metres, in the plane tangent at `origin_lla`, of geographic positions.

    lla: (N, 3) latitude and longitude in degrees, ellipsoidal height in metres (WGS84), as is the origin.
    """
    points = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
    return (_earth_from_lla(points) - _earth_from_lla(np.array([origin_lla]))) @ _earth_from_enu(origin_lla)


def lla_from_enu(position_enu: ArrayLike, origin_lla: Lla) -> Array:
    """Latitude, longitude (degrees) and ellipsoidal height (metres): the inverse of `enu_from_lla`."""
    points = np.asarray(position_enu, dtype=np.float64).reshape(-1, 3)
    return _lla_from_earth(points @ _earth_from_enu(origin_lla).T + _earth_from_lla(np.array([origin_lla])))


def _earth_from_enu(origin_lla: Lla) -> Array:
    """(3, 3) whose columns are east, north and up at a place, in geocentric axes."""
    latitude, longitude = np.deg2rad(origin_lla[:2])
    sin_lat, cos_lat, sin_lon, cos_lon = (
        np.sin(latitude),
        np.cos(latitude),
        np.sin(longitude),
        np.cos(longitude),
    )
    return np.array(
        [
            [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
            [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
            [0.0, cos_lat, sin_lat],
        ]
    )


def _earth_from_lla(lla: Array) -> Array:
    """Geocentric (N, 3) metres: z to the north pole, x to latitude and longitude 0."""
    latitude, longitude = np.deg2rad(lla[:, 0]), np.deg2rad(lla[:, 1])
    to_axis = _EQUATOR_M / np.sqrt(1 - _ECCENTRICITY_2 * np.sin(latitude) ** 2)
    across = (to_axis + lla[:, 2]) * np.cos(latitude)
    along = (to_axis * (1 - _ECCENTRICITY_2) + lla[:, 2]) * np.sin(latitude)
    return np.column_stack([across * np.cos(longitude), across * np.sin(longitude), along])


def _lla_from_earth(points: Array) -> Array:
    """The inverse of `_earth_from_lla`, by Bowring's iteration (Survey Review 23, 1976)."""
    across = np.hypot(points[:, 0], points[:, 1])
    reduced = np.arctan2(points[:, 2] * _EQUATOR_M, across * _POLE_M)
    for _ in range(_LATITUDE_ROUNDS):
        latitude = np.arctan2(
            points[:, 2] + _ECCENTRICITY_2 * _EQUATOR_M**2 / _POLE_M * np.sin(reduced) ** 3,
            across - _ECCENTRICITY_2 * _EQUATOR_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2(_POLE_M * np.sin(latitude), _EQUATOR_M * np.cos(latitude))
    height = (
        across * np.cos(latitude)
        + points[:, 2] * np.sin(latitude)
        - _EQUATOR_M * np.sqrt(1 - _ECCENTRICITY_2 * np.sin(latitude) ** 2)
    )
    longitude = np.arctan2(points[:, 1], points[:, 0])
    return np.column_stack([np.rad2deg(latitude), np.rad2deg(longitude), height])
