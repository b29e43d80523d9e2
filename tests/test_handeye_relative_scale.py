"""Two trajectories that both claim metres and do not mean the same."""

import numpy as np
import pytest

from handeye_scenes import PORT, drifting, trajectory
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.relative_scale import relative_scale
from rigwake.pipeline.handeye_run import run_handeye

TIMES = np.arange(400) * 0.2


def circling() -> SE3:
    """Turning to one side, rolling and pitching: a scale that is off looks like an offset."""
    t = TIMES[:, None]
    tilt = so3.exp(0.15 * np.sin(t * [0.6, 0.9, 0.0]))
    yaw = 0.25 * TIMES
    way = 12 * np.stack([np.sin(yaw), 1 - np.cos(yaw), 0.02 * np.sin(TIMES)], axis=1)
    return SE3(so3.exp(np.outer(yaw, [0, 0, 1])) @ tilt, way)


def pair(scale: float, seed: int):
    rng = np.random.default_rng(seed)
    body, seen = (drifting(poses, 1e-3, 2e-3, rng) for poses in (circling(), circling() * PORT))
    stretched = SE3(seen.rotation, seen.translation * scale)
    return trajectory("rig", body, TIMES), trajectory("port", stretched, TIMES)


def nees(scale: float, seed: int) -> float:
    rig, port = pair(scale, seed)
    result = calibrate_handeye(rig, [port], HandeyeOptions(time_offset=False))
    off = PORT.local(result.ref_from_members["port"])
    return float(off @ np.linalg.solve(result.joint_covariance, off))


def test_a_scale_that_is_off_counts_as_uncertainty_and_is_told():
    assert np.mean([nees(1.03, seed) for seed in range(6)]) < 12  # 6 is expected
    rig, port = pair(1.03, 1)
    *_, (finding,) = run_handeye(rig, [port], HandeyeOptions(time_offset=False))
    assert "rig goes 2.8" in finding.message or "rig goes 2.9" in finding.message
    assert "less far" in finding.message


def test_equal_scales_widen_nothing():
    assert 3 < np.mean([nees(1.0, seed) for seed in range(6)]) < 9
    rig, port = pair(1.0, 1)
    assert run_handeye(rig, [port], HandeyeOptions(time_offset=False))[2] == ()


def test_the_scale_is_that_of_the_ways_and_none_without_a_way():
    rig, port = pair(1.03, 2)
    found = relative_scale(rig, port, PORT, 0.0)
    assert found is not None
    assert found.value == pytest.approx(1 / 1.03, abs=4 * found.std)
    assert found.std < 3e-3
    still = SE3(rig.world_from_body.rotation, 0.0 * rig.world_from_body.translation)
    turning = trajectory("rig", still, TIMES)
    assert relative_scale(turning, trajectory("port", still * PORT, TIMES), PORT, 0.0) is None
