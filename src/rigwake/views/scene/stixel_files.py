"""Stixels of a recording as files: JSON lines, overlays, top views."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigwake._types import Image
from rigwake.atomic import atomic_path, write_text_atomic
from rigwake.errors import UsageError
from rigwake.readers.topics import TopicMap
from rigwake.views.attitude import LevelAttitude
from rigwake.views.draw import draw_top_view, water_uncertainty
from rigwake.views.frames import frame_sets
from rigwake.views.prepare import SurroundOptions, SurroundSetup, prepare_surround
from rigwake.views.projections import TopDown
from rigwake.views.scene.segment_files import SegmentChoices
from rigwake.views.scene.segmentation import COLOURS, OBSTACLE, WATER, overlay
from rigwake.views.scene.stixel_source import StixelEstimator
from rigwake.views.scene.stixel_world import StixelWorld
from rigwake.views.strips import LevelStrip

_NEAR_M, _FAR_M = 5.0, 60.0  # ends of the colour scale of ranges


@dataclass(frozen=True)
class StixelSummary:
    """What was written. nearest: (bearing_deg, range_m, range_std_m) of the nearest obstacle of the last frame set."""

    folder: Path
    frame_sets: int
    stixels: int
    nearest: tuple[float, float, float] | None
    notes: tuple[str, ...]
    unsure: int

    def lines(self) -> list[str]:
        """Sentences for people."""
        lines = [*self.notes, f"{self.folder}: {self.stixels} stixels of {self.frame_sets} frame sets."]
        if self.unsure:
            lines.append(
                f"{self.unsure} frame sets are too dark or show too little: do not trust their stixels."
            )
        if self.nearest is not None:
            bearing, distance, std = self.nearest
            side = "starboard" if bearing >= 0 else "port"
            lines.append(
                f"Nearest obstacle of the last: {distance:.1f} +- {std:.1f} m, {abs(bearing):.0f} deg to {side}."
            )
        return lines

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "frame_sets": self.frame_sets,
            "stixels": self.stixels,
            "unsure_frame_sets": self.unsure,
            "nearest": None if self.nearest is None else list(self.nearest),
            "notes": list(self.notes),
        }


def stixels_to_folder(
    calibration: Path,
    recording: Path,
    folder: Path,
    choices: SegmentChoices,
    uses_matches: bool = True,
    radius_m: float = 40.0,
    topics: TopicMap | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StixelSummary:
    """Write `stixels.jsonl` (one line per frame set), `overlays/` and `topviews/`.

    Raises UsageError if the height above the water is neither given nor found, InputError if nothing can be read.
    """
    options = SurroundOptions(height_m=choices.height_m, hull="mask", correct_colours=False)
    setup = prepare_surround(calibration, recording, options, topics)
    if setup.height is None:
        raise UsageError(
            "The height of the cameras above the water is not known.",
            consequence="A foot in the water has no distance.",
            remedy="Give it: --height-m METRES (mean height of the cameras above the water).",
        )
    estimator = StixelEstimator(setup.rig, choices.classifier(), setup.masks, shell_m=setup.shell_m)
    estimator.uses_matches = uses_matches
    times = setup.times_ns()
    chosen = times[
        np.unique(np.linspace(0, len(times) - 1, min(choices.count, len(times))).round().astype(int))
    ]
    lines, count, unsure, nearest = [], 0, 0, None
    for done, frames in enumerate(frame_sets(setup.streams, setup.rig, chosen)):
        images, attitude = frames.images(setup.rig), setup.attitude_at(frames)
        strip, labels, world = estimator.estimate(
            images, attitude, frames.timestamp_ns, setup.earlier(frames) if uses_matches else None
        )
        unsure += bool(labels.words)
        lines.append(json.dumps(world_to_dict(world, labels.words, frames.missing), allow_nan=False))
        write_image(folder / "overlays" / f"{frames.timestamp_ns}.jpg", draw_stixels(strip, world))
        write_image(folder / "labels" / f"{frames.timestamp_ns}.jpg", overlay(strip.image, labels))
        top = draw_free_water(world, setup, attitude, radius_m)
        write_image(folder / "topviews" / f"{frames.timestamp_ns}.png", top)
        count += len(world)
        nearest = _nearest(world)
        progress(done + 1, len(chosen))
    write_text_atomic(folder / "stixels.jsonl", "".join(line + "\n" for line in lines))
    notes = (setup.leveller.words[:1].upper() + setup.leveller.words[1:] + ".", *setup.notes)
    return StixelSummary(folder, len(chosen), count, nearest, notes, unsure)


def _nearest(world: StixelWorld) -> tuple[float, float, float] | None:
    distance, std = world.range_m()
    known = np.flatnonzero((world.kind == OBSTACLE) & np.isfinite(distance) & (distance < 500))
    if not len(known):
        return None
    k = known[distance[known].argmin()]
    bearing = -180 + (world.column[k] + 0.5) * world.grid.step_deg
    return float(bearing), float(distance[k]), float(std[k])


def world_to_dict(world: StixelWorld, words: str = "", missing: Any = None) -> dict[str, Any]:
    """One line of `stixels.jsonl`: obstacles by bearing with range and uncertainty, and the outline of the free water
    (metres ahead and to port). Unknown: null."""

    def rounded(value: float, digits: int = 2) -> float | None:
        return round(value, digits) if np.isfinite(value) else None

    obstacles = [
        {
            "bearing_deg": rounded(s.bearing_deg),
            "bottom_deg": rounded(s.bottom_deg),
            "top_deg": rounded(s.top_deg),
            "range_m": rounded(s.range_m, 3),
            "range_std_m": rounded(s.range_std_m, 3),
            "stands_in_water": s.stands_in_water,
            "probability": rounded(s.probability, 3),
        }
        for s in world.stixels()
        if s.kind == "obstacle"
    ]
    return {
        "timestamp_ns": world.timestamp_ns,
        "width_deg": world.grid.step_deg,
        "words": words,
        "missing_cameras": dict(missing or {}),
        "obstacles": obstacles,
        "free_water_m": np.round(world.free_polygon(), 2).tolist(),
    }


def write_image(path: Path, picture: Image) -> None:
    """Write a picture atomically, as its suffix says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _, encoded = cv2.imencode(path.suffix, picture)
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def range_colours(range_m: Any) -> Image:
    """BGR of ranges: red near, blue far, grey unknown."""
    near, far = np.log(_NEAR_M), np.log(_FAR_M)
    scaled = (np.log(np.clip(np.nan_to_num(range_m, nan=_FAR_M), _NEAR_M, _FAR_M)) - near) / (far - near)
    picture = cv2.applyColorMap((255 * (1 - scaled)).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO)
    picture = picture.reshape(*np.shape(range_m), 3)
    picture[~np.isfinite(range_m)] = 110
    return np.asarray(picture, np.uint8)


def draw_stixels(strip: LevelStrip, world: StixelWorld) -> Image:
    """The strip with obstacles coloured by range (red 5 m, blue 60 m) and water in blue, twice as large."""
    painted = strip.image.copy()
    distance, _ = world.range_m()
    colours = range_colours(distance[None])[0] if len(world) else np.zeros((0, 3), np.uint8)
    for k in range(len(world)):
        if world.kind[k] == OBSTACLE:
            painted[world.top[k] : world.bottom[k], world.column[k]] = colours[k]
        elif world.kind[k] == WATER:
            painted[world.top[k] : world.bottom[k], world.column[k]] = COLOURS[WATER]
    mixed = cv2.addWeighted(strip.image, 0.5, painted, 0.5, 0)
    return np.asarray(cv2.resize(mixed, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST), np.uint8)


def draw_free_water(
    world: StixelWorld, setup: SurroundSetup, attitude: LevelAttitude, radius_m: float
) -> Image:
    """A map, bow up: free water blue, feet of obstacles red with their uncertainty, rings and the vessel."""
    view = TopDown(800, 800, radius_m)
    picture = np.full((800, 800, 3), 60, np.uint8)
    outline = np.round(view.pixels(world.free_polygon(4 * radius_m))).astype(np.int32)
    cv2.fillPoly(picture, [outline], (150, 95, 40), cv2.LINE_AA)
    distance, std = world.range_m()
    azimuth = world.grid.azimuths()[world.column]
    for k in np.flatnonzero((world.kind == OBSTACLE) & np.isfinite(distance) & (distance < 2 * radius_m)):
        reach = distance[k] + np.array([-1.0, 1.0]) * min(std[k], radius_m)
        ends = np.round(view.pixels(np.outer(reach, [np.cos(azimuth[k]), -np.sin(azimuth[k])]))).astype(int)
        cv2.line(picture, ends[0].tolist(), ends[1].tolist(), (60, 60, 235), 2, cv2.LINE_AA)
    uncertainty = water_uncertainty(attitude, setup.calibration, setup.wave_std_m)
    draw_top_view(picture, view, setup.rig, attitude, uncertainty, world.surface(setup.shell_m))
    return picture
