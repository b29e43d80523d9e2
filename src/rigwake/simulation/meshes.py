"""Triangles with texture coordinates, and the solids that scenery is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigwake._types import Array, Floats

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, each with its own texture.

    triangles: (T, 3, 3) corners, metres, counter-clockwise from outside. uv: (T, 3, 2) metres along the surface.
    texture: (T,) number in the texture atlas. tint: (T, 3) factor on its colour.
    """

    triangles: Floats
    uv: Floats
    texture: NDArray[np.int32]
    tint: Floats

    def __len__(self) -> int:
        return len(self.triangles)

    def moved(self, yaw: float, offset: ArrayLike) -> Mesh:
        """Turned about the vertical by `yaw`, then shifted by `offset` (3,)."""
        c, s = np.cos(yaw), np.sin(yaw)
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        triangles = (self.triangles @ rotation.T + np.asarray(offset)).astype(np.float32)
        return Mesh(triangles, self.uv, self.texture, self.tint)

    def normals(self) -> Floats:
        """(T, 3) unit normals."""
        edges = self.triangles[:, 1:] - self.triangles[:, :1]
        normal = np.cross(edges[:, 0], edges[:, 1])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        # a sliver without area (the pole of a blob) gets the vertical: no ray may ever carry a NaN
        return np.where(length > 1e-9, normal / np.maximum(length, 1e-9), [[0, 0, 1]]).astype(np.float32)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles of several meshes, in order."""
    return Mesh(
        np.concatenate([m.triangles for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
        np.concatenate([m.texture for m in meshes]),
        np.concatenate([m.tint for m in meshes]),
    )


def from_grid(points: Array, uv: Array, texture: int, tint: Colour) -> Mesh:
    """A surface from a grid of points (R, C, 3) with uv (R, C, 2); outside where rows turn left into columns.

    Columns run along the first surface direction, rows along the second: normal = columns x rows.
    """
    corners = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], 2)
    corner_uv = np.stack([uv[:-1, :-1], uv[:-1, 1:], uv[1:, 1:], uv[1:, :-1]], 2)
    order = [[0, 1, 2], [0, 2, 3]]
    triangles = corners[:, :, order].reshape(-1, 3, 3).astype(np.float32)
    count = len(triangles)
    return Mesh(
        triangles,
        corner_uv[:, :, order].reshape(-1, 3, 2).astype(np.float32),
        np.full(count, texture, np.int32),
        np.broadcast_to(np.array(tint, np.float32), (count, 3)),
    )


def rectangle(
    origin: ArrayLike,
    along: ArrayLike,
    up: ArrayLike,
    texture: int,
    tint: Colour = (1, 1, 1),
    cell_m: float = 4.0,
) -> Mesh:
    """A parallelogram `origin + a along + b up`, cut into cells; outside is along x up. uv in metres."""
    o, a, b = (np.asarray(v, dtype=np.float64) for v in (origin, along, up))
    size_a, size_b = np.linalg.norm(a), np.linalg.norm(b)
    columns = np.linspace(0, 1, int(np.ceil(size_a / cell_m)) + 1)
    rows = np.linspace(0, 1, int(np.ceil(size_b / cell_m)) + 1)
    points = o + columns[None, :, None] * a + rows[:, None, None] * b
    grid = np.stack(np.meshgrid(columns * size_a, rows * size_b), -1)
    return from_grid(points, grid, texture, tint)


def box(
    low: ArrayLike,
    high: ArrayLike,
    side: int,
    top: int,
    tint: Colour = (1, 1, 1),
    top_tint: Colour | None = None,
    cell_m: float = 4.0,
) -> Mesh:
    """An upright box between two corners, without a bottom."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, float), np.asarray(high, float)
    dx, dy, up = (x1 - x0, 0, 0), (0, y1 - y0, 0), (0, 0, z1 - z0)
    return join(
        [
            rectangle((x0, y0, z0), dx, up, side, tint, cell_m),
            rectangle((x1, y0, z0), dy, up, side, tint, cell_m),
            rectangle((x1, y1, z0), np.negative(dx), up, side, tint, cell_m),
            rectangle((x0, y1, z0), np.negative(dy), up, side, tint, cell_m),
            rectangle((x0, y0, z1), dx, dy, top, top_tint or tint, cell_m),
        ]
    )


def prism(
    outline: ArrayLike, bottom_m: float, top_m: float, taper: float, side: int, top: int, tint: Colour
) -> Mesh:
    """Walls over a counter-clockwise plan outline (K, 2), the bottom shrunk by `taper`, and a flat lid."""
    plan = np.asarray(outline, dtype=np.float64)
    middle = plan.mean(axis=0)
    closed = np.concatenate([plan, plan[:1]])
    lower = np.column_stack([middle + (closed - middle) * taper, np.full(len(closed), bottom_m)])
    upper = np.column_stack([closed, np.full(len(closed), top_m)])
    girth = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    uv = np.stack([np.column_stack([girth, 0 * girth + z]) for z in (bottom_m, top_m)])
    walls = from_grid(np.stack([lower, upper]), uv, side, tint)
    lid = np.stack([np.broadcast_to([*middle, top_m], (len(plan), 3)), upper[:-1], upper[1:]], 1)
    return join([walls, _loose(lid, lid[..., :2], top, tint)])


def _loose(triangles: Array, uv: Array, texture: int, tint: Colour) -> Mesh:
    count = len(triangles)
    return Mesh(
        triangles.astype(np.float32),
        uv.astype(np.float32),
        np.full(count, texture, np.int32),
        np.broadcast_to(np.array(tint, np.float32), (count, 3)),
    )


def tube(
    a: ArrayLike,
    b: ArrayLike,
    radius_a: float,
    radius_b: float,
    texture: int,
    tint: Colour = (1, 1, 1),
    faces: int = 10,
) -> Mesh:
    """A round bar from a to b with caps."""
    start, end = np.asarray(a, float), np.asarray(b, float)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.0, 0, 1] if abs(axis[2]) < 0.9 else [1.0, 0, 0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, faces + 1)
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
    radii = np.array([1e-4, radius_a, radius_b, 1e-4])
    centres = np.stack([start, start, end, end])
    points = centres[:, None] + radii[:, None, None] * ring
    length = float(np.linalg.norm(end - start))
    along = np.array([-radius_a, 0, length, length + radius_b])
    grid = np.stack(np.meshgrid(angle * max(radius_a, radius_b), along), -1)
    return from_grid(points, grid, texture, tint)


def gable(
    low: ArrayLike,
    size: tuple[float, float],
    rise_m: float,
    texture: int,
    wall: int,
    tint: Colour,
    wall_tint: Colour,
) -> Mesh:
    """A saddle roof over a rectangle (ridge along x), overhanging a little, with its two end walls."""
    x0, y0, z = np.asarray(low, float)
    (dx, dy), eaves = size, 0.4
    middle, slope = y0 + dy / 2, rise_m * eaves / (dy / 2)
    half = dy / 2 + eaves
    south = rectangle(
        (x0 - eaves, y0 - eaves, z - slope), (dx + 2 * eaves, 0, 0), (0, half, rise_m + slope), texture, tint
    )
    north = rectangle(
        (x0 + dx + eaves, y0 + dy + eaves, z - slope),
        (-dx - 2 * eaves, 0, 0),
        (0, -half, rise_m + slope),
        texture,
        tint,
    )
    ends = np.array(
        [
            [(x0, y0 + dy, z), (x0, y0, z), (x0, middle, z + rise_m)],
            [(x0 + dx, y0, z), (x0 + dx, y0 + dy, z), (x0 + dx, middle, z + rise_m)],
        ]
    )
    return join([south, north, _loose(ends, ends[..., 1:], wall, wall_tint)])


def blob(
    rng: np.random.Generator,
    centre: ArrayLike,
    radii: ArrayLike,
    roughness: float,
    texture: int,
    tint: Colour,
    rings: int = 9,
) -> Mesh:
    """A lumpy ellipsoid: the crown of a tree, a bush, a rock."""
    polar, around = np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings + 1)
    bumps = 1 + roughness * rng.standard_normal((rings, 2 * rings + 1))
    bumps[:, -1] = bumps[:, 0]
    bumps[[0, -1]] = 1
    sphere = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(around),
            np.sin(polar)[:, None] * np.sin(around),
            np.broadcast_to(-np.cos(polar)[:, None], bumps.shape),
        ],
        -1,
    )
    size = np.asarray(radii, float)
    points = np.asarray(centre, float) + sphere * size * bumps[..., None]
    grid = np.stack(np.meshgrid(around * size[0], polar * size[2]), -1)
    return from_grid(points, grid, texture, tint)
