"""Seams on a floor (or a quay, or land): how well the lines of a textured ground continue from camera to camera."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rigwake.views.attitude import LevelAttitude
from rigwake.views.frames import FrameSet
from rigwake.views.projections import TopDown
from rigwake.views.seams import drawn_alone, followed_corners
from rigwake.views.surface import WaterAndShell
from rigwake.views.surround_rig import SurroundRig
from rigwake.views.surround_view import SurroundView

_FEWEST = 8


@dataclass(frozen=True)
class FloorSeam:
    """Two cameras, how many corners of the ground both show, and the median distance between where they draw them, in
    pixels of the top view and in metres; NaN with fewer than eight."""

    first: str
    second: str
    matches: int
    median_px: float
    median_m: float


def floor_seams(rig: SurroundRig, frames: FrameSet, attitude: LevelAttitude, top: TopDown) -> list[FloorSeam]:
    """Draw every camera alone into a top view of the plane `attitude.height_m` below the viewpoint, and compare.

    Raises UsageError if the height is unknown.
    """
    view = SurroundView(rig, top)
    surface = WaterAndShell()
    there = np.flatnonzero(~frames.is_missing)
    alone = {int(c): drawn_alone(view, frames, attitude, surface, int(c)) for c in there}
    found = []
    for a, b in combinations(alone, 2):
        start, end = followed_corners(alone[a], alone[b])
        if not len(start):
            continue
        distance = np.linalg.norm(end - start, axis=1)
        median = float(np.median(distance)) if len(distance) >= _FEWEST else float("nan")
        found.append(FloorSeam(rig.names[a], rig.names[b], len(distance), median, median / top.px_per_m))
    return found
