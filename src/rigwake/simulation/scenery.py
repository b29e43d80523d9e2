"""The land around the water, assembled from a layout, a density and a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from rigwake._types import Array
from rigwake.simulation import structures
from rigwake.simulation.hull_mesh import build_hull
from rigwake.simulation.meshes import Mesh, blob, box, from_grid, join, rectangle
from rigwake.simulation.scenario import Scene
from rigwake.simulation.scene_layout import FAR_SHORE_M, QUAY_HEIGHT_M, SceneLayout, Side, build_layout
from rigwake.simulation.textures import Atlas, build_atlas, noise

_PLATEAU_M = 55.0  # flat ground behind a quay, then hills
_REACH_M = 1100.0
_PLACES = 0.75  # of that: houses and trees stand no farther out


@dataclass(frozen=True, eq=False)
class Scenery:
    """Everything that stands still: triangles, textures, and points known by construction (K, 3)."""

    mesh: Mesh
    atlas: Atlas
    known_points_world: Array


@dataclass(frozen=True, eq=False)
class KeepClear:
    """Water that must stay free: within `radius_m` of any of the plan positions (N, 2)."""

    positions: Array
    radius_m: float

    def allows(self, plan: Array, margin_m: float) -> bool:
        """Whether something of radius `margin_m` may float at a plan position (2,)."""
        distance = np.linalg.norm(self.positions - plan, axis=1)
        return bool(distance.min() > self.radius_m + margin_m)


def build_scenery(scene: Scene, seed: int, keep_clear: KeepClear) -> Scenery:
    """Build the scene. The same scene, seed and path give the same triangles."""
    rng = np.random.default_rng([seed, 31])
    density = scene.density
    atlas = build_atlas(seed, contrast=min(1.0, 0.15 + 0.85 * density))
    layout = build_layout(scene)
    parts, known = [_hills(rng, layout, atlas, density)], []
    for side in layout.sides:
        if side.kind == "open":
            continue
        local = _quay(rng, side, atlas, density) if side.kind == "quay" else _shore(rng, side, atlas, density)
        boards = _target_places(side, density)
        local += [structures.target(atlas).moved(0, place) for place in boards]
        world = join(local).moved(_heading(side), (*side.start, 0.0))
        parts.append(world)
        known += [_to_world(side, place + np.array([0, 0.06, 0])) for place in boards]
        parts += _afloat(rng, side, atlas, density, keep_clear)
    parts += _buoys(rng, layout, atlas, density, keep_clear)
    return Scenery(join(parts), atlas, np.array(known).reshape(-1, 3))


def _heading(side: Side) -> float:
    return float(np.arctan2(side.along[1], side.along[0]))


def _to_world(side: Side, place: Array) -> Array:
    return np.append(side.place(place[0], -place[1]), place[2])


def _target_places(side: Side, density: float) -> list[Array]:
    """Boards on posts near the edge, every 30 m of it, in a scene that has anything at all."""
    if density < 0.05:
        return []
    count = max(int(side.length_m // 30), 1)
    places = (np.arange(count) + 0.5) * side.length_m / count
    inland, height = (6.0, 3.4) if side.kind == "quay" else (9.0, 4.2)
    return [np.array([x, -inland, height]) for x in places]


def _quay(rng: np.random.Generator, side: Side, atlas: Atlas, density: float) -> list[Mesh]:
    """Wall, paving, and behind them houses, or containers under cranes. Local frame: y towards the water."""
    length, top = side.length_m, QUAY_HEIGHT_M
    stone = atlas.number("stone")
    parts = [
        rectangle((length + 60, 0, -2), (-length - 120, 0, 0), (0, 0, top + 2), stone, cell_m=3.0),
        rectangle(
            (-60, -1.2, top), (length + 120, 0, 0), (0, 1.2, 0), atlas.number("concrete"), (1.2, 1.2, 1.2), 3.0
        ),
        rectangle(
            (-60, -_PLATEAU_M, top - 0.02), (length + 120, 0, 0), (0, _PLATEAU_M - 1.2, 0),
            atlas.number("asphalt"), (1.5, 1.45, 1.4), 6.0,
        ),
    ]  # fmt: skip
    furniture = structures.quay_furniture(rng, atlas, length, top)
    parts += [m.moved(0, (0, 0, top)) for m in furniture if rng.random() < density]
    if rng.random() < 0.4 and density > 0.3:
        parts += _container_yard(rng, length, atlas, density)
    else:
        parts += _street(rng, length, atlas, density)
    for _ in range(int(density * length / 9)):
        place = (rng.uniform(-30, length + 30), -rng.uniform(7.5, 9.5), top)
        parts.append(structures.tree(rng, atlas).moved(rng.uniform(0, 6), place))
    return parts


def _street(rng: np.random.Generator, length: float, atlas: Atlas, density: float) -> list[Mesh]:
    parts = []
    for row, (setback, gap) in enumerate(((13.0, 1.5), (34.0, 4.0))):
        x = -45.0
        while x < length + 45:
            bays, storeys = int(rng.integers(3, 8)), int(rng.integers(1, 4)) + row
            if rng.random() < 0.95 * min(density, 1.0):
                house = structures.building(rng, atlas, bays, storeys, rng.uniform(9, 13))
                parts.append(house.moved(0, (x, -setback - rng.uniform(0, 1.5), QUAY_HEIGHT_M)))
            x += bays * 3.0 + rng.choice([0.02, gap, 3 * gap], p=[0.6, 0.25, 0.15])
    return parts


def _container_yard(rng: np.random.Generator, length: float, atlas: Atlas, density: float) -> list[Mesh]:
    parts = []
    for setback in (14.0, 24.0, 34.0):
        x = -30.0
        while x < length + 25:
            rows = int(rng.integers(2, 6))
            if rng.random() < 0.85 * min(density, 1.0):
                stack = structures.container_stack(rng, atlas, rows)
                parts.append(stack.moved(0, (x, -setback, QUAY_HEIGHT_M)))
            x += rows * 6.4 + rng.uniform(2, 8)
    for x in np.arange(0.2, 1.0, 0.45) * length:
        parts.append(structures.crane(rng, atlas).moved(0, (x + rng.uniform(-6, 6), -6, QUAY_HEIGHT_M)))
    low, high = (length * 0.3, -52, QUAY_HEIGHT_M), (length * 0.75, -42, 11)
    shed = box(low, high, atlas.number("corrugated"), atlas.number("concrete"), (0.7, 0.75, 0.8))
    return [*parts, shed]


def _shore(rng: np.random.Generator, side: Side, atlas: Atlas, density: float) -> list[Mesh]:
    """A sloping bank with rocks, bushes, trees and scattered houses."""
    length = side.length_m
    x = np.arange(-60, length + 61, 3.0)
    w = np.array([-6, -3, 0, 2, 4, 7, 11, 16, 24, 40, _PLATEAU_M + 4])
    lift = np.interp(w, [-6, 0, 4, 11, 24, 60], [-1.6, -0.1, 0.7, 1.8, 2.6, 3.2])
    bumps = rng.normal(0, 0.22, (len(w), len(x))) * np.clip(w / 8, 0, 1)[:, None]
    grid_x, grid_w = np.meshgrid(x, w)
    # rows from the land to the water, so that the surface faces up
    points = np.stack([grid_x, -grid_w, lift[:, None] + bumps], -1)[::-1]
    parts = [
        from_grid(points[:7], points[:7, :, :2], atlas.number("grass"), (1, 1, 1)),
        from_grid(points[6:], points[6:, :, :2], atlas.number("stone"), (0.9, 0.87, 0.8)),
    ]
    for _ in range(int(length * 1.2 * density)):
        place = (rng.uniform(-40, length + 40), -rng.gamma(2, 1.6), rng.uniform(-0.1, 0.4))
        size = rng.gamma(3, 0.16)
        rock = blob(
            rng, place, (size * 1.3, size, size * 0.8), 0.14, atlas.number("stone"), (0.8, 0.8, 0.8), 6
        )
        parts.append(rock)
    for _ in range(int(length * 0.35 * density)):
        place = (rng.uniform(-50, length + 50), -rng.uniform(12, 50), 2.0)
        parts.append(structures.tree(rng, atlas).moved(rng.uniform(0, 6), place))
    for _ in range(int(length / 16 * density)):
        house = structures.building(rng, atlas, int(rng.integers(2, 5)), 1, rng.uniform(7, 10))
        place = (rng.uniform(-20, length), -rng.uniform(16, 34), 1.9)
        parts.append(house.moved(rng.normal(0, 0.15), place))
    return parts


def _afloat(
    rng: np.random.Generator, side: Side, atlas: Atlas, density: float, keep_clear: KeepClear
) -> list[Mesh]:
    """Pontoons with boats on a shore, boats alongside a quay, where the water need not stay free (world frame)."""
    parts = []
    heading = _heading(side)
    if side.kind == "shore":
        for x in np.arange(12, side.length_m - 6, 22.0):
            reach = rng.uniform(10, 20)
            tip = side.place(x, -reach)
            if rng.random() < density and keep_clear.allows(tip, 3.0):
                walk = structures.pontoon(rng, atlas, reach)
                parts.append(walk.moved(heading, (*side.place(x, 0.0), 0.0)))
    spots = np.arange(6.0, side.length_m - 6, 10.0)
    for x in spots + rng.uniform(-2, 2, len(spots)):
        if rng.random() > 0.6 * density:
            continue
        hull = build_hull(str(rng.choice(["workboat", "sailboat"])))
        beam = hull.response.beam_m / 2
        place = side.place(x, -(beam + 0.9) if side.kind == "quay" else -rng.uniform(6, 14))
        if not keep_clear.allows(place, hull.response.length_m / 2):
            continue
        turned = heading + rng.choice([0.0, np.pi]) + (0.0 if side.kind == "quay" else np.pi / 2)
        parts.append(structures.moored_boat(rng, atlas, hull).moved(turned, (*place, 0.0)))
    return parts


def _buoys(
    rng: np.random.Generator, layout: SceneLayout, atlas: Atlas, density: float, keep_clear: KeepClear
) -> list[Mesh]:
    """Buoys where the boat does not pass, near enough to be seen well."""
    size = np.array([layout.half_length_m, layout.half_width_m])
    tries = rng.uniform(-0.9, 0.9, (int(60 * density), 2)) * size
    placed: list[Array] = []
    for plan in tries:
        spaced = all(np.linalg.norm(plan - other) > 14 for other in placed)
        if len(placed) < 10 * density and spaced and keep_clear.allows(plan, 1.0):
            placed.append(plan)
    return [structures.buoy(rng, atlas).moved(0, (*plan, rng.uniform(-0.1, 0.1))) for plan in placed]


def _hills(rng: np.random.Generator, layout: SceneLayout, atlas: Atlas, density: float) -> Mesh:
    """Ground out to a kilometre: hills behind the plateau, a far shore beyond open water, houses and woods on it."""
    x = _spread(layout.half_length_m)
    y = _spread(layout.half_width_m)
    grid_x, grid_y = np.meshgrid(x, y)
    relief = noise(rng, 1.7)
    rows = ((grid_y + _REACH_M) / (2 * _REACH_M) * 255).astype(int) % 256
    columns = ((grid_x + _REACH_M) / (2 * _REACH_M) * 255).astype(int) % 256
    rugged = 1 + 0.5 * relief[rows, columns]
    height = _ground(layout, grid_x, grid_y, rugged)
    points = np.stack([grid_x, grid_y, height], -1)
    parts = [from_grid(points, points[..., :2], atlas.number("forest"), (1.1, 1.1, 1.0))]
    height_at = RegularGridInterpolator((y, x), height)
    for _ in range(int(260 * density)):
        plan = rng.uniform(-_PLACES, _PLACES, 2) * _REACH_M
        ground = float(height_at(plan[::-1])[0])
        if ground < 4.5:
            continue
        if rng.random() < 0.6:
            house = structures.building(rng, atlas, int(rng.integers(2, 6)), int(rng.integers(1, 3)), 9.0)
            parts.append(house.moved(rng.uniform(0, 6.3), (*plan, ground - 2.5)))
        else:
            parts.append(structures.tree(rng, atlas).moved(0.0, (*plan, ground - 1.0)))
    return join(parts)


def _spread(half: float) -> Array:
    """Grid lines, close together near the water and wide apart far out, at least as far as things are placed."""
    near = np.arange(0, half + 150, 10.0)
    far = near[-1] + np.cumsum(np.geomspace(12, 45, 26))
    beyond = np.arange(
        far[-1] + 45, _PLACES * _REACH_M + 45, 45.0
    )  # narrow water: none where it is wide enough
    positive = np.concatenate([near, far, beyond])
    return np.concatenate([-positive[:0:-1], positive])


def _ground(layout: SceneLayout, x: Array, y: Array, rugged: Array) -> Array:
    """Height of the ground at plan positions: below water inside and off open sides, plateau, hills."""
    beyond = {
        "south": -y - layout.half_width_m,
        "east": x - layout.half_length_m,
        "north": y - layout.half_width_m,
        "west": -x - layout.half_length_m,
    }
    height = np.full(np.broadcast(x, y).shape, -4.0)
    for side, inland in zip(layout.sides, beyond.values(), strict=True):
        if side.kind == "open":
            rise = np.interp(inland, [FAR_SHORE_M - 40, FAR_SHORE_M, FAR_SHORE_M + 350], [-4, 1, 70])
        else:
            rise = np.interp(inland, [12, _PLATEAU_M - 10, _PLATEAU_M + 40, 420], [-4, 1.2, 6, 75])
        height = np.maximum(height, rise)
    return np.asarray(np.where(height > 2.0, height * rugged, height))
