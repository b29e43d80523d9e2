"""Compiled loops: what colour a ray brings home.

All run without the interpreter's lock. `Surfaces` and `Water` are tuples of arrays, the form compiled code takes.

Water: Fresnel by Schlick with the roughness correction of Bruneton et al. (2010), *Real-time Realistic Ocean
Lighting*; sun glitter by the slope density of Cox and Munk (1954), with the slopes too short to be seen at a
distance as its variance.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from rigwake.geometry.so3 import Array
from rigwake.simulate.light import SUN_IRRADIANCE
from rigwake.simulate.meshes import Floats

LAND, SKY, WATER, HULL = 60, 120, 180, 240
_HAZE_M = 3500.0
_HORIZON_M = 6000.0
_CAPILLARY_VARIANCE = 6e-4  # slopes of ripples shorter than the shortest tile

# no `nnan`, `ninf`: misses are infinite. Inlined by LLVM: a call would copy the arrays' descriptors each time
_FAST = {"contract", "reassoc", "arcp", "nsz", "afn"}
_loop = numba.njit(nogil=True, cache=True, fastmath=_FAST, error_model="numpy")
_inlined = numba.njit(nogil=True, cache=True, fastmath=_FAST, error_model="numpy", forceinline=True)


class Surfaces(NamedTuple):
    """Triangles, textures and sky, as plain arrays."""

    uv: Floats
    texture: Any
    tint: Floats
    normal: Floats
    light: Floats
    texels: Floats
    starts: Any
    sizes: Any
    metres: Floats
    panorama: Floats
    sun: Floats
    horizon: Floats


class Water(NamedTuple):
    """Tiles of height and slopes with their mip levels: (M, 3) cells, first cell by (tile, level), edge lengths in
    metres and their base-2 logarithms, slope variance lost by (tile, level), bound of the height."""

    cells: Floats
    starts: Any
    lengths: Floats
    octaves: Floats
    lost: Floats
    bound: float


class Rays(NamedTuple):
    """Rays of a chunk and what they hit: origins, directions (N, 3), pixel, width (radians), distance, triangle
    (-1: none) and its barycentric coordinates."""

    origin: Floats
    direction: Floats
    pixel: Any
    width: Floats
    distance: Floats
    triangle: Any
    u: Floats
    v: Floats


class Mirrored(NamedTuple):
    """Rays thrown back by water: as `Rays`, with their share of the pixel and the sun's glint, if nothing hides it."""

    origin: Floats
    direction: Floats
    pixel: Any
    width: Floats
    travelled: Floats
    share: Floats
    glint: Floats


@_inlined
def _bilinear(texels: Floats, start: int, size: int, u: float, v: float) -> tuple[float, float, float]:
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


@_inlined
def _texture(s: Surfaces, number: int, u_m: float, v_m: float, width_m: float) -> tuple[float, float, float]:
    """Colour of a texture at metres along a surface, averaged over a width: trilinear in the mip pyramid."""
    edge, size = s.metres[number], s.sizes[number, 0]
    level = math.log2(max(width_m * size / edge, 1e-6))
    level = min(max(level, 0.0), s.starts.shape[1] - 1.001)
    low = int(level)
    share = level - low
    u, v = u_m / edge, v_m / edge
    r, g, b = _bilinear(s.texels, s.starts[number, low], s.sizes[number, low], u, v)
    if share < 0.02:
        return r, g, b
    r1, g1, b1 = _bilinear(s.texels, s.starts[number, low + 1], s.sizes[number, low + 1], u, v)
    return r + share * (r1 - r), g + share * (g1 - g), b + share * (b1 - b)


@_inlined
def _sky(s: Surfaces, dx: float, dy: float, dz: float) -> tuple[float, float, float]:
    height, width = s.panorama.shape[0], s.panorama.shape[1]
    if dz <= 0:
        return s.horizon[0], s.horizon[1], s.horizon[2]
    y = min(math.sqrt(dz) * height, height - 1.001)
    x = (math.atan2(dy, dx) / (2 * math.pi)) % 1.0 * width - 0.5
    x0, y0 = math.floor(x), int(y)
    ax, ay = x - x0, y - y0
    x0 %= width
    x1 = (x0 + 1) % width
    p = s.panorama
    r = (1 - ay) * ((1 - ax) * p[y0, x0, 0] + ax * p[y0, x1, 0]) + ay * (
        (1 - ax) * p[y0 + 1, x0, 0] + ax * p[y0 + 1, x1, 0]
    )
    g = (1 - ay) * ((1 - ax) * p[y0, x0, 1] + ax * p[y0, x1, 1]) + ay * (
        (1 - ax) * p[y0 + 1, x0, 1] + ax * p[y0 + 1, x1, 1]
    )
    b = (1 - ay) * ((1 - ax) * p[y0, x0, 2] + ax * p[y0, x1, 2]) + ay * (
        (1 - ax) * p[y0 + 1, x0, 2] + ax * p[y0 + 1, x1, 2]
    )
    return r, g, b


@_inlined
def _land(
    s: Surfaces,
    triangle: int,
    u: float,
    v: float,
    px: float,
    py: float,
    pz: float,
    cosine: float,
    width_m: float,
) -> tuple[float, float, float]:
    """Colour of a point on a triangle: texture x weathering x tint x the light baked into its corners."""
    w = 1 - u - v
    uv, light, normal = s.uv[triangle], s.light[triangle], s.normal[triangle]
    seen = width_m / math.sqrt(max(cosine, 0.04))
    tu, tv = w * uv[0, 0] + u * uv[1, 0] + v * uv[2, 0], w * uv[0, 1] + u * uv[1, 1] + v * uv[2, 1]
    r, g, b = _texture(s, s.texture[triangle], tu, tv, seen)
    if abs(normal[2]) > 0.7:
        mr, mg, mb = _texture(s, len(s.metres) - 1, px, py, seen)
    else:
        mr, mg, mb = _texture(s, len(s.metres) - 1, px * normal[1] - py * normal[0], pz, seen)
    tint = s.tint[triangle]
    return (
        r * mr * tint[0] * (w * light[0, 0] + u * light[1, 0] + v * light[2, 0]),
        g * mg * tint[1] * (w * light[0, 1] + u * light[1, 1] + v * light[2, 1]),
        b * mb * tint[2] * (w * light[0, 2] + u * light[1, 2] + v * light[2, 2]),
    )


@_inlined
def _tile(water: Water, tile: int, level: int, x: float, y: float) -> tuple[float, float, float]:
    # +0.5: cell (0, 0) of level 0 lies at the origin, while `_bilinear` puts it half a cell away
    edge, size = water.lengths[tile], 256 >> level
    u, v = x / edge + 0.5 / 256, y / edge + 0.5 / 256
    return _bilinear(water.cells, water.starts[tile, level], size, u, v)


@_inlined
def water_distance(
    water: Water,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    width: float,
    nearest: float,
) -> float:
    """Distance along a ray to the surface of the sea (Newton steps on the two longer tiles), inf if none."""
    if dz >= -1e-5:
        return np.inf
    first, last = (water.bound - oz) / dz, (-water.bound - oz) / dz
    if first > min(nearest, _HORIZON_M):
        return np.inf
    t = -oz / dz
    seen = width * t / math.sqrt(max(-dz, 0.04))
    level0 = _nearest_level(water, 0, seen)
    level1 = _nearest_level(water, 1, seen)
    close_enough = max(1e-3, 0.5 * seen)  # along the ray: the next step would be far smaller still
    for _ in range(3):
        x, y = ox + t * dx, oy + t * dy
        h0, sx0, sy0 = _tile(water, 0, level0, x, y)
        h1, sx1, sy1 = _tile(water, 1, level1, x, y)
        closing = min(dz - (sx0 + sx1) * dx - (sy0 + sy1) * dy, 0.4 * dz)
        step = (oz + t * dz - h0 - h1) / closing
        t = min(max(t - step, first), last)
        if abs(step) < close_enough:
            break
    return t


@_inlined
def _nearest_level(water: Water, tile: int, width_m: float) -> int:
    cell = water.lengths[tile] / 256
    if width_m < 1.42 * cell:
        return 0
    return int(min(math.log2(width_m / cell) + 0.5, 7.0))


@_inlined
def _clear_air(distance_m: float) -> float:
    """Share of light that haze lets through: `exp(-x)` to third order, which is cheaper."""
    x = distance_m / _HAZE_M
    return 1 / (1 + x * (1 + x * (0.5 + x / 6)))


@_inlined
def _slopes(water: Water, x: float, y: float, width_m: float) -> tuple[float, float, float]:
    """Slopes by x and y averaged over a width, and the variance of what that averages away."""
    sx = sy = 0.0
    lost = _CAPILLARY_VARIANCE
    octave = math.log2(max(width_m, 1e-6)) + 8
    for tile in range(3):
        level = min(max(octave - water.octaves[tile], 0.0), 7.0)
        low = int(level)
        if low == 7:  # a single cell, all averaged away
            lost += water.lost[tile, 7]
            continue
        share = level - low
        _, ax, ay = _tile(water, tile, low, x, y)
        if share > 0.02:
            _, bx, by = _tile(water, tile, low + 1, x, y)
            ax, ay = ax + share * (bx - ax), ay + share * (by - ay)
        sx += ax
        sy += ay
        lost += (1 - share) * water.lost[tile, low] + share * water.lost[tile, low + 1]
    return sx, sy, lost


@_inlined
def _mirror(
    s: Surfaces, water: Water, rays: Rays, i: int, t: float, out: Mirrored, k: int, image: Floats
) -> None:
    """Water met by ray i: the light from below goes into the image, the mirrored ray into `out[k]`."""
    dx, dy, dz = rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2]
    x, y = rays.origin[i, 0] + t * dx, rays.origin[i, 1] + t * dy
    width_m = rays.width[i] * t / math.sqrt(max(-dz, 0.04))
    sx, sy, lost = _slopes(water, x, y, width_m)
    rough = math.sqrt(lost)
    # facets that lean away are hidden at a low angle: those seen lean towards the eye
    flat = max(math.hypot(dx, dy), 1e-6)
    lean = rough * max(0.0, 1 + dz / max(2.5 * rough, 0.05)) * 0.8
    nx, ny, nz = -sx - lean * dx / flat, -sy - lean * dy / flat, 1.0
    length = math.sqrt(nx * nx + ny * ny + 1)
    nx, ny, nz = nx / length, ny / length, nz / length
    facing = max(-(nx * dx + ny * dy + nz * dz), 0.015)
    steep = 1 + rough * (2.69 + rough * (3.62 + 3.24 * rough))  # exp(2.69 rough)
    fresnel = 0.02 + 0.98 * (1 - facing) ** (5 / steep) / (1 + 22.7 * rough * math.sqrt(rough))
    rx, ry, rz = dx + 2 * facing * nx, dy + 2 * facing * ny, max(dz + 2 * facing * nz, 0.012)
    length = math.sqrt(rx * rx + ry * ry + rz * rz)
    rx, ry, rz = rx / length, ry / length, rz / length
    haze = _clear_air(t)
    # light scattered back by the water itself, a little more of it through tilted faces
    body = (1 - fresnel) * (0.75 + 1.6 * max(sx * dx + sy * dy, -0.3)) * haze
    pixel = rays.pixel[i]
    image[pixel, 0] += body * 0.012 + (1 - haze) * s.horizon[0]
    image[pixel, 1] += body * 0.042 + (1 - haze) * s.horizon[1]
    image[pixel, 2] += body * 0.050 + (1 - haze) * s.horizon[2]
    hx, hy, hz = s.sun[0] - dx, s.sun[1] - dy, s.sun[2] - dz
    miss = (hx / hz + sx) ** 2 + (hy / hz + sy) ** 2
    variance = lost + 2e-4  # and the width of the sun itself
    density = math.exp(-0.5 * miss / variance) / (2 * math.pi * variance) if miss < 60 * variance else 0.0
    out.glint[k] = min(fresnel * SUN_IRRADIANCE * density / (4 * facing), 6.0) * haze
    out.origin[k, 0], out.origin[k, 1], out.origin[k, 2] = x, y, rays.origin[i, 2] + t * dz + 0.02
    out.direction[k, 0], out.direction[k, 1], out.direction[k, 2] = rx, ry, rz
    out.pixel[k], out.share[k] = pixel, fresnel * haze
    out.width[k], out.travelled[k] = rays.width[i] + 0.6 * rough, width_m


@_loop
def shade(s: Surfaces, water: Water, rays: Rays, out: Mirrored, image: Floats) -> int:
    """Add each ray's colour to its pixel of `image` (P, 3); rays that meet water go on in `out`. Returns how many."""
    k = 0
    for i in range(len(rays.pixel)):
        dx, dy, dz = rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2]
        triangle = rays.triangle[i]
        t = rays.distance[i] if triangle >= 0 else np.inf
        ox, oy, oz = rays.origin[i, 0], rays.origin[i, 1], rays.origin[i, 2]
        sea = water_distance(water, ox, oy, oz, dx, dy, dz, rays.width[i], t)
        if sea < t and sea < _HORIZON_M:
            _mirror(s, water, rays, i, sea, out, k, image)
            k += 1
            continue
        if triangle < 0:
            r, g, b = _sky(s, dx, dy, dz)
            glare = dx * s.sun[0] + dy * s.sun[1] + dz * s.sun[2]
            if glare > 0.9994:
                r, g, b = r + 8, g + 8, b + 7
        else:
            n = s.normal[triangle]
            cosine = abs(n[0] * dx + n[1] * dy + n[2] * dz)
            r, g, b = _land(
                s,
                triangle,
                rays.u[i],
                rays.v[i],
                ox + t * dx,
                oy + t * dy,
                oz + t * dz,
                cosine,
                rays.width[i] * t,
            )
            haze = _clear_air(t)
            r, g, b = (
                r * haze + (1 - haze) * s.horizon[0],
                g * haze + (1 - haze) * s.horizon[1],
                b * haze + (1 - haze) * s.horizon[2],
            )
        pixel = rays.pixel[i]
        image[pixel, 0] += r
        image[pixel, 1] += g
        image[pixel, 2] += b
    return k


@_loop
def shade_mirrored(
    s: Surfaces, rays: Mirrored, distance: Floats, triangles: Any, u: Floats, v: Floats, image: Floats
) -> None:
    """Add what mirrored rays see, by their share; the sun glints where nothing stands in the way."""
    for i in range(len(triangles)):
        dx, dy, dz = rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2]
        triangle, t = triangles[i], distance[i]
        glint = 0.0
        if triangle < 0:
            r, g, b = _sky(s, dx, dy, dz)
            glint = rays.glint[i]
        else:
            n = s.normal[triangle]
            cosine = abs(n[0] * dx + n[1] * dy + n[2] * dz)
            ox, oy, oz = rays.origin[i, 0], rays.origin[i, 1], rays.origin[i, 2]
            width_m = rays.travelled[i] + rays.width[i] * t
            r, g, b = _land(s, triangle, u[i], v[i], ox + t * dx, oy + t * dy, oz + t * dz, cosine, width_m)
        pixel, share = rays.pixel[i], rays.share[i]
        image[pixel, 0] += share * r + glint
        image[pixel, 1] += share * g + 0.93 * glint
        image[pixel, 2] += share * b + 0.8 * glint


@_loop
def shade_hull(
    albedo: Floats, normal: Floats, sky_light: Floats, pixel: Any, sun: Array, image: Floats
) -> None:
    """Add the own hull: colours (N, 3) fixed to the camera under a sun (3,) that turns about it."""
    for i in range(len(pixel)):
        lit = max(normal[i, 0] * sun[0] + normal[i, 1] * sun[1] + normal[i, 2] * sun[2], 0.0) * SUN_IRRADIANCE
        image[pixel[i], 0] += albedo[i, 0] * (sky_light[i, 0] + lit)
        image[pixel[i], 1] += albedo[i, 1] * (sky_light[i, 1] + 0.93 * lit)
        image[pixel[i], 2] += albedo[i, 2] * (sky_light[i, 2] + 0.8 * lit)


@_loop
def surface_colours(s: Surfaces, triangles: Any, u: Floats, v: Floats, width_m: Floats, out: Floats) -> None:
    """Colours (N, 3) of points on triangles without any light."""
    for i in range(len(triangles)):
        uv, w = s.uv[triangles[i]], 1 - u[i] - v[i]
        tu = w * uv[0, 0] + u[i] * uv[1, 0] + v[i] * uv[2, 0]
        tv = w * uv[0, 1] + u[i] * uv[1, 1] + v[i] * uv[2, 1]
        r, g, b = _texture(s, s.texture[triangles[i]], tu, tv, width_m[i])
        tint = s.tint[triangles[i]]
        out[i, 0], out[i, 1], out[i, 2] = r * tint[0], g * tint[1], b * tint[2]


@_loop
def aim(
    cam_rays: Floats,
    row: Any,
    rotation: Array,
    centre: Array,
    depth_m: float,
    origin: Floats,
    direction: Floats,
    reach: Floats,
) -> None:
    """World rays of camera rays (N, 3) in image rows (N,), each row with its own pose (H, 3, 3), (H, 3), and how
    far they need to look: to `depth_m` below the still water."""
    for i in range(len(row)):
        R, c = rotation[row[i]], centre[row[i]]
        for a in range(3):
            direction[i, a] = R[a, 0] * cam_rays[i, 0] + R[a, 1] * cam_rays[i, 1] + R[a, 2] * cam_rays[i, 2]
            origin[i, a] = c[a]
        down = -direction[i, 2]
        reach[i] = (c[2] + depth_m) / down + 0.1 if down > 1e-4 else 1e6


@_loop
def classify(water: Water, rays: Rays, label: Any, ranges: Floats) -> None:
    """What each ray meets first, and how far away (inf: sky)."""
    for i in range(len(rays.pixel)):
        o, d = rays.origin[i], rays.direction[i]
        t = rays.distance[i] if rays.triangle[i] >= 0 else np.inf
        sea = water_distance(water, o[0], o[1], o[2], d[0], d[1], d[2], rays.width[i], t)
        pixel = rays.pixel[i]
        if sea < t and sea < _HORIZON_M:
            label[pixel], ranges[pixel] = WATER, sea
        elif rays.triangle[i] >= 0:
            label[pixel], ranges[pixel] = LAND, t
        else:
            label[pixel], ranges[pixel] = SKY, np.inf
