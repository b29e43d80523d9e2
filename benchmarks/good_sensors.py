"""Recordings with nothing wrong, on calm and on rough water: is a sensor accused, or repaired?

    python benchmarks/good_sensors.py [--rigs 20]

Tracks only, no pictures. Each rig is two cameras of a preset, taken in turn, their mountings moved and turned at
random, on 0 to 0.2 (every other rig) or 1 to 1.6 times its waves; receivers are of RTK or of 1 m by turns. Paths are
the true ones in a unit of their own, with the noise and the drift of a good odometry: 0.2 mrad and 3 mm a frame, a
scale and a heading that wander by 0.5 % and 0.3 degrees. Lenses, gyroscope, clocks, mounts, accelerometer and receiver
are compared as `calibrate` does. Ends with exit code 1 if any sensor was accused.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from calibration_worlds import true_odometry
from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.pipeline.sensor_checks import vet_sensors
from rigwake.pipeline.stream_selection import select
from rigwake.plausibility.coarse_turns import vet_turns
from rigwake.plausibility.imu_samples import vet_samples
from rigwake.plausibility.values import SensorCheck
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.sensors import gauss_markov
from rigwake.simulation.tracks_only import SimulatedTracks, simulate_tracks
from rigwake.trajectory import Trajectory

PRESETS = ("demo", "ferry", "marina", "mast", "quay", "thesis", "workboat")


def random_rig(seed: int) -> tuple[str, SimulatedTracks]:
    """What it is, and half a minute of it."""
    rng, rough = np.random.default_rng(seed), seed % 2 == 1
    document = load_scenario(PRESETS[seed % len(PRESETS)]).model_dump()
    chosen = rng.choice(len(document["cameras"]), min(2, len(document["cameras"])), replace=False)
    document["cameras"] = [document["cameras"][k] for k in sorted(chosen)]
    for camera in document["cameras"]:
        x, y, z = camera["position_m"]
        camera["position_m"] = [x, y, z + rng.uniform(0.1, 0.9)]
        camera["yaw_deg"] += rng.uniform(-20, 20)
        camera["pitch_deg"] += rng.uniform(-5, 5)
    document["seed"], document["scene"]["seed"] = seed, seed + 500
    document["duration_s"] = min(document["duration_s"] or 30, 30)
    document["sea"]["hs_m"] = (0.1 + document["sea"]["hs_m"]) * rng.uniform(
        *((1.0, 1.6) if rough else (0.0, 0.2))
    )
    metre = {"white_std_m": 0.25, "correlated_std_m": 1.0, "correlated_tau_s": 40}
    rtk = {"white_std_m": None, "correlated_std_m": None, "quality": "rtk"}
    if document["gnss"] is not None:
        document["gnss"] |= metre if seed % 3 == 0 else rtk
    document["tracking"] |= {"features": 50, "landmarks": 800, "outliers": 0.005, "water": 0.05}
    words = f"{PRESETS[seed % len(PRESETS)]}, waves {document['sea']['hs_m']:.2f} m"
    return words, simulate_tracks(build_scenario(document, f"rig {seed}"))


def drifting_odometry(world: SimulatedTracks, seed: int) -> dict[str, Trajectory]:
    """What a good odometry of every camera reports."""
    found, rng = {}, np.random.default_rng(seed)
    for name, true in true_odometry(world, metric=True).items():
        path, n = true.world_from_body, len(true.timestamps_ns)
        wander = gauss_markov(rng, n, float(np.median(np.diff(true.timestamps_ns))) * 1e-9, 1.0, 20.0)
        heading = so3.exp(np.deg2rad(0.3) * wander * [0.3, 0.3, 1.0])
        steps = np.diff(path.translation, axis=0) * (1 + 0.005 * wander[:-1, :1])
        turned = np.einsum("nij,nj->ni", heading[:-1], steps)
        at = np.concatenate([np.zeros((1, 3)), np.cumsum(turned, axis=0)]) + rng.normal(0, 0.003, (n, 3))
        rotation = heading @ path.rotation @ so3.exp(rng.normal(0, 2e-4, (n, 3)))
        found[name] = Trajectory(name, true.timestamps_ns, SE3(rotation, at / 5.0), is_metric=False)
    return found


def checked(world: SimulatedTracks, seed: int) -> tuple[SensorCheck, ...]:
    """Every comparison of the rig's sensors. Raises InputError where the IMU is refused."""
    selection = select(world.recording, load_config(None, ("intrinsics=fixed",)))
    trajectories = drifting_odometry(world, seed)
    by_samples: tuple[SensorCheck, ...] = ()
    if selection.imu is not None:
        by_samples = (*vet_samples(selection.imu).checks, *vet_turns(selection.imu, trajectories).checks)
    return (*by_samples, *vet_sensors(selection, world.tracks, trajectories, repair=True).checks)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    chosen = parser.parse_args()
    accused = 0
    print("| rig | comparisons | accused, or repaired | |\n|---|---|---|---|")
    for seed in range(chosen.first, chosen.first + chosen.rigs):
        started = time.process_time()
        words, world = random_rig(seed)
        try:
            checks = checked(world, seed)
            wrong = [c.sentence for c in checks if not c.agrees or c.action != "none"]
        except RigwakeError as error:
            checks, wrong = (), [str(error)]
        accused += bool(wrong)
        seconds = time.process_time() - started
        print(
            f"| {seed}: {words} | {len(checks)} | {'; '.join(wrong) or 'nobody'} | {seconds:.0f} s |",
            flush=True,
        )
    print(f"\nrigs with a false accusation: {accused} of {chosen.rigs}")
    return int(accused > 0)


if __name__ == "__main__":
    sys.exit(main())
