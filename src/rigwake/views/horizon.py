"""Which way is up, from the pictures alone: a level line that goes all around (the horizon, or a water's edge)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image
from rigwake.views.attitude import LevelAttitude, level_rotation
from rigwake.views.strips import StripGrid, level_strip
from rigwake.views.surface import Shell
from rigwake.views.surround_rig import SurroundRig

_GRID = StripGrid(step_deg=0.75, top_deg=36.0, rows=96)
_OFFSETS_DEG = np.arange(-6.0, 1.1, 1.0)  # of the line: a shore a little below the horizon is level, too
_TILT_STD = np.deg2rad(1.0)
_LEAST_CONTRAST = 8.0  # grey levels along the line: less is no horizon
_MOST_CONTRAST = 40.0  # so that lamps and hulls do not outweigh a whole shore
_BAND_ROWS = 5
_USUAL_TILT_DEG = 8.0
_TILT_COST = 8.0  # grey levels
_FAR_M = 200.0


def horizon_attitude(
    images: Mapping[str, Image],
    rig: SurroundRig,
    start: LevelAttitude,
    search_deg: float = 15.0,
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
) -> LevelAttitude | None:
    """The attitude in which the longest level edge lies level; None if no tilt stands out.

    The level strip is made with `start`; of all tilts within `search_deg` (and a few constant elevations) the one is
    taken along whose line `tan(elevation) = c - x cos(azimuth) + y sin(azimuth)` it gets darkest from above to below:
    water is darker than sky and shore, whatever the texture. Large tilts are a little less likely.
    """
    strip = level_strip(images, rig, start, Shell(_FAR_M), _GRID, masks)
    contrast = _contrast(strip.image, strip.is_seen, _BAND_ROWS)
    candidates = _candidates(np.zeros(3), search_deg, 2.0, _OFFSETS_DEG)
    scores = (
        _scores(contrast, candidates) - _TILT_COST * (candidates[:, :2] ** 2).sum(axis=1) / _USUAL_TILT_DEG**2
    )
    centre = candidates[int(scores.argmax())]
    best = float(_scores(contrast, centre[None])[0])
    sharp = _contrast(strip.image, strip.is_seen, 1)  # the edge itself, once its neighbourhood is known
    step = 2.0
    while step > 0.04:
        candidates = _candidates(centre, step, step / 2, centre[2] + np.array([-step / 2, 0, step / 2]))
        centre = candidates[int(_scores(sharp, candidates).argmax())]
        step /= 2
    if best < _LEAST_CONTRAST:
        return None
    up_level = np.array([np.tan(np.deg2rad(centre[0])), np.tan(np.deg2rad(centre[1])), 1.0])
    up_rig = start.level_from_rig.T @ (up_level / np.linalg.norm(up_level))
    return replace(
        start, level_from_rig=level_rotation(up_rig, rig.forward_rig), tilt_std=_TILT_STD, source="horizon"
    )


def _candidates(centre: Array, reach_deg: float, step_deg: float, offsets_deg: Array) -> Array:
    """(N, 3) tilts (degrees, towards ahead and port) and constant elevations."""
    steps = np.arange(-reach_deg, reach_deg + step_deg / 2, step_deg)
    x, y, c = np.meshgrid(centre[0] + steps, centre[1] + steps, offsets_deg, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), c.ravel()], axis=1)


def _contrast(picture: Image, is_seen: NDArray[np.bool_], rows: int) -> NDArray[np.float32]:
    """Mean brightness of so many rows above less that of the rows below, clipped; zero at the rims."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.float32)
    mean = cv2.blur(grey, (3, rows))
    half = rows // 2 + 1
    seen = cv2.erode(is_seen.astype(np.uint8), np.ones((2 * rows + 3, 3), np.uint8), borderValue=0) > 0
    contrast = np.zeros_like(grey)
    contrast[half:-half] = mean[: -2 * half] - mean[2 * half :]
    return np.where(seen, np.clip(contrast, -_MOST_CONTRAST, _MOST_CONTRAST), 0.0).astype(np.float32)


def _scores(contrast: NDArray[np.float32], candidates: Array) -> Array:
    """(N,) mean contrast along every line; columns where it leaves the strip count as zero."""
    azimuth = _GRID.azimuths()[::2]
    x, y, c = np.deg2rad(candidates).T
    slope = c[:, None] - x[:, None] * np.cos(azimuth) + y[:, None] * np.sin(azimuth)
    rows = np.round((_GRID.top_deg - np.rad2deg(np.arctan(slope))) / _GRID.step_deg - 0.5).astype(np.int64)
    inside = (rows >= 0) & (rows < _GRID.rows)
    columns = np.arange(len(azimuth)) * 2
    values = contrast[np.where(inside, rows, 0), columns]
    return np.asarray(np.where(inside, values, 0.0).mean(axis=1), dtype=np.float64)
