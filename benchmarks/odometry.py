"""Odometry on real and simulated recordings: ours, the frame-to-frame baseline and pycolmap on the same frames.

    python benchmarks/odometry.py [kitti] [stereo] [harbour] [euroc] [speed] [--peers]

Data: RIGWAKE_DATA, or ../shared/data beside the project. ATE in metres after the named alignment; CPU seconds of
this process, tracking included. A path given in RIGWAKE_KITTI (the full odometry data set) adds its sequences 00-10.
"""

import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

from rigwake._types import Array, Indices
from rigwake.errors import RigwakeError
from rigwake.evaluation.trajectory_errors import absolute_error, associate, kitti_error
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.odometry.camera_odometry import CameraOdometryOptions, run_camera
from rigwake.odometry.metric import metric_start
from rigwake.odometry.monocular import estimate_monocular
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.odometry.self_calibration import estimate_refining_lens
from rigwake.odometry.smoother import smooth
from rigwake.odometry.stereo import estimate_stereo
from rigwake.odometry.thesis_odometry import ThesisOptions, estimate_thesis
from rigwake.readers.open import open_recording
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import CameraStream
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.tracking_options import FrontEndName, TrackingOptions
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

DATA = Path(os.environ.get("RIGWAKE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
SEEDS = 3
FOCAL_FRACTION = 0.995
KITTI_PEER_STEP, HARBOUR_PEER_STEP = (
    2,
    4,
)  # the peer, of much slower mappers, gets every second or fourth frame
HEADER = (
    "| recording | method | frames | alignment | ATE m | ATE % of path | rotation deg | CPU s | fps |\n"
    + "|---" * 9
    + "|"
)


def row(
    name: str, method: str, truth: Trajectory, found: Trajectory, frames: int, cpu_s: float, kind: str
) -> None:
    error = absolute_error(truth, found, alignment=kind)
    fraction = 100 * error.rmse_m / truth.path_length
    print(
        f"| {name} | {method} | {len(found)}/{frames} | {kind} | {error.rmse_m:.3f} | {fraction:.2f} | "
        f"{error.rotation_rmse_deg:.3f} | {cpu_s:.1f} | {frames / cpu_s:.0f} |",
        flush=True,
    )


def drift_row(name: str, truth: Trajectory, found: Trajectory) -> None:
    """KITTI's figures, the rotation drift from first to last, and the errors over 100 m about the camera's axes."""
    metric = scaled(truth, found)
    drift = kitti_error(truth, metric)
    errors, turns = section_errors(truth, found)
    whole, _ = section_errors(truth, found, None)
    slope = (errors[:, 1] @ turns[:, 1]) / (turns[:, 1] @ turns[:, 1])
    pitch, yaw, roll = np.sqrt(np.mean(errors**2, axis=0))
    print(
        f"<!-- {name}: t_rel {drift.t_rel_percent:.2f} %, r_rel {drift.r_rel_deg_per_100m:.3f} deg/100 m over "
        f"{drift.sequences} sections (100 m: RMS of pitch {pitch:.3f}, yaw {yaw:.3f}, roll {roll:.3f}, yaw error "
        f"{100 * slope:+.2f} % of the turn), first to last {np.linalg.norm(whole):.3f} deg/100 m -->",
        flush=True,
    )


def section_errors(
    truth: Trajectory, found: Trajectory, length_m: float | None = 100.0
) -> tuple[Array, Array]:
    """Rotation errors and true turns, degrees per 100 m about the axes of the camera at its start, of the sections
    of that length that begin at every tenth pose; of the whole path for None."""
    i, j = associate(truth, found)
    true, estimate = truth.world_from_body[i], found.world_from_body[j]
    travelled = np.r_[0, np.cumsum(np.linalg.norm(np.diff(true.translation, axis=0), axis=1))]
    starts, ends = np.array([0]), np.array([len(i) - 1])
    if length_m is not None:
        starts = np.arange(0, len(i), 10)
        ends = np.searchsorted(travelled, travelled[starts] + length_m)
        starts, ends = starts[ends < len(i)], ends[ends < len(i)]
    turn = true[starts].inverse() * true[ends]
    error = (estimate[starts].inverse() * estimate[ends]) * turn.inverse()
    per_100m = 100 / (travelled[ends] - travelled[starts])[:, None]
    return np.rad2deg(so3.log(error.rotation)) * per_100m, np.rad2deg(so3.log(turn.rotation)) * per_100m


def agreement_rows(name: str, truth: Trajectory, results: dict[str, Trajectory]) -> None:
    """How far each method's rotations are from ours over 100 m, and how far both have the same errors there."""
    ours = results["rigwake"]
    for method, found in results.items():
        if method == "rigwake":
            continue
        i, j = associate(ours, found)
        pair = (errors_at(truth, ours, i), errors_at(truth, found, j))
        apart = np.linalg.norm(pair[0] - pair[1], axis=1).mean()
        correlation = np.corrcoef(pair[0].ravel(), pair[1].ravel())[0, 1]
        print(
            f"<!-- {name} {method}: rotations over 100 m {apart:.3f} deg from rigwake's, "
            f"errors correlated by {correlation:.2f} -->",
            flush=True,
        )


def errors_at(truth: Trajectory, found: Trajectory, index: Indices) -> Array:
    """Rotation errors over 100 m of the path through the poses `index`."""
    return section_errors(truth, poses_at(found, index))[0]


def poses_at(path: Trajectory, index: Indices) -> Trajectory:
    return Trajectory(
        path.name, path.timestamps_ns[index], path.world_from_body[index], is_metric=path.is_metric
    )


def scaled(truth: Trajectory, found: Trajectory) -> Trajectory:
    """`found` in the units of the truth."""
    scale = absolute_error(truth, found, alignment="sim3").scale
    poses = found.world_from_body
    return replace(found, world_from_body=SE3(poses.rotation, scale * poses.translation))


def monocular(name: str, stream: CameraStream, truth: Trajectory, peers: bool) -> None:
    started = time.process_time()
    tracks = track_camera(stream)
    tracking_s = time.process_time() - started
    ours: dict[str, Trajectory] = {}
    for method, estimate in (
        ("frame to frame (seed)", frame_to_frame),
        ("rigwake, lens as given", lens_as_given),
        ("rigwake", lens_refined),
        (f"rigwake, focal length {100 * (FOCAL_FRACTION - 1):+.1f} %", another_focal_length),
    ):
        runs = []
        for seed in range(SEEDS):
            started = time.process_time()
            found = estimate(tracks, stream, seed)
            cpu_s = tracking_s + time.process_time() - started
            runs.append((absolute_error(truth, found, alignment="sim3").rmse_m, cpu_s, found))
        _, cpu_s, found = sorted(runs, key=lambda run: run[0])[SEEDS // 2]
        row(name, f"{method}, median of {SEEDS} seeds", truth, found, len(stream), cpu_s, "sim3")
        drift_row(f"{name} {method}", truth, found)
        ours[method] = found
    if peers:
        found_by_peer = pycolmap_rows(name, stream, truth, KITTI_PEER_STEP, refine=(False, True))
        for method, found in found_by_peer.items():
            drift_row(f"{name} {method}", truth, found)
        ours |= found_by_peer
        agreement_rows(name, truth, ours)


def frame_to_frame(tracks: Tracks, stream: CameraStream, seed: int) -> Trajectory:
    return estimate_thesis(tracks, stream.model, ThesisOptions(seed=seed))


def lens_as_given(tracks: Tracks, stream: CameraStream, seed: int) -> Trajectory:
    return estimate_monocular(tracks, stream.model, OdometryOptions(seed=seed)).trajectory


def lens_refined(tracks: Tracks, stream: CameraStream, seed: int) -> Trajectory:
    options = OdometryOptions(seed=seed)
    visual, lens = estimate_refining_lens(
        tracks, stream.model, lambda seen, camera: estimate_monocular(seen, camera, options)
    )
    if lens is not None:
        print(f"<!-- lens refined by {lens.shift_px:.2f} px, cost lowered by {100 * lens.gain:.1f} % -->")
    return visual.trajectory


def another_focal_length(tracks: Tracks, stream: CameraStream, seed: int) -> Trajectory:
    """What the rotations owe to the focal length given: the same with another one."""
    lens = stream.model
    fraction = np.array([FOCAL_FRACTION if name in ("fx", "fy") else 1.0 for name in lens.param_names])
    other = lens.with_params(fraction * np.array(lens.params))
    bearings, _ = other.unproject(tracks.pixels)
    return lens_refined(replace(tracks, bearings_cam=bearings), replace(stream, model=other), seed)


def pycolmap_rows(
    name: str, stream: CameraStream, truth: Trajectory, step: int, refine: tuple[bool, ...]
) -> dict[str, Trajectory]:
    """Rows of COLMAP's mappers on every `step`-th frame; what they found, by method."""
    from colmap_odometry import map_camera  # pycolmap is an optional peer

    results, indices = {}, np.arange(0, len(stream), step)
    for mapping in map_camera(stream, indices, refine):
        method = f"{mapping.method}, frames in steps of {step}"
        if mapping.trajectory is None:
            print(f"| {name} | {method} | 0/{len(indices)} | | | | | {mapping.cpu_s:.1f} | |", flush=True)
            continue
        row(name, method, truth, mapping.trajectory, len(indices), mapping.cpu_s, "sim3")
        results[method] = mapping.trajectory
    return results


def kitti(peers: bool) -> None:
    recording = open_recording(DATA / "kitti_03_first_300")
    stream = next(iter(recording.cameras.values()))
    monocular("kitti_03_first_300", stream, recording.true_trajectories[stream.name], peers)
    full = os.environ.get("RIGWAKE_KITTI")
    for folder in sorted(Path(full, "sequences").glob("[01][0-9]")) if full else []:
        recording = open_recording(folder)
        if recording.true_trajectories:
            stream = next(iter(recording.cameras.values()))
            monocular(f"KITTI {folder.name}", stream, recording.true_trajectories[stream.name], peers)


def stereo(peers: bool) -> None:
    recording = open_recording(DATA / "kitti_00_stereo_20")
    first, second = list(recording.cameras.values())[:2]
    assert recording.true_rig is not None
    mounting = [recording.true_rig.camera(c.name).rig_from_cam for c in (first, second)]
    second_from_first = mounting[1].inverse() * mounting[0]
    started = time.process_time()
    found = estimate_stereo(track_camera(first), first, second, second_from_first)
    cpu_s = time.process_time() - started
    truth = recording.true_trajectories[first.name]
    for start in (0, 14):
        a, b = truth.world_from_body[start:], found.world_from_body[start:]
        error = (b[0].inverse() * b[-1]).translation - (a[0].inverse() * a[-1]).translation
        length = np.linalg.norm(np.diff(a.translation, axis=0), axis=1).sum()
        print(
            f"| kitti_00_stereo_20 from frame {start} | rigwake stereo | {len(b)} | none | end point "
            f"{np.linalg.norm(error):.3f} | {100 * np.linalg.norm(error) / length:.2f} | | {cpu_s:.1f} | |",
            flush=True,
        )


def harbour(peers: bool) -> None:
    recording = open_recording(DATA / "harbour_a" / "harbour_a.bag")
    imu, gnss = next(iter(recording.imus.values())), next(iter(recording.gnss.values()))
    for name, stream in recording.cameras.items():
        file = read_trajectory(DATA / "harbour_a" / f"truth_cam_{name}.tum")
        truth = replace(file.trajectory, timestamps_ns=stream.timestamps_ns)
        started = time.process_time()
        result = run_camera(stream, imu, gnss)
        cpu_s = time.process_time() - started
        row(
            f"harbour_a {name}",
            "rigwake vision + IMU + GNSS",
            truth,
            result.trajectory,
            len(stream),
            cpu_s,
            "se3",
        )
        assert result.visual is not None
        assert stream.model is not None
        row(
            f"harbour_a {name}", "rigwake vision", truth, result.visual.trajectory, len(stream), cpu_s, "sim3"
        )
        start = metric_start(result.visual.trajectory, imu)
        inertial = smooth(result.tracks, stream.model, result.visual, start, imu)
        row(
            f"harbour_a {name}", "rigwake vision + IMU", truth, inertial.trajectory, len(stream), cpu_s, "se3"
        )
        seed = estimate_thesis(result.tracks, stream.model)
        row(f"harbour_a {name}", "frame to frame (seed)", truth, seed, len(stream), cpu_s, "sim3")
        labels(name, result)
        if peers:
            pycolmap_rows(f"harbour_a {name}", stream, truth, HARBOUR_PEER_STEP, refine=(False,))
            visual = result.visual
            same = np.flatnonzero(visual.frame_indices % HARBOUR_PEER_STEP == 0)
            found = poses_at(visual.trajectory, same)
            method = "rigwake vision, of all frames the peer's"
            row(f"harbour_a {name}", method, truth, found, len(found), cpu_s, "sim3")


def speed(peers: bool) -> None:
    """Frames per second of vision + IMU on one camera, by front end; CPU and wall time of both cores."""
    recording = open_recording(DATA / "harbour_a" / "harbour_a.bag")
    stream, imu = recording.camera("front"), next(iter(recording.imus.values()))
    print("| front end | frames/s | frames/CPU-s | tracking only: frames/s |\n|---|---|---|---|", flush=True)
    for front_end in get_args(FrontEndName):
        options = CameraOdometryOptions(tracking=TrackingOptions(front_end=front_end))
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        result = run_camera(stream, imu, options=options)
        wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
        tracking = result.tracks.report.frames_per_second
        print(
            f"| {front_end} | {len(stream) / wall_s:.1f} | {len(stream) / cpu_s:.1f} | {tracking:.1f} |",
            flush=True,
        )


def labels(name: str, result) -> None:
    """Fraction of inliers on water and hull in the first frame, where labels are known."""
    image = cv2.imread(str(DATA / "harbour_a" / f"truth_labels_{name}.png"), cv2.IMREAD_GRAYSCALE)
    first = result.visual.inliers & (result.tracks.frame_indices < 3)
    at = np.clip(
        np.rint(result.tracks.pixels[first]).astype(int), 0, [image.shape[1] - 1, image.shape[0] - 1]
    )
    seen = image[at[:, 1], at[:, 0]]
    print(
        f"<!-- harbour_a {name}: inliers of the first three frames on water {np.mean(seen == 180):.3f}, "
        f"on the hull {np.mean(seen == 240):.3f}, of {len(seen)} -->",
        flush=True,
    )


def euroc(peers: bool) -> None:
    recording = open_recording(DATA / "euroc_v101_micro")
    stream = recording.camera("cam0")
    started = time.process_time()
    imu = next(iter(recording.imus.values()))
    result = run_camera(stream, imu, options=CameraOdometryOptions(hull=False, horizon="off"))
    cpu_s = time.process_time() - started
    path = DATA / "euroc_v101_micro" / "GT" / "V1_01_easy.csv"
    values = np.genfromtxt(path, delimiter=",", comments="#")
    body = SE3.from_quat_wxyz(values[:, 4:8], values[:, 1:4])
    stamps = np.genfromtxt(path, delimiter=",", comments="#", usecols=0, dtype=np.int64)
    ends = [int(np.argmin(np.abs(stamps - s))) for s in result.trajectory.timestamps_ns[[0, -1]]]
    truth = np.linalg.norm(so3.log(body.rotation[ends[0]].T @ body.rotation[ends[1]]))
    R = result.trajectory.world_from_body.rotation
    found = np.linalg.norm(so3.log(R[0].T @ R[-1]))
    print(
        f"| euroc_v101_micro cam0 | rigwake | {len(result.trajectory)}/{len(stream)} | none | | | turned "
        f"{np.rad2deg(found):.3f}, truth {np.rad2deg(truth):.3f} | {cpu_s:.1f} | {len(stream) / cpu_s:.0f} |"
    )


SECTIONS = {"kitti": kitti, "stereo": stereo, "harbour": harbour, "euroc": euroc, "speed": speed}


def main() -> None:
    chosen = [a for a in sys.argv[1:] if not a.startswith("-")] or list(SECTIONS)
    print(HEADER, flush=True)
    for name in chosen:
        try:
            SECTIONS[name]("--peers" in sys.argv)
        except RigwakeError as error:
            print(f"| {name} | failed: {error} |" + " |" * 7, flush=True)


if __name__ == "__main__":
    main()
