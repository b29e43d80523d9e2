"""Intrinsic calibration of the EuRoC AprilGrid corners, against the published intrinsics and OpenCV.

Same corners for all (RMS distance over all of them, nothing left out); `held-out` is the RMS of views that the
calibration did not see. Needs RIGWAKE_DATA, the folder of the real recordings.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import cv2
import numpy as np

from rigwake.cameras.formats.camera_files import read_camera
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry.se3 import stack
from rigwake.intrinsics.board_adjustment import BoardEstimate, adjust, residuals
from rigwake.intrinsics.board_calibration import calibrate
from rigwake.intrinsics.board_observations import BoardObservations, read_corner_file
from rigwake.intrinsics.initial_guess import stacked, view_pose
from rigwake.intrinsics.select import cross_validate

SIZE = 752, 480


def rms_of(camera: CameraModel, observations: BoardObservations) -> float:
    """RMS distance of all corners with this camera, the board's poses fitted by plain least squares."""
    poses = [view_pose(camera, view) for view in observations.views]
    start = BoardEstimate(camera, stack([pose for pose in poses if pose is not None]))
    corners = stacked(observations)
    estimate, _ = adjust(start, corners, np.zeros(len(camera.params), dtype=np.bool_))
    return float(np.sqrt(np.mean(np.sum(residuals(estimate, corners)[0] ** 2, axis=1))))


def opencv(observations: BoardObservations, flags: int) -> tuple[float, np.ndarray, float]:
    points = [view.points_board.astype(np.float32) for view in observations.views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in observations.views]
    start = time.process_time()
    rms, K, _, _, _ = cv2.calibrateCamera(points, pixels, SIZE, None, None, flags=flags)
    return rms, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), time.process_time() - start


def row(label: str, focal: np.ndarray, stds: np.ndarray | None, rms: float, held: str, seconds: str) -> str:
    required_ratio = [""] * 4 if stds is None else [f" ± {std:.2f}" for std in stds]
    numbers = " | ".join(f"{value:.2f}{std}" for value, std in zip(focal, required_ratio, strict=True))
    return f"| {label} | {numbers} | {rms:.3f} | {held} | {seconds} |"


def report(folder: Path, camera_name: str) -> None:
    published = read_camera(folder / f"euroc_v101_micro/mav0/{camera_name}/sensor.yaml")
    observations = read_corner_file(folder / f"euroc_aprilgrid/cam_april/{camera_name}.csv.gz", *SIZE)
    pixels = np.concatenate([view.pixels for view in observations.views])
    print(
        f"\n{camera_name}: {len(pixels)} corners in {len(observations.views)} views, columns "
        f"{pixels[:, 0].min():.0f} to {pixels[:, 0].max():.0f} of {SIZE[0]}, rows {pixels[:, 1].min():.0f} to "
        f"{pixels[:, 1].max():.0f} of {SIZE[1]}\n"
    )
    print(
        "| calibration | fx | fy | cx | cy | RMS px | held-out px | CPU s |\n|---|---|---|---|---|---|---|---|"
    )
    print(row("published (radtan4)", published.params[:4], None, rms_of(published, observations), "", ""))
    for label, flags in (("OpenCV radtan4", cv2.CALIB_FIX_K3), ("OpenCV radtan5", 0)):
        rms, focal, seconds = opencv(observations, flags)
        print(row(label, focal, None, rms, "", f"{seconds:.1f}"))
    held = {
        s.model: f"{s.held_out_px:.3f}" for s in cross_validate(observations, ["pinhole", "kb4", "rational"])
    }
    for label, model, free in (
        ("rigwake pinhole (radtan4)", "pinhole", ()),
        ("rigwake pinhole (radtan5)", "pinhole", ("k3",)),
        ("rigwake kb4", "kb4", ()),
        ("rigwake rational", "rational", ()),
    ):
        start = time.process_time()
        result = calibrate(observations, model, free=free)
        seconds = time.process_time() - start
        stds = np.array(list(result.stds.values())[:4])
        rms = rms_of(result.camera, observations)
        print(row(label, result.camera.params[:4], stds, rms, "" if free else held[model], f"{seconds:.1f}"))


def main() -> None:
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    folder = Path(os.environ.get("RIGWAKE_DATA", beside))
    if not folder.is_dir():
        print("no real recordings here: set RIGWAKE_DATA to their folder")
        return
    for camera_name in ("cam0", "cam1"):
        report(folder, camera_name)


if __name__ == "__main__":
    main()
