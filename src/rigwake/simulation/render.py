"""Pictures: every sub-pixel's ray through the lens itself, into the scene, and once more off the water."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from rigwake._types import Array, Floats
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry.se3 import SE3
from rigwake.simulation import shading
from rigwake.simulation.hull_mesh import Hull
from rigwake.simulation.light import Sky, bake_irradiance, build_embree, build_sky, sky_light
from rigwake.simulation.scenario import Weather
from rigwake.simulation.scenery import Scenery
from rigwake.simulation.sea_surface import Water, water_at
from rigwake.simulation.shading import Mirrored, Rays, Surfaces
from rigwake.simulation.skyline import gather_boxes, seen_band
from rigwake.simulation.structures import hull_mesh
from rigwake.simulation.textures import Atlas
from rigwake.simulation.waves import WaveField

_CHUNK = 1 << 15
_BLOCK_PX = 8  # rays are shot block by block: neighbours hit the same triangles and texels


@dataclass(frozen=True, eq=False)
class RenderView:
    """One camera's rays, ready to be turned into the world: all sub-pixels that do not see the own hull.

    cam_rays: (N, 3) unit. pixel, row: (N,) which pixel, which image row. width: (N,) radians across. rounding: (N,)
    in 0..1, how each ray of a pixel rounds mip levels.
    The hull's sub-pixels: colour, normal in the rig frame, light of the sky, pixel.
    """

    rig_from_cam: SE3
    shape: tuple[int, int]
    samples: int
    cam_rays: Floats
    pixel: NDArray[np.int32]
    row: NDArray[np.int32]
    width: Floats
    rounding: Floats
    hull_albedo: Floats
    hull_normal: Floats
    hull_light: Floats
    hull_pixel: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class TruthImage:
    """What is in each pixel's centre. labels: (H, W) uint8, 0 outside the image circle, 60 land, 120 sky,
    180 water, 240 own hull. ranges_m: (H, W) float32 distance along the ray, inf for sky, NaN outside and hull."""

    labels: NDArray[np.uint8]
    ranges_m: Floats


class Renderer:
    """A scene under a sky on a sea, ready to be looked at from anywhere. Safe to share between threads."""

    def __init__(self, scenery: Scenery, sea: WaveField, weather: Weather, seed: int) -> None:
        self.sea = sea
        self.sky = build_sky(weather, seed)
        self.atlas = scenery.atlas
        self.embree = build_embree(scenery.mesh)
        self.boxes = gather_boxes(scenery.mesh.triangles)
        light = bake_irradiance(scenery.mesh, self.embree, self.sky)
        mesh = scenery.mesh
        self.surfaces = _surfaces(
            mesh.uv, mesh.texture, mesh.tint, mesh.normals(), light, scenery.atlas, self.sky
        )

    def view(self, model: CameraModel, rig_from_cam: SE3, hull: Hull, samples: int) -> RenderView:
        """Prepare a camera with `samples` rays per pixel (a square number), the hull traced once."""
        side = round(np.sqrt(samples))
        offsets = (np.arange(side) + 0.5) / side - 0.5
        pixel_width = _pixel_widths(model) / np.float32(side)
        parts = [_lens_rays(model, du, dv) for dv in offsets for du in offsets]
        cam_rays = np.concatenate([rays for rays, _ in parts])
        all_pixels = np.concatenate([pixel for _, pixel in parts])
        rounding = np.repeat((np.arange(len(parts)) + 0.5) / len(parts), [len(rays) for rays, _ in parts])
        order = np.argsort(_shooting_order(model)[all_pixels], kind="stable")
        cam_rays, all_pixels, rounding = cam_rays[order], all_pixels[order], rounding[order]
        widths = pixel_width[all_pixels]
        hull_hit, colour, normal, light = self._trace_hull(hull, rig_from_cam, cam_rays, widths)
        free = ~hull_hit
        return RenderView(
            rig_from_cam,
            (model.height_px, model.width_px),
            side * side,
            cam_rays[free],
            all_pixels[free],
            (all_pixels[free] // model.width_px).astype(np.int32),
            widths[free],
            rounding[free].astype(np.float32),
            colour,
            normal,
            light,
            all_pixels[hull_hit],
        )

    def _trace_hull(
        self, hull: Hull, rig_from_cam: SE3, cam_rays: Floats, widths: Floats
    ) -> tuple[NDArray[np.bool_], Floats, Floats, Floats]:
        mesh = hull_mesh(hull, self.atlas)
        embree = build_embree(mesh)
        light = sky_light(mesh, embree, self.sky)
        surfaces = _surfaces(mesh.uv, mesh.texture, mesh.tint, mesh.normals(), light, self.atlas, self.sky)
        directions = (cam_rays @ rig_from_cam.rotation.T).astype(np.float32)
        hit = _cast(
            embree, np.broadcast_to(np.float32(rig_from_cam.translation), directions.shape), directions
        )
        seen = hit["primID"] >= 0
        triangle, u, v = hit["primID"][seen], hit["u"][seen], hit["v"][seen]
        colour = np.empty((len(triangle), 3), np.float32)
        shading.surface_colours(surfaces, triangle, u, v, hit["tfar"][seen] * widths[seen], colour)
        corner = np.stack([1 - u - v, u, v], 1)
        lit = np.einsum("nc,nca->na", corner, light[triangle]).astype(np.float32)
        return seen, colour, surfaces.normal[triangle], lit

    def water(self, time_s: float) -> Water:
        """The sea at a time (seconds since the start)."""
        return water_at(self.sea, time_s)

    def render(self, view: RenderView, world_from_rig: SE3, water: Water) -> Floats:
        """Linear radiance (H, W, 3) RGB. world_from_rig: a transform per image row (H,), or one for all.

        The hull turns with the rig; its light is that of the middle row.
        """
        height, width = view.shape
        image = np.zeros((height * width, 3), np.float32)
        rotation, centre = _per_row(view, world_from_rig)
        for rays in self._shots(view, rotation, centre, water.bound):
            out = _empty_mirrored(len(rays.pixel))
            count = shading.shade(self.surfaces, water, rays, out, image)
            if count:
                thrown = Mirrored(*(array[:count] for array in out))
                hit = self.embree.run(thrown.origin, thrown.direction, output=True)
                shading.shade_mirrored(
                    self.surfaces, thrown, hit["tfar"], hit["primID"], hit["u"], hit["v"], image
                )
        middle = rotation[height // 2] @ view.rig_from_cam.rotation.T
        sun_rig = middle.T @ self.sky.sun
        shading.shade_hull(
            view.hull_albedo, view.hull_normal, view.hull_light, view.hull_pixel, sun_rig, image
        )
        return np.asarray(image.reshape(height, width, 3) / view.samples, np.float32)

    def truth(self, view: RenderView, world_from_rig: SE3, water: Water) -> TruthImage:
        """Labels and ranges of a view prepared with one ray per pixel."""
        height, width = view.shape
        labels = np.zeros(height * width, np.uint8)
        ranges = np.full(height * width, np.nan, np.float32)
        labels[view.hull_pixel] = shading.HULL
        rotation, centre = _per_row(view, world_from_rig)
        for rays in self._shots(view, rotation, centre, water.bound):
            shading.classify(water, rays, labels, ranges)
        return TruthImage(labels.reshape(height, width), ranges.reshape(height, width))

    def _shots(self, view: RenderView, rotation: Array, centre: Array, depth_m: float) -> Iterator[Rays]:
        """All rays of a view and what they hit, a chunk at a time; those that can hit nothing are not cast."""
        band = seen_band(self.boxes, centre, depth_m)
        for start in range(0, len(view.pixel), _CHUNK):
            part = slice(start, start + _CHUNK)
            cam_rays = view.cam_rays[part]
            rays = np.empty_like(cam_rays), np.empty_like(cam_rays)
            thrown = np.empty_like(cam_rays), np.empty_like(cam_rays), np.empty(len(cam_rays), np.float32)
            cast = np.empty(len(cam_rays), np.int32)
            count = shading.aim(cam_rays, view.row[part], rotation, centre, depth_m, band, rays, cast, thrown)
            hit = self.embree.run(*(array[:count] for array in thrown), output=True)
            yield Rays(
                *rays,
                view.pixel[part],
                view.width[part],
                view.rounding[part],
                cast,
                hit["tfar"],
                hit["primID"],
                hit["u"],
                hit["v"],
            )


def _surfaces(
    uv: Floats,
    texture: NDArray[np.int32],
    tint: Floats,
    normal: Floats,
    light: Floats,
    atlas: Atlas,
    sky: Sky,
) -> Surfaces:
    return Surfaces(
        uv,
        texture,
        np.ascontiguousarray(tint),
        normal,
        light,
        atlas.texels,
        atlas.starts,
        atlas.sizes,
        atlas.metres,
        np.log2(atlas.sizes[:, 0] / atlas.metres).astype(np.float32),
        sky.panorama,
        sky.sun,
        sky.horizon.astype(np.float32),
    )


def _cast(scene: EmbreeScene, origins: Floats, directions: Floats) -> dict[str, NDArray[Any]]:
    """Hits of all rays, a chunk at a time."""
    parts = []
    for start in range(0, len(directions), _CHUNK):
        part = slice(start, start + _CHUNK)
        parts.append(scene.run(np.ascontiguousarray(origins[part]), directions[part], output=True))
    return {key: np.concatenate([p[key] for p in parts]) for key in ("primID", "u", "v", "tfar")}


def _pixel_grid(model: CameraModel) -> Array:
    u, v = np.meshgrid(
        np.arange(model.width_px, dtype=np.float64), np.arange(model.height_px, dtype=np.float64)
    )
    return np.stack([u.ravel(), v.ravel()], 1)


def _lens_rays(model: CameraModel, du: float, dv: float) -> tuple[Floats, NDArray[np.int32]]:
    """Unit rays through all pixel centres shifted by (du, dv) that the lens sees, and their pixel numbers."""
    rays, valid = model.unproject(_pixel_grid(model) + np.array([du, dv]))
    return rays[valid].astype(np.float32), np.flatnonzero(valid).astype(np.int32)


def _pixel_widths(model: CameraModel) -> Floats:
    """Angle (H*W,) across each pixel, radians: root of the product of the two directions."""
    grid = _pixel_grid(model)
    centre, right, below = (
        model.unproject(grid + np.array(step))[0] for step in ((0, 0), (0.25, 0), (0, 0.25))
    )
    across, down = (4 * np.linalg.norm(other - centre, axis=1) for other in (right, below))
    width = np.sqrt(across * down)
    known = np.isfinite(width)
    typical = float(np.median(width[known])) if known.any() else 1e-3
    return np.where(known, width, typical).astype(np.float32)


def _shooting_order(model: CameraModel) -> NDArray[np.int64]:
    """Rank (H*W,) of each pixel when the image is worked through block by block."""
    line, column = np.divmod(np.arange(model.height_px * model.width_px), model.width_px)
    block = line // _BLOCK_PX * model.width_px + column // _BLOCK_PX
    inside = line % _BLOCK_PX * _BLOCK_PX + column % _BLOCK_PX
    return np.asarray(block * _BLOCK_PX**2 + inside)


def _per_row(view: RenderView, world_from_rig: SE3) -> tuple[Array, Array]:
    world_from_cam = world_from_rig * view.rig_from_cam
    height = view.shape[0]
    rotation = np.broadcast_to(world_from_cam.rotation, (height, 3, 3))
    centre = np.broadcast_to(world_from_cam.translation, (height, 3))
    return np.ascontiguousarray(rotation), np.ascontiguousarray(centre)


def _empty_mirrored(count: int) -> Mirrored:
    def plain() -> Floats:
        return np.empty(count, np.float32)

    def vectors() -> Floats:
        return np.empty((count, 3), np.float32)

    return Mirrored(vectors(), vectors(), np.empty(count, np.int32), plain(), plain(), plain(), plain())
