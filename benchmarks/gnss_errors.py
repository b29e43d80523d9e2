"""Rigs at random with a receiver of a metre whose error lasts, with an outage: with the receiver, and without.

    python benchmarks/gnss_errors.py [--rigs 30]

Tracks only, no pictures; lenses exact. Half of the rigs are on the `ferry` (a turn each way, 60 s, outage of 10 s),
half on the `demo` boat (28 s, outage of 6 s), on 0.6 to 1.4 times the waves of the preset. Three of its cameras, their
mountings moved and turned at random; waves, landmarks, noise and receiver by the seed. Receivers err by 1 m (1.6 m in
height) with a correlation time of 40 s, and by white noise of 0.25 m. The rig is estimated as `calibrate` does it, from
what a perfect odometry reports; what its search of pictures finds, landmarks of one camera in others and at other
times, is drawn from the truth with the noise of tracks: up to four sightings of four landmarks in ten.

Figures: the offset's error of the worst camera and the standard deviation predicted for it (what the motion permits),
the same between two cameras, the error of the largest distance between two cameras, NEES per
degree of freedom of the whole rig.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from calibration_worlds import true_odometry
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.association_rounds import joined
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustmentOptions, AssembledProblem, RigMeasurements
from rigwake.ba.rig.rig_verdicts import ReferenceFrame, calibrated_cameras
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.rig_problem import Observations
from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.geometry.se3 import SE3
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.rig_stage import initialise_rig
from rigwake.pipeline.stream_selection import select
from rigwake.readers.truth_files import rig_in_frame
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.tracks_only import SimulatedTracks, simulate_tracks

OPTIONS = AdjustmentOptions(state_rate_hz=2.0, tracks_per_second=20)
ASSOCIATED, SIGHTINGS = 0.4, 4  # of the landmarks; at most, of each


def random_rig(seed: int) -> SimulatedTracks:
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
        camera["rolling_shutter_ms"] = 0.0
    document["seed"], document["scene"]["seed"] = seed, seed + 1000
    if preset == "ferry":  # turns both ways in a minute
        leg, turn = {"type": "straight", "duration_s": 5}, {"type": "turn", "angle_deg": 150}
        legs = [leg | {"speed_mps": 4.5}, turn | {"rate_deg_s": 6}, leg, turn | {"rate_deg_s": -6}]
        document["vessel"]["manoeuvres"], document["duration_s"] = legs, 60
    document["sea"]["hs_m"] *= rng.uniform(0.6, 1.4)
    outage = [[35, 45]] if preset == "ferry" else [[12, 18]]
    document["gnss"] |= {
        "white_std_m": 0.25,
        "correlated_std_m": 1.0,
        "correlated_tau_s": 40,
        "outages_s": outage,
    }
    document["tracking"] |= {"features": 30, "landmarks": 800, "outliers": 0.01, "water": 0.1}
    return simulate_tracks(build_scenario(document, f"rig {seed}"))


def with_association(assembled: AssembledProblem, world: SimulatedTracks, seed: int) -> AssembledProblem:
    """Observations of landmarks by tracks of other cameras and times, as the search in pictures would add them."""
    rng, problem = np.random.default_rng(seed), assembled.problem
    names = [camera.name for camera in problem.cameras]
    used = [
        np.unique(problem.observations.timestamps_ns[problem.observations.camera_indices == k])
        for k in range(3)
    ]
    known = [_landmark_of_track(world, name) for name in names]
    owners = np.array(
        [known[c][t] for c, t in zip(assembled.track_cameras, assembled.track_ids, strict=True)]
    )
    chosen = np.flatnonzero((owners >= 0) & (rng.random(len(owners)) < ASSOCIATED))
    rows, cameras, landmarks = [], [], []
    for k, name in enumerate(names):
        tracks, truth = world.tracks[name], world.truth[name]
        in_time = np.isin(tracks.timestamps_ns[tracks.frame_indices], used[k])
        usable = np.flatnonzero(in_time & (truth.landmark_ids >= 0) & ~truth.is_outlier)
        by_landmark = usable[np.argsort(truth.landmark_ids[usable], kind="stable")]
        ids = truth.landmark_ids[by_landmark]
        for landmark in chosen:
            first, last = np.searchsorted(ids, [owners[landmark], owners[landmark] + 1])
            seen = by_landmark[first:last]
            if assembled.track_cameras[landmark] == k:
                seen = seen[tracks.track_ids[seen] != assembled.track_ids[landmark]]
            seen = rng.permutation(seen)[:SIGHTINGS]
            rows.append(seen)
            cameras.append(np.full(len(seen), k))
            landmarks.append(np.full(len(seen), landmark))
    found = np.concatenate(rows)
    index = np.concatenate(cameras)
    per_camera = [world.tracks[name] for name in names]
    std_px = np.array([per_camera[c].std_px[r] for c, r in zip(index, found, strict=True)])
    exact = np.array([world.truth[names[c]].pixels[r] for c, r in zip(index, found, strict=True)])
    added = Observations(
        index,
        np.array(
            [
                per_camera[c].timestamps_ns[per_camera[c].frame_indices[r]]
                for c, r in zip(index, found, strict=True)
            ]
        ),
        np.concatenate(landmarks),
        exact + std_px[:, None] * rng.normal(size=exact.shape),
        std_px,
    )
    return replace(assembled, problem=replace(problem, observations=joined(problem.observations, added)))


def _landmark_of_track(world: SimulatedTracks, name: str) -> Mapping[int, int]:
    """By track number, the row of its landmark in the world; -1 on water."""
    return dict(
        zip(world.tracks[name].track_ids.tolist(), world.truth[name].landmark_ids.tolist(), strict=True)
    )


def rig_errors(world: SimulatedTracks, seed: int) -> Mapping[str, float]:
    """Worst offset and its predicted deviation (m), relative error of the longest baseline, NEES per degree
    of freedom."""
    config = load_config(None, ("intrinsics=fixed",))
    selection = select(world.recording, config)
    first = initialise_rig(selection, true_odometry(world, metric=False), config, RigPrior())
    measured = RigMeasurements(world.tracks, selection.imu, selection.gnss)
    assembled = with_association(assemble_problem(measured, first, OPTIONS), world, seed)
    adjusted = adjust(assembled, OPTIONS)
    covariance = covariance_of(adjusted.solution.problem, clustered=True)
    found = calibrated_cameras(adjusted.solution, covariance, ReferenceFrame("imu", SE3.identity()), {}, {})
    truth = rig_in_frame(world.recording.true_rig, "imu").cameras
    names = list(found.cameras)
    errors = [truth[n].rig_from_cam.local(found.cameras[n].rig_from_cam) for n in names]
    true_at = np.stack([truth[n].rig_from_cam.translation for n in names])
    at = np.stack([found.cameras[n].rig_from_cam.translation for n in names])
    baselines = np.linalg.norm(true_at[:, None] - true_at[None], axis=-1)
    longest = np.unravel_index(np.argmax(baselines), baselines.shape)
    joint = np.concatenate(errors)
    assert found.joint_covariance is not None
    variances = np.diag(found.joint_covariance).reshape(-1, 6)[:, 3:].sum(axis=1)
    return {
        "offset": 100 * max(float(np.linalg.norm(e[3:])) for e in errors),
        "pair": 100
        * max(
            float(np.linalg.norm(_seen(found.cameras, a, b) - _seen(truth, a, b)))
            for a in names
            for b in names
        ),
        "predicted": 100 * float(np.sqrt(variances.max())),
        "baseline": 100 * float(np.linalg.norm(at[longest[0]] - at[longest[1]]) / baselines[longest] - 1.0),
        "nees": float(joint @ np.linalg.solve(found.joint_covariance, joint)) / len(joint),
    }


def _seen(cameras: Mapping[str, Any], a: str, b: str) -> Any:
    """(3,) where camera b sits as seen from camera a."""
    return (cameras[a].rig_from_cam.inverse() * cameras[b].rig_from_cam).translation


def without_receiver(world: SimulatedTracks) -> SimulatedTracks:
    return replace(world, recording=replace(world.recording, gnss={}))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rigs", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    chosen = parser.parse_args()
    rows: dict[str, list[tuple[float, float]]] = {}
    print("With the receiver, without:\n")
    print(
        "| rig | offset (cm) | between cameras (cm) | predicted (cm) | baseline (%) | NEES/dof | |\n"
        "|---|---|---|---|---|---|---|"
    )
    for seed in range(chosen.first, chosen.first + chosen.rigs):
        started, world = time.process_time(), random_rig(seed)
        try:
            both = [rig_errors(world, seed), rig_errors(without_receiver(world), seed)]
        except RigwakeError as error:
            print(f"| {seed} | refused: {error} | | | | | |", flush=True)
            continue
        for key in both[0]:
            rows.setdefault(key, []).append((both[0][key], both[1][key]))
        figures = " | ".join(f"{both[0][key]:.2f}, {both[1][key]:.2f}" for key in both[0])
        print(f"| {seed} | {figures} | {time.process_time() - started:.0f} s |", flush=True)
    if rows:
        summarise({key: np.array(values) for key, values in rows.items()}, chosen.rigs)


def summarise(rows: Mapping[str, Any], rigs: int) -> None:
    """rows: of every figure (N, 2), with the receiver and without."""
    offset, pair, predicted, baseline, nees = (
        rows[k] for k in ("offset", "pair", "predicted", "baseline", "nees")
    )
    long = np.abs(baseline)
    print(f"\nrigs calibrated: {len(offset)} of {rigs}\n\n| | with the receiver | without |\n|---|---|---|")
    table = {
        "offset, median (cm)": np.median(offset, axis=0),
        "between cameras, median (cm)": np.median(pair, axis=0),
        "offset, largest (cm)": offset.max(axis=0),
        "deviation predicted for it, median (cm)": np.median(predicted, axis=0),
        "rigs whose offset is within 3 cm (%)": 100 * np.mean(offset <= 3.0, axis=0),
        "longest distance, median error (%)": np.median(long, axis=0),
        "rigs whose longest distance is within 0.2 % (%)": 100 * np.mean(long <= 0.2, axis=0),
        "mean NEES/dof": nees.mean(axis=0),
        "largest NEES/dof": nees.max(axis=0),
    }
    for name, (with_it, without) in table.items():
        print(f"| {name} | {with_it:.2f} | {without:.2f} |")
    good = np.mean(offset[:, 0] <= 1.1 * offset[:, 1] + 0.1)
    print(f"\nnot worse with the receiver than without, by more than 1 mm or 10 %: {good:.0%}")


if __name__ == "__main__":
    main()
