"""Rigs calibrated with lenses that are described wrongly: by chance, or by so much.

    python benchmarks/lens_errors.py chance [--draws 16] [--first 0]
    python benchmarks/lens_errors.py faults [--cameras front]

Simulated tracks of the demo (two fisheyes, IMU and GNSS), seen through wrong lenses from each camera's odometry on,
without landmarks associated across cameras. `chance`: every draw has another sail and lens errors drawn from the prior
of a file without covariance. Printed per camera: errors of the rig, NEES of rig and intrinsics over their degrees of
freedom (1 if the uncertainty is honest), pixels by which the lens was and is wrong. The ratio is to the same sails with
right lenses, trusted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from calibration_worlds import own_odometry, sail
from rigwake._types import Array
from rigwake.ba.rig.intrinsics_refinement import intrinsics_prior, moved_px
from rigwake.cameras.protocol import CameraModel
from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.evaluation.rig_errors import evaluate_calibration
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.stream_selection import select
from rigwake.pipeline.vetted_rig import estimate_vetted_rig
from rigwake.readers.truth_files import rig_in_frame
from rigwake.simulation.tracks_only import SimulatedTracks

WrongLens = Callable[[str, CameraModel, Array], CameraModel]
"""A lens in place of the true one, by the camera's name, its lens and the pixels (N, 2) of its tracks."""


@dataclass(frozen=True)
class CameraOutcome:
    """Errors of one camera; NEES over degrees of freedom; RMS pixels by which its lens was and is wrong."""

    rotation_deg: float
    offset_mm: float
    rig_nees: float
    lens_nees: float
    given_px: float
    found_px: float


def by_chance(seed: int) -> WrongLens:
    rng = np.random.default_rng(1000 + seed)

    def drawn(name: str, lens: CameraModel, pixels: Array) -> CameraModel:
        root = np.linalg.cholesky(np.linalg.inv(intrinsics_prior(lens, pixels).information))
        return lens.with_params(lens.params + root @ rng.normal(size=len(lens.params)))

    return drawn


def by(cameras: list[str], focal: float = 1.0, centre_px: float = 0.0, flat: bool = False) -> WrongLens:
    def changed(name: str, lens: CameraModel, pixels: Array) -> CameraModel:
        params = lens.params.copy()
        if name in cameras or not cameras:
            params[:2] *= focal
            params[2:4] += centre_px / np.sqrt(2)
            params[4:] *= 0.0 if flat else 1.0
        return lens.with_params(params)

    return changed


def seen_through(world: SimulatedTracks, change: WrongLens) -> SimulatedTracks:
    streams, tracks = {}, {}
    for name, stream in world.recording.cameras.items():
        assert stream.model is not None
        lens = change(name, stream.model, world.tracks[name].pixels)
        bearings, seen = lens.unproject(world.tracks[name].pixels)
        streams[name] = replace(stream, model=lens)
        tracks[name] = replace(world.tracks[name], bearings_cam=bearings).take(np.flatnonzero(seen))
    return replace(world, recording=replace(world.recording, cameras=streams), tracks=tracks)


def rms(lengths: Array) -> float:
    return float(np.sqrt(np.nanmean(lengths**2)))


def outcomes(true: SimulatedTracks, world: SimulatedTracks, choice: str) -> dict[str, CameraOutcome] | str:
    """By camera; or the words of the refusal."""
    config = load_config(None, ("adjustment.cross_camera=false", f"intrinsics={choice}"))
    try:
        found = estimate_vetted_rig(
            world.recording,
            select(world.recording, config),
            world.tracks,
            own_odometry(world),
            config,
            RigPrior(),
            masks=Path("nowhere"),
        )
    except RigwakeError as error:
        return f"refused: {error}"
    calibration = found.rig.calibration
    errors = evaluate_calibration(calibration, rig_in_frame(true.recording.true_rig, calibration.reference))
    by_camera = {}
    for name, error in errors.cameras.items():
        before, lens = true.recording.cameras[name].model, calibration.cameras[name].model
        given, pixels = world.recording.cameras[name].model, true.tracks[name].pixels
        assert before is not None
        assert lens is not None
        assert given is not None
        by_camera[name] = CameraOutcome(
            error.rotation_error_deg,
            1e3 * error.translation_error_norm_m,
            np.nan if error.nees is None else error.nees / error.nees_dof,
            lens_nees(before, lens, calibration.cameras[name].statistics.get("intrinsics")),
            rms(np.linalg.norm(moved_px(before, given, pixels), axis=1)),
            rms(np.linalg.norm(moved_px(before, lens, pixels), axis=1)),
        )
    return by_camera


def lens_nees(true: CameraModel, found: CameraModel, statistics: dict | None) -> float:
    if not statistics:
        return np.nan
    free = [k for k, name in enumerate(true.param_names) if name not in statistics["held"]]
    off, spread = found.params - true.params, np.array(statistics["covariance"])
    return float(off[free] @ np.linalg.solve(spread[np.ix_(free, free)], off[free])) / len(free)


def shown(title: str, found: dict[str, CameraOutcome] | str) -> None:
    if isinstance(found, str):
        print(f"{title:32}  {found[:160]}", flush=True)
        return
    for name, f in found.items():
        print(
            f"{title:32}  {name:6} {f.rotation_deg:7.3f} deg {f.offset_mm:8.1f} mm   NEES/dof {f.rig_nees:5.2f} "
            f"lens {f.lens_nees:5.2f}   lens {f.given_px:5.2f} -> {f.found_px:5.2f} px",
            flush=True,
        )


def chance(draws: int, first: int) -> None:
    every: list[CameraOutcome] = []
    trusted: list[CameraOutcome] = []
    for seed in range(first, first + draws):
        began, true = process_time(), sail(seed=seed)
        world = seen_through(true, by_chance(seed))
        found = outcomes(true, world, "refine")
        shown(f"draw {seed}", found)
        every += [] if isinstance(found, str) else list(found.values())
        exact = outcomes(true, true, "fixed")
        trusted += [] if isinstance(exact, str) else list(exact.values())
        print(f"{'':32}  {process_time() - began:.0f} CPU s", flush=True)
    if every and trusted:
        rig, lens = np.mean([f.rig_nees for f in every]), np.nanmean([f.lens_nees for f in every])
        ratio = np.median([f.offset_mm for f in every]) / np.median([f.offset_mm for f in trusted])
        print(f"mean NEES/dof: rig {rig:.2f}, intrinsics {lens:.2f}; offsets {ratio:.2f} times exact lenses'")


def faults(cameras: list[str]) -> None:
    true = sail()
    for title, change in (
        ("right", by(cameras)),
        ("focal length +3 %", by(cameras, 1.03)),
        ("focal length -3 %", by(cameras, 0.97)),
        ("centre 8 px off", by(cameras, centre_px=8.0)),
        ("no distortion", by(cameras, flat=True)),
        ("all of these", by(cameras, 1.03, 8.0, True)),
    ):
        world = seen_through(true, change)
        for choice in ("fixed", "refine"):
            shown(f"{title}, {choice}", outcomes(true, world, choice))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="?", choices=("chance", "faults"), default="faults")
    parser.add_argument("--draws", type=int, default=16)
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument(
        "--cameras", default="", help="those whose lens is wrong, comma-separated (default: all)"
    )
    wanted = parser.parse_args()
    if wanted.what == "chance":
        chance(wanted.draws, wanted.first)
    else:
        faults([name for name in wanted.cameras.split(",") if name])


if __name__ == "__main__":
    main()
