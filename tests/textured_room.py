"""A small recording that calibrates, made in seconds: two cameras of the demo's boat in a room with textured walls."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake.cameras.protocol import CameraModel
from rigwake.recording import Frame
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.setup import build_recording, prepare
from rigwake.tracking.masks import pixel_grid
from rigwake.trajectory import Trajectory
from rigwake.writers.write import write_recording

SIZE = (280, 210)
LENS = {
    "fx": 88.1,
    "fy": 88.1,
    "cx": 139.6,
    "cy": 104.2,
    "k1": -0.011,
    "k2": 0.006,
    "k3": -0.0034,
    "k4": 0.0005,
}
ROOM = np.array([[-20.0, -20.0, -4.0], [20.0, 20.0, 9.0]])  # metres from the middle of the boat's way
TEXELS_PER_METRE = 6


def texture() -> NDArray[np.float32]:
    rng = np.random.default_rng(5)
    image = np.zeros((1024, 1024), np.float32)
    for cells in (32, 64, 128, 256):
        noise = rng.normal(size=(cells, cells)).astype(np.float32)
        image += cv2.resize(noise, (1024, 1024), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(128 + 45 * image, 0, 255), np.float32)


@dataclass(frozen=True, eq=False)
class Room:
    """What a camera sees of the walls, floor and ceiling, from its true trajectory."""

    model: CameraModel
    truth: Trajectory
    stamps: NDArray[np.int64]
    middle: NDArray[np.float64]

    def frames(self, indices: Sequence[int], *, colour: bool = False) -> Iterator[Frame]:
        walls = texture()
        bearings, valid = self.model.unproject(pixel_grid(*SIZE))
        for index in indices:
            at = int(np.argmin(np.abs(self.truth.timestamps_ns - self.stamps[index])))
            pose = self.truth.world_from_body[at]
            image = self._image(walls, np.nan_to_num(bearings) @ pose.rotation.T, pose.translation)
            image = np.where(valid, image, 0).reshape(SIZE[1], SIZE[0])
            image += np.random.default_rng(int(index)).normal(0, 1.5, image.shape)
            grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
            yield Frame(
                int(index), int(self.stamps[index]), np.repeat(grey[..., None], 3, 2) if colour else grey
            )

    def _image(self, walls, rays, position):
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = (np.where(rays > 0, ROOM[1], ROOM[0]) + self.middle - position) / rays
        hit = np.where(np.isfinite(hit), hit, np.inf)
        axis = np.argmin(hit, axis=1)
        reach = np.minimum(hit[np.arange(len(hit)), axis], 1e3)
        points = position + reach[:, None] * rays - self.middle
        on_wall = np.array([[1, 2], [0, 2], [0, 1]])[axis]
        u, v = (TEXELS_PER_METRE * np.take_along_axis(points, on_wall[:, k : k + 1], 1)[:, 0] for k in (0, 1))
        u, v = ((x % 1024).astype(np.float32).reshape(SIZE[1], SIZE[0]) for x in (u + 311 * axis, v))
        sampled = cv2.remap(walls, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return sampled.ravel().astype(np.float64)


def write_room(path: Path, seconds: float = 16.0, rate_hz: float = 4.0) -> Path:
    """Write the recording (`.bag`, `.mcap` or a folder)."""
    document = load_scenario("demo").model_dump()
    document["duration_s"] = seconds
    document["cameras"] = [
        c | {"width_px": SIZE[0], "height_px": SIZE[1], "params": LENS, "rate_hz": rate_hz}
        for c in document["cameras"]
        if c["name"] in ("front", "left")
    ]
    simulated = prepare(build_scenario(document, "room"))
    empty = build_recording(simulated, {c.name: None for c in simulated.scenario.cameras}, path)
    sources = {}
    for camera in simulated.scenario.cameras:
        truth = empty.true_trajectories[camera.name]
        middle = truth.world_from_body.translation.mean(axis=0) * [1, 1, 0]
        model = empty.cameras[camera.name].model
        sources[camera.name] = Room(model, truth, simulated.camera_stamps(camera), middle)
    write_recording(build_recording(simulated, sources, path), path)
    return path
