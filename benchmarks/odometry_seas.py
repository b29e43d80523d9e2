"""Automatic masks in calmer and rougher seas: how many of the odometry's inliers lie on water or on the own hull.

    python benchmarks/odometry_seas.py [FOLDER]

Renders short recordings of the demo scenario with other waves (some minutes each, kept in FOLDER if one is named) with
label images of every frame, runs the odometry with hull and horizon found automatically, and counts. Wanted: < 2 %.
"""

import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import yaml

from rigwake.evaluation.trajectory_errors import absolute_error
from rigwake.odometry.camera_odometry import run_camera
from rigwake.readers.open import open_recording
from rigwake.readers.trajectories import read_trajectory
from rigwake.simulation.scenario import load_scenario

SEAS = {
    "calmer": {"hs_m": 0.06, "tp_s": 2.6},
    "as the demo": {"hs_m": 0.25, "tp_s": 3.2},
    "rougher": {"hs_m": 0.6, "tp_s": 4.2},
}
CAMERAS = ("front", "right")
SECONDS, RATE_HZ = 10, 8
WATER, HULL = 180, 240


def rendered(folder: Path, name: str, sea: dict[str, float]) -> Path:
    """The recording of this sea, made if it is not there yet."""
    recording = folder / f"{name.replace(' ', '_')}.mcap"
    if not recording.exists():
        scenario = load_scenario("demo").model_dump(mode="json", exclude_none=True)
        scenario |= {"name": "sea", "duration_s": SECONDS, "sea": scenario["sea"] | sea}
        scenario["cameras"] = [c | {"rate_hz": RATE_HZ} for c in scenario["cameras"] if c["name"] in CAMERAS]
        file = recording.with_suffix(".yaml")
        file.write_text(yaml.safe_dump(scenario, sort_keys=False))
        command = [
            str(Path(sys.executable).with_name("rigwake")),
            "simulate",
            str(file),
            "-o",
            str(recording),
        ]
        subprocess.run([*command, "--truth-images", "--workers", "1"], check=True, stdout=subprocess.DEVNULL)
    return recording


def on_labels(folder: Path, result) -> np.ndarray:
    """What each inlier of the odometry lies on."""
    tracks, seen = result.tracks, []
    for frame, file in enumerate(sorted(folder.glob("*.png"), key=lambda file: int(file.stem))):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        rows = result.visual.inliers & (tracks.frame_indices == frame)
        at = np.clip(np.rint(tracks.pixels[rows]).astype(int), 0, np.array(image.shape[::-1]) - 1)
        seen.append(image[at[:, 1], at[:, 0]])
    return np.concatenate(seen)


def main() -> None:
    print("| sea | Hs m | camera | inliers | on water % | on hull % | ATE m | rotation deg | frames/CPU-s |")
    print("|---" * 9 + "|", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(temporary)
        for name, sea in SEAS.items():
            path = rendered(folder, name, sea)
            truth_folder = path.parent / f"{path.stem}_truth"
            recording = open_recording(path)
            imu, gnss = next(iter(recording.imus.values())), next(iter(recording.gnss.values()))
            for camera in CAMERAS:
                stream = recording.camera(camera)
                started = time.process_time()
                result = run_camera(stream, imu, gnss)
                cpu_s = time.process_time() - started
                seen = on_labels(truth_folder / "labels" / camera, result)
                truth = read_trajectory(truth_folder / f"truth_cam_{camera}.tum").trajectory
                truth = replace(truth, timestamps_ns=stream.timestamps_ns)
                error = absolute_error(truth, result.trajectory, alignment="se3")
                print(
                    f"| {name} | {sea['hs_m']} | {camera} | {len(seen)} | {100 * np.mean(seen == WATER):.2f} | "
                    f"{100 * np.mean(seen == HULL):.2f} | {error.rmse_m:.3f} | {error.rotation_rmse_deg:.3f} | "
                    f"{len(stream) / cpu_s:.0f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
