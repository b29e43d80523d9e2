"""Scores of blocks: derivatives, unbiased steps, honest covariances, what is seen and what is not."""

from __future__ import annotations

import numpy as np
import pytest

from monitor_worlds import Watch, figure_eights, watch
from rigwake.geometry import so3
from rigwake.monitor.pair_kernels import COLUMNS, accumulate, pair_residuals
from rigwake.simulation.track_stream import MountFault

pytestmark = pytest.mark.xdist_group("watch")


def test_derivatives_against_finite_differences() -> None:
    rng = np.random.default_rng(1)
    n = 20
    first = rng.standard_normal((n, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    std = rng.uniform(0.5e-3, 2e-3, (n, 2))
    R = so3.exp(np.array([0.1, -0.2, 0.3]))
    place, t = np.array([0.7, -0.4, 0.3]), np.array([1.8, 0.3, -0.2])
    second = first @ R + 0.02 * rng.standard_normal((n, 3))
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    by_velocity = rng.standard_normal((3, 3))
    turning, drift, rate = rng.standard_normal((3, 3))
    pair = np.zeros(n, dtype=np.int64)

    def residuals(x: np.ndarray) -> np.ndarray:
        """Of changes: mounting (rotation, place, clock), rotation of the rig, velocity."""
        mount = so3.exp(x[:3])
        late = x[6]
        rotation = so3.exp(x[7:10] + turning * late) @ R
        moved = t + by_velocity @ x[10:13] + (drift - np.cross(rate, t)) * late
        p = place + x[3:6]
        way = rotation @ p - p + moved
        out = np.empty(n)
        pair_residuals(first @ mount.T, second @ mount.T, std, pair, rotation[None], way[None], out)
        return out

    way = R @ place - place + t
    products, rows = np.zeros((1, COLUMNS, COLUMNS)), np.empty((n, COLUMNS))
    accumulate(
        first,
        second,
        std,
        np.ones(n),
        pair,
        R[None],
        way[None],
        by_velocity[None],
        place[None],
        turning[None],
        drift[None],
        rate[None],
        products,
        rows,
    )
    np.testing.assert_allclose(-rows[:, -1], residuals(np.zeros(13)), rtol=1e-10)
    for k in range(13):
        h = np.zeros(13)
        h[k] = 1e-6
        numeric = (residuals(h) - residuals(-h)) / 2e-6
        np.testing.assert_allclose(rows[:, k], numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max() + 1e-6)


def test_steps_are_unbiased_and_covariances_honest() -> None:
    """Without a change: over blocks and cameras the whitened steps have mean zero and at most unit variance."""
    _, scores = figure_eights()
    whitened = []
    for k in range(1, len(scores)):
        for c in range(4):
            at = scores.columns(c)
            H, g = scores.H[k][at, at] * scores.inflation[k, c], scores.g[k][at]
            whitened.append(np.linalg.solve(np.linalg.cholesky(H), g))
    z = np.array(whitened)
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(len(z))
    assert 0.1 < float((z**2).mean()) < 1.6
    steps_deg = np.rad2deg(1 / np.sqrt(scores.H[1:, 0, 0]))
    assert steps_deg.max() < 0.02  # about the bow, by ten seconds of figure eights
    assert np.abs(scores.noise[1:] - 1).max() < 0.15


def test_a_step_is_measured_where_it_happened() -> None:
    turned = np.deg2rad([0.05, -0.04, 0.08])
    scores = watch("eights", 40.0, fault=MountFault("left", 0.0, turned_rad=turned)).scores()
    at = scores.columns(scores.cameras.index("left"))
    H, g = scores.H[1:, at, at].sum(axis=0), scores.g[1:, at].sum(axis=0)
    found = np.linalg.solve(H, g)
    sigma = np.sqrt(np.diag(np.linalg.inv(H)))
    # robust weights pull a little towards nothing
    assert np.all(np.abs(found - turned) < 4 * sigma + 0.12 * np.abs(turned))


def test_standstill_shows_nothing() -> None:
    scores = watch("standstill", 30.0, hs_m=0.02, cameras=2).scores()
    for k in range(len(scores)):
        std = 1 / np.sqrt(np.maximum(np.diag(scores.H[k])[:3], 1e-12))
        assert np.rad2deg(std).max() > 1.0


def test_a_camera_without_tracks_has_no_information() -> None:
    lively = watch("eights", 32.0, cameras=3)
    fog = lively.tracks["back"].take(np.zeros(len(lively.tracks["back"]), dtype=bool))
    half = Watch(lively.recording, {**lively.tracks, "back": fog}, lively.calibration, lively.motion)
    scores = half.scores()
    at = scores.columns(scores.cameras.index("back"))
    assert not scores.H[:, at].any()
    assert scores.rows[:, scores.cameras.index("front")].min() > 1000
