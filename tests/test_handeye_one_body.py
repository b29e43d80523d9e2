"""Trajectories that are not of one body, not in one unit, or of very different rates."""

from dataclasses import replace

import numpy as np
import pytest

from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, in_one_unit
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.trajectory import Trajectory

X = SE3.exp(np.array([0.5, -0.8, 0.3, 0.8, -0.45, 1.2]))


def voyage(seed: int, rate_hz: float = 10.0, duration_s: float = 60.0) -> tuple[np.ndarray, SE3]:
    """Stamps and poses of a boat that turns and rolls, by smooth random functions of time."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, duration_s, 1 / rate_hz)
    phase, rate = rng.uniform(0, 6, 8), rng.uniform(0.1, 0.4, 4)
    heading = sum(np.sin(r * t + p) for r, p in zip(rate, phase, strict=False))
    roll = 0.1 * np.sin(1.1 * t + phase[4]) + 0.04 * np.sin(1.7 * t + phase[5])
    pitch = 0.06 * np.sin(0.9 * t + phase[6])
    turn = so3.exp(np.outer(heading, [0, 0, 1])) @ so3.exp(np.outer(pitch, [0, 1, 0]))
    turn = turn @ so3.exp(np.outer(roll, [1, 0, 0]))
    steps = 2.0 / rate_hz * np.stack([np.cos(heading), np.sin(heading), 0.1 * np.cos(t)], axis=1)
    return np.round(1e9 * t).astype(np.int64), SE3(turn, np.cumsum(steps, axis=0))


def noisy(name: str, stamps: np.ndarray, poses: SE3, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    error = np.hstack([rng.normal(0, 2e-4, (len(stamps), 3)), rng.normal(0, 2e-3, (len(stamps), 3))])
    return Trajectory(name, stamps, poses * SE3.exp(error))


@pytest.mark.parametrize("seed", range(4))
def test_two_boats_are_refused(seed: int) -> None:
    stamps, first = voyage(seed)
    _, second = voyage(seed + 100)
    reference = noisy("one", stamps, first, 1)
    member = noisy("two", stamps, second * X, 2)
    with pytest.raises(EstimationError, match="one rigid body"):
        calibrate_handeye(reference, [member], HandeyeOptions(time_offset=False))
    same = noisy("two", stamps, first * X, 2)
    calibrate_handeye(reference, [same], HandeyeOptions(time_offset=False))


@pytest.mark.parametrize("factor", [1000.0, 100.0, 0.001, 3.28084 * 3])
def test_another_unit_is_noticed_and_its_scale_estimated(factor: float) -> None:
    stamps, poses = voyage(0)
    reference, member = noisy("ref", stamps, poses, 1), noisy("cam", stamps, poses * X, 2)
    assert in_one_unit(reference, member) == (member, None)
    scaled = SE3(member.world_from_body.rotation, factor * member.world_from_body.translation)
    believed, finding = in_one_unit(reference, replace(member, world_from_body=scaled))
    assert finding is not None
    assert not believed.is_metric
    camera = calibrate_handeye(reference, [believed]).members["cam"]
    assert camera.scale == pytest.approx(1 / factor, rel=1e-2)
    np.testing.assert_allclose(camera.rig_from_cam.translation, X.translation, atol=0.05)


def test_a_lever_arm_is_no_unit() -> None:
    """A body that turns on the spot moves its members, but not by one factor."""
    stamps, poses = voyage(0)
    on_the_spot = SE3(poses.rotation, 0.01 * poses.translation)
    reference = noisy("ref", stamps, on_the_spot, 1)
    member = noisy("cam", stamps, on_the_spot * X, 2)
    assert in_one_unit(reference, member) == (member, None)


@pytest.mark.parametrize("rates", [(10.0, 200.0), (200.0, 10.0), (5.0, 100.0)])
@pytest.mark.parametrize("offset_s", [0.0, 0.35])
def test_rates_that_differ_by_twenty(rates: tuple[float, float], offset_s: float) -> None:
    (slow, poses), (fast, finer) = (voyage(3, rate) for rate in rates)
    reference = noisy("ref", slow, poses, 1)
    member = noisy("cam", fast - round(1e9 * offset_s), finer * X, 2)
    camera = calibrate_handeye(reference, [member]).members["cam"]
    assert camera.time_offset_s == pytest.approx(offset_s, abs=3e-3)
    turned = so3.log(X.rotation.T @ camera.rig_from_cam.rotation)
    assert np.degrees(np.linalg.norm(turned)) < 0.05


@pytest.mark.parametrize("gap", [(10, 50), (5, 25), (30, 58)])
def test_a_long_gap_is_no_other_body(gap: tuple[int, int]) -> None:
    stamps, poses = voyage(1)
    reference, member = noisy("ref", stamps, poses, 1), noisy("cam", stamps, poses * X, 2)
    kept = (member.times_s < gap[0]) | (member.times_s > gap[1])
    camera = calibrate_handeye(reference, [member.take(kept)], HandeyeOptions(time_offset=False)).members[
        "cam"
    ]
    assert np.degrees(np.linalg.norm(so3.log(X.rotation.T @ camera.rig_from_cam.rotation))) < 0.1
