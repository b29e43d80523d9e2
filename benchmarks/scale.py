"""Long recordings: which sections are chosen, what that costs in precision, and how time and memory grow.

    OPENBLAS_NUM_THREADS=1 python benchmarks/scale.py [--only sections|growth] [--minutes 30] [--waves 0.0]

`sections`: a recording of half an hour, six cameras, most of it moored, without pictures. What every 8 s tell is
taken from the tracks that the simulator makes of them; sigmas are those of the worst camera along its worst axis.
`growth`: the rig bundle adjustment from 1 to 16 minutes and 2 to 12 cameras, each in a process of its own.
CPU-seconds are of the process, so that other work on the machine counts little.
"""

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustmentOptions, InitialRig, RigMeasurements
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.rig_problem import BundleCamera
from rigwake.config import load_config
from rigwake.excerpt import gnss_between, imu_between
from rigwake.odometry.imu_alignment import with_noise
from rigwake.pipeline.section_stage import with_chosen_sections
from rigwake.pipeline.stream_selection import select
from rigwake.readers.truth_files import rig_in_frame
from rigwake.recording import Recording
from rigwake.sections.section_choice import WhitenedInformation
from rigwake.sections.section_words import choice_words, sigma_words
from rigwake.sections.stretch_information import StretchInformation, information_about
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.setup import Simulation, build_recording, prepare
from rigwake.simulation.track_stream import tracks_within
from rigwake.simulation.tracks_only import NoFrames
from rigwake.trajectory import Trajectory

GROWTH = ((1, 6), (2, 6), (4, 6), (8, 6), (16, 6), (4, 2), (4, 4), (4, 8), (4, 12), (16, 12))
OFFLINE = ("adjustment.cross_camera=false", "intrinsics=fixed")
EIGHT_S = 40.0
EIGHT = {"type": "figure_eight", "rate_deg_s": 18.0, "speed_mps": 1.7}


def cpu_s() -> float:
    return time.process_time()


def peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def simulation(seconds: float, cameras: int, manoeuvres: list[dict[str, Any]], waves_m: float) -> Simulation:
    """The `demo` boat with so many of its fisheyes, turned a little so that all differ."""
    document = load_scenario("demo").model_dump()
    fisheyes = document["cameras"]
    document["cameras"] = [
        fisheyes[n % 4] | {"name": f"cam{n}", "yaw_deg": 360 * n / cameras - 180 + 1.0, "rate_hz": 5}
        for n in range(cameras)
    ]
    document["tracking"] |= {"features": 60, "landmarks": 1000, "outliers": 0.005, "water": 0.0}
    document |= {"duration_s": seconds, "scene": {"layout": "harbour", "size_m": [110, 80]}}
    document["sea"] |= {"hs_m": waves_m}
    document["vessel"]["manoeuvres"] = manoeuvres
    return prepare(build_scenario(document, "scale"))


def recording_of(simulated: Simulation) -> Recording:
    return build_recording(simulated, {c.name: NoFrames() for c in simulated.scenario.cameras}, Path("scale"))


def first_values(recording: Recording, turn_deg: float, shift_m: float) -> InitialRig:
    """The truth in the IMU's frame, with mountings off at random."""
    rng = np.random.default_rng(0)
    assert recording.true_rig is not None
    truth, body = rig_in_frame(recording.true_rig, "imu"), recording.true_trajectories["rig"]
    cameras = {}
    for name, stream in recording.cameras.items():
        off = np.concatenate([rng.normal(0, np.deg2rad(turn_deg), 3), rng.normal(0, shift_m, 3)])
        assert stream.model is not None
        mounted = truth.cameras[name].rig_from_cam.retract(off)
        cameras[name] = BundleCamera(
            name, stream.model, mounted, free=frozenset({"rig_from_cam", "time_offset"})
        )
    path = Trajectory("imu", body.timestamps_ns, body.world_from_body * recording.true_rig.rig_from_imu)
    return InitialRig(path, cameras, antenna_rig=truth.antenna_rig)


def told_by_tracks(
    simulated: Simulation, recording: Recording, forecast: StretchInformation
) -> StretchInformation:
    """What each stretch really tells: the information of the adjustment of its tracks, at the truth."""
    start = first_values(recording, 0.0, 0.0)
    imu, gnss = with_noise(next(iter(recording.imus.values()))), next(iter(recording.gnss.values()))
    size = forecast.matrices.shape[1]
    matrices = np.zeros_like(forecast.matrices)
    for row, span in enumerate((forecast.spans_ns - simulated.start_ns) * 1e-9):
        tracks = tracks_within(simulated, [tuple(span.tolist())])
        begin, end = forecast.spans_ns[row].tolist()
        measured = RigMeasurements(
            tracks, imu_between(imu, begin - 10**9, end + 10**9), gnss_between(gnss, (begin, end))
        )
        problem = assemble_problem(measured, start, AdjustmentOptions(cross_camera=False)).problem
        matrices[row] = information_about(problem, forecast.parameters, size)
    return StretchInformation(forecast.spans_ns, forecast.parameters, matrices, forecast.prior)


def worst(whitened: WhitenedInformation, rows: list[int]) -> tuple[float, float]:
    """Degrees and millimetres of the worst camera."""
    sigmas = whitened.sigmas(rows).values()
    return (
        float(np.degrees(max(s.rotation for s in sigmas))),
        1e3 * max(s.translation for s in sigmas),
    )


def compare_sections(minutes: float, waves_m: float) -> None:
    pause = (60 * minutes - 3 * EIGHT_S) / 4
    moored = {"type": "standstill", "duration_s": pause}
    simulated = simulation(60 * minutes, 6, [moored, EIGHT, moored, EIGHT, moored, EIGHT, moored], waves_m)
    recording = recording_of(simulated)
    config = load_config(None, OFFLINE)
    begun = cpu_s()
    _, plan = with_chosen_sections(select(recording, config), config, lambda *_: None)
    assert plan is not None
    print(f"\n{minutes:g} min, 6 cameras, waves of {waves_m:g} m: {choice_words(plan)}")
    print(f"chosen in {cpu_s() - begun:.1f} CPU-s; predicted {sigma_words(plan.choice.predicted['cam0'])}\n")
    begun = cpu_s()
    told = told_by_tracks(simulated, recording, plan.information)
    print(f"(information of all tracks: {cpu_s() - begun:.0f} CPU-s)")
    whitened = WhitenedInformation(told)
    chosen, total = plan.choice.stretches.tolist(), len(told)
    count = len(chosen)
    rng = np.random.default_rng(1)
    random = [rng.choice(total, count, replace=False).tolist() for _ in range(20)]
    sets = {
        "all": [list(range(total))],
        "chosen": [chosen],
        "from the start": [list(range(count))],
        "from the end": [list(range(total - count, total))],
        "at random (median of 20)": random,
    }
    found = {name: np.median([worst(whitened, rows) for rows in some], axis=0) for name, some in sets.items()}
    print("| used | deg | mm | x chosen, deg | x chosen, mm |\n|---|---|---|---|---|")
    for name, (deg, mm) in found.items():
        by = found["chosen"]
        print(f"| {name} | {deg:.4f} | {mm:.2f} | {deg / by[0]:.2f} | {mm / by[1]:.2f} |")
    begun = cpu_s()
    spans = [
        ((a - simulated.start_ns) * 1e-9, (b - simulated.start_ns) * 1e-9) for a, b in plan.choice.sections_ns
    ]
    adjust_and_print(simulated, recording, spans, begun)


def adjust_and_print(
    simulated: Simulation, recording: Recording, spans_s: list[tuple[float, float]], begun: float
) -> None:
    """Adjust the rig from the tracks of these spans, and print how far it is off."""
    tracks = tracks_within(simulated, spans_s)
    imu, gnss = with_noise(next(iter(recording.imus.values()))), next(iter(recording.gnss.values()))
    nanoseconds = [
        (simulated.start_ns + round(a * 1e9), simulated.start_ns + round(b * 1e9)) for a, b in spans_s
    ]
    measured = RigMeasurements(tracks, imu, gnss_between(gnss, *nanoseconds))
    options = AdjustmentOptions(cross_camera=False)
    simulated_s, begun = cpu_s() - begun, cpu_s()
    assembled = assemble_problem(measured, first_values(recording, 0.5, 0.03), options)
    adjusted = adjust(assembled, options)
    problem = adjusted.solution.problem
    covariance = covariance_of(problem, clustered=True)
    truth = rig_in_frame(recording.true_rig, "imu")  # type: ignore[arg-type]
    errors, sigmas, nees = [], [], []
    for camera in problem.cameras:
        off = truth.cameras[camera.name].rig_from_cam.local(camera.rig_from_cam)
        spread, told = covariance.of(covariance.rows_of(camera.name, "rig_from_cam"))
        errors.append(np.where(told, np.abs(off), 0.0))
        sigmas.append(np.where(told, np.sqrt(np.diag(spread)), 0.0))
        inverse = np.linalg.pinv(spread[np.ix_(told, told)], hermitian=True)
        nees.append(float(off[told] @ inverse @ off[told]) / max(int(told.sum()), 1))
    worst_of = {}
    for what, values in (("errors", np.array(errors)), ("sigmas", np.array(sigmas))):
        worst_of[what] = f"{np.degrees(values[:, :3].max()):.4f} deg, {1e3 * values[:, 3:].max():.1f} mm"
    print(
        f"adjusted: {len(problem.states)} states, {len(problem.observations)} observations, "
        f"{cpu_s() - begun:.1f} CPU-s (tracks {simulated_s:.0f}), {peak_gb():.2f} GB; worst axes: errors "
        f"{worst_of['errors']}; sigmas {worst_of['sigmas']}; NEES {np.mean(nees):.2f} per axis",
        flush=True,
    )


def grow(minutes: float, cameras: int) -> None:
    """One row of the growth table, in this process."""
    eights = [EIGHT] * int(60 * minutes / EIGHT_S + 1)
    simulated = simulation(60 * minutes, cameras, eights, 0.2)
    recording = recording_of(simulated)
    adjust_and_print(simulated, recording, [(0.0, 60.0 * minutes)], cpu_s())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", choices=("sections", "growth"))
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--waves", type=float, default=0.0)
    parser.add_argument("--grow", nargs=2, type=float, metavar=("MINUTES", "CAMERAS"))
    given = parser.parse_args()
    if given.grow:
        grow(given.grow[0], int(given.grow[1]))
        return
    if given.only != "growth":
        compare_sections(given.minutes, given.waves)
    if given.only != "sections":
        for minutes, cameras in GROWTH:
            print(f"\n{minutes} min, {cameras} cameras:", flush=True)
            subprocess.run([sys.executable, __file__, "--grow", str(minutes), str(cameras)], check=False)


if __name__ == "__main__":
    main()
