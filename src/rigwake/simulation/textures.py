"""Procedural textures: small tileable pictures and their mip pyramids in one flat array.

Noise is synthesised in the Fourier domain (amplitude `1/f^beta`, random phase), which makes it tileable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Floats

SIZE = 256
MACRO_SIZE = 1024
MACRO_M = 53.0  # a colour pattern that repeats only after this many metres lies over every texture


@dataclass(frozen=True, eq=False)
class Atlas:
    """Textures with their mip levels.

    texels: (N, 3) linear colours of all levels of all textures. starts: (K, L) first texel of each level.
    sizes: (K, L) edge length in texels. metres: (K,) length of a texture's edge on a surface.
    """

    names: tuple[str, ...]
    texels: Floats
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    metres: Floats

    def number(self, name: str) -> int:
        """The number of a texture."""
        return self.names.index(name)


def noise(rng: np.random.Generator, beta: float, size: int = SIZE, lowest: float = 1.0) -> Array:
    """Tileable noise (size, size), zero mean and unit deviation; beta 0 is white, 1 cloudy, 2 smooth."""
    f = np.fft.fftfreq(size, 1 / size)
    radius = np.hypot(f[:, None], f[None, :])
    amplitude = np.where(radius >= lowest, np.maximum(radius, 1) ** -beta, 0)
    spectrum = np.fft.fft2(rng.standard_normal((size, size))) * amplitude
    values = np.fft.ifft2(spectrum).real
    return np.asarray((values - values.mean()) / values.std())


def build_atlas(seed: int, contrast: float) -> Atlas:
    """All textures; `contrast` 0 leaves only their mean colours."""
    rng = np.random.default_rng([seed, 7])
    pictures, metres, names = [], [], []
    for name, (painter, edge_m) in _PAINTERS.items():
        picture = painter(rng)
        mean = picture.mean(axis=(0, 1))
        pictures.append(np.clip(mean + contrast * (picture - mean), 0.004, 1.0))
        metres.append(edge_m)
        names.append(name)
    pictures.append(np.clip(1 + contrast * (_macro(rng) - 1), 0.1, 3.0))
    levels = [_pyramid(picture) for picture in pictures]
    deepest = max(len(pyramid) for pyramid in levels)
    starts, sizes, flat, at = [], [], [], 0
    for pyramid in levels:
        row_start, row_size = [], []
        for level in range(deepest):
            picture = pyramid[min(level, len(pyramid) - 1)]
            if level < len(pyramid):
                flat.append(picture.reshape(-1, 3))
                here = at
                at += len(flat[-1])
            row_start.append(here)
            row_size.append(len(picture))
        starts.append(row_start)
        sizes.append(row_size)
    return Atlas(
        (*names, "macro"),
        np.concatenate(flat).astype(np.float32),
        np.array(starts),
        np.array(sizes),
        np.array([*metres, MACRO_M], np.float32),
    )


def _pyramid(picture: Array) -> list[Array]:
    levels = [picture]
    while len(levels[-1]) > 1:
        n = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(n, 2, n, 2, 3).mean(axis=(1, 3)))
    return levels


def _macro(rng: np.random.Generator) -> Array:
    """Multiplies every surface: stains, wear and weathering from metres down to centimetres."""
    grey = 0.10 * noise(rng, 1.0, MACRO_SIZE) + 0.10 * noise(rng, 0.7, MACRO_SIZE, lowest=12)
    stains = np.tanh(2.5 * (noise(rng, 1.3, MACRO_SIZE, lowest=6) - 1.2))
    hue = np.stack([noise(rng, 1.3, MACRO_SIZE) for _ in range(3)], -1) * 0.05
    return np.asarray(1.0 + (grey - 0.09 * (stains + 1))[..., None] + hue)


def _coloured(colour: tuple[float, float, float], grey: Array) -> Array:
    return np.asarray(np.array(colour) * np.clip(grey, 0.05, 3)[..., None])


def _grain(rng: np.random.Generator, amount: float, beta: float = 0.9) -> Array:
    return 1 + amount * noise(rng, beta)


def _grid() -> tuple[Array, Array]:
    """u to the right, v upwards, both 0..1 at texel centres; row 0 is the bottom."""
    axis = (np.arange(SIZE) + 0.5) / SIZE
    u, v = np.meshgrid(axis, axis)
    return u, v


def _masonry(rng: np.random.Generator, rows: int, columns: int, spread: float, joint: float) -> Array:
    """Brightness of staggered blocks, each a little different, with dark joints."""
    u, v = _grid()
    row = np.floor(v * rows).astype(int)
    shifted = u * columns + 0.5 * (row % 2)
    column = np.floor(shifted).astype(int) % columns
    block = 1 + spread * rng.standard_normal((rows, columns))[row, column]
    edge_u = np.minimum(shifted % 1, 1 - shifted % 1) / columns
    edge_v = np.minimum((v * rows) % 1, 1 - (v * rows) % 1) / rows
    return np.where(np.minimum(edge_u, edge_v) < joint, 0.55, block) * _grain(rng, 0.12)


def _brick(rng: np.random.Generator) -> Array:
    return _coloured((0.36, 0.17, 0.12), _masonry(rng, 24, 8, 0.2, 0.005))


def _stone(rng: np.random.Generator) -> Array:
    stone = _coloured((0.33, 0.32, 0.3), _masonry(rng, 6, 4, 0.2, 0.008) * _grain(rng, 0.25, 0.7))
    return stone


def _concrete(rng: np.random.Generator) -> Array:
    cracks = np.exp(-(((noise(rng, 1.4)) / 0.03) ** 2))
    return _coloured((0.42, 0.41, 0.39), _grain(rng, 0.18, 0.8) * (1 - 0.35 * cracks))


def _asphalt(rng: np.random.Generator) -> Array:
    patches = np.tanh(3 * noise(rng, 1.6))
    return _coloured((0.16, 0.16, 0.165), _grain(rng, 0.25, 0.4) * (1 + 0.2 * patches))


def _grass(rng: np.random.Generator) -> Array:
    dry = 0.5 + 0.5 * np.tanh(noise(rng, 1.2))
    green, straw = np.array([0.09, 0.17, 0.045]), np.array([0.24, 0.22, 0.09])
    mix = green + dry[..., None] * 0.6 * (straw - green)
    return np.asarray(mix * _grain(rng, 0.35, 0.5)[..., None].clip(0.1))


def _foliage(rng: np.random.Generator) -> Array:
    leaves = np.tanh(1.5 * noise(rng, 0.5, lowest=6))
    return _coloured((0.07, 0.13, 0.035), 1 + 0.65 * leaves + 0.2 * noise(rng, 1.2))


def _forest(rng: np.random.Generator) -> Array:
    crowns = np.tanh(noise(rng, 0.8, lowest=9))
    fields = np.clip(np.tanh(4 * (noise(rng, 2.0) - 0.6)), 0, 1)[..., None]
    wood = _coloured((0.06, 0.105, 0.045), 1 + 0.5 * crowns)
    return np.asarray(
        wood * (1 - fields) + fields * np.array([0.23, 0.24, 0.1]) * _grain(rng, 0.1)[..., None]
    )


def _roof(rng: np.random.Generator) -> Array:
    u, v = _grid()
    rows, columns = 14, 16
    row = np.floor(v * rows).astype(int)
    column = np.floor(u * columns).astype(int)
    tile = 1 + 0.18 * rng.standard_normal((rows, columns))[row, column]
    wave = 0.8 + 0.25 * np.sin(2 * np.pi * u * columns) + 0.2 * ((v * rows) % 1)
    return _coloured((0.42, 0.15, 0.09), tile * wave * _grain(rng, 0.1))


def _planks(rng: np.random.Generator) -> Array:
    u, v = _grid()
    board = np.floor(v * 8).astype(int)
    gap = np.where(np.abs((v * 8) % 1 - 0.5) > 0.46, 0.35, 1.0)
    streaks = np.repeat(noise(rng, 0.6)[:, :1], SIZE, axis=1) * 0.1
    nails = np.where((np.abs((u * 4) % 1 - 0.5) < 0.02) & (np.abs((v * 8) % 1 - 0.3) < 0.07), 0.4, 1.0)
    shade = (1 + 0.16 * rng.standard_normal(8)[board] + streaks) * gap * nails
    return _coloured((0.36, 0.28, 0.2), shade * _grain(rng, 0.12))


def _corrugated(rng: np.random.Generator) -> Array:
    """The side of a container: ribs, frame, rust and a faded logo; one texture is one container side."""
    u, v = _grid()
    shade = 0.85 + 0.22 * np.sign(np.sin(2 * np.pi * u * 20))
    frame = (np.minimum(u, 1 - u) < 0.02) | (np.minimum(v, 1 - v) < 0.05)
    logo = (np.abs(u - 0.3) < 0.17) & (np.abs(v - 0.62) < 0.16) & (noise(rng, 1.2, lowest=5) > -0.35)
    rust = np.clip(noise(rng, 1.0) - 1.3, 0, 1)
    picture = np.asarray(np.where(frame, 0.55, shade)[..., None] * np.ones(3))
    picture = np.where(logo[..., None], 1.45 * picture, picture)
    return np.asarray(0.6 * picture * (1 - 0.6 * rust[..., None] * np.array([0.3, 0.8, 1.0])))


def _metal(rng: np.random.Generator) -> Array:
    u, v = _grid()
    stripe = np.where(((u + v) * 4) % 1 < 0.5, 0.75, 1.0)
    return _coloured((0.62, 0.62, 0.62), stripe * _grain(rng, 0.12, 1.0))


def _paint(rng: np.random.Generator) -> Array:
    streaks = 0.05 * np.repeat(noise(rng, 0.7)[:1], SIZE, axis=0)
    return _coloured((0.7, 0.7, 0.7), 1 + streaks + 0.05 * noise(rng, 0.9))


def _panel(rng: np.random.Generator) -> Array:
    """Painted panels with seams, rivets and a dark hatch."""
    u, v = _grid()
    seam = (np.abs(u - 0.5) > 0.49) | (np.abs(v - 0.5) > 0.485)
    rivet = ((u * 12) % 1 - 0.5) ** 2 + ((v - 0.06) * 12) ** 2 < 0.05
    hatch = (np.abs(u - 0.55) < 0.13) & (np.abs(v - 0.5) < 0.2)
    shade = np.where(seam, 0.35, 1.0) * np.where(rivet, 0.5, 1.0) * np.where(hatch, 0.6, 1.0)
    return _coloured((0.7, 0.7, 0.7), shade * _grain(rng, 0.06))


def _rubber(rng: np.random.Generator) -> Array:
    return _coloured((0.045, 0.045, 0.05), _grain(rng, 0.3, 0.6))


def _cabin(rng: np.random.Generator) -> Array:
    """White superstructure with a band of dark windows."""
    u, v = _grid()
    window = (np.abs((u * 2) % 1 - 0.5) < 0.36) & (np.abs(v - 0.6) < 0.18)
    shade = np.where(window[..., None], np.array([0.03, 0.045, 0.06]), np.array([0.72, 0.73, 0.74]))
    return np.asarray(shade * _grain(rng, 0.05)[..., None])


def _facade(frame: tuple[float, float, float], shutters: bool, rough: float) -> Callable[..., Array]:
    """One bay of a house front: wall, a window with frame, sill and panes, shutters."""

    def paint(rng: np.random.Generator) -> Array:
        u, v = _grid()
        wall = np.array([0.68, 0.68, 0.68]) * _grain(rng, rough)[..., None]
        inside = (np.abs(u - 0.5) < 0.2) & (np.abs(v - 0.52) < 0.28)
        pane = inside & (np.abs(u - 0.5) > 0.015) & (np.abs(np.abs(u - 0.5) - 0.2) > 0.02)
        pane &= (np.abs(v - 0.6) > 0.014) & (np.abs(np.abs(v - 0.52) - 0.28) > 0.025)
        curtain = np.where(v > 0.66, 0.16, 0.05) + 0.03 * noise(rng, 1.0)
        wall = np.where(inside[..., None], np.array(frame), wall)
        wall = np.where(pane[..., None], curtain[..., None] * np.array([0.8, 0.95, 1.1]), wall)
        sill = (np.abs(u - 0.5) < 0.24) & (np.abs(v - 0.225) < 0.018)
        wall = np.where(sill[..., None], 0.75, wall)
        if shutters:
            shutter = (np.abs(np.abs(u - 0.5) - 0.29) < 0.07) & (np.abs(v - 0.52) < 0.27)
            slats = 0.75 + 0.25 * np.sin(2 * np.pi * v * 40)
            wall = np.where(shutter[..., None], slats[..., None] * np.array([0.12, 0.2, 0.16]), wall)
        return np.asarray(np.where((v > 0.965)[..., None], 0.5 * wall, wall))

    return paint


def _shop(rng: np.random.Generator) -> Array:
    """A ground floor: door, display window, awning and a sign of random marks."""
    u, v = _grid()
    wall = np.array([0.5, 0.48, 0.45]) * _grain(rng, 0.08)[..., None]
    glass = (np.abs(u - 0.63) < 0.3) & (np.abs(v - 0.36) < 0.26)
    door = (np.abs(u - 0.14) < 0.1) & (v < 0.66)
    awning = np.abs(v - 0.72) < 0.055
    sign = (np.abs(v - 0.87) < 0.07) & (np.abs(u - 0.5) < 0.42)
    marks = sign & (noise(rng, 0.9, lowest=8) > 0.6)
    display = 0.08 + 0.1 * np.clip(noise(rng, 0.8), 0, 2)
    wall = np.where(glass[..., None], display[..., None] * np.array([1.1, 1.0, 0.8]), wall)
    wall = np.where(door[..., None], np.array([0.2, 0.1, 0.06]), wall)
    stripes = np.where((u * 10) % 1 < 0.5, 0.75, 0.25)[..., None] * np.array([1.0, 0.75, 0.7])
    wall = np.where(awning[..., None], stripes, wall)
    wall = np.where(sign[..., None], np.array([0.1, 0.13, 0.2]), wall)
    return np.asarray(np.where(marks[..., None], 0.85, wall))


def _stripes(rng: np.random.Generator) -> Array:
    _, v = _grid()
    band = np.where((v * 2) % 1 < 0.5, 1.0, 0.25)
    return _coloured((0.8, 0.8, 0.8), band * _grain(rng, 0.06))


def _checker(rng: np.random.Generator) -> Array:
    u, v = _grid()
    return _coloured((0.9, 0.9, 0.9), np.where((u < 0.5) == (v < 0.5), 1.0, 0.03))


_PAINTERS: dict[str, tuple[Callable[[np.random.Generator], Array], float]] = {
    "brick": (_brick, 2.0),
    "stone": (_stone, 3.0),
    "concrete": (_concrete, 3.0),
    "asphalt": (_asphalt, 5.0),
    "grass": (_grass, 5.0),
    "foliage": (_foliage, 2.6),
    "forest": (_forest, 70.0),
    "roof": (_roof, 4.0),
    "planks": (_planks, 1.6),
    "corrugated": (_corrugated, 6.0),
    "metal": (_metal, 1.5),
    "paint": (_paint, 3.0),
    "panel": (_panel, 1.2),
    "rubber": (_rubber, 1.0),
    "cabin": (_cabin, 2.4),
    "facade_white": (_facade((0.8, 0.8, 0.78), False, 0.05), 3.0),
    "facade_shutters": (_facade((0.7, 0.68, 0.62), True, 0.07), 3.0),
    "facade_office": (_facade((0.25, 0.27, 0.3), False, 0.04), 3.4),
    "shop": (_shop, 3.4),
    "stripes": (_stripes, 1.2),
    "checker": (_checker, 2.0),
}
