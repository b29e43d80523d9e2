"""The 3-D view as plain values: frusta, ellipsoids, a boat outline, paths. Drawn by assets/report.js."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.report.adjustment_file import LandmarkCloud
from rigwake.report.charts import CLOUD_REACH, axis_text, ticks

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
        "grid": _grid(shown.min(axis=0) - 0.2 * extent, shown.max(axis=0) + 0.2 * extent, np.zeros(3)),
        "dimensions": _dimensions(known),
    }


def _dimensions(points: Array) -> str:
    """In words, the box around points (n, 3)."""
    across = " × ".join(axis_text(float(round(x, 2))) for x in np.ptp(points, axis=0))
    return f"{across} m (x × y × z)"


def _grid(low: Array, high: Array, origin: Array) -> dict[str, Any]:
    """Lines of a level grid at the lowest height of a box (3,), (3,): where they lie, and their names as seen from
    `origin` (3,), which is where the scene's own zero lies. One step serves both axes."""
    marks = ticks(0.0, float(np.max(high[:2] - low[:2])), 6)
    step = marks[1] - marks[0] if len(marks) > 1 else 1.0
    grid: dict[str, Any] = {"z": round(float(low[2]), 4), "low": [], "high": []}
    for name, axis in (("x", 0), ("y", 1)):
        first = np.floor((low[axis] + origin[axis]) / step)
        last = np.ceil((high[axis] + origin[axis]) / step)
        values = step * np.arange(first, last + 1)
        grid[name] = [round(float(v - origin[axis]), 4) for v in values]
        grid[f"{name}_names"] = [f"{axis_text(float(v))} m" for v in values.round(6)]
        grid["low"].append(grid[name][0])
        grid["high"].append(grid[name][-1])
    return grid


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


def path_scene(
    paths: Mapping[str, Array], colours: Mapping[str, int], cloud: LandmarkCloud | None = None
) -> dict[str, Any]:
    """Paths and landmarks in the world, centred on the paths, metres. Landmarks further away than `CLOUD_REACH` times
    the paths' extent are left out."""
    if not paths:
        return {"extent": 1.0, "middle": [0, 0, 0], "radius": 1.0, "paths": [], "cloud": [], "grid": None}
    everything = np.concatenate(list(paths.values()))
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle = (low + high) / 2
    extent = float(max(np.ptp(everything, axis=0).max() / 2, 1.0))
    points = np.zeros((0, 3))
    names: list[str] = []
    if cloud is not None:
        reach = CLOUD_REACH * 2 * extent
        near = np.flatnonzero(
            ((cloud.points_world > low - reach) & (cloud.points_world < high + reach)).all(1)
        )
        points, names = cloud.points_world[near], [cloud.cameras[k] for k in near]
    shown = np.concatenate([everything, points])
    # heights of a few landmarks that lie wrong would put the grid below the world
    floor = np.array([*shown[:, :2].min(axis=0), np.quantile(shown[:, 2], 0.02)])
    box = np.array([floor, shown.max(axis=0)]) - middle
    return {
        "extent": extent,
        "middle": _rounded(box.mean(axis=0)),
        "radius": round(float(np.linalg.norm(np.ptp(box, axis=0)) / 2), 3),
        "paths": [
            {"name": n, "colour": colours.get(n, -1), "points": (p - middle).round(_PATH_DIGITS).tolist()}
            for n, p in paths.items()
        ],
        "cloud": [
            {"colour": colours.get(name, -1), "points": (points[chosen] - middle).round(2).tolist()}
            for name in dict.fromkeys(names)
            if len(chosen := np.flatnonzero(np.array(names) == name))
        ],
        "grid": _grid(box[0], box[1], middle),
    }


def _rounded(values: Array) -> list[float]:
    return [round(float(x), 4) for x in values]
