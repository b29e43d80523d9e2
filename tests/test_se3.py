import numpy as np
import pytest
from hypothesis import given, settings

from geometry_strategies import rotation_vectors, tangents, transforms
from rigwake.geometry import se3, so3
from rigwake.geometry.se3 import SE3


@given(tangents())
def test_exp_and_log_are_inverse(tangent: np.ndarray) -> None:
    np.testing.assert_allclose(SE3.exp(tangent).log(), tangent, atol=1e-9)


@given(rotation_vectors(np.pi))
def test_rotation_log_reaches_half_turns(v: np.ndarray) -> None:
    np.testing.assert_allclose(so3.exp(so3.log(so3.exp(v))), so3.exp(v), atol=1e-12)


def test_log_of_exact_half_turn() -> None:
    R = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(np.abs(so3.log(R)), [0, 0, np.pi], atol=1e-12)


@given(transforms(), transforms(), transforms())
def test_group_laws(a: SE3, b: SE3, c: SE3) -> None:
    np.testing.assert_allclose((a * (b * c)).matrix, ((a * b) * c).matrix, atol=1e-10)
    np.testing.assert_allclose((a * a.inverse()).matrix, np.eye(4), atol=1e-10)
    point = np.array([1.0, -2.0, 3.0])
    np.testing.assert_allclose((a * b) * point, a * (b * point), atol=1e-10)
    np.testing.assert_allclose(a.matrix @ b.matrix, (a * b).matrix, atol=1e-10)


@given(transforms(), tangents())
def test_adjoint_moves_a_perturbation_to_the_left(x: SE3, d: np.ndarray) -> None:
    np.testing.assert_allclose((x * SE3.exp(d)).matrix, (SE3.exp(x.adjoint() @ d) * x).matrix, atol=1e-7)


@given(transforms(), tangents(max_angle=2.0))
def test_retract_and_local_are_inverse(x: SE3, d: np.ndarray) -> None:
    np.testing.assert_allclose(x.local(x.retract(d)), d, atol=1e-8)


def central_difference(function, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    return np.stack([(function(x + e) - function(x - e)) / (2 * step) for e in step * np.eye(len(x))], -1)


@given(tangents(max_angle=3.0))
@settings(max_examples=60)
def test_se3_jacobians_against_finite_differences(tangent: np.ndarray) -> None:
    x = SE3.exp(tangent)
    numeric = central_difference(lambda t: x.local(SE3.exp(t)), tangent)
    scale = max(1.0, np.abs(numeric).max())
    np.testing.assert_allclose(se3.right_jacobian(tangent) / scale, numeric / scale, atol=2e-7)
    product = se3.right_jacobian(tangent) @ se3.right_jacobian_inverse(tangent)
    np.testing.assert_allclose(product, np.eye(6), atol=1e-8 * scale)


@given(rotation_vectors(3.0))
@settings(max_examples=60)
def test_so3_jacobians(v: np.ndarray) -> None:
    numeric = central_difference(lambda w: so3.log(so3.exp(-v) @ so3.exp(w)), v)
    np.testing.assert_allclose(so3.right_jacobian(v), numeric, atol=1e-7)
    np.testing.assert_allclose(so3.right_jacobian(v) @ so3.right_jacobian_inverse(v), np.eye(3), atol=1e-9)
    np.testing.assert_allclose(so3.left_jacobian(v) @ so3.left_jacobian_inverse(v), np.eye(3), atol=1e-9)


@pytest.mark.parametrize("angle", [4.9e-2, 5.1e-2, 0.99e-2, 1.01e-2, 0.99e-4, 1.01e-4])
def test_series_meet_the_closed_forms(angle: float) -> None:
    below = np.array([angle, 0.3 * angle, 0, 1.0, 2.0, 3.0])
    J, step = se3.right_jacobian(below), se3.right_jacobian(below * (1 + 1e-9))
    np.testing.assert_allclose(J, step, atol=1e-8)


@given(rotation_vectors(np.pi))
def test_quaternions_round_trip(v: np.ndarray) -> None:
    R = so3.exp(v)
    q = so3.quat_wxyz_from_matrix(R)
    assert q[0] >= 0
    np.testing.assert_allclose(so3.matrix_from_quat_wxyz(q), R, atol=1e-12)


def test_batches_agree_with_singles() -> None:
    xi = np.random.default_rng(0).normal(size=(4, 5, 6))
    batch = SE3.exp(xi)
    assert batch.shape == (4, 5)
    np.testing.assert_allclose(batch[2, 3].matrix, SE3.exp(xi[2, 3]).matrix)
    np.testing.assert_allclose(batch.log()[1, 1], SE3.exp(xi[1, 1]).log())
    np.testing.assert_allclose(se3.left_jacobian(xi)[0, 2], se3.left_jacobian(xi[0, 2]))


def test_covariance_in_axes_of_a_is_what_a_person_reads_off() -> None:
    rng = np.random.default_rng(1)
    truth = SE3.exp(np.array([0.4, -1.0, 0.3, 1, 2, 3]))
    L = np.tril(rng.normal(size=(6, 6))) * 1e-3
    estimates = truth.retract(rng.normal(size=(20000, 6)) @ L.T)
    errors = np.concatenate(
        [so3.log(estimates.rotation @ truth.rotation.T), estimates.translation - truth.translation], axis=1
    )
    predicted = se3.covariance_in_axes_of_a(truth, L @ L.T)
    np.testing.assert_allclose(np.cov(errors.T), predicted, atol=0.05 * np.abs(predicted).max())


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="SE3 wants"):
        SE3(np.eye(3), np.zeros((2, 3)))
