"""A boat that stands, in pictures of open sea and its own deck: what both say of a camera that turned."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from basin_recording import LENS, SIZE
from cli_runs import run
from rigwake.calibration import save_calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry import so3
from rigwake.monitor.horizon_cue import SLOTS_PER_BLOCK, look_at_horizon
from rigwake.monitor.rig_motion import rig_motion
from rigwake.recording import Frame, Recording
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.setup import Simulation, build_recording, prepare
from rigwake.simulation.watch import calibration_of, rig_in_imu_frame
from rigwake.tracking.hull_picture import save_hull_picture
from rigwake.tracking.masks import CameraMask, pixel_grid
from rigwake.writers.write import write_recording
from test_hull_edges import deck_picture

DECK = np.zeros(SIZE[::-1], dtype=bool)
DECK[SIZE[1] * 2 // 3 :] = True


@dataclass(frozen=True, eq=False)
class SeaPictures:
    """Sky over waves, and a deck that stays where it is. up_cam: (F, 3). turn: (3,) camera axes, from `first` on."""

    model: CameraModel
    up_cam: np.ndarray
    timestamps_ns: NDArray[np.int64]
    turn: np.ndarray
    first: int
    deck: bool

    def frames(self, indices: Sequence[int] | np.ndarray, *, colour: bool = False) -> Iterator[Frame]:
        bearings, _ = self.model.unproject(pixel_grid(*SIZE))
        bearings = np.nan_to_num(bearings, nan=1.0)
        pixels, _ = self.model.project(bearings @ so3.exp(self.turn).T)
        turned = np.nan_to_num(pixels, nan=-9.0).astype(np.float32).reshape(*SIZE[::-1], 2)
        for index in map(int, indices):
            rng = np.random.default_rng(index)
            elevation = np.rad2deg(bearings @ self.up_cam[index]).reshape(SIZE[::-1])
            waves = 90 + cv2.resize(rng.normal(0, 12, (60, 80)).astype(np.float32), SIZE)
            image = (waves + (170 - waves) / (1 + np.exp(-elevation / 0.2))).astype(np.float32)
            if self.deck:
                image = np.where(DECK, deck_picture(), image)
            if index >= self.first:
                image = cv2.remap(image, turned, None, cv2.INTER_CUBIC)
            image = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
            yield Frame(index, int(self.timestamps_ns[index]), np.dstack([image] * 3) if colour else image)


def standing(seconds: float, rate_hz: float, names: Sequence[str]) -> Simulation:
    """The demo's boat at its mooring."""
    document = load_scenario("demo").model_dump()
    document["duration_s"] = seconds
    document["sea"]["hs_m"] = 0.1
    document["vessel"]["manoeuvres"] = [{"type": "standstill", "duration_s": 60}]
    small = {"width_px": SIZE[0], "height_px": SIZE[1], "params": LENS, "rate_hz": rate_hz}
    document["cameras"] = [c | small for c in document["cameras"] if c["name"] in names]
    return prepare(build_scenario(document, "standing"))


def recorded(
    simulated: Simulation, turn_deg: Sequence[float], *, since_s: float = 0.0, deck: bool = True
) -> Recording:
    """In memory. turn_deg: of `left`, rig axes, from a time on."""
    sources = {}
    for camera in simulated.scenario.cameras:
        mounted = simulated.rig.camera(camera.name)
        assert mounted.model is not None
        times = simulated.scene_times_s(camera)
        rotation = simulated.motion.world_from_rig(times).rotation @ mounted.rig_from_cam.rotation
        turn = np.deg2rad(np.array(turn_deg)) if camera.name == "left" else np.zeros(3)
        stamps = simulated.camera_stamps(camera)
        first = int(np.searchsorted(stamps, stamps[0] + round(since_s * 1e9)))
        own = mounted.rig_from_cam.rotation.T @ turn
        sources[camera.name] = SeaPictures(mounted.model, rotation[:, 2], stamps, own, first, deck)
    return build_recording(simulated, sources, Path("standing"))


def test_the_horizon_of_a_camera_that_turned_in_pictures() -> None:
    simulated = standing(60.0, 1.0, ("front", "left", "back"))
    recording = recorded(simulated, (0.3, -0.2, 0.0), since_s=30.0, deck=False)
    rig = rig_in_imu_frame(simulated.rig)
    motion = rig_motion(recording.imus["imu"])
    starts = simulated.start_ns + 10**10 * np.arange(6)
    lines = look_at_horizon(recording.cameras, rig, motion, starts)
    assert len(lines) > 0.8 * 3 * 6 * SLOTS_PER_BLOCK
    imu_from_rig = simulated.rig.rig_from_imu.inverse().rotation  # type: ignore[union-attr]
    turn = imu_from_rig @ np.array([0.3, -0.2, 0.0])
    apart = {}
    for half in (0, 1):
        by_slot = {}
        for m in np.flatnonzero(lines.slot // (3 * SLOTS_PER_BLOCK) == half):
            by_slot.setdefault(int(lines.slot[m]), {})[int(lines.camera[m])] = lines.tilt[m]
        seen = [s[1] - (s[0] + s[2]) / 2 for s in by_slot.values() if len(s) == 3]
        apart[half] = np.rad2deg(np.median(seen, axis=0))
    # a camera turned by w sees up turned by -w: up changes by up x w
    up = motion.up_rig_at(starts[:1])[0]
    np.testing.assert_allclose(apart[1] - apart[0], np.cross(up, turn), atol=0.05)


@pytest.mark.slow
def test_standing_the_own_hull_shows_a_third_of_a_degree(tmp_path: Path) -> None:
    """As a user would: a calibration with its masks, and a recording at the mooring."""
    simulated = standing(23.0, 2.0, ("front", "left"))
    write_recording(recorded(simulated, (0.2, -0.22, 0.0)), tmp_path / "today.bag", image_encoding="png")
    save_calibration(calibration_of(rig_in_imu_frame(simulated.rig)), tmp_path / "calibration.yaml")
    (tmp_path / "masks").mkdir()
    for name, stream in recorded(simulated, (0.0, 0.0, 0.0)).cameras.items():
        CameraMask(*SIZE).with_region("hull", DECK).save(tmp_path / "masks", name)
        save_hull_picture(stream, tmp_path / "masks")
    ended = run("monitor", tmp_path / "calibration.yaml", tmp_path / "today.bag")
    assert ended.code == 5, ended.words
    found = re.search(r"left DRIFTED (\S+) ± (\S+) deg against the own hull", ended.words)
    assert found is not None, ended.words
    size, std = map(float, found.groups())
    assert abs(size - np.hypot(0.2, 0.22)) < 3 * std < 0.1
    assert "front UNOBSERVABLE" in ended.words
    assert "own hull where it was" in ended.words
    assert "cue horizon:" in ended.words
    assert "rigwake recalibrate" in ended.words
