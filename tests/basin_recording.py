"""A small recording with pictures in seconds: the demo's boat in a basin whose round wall carries a random texture.

Two fisheyes of 320 x 240 at 4 Hz with time offsets, an IMU and GNSS; no water, no own boat in view. Everything but the
pictures is the simulator's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry.se3 import SE3
from rigwake.recording import Frame, Recording
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.setup import Simulation, build_recording, prepare
from rigwake.tracking.masks import pixel_grid
from tracking_scene import random_texture

SIZE = (320, 240)
LENS = {
    "fx": 100.6,
    "fy": 100.7,
    "cx": 160.9,
    "cy": 118.7,
    "k1": -0.011,
    "k2": 0.006,
    "k3": -0.0034,
    "k4": 0.0005,
}
OFFSETS_MS = {"front": 24.0, "left": -17.0}
_WALL_M, _HEIGHT_M = 24.0, 40.0  # radius of the wall about the boat's circuit, height that the texture spans


def basin(seconds: float = 16.0, rate_hz: float = 4.0) -> Simulation:
    """The demo's motion with two small cameras whose clocks are off."""
    document = load_scenario("demo").model_dump()
    document["duration_s"] = seconds
    document["cameras"] = [
        c
        | {"width_px": SIZE[0], "height_px": SIZE[1], "params": LENS, "rate_hz": rate_hz}
        | {"time_offset_ms": OFFSETS_MS[c["name"]]}
        for c in document["cameras"]
        if c["name"] in OFFSETS_MS
    ]
    return prepare(build_scenario(document, "basin"))


@cache
def _wall() -> NDArray[np.float32]:
    """The texture, with its first columns once more at its end."""
    texture = random_texture(0)
    return np.concatenate([texture, texture[:, :2]], axis=1)


@dataclass(frozen=True, eq=False)
class BasinPictures:
    """What one camera sees of the wall about `centre_world`: (F,) `world_from_cam`, one ray per pixel."""

    model: CameraModel
    world_from_cam: SE3
    timestamps_ns: NDArray[np.int64]
    centre_world: Array

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for index in indices:
            image = self._image(int(index))
            yield Frame(
                int(index), int(self.timestamps_ns[index]), np.dstack([image] * 3) if colour else image
            )

    @cached_property
    def rays(self) -> tuple[Array, NDArray[np.bool_]]:
        """One bearing per pixel, and which pixels the lens reaches."""
        return self.model.unproject(pixel_grid(*SIZE))

    def _image(self, index: int) -> Image:
        bearings, valid = self.rays
        ray = np.nan_to_num(bearings, nan=0.5) @ self.world_from_cam.rotation[index].T
        origin = self.world_from_cam.translation[index] - self.centre_world
        a = np.maximum(ray[:, 0] ** 2 + ray[:, 1] ** 2, 1e-9)
        b = ray[:, :2] @ origin[:2]
        reach = (-b + np.sqrt(b * b - a * (origin[:2] @ origin[:2] - _WALL_M**2))) / a
        point = origin + ray * reach[:, None]
        texture = _wall()
        rows, columns = texture.shape[0], texture.shape[1] - 2
        column = np.arctan2(point[:, 1], point[:, 0]) / (2 * np.pi) * columns % columns
        row = np.clip(0.5 + point[:, 2] / _HEIGHT_M, 0, 1) * (rows - 1)
        seen = cv2.remap(
            texture,
            column.reshape(SIZE[::-1]).astype(np.float32),
            row.reshape(SIZE[::-1]).astype(np.float32),
            cv2.INTER_LINEAR,
        )
        noise = np.random.default_rng(index).normal(0, 1.0, seen.shape)
        seen = cv2.GaussianBlur(seen * valid.reshape(SIZE[::-1]), (0, 0), 0.7)
        return np.clip(np.rint(seen + noise), 0, 255).astype(np.uint8)


def basin_recording(simulated: Simulation, path: Path) -> Recording:
    """Pictures, IMU and GNSS of the basin as a recording in memory."""
    centre = simulated.motion.world_from_rig(
        np.linspace(0, simulated.scenario.duration_s, 50)
    ).translation.mean(axis=0)
    sources = {}
    for camera in simulated.scenario.cameras:
        mounted = simulated.rig.camera(camera.name)
        assert mounted.model is not None
        world_from_cam = (
            simulated.motion.world_from_rig(simulated.scene_times_s(camera)) * mounted.rig_from_cam
        )
        sources[camera.name] = BasinPictures(
            mounted.model, world_from_cam, simulated.camera_stamps(camera), centre
        )
    return build_recording(simulated, sources, path)
