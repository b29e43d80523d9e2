"""How hand-eye calibration degrades with noise: the study of the method that rigwake started from, repeated.

    python benchmarks/noise_study.py [--draws 100] [--write docs]

A boat sails a circle in 176 poses with about a degree of roll and pitch; two cameras look 90 degrees apart and
15 degrees down. Normal errors are added to the matrix elements of the poses ("additive") or of the increments,
which are then chained ("cumulative"); rotations are projected back onto SO(3). Errors are along and about the
axes of the boat, through the first camera's known place on it. `ml` is told the noise it has.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, NoiseLevel, pose_problem, step_covariances
from rigwake.handeye.initial_mounting import thesis_handeye
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.likelihood import form_equations
from rigwake.handeye.motions import Mounting, residuals
from rigwake.handeye.noise import Jitter, known_noise
from rigwake.trajectory import Trajectory

POSES, RADIUS_M, STEP_NS = 176, 20.0, 100_000_000
LEVELS = [(0, 1e-3), (0, 1e-2), (0, 1e-1), (1e-4, 0), (1e-3, 0), (1e-4, 1e-3), (1e-3, 1e-2)]
# worst axis, metres, as the original study prints them (those of its rows that are known to us)
PRINTED = {
    ("cumulative", 0, 1e-3): 0.27,
    ("cumulative", 0, 1e-2): 2.24,
    ("cumulative", 0, 1e-1): 40.0,
    ("additive", 0, 1e-1): 0.21,
}
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def boat() -> SE3:
    """World from rig on a circle, roll and pitch of one degree RMS."""
    k = np.arange(POSES)
    yaw = 2 * np.pi * k / (POSES - 1)
    wave = np.deg2rad(np.sqrt(2.0))
    roll, pitch = wave * np.sin(2 * np.pi * k / 12), wave * np.sin(2 * np.pi * k / 15 + 1)
    turn = so3.exp(np.outer(yaw, [0, 0, 1])) @ so3.exp(np.outer(pitch, [0, 1, 0]))
    position = np.stack([RADIUS_M * np.sin(yaw), RADIUS_M * (1 - np.cos(yaw)), 0.1 * np.sin(k / 5)], axis=1)
    return SE3(turn @ so3.exp(np.outer(roll, [1, 0, 0])), position)


def camera(yaw_deg: float, position: list[float]) -> SE3:
    turn = so3.exp([0, 0, np.deg2rad(yaw_deg)]) @ so3.exp([0, np.deg2rad(15.0), 0])
    return SE3(turn @ OPTICAL, np.array(position))


FRONT, PORT = camera(0, [3.0, 0, 1.5]), camera(90, [0, 1.2, 1.4])
TRUTH = FRONT.inverse() * PORT


def noisy_elements(
    transforms: SE3, rotation_std: float, translation_std: float, rng: np.random.Generator
) -> SE3:
    n = len(transforms)
    turned = transforms.rotation + rotation_std * rng.normal(size=(n, 3, 3))
    rotation = so3.nearest_rotation(turned) if rotation_std else transforms.rotation
    return SE3(rotation, transforms.translation + translation_std * rng.normal(size=(n, 3)))


def noisy(
    poses: SE3, kind: str, rotation_std: float, translation_std: float, rng: np.random.Generator
) -> SE3:
    if kind == "additive":
        return noisy_elements(poses, rotation_std, translation_std, rng)
    increments = noisy_elements(poses[:-1].inverse() * poses[1:], rotation_std, translation_std, rng)
    chained = [poses[0]]
    for k in range(len(increments)):
        chained.append(chained[-1] * increments[k])
    return SE3(np.stack([x.rotation for x in chained]), np.stack([x.translation for x in chained]))


def trajectory(name: str, poses: SE3) -> Trajectory:
    return Trajectory(name, np.arange(len(poses)) * STEP_NS, poses)


def options_for(kind: str, rotation_std: float, translation_std: float) -> HandeyeOptions:
    # the skew part of a matrix of independent elements has their deviation over sqrt(2)
    level = NoiseLevel(rotation_std / np.sqrt(2), translation_std)
    return HandeyeOptions(
        noise="poses" if kind == "additive" else "increments",
        levels={"front": level, "port": level},
        time_offset=False,
    )


def in_boat_axes(tangents: np.ndarray) -> np.ndarray:
    """Right-tangent errors of `front_from_port` (..., 6) about and along the axes of the boat."""
    R = (FRONT * TRUTH).rotation
    return np.concatenate([tangents[..., :3] @ R.T, tangents[..., 3:] @ R.T], axis=-1)


def cramer_rao(kind: str, rotation_std: float, translation_std: float) -> np.ndarray:
    """(6,) smallest possible deviations in the axes of the boat: information at the true motion."""
    options = options_for(kind, rotation_std, translation_std)
    front, port = trajectory("front", boat() * FRONT), trajectory("port", boat() * PORT)
    problem = pose_problem(front, [port], options, [False])
    world = SE3.identity((1,)) if kind == "additive" else None
    truth = [Mounting(TRUTH, world, 0.0, np.zeros(1))]
    steps = problem.steps(truth)
    covariances = problem.known_covariances(truth, step_covariances(problem, options))
    equations = form_equations(
        problem,
        steps,
        truth,
        [residuals(steps[0], truth[0])],
        known_noise([TRUTH], *covariances),
        [Jitter()],
        robust=False,
    )
    scale = 1 / np.sqrt(np.diag(equations.information))
    scaled = equations.information * scale[:, None] * scale[None, :]
    covariance = (np.linalg.inv(scaled) * scale[:, None] * scale[None, :])[:6, :6]
    R = np.kron(np.eye(2), (FRONT * TRUTH).rotation)
    return np.sqrt(np.diag(R @ covariance @ R.T))


@dataclass(frozen=True)
class Row:
    """One noise level: RMSE per axis (6,) of both methods, the bound, NEES and how often z was refused."""

    kind: str
    rotation_std: float
    translation_std: float
    thesis_rmse: np.ndarray
    ml_rmse: np.ndarray
    bound: np.ndarray
    nees: float
    thesis_median_worst: float
    ml_median_worst: float


def study(kind: str, rotation_std: float, translation_std: float, draws: int) -> Row:
    options = options_for(kind, rotation_std, translation_std)
    baseline, ours, nees = [], [], []
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        front = noisy(boat() * FRONT, kind, rotation_std, translation_std, rng)
        port = noisy(boat() * PORT, kind, rotation_std, translation_std, rng)
        baseline.append(in_boat_axes(TRUTH.local(thesis_handeye(front, port))))
        result = calibrate_handeye(trajectory("front", front), [trajectory("port", port)], options)
        d = TRUTH.local(result.ref_from_members["port"])
        ours.append(in_boat_axes(d))
        unknown = slice(3, 6) if rotation_std == 0 else slice(0, 6)  # exact rotations have no deviation
        covariance = result.joint_covariance[unknown, unknown]
        nees.append(d[unknown] @ np.linalg.solve(covariance, d[unknown]) * 6 / len(d[unknown]))

    def rmse(errors: list[np.ndarray]) -> np.ndarray:
        return np.sqrt(np.mean(np.square(errors), axis=0))

    def worst(errors: list[np.ndarray]) -> float:
        return float(np.median(np.abs(errors), axis=0)[3:].max())

    bound = cramer_rao(kind, rotation_std, translation_std)
    return Row(
        kind,
        rotation_std,
        translation_std,
        rmse(baseline),
        rmse(ours),
        bound,
        float(np.mean(nees)),
        worst(baseline),
        worst(ours),
    )


def markdown(rows: list[Row], draws: int) -> str:
    spread = 1.96 * np.sqrt(12 / draws)
    lines = [
        f"Worst translation axis, median of {draws} draws; RMSE over the Cramer-Rao bound per axis (roll, pitch, "
        f"yaw, x, y, z of the boat); mean NEES, 6 is expected, 95 % of honest estimators lie in "
        f"{6 - spread:.2f} .. {6 + spread:.2f} (rows with exact rotations: {6 - spread * np.sqrt(2):.2f} .. "
        f"{6 + spread * np.sqrt(2):.2f}). A dash: exact rotations, no bound.",
        "",
        "| noise | stdR | stdT m | printed by the original | thesis | ml | bound, worst axis RMSE m "
        "| ml RMSE / bound | NEES |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        printed = PRINTED.get((row.kind, row.rotation_std, row.translation_std))
        ratios = row.ml_rmse / row.bound
        if row.rotation_std == 0:
            ratios[:3] = np.nan
        shown = " ".join("–" if np.isnan(x) else f"{x:.2f}" for x in ratios)
        lines.append(
            f"| {row.kind} | {row.rotation_std:g} | {row.translation_std:g} | "
            f"{'' if printed is None else f'{printed:g} m'} | {_metres(row.thesis_median_worst)} | "
            f"{_metres(row.ml_median_worst)} | {_metres(row.bound[3:].max())} | {shown} | {row.nees:.2f} |"
        )
    return "\n".join(lines) + "\n"


def _metres(value: float) -> str:
    if value >= 1:
        return f"{value:.2f} m"
    return f"{1e2 * value:.1f} cm" if value >= 0.01 else f"{1e3 * value:.3g} mm"


def plot(rows: list[Row], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for panel, kind in zip(panels, ("additive", "cumulative"), strict=True):
        chosen = [row for row in rows if row.kind == kind]
        at = np.arange(len(chosen))
        panel.semilogy(at, [r.thesis_rmse[3:].max() for r in chosen], "s", color="tab:red", label="thesis")
        panel.semilogy(at, [r.ml_rmse[3:].max() for r in chosen], "o", color="tab:blue", label="ml")
        panel.semilogy(at, [r.bound[3:].max() for r in chosen], "k_", markersize=18, label="Cramér-Rao bound")
        labels = [f"{r.rotation_std:g}\n{r.translation_std:g}" for r in chosen]
        panel.set_xticks(at, labels)
        panel.set_title(f"{kind} noise")
        panel.set_xlabel("stdR (matrix element) / stdT (m)")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("RMSE of the worst translation axis, m")
    panels[0].legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument(
        "--write", type=Path, help="folder of noise_study.md, whose table is renewed, and noise_study.png"
    )
    arguments = parser.parse_args()
    rows = [study(kind, *level, arguments.draws) for kind in ("additive", "cumulative") for level in LEVELS]
    text = markdown(rows, arguments.draws)
    print(text)
    if arguments.write:
        page = arguments.write / "noise_study.md"
        before, _, after = page.read_text().partition("Worst translation axis")
        page.write_text(before + text + "\n![" + after.partition("\n![")[2])
        plot(rows, arguments.write / "noise_study.png")


if __name__ == "__main__":
    main()
