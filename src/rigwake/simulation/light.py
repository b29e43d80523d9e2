"""Sun and sky: the picture of the sky, and the light that reaches every corner of the scenery, worked out once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from rigwake._types import Array, Floats
from rigwake.simulation.meshes import Mesh
from rigwake.simulation.scenario import Weather
from rigwake.simulation.textures import noise

SUN_COLOUR = np.array([1.0, 0.93, 0.8])
SUN_IRRADIANCE = 2.6
SKY_WIDTH, SKY_HEIGHT = 1536, 320
_SKY_DIRECTIONS = 8
_OCCLUSION_REACH_M = 30.0


@dataclass(frozen=True, eq=False)
class Sky:
    """The sky as a panorama: (SKY_HEIGHT, SKY_WIDTH, 3) radiance, row 0 at the horizon, the top row at the zenith,
    rows even in the square root of elevation's sine; columns from east to north. Without the sun's disc."""

    panorama: Floats
    sun: Floats  # (3,) unit direction towards it
    ambient: Array  # (3,) mean radiance
    horizon: Array  # (3,) mean radiance just above the horizon


def build_sky(weather: Weather, seed: int) -> Sky:
    """A blue gradient with haze near the horizon, a glow around the sun, and clouds on a layer overhead."""
    rng = np.random.default_rng([seed, 53])
    azimuth = (np.arange(SKY_WIDTH) + 0.5) / SKY_WIDTH * 2 * np.pi
    sine = ((np.arange(SKY_HEIGHT) + 0.5) / SKY_HEIGHT) ** 2
    cosine = np.sqrt(1 - sine**2)
    ray = np.stack(
        [
            cosine[:, None] * np.cos(azimuth),
            cosine[:, None] * np.sin(azimuth),
            np.broadcast_to(sine[:, None], (SKY_HEIGHT, SKY_WIDTH)),
        ],
        -1,
    )
    sun = sun_direction(weather)
    up = sine[:, None, None]
    zenith, low = np.array([0.16, 0.33, 0.72]), np.array([0.62, 0.74, 0.86])
    blue = low + (zenith - low) * (1 - np.exp(-3.2 * up))
    towards = np.clip(ray @ sun, 0, 1)[..., None]
    glow = (0.35 * towards**8 + 0.9 * towards**120) * SUN_COLOUR
    clouds, shade = _clouds(rng, ray, weather.cloud_cover)
    white = np.array([0.98, 0.98, 1.0]) * (0.5 + 0.75 * shade[..., None]) + 0.5 * glow
    cover = (clouds * np.clip(sine * 9, 0, 1)[:, None])[..., None]
    panorama = (blue + glow) * (1 - cover) + white * cover
    weight = sine[:, None, None] ** 0.5
    ambient = (panorama * weight).sum((0, 1)) / (weight.sum() * SKY_WIDTH)
    return Sky(
        panorama.astype(np.float32), sun.astype(np.float32), ambient, panorama[: SKY_HEIGHT // 6].mean((0, 1))
    )


def sun_direction(weather: Weather) -> Array:
    """Unit vector (3,) towards the sun."""
    azimuth, elevation = np.deg2rad([weather.sun_azimuth_deg, weather.sun_elevation_deg])
    return np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def _clouds(rng: np.random.Generator, ray: Array, cover: float) -> tuple[Array, Array]:
    """Opacity and brightness (H, W) of a cloud layer, looked up where each ray meets it."""
    layer = noise(rng, 1.45, 1024, lowest=2)
    detail = noise(rng, 0.9, 1024, lowest=24)
    at = ray[..., :2] / (ray[..., 2:] + 0.13)
    if cover <= 0:
        return np.zeros(ray.shape[:2]), np.zeros(ray.shape[:2])
    cells = np.moveaxis(at * 90, -1, 0)
    blend = map_coordinates(layer + 0.22 * detail, cells, order=1, mode="grid-wrap")
    threshold = np.quantile(layer, 1 - cover)
    opacity = np.clip((blend - threshold) * 1.5, 0, 1)
    thick = np.clip((blend - threshold) * 0.7, 0, 1)
    return opacity * opacity * (3 - 2 * opacity), 1 - 0.75 * thick


def build_embree(mesh: Mesh) -> EmbreeScene:
    """The mesh, ready for rays."""
    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(mesh.triangles))
    return scene


def bake_irradiance(mesh: Mesh, scene: EmbreeScene, sky: Sky) -> Floats:
    """Light on each corner (T, 3, 3): the sun where it is seen, and the part of the sky that is not hidden."""
    at, normal, inverse = _distinct_corners(mesh)
    towards_sun = np.broadcast_to(sky.sun, at.shape)
    lit = np.clip(normal @ sky.sun, 0, 1)
    facing = np.flatnonzero(lit > 0)
    lit[facing] *= ~_hidden(scene, at[facing], towards_sun[facing], 1e4)
    light = SUN_IRRADIANCE * lit[:, None] * SUN_COLOUR + _from_sky(scene, at, normal, sky)
    return np.ascontiguousarray(light[inverse].reshape(-1, 3, 3), dtype=np.float32)


def sky_light(mesh: Mesh, scene: EmbreeScene, sky: Sky) -> Floats:
    """As `bake_irradiance`, without the sun: for a hull, which turns beneath it."""
    at, normal, inverse = _distinct_corners(mesh)
    light = _from_sky(scene, at, normal, sky)
    return np.ascontiguousarray(light[inverse].reshape(-1, 3, 3), dtype=np.float32)


def _distinct_corners(mesh: Mesh) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Places just off the corners and their normals (C, 3), each once, and which of them each corner is."""
    normals = np.repeat(mesh.normals(), 3, axis=0)
    corners = mesh.triangles.reshape(-1, 3)
    rounded = np.concatenate([np.round(corners * 50), np.round(normals * 20)], 1).astype(np.int64)
    mixed = rounded @ np.array([73856093, 19349663 * 7919, 83492791 * 104729, 15485863, 32452843, 49979687])
    _, first, inverse = np.unique(mixed, return_index=True, return_inverse=True)
    return corners[first] + np.float32(0.03) * normals[first], normals[first], inverse


def _from_sky(scene: EmbreeScene, at: Floats, normal: Floats, sky: Sky) -> Array:
    upward = 0.5 + 0.5 * normal[:, 2:]
    bounce = 0.25 * (1 - upward) * SUN_COLOUR
    return np.asarray(_visible_sky(scene, at, normal)[:, None] * (upward * sky.ambient + bounce))


def _hidden(
    scene: EmbreeScene, origins: Floats, directions: NDArray[np.float32], reach_m: float
) -> NDArray[np.bool_]:
    reach = np.full(len(origins), reach_m, np.float32)
    hit = scene.run(
        np.ascontiguousarray(origins, dtype=np.float32),
        np.ascontiguousarray(directions, dtype=np.float32),
        dists=reach,
        query="OCCLUDED",
    )
    return np.asarray(hit) >= 0


def _visible_sky(scene: EmbreeScene, at: Floats, normal: Floats) -> Array:
    """Cosine-weighted share (N,) of the hemisphere that nothing near hides; the same directions everywhere."""
    index = np.arange(_SKY_DIRECTIONS) + 0.5
    radius, angle = np.sqrt(index / _SKY_DIRECTIONS), index * np.pi * (3 - np.sqrt(5))  # Fibonacci disc
    disc = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], -1)
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]])
    across = np.cross(helper, normal)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(normal, across)
    free = np.zeros(len(at))
    for a, b, c in disc:
        free += ~_hidden(scene, at, a * across + b * other + c * normal, _OCCLUSION_REACH_M)
    return np.asarray(0.15 + 0.85 * free / _SKY_DIRECTIONS)
