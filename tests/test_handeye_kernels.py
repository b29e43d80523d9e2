"""The compiled loops of hand-eye say what `geometry.se3` says, and their Jacobians are derivatives."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry_strategies import transforms
from handeye_scenes import PORT, drifting, trajectory, wavy
from rigwake.geometry.se3 import SE3
from rigwake.handeye import kernels, noise_kernels, normal_kernels
from rigwake.handeye.motions import (
    Mounting,
    MountingLayout,
    TrajectoryCurve,
    linearise,
    residuals,
    steps_between,
)

TIMES = np.arange(40) * 0.1


@given(a=transforms(), b=transforms(), scale=st.floats(0.1, 10))
@settings(max_examples=60)
def test_motions_logarithms_and_retractions_agree_with_se3(a, b, scale):
    poses = SE3(np.stack([a.rotation, b.rotation]), np.stack([a.translation, b.translation]) * scale)
    motion = SE3(*kernels.motions(poses.rotation, poses.translation, np.arange(1), 1))
    expected = poses[0].inverse() * poses[1]
    size = 1 + np.abs(poses.translation).max()
    assert np.abs(motion[0].matrix - expected.matrix).max() < 1e-12 * size
    tangent = kernels.tangents(poses.rotation, poses.translation)
    back = SE3(*kernels.retracted(*_identities(2), tangent))
    assert np.abs(back.matrix - poses.matrix).max() < 1e-7 * size  # half turns: the root of rounding
    turns = kernels.rotation_vectors(poses.rotation)
    assert np.array_equal(turns, tangent[:, :3])


def _identities(count):
    identity = SE3.identity((count,))
    return identity.rotation, identity.translation


def _pair():
    rng = np.random.default_rng(3)
    poses = [drifting(wavy(TIMES) * X, 1e-3, 1e-2, rng) for X in (SE3.identity(), PORT)]
    return [TrajectoryCurve.of(trajectory(n, p, TIMES)) for n, p in zip(("rig", "port"), poses, strict=True)]


@pytest.mark.parametrize("absolute", [False, True])
def test_jacobians_are_derivatives_where_the_noise_is_small(absolute):
    body = wavy(TIMES)
    reference, member = (
        TrajectoryCurve.of(trajectory("x", body * X, TIMES)).at_poses for X in (SE3.identity(), PORT)
    )
    layout = MountingLayout(1 if absolute else 0, False, 1)
    start = Mounting(PORT, SE3.identity((1,)) if absolute else None, 0.0, np.zeros(1))
    steps = steps_between(reference, member, absolute)
    J = linearise(steps, start, layout, np.zeros((len(steps.valid), 6))).jacobians
    for c in range(layout.size):
        step = np.zeros(layout.size)
        step[c] = 1e-6
        moved = [residuals(steps, start.retract(sign * step, layout)) for sign in (1, -1)]
        assert (moved[0] - moved[1]) / 2e-6 == pytest.approx(J[:, :, c], abs=1e-7)


def test_samples_pass_through_the_poses_and_end_with_them():
    curve = _pair()[0]
    at = curve.at(np.concatenate([TIMES, TIMES[:-1] + 0.05, [-1.0, TIMES[-1] + 1]]))
    here = at.world_from_body[: len(TIMES)]
    assert np.abs(here.matrix - curve.world_from_body.matrix).max() < 1e-12
    assert np.array_equal(at.segments, [0] * (2 * len(TIMES) - 1) + [-1, -1])


def test_information_and_scores_are_those_of_stacked_matrices():
    rng = np.random.default_rng(0)
    n, steps = 5000, np.arange(0, 5000, 2)  # more than one tile
    J, W = rng.normal(size=(n, 6, 7)), _spd(rng, 12)
    weights = rng.uniform(0.2, 1, n)
    for covariances in (W[None], np.stack([W * (1 + i % 3) for i in range(len(steps))])):
        found = np.zeros((14, 14))
        normal_kernels.add_information(J, J, covariances, (0, 6), weights, steps, found, (0, 7))
        middle = np.broadcast_to(covariances[:, :6, 6:], (len(steps), 6, 6))
        expected = np.einsum("n,nar,nab,nbc->rc", weights[steps], J[steps], middle, J[steps], optimize=True)
        assert found[:7, 7:] == pytest.approx(expected, rel=1e-9, abs=1e-6)
        assert not found[:7, :7].any()
        assert not found[7:].any()


def _spd(rng, size):
    root = rng.normal(size=(size, size))
    return root @ root.T + np.eye(size)


def test_spurious_information_is_the_mean_of_squared_changes():
    """Against errors drawn at random: `E[(ad(e) Ad)^T W ad(e) Ad]`."""
    rng = np.random.default_rng(1)
    covariance, W = 1e-2 * _spd(rng, 6), _spd(rng, 6)
    X = SE3.exp(rng.normal(size=(1, 6)))
    found = normal_kernels.spurious(
        covariance[None],
        W[None],
        X.adjoint(),
        np.zeros((1, 3)),
        np.zeros(1, int),
        np.zeros(1, int),
        0,
        6,
        6,
        0,
    )
    total = np.zeros((6, 6))
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=20_000)
    for e in errors:
        ad = np.zeros((6, 6))
        for vector, rows, columns in ((e[:3], 0, 0), (e[:3], 3, 3), (e[3:], 3, 0)):
            x, y, z = vector
            ad[rows : rows + 3, columns : columns + 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        D = ad @ X.adjoint()[0]
        total += D.T @ W @ D
    assert found == pytest.approx(total / len(errors), rel=0.05, abs=0.05 * np.abs(found).max())


def test_propagated_covariance_is_that_of_adjoints():
    rng = np.random.default_rng(2)
    mountings = SE3.exp(rng.normal(size=(2, 6)))
    reference, members = _spd(rng, 6) * 1e-8, np.stack([_spd(rng, 6), _spd(rng, 6)]) * 1e-8
    total, of_reference = noise_kernels.propagated(
        mountings.rotation, mountings.translation, reference[None], members[:, None], np.zeros(6)
    )
    stacked = np.concatenate(list(mountings.inverse().adjoint()))
    assert of_reference[0] == pytest.approx(stacked @ reference @ stacked.T, rel=1e-9, abs=1e-18)
    own = total[0] - of_reference[0]
    assert own[:6, :6] == pytest.approx(members[0], rel=1e-5, abs=1e-13)  # and products of two errors
    assert not own[:6, 6:].any()
