"""Simulated watches without pictures, scored and judged, for tests of the monitor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from rigwake.calibration import Calibration
from rigwake.monitor.innovations import belief_of
from rigwake.monitor.judge import Judgement, judge_blocks
from rigwake.monitor.rig_motion import RigMotion, rig_motion
from rigwake.monitor.score import BlockScores, score_blocks
from rigwake.monitor.thresholds import Thresholds
from rigwake.recording import Recording
from rigwake.simulation.setup import build_recording, prepare
from rigwake.simulation.track_stream import MountFault, stream_tracks
from rigwake.simulation.tracks_only import NoFrames
from rigwake.simulation.watch import WatchMotion, calibration_of, rig_in_imu_frame, watch_scenario
from rigwake.tracks import Tracks


@dataclass(frozen=True, eq=False)
class Watch:
    """A watch as recorded, its tracks, and the calibration that it is held against (exact, and it says 0.01 deg)."""

    recording: Recording
    tracks: Mapping[str, Tracks]
    calibration: Calibration
    motion: RigMotion

    def scores(self) -> BlockScores:
        return score_blocks(self.tracks, self.calibration.rig, self.motion)

    def judge(self, scores: BlockScores | None = None) -> Judgement:
        scores = scores or self.scores()
        thresholds = Thresholds()
        belief = belief_of(self.calibration, scores.cameras, thresholds)
        places = {name: c.rig_from_cam.translation for name, c in self.calibration.cameras.items()}
        return judge_blocks(scores, belief, places, thresholds)


def watch(
    kind: WatchMotion,
    duration_s: float,
    *,
    seed: int = 3,
    fault: MountFault | None = None,
    cameras: int = 4,
    hs_m: float = 0.25,
) -> Watch:
    scenario = watch_scenario(kind, duration_s, seed, hs_m=hs_m, cameras=cameras)
    simulation = prepare(scenario)
    recording = build_recording(simulation, {c.name: NoFrames() for c in scenario.cameras}, Path("watch"))
    rig = rig_in_imu_frame(simulation.rig)
    ((_, tracks),) = stream_tracks(simulation, duration_s, fault=fault)
    assert rig.antenna_rig is not None
    motion = rig_motion(recording.imus["imu"], recording.gnss["gnss"], np.array(rig.antenna_rig))
    return Watch(recording, tracks, calibration_of(rig), motion)


@cache
def figure_eights() -> tuple[Watch, BlockScores]:
    """A lively watch of 100 s without a change, and its scores: of use to all that only look at them."""
    world = watch("eights", 100.0, seed=7)
    return world, world.scores()
