"""A scenario made ready: everything checked, the boat's motion known, nothing rendered yet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_dict
from rigwake.errors import CameraError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.recording import CameraStream, FrameSource, Recording
from rigwake.rig import Rig, RigCamera
from rigwake.simulation.hull_mesh import Hull, build_hull
from rigwake.simulation.scenario import Camera, Scenario
from rigwake.simulation.scene_layout import SceneLayout, build_layout
from rigwake.simulation.sensors import (
    imu_mounting,
    mounted,
    regular_stamps,
    seconds_since,
    simulate_attitude,
    simulate_gnss,
    simulate_imu,
)
from rigwake.simulation.vessel import VesselMotion, build_motion
from rigwake.simulation.waves import WaveField, build_wave_field
from rigwake.trajectory import Trajectory

_BODY_FROM_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # REP-103: z forward is x of the body
_TRUTH_HZ = 100.0


@dataclass(frozen=True, eq=False)
class Simulation:
    """A checked scenario with its sea, motion and rig; times of `motion` count from `start_ns`."""

    scenario: Scenario
    layout: SceneLayout
    hull: Hull
    sea: WaveField
    motion: VesselMotion
    rig: Rig

    @property
    def start_ns(self) -> int:
        """Stamp of the first instant."""
        return round(self.scenario.start_s * 1e9)

    def camera_stamps(self, camera: Camera) -> Stamps:
        """(N,) stamps of a camera's frames, on its own clock."""
        return regular_stamps(camera.rate_hz, self.scenario.duration_s, self.start_ns)

    def scene_times_s(self, camera: Camera) -> Array:
        """(N,) seconds since the start at which a camera's frames (their first row) show the scene."""
        return seconds_since(self.camera_stamps(camera), self.start_ns) + camera.time_offset_ms * 1e-3

    def rng(self, *purpose: int) -> np.random.Generator:
        """A generator of its own for each purpose, fixed by the scenario's seed."""
        return np.random.default_rng([self.scenario.seed, *purpose])


def prepare(scenario: Scenario) -> Simulation:
    """Check a scenario and work out the motion.

    Raises UsageError that names the field: a lens that its model refuses, a field of view over the model's
    limit, a camera inside the boat, a path that leaves the water.
    """
    hull = build_hull(scenario.vessel.hull)
    cameras = {camera.name: _rig_camera(i, camera, hull) for i, camera in enumerate(scenario.cameras)}
    layout = build_layout(scenario.scene)
    sea = build_wave_field(scenario.sea, scenario.seed)
    motion = build_motion(scenario.vessel, scenario.duration_s, hull.response, layout, sea)
    rig = Rig(
        "base_link",
        cameras,
        antenna_rig=scenario.gnss.position_m if scenario.gnss else None,
        rig_from_imu=imu_mounting(scenario.imu) if scenario.imu else None,
    )
    return Simulation(scenario, layout, hull, sea, motion, rig)


def camera_model(index: int, camera: Camera) -> CameraModel:
    """The lens of a scenario's camera; UsageError names the field that its model refuses."""
    try:
        return camera_from_dict(
            {
                "model": camera.model,
                "width_px": camera.width_px,
                "height_px": camera.height_px,
                "params": camera.params,
                "max_angle_deg": camera.fov_deg / 2,
            }
        )
    except CameraError as error:
        raise UsageError(
            f"cameras[{index}] ({camera.name}): model, params or fov_deg: {error.cause}",
            consequence="Nothing was simulated.",
            remedy=error.remedy or "Correct the lens.",
        ) from error


def _rig_camera(index: int, camera: Camera, hull: Hull) -> RigCamera:
    position = np.array(camera.position_m)
    if hull.contains(position):
        raise UsageError(
            f"cameras[{index}].position_m: {camera.name} sits inside the boat, at {camera.position_m}.",
            consequence="It would see nothing but the hull, so nothing was simulated.",
            remedy="Move it outside.",
        )
    rig_from_body = mounted(position, camera.yaw_deg, camera.pitch_deg, camera.roll_deg)
    return RigCamera(
        camera.name,
        SE3(rig_from_body.rotation @ _BODY_FROM_OPTICAL, position),
        camera_model(index, camera),
        camera.time_offset_ms * 1e-3,
        topic=camera_topic(camera),
    )


def camera_topic(camera: Camera) -> str:
    """Where a recording holds the images."""
    return f"/cameras/{camera.name}/image_raw/compressed"


def build_recording(simulation: Simulation, sources: dict[str, FrameSource], path: Path) -> Recording:
    """The `Recording` value: sensors sampled, truth attached, frames from `sources` by camera name."""
    scenario, motion, start_ns = simulation.scenario, simulation.motion, simulation.start_ns
    streams = {}
    for camera in scenario.cameras:
        model = simulation.rig.camera(camera.name).model
        assert model is not None
        streams[camera.name] = CameraStream(
            camera.name,
            simulation.camera_stamps(camera),
            sources[camera.name],
            camera.width_px,
            camera.height_px,
            model,
            topic=camera_topic(camera),
            frame_id=f"{camera.name}_optical",
        )
    imus, gnss, attitudes = {}, {}, {}
    if scenario.imu:
        imus["imu"] = simulate_imu(motion, scenario.imu, start_ns, simulation.rng(1), "/imu/data")
    if scenario.gnss:
        gnss["gnss"] = simulate_gnss(motion, scenario.gnss, start_ns, simulation.rng(2), "/gnss/fix")
    if scenario.attitude:
        attitudes["attitude"] = simulate_attitude(
            motion, scenario.attitude, start_ns, simulation.rng(3), "/attitude"
        )
    return Recording(
        path,
        "simulation",
        streams,
        imus,
        gnss,
        attitudes,
        true_rig=simulation.rig,
        true_trajectories=true_trajectories(simulation),
    )


def true_trajectories(simulation: Simulation) -> dict[str, Trajectory]:
    """The rig at 100 Hz (`rig`), and each camera at the scene time of each of its frames, on the true clock."""
    start = simulation.start_ns
    stamps = regular_stamps(_TRUTH_HZ, simulation.scenario.duration_s, start)
    known = {"rig": Trajectory("rig", stamps, simulation.motion.world_from_rig(seconds_since(stamps, start)))}
    for camera in simulation.scenario.cameras:
        times = simulation.scene_times_s(camera)
        world_from_cam = (
            simulation.motion.world_from_rig(times) * simulation.rig.camera(camera.name).rig_from_cam
        )
        shown = start + np.round(times * 1e9).astype(np.int64)
        known[camera.name] = Trajectory(camera.name, shown, world_from_cam)
    return known
