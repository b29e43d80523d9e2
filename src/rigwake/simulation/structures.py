"""What stands in a harbour, each piece around its own origin: x along the quay, y towards the water, z up."""

from __future__ import annotations

import numpy as np

from rigwake.simulation.hull_mesh import Hull, Prism
from rigwake.simulation.meshes import Colour, Mesh, blob, box, gable, join, prism, rectangle, tube
from rigwake.simulation.textures import Atlas

_WALLS: tuple[Colour, ...] = (
    (1.0, 0.95, 0.82), (0.95, 0.72, 0.5), (0.8, 0.45, 0.33), (0.62, 0.7, 0.78), (0.95, 0.86, 0.55),
    (0.85, 0.85, 0.85), (0.6, 0.72, 0.58), (0.78, 0.6, 0.62),
)  # fmt: skip
_BOXES: tuple[Colour, ...] = (
    (0.15, 0.3, 0.55), (0.65, 0.15, 0.1), (0.1, 0.4, 0.25), (0.85, 0.45, 0.1), (0.55, 0.55, 0.55),
    (0.75, 0.65, 0.2), (0.35, 0.1, 0.2),
)  # fmt: skip
_BAY_M = 3.0
_STOREY_M = 3.0


def pick(rng: np.random.Generator, colours: tuple[Colour, ...]) -> Colour:
    """One of the colours, a little lighter or darker."""
    chosen = np.array(colours[rng.integers(len(colours))]) * rng.uniform(0.8, 1.1)
    return (float(chosen[0]), float(chosen[1]), float(chosen[2]))


def building(rng: np.random.Generator, atlas: Atlas, bays: int, storeys: int, depth_m: float) -> Mesh:
    """A house: shops or stone below, windows above, a tiled saddle roof with chimneys or a flat one."""
    width, height = bays * _BAY_M, storeys * _STOREY_M
    style = rng.choice(["facade_white", "facade_shutters", "facade_office"], p=[0.4, 0.4, 0.2])
    bay = 3.4 if style == "facade_office" else _BAY_M
    tint = pick(rng, _WALLS)
    base = atlas.number(str(rng.choice(["shop", "stone", "brick"])))
    wall, roof = atlas.number(str(style)), atlas.number("roof")
    ground = 3.4
    parts = [
        box((0, -depth_m, 0), (width, 0, ground), base, wall, (0.9, 0.9, 0.9)),
        # stretched so that whole bays and storeys fit
        scaled(
            box((0, -depth_m, ground), (width, 0, ground + height), wall, atlas.number("concrete"), tint),
            bay / _BAY_M,
        ),
    ]
    top = ground + height
    if style == "facade_office" or rng.random() < 0.2:
        parts.append(
            box(
                (1, -depth_m + 1, top),
                (4, -depth_m + 4, top + 2),
                atlas.number("metal"),
                wall,
                (0.6, 0.6, 0.6),
            )
        )
        return join(parts)
    rise = rng.uniform(0.25, 0.42) * depth_m
    parts.append(
        gable(
            (0, -depth_m, top),
            (width, depth_m),
            rise,
            roof,
            wall,
            pick(rng, ((1, 1, 1), (0.55, 0.55, 0.6))),
            tint,
        )
    )
    for _ in range(int(rng.integers(1, 4))):
        x = rng.uniform(0.5, width - 1.5)
        low = (x, -depth_m / 2 - 0.4, top + 0.3 * rise)
        parts.append(box(low, (x + 0.9, low[1] + 0.8, top + rise + 0.9), atlas.number("brick"), roof))
    for x in np.arange(2.0, width - 2, 4.0):
        if rng.random() < 0.5:  # a dormer
            low = (x, -depth_m * 0.3, top + 0.1 * rise)
            parts.append(box(low, (x + 1.6, -0.6, top + 0.62 * rise), wall, roof, tint, (0.8, 0.8, 0.8)))
    return join(parts)


def scaled(mesh: Mesh, along: float, up: float = 1.0) -> Mesh:
    """The mesh with its texture squeezed by these factors."""
    return Mesh(mesh.triangles, mesh.uv * np.array([along, up], np.float32), mesh.texture, mesh.tint)


def container_stack(rng: np.random.Generator, atlas: Atlas, rows: int) -> Mesh:
    """Containers of 6.06 x 2.44 x 2.59 m, up to four high, ends to the water in two rows."""
    side, parts = atlas.number("corrugated"), []
    for row in range(rows):
        for level in range(int(rng.integers(1, 5))):
            for line in range(2):
                x, y, z = row * 6.4 + rng.normal(0, 0.04), -2.44 - line * 2.7, level * 2.6
                one = box(
                    (x, y, z), (x + 6.06, y + 2.44, z + 2.59), side, side, pick(rng, _BOXES), cell_m=3.1
                )
                parts.append(scaled(one, 6.0 / 6.06, 6.0 / 2.59))
    return join(parts)


def crane(rng: np.random.Generator, atlas: Atlas) -> Mesh:
    """A portal crane: four legs, a cab, a lattice jib over the water, ropes."""
    metal, colour = atlas.number("metal"), pick(rng, ((0.9, 0.65, 0.1), (0.2, 0.45, 0.7), (0.8, 0.2, 0.12)))
    parts = []
    for x in (-3.0, 3.0):
        for y in (-3.5, 3.0):
            parts.append(tube((x, y, 0), (x * 0.6, y * 0.6, 9), 0.3, 0.25, metal, colour))
        parts.append(tube((x, -3.5, 2.5), (x, 3.0, 2.5), 0.15, 0.15, metal, colour))
    parts.append(box((-2.2, -2.6, 9), (2.2, 2.2, 12), atlas.number("cabin"), metal, colour))
    parts.append(tube((0, 0, 12), (0, -1, 22), 0.4, 0.25, metal, colour))
    tip = np.array([rng.uniform(-8, 8), 15.0, rng.uniform(22, 30)])
    chords = [np.array([-0.9, 2.0, 11.5]), np.array([0.9, 2.0, 11.5]), np.array([0.0, 2.0, 13.2])]
    for chord in chords:
        parts.append(tube(chord, tip, 0.13, 0.1, metal, colour, 6))
    for k in range(11):  # lattice
        here, there = k / 12, (k + 1) / 12
        for i in range(3):
            a, b = chords[i], chords[(i + 1) % 3]
            start, end = a + here * (tip - a), b + there * (tip - b)
            parts.append(tube(start, end, 0.06, 0.06, metal, colour, 4))
    parts.append(tube((0, -1, 22), tip, 0.05, 0.05, metal, (0.1, 0.1, 0.1), 4))
    parts.append(tube(tip, tip - [0, 0, 12], 0.05, 0.05, metal, (0.1, 0.1, 0.1), 4))
    low = tip - [0.5, 0.5, 13.2]
    parts.append(box(low, low + 1.2, metal, metal, (0.9, 0.3, 0.1)))
    return join(parts)


def hull_mesh(hull: Hull, atlas: Atlas) -> Mesh:
    """A boat, in its own rig frame."""
    parts = []
    for part in hull.parts:
        texture = atlas.number(part.texture)
        if isinstance(part, Prism):
            parts.append(
                prism(
                    part.outline,
                    part.bottom_m,
                    part.top_m,
                    part.taper,
                    texture,
                    atlas.number("panel"),
                    part.colour,
                )
            )
        else:
            parts.append(tube(part.a, part.b, part.radius_a, part.radius_b, texture, part.colour, 14))
    return join(parts)


def moored_boat(rng: np.random.Generator, atlas: Atlas, hull: Hull) -> Mesh:
    """A boat at its berth, in colours of its own, a little smaller or larger than its sisters."""
    mesh = hull_mesh(hull, atlas)
    tint = mesh.tint * np.float32(rng.uniform(0.5, 1.2, 3))
    size = np.float32(rng.uniform(0.65, 1.0))
    return Mesh(mesh.triangles * size, mesh.uv, mesh.texture, tint)


def pontoon(rng: np.random.Generator, atlas: Atlas, length_m: float) -> Mesh:
    """A floating walkway of planks from the shore over the water, on piles, with power posts."""
    planks, dark = atlas.number("planks"), atlas.number("rubber")
    parts = [box((-1.1, -2.0, -0.3), (1.1, length_m, 0.55), dark, planks, (1, 1, 1), cell_m=1.5)]
    for y in np.arange(2.0, length_m, 6.0):
        side = float(rng.choice([-1.25, 1.25]))
        parts.append(
            tube((side, y, -1), (side, y, rng.uniform(1.8, 2.6)), 0.14, 0.13, planks, (0.8, 0.8, 0.8))
        )
        parts.append(box((0.7, y - 0.12, 0.55), (0.95, y + 0.12, 1.45), atlas.number("panel"), planks))
    return join(parts)


def buoy(rng: np.random.Generator, atlas: Atlas) -> Mesh:
    """A navigation buoy: float, striped body, cage and top mark."""
    colour = pick(rng, ((0.75, 0.08, 0.06), (0.05, 0.4, 0.15), (0.9, 0.7, 0.08), (0.9, 0.35, 0.05)))
    stripes, metal = atlas.number("stripes"), atlas.number("metal")
    return join(
        [
            tube((0, 0, -0.4), (0, 0, 0.35), 0.75, 0.8, atlas.number("paint"), colour, 16),
            tube((0, 0, 0.35), (0, 0, 2.1), 0.6, 0.25, stripes, colour, 16),
            tube((0, 0, 2.1), (0, 0, 2.7), 0.06, 0.06, metal, (0.3, 0.3, 0.3)),
            tube((0, 0, 2.7), (0, 0, 3.2), 0.28, 0.02, atlas.number("paint"), colour),
        ]
    )


def tree(rng: np.random.Generator, atlas: Atlas) -> Mesh:
    """A trunk and a crown of several lumps."""
    height = rng.uniform(5, 10)
    leaves = atlas.number("foliage")
    green = pick(rng, ((1.0, 1.0, 1.0), (0.8, 0.95, 0.7), (1.3, 1.15, 0.7)))
    parts = [tube((0, 0, 0), (0, 0, 0.6 * height), 0.3, 0.2, atlas.number("planks"), (0.4, 0.33, 0.28), 7)]
    for _ in range(int(rng.integers(4, 8))):
        centre = rng.normal(0, 0.11, 3) * height + [0, 0, 0.6 * height]
        radius = height * rng.uniform(0.15, 0.25)
        parts.append(blob(rng, centre, (radius, radius, 0.8 * radius), 0.09, leaves, green, rings=6))
    return join(parts)


def quay_furniture(rng: np.random.Generator, atlas: Atlas, length_m: float, height_m: float) -> list[Mesh]:
    """Bollards, tyres as fenders, ladders and lamp posts along the edge (y = 0, top of the wall at z = 0)."""
    metal, rubber = atlas.number("metal"), atlas.number("rubber")
    parts = []
    for x in np.arange(4.0, length_m, 7.0):
        at = x + rng.uniform(-1, 1)
        iron = (0.12, 0.12, 0.13)
        parts.append(tube((at, -0.5, 0), (at, -0.5, 0.45), 0.16, 0.14, metal, iron))
        parts.append(
            tube((at, -0.5, 0.45), (at, -0.5, 0.6), 0.26, 0.26, metal, pick(rng, ((0.8, 0.7, 0.1), iron)))
        )
        tyre = at + rng.uniform(1.5, 4.0)
        z = -height_m * rng.uniform(0.3, 0.6)
        parts.append(tube((tyre, 0, z), (tyre, 0.25, z), 0.5, 0.42, rubber, (1, 1, 1), 12))
    for x in np.arange(12.0, length_m, 26.0):
        for rail in (-0.25, 0.25):
            parts.append(
                tube(
                    (x + rail, 0.08, -height_m - 1),
                    (x + rail, 0.08, 0.4),
                    0.04,
                    0.04,
                    metal,
                    (0.9, 0.8, 0.1),
                    6,
                )
            )
        for z in np.arange(-height_m - 0.8, 0.2, 0.32):
            parts.append(
                tube((x - 0.25, 0.08, z), (x + 0.25, 0.08, z), 0.025, 0.025, metal, (0.9, 0.8, 0.1), 5)
            )
        lamp = x + rng.uniform(5, 12)
        parts.append(tube((lamp, -2.5, 0), (lamp, -2.5, 6.5), 0.09, 0.06, metal, (0.25, 0.28, 0.28), 8))
        parts.append(tube((lamp, -2.5, 6.4), (lamp, -1.2, 6.7), 0.05, 0.12, metal, (0.3, 0.33, 0.33), 8))
    return parts


def target(atlas: Atlas) -> Mesh:
    """A 2 x 2 m chequered board facing the water, its corner at the origin, with a white rim behind it."""
    board = rectangle((1, 0.06, -1), (-2, 0, 0), (0, 0, 2), atlas.number("checker"), cell_m=1.0)
    rim = box((-1.15, -0.1, -1.15), (1.15, 0.05, 1.15), atlas.number("paint"), atlas.number("paint"))
    return join([board, rim])
