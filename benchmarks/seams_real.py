"""Seams of real rigs: lines of chequered floors across them, and colours before and after they are matched.

    python benchmarks/seams_real.py [FOLDER OF REAL RECORDINGS] [--pictures FOLDER]

Floors: every camera alone is drawn into a top view of the floor; the median distance between where two cameras draw the
same corner is printed in pixels of that top view and in centimetres. The calibrations are the makers' homographies, not
ours. Colours: `harbour_a`, gains and vignetting fitted to four frame sets and judged on four others, with its pictures
as they are and with cameras whose gains are 0.7-1.3 and whose lenses vignette. The difference is that of the mean
colours of patches of four degrees above the horizon; "per pixel" is the median over single pixels, where parallax and
noise count too. Grey levels. Without a folder: RIGWAKE_DATA, or ../shared/data beside the project.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import cv2
import numpy as np

from floor_plans import FLOOR_PLANS
from rigwake.readers.open import open_recording
from rigwake.readers.trajectories import read_trajectory
from rigwake.views.attitude import LevelAttitude, track_from_trajectory, unlevelled
from rigwake.views.colour import ColourModel, ColourSamples, colour_samples, fit_colour, half_field
from rigwake.views.floor_seams import floor_seams
from rigwake.views.frames import FrameSet, frame_sets, output_times, require_fit
from rigwake.views.projections import TopDown
from rigwake.views.rig_sources import read_rig_source, rig_from_homographies
from rigwake.views.seams import SeamMeter, SeamWindow, drawn_alone, overlapping_pairs
from rigwake.views.stills import picture_per_camera
from rigwake.views.surface import WaterAndShell
from rigwake.views.surround_rig import SurroundRig, surround_rig
from rigwake.views.surround_view import SurroundView

_SHELL_M = 62.0
_FITTED, _JUDGED = (20, 100, 180, 260), (60, 140, 220, 290)
_HEIGHT_M = 1.94
_WINDOW_DEG = (8.0, 28.0, 1.0)  # half width, top and bottom of what single pixels are compared in


def floor_rows(name: str, folder: Path, pictures: Path | None) -> None:
    """A row per seam of one chequered floor."""
    plan, radius_m = FLOOR_PLANS[name]
    rig = surround_rig(rig_from_homographies(folder / "yaml", plan))
    recording = picture_per_camera(folder / "images", rig.names)
    if recording is None:
        print(f"{name}: its pictures are not here")
        return
    frames = next(frame_sets(require_fit(rig, recording), rig, [0]))
    stand = unlevelled(rig, float(rig.viewpoint_rig[2]))
    top = TopDown(900, 900, radius_m)
    for seam in floor_seams(rig, frames, stand, top):
        words = f"{seam.median_px:6.1f} px {100 * seam.median_m:6.1f} cm"
        seen = words if np.isfinite(seam.median_px) else "too few corners"
        print(f"{name:24}{seam.first + '|' + seam.second:14}{seen}  {seam.matches:5d} corners")
    if pictures is not None:
        picture = SurroundView(rig, top).picture(frames, stand, WaterAndShell())
        cv2.imwrite(str(pictures / f"{name}.jpg"), picture)


def exposed(frames: FrameSet, rig: SurroundRig, gains: np.ndarray, vignetting: np.ndarray) -> FrameSet:
    """What cameras of other exposure behind vignetting lenses would have recorded."""
    model = ColourModel(np.zeros((len(rig), 3)), vignetting)
    stack = []
    for index, image in enumerate(frames.stack):
        rows, columns = image.shape[:2]
        u, v = np.meshgrid(np.arange(float(columns)), np.arange(float(rows)))
        bearings, valid = rig.models[index].unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        angle = np.arccos(np.clip(np.where(valid, bearings[:, 2], 0), -1, 1)).reshape(rows, columns)
        shading = model.shading(angle / half_field(rig, index))[..., None]
        stack.append(np.clip(np.round(0.72 * image * gains[index] / shading), 0, 255).astype(np.uint8))
    return FrameSet(frames.timestamp_ns, frames.names, np.stack(stack), {}, frames.offsets_s)


def colour_row(words: str, rig: SurroundRig, sets: list[FrameSet], stands: list[LevelAttitude]) -> None:
    """Differences across seams of the second half of the frame sets, colours fitted to the first half."""
    half = len(sets) // 2
    samples = [colour_samples(f.images(rig), rig, s) for f, s in zip(sets[:half], stands, strict=False)]
    colour = fit_colour(ColourSamples.joined(samples), len(rig))
    surface, meter = WaterAndShell(_SHELL_M), SeamMeter(rig, colour)
    before, after = [], []
    pixels: dict[bool, list[np.ndarray]] = {False: [], True: []}
    width, top, bottom = np.deg2rad(_WINDOW_DEG)
    for frames, stand in zip(sets[half:], stands[half:], strict=True):
        for seam in meter.measure(frames, stand, surface):
            before.append(seam.difference_raw)
            after.append(seam.difference)
        for a, b, azimuth, _ in overlapping_pairs(rig, stand):
            window = SeamWindow(azimuth, float(width), float(top), float(bottom))
            for corrected in (False, True):
                view = SurroundView(rig, window, colour=colour if corrected else None, feather_deg=0.5)
                one, other = (drawn_alone(view, frames, stand, surface, c).astype(float) for c in (a, b))
                both = (one.max(axis=2) > 0) & (other.max(axis=2) > 0)
                pixels[corrected].append(np.abs(one - other)[both].mean(axis=1))
    mean_before, mean_after = float(np.nanmean(before)), float(np.nanmean(after))
    single = [float(np.median(np.concatenate(pixels[k]))) for k in (False, True)]
    print(
        f"{words:34}{mean_before:8.2f}{mean_after:8.2f}{mean_before / mean_after:8.1f}"
        f"{single[0]:12.1f}{single[1]:8.1f}"
    )


def colour_rows(folder: Path) -> None:
    """Colours across the seams of `harbour_a`: as recorded, and as unequal cameras would have."""
    recording = open_recording(folder / "harbour_a.bag")
    rig = surround_rig(read_rig_source(folder / "truth.yaml", recording).rig)
    streams = require_fit(rig, recording)
    track = track_from_trajectory(read_trajectory(folder / "truth_base.tum").trajectory, rig)
    track = track.with_height(_HEIGHT_M, 0.02)
    times = output_times(streams, rig)
    sets = [f for half in (_FITTED, _JUDGED) for f in frame_sets(streams, rig, times[list(half)])]
    lost = [name for frames in sets for name in frames.missing]
    assert not lost, f"frame sets lack {lost}"
    stands = [track.at(frames.timestamp_ns) for frames in sets]
    gains = np.random.default_rng(4).uniform(0.7, 1.3, (len(rig), 3))
    unequal = [exposed(f, rig, gains, np.array([0.1, -0.5, 0.1])) for f in sets]
    print(f"\n{'colours across seams':34}{'before':>8}{'after':>8}{'times':>8}{'per pixel':>12}{'after':>8}")
    colour_row("harbour_a, as recorded", rig, sets, stands)
    colour_row("harbour_a, gains and vignetting", rig, unequal, stands)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    parser.add_argument("folder", type=Path, nargs="?", default=Path(os.environ.get("RIGWAKE_DATA", beside)))
    parser.add_argument("--pictures", type=Path, help="folder to write the top views to")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print("lines of the floor across seams, top views of 900 x 900 px")
    for name in FLOOR_PLANS:
        if (options.folder / name).is_dir():
            floor_rows(name, options.folder / name, options.pictures)
        else:
            print(f"{name}: not here")
    if (options.folder / "harbour_a").is_dir():
        colour_rows(options.folder / "harbour_a")
    else:
        print("harbour_a: not here")


if __name__ == "__main__":
    main()
