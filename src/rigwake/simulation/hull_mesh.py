"""The boats: solid parts in the rig frame, from which come the mesh, the inside test and the waterline."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array
from rigwake.simulation.waves import SelfMaskResponse

Colour = tuple[float, float, float]
_WHITE: Colour = (0.78, 0.79, 0.8)
_GREY: Colour = (0.42, 0.44, 0.46)
_BLUE: Colour = (0.1, 0.2, 0.42)
_ORANGE: Colour = (0.85, 0.33, 0.08)
_WOOD: Colour = (0.5, 0.34, 0.2)
_DARK: Colour = (0.07, 0.08, 0.09)


@dataclass(frozen=True)
class Prism:
    """An upright solid over a plan outline (counter-clockwise), its bottom shrunk by `taper` about its middle."""

    outline: tuple[tuple[float, float], ...]
    bottom_m: float
    top_m: float
    colour: Colour
    texture: str = "paint"
    taper: float = 1.0

    def contains(self, point: Array) -> bool:
        """Whether a point (3,) lies inside (the taper is ignored: it only shrinks)."""
        if not self.bottom_m <= point[2] <= self.top_m:
            return False
        corners = np.array(self.outline)
        to_next = np.roll(corners, -1, axis=0) - corners
        offset = point[:2] - corners
        return bool(np.all(to_next[:, 0] * offset[:, 1] - to_next[:, 1] * offset[:, 0] >= 0))


@dataclass(frozen=True)
class Tube:
    """A round bar from a to b, its radius going from `radius_a` to `radius_b`."""

    a: tuple[float, float, float]
    b: tuple[float, float, float]
    radius_a: float
    radius_b: float
    colour: Colour
    texture: str = "paint"

    def contains(self, point: Array) -> bool:
        """Whether a point (3,) lies inside."""
        a, axis = np.array(self.a), np.array(self.b) - np.array(self.a)
        along = float((point - a) @ axis / (axis @ axis))
        radius = self.radius_a + along * (self.radius_b - self.radius_a)
        return bool(0 <= along <= 1 and np.linalg.norm(point - a - along * axis) <= radius)


@dataclass(frozen=True)
class Hull:
    """A boat: its solids in the rig frame and how its waterline rides the waves."""

    parts: tuple[Prism | Tube, ...]
    response: SelfMaskResponse

    def contains(self, point_rig: Array) -> bool:
        """Whether a point (3,) of the rig frame is inside the boat."""
        return any(part.contains(point_rig) for part in self.parts)


def build_hull(kind: str) -> Hull:
    """The hull of this name: catamaran, ferry, workboat or sailboat."""
    return _HULLS[kind]


def _box(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    colour: Colour,
    texture: str = "paint",
) -> Prism:
    outline = ((x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]))
    return Prism(outline, z[0], z[1], colour, texture)


def _ship_outline(length: float, beam: float) -> tuple[tuple[float, float], ...]:
    """A pointed bow and a square stern, counter-clockwise and convex."""
    x = np.linspace(-0.5, 0.5, 13)
    half = np.minimum(0.5, 0.5 * np.sqrt(np.clip((0.5 - x) / 0.55, 0, 1)) ** 0.9)
    half = np.minimum(half, 0.44 + 0.3 * (x + 0.5))
    starboard = [(float(a * length), float(-b * beam)) for a, b in zip(x, half, strict=True)]
    port = [(float(a * length), float(b * beam)) for a, b in zip(x[-2::-1], half[-2::-1], strict=True)]
    return tuple(starboard + port)


def _catamaran() -> Hull:
    """4.9 x 2.4 m: two inflated pontoons, a payload tray on arched struts."""
    parts: list[Prism | Tube] = []
    for y in (-1.02, 1.02):
        ends = [(-2.45, 0.16, 0.1), (-2.2, 0.12, 0.2), (1.5, 0.12, 0.21), (2.1, 0.24, 0.17), (2.5, 0.4, 0.06)]
        for (xa, za, ra), (xb, zb, rb) in itertools.pairwise(ends):
            parts.append(Tube((xa, y, za), (xb, y, zb), ra, rb, _GREY, "panel"))
        for x in (-0.9, 0.75):
            middle = (x, y * 0.78, 0.75)
            parts.append(Tube((x, y, 0.3), middle, 0.05, 0.05, _DARK))
            parts.append(Tube(middle, (x * 0.8, y * 0.5, 1.02), 0.05, 0.05, _DARK))
        parts.append(_box((-2.6, -2.35), (y - 0.14, y + 0.14), (-0.1, 0.5), _DARK))
    parts.append(_box((-0.95, 0.8), (-0.55, 0.55), (1.0, 1.07), _WHITE, "panel"))
    parts.append(_box((-0.5, -0.05), (-0.35, 0.35), (1.07, 1.24), _ORANGE, "panel"))
    parts.append(_box((0.1, 0.45), (-0.2, 0.2), (1.07, 1.2), _BLUE, "panel"))
    response = SelfMaskResponse(4.6, 2.3, (1.0, 1.1, 1.2), (0.5, 0.4, 0.4))
    return Hull(tuple(parts), response)


def _ferry() -> Hull:
    """28 x 8.4 m: car-ferry hull with a saloon and a bridge."""
    parts = (
        Prism(_ship_outline(28, 8.4), -1.6, 2.2, _BLUE, "paint", taper=0.86),
        Prism(_ship_outline(28.1, 8.5), 2.2, 3.1, _WHITE, "panel"),
        _box((-11, 7), (-3.4, 3.4), (3.1, 5.6), _WHITE, "cabin"),
        _box((1.5, 6.0), (-2.8, 2.8), (5.6, 8.0), _WHITE, "cabin"),
        _box((-8.5, -6.5), (-0.9, 0.9), (5.6, 8.6), _ORANGE, "panel"),
        Tube((3.5, 0, 8.0), (3.5, 0, 12.0), 0.12, 0.06, _GREY),
    )
    return Hull(parts, SelfMaskResponse(26, 8, (3.0, 4.5, 3.2), (0.4, 0.12, 0.4)))


def _workboat() -> Hull:
    """9 x 3.1 m: open after deck, wheelhouse forward."""
    parts = (
        Prism(_ship_outline(9, 3.1), -0.5, 0.95, _ORANGE, "paint", taper=0.82),
        Prism(_ship_outline(9.1, 3.2), 0.95, 1.15, _DARK, "rubber"),
        _box((0.0, 2.3), (-1.0, 1.0), (1.15, 3.1), _WHITE, "cabin"),
        _box((-3.4, -2.6), (-0.7, 0.7), (1.15, 1.7), _GREY, "panel"),
        Tube((-0.4, 0, 1.15), (-0.4, 0, 4.6), 0.07, 0.05, _GREY),
    )
    return Hull(parts, SelfMaskResponse(8.4, 2.9, (1.7, 2.4, 1.8), (0.4, 0.15, 0.4)))


def _sailboat() -> Hull:
    """11 x 3.6 m: cabin, cockpit, boom and mast."""
    parts = (
        Prism(_ship_outline(11, 3.6), -0.5, 1.05, _WHITE, "paint", taper=0.8),
        Prism(_ship_outline(10.6, 3.3), 1.05, 1.1, _WOOD, "planks"),
        _box((-1.2, 2.2), (-0.95, 0.95), (1.1, 1.6), _WHITE, "cabin"),
        Tube((0.6, 0, 1.1), (0.6, 0, 14.5), 0.09, 0.06, _GREY),
        Tube((0.5, 0, 2.4), (-3.9, 0, 2.3), 0.12, 0.09, _BLUE),
    )
    return Hull(parts, SelfMaskResponse(9.5, 3.2, (1.8, 3.0, 2.0), (0.4, 0.12, 0.4)))


_HULLS = {"catamaran": _catamaran(), "ferry": _ferry(), "workboat": _workboat(), "sailboat": _sailboat()}
