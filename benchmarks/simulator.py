"""Speed and truthfulness of the simulator.

    python benchmarks/simulator.py

Peer of the renderer: the bare ray casting of the same rays by Embree, the floor under any shading. Peer of the
corners: the same detector on an ideal analytic picture.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from rigwake.cameras.registry import camera_from_params
from rigwake.simulation.record import SeaCache, Shot, build_world
from rigwake.simulation.scenario import load_scenario
from rigwake.simulation.setup import Simulation, prepare
from rigwake.simulation.tracks_only import simulate_tracks
from simulation_selfcheck import corner_errors, motion_agreement

WORKERS = 2
IMAGES = 24


def both_cores(work: Callable[[int], object]) -> tuple[float, float]:
    """Wall and CPU seconds per call, on two threads."""
    wall, cpu = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(work, range(IMAGES)))
    return (time.perf_counter() - wall) / IMAGES, (time.process_time() - cpu) / IMAGES


def rendering(simulation: Simulation, shots: list[Shot]) -> None:
    shot = shots[0]
    renderer = shot.renderer
    times = simulation.scene_times_s(shot.camera)
    seas = [renderer.water(float(t)) for t in times[:IMAGES]]
    shared = SeaCache(renderer)
    rays = (shot.view.cam_rays @ shot.row_poses(0.0)[0].rotation.T).astype(np.float32)
    mirrored = rays[shot.view.cam_rays[:, 1] > 0] * np.float32([1, 1, -1])

    def cast(index: int) -> None:
        for directions in (rays, mirrored):  # each ray, and one mirrored for each that may meet water
            for part in np.array_split(directions, max(len(directions) >> 15, 1)):
                renderer.embree.run(np.zeros_like(part) + np.float32([0, 0, 1.6]), part, output=True)

    def render(index: int) -> None:
        renderer.render(shot.view, shot.row_poses(float(times[index])), seas[index])

    def take(index: int) -> None:
        time_s = float(times[index // len(shots)])  # as in a recording: cameras of one instant share its sea
        shots[index % len(shots)].take(index, time_s, shared.at(time_s))

    render(0)
    camera = shot.camera
    cast_s, shaded_s, whole_s = both_cores(cast), both_cores(render), both_cores(take)
    what = f"{camera.width_px}x{camera.height_px}, 4 rays per pixel, {len(rays) / 1e6:.2f} M rays"
    print(f"\n| {what} | wall, {WORKERS} threads | CPU | / bare |")
    print("|---|---|---|---|")
    for name, (wall, cpu) in (
        ("bare ray casting of the same rays", cast_s),
        ("shaded", shaded_s),
        ("sea, shading, sensor and JPEG", whole_s),
    ):
        print(f"| {name} | {wall:.3f} s | {cpu:.3f} s | {cpu / cast_s[1]:.2f} |")
    frames = sum(len(s.stamps) for s in shots)
    print(
        f"\n`{simulation.scenario.name}` has {frames} frames: {frames * whole_s[0]:.0f} s on {WORKERS} threads."
    )


def corners() -> None:
    lenses = {
        "kb4": [200.4, 201, 322.6, 236.9, -0.0115, 0.0062, -0.0034, 0.0005],
        "mei": [400, 401, 320, 240, 1.4, -0.05, 0.01, 1e-3, -2e-3, 0.002],
        "ds": [200, 201, 320, 240, -0.2, 0.6],
    }
    print("\n| corners, 4 rays per pixel | to | bias | RMS | ideal RMS | ratio |\n|---|---|---|---|---|---|")
    for name, params in lenses.items():
        errors = corner_errors(camera_from_params(name, params, 640, 480, np.deg2rad(97.5)), 4)
        bias = float(np.abs(errors.rendered_px.mean(axis=0)).max())
        rms, ideal = (float(np.sqrt(np.mean(e**2))) for e in (errors.rendered_px, errors.ideal_px))
        print(
            f"| {name} | {errors.angles_deg.max():.0f} deg | {bias:.4f} px | {rms:.4f} px | {ideal:.4f} px "
            f"| {rms / ideal:.2f} |"
        )


def motion(simulation: Simulation, shots: list[Shot]) -> None:
    print(
        "\n| image motion, a frame apart | flow on land, median | KLT agrees on land | on water |\n|---|---|---|---|"
    )
    for number, shot in enumerate(shots):
        exact = Shot.prepare(simulation, shot.renderer, number, samples=1)
        for first in (20, 90):
            agreement = motion_agreement(shot, exact, first, first + 1)
            print(
                f"| {shot.camera.name}, frame {first} | {np.median(agreement.flow_error_px):.3f} px "
                f"| {100 * agreement.land_fraction:.1f} % of {agreement.land_tracks} "
                f"| {100 * agreement.water_fraction:.1f} % of {agreement.water_tracks} |"
            )


def tracks_only() -> None:
    scenario = load_scenario("thesis")
    simulate_tracks(scenario)
    costs = []
    for seed in range(5):
        before = time.process_time()
        simulate_tracks(scenario.model_copy(update={"seed": seed}))
        costs.append(time.process_time() - before)
    median = float(np.median(costs))
    print(
        f"\nTracks only, {scenario.duration_s:g} s, 4 cameras: {median:.2f} CPU-s, limit 2 s (ratio {median / 2:.2f})."
    )


def world(preset: str) -> tuple[Simulation, list[Shot]]:
    simulation = prepare(load_scenario(preset))
    before = time.process_time()
    scenery, renderer = build_world(simulation)
    print(f"\n`{preset}`: {len(scenery.mesh)} triangles, built in {time.process_time() - before:.1f} CPU-s.")
    return simulation, [Shot.prepare(simulation, renderer, i) for i in range(4)]


def main() -> None:
    tracks_only()
    rendering(*world("thesis_lively"))
    demo = world("demo")
    rendering(*demo)
    motion(*demo)
    corners()
    print(f"\nPeak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB, limit 2 GB.")


if __name__ == "__main__":
    main()
