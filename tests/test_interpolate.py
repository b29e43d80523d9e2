import numpy as np
import pytest

from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.interpolate import TransformSpline, interpolate
from rigwake.geometry.se3 import SE3

START_NS = 1_404_733_405_732_800_000  # a date: floats of seconds would lose 240 ns


def smooth_motion(times: np.ndarray) -> SE3:
    rotation_vectors = np.stack([0.3 * np.sin(times), 0.2 * np.cos(2 * times), 0.8 * times], -1)
    return SE3(so3.exp(rotation_vectors), np.stack([times**2, np.sin(times), 0.1 * times], -1))


STAMPS = START_NS + np.arange(0, 4_000_000_000, 20_000_000)
TIMES = (STAMPS - START_NS) * 1e-9


def test_knots_are_reproduced_to_the_nanosecond() -> None:
    motion = smooth_motion(TIMES)
    for found in (interpolate(STAMPS, motion, STAMPS), TransformSpline(STAMPS, motion).at(STAMPS)):
        np.testing.assert_allclose(found.matrix, motion.matrix, atol=1e-12)


def test_slerp_of_a_constant_turn_is_exact() -> None:
    ends = SE3(so3.exp(np.array([[0, 0, 0.0], [0, 0, 1.0]])), np.array([[0, 0, 0.0], [2, 0, 0]]))
    found = interpolate(np.array([0, 10]), ends, np.array([0, 3, 10]))
    np.testing.assert_allclose(so3.log(found.rotation)[:, 2], [0, 0.3, 1.0], atol=1e-12)
    np.testing.assert_allclose(found.translation[:, 0], [0, 0.6, 2.0])


def test_spline_and_its_derivatives() -> None:
    spline = TransformSpline(STAMPS, smooth_motion(TIMES))
    at = STAMPS[20:-20:7] + 3_141_592
    times = (at - START_NS) * 1e-9
    np.testing.assert_allclose(spline.at(at).matrix, smooth_motion(times).matrix, atol=2e-7)
    velocity = np.stack([2 * times, np.cos(times), np.full_like(times, 0.1)], -1)
    np.testing.assert_allclose(spline.velocity_world(at), velocity, atol=1e-5)
    acceleration = np.stack([np.full_like(times, 2.0), -np.sin(times), np.zeros_like(times)], -1)
    np.testing.assert_allclose(spline.acceleration_world(at), acceleration, atol=1e-3)


@pytest.mark.parametrize("at", [STAMPS[0] - 1, STAMPS[-1] + 1])
def test_no_extrapolation(at: int) -> None:
    motion = smooth_motion(TIMES)
    with pytest.raises(InputError, match="outside"):
        interpolate(STAMPS, motion, np.array([at]))
    with pytest.raises(InputError, match="outside"):
        TransformSpline(STAMPS, motion).at(np.array([at]))
    with pytest.raises(InputError, match="two poses"):
        interpolate(STAMPS[:1], motion[:1], STAMPS[:1])
