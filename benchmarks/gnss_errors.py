"""Rigs at random with a receiver of a metre whose error lasts, with an outage: with the receiver, and without.

    python benchmarks/gnss_errors.py [--rigs 30] [--features 50]

Tracks only, no pictures; lenses exact. Half of the rigs are on the `ferry` (its own manoeuvres, outage of 10 s), half
on the `demo` boat with an outage of 6 s. Three cameras of the preset, their mountings moved and turned at random;
waves, landmarks, noise and receiver by the seed. The rig is estimated as `calibrate --trajectories` does it, from what
a perfect odometry reports. Figures: the offset's error of the worst camera, the error of the largest distance between
two cameras, NEES per degree of freedom of the whole rig.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from calibration_worlds import true_odometry
from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.rig_stage import estimate_rig, initialise_rig
from rigwake.pipeline.stream_selection import select
from rigwake.readers.truth_files import rig_in_frame
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.tracks_only import SimulatedTracks, simulate_tracks

SETTINGS = ("adjustment.cross_camera=false", "intrinsics=fixed")


def random_rig(seed: int, features: int) -> SimulatedTracks:
    """A sail of 60 s (`ferry`) or 28 s (`demo`) with three cameras somewhere on the boat."""
    rng = np.random.default_rng(seed)
    preset = ("ferry", "demo")[seed % 2]
    document = load_scenario(preset).model_dump()
    chosen = rng.choice(len(document["cameras"]), 3, replace=False)
    document["cameras"] = [document["cameras"][k] for k in sorted(chosen)]
    for camera in document["cameras"]:
        outward = 1.0 + rng.uniform(0.0, 0.1)  # not into the hull
        x, y, z = camera["position_m"]
        camera["position_m"] = [outward * x, outward * y, z + rng.uniform(0.1, 0.9)]
        camera["yaw_deg"] += rng.uniform(-20, 20)
        camera["pitch_deg"] += rng.uniform(-5, 5)
    document["seed"], document["scene"]["seed"] = seed, seed + 1000
    document["duration_s"] = min(document["duration_s"] or 28, 64)
    outage = [[40, 50]] if preset == "ferry" else [[12, 18]]
    document["gnss"] |= {"quality": "standalone", "outages_s": outage}
    document["tracking"] |= {"features": features, "landmarks": 800, "outliers": 0.01, "water": 0.1}
    return simulate_tracks(build_scenario(document, f"rig {seed}"))


def rig_errors(world: SimulatedTracks) -> Mapping[str, Any]:
    """Worst offset (m), relative error of the longest baseline, NEES and its degrees of freedom."""
    recording, config = world.recording, load_config(None, SETTINGS)
    selection, prior = select(recording, config), RigPrior()
    first = initialise_rig(selection, true_odometry(world, metric=False), config, prior)
    rig = estimate_rig(recording, selection, world.tracks, first, config, prior, masks=Path("none"))
    found = rig.calibration
    truth = rig_in_frame(recording.true_rig, found.reference)
    names = list(found.cameras)
    errors = {n: truth.cameras[n].rig_from_cam.local(found.cameras[n].rig_from_cam) for n in names}
    true_at = np.stack([truth.cameras[n].rig_from_cam.translation for n in names])
    at = np.stack([found.cameras[n].rig_from_cam.translation for n in names])
    baselines = np.linalg.norm(true_at[:, None] - true_at[None], axis=-1)
    longest = np.unravel_index(np.argmax(baselines), baselines.shape)
    long_m = np.linalg.norm(at[longest[0]] - at[longest[1]])
    joint = np.concatenate([errors[n] for n in names])
    assert found.joint_covariance is not None
    return {
        "offset_m": max(float(np.linalg.norm(e[3:])) for e in errors.values()),
        "baseline": float(long_m / baselines[longest] - 1.0),
        "nees": float(joint @ np.linalg.solve(found.joint_covariance, joint)) / len(joint),
        "cameras": len(names),
    }


def without_receiver(world: SimulatedTracks) -> SimulatedTracks:
    return replace(world, recording=replace(world.recording, gnss={}))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rigs", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--features", type=int, default=50)
    chosen = parser.parse_args()
    rows = []
    print("| rig | offset with, without (cm) | baseline with, without (%) | NEES/dof with, without |")
    print("|---|---|---|---|")
    for seed in range(chosen.first, chosen.first + chosen.rigs):
        world = random_rig(seed, chosen.features)
        try:
            both = [rig_errors(world), rig_errors(without_receiver(world))]
        except RigwakeError as error:
            print(f"| {seed} | refused: {error} | | |", flush=True)
            continue
        rows.append(both)
        offset, baseline, nees = ([row[key] for row in both] for key in ("offset_m", "baseline", "nees"))
        print(
            f"| {seed} | {100 * offset[0]:.1f}, {100 * offset[1]:.1f} "
            f"| {100 * baseline[0]:+.2f}, {100 * baseline[1]:+.2f} | {nees[0]:.2f}, {nees[1]:.2f} |",
            flush=True,
        )
    if not rows:
        return
    offset, baseline, nees = (
        np.array([[one[key] for one in row] for row in rows]) for key in ("offset_m", "baseline", "nees")
    )
    worst_m, longest = offset[:, 0], np.abs(baseline[:, 0])
    print(f"\nrigs calibrated: {len(rows)} of {chosen.rigs}")
    print(f"offset, median and largest (cm): {100 * np.median(worst_m):.1f}, {100 * worst_m.max():.1f}")
    print(f"baseline, median and largest (%): {100 * np.median(longest):.2f}, {100 * longest.max():.2f}")
    print(f"mean NEES/dof with the receiver {nees[:, 0].mean():.2f}, without {nees[:, 1].mean():.2f}")
    print(f"not worse than without (by 1 mm or 10 %): {np.mean(worst_m <= 1.1 * offset[:, 1] + 1e-3):.0%}")


if __name__ == "__main__":
    main()
