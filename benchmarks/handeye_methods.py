"""Accuracy and time of hand-eye methods: the classical closed forms, the thesis baseline and `ml`.

    python benchmarks/handeye_methods.py [--draws 30] [--only accuracy|time]

The boat circuit of `noise_study.py` (176 poses). The closed forms get the motions over ten poses. OpenCV 5 has no
`calibrateHandEye`; its methods, on all pairs of poses as it forms them, are shown in an environment with OpenCV 4:

    python -m venv opencv4
    opencv4/bin/pip install -e . "opencv-contrib-python-headless<5"
    opencv4/bin/python benchmarks/handeye_methods.py --draws 20
"""

from __future__ import annotations

import argparse
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from closed_forms import CLOSED_FORMS
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions
from rigwake.handeye.initial_mounting import thesis_handeye
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.trajectory import Trajectory

STUDY = runpy.run_path(str(Path(__file__).with_name("noise_study.py")))
STRIDE = 10
NOISES = [
    ("additive", 1e-4, 1e-3),
    ("additive", 1e-3, 1e-2),
    ("cumulative", 1e-4, 1e-3),
    ("cumulative", 1e-3, 1e-2),
]
Solver = Callable[[SE3, SE3], SE3]


def motions(poses: SE3) -> SE3:
    return poses[:-STRIDE].inverse() * poses[STRIDE:]


def on_motions(solver: Solver) -> Solver:
    return lambda front, port: solver(motions(front), motions(port))


def opencv(method: int) -> Solver:
    def solve(front: SE3, port: SE3) -> SE3:
        board_from_port = port.inverse()  # OpenCV: gripper -> base, target -> camera
        R, t = cv2.calibrateHandEye(
            list(front.rotation),
            list(front.translation),
            list(board_from_port.rotation),
            list(board_from_port.translation),
            method=method,
        )
        return SE3(R, t.ravel())

    return solve


def ml(*, time_offset: bool = False, **fields) -> Solver:
    def solve(front: SE3, port: SE3) -> SE3:
        trajectories = [
            STUDY["trajectory"](name, poses) for name, poses in (("front", front), ("port", port))
        ]
        return calibrate_handeye(
            trajectories[0], trajectories[1:], HandeyeOptions(time_offset=time_offset, **fields)
        ).ref_from_members["port"]

    return solve


def solvers(kind: str) -> dict[str, Solver]:
    found: dict[str, Solver] = {name: on_motions(solver) for name, solver in CLOSED_FORMS.items()}
    if hasattr(cv2, "calibrateHandEye"):
        for name in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS"):
            found[f"cv2 {name}"] = opencv(getattr(cv2, f"CALIB_HAND_EYE_{name}"))
    found["thesis"] = thesis_handeye
    found["ml, noise estimated"] = ml()
    found["ml, kind of noise told"] = ml(noise="poses" if kind == "additive" else "increments")
    found["ml, noise and clock estimated"] = ml(time_offset=True)
    return found


def compare(draws: int) -> None:
    print(
        "| method | "
        + " | ".join(f"{k} {r:g} / {t:g} m" for k, r, t in NOISES)
        + " | CPU ms, 176 poses: median (best) | / ml |"
    )
    print("|---|" + "---|" * (len(NOISES) + 2))
    columns, times = [], {}
    for kind, rotation_std, translation_std in NOISES:
        errors: dict[str, list[tuple[float, float]]] = {}
        for draw in range(draws):
            rng = np.random.default_rng(draw)
            pair = [
                STUDY["noisy"](STUDY["boat"]() * X, kind, rotation_std, translation_std, rng)
                for X in (STUDY["FRONT"], STUDY["PORT"])
            ]
            for name, solver in solvers(kind).items():
                start = process_time()
                found = solver(*pair)
                times.setdefault(name, []).append(1e3 * (process_time() - start))
                off = STUDY["TRUTH"].inverse() * found
                turn = np.rad2deg(np.linalg.norm(so3.log(off.rotation)))
                errors.setdefault(name, []).append((turn, 1e2 * np.linalg.norm(off.translation)))
        columns.append({name: np.median(e, axis=0) for name, e in errors.items()})
    reference = np.median(times["ml, noise estimated"])
    for name in columns[0]:
        cells = " | ".join(f"{c[name][0]:.3f} deg, {c[name][1]:.3g} cm" for c in columns)
        took = np.median(times[name])
        print(f"| {name} | {cells} | {took:.1f} ({min(times[name]):.1f}) | {took / reference:.2f} |")


def noisy_pair(kind: str, seed: int) -> list[Trajectory]:
    """The boat circuit with errors of 1e-4 and 1 mm: of increments, of poses, of both, or none."""
    rng = np.random.default_rng(seed)
    pair = []
    for name in ("FRONT", "PORT"):
        poses = STUDY["boat"]() * STUDY[name]
        for each in {"increments": ["cumulative"], "jitter": ["additive"], "exact": []}.get(
            kind, ["cumulative", "additive"]
        ):
            fraction = 0.3 if kind == "both" and each == "cumulative" else 1.0
            poses = STUDY["noisy"](poses, each, fraction * 1e-4, fraction * 1e-3, rng)
        pair.append(STUDY["trajectory"](name.lower(), poses))
    return pair


def short_trajectories(draws: int) -> None:
    """Time of one pair of 176 poses with the default options, after the first call."""
    print(f"| 176 poses, {draws} draws | clock | CPU ms: median (best) | wall ms: median (best) | / 10 ms |")
    print("|---|---|---|---|---|")
    for kind in ("exact", "increments", "jitter", "both"):
        for time_offset in (False, True):
            options, cpu, wall = HandeyeOptions(time_offset=time_offset), [], []
            for draw in range(draws):
                front, port = noisy_pair(kind, draw)
                if draw == 0:
                    calibrate_handeye(front, [port], options)  # compiles
                start = process_time(), perf_counter()
                calibrate_handeye(front, [port], options)
                cpu.append(1e3 * (process_time() - start[0]))
                wall.append(1e3 * (perf_counter() - start[1]))
            print(
                f"| {kind} | {'estimated' if time_offset else 'known'} | {np.median(cpu):.1f} ({min(cpu):.1f}) | "
                f"{np.median(wall):.1f} ({min(wall):.1f}) | {np.median(cpu) / 10:.2f} |"
            )


def long_trajectory() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(100_000) * 0.01
    yaw, roll = np.sin(t / 4), 0.1 * np.sin(t)
    R = so3.exp(np.outer(yaw, [0, 0, 1])) @ so3.exp(np.outer(roll, [1, 0, 0]))
    body = SE3(R, np.stack([t, 5 * np.sin(t / 3), np.sin(t)], axis=1))
    noise = rng.normal(size=(2, len(t), 6)) * 1e-4
    stamps = np.round(t * 1e9).astype(np.int64)
    pair = [
        Trajectory("rig", stamps, body.retract(noise[0])),
        Trajectory("port", stamps, (body * STUDY["PORT"]).retract(noise[1])),
    ]
    for time_offsets in (False, True):
        took = []
        for _ in range(5):
            start = process_time()
            calibrate_handeye(pair[0], pair[1:], HandeyeOptions(time_offset=time_offsets))
            took.append(process_time() - start)
        kind = "estimated" if time_offsets else "known"
        print(f"100 000 poses, clocks {kind}: {np.median(took):.2f} s of CPU (best {min(took):.2f})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--only", choices=("accuracy", "time"))
    arguments = parser.parse_args()
    if arguments.only != "time":
        compare(arguments.draws)
        print()
    if arguments.only != "accuracy":
        short_trajectories(2 * arguments.draws)
        print()
        long_trajectory()


if __name__ == "__main__":
    main()
