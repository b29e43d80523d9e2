"""Whose rotation errors they are, told by the lever arm; and calibration where one side is much the better."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handeye_scenes import camera, drifting, jittered, trajectory, wavy
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, NoiseLevel
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.noise_kernels import levels_by_lever_arm

POSES = 176
TIMES = np.arange(POSES) * 0.2


def residuals(fraction, rotation_std, translation_std, arm, count, rng):
    """Rows `[r_R, r_t]`: rotation errors of both sides, of which the reference's swing the arm."""
    reference, own = (
        rng.normal(size=(count, 3)) * rotation_std * np.sqrt(part) for part in (fraction, 1 - fraction)
    )
    moved = np.cross(arm, reference) + rng.normal(size=(count, 3)) * translation_std
    return np.hstack([reference + own, moved])


@settings(max_examples=30)
@given(
    fraction=st.floats(0.05, 0.95),
    length=st.floats(1.0, 12.0),
    arm_variance=st.floats(1.0, 30.0),
    seed=st.integers(0, 1000),
)
def test_fraction_and_level_are_found(fraction, length, arm_variance, seed):
    rng = np.random.default_rng(seed)
    arm = rng.normal(size=3)
    arm *= length / np.linalg.norm(arm)
    rotation_std = (
        1e-3 * arm_variance / length
    )  # moves the member by `arm_variance` times its own error of 1 mm
    rows = residuals(fraction, rotation_std, 1e-3, arm, 3000, rng)
    found = levels_by_lever_arm(rows, arm, rotation_std**2)
    assert found.fraction == pytest.approx(fraction, abs=0.12)
    assert found.translation == pytest.approx(1e-6, rel=0.15)
    # a fraction known from elsewhere gives the level that goes with it
    assert levels_by_lever_arm(rows, arm, rotation_std**2, fraction).translation == pytest.approx(
        1e-6, rel=0.15
    )


def test_a_short_arm_leaves_the_fraction_in_the_middle():
    rng = np.random.default_rng(0)
    for arm in (np.zeros(3), np.array([1e-3, 0, 0])):
        found = levels_by_lever_arm(residuals(0.0, 1e-3, 1e-2, arm, 500, rng), arm, 1e-6)
        assert found.fraction == pytest.approx(0.5, abs=0.05)
        assert found.translation == pytest.approx(1e-4, rel=0.15)


def test_gross_outliers_do_not_move_the_levels():
    rng = np.random.default_rng(1)
    arm = np.array([2.0, 1.0, 0.0])
    rows = residuals(0.2, 1e-3, 1e-3, arm, 1000, rng)
    clean = levels_by_lever_arm(rows, arm, 1e-6)
    rows[::100] += 3.0
    found = levels_by_lever_arm(rows, arm, 1e-6)
    assert found.fraction == pytest.approx(clean.fraction, abs=0.1)
    assert found.translation < 1.5 * clean.translation


def errors(learnt, sides, mountings, draws=25):
    """(draws * members, 6) errors, and NEES of each, with noise learnt or told."""
    rng = np.random.default_rng(3)
    names = [f"camera{m}" for m in range(len(mountings))]
    levels = dict.fromkeys(names, NoiseLevel(sides[1], 1e-3)) | {"ins": NoiseLevel(sides[0], 1e-3)}
    options = HandeyeOptions() if learnt else HandeyeOptions(noise="increments", levels=levels)
    found, nees = [], []
    for _ in range(draws):
        sailed = wavy(TIMES, 0.1)
        reference = trajectory("ins", drifting(sailed, sides[0], 1e-3, rng), TIMES)
        members = [
            trajectory(name, drifting(sailed * X, sides[1], 1e-3, rng), TIMES)
            for name, X in zip(names, mountings, strict=True)
        ]
        result = calibrate_handeye(reference, members, options)
        for name, X in zip(names, mountings, strict=True):
            d = X.local(result.ref_from_members[name])
            found.append(d)
            nees.append(d @ np.linalg.solve(result.members[name].covariance[:6, :6], d))
    return np.array(found), np.array(nees)


@pytest.mark.parametrize(
    ("arm_m", "sides"),
    [(8.0, (1e-5, 1e-3)), (8.0, (1e-3, 1e-5)), (8.0, (1e-3, 1e-3)), (2.0, (1e-5, 1e-3))],
)
def test_learnt_noise_is_as_good_as_told_whichever_side_is_better(sides, arm_m):
    mountings = [camera(90, 15, [arm_m, 1.2, 1.4])]
    learnt, nees = errors(True, sides, mountings)
    known, _ = errors(False, sides, mountings)
    rmse, best = (np.sqrt(np.mean(e**2, axis=0)).reshape(2, 3).max(axis=1) for e in (learnt, known))
    assert np.all(rmse < 1.25 * best)
    assert 3.0 < np.mean(nees) < 9.0  # 6 is expected


@pytest.mark.slow
@pytest.mark.parametrize("sides", [(1e-5, 1e-3), (1e-3, 1e-5)])
def test_members_together_tell_whose_errors_they_share(sides):
    mountings = [camera(yaw, 15, [8.0, y, 1.4]) for yaw, y in ((90, 1.2), (-90, -1.2), (0, 0.0))]
    learnt, nees = errors(True, sides, mountings, draws=10)
    known, _ = errors(False, sides, mountings, draws=10)
    rmse, best = (np.sqrt(np.mean(e**2, axis=0)).reshape(2, 3).max(axis=1) for e in (learnt, known))
    assert np.all(rmse < 1.4 * best)
    assert 3.0 < np.mean(nees) < 9.0


def test_jitter_of_rotations_is_not_taken_for_drift_by_the_way_sailed():
    X: SE3 = camera(90, 15, [2.0, 1.2, 1.4])
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        sailed = wavy(TIMES, 0.1)
        pair = [
            trajectory(name, jittered(poses, 1e-3, 1e-3, rng), TIMES)
            for name, poses in (("ins", sailed), ("camera", sailed * X))
        ]
        result = calibrate_handeye(pair[0], pair[1:])
        assert result.noise.startswith("poses")
        found.append(X.local(result.ref_from_members["camera"])[3:])
    assert np.sqrt(np.mean(np.array(found) ** 2, axis=0)).max() < 2.5e-3  # 4.4e-3 as increments
