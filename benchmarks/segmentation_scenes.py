"""Pictures to train the segmentation with: random harbours, random boats near the camera, cheap strips of them.

Every scene has its own layout, size, light, sea and fleet; every picture its own place, heading, height and angular
step. What is stored is linear light, so that every epoch can see it through another camera in other weather.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.simulation.meshes import Mesh, blob, box, join, prism, tube
from rigwake.simulation.render import Renderer, RenderView
from rigwake.simulation.scenario import Scene, Sea, Weather
from rigwake.simulation.scenery import KeepClear, Scenery, build_scenery
from rigwake.simulation.shading import LAND, SKY, WATER
from rigwake.simulation.textures import Atlas
from rigwake.simulation.waves import build_wave_field
from rigwake.views.strips import StripGrid
from rigwake.views.surface import level_directions

ROWS, COLUMNS = 192, 320
_PLACES, _HEADINGS = 6, 4  # pictures per scene: their product
_COLOURS = (
    (0.85, 0.85, 0.85), (0.8, 0.8, 0.76), (0.75, 0.78, 0.8), (0.08, 0.12, 0.3), (0.15, 0.3, 0.55), (0.6, 0.1, 0.07),
    (0.1, 0.1, 0.1), (0.08, 0.3, 0.15), (0.45, 0.3, 0.17), (0.85, 0.35, 0.06), (0.4, 0.42, 0.44), (0.8, 0.65, 0.1),
    (0.03, 0.03, 0.04), (0.3, 0.55, 0.6), (0.5, 0.2, 0.3),
)  # fmt: skip
_SKINS = (
    "paint",
    "panel",
    "planks",
    "metal",
    "rubber",
    "cabin",
    "corrugated",
    "concrete",
    "facade_office",
    "stripes",
)


@dataclass(frozen=True, eq=False)
class Pictures:
    """light: (N, ROWS, COLUMNS, 3) float16 linear RGB. ranges_m: (N, ROWS, COLUMNS) float16, inf in the sky.
    labels: (N, ROWS, COLUMNS) uint8: 0 water, 1 obstacle, 2 sky. top_deg, step_deg: (N,) of each grid."""

    light: np.ndarray
    ranges_m: np.ndarray
    labels: np.ndarray
    top_deg: Array
    step_deg: Array

    def save(self, path: Path) -> None:
        """Uncompressed, without pickle."""
        np.savez(path, **vars(self))

    @classmethod
    def load(cls, path: Path) -> Pictures:
        with np.load(path, allow_pickle=False) as stored:
            return cls(**{name: stored[name] for name in stored.files})


def random_colour(rng: np.random.Generator, spread: float = 0.25) -> tuple[float, float, float]:
    """One of the colours of boats, most often white."""
    chosen = np.array(_COLOURS[int(rng.integers(len(_COLOURS)) if rng.random() < 0.65 else rng.integers(3))])
    r, g, b = np.clip(chosen * rng.uniform(1 - spread, 1 + spread, 3), 0.02, 1.0)
    return float(r), float(g), float(b)


def random_boat(rng: np.random.Generator, atlas: Atlas) -> tuple[Mesh, float]:
    """A boat that nobody built, along x, and its length: hull, stripe, cabins, canopy, rails, mast, fenders."""
    length = float(rng.choice([rng.uniform(2, 4.5), rng.uniform(5, 9), rng.uniform(8, 16)]))
    beam = length * rng.uniform(0.2, 0.42)
    freeboard = rng.uniform(0.09, 0.17) * length * (1.3 if length < 5 else 0.8)
    x = np.linspace(-0.5, 0.5, 11)
    half = 0.5 * np.clip((0.5 - x) / rng.uniform(0.2, 0.7), 0, 1) ** rng.uniform(0.35, 0.9)
    half = np.minimum(half, rng.uniform(0.35, 0.5) + 0.2 * (x + 0.5)) + 0.004
    outline = np.concatenate([np.column_stack([x, -half]), np.column_stack([x, half])[-2::-1]]) * [
        length,
        beam,
    ]
    hull, skin = random_colour(rng), atlas.number(str(rng.choice(_SKINS[:4])))
    deck = atlas.number(str(rng.choice(["planks", "panel", "paint"])))
    parts = [prism(outline, -0.5, freeboard, rng.uniform(0.7, 0.98), skin, deck, hull)]
    if rng.random() < 0.5:
        low = rng.uniform(-0.05, 0.8) * freeboard
        parts.append(
            prism(
                outline * 1.005,
                low,
                low + rng.uniform(0.06, 0.3) * freeboard,
                1.0,
                skin,
                deck,
                random_colour(rng),
            )
        )
    top = freeboard
    for _ in range(int(rng.integers(0, 4)) if length > 3.5 else 0):
        size = np.array([rng.uniform(0.15, 0.5) * length, rng.uniform(0.5, 0.85) * beam])
        at = rng.uniform(-0.38, 0.3) * length
        height = rng.uniform(0.4, 2.2) * min(1.0, length / 7)
        side = atlas.number(str(rng.choice(["cabin", "cabin", "facade_office", "panel", "planks", "paint"])))
        low = (at - size[0] / 2, -size[1] / 2, top)
        parts.append(
            box(
                low,
                (at + size[0] / 2, size[1] / 2, top + height),
                side,
                skin,
                random_colour(rng),
                random_colour(rng),
            )
        )
        top += height if rng.random() < 0.5 else 0.0
    if rng.random() < 0.35 and length > 4:  # a canopy on poles
        at, reach, up = rng.uniform(-0.3, 0.1) * length, 0.15 * length, freeboard + rng.uniform(1.6, 2.3)
        parts.append(
            box(
                (at - reach, -0.45 * beam, up),
                (at + reach, 0.45 * beam, up + 0.12),
                skin,
                skin,
                random_colour(rng),
            )
        )
        for sx in (-reach, reach):
            for sy in (-0.42, 0.42):
                parts.append(
                    tube((at + sx, sy * beam, freeboard), (at + sx, sy * beam, up), 0.025, 0.025, skin)
                )
    if rng.random() < 0.5 and length > 4:  # rails
        for sy in (-0.45, 0.45):
            up = freeboard + 0.6
            parts.append(
                tube((-0.45 * length, sy * beam, up), (0.25 * length, sy * beam, up), 0.02, 0.02, skin)
            )
            for px in np.linspace(-0.45, 0.25, 7) * length:
                parts.append(tube((px, sy * beam, freeboard), (px, sy * beam, up), 0.015, 0.015, skin))
    if rng.random() < 0.45 and length > 4:
        mast, high = rng.uniform(-0.1, 0.2) * length, rng.uniform(1.5, 12) * min(1, length / 9)
        parts.append(tube((mast, 0, top), (mast, 0, top + high), 0.08, 0.05, skin, random_colour(rng)))
    rubber = atlas.number("rubber")
    for _ in range(int(rng.integers(0, 7))):
        at, sy = rng.uniform(-0.4, 0.2) * length, float(rng.choice([-1, 1])) * (0.47 * beam + 0.08)
        colour = ((0.9, 0.9, 0.9), (0.3, 0.3, 0.3), (0.1, 0.15, 0.5), (0.9, 0.3, 0.05))[int(rng.integers(4))]
        low = rng.uniform(0.05, 0.5) * freeboard
        parts.append(
            tube((at, sy, low), (at, sy, low + rng.uniform(0.2, 0.6)), 0.11, 0.11, rubber, colour, 7)
        )
    return join(parts), length


def random_thing(rng: np.random.Generator, atlas: Atlas) -> tuple[Mesh, float]:
    """Anything else that stands in the water: buoy, pile, jetty, rock, kayak, swimmer, raft, wall."""
    skin, colour = atlas.number(str(rng.choice(_SKINS))), random_colour(rng)
    kind = str(rng.choice(["ball", "pile", "jetty", "rock", "kayak", "head", "cone", "wall"]))
    if kind in ("ball", "head"):
        size = rng.uniform(0.25, 0.8) if kind == "ball" else 0.16
        return blob(rng, (0, 0, size * 0.5), (size, size, size), 0.0, skin, colour, 8), size
    if kind == "pile":
        parts = []
        for _ in range(int(rng.integers(1, 5))):
            at, lean, high = rng.normal(0, 0.7, 2), rng.normal(0, 0.15, 2), rng.uniform(0.6, 3.5)
            parts.append(tube((*at, -1), (*(at + lean), high), rng.uniform(0.1, 0.25), 0.12, skin, colour))
        return join(parts), 1.5
    if kind == "jetty":
        size = rng.uniform([4, 1, 0.25], [18, 3, 0.9])
        parts = [
            box((-size[0] / 2, -size[1] / 2, -0.3), (size[0] / 2, size[1] / 2, size[2]), skin, skin, colour)
        ]
        for at in np.arange(-0.45, 0.5, 0.3) * size[0]:
            parts.append(
                tube((at, size[1] / 2, -1), (at, size[1] / 2, rng.uniform(1, 2.6)), 0.13, 0.12, skin)
            )
        return join(parts), float(size[0])
    if kind == "rock":
        size = rng.uniform(0.3, 2.0)
        grey = (0.8, 0.78, 0.72)
        stone = atlas.number(str(rng.choice(["stone", "grass", "concrete"])))
        return blob(rng, (0, 0, 0), (size * 1.4, size, size * 0.7), 0.13, stone, grey, 7), 1.4 * size
    if kind == "kayak":
        body = blob(rng, (0, 0, 0.1), (2.0, 0.33, 0.22), 0.0, atlas.number("paint"), colour, 9)
        person = blob(rng, (0, 0, 0.65), (0.2, 0.24, 0.42), 0.05, skin, random_colour(rng), 7)
        head = blob(rng, (0, 0, 1.15), (0.12, 0.11, 0.14), 0.0, skin, (0.6, 0.45, 0.35), 6)
        return join([body, person, head]), 2.5
    if kind == "cone":
        high = rng.uniform(0.6, 2.5)
        return tube(
            (0, 0, -0.3), (0, 0, high), 0.3 + 0.15 * high, rng.uniform(0.05, 0.4), skin, colour, 14
        ), 0.8
    size = rng.uniform([6, 0.5, 0.8], [25, 4, 5])
    return box(
        (-size[0] / 2, -size[1] / 2, -1), (size[0] / 2, size[1] / 2, size[2]), skin, skin, colour
    ), float(size[0])


def _scene(rng: np.random.Generator, number: int) -> tuple[Scene, Sea, Weather]:
    layout = str(rng.choice(["harbour", "bay", "canal", "marina"]))
    narrow = rng.random() < 0.5
    width = rng.uniform(30, 50) if narrow else rng.uniform(50, 140)
    scene = Scene(
        layout=layout,  # type: ignore[arg-type]
        size_m=(float(rng.uniform(40, 150)), float(width)),
        density=float(rng.uniform(0.3, 1.5)),
        seed=number,
    )
    calm = rng.random() < 0.45
    sea = Sea(
        hs_m=float(rng.uniform(0.005, 0.06) if calm else rng.uniform(0.06, 0.6)),
        tp_s=float(rng.uniform(1.5, 4)),
    )
    weather = Weather(
        sun_azimuth_deg=float(rng.uniform(0, 360)),
        sun_elevation_deg=float(rng.choice([rng.uniform(3, 15), rng.uniform(15, 70)])),
        cloud_cover=float(rng.choice([0.0, rng.random(), 1.0], p=[0.15, 0.55, 0.3])),
    )
    return scene, sea, weather


def _fleet(rng: np.random.Generator, places: Array, reach: Array, atlas: Atlas) -> list[Mesh]:
    """Boats and things in the water around the places (N, 2), none nearer than 1.5 m to any."""
    parts: list[Mesh] = []
    taken: list[tuple[Array, float]] = []
    for _ in range(int(rng.integers(25, 60))):
        mesh, length = random_boat(rng, atlas) if rng.random() < 0.6 else random_thing(rng, atlas)
        for _ in range(6):
            away = 0.6 * length + 1.5 + rng.gamma(1.6, 6.0)
            turn = rng.uniform(0, 2 * np.pi)
            at = places[rng.integers(len(places))] + away * np.array([np.cos(turn), np.sin(turn)])
            free = np.linalg.norm(places - at, axis=1).min() > 0.55 * length + 1.2
            apart = all(np.linalg.norm(at - other) > 0.4 * (length + size) for other, size in taken)
            if free and apart and (np.abs(at) < reach + 1.0).all():
                parts.append(mesh.moved(rng.uniform(0, 2 * np.pi), (*at, rng.uniform(-0.1, 0.05))))
                taken.append((at, length))
                break
    return parts


def rectangle_view(grid: StripGrid, columns: int) -> RenderView:
    """A camera that sees `columns` of a grid ahead, in the level frame, one ray per pixel."""
    azimuth = np.deg2rad((np.arange(columns) + 0.5 - columns / 2) * grid.step_deg)
    rays = level_directions(azimuth[None, :], grid.elevations()[:, None]).reshape(-1, 3).astype(np.float32)
    count, none = len(rays), np.zeros((0, 3), np.float32)
    pixel = np.arange(count, dtype=np.int32)
    width = np.full(count, np.deg2rad(grid.step_deg), np.float32)
    half = np.full(count, 0.5, np.float32)
    return RenderView(
        SE3.identity(), (grid.rows, columns), 1, rays, pixel, (pixel // columns).astype(np.int32), width, half,
        none, none, none, np.zeros(0, np.int32),
    )  # fmt: skip


def build_random_world(number: int) -> tuple[Renderer, Array, np.random.Generator]:
    """Scene `number`: its renderer, places (N, 2) for cameras, and the generator to go on with."""
    rng = np.random.default_rng([number, 1801])
    scene, sea, weather = _scene(rng, number)
    reach = np.array(scene.size_m) / 2 - 2.5
    places = rng.uniform(-1, 1, (_PLACES, 2)) * reach
    scenery = build_scenery(scene, number, KeepClear(places, 2.5))
    mesh = join([scenery.mesh, *_fleet(rng, places, reach, scenery.atlas)])
    tint = mesh.tint * rng.uniform(0.75, 1.25, 3).astype(np.float32)
    mesh = Mesh(mesh.triangles, mesh.uv, mesh.texture, tint)
    scenery = Scenery(mesh, scenery.atlas, scenery.known_points_world)
    return Renderer(scenery, build_wave_field(sea, number), weather, number), places, rng


def labels_of(truth: np.ndarray) -> np.ndarray:
    """Classes 0 water, 1 obstacle, 2 sky of the simulator's labels."""
    labels = np.full(truth.shape, 255, np.uint8)
    for value, label in ((WATER, 0), (LAND, 1), (SKY, 2)):
        labels[truth == value] = label
    return labels


def render_scene(number: int, step_deg: tuple[float, float] = (0.14, 0.5)) -> Pictures:
    """All pictures of one random scene."""
    renderer, places, rng = build_random_world(number)
    light, ranges, labels, tops, steps = [], [], [], [], []
    for place in places:
        height = float(np.clip(np.exp(rng.normal(0.65, 0.5)), 0.5, 7))
        water = renderer.water(float(rng.uniform(0, 60)))
        for _ in range(_HEADINGS):
            step = float(np.exp(rng.uniform(*np.log(step_deg))))
            grid = StripGrid(step, float(rng.uniform(0.2, 0.62)) * ROWS * step, ROWS)
            view = rectangle_view(grid, COLUMNS)
            tilt = so3.exp(np.deg2rad([rng.normal(0, 0.8), rng.normal(0, 0.8), 0.0]))
            R = so3.exp(np.array([0, 0, rng.uniform(0, 2 * np.pi)])) @ tilt
            stand = SE3(R, np.array([*place, height]))
            truth = renderer.truth(view, stand, water)
            light.append(renderer.render(view, stand, water).clip(0, 6e4).astype(np.float16))
            ranges.append(np.minimum(truth.ranges_m, 6e4).astype(np.float16))
            labels.append(labels_of(truth.labels))
            tops.append(grid.top_deg)
            steps.append(step)
    return Pictures(np.stack(light), np.stack(ranges), np.stack(labels), np.array(tops), np.array(steps))
