"""The folder that a calibration leaves behind, made up: layout as in docs/report.md."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from calibrated_rigs import FISHEYE, boat, optical
from calibrated_rigs import camera as calibrated_camera
from rigwake.calibration import Calibration, save_calibration
from rigwake.geometry.se3 import SE3
from rigwake.tracks import TrackingReport, Tracks
from rigwake.trajectory import Trajectory
from rigwake.writers.trajectory_writer import write_tum

START_NS = 1_700_000_000_000_000_000
GOOD_CHECKS = {
    "split_half": {
        name: {
            "rotation_deg": 0.011,
            "translation_m": [0.002, -0.003, 0.006],
            "sigmas": 1.1,
            "halves": [
                {
                    "translation_m": [1.0 + k, 0.5, None],
                    "std_translation_m": [0.004, 0.005, None],
                    "std_rotation_deg": [0.01, 0.02, 0.03],
                }
                for k in (0, 1)
            ],
        }
        for name in ("front", "port", "starboard", "aft")
    },
    "hand_over": {
        "count": 214,
        "median_px": 0.71,
        "rms_px": 1.2,
        "by_pair": {"front->port": {"count": 120, "median_px": 0.6, "rms_px": 1.0}},
    },
    "observability": {"weakest": "vertical offset of aft", "condition": 153.2},
    "residuals": {"front": {"count": 1000, "rms_px": 0.4, "median_px": 0.3}},
}
PROVENANCE = {
    "inputs": [{"path": "harbour.bag", "sha256": "3f7a"}],
    "settings": {
        "cameras": 4,
        "tracking": {"front_end": "klt", "nested": {"a_setting_with_a_long_name": None}},
    },
    "versions": {"rigwake": "0.1.0", "numpy": "2.4"},
}


def circle(duration_s: float, rate_hz: float = 20.0) -> Trajectory:
    """A boat on a circuit with a little roll and pitch."""
    t = np.arange(0, duration_s, 1 / rate_hz)
    angle = 2 * np.pi * t / 60
    radius = 22 + 5 * np.sin(angle / 2)
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.1 * np.sin(1.3 * t)], axis=1)
    yaw = SE3.exp(np.stack([0 * t, 0 * t, angle + np.pi / 2, 0 * t, 0 * t, 0 * t], axis=1))
    tilt = SE3.exp(
        np.stack([0.03 * np.sin(1.9 * t), 0.02 * np.sin(1.4 * t), 0 * t, 0 * t, 0 * t, 0 * t], axis=1)
    )
    stamps = START_NS + (t * 1e9).astype(np.int64)
    return Trajectory("rig", stamps, SE3((yaw * tilt).rotation, position))


def write_folder(
    folder: Path,
    calibration: Calibration | None = None,
    duration_s: float = 60.0,
    observations: int = 2000,
    pictures_per_camera: int = 1,
    seed: int = 0,
) -> Path:
    """A complete OUT folder."""
    rng = np.random.default_rng(seed)
    if calibration is None:
        calibration = boat(checks=GOOD_CHECKS, provenance=PROVENANCE)
    save_calibration(calibration, folder / "calibration.yaml")
    rough = {n: replace(c, rig_from_cam=c.rig_from_cam.retract(rng.normal(0, 0.05, 6)))
             for n, c in calibration.cameras.items()}  # fmt: skip
    save_calibration(replace(calibration, cameras=rough), folder / "initial_rig.yaml")
    rig = circle(duration_s, 8.0)
    write_tum(rig, folder / "trajectories" / "rig.tum")
    for name, one in calibration.cameras.items():
        finite = SE3(np.nan_to_num(one.rig_from_cam.rotation), np.nan_to_num(one.rig_from_cam.translation))
        path = Trajectory(name, rig.timestamps_ns[::2], rig.world_from_body[::2] * finite)
        write_tum(path, folder / "trajectories" / f"{name}.tum")
        write_tracks(folder / "tracks" / f"{name}.npz", name, rig.timestamps_ns, observations, rng)
    write_residuals(folder / "residuals.npz", list(calibration.cameras), rig, observations, rng)
    write_adjustment(folder / "adjustment.npz", list(calibration.cameras), rig, rng)
    write_masks(folder / "masks", list(calibration.cameras))
    write_pictures(folder / "pictures", list(calibration.cameras), pictures_per_camera, rng)
    return folder


def image_points(count: int, rng: np.random.Generator) -> np.ndarray:
    """Pixels above the horizon more than below it, inside the image circle."""
    u, v = rng.normal(320, 130, count), rng.gamma(4, 50, count)
    return np.stack([np.clip(u, 0, 639), np.clip(v, 0, 479)], axis=1)


def write_tracks(path: Path, name: str, stamps: np.ndarray, count: int, rng: np.random.Generator) -> None:
    ids_in_all = max(count // 15, 1)
    keys = np.unique(rng.integers(0, len(stamps), count) * ids_in_all + rng.integers(0, ids_in_all, count))
    pairs = np.stack([keys // ids_in_all, keys % ids_in_all], axis=1)
    pixels = image_points(len(pairs), rng)
    report = TrackingReport(len(stamps) + 3, len(stamps), 1, 2, 0, ids_in_all, len(pairs), 41.0)
    bearings = np.tile([0.0, 0, 1], (len(pairs), 1))
    Tracks(name, stamps, pairs[:, 0], pairs[:, 1], pixels, bearings, np.full(len(pairs), 0.3), report).save(
        path
    )


def write_residuals(
    path: Path, names: list[str], rig: Trajectory, count: int, rng: np.random.Generator
) -> None:
    total = count * len(names)
    pixels = image_points(total, rng)
    bearings, valid = FISHEYE.unproject(pixels)
    angle_deg = np.rad2deg(np.arccos(np.clip(np.where(valid, bearings[:, 2], np.nan), -1, 1)))
    swirl = 0.002 * (pixels - [320, 240])[:, ::-1] * [1, -1]
    sigma = 0.25 + 0.003 * np.nan_to_num(angle_deg)
    residuals = swirl + rng.normal(0, 1, (total, 2)) * sigma[:, None]
    np.savez(
        path,
        camera=np.repeat(np.arange(len(names)), count),
        camera_names=np.array(names),
        timestamp_ns=rng.choice(rig.timestamps_ns, total),
        pixels=pixels,
        residuals_px=residuals,
        angle_deg=angle_deg,
    )


def write_adjustment(
    path: Path, names: list[str], rig: Trajectory, rng: np.random.Generator, landmarks: int = 600
) -> None:
    """Sensors over time and a ring of landmarks on shore; one lies very far away."""
    stamps = rig.timestamps_ns[::4]
    n, around = len(stamps), rng.uniform(0, 2 * np.pi, landmarks)
    shore = np.stack([45 * np.cos(around), 45 * np.sin(around), rng.uniform(0, 8, landmarks)], axis=1)
    shore[0] = 1e6
    np.savez_compressed(
        path,
        bias_timestamps_ns=stamps,
        gyro_bias=1e-3 + 1e-5 * rng.normal(size=(n, 3)).cumsum(axis=0),
        accel_bias=2e-2 + 1e-3 * rng.normal(size=(n, 3)).cumsum(axis=0),
        imu_timestamps_ns=stamps,
        imu_turn=2e-4 * rng.normal(size=(n, 3)),
        imu_turn_std=np.full((n, 3), 2e-4),
        imu_speed=3e-3 * rng.normal(size=(n, 3)),
        imu_speed_std=np.full((n, 3), 2e-3),
        imu_count=np.array(3 * n),
        gnss_timestamps_ns=stamps,
        gnss_off=0.02 * rng.normal(size=(n, 3)),
        gnss_lasting=np.zeros((n, 3)),
        gnss_std=np.full((n, 3), 0.02),
        gnss_count=np.array(n),
        camera_names=np.array(names),
        landmarks_world=shore.astype(np.float32),
        landmark_cameras=(np.arange(landmarks) % len(names)).astype(np.int16),
        landmark_counts=np.array([5000, landmarks]),
    )


def write_masks(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for name in names:
        v, u = np.mgrid[:480, :640]
        lens = (u - 322) ** 2 + (v - 237) ** 2 < 300**2
        hull = v > 420 - 0.0008 * (u - 320) ** 2
        water = (v > 290) & ~hull
        for suffix, region in (("", lens & ~hull & ~water), ("_hull", hull & lens), ("_water", water & lens)):
            cv2.imwrite(str(folder / f"{name}{suffix}.png"), (255 * region).astype(np.uint8))


def harbour_image(rng: np.random.Generator) -> np.ndarray:
    """Sky, a quay with houses, water, in a round image."""
    image = np.zeros((480, 640, 3), np.uint8)
    image[:230] = np.linspace((235, 190, 140), (245, 225, 205), 230)[:, None]
    image[230:] = np.linspace((120, 105, 80), (70, 60, 40), 250)[:, None]
    for left in range(0, 640, 40):
        top = int(rng.integers(150, 222))
        colour = tuple(int(x) for x in rng.integers(60, 200, 3))
        cv2.rectangle(image, (left, top), (left + int(rng.integers(20, 40)), 232), colour, -1)
    noise = rng.normal(0, 5, image.shape)
    v, u = np.mgrid[:480, :640]
    inside = ((u - 322) ** 2 + (v - 237) ** 2 < 300**2)[..., None]
    return (np.clip(image + noise, 0, 255) * inside).astype(np.uint8)


def write_pictures(folder: Path, names: list[str], per_camera: int, rng: np.random.Generator) -> None:
    folder.mkdir(parents=True)
    entries = []
    for name in names:
        for k in range(2 * per_camera):
            file = f"{name}_{k}.jpg"
            cv2.imwrite(str(folder / file), harbour_image(rng))
            entry = {"camera": name, "file": file, "timestamp_ns": START_NS + k * 10**9}
            if k % 2 == 0:
                u = np.linspace(40, 600, 60)
                line = np.stack([u, 230 + 0.0002 * (u - 320) ** 2], axis=1).round(2).tolist()
                entries.append({**entry, "kind": "horizon", "horizon_px": [*line[:30], None, *line[30:]]})
            else:
                seen = np.stack([rng.uniform(80, 560, 9), rng.uniform(150, 230, 9)], axis=1)
                points = [
                    {
                        "predicted_px": (p + rng.normal(0, 2, 2)).tolist(),
                        "observed_px": p.tolist(),
                        "from_camera": names[0],
                        "landmark": i,
                    }
                    for i, p in enumerate(seen)
                ]
                entries.append({**entry, "kind": "hand_over", "points": points})
    for k, off_px in enumerate((0.3, 6.0)):
        tiles = [harbour_image(rng)[200:231, 300:331] for _ in range(3)]
        cv2.imwrite(str(folder / f"patch_{k}.jpg"), cv2.resize(np.hstack(tiles), None, fx=5, fy=5))
        point = {
            "predicted_px": [310.0, 215.0],
            "observed_px": [310.0 + off_px, 215.0],
            "from_camera": names[0],
            "landmark": k,
        }
        entry = {"camera": names[-1], "file": f"patch_{k}.jpg", "timestamp_ns": START_NS, "tile_px": 31}
        entries.append({**entry, "kind": "patches", "points": [point]})
    (folder / "pictures.json").write_text(json.dumps(entries))


def many_cameras(count: int) -> Calibration:
    """A ring of cameras."""
    cameras = {}
    for k in range(count):
        yaw = 360 * k / count
        position = (1.6 * np.cos(np.deg2rad(yaw)), 0.8 * np.sin(np.deg2rad(yaw)), 1.2)
        cameras[f"cam{k:02d}"] = calibrated_camera(f"cam{k:02d}", optical(yaw, 10, position))
    return Calibration("base_link", cameras, checks=GOOD_CHECKS, provenance=PROVENANCE)
