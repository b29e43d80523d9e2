"""`calibrate_handeye`: exact without noise, honest with it, and never a figure that was unobservable."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry_strategies import transforms
from handeye_scenes import (
    PORT,
    camera,
    drifting,
    jittered,
    planar,
    spin,
    standstill,
    straight,
    trajectory,
    wavy,
)
from rigwake.errors import UnobservableError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, NoiseLevel
from rigwake.handeye.joint_calibration import calibrate_handeye

TIMES = np.arange(300) * 0.1
SYNCHRONOUS = HandeyeOptions(time_offset=False)


def pair(motion, noise=None, mounting=PORT, times=TIMES, seed=0, **fields):
    """Reference and member of one motion, `noise = (function, rotation_std, translation_std)`."""
    rng = np.random.default_rng(seed)
    poses = [motion(times), motion(times) * mounting]
    if noise is not None:
        function, *levels = noise
        poses = [function(p, *levels, rng) for p in poses]
    return trajectory("rig", poses[0], times), trajectory("port", poses[1], times, **fields)


def errors(X: SE3, estimate: SE3) -> np.ndarray:
    """[rotation, translation] about and along the axes of the reference."""
    d = X.local(estimate)
    return np.concatenate([X.rotation @ d[:3], X.rotation @ d[3:]])


@given(
    mounting=transforms(),
    seed=st.integers(0, 2**31),
    noise=st.sampled_from([None, "increments", "poses"]),
    scale=st.sampled_from([None, 0.01, 7.0]),
)
@settings(max_examples=25)
def test_exact_without_noise(mounting, seed, noise, scale):
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(40, 6)) * np.repeat([0.3, 1.0], 3)
    poses = [SE3.exp(rng.normal(size=6))]
    for step in steps:
        poses.append(poses[-1] * SE3.exp(step))
    body = SE3(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
    seen = SE3.exp(rng.normal(size=6)) * (body * mounting)  # in a world of its own
    seen = SE3(seen.rotation, seen.translation * (scale or 1.0))
    times = np.arange(len(body)) * 0.1
    result = calibrate_handeye(
        trajectory("rig", body, times),
        [trajectory("cam", seen, times, is_metric=scale is None)],
        HandeyeOptions(noise=noise, time_offset=False),
    )
    size = max(1.0, float(np.linalg.norm(mounting.translation)))
    assert np.abs(mounting.local(result.ref_from_members["cam"])).max() < 1e-9 * size
    if scale is not None:
        assert result.members["cam"].scale == pytest.approx(1 / scale, rel=1e-9)


@pytest.mark.parametrize(("kind", "function"), [("increments", drifting), ("poses", jittered)])
def test_covariance_is_honest(kind, function):
    level = NoiseLevel(1e-3, 5e-3)
    options = HandeyeOptions(noise=kind, time_offset=False, levels={"rig": level, "port": level})
    nees = []
    for seed in range(40):
        noise = (function, level.rotation_std, level.translation_std)
        result = calibrate_handeye(*_one(pair(wavy, noise, times=TIMES[:120], seed=seed)), options)
        d = PORT.local(result.ref_from_members["port"])
        nees.append(d @ np.linalg.solve(result.joint_covariance, d))
    # mean of 40 chi-square variables of 6 degrees of freedom: 95 % lie within 4.97 .. 7.12, 99.9 % within these
    assert 4.3 < np.mean(nees) < 8.0


def _one(trajectories):
    reference, member = trajectories
    return reference, [member]


def test_clock_scale_and_mounting_together():
    times = np.arange(600) * 0.05
    reference = trajectory("rig", wavy(times), times)
    offset, scale = -250.123, 0.2
    own = np.arange(30, 500) * 0.061  # another rate, starts later, ends earlier
    seen = wavy(own) * PORT
    member = trajectory("cam", SE3(seen.rotation, seen.translation * scale), own - offset, is_metric=False)
    result = calibrate_handeye(reference, [member])
    cam = result.members["cam"]
    assert cam.time_offset_s == pytest.approx(offset, abs=2e-4)
    assert cam.scale == pytest.approx(1 / scale, rel=1e-3)
    assert np.abs(errors(PORT, result.ref_from_members["cam"])[:3]).max() < 1e-3
    assert np.abs(errors(PORT, result.ref_from_members["cam"])[3:]).max() < 5e-3


def test_scale_of_every_segment():
    reference, member = pair(wavy)
    half = len(TIMES) // 2
    factors = np.where(np.arange(len(TIMES)) < half, 0.5, 3.0)
    seen = SE3(member.world_from_body.rotation, member.world_from_body.translation * factors[:, None])
    ids = (np.arange(len(TIMES)) >= half).astype(np.int64)
    member = trajectory("port", seen, TIMES, is_metric=False, segment_ids=ids)
    result = calibrate_handeye(reference, [member], SYNCHRONOUS)
    assert result.scales["port"][:, 0] == pytest.approx([2.0, 1 / 3], rel=1e-8)
    assert np.abs(errors(PORT, result.ref_from_members["port"])).max() < 1e-8


def test_members_are_solved_jointly_and_share_the_noise_of_the_reference():
    starboard = camera(-90, 15, [0.0, -1.2, 1.4])
    rng = np.random.default_rng(5)
    poses = [wavy(TIMES) * X for X in (SE3.identity(), PORT, starboard)]
    noisy = [drifting(p, s * 1e-3, s * 1e-2, rng) for p, s in zip(poses, (3.0, 0.3, 0.3), strict=True)]
    names = ("rig", "port", "starboard")
    levels = {n: NoiseLevel(s * 1e-3, s * 1e-2) for n, s in zip(names, (3.0, 0.3, 0.3), strict=True)}
    trajectories = [trajectory(n, p, TIMES) for n, p in zip(names, noisy, strict=True)]
    options = HandeyeOptions(noise="increments", time_offset=False, levels=levels)
    result = calibrate_handeye(trajectories[0], trajectories[1:], options)
    X, Y = result.ref_from_members["port"], result.ref_from_members["starboard"]
    between = (PORT.inverse() * starboard).local(X.inverse() * Y)
    # d(X^-1 Y) = dY - Ad(Y^-1 X) dX: far better known than either, through their correlation
    J = np.hstack([-(Y.inverse() * X).adjoint(), np.eye(6)])
    covariance = J @ result.joint_covariance @ J.T
    assert np.sqrt(np.trace(covariance[:3, :3])) < 0.3 * np.sqrt(np.trace(result.joint_covariance[:3, :3]))
    assert between @ np.linalg.solve(covariance, between) < 22.5  # 99.9 % of 6 degrees of freedom


def test_gaps_and_outliers_do_not_bend_the_result():
    rng = np.random.default_rng(8)
    reference, member = pair(wavy, (drifting, 2e-4, 1e-3))
    poses = member.world_from_body
    jump = SE3.exp([0.2, -0.1, 0.3, 2.0, 1.0, -1.0])
    poses = SE3(poses.rotation.copy(), poses.translation.copy())
    for start in (60, 140, 200):
        moved = jump * poses[start:]
        poses.rotation[start:], poses.translation[start:] = moved.rotation, moved.translation
    kept = np.flatnonzero((np.arange(300) < 90) | (np.arange(300) > 120) & (rng.random(300) > 0.2))
    member = trajectory("port", poses[kept], TIMES[kept])
    result = calibrate_handeye(reference, [member])
    assert result.down_weighted >= 3
    found = result.members["port"]
    sigmas = errors(PORT, result.ref_from_members["port"]) / np.sqrt(np.diag(found.covariance_rig_axes))
    assert np.abs(sigmas).max() < 4
    assert np.abs(errors(PORT, result.ref_from_members["port"])[3:]).max() < 0.03


ROTATION_Z, X, Y, Z = 2, 3, 4, 5
DEGENERATE = {
    "planar": (planar, {Z}),
    "straight": (straight, {0, X, Y, Z}),
    "one axis": (spin, {ROTATION_Z, X, Y, Z}),
}


@pytest.mark.parametrize(
    "noise", [None, (drifting, 1e-4, 1e-3), (drifting, 3e-4, 3e-3)], ids=["exact", "little noise", "noise"]
)
@pytest.mark.parametrize("name", DEGENERATE)
def test_open_axes_are_marked_and_the_others_right(name, noise):
    motion, open_axes = DEGENERATE[name]
    result = calibrate_handeye(*_one(pair(motion, noise)))
    port = result.members["port"]
    assert set(np.flatnonzero(~port.observable_axes)) == open_axes
    known = port.observable_axes
    variances = np.where(known, np.diag(np.nan_to_num(port.covariance_rig_axes)), 1.0)
    if known[:3].all():
        off = errors(PORT, result.ref_from_members["port"])[known]
        assert np.all(np.abs(off) < 3.5 * np.sqrt(variances[known]) + 1e-9)
    else:
        assert np.isnan(port.rig_from_cam.rotation).all()
    assert np.isnan(port.rig_from_cam.translation[[i - 3 for i in open_axes if i > 2]]).all()
    assert all(d.words and d.remedy for d in port.unobservable)


def test_standing_still_is_refused():
    for noise in (None, (drifting, 1e-4, 1e-3), (jittered, 1e-4, 1e-3)):
        with pytest.raises(UnobservableError, match="determines nothing"):
            calibrate_handeye(*_one(pair(standstill, noise)))


def test_too_short_is_refused():
    with pytest.raises(UnobservableError, match="share 3 poses"):
        calibrate_handeye(*_one(pair(wavy, times=TIMES[:3])), SYNCHRONOUS)


def test_noise_adds_no_spurious_roll_and_pitch():
    """Planar motion whose attitude noise is as large as waves would be: the vertical offset stays open."""
    for seed in range(5):
        result = calibrate_handeye(*_one(pair(planar, (jittered, 5e-3, 1e-2), seed=seed)))
        assert not result.members["port"].observable_axes[Z]


def test_monocular_reference_is_refused():
    reference, member = pair(wavy)
    monocular = trajectory("rig", reference.world_from_body, TIMES, is_metric=False)
    with pytest.raises(UsageError, match="up to scale"):
        calibrate_handeye(monocular, [member])
    with pytest.raises(UsageError, match="different names"):
        calibrate_handeye(reference, [reference])


def test_the_thesis_baseline_is_right_without_noise_and_has_no_uncertainty():
    result = calibrate_handeye(*_one(pair(wavy)), HandeyeOptions(method="thesis", time_offset=False))
    assert np.abs(errors(PORT, result.ref_from_members["port"])).max() < 1e-6
    assert np.isnan(result.members["port"].covariance).all()
