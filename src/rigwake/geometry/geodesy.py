"""Geographic coordinates (WGS84) to and from a local tangent plane, by PROJ."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Transformer

from rigwake._types import Array

Lla = tuple[float, float, float]


@lru_cache(maxsize=16)
def _enu_from_lla(origin_lla: Lla) -> Transformer:
    latitude_deg, longitude_deg, height = origin_lla
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={latitude_deg!r} +lon_0={longitude_deg!r} +h_0={height!r}"
    )


def enu_from_lla(lla: ArrayLike, origin_lla: Lla) -> Array:
    """East, north, up (N, 3) in metres, in the plane tangent at `origin_lla`, of geographic positions.

    lla: (N, 3) latitude and longitude in degrees, ellipsoidal height in metres (WGS84), as is the origin.
    """
    points = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
    transformer = _enu_from_lla(_plain(origin_lla))
    return np.column_stack(transformer.transform(points[:, 1], points[:, 0], points[:, 2]))


def lla_from_enu(position_enu: ArrayLike, origin_lla: Lla) -> Array:
    """Latitude, longitude (degrees) and ellipsoidal height (metres): the inverse of `enu_from_lla`."""
    points = np.asarray(position_enu, dtype=np.float64).reshape(-1, 3)
    transformer = _enu_from_lla(_plain(origin_lla))
    longitude, latitude, height = transformer.transform(
        points[:, 0], points[:, 1], points[:, 2], direction="INVERSE"
    )
    return np.column_stack([latitude, longitude, height])


def _plain(origin_lla: Lla) -> Lla:
    latitude_deg, longitude_deg, height = origin_lla
    return float(latitude_deg), float(longitude_deg), float(height)
