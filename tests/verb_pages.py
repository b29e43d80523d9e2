"""One page of every verb that writes one, from small inputs, for the tests of pages."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from board_simulation import looking_poses, simulated_corners
from calibrated_rigs import boat
from cli_runs import run
from handeye_scenes import camera, trajectory, wavy
from monitor_worlds import watch
from odometry_worlds import circling, fisheye, tracks_of
from report_folders import harbour_image, write_folder
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import EstimationError
from rigwake.evaluation.rig_errors import compare_calibrations
from rigwake.evaluation.trajectory_evaluation import evaluate_trajectory
from rigwake.fleet.fleet_jobs import FleetOutcome
from rigwake.fleet.fleet_page import render_page as fleet_page
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions
from rigwake.inspection.readiness import judge
from rigwake.inspection.recording_inspection import inspect_recording
from rigwake.intrinsics.boards import parse_board
from rigwake.logbook.logbook_page import render_history
from rigwake.logbook.store import Logbook
from rigwake.monitor.monitor_page import render_page as monitor_page
from rigwake.monitor.run import monitor
from rigwake.odometry.camera_odometry import CameraOdometry
from rigwake.odometry.monocular import estimate_monocular
from rigwake.pipeline.handeye_run import run_handeye
from rigwake.pipeline.intrinsics_run import IntrinsicsRun, LensChoice, lens_of
from rigwake.recording import CameraStream, Frame, GnssStream, ImuStream, Recording
from rigwake.report import build_report
from rigwake.report.diff_page import diff_page
from rigwake.report.handeye_page import handeye_page
from rigwake.report.inspection_page import inspection_page
from rigwake.report.odometry_page import odometry_page
from rigwake.report.trajectory_page import trajectory_page
from rigwake.tracking.masks import CameraMask
from rigwake.trajectory import Trajectory
from view_scenes import HEIGHT_M, attitude, four_cameras, photograph, water_and_ring, write_rig

START_NS = 1_700_000_000_000_000_000


class DrawnFrames:
    """Frames of a harbour that is the same in all."""

    def __init__(self, stamps: np.ndarray) -> None:
        self.stamps = stamps
        self.image = harbour_image(np.random.default_rng(3))

    def frames(self, indices, *, colour: bool = False):
        for index in indices:
            grey = self.image if self.image.ndim == 2 else self.image[..., 0]
            yield Frame(int(index), int(self.stamps[index]), self.image if colour else grey)


def recording(name: str = "sail.bag") -> Recording:
    """Two cameras, an IMU with a gap, a GNSS, for twenty seconds."""
    stamps = START_NS + np.arange(200) * 100_000_000
    source = DrawnFrames(stamps)
    height, width = source.image.shape[:2]
    cameras = {
        n: CameraStream(n, stamps, source, width, height) for n in ("front", "a_very_long_camera_name")
    }
    t = np.arange(2000) * 0.01
    at = START_NS + (t * 1e9).astype(np.int64)
    kept = (t < 7) | (t > 8)
    gyro = np.stack([0.1 * np.sin(t), 0.1 * np.cos(1.3 * t), 0.3 * np.sin(0.2 * t)], axis=1)
    imu = ImuStream("imu", at[kept], gyro[kept], np.tile([0.0, 0, 9.81], (len(t), 1))[kept])
    places = np.stack([2 * t[::20], np.sin(0.3 * t[::20]), 0 * t[::20]], axis=1)
    gnss = GnssStream(
        "gps", at[::20], places, np.tile(1e-4 * np.eye(3), (len(places), 1, 1)), (54.3, 10.1, 0.0)
    )
    return Recording(Path(name), "ros1 bag", cameras, {"imu": imu}, {"gps": gnss})


def inspection() -> str:
    """Of a recording with a gap."""
    seen = inspect_recording(recording())
    return inspection_page(seen, judge(seen))


def odometry() -> str:
    """A camera up to scale, a metric one, one that failed."""
    path = circling(60)
    tracks = tracks_of(path, fisheye(), wrong_fraction=0.1)
    visual = estimate_monocular(tracks, fisheye())
    mask = CameraMask(640, 480, {"hull": np.arange(480)[:, None] > np.full((480, 640), 400)})
    front = CameraOdometry(visual.trajectory, "none", tracks, mask, visual)
    metric = Trajectory("back", tracks.timestamps_ns, path)
    back = replace(front, trajectory=metric, scale_source="gnss", visual=None, notes=("A note.",))
    cameras = {
        n: CameraStream(n, tracks.timestamps_ns, DrawnFrames(tracks.timestamps_ns), 640, 480, fisheye())
        for n in ("front", "back")
    }
    failed = EstimationError("No start.", remedy="Turn more.")
    return odometry_page(
        Recording(Path("sail.bag"), "ros1 bag", cameras), {"front": front, "back": back, "left": failed}
    )


def handeye() -> str:
    """One member on a rig that moves about all axes."""
    times = np.arange(0, 30, 0.1)
    body = wavy(times)
    reference = trajectory("imu", body, times)
    members = [trajectory("port", body * camera(90, 10, [0.4, 0.8, 1.2]), times)]
    result, checks, _ = run_handeye(reference, members, HandeyeOptions())
    return handeye_page(result, reference, members, checks)


def diff() -> str:
    """A rig whose cameras were knocked."""
    first = boat("base_link")
    rng = np.random.default_rng(1)
    moved = {
        n: replace(c, rig_from_cam=c.rig_from_cam * SE3.exp(rng.normal(0, [0.003] * 3 + [0.02] * 3)))
        for n, c in first.cameras.items()
    }
    second = replace(first, cameras=moved)
    ranges = [5.0, 20.0, 100.0]
    return diff_page(
        first, second, compare_calibrations(first, second, ranges), ranges, ("june.yaml", "july.yaml")
    )


def intrinsics() -> str:
    """A fisheye before a board, and a camera that saw none."""
    lens = camera_from_params("kb4", [200, 201, 322, 238, 0.02, -0.005, 0.001, -0.0005], 640, 480)
    rng = np.random.default_rng(0)
    board = parse_board("aprilgrid:6x6:0.044:0.3")
    seen = simulated_corners(lens, board, looking_poses(0.9, 15, rng, 0.3), 0.1, rng)
    image = np.full((480, 640), 90, np.uint8)
    run = IntrinsicsRun(
        {"front": lens_of(seen, LensChoice("kb4"), lambda name: image)},
        {"left": EstimationError("No board.")},
    )
    return run.page("board.bag")


def evaluate() -> str:
    """A trajectory a centimetre off."""
    path = circling(60)
    stamps = START_NS + np.arange(60) * 100_000_000
    truth = Trajectory("front", stamps, path)
    found = Trajectory("front", stamps, SE3(path.rotation, path.translation + 0.01))
    return trajectory_page(evaluate_trajectory(truth, found, alignment="se3"), "found.tum", "truth.tum")


def log_plot(folder: Path) -> str:
    """A logbook with two calibrations."""
    with Logbook(folder / "vessel.db", create=True) as book:
        for k in range(2):
            turn = SE3.exp(np.array([0.0, 0.0, 0.002 * k, 0.0, 0.0, 0.0]))
            rig = boat("base_link")
            cameras = {n: replace(c, rig_from_cam=c.rig_from_cam * turn) for n, c in rig.cameras.items()}
            book.add(replace(rig, cameras=cameras), START_NS + k * 86_400_000_000_000, f"day {k}")
        return render_history(book)


def fleet() -> str:
    """A fleet of three recordings, one failed."""
    outcomes = [
        FleetOutcome(
            f"day{k}", f"/recordings/a_long_folder_name_for_day_{k}.bag", status, "ferry", cause=cause
        )
        for k, (status, cause) in enumerate([("calibrated", ""), ("calibrated", ""), ("failed", "time-out")])
    ]
    return fleet_page(outcomes, 3, "fleet.csv")


def monitor_of_a_watch() -> str:
    """A minute of a simulated watch without pictures."""
    seen = watch("eights", 60.0)
    return monitor_page(monitor(seen.calibration, seen.recording, tracks=seen.tracks), seen.recording)


def seams(folder: Path) -> str:
    """Of one picture per camera of a ring of buildings on the water."""
    (folder / "pictures").mkdir()
    for name, image in photograph(four_cameras(), attitude(), water_and_ring(12.0)).items():
        cv2.imwrite(str(folder / "pictures" / f"{name}.png"), image)
    write_rig(folder / "rig.yaml")
    words = [folder / "rig.yaml", folder / "pictures", "-o", folder / "out", "--height-m", HEIGHT_M]
    ended = run("surround", *words, "--shell-m", 12, "--stabilise", "off")
    assert ended.code == 0, ended.words
    return (folder / "out" / "seams.html").read_text()


QUICK = {
    "inspect": inspection,
    "odometry": odometry,
    "handeye": handeye,
    "diff": diff,
    "intrinsics": intrinsics,
    "evaluate": evaluate,
    "fleet": fleet,
}


def write_pages(folder: Path) -> dict[str, Path]:
    """Every page, by the verb that writes it."""
    texts = {verb: make() for verb, make in QUICK.items()}
    texts |= {"log plot": log_plot(folder), "monitor": monitor_of_a_watch(), "surround": seams(folder)}
    write_folder(folder / "calibrate", duration_s=30)
    files = {"calibrate": build_report(folder / "calibrate")}
    for verb, text in texts.items():
        files[verb] = folder / f"{verb}.html"
        files[verb].write_text(text)
    return files
