"""How high the cameras are above the water: from ripples that two cameras match at the same time.

What two cameras match on the water lies in its surface, or under it (mirror images), or anywhere (chance). Only the
surface makes many points agree on one height, at all ranges and in all directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from rigwake._types import Array, Image, Mask
from rigwake.errors import EstimationError
from rigwake.views.attitude import LevelAttitude
from rigwake.views.depth.epipolar import epipolar_pairs, match_pair
from rigwake.views.surround_rig import SurroundRig

RIPPLES_STD = (
    0.05  # relative: mirrored light seems to come from a little under the surface; six simulated scenes
)
_STEEP = np.sin(np.deg2rad(12.0))  # of depression: what is higher up lies far away or stands on land
_RELATIVE_STD = 0.02  # of a range, at most
_TEXTURE = 4.0  # grey levels
_HEIGHTS_M = (0.3, 60.0)
_STEP = 0.01  # of the histogram of logarithms
_KERNEL = 4.0  # steps, standard deviation
_NARROW = 2.0
_HEAVE = 0.2  # relative, of the peak of one frame set about that of all
_LEAST_OF_SET = 300
_APART = 10  # steps between two peaks
_LEAST_POINTS = 1500  # within the peak
_SECOND = 0.5  # density of another peak, in densities of the first, beyond which neither is believed


def ripple_heights(
    images: Mapping[str, Image], rig: SurroundRig, attitude: LevelAttitude, masks: Mapping[str, Mask] | None
) -> Array:
    """(N,) metres by which matched points far below the horizon lie under the viewpoint."""
    found = [np.zeros(0)]
    for pair in epipolar_pairs(rig, attitude):
        matched = match_pair(pair, images, rig, attitude, masks)
        if matched is not None:
            distance = np.linalg.norm(matched.points_level, axis=1)
            down = -matched.points_level[:, 2]
            clear = (matched.texture > _TEXTURE) & (matched.inverse_std * distance < _RELATIVE_STD)
            found.append(down[clear & (down > _STEEP * distance)])
    return np.concatenate(found)


def height_of_ripples(by_set: Sequence[Array]) -> tuple[float, int]:
    """The height on which by far the most of all agree, metres, and how many do. by_set: (N,) heights of every frame
    set; the vessel heaves, so that each has a peak of its own, and their mean counts.

    Raises EstimationError if there are too few or none stands out.
    """
    heights_m = np.concatenate(by_set)
    low, high = np.log(_HEIGHTS_M)
    logarithm = np.log(heights_m[(heights_m > _HEIGHTS_M[0]) & (heights_m < _HEIGHTS_M[1])])
    edges = np.arange(low, high + _STEP, _STEP)
    density = cv2.GaussianBlur(np.histogram(logarithm, edges)[0].astype(np.float64)[None], (0, 0), _KERNEL)[0]
    best = int(density.argmax())
    centre = low + (best + 0.5) * _STEP
    agreeing = int((np.abs(logarithm - centre) < 2 * _KERNEL * _STEP).sum())
    if agreeing < _LEAST_POINTS:
        raise EstimationError("Two cameras match too little of the water near the vessel.")
    peaks = (density[1:-1] >= density[:-2]) & (density[1:-1] >= density[2:])
    others = np.flatnonzero(peaks) + 1
    others = others[np.abs(others - best) > _APART]
    if len(others) and density[others].max() > _SECOND * density[best]:
        raise EstimationError("What two cameras match near the vessel does not agree on one height.")
    own = [peak for heights in by_set if (peak := _peak_near(heights, centre)) is not None]
    return float(np.exp(np.mean(own) if own else centre)), agreeing


def _peak_near(heights_m: Array, centre: float) -> float | None:
    """The peak of the logarithms within the heave about `centre`; None with too few. A narrow kernel: mirrored light
    under the surface draws a wide one down."""
    near = np.log(heights_m[heights_m > 0]) - centre
    near = near[np.abs(near) < _HEAVE]
    if len(near) < _LEAST_OF_SET:
        return None
    edges = np.arange(-_HEAVE, _HEAVE, _STEP / 2)
    density = cv2.GaussianBlur(np.histogram(near, edges)[0].astype(np.float64)[None], (0, 0), 2 * _NARROW)[0]
    return centre + float(edges[int(density.argmax())]) + _STEP / 4
