"""What is written reads back: stamps and lossless pixels to the bit, in every format."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.errors import UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.inspection.recording_inspection import inspect_recording
from rigwake.readers.open import open_recording
from rigwake.recording import (
    AttitudeStream,
    CameraStream,
    Frame,
    GnssStream,
    ImuStream,
    Recording,
)
from rigwake.rig import Rig, RigCamera
from rigwake.trajectory import Trajectory
from rigwake.writers.write import RecordingFormat, write_recording

WIDTH, HEIGHT, FRAMES = 48, 32, 7
START_NS = 1_700_000_000_123_456_789
FORMATS: list[tuple[RecordingFormat, str, str]] = [
    ("ros1", "rec.bag", "raw"),
    ("ros1", "rec.bag", "png"),
    ("ros2", "rec", "raw"),
    ("mcap", "rec.mcap", "raw"),
    ("mcap", "rec", "png"),
    ("folder", "rec", "png"),
    ("euroc", "rec", "png"),
]


@dataclass(frozen=True, eq=False)
class NoiseFrames:
    """Random images, the same for the same seed and index."""

    seed: int
    stamps: NDArray[np.int64]
    grey: bool

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for index in indices:
            rng = np.random.default_rng((self.seed, int(index)))
            shape = (HEIGHT, WIDTH) if self.grey else (HEIGHT, WIDTH, 3)
            image = rng.integers(0, 256, shape, dtype=np.uint8)
            if colour and self.grey:
                image = np.repeat(image[..., None], 3, axis=2)
            elif not colour and not self.grey:
                image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            yield Frame(int(index), int(self.stamps[index]), image)


def small_recording(cameras: tuple[str, ...] = ("front", "port")) -> Recording:
    rng = np.random.default_rng(5)
    stamps = START_NS + np.arange(FRAMES) * 100_000_001
    imu_stamps = START_NS + np.arange(70) * 10_000_003
    lens = KannalaBrandt4((20.0, 21.0, 23.5, 15.5, 0.01, -0.002, 0.0, 0.0), WIDTH, HEIGHT, None)
    streams = {
        name: CameraStream(
            name,
            stamps + 7 * k,
            NoiseFrames(k, stamps + 7 * k, k == 0),
            WIDTH,
            HEIGHT,
            lens,
            "",
            f"{name}_optical",
        )
        for k, name in enumerate(cameras)
    }
    rotations = so3.exp(rng.normal(size=(70, 3)) * 0.2)
    A = rng.normal(size=(70, 3, 3)) * 0.01
    spread = A @ np.swapaxes(A, 1, 2) + 1e-6 * np.eye(3)
    rig_from_cam = SE3.exp(rng.normal(size=6))
    poses = Trajectory(
        "odom",
        stamps,
        SE3.exp(rng.normal(size=(FRAMES, 6))),
        np.broadcast_to(np.diag([1.0, 2, 3, 4, 5, 6]), (FRAMES, 6, 6)).copy(),
        "poses",
    )
    return Recording(
        Path("none"),
        "test",
        streams,
        {"imu": ImuStream("imu", imu_stamps, rng.normal(size=(70, 3)), rng.normal(size=(70, 3)))},
        {
            "gnss": GnssStream(
                "gnss",
                imu_stamps[::10],
                np.cumsum(rng.normal(size=(7, 3)), 0),
                spread[::10],
                (57.7, 11.9, 40.0),
            )
        },
        {"imu": AttitudeStream("imu", imu_stamps, rotations, spread)},
        {"odom": poses},
        {("base_link", "post"): SE3.exp(rng.normal(size=6)), ("post", "front_optical"): rig_from_cam},
        Rig(
            "base_link", {n: RigCamera(n, rig_from_cam, lens) for n in cameras}, (0.1, 0.2, 0.3), rig_from_cam
        ),
        {"body": poses},
    )


@pytest.mark.parametrize(("file_format", "name", "encoding"), FORMATS)
def test_round_trip_is_exact(tmp_path: Path, file_format: RecordingFormat, name: str, encoding: str) -> None:
    cameras = ("cam0", "cam1") if file_format == "euroc" else ("front", "port")
    written = small_recording(cameras)
    write_recording(written, tmp_path / name, file_format=file_format, image_encoding=encoding)  # type: ignore[arg-type]
    again = open_recording(tmp_path / name)
    assert list(again.cameras) == list(cameras)
    for camera in again.cameras.values():
        original = written.camera(camera.name)
        assert np.array_equal(camera.timestamps_ns, original.timestamps_ns)
        assert camera.model == original.model
        pairs = list(zip(camera.frames(colour=True), original.frames(colour=True), strict=True))
        assert len(pairs) == FRAMES
        assert all(np.array_equal(a.image, b.image) and a.timestamp_ns == b.timestamp_ns for a, b in pairs)
    (imu,), (original_imu,) = again.imus.values(), written.imus.values()
    assert np.array_equal(imu.timestamps_ns, original_imu.timestamps_ns)
    assert np.array_equal(imu.gyro, original_imu.gyro)
    assert np.array_equal(imu.accel, original_imu.accel)
    assert not [f for f in again.findings if f.severity == "error"]


@pytest.mark.parametrize(("file_format", "name", "encoding"), FORMATS[:-1])
def test_other_streams_come_back(
    tmp_path: Path, file_format: RecordingFormat, name: str, encoding: str
) -> None:
    written = small_recording()
    write_recording(written, tmp_path / name, file_format=file_format, image_encoding=encoding)  # type: ignore[arg-type]
    again = open_recording(tmp_path / name)
    gnss, original = again.gnss["gnss"], written.gnss["gnss"]
    assert np.array_equal(gnss.timestamps_ns, original.timestamps_ns)
    moved, expected = (g.position_enu - g.position_enu[0] for g in (gnss, original))
    assert np.abs(moved - expected).max() < 1e-5  # the two tangent planes are metres apart
    assert np.allclose(gnss.covariances, original.covariances, atol=1e-12)
    attitude, original_attitude = again.attitudes["imu" if file_format != "folder" else "attitude_imu"], None
    original_attitude = written.attitudes["imu"]
    assert np.allclose(attitude.world_from_body, original_attitude.world_from_body, atol=1e-12)
    assert np.allclose(attitude.covariances, original_attitude.covariances, atol=1e-12)
    poses, original_poses = again.poses["odom"], written.poses["odom"]
    assert np.array_equal(poses.timestamps_ns, original_poses.timestamps_ns)
    assert np.abs(poses.world_from_body.local(original_poses.world_from_body)).max() < 1e-9
    assert poses.covariances is not None
    assert original_poses.covariances is not None
    assert np.allclose(poses.covariances, original_poses.covariances, atol=1e-9)
    if file_format != "folder":
        assert again.static_transforms.keys() == written.static_transforms.keys()
        for edge, transform in again.static_transforms.items():
            assert np.abs(transform.local(written.static_transforms[edge])).max() < 1e-12
    else:
        assert again.true_rig is not None
        assert again.true_rig.antenna_rig == (0.1, 0.2, 0.3)
        assert list(again.true_trajectories) == ["body"]


@pytest.mark.parametrize(("file_format", "name", "encoding"), FORMATS[:-1])
def test_what_is_written_inspects_the_same(
    tmp_path: Path, file_format: RecordingFormat, name: str, encoding: str
) -> None:
    written = small_recording()
    write_recording(written, tmp_path / name, file_format=file_format, image_encoding=encoding)  # type: ignore[arg-type]
    before, after = (inspect_recording(r) for r in (written, open_recording(tmp_path / name)))
    for camera, seen in after.pictures.items():
        original = before.pictures[camera]
        assert seen.mean_level == pytest.approx(original.mean_level, abs=0.6)  # decoders round grey
        assert (seen.sampled, seen.readable, seen.frozen) == (FRAMES, FRAMES, 0)
        assert len(seen.rotations) == len(original.rotations)
    same = [key for key in before.timings if not key.startswith("attitude")]  # folders rename these
    assert [after.timings[key] == before.timings[key] for key in same] == [True] * len(same)
    assert before.turning is not None
    assert after.turning is not None
    assert after.turning.tilt_std_deg == before.turning.tilt_std_deg


def test_existing_folders_are_not_overwritten(tmp_path: Path) -> None:
    for file_format in ("folder", "euroc", "ros2"):
        with pytest.raises(UsageError, match="exists"):
            write_recording(small_recording(), tmp_path, file_format=file_format)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    class Broken(NoiseFrames):
        def frames(
            self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False
        ) -> Iterator[Frame]:
            yield from super().frames(indices[:3], colour=colour)
            raise RuntimeError("camera unplugged")

    recording = small_recording(("front",))
    stamps = recording.camera("front").timestamps_ns
    camera = CameraStream("front", stamps, Broken(0, stamps, True), WIDTH, HEIGHT)
    broken = Recording(Path("none"), "test", {"front": camera})
    for file_format, name, _ in FORMATS:
        with pytest.raises(RuntimeError, match="unplugged"):
            write_recording(broken, tmp_path / name, file_format=file_format, image_encoding="png")
        assert not list(tmp_path.iterdir())
