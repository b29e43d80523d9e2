"""Memory stays bounded whatever the bag's size, and opening a bag does not read its images."""

import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rigwake.readers.open import open_recording
from rigwake.recording import CameraStream, Frame, Recording
from rigwake.writers.rosbag import write_rosbag1
from rigwake.writers.write import write_recording
from test_writers import NoiseFrames, small_recording

FRAMES, WIDTH, HEIGHT = 60, 640, 480
IMAGE_BYTES = 3 * WIDTH * HEIGHT


class LargeFrames(NoiseFrames):
    def frames(self, indices, *, colour=False):  # type: ignore[no-untyped-def]
        picture = np.random.default_rng(0).integers(0, 256, (HEIGHT + 64, WIDTH, 3), dtype=np.uint8)
        for index in indices:
            yield Frame(int(index), int(self.stamps[index]), picture[index % 64 : index % 64 + HEIGHT])


def large_recording() -> Recording:
    recording = small_recording(("front",))
    stamps = recording.camera("front").timestamps_ns[0] + np.arange(FRAMES) * 10**8
    camera = CameraStream("front", stamps, LargeFrames(0, stamps, False), WIDTH, HEIGHT)
    return replace(recording, cameras={"front": camera})


@pytest.mark.parametrize(
    ("name", "compression"), [("r.bag", "none"), ("r.bag", "lz4"), ("r.mcap", "none"), ("r", "none")]
)
def test_frames_are_streamed(tmp_path: Path, name: str, compression: str) -> None:
    path = tmp_path / name
    if name == "r.bag":
        write_rosbag1(large_recording(), path, "raw", compression)  # type: ignore[arg-type]
    else:
        write_recording(
            large_recording(), path, file_format="ros2" if name == "r" else "mcap", image_encoding="raw"
        )
    tracemalloc.start()
    count = sum(1 for _ in open_recording(path).camera("front").frames(colour=True))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == FRAMES
    assert peak < 12 * IMAGE_BYTES  # of 60 images in the bag


@pytest.mark.parametrize("name", ["r.bag", "r.mcap"])
def test_opening_does_not_read_the_images(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / name
    write_recording(large_recording(), path, image_encoding="raw")
    read, pread = 0, os.pread

    def counted(file: int, size: int, at: int) -> bytes:
        nonlocal read
        content = pread(file, size, at)
        read += len(content)
        return content

    monkeypatch.setattr(os, "pread", counted)
    recording = open_recording(path)
    assert len(recording.camera("front")) == FRAMES
    assert len(recording.imus["imu"].gyro) == 70
    assert read < 2 * IMAGE_BYTES  # the first image, for its size, and headers


def test_writing_is_streamed(tmp_path: Path) -> None:
    recording = large_recording()
    for file_format in ("ros1", "mcap", "folder"):
        tracemalloc.start()
        write_recording(recording, tmp_path / file_format, file_format=file_format, image_encoding="jpeg")  # type: ignore[arg-type]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 15 * IMAGE_BYTES
