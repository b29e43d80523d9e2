"""Compiled loops: what colour a ray brings home.

All run without the interpreter's lock. `Surfaces` and `Water` are tuples of arrays, the form compiled code takes.

Water: Fresnel by Schlick with the roughness correction of Bruneton et al. (2010), *Real-time Realistic Ocean
Lighting*; sun glitter by the slope density of Cox and Munk (1954), with the slopes too short to be seen at a
distance as its variance.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rigwake._types import Array, Floats
from rigwake.simulation.compiled import borrowed, inlined, loop
from rigwake.simulation.light import SUN_IRRADIANCE
from rigwake.simulation.sea_surface import HORIZON_M, Water, bilinear, may_meet_water, meet_water, ripples
from rigwake.simulation.skyline import in_band

LAND, SKY, WATER, HULL = 60, 120, 180, 240
_HAZE_M = 3500.0


class Surfaces(NamedTuple):
    """Triangles, textures (with the base-2 logarithm of their finest texels per metre) and sky, as plain arrays."""

    uv: Floats
    texture: Any
    tint: Floats
    normal: Floats
    light: Floats
    texels: Floats
    starts: Any
    sizes: Any
    metres: Floats
    octaves: Floats
    panorama: Floats
    sun: Floats
    horizon: Floats


class Rays(NamedTuple):
    """Rays of a chunk: origins, directions (N, 3), pixel, width (radians), how they round mip levels (0..1); which
    of the hits below is theirs (-1: not cast, nothing there); hits: distance, triangle (-1: none), barycentric
    coordinates."""

    origin: Floats
    direction: Floats
    pixel: Any
    width: Floats
    rounding: Floats
    cast: Any
    distance: Floats
    triangle: Any
    u: Floats
    v: Floats


class Mirrored(NamedTuple):
    """Rays thrown back by water, one for each half of a pixel's: as `Rays`, with their fraction of the pixel, the width
    that they set out with (metres), and the sun's glint, if nothing hides it."""

    origin: Floats
    direction: Floats
    pixel: Any
    width: Floats
    travelled: Floats
    fraction: Floats
    glint: Floats


@inlined
def _texture(s: Surfaces, number: int, u_m: float, v_m: float, octave: float) -> tuple[float, float, float]:
    """Colour of a texture at metres along a surface, in the mip level whose texels are `2^octave` metres across."""
    edge = s.metres[number]
    level = int(min(max(octave + s.octaves[number], 0.0), s.starts.shape[1] - 1.0))
    return bilinear(s.texels, s.starts[number, level], s.sizes[number, level], u_m / edge, v_m / edge)


@inlined
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


@inlined
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
    rounding: float,
) -> tuple[float, float, float]:
    """Colour of a point on a triangle: texture x weathering x tint x the light baked into its corners.

    Mip levels are not interpolated: each ray of a pixel rounds them its own way, so that their mean is interpolated.
    """
    w = 1 - u - v
    octave = math.log2(np.float32(max(width_m / math.sqrt(max(cosine, 0.04)), 1e-6))) + rounding
    tu = w * s.uv[triangle, 0, 0] + u * s.uv[triangle, 1, 0] + v * s.uv[triangle, 2, 0]
    tv = w * s.uv[triangle, 0, 1] + u * s.uv[triangle, 1, 1] + v * s.uv[triangle, 2, 1]
    r, g, b = _texture(s, s.texture[triangle], tu, tv, octave)
    if abs(s.normal[triangle, 2]) > 0.7:
        mu, mv = px, py
    else:
        mu, mv = px * s.normal[triangle, 1] - py * s.normal[triangle, 0], pz
    mr, mg, mb = _texture(s, len(s.metres) - 1, mu, mv, octave)
    light_r = w * s.light[triangle, 0, 0] + u * s.light[triangle, 1, 0] + v * s.light[triangle, 2, 0]
    light_g = w * s.light[triangle, 0, 1] + u * s.light[triangle, 1, 1] + v * s.light[triangle, 2, 1]
    light_b = w * s.light[triangle, 0, 2] + u * s.light[triangle, 1, 2] + v * s.light[triangle, 2, 2]
    return (
        r * mr * s.tint[triangle, 0] * light_r,
        g * mg * s.tint[triangle, 1] * light_g,
        b * mb * s.tint[triangle, 2] * light_b,
    )


@inlined
def _cosine(s: Surfaces, triangle: int, dx: float, dy: float, dz: float) -> float:
    normal = s.normal[triangle, 0] * dx + s.normal[triangle, 1] * dy + s.normal[triangle, 2] * dz
    return abs(normal)


@inlined
def _clear_air(distance_m: float) -> float:
    """Fraction of light that haze lets through: `exp(-x)` to third order, which is cheaper."""
    x = distance_m / _HAZE_M
    return 1 / (1 + x * (1 + x * (0.5 + x / 6)))


@inlined
def _mirror(
    s: Surfaces,
    water: Water,
    rays: Rays,
    i: int,
    t: float,
    long_sx: float,
    long_sy: float,
    octave: float,
    out: Mirrored,
    k: int,
    joins: bool,
    image: Floats,
) -> int:
    """Water met by ray i: the light from below goes into the image, the mirrored ray into `out[k]`, or joins the one
    before. Returns how many there are then."""
    dx, dy, dz = rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2]
    x, y = rays.origin[i, 0] + t * dx, rays.origin[i, 1] + t * dy
    width_m = rays.width[i] * t / math.sqrt(max(-dz, 0.04))
    short_sx, short_sy, lost = ripples(water, x, y, octave, rays.rounding[i])
    sx, sy = long_sx + short_sx, long_sy + short_sy
    rough = math.sqrt(lost)
    # facets that lean away are hidden at a low angle: those seen lean towards the eye
    flat = math.sqrt(max(dx * dx + dy * dy, 1e-12))
    lean = rough * max(0.0, 1 + dz / max(2.5 * rough, 0.05)) * 0.8 / flat
    nx, ny = -sx - lean * dx, -sy - lean * dy
    nz = 1 / math.sqrt(nx * nx + ny * ny + 1)
    nx, ny = nx * nz, ny * nz
    facing = max(-(nx * dx + ny * dy + nz * dz), 0.015)
    steep = 1 + rough * (2.69 + rough * (3.62 + 3.24 * rough))  # exp(2.69 rough)
    fresnel = 0.02 + 0.98 * np.float32(1 - facing) ** np.float32(5 / steep) / (
        1 + 22.7 * rough * math.sqrt(rough)
    )
    haze = _clear_air(t)
    # light scattered back by the water itself, a little more of it through tilted faces
    body = (1 - fresnel) * (0.75 + 1.6 * max(sx * dx + sy * dy, -0.3)) * haze
    pixel = rays.pixel[i]
    image[pixel, 0] += body * 0.012 + (1 - haze) * s.horizon[0]
    image[pixel, 1] += body * 0.042 + (1 - haze) * s.horizon[1]
    image[pixel, 2] += body * 0.050 + (1 - haze) * s.horizon[2]
    if not joins:
        out.origin[k, 0], out.origin[k, 1], out.origin[k, 2] = x, y, rays.origin[i, 2] + t * dz + 0.02
        out.direction[k, 0] = out.direction[k, 1] = out.direction[k, 2] = 0.0
        out.pixel[k], out.width[k], out.travelled[k] = pixel, rays.width[i] + 0.6 * rough, width_m
        out.fraction[k] = out.glint[k] = 0.0
        k += 1
    fraction = fresnel * haze
    out.direction[k - 1, 0] += fraction * (dx + 2 * facing * nx)
    out.direction[k - 1, 1] += fraction * (dy + 2 * facing * ny)
    out.direction[k - 1, 2] += fraction * max(dz + 2 * facing * nz, 0.012)
    out.fraction[k - 1] += fraction
    out.glint[k - 1] += min(_glint(s, dx, dy, dz, sx, sy, lost) * fraction / facing, 6.0)
    return k


@inlined
def _glint(s: Surfaces, dx: float, dy: float, dz: float, sx: float, sy: float, lost: float) -> float:
    """Sunlight mirrored towards the eye by slopes too short to be seen, in units of `fresnel / facing`."""
    hx, hy, hz = s.sun[0] - dx, s.sun[1] - dy, s.sun[2] - dz
    miss_x, miss_y = hx / hz + sx, hy / hz + sy
    variance = lost + 2e-4  # and the width of the sun itself
    miss = (miss_x * miss_x + miss_y * miss_y) / variance
    if miss > 60:
        return 0.0
    return SUN_IRRADIANCE / 4 * math.exp(-0.5 * miss) / (2 * math.pi * variance)


@inlined
def _settle(out: Mirrored, k: int) -> None:
    """Gathered directions made unit; as far as they differ, the mirrored ray is wide."""
    dx, dy, dz = out.direction[k, 0], out.direction[k, 1], out.direction[k, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    out.direction[k, 0], out.direction[k, 1], out.direction[k, 2] = dx / length, dy / length, dz / length
    out.width[k] += math.sqrt(
        12 * max(1 - length / out.fraction[k], 0.0)
    )  # of even light with the same variance


@loop
def shade(s: Surfaces, water: Water, rays: Rays, out: Mirrored, image: Floats) -> int:
    """Add each ray's colour to its pixel of `image` (P, 3); what pixels see in the water goes on in `out`. Returns
    how many those are."""
    s, water, rays, out = borrowed(s), borrowed(water), borrowed(rays), borrowed(out)
    count, last = 0, -1
    for i in range(len(rays.pixel)):
        dx, dy, dz = rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2]
        ox, oy, oz = rays.origin[i, 0], rays.origin[i, 1], rays.origin[i, 2]
        hit = rays.cast[i]
        triangle = rays.triangle[hit] if hit >= 0 else -1
        t = rays.distance[hit] if triangle >= 0 else np.inf
        if may_meet_water(water, oz, dz, t):
            sea, sx, sy, octave = meet_water(water, ox, oy, oz, dx, dy, dz, rays.width[i], rays.rounding[i])
            if sea < t and sea < HORIZON_M:
                half = 2 * rays.pixel[i] + (1 if rays.rounding[i] > 0.5 else 0)
                count = _mirror(s, water, rays, i, sea, sx, sy, octave, out, count, half == last, image)
                last = half
                continue
        if triangle < 0:
            r, g, b = _sky(s, dx, dy, dz)
            glare = dx * s.sun[0] + dy * s.sun[1] + dz * s.sun[2]
            if glare > 0.9994:
                r, g, b = r + 8, g + 8, b + 7
        else:
            cosine = _cosine(s, triangle, dx, dy, dz)
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            width_m = rays.width[i] * t
            r, g, b = _land(s, triangle, rays.u[hit], rays.v[hit], x, y, z, cosine, width_m, rays.rounding[i])
            haze = _clear_air(t)
            r = r * haze + (1 - haze) * s.horizon[0]
            g = g * haze + (1 - haze) * s.horizon[1]
            b = b * haze + (1 - haze) * s.horizon[2]
        pixel = rays.pixel[i]
        image[pixel, 0] += r
        image[pixel, 1] += g
        image[pixel, 2] += b
    for k in range(count):
        _settle(out, k)
    return count


@loop
def shade_mirrored(
    s: Surfaces, rays: Mirrored, distance: Floats, triangles: Any, u: Floats, v: Floats, image: Floats
) -> None:
    """Add what mirrored rays see, by their share; the sun glints where nothing stands in the way."""
    s, rays = borrowed(s), borrowed(rays)
    for i in range(len(triangles)):
        dx, dy, dz = rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2]
        triangle, t = triangles[i], distance[i]
        glint = 0.0
        if triangle < 0:
            r, g, b = _sky(s, dx, dy, dz)
            glint = rays.glint[i]
        else:
            cosine = _cosine(s, triangle, dx, dy, dz)
            x, y, z = rays.origin[i, 0] + t * dx, rays.origin[i, 1] + t * dy, rays.origin[i, 2] + t * dz
            width_m = rays.travelled[i] + rays.width[i] * t
            r, g, b = _land(s, triangle, u[i], v[i], x, y, z, cosine, width_m, 0.5)
        pixel, fraction = rays.pixel[i], rays.fraction[i]
        image[pixel, 0] += fraction * r + glint
        image[pixel, 1] += fraction * g + 0.93 * glint
        image[pixel, 2] += fraction * b + 0.8 * glint


@loop
def shade_hull(
    albedo: Floats, normal: Floats, sky_light: Floats, pixel: Any, sun: Array, image: Floats
) -> None:
    """Add the own hull: colours (N, 3) fixed to the camera under a sun (3,) that turns about it."""
    for i in range(len(pixel)):
        lit = max(normal[i, 0] * sun[0] + normal[i, 1] * sun[1] + normal[i, 2] * sun[2], 0.0) * SUN_IRRADIANCE
        image[pixel[i], 0] += albedo[i, 0] * (sky_light[i, 0] + lit)
        image[pixel[i], 1] += albedo[i, 1] * (sky_light[i, 1] + 0.93 * lit)
        image[pixel[i], 2] += albedo[i, 2] * (sky_light[i, 2] + 0.8 * lit)


@loop
def surface_colours(s: Surfaces, triangles: Any, u: Floats, v: Floats, width_m: Floats, out: Floats) -> None:
    """Colours (N, 3) of points on triangles without any light."""
    s = borrowed(s)
    for i in range(len(triangles)):
        triangle, w = triangles[i], 1 - u[i] - v[i]
        tu = w * s.uv[triangle, 0, 0] + u[i] * s.uv[triangle, 1, 0] + v[i] * s.uv[triangle, 2, 0]
        tv = w * s.uv[triangle, 0, 1] + u[i] * s.uv[triangle, 1, 1] + v[i] * s.uv[triangle, 2, 1]
        r, g, b = _texture(s, s.texture[triangle], tu, tv, math.log2(max(width_m[i], 1e-6)) + 0.5)
        out[i, 0], out[i, 1] = r * s.tint[triangle, 0], g * s.tint[triangle, 1]
        out[i, 2] = b * s.tint[triangle, 2]


@loop
def aim(
    cam_rays: Floats,
    row: Any,
    rotation: Array,
    centre: Array,
    depth_m: float,
    band: Array,
    rays: tuple[Floats, Floats],
    cast: Any,
    thrown: tuple[Floats, Floats, Floats],
) -> int:
    """World rays (origins, directions) of camera rays (N, 3) in image rows (N,), each row with its own
    `world_from_cam` (H, 3, 3), (H, 3).

    Those that may meet scenery (inside `band`) are also thrown, with how far they need to look: to `depth_m` below
    the still water. `cast`: (N,) their place among the thrown, or -1. Returns how many those are.
    """
    origin, direction = rays
    thrown_origin, thrown_direction, reach = thrown
    count = 0
    for i in range(len(row)):
        at = row[i]
        x, y, z = cam_rays[i, 0], cam_rays[i, 1], cam_rays[i, 2]
        dx = rotation[at, 0, 0] * x + rotation[at, 0, 1] * y + rotation[at, 0, 2] * z
        dy = rotation[at, 1, 0] * x + rotation[at, 1, 1] * y + rotation[at, 1, 2] * z
        dz = rotation[at, 2, 0] * x + rotation[at, 2, 1] * y + rotation[at, 2, 2] * z
        direction[i, 0], direction[i, 1], direction[i, 2] = dx, dy, dz
        cx, cy, cz = centre[at, 0], centre[at, 1], centre[at, 2]
        origin[i, 0], origin[i, 1], origin[i, 2] = cx, cy, cz
        cast[i] = -1
        if in_band(band, dx, dy, dz):
            cast[i] = count
            thrown_direction[count, 0], thrown_direction[count, 1], thrown_direction[count, 2] = dx, dy, dz
            thrown_origin[count, 0], thrown_origin[count, 1], thrown_origin[count, 2] = cx, cy, cz
            reach[count] = (cz + depth_m) / -dz + 0.1 if dz < -1e-4 else 1e6
            count += 1
    return count


@loop
def classify(water: Water, rays: Rays, label: Any, ranges: Floats) -> None:
    """What each ray meets first, and how far away (inf: sky)."""
    water, rays = borrowed(water), borrowed(rays)
    for i in range(len(rays.pixel)):
        dx, dy, dz = rays.direction[i, 0], rays.direction[i, 1], rays.direction[i, 2]
        ox, oy, oz = rays.origin[i, 0], rays.origin[i, 1], rays.origin[i, 2]
        hit = rays.cast[i]
        land = hit >= 0 and rays.triangle[hit] >= 0
        t = rays.distance[hit] if land else np.inf
        pixel = rays.pixel[i]
        label[pixel], ranges[pixel] = LAND if land else SKY, t
        if may_meet_water(water, oz, dz, t):
            sea, _, _, _ = meet_water(water, ox, oy, oz, dx, dy, dz, rays.width[i], 0.5)
            if sea < t and sea < HORIZON_M:
                label[pixel], ranges[pixel] = WATER, sea
