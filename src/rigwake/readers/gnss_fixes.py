"""Satellite fixes of any format as one stream; what is no position is left out, what is not measured is unknown."""

from __future__ import annotations

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.geometry.geodesy import enu_from_lla
from rigwake.readers.streams import LARGEST_VALUE, symmetric_psd, usable_rows
from rigwake.recording import Finding, GnssStream

UNKNOWN_GNSS_VARIANCE = 25.0
"""m^2 per axis of a receiver that does not say."""
UNKNOWN_UP_VARIANCE = 1e6
"""m^2 of a height that was not measured."""
_FAR_M = 5e5
_METRES_PER_DEG = 111e3
_HIGHEST_M = 1e5
_FAR_UP_M = 2e3  # from the usual height


def gnss_stream_of_fixes(
    name: str,
    timestamps_ns: Stamps,
    lla: Array,
    covariances: Array,
    *,
    velocity_enu: Array | None = None,
    topic: str = "",
    frame_id: str = "",
) -> tuple[GnssStream, tuple[Finding, ...]]:
    """The fixes (N, 3; degrees, degrees, metres) in the plane tangent at the first that is one.

    covariances: (N, 3, 3) ENU; zeros where unknown. Left out and said: impossible coordinates, (0, 0) of receivers
    without a fix, places 500 km off the rest. A height that is NaN is unknown: the position stays, its height has
    UNKNOWN_UP_VARIANCE. Raises InputError if nothing is left.
    """
    lla, covariances = np.array(lla, dtype=np.float64), np.array(covariances, dtype=np.float64)
    findings: list[Finding] = []
    with np.errstate(invalid="ignore"):
        possible = (np.abs(lla[:, 0]) <= 90) & (np.abs(lla[:, 1]) <= 360)
        high = (np.abs(lla[:, 2]) < _HIGHEST_M) & possible
        if high.any():  # -9999 and the like stand for a height that is missing
            high &= np.abs(lla[:, 2] - np.median(lla[high, 2])) < _FAR_UP_M
    lla[~possible] = np.nan
    beyond = np.abs(lla[:, 1]) > 180  # false for NaN
    lla[beyond, 1] = (lla[beyond, 1] + 180.0) % 360.0 - 180.0
    findings += _without_strays(name, lla)
    no_height = ~high & np.isfinite(lla[:, 0])
    if no_height.any():
        known = lla[high & np.isfinite(lla[:, 0]), 2]
        lla[no_height, 2] = np.median(known) if len(known) else 0.0
        message = f"{int(no_height.sum())} fixes have no altitude (of {len(lla)}): no height is known there."
        findings.append(Finding("warning", name, message))
    rows, repaired = usable_rows(name, timestamps_ns, lla)
    if not len(rows):
        causes = " ".join(finding.message for finding in findings)
        raise InputError(f"{topic or name} holds no valid fix. {causes}".strip())
    origin = (float(lla[rows[0], 0]), float(lla[rows[0], 1]), float(lla[rows[0], 2]))
    spread, said = _believable(name, covariances[rows])
    spread[no_height[rows], 2, :] = spread[no_height[rows], :, 2] = 0.0
    spread[no_height[rows], 2, 2] = UNKNOWN_UP_VARIANCE
    stream = GnssStream(
        name,
        timestamps_ns[rows],
        enu_from_lla(lla[rows], origin),
        spread,
        origin,
        None if velocity_enu is None else velocity_enu[rows],
        topic,
        frame_id,
    )
    return stream, (*findings, *repaired, *said)


def _without_strays(name: str, lla: Array) -> list[Finding]:
    """Sets fixes to NaN that are at (0, 0) or far from all others; says how many."""
    there = np.isfinite(lla[:, 0])
    at_zero = there & (lla[:, 0] == 0.0) & (lla[:, 1] == 0.0)
    real = there & ~at_zero
    if not real.any():
        lla[at_zero] = np.nan
        return [_left_out(name, at_zero, "at latitude 0, longitude 0: no fix")] if at_zero.any() else []
    centre = np.median(lla[real, :2], axis=0)
    east = (lla[:, 1] - centre[1] + 180.0) % 360.0 - 180.0
    metres = _METRES_PER_DEG * np.hypot(lla[:, 0] - centre[0], east * np.cos(np.radians(centre[0])))
    with np.errstate(invalid="ignore"):
        at_zero &= metres > 1e3
        far = there & ~at_zero & (metres > _FAR_M)
    lla[at_zero | far] = np.nan
    findings = (
        [_left_out(name, at_zero, "at latitude 0, longitude 0, as without a fix")] if at_zero.any() else []
    )
    return [*findings, *([_left_out(name, far, "500 km and more from the others")] if far.any() else [])]


def _left_out(name: str, rows: Array, what: str) -> Finding:
    return Finding("warning", name, f"{int(rows.sum())} of {len(rows)} fixes are {what}; they were left out.")


def _believable(name: str, covariances: Array) -> tuple[Array, list[Finding]]:
    """Covariances with 5 m per axis where none is stated, or what is stated is none (said)."""
    with np.errstate(invalid="ignore"):
        stated = ~(covariances == 0).all(axis=(1, 2))
        sane = np.all(np.abs(covariances) < LARGEST_VALUE, axis=(1, 2))
    spread = symmetric_psd(covariances, UNKNOWN_GNSS_VARIANCE)
    replaced = stated & (
        ~sane | np.any(spread != (covariances + np.swapaxes(covariances, 1, 2)) / 2, axis=(1, 2))
    )
    if not replaced.any():
        return spread, []
    message = (
        f"{int(replaced.sum())} of {len(replaced)} covariances are NaN, infinite or not positive: "
        "5 m per axis is assumed there."
    )
    return spread, [Finding("warning", name, message)]
