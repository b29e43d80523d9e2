"""A rig of four fisheyes above a patterned world, drawn exactly: for tests of the views."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from calibrated_rigs import FISHEYE, optical
from rigwake._types import Array, Image
from rigwake.geometry import so3
from rigwake.rig import Rig, RigCamera
from rigwake.tracking.masks import pixel_grid
from rigwake.views.attitude import LevelAttitude, level_rotation
from rigwake.views.surround_rig import SurroundRig, surround_rig

HEIGHT_M = 1.9
PLACES = {
    "front": (0.0, 15.0, (1.0, 0.0, 1.93)),
    "left": (90.0, 14.0, (0.0, 0.95, 1.88)),
    "back": (180.0, 15.0, (-1.0, 0.0, 1.95)),
    "right": (-91.0, 16.0, (0.0, -0.95, 1.9)),
}


def four_cameras(rotation_error_deg: dict[str, tuple[float, float, float]] | None = None) -> SurroundRig:
    """Cameras 1.4 m apart; rotation_error_deg: turns about each camera's own axes."""
    cameras = {}
    for name, (yaw, pitch, position) in PLACES.items():
        error = np.deg2rad((rotation_error_deg or {}).get(name, (0.0, 0.0, 0.0)))
        place = optical(yaw, pitch, position).retract(np.concatenate([error, np.zeros(3)]))
        cameras[name] = RigCamera(name, place, FISHEYE)
    return surround_rig(Rig("base_link", cameras))


def attitude(roll_deg: float = 0.0, pitch_deg: float = 0.0, height_m: float = HEIGHT_M) -> LevelAttitude:
    """Rolled to starboard, then pitched bow down."""
    level_from_rig = so3.exp(np.deg2rad([0.0, pitch_deg, 0.0])) @ so3.exp(np.deg2rad([roll_deg, 0.0, 0.0]))
    up_rig = level_from_rig[2]
    return LevelAttitude(level_rotation(up_rig, np.array([1.0, 0.0, 0.0])), height_m, source="trajectory")


def photograph(
    rig: SurroundRig, stand: LevelAttitude, colour: Callable[[Array, Array], Array], supersample: int = 1
) -> dict[str, Image]:
    """What the cameras see: `colour(origins, directions)` gives (N, 3) BGR of rays in the level frame."""
    images = {}
    for name, model, cam_from_level in zip(
        rig.names, rig.models, rig.cam_from_level(stand.level_from_rig), strict=True
    ):
        level_from_cam = cam_from_level.inverse()
        total = np.zeros((model.height_px * model.width_px, 3))
        offsets = (np.arange(supersample) + 0.5) / supersample - 0.5
        for du in offsets:
            for dv in offsets:
                bearings, valid = model.unproject(
                    pixel_grid(model.width_px, model.height_px) + np.array([du, dv])
                )
                rays = bearings[valid] @ level_from_cam.rotation.T
                total[valid] += colour(np.broadcast_to(level_from_cam.translation, rays.shape), rays)
        picture = np.clip(np.round(total / supersample**2), 0, 255).astype(np.uint8)
        images[name] = picture.reshape(model.height_px, model.width_px, 3)
    return images


def water_and_ring(radius_m: float = 12.0, is_mottled: bool = False) -> Callable[[Array, Array], Array]:
    """A chequered water plane, a striped or mottled ring of 4 m height that stands on it, and a smooth sky."""
    height_m = HEIGHT_M

    def colour(origins: Array, rays: Array) -> Array:
        down = np.minimum(rays[:, 2], -1e-9)
        to_water = (-height_m - origins[:, 2]) / down
        water = origins + rays * to_water[:, None]
        a = (rays[:, :2] ** 2).sum(1)
        b = (origins[:, :2] * rays[:, :2]).sum(1)
        c = (origins[:, :2] ** 2).sum(1) - radius_m**2
        to_ring = (-b + np.sqrt(b * b - a * c)) / a
        ring = origins + rays * to_ring[:, None]
        azimuth = np.arctan2(ring[:, 1], ring[:, 0])
        above = ring[:, 2] + height_m
        stripes = 120 + 50 * np.sin(60 * azimuth) + 40 * np.sin(2.1 * above + 25 * azimuth)
        if is_mottled:
            stripes = 40 + 160 * _noise(azimuth * 48 / np.pi, above * 40 / radius_m)
        waves = 90 + 30 * np.sin(2.5 * water[:, 0]) * np.sin(2.5 * water[:, 1])
        sky = 200 + 20 * np.sin(3 * rays[:, 2])
        on_water = (rays[:, 2] < 0) & (to_water < to_ring)
        on_ring = ~on_water & (above < 4.0)
        grey = np.where(on_water, waves, np.where(on_ring, stripes, sky))
        return np.asarray(np.stack([grey, 0.9 * grey, 0.8 * grey], axis=1))

    return colour


def _noise(x: Array, y: Array) -> Array:
    """Smooth random texture in [0, 1] on a lattice of unit cells, of period 96 in x."""
    lattice = np.random.default_rng(8).random((64, 96))
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    fy, fx = y - i, x - j
    fy, fx = fy * fy * (3 - 2 * fy), fx * fx * (3 - 2 * fx)

    def at(row: Array, column: Array) -> Array:
        return lattice[row % 64, column % 96]

    top = at(i, j) * (1 - fx) + at(i, j + 1) * fx
    bottom = at(i + 1, j) * (1 - fx) + at(i + 1, j + 1) * fx
    return np.asarray(top * (1 - fy) + bottom * fy)


def write_rig(path: Path, names: dict[str, str] | None = None, width: int = 640) -> None:
    """The file of `four_cameras`; names: other names of its cameras."""
    rig = four_cameras()
    lines = ["reference: base_link", "cameras:"]
    for index, name in enumerate(rig.names):
        place = rig.rig_from_cam[index]
        params = dict(zip(rig.models[index].param_names, rig.models[index].params.tolist(), strict=True))
        lines += [
            f"  {(names or {}).get(name, name)}:",
            f"    camera: {{model: kb4, width_px: {width}, height_px: 480, params: {json.dumps(params)}}}",
            "    rig_from_cam:",
            f"      quat_wxyz: {place.quat_wxyz.tolist()}",
            f"      translation_m: {place.translation.tolist()}",
        ]
    path.write_text("\n".join(lines))
