"""Odometry on real and simulated recordings: ours, the frame-to-frame baseline and pycolmap on the same frames.

    python benchmarks/odometry.py [kitti] [stereo] [harbour] [euroc] [speed] [--peers]

Data: RIGWAKE_DATA, or ../shared/data beside the project. ATE in metres after the named alignment; CPU seconds of
this process, tracking included. A path given in RIGWAKE_KITTI (the full odometry data set) adds its sequences 00-10.
"""

import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

from rigwake.cameras.base import CameraModel
from rigwake.errors import RigwakeError
from rigwake.evaluate.trajectories import absolute_error, kitti_error
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.odometry.camera import CameraOdometryOptions, run_camera
from rigwake.odometry.metric import metric_start
from rigwake.odometry.monocular import estimate_monocular
from rigwake.odometry.options import OdometryOptions
from rigwake.odometry.seed import SeedOptions, estimate_seed
from rigwake.odometry.self_calibration import estimate_refining_lens
from rigwake.odometry.smoother import smooth
from rigwake.odometry.stereo import estimate_stereo
from rigwake.readers.open import open_recording
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import CameraStream
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.options import FrontEndName, TrackingOptions
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

DATA = Path(os.environ.get("RIGWAKE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
SEEDS = 3
PEER_FEATURES = 2000  # of pycolmap, per image
HEADER = (
    "| recording | method | frames | alignment | ATE m | ATE % of path | rotation deg | CPU s | fps |\n"
    + "|---" * 9
    + "|"
)


def row(
    name: str, method: str, truth: Trajectory, found: Trajectory, frames: int, cpu_s: float, kind: str
) -> None:
    error = absolute_error(truth, found, alignment=kind)
    share = 100 * error.rmse_m / truth.path_length
    print(
        f"| {name} | {method} | {len(found)}/{frames} | {kind} | {error.rmse_m:.3f} | {share:.2f} | "
        f"{error.rotation_rmse_deg:.3f} | {cpu_s:.1f} | {frames / cpu_s:.0f} |",
        flush=True,
    )


def drift_row(name: str, truth: Trajectory, found: Trajectory, scale: float) -> None:
    metric = replace(
        found, world_from_body=SE3(found.world_from_body.rotation, scale * found.world_from_body.translation)
    )
    drift = kitti_error(truth, metric)
    print(
        f"<!-- {name}: t_rel {drift.t_rel_percent:.2f} %, r_rel {drift.r_rel_deg_per_100m:.3f} deg/100 m -->",
        flush=True,
    )


def monocular(name: str, stream: CameraStream, truth: Trajectory, peers: bool) -> None:
    started = time.process_time()
    tracks = track_camera(stream)
    tracking_s = time.process_time() - started
    for method, estimate in (
        ("frame to frame (seed)", frame_to_frame),
        ("rigwake, lens as given", lens_as_given),
        ("rigwake", lens_refined),
    ):
        runs = []
        for seed in range(SEEDS):
            started = time.process_time()
            found = estimate(tracks, stream, seed)
            cpu_s = tracking_s + time.process_time() - started
            runs.append((absolute_error(truth, found, alignment="sim3").rmse_m, cpu_s, found))
        _, cpu_s, found = sorted(runs, key=lambda run: run[0])[SEEDS // 2]
        row(name, f"{method}, median of {SEEDS} seeds", truth, found, len(stream), cpu_s, "sim3")
        drift_row(f"{name} {method}", truth, found, absolute_error(truth, found, alignment="sim3").scale)
    if peers:
        pycolmap_row(name, stream, truth, refine=False)
        pycolmap_row(name, stream, truth, refine=True)


def frame_to_frame(tracks: Tracks, stream: CameraStream, seed: int) -> Trajectory:
    return estimate_seed(tracks, stream.model, SeedOptions(seed=seed))


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


def pycolmap_row(name: str, stream: CameraStream, truth: Trajectory, refine: bool) -> None:
    """COLMAP's incremental mapper on the same frames: SIFT on the CPU, sequential matching, focal length held.

    refine: whether it refines the distortion, too.
    """
    import pycolmap

    with tempfile.TemporaryDirectory() as folder:
        images, database = Path(folder) / "images", Path(folder) / "database.db"
        images.mkdir()
        for frame in stream.frames():
            cv2.imwrite(str(images / f"{frame.index:06d}.png"), frame.image)
        model, params = colmap_camera(stream.model)
        started = time.process_time()
        pycolmap.extract_features(
            database,
            images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(camera_model=model, camera_params=params),
            extraction_options={"sift": {"max_num_features": PEER_FEATURES}},
            device=pycolmap.Device.cpu,
        )
        pycolmap.match_sequential(database, device=pycolmap.Device.cpu)
        options = pycolmap.IncrementalPipelineOptions(
            ba_refine_focal_length=False, ba_refine_extra_params=refine, multiple_models=False
        )
        models = pycolmap.incremental_mapping(database, images, folder, options)
        cpu_s = time.process_time() - started
    method = "pycolmap incremental, " + ("distortion refined" if refine else "lens as given")
    best = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    if best is None:
        print(f"| {name} | {method} | 0/{len(stream)} | | | | | {cpu_s:.1f} | |", flush=True)
        return
    placed = sorted((int(Path(i.name).stem), i.cam_from_world()) for i in best.images.values() if i.has_pose)
    cam_from_world = SE3.from_matrix(np.stack([pose.matrix() for _, pose in placed]))
    stamps = stream.timestamps_ns[[index for index, _ in placed]]
    found = Trajectory(stream.name, stamps, cam_from_world.inverse(), is_metric=False)
    row(name, method, truth, found, len(stream), cpu_s, "sim3")
    drift_row(f"{name} {method}", truth, found, absolute_error(truth, found, alignment="sim3").scale)


def colmap_camera(model: CameraModel) -> tuple[str, str]:
    """COLMAP's name of the lens and its parameters; its first pixel has its centre at one half."""
    values = dict(zip(model.param_names, model.params, strict=True))
    extra = ("k1", "k2", "k3", "k4") if model.model == "kb4" else ("k1", "k2", "p1", "p2")
    shift = {"cx": 0.5, "cy": 0.5}
    names = ("fx", "fy", "cx", "cy", *extra)
    params = ",".join(str(values[n] + shift.get(n, 0.0)) for n in names)
    return "OPENCV_FISHEYE" if model.model == "kb4" else "OPENCV", params


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
        seed = estimate_seed(result.tracks, stream.model)
        row(f"harbour_a {name}", "frame to frame (seed)", truth, seed, len(stream), cpu_s, "sim3")
        labels(name, result)
        if peers:
            pycolmap_row(f"harbour_a {name}", stream, truth, refine=False)


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
    """Share of inliers on water and hull in the first frame, where labels are known."""
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
    result = run_camera(stream, imu, options=CameraOdometryOptions(hull=False, horizon=False))
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
