"""Relative pose on bearings: exact recovery, outliers, points behind the image plane, degenerate motion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry_strategies import rotation_vectors
from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.geometry.two_view import (
    in_front,
    refine_relative_pose,
    relative_pose,
    relative_pose_known_rotation,
    rotation_between,
    sampson_angles,
)


def two_views(seed: int, n: int = 120, noise: float = 0.0, outliers: float = 0.0, baseline: float = 0.5):
    """Points all around the camera (so many have z < 0), seen from two places."""
    rng = np.random.default_rng(seed)
    second_from_first = SE3(so3.exp(rng.normal(0, 0.2, 3)), rng.normal(size=3))
    length = np.linalg.norm(second_from_first.translation)
    second_from_first = SE3(second_from_first.rotation, second_from_first.translation * baseline / length)
    directions = rng.normal(size=(n, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(2, 8, (n, 1))
    bearings = []
    for seen in (points, second_from_first * points):
        b = seen / np.linalg.norm(seen, axis=1, keepdims=True) + rng.normal(0, noise, (n, 3))
        bearings.append(b / np.linalg.norm(b, axis=1, keepdims=True))
    wrong = rng.random(n) < outliers
    b = rng.normal(size=(wrong.sum(), 3))
    bearings[1][wrong] = b / np.linalg.norm(b, axis=1, keepdims=True)
    return second_from_first, *bearings, wrong


def degrees_apart(a: SE3, b: SE3) -> tuple[float, float]:
    turn = np.linalg.norm(so3.log(a.rotation.T @ b.rotation))
    ta, tb = (x.translation / np.linalg.norm(x.translation) for x in (a, b))
    return np.rad2deg(turn), np.rad2deg(np.arctan2(np.linalg.norm(np.cross(ta, tb)), ta @ tb))


@pytest.mark.parametrize("solver", ["five-point", "eight-point"])
@pytest.mark.parametrize("seed", range(4))
def test_recovers_pose_among_outliers_all_around_the_camera(solver, seed):
    truth, first, second, wrong = two_views(seed, noise=1e-3, outliers=0.3)
    found = relative_pose(first, second, max_angle=4e-3, rng=np.random.default_rng(seed), solver=solver)
    rotation_deg, direction_deg = degrees_apart(truth, found.second_from_first)
    assert rotation_deg < 0.1
    assert direction_deg < (0.5 if solver == "five-point" else 1.5)
    assert found.inliers[~wrong].mean() > 0.9
    assert found.inliers[wrong].mean() < 0.1


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_known_rotation_recovers_the_direction_with_its_sign(seed):
    truth, first, second, wrong = two_views(seed, noise=3e-4, outliers=0.5)
    found = relative_pose_known_rotation(
        truth.rotation, first, second, max_angle=2e-3, rng=np.random.default_rng(seed)
    )
    assert degrees_apart(truth, found.second_from_first)[1] < 1.0
    assert found.inliers[~wrong].mean() > 0.85


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_true_pairs_obey_the_constraint_and_meet_in_front(seed):
    truth, first, second, _ = two_views(seed)
    assert sampson_angles(truth, first, second).max() < 1e-10
    assert in_front(truth, first, second).all()
    mirrored = SE3(truth.rotation, -truth.translation)
    assert not in_front(mirrored, first, second).any()


def test_sampson_angle_is_the_angle_that_noise_adds():
    rng = np.random.default_rng(0)
    truth, first, second, _ = two_views(1, n=4000)
    noise = 1e-3
    noisy = []
    for b in (first, second):
        moved = b + rng.normal(0, noise, b.shape)
        noisy.append(moved / np.linalg.norm(moved, axis=1, keepdims=True))
    assert sampson_angles(truth, *noisy).std() == pytest.approx(noise * np.sqrt(1 - 2 / np.pi), rel=0.05)


def test_refinement_reaches_the_noise_limit_from_a_rough_start():
    truth, first, second, _ = two_views(3, n=400, noise=1e-3)
    rough = truth.retract([0.02, -0.02, 0.02, 0.03, 0.02, 0.03])
    rotation_deg, direction_deg = degrees_apart(truth, refine_relative_pose(rough, first, second))
    assert rotation_deg < 0.03
    assert direction_deg < 0.15


@settings(max_examples=25)
@given(rotation_vectors(max_angle=2.0), st.integers(0, 1000))
def test_pure_rotation_is_found_and_shows_no_parallax(rotation_vector, seed):
    _, first, _, _ = two_views(seed)
    R = so3.exp(rotation_vector)
    second = first @ R.T
    np.testing.assert_allclose(rotation_between(first, second), R, atol=1e-9)
    with pytest.raises(EstimationError, match="No sample"):
        relative_pose_known_rotation(R, first, second, max_angle=1e-3, rng=np.random.default_rng(seed))


def test_same_seed_same_answer():
    _, first, second, _ = two_views(5, noise=1e-3, outliers=0.3)
    runs = [relative_pose(first, second, max_angle=3e-3, rng=np.random.default_rng(7)) for _ in range(2)]
    np.testing.assert_array_equal(
        runs[0].second_from_first.translation, runs[1].second_from_first.translation
    )


def test_refuses_what_cannot_work():
    _, first, second, _ = two_views(0)
    rng = np.random.default_rng(0)
    with pytest.raises(EstimationError, match="at least 5"):
        relative_pose(first[:4], second[:4], max_angle=1e-3, rng=rng)
    with pytest.raises(EstimationError, match="five-point"):
        relative_pose(first, second, max_angle=1e-3, rng=rng, solver="four-point")
    broken = second.copy()
    broken[3] = np.nan
    with pytest.raises(EstimationError, match="NaN"):
        relative_pose(first, broken, max_angle=1e-3, rng=rng)
    with pytest.raises(EstimationError, match=r"\(N, 3\)"):
        relative_pose(first, second[:-1], max_angle=1e-3, rng=rng)
