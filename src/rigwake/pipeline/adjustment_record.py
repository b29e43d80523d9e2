"""`adjustment.npz`: what the bundle adjustment left of the sensors over time, and its landmarks; docs/report.md.

Bounded whatever the length of the recording, plain arrays, no pickle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rigwake._types import Array, Indices
from rigwake.atomic import atomic_path
from rigwake.ba.rig.gnss_noise import antenna_off
from rigwake.ba.rig.search_proposals import camera_from_world
from rigwake.ba.solver.imu_factors import inertial_rows
from rigwake.ba.solver.linear_factors import fixes_inside
from rigwake.ba.solver.parameter_layout import layout_of
from rigwake.ba.solver.preintegration import LONGEST_BRIDGE_S
from rigwake.ba.solver.rig_problem import RigProblem

_MOST_ROWS = 2000  # of each series over time
_MOST_LANDMARKS = 4000
_LEAST_PARALLAX = np.deg2rad(1.0)  # what is seen under less is somewhere along a ray, not at a point


def write_adjustment(path: Path, problem: RigProblem) -> None:
    """Residuals of IMU and GNSS, biases and landmarks of a problem at its optimum; what it has not is left out."""
    arrays = {**_biases(problem), **_inertial(problem), **_gnss(problem), **_landmarks(problem)}
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _evenly(count: int, most: int) -> Indices:
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.int64))


def _biases(problem: RigProblem) -> dict[str, Array | Indices]:
    inertial = problem.states.inertial
    if inertial is None:
        return {}
    kept = _evenly(len(problem.states), _MOST_ROWS)
    return {
        "bias_timestamps_ns": problem.states.timestamps_ns[kept],
        "gyro_bias": inertial.gyro_bias[kept],
        "accel_bias": inertial.accel_bias[kept],
    }


def _inertial(problem: RigProblem) -> dict[str, Array | Indices]:
    """Per interval between states, in rig axes: turn (rad) and change of velocity (m/s) less what the IMU says."""
    if problem.imu is None or problem.states.inertial is None or len(problem.states) < 2:
        return {}
    stamps = problem.states.timestamps_ns
    rows = np.flatnonzero(np.diff(stamps) <= round(LONGEST_BRIDGE_S * 1e9))  # sections are not joined
    kept = rows[_evenly(len(rows), _MOST_ROWS)]
    residuals, _, _, covariances = inertial_rows(problem, layout_of(problem))
    std = np.sqrt(np.einsum("nii->ni", covariances))
    return {
        "imu_timestamps_ns": stamps[kept],
        "imu_turn": residuals[kept, 0:3],
        "imu_turn_std": std[kept, 0:3],
        "imu_speed": residuals[kept, 3:6],
        "imu_speed_std": std[kept, 3:6],
        "imu_count": np.array(len(rows)),
    }


def _gnss(problem: RigProblem) -> dict[str, Array | Indices]:
    """Per fix, ENU metres: the estimated antenna less the fix, and the part of it that lasts."""
    gnss = problem.gnss
    if gnss is None:
        return {}
    stamps, off = antenna_off(problem)
    used, _ = fixes_inside(problem)
    std = np.sqrt(np.einsum("nii->ni", gnss.covariances[used]))
    lasting, errors = np.zeros((len(stamps), 3)), problem.antenna.errors
    if errors is not None:  # estimate + error = fix: the sign of the residual
        for axis in range(3):
            lasting[:, axis] = -np.interp(stamps, errors.timestamps_ns, errors.values_enu[:, axis])
    kept = _evenly(len(stamps), _MOST_ROWS)
    return {
        "gnss_timestamps_ns": stamps[kept],
        "gnss_off": off[kept],
        "gnss_lasting": lasting[kept],
        "gnss_std": std[kept],
        "gnss_count": np.array(len(stamps)),
    }


def _landmarks(problem: RigProblem) -> dict[str, Array | Indices]:
    """Landmarks (world, metres) whose distance the views tell, with the camera (index) that saw each first."""
    observations, count = problem.observations, len(problem.landmarks)
    lowest, highest = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    first, stamp = np.full(count, -1), np.full(count, np.iinfo(np.int64).max)
    for index in range(len(problem.cameras)):
        rows = np.flatnonzero(observations.camera_indices == index)
        if not len(rows):
            continue
        seen, at = observations.landmark_indices[rows], observations.timestamps_ns[rows]
        centres = camera_from_world(problem, index, at).inverse().translation
        np.minimum.at(lowest, seen, centres)
        np.maximum.at(highest, seen, centres)
        own = np.full(count, np.iinfo(np.int64).max)
        np.minimum.at(own, seen, at)
        first[own < stamp], stamp = index, np.minimum(stamp, own)
    with np.errstate(invalid="ignore"):
        base = np.linalg.norm(highest - lowest, axis=1)
        told = np.flatnonzero(base * problem.landmarks.inverse_ranges > _LEAST_PARALLAX)
    kept = told[_evenly(len(told), _MOST_LANDMARKS)]
    return {
        "camera_names": np.array([camera.name for camera in problem.cameras]),
        "landmarks_world": problem.landmarks.points_world[kept].astype(np.float32),
        "landmark_cameras": first[kept].astype(np.int16),
        "landmark_counts": np.array([count, len(told)]),
    }
