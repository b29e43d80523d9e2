"""Simulated watches, scored by cue and changed afterwards, for `benchmarks/monitor.py`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from rigwake.monitor.block_motion import GyroBias
from rigwake.monitor.change_detection import likelihood_ratios
from rigwake.monitor.cues import CUES, joint, score_cues, weighted_cues
from rigwake.monitor.innovations import (
    Belief,
    Innovations,
    belief_of,
    innovations,
    innovations_of_motion,
    with_offsets,
)
from rigwake.monitor.judge import Judgement, joint_claim, judge_cues
from rigwake.monitor.pair_kernels import MOUNTING
from rigwake.monitor.rig_motion import rig_motion
from rigwake.monitor.score import BLOCK_S, BlockScores, join_blocks, score_blocks_with_motion
from rigwake.monitor.thresholds import Thresholds
from rigwake.rig import Rig
from rigwake.simulation.setup import build_recording, prepare
from rigwake.simulation.track_stream import MountFault, stream_sightings
from rigwake.simulation.tracks_only import NoFrames
from rigwake.simulation.watch import calibration_of, rig_in_imu_frame, watch_scenario

# how large a step looks to robust weights, measured with steps simulated in full
LOOKS_SMALLER = {"ego-motion": 0.8, "overlap": 0.95, "landmarks": 0.95}
LENS_OFFSET_DEG = 0.02
BEFORE, AFTER = 13, 19  # blocks before and after the step


@dataclass(frozen=True, eq=False)
class Run:
    """A watch: its scores by cue as they are weighed, those of the motion alone, and its rig."""

    cues: Mapping[str, BlockScores]
    alone: BlockScores
    rig: Rig

    @classmethod
    def of(cls, cues: Mapping[str, BlockScores], rig: Rig) -> Run:
        """From the scores of `score_cues`."""
        return cls(weighted_cues(cues), cues[CUES[0]], rig)

    def part(self, blocks: slice) -> Run:
        """Some of its blocks."""
        return Run({name: s.take(blocks) for name, s in self.cues.items()}, self.alone.take(blocks), self.rig)

    def changed(self, columns: np.ndarray, since: np.ndarray | float, *, real: bool = True) -> Run:
        """As if something had changed by `columns` times `since` (B,). real: as robust weights see it; else exactly."""

        def added(scores: BlockScores, looks: float) -> BlockScores:
            step = (looks if real else 1.0) * (scores.H @ columns[: scores.H.shape[1]])
            return replace(scores, g=scores.g + np.broadcast_to(since, len(scores))[:, None] * step)

        return Run(
            {name: added(scores, LOOKS_SMALLER[name]) for name, scores in self.cues.items()},
            added(self.alone, LOOKS_SMALLER[CUES[0]]),
            self.rig,
        )

    def with_errors(self, seed: int) -> Run:
        """As if calibration and lenses were wrong, by what is thought likely."""
        rng = np.random.default_rng(seed)
        cameras, size = len(self.alone.cameras), self.cues[CUES[0]].H.shape[1]
        error = np.deg2rad(LENS_OFFSET_DEG) * rng.standard_normal(size)
        for c in range(cameras):
            error[MOUNTING * c : MOUNTING * (c + 1)] = np.r_[
                np.deg2rad(0.01) * rng.standard_normal(3), 0.005 * rng.standard_normal(3), 0.0
            ]
        return self.changed(-error, 1.0, real=False)

    def statistic(self, names: tuple[str, ...]) -> np.ndarray:
        """(B,) the largest of all cameras by some of the cues; by all of them as it counts: where the motion supports
        what it tells, or else the motion's."""
        found = self._found(joint([self.cues[name] for name in names]))
        statistics = likelihood_ratios(found, Thresholds())
        value = statistics.value.max(axis=1)
        if names != CUES:
            return np.asarray(value)
        motion = innovations_of_motion(self.alone, self._belief(self.alone), Thresholds())
        alone = likelihood_ratios(motion, Thresholds()).value.max(axis=1)
        for k in np.flatnonzero(value > alone):
            if not joint_claim(found, motion, statistics, int(k), self.places, Thresholds()):
                value[k] = alone[k]
        return np.asarray(np.maximum(value, alone))

    def _found(self, scores: BlockScores) -> Innovations:
        return innovations(scores, self._belief(scores), Thresholds())

    def _belief(self, scores: BlockScores) -> Belief:
        belief = belief_of(calibration_of(self.rig), scores.cameras, Thresholds())
        return with_offsets(belief, scores.H.shape[1], Thresholds())

    @property
    def places(self) -> dict[str, np.ndarray]:
        """(3,) of every camera on the rig."""
        return {name: camera.rig_from_cam.translation for name, camera in self.rig.cameras.items()}

    def judged(self) -> Judgement:
        """What the monitor says."""
        thresholds = Thresholds()
        belief = belief_of(calibration_of(self.rig), self.alone.cameras, thresholds)
        return judge_cues(joint(list(self.cues.values())), self.alone, belief, self.places, thresholds)


def scored_watch(
    motion: str, duration_s: float, seed: int, fault: MountFault | None = None, hs_m: float = 0.25
) -> tuple[dict[str, BlockScores], Rig, float]:
    """Scores of a watch by cue, its rig, and the processor time per second of the watch."""
    scenario = watch_scenario(motion, duration_s, seed, hs_m=hs_m)  # type: ignore[arg-type]
    simulation = prepare(scenario)
    recording = build_recording(simulation, {c.name: NoFrames() for c in scenario.cameras}, Path("watch"))
    rig = rig_in_imu_frame(simulation.rig)
    moved = rig_motion(recording.imus["imu"], recording.gnss["gnss"], np.array(rig.antenna_rig))
    parts: dict[str, list[BlockScores]] = {name: [] for name in CUES}
    bias, spent = None, 0.0
    for first_s, tracks, views in stream_sightings(simulation, BLOCK_S, fault=fault):
        began = time.process_time()
        start = np.array([simulation.start_ns + round(first_s * 1e9)])
        alone, motions = score_blocks_with_motion(tracks, rig, moved, starts_ns=start, bias=bias)
        for name, part in score_cues(alone, motions, views, rig, moved).items():
            parts[name].append(part)
        if np.isfinite(alone.bias).all():
            bias = GyroBias(alone.bias[-1], float(alone.bias_std[-1]))
        spent += time.process_time() - began
    return {name: join_blocks(part) for name, part in parts.items()}, rig, spent / duration_s


def kept_or_scored(motion: str, minutes: float, seed: int, folder: Path | None) -> Run:
    """A run from its file, if there is one; else scored, and kept."""
    kept = None if folder is None else folder / f"{motion}_{minutes:g}_{seed}.npz"
    names = [f.name for f in fields(BlockScores) if f.name != "cameras"]
    if kept is not None and kept.is_file():
        with np.load(kept, allow_pickle=False) as arrays:
            cameras = tuple(str(name) for name in arrays["cameras"])
            cues = {name: BlockScores(cameras, *(arrays[f"{name}/{f}"] for f in names)) for name in CUES}
        rig = rig_in_imu_frame(prepare(watch_scenario(motion, 60.0, seed)).rig)  # type: ignore[arg-type]
        return Run.of(cues, rig)
    cues, rig, spent = scored_watch(motion, 60 * minutes, seed)
    print(f"{motion}, seed {seed}: statistics take {100 * spent:.2f} % of a core", flush=True)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        arrays = {f"{name}/{f}": getattr(part, f) for name, part in cues.items() for f in names}
        np.savez_compressed(kept, **arrays, cameras=np.array(cues[CUES[0]].cameras))
    return Run.of(cues, rig)


def excerpts(runs: list[Run], draws: int, columns: list[int], size: float) -> Iterator[tuple[str, Run]]:
    """Camera and excerpt of some minutes in which it changed, with errors of calibration and lenses."""
    for draw in range(draws):
        run = runs[draw % len(runs)]
        first = int(np.random.default_rng(draw).integers(1, max(len(run.alone) - BEFORE - AFTER, 2)))
        part = run.part(slice(first, first + BEFORE + AFTER)).with_errors(draw)
        camera = draw % len(run.alone.cameras)
        change = np.zeros(run.cues[CUES[0]].H.shape[1])
        change[MOUNTING * camera + np.array(columns)] = size
        since = np.zeros(len(part.alone))
        since[BEFORE], since[BEFORE + 1 :] = 0.5, 1.0
        yield run.alone.cameras[camera], part.changed(change, since)
