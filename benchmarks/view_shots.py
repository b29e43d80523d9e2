"""Frame sets of simulated scenes with everything known about them, for benchmarks of the views.

Scenes that no network was trained on, about half of them close quarters. Pictures, the own hull, the attitude, and what
a camera in the viewpoint would see (classes and ranges in the grid of the level strip) are kept in a folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigwake._types import Array, Image, Mask
from rigwake.geometry.se3 import SE3
from rigwake.simulation.meshes import join, tube
from rigwake.simulation.record import Shot, build_world
from rigwake.simulation.render import Renderer
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.scenery import Scenery
from rigwake.simulation.setup import Simulation, prepare
from rigwake.simulation.shading import HULL
from rigwake.views.attitude import LevelAttitude, level_rotation
from rigwake.views.frames import FrameSet
from rigwake.views.strips import StripGrid
from rigwake.views.surround_rig import SurroundRig, surround_rig
from segmentation_scenes import labels_of, rectangle_view

GRID = StripGrid()
CLOSE = ("quay", "marina", "basin", "pier", "haven")
BUOY_RADIUS_M = 0.3
BUOY_RANGES_M = (5.0, 8.0, 11.0, 15.0, 15.0, 15.0, 20.0, 25.0, 30.0)
_BEFORE = 3  # frames: half a second
_STRAIGHT = [{"type": "straight", "duration_s": 60, "speed_mps": 1.0}]
_CHANGES: dict[str, tuple[str, dict[str, Any]]] = {
    "quay": ("quay", {}),
    "marina": ("marina", {}),
    "basin": ("quay", {
        "seed": 131, "scene": {"layout": "harbour", "size_m": [80, 40], "density": 1.6},
        "weather": {"sun_azimuth_deg": 140, "sun_elevation_deg": 14, "cloud_cover": 0.4},
    }),
    "demo": ("demo", {}),
    "bay": ("demo", {
        "seed": 57, "scene": {"layout": "bay", "size_m": [220, 180], "density": 0.8},
        "weather": {"sun_azimuth_deg": 80, "sun_elevation_deg": 35, "cloud_cover": 0.5},
    }),
    "buoys": ("demo", {
        "seed": 91, "scene": {"layout": "bay", "size_m": [240, 200], "density": 0.5},
        "sea": {"hs_m": 0.12, "tp_s": 2.6},
        "weather": {"sun_azimuth_deg": 200, "sun_elevation_deg": 30, "cloud_cover": 0.7},
        "vessel": {"hull": "catamaran", "manoeuvres": _STRAIGHT},
    }),
    "pier": ("quay", {
        "seed": 2203, "scene": {"layout": "canal", "size_m": [70, 34], "density": 1.2},
        "weather": {"sun_azimuth_deg": 250, "sun_elevation_deg": 24, "cloud_cover": 0.6},
    }),
    "haven": ("marina", {
        "seed": 3319, "weather": {"sun_azimuth_deg": 30, "sun_elevation_deg": 40, "cloud_cover": 0.3},
    }),
    "sound": ("demo", {
        "seed": 4421, "scene": {"layout": "bay", "size_m": [200, 220], "density": 0.7},
        "sea": {"hs_m": 0.2, "tp_s": 3.0},
        "weather": {"sun_azimuth_deg": 310, "sun_elevation_deg": 22, "cloud_cover": 0.3},
    }),
    "strait": ("demo", {
        "seed": 5527, "scene": {"layout": "bay", "size_m": [260, 170], "density": 0.9},
        "sea": {"hs_m": 0.15, "tp_s": 2.8},
        "weather": {"sun_azimuth_deg": 120, "sun_elevation_deg": 28, "cloud_cover": 0.6},
    }),
}  # fmt: skip
SCENES = tuple(_CHANGES)
JUDGED = ("quay", "pier", "haven", "bay", "buoys", "strait")
UNSEEN = ("pier", "haven", "strait")  # no constant was chosen on these


@dataclass(frozen=True, eq=False)
class ViewShot:
    """One frame set. images, hulls: by camera name. truth: classes (0 water, 1 obstacle, 2 sky, 255 none) that each
    camera sees, by name. labels, ranges_m: (rows, columns) from the viewpoint. buoys_level: (N, 2) ahead and to port.
    images_before, rig_from_rig_before: pictures taken a little earlier, and how the rig has moved since."""

    timestamp_ns: int
    images: Mapping[str, Image]
    hulls: Mapping[str, Mask]
    truth: Mapping[str, np.ndarray]
    attitude: LevelAttitude
    labels: np.ndarray
    ranges_m: np.ndarray
    buoys_level: Array
    images_before: Mapping[str, Image]
    rig_from_rig_before: SE3

    def frame_set(self, rig: SurroundRig) -> FrameSet:
        """The same as a frame set."""
        stack = np.stack([self.images[name] for name in rig.names])
        return FrameSet(self.timestamp_ns, rig.names, stack, {}, np.zeros(len(rig)))


def scene_rig(name: str) -> SurroundRig:
    """The true rig of a scene."""
    return surround_rig(_prepared(name).rig)


def scene_shots(name: str, count: int, folder: Path) -> list[ViewShot]:
    """`count` frame sets of a scene; rendered where the folder does not hold them yet."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}_{k}_of_{count}.npz" for k in range(count)]
    if not all(path.exists() for path in paths):
        simulation = _prepared(name)
        _, renderer = build_world(simulation)
        buoys = np.zeros((0, 2))
        if name == "buoys":
            renderer, buoys = _with_buoys(simulation)
        shots = [Shot.prepare(simulation, renderer, k) for k in range(len(simulation.scenario.cameras))]
        for k, path in enumerate(paths):
            if not path.exists():
                _take(simulation, renderer, shots, (k + 0.5) / count, buoys, path)
    return [_read(path) for path in paths]


def _prepared(name: str) -> Simulation:
    preset, changes = _CHANGES[name]
    document = load_scenario(preset).model_dump() | changes
    return prepare(build_scenario(document))


def _with_buoys(simulation: Simulation) -> tuple[Renderer, Array]:
    """The scene with buoys around the place where the boat is at first, and where they are in the world."""
    scenery, _ = build_world(simulation)
    rng = np.random.default_rng(7)
    start = simulation.motion.world_from_rig(np.array([5.0])).translation[0, :2]
    turns = rng.permutation(len(BUOY_RANGES_M)) * 2 * np.pi / len(BUOY_RANGES_M) + 0.3
    at = start + np.array(BUOY_RANGES_M)[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    skin = scenery.atlas.number("paint")
    tints = ((0.8, 0.1, 0.05), (0.1, 0.4, 0.1), (0.85, 0.6, 0.05), (0.85, 0.85, 0.85))
    meshes = [
        tube((*place, -0.4), (*place, 0.75), BUOY_RADIUS_M, BUOY_RADIUS_M, skin, tints[k % 4], 14)
        for k, place in enumerate(at)
    ]
    scenery = Scenery(join([scenery.mesh, *meshes]), scenery.atlas, scenery.known_points_world)
    scenario = simulation.scenario
    return Renderer(scenery, simulation.sea, scenario.weather, scenario.scene_seed), at


def _take(
    simulation: Simulation, renderer: Renderer, shots: list[Shot], fraction: float, buoys: Array, path: Path
) -> None:
    rig = surround_rig(simulation.rig)
    duration = 10.0 if len(buoys) else simulation.scenario.duration_s
    index = int(fraction * duration * simulation.scenario.cameras[0].rate_hz)
    time_s = float(simulation.scene_times_s(simulation.scenario.cameras[0])[index])
    water = renderer.water(time_s)
    stored: dict[str, Any] = {"timestamp_ns": int(shots[0].stamps[index])}
    earlier = max(index - _BEFORE, 0)
    time_before_s = float(simulation.scene_times_s(simulation.scenario.cameras[0])[earlier])
    water_before = renderer.water(time_before_s)
    before, world_from_rig = simulation.motion.world_from_rig(np.array([time_before_s, time_s]))
    moved = world_from_rig.inverse() * before
    stored |= {"moved_rotation": moved.rotation, "moved_translation": moved.translation}
    for shot in shots:
        name = shot.camera.name
        stored[f"jpeg_{name}"] = np.frombuffer(shot.take(index, time_s, water), np.uint8)
        jpeg_before = shot.take(earlier, time_before_s, water_before)
        stored[f"before_{name}"] = np.frombuffer(jpeg_before, np.uint8)
        model = simulation.rig.camera(name).model
        assert model is not None
        view = renderer.view(model, simulation.rig.camera(name).rig_from_cam, simulation.hull, 1)
        truth = renderer.truth(view, world_from_rig, water).labels
        stored[f"hull_{name}"], stored[f"truth_{name}"] = truth == HULL, labels_of(truth)
    up_rig = world_from_rig.rotation[2]
    level_from_rig = level_rotation(up_rig, rig.forward_rig)
    viewpoint = world_from_rig * rig.viewpoint_rig
    stand = SE3(world_from_rig.rotation @ level_from_rig.T, viewpoint)
    truth = renderer.truth(rectangle_view(GRID, GRID.columns), stand, water)
    places = np.concatenate([buoys - viewpoint[:2], np.zeros((len(buoys), 1))], axis=1) @ stand.rotation
    stored |= {
        "level_from_rig": level_from_rig, "height_m": viewpoint[2], "labels": labels_of(truth.labels),
        "ranges_m": truth.ranges_m, "buoys_level": places[:, :2],
    }  # fmt: skip
    np.savez_compressed(path, **stored)


def _read(path: Path) -> ViewShot:
    with np.load(path, allow_pickle=False) as stored:
        names = [key[5:] for key in stored.files if key.startswith("jpeg_")]
        attitude = LevelAttitude(
            stored["level_from_rig"], float(stored["height_m"]), np.deg2rad(0.05), 0.02, "trajectory"
        )
        return ViewShot(
            int(stored["timestamp_ns"]),
            {n: cv2.imdecode(stored[f"jpeg_{n}"], cv2.IMREAD_COLOR) for n in names},
            {n: stored[f"hull_{n}"] for n in names},
            {n: stored[f"truth_{n}"] for n in names},
            attitude,
            stored["labels"],
            stored["ranges_m"],
            stored["buoys_level"],
            {n: cv2.imdecode(stored[f"before_{n}"], cv2.IMREAD_COLOR) for n in names},
            SE3(stored["moved_rotation"], stored["moved_translation"]),
        )
