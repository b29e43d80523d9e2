"""Camera-IMU and camera-camera from board corners, in the solver that calibrates rigs.

    python benchmarks/imu_board.py [FOLDER OF REAL RECORDINGS]

`euroc_aprilgrid`: two cameras and an IMU moved before a board for 72 s. Every corner that a camera sees is a
landmark of that camera alone: neither that both see the same board nor the board's size or shape is used, except
that poses of the board start the estimate. Compared with the published calibration, made with the board known.
"""

from __future__ import annotations

import gzip
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from handeye_real import EUROC_CAM0_FROM_CAM1, EUROC_INTRINSICS, board_trajectory, degrees_and_mm
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.imu_noise import imu_noise_factors
from rigwake.ba.rig.initialisation import initial_rig
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustedRig, AdjustmentOptions, RigMeasurements
from rigwake.cameras.registry import camera_from_params
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.recording import ImuStream
from rigwake.tracks import Tracks

IMU_FROM_CAM0 = SE3(  # published, `T_BS` of cam0
    so3.nearest_rotation(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422],
            [0.999557249008, 0.0149672133247, 0.025715529948],
            [-0.0257744366974, 0.00375618835797, 0.999660727178],
        ]
    ),
    np.array([-0.0216401454975, -0.064676986768, 0.00981073058949]),
)
PUBLISHED = {"cam0": IMU_FROM_CAM0, "cam1": IMU_FROM_CAM0 * EUROC_CAM0_FROM_CAM1}
CORNER_STD_PX = 0.2
# many rounds: the IMU is noisier than its data sheet, and each round finds more of it
OPTIONS = AdjustmentOptions(tracks_per_second=1000, rounds=4, cross_camera=False)


def lens(camera: str):
    (fx, fy, cx, cy), (k1, k2, p1, p2) = EUROC_INTRINSICS[camera]
    return camera_from_params("pinhole", [fx, fy, cx, cy, 0.0, k1, k2, p1, p2, 0.0], 752, 480)


def corner_tracks(recordings: Path, camera: str) -> Tracks:
    """Each corner of the board as one track."""
    path = recordings / "euroc_aprilgrid" / "imu_april" / f"{camera}.csv.gz"
    with gzip.open(path, "rt") as stream:
        rows = [line.split(",") for line in stream.read().splitlines()[1:]]
    stamps = np.array([row[0] for row in rows], dtype=np.int64)
    numbers = np.array([row[1:5] for row in rows], dtype=np.float64)
    frames, frame_indices = np.unique(stamps, return_inverse=True)
    bearings, valid = lens(camera).unproject(numbers[:, 2:])
    tracks = Tracks(
        camera,
        frames,
        frame_indices.astype(np.int64),
        (4 * numbers[:, 0] + numbers[:, 1]).astype(np.int64),
        numbers[:, 2:],
        bearings,
        np.full(len(rows), CORNER_STD_PX),
    )
    return tracks.take(np.lexsort((tracks.track_ids, tracks.frame_indices))).take(valid)


def read_imu(recordings: Path) -> ImuStream:
    """With the noise densities of EuRoC's `sensor.yaml`."""
    path = recordings / "euroc_aprilgrid" / "imu_april" / "imu0.csv"
    with path.open() as stream:
        stamps = np.array([line.split(",", 1)[0] for line in stream.readlines()[1:]], dtype=np.int64)
    samples = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(1, 7))
    return ImuStream(
        "imu", stamps, samples[:, :3], samples[:, 3:],
        gyro_noise_density=1.6968e-4, accel_noise_density=2e-3, gyro_bias_walk=1.9393e-5, accel_bias_walk=3e-3,
    )  # fmt: skip


def calibrate_boards(recordings: Path) -> AdjustedRig:
    tracks = {camera: corner_tracks(recordings, camera) for camera in EUROC_INTRINSICS}
    trajectories = {
        camera: replace(board_trajectory(recordings, camera), covariances=None) for camera in EUROC_INTRINSICS
    }
    imu = read_imu(recordings)
    first = initial_rig(trajectories, {camera: lens(camera) for camera in tracks}, imu, None)
    return adjust(assemble_problem(RigMeasurements(tracks, imu), first, OPTIONS), OPTIONS)


def main() -> None:
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    recordings = Path(sys.argv[1] if len(sys.argv) > 1 else os.environ.get("RIGWAKE_DATA", beside))
    adjusted = calibrate_boards(recordings)
    problem = adjusted.solution.problem
    print("| | from published: deg | mm | offset ms |\n|---|---|---|---|")
    for camera in problem.cameras:
        turn, shift = degrees_and_mm(PUBLISHED[camera.name].inverse() * camera.rig_from_cam)
        print(f"| imu, {camera.name} | {turn:.3f} | {shift:.2f} | {1e3 * camera.time_offset_s:+.3f} |")
    a, b = (camera.rig_from_cam for camera in problem.cameras)
    turn, shift = degrees_and_mm(EUROC_CAM0_FROM_CAM1.inverse() * (a.inverse() * b))
    print(f"| cam0, cam1 | {turn:.3f} | {shift:.2f} | |")
    assert problem.imu is not None
    noise = adjusted.noise_factors | imu_noise_factors(read_imu(recordings), problem.imu)
    print(f"\n{len(problem.observations)} corners; noise against its assumed value:", end=" ")
    print(", ".join(f"{name} {factor:.1f}" for name, factor in noise.items()))


if __name__ == "__main__":
    main()
