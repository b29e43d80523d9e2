"""Hand-eye where one of two trajectories is the better: noise learnt from the residuals against noise told.

    python benchmarks/handeye_sides.py [--draws 60]

176 poses, 0.2 s apart, of a boat that turns to both sides while it rolls and pitches by 0.1 rad; a camera 2 or 8 m
from the reference. Errors of increments (drift) or of poses (jitter), rotation as named, 1 mm. Told the noise,
maximum likelihood is at the Cramér-Rao bound (benchmarks/noise_study.py): the ratio is what learning it costs.
"""

import argparse

import numpy as np

from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, NoiseLevel, NoiseModel
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.trajectory import Trajectory

POSES, PERIOD_S, TRANSLATION_STD = 176, 0.2, 1e-3
SIDES = {"the camera's": (1e-5, 1e-3), "the reference's": (1e-3, 1e-5), "of both": (1e-3, 1e-3)}
KINDS: dict[str, NoiseModel] = {"drift": "increments", "jitter": "poses"}
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def sailed() -> SE3:
    t = np.arange(POSES) * PERIOD_S
    turn = (
        so3.exp(np.outer(np.deg2rad(60) * np.sin(t / 4), [0, 0, 1]))
        @ so3.exp(np.outer(0.1 * np.sin(t / 1.7), [0, 1, 0]))
        @ so3.exp(np.outer(0.1 * np.sin(t / 1.1 + 0.3), [1, 0, 0]))
    )
    return SE3(turn, np.stack([3 * t, 5 * np.sin(t / 3), np.sin(t / 0.9)], axis=1))


def noisy(name: str, poses: SE3, kind: str, rotation_std: float, rng: np.random.Generator) -> Trajectory:
    errors = rng.normal(size=(POSES, 6)) * np.repeat([rotation_std, TRANSLATION_STD], 3)
    if kind == "jitter":
        measured = poses.retract(errors)
    else:
        steps = (poses[:-1].inverse() * poses[1:]).retract(errors[1:])
        chained = [poses[0]]
        for k in range(POSES - 1):
            chained.append(chained[-1] * steps[k])
        measured = SE3(np.stack([x.rotation for x in chained]), np.stack([x.translation for x in chained]))
    stamps = np.round(np.arange(POSES) * PERIOD_S * 1e9).astype(np.int64)
    return Trajectory(name, stamps, measured)


def worst_axes(errors: list[np.ndarray]) -> np.ndarray:
    """RMSE of the worst axis: degrees, millimetres."""
    rmse = np.sqrt(np.mean(np.array(errors) ** 2, axis=0)).reshape(2, 3).max(axis=1)
    return rmse * [np.rad2deg(1), 1e3]


def compare(kind: str, sides: tuple[float, float], arm_m: float, draws: int) -> str:
    turn = so3.exp([0, 0, np.deg2rad(90)]) @ so3.exp([0, np.deg2rad(15), 0])
    X, rng = SE3(turn @ OPTICAL, np.array([arm_m, 1.2, 1.4])), np.random.default_rng(3)
    levels = {n: NoiseLevel(s, TRANSLATION_STD) for n, s in zip(("reference", "camera"), sides, strict=True)}
    known_fraction = HandeyeOptions(noise=KINDS[kind], levels=levels)
    errors: dict[bool, list[np.ndarray]] = {True: [], False: []}
    nees = []
    for _ in range(draws):
        reference = noisy("reference", sailed(), kind, sides[0], rng)
        member = noisy("camera", sailed() * X, kind, sides[1], rng)
        for learnt in (True, False):
            result = calibrate_handeye(reference, [member], HandeyeOptions() if learnt else known_fraction)
            error = X.local(result.ref_from_members["camera"])
            errors[learnt].append(error)
            if learnt:
                nees.append(error @ np.linalg.solve(result.members["camera"].covariance[:6, :6], error))
    learnt_rmse, told_rmse = worst_axes(errors[True]), worst_axes(errors[False])
    ratio = learnt_rmse / told_rmse
    return (
        f"{learnt_rmse[0]:.4f} deg, {learnt_rmse[1]:.1f} mm | {told_rmse[0]:.4f} deg, {told_rmse[1]:.1f} mm | "
        f"{ratio[0]:.2f}, {ratio[1]:.2f} | {np.mean(nees):.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=60)
    draws = parser.parse_args().draws
    print(
        "| errors | rotations (1e-3 rad a step) | arm, m | learnt (worst axis) | told | ratio | NEES (6 expected) |"
    )
    print("|---" * 7 + "|")
    for kind in KINDS:
        for whose, sides in SIDES.items():
            for arm_m in (2.0, 8.0):
                print(f"| {kind} | {whose} | {arm_m:g} | {compare(kind, sides, arm_m, draws)} |", flush=True)


if __name__ == "__main__":
    main()
