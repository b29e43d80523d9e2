"""Fixes that a receiver gives more than once, each time with a new stamp, and heights that it does not measure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.recording import GnssStream

_LEAST_STEP_M = 0.05  # below, a vessel that lies still or a coarse last digit repeat a position too
_DIGIT_STEPS, _NO_STEP_M, _LEAST_DIGIT_M = 1.5, 2e-3, 0.01
_WORTH_A_WORD = 0.02  # of the fixes
_UNKNOWN_HEIGHT_M = 100.0
_OFF_GRID, _ON_GRID = 0.1, 0.95  # digits off a whole one, and the fraction of the steps that must be on one
_COARSE_M = 0.05  # of a last digit, from which on it counts as noise
_ONE_HEIGHT_M = 1e-3
_EQUATOR_M, _ECCENTRICITY_2 = 6378137.0, 6.69438e-3  # WGS 84


def repeated_rows(gnss: GnssStream) -> NDArray[np.bool_]:
    """(G,) fixes that repeat the one before to the last digit although the next other one lies elsewhere.

    Two fixes of a moving vessel are never alike: these are one fix, sent again. None where they are so few that chance
    makes them.
    """
    p = gnss.position_enu
    same = np.concatenate([[False], (np.diff(p, axis=0) == 0).all(axis=1)])
    if same.mean() < _WORTH_A_WORD:
        return np.zeros(len(p), dtype=bool)
    other = np.flatnonzero(~same)
    run = np.cumsum(~same) - 1
    steps = np.append(np.linalg.norm(np.diff(p[other], axis=0), axis=1), 0.0)
    return np.asarray(same & (steps[run] > max(_LEAST_STEP_M, _DIGIT_STEPS * _last_digit(p[other]))))


def with_rounding(gnss: GnssStream) -> tuple[GnssStream, float]:
    """The fixes with the variance of their last digit added, east and north, and the metres of that digit; 0 where it
    is fine, or far below the stated deviation."""
    p = gnss.position_enu
    other = np.concatenate([[True], (np.diff(p, axis=0) != 0).any(axis=1)])
    digit = _last_digit(p[other])
    stated = float(np.sqrt(np.median(gnss.covariances[:, [0, 1], [0, 1]]))) if len(gnss.covariances) else 0.0
    if digit < max(_COARSE_M, 0.5 * stated) or not _on_grid(p[other], digit):
        return gnss, 0.0
    return replace(gnss, covariances=gnss.covariances + np.diag([digit**2 / 12, digit**2 / 12, 0.0])), digit


def _on_grid(p: Array, digit: float) -> bool:
    """Whether fixes move by whole digits along the axis of that digit."""
    for steps in np.diff(p[:, :2], axis=0).T / digit:
        if np.mean(np.abs(steps - np.round(steps)) < _OFF_GRID) > _ON_GRID:
            return True
    return False


def _last_digit(p: Array) -> float:
    """Metres of the last digit of fixes (N, 3) that differ: four decimals of a minute are 0.18 m, and a slow vessel
    stays for several fixes where they are. The least step along an axis along which some fixes do not move."""
    found = 0.0
    for steps in np.abs(np.diff(p[:, :2], axis=0)).T:
        moved = steps[steps > _LEAST_DIGIT_M]
        if len(moved) and np.mean(steps < _NO_STEP_M) > _WORTH_A_WORD:
            found = max(found, float(moved.min()))
    return found


def never_moves(gnss: GnssStream) -> bool:
    """Whether all fixes are one position: no receiver's noise is that small."""
    return len(gnss.position_enu) > 1 and not np.ptp(gnss.position_enu, axis=0).any()


def without_heights(gnss: GnssStream) -> GnssStream | None:
    """The fixes with heights of no weight, where all are one height although the fixes move; else None."""
    p = gnss.position_enu
    # one height above the ellipsoid lies below the tangent plane by its curvature
    bent = 1 - _ECCENTRICITY_2 * np.sin(np.deg2rad(gnss.origin_lla[0])) ** 2
    east, north = _EQUATOR_M / np.sqrt(bent), _EQUATOR_M * (1 - _ECCENTRICITY_2) / bent**1.5
    below = p[:, 0] ** 2 / (2 * east) + p[:, 1] ** 2 / (2 * north)
    if len(p) < 2 or np.ptp(p[:, 2] + below) > _ONE_HEIGHT_M or not np.ptp(p[:, :2], axis=0).any():
        return None
    covariances = gnss.covariances.copy()
    covariances[:, 2, :] = covariances[:, :, 2] = 0.0
    covariances[:, 2, 2] = _UNKNOWN_HEIGHT_M**2
    return replace(gnss, covariances=covariances)
