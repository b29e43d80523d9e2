"""Simulated sails without pictures, and the way from their tracks to a calibrated rig, for tests of the main job."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.ba.rig.rig_values import InitialRig, RigMeasurements
from rigwake.ba.solver.rig_problem import BundleCamera
from rigwake.calibration import Calibration
from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.evaluation.rig_errors import RigErrors, evaluate_calibration
from rigwake.geometry.se3 import SE3
from rigwake.odometry.imu_alignment import with_noise
from rigwake.odometry.monocular import estimate_monocular
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.rig_stage import estimate_rig, initialise_rig
from rigwake.pipeline.stream_selection import select
from rigwake.readers.truth_files import rig_in_frame
from rigwake.recording import Recording
from rigwake.rig import Rig
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.tracks_only import SimulatedTracks, simulate_tracks
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

STILL_WATER = {"hs_m": 0.0}
STRAIGHT = {"manoeuvres": [{"type": "straight", "duration_s": 28, "speed_mps": 1.0}]}
STANDSTILL = {"manoeuvres": [{"type": "standstill", "duration_s": 28}]}


def sail(cameras: Sequence[str] = ("front", "left"), features: int = 80, **changes: Any) -> SimulatedTracks:
    """The `demo` scenario without pictures; changes: top-level keys, mappings are merged into what is there."""
    document = load_scenario("demo").model_dump()
    document["cameras"] = [c for c in document["cameras"] if c["name"] in cameras]
    document["tracking"] |= {"features": features, "landmarks": 800, "outliers": 0.005, "water": 0.0}
    for key, value in changes.items():
        both = isinstance(value, Mapping) and isinstance(document[key], dict)
        document[key] = {**document[key], **value} if both else value
    return simulate_tracks(build_scenario(document, "test"))


def with_clocks(world: SimulatedTracks, offsets_ms: Mapping[str, float]) -> SimulatedTracks:
    """The same images with stamps that are late by so much: `t_rig = t_cam + offset`."""
    shift = {name: round(ms * 1e6) for name, ms in offsets_ms.items()}
    tracks = {
        name: replace(t, timestamps_ns=t.timestamps_ns - shift.get(name, 0))
        for name, t in world.tracks.items()
    }
    return replace(world, tracks=tracks)


def first_values(
    world: SimulatedTracks, seed: int = 0, turn_deg: float = 1.0, shift_m: float = 0.05
) -> InitialRig:
    """The truth in the IMU's frame, with motion, mountings and antenna off at random."""
    recording, rng = world.recording, np.random.default_rng(seed)
    truth = rig_in_frame(recording.true_rig, "imu")
    body = recording.true_trajectories["rig"]
    off = np.concatenate([rng.normal(0, np.deg2rad(0.3), 3), rng.normal(0, 0.03, 3)])
    world_from_imu = (body.world_from_body * recording.true_rig.rig_from_imu).retract(off)
    cameras = {
        name: BundleCamera(
            name,
            stream.model,
            truth.cameras[name].rig_from_cam.retract(
                np.concatenate([rng.normal(0, np.deg2rad(turn_deg), 3), rng.normal(0, shift_m, 3)])
            ),
            free=frozenset({"rig_from_cam", "time_offset"}),
        )
        for name, stream in recording.cameras.items()
    }
    trajectory = Trajectory("imu", body.timestamps_ns, world_from_imu)
    return InitialRig(trajectory, cameras, antenna_rig=truth.antenna_rig + rng.normal(0, 0.1, 3))


def measurements(world: SimulatedTracks) -> RigMeasurements:
    """All that was measured, with the noise of the IMU known."""
    recording = world.recording
    return RigMeasurements(world.tracks, with_noise(recording.imus["imu"]), recording.gnss["gnss"])


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A calibration from simulated tracks, in the frame that it reports in."""

    calibration: Calibration
    truth: Rig
    errors: RigErrors
    failed: Mapping[str, str]
    scale_source: str


def own_odometry(world: SimulatedTracks) -> dict[str, Trajectory]:
    """Monocular odometry of every camera's tracks; cameras that fail are left out."""
    found = {}
    for name, tracks in world.tracks.items():
        model = world.recording.cameras[name].model
        try:
            found[name] = estimate_monocular(
                tracks, model, OdometryOptions(adjust_all_frames=False)
            ).trajectory
        except RigwakeError:
            continue
    return found


def true_odometry(world: SimulatedTracks, *, metric: bool) -> dict[str, Trajectory]:
    """What a perfect external odometry reports: each camera in its own first frame, in metres or in its own unit."""
    found = {}
    for index, name in enumerate(world.tracks):
        true = world.recording.true_trajectories[name]
        path = true.world_from_body[0].inverse() * true.world_from_body
        unit = 1.0 if metric else 3.0 + index
        found[name] = Trajectory(
            name,
            world.tracks[name].timestamps_ns,
            SE3(path.rotation, path.translation / unit),
            is_metric=metric,
        )
    return found


def calibrated(
    world: SimulatedTracks,
    *settings: str,
    trajectories: Mapping[str, Trajectory] | None = None,
    prior: RigPrior | None = None,
) -> Calibrated:
    """From tracks to a rig, as `rigwake calibrate` does it, without cross-camera association (it needs images)."""
    # the lenses of a simulation are exact; tests of their refinement say so
    config = load_config(None, ("adjustment.cross_camera=false", "intrinsics=fixed", *settings))
    recording: Recording = world.recording
    selection = select(recording, config)
    trajectories = own_odometry(world) if trajectories is None else trajectories
    prior = prior or RigPrior()
    first = initialise_rig(selection, trajectories, config, prior)
    tracks: Mapping[str, Tracks] = world.tracks
    rig = estimate_rig(recording, selection, tracks, first, config, prior, masks=Path("nowhere"))
    truth = rig_in_frame(recording.true_rig, rig.calibration.reference)
    errors = evaluate_calibration(rig.calibration, truth)
    return Calibrated(rig.calibration, truth, errors, first.failed, first.scale_source)
