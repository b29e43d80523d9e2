"""Motions and noise for the tests of hand-eye calibration and of time offsets."""

import numpy as np

from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.trajectory import Trajectory

CAMERA_AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # optical axes of a camera that looks ahead


def camera(yaw_deg: float, down_deg: float, position: list[float]) -> SE3:
    turn = so3.exp([0, 0, np.deg2rad(yaw_deg)]) @ so3.exp([0, np.deg2rad(down_deg), 0])
    return SE3(turn @ CAMERA_AXES, np.array(position))


PORT = camera(90, 15, [0.0, 1.2, 1.4])


def wavy(times_s: np.ndarray, wave_rad: float = 0.3) -> SE3:
    """World from rig: turning to both sides while rolling, pitching and heaving."""
    t = np.asarray(times_s)
    yaw = np.deg2rad(60) * np.sin(t / 4)
    turn = (
        so3.exp(np.outer(yaw, [0, 0, 1]))
        @ so3.exp(np.outer(wave_rad * np.sin(t / 1.7), [0, 1, 0]))
        @ so3.exp(np.outer(wave_rad * np.sin(t / 1.1 + 0.3), [1, 0, 0]))
    )
    return SE3(turn, np.stack([3 * t, 5 * np.sin(t / 3), np.sin(t / 0.9)], axis=1))


def planar(times_s: np.ndarray) -> SE3:
    t = np.asarray(times_s)
    turn = so3.exp(np.outer(np.deg2rad(60) * np.sin(t / 4), [0, 0, 1]))
    return SE3(turn, np.stack([3 * t, 5 * np.sin(t / 3), 0 * t], axis=1))


def straight(times_s: np.ndarray) -> SE3:
    t = np.asarray(times_s)
    return SE3(
        np.broadcast_to(np.eye(3), (len(t), 3, 3)), np.stack([3 * t + 0.2 * np.sin(t), 0 * t, 0 * t], 1)
    )


def standstill(times_s: np.ndarray) -> SE3:
    return SE3.identity((len(times_s),))


def spin(times_s: np.ndarray) -> SE3:
    t = np.asarray(times_s)
    return SE3(so3.exp(np.outer(np.deg2rad(90) * np.sin(t / 4), [0, 0, 1])), np.zeros((len(t), 3)))


def drifting(poses: SE3, rotation_std: float, translation_std: float, rng: np.random.Generator) -> SE3:
    """Independent errors of the increments."""
    increments = (poses[:-1].inverse() * poses[1:]).retract(
        _errors(len(poses) - 1, rotation_std, translation_std, rng)
    )
    out = [poses[0]]
    for k in range(len(increments)):
        out.append(out[-1] * increments[k])
    return SE3(np.stack([x.rotation for x in out]), np.stack([x.translation for x in out]))


def jittered(poses: SE3, rotation_std: float, translation_std: float, rng: np.random.Generator) -> SE3:
    """Independent errors of the poses."""
    return poses.retract(_errors(len(poses), rotation_std, translation_std, rng))


def lasting(
    poses: SE3, rotation_std: float, translation_std: float, memory: float, rng: np.random.Generator
) -> SE3:
    """Errors of the poses that each keep the fraction `memory` of the one before."""
    errors = _errors(len(poses), rotation_std, translation_std, rng)
    for k in range(1, len(errors)):
        errors[k] = memory * errors[k - 1] + np.sqrt(1 - memory**2) * errors[k]
    return poses.retract(errors)


def _errors(count: int, rotation_std: float, translation_std: float, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(count, 6)) * np.repeat([rotation_std, translation_std], 3)


def trajectory(name: str, poses: SE3, times_s: np.ndarray, **fields) -> Trajectory:
    return Trajectory(name, np.round(np.asarray(times_s) * 1e9).astype(np.int64), poses, **fields)
