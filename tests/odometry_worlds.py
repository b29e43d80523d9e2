"""Synthetic tracks for the tests of odometry: a fisheye camera that circles between points."""

import numpy as np

from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.geometry import so3
from rigwake.geometry.interpolate import TransformSpline
from rigwake.geometry.se3 import SE3
from rigwake.recording import GnssStream, ImuStream
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

FRAME_NS = 100_000_000


def fisheye() -> CameraModel:
    return camera_from_params("kb4", [200, 200, 320, 240, 0, 0, 0, 0], 640, 480, np.deg2rad(95))


def circling(frames: int, radius: float = 8.0, seconds_per_turn: float = 40.0) -> SE3:
    """`world_from_cam` of a camera that looks along its path, level, rolling and heaving a little."""
    t = np.arange(frames) * FRAME_NS * 1e-9
    angle = 2 * np.pi * t / seconds_per_turn
    heave = 0.1 * np.sin(2 * np.pi * t / 3.1)
    centres = np.stack([radius * np.cos(angle), radius * np.sin(angle), heave], axis=1)
    zero = np.zeros(frames)
    heading = so3.exp(np.stack([zero, zero, angle + np.pi / 2], axis=1))
    roll = so3.exp(
        np.stack([0.05 * np.sin(2 * np.pi * t / 2.7), 0.03 * np.cos(2 * np.pi * t / 3.7), zero], axis=1)
    )
    rig_from_cam = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return SE3(heading @ roll @ rig_from_cam, centres)


def tracks_of(
    world_from_cam: SE3,
    camera: CameraModel,
    *,
    seed: int = 0,
    points: int = 350,
    noise_px: float = 0.2,
    longest: int = 60,
    wrong_fraction: float = 0.0,
) -> Tracks:
    """What a tracker would see of points on the walls of a harbour; tracks break after `longest` frames.

    wrong_fraction: of tracks that wander over the image like water does.
    """
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(0, 2 * np.pi, points)
    distance = rng.uniform(15, 40, points)
    cloud = np.stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-1, 8, points)], axis=1
    )
    wrong = rng.random(points) < wrong_fraction
    drift = rng.normal(0, 4.0, (points, 2))
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for f in range(len(world_from_cam)):
        pixels, valid = camera.project(world_from_cam[f].inverse() * cloud)
        pixels = pixels + rng.normal(0, noise_px, pixels.shape)
        phase = (f + np.arange(points)) % longest
        pixels[wrong] += drift[wrong] * phase[wrong, None]
        inside = valid & (pixels > 5).all(1) & (pixels < [635, 475]).all(1)
        ids = np.arange(points) * 10_000 + (f + np.arange(points)) // longest
        columns[0].append(np.full(inside.sum(), f))
        columns[1].append(ids[inside])
        columns[2].append(pixels[inside])
        columns[3].append(camera.unproject(pixels[inside])[0])
    frame, track, pixels, bearings = (np.concatenate(c) for c in columns)
    kept = np.isfinite(bearings).all(axis=1)
    stamps = 1_000_000_000 + np.arange(len(world_from_cam)) * FRAME_NS
    return Tracks(
        "front", stamps, frame[kept], track[kept], pixels[kept], bearings[kept], np.full(kept.sum(), noise_px)
    )


RIG_FROM_CAM = SE3.exp(np.array([0.3, -1.1, 0.9, 0.4, -0.2, 0.6]))
ANTENNA_RIG = np.array([-0.6, 0.3, 0.8])
GYRO_BIAS = np.array([0.004, -0.002, 0.003])
ACCEL_BIAS = np.array([0.05, -0.03, 0.04])
TIME_OFFSET_S = 0.023


def swaying(timestamps_ns: np.ndarray) -> SE3:
    """`world_from_rig` of a boat that turns at changing speed while waves roll and pitch it."""
    t = (timestamps_ns - timestamps_ns[0]) * 1e-9
    angle = 0.15 * t + 0.3 * np.sin(0.5 * t)
    centres = np.stack([9 * np.cos(angle) + 0.5 * t, 9 * np.sin(angle), 0.1 * np.sin(2.1 * t)], axis=1)
    zero = np.zeros(len(t))
    heading = so3.exp(np.stack([zero, zero, angle + np.pi / 2], axis=1))
    sway = so3.exp(np.stack([0.06 * np.sin(2.3 * t), 0.04 * np.sin(1.7 * t + 1), zero], axis=1))
    return SE3(heading @ sway, centres)


def sensors_of(seconds: float = 30.0, seed: int = 0) -> tuple[ImuStream, GnssStream]:
    """IMU at 100 Hz in rig axes and GNSS at 5 Hz on the swaying boat."""
    rng = np.random.default_rng(seed)
    stamps = 5_000_000_000 + np.arange(round(seconds * 100)) * 10_000_000
    padded = np.concatenate([stamps[:1] - 10_000_000, stamps, stamps[-1:] + 10_000_000])
    # the same boat a little earlier and later: `swaying` counts from its first stamp
    path = swaying(np.arange(padded[0], padded[-1] + 1, 10_000_000))
    spline = TransformSpline(padded, path)
    R = path.rotation[1:-1]
    force = np.einsum("nji,nj->ni", R, spline.acceleration_world(stamps) + np.array([0, 0, 9.81]))
    n = len(stamps)
    half_ns = 1_000_000
    before, after = spline.at(stamps - half_ns).rotation, spline.at(stamps + half_ns).rotation
    rates = so3.log(np.swapaxes(before, 1, 2) @ after) / (2e-9 * half_ns)
    imu = ImuStream(
        "imu",
        stamps,
        rates + GYRO_BIAS + rng.normal(0, 1.5e-3, (n, 3)),
        force + ACCEL_BIAS + rng.normal(0, 0.02, (n, 3)),
    )
    fixes = stamps[::20]
    antenna = spline.at(fixes) * np.tile(ANTENNA_RIG, (len(fixes), 1))
    covariances = np.tile(np.eye(3) * 0.02**2, (len(fixes), 1, 1))
    gnss = GnssStream(
        "gnss", fixes, antenna + rng.normal(0, 0.02, antenna.shape), covariances, (57.0, 11.0, 0.0)
    )
    return imu, gnss


def rig_path(seconds: float = 30.0) -> Trajectory:
    """The truth at 10 Hz, on the rig's clock, well inside the sensors' time."""
    first = 5_000_000_000 - 10_000_000
    every = first + np.arange(round(seconds * 100)) * 10_000_000
    chosen = np.arange(30, len(every) - 30, 10)
    return Trajectory("rig", every[chosen], swaying(every)[chosen])


def visual_path(seconds: float = 30.0, scale: float = 0.37) -> Trajectory:
    """What monocular odometry would make of it: camera's clock, own origin and axes, unknown unit."""
    truth = rig_path(seconds)
    world_from_cam = truth.world_from_body * RIG_FROM_CAM
    in_first = world_from_cam[0].inverse() * world_from_cam
    stamps = truth.timestamps_ns - round(TIME_OFFSET_S * 1e9)
    return Trajectory("front", stamps, SE3(in_first.rotation, in_first.translation * scale), is_metric=False)
