"""Time offsets from angular speed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handeye_scenes import PORT, straight, trajectory, wavy
from rigwake.errors import UnobservableError
from rigwake.geometry.se3 import SE3
from rigwake.sync import angular_speed, estimate_time_offset


@given(offset=st.floats(-5000, 5000), rate_hz=st.floats(8, 40), start=st.floats(0, 15))
@settings(max_examples=20)
def test_offset_of_any_size_to_a_fraction_of_a_sample(offset, rate_hz, start):
    times = np.arange(1200) * 0.05
    own = start + np.arange(0, 40, 1 / rate_hz)
    reference = trajectory("rig", wavy(times), times)
    member = trajectory("cam", SE3.exp([1, 2, 3, 4, 5, 6]) * (wavy(own) * PORT), own - offset)
    found = estimate_time_offset(reference, member)
    assert found.offset_s == pytest.approx(offset, abs=0.3 / rate_hz + 0.01)
    assert found.correlation > 0.99


def test_angular_speed_is_that_of_the_rotation():
    times = np.arange(50) * 0.1
    turning = SE3.exp(np.outer(times, [0, 0, 0.7, 0, 0, 0]))
    at, speed = angular_speed(trajectory("rig", turning, times))
    assert speed == pytest.approx(0.7)
    assert at == pytest.approx(times[:-1] + 0.05)


def test_no_turning_is_refused():
    times = np.arange(200) * 0.1
    reference = trajectory("rig", straight(times), times)
    with pytest.raises(UnobservableError, match="do not match"):
        estimate_time_offset(reference, trajectory("cam", straight(times), times + 500))


def test_unrelated_motion_is_refused():
    rng = np.random.default_rng(1)
    times = np.arange(2000) * 0.05

    def random_turning() -> SE3:
        speed = np.abs(np.convolve(rng.normal(size=len(times) + 40), np.ones(41) / 41, "valid"))
        return SE3.exp(np.outer(np.cumsum(speed) * 0.05, [0, 0, 1, 0, 0, 0]))

    with pytest.raises(UnobservableError, match="cannot be aligned"):
        estimate_time_offset(
            trajectory("rig", random_turning(), times), trajectory("cam", random_turning(), times)
        )
