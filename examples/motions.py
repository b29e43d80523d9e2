"""Which motion determines what: four ways to sail, calibrated by hand-eye, drawn side by side.

python examples/motions.py docs/motions.png

Two cameras, 90 degrees apart, with odometry that drifts 2 mm and 0.01 degrees per step (10 steps per second, one
minute). The numbers below each path are what rigwake says about the second camera.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rigwake.calibration import CalibratedCamera
from rigwake.errors import UnobservableError
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, NoiseLevel
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.trajectory import Trajectory

RATE_HZ, DURATION_S = 10.0, 60.0
NOISE = NoiseLevel(np.deg2rad(0.01), 0.002)
REF_FROM_CAM = SE3.exp(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])) * SE3.exp(
    np.array([0, 0, 0, 0.8, 0.5, 0.3])
)

Course = Callable[[np.ndarray], np.ndarray]


def sail(heading: Course, tilt_deg: float) -> SE3:
    """The boat's poses: 2 m/s along its heading, rolling and pitching by so much."""
    t = np.arange(0, DURATION_S, 1 / RATE_HZ)
    yaw = heading(t)
    velocity = 2.0 * np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(t)], axis=1)
    position = np.cumsum(velocity, axis=0) / RATE_HZ
    tilt = np.deg2rad(tilt_deg)
    zero = np.zeros((len(t), 3))
    turn = SE3.exp(np.concatenate([np.stack([0 * t, 0 * t, yaw], axis=1), zero], axis=1))
    roll, pitch = tilt * np.sin(2 * np.pi * t / 3.1), tilt * np.sin(2 * np.pi * t / 4.3)
    lean = SE3.exp(np.concatenate([np.stack([roll, pitch, 0 * t], axis=1), zero], axis=1))
    return SE3((turn * lean).rotation, position)


def odometry(name: str, world_from_body: SE3, rng: np.random.Generator) -> Trajectory:
    """The same motion with noise on every increment."""
    steps = world_from_body[:-1].inverse() * world_from_body[1:]
    std = np.repeat([NOISE.rotation_std, NOISE.translation_std], 3)
    noisy = steps.retract(rng.normal(0, std, (len(steps), 6)))
    poses = [SE3.identity()]
    for k in range(len(noisy)):
        poses.append(poses[-1] * noisy[k])
    stamps = (np.arange(len(poses)) * int(1e9 / RATE_HZ)).astype(np.int64)
    rotation, translation = np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])
    return Trajectory(name, stamps, SE3(rotation, translation))


def verdict(world_from_boat: SE3, seed: int = 0) -> list[str]:
    """What hand-eye says about the second camera, in two or three lines."""
    rng = np.random.default_rng(seed)
    reference = odometry("first", world_from_boat, rng)
    member = odometry("second", world_from_boat * REF_FROM_CAM, rng)
    options = HandeyeOptions(noise="increments", levels={"first": NOISE, "second": NOISE}, time_offset=False)
    try:
        camera = calibrate_handeye(reference, [member], options).members["second"]
    except UnobservableError as error:
        return ["nothing determined", error.cause[:60]]
    return lines_of(camera)


def lines_of(camera: CalibratedCamera) -> list[str]:
    """Standard deviations of what is determined, and the words for what is not."""
    rotation = camera.std_rotation_deg
    turned = f"± {np.nanmax(rotation):.2f}°" if np.isfinite(rotation).all() else "unobservable"
    known = np.isfinite(camera.std_translation_m)
    offsets = [
        f"{n} {100 * s:.1f} cm" if np.isfinite(s) else f"{n} –"
        for n, s in zip("xyz", camera.std_translation_m, strict=True)
    ]
    return [f"rotation {turned}", "offset ± " + ", ".join(offsets) if any(known) else "offset unobservable"]


def eight(t: np.ndarray) -> np.ndarray:
    """Full turns to one side, then to the other."""
    return 2.2 * np.pi * np.sin(2 * np.pi * t / DURATION_S)


MOTIONS: dict[str, tuple[Course, float]] = {
    "straight, calm": (lambda t: 0 * t, 0.0),
    "steady circle, calm": (lambda t: 2 * np.pi * t / DURATION_S, 0.0),
    "turns to both sides, calm": (eight, 0.0),
    "the same in waves of 3°": (eight, 3.0),
}


def main(picture: str) -> None:
    """Draw all motions and print what they determine."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    for axes, (title, (heading, tilt_deg)) in zip(
        figure.subplots(1, len(MOTIONS)), MOTIONS.items(), strict=True
    ):
        boat = sail(heading, tilt_deg)
        said = verdict(boat)
        print(f"{title}: {'; '.join(said)}")
        axes.plot(*boat.translation[:, :2].T, color="#0072B2")
        axes.plot(*boat.translation[0, :2], "s", color="#0072B2", ms=4)
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("\n".join(said), fontsize=8)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xticks=[], yticks=[])
    Path(picture).parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_figure(picture, dpi=130)


if __name__ == "__main__":
    main(sys.argv[1])
