"""False alarms and delays of the monitor on simulated tracks, by cue and with all of them.

    python benchmarks/monitor.py [--runs 1] [--minutes 30] [--draws 12] [--save FOLDER] [--score-only] [--motion NAME]

Every run is a watch without a fault, scored once by every cue. False alarms are counted on it as it is, with errors of
the calibration drawn from its covariance (0.01 deg, 5 mm), and offsets of 0.02 deg between every two cameras in what
both see, as lens models leave them. The rate of alarms per hundred hours is bounded from the largest statistic of every
five minutes, drawn anew with replacement, with an exponential tail. Steps and shifts are added to the scores, which are
linear in small changes, after 130 s and in the middle of a block (half of that block's score): they cost no further
simulation. Robust weights make real steps look smaller than they are, so every step is added at 0.8 (the motion) and
0.95 (overlaps, landmarks) of its size. Rows marked "in full" simulate the fault itself. The picture of delays over
false alarms is docs/measurements/monitor_roc.svg (not with --motion).
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from rigwake.geometry import so3
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
from rigwake.monitor.states import CameraState
from rigwake.monitor.thresholds import Thresholds
from rigwake.monitor.verdict_words import rig_notes, unobservable_words
from rigwake.rig import Rig
from rigwake.simulation.setup import build_recording, prepare
from rigwake.simulation.track_stream import MountFault, stream_sightings
from rigwake.simulation.tracks_only import NoFrames
from rigwake.simulation.watch import calibration_of, rig_in_imu_frame, watch_scenario

MOTIONS = ("eights", "gentle", "straight")
AXES = ("bow", "port", "up")
FUSED = "all together"
ROC = Path(__file__).resolve().parent.parent / "docs" / "measurements" / "monitor_roc.svg"
# how large a step looks to robust weights, measured with steps simulated in full
LOOKS_SMALLER = {"ego-motion": 0.8, "overlap": 0.95, "landmarks": 0.95}
LENS_OFFSET_DEG = 0.02
BEFORE, AFTER = 13, 19  # blocks before and after the step
RATES = (60, 30, 20, 10, 6, 3)  # of false alarms per hour, in the picture


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


def false_alarms(motion: str, runs: list[Run]) -> None:
    """Alarms of whole watches, and a bound on their rate."""
    alarms, marks, states = 0, [], []
    for seed, run in enumerate(runs):
        run = run.with_errors(seed)
        judgement = run.judged()
        alarms += len(judgement.alarms)
        value = run.statistic(CUES)
        marks += [float(part.max()) for part in np.array_split(value, max(len(value) // 30, 1))]
        states += [state for row in judgement.standings[12:] for state in row]
    hours = sum(len(run.alone) for run in runs) * BLOCK_S / 3600
    rate, upper = rate_per_100_hours(np.array(marks), Thresholds().alarm)
    told = 100 * np.mean([state is CameraState.OK for state in states]) if states else np.nan
    print(
        f"{motion}: {hours:.1f} h, {alarms} false alarms, largest statistic {max(marks):.1f} (alarm "
        f"{Thresholds().alarm:g}); per 100 h by bootstrap {rate:.2g}, 95 % of draws below {upper:.2g}; "
        f"OK in {told:.0f} % of blocks",
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


def steps(motion: str, runs: list[Run], draws: int) -> None:
    """Turns of a camera by axis and size, and shifts."""
    rows = [("rotation", size, axis) for size, axis in itertools.product((0.1, 0.2, 0.5), range(3))]
    rows += [("translation", 2.0, axis) for axis in range(3)]
    for cause, size, axis in rows:
        turn = cause == "rotation"
        delays, right = [], 0
        for camera, part in excerpts(
            runs, draws, [axis if turn else 3 + axis], np.deg2rad(size) if turn else size / 100
        ):
            alarm = next((a for a in part.judged().alarms if a.block >= BEFORE), None)
            delays.append(np.inf if alarm is None else (alarm.block - BEFORE + 0.5) * BLOCK_S)
            best = None if alarm is None else alarm.explanations[0]
            right += best is not None and (best.camera, best.cause) == (camera, cause)
        found = np.isfinite(delays)
        late = np.sort(delays)[int(np.ceil(0.95 * len(delays))) - 1]
        what = f"{size:g} deg about" if turn else f"{size:g} cm along"
        print(
            f"  {motion}, {what} {AXES[axis]}: found {100 * found.mean():.0f} % in three minutes, median "
            f"{np.median(delays):.0f} s, 95 % {late:.0f} s, named right {right} of {found.sum()}",
            flush=True,
        )


def ramps(motion: str, run: Run, rate_deg_per_hour: float = 0.3) -> None:
    """A slow turn from the start of a watch about each axis: when it is called, and what."""
    for axis in range(3):
        change = np.zeros(run.cues[CUES[0]].H.shape[1])
        change[axis] = np.deg2rad(rate_deg_per_hour) / LOOKS_SMALLER[CUES[0]]
        since = (np.arange(len(run.alone)) + 0.5) * BLOCK_S / 3600
        alarm = run.with_errors(axis).changed(change, since).judged().alarm_of(run.alone.cameras[0])
        words = "not found"
        if alarm is not None and alarm.change is not None:
            at = rate_deg_per_hour * (alarm.block + 1) * BLOCK_S / 3600
            words = (
                f"alarm at {at:.2f} deg, a {alarm.change.kind} of {alarm.change.rate_deg_per_hour:.2f} deg/h"
            )
        print(f"  {motion}, {rate_deg_per_hour:g} deg/h about {AXES[axis]}: {words}", flush=True)


def not_blamed(run: Run) -> None:
    """What is no fault of a camera's mounting: added to the scores."""
    part = run.part(slice(1, 1 + BEFORE + AFTER)).with_errors(3)
    since = (np.arange(len(part.alone)) >= BEFORE).astype(float)
    turned = np.deg2rad(0.5) * np.array([0.6, 0.0, 0.8])
    imu = np.zeros(run.cues[CUES[0]].H.shape[1])
    for k, camera in enumerate(run.rig.cameras.values()):
        imu[MOUNTING * k : MOUNTING * k + 3] = -turned
        imu[MOUNTING * k + 3 : MOUNTING * k + 6] = -np.cross(turned, camera.rig_from_cam.translation)
    clock = np.zeros(len(imu))
    clock[MOUNTING + 6] = 0.02
    rows = {
        "IMU knocked by 0.5 deg": part.changed(imu, since),
        "clock jumps by 20 ms": part.changed(clock, since),
    }
    whole = run.with_errors(3)
    lists = np.deg2rad(np.arange(len(whole.alone)) >= len(whole.alone) // 2)
    gravity = so3.exp(lists[:, None] * np.array([1.0, 0, 0])) @ whole.alone.gravity[:, :, None]
    rows["the boat lists by 1 deg"] = replace(whole, alone=replace(whole.alone, gravity=gravity[:, :, 0]))
    for what, changed in rows.items():
        tell(f"eights, {what}", changed)


def in_full(motion: str, what: str, fault: MountFault | None, seconds: float, hs_m: float = 0.25) -> None:
    """A fault simulated itself."""
    cues, rig, _ = scored_watch(motion, seconds, 7, fault, hs_m)
    tell(f"{motion}, {what} (in full)", Run.of(cues, rig))


def tell(what: str, run: Run) -> None:
    """What is said at the end."""
    judgement = run.judged()
    words = [alarm.words for alarm in judgement.alarms] + rig_notes(judgement, Thresholds())
    states = dict(zip(run.alone.cameras, map(str, judgement.standings[-1]), strict=True))
    blamed = [name for name, state in states.items() if state == "DRIFTED"]
    if not words and "UNOBSERVABLE" in states.values():
        camera = list(states.values()).index("UNOBSERVABLE")
        std = judgement.statistics.std_deg[-1, camera]
        words = [unobservable_words(judgement.scores, std, camera, Thresholds())]
    ever_ok = any(state is CameraState.OK for row in judgement.standings for state in row)
    print(
        f"  {what}: blamed {', '.join(blamed) or 'none'}; {'; '.join(dict.fromkeys(words)) or 'nothing said'}; "
        f"at the end {', '.join(sorted(set(states.values())))}{'' if ever_ok else ', never OK'}",
        flush=True,
    )


def drop(pixels: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Pixels through a drop on the lens."""
    away = pixels - np.array([150.0, 200.0])
    far = np.linalg.norm(away, axis=1, keepdims=True)
    return np.asarray(pixels + np.where(far < 70, away * 0.25 * (1 - far / 70), 0))


def roc(
    motion: str, runs: list[Run], draws: int, size_deg: float = 0.2
) -> dict[str, list[tuple[float, float]]]:
    """Mean delay (s, at most three minutes) of a step about any axis at rates of false alarms per hour, by cue."""
    choices: dict[str, tuple[str, ...]] = {name: (name,) for name in CUES} | {FUSED: CUES}
    moved: dict[str, list[np.ndarray]] = {label: [] for label in choices}
    for axis in range(3):
        for _, part in excerpts(runs, draws, [axis], np.deg2rad(size_deg)):
            for label, names in choices.items():
                moved[label].append(part.statistic(names)[BEFORE:])
    hours = sum(len(run.alone) for run in runs) * BLOCK_S / 3600
    curves = {}
    for label, names in choices.items():
        quiet = [run.with_errors(seed).statistic(names) for seed, run in enumerate(runs)]
        curves[label] = [
            (float(rate), delay_at(level_of(quiet, rate * hours), moved[label]))
            for rate in RATES
            if rate * hours >= 1
        ]
        words = ", ".join(f"{delay:.0f} s at {rate:g}/h" for rate, delay in curves[label])
        print(f"  {motion}, {size_deg:g} deg by {label}: {words}", flush=True)
    best = [min(curves[name][k][1] for name in CUES) for k in range(len(curves[FUSED]))]
    worst = max(delay / least for (_, delay), least in zip(curves[FUSED], best, strict=True))
    print(f"  {motion}: delay by all together over that of the best cue, at worst {worst:.2f}", flush=True)
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
    colours = dict(zip([*CUES, FUSED], ("#c2410c", "#0f766e", "#7c3aed", "#111827"), strict=True))
    parts = []
    for k, (motion, by_cue) in enumerate(curves.items()):
        x0 = k * (WIDTH + 20) + LEFT
        parts.append(f'<text x="{x0}" y="14" font-weight="bold">{motion}</text>')
        for delay in (0, 60, 120, 180):
            y = _to_y(delay)
            parts.append(f'<path d="M{x0} {y:.1f}H{x0 + WIDTH - LEFT}" stroke="#d1d5db"/>')
            parts.append(f'<text x="{x0 - 5}" y="{y + 4:.1f}" text-anchor="end">{delay}</text>')
        for rate in (3, 10, 30):
            x = _to_x(x0, rate)
            parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 14}" text-anchor="middle">{rate}</text>')
        for label, curve in by_cue.items():
            points = " ".join(f"{_to_x(x0, rate):.1f},{_to_y(delay):.1f}" for rate, delay in curve)
            width = 2.5 if label == FUSED else 1.5
            parts.append(
                f'<polyline points="{points}" fill="none" stroke="{colours[label]}" stroke-width="{width}"/>'
            )
    for k, (label, colour) in enumerate(colours.items()):
        parts.append(f'<text x="{LEFT + 110 * k}" y="{HEIGHT + 12}" fill="{colour}">{label}</text>')
    total = max(len(curves), 2) * (WIDTH + 20) + 10
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total} {HEIGHT + 20}" font-family="sans-serif" '
        f'font-size="11" role="img" aria-label="Delay in seconds over false alarms per hour, by cue">'
        f'<rect width="100%" height="100%" fill="#ffffff"/>{"".join(parts)}</svg>\n',
        encoding="utf-8",
    )


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=10)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--motion", choices=MOTIONS, action="append", help="one of them only")
    parser.add_argument("--save", type=Path, help="folder in which the scores are kept for another time")
    parser.add_argument("--score-only", action="store_true", help="only score, for --save")
    parser.add_argument(
        "--roc", type=Path, default=ROC, help="file for the picture of delays over false alarms"
    )
    arguments = parser.parse_args()
    curves = {}
    for motion in arguments.motion or MOTIONS:
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.runs)
        runs = [kept_or_scored(motion, arguments.minutes, seed, arguments.save) for seed in seeds]
        if arguments.score_only:
            continue
        false_alarms(motion, runs)
        if motion == "straight":
            continue
        steps(motion, runs, arguments.draws)
        ramps(motion, runs[0])
        curves[motion] = roc(motion, runs, max(arguments.draws // 2, 1))
        if motion == "eights":
            not_blamed(runs[0])
            in_full(motion, "clock jumps by 20 ms", MountFault("left", 43.0, late_s=0.02), 80.0)
            in_full(motion, "a drop on the lens", MountFault("left", 43.0, pixels=drop), 80.0)
    if arguments.score_only:
        return
    in_full("straight", "calm water, nothing moved", None, 60.0, 0.02)
    in_full("standstill", "nothing moved", None, 60.0, 0.02)
    turned = MountFault("left", 33.0, turned_rad=np.deg2rad([0.3, 0.0, 0.0]))
    in_full("standstill", "left turns by 0.3 deg about bow", turned, 60.0, 0.02)
    if not arguments.motion:
        draw_roc(curves, arguments.roc)


if __name__ == "__main__":
    main()
