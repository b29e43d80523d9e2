"""Points that two cameras see, on simulated sightings: what they tell of a camera that turned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rigwake.monitor.change_detection import likelihood_ratios
from rigwake.monitor.cues import fuse, score_cues
from rigwake.monitor.innovations import Belief, innovations, with_offsets
from rigwake.monitor.judge import Judgement, judge_blocks, judge_cues
from rigwake.monitor.rig_motion import rig_motion
from rigwake.monitor.score import BlockScores, score_blocks_with_motion
from rigwake.monitor.thresholds import Thresholds
from rigwake.simulation.setup import build_recording, prepare
from rigwake.simulation.track_stream import MountFault, stream_sightings
from rigwake.simulation.tracks_only import NoFrames
from rigwake.simulation.watch import WatchMotion, rig_in_imu_frame, watch_scenario
from rigwake.tracks import CrossViews

TURN_DEG = np.array([0.2, -0.1, 0.3])


def cues_of(motion: WatchMotion, *, turned: bool) -> dict[str, BlockScores]:
    """One block of ten seconds, in which `left` is turned or not."""
    scenario = watch_scenario(motion, 11.3, 5)
    simulation = prepare(scenario)
    recording = build_recording(simulation, {c.name: NoFrames() for c in scenario.cameras}, Path("watch"))
    rig = rig_in_imu_frame(simulation.rig)
    moved = rig_motion(recording.imus["imu"], recording.gnss["gnss"], np.array(rig.antenna_rig))
    fault = MountFault("left", turned_rad=np.deg2rad(TURN_DEG)) if turned else None
    ((_, tracks, views),) = stream_sightings(simulation, 11.3, fault=fault)
    starts = np.array([simulation.start_ns])
    alone, motions = score_blocks_with_motion(tracks, rig, moved, starts_ns=starts)
    return score_cues(alone, motions, views, rig, moved)


def step_deg(scores: BlockScores, camera: str) -> np.ndarray:
    at = scores.columns(scores.cameras.index(camera))
    return np.rad2deg(np.linalg.solve(scores.H[0][at, at], scores.g[0][at]))


@pytest.fixture(scope="module")
def eights() -> dict[bool, dict[str, BlockScores]]:
    return {turned: cues_of("eights", turned=turned) for turned in (False, True)}


def test_landmarks_see_a_turn_about_the_vertical(eights: dict[bool, dict[str, BlockScores]]) -> None:
    before, after = (step_deg(eights[turned]["landmarks"], "left") for turned in (False, True))
    assert np.abs(before).max() < 0.04
    np.testing.assert_allclose(after, TURN_DEG, atol=0.05)


def test_all_cues_together_are_surer_than_the_motion_alone(
    eights: dict[bool, dict[str, BlockScores]],
) -> None:
    alone, together = eights[False]["ego-motion"], fuse(eights[False])
    at = alone.columns(1)
    sure = [np.linalg.inv(scores.H[0][at, at])[2, 2] ** 0.5 for scores in (alone, together)]
    assert sure[1] < 0.5 * sure[0]
    np.testing.assert_allclose(step_deg(fuse(eights[True]), "left"), TURN_DEG, atol=0.06)


def test_overlap_needs_no_motion() -> None:
    """At standstill: rotations about the base lines between cameras are seen, about the vertical hardly."""
    cues = cues_of("standstill", turned=True)
    np.testing.assert_allclose(step_deg(cues["overlap"], "left")[:2], TURN_DEG[:2], atol=0.05)


def test_without_common_views_nothing_is_said(eights: dict[bool, dict[str, BlockScores]]) -> None:
    views = CrossViews.nothing(("front", "left"))
    assert len(views) == 0
    assert len(views.take(np.empty(0, dtype=np.int64))) == 0
    assert eights[False]["overlap"].rows.all()


BLOCKS, CAMERAS = 16, ("front", "left", "right")
BELIEF = Belief(np.zeros(21), np.diag(np.tile(np.r_[[1.7e-4] * 3, [5e-3] * 3, 5e-4] ** 2, 3)))


def drawn(std_deg: np.ndarray, size: int, seed: int, steps: np.ndarray | None = None) -> BlockScores:
    """Scores as noise of so many degrees by block and axis would give, with changes (B, size) of what is measured.

    Every camera is measured by itself; with offsets behind (size 30), against the next one.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for pair, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        for axis in range(3):
            row = np.zeros(size)
            row[7 * pair + axis] = 1.0
            if size > 21:
                row[:] = 0.0
                row[7 * b + axis], row[7 * a + axis], row[21 + 3 * pair + axis] = 1.0, -1.0, 1.0
            rows.append(row / np.deg2rad(std_deg[axis]))
    J = np.array(rows)
    changes = np.zeros((BLOCKS, size)) if steps is None else steps
    g = np.array([J.T @ (J @ change + rng.standard_normal(len(J))) for change in changes])
    b = BLOCKS
    return BlockScores(
        CAMERAS,
        np.arange(b) * 10**10,
        np.broadcast_to(J.T @ J, (b, size, size)).copy(),
        g,
        *(np.ones((b, 3)), np.ones((b, 3)), np.full((b, 3), 1000)),
        *(np.full(b, 2.0), np.full(b, 0.4), np.tile([0.0, 0, 1], (b, 1))),
        *(np.zeros((b, 3, 4, 4, 4)), np.zeros((b, 3)), np.full(b, 1e-4)),
    )


MOTION_DEG, SHARED_DEG = np.array([0.008, 0.008, 0.046]), np.array([0.008, 0.008, 0.008])


def judged(alone: BlockScores, shared: BlockScores) -> Judgement:
    together = fuse({"ego-motion": alone, "landmarks": shared})
    places = {name: np.zeros(3) for name in CAMERAS}
    return judge_cues(together, alone, BELIEF, places, Thresholds())


def turned_left(size: int, degrees: float, camera: int = 1) -> np.ndarray:
    steps = np.zeros((BLOCKS, size))
    steps[8:, 7 * camera + 2] = np.deg2rad(degrees)
    return steps


def test_what_two_cameras_see_raises_the_alarm_sooner() -> None:
    """A tenth of a degree about the vertical: the motion alone needs more than a minute for it."""
    alone = drawn(MOTION_DEG, 21, 1, turned_left(21, 0.1))
    shared = drawn(SHARED_DEG, 30, 2, turned_left(30, 0.1))
    places = {name: np.zeros(3) for name in CAMERAS}
    late = judge_blocks(alone, BELIEF, places, Thresholds()).alarms
    (alarm,) = judged(alone, shared).alarms
    assert alarm.camera == "left"
    assert alarm.block <= 12
    assert not late or late[0].block > alarm.block


def test_what_two_cameras_see_blames_none_by_itself() -> None:
    """They disagree by half a degree, and the motion says that nothing turned."""
    alone = drawn(MOTION_DEG, 21, 1)
    shared = drawn(SHARED_DEG, 30, 2, turned_left(30, 0.5))
    assert not judged(alone, shared).alarms


def test_lenses_that_let_two_cameras_disagree_are_no_change() -> None:
    offsets = np.zeros((BLOCKS, 30))
    offsets[:, 21:] = np.deg2rad(0.03) * np.array([1, -1, 1, 1, 1, -1, -1, 1, 1])
    scores = drawn(SHARED_DEG, 30, 2, offsets)
    found = innovations(scores, with_offsets(BELIEF, 30, Thresholds()), Thresholds())
    assert likelihood_ratios(found, Thresholds()).value.max() < 30
