"""Points that two cameras see, on simulated sightings: what they tell of a camera that turned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rigwake.monitor.cues import fuse, score_cues
from rigwake.monitor.rig_motion import rig_motion
from rigwake.monitor.score import BlockScores, score_blocks_with_motion
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
