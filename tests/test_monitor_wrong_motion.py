"""A block whose gyro bias jumps found a wrong motion: it raises no alarm, and costs no other block anything."""

from __future__ import annotations

import numpy as np
import pytest

from rigwake.monitor.innovations import Belief, discount_wrong_motion, innovations_of_motion
from rigwake.monitor.judge import judge_blocks
from rigwake.monitor.score import BlockScores
from rigwake.monitor.thresholds import Thresholds

BLOCKS, NAMES = 20, ("left", "right")
WRONG = slice(14, 17)
STEP_DEG = 0.3
STD = np.deg2rad(0.012)


def watched(bias_off_deg_s: float) -> BlockScores:
    """Blocks that see a rotation to 0.06 deg about every axis; in three of them `left` looks turned, and the gyro's
    bias about the vertical is off."""
    rng = np.random.default_rng(0)
    size = 7 * len(NAMES)
    information = np.tile(np.r_[np.full(3, np.deg2rad(0.06) ** -2.0), np.full(3, 1e2), 1e4], len(NAMES))
    H = np.tile(np.diag(information), (BLOCKS, 1, 1))
    g = np.sqrt(information) * rng.standard_normal((BLOCKS, size))
    g[WRONG] += H[WRONG][:, :, 0] * np.deg2rad(STEP_DEG)
    bias = np.deg2rad([0.0, 0.0, 0.3]) + STD / 3 * rng.standard_normal((BLOCKS, 3))
    bias[WRONG, 2] += np.deg2rad(bias_off_deg_s)
    ones = np.ones((BLOCKS, len(NAMES)))
    return BlockScores(
        NAMES,
        np.arange(BLOCKS, dtype=np.int64) * 10**10,
        H,
        g,
        ones,
        ones,
        np.full((BLOCKS, len(NAMES)), 1000),
        np.full(BLOCKS, 2.0),
        np.full(BLOCKS, 0.1),
        np.tile([0.0, 0, 1], (BLOCKS, 1)),
        np.zeros((BLOCKS, len(NAMES), 4, 4, 4)),
        bias,
        np.full(BLOCKS, STD),
    )


def weight_of(scores: BlockScores) -> np.ndarray:
    return np.asarray(discount_wrong_motion(scores).H[:, 0, 0] / scores.H[:, 0, 0])


@pytest.mark.parametrize(("bias_off_deg_s", "alarms"), [(0.0, 1), (0.15, 0)])
def test_only_blocks_with_a_sound_motion_raise_an_alarm(bias_off_deg_s: float, alarms: int) -> None:
    size = 7 * len(NAMES)
    belief = Belief(np.zeros(size), np.eye(size) * np.deg2rad(0.01) ** 2)
    places = {name: np.zeros(3) for name in NAMES}
    judgement = judge_blocks(watched(bias_off_deg_s), belief, places, Thresholds())
    assert [alarm.camera for alarm in judgement.alarms] == ["left"] * alarms


def test_what_a_wrong_bias_costs() -> None:
    np.testing.assert_allclose(weight_of(watched(0.0)), 1.0)
    weight = weight_of(watched(0.15))
    assert (weight[WRONG] < 0.05).all()
    np.testing.assert_allclose(np.delete(weight, np.arange(BLOCKS)[WRONG]), 1.0)
    # a lasting change is believed once most of two minutes have it
    lasting = watched(0.0)
    lasting.bias[6:, 2] += np.deg2rad(0.15)
    assert (weight_of(lasting)[13:] == 1.0).all()


def test_blocks_that_saw_nothing_have_no_bias() -> None:
    scores = watched(0.0)
    scores.bias[[0, 5, 9]] = np.nan
    scores.bias_std[[0, 5, 9]] = np.nan
    np.testing.assert_allclose(weight_of(scores), 1.0)
    belief = Belief(np.zeros(scores.H.shape[1]), np.eye(scores.H.shape[1]))
    assert len(innovations_of_motion(scores, belief, Thresholds()).steady) == BLOCKS
    assert len(discount_wrong_motion(scores.take(slice(0, 0)))) == 0
