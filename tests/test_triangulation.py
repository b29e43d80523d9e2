"""Triangulation from rays: exact recovery in every direction, noise bounds, parallax and cheirality gates."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.geometry.triangulation import triangulate_midpoint, triangulate_rays


def triangulate_dlt(
    second_from_first: SE3, bearings_first: np.ndarray, bearings_second: np.ndarray
) -> np.ndarray:
    """Linear two-view triangulation: the null vector of `[b1]x X = 0, [b2]x (R X + t) = 0`.

    Hartley and Zisserman 12.2, with bearings for pixels. (N, 3), (N, 3) -> points in the first camera's frame (N, 3).
    """
    first_from_first = SE3.identity()
    rows = []
    for cam_from_first, bearings in (
        (first_from_first, bearings_first),
        (second_from_first, bearings_second),
    ):
        projection = np.column_stack([cam_from_first.rotation, cam_from_first.translation])
        rows.append(np.einsum("nij,jk->nik", so3.hat(bearings), projection))
    homogeneous = np.linalg.svd(np.concatenate(rows, axis=1))[2][:, -1]
    return np.asarray(homogeneous[:, :3] / homogeneous[:, 3:])


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def scene(seed: int, n: int = 60) -> tuple[SE3, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    second_from_first = SE3(so3.exp(rng.normal(0, 0.3, 3)), 0.7 * unit(rng.normal(size=3)))
    points = unit(rng.normal(size=(n, 3))) * rng.uniform(1.5, 10, (n, 1))
    # keep off the baseline, where no method can triangulate
    centre = second_from_first.inverse().translation
    points = points[np.abs(unit(points) @ unit(centre)) < 0.95]
    return second_from_first, points, unit(points), unit(second_from_first * points)


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_two_view_methods_are_exact_behind_the_image_plane_too(seed):
    second_from_first, points, first, second = scene(seed)
    assert (points[:, 2] < 0).any()
    np.testing.assert_allclose(
        triangulate_dlt(second_from_first, first, second), points, rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(
        triangulate_midpoint(second_from_first, first, second), points, rtol=1e-6, atol=1e-6
    )


def many_rays(seed: int, noise: float, views: int = 8, n: int = 200):
    rng = np.random.default_rng(seed)
    points = unit(rng.normal(size=(n, 3))) * rng.uniform(3, 10, (n, 1))
    centres = rng.normal(0, 0.7, (views, 3))
    origins = np.tile(centres, (n, 1))
    directions = unit(unit(np.repeat(points, views, axis=0) - origins) + rng.normal(0, noise, (n * views, 3)))
    return points, origins, directions, np.arange(0, n * views + 1, views)


def test_many_rays_reach_the_noise_limit_and_refinement_helps():
    noise = 2e-3
    points, origins, directions, starts = many_rays(0, noise)
    refined = triangulate_rays(origins, directions, starts)
    plain = triangulate_rays(origins, directions, starts, refine=False)
    # Cramer-Rao bound of a point from its rays: information sum (I - d d^T) / (range * noise)^2
    rays = np.repeat(points, 8, axis=0) - origins
    ranges = np.linalg.norm(rays, axis=1)
    d = rays / ranges[:, None]
    information = (np.eye(3) - d[:, :, None] * d[:, None, :]) / (ranges * noise)[:, None, None] ** 2
    bound = np.linalg.inv(information.reshape(-1, 8, 3, 3).sum(1))
    errors = refined.points - points
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(bound), errors)
    assert 2.5 < nees.mean() < 3.5
    assert np.abs(plain.points - points).mean() >= np.abs(errors).mean() * 0.98
    np.testing.assert_allclose(np.sqrt((refined.rms_angle**2).mean()), noise * np.sqrt(2), rtol=0.15)


def test_parallax_is_the_angle_at_the_point():
    origins = np.array([[0.0, 0, 0], [1, 0, 0]])
    directions = unit(np.array([[0.0, 0, 1], [-1, 0, 1]]))
    result = triangulate_rays(origins, directions, np.array([0, 2]))
    np.testing.assert_allclose(result.points, [[0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(result.max_parallax, np.pi / 4)
    assert result.accepted(min_parallax=0.1, max_rms_angle=1e-6).all()
    assert not result.accepted(min_parallax=1.0, max_rms_angle=1e-6).any()


def test_gates_points_behind_their_rays_and_rays_that_fix_nothing():
    origins = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0]])
    directions = unit(np.array([[0.0, 0, -1], [1, 0, -1], [0, 0, 1], [0, 0, 1], [0, 1, 0]]))
    result = triangulate_rays(origins, directions, np.array([0, 2, 4, 5]))
    assert not result.ahead[0]
    assert np.isnan(result.points[1]).all()  # parallel rays
    assert np.isnan(result.points[2]).all()  # a single ray
    assert not result.accepted(0.0, np.inf).any()
