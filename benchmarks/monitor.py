"""False alarms and delays of the monitor on simulated tracks.

    python benchmarks/monitor.py [--runs 4] [--minutes 30] [--save FOLDER]

Every run is a watch without a fault, scored once. False alarms are counted on it as it is, with errors of the
calibration drawn from its covariance. Steps are then added to the scores, which are linear in small changes, after two
minutes and in the middle of a block (half of that block's score): thousands of steps cost no further simulation. Robust
weights make real steps look smaller than they are, so every step is added at 0.8 of its size (`tests/test_monitor_*`
simulate steps in full).
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from rigwake.monitor.innovations import belief_of
from rigwake.monitor.judge import judge_blocks
from rigwake.monitor.rig_motion import rig_motion
from rigwake.monitor.score import BLOCK_S, BlockScores, GyroBias, join_blocks, score_blocks
from rigwake.monitor.thresholds import Thresholds
from rigwake.rig import Rig
from rigwake.simulation.setup import build_recording, prepare
from rigwake.simulation.track_stream import stream_tracks
from rigwake.simulation.tracks_only import NoFrames
from rigwake.simulation.watch import calibration_of, rig_in_imu_frame, watch_scenario

MOTIONS = ("eights", "gentle", "straight")
LOOKS_SMALLER = 0.8
BEFORE, AFTER = 13, 19  # blocks before and after the step


def scored_watch(motion: str, duration_s: float, seed: int) -> tuple[BlockScores, Rig, float]:
    """Scores of a watch without a fault, its rig, and the processor time per second of the watch."""
    scenario = watch_scenario(motion, duration_s, seed)  # type: ignore[arg-type]
    simulation = prepare(scenario)
    recording = build_recording(simulation, {c.name: NoFrames() for c in scenario.cameras}, Path("watch"))
    rig = rig_in_imu_frame(simulation.rig)
    moved = rig_motion(recording.imus["imu"], recording.gnss["gnss"], np.array(rig.antenna_rig))
    bias, parts, spent = None, [], 0.0
    for first_s, tracks in stream_tracks(simulation, BLOCK_S):
        began = time.process_time()
        start = np.array([simulation.start_ns + round(first_s * 1e9)])
        parts.append(score_blocks(tracks, rig, moved, starts_ns=start, bias=bias))
        if np.isfinite(parts[-1].bias).all():
            bias = GyroBias(parts[-1].bias[-1], 2e-4)
        spent += time.process_time() - began
    return join_blocks(parts), rig, spent / duration_s


def with_calibration_errors(scores: BlockScores, seed: int) -> BlockScores:
    """As if the calibration were wrong by what its covariance says (0.01 deg, 5 mm)."""
    rng = np.random.default_rng(seed)
    error = np.zeros(scores.H.shape[1])
    for c in range(len(scores.cameras)):
        error[7 * c : 7 * c + 3] = np.deg2rad(0.01) * rng.standard_normal(3)
        error[7 * c + 3 : 7 * c + 6] = 0.005 * rng.standard_normal(3)
    return replace(scores, g=scores.g - scores.H @ error)


def false_alarms(scores: BlockScores, rig: Rig, seed: int) -> tuple[int, float]:
    """Alarms, and the largest statistic."""
    judgement = judged(with_calibration_errors(scores, seed), rig)
    return len(judgement.alarms), float(judgement.statistics.value.max())


def judged(scores: BlockScores, rig: Rig):  # type: ignore[no-untyped-def]
    thresholds = Thresholds()
    belief = belief_of(calibration_of(rig), scores.cameras, thresholds)
    places = {name: camera.rig_from_cam.translation for name, camera in rig.cameras.items()}
    return judge_blocks(scores, belief, places, thresholds)


def step_delay(
    scores: BlockScores, rig: Rig, first: int, camera: int, axis: int, size_deg: float, seed: int
) -> tuple[float, bool]:
    """Seconds from a step to its alarm (infinite if none), and whether the camera is blamed."""
    part = scores.take(slice(first, first + BEFORE + AFTER))
    part = with_calibration_errors(part, seed)
    step = np.zeros(part.H.shape[1])
    step[7 * camera + axis] = np.deg2rad(size_deg) * LOOKS_SMALLER
    since = np.zeros(len(part))
    since[BEFORE], since[BEFORE + 1 :] = 0.5, 1.0
    judgement = judged(replace(part, g=part.g + since[:, None] * (part.H @ step)), rig)
    for alarm in judgement.alarms:
        if alarm.block >= BEFORE:
            return (alarm.block - BEFORE + 0.5) * BLOCK_S, alarm.camera == part.cameras[camera]
    return np.inf, False


def report(motion: str, runs: list[tuple[BlockScores, Rig]], draws: int) -> None:
    """The table of one motion."""
    hours = sum(len(scores) for scores, _ in runs) * BLOCK_S / 3600
    alarms = [false_alarms(scores, rig, seed) for seed, (scores, rig) in enumerate(runs)]
    print(
        f"{motion}: {hours:.1f} h, {sum(n for n, _ in alarms)} false alarms, "
        f"largest statistic {max(v for _, v in alarms):.1f} (alarm {Thresholds().alarm:g})",
        flush=True,
    )
    rng = np.random.default_rng(5)
    for size_deg, axis in itertools.product((0.1, 0.2, 0.5), range(3)):
        delays, right = [], []
        for draw in range(draws):
            scores, rig = runs[draw % len(runs)]
            first = int(rng.integers(1, len(scores) - BEFORE - AFTER))
            delay, blamed = step_delay(scores, rig, first, draw % len(scores.cameras), axis, size_deg, draw)
            delays.append(delay)
            right.append(blamed)
        found = np.isfinite(delays)
        late = np.sort(delays)[int(np.ceil(0.95 * len(delays))) - 1]
        print(
            f"  {size_deg} deg about {('bow', 'port', 'up')[axis]}: found {100 * found.mean():.0f} %, median "
            f"{np.median(delays):.0f} s, 95 % {late:.0f} s, blamed right {sum(right)} of {found.sum()}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--save", type=Path, help="folder in which the scores are kept for another time")
    arguments = parser.parse_args()
    for motion in MOTIONS:
        runs = []
        for seed in range(10, 10 + arguments.runs):
            kept = None if arguments.save is None else arguments.save / f"{motion}_{seed}.npz"
            if kept is not None and kept.is_file():
                runs.append(load(kept, motion))
                continue
            scores, rig, spent = scored_watch(motion, 60 * arguments.minutes, seed)
            print(f"{motion}, seed {seed}: statistics take {100 * spent:.2f} % of a core", flush=True)
            runs.append((scores, rig))
            if kept is not None:
                kept.parent.mkdir(parents=True, exist_ok=True)
                arrays = {f.name: getattr(scores, f.name) for f in fields(scores)}
                np.savez_compressed(kept, **{**arrays, "cameras": np.array(scores.cameras)})
        report(motion, runs, arguments.draws)


def load(file: Path, motion: str) -> tuple[BlockScores, Rig]:
    with np.load(file, allow_pickle=False) as arrays:
        values = {f.name: arrays[f.name] for f in fields(BlockScores) if f.name != "cameras"}
        scores = BlockScores(tuple(str(name) for name in arrays["cameras"]), **values)
    return scores, rig_in_imu_frame(prepare(watch_scenario(motion, 60.0, 10)).rig)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
