"""What refining or finding a lens moved: where over the picture, which way, how far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake.ba.rig.intrinsics_refinement import moved_px
from rigwake.calibration import Calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_dict
from rigwake.errors import CameraError
from rigwake.report.reduce import MAP_COLUMNS, MAP_ROWS, ImageMap

_UNMOVED_PX = 1e-3


@dataclass(frozen=True, eq=False)
class LensDisplacement:
    """map: at every cell's middle, from the pixel of the lens given to that of the lens found for the same ray.
    rms_px, max_px: of the points in use. models: the names of both."""

    map: ImageMap
    rms_px: float | None
    max_px: float | None
    models: tuple[str, str]


def lens_displacements(calibration: Calibration) -> dict[str, LensDisplacement]:
    """By camera, of all whose lens was refined or found; those that stayed as given move by nothing."""
    found = {}
    for name, camera in calibration.cameras.items():
        told = camera.statistics.get("intrinsics")
        if not told or camera.model is None or "given_camera" not in told:
            continue
        try:
            given = camera_from_dict(told["given_camera"])
        except CameraError:  # of another version
            continue
        over_picture = _over_picture(given, camera.model)
        if over_picture.counts.max() < _UNMOVED_PX:
            continue
        found[name] = LensDisplacement(
            over_picture,
            told.get("moved_rms_px"),
            told.get("moved_max_px"),
            (given.model, camera.model.model),
        )
    return found


def _over_picture(given: CameraModel, found: CameraModel) -> ImageMap:
    columns = (np.arange(MAP_COLUMNS) + 0.5) * given.width_px / MAP_COLUMNS - 0.5
    rows = (np.arange(MAP_ROWS) + 0.5) * given.height_px / MAP_ROWS - 0.5
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    moved = moved_px(given, found, pixels).reshape(MAP_ROWS, MAP_COLUMNS, 2)
    size = np.linalg.norm(moved, axis=-1)
    return ImageMap(given.width_px, given.height_px, np.nan_to_num(size), moved)
