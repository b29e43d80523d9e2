"""Sim(3) pose graph: group laws, derivatives, and a loop whose scale had drifted."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odometry_worlds import circling
from rigwake.geometry import so3
from rigwake.odometry.pose_graph import Edges, Similarities, linearised, optimise_pose_graph

LOOP = Similarities.from_transforms(circling(80, seconds_per_turn=8.0))


def some(seed: int, count: int) -> Similarities:
    return Similarities.exp(np.random.default_rng(seed).normal(0, [1, 1, 1, 5, 5, 5, 0.5], (count, 7)))


def applied(transform: Similarities, points: np.ndarray) -> np.ndarray:
    turned = np.einsum("nij,nj->ni", transform.rotation, points)
    return transform.scale[:, None] * turned + transform.translation


def edges_between(first, second, measured, robust=False, std=0.01) -> Edges:
    count = len(first)
    return Edges(first, second, measured, np.full((count, 7), std), np.full(count, robust))


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_group_laws(seed):
    a, b = some(seed, 5), some(seed + 1, 5)
    points = np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(applied(a * b, points), applied(a, applied(b, points)), atol=1e-9)
    np.testing.assert_allclose(applied(a.inverse(), applied(a, points)), points, atol=1e-9)
    np.testing.assert_allclose(Similarities.exp(a.log()).rotation, a.rotation, atol=1e-9)
    np.testing.assert_allclose((a.inverse() * a).log(), 0, atol=1e-9)


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_derivatives_are_those_of_finite_differences(seed):
    nodes, step = some(seed, 2), 1e-6
    noise = Similarities.exp(np.random.default_rng(seed).normal(0, 0.3, (1, 7)))
    edges = edges_between(np.array([0]), np.array([1]), (nodes[:1].inverse() * nodes[1:]) * noise)
    _, *analytic = linearised(nodes, edges)
    for node, jacobian in enumerate(analytic):
        for axis in range(7):
            sides = []
            for sign in (1, -1):
                tangents = np.zeros((2, 7))
                tangents[node, axis] = sign * step
                sides.append(linearised(nodes * Similarities.exp(tangents), edges)[0][0])
            np.testing.assert_allclose(
                jacobian[0, :, axis], (sides[0] - sides[1]) / (2 * step), atol=1e-5, rtol=1e-5
            )


def drifted(growth: float = 0.004) -> tuple[Similarities, Edges]:
    """The loop as odometry sees it, each step longer than the last, and turned a little; with its own edges."""
    count = len(LOOP)
    steps = LOOP[slice(0, -1)].inverse() * LOOP[slice(1, None)]
    wrong = np.zeros((count - 1, 7))
    wrong[:, 1], wrong[:, 6] = 2e-3, growth
    seen = steps * Similarities.exp(wrong)
    nodes = LOOP[slice(0, 1)]
    path = [nodes]
    for k in range(count - 1):
        nodes = nodes * seen[slice(k, k + 1)]
        path.append(nodes)
    # the odometry's own poses have no scale: it does not know that its unit has changed
    estimated = Similarities(
        np.concatenate([p.rotation for p in path]),
        np.concatenate([p.translation for p in path]),
        np.ones(count),
    )
    order = np.arange(count - 1)
    own = estimated[order].inverse() * estimated[order + 1]
    return estimated, edges_between(order, order + 1, own)


def joined(a: Edges, b: Edges) -> Edges:
    measured = [
        np.concatenate([getattr(a.first_from_second, n), getattr(b.first_from_second, n)])
        for n in ("rotation", "translation", "scale")
    ]
    rest = [np.concatenate([getattr(a, n), getattr(b, n)]) for n in ("first", "second", "std", "robust")]
    return Edges(rest[0], rest[1], Similarities(*measured), rest[2], rest[3])


def closing(estimated: Similarities, growth: float = 0.004) -> Edges:
    """The last frame recognised from the first: where it is, and how much its unit has grown."""
    true = LOOP[slice(0, 1)].inverse() * LOOP[slice(-1, None)]
    scale = np.array([np.exp(-growth * (len(LOOP) - 1))])
    return edges_between(
        np.array([0]),
        np.array([len(LOOP) - 1]),
        Similarities(true.rotation, true.translation, scale),
        robust=True,
        std=1e-4,
    )


def worst(nodes: Similarities) -> float:
    return float(np.linalg.norm(nodes.translation - LOOP.translation, axis=1).max())


def test_a_loop_takes_drift_of_scale_and_rotation_away():
    estimated, edges = drifted()
    closed, member = optimise_pose_graph(estimated, joined(edges, closing(estimated)))
    assert member.all()
    assert worst(estimated) > 2.0
    assert worst(closed) < 0.25 * worst(estimated)
    # units shrink steadily by what the loop showed
    np.testing.assert_allclose(np.diff(np.log(closed.scale)), -0.004, atol=5e-4)


def test_a_wrong_loop_among_right_ones_has_little_say():
    estimated, edges = drifted()
    good = closing(estimated)
    wrong = Similarities.exp(np.array([[0, 0, 1.0, 9.0, -7.0, 3.0, 0.7]]))
    bad = edges_between(np.array([10]), np.array([50]), wrong, robust=True, std=1e-4)
    closed, _ = optimise_pose_graph(estimated, joined(joined(edges, good), bad))
    assert worst(closed) < 0.5 * worst(estimated)


def test_a_graph_without_contradiction_stays():
    estimated, edges = drifted()
    closed, _ = optimise_pose_graph(estimated, edges)
    np.testing.assert_allclose(closed.translation, estimated.translation, atol=1e-8)
    np.testing.assert_allclose(closed.scale, 1.0, atol=1e-9)


def test_parts_without_a_loop_between_them_are_told_apart():
    estimated, edges = drifted()
    cut = np.flatnonzero(edges.first != 20)
    two = Edges(
        edges.first[cut], edges.second[cut], edges.first_from_second[cut], edges.std[cut], edges.robust[cut]
    )
    moved = Similarities(estimated.rotation, estimated.translation + 1.0, estimated.scale)
    closed, member = optimise_pose_graph(moved, two)
    np.testing.assert_array_equal(member, np.arange(len(LOOP)) > 20)
    np.testing.assert_array_equal(closed.translation[:21], moved.translation[:21])


@pytest.mark.parametrize("angle", [0.0, 3.0])
def test_exp_of_a_pure_rotation_has_scale_one(angle):
    one = Similarities.exp(np.array([[angle, 0, 0, 0, 0, 0, 0]]))
    np.testing.assert_allclose(one.rotation[0], so3.exp(np.array([angle, 0, 0])))
    assert one.scale[0] == 1.0
