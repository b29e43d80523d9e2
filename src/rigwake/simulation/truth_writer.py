"""The truth beside a recording: `truth.yaml`, trajectories, and label and range images on request."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from rigwake._progress import CountProgress
from rigwake._types import Array
from rigwake.atomic import atomic_path, write_text_atomic
from rigwake.geometry.se3 import SE3
from rigwake.simulation.record import SeaCache, Shot
from rigwake.simulation.render import Renderer
from rigwake.simulation.setup import Simulation, camera_topic, true_trajectories
from rigwake.writers.trajectory_writer import write_tum

_CONVENTIONS = """\
a_from_b = (quat_wxyz, translation_m): x_a = R(q) x_b + translation. Quaternions are Hamilton.
world: ENU (x east, y north, z up), metres, mean water level z=0, origin = gnss_origin_lla.
base: x bow, y port, z up. cam: optical frame, x right, y down, z forward. Pixel (0,0) = centre of the top-left pixel.
imu: angular velocity and specific force in IMU axes at the header stamp, plus bias plus white noise.
gnss: position of the antenna = p_base + R_wb * antenna_lever_arm_base_m at its header stamp.
time: clock_t0_s + t. IMU and GNSS stamps are on the truth clock. The first row of an image with header stamp s shows
the scene at truth time s + time_offset_s, its last row rolling_shutter_s later (zero exposure).
TUM files: t x y z qx qy qz qw of world_from_base or world_from_cam on the truth clock; truth_cam_*.tum: a line
per image, in order.
labels: 0 outside the image circle, 60 land, 120 sky, 180 water, 240 own hull. ranges: uint16 centimetres, 0 = none.
"""


def truth_to_dict(simulation: Simulation, known_points_world: Array) -> dict[str, Any]:
    """Plain values of `truth.yaml`."""
    scenario = simulation.scenario
    content: dict[str, Any] = {
        "conventions": _CONVENTIONS,
        "clock_t0_s": scenario.start_s,
        "cameras": {},
    }
    for camera in scenario.cameras:
        known = simulation.rig.camera(camera.name)
        content["cameras"][camera.name] = {
            "topic": camera_topic(camera),
            "model": camera.model,
            "width": camera.width_px,
            "height": camera.height_px,
            "fov_deg": camera.fov_deg,
            "intrinsics": dict(camera.params),
            "base_from_cam": _transform(known.rig_from_cam),
            "time_offset_s": known.time_offset_s,
            "rolling_shutter_s": camera.rolling_shutter_ms * 1e-3,
        }
    if scenario.imu and simulation.rig.rig_from_imu is not None:
        imu = scenario.imu
        content["imu"] = {
            "rate_hz": imu.rate_hz,
            "base_from_imu": _transform(simulation.rig.rig_from_imu),
            "gyro_noise_density": imu.gyro_noise_density,
            "accel_noise_density": imu.accel_noise_density,
            "gyro_bias_random_walk": imu.gyro_bias_walk,
            "accel_bias_random_walk": imu.accel_bias_walk,
            "gravity_world": [0.0, 0.0, -9.81],
        }
    if scenario.gnss:
        content["gnss_origin_lla"] = list(scenario.gnss.origin_lla)
        content["gnss"] = {
            "rate_hz": scenario.gnss.rate_hz,
            "antenna_lever_arm_base_m": list(scenario.gnss.position_m),
            "outages_s": [list(outage) for outage in scenario.gnss.outages_s],
        }
    content["known_points_world_m"] = [[round(float(v), 6) for v in point] for point in known_points_world]
    return content


def _transform(a_from_b: SE3) -> dict[str, list[float]]:
    return {
        "quat_wxyz": [round(float(v), 12) for v in a_from_b.quat_wxyz],
        "translation_m": [round(float(v), 12) for v in a_from_b.translation],
    }


def write_truth(simulation: Simulation, known_points_world: Array, folder: Path) -> None:
    """Write `truth.yaml`, `scenario.yaml`, `truth_base.tum` and `truth_cam_NAME.tum` into a folder."""
    content = truth_to_dict(simulation, known_points_world)
    write_text_atomic(folder / "truth.yaml", yaml.safe_dump(content, sort_keys=False, width=120))
    scenario = simulation.scenario.model_dump(mode="json", exclude_none=True)
    write_text_atomic(folder / "scenario.yaml", yaml.safe_dump(scenario, sort_keys=False, width=120))
    for name, trajectory in true_trajectories(simulation).items():
        write_tum(trajectory, folder / ("truth_base.tum" if name == "rig" else f"truth_cam_{name}.tum"))


def write_truth_images(
    simulation: Simulation, renderer: Renderer, folder: Path, progress: CountProgress
) -> None:
    """Write what each pixel's centre sees of every frame: `labels/NAME/STAMP.png`, `ranges/NAME/STAMP.png`."""
    shots = [
        Shot.prepare(simulation, renderer, i, samples=1) for i in range(len(simulation.scenario.cameras))
    ]
    total, done, seas = sum(len(shot.stamps) for shot in shots), 0, SeaCache(renderer)
    for shot in shots:
        for stamp, time in zip(
            shot.stamps.tolist(), simulation.scene_times_s(shot.camera).tolist(), strict=True
        ):
            seen = renderer.truth(shot.view, shot.row_poses(time), seas.at(time))
            centimetres = np.nan_to_num(seen.ranges_m * 100, nan=0.0, posinf=0.0)
            ranges = np.clip(centimetres, 0, 65535).astype(np.uint16)
            for kind, image in (("labels", seen.labels), ("ranges", ranges)):
                with atomic_path(folder / kind / shot.camera.name / f"{stamp}.png") as path:
                    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
            done += 1
            progress("truth images", done, total)
