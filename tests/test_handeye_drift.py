"""Hand-eye: what changes during a recording is named, and lengths that no odometry errs by."""

from dataclasses import replace

import numpy as np
import pytest

from handeye_scenes import PORT, drifting, planar, straight, trajectory, wavy
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.pipeline.handeye_run import run_handeye
from rigwake.plausibility.handeye_drift import _strides, check_steadiness
from rigwake.trajectory import Trajectory

TIMES = np.arange(600) * 0.15


def pair(motion=wavy, seed: int = 0, times=TIMES) -> tuple[Trajectory, Trajectory]:
    rng = np.random.default_rng(seed)
    poses = (drifting(p, 1e-3, 5e-3, rng) for p in (motion(times), motion(times) * PORT))
    rig, port = (trajectory(n, p, times) for n, p in zip(("rig", "port"), poses, strict=True))
    return rig, port


def refusal(rig: Trajectory, port: Trajectory) -> str:
    with pytest.raises(InputError) as raised:
        run_handeye(rig, [port], HandeyeOptions())
    return str(raised.value)


@pytest.mark.parametrize("motion", [wavy, planar, straight])
@pytest.mark.parametrize("seed", [1, 2])
def test_good_pairs_are_not_accused(motion, seed: int) -> None:
    rig, port = pair(motion, seed)
    result = calibrate_handeye(rig, [port])
    assert check_steadiness(rig, port, result) == ()


def test_lengths_half_as_long_again_are_refused() -> None:
    rig, port = pair()
    port = replace(port, world_from_body=scaled(port.world_from_body, 1.5))
    assert "its lengths are 1.50" in refusal(rig, port)


def test_a_clock_at_another_rate() -> None:
    rig, port = pair()
    stamps = port.timestamps_ns
    slow = (stamps[0] + (stamps - stamps[0]) * 1.002).astype(np.int64)
    assert "0.20% faster" in refusal(rig, replace(port, timestamps_ns=slow))


def test_a_body_knocked_halfway() -> None:
    rig, port = pair()
    knock = SE3(so3.exp(np.radians([0.0, 3.0, 0.0])), np.zeros(3))
    poses = port.world_from_body
    turned = SE3(poses.rotation.copy(), poses.translation.copy())
    after = TIMES >= 50
    turned.rotation[after] = (poses[after] * knock).rotation
    said = refusal(rig, replace(port, world_from_body=turned))
    assert "turned by 3.0 deg on the rig, about 50 s" in said


def test_a_frozen_pose() -> None:
    rig, port = pair()
    poses = port.world_from_body
    held = SE3(poses.rotation.copy(), poses.translation.copy())
    held.rotation[200:260], held.translation[200:260] = poses.rotation[200], poses.translation[200]
    assert "exactly the same from 30.0 to 38." in refusal(rig, replace(port, world_from_body=held))


def scaled(poses: SE3, factor: float) -> SE3:
    return SE3(poses.rotation, factor * poses.translation)


def test_a_gap_of_the_reference_is_no_change() -> None:
    times = np.arange(0, 200, 0.2)
    rig, port = pair(times=times)
    kept, result = rig.take(np.flatnonzero((times < 60) | (times > 95))), calibrate_handeye(rig, [port])
    assert check_steadiness(kept, port, result) == ()
    strides = _strides(kept, port, result)
    assert strides is not None
    assert not np.any((strides.times_s > 60) & (strides.times_s < 95))


@pytest.mark.parametrize("seed", [1, 2])
def test_slow_drift_of_an_odometry_is_no_change(seed: int) -> None:
    """A scale that drifts by 3 %, and a heading of the reference that wanders by 0.4 deg over two minutes."""
    times = np.arange(0, 300, 0.3)
    rig, port = pair(planar, seed, times)
    steps = port.world_from_body[:-1].inverse() * port.world_from_body[1:]
    grown = SE3(steps.rotation, steps.translation * np.linspace(1.0, 1.03, len(steps))[:, None])
    drifted = [port.world_from_body[0]]
    for step in grown:
        drifted.append(drifted[-1] * step)
    rng, heading = np.random.default_rng(seed), [0.0]
    for _ in times[1:]:
        heading.append(heading[-1] * (1 - 0.3 / 120) + 0.4 * np.sqrt(0.6 / 120) * rng.normal())
    turned = rig.world_from_body * SE3(
        so3.exp(np.radians(np.outer(heading, [0, 0, 1]))), np.zeros((len(times), 3))
    )
    for one, other in (
        (rig, replace(port, world_from_body=stacked(drifted))),
        (replace(rig, world_from_body=turned), port),
    ):
        assert check_steadiness(one, other, calibrate_handeye(one, [other])) == ()


def test_noise_at_a_mooring_is_no_scale() -> None:
    times = np.arange(0, 240, 0.2)
    roll = np.outer(0.14 * np.sin(times), [1, 0, 0]) + np.outer(0.1 * np.sin(0.7 * times), [0, 1, 0.4])
    sway = 0.15 * np.stack([np.sin(0.3 * times), np.sin(0.23 * times), np.sin(0.9 * times)], axis=1)
    moored = SE3(so3.exp(roll), sway)
    rng = np.random.default_rng(0)
    rig = trajectory("rig", moored, times)
    port = trajectory("port", drifting(moored * PORT, 1e-3, 1e-2, rng), times)
    _, checks, noticed = run_handeye(rig, [port], HandeyeOptions())
    assert all(check.agrees for check in checks)
    assert noticed == ()


def stacked(poses: list[SE3]) -> SE3:
    return SE3(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
