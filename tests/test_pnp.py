"""PnP on bearings: recovery among outliers, derivatives, honest covariance, agreement with OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigwake.errors import EstimationError
from rigwake.geometry import pnp
from rigwake.geometry.se3 import SE3


def resection(seed: int, n: int = 100, noise: float = 0.0, outliers: float = 0.0):
    rng = np.random.default_rng(seed)
    world_from_cam = SE3.exp(np.concatenate([rng.normal(0, 1, 3), rng.normal(0, 5, 3)]))
    points_cam = rng.normal(size=(n, 3))
    points_cam *= rng.uniform(2, 15, (n, 1)) / np.linalg.norm(points_cam, axis=1, keepdims=True)
    bearings = points_cam / np.linalg.norm(points_cam, axis=1, keepdims=True) + rng.normal(0, noise, (n, 3))
    wrong = rng.random(n) < outliers
    bearings[wrong] = rng.normal(size=(wrong.sum(), 3))
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    return world_from_cam, world_from_cam * points_cam, bearings, wrong


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_recovers_pose_among_outliers_all_around_the_camera(seed):
    truth, points, bearings, wrong = resection(seed, noise=1e-3, outliers=0.4)
    found = pnp.absolute_pose(
        points,
        bearings,
        max_angles=np.array(5e-3),
        angle_stds=np.array(1e-3),
        rng=np.random.default_rng(seed),
    )
    error = truth.local(found.world_from_cam)
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.1
    assert np.linalg.norm(error[3:]) < 0.02
    assert found.inliers[~wrong].mean() > 0.95
    assert found.inliers[wrong].mean() < 0.05


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_gradient_matches_finite_differences_of_the_cost(seed):
    truth, points, bearings, _ = resection(seed, n=30, noise=5e-3)
    x = truth.retract(np.random.default_rng(seed).normal(0, 5e-3, 6))
    stds = np.full(30, 5e-3)

    def cost(delta: np.ndarray) -> float:
        y = x.retract(delta)
        return pnp._normal_equations(y.rotation, y.translation, points, bearings, stds, 3.0)[2]

    gradient = pnp._normal_equations(x.rotation, x.translation, points, bearings, stds, 3.0)[1]
    numeric = [(cost(e) - cost(-e)) / 2e-6 for e in np.eye(6) * 1e-6]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-3 * np.abs(gradient).max())


def test_covariance_is_honest():
    nees = []
    for seed in range(150):
        truth, points, bearings, _ = resection(seed, n=40, noise=2e-3)
        x, covariance = pnp.refine_absolute_pose(truth, points, bearings, np.full(40, 2e-3), robust_scale=100)
        error = x.local(truth)
        nees.append(error @ np.linalg.solve(covariance, error))
    assert 5.2 < np.mean(nees) < 6.9  # chi-square with 6 degrees of freedom, mean of 150


def test_agrees_with_opencv_in_front_of_a_pinhole():
    truth, points, bearings, _ = resection(3, n=200, noise=1e-3)
    front = bearings[:, 2] > 0.4
    points, bearings = points[front], bearings[front]
    x, _ = pnp.refine_absolute_pose(
        truth.retract([0.05, 0, 0.05, 0.1, 0.1, 0]), points, bearings, np.full(len(points), 1e-3)
    )
    _, rotation_vector, translation = cv2.solvePnP(points, bearings[:, :2] / bearings[:, 2:], np.eye(3), None)
    peer = SE3(cv2.Rodrigues(rotation_vector)[0], translation[:, 0]).inverse()
    assert np.linalg.norm(peer.local(x)[:3]) < 1e-3
    assert np.linalg.norm(peer.local(x)[3:]) < 1e-2


def test_refuses_what_cannot_work():
    _, points, bearings, _ = resection(0)
    gates = {"max_angles": np.array(1e-3), "angle_stds": np.array(1e-3), "rng": np.random.default_rng(0)}
    with pytest.raises(EstimationError, match="at least 3"):
        pnp.absolute_pose(points[:2], bearings[:2], **gates)
    with pytest.raises(EstimationError, match="finite"):
        pnp.absolute_pose(points, bearings * np.nan, **gates)


def test_a_damped_step_solves_the_normal_equations():
    rng = np.random.default_rng(5)
    for damping in (0.0, 1e-6, 10.0):
        jacobian, gradient = rng.normal(size=(12, 6)) * np.logspace(0, 3, 6), rng.normal(size=6)
        matrix = jacobian.T @ jacobian
        damped = matrix + damping * np.diag(np.diag(matrix) + 1e-12)
        expected = -np.linalg.solve(damped, gradient)
        np.testing.assert_allclose(pnp._damped_step(matrix, gradient, damping), expected, rtol=1e-8)
