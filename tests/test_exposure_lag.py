"""Images stamped the later the longer a frame lasts, told apart from a clock that drifts, and corrected."""

from dataclasses import replace

import numpy as np
import pytest

from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.pipeline.stream_selection import Selection
from rigwake.pipeline.vetted_rig import _restamped
from rigwake.plausibility.exposure_lag import exposure_lag, frame_periods, later_by, restamped
from rigwake.plausibility.turn_checks import check_clocks
from rigwake.plausibility.turn_fit import fit_turns
from rigwake.recording import CameraStream, ImuStream
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

MOUNT = so3.exp([0.3, -1.0, 0.7])
START_NS = 1_700_000_000_000_000_000


def turned(times_s: np.ndarray) -> np.ndarray:
    """A hand-held body, which turns about all axes."""
    t = times_s[:, None]
    return so3.exp(0.3 * np.sin(t * [1.9, 2.6, 3.3] + [0.0, 1.0, 2.0]))


def gyroscope(seconds: float) -> ImuStream:
    times = np.arange(0, seconds, 0.005)
    R = turned(np.append(times, times[-1] + 0.005))
    rates = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / 0.005
    stamps = START_NS + np.round(1e9 * (times + 0.0025)).astype(np.int64)
    return ImuStream("imu", stamps, rates, np.zeros_like(rates))


def path(slope: float, drift: float = 0.0, varying: bool = True) -> Trajectory:
    """Frames that last 60, then 33, then 45 ms, stamped `slope` of that too late."""
    periods = np.repeat([0.06, 0.033, 0.045], [110, 120, 110]) if varying else np.full(340, 0.045)
    times = 0.5 + np.cumsum(periods)
    noise = so3.exp(np.random.default_rng(3).normal(size=(len(times), 3)) * 3e-4)
    R = turned(times) @ MOUNT @ noise
    stamped = times + slope * periods + drift * times
    stamps = START_NS + np.round(1e9 * stamped).astype(np.int64)
    return Trajectory("cam", stamps, SE3(R, np.zeros((len(R), 3))))


IMU = gyroscope(18.0)


def test_the_lag_is_found_and_corrected():
    camera = path(0.9)
    assert not check_clocks({"cam": fit_turns(camera, IMU)})[0].agrees  # seems to drift
    lag = exposure_lag(camera, camera.timestamps_ns, IMU)
    assert lag is not None
    assert lag.slope == pytest.approx(0.9, abs=5 * lag.std)
    assert lag.std < 0.1
    check = lag.check("cam")
    assert "33 to 60 ms" in check.sentence
    assert check.action == "repaired"
    moved = later_by(lag, camera.timestamps_ns)
    assert moved is not None
    corrected = restamped(camera, camera.timestamps_ns, moved)
    fit = fit_turns(corrected, IMU)
    assert check_clocks({"cam": fit}) == ()
    assert np.rad2deg(np.linalg.norm(so3.log(fit.imu_from_cam @ MOUNT.T))) < 0.1


@pytest.mark.parametrize("camera", [path(0.0), path(0.9, varying=False), path(0.0, drift=3e-3)])
def test_sound_stamps_steady_frames_and_drifting_clocks_are_none(camera):
    assert exposure_lag(camera, camera.timestamps_ns, IMU) is None


def test_a_missing_frame_is_not_a_longer_exposure():
    stamps = np.delete(np.arange(100) * 50_000_000, [40, 41])
    assert np.allclose(frame_periods(stamps), 0.05)


def test_stamps_that_would_not_increase_are_left():
    camera = path(0.9)
    lag = exposure_lag(camera, camera.timestamps_ns, IMU)
    assert lag is not None
    assert later_by(replace(lag, slope=40.0), camera.timestamps_ns) is None


def test_frames_tracks_and_path_get_the_same_stamps():
    camera = path(0.9)
    stamps = np.sort(np.append(camera.timestamps_ns, camera.timestamps_ns[-1] + 45_000_000))
    stream = CameraStream("cam", stamps, None, 10, 10)
    none = np.empty(0, dtype=np.int64)
    tracks = Tracks("cam", stamps[::2], none, none, np.empty((0, 2)), np.empty((0, 3)), np.empty(0))
    selection = Selection({"cam": stream, "dark": stream}, IMU, None)
    after, by_camera, paths, (check,) = _restamped(selection, {"cam": tracks}, {"cam": camera}, repair=True)
    moved = after.cameras["cam"].timestamps_ns
    assert np.array_equal(by_camera["cam"].timestamps_ns, moved[::2])
    assert np.array_equal(paths["cam"].timestamps_ns, moved[:-1])
    assert after.cameras["dark"] is stream
    assert check.sensor == "camera cam"
    assert np.ptp(moved - stamps) == pytest.approx(0.9 * 27e6, rel=0.2)
    kept, _, _, (told,) = _restamped(selection, {"cam": tracks}, {"cam": camera}, repair=False)
    assert kept.cameras["cam"] is stream
    assert told.action == "none"
    assert "corrected" not in told.hypothesis
