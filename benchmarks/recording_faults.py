"""What can be wrong in a rendered recording: changes of a copy of its folder, for `benchmarks/faults.py`."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

Table = NDArray[np.float64]


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


def rounded(step_s: float) -> Callable[[NDArray[np.int64]], NDArray[np.int64]]:
    """Stamps of a clock with coarse steps."""
    step = round(step_s * 1e9)
    return lambda s: s // step * step


def images_lost(f: Faulty) -> None:
    """Every second picture of one camera, and its stamp."""
    path = f.folder / f.cameras[0] / "timestamps.csv"
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows[::2]]) + "\n")
    for image in f.images(f.cameras[0])[1::2]:
        image.unlink()


def zoomed_and_exchanged(f: Faulty) -> None:
    """One camera has a lens 6 % longer than another, and each has the lens file of the other."""
    zoomed(f, 1.06, lambda n: np.full(n, 1.06))
    f.lens(f.cameras[1], 1.06)


def breathing(f: Faulty) -> None:
    """Autofocus: the focal length of one camera grows steadily, by 1 % in all."""
    zoomed(f, 1.01, lambda n: np.linspace(1.0, 1.01, n))


def zoomed(f: Faulty, most: float, by_image: Callable[[int], Table]) -> None:
    """Pictures of one camera larger about its principal point, by a factor each."""
    camera = f.cameras[0]
    p = yaml.safe_load((f.folder / "rig.yaml").read_text())["cameras"][camera]["camera"]["params"]
    factors = iter(by_image(len(f.images(camera))))

    def larger(picture: np.ndarray) -> np.ndarray:
        z = float(next(factors))
        matrix = np.array([[z, 0.0, (1 - z) * p["cx"]], [0.0, z, (1 - z) * p["cy"]]])
        return cv2.warpAffine(picture, matrix, picture.shape[1::-1], flags=cv2.INTER_CUBIC)

    f.change_images(camera, larger)


def halved(picture: np.ndarray) -> np.ndarray:
    return cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def cropped(f: Faulty) -> None:
    """48 columns cut off at the left of one camera's pictures; the lens file knows the new size, not the new centre."""
    f.change_images(f.cameras[0], lambda p: p[:, 48:])
    f.edit_rig(lambda rig: rig["cameras"][f.cameras[0]]["camera"].update(
        width_px=rig["cameras"][f.cameras[0]]["camera"]["width_px"] - 48))  # fmt: skip


def permuted(f: Faulty) -> None:
    """Pictures of one camera exchanged with their neighbours now and then, under the stamps as they were."""
    images = f.images(f.cameras[0])
    for k in range(4, len(images) - 1, 9):
        first, second = images[k].resolve(), images[k + 1].resolve()
        images[k].unlink()
        images[k + 1].unlink()
        os.symlink(second, images[k])
        os.symlink(first, images[k + 1])


def quarter_turned(f: Faulty) -> None:
    """Pictures of one camera turned by 90 degrees, and width and height in the lens file exchanged too."""
    f.change_images(f.cameras[0], lambda p: cv2.rotate(p, cv2.ROTATE_90_CLOCKWISE))

    def change(rig: dict) -> None:
        lens = rig["cameras"][f.cameras[0]]["camera"]
        lens["width_px"], lens["height_px"] = lens["height_px"], lens["width_px"]

    f.edit_rig(change)


def not_numbers(file: str, every: int) -> Callable[[Faulty], None]:
    """Rows whose values are not a number."""

    def change(stamps: NDArray[np.int64], v: Table) -> None:
        v[every::every] = np.nan

    return lambda f: f.edit(file, change)


def thinned(file: str, every: int) -> Callable[[Faulty], None]:
    return lambda f: f.edit(file, lambda stamps, v: (stamps[::every], v[::every]))


def limited(most: float) -> Callable[[Table], None]:
    """A gyroscope whose range ends at `most` rad/s."""

    def change(v: Table) -> None:
        np.clip(v[:, :3], -most, most, out=v[:, :3])

    return change


def turned_against(columns: slice, deg: float) -> Callable[[Table], None]:
    """Three columns turned about an axis in the deck: gyroscope and accelerometer are not mounted alike."""
    turn = cv2.Rodrigues(np.deg2rad(deg) * np.array([0.8, 0.6, 0.0]))[0]

    def change(v: Table) -> None:
        v[:, columns] = v[:, columns] @ turn.T

    return change


def gyroscope_late(f: Faulty) -> None:
    """The gyroscope alone goes through a filter that delays it by 0.1 s; the accelerometer does not."""

    def change(stamps: NDArray[np.int64], v: Table) -> None:
        n = max(2, round(0.2e9 / float(np.median(np.diff(stamps)))))
        sums = np.cumsum(np.concatenate([np.repeat(v[:1, :3], n, axis=0), v[:, :3]]), axis=0)
        v[:, :3] = (sums[n:] - sums[:-n]) / n

    f.edit("imu.csv", change)


def drifting_fixes(v: Table) -> None:
    """Fixes that run away to the north by 0.2 m per second."""
    v[:, 0] += np.arange(len(v)) * 0.2 * 0.2 / 111_320.0


def all_lenses(factor: float) -> Callable[[Faulty], None]:
    def change(f: Faulty) -> None:
        for camera in f.cameras:
            f.lens(camera, factor)

    return change
