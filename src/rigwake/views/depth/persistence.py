"""What stands on the water a little earlier stood at the same place of the world; glitter and wave crests did not.

The strip of the earlier pictures is segmented too. A piece of obstacle is looked up there where its foot on the water
plane was seen from, with the way and the turn of the vessel since.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Mask
from rigwake.geometry.se3 import SE3
from rigwake.views.attitude import LevelAttitude, level_rotation
from rigwake.views.depth.motion import Earlier
from rigwake.views.scene.segmentation import NOT_SEEN, OBSTACLE, WATER, PixelClassifier, segment_strip
from rigwake.views.strips import StripGrid, level_strip
from rigwake.views.surface import Surface
from rigwake.views.surround_rig import SurroundRig


@dataclass(frozen=True, eq=False)
class EarlierLooks:
    """odds: (rows, columns) log odds of obstacle over water in the earlier strip, NaN where nothing was seen.
    then_from_now: from the level frame of now to that of then."""

    odds: Array
    then_from_now: SE3

    def mean_odds(self, number: NDArray[np.int32], count: int, grid: StripGrid, height_m: float) -> Array:
        """(count,) mean odds of numbered pieces (rows, columns) where they were then; NaN where not seen then.

        Every column of a piece stands upright on its lowest pixel. height_m: of the viewpoint above the water.
        """
        rows, columns = np.nonzero(number)
        piece = number[rows, columns]
        key = piece.astype(np.int64) * grid.columns + columns
        foot = np.zeros(count * grid.columns, np.int64)
        np.maximum.at(foot, key, rows)
        slope = np.tan(np.maximum(-grid.elevations(), np.deg2rad(0.2)))
        distance = height_m / slope[foot[key]]
        directions = grid.directions()[rows, columns]
        points = directions * (distance / np.hypot(directions[:, 0], directions[:, 1]))[:, None]
        then = self.then_from_now * points
        at = np.round(grid.pixels(then / np.linalg.norm(then, axis=1)[:, None])).astype(np.int64)
        inside = (at[:, 1] >= 0) & (at[:, 1] < grid.rows)
        found = np.where(inside, self.odds[at[:, 1].clip(0, grid.rows - 1), at[:, 0] % grid.columns], np.nan)
        seen = np.isfinite(found)
        total = np.bincount(piece[seen], found[seen], count)
        with np.errstate(invalid="ignore"):
            return np.asarray(total / np.bincount(piece[seen], minlength=count))


def earlier_looks(
    earlier: Earlier,
    rig: SurroundRig,
    attitude: LevelAttitude,
    surface: Surface,
    grid: StripGrid,
    classifier: PixelClassifier,
    masks: Mapping[str, Mask] | None = None,
) -> EarlierLooks | None:
    """Segment the earlier pictures, levelled as the rig stood then. attitude: of now.

    None where the viewpoint's height above the water, now or then, is unknown or not positive (a small boat in waves).
    """
    moved = earlier.rig_from_rig_then
    now = attitude.level_from_rig
    then = level_rotation(moved.rotation.T @ now[2], rig.forward_rig)
    way_level = now @ (moved * rig.viewpoint_rig - rig.viewpoint_rig)
    turn = then @ moved.rotation.T @ now.T
    height_m = attitude.height_m + float(way_level[2])
    if not height_m > 0:
        return None
    stand = replace(attitude, level_from_rig=then, height_m=height_m)
    strip = level_strip(earlier.images, rig, stand, surface, grid, masks)
    labels = segment_strip(strip, classifier)
    logarithm = np.log(np.maximum(labels.probability, 1e-4))
    odds = np.where(labels.classes == NOT_SEEN, np.nan, logarithm[OBSTACLE] - logarithm[WATER])
    return EarlierLooks(odds, SE3(turn, -turn @ way_level))
