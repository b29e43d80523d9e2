"""One thing wrong in a rendered recording at a time, and what `calibrate` makes of it.

    python benchmarks/faults.py RECORDING TRUTH [--cameras front,left] [--only WORD]... [--pairs] [--rows FILE]

RECORDING: a folder as `rigwake simulate demo -o FOLDER` writes it, with its TRUTH. Each fault is written into a copy of
the recording (pictures that stay as they are are linked), calibrated, and judged: refused with the sensor named,
partial (the sensor left out and named), repaired, or calibrated; and, of what was calibrated, the errors against the
truth and the largest NEES of six. A result is sound if every camera is within 3 sigmas (NEES below 27) or the faulty
sensor was named; `SILENT` marks what is neither. What a camera stage made of the same pictures, lens and IMU is taken
again from `--cache` (a temporary folder by default), so a fault of GNSS costs only the rig. `--rows`: rows are added to
FILE as they come, and those that stand there are not run again. Ends with exit code 1 if anything was silently wrong.
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from recording_faults import (
    Faulty,
    all_lenses,
    breathing,
    clipped,
    cropped,
    doubled,
    drifting,
    drifting_fixes,
    exchanged,
    frozen,
    gnss,
    gyroscope_late,
    halved,
    held,
    held_fixes,
    images_lost,
    imu,
    jittering,
    jumping,
    knocked,
    lagging,
    late,
    limited,
    metre_grade,
    noisy,
    not_numbers,
    offset,
    order,
    outliers,
    permuted,
    quarter_turned,
    refocused,
    rounded,
    scale,
    sent_again,
    shift,
    shown_again,
    smoothed,
    stamps_of,
    still_axis,
    stuck,
    thinned,
    turned_against,
    without_rows,
    zoomed_and_exchanged,
)
from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.evaluation.rig_errors import evaluate_calibration
from rigwake.pipeline.calibration_run import calibrate
from rigwake.pipeline.camera_key import camera_key
from rigwake.pipeline.camera_processes import Finished, Progress
from rigwake.pipeline.camera_stage import (
    CameraJob,
    CameraOutcome,
    load_outcome,
    process_camera,
    stage_files,
)
from rigwake.readers.truth_files import read_true_rig, rig_in_frame

WORDS = 200  # letters of what was said, at most
NEES_LIMIT = 27.0  # of six degrees of freedom: the square of 3 sigmas along every axis at once


class CachedCameras:
    """The camera stage, but for cameras whose pictures, lens, settings and IMU were met before: those are copied."""

    def __init__(self, recording: Path, cache: Path) -> None:
        self.recording, self.cache = recording, cache

    def __call__(
        self, jobs: Sequence[CameraJob], workers: int, progress: Progress, finished: Finished
    ) -> list[CameraOutcome]:
        stored = {job.stream.name: self.cache / self._key(job) for job in jobs}
        known = {job.stream.name: job for job in jobs if stored[job.stream.name].is_dir()}
        for name, job in known.items():
            shutil.copytree(stored[name], job.out, dirs_exist_ok=True)
            finished(load_outcome(job.out, name))

        def keep(outcome: CameraOutcome) -> None:
            job = next(job for job in jobs if job.stream.name == outcome.name)
            for file in stage_files(job.out, outcome.name, odometry=job.odometry):
                if file.is_file():
                    copy = stored[outcome.name] / file.relative_to(job.out)
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(file, copy)
            finished(outcome)

        for job in jobs:  # in this process: what was compiled for one row serves the next
            if job.stream.name not in known:
                keep(process_camera(job, lambda stage, fraction: None))
        return [load_outcome(job.out, job.stream.name) for job in jobs]

    def _key(self, job: CameraJob) -> str:
        """Pictures by their name and content; a linked picture is the original and counts by where it lies."""
        sums = hashlib.sha256()
        for picture in sorted((self.recording / job.stream.name).glob("*.jpg")):
            content = str(picture.resolve()).encode() if picture.is_symlink() else picture.read_bytes()
            sums.update(picture.name.encode() + content)
        identity = {"pictures": sums.hexdigest()}
        return camera_key(job.stream, job.imu, job.config, job.odometry, identity, "")


ROTATE = cv2.ROTATE_180
# name -> (what the report must name, the fault)
FAULTS: dict[str, tuple[str, Callable[[Faulty], None]]] = {
    "none": ("", lambda f: None),
    "focal length of all cameras +3 %": ("camera", all_lenses(1.03)),
    "focal length of all cameras -3 %": ("camera", all_lenses(0.97)),
    "focal length of one camera +1.5 %": ("camera", lambda f: f.lens(f.cameras[0], 1.015)),
    "principal point of one camera 10 px off": ("camera", lambda f: f.lens(f.cameras[0], 1.0, 10.0)),
    "pictures of one camera upside down": (
        "camera", lambda f: f.change_images(f.cameras[0], lambda p: cv2.rotate(p, ROTATE))),
    "pictures of one camera mirrored": (
        "camera", lambda f: f.change_images(f.cameras[0], lambda p: cv2.flip(p, 1))),
    "pictures of one camera upside down from halfway": (
        "camera", lambda f: f.change_images(f.cameras[0], lambda p: cv2.rotate(p, ROTATE), slice(84, None))),
    "two cameras exchanged halfway": ("camera", exchanged),
    "one camera knocked by 1 deg halfway": ("camera", knocked),
    "one camera knocked by 0.3 deg halfway": ("camera", lambda f: knocked(f, 0.3)),
    "one camera frozen for a third": ("camera", frozen),
    "clock of one camera drifts by 1e-3": ("camera", lambda f: f.restamp(f.cameras[0], drifting(1e-3))),
    "clock of one camera 0.3 s off": ("", lambda f: f.restamp(f.cameras[0], late(0.3))),
    "accelerometer in g": ("accelerometer", imu(scale(slice(3, 6), 1 / 9.80665))),
    "accelerometer with the wrong sign": ("accelerometer", imu(scale(slice(3, 6), -1.0))),
    "accelerometer without gravity": ("accelerometer", imu(lambda v: np.subtract(v[:, 5], 9.81, out=v[:, 5]))),
    "accelerometer x and y exchanged": ("accelerometer", imu(order([3, 4], [4, 3]))),
    "accelerometer scale 10 %": ("accelerometer", imu(scale(slice(3, 6), 1.1))),
    "gyroscope in deg/s": ("gyroscope", imu(scale(slice(0, 3), 180 / np.pi))),
    "gyroscope scale 3 %": ("gyroscope", imu(scale(slice(0, 3), 1.03))),
    "gyroscope with the wrong sign": ("gyroscope", imu(scale(slice(0, 3), -1.0))),
    "gyroscope x and y exchanged": ("gyroscope", imu(order([0, 1], [1, 0]))),
    "gyroscope clipped": ("gyroscope", imu(clipped)),
    "IMU with z flipped": ("gyroscope", imu(scale([2, 5], -1.0))),
    "IMU with x and y exchanged": ("gyroscope", imu(order([0, 1, 3, 4], [1, 0, 4, 3]))),
    "IMU gap of 2 s": ("imu", without_rows("imu.csv", 2.0)),
    "IMU held for 2 s": ("imu", lambda f: f.edit("imu.csv", held)),
    "IMU 1 s late": ("", stamps_of("imu.csv", late(1.0))),
    "IMU clock drifts by 1e-3": ("imu", stamps_of("imu.csv", drifting(1e-3))),
    "GNSS stuck for 6 s": ("gnss", gnss(stuck(slice(40, 70)))),
    "GNSS latitude and longitude exchanged": ("gnss", gnss(order([0, 1], [1, 0]))),
    "GNSS 1 s late": ("", stamps_of("gnss.csv", late(1.0))),
    "GNSS 0.2 s late": ("", stamps_of("gnss.csv", late(0.2))),
    "GNSS jumps by 2 m": ("gnss", gnss(shift(slice(70, None), (2.0, 1.0)))),
    "GNSS jumps by 1 m and back": ("gnss", gnss(shift(slice(60, 90), (1.0, 0.5)))),
    "GNSS outliers": ("gnss", gnss(outliers)),
    "GNSS of 1 m that lasts": ("", gnss(metre_grade)),
    "GNSS distances 10 % long": ("gnss", gnss(lambda v: v.__setitem__(
        (slice(None), slice(0, 2)), v[:1, :2] + 1.1 * (v[:, :2] - v[:1, :2])))),
    "GNSS outage of 8 s": ("", without_rows("gnss.csv", 8.0)),
    "GNSS runs away by 0.2 m/s": ("gnss", gnss(drifting_fixes)),
    "GNSS stuck all the time": ("gnss", gnss(stuck(slice(0, None)))),
    "GNSS longitude with the wrong sign": ("gnss", gnss(scale([1], -1.0))),
    "one camera refocused halfway": ("camera", refocused),
    "clock of one camera jumps by 0.5 s halfway": ("camera", lambda f: f.restamp(f.cameras[0], jumping(0.5))),
    "accelerometer in milli-g": ("accelerometer", imu(scale(slice(3, 6), 1e3 / 9.80665))),
    "accelerometer 0.3 s behind the gyroscope": ("accelerometer", lagging(slice(3, 6), 0.3)),
    "gyroscope very noisy": ("gyroscope", imu(noisy(slice(0, 3), 0.2))),
    "accelerometer very noisy": ("accelerometer", imu(noisy(slice(3, 6), 3.0))),
    "IMU stamps 2 % fast": ("imu", stamps_of("imu.csv", drifting(0.02))),
    "IMU stamps twice as fast": ("imu", stamps_of("imu.csv", drifting(1.0))),
    "IMU clock jumps by 0.15 s halfway": ("imu", stamps_of("imu.csv", jumping(0.15))),
    "accelerometer x always zero": ("accelerometer", imu(scale([3], 0.0))),
    "accelerometer y nothing but noise": ("accelerometer", imu(still_axis(4))),
    "accelerometer x twice": ("accelerometer", imu(scale([3], 2.0))),
    "accelerometer bias of 3 m/s2": ("accelerometer", imu(offset([3, 4], [2.5, 1.5]))),
    "gyroscope x nothing but noise": ("gyroscope", imu(still_axis(0))),
    "gyroscope z scale 10 %": ("gyroscope", imu(scale([2], 1.1))),
    "gyroscope bias of 40 deg/s": ("gyroscope", imu(offset([0, 1, 2], [0.5, 0.1, -0.5]))),
    "gyroscope bias of 12 deg/s": ("gyroscope", imu(offset([0, 1, 2], [0.15, 0.05, -0.15]))),
    "GNSS heights in feet": ("gnss", gnss(scale([2], 1 / 0.3048))),
    "GNSS heights upside down": ("gnss", gnss(scale([2], -1.0))),
    "GNSS heights always zero": ("gnss", gnss(scale([2], 0.0))),
    "GNSS heights jump by 2 m": ("gnss", gnss(lambda v: v.__setitem__(
        (slice(70, None), 2), v[70:, 2] + 2.0))),
    "GNSS fixes sent five times": ("gnss", sent_again(5)),
    "GNSS fixes held for a second": ("gnss", gnss(held_fixes(5))),
    "GNSS in GPS time, 18 s ahead": ("gnss", stamps_of("gnss.csv", late(18.0))),
    "GNSS in local time, 2 h ahead": ("gnss", stamps_of("gnss.csv", late(7200.0))),
    "GNSS in whole metres": ("gnss", gnss(lambda v: v.__setitem__(
        (slice(None), slice(0, 2)), np.round(v[:, :2], 5)))),
    "pictures of one camera shown again": ("camera", shown_again),
    "pictures of one camera doubled": ("camera", doubled),
    "stamps of one camera 20 % fast": ("camera", lambda f: f.restamp(f.cameras[0], drifting(0.2))),
    "stamps of one camera jitter by 10 ms": ("", lambda f: f.restamp(f.cameras[0], jittering(0.01))),
    "stamps of one camera jitter by 30 ms": ("camera", lambda f: f.restamp(f.cameras[0], jittering(0.03))),
    "stamps of one camera in steps of 50 ms": ("", lambda f: f.restamp(
        f.cameras[0], lambda s: s // 50_000_000 * 50_000_000)),
    "IMU low-pass filtered over 0.1 s": ("", lambda f: f.edit("imu.csv", smoothed)),
    "accelerometer 0.1 s behind the gyroscope": ("accelerometer", lagging(slice(3, 6), 0.1)),
    "gyroscope alone low-pass filtered, 0.1 s late": ("gyroscope", gyroscope_late),
    "gyroscope in deg/s, x and y exchanged": (
        "gyroscope", imu(lambda v: v.__setitem__((slice(None), slice(0, 3)), np.rad2deg(v[:, [1, 0, 2]])))),
    "gyroscope turned by 4 deg against the accelerometer": ("gyroscope", imu(turned_against(slice(0, 3), 4.0))),
    "gyroscope range of 0.25 rad/s": ("gyroscope", imu(limited(0.25))),
    "IMU at 10 Hz": ("", thinned("imu.csv", 10)),
    "IMU stamps of another year": ("", stamps_of("imu.csv", late(4e7))),
    "IMU stamps twice each": ("", stamps_of("imu.csv", lambda s: s[np.arange(len(s)) // 2 * 2])),
    "IMU stamps in bunches of 0.2 s": ("imu", stamps_of(
        "imu.csv", lambda s: s[np.arange(len(s)) // 20 * 20] + np.arange(len(s)) % 20 * 100_000)),
    "IMU rows that are no numbers": ("", not_numbers("imu.csv", 70)),
    "GNSS rows that are no numbers": ("", not_numbers("gnss.csv", 7)),
    "GNSS stamps in whole seconds": ("", stamps_of("gnss.csv", rounded(1.0))),
    "GNSS heights of the geoid": ("", gnss(offset([2], [40.0]))),
    "GNSS position of a base 30 m off": ("", gnss(shift(slice(None), (25.0, -16.0)))),
    "stamps of one camera in steps of 0.1 s": ("", lambda f: f.restamp(f.cameras[0], rounded(0.1))),
    "every second picture of one camera lost": ("", images_lost),
    "lens files of two cameras exchanged": ("camera", zoomed_and_exchanged),
    "pictures of one camera halved against its lens": (
        "front", lambda f: f.change_images(f.cameras[0], halved)),
    "pictures of one camera cropped": ("camera", cropped),
    "pictures of one camera a quarter turned": ("camera", quarter_turned),
    "pictures of one camera exchanged with their neighbours": ("camera", permuted),
    "focal length of one camera grows by 1 %": ("camera", breathing),
}  # fmt: skip
PAIRS = (
    ("accelerometer in g", "GNSS 1 s late"),
    ("gyroscope scale 3 %", "focal length of one camera +1.5 %"),
    ("GNSS stuck for 6 s", "clock of one camera drifts by 1e-3"),
    ("IMU with z flipped", "GNSS latitude and longitude exchanged"),
    ("principal point of one camera 10 px off", "GNSS jumps by 2 m"),
)


def judged(recording: Path, truth: Path, named: list[str], cache: Path) -> str:
    """One row: what came of it, whether the faulty sensor was named, errors, NEES, and whether that is sound."""
    started = cpu_s()
    with tempfile.TemporaryDirectory() as out:
        try:
            cameras = CachedCameras(recording, cache)
            run = calibrate(recording, out, load_config(None, ()), run_cameras=cameras)
        except RigwakeError as error:
            words = str(error).lower()
            good = any(name in words for name in named)  # the first that was found ends the run
            verdict = "refused" if good else "refused, not named"
            sound = f"{'sound' if good else 'WRONG'} ({cpu_s() - started:.0f} s)"
            return f"{verdict} | {'yes' if good else 'NO'} | – | – | {sound} | {words[:WORDS]}"
        noted = [c for c in run.sensor_checks if c.hypothesis]
        words = " ".join([*(c.sentence for c in noted), *run.failed, *run.notes]).lower()
        words = words.replace("accelerations in", "accelerometer in")
        good = all(name in words for name in named)
        errors = evaluate_calibration(
            run.calibration, rig_in_frame(read_true_rig(truth), run.calibration.reference)
        )
    turn = max(e.rotation_error_deg for e in errors.cameras.values())
    shift_m = max(float(np.linalg.norm(e.translation_error_m)) for e in errors.cameras.values())
    nees = max((e.nees or 0.0) for e in errors.cameras.values())
    what = (
        "partial"
        if run.is_partial
        else "repaired"
        if any(c.action == "repaired" for c in noted)
        else "calibrated"
    )
    sound = "sound" if nees < NEES_LIMIT else "named" if good and named else "SILENT"
    figures = f"{turn:.3f} / {100 * shift_m:.1f} | {nees:.1f} | {sound} ({cpu_s() - started:.0f} s)"
    return f"{what} | {'yes' if good else 'NO'} | {figures} | {words[:WORDS]}"


def cpu_s() -> float:
    """Of this process and of those that it started."""
    used = [resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--cameras", default="front,left,right")
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--rows", type=Path)
    chosen = parser.parse_args()
    cases = [(name,) for name in FAULTS if not chosen.only or any(w in name for w in chosen.only)]
    if chosen.pairs:
        cases = list(PAIRS)
    known = {} if chosen.rows is None or not chosen.rows.exists() else rows_of(chosen.rows.read_text())
    print(
        "| wrong | outcome | named | worst deg / cm | largest NEES | |\n|---|---|---|---|---|---|", flush=True
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        cache = chosen.cache or Path(folder) / "cache"
        for number, faults in enumerate(cases):
            named = [FAULTS[name][0] for name in faults if FAULTS[name][0]]
            words = " + ".join(faults)
            if words not in known:
                faulty = Faulty(
                    chosen.recording.resolve(), Path(folder) / str(number), chosen.cameras.split(",")
                )
                for name in faults:
                    FAULTS[name][1](faulty)
                known[words] = judged(faulty.folder, chosen.truth, named, cache)
                if chosen.rows is not None:
                    with chosen.rows.open("a") as file:
                        file.write(f"| {words} | {known[words]} |\n")
                shutil.rmtree(faulty.folder)
            rows.append((named, known[words]))
            print(f"| {words} | {known[words]} |", flush=True)
    wrong = sum("SILENT" in row for _, row in rows)
    rightly = [row.split(" | ")[1] == "yes" for named, row in rows if named]
    print(f"\nsilently wrong: {wrong} of {len(rows)}; named rightly: {sum(rightly)} of {len(rightly)}")
    return int(wrong > 0)


def rows_of(text: str) -> dict[str, str]:
    """Rows of a former run by what was wrong."""
    lines = [
        line.removeprefix("| ").removesuffix(" |") for line in text.splitlines() if line.startswith("| ")
    ]
    return dict(line.split(" | ", 1) for line in lines)


if __name__ == "__main__":
    sys.exit(main())
