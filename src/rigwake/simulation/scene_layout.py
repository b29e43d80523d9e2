"""Where the water ends: the plan of each layout, shared by the scenery, the tracks-only mode and the path check.

All layouts are a rectangle of water centred on the world origin, length along east, with four sides of a kind
each: a quay with a town behind it, a shore without a quay, or open water to a far shore.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rigwake._types import Array
from rigwake.simulation.scenario import Scene

SideKind = Literal["quay", "shore", "open"]
FAR_SHORE_M = 420.0
QUAY_HEIGHT_M = 1.9

_SIDES: dict[str, tuple[SideKind, SideKind, SideKind, SideKind]] = {  # south, east, north, west
    "harbour": ("quay", "quay", "quay", "shore"),
    "bay": ("open", "shore", "shore", "open"),
    "canal": ("quay", "open", "quay", "open"),
    "marina": ("shore", "quay", "shore", "open"),
}


@dataclass(frozen=True)
class Side:
    """One edge of the water, walked with the land on the right: from `start`, along unit `along`."""

    kind: SideKind
    start: tuple[float, float]
    along: tuple[float, float]
    length_m: float

    def place(self, distance_m: Array | float, inland_m: Array | float) -> Array:
        """World plan positions (..., 2) at a distance along the edge and inland of it (broadcast)."""
        s, w = np.broadcast_arrays(np.asarray(distance_m, float), np.asarray(inland_m, float))
        along = np.array(self.along)
        inland = np.array([along[1], -along[0]])
        return np.array(self.start) + s[..., None] * along + w[..., None] * inland


@dataclass(frozen=True)
class SceneLayout:
    """The plan: half sizes of the water and its four sides."""

    half_length_m: float
    half_width_m: float
    sides: tuple[Side, ...]

    def clearance(self, points: Array) -> Array:
        """Distance (...) of plan points (..., 2) to the nearest edge of the water, negative on land."""
        p = np.abs(np.asarray(points))
        return np.asarray(np.minimum(self.half_length_m - p[..., 0], self.half_width_m - p[..., 1]))


def build_layout(scene: Scene) -> SceneLayout:
    """The plan of a scene."""
    a, b = scene.size_m[0] / 2, scene.size_m[1] / 2
    corners = [(-a, -b), (a, -b), (a, b), (-a, b)]
    along = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    lengths = [2 * a, 2 * b, 2 * a, 2 * b]
    sides = zip(_SIDES[scene.layout], corners, along, lengths, strict=True)
    return SceneLayout(a, b, tuple(Side(*side) for side in sides))


def sample_landmarks(layout: SceneLayout, rng: np.random.Generator, count: int) -> Array:
    """Random points (count, 3) on what stands around the water: quay walls, fronts behind them, a far shore."""
    lengths = np.array([side.length_m for side in layout.sides])
    which = rng.choice(len(lengths), count, p=lengths / lengths.sum())
    points = np.empty((count, 3))
    for i, side in enumerate(layout.sides):
        rows = np.flatnonzero(which == i)
        n = len(rows)
        distance = rng.uniform(-0.1, 1.1, n) * side.length_m
        wall = rng.random(n) < 0.25
        inland = np.where(wall, 0.0, rng.gamma(2.0, 9.0, n))
        height = np.where(wall, rng.uniform(0.1, QUAY_HEIGHT_M, n), QUAY_HEIGHT_M + rng.gamma(1.6, 3.5, n))
        if side.kind == "open":
            inland = FAR_SHORE_M + rng.gamma(2.0, 60.0, n)
            height = rng.gamma(1.5, 15.0, n)
        points[rows] = np.column_stack([side.place(distance, inland), height])
    return points
