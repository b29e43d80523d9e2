"""One thing wrong in a rendered recording at a time, and what `calibrate` makes of it.

    python benchmarks/faults.py RECORDING TRUTH [--cameras front,left] [--only WORD]... [--pairs]

RECORDING: a folder as `rigwake simulate demo -o FOLDER` writes it, with its TRUTH. Each fault is written into a copy of
the recording (pictures that stay as they are are linked), calibrated, and judged: refused with the sensor named,
partial (the sensor left out and named), repaired, or calibrated; and, of what was calibrated, the errors against the
truth and the largest NEES of six. A result is sound if every camera is within 3 sigmas (NEES below 27) or the faulty
sensor was named; `SILENT` marks what is neither. What a camera stage made of the same pictures, lens and IMU is taken
again from `--cache` (a temporary folder by default), so a fault of GNSS costs only the rig. Ends with exit code 1 if
anything was silently wrong.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.evaluation.rig_errors import evaluate_calibration
from rigwake.pipeline.calibration_run import calibrate
from rigwake.pipeline.camera_key import camera_key
from rigwake.pipeline.camera_processes import Finished, Progress, process_cameras
from rigwake.pipeline.camera_stage import CameraJob, CameraOutcome, load_outcome, stage_files
from rigwake.readers.truth_files import read_true_rig, rig_in_frame

Table = NDArray[np.float64]
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

        fresh = [job for job in jobs if job.stream.name not in known]
        if fresh:
            process_cameras(fresh, workers, progress, keep)
        return [load_outcome(job.out, job.stream.name) for job in jobs]

    def _key(self, job: CameraJob) -> str:
        """Pictures by their name and content; a linked picture is the original and counts by where it lies."""
        sums = hashlib.sha256()
        for picture in sorted((self.recording / job.stream.name).glob("*.jpg")):
            content = str(picture.resolve()).encode() if picture.is_symlink() else picture.read_bytes()
            sums.update(picture.name.encode() + content)
        identity = {"pictures": sums.hexdigest()}
        return camera_key(job.stream, job.imu, job.config, job.odometry, identity, "")


class Faulty:
    """A copy of a folder recording to spoil. Sensors are tables whose first column is nanoseconds."""

    def __init__(self, source: Path, target: Path, cameras: list[str]) -> None:
        self.folder, self.cameras = target, cameras
        target.mkdir()
        for file in ("imu.csv", "gnss.csv", "rig.yaml"):
            shutil.copy(source / file, target / file)
        for camera in cameras:
            (target / camera).mkdir()
            for file in sorted((source / camera).iterdir()):
                if file.suffix == ".csv":
                    shutil.copy(file, target / camera / file.name)
                else:
                    os.symlink(file, target / camera / file.name)
        self.edit_rig(lambda rig: rig.update(cameras={c: rig["cameras"][c] for c in cameras}))

    def edit_rig(self, change: Callable[[dict], None]) -> None:
        path = self.folder / "rig.yaml"
        rig = yaml.safe_load(path.read_text())
        change(rig)
        path.write_text(yaml.safe_dump(rig))

    def edit(self, file: str, change: Callable[[NDArray[np.int64], Table], tuple | None]) -> None:
        """change: of stamps (N,) and values (N, k), in place, or returning both anew."""
        path = self.folder / file
        with path.open() as lines:
            head, *rows = list(csv.reader(lines))
        stamps = np.array([int(row[0]) for row in rows])
        values = np.array([[float(x) for x in row[1:]] for row in rows])
        stamps, values = change(stamps, values) or (stamps, values)
        with path.open("w", newline="") as lines:
            writer = csv.writer(lines)
            writer.writerow(head)
            writer.writerows([int(s), *map(repr, map(float, v))] for s, v in zip(stamps, values, strict=True))

    def images(self, camera: str) -> list[Path]:
        return sorted((self.folder / camera).glob("*.jpg"))

    def change_images(
        self, camera: str, change: Callable[[np.ndarray], np.ndarray], part: slice = slice(None)
    ) -> None:
        images = self.images(camera)
        for path in images[part]:
            picture = cv2.imread(str(path.resolve()), cv2.IMREAD_UNCHANGED)
            path.unlink()
            cv2.imwrite(str(path), change(picture), [cv2.IMWRITE_JPEG_QUALITY, 95])

    def lens(self, camera: str, factor: float = 1.0, dx: float = 0.0, dy: float = 0.0) -> None:
        def change(rig: dict) -> None:
            p = rig["cameras"][camera]["camera"]["params"]
            p["fx"], p["fy"] = factor * p["fx"], factor * p["fy"]
            p["cx"], p["cy"] = p["cx"] + dx, p["cy"] + dy

        self.edit_rig(change)

    def restamp(self, camera: str, change: Callable[[NDArray[np.int64]], NDArray[np.int64]]) -> None:
        path = self.folder / camera / "timestamps.csv"
        with path.open() as lines:
            head, *rows = list(csv.reader(lines))
        at = head.index("timestamp_ns")
        stamps = change(np.array([int(row[at]) for row in rows]))
        for row, stamp in zip(rows, stamps, strict=True):
            row[at] = str(int(stamp))
        with path.open("w", newline="") as lines:
            csv.writer(lines).writerows([head, *rows])


def middle(stamps: NDArray[np.int64]) -> int:
    return int((stamps[0] + stamps[-1]) // 2)


def imu(change: Callable[[Table], object]) -> Callable[[Faulty], None]:
    """change: of values (N, 6) `[gyro, accel]`, in place."""

    def in_place(stamps: NDArray[np.int64], v: Table) -> None:
        change(v)

    return lambda f: f.edit("imu.csv", in_place)


def gnss(change: Callable[[Table], None]) -> Callable[[Faulty], None]:
    """change: of values `[latitude, longitude, altitude, covariance...]`, in place."""
    return lambda f: f.edit("gnss.csv", lambda stamps, v: change(v))


def stamps_of(
    file: str, change: Callable[[NDArray[np.int64]], NDArray[np.int64]]
) -> Callable[[Faulty], None]:
    return lambda f: f.edit(file, lambda stamps, v: (change(stamps), v))


def scale(columns: slice | list[int], factor: float) -> Callable[[Table], None]:
    def change(v: Table) -> None:
        v[:, columns] *= factor

    return change


def order(columns: list[int], source: list[int]) -> Callable[[Table], None]:
    def change(v: Table) -> None:
        v[:, columns] = v[:, source]

    return change


def shift(rows: slice, metres: tuple[float, float]) -> Callable[[Table], None]:
    """Fixes moved north and east."""

    def change(v: Table) -> None:
        v[rows, 0] += metres[0] / 111_320.0
        v[rows, 1] += metres[1] / (111_320.0 * np.cos(np.deg2rad(v[0, 0])))

    return change


def stuck(rows: slice) -> Callable[[Table], None]:
    def change(v: Table) -> None:
        v[rows, :3] = v[rows.start, :3]

    return change


def sent_again(times: int) -> Callable[[Faulty], None]:
    """Every fix `times` times, at that rate."""

    def change(stamps: NDArray[np.int64], v: Table) -> tuple:
        step = int(np.median(np.diff(stamps))) // times
        return (stamps[:, None] + step * np.arange(times)).reshape(-1), np.repeat(v, times, axis=0)

    return lambda f: f.edit("gnss.csv", change)


def held_fixes(times: int) -> Callable[[Table], None]:
    """The receiver measures more seldom than it sends."""

    def change(v: Table) -> None:
        v[:] = v[np.arange(len(v)) // times * times]

    return change


def shown_again(f: Faulty) -> None:
    """A stretch of pictures in place of that which follows."""
    images = f.images(f.cameras[0])
    first, count = len(images) // 3, len(images) // 8
    for k in range(count):
        images[first + count + k].unlink()
        os.symlink(images[first + k].resolve(), images[first + count + k])


def doubled(f: Faulty) -> None:
    """Every second picture is the one before, under a new stamp."""
    images = f.images(f.cameras[0])
    for before, path in zip(images[::2], images[1::2], strict=False):
        path.unlink()
        os.symlink(before.resolve(), path)


def still_axis(column: int) -> Callable[[Table], None]:
    """An axis that shows nothing but noise."""

    def change(v: Table) -> None:
        v[:, column] = np.random.default_rng(4).normal(0.0, 0.02 if column > 2 else 0.002, len(v))

    return change


def jittering(seconds: float) -> Callable[[NDArray[np.int64]], NDArray[np.int64]]:
    def change(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        off = np.random.default_rng(5).normal(0.0, seconds, len(stamps))
        return np.maximum.accumulate(stamps + np.round(off * 1e9).astype(np.int64) + np.arange(len(stamps)))

    return change


def offset(columns: list[int], values: list[float]) -> Callable[[Table], None]:
    def change(v: Table) -> None:
        v[:, columns] += values

    return change


def metre_grade(v: Table) -> None:
    """An error of 1 m that lasts 40 s, and 25 cm of white noise, rightly stated."""
    rng, n = np.random.default_rng(1), len(v)
    error = rng.normal(size=(n, 3))
    rho = np.exp(-0.2 / 40.0)
    for k in range(1, n):
        error[k] = rho * error[k - 1] + np.sqrt(1 - rho**2) * error[k]
    error += 0.25 * rng.normal(size=(n, 3))
    v[:, 0] += error[:, 0] / 111_320.0
    v[:, 1] += error[:, 1] / (111_320.0 * np.cos(np.deg2rad(v[0, 0])))
    v[:, 2] += 1.6 * error[:, 2]
    v[:, [3, 6, 8]] = [1.06, 1.06, 2.7]


def outliers(v: Table) -> None:
    rng = np.random.default_rng(2)
    v[5::13, :2] += rng.normal(size=(len(v[5::13]), 2)) * 4e-5


def without_rows(file: str, seconds: float) -> Callable[[Faulty], None]:
    def change(stamps: NDArray[np.int64], v: Table) -> tuple:
        gone = np.abs(stamps - middle(stamps)) < 0.5e9 * seconds
        return stamps[~gone], v[~gone]

    return lambda f: f.edit(file, change)


def held(stamps: NDArray[np.int64], v: Table) -> None:
    gone = np.abs(stamps - middle(stamps)) < 10**9
    v[gone] = v[int(np.argmax(gone))]


def clipped(v: Table) -> None:
    limit = np.quantile(np.abs(v[:, :3]), 0.97)
    np.clip(v[:, :3], -limit, limit, out=v[:, :3])


def knocked(f: Faulty, deg: float = 1.0) -> None:
    """The pictures of the second half turned about the optical axis: a knock of the mount, but for its offset."""
    camera = f.cameras[0]
    p = yaml.safe_load((f.folder / "rig.yaml").read_text())["cameras"][camera]["camera"]["params"]

    def turned(picture: np.ndarray) -> np.ndarray:
        matrix = cv2.getRotationMatrix2D((p["cx"], p["cy"]), deg, 1.0)
        size = (picture.shape[1], picture.shape[0])
        return cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_CUBIC)

    f.change_images(camera, turned, slice(len(f.images(camera)) // 2, None))


def exchanged(f: Faulty) -> None:
    a, b = f.cameras[:2]
    half = len(f.images(a)) // 2
    for one, two in zip(f.images(a)[half:], f.images(b)[half:], strict=False):
        first, second = one.resolve(), two.resolve()
        one.unlink()
        two.unlink()
        os.symlink(second, one)
        os.symlink(first, two)


def frozen(f: Faulty) -> None:
    images = f.images(f.cameras[0])
    first = len(images) // 3
    for path in images[first : 2 * first]:
        path.unlink()
        os.symlink(images[first - 1].resolve(), path)


def drifting(rate: float) -> Callable[[NDArray[np.int64]], NDArray[np.int64]]:
    return lambda s: s[0] + np.round((s - s[0]) * (1 + rate)).astype(np.int64)


def late(seconds: float) -> Callable[[NDArray[np.int64]], NDArray[np.int64]]:
    return lambda s: s + round(seconds * 1e9)


def refocused(f: Faulty) -> None:
    """The pictures of the second half are 2 % larger: somebody turned the lens."""
    camera = f.cameras[0]
    p = yaml.safe_load((f.folder / "rig.yaml").read_text())["cameras"][camera]["camera"]["params"]
    matrix = np.array([[1.02, 0.0, -0.02 * p["cx"]], [0.0, 1.02, -0.02 * p["cy"]]])

    def larger(picture: np.ndarray) -> np.ndarray:
        return cv2.warpAffine(picture, matrix, picture.shape[1::-1], flags=cv2.INTER_CUBIC)

    f.change_images(camera, larger, slice(len(f.images(camera)) // 2, None))


def jumping(seconds: float) -> Callable[[NDArray[np.int64]], NDArray[np.int64]]:
    return lambda s: s + np.where(np.arange(len(s)) >= len(s) // 2, round(seconds * 1e9), 0)


def lagging(columns: slice, seconds: float) -> Callable[[Faulty], None]:
    """Some columns of the IMU are what they were `seconds` before."""

    def change(stamps: NDArray[np.int64], v: Table) -> None:
        rows = round(seconds * 1e9 / float(np.median(np.diff(stamps))))
        v[rows:, columns] = v[:-rows, columns].copy()

    return lambda f: f.edit("imu.csv", change)


def smoothed(stamps: NDArray[np.int64], v: Table) -> None:
    """Ten samples' mean, late by half of them."""
    sums = np.cumsum(np.concatenate([np.repeat(v[:1], 10, axis=0), v]), axis=0)
    v[:] = (sums[10:] - sums[:-10]) / 10


def noisy(columns: slice, sigma: float) -> Callable[[Table], None]:
    def change(v: Table) -> None:
        v[:, columns] += np.random.default_rng(3).normal(0.0, sigma, v[:, columns].shape)

    return change


def drifting_fixes(v: Table) -> None:
    """Fixes that run away to the north by 0.2 m per second."""
    v[:, 0] += np.arange(len(v)) * 0.2 * 0.2 / 111_320.0


def all_lenses(factor: float) -> Callable[[Faulty], None]:
    def change(f: Faulty) -> None:
        for camera in f.cameras:
            f.lens(camera, factor)

    return change


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
    started = time.process_time()
    with tempfile.TemporaryDirectory() as out:
        try:
            cameras = CachedCameras(recording, cache)
            run = calibrate(recording, out, load_config(None, ()), run_cameras=cameras)
        except RigwakeError as error:
            words = str(error).lower()
            good = any(name in words for name in named)  # the first that was found ends the run
            verdict = "refused" if good else "refused, not named"
            return f"{verdict} | {'yes' if good else 'NO'} | – | – | {'sound' if good else 'WRONG'} | {words[:110]}"
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
    seconds = time.process_time() - started
    figures = f"{turn:.3f} / {100 * shift_m:.1f} | {nees:.1f} | {sound} ({seconds:.0f} s)"
    return f"{what} | {'yes' if good else 'NO'} | {figures} | {words[:110]}"


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
    chosen = parser.parse_args()
    cases = [((name,), [name]) for name in FAULTS if not chosen.only or any(w in name for w in chosen.only)]
    if chosen.pairs:
        cases = [(pair, list(pair)) for pair in PAIRS]
    print(
        "| wrong | outcome | named | worst deg / cm | largest NEES | |\n|---|---|---|---|---|---|", flush=True
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        cache = chosen.cache or Path(folder) / "cache"
        for number, (faults, names) in enumerate(cases):
            spoilt = Path(folder) / f"recording_{number}"
            faulty = Faulty(chosen.recording.resolve(), spoilt, chosen.cameras.split(","))
            for name in faults:
                FAULTS[name][1](faulty)
            named = [FAULTS[name][0] for name in faults if FAULTS[name][0]]
            rows.append((named, judged(faulty.folder, chosen.truth, named, cache)))
            print(f"| {' + '.join(names)} | {rows[-1][1]} |", flush=True)
            shutil.rmtree(spoilt)
    wrong = sum("SILENT" in row for _, row in rows)
    rightly = [row.split(" | ")[1] == "yes" for named, row in rows if named]
    print(f"\nsilently wrong: {wrong} of {len(rows)}; named rightly: {sum(rightly)} of {len(rightly)}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
