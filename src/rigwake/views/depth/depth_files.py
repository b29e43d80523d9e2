"""Ranges of a recording as files: 16-bit PNG, NPZ, point clouds, pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigwake.atomic import atomic_path
from rigwake.readers.topics import TopicMap
from rigwake.views.depth.depth_panorama import (
    MATCHED,
    PLANE,
    DepthPanorama,
    fuse_depth,
    matched_points,
)
from rigwake.views.depth.height_check import tested_by_height
from rigwake.views.depth.persistence import earlier_looks
from rigwake.views.frames import frame_sets
from rigwake.views.prepare import SurroundOptions, prepare_surround
from rigwake.views.scene.network import shipped_network
from rigwake.views.scene.segmentation import OBSTACLE, segment_strip
from rigwake.views.scene.stixel_files import range_colours, write_image
from rigwake.views.strips import LevelStrip, StripGrid, level_strip
from rigwake.views.surface import WaterAndShell

PNG_PER_M = 256.0  # grey values per metre; 0 is unknown, 65535 at least 256 m
_CLOUD_MOST_M = 200.0


@dataclass(frozen=True)
class DepthSummary:
    """What was written. density: fraction of obstacle pixels with a matched range."""

    folder: Path
    frame_sets: int
    density: float
    notes: tuple[str, ...]

    def lines(self) -> list[str]:
        """Sentences for people."""
        words = f"{100 * self.density:.0f} % of the obstacle pixels have a matched range."
        if not np.isfinite(self.density):
            words = "Nothing stands on the water there."
        elif self.density < 0.02:
            words = "No two cameras see the same obstacles: ranges come from the water plane alone."
        return [*self.notes, f"{self.folder}: ranges of {self.frame_sets} frame sets. {words}"]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        density = self.density if np.isfinite(self.density) else None
        return {"frame_sets": self.frame_sets, "density": density, "notes": list(self.notes)}


def depth_to_folder(
    calibration: Path,
    recording: Path,
    folder: Path,
    at: float | None = None,
    count: int = 5,
    height_m: float | None = None,
    nearest_m: float = 3.0,
    topics: TopicMap | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    sweeps: bool = False,
) -> DepthSummary:
    """Write of every frame set `T.png` (16 bit), `T.npz`, `T.ply` and `T_colour.jpg`, T its time stamp.

    Pictures taken a little earlier are matched too where the way since is known. Without a known height above the
    water, water has no range. sweeps: as `matched_points`.
    Raises InputError or UsageError as `prepare_surround`.
    """
    options = SurroundOptions(height_m=height_m, hull="mask", correct_colours=False)
    setup = prepare_surround(calibration, recording, options, topics)
    network, grid = shipped_network(), StripGrid()
    if at is not None:
        sets = [setup.frame_set_at(at)]
    else:
        times = setup.times_ns()
        chosen = np.unique(
            np.linspace(0, len(times) - 1, min(count, len(times)) + 2).round().astype(int)[1:-1]
        )
        sets = list(frame_sets(setup.streams, setup.rig, times[chosen]))
    matched, obstacles = 0, 0
    for done, frames in enumerate(sets):
        images, attitude = frames.images(setup.rig), setup.attitude_at(frames)
        surface = WaterAndShell(setup.shell_m) if setup.height else setup.surface_at(frames, attitude)
        strip = level_strip(images, setup.rig, attitude, surface, grid, setup.masks, frames.timestamp_ns)
        earlier = setup.earlier(frames)
        points = matched_points(images, setup.rig, attitude, setup.masks, nearest_m, earlier, sweeps)
        before = None
        if earlier is not None:
            before = earlier_looks(earlier, setup.rig, attitude, surface, grid, network, setup.masks)
        labels = tested_by_height(segment_strip(strip, network), points, grid, attitude, before)
        depth = fuse_depth(points, labels, grid, attitude, frames.timestamp_ns)
        matched += int((depth.source == MATCHED).sum())
        obstacles += int((labels.classes == OBSTACLE).sum())
        write_depth(depth, strip, folder / str(frames.timestamp_ns))
        progress(done + 1, len(sets))
    notes = (setup.leveller.words[:1].upper() + setup.leveller.words[1:] + ".", *setup.notes)
    return DepthSummary(folder, len(sets), matched / obstacles if obstacles else np.nan, notes)


def write_depth(depth: DepthPanorama, strip: LevelStrip, stem: Path) -> None:
    """`STEM.png`, `.npz`, `.ply`, `_colour.jpg`."""
    value = np.clip(np.nan_to_num(depth.range_m) * PNG_PER_M, 0, 65535).astype(np.uint16)
    stem.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(stem.with_suffix(".png")) as temporary:
        temporary.write_bytes(cv2.imencode(".png", value)[1].tobytes())
    with atomic_path(stem.with_suffix(".npz")) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(
            stream, range_m=depth.range_m.astype(np.float32), sigma_m=depth.sigma_m.astype(np.float32),
            confidence=depth.confidence.astype(np.float32), source=depth.source,
            step_deg=depth.grid.step_deg, top_deg=depth.grid.top_deg,
        )  # fmt: skip
    with atomic_path(stem.with_suffix(".ply")) as temporary:
        temporary.write_bytes(point_cloud(depth, strip))
    painted = range_colours(np.where(depth.source > 0, depth.range_m, np.nan))
    painted[depth.source == PLANE] = (0.6 * painted[depth.source == PLANE]).astype(np.uint8)
    both = np.vstack([strip.image, painted])
    write_image(stem.parent / f"{stem.name}_colour.jpg", cv2.resize(both, None, fx=2, fy=2))


def point_cloud(depth: DepthPanorama, strip: LevelStrip) -> bytes:
    """Binary PLY in the level frame (x ahead, y to port, z up, from the viewpoint): position, colour, confidence."""
    known = np.isfinite(depth.range_m) & (depth.range_m < _CLOUD_MOST_M)
    points = depth.grid.directions()[known] * depth.range_m[known][:, None]
    names = ["x", "y", "z", "red", "green", "blue", "confidence"]
    vertex = np.zeros(len(points), dtype=list(zip(names, ["<f4"] * 3 + ["u1"] * 3 + ["<f4"], strict=True)))
    for k, axis in enumerate("xyz"):
        vertex[axis] = points[:, k]
    for k, colour in enumerate(("blue", "green", "red")):
        vertex[colour] = strip.image[known][:, k]
    vertex["confidence"] = depth.confidence[known]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {'uchar' if n in ('red', 'green', 'blue') else 'float'} {n}" for n in names]
    return ("\n".join([*header, "end_header"]) + "\n").encode() + vertex.tobytes()
