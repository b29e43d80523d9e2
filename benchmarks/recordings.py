"""Reading of 1 GB bags against rosbags alone: throughput, peak memory, and what opening costs.

The bags hold four cameras of raw 640 x 480 colour images, an IMU at 200 Hz and GNSS at 5 Hz. Every measurement runs
in a process of its own; times are CPU seconds, the median of `--repeats` runs. The peer reads the same messages with
`rosbags` and views the pixels as an array, with nothing checked.

    .venv/bin/python benchmarks/recordings.py [--gigabytes 1] [--repeats 3]
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from rigwake.readers.open import open_recording
from rigwake.readers.ros_decoding import typestore
from rigwake.recording import CameraStream, Frame, GnssStream, ImuStream, Recording
from rigwake.writers.write import write_recording

WIDTH, HEIGHT = 640, 480
CAMERAS = ("front", "port", "back", "starboard")
IMAGE_BYTES = 3 * WIDTH * HEIGHT


@dataclass(frozen=True, eq=False)
class Noise:
    """Frames cut from one random picture, so that making them costs nothing."""

    stamps: NDArray[np.int64]

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        picture = np.random.default_rng(0).integers(0, 256, (HEIGHT + 64, WIDTH, 3), dtype=np.uint8)
        for index in indices:
            shift = int(index) % 64
            yield Frame(int(index), int(self.stamps[index]), picture[shift : shift + HEIGHT])


def synthetic(gigabytes: float) -> Recording:
    frames = int(gigabytes * 1e9 / IMAGE_BYTES / len(CAMERAS))
    start = 1_700_000_000_000_000_000
    stamps = start + np.arange(frames) * 100_000_000
    imu_stamps = start + np.arange(frames * 20) * 5_000_000
    gnss_stamps = start + np.arange(max(frames // 2, 1)) * 200_000_000
    rng = np.random.default_rng(1)
    n = len(imu_stamps)
    position = np.cumsum(rng.normal(size=(len(gnss_stamps), 3)), axis=0)
    spread = np.tile(np.eye(3) * 1e-4, (len(gnss_stamps), 1, 1))
    return Recording(
        Path("synthetic"),
        "synthetic",
        {name: CameraStream(name, stamps, Noise(stamps), WIDTH, HEIGHT) for name in CAMERAS},
        {"imu": ImuStream("imu", imu_stamps, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))},
        {"gnss": GnssStream("gnss", gnss_stamps, position, spread, (57.7, 11.9, 40.0))},
    )


def peer_everything(path: Path) -> int:
    """All IMU messages and images by rosbags alone."""
    count = 0
    store = typestore("ros1" if path.suffix == ".bag" else "cdr")
    with AnyReader([path], default_typestore=store) as reader:
        wanted = [c for c in reader.connections if c.msgtype.endswith(("/Imu", "/Image"))]
        for connection, _, payload in reader.messages(wanted):
            message = reader.deserialize(payload, connection.msgtype)
            if connection.msgtype.endswith("/Image"):
                count += message.data.reshape(HEIGHT, WIDTH, 3).shape[0] == HEIGHT
            else:
                count += 1
    return count


def rigwake_everything(path: Path) -> int:
    """The same by rigwake."""
    recording = open_recording(path)
    count = sum(len(imu.gyro) for imu in recording.imus.values())
    return count + sum(1 for camera in recording.cameras.values() for _ in camera.frames(colour=True))


def rigwake_open(path: Path) -> int:
    """IMU, GNSS and the stamps of all images, without the images."""
    recording = open_recording(path)
    return sum(len(s.timestamps_ns) for s in (*recording.imus.values(), *recording.gnss.values()))


def _measure(work: Callable[[Path], int], path: Path, results: multiprocessing.Queue) -> None:  # type: ignore[type-arg]
    before_s, wall_s = time.process_time(), time.perf_counter()
    count = work(path)
    cpu_s, wall_s = time.process_time() - before_s, time.perf_counter() - wall_s
    results.put((count, cpu_s, wall_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))


def measure(work: Callable[[Path], int], path: Path, repeats: int) -> tuple[int, float, float, float]:
    """Count, median CPU seconds, median wall seconds, peak memory in MB."""
    context = multiprocessing.get_context("spawn")
    runs = []
    for _ in range(repeats):
        results = context.Queue()
        process = context.Process(target=_measure, args=(work, path, results))
        process.start()
        runs.append(results.get())
        process.join()
    values = np.array(runs, dtype=float)
    cpu_s, wall_s = np.median(values[:, 1:3], axis=0)
    return int(values[0, 0]), float(cpu_s), float(wall_s), float(values[:, 3].max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=1.0)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    print("| format | what | messages | CPU s | wall s | peak MB | throughput of rosbags |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in ("synthetic.bag", "synthetic.mcap"):
            path = Path(folder) / name
            write_recording(synthetic(options.gigabytes), path, image_encoding="raw")
            peer = measure(peer_everything, path, options.repeats)
            everything = measure(rigwake_everything, path, options.repeats)
            opened = measure(rigwake_open, path, options.repeats)
            if everything[0] != peer[0]:
                raise SystemExit(f"{name}: {everything[0]} messages read, rosbags reads {peer[0]}")
            kind = f"{path.suffix} {path.stat().st_size / 1e9:.2f} GB"
            rows = [
                ("rosbags alone", peer),
                ("rigwake, decoded", everything),
                ("rigwake, opened only", opened),
            ]
            for what, (count, cpu_s, wall_s, peak_mb) in rows:
                ratio = f"{peer[1] / cpu_s:.2f} x" if count == peer[0] else ""
                print(f"| {kind} | {what} | {count} | {cpu_s:.2f} | {wall_s:.2f} | {peak_mb:.0f} | {ratio} |")
            path.unlink()


if __name__ == "__main__":
    main()
