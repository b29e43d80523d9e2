"""The 3-D view as plain values: frusta, ellipsoids, a boat outline, paths. Drawn by assets/report.js."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.calibration import CalibratedCamera, Calibration

# the outline of a hull seen from above, bow at x = 0.5, one long
_HALF_HULL = [(0.36, 0.1), (0.15, 0.17), (-0.2, 0.18), (-0.5, 0.15)]
_HULL = np.array([(0.5, 0.0), *_HALF_HULL, *((x, -y) for x, y in reversed(_HALF_HULL))])
_FRAMES_WITH_A_BOW = ("imu", "base_link")
_FRUSTUM_HALF_ANGLE = np.deg2rad(35)  # wide lenses are drawn as if they were this narrow
_PATH_DIGITS = 3


def rig_scene(calibration: Calibration) -> dict[str, Any]:
    """Cameras in the frame of the rig; what is unobservable is null, and `open` gives its directions."""
    positions = np.array([c.rig_from_cam.translation for c in calibration.cameras.values()])
    known = np.nan_to_num(positions)
    extent = float(max(np.ptp(known, axis=0).max(), 0.5))
    shown = np.vstack([known, np.zeros(3)])
    middle = (shown.min(axis=0) + shown.max(axis=0)) / 2
    return {
        "extent": extent,
        "middle": _rounded(middle),
        "radius": round(float(np.linalg.norm(shown - middle, axis=1).max()) + 0.25 * extent, 3),
        "reference": calibration.reference,
        "hull": _hull(known) if calibration.reference in _FRAMES_WITH_A_BOW else None,
        "cameras": [_camera(c, extent) for c in calibration.cameras.values()],
        "antenna": None if calibration.antenna_rig is None else _rounded(calibration.antenna_rig),
    }


def _hull(positions: Array) -> list[list[float]]:
    """An outline around all cameras, at the height of the rig's origin: for orientation, not to scale."""
    low, high = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
    length = float(max(1.5 * (high[0] - low[0]), 3.2 * (high[1] - low[1]), 1.0))
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2])
    outline = _HULL * length + middle
    return [[*row, 0.0] for row in outline.round(3).tolist()]


def _camera(camera: CalibratedCamera, extent: float) -> dict[str, Any]:
    rotation, translation = camera.rig_from_cam.rotation, camera.rig_from_cam.translation
    frustum = None
    if np.isfinite(rotation).all():
        depth = 0.16 * extent
        half = depth * np.tan(_FRUSTUM_HALF_ANGLE)
        lens = camera.model
        tall = half * (lens.height_px / lens.width_px if lens is not None else 0.75)
        corners = np.array(
            [(x, y, depth) for x, y in ((-half, -tall), (half, -tall), (half, tall), (-half, tall))]
        )
        frustum = (corners @ rotation.T).round(4).tolist()
    std = camera.std_translation_m
    axes = None
    if np.isfinite(std).all():
        values, vectors = np.linalg.eigh(camera.covariance_rig_axes[3:, 3:])
        axes = (vectors * np.sqrt(np.maximum(values, 0))).T.tolist()
    return {
        "name": camera.name,
        "position": [None if np.isnan(x) else round(float(x), 4) for x in translation],
        "frustum": frustum,
        "sigma_axes": axes,
        "open": [  # only translations can be drawn as lines
            _rounded(d.direction[3:]) for d in camera.unobservable if np.linalg.norm(d.direction[3:]) > 0.1
        ],
    }


def path_scene(paths: Mapping[str, Array], colours: Mapping[str, int]) -> dict[str, Any]:
    """Paths in the world, centred, metres."""
    if not paths:
        return {"extent": 1.0, "middle": [0, 0, 0], "radius": 1.0, "paths": []}
    everything = np.concatenate(list(paths.values()))
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    extent = float(max(np.ptp(everything, axis=0).max() / 2, 1.0))
    return {
        "extent": extent,
        "middle": [0, 0, 0],
        "radius": extent,
        "paths": [
            {"name": n, "colour": colours.get(n, -1), "points": (p - middle).round(_PATH_DIGITS).tolist()}
            for n, p in paths.items()
        ],
    }


def _rounded(values: Array) -> list[float]:
    return [round(float(x), 4) for x in values]
