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
from dataclasses import replace
from pathlib import Path

import numpy as np

from monitor_roc import draw_roc, roc
from monitor_watches import AFTER, BEFORE, LOOKS_SMALLER, Run, excerpts, kept_or_scored, scored_watch
from rigwake.geometry import so3
from rigwake.monitor.cues import CUES
from rigwake.monitor.pair_kernels import MOUNTING
from rigwake.monitor.score import BLOCK_S
from rigwake.monitor.states import CameraState
from rigwake.monitor.thresholds import Thresholds
from rigwake.monitor.verdict_words import rig_notes, unobservable_words
from rigwake.simulation.track_stream import MountFault

MOTIONS = ("eights", "gentle", "straight")
AXES = ("bow", "port", "up")
ROC = Path(__file__).resolve().parent.parent / "docs" / "measurements" / "monitor_roc.svg"


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
