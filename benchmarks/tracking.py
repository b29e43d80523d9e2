"""The tracker alone against projected truth, the masks against labels, and the speed of the front ends.

    python benchmarks/tracking.py [FOLDER OF REAL RECORDINGS] [--frames N]

`harbour_a` (independent simulator: JPEG, vignetting, noise, waves): true poses; the point of a track is what its
first pixel saw, at the one distance that fits all of its observations best, so that nothing but a wrong distance
can hide a tracker's error. `cylinder`: rendered here, the point is known exactly, with and without vignetting and
an exposure jump. The peer is OpenCV's pyramidal Lucas-Kanade from frame to frame, with the same detector.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from rigwake._types import Array, Image, Mask
from rigwake.geometry.se3 import SE3
from rigwake.readers.open import open_recording
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import CameraStream, Recording
from rigwake.tracking.features import detect_corners
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.masks import inside, lens_mask
from rigwake.tracking.self_mask import find_self_mask
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracking.water import HorizonMask
from rigwake.tracks import Tracks
from tracking_scene import CylinderScene, fisheye, turning_scene, wall_points

CAMERAS = ("front", "left", "back", "right")
ZONES_DEG = ((0, 30), (30, 60), (60, 75), (75, 93))
AGES_S = ((0.0, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 5.05), (5.05, 99.0))
TABLES = ("speed", "masks", "harbour", "cylinder")
GROSS_PX = 2.0
UP = np.array([0.0, 0.0, 1.0])

Follower = Callable[[CameraStream, Array], Tracks]


@dataclass(frozen=True)
class Errors:
    """Observed minus projected truth of all but the first observations of each track."""

    error_px: Array
    std_px: Array
    angle_deg: Array
    age_s: Array

    def join(self, other: Errors) -> Errors:
        names = ("error_px", "std_px", "angle_deg", "age_s")
        return Errors(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


def lucas_kanade(
    before: Image, after: Image, pixels: Array, guess: Array, options: TrackingOptions
) -> tuple[Array, Mask]:
    """OpenCV's: where points (N, 2) have gone, and which were found."""
    landed, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, pixels.astype(np.float32), guess.astype(np.float32),
        winSize=(options.window_px, options.window_px), maxLevel=options.levels - 1,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.03),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return landed.astype(float), found[:, 0] > 0


def frame_to_frame(stream: CameraStream, up_cam: Array) -> Tracks:
    """The peer: each observation is where Lucas-Kanade arrives from the frame before."""
    options, horizon = TrackingOptions(), HorizonMask(stream.model)
    lens = lens_mask(stream).usable
    ids, pixels, before, next_id = np.empty(0, np.int64), np.empty((0, 2)), None, 0
    seen = []
    for frame in stream.frames(np.arange(len(up_cam))):
        usable = lens & ~horizon.below(up_cam[frame.index])
        if before is not None:
            landed, found = lucas_kanade(before, frame.image, pixels, pixels, options)
            returned, back = lucas_kanade(frame.image, before, landed, pixels, replace(options, levels=2))
            kept = (
                found & back & (np.linalg.norm(returned - pixels, axis=1) <= options.max_forward_backward_px)
            )
            pixels = landed
            kept &= inside(usable, pixels)
            ids, pixels = ids[kept], pixels[kept]
        new = detect_corners(
            frame.image, usable, pixels, wanted=options.max_features - len(ids), cell_px=options.cell_px,
            min_distance_px=options.min_distance_px, min_strength=400.0,
        )  # fmt: skip
        ids, pixels = np.r_[ids, next_id + np.arange(len(new))], np.r_[pixels, new]
        next_id, before = next_id + len(new), frame.image
        seen.append((np.full(len(ids), frame.index), ids, pixels))
    rows, ids, pixels = (np.concatenate(column) for column in zip(*seen, strict=True))
    bearings, valid = stream.model.unproject(pixels)
    kept = valid & (np.bincount(ids)[ids] > 1)
    stamps = stream.timestamps_ns[: len(up_cam)]
    std = np.full(kept.sum(), np.nan)
    return Tracks(stream.name, stamps, rows[kept], ids[kept], pixels[kept], bearings[kept], std)


def rigwake_tracks(**settings: object) -> Follower:
    options = TrackingOptions(**settings)  # type: ignore[arg-type]

    def run(stream: CameraStream, up_cam: Array) -> Tracks:
        return track_camera(stream, options, indices=np.arange(len(up_cam)), up_cam=up_cam)

    return run


METHODS: dict[str, Follower] = {
    "Lucas-Kanade, frame to frame (peer)": frame_to_frame,
    "klt": rigwake_tracks(),
    "klt, patch radius 6 px": rigwake_tracks(patch_radius_px=6),
    "klt, patch radius 10 px": rigwake_tracks(patch_radius_px=10),
    "klt, correlation over 0.97": rigwake_tracks(min_correlation=0.97),
    "sift": rigwake_tracks(front_end="sift"),
    "fast-brief": rigwake_tracks(front_end="fast-brief"),
    "orb": rigwake_tracks(front_end="orb"),
}


def anchored_errors(tracks: Tracks, stream: CameraStream, world_from_cam: SE3) -> Errors:
    """Errors of the tracks that stay on land: above the horizon, at a finite distance."""
    _, first, track = np.unique(tracks.track_ids, return_index=True, return_inverse=True)
    rotation = world_from_cam.rotation[tracks.frame_indices]
    position = world_from_cam.translation[tracks.frame_indices]
    rays = np.einsum("nij,nj->ni", rotation, tracks.bearings_cam)

    def project(inverse_distance: Array) -> Array:
        moved = position - position[first][track]
        points = rays[first][track] - inverse_distance[track, None] * moved
        pixels, _ = stream.model.project(np.einsum("nji,nj->ni", rotation, points))
        return np.nan_to_num(pixels, nan=1e4)

    def cost(inverse_distance: Array) -> Array:
        error2 = ((tracks.pixels - project(inverse_distance)) ** 2).sum(axis=1)
        return np.bincount(track, np.minimum(error2, 25.0))

    best = _line_search(cost, len(first))
    error = tracks.pixels - project(best)
    elevation = np.rad2deg(np.arcsin(np.clip(rays[:, 2], -1, 1)))
    lowest, highest = np.full(len(first), 90.0), np.full(len(first), -90.0)
    np.minimum.at(lowest, track, elevation)
    np.maximum.at(highest, track, elevation)
    land = (lowest > 0.3) & (highest < 25) & (best > 1 / 300) & (np.bincount(track) >= 3)
    chosen = land[track]
    chosen[first] = False
    return _errors(tracks, error, first, track, chosen)


def _line_search(cost: Callable[[Array], Array], n: int) -> Array:
    """Inverse distances (n,) of least cost between infinity and 0.5 m: a grid, then golden sections."""
    grid = np.r_[0.0, np.geomspace(1 / 400, 2.0, 40)]
    best = np.argmin([cost(np.full(n, value)) for value in grid], axis=0)
    low, high = grid[np.maximum(best - 1, 0)], grid[np.minimum(best + 1, len(grid) - 1)]
    ratio = (np.sqrt(5) - 1) / 2
    for _ in range(30):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        left = cost(a) < cost(b)
        low, high = np.where(left, low, a), np.where(left, b, high)
    return np.asarray((low + high) / 2)


def _errors(tracks: Tracks, error: Array, first: Array, track: Array, chosen: Array) -> Errors:
    stamps = tracks.timestamps_ns[tracks.frame_indices]
    age = (stamps - stamps[first][track]) * 1e-9
    angle = np.rad2deg(np.arccos(np.clip(tracks.bearings_cam[:, 2], -1, 1)))
    return Errors(error[chosen], tracks.std_px[chosen], angle[chosen], age[chosen])


def cylinder_errors(tracks: Tracks, scene: CylinderScene) -> Errors:
    _, first, track = np.unique(tracks.track_ids, return_index=True, return_inverse=True)
    points = np.empty((len(first), 3))
    for k, row in enumerate(first):
        pose = scene.world_from_cam[int(tracks.frame_indices[row])]
        points[k] = wall_points(pose, tracks.bearings_cam[row : row + 1])[0]
    poses = scene.world_from_cam[tracks.frame_indices]
    local = np.einsum("nji,nj->ni", poses.rotation, points[track] - poses.translation)
    pixels, _ = scene.model.project(local)
    later = np.ones(len(tracks), dtype=bool)
    later[first] = False
    return _errors(tracks, np.nan_to_num(tracks.pixels - pixels, nan=1e4), first, track, later)


def summary(errors: Errors, chosen: Array) -> str:
    """Bias, RMS and robust deviation of the errors below 2 px, and the fraction of those above."""
    error = errors.error_px[chosen]
    if len(error) < 30:
        return "-"
    gross = np.linalg.norm(error, axis=1) > GROSS_PX
    good = error[~gross]
    bias = np.linalg.norm(good.mean(axis=0))
    robust = 1.4826 * np.median(np.abs(good))
    return f"{bias:.3f} / {np.sqrt((good**2).mean()):.3f} / {robust:.3f} ({100 * gross.mean():.1f})"


def print_errors(title: str, results: dict[str, tuple[Errors, float]]) -> None:
    print(
        f"\n### {title}\n\nbias / RMS / 1.4826 MAD in px (share of gross errors over {GROSS_PX:.0f} px in %)\n"
    )
    zones = [f"{low}-{high} deg" for low, high in ZONES_DEG]
    ages = [f"{low:g}-{high:g} s" for low, high in AGES_S[:-1]] + ["longer"]
    columns = ["tracker", "points per frame", *zones, *ages, "RMS to 5 s / peer's", "NEES (median)"]
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns))
    peer = None
    for name, (errors, per_frame) in results.items():
        young = errors.age_s <= 5.05
        cells = [
            summary(errors, young & (errors.angle_deg >= a) & (errors.angle_deg < b)) for a, b in ZONES_DEG
        ]
        cells += [summary(errors, (errors.age_s > a) & (errors.age_s <= b)) for a, b in AGES_S]
        squared = (errors.error_px**2).sum(axis=1)
        rms = np.sqrt(squared[young & (squared < GROSS_PX**2)].mean())
        peer = peer or rms
        nees = np.median(squared / errors.std_px**2 / 2) / np.log(2)
        print(
            f"| {name} | {per_frame:.0f} | " + " | ".join(cells) + f" | {rms / peer:.2f} | {nees:.2f} |",
            flush=True,
        )


def harbour(recording: Recording, folder: Path, cameras: tuple[str, ...], frames: int) -> None:
    results = {}
    for name, method in METHODS.items():
        parts, count = [], 0
        for camera in cameras:
            stream = recording.camera(camera)
            poses = read_trajectory(folder / f"truth_cam_{camera}.tum").trajectory.world_from_body[:frames]
            up_cam = np.einsum("nji,j->ni", poses.rotation, UP)
            parts.append(anchored_errors(method(stream, up_cam), stream, poses))
            count += len(parts[-1].age_s)
        errors = parts[0]
        for part in parts[1:]:
            errors = errors.join(part)
        results[name] = (errors, count / frames / len(cameras))
    print_errors(f"harbour_a, {', '.join(cameras)}, {frames} frames each, land above the horizon", results)


def cylinder(frames: int = 50) -> None:
    light = np.where(np.arange(frames) < frames // 2, 1.0, 0.75)
    cases = {
        "even light": {"vignetting": 0.0},
        "vignetting 40 %, exposure -25 % half-way": {"vignetting": 0.4, "gains": light},
    }
    for title, settings in cases.items():
        scene = replace(turning_scene(frames, **settings), model=fisheye(640, 480))
        stream, up_cam = scene.stream(), np.full((frames, 3), np.nan)  # no horizon: the whole image is used
        results = {}
        for name, method in METHODS.items():
            tracks = method(stream, up_cam)
            errors = cylinder_errors(tracks, scene)
            results[name] = (errors, len(errors.age_s) / frames)
        print_errors(f"cylinder, {title}", results)


def masks(recording: Recording, folder: Path) -> None:
    print("\n### Masks on harbour_a, share of the labelled pixels and keypoints in the first frame\n")
    print(
        "| camera | own hull found | land lost to self mask | water masked | land above water lost to horizon "
        "| keypoints on water or hull, no masks | with masks | CPU s |\n|---|---|---|---|---|---|---|---|"
    )
    for camera in CAMERAS:
        stream = recording.camera(camera)
        poses = read_trajectory(folder / f"truth_cam_{camera}.tum").trajectory.world_from_body[:1]
        labels = cv2.imread(str(folder / f"truth_labels_{camera}.png"), cv2.IMREAD_GRAYSCALE)
        started = time.process_time()
        lens = lens_mask(stream)
        hull = find_self_mask(stream, lens.usable)
        elapsed = time.process_time() - started
        up_cam = np.einsum("nji,j->ni", poses.rotation, UP)
        water = HorizonMask(stream.model).below(up_cam[0])
        seen = lens.usable
        moving = []
        for mask, up in ((lens, np.full((2, 3), np.nan)), (lens.with_region("hull", hull), up_cam[[0, 0]])):
            tracks = track_camera(stream, mask=mask, indices=np.arange(2), up_cam=up)
            x, y = np.rint(tracks.pixels[tracks.frame_indices == 0]).astype(int).T
            moving.append(np.isin(labels[y, x], (180, 240)).mean())
        print(
            f"| {camera} | {hull[(labels == 240) & seen].mean():.4f} | {hull[(labels == 60) & seen].mean():.4f} "
            f"| {(water | hull)[(labels == 180) & seen].mean():.4f} | {water[(labels == 60) & seen].mean():.3f} "
            f"| {moving[0]:.3f} | {moving[1]:.4f} | {elapsed:.2f} |"
        )


def speed(recording: Recording, frames: int) -> None:
    print(
        f"\n### Speed, harbour_a front, {frames} frames of 640x480, 400 points, one process, JPEG decoding included\n"
    )
    print("| front end | frames per second | CPU ms per frame | speed / SIFT's |\n|---|---|---|---|")
    stream, rows, sift = recording.camera("front"), [], 1.0
    for front_end in ("klt", "fast-brief", "orb", "sift"):
        options = TrackingOptions(front_end=front_end)
        track_camera(stream, options, indices=np.arange(3))  # compiles
        wall, cpu = time.perf_counter(), time.process_time()
        track_camera(stream, options, indices=np.arange(frames))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        rows.append((front_end, frames / wall, 1e3 * cpu / frames))
        sift = 1e3 * cpu / frames
    for name, fps, cpu_ms in rows:
        print(f"| {name} | {fps:.0f} | {cpu_ms:.1f} | {sift / cpu_ms:.1f} |")


def main() -> None:
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", default=Path(os.environ.get("RIGWAKE_DATA", beside)))
    parser.add_argument("--frames", type=int, default=200, help="frames per camera of harbour_a")
    parser.add_argument("--cameras", nargs="+", default=["front", "left"], choices=CAMERAS)
    parser.add_argument("--only", nargs="+", default=TABLES, choices=TABLES)
    asked = parser.parse_args()
    folder = asked.folder / "harbour_a"
    if folder.is_dir():
        recording = open_recording(folder / "harbour_a.bag")
        if "speed" in asked.only:
            speed(recording, min(asked.frames, 100))
        if "masks" in asked.only:
            masks(recording, folder)
        if "harbour" in asked.only:
            harbour(recording, folder, tuple(asked.cameras), asked.frames)
    else:
        print(f"no {folder}: its tables are left out")
    if "cylinder" in asked.only:
        cylinder()


if __name__ == "__main__":
    main()
