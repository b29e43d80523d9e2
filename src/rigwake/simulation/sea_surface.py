"""The sea as rays meet it: tiles of height and slope with mip levels, and the intersection with a ray."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rigwake._types import Floats
from rigwake.simulation.compiled import inlined
from rigwake.simulation.waves import TILE_CELLS, WaveField

HORIZON_M = 6000.0
_LEVELS = 8
_CAPILLARY_VARIANCE = 6e-4  # slopes of ripples shorter than the shortest tile


class Water(NamedTuple):
    """Tiles of height and slopes with their mip levels: (M, 3) cells, first cell by (tile, level), edge lengths in
    metres and their base-2 logarithms, slope variance lost by (tile, level), bound of the height."""

    cells: Floats
    starts: Any
    lengths: Floats
    octaves: Floats
    lost: Floats
    bound: float


def water_at(sea: WaveField, time_s: float) -> Water:
    """The sea's tiles at a time with their mip levels, and what slope variance each level averages away."""
    cells, starts, lost, at, highest = [], [], [], 0, 0.0
    for tile in sea.tiles:
        surface = tile.surface(time_s)
        highest += float(np.abs(surface[..., 0]).max())
        variance, row = [], []
        for _ in range(_LEVELS):
            cells.append(surface.reshape(-1, 3))
            row.append(at)
            at += len(cells[-1])
            variance.append(
                float(np.mean(surface[..., 1:] ** 2))
            )  # slopes of a periodic surface have no mean
            quarters = surface[::2, ::2] + surface[1::2, ::2] + surface[::2, 1::2] + surface[1::2, 1::2]
            surface = np.asarray(quarters / 4, np.float32)
        starts.append(row)
        lost.append([max(variance[0] - left, 0.0) for left in variance])
    lengths = np.array([tile.length_m for tile in sea.tiles], np.float32)
    return Water(
        np.concatenate(cells),
        np.array(starts),
        lengths,
        np.log2(lengths),
        np.array(lost, np.float32),
        max(highest, 1e-3),
    )


@inlined
def bilinear(texels: Floats, start: int, size: int, u: float, v: float) -> tuple[float, float, float]:
    """Three channels at (u, v) of a periodic square of `size` x `size` texels, whose centres lie at half texels."""
    x, y = u * size - 0.5, v * size - 0.5
    fx, fy = math.floor(x), math.floor(y)
    ax, ay = x - fx, y - fy
    x0, y0 = int(fx) & (size - 1), int(fy) & (size - 1)
    x1, y1 = (x0 + 1) & (size - 1), (y0 + 1) & (size - 1)
    i, j = start + y0 * size, start + y1 * size
    w00, w01 = (1 - ax) * (1 - ay), ax * (1 - ay)
    w10, w11 = (1 - ax) * ay, ax * ay
    a, b, c, d = i + x0, i + x1, j + x0, j + x1
    return (
        w00 * texels[a, 0] + w01 * texels[b, 0] + w10 * texels[c, 0] + w11 * texels[d, 0],
        w00 * texels[a, 1] + w01 * texels[b, 1] + w10 * texels[c, 1] + w11 * texels[d, 1],
        w00 * texels[a, 2] + w01 * texels[b, 2] + w10 * texels[c, 2] + w11 * texels[d, 2],
    )


@inlined
def _tile(water: Water, tile: int, octave: float, x: float, y: float) -> tuple[float, float, float]:
    """Height and slopes of one tile, in the mip level whose cells are `2^octave` metres / 256 across."""
    level = int(min(max(octave - water.octaves[tile], 0.0), 7.0))
    # +0.5: cell (0, 0) of level 0 lies at the origin, while `bilinear` puts it half a cell away
    edge = water.lengths[tile]
    u, v = x / edge + 0.5 / TILE_CELLS, y / edge + 0.5 / TILE_CELLS
    return bilinear(water.cells, water.starts[tile, level], TILE_CELLS >> level, u, v)


@inlined
def _newton(
    water: Water,
    octave: float,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    t: float,
) -> tuple[float, float, float]:
    """Step along a ray that brings it to the surface, and the surface's slopes, from the two longer tiles."""
    x, y = ox + t * dx, oy + t * dy
    h0, sx0, sy0 = _tile(water, 0, octave, x, y)
    h1, sx1, sy1 = _tile(water, 1, octave, x, y)
    sx, sy = sx0 + sx1, sy0 + sy1
    closing = min(dz - sx * dx - sy * dy, 0.4 * dz)
    return (h0 + h1 - oz - t * dz) / closing, sx, sy


@inlined
def may_meet_water(water: Water, oz: float, dz: float, nearest: float) -> bool:
    """Whether a ray can reach the highest wave before `nearest`."""
    return dz < -1e-5 and (water.bound - oz) / dz <= min(nearest, HORIZON_M)


@inlined
def meet_water(
    water: Water,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    width: float,
    rounding: float,
) -> tuple[float, float, float, float]:
    """Distance to the sea along a ray that points down, the slopes there of the two longer tiles, and the mip level
    (of a tile of 1 m) of the ray's width there.

    Newton steps from the still water. Mip levels are not interpolated: each ray of a pixel rounds them its own way
    (`rounding` in 0..1), so that their mean is interpolated.
    """
    first, last = (water.bound - oz) / dz, (-water.bound - oz) / dz
    t = -oz / dz
    seen = width * t / math.sqrt(max(-dz, 0.04))
    level = math.log2(np.float32(max(seen, 1e-6))) + 8
    octave = level + rounding
    close_enough = max(1e-3, 0.5 * seen)  # along the ray: the next step would be far smaller still
    step, sx, sy = _newton(water, octave, ox, oy, oz, dx, dy, dz, t)
    t = min(max(t + step, first), last)
    if abs(step) >= close_enough:
        step, sx, sy = _newton(water, octave, ox, oy, oz, dx, dy, dz, t)
        t = min(max(t + step, first), last)
        if abs(step) >= close_enough:
            step, sx, sy = _newton(water, octave, ox, oy, oz, dx, dy, dz, t)
            t = min(max(t + step, first), last)
    return t, sx, sy, level


@inlined
def ripples(water: Water, x: float, y: float, octave: float, rounding: float) -> tuple[float, float, float]:
    """Slopes of the shortest tile, and the variance of all slopes that a width of this mip level averages away."""
    lost = _CAPILLARY_VARIANCE
    for tile in range(3):
        level = min(max(octave - water.octaves[tile], 0.0), 7.0)
        low = int(min(level, 6.0))
        lost += water.lost[tile, low] + (level - low) * (water.lost[tile, low + 1] - water.lost[tile, low])
    _, sx, sy = _tile(water, 2, octave + rounding, x, y)
    return sx, sy, lost
