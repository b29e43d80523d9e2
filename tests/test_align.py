import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry_strategies import transforms
from rigwake.errors import EstimationError
from rigwake.geometry.align import align_points
from rigwake.geometry.se3 import SE3

POINTS = np.random.default_rng(0).normal(size=(30, 3)) * [20, 30, 1]


@given(transforms(), st.floats(0.01, 100))
@settings(max_examples=50)
def test_similarity_is_recovered(target_from_source: SE3, scale: float) -> None:
    target = target_from_source * (scale * POINTS)
    found = align_points(POINTS, target, "sim3")
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.target_from_source.matrix, target_from_source.matrix, atol=1e-6)
    moved = found.apply(SE3(np.broadcast_to(np.eye(3), (30, 3, 3)), POINTS))
    np.testing.assert_allclose(moved.translation, target, atol=1e-7 * max(scale, 1))


def test_se3_keeps_the_scale_and_reflections_are_not_taken() -> None:
    mirrored = POINTS * [1, 1, -1]
    found = align_points(POINTS, mirrored, "se3")
    assert found.scale == 1.0
    assert np.linalg.det(found.target_from_source.rotation) == pytest.approx(1.0)


def test_yaw_keeps_the_vertical() -> None:
    truth = SE3.exp(np.array([0, 0, 1.2, 3, 4, 5]))
    found = align_points(POINTS, truth * POINTS, "yaw")
    np.testing.assert_allclose(found.target_from_source.matrix, truth.matrix, atol=1e-9)
    tilted = SE3.exp(np.array([0.2, 0.1, 0, 0, 0, 0]))
    yaw_only = align_points(POINTS, tilted * POINTS, "yaw").target_from_source.rotation
    np.testing.assert_allclose(yaw_only[2], [0, 0, 1], atol=1e-15)


@pytest.mark.parametrize("kind", ["se3", "sim3"])
def test_points_on_a_line_are_refused(kind: str) -> None:
    line = np.outer(np.arange(10.0), [1, 2, 3])
    with pytest.raises(EstimationError, match="one line"):
        align_points(line, line, kind)
    with pytest.raises(EstimationError):
        align_points(np.zeros((5, 3)), np.zeros((5, 3)), kind)
