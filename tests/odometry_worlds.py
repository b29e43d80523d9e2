"""Synthetic tracks for the tests of odometry: a fisheye camera that circles between points."""

import numpy as np

from rigwake.cameras.base import CameraModel
from rigwake.cameras.catalogue import camera_from_params
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.tracks import Tracks

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
    points: int = 600,
    noise_px: float = 0.2,
    longest: int = 60,
    wrong_share: float = 0.0,
) -> Tracks:
    """What a tracker would see of points on the walls of a harbour; tracks break after `longest` frames.

    wrong_share: of tracks that wander over the image like water does.
    """
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(0, 2 * np.pi, points)
    distance = rng.uniform(15, 40, points)
    cloud = np.stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-1, 8, points)], axis=1
    )
    wrong = rng.random(points) < wrong_share
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
