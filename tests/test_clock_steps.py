"""A computer whose clock is set while it records: by how much, when, and which sensors show it."""

from pathlib import Path

import numpy as np
import pytest

from rigwake.readers.clock_steps import set_back_rows
from rigwake.readers.open import open_recording
from rigwake.readers.streams import time_order
from rigwake.recording import Recording
from ros_bags import START_NS, SmallBag
from test_ros_cameras import words

LENGTH_S = 12.0


def write_bag(path: Path, clock, ros: int = 1, gnss: bool = True, log=None) -> Path:
    """Cameras at 10 and 2 Hz, an IMU at 50 Hz and fixes at 5 Hz; gyro z is the true time since the start."""
    log = log or clock
    events = [(k / 50, "imu") for k in range(int(50 * LENGTH_S))]
    events += [(k / 10 + 0.003, "fast") for k in range(int(10 * LENGTH_S))]
    events += [(k / 2 + 0.004, "slow") for k in range(int(2 * LENGTH_S))]
    events += [(k / 5 + 0.005, "fix") for k in range(int(5 * LENGTH_S) if gnss else 0)]
    with SmallBag(path, ros) as bag:
        for at, what in sorted(events):
            if what == "imu":
                bag.imu("/imu/data", clock(at), gyro=(0, 0, at), log_s=log(at))
            elif what == "fix":
                bag.fix("/fix", clock(at), (53.54 + 1e-5 * at, 9.98, 40.0), log_s=log(at))
            else:
                pixels = np.full((12, 16), 10 + int(10 * at), np.uint8)
                bag.image(f"/{what}/image_raw", clock(at), pixels, log_s=log(at))
    return path


def check_one_stretch(recording: Recording, clock, after_s: float, least_s: float) -> None:
    """Every sample has the stamp that belongs to it in one stretch, of which at least so much is there."""
    (imu,) = recording.imus.values()
    true_s = imu.gyro[:, 2]
    assert (np.diff(true_s) > 0).all()
    assert np.ptp(true_s) > least_s
    is_late = true_s > after_s - 1e-6
    assert is_late.all() or not is_late.any()
    at = np.array([round(clock(t) * 1e9) for t in true_s])
    np.testing.assert_array_equal(imu.timestamps_ns - START_NS, at)
    for camera in recording.cameras.values():
        frames = list(camera.frames())
        seen_s = np.array([(frame.image.mean() - 10) / 10 for frame in frames])
        stamps_s = np.array([(frame.timestamp_ns - START_NS) * 1e-9 for frame in frames])
        offset = clock(LENGTH_S - 0.1) - (LENGTH_S - 0.1) if is_late.all() else clock(0.0)
        np.testing.assert_allclose(stamps_s - offset, seen_s, atol=0.11)
        assert np.ptp(seen_s) > least_s - 1.5


@pytest.mark.parametrize(
    ("at_s", "back_s", "ros"),
    [(4.0, 0.35, 2), (4.0, 2.507, 1), (6.1, 1.711, 2), (8.5, 5.003, 1), (9.0, 0.309, 1)],
)
def test_a_clock_that_is_set_back(tmp_path: Path, at_s: float, back_s: float, ros: int) -> None:
    def clock(at: float) -> float:
        return at if at < at_s else at - back_s

    recording = open_recording(write_bag(tmp_path / "r.bag", clock, ros))
    check_one_stretch(recording, clock, at_s, max(at_s, LENGTH_S - at_s) - 0.3)
    assert "was set back" in words(recording)
    assert not np.isnan(recording.gnss["gnss"].position_enu).any()


@pytest.mark.parametrize(("at_s", "back_s"), [(3.0, 1.507), (6.05, 2.013), (9.0, 3.007)])
def test_headers_alone_are_set_back(tmp_path: Path, at_s: float, back_s: float) -> None:
    """The recorder runs on another computer, whose clock is right."""

    def clock(at: float) -> float:
        return at if at < at_s else at - back_s

    recording = open_recording(write_bag(tmp_path / "r.bag", clock, log=lambda at: at))
    check_one_stretch(recording, clock, at_s, max(at_s, LENGTH_S - at_s) - 0.3)


@pytest.mark.parametrize("forward_s", [4000.0, 1.7e8])
@pytest.mark.parametrize("at_s", [3.0, 9.0])
def test_a_clock_that_is_set_forward(tmp_path: Path, at_s: float, forward_s: float) -> None:
    def clock(at: float) -> float:
        return at if at < at_s else at + forward_s

    recording = open_recording(write_bag(tmp_path / "r.bag", clock))
    check_one_stretch(recording, clock, at_s, max(at_s, LENGTH_S - at_s) - 0.3)
    assert "clock was set while recording" in words(recording)


def test_a_sensor_with_a_clock_of_its_own_is_cut_alone(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        for k in range(600):
            bag.imu("/imu/data", k / 50)
            if k % 5 == 0:
                bag.fix("/fix", k / 50, (53.54, 9.98, 40.0))
                own = k / 50 if k < 200 else k / 50 - 2.007
                bag.image("/front/image_raw", own, log_s=k / 50)
    recording = open_recording(tmp_path / "r.bag")
    assert len(recording.imus["imu"].timestamps_ns) == 600
    assert len(recording.gnss["gnss"].timestamps_ns) == 120
    assert len(recording.cameras["front"]) == 80


def shuffled(stamps: np.ndarray, way: str) -> np.ndarray:
    match way:
        case "late message":
            return np.concatenate([stamps[:50], stamps[55:56], stamps[50:55], stamps[56:]])
        case "late batch":
            return np.concatenate([stamps[:50], stamps[70:80], stamps[50:70], stamps[80:]])
        case "parts swapped":
            return np.concatenate([stamps[60:], stamps[:60]])
        case "recorded twice":
            return np.concatenate([stamps[:60], stamps[40:]])
        case _:
            return np.sort(np.concatenate([stamps, stamps + 3]))


@pytest.mark.parametrize(
    "way", ["late message", "late batch", "parts swapped", "recorded twice", "two publishers"]
)
def test_what_is_no_step_of_a_clock(way: str) -> None:
    stamps = START_NS + 50_000_000 * np.arange(100)
    given = shuffled(stamps, way)
    assert not len(set_back_rows(given))
    order, _ = time_order("imu", given)
    assert given[order].tolist() == sorted(set(given.tolist()))
