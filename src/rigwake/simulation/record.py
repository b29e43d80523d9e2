"""Rendering a whole recording: frames in parallel, kept in a work folder, so that a run that broke off resumes."""

from __future__ import annotations

import hashlib
import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rigwake._progress import CountProgress
from rigwake._types import Floats
from rigwake.atomic import atomic_path
from rigwake.geometry.se3 import SE3
from rigwake.readers.image_files import FileFrames
from rigwake.readers.images import ImageSize
from rigwake.recording import FrameSource, Recording
from rigwake.simulation.imaging import develop, encode, vignetting
from rigwake.simulation.render import Renderer, RenderView
from rigwake.simulation.scenario import Camera, Scenario
from rigwake.simulation.scenery import KeepClear, Scenery, build_scenery
from rigwake.simulation.sea_surface import Water
from rigwake.simulation.setup import Simulation, build_recording

_RENDERER = 2  # one more whenever the same scenario gives other pictures


def build_world(simulation: Simulation) -> tuple[Scenery, Renderer]:
    """The scenery of a simulation, with free water along the boat's path, and its renderer."""
    scenario = simulation.scenario
    path = simulation.motion.spline(np.arange(0.0, scenario.duration_s + 0.25, 0.25))[:, :2]
    keep_clear = KeepClear(path, simulation.hull.response.length_m / 2 + scenario.vessel.clearance_m)
    scenery = build_scenery(scenario.scene, scenario.scene_seed, keep_clear)
    return scenery, Renderer(scenery, simulation.sea, scenario.weather, scenario.scene_seed)


def work_folder(output: Path, scenario: Scenario) -> Path:
    """Where frames wait until the recording is written: beside it, named by all that shapes a frame."""
    shaping = f"{_RENDERER} {scenario.model_dump_json()}"
    fingerprint = hashlib.sha256(shaping.encode()).hexdigest()[:12]
    return output.parent / f".{output.stem}-{fingerprint}"


def render_recording(
    simulation: Simulation, renderer: Renderer, work: Path, *, workers: int, progress: CountProgress
) -> Recording:
    """Render all frames that are not yet in `work`, then return the recording that reads them from there.

    Every frame's randomness is seeded by its camera and number: workers and interruptions change nothing.
    """
    shots = {
        camera.name: Shot.prepare(simulation, renderer, i)
        for i, camera in enumerate(simulation.scenario.cameras)
    }
    waiting = [
        (float(time), camera, int(index))
        for camera in simulation.scenario.cameras
        for index, time in enumerate(simulation.scene_times_s(camera))
        if not _frame_path(work, camera, int(shots[camera.name].stamps[index])).exists()
    ]
    waiting.sort(key=lambda task: (task[0], task[1].name))  # frames of one instant share its sea
    total = sum(len(shot.stamps) for shot in shots.values())
    for camera in simulation.scenario.cameras:
        (work / camera.name).mkdir(parents=True, exist_ok=True)
    done = total - len(waiting)
    progress("rendering", done, total)
    seas = SeaCache(renderer)

    def one(time_s: float, camera: Camera, index: int) -> None:
        encoded = shots[camera.name].take(index, time_s, seas.at(time_s))
        with atomic_path(_frame_path(work, camera, int(shots[camera.name].stamps[index]))) as path:
            path.write_bytes(encoded)

    with ThreadPoolExecutor(workers) as pool:
        try:
            for future in as_completed([pool.submit(one, *task) for task in waiting]):
                future.result()
                done += 1
                progress("rendering", done, total)
        except BaseException:  # an interrupt too: what is not yet begun is not begun
            pool.shutdown(cancel_futures=True)
            raise
    return build_recording(
        simulation, {c.name: _source(simulation, c, work) for c in simulation.scenario.cameras}, work
    )


def _frame_path(work: Path, camera: Camera, stamp_ns: int) -> Path:
    return work / camera.name / f"{stamp_ns}.jpg"


def _source(simulation: Simulation, camera: Camera, work: Path) -> FrameSource:
    stamps = simulation.camera_stamps(camera)
    names = tuple(f"{stamp}.jpg" for stamp in stamps.tolist())
    return FileFrames(work / camera.name, names, stamps, ImageSize(camera.width_px, camera.height_px))


@dataclass(frozen=True, eq=False)
class Shot:
    """One camera of a simulation, ready to take pictures."""

    simulation: Simulation
    renderer: Renderer
    camera: Camera
    number: int
    view: RenderView
    vignette: Floats
    stamps: np.ndarray

    @classmethod
    def prepare(
        cls, simulation: Simulation, renderer: Renderer, number: int, samples: int | None = None
    ) -> Shot:
        """Camera `number` of the scenario, with the scenario's rays per pixel unless told otherwise."""
        camera = simulation.scenario.cameras[number]
        mounted = simulation.rig.camera(camera.name)
        assert mounted.model is not None
        rays = samples or simulation.scenario.output.samples_per_pixel
        view = renderer.view(mounted.model, mounted.rig_from_cam, simulation.hull, rays)
        vignette = vignetting(mounted.model, camera.noise.vignette)
        return cls(simulation, renderer, camera, number, view, vignette, simulation.camera_stamps(camera))

    def row_poses(self, time_s: float) -> SE3:
        """`world_from_rig` of each image row (H,); the rows of a rolling shutter follow one another."""
        late = np.linspace(0, self.camera.rolling_shutter_ms * 1e-3, self.camera.height_px)
        return self.simulation.motion.world_from_rig(time_s + late)

    def take(self, index: int, time_s: float, water: Water) -> bytes:
        """Frame `index`, which shows the scene at `time_s`, as JPEG."""
        light = self.renderer.render(self.view, self.row_poses(time_s), water)
        phase = float(self.simulation.rng(20, self.number).uniform(0, 2 * np.pi))
        rng = self.simulation.rng(21, self.number, index)
        picture = develop(light, self.camera.noise, self.vignette, time_s, phase, rng)
        output = self.simulation.scenario.output
        return encode(picture, output.jpeg_quality, output.colour)


@dataclass(eq=False)
class SeaCache:
    """The sea at the last few instants, worked out once for all cameras."""

    renderer: Renderer
    _kept: dict[float, Water] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def at(self, time_s: float) -> Water:
        """The sea at a time."""
        with self._lock:
            if time_s not in self._kept:
                while len(self._kept) >= 4:
                    self._kept.pop(next(iter(self._kept)))
                self._kept[time_s] = self.renderer.water(time_s)
            return self._kept[time_s]
