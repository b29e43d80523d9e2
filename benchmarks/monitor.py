"""False alarms and delays of the monitor on simulated tracks, by cue and with all of them.

    python benchmarks/monitor.py [--runs 4] [--minutes 30] [--draws 12] [--save FOLDER] [--roc FILE.svg]

Every run is a watch without a fault, scored once by every cue. False alarms are counted on it as it is, with errors of
the calibration drawn from its covariance; their rate per hundred hours is bounded by drawing whole runs' maxima anew
(bootstrap over blocks of five minutes). Steps and shifts are then added to the scores, which are linear in small
changes, after two minutes and in the middle of a block (half of that block's score): thousands of steps cost no
further simulation. Robust weights make real steps look smaller than they are, so every step is added at 0.8 (the
motion) and 0.95 (overlaps, landmarks) of its size (`tests/test_monitor_*` simulate steps in full).
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from rigwake.monitor.block_motion import GyroBias
from rigwake.monitor.change_detection import glr
from rigwake.monitor.cues import CUES, score_cues, weighted_cues
from rigwake.monitor.innovations import belief_of, innovations
from rigwake.monitor.judge import Judgement, judge_cues
from rigwake.monitor.rig_motion import rig_motion
from rigwake.monitor.score import BLOCK_S, BlockScores, join_blocks, score_blocks_with_motion
from rigwake.monitor.thresholds import Thresholds
from rigwake.rig import Rig
from rigwake.simulation.setup import build_recording, prepare
from rigwake.simulation.track_stream import stream_sightings
from rigwake.simulation.tracks_only import NoFrames
from rigwake.simulation.watch import calibration_of, rig_in_imu_frame, watch_scenario

MOTIONS = ("eights", "gentle", "straight")
# how large a step looks to robust weights, measured with steps simulated in full
LOOKS_SMALLER = {"ego-motion": 0.8, "overlap": 0.95, "landmarks": 0.95}
RATES = (60, 30, 20, 10, 6, 3)  # of false alarms per hour, of the picture
BEFORE, AFTER = 13, 19  # blocks before and after the step


def scored_watch(motion: str, duration_s: float, seed: int) -> tuple[dict[str, BlockScores], Rig, float]:
    """Scores of a watch without a fault by cue, its rig, and the processor time per second of the watch."""
    scenario = watch_scenario(motion, duration_s, seed)  # type: ignore[arg-type]
    simulation = prepare(scenario)
    recording = build_recording(simulation, {c.name: NoFrames() for c in scenario.cameras}, Path("watch"))
    rig = rig_in_imu_frame(simulation.rig)
    moved = rig_motion(recording.imus["imu"], recording.gnss["gnss"], np.array(rig.antenna_rig))
    parts: dict[str, list[BlockScores]] = {name: [] for name in CUES}
    bias, spent = None, 0.0
    for first_s, tracks, views in stream_sightings(simulation, BLOCK_S):
        began = time.process_time()
        start = np.array([simulation.start_ns + round(first_s * 1e9)])
        alone, motions = score_blocks_with_motion(tracks, rig, moved, starts_ns=start, bias=bias)
        scores = score_cues(alone, motions, views, rig, moved)
        for name, part in scores.items():
            parts[name].append(part)
        found = scores[CUES[0]].bias
        if np.isfinite(found).all():
            bias = GyroBias(found[-1], 2e-4)
        spent += time.process_time() - began
    return {name: join_blocks(part) for name, part in parts.items()}, rig, spent / duration_s


@dataclass(frozen=True, eq=False)
class Run:
    """A watch without a fault: its scores by cue as `fuse` weighs them, those of the motion alone, and its rig."""

    cues: Mapping[str, BlockScores]
    alone: BlockScores
    rig: Rig

    def together(
        self,
        blocks: slice,
        error: np.ndarray,
        change: np.ndarray | None = None,
        since: np.ndarray | None = None,
        names: tuple[str, ...] = CUES,
    ) -> BlockScores:
        """Scores by some cues with an error of the calibration (7C,), and a change (7C,) times `since` (B,)."""
        parts = []
        for name in names:
            part = self.cues[name].take(blocks)
            g = part.g - part.H @ error
            if change is not None and since is not None:
                g = g + since[:, None] * LOOKS_SMALLER[name] * (part.H @ change)
            parts.append(replace(part, g=g))
        return replace(
            parts[0],
            H=np.sum([p.H for p in parts], axis=0),
            g=np.sum([p.g for p in parts], axis=0),
            rows=np.sum([p.rows for p in parts], axis=0),
        )


def calibration_error(cameras: int, seed: int) -> np.ndarray:
    """(7C,) by what the calibration's covariance says: 0.01 deg, 5 mm."""
    rng = np.random.default_rng(seed)
    error = np.zeros(7 * cameras)
    for c in range(cameras):
        error[7 * c : 7 * c + 3] = np.deg2rad(0.01) * rng.standard_normal(3)
        error[7 * c + 3 : 7 * c + 6] = 0.005 * rng.standard_normal(3)
    return error


def judged(
    run: Run,
    blocks: slice,
    error: np.ndarray,
    change: np.ndarray | None = None,
    since: np.ndarray | None = None,
) -> Judgement:
    """What the monitor says of a part of a run."""
    thresholds = Thresholds()
    together = run.together(blocks, error, change, since)
    alone = run.alone.take(blocks)
    g = alone.g - alone.H @ error
    if change is not None and since is not None:
        g = g + since[:, None] * LOOKS_SMALLER[CUES[0]] * (alone.H @ change)
    belief = belief_of(calibration_of(run.rig), alone.cameras, thresholds)
    places = {name: camera.rig_from_cam.translation for name, camera in run.rig.cameras.items()}
    return judge_cues(together, replace(alone, g=g), belief, places, thresholds)


def statistic(scores: BlockScores, rig: Rig) -> np.ndarray:
    """(B,) the largest of all cameras."""
    thresholds = Thresholds(steady_lag=10**6)
    belief = belief_of(calibration_of(rig), scores.cameras, thresholds)
    return np.asarray(glr(innovations(scores, belief, thresholds), thresholds).value.max(axis=1))


def changed(
    run: Run, draw: int, columns: list[int], size: float
) -> tuple[slice, np.ndarray, np.ndarray, np.ndarray]:
    """Blocks about a change, the calibration's error, the change (7C,), and since when (B,)."""
    first = int(np.random.default_rng(draw).integers(1, len(run.alone) - BEFORE - AFTER))
    blocks = slice(first, first + BEFORE + AFTER)
    cameras = len(run.alone.cameras)
    change = np.zeros(7 * cameras)
    change[7 * (draw % cameras) + np.array(columns)] = size
    since = np.zeros(BEFORE + AFTER)
    since[BEFORE], since[BEFORE + 1 :] = 0.5, 1.0
    return blocks, calibration_error(cameras, draw), change, since


def delay_of(judgement: Judgement, cause: str, camera: str) -> tuple[float, bool]:
    """Seconds from a change to its alarm (infinite if none), and whether camera and cause are named."""
    for alarm in judgement.alarms:
        if alarm.block >= BEFORE:
            best = alarm.explanations[0]
            return (alarm.block - BEFORE + 0.5) * BLOCK_S, (best.camera, best.cause) == (camera, cause)
    return np.inf, False


def false_alarms(motion: str, runs: list[Run]) -> None:
    """Alarms of whole watches, and a bound on their rate."""
    alarms, largest, marks = 0, 0.0, []
    for seed, run in enumerate(runs):
        error = calibration_error(len(run.alone.cameras), seed)
        judgement = judged(run, slice(0, len(run.alone)), error)
        alarms += len(judgement.alarms)
        value = judgement.statistics.value.max(axis=1)
        largest = max(largest, float(value.max()))
        marks += [float(part.max()) for part in np.array_split(value, max(len(value) // 30, 1))]
    hours = sum(len(run.alone) for run in runs) * BLOCK_S / 3600
    rate, upper = rate_per_100_hours(np.array(marks), Thresholds().alarm)
    print(
        f"{motion}: {hours:.1f} h, {alarms} false alarms, largest statistic {largest:.1f} (alarm "
        f"{Thresholds().alarm:g}); per 100 h by bootstrap {rate:.2g}, 95 % of draws below {upper:.2g}",
        flush=True,
    )


def rate_per_100_hours(marks: np.ndarray, alarm: float, draws: int = 2000) -> tuple[float, float]:
    """Expected alarms per 100 h and their 95 % bound, from maxima of five minutes: an exponential tail fitted to those
    above the median, over draws with replacement."""
    rng = np.random.default_rng(0)
    rates = []
    for _ in range(draws):
        drawn = rng.choice(marks, len(marks))
        middle = float(np.median(drawn))
        beyond = drawn[drawn > middle] - middle
        tail = float(beyond.mean()) if len(beyond) else 1e-6
        rates.append(1200 * 0.5 * float(np.exp(min((middle - alarm) / tail, 0.0))))
    return float(np.median(rates)), float(np.quantile(rates, 0.95))


def steps(motion: str, runs: list[Run], draws: int) -> None:
    """Turns of a camera by axis and size, and shifts."""
    rows = [("rotation", size, axis) for size, axis in itertools.product((0.1, 0.2, 0.5), range(3))]
    rows += [("translation", size, axis) for size, axis in itertools.product((2.0, 5.0), range(3))]
    for cause, size, axis in rows:
        delays, right = [], []
        for draw in range(draws):
            run = runs[draw % len(runs)]
            metric = np.deg2rad(size) if cause == "rotation" else size / 100
            column = axis if cause == "rotation" else 3 + axis
            blocks, error, change, since = changed(run, draw, [column], metric)
            judgement = judged(run, blocks, error, change, since)
            delay, named = delay_of(judgement, cause, run.alone.cameras[draw % len(run.alone.cameras)])
            delays.append(delay)
            right.append(named)
        found = np.isfinite(delays)
        late = np.sort(delays)[int(np.ceil(0.95 * len(delays))) - 1]
        what = f"{size:g} deg about" if cause == "rotation" else f"{size:g} cm along"
        print(
            f"  {what} {('bow', 'port', 'up')[axis]}: found {100 * found.mean():.0f} % in three minutes, median "
            f"{np.median(delays):.0f} s, 95 % {late:.0f} s, named right {sum(right)} of {found.sum()}",
            flush=True,
        )


def ramps(motion: str, runs: list[Run], rate_deg_per_hour: float = 0.3) -> None:
    """A slow turn from the start of every watch about each axis: when it is called, and what."""
    for axis in range(3):
        for run in runs[:1]:
            count, cameras = len(run.alone), len(run.alone.cameras)
            change = np.zeros(7 * cameras)
            change[axis] = np.deg2rad(rate_deg_per_hour) / LOOKS_SMALLER["ego-motion"]
            since = (np.arange(count) + 0.5) * BLOCK_S / 3600
            judgement = judged(run, slice(0, count), calibration_error(cameras, axis), change, since)
            alarm = judgement.alarm_of(run.alone.cameras[0])
            words = "not found"
            if alarm is not None and alarm.change is not None:
                at = rate_deg_per_hour * (alarm.block + 1) * BLOCK_S / 3600
                words = f"alarm at {at:.2f} deg, a {alarm.change.kind} of {alarm.change.rate_deg_per_hour:.2f} deg/h"
            print(f"  {rate_deg_per_hour:g} deg/h about {('bow', 'port', 'up')[axis]}: {words}", flush=True)


def roc(
    motion: str, runs: list[Run], draws: int, size_deg: float = 0.2
) -> dict[str, list[tuple[float, float]]]:
    """Mean delay (s, at most three minutes) of a step about any axis at rates of false alarms per hour, by cue."""
    choices: dict[str, tuple[str, ...]] = {name: (name,) for name in CUES} | {"all together": CUES}
    curves = {}
    for label, names in choices.items():
        quiet = []
        for seed, run in enumerate(runs):
            error = calibration_error(len(run.alone.cameras), seed)
            quiet.append(statistic(run.together(slice(0, len(run.alone)), error, names=names), run.rig))
        moved = []
        for draw in range(draws):
            run = runs[draw % len(runs)]
            blocks, error, change, since = changed(run, draw, [(draw // 4) % 3], np.deg2rad(size_deg))
            moved.append(statistic(run.together(blocks, error, change, since, names), run.rig)[BEFORE:])
        hours = sum(len(values) for values in quiet) * BLOCK_S / 3600
        curves[label] = [
            (float(rate), delay_at(level_of(quiet, rate * hours), moved))
            for rate in (60, 30, 20, 10, 6, 3)
            if rate * hours >= 1
        ]
        print(
            f"  {label}: " + ", ".join(f"{delay:.0f} s at {rate:g}/h" for rate, delay in curves[label]),
            flush=True,
        )
    worst = max(
        curves["all together"][k][1] / min(curves[name][k][1] for name in CUES)
        for k in range(len(curves["all together"]))
    )
    print(f"  {motion}: all together over the best cue, at worst {worst:.2f}", flush=True)
    return curves


def level_of(quiet: list[np.ndarray], alarms: float) -> float:
    """The level that the statistics of quiet watches cross upwards so many times."""
    levels = np.unique(np.concatenate(quiet))
    for level in levels:
        crossings = sum(int(((v[1:] > level) & (v[:-1] <= level)).sum()) + int(v[0] > level) for v in quiet)
        if crossings <= alarms and level >= np.median(levels):
            return float(level)
    return float(levels[-1])


def delay_at(level: float, moved: list[np.ndarray]) -> float:
    """Mean seconds to the first value above a level; three minutes where there is none."""
    delays = []
    for values in moved:
        over = np.flatnonzero(values > level)
        delays.append((over[0] + 0.5) * BLOCK_S if len(over) else AFTER * BLOCK_S)
    return float(np.mean(delays))


WIDTH, HEIGHT, LEFT, TOP = 250, 190, 40, 24  # of a panel


def _to_x(first: float, rate: float) -> float:
    return float(first + (np.log10(rate) - 0.3) / 1.6 * (WIDTH - LEFT))


def _to_y(delay: float) -> float:
    return TOP + (1 - delay / 190) * (HEIGHT - TOP - 30)


def draw_roc(curves: Mapping[str, Mapping[str, list[tuple[float, float]]]], path: Path) -> None:
    """One small panel per motion: delay over false alarms per hour, a line per cue."""
    colours = dict(zip([*CUES, "all together"], ("#c2410c", "#0f766e", "#7c3aed", "#111827"), strict=True))
    parts = []
    for k, (motion, by_cue) in enumerate(curves.items()):
        x0 = k * (WIDTH + 20) + LEFT
        parts.append(f'<text x="{x0}" y="14" font-weight="bold">{motion}</text>')
        for delay in (0, 60, 120, 180):
            y = _to_y(delay)
            parts.append(f'<path d="M{x0} {y:.1f}H{x0 + WIDTH - LEFT}" stroke="#d1d5db"/>')
            parts.append(f'<text x="{x0 - 5}" y="{y + 4:.1f}" text-anchor="end">{delay}</text>')
        for rate in (3, 10, 30):
            parts.append(
                f'<text x="{_to_x(x0, rate):.1f}" y="{HEIGHT - 14}" text-anchor="middle">{rate}</text>'
            )
        for label, curve in by_cue.items():
            points = " ".join(f"{_to_x(x0, rate):.1f},{_to_y(delay):.1f}" for rate, delay in curve)
            parts.append(
                f'<polyline points="{points}" fill="none" stroke="{colours[label]}" '
                f'stroke-width="{2.5 if label == "all together" else 1.5}"/>'
            )
    for k, (label, colour) in enumerate(colours.items()):
        parts.append(f'<text x="{LEFT + 130 * k}" y="{HEIGHT + 12}" fill="{colour}">{label}</text>')
    total = len(curves) * (WIDTH + 20) + 10
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total} {HEIGHT + 20}" font-family="sans-serif" '
        f'font-size="11" role="img" aria-label="Delay in seconds over false alarms per hour, by cue">'
        f'<rect width="100%" height="100%" fill="#ffffff"/>{"".join(parts)}</svg>\n',
        encoding="utf-8",
    )


def kept_or_scored(motion: str, minutes: float, seed: int, folder: Path | None) -> Run:
    """A run from its file, if there is one; else scored, and kept."""
    kept = None if folder is None else folder / f"{motion}_{seed}.npz"
    if kept is not None and kept.is_file():
        with np.load(kept, allow_pickle=False) as arrays:
            cameras = tuple(str(name) for name in arrays["cameras"])
            cues = {
                name: BlockScores(
                    cameras, *(arrays[f"{name}/{f.name}"] for f in fields(BlockScores) if f.name != "cameras")
                )
                for name in CUES
            }
        rig = rig_in_imu_frame(prepare(watch_scenario(motion, 60.0, seed)).rig)  # type: ignore[arg-type]
    else:
        cues, rig, spent = scored_watch(motion, 60 * minutes, seed)
        print(f"{motion}, seed {seed}: statistics take {100 * spent:.2f} % of a core", flush=True)
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            arrays = {
                f"{name}/{f.name}": getattr(part, f.name)
                for name, part in cues.items()
                for f in fields(part)
                if f.name != "cameras"
            }
            np.savez_compressed(kept, **arrays, cameras=np.array(cues[CUES[0]].cameras))
    return Run(weighted_cues(cues), cues[CUES[0]], rig)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--save", type=Path, help="folder in which the scores are kept for another time")
    parser.add_argument("--roc", type=Path, help="file for the picture of delays over false alarms")
    arguments = parser.parse_args()
    curves = {}
    for motion in MOTIONS:
        runs = [
            kept_or_scored(motion, arguments.minutes, seed, arguments.save)
            for seed in range(10, 10 + arguments.runs)
        ]
        false_alarms(motion, runs)
        if motion == "straight":
            continue
        steps(motion, runs, arguments.draws)
        ramps(motion, runs)
        curves[motion] = roc(motion, runs, 2 * arguments.draws)
    if arguments.roc is not None:
        draw_roc(curves, arguments.roc)


if __name__ == "__main__":
    main()
