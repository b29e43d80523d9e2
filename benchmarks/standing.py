"""What stands on the water, against the truth of six simulated scenes: labels, stixels, ranges, seams, height, buoys.

    python benchmarks/standing.py [--folder SHOTS] [--scenes quay marina ..] [--sets 3] [--only labels stixels ..]
    python benchmarks/standing.py --scenes marina --pictures docs      # the pictures of the documentation

Three scenes are close quarters (`quay`, `pier`, `haven`), three are open (`bay`, `buoys`, `strait`); no network was
trained on them, and no constant was chosen on `pier`, `haven` and `strait`. Others: `marina`, `basin`, `demo`, `sound`
(`view_shots.py`). Attitude, way and height are the true ones, but where the height is estimated. Range errors are
medians; NEES/dof is the median squared error in units of the predicted variance over that of a normal distribution.
"sweep": the sphere sweep in place of pairs and motion.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from rigwake._types import Array
from rigwake.errors import EstimationError
from rigwake.views.depth.depth_panorama import (
    MATCHED,
    PLANE,
    DepthPanorama,
    fuse_depth,
    matched_points,
)
from rigwake.views.depth.height_check import tested_by_height
from rigwake.views.depth.motion import Earlier
from rigwake.views.depth.persistence import earlier_looks
from rigwake.views.height import estimate_height
from rigwake.views.scene.label_measures import LabelComparison, flat_horizon
from rigwake.views.scene.network import shipped_network
from rigwake.views.scene.segmentation import OBSTACLE, WATER, Labels, PixelClassifier, overlay, segment_strip
from rigwake.views.scene.stixel_files import draw_stixels, range_colours
from rigwake.views.scene.stixel_source import contact_shifts
from rigwake.views.scene.stixel_world import StixelWorld, find_stixels
from rigwake.views.seams import RANGE_EDGES_M, SeamMeter
from rigwake.views.strips import LevelStrip, level_strip
from rigwake.views.surface import WaterAndShell
from rigwake.views.surround_rig import SurroundRig
from view_shots import BUOY_RADIUS_M, CLOSE, GRID, JUDGED, SCENES, UNSEEN, ViewShot, scene_rig, scene_shots

_MEDIAN_CHI2 = 0.4549
_FREE_M = 60.0
_FOOT_ROWS = 4
TABLES = ("labels", "stixels", "depth", "seams", "height", "buoys")


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame set and what rigwake made of it. true_labels: (rows, columns) of the strip as it was drawn."""

    shot: ViewShot
    strip: LevelStrip
    alone: Labels
    labels: Labels
    depth: DepthPanorama
    swept: DepthPanorama
    swept_labels: Labels
    world: StixelWorld
    true_world: StixelWorld
    true_labels: np.ndarray


def estimate(rig: SurroundRig, shot: ViewShot, classifier: PixelClassifier, by_motion: bool) -> Seen:
    """All estimates of one frame set, each on its own (nothing is smoothed over time)."""
    surface, attitude = WaterAndShell(), shot.attitude
    strip = level_strip(shot.images, rig, attitude, surface, GRID, shot.hulls)
    alone = segment_strip(strip, classifier)
    earlier = Earlier(shot.images_before, shot.rig_from_rig_before) if by_motion else None
    matched = matched_points(shot.images, rig, attitude, shot.hulls, earlier=earlier)
    before = None
    if earlier is not None:
        before = earlier_looks(earlier, rig, attitude, surface, GRID, classifier, shot.hulls)
    labels = tested_by_height(alone, matched, GRID, attitude, before)
    depth = fuse_depth(matched, labels, GRID, attitude)
    swept = matched_points(shot.images, rig, attitude, shot.hulls, earlier=earlier, sweeps=True)
    true_labels = labels_drawn(rig, shot, strip)
    worlds = []
    exact = _sure(true_labels)
    for found in (labels, exact):
        fused = depth if found is labels else fuse_depth(matched, found, GRID, attitude)
        shift = contact_shifts(found, strip, shot.images, rig, attitude)
        worlds.append(find_stixels(found, GRID, attitude, *fused.inverse_horizontal(), shift))
    swept_labels = tested_by_height(alone, swept, GRID, attitude, before)
    by_sweep = fuse_depth(swept, swept_labels, GRID, attitude)
    return Seen(shot, strip, alone, labels, depth, by_sweep, swept_labels, *worlds, true_labels)


def labels_drawn(rig: SurroundRig, shot: ViewShot, strip: LevelStrip) -> np.ndarray:
    """True classes of the strip's pixels, with the parallax that the strip has."""
    planes = {
        name: np.stack([np.where(truth == c, 255, 0).astype(np.uint8) for c in range(3)], axis=-1)
        for name, truth in shot.truth.items()
    }
    drawn = level_strip(planes, rig, shot.attitude, WaterAndShell(), GRID, shot.hulls).image
    labels = drawn.argmax(axis=2).astype(np.uint8)
    labels[~strip.is_seen | (drawn.max(axis=2) == 0)] = 255
    return labels


def _sure(classes: np.ndarray) -> Labels:
    probability = np.full((3, *classes.shape), 0.02, np.float32)
    for c in range(3):
        probability[c][classes == c] = 0.96
    probability[:, classes == 255] = 1 / 3
    return Labels(classes, probability)


def label_rows(name: str, seen: Sequence[Seen], rig: SurroundRig) -> list[str]:
    """Measures of the labels: the network alone, with the test by height, and a cut at the horizon."""
    elevation = np.rad2deg(GRID.elevations())
    lines = []
    for words, chosen in (
        ("network alone", lambda s: s.alone.classes),
        ("and height", lambda s: s.labels.classes),
        ("flat horizon", lambda s: flat_horizon(s.true_labels, elevation)),
    ):
        comparison = LabelComparison(GRID.step_deg)
        for s in seen:
            comparison.add(chosen(s), s.true_labels, elevation, s.shot.attitude.height_m, wraps=True)
        m = comparison.measures()
        lines.append(
            f"{name:8}{words:16}{m.mean_iou:7.3f}{m.recall:8.2f}{m.precision:8.2f}{m.water_edge_deg:8.2f}"
            f"{m.objects_found:6d}/{m.objects:<5d}{m.false_objects / m.pictures:7.1f}"
        )
    return lines


def stixel_rows(name: str, seen: Sequence[Seen], rig: SurroundRig) -> list[str]:
    """Range errors of stixels that stand in the water, and agreement of the free water."""
    lines = []
    for words, chosen in (("network", lambda s: s.world), ("true labels", lambda s: s.true_world)):
        found = [_stixel_errors(s, chosen(s)) for s in seen]
        distance, error, normalised = (np.concatenate([f[k] for f in found]) for k in range(3))
        free = np.array([_free_areas(s, chosen(s)) for s in seen]).sum(axis=0)
        line = f"{name:8}{words:12}"
        for low, high in pairwise((0.0, 15.0, 30.0, 50.0)):
            part = (distance >= low) & (distance < high)
            line += _range_cell(error[part], normalised[part])
        wrong = np.mean([f[3] for f in found])
        lines.append(f"{line}{free[0] / free[1]:8.3f}{100 * wrong:8.1f}")
    return lines


def _range_cell(error: Array, normalised: Array) -> str:
    if len(error) < 10:
        return f"{'-':>19}"
    nees = np.median(normalised**2) / _MEDIAN_CHI2
    return f"{100 * np.median(np.abs(error)):6.1f}%{nees:5.1f}{100 * np.mean(np.abs(error) > 0.1):6.0f}%"


def _stixel_errors(s: Seen, world: StixelWorld) -> tuple[Array, Array, Array, float]:
    """True distances (N,), relative errors, errors over deviations, and the share of stixels with nothing there."""
    distance, std = world.range_m()
    horizontal = s.shot.ranges_m * np.cos(GRID.elevations())[:, None]
    land = np.where(s.shot.labels == OBSTACLE, horizontal, np.nan)
    chosen = np.flatnonzero(
        (world.kind == OBSTACLE) & world.stands & np.isfinite(distance) & (distance < _FREE_M)
    )
    true = np.full(len(chosen), np.nan)
    for k, at in enumerate(chosen):
        foot = land[max(world.bottom[at] - _FOOT_ROWS, world.top[at]) : world.bottom[at], world.column[at]]
        if np.isfinite(foot).any():
            true[k] = np.nanmedian(foot)
    there = np.isfinite(true)
    found, deviation, real = distance[chosen][there], std[chosen][there], true[there]
    # inverse distances: that is what is measured, and nearly normal
    normalised = (1 / found - 1 / real) / (deviation / found**2)
    return real, found / real - 1, normalised, float(np.mean(~there)) if len(there) else 0.0


def _free_areas(s: Seen, world: StixelWorld) -> tuple[float, float]:
    """Area of free water that both the estimate and the truth have, and that either has."""
    free = np.nan_to_num(world.free_range_m(_FREE_M))
    blocked = s.shot.labels != WATER
    rows = GRID.rows
    lowest = np.where(blocked, np.arange(rows)[:, None], -1)
    seen = s.true_labels != 255
    lowest[~seen] = -1
    row = lowest.max(axis=0)
    horizontal = s.shot.ranges_m * np.cos(GRID.elevations())[:, None]
    true = horizontal[np.maximum(row, 0), np.arange(GRID.columns)]
    true = np.where((row >= 0) & np.isfinite(true), np.minimum(true, _FREE_M), _FREE_M)
    both = seen.any(axis=0)
    return float((np.minimum(free, true)[both] ** 2).sum()), float((np.maximum(free, true)[both] ** 2).sum())


def depth_rows(name: str, seen: Sequence[Seen], rig: SurroundRig) -> list[str]:
    """Errors of matched ranges on land and of the plane on water, density, and what the confidence is worth."""
    return [
        _depth_row(name, [_depth_errors(s, s.depth, s.labels) for s in seen]),
        _depth_row("  sweep", [_depth_errors(s, s.swept, s.swept_labels) for s in seen]),
    ]


def _depth_row(name: str, found: Sequence[tuple[Array, Array, Array, float, Array, int]]) -> str:
    true, error, confidence = (np.concatenate([f[k] for f in found]) for k in range(3))
    line = f"{name:8}"
    for low, high in pairwise((5.0, 10.0, 15.0, 30.0, 100.0)):
        part = np.abs(error[(true >= low) & (true < high)])
        off = 100 * np.mean(part > 0.1) if len(part) else np.nan
        line += f"{100 * np.median(part):6.1f}%{off:5.0f}%" if len(part) > 20 else f"{'-':>13}"
    wrong = np.abs(error) > 0.1
    best = confidence >= np.median(confidence)
    water = np.concatenate([f[4] for f in found])
    matched_water = sum(f[5] for f in found)
    density = np.mean([f[3] for f in found])
    return (
        f"{line}{density:7.2f}{wrong[best].mean() / max(wrong.mean(), 1e-9):7.2f}"
        f"{100 * np.median(np.abs(water)) if len(water) else np.nan:7.1f}%{matched_water:6d}"
    )


def _depth_errors(
    s: Seen, depth: DepthPanorama, labels: Labels
) -> tuple[Array, Array, Array, float, Array, int]:
    true = s.shot.ranges_m
    land = (s.shot.labels == OBSTACLE) & s.strip.is_seen & (true < 100)
    matched = depth.source == MATCHED
    both = land & matched
    error = depth.range_m[both] / true[both] - 1
    water = (s.shot.labels == WATER) & (depth.source == PLANE) & (true < 30)
    wrong = int((matched & (labels.classes == WATER)).sum())
    density = float(matched[land & (labels.classes == OBSTACLE)].mean())
    return true[both], error, depth.confidence[both], density, depth.range_m[water] / true[water] - 1, wrong


def seam_rows(name: str, seen: Sequence[Seen], rig: SurroundRig) -> list[str]:
    """Median misalignment across seams by range: on the stixels, on stixels of true labels, and on a fixed shell."""
    lines = []
    meter = SeamMeter(rig)
    for words, surface in (
        ("stixels", lambda s: s.world.surface()),
        ("true labels", lambda s: s.true_world.surface()),
        ("shell", lambda s: WaterAndShell()),
    ):
        matches = [m for s in seen for m in meter.measure(s.shot.frame_set(rig), s.shot.attitude, surface(s))]
        size = np.concatenate([np.linalg.norm(m.misalignment_px, axis=1) for m in matches])
        ranges = np.concatenate([m.range_m for m in matches])
        line = f"{name:8}{words:12}"
        for low, high in pairwise(RANGE_EDGES_M):
            part = size[(ranges >= low) & ((ranges < high) | (high == np.inf))]
            line += f"{np.median(part):8.2f} ({len(part):4d})" if len(part) >= 8 else f"{'-':>15}"
        lines.append(line)
    return lines


@dataclass(frozen=True, eq=False)
class KnownTilt:
    """True attitudes without the height, as `estimate_height` asks for them."""

    shots: Sequence[ViewShot]

    def at(self, timestamp_ns: int, images: object = None) -> object:
        """The attitude at the time of a frame set."""
        shot = next(s for s in self.shots if s.timestamp_ns == timestamp_ns)
        return replace(shot.attitude, height_m=np.nan)


def height_rows(name: str, seen: Sequence[Seen], rig: SurroundRig) -> list[str]:
    """Estimated height above the water."""
    shots = [s.shot for s in seen]
    true = float(np.mean([s.attitude.height_m for s in shots]))
    hulls = shots[0].hulls
    try:
        found = estimate_height(rig, [s.frame_set(rig) for s in shots], KnownTilt(shots), hulls)  # type: ignore[arg-type]
    except EstimationError as error:
        return [f"{name:8}{true:8.3f}  {error.cause}"]
    off = found.height_m / true - 1
    return [
        f"{name:8}{true:8.3f}{found.height_m:8.3f}{100 * off:8.1f}%{100 * found.std_m / true:8.1f}%"
        f"{abs(found.height_m - true) / found.std_m:8.2f}{found.contacts:8d}"
        f"  {'ripples' if found.by_ripples else 'waterlines'}"
    ]


def buoy_rows(name: str, seen: Sequence[Seen], rig: SurroundRig) -> list[str]:
    """Buoys found among the stixels: how often, and how far away."""
    if not any(len(s.shot.buoys_level) for s in seen):
        return []
    lines = []
    found: dict[float, list[float]] = {}
    for s in seen:
        distance, _ = s.world.range_m()
        obstacle = (s.world.kind == OBSTACLE) & s.world.stands & np.isfinite(distance)
        for place in s.shot.buoys_level:
            true = float(np.linalg.norm(place)) - BUOY_RADIUS_M
            azimuth = np.arctan2(-place[1], place[0])
            apart = np.abs(np.angle(np.exp(1j * (GRID.azimuths()[s.world.column] - azimuth))))
            mine = obstacle & (apart < np.arctan(BUOY_RADIUS_M / true)) & (np.abs(distance / true - 1) < 0.3)
            key = next((low for low in (25.0, 18.0, 12.0, 6.0) if true >= low), 0.0)
            found.setdefault(key, []).append(
                float(np.median(distance[mine]) / true - 1) if mine.any() else np.nan
            )
    for low in sorted(found):
        error = np.array(found[low])
        there = error[np.isfinite(error)]
        if len(there):
            lines.append(
                f"{name:8}{low:5.0f} m and more: found {len(there)} of {len(error)}, "
                f"range {100 * np.median(np.abs(there)):.1f} %, bias {100 * np.median(there):+.1f} %"
            )
        else:
            lines.append(f"{name:8}{low:5.0f} m and more: found 0 of {len(error)}")
    return lines


ROWS: dict[str, Callable[[str, Sequence[Seen], SurroundRig], list[str]]] = {
    "labels": label_rows,
    "stixels": stixel_rows,
    "depth": depth_rows,
    "seams": seam_rows,
    "height": height_rows,
    "buoys": buoy_rows,
}
HEADS = {
    "labels": f"{'':24}{'mIoU':>7}{'recall':>8}{'precis.':>8}{'edge':>8}{'objects':>12}{'false':>7}",
    "stixels": f"{'':20}{'to 15 m, NEES, off':>19}{'15-30 m':>19}{'30-50 m':>19}{'free':>8}{'false%':>8}",
    "depth": f"{'':8}{'5-10 m, off':>13}{'10-15 m':>13}{'15-30 m':>13}{'30-100 m':>13}{'dens.':>6}{'best':>7}"
    f"{'plane':>8}{'wrong':>6}",
    "seams": f"{'':20}{'3-6 m':>15}{'6-15 m':>15}{'15-50 m':>15}{'beyond':>15}   px of 2048 (matches)",
    "height": f"{'':8}{'true':>8}{'found':>8}{'off':>9}{'sigma':>9}{'z':>8}{'votes':>8}",
    "buoys": "0.6 m wide; of those found within 30 % of their range",
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--folder", type=Path, help="where rendered frame sets are kept (default: thrown away)"
    )
    parser.add_argument("--scenes", nargs="+", default=list(JUDGED), choices=SCENES)
    parser.add_argument("--sets", type=int, default=3, help="frame sets per scene (buoys: twice as many)")
    parser.add_argument("--no-motion", action="store_true", help="match cameras only, no earlier pictures")
    parser.add_argument("--model", type=Path, help="another network (ONNX) in place of the one shipped")
    parser.add_argument("--pictures", type=Path, help="folder to write pictures of the first frame set to")
    parser.add_argument("--only", nargs="+", default=list(TABLES), choices=TABLES)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as scratch:
        _tables(options, options.folder or Path(scratch))


def write_pictures(seen: Seen, folder: Path) -> None:
    """Labels, stixels, and found above true ranges of one frame set, as the documentation shows them."""
    size = (round(1.4 * GRID.columns), round(1.4 * GRID.rows))
    ranges = np.vstack([range_colours(seen.depth.range_m), range_colours(seen.shot.ranges_m)])
    for name, picture, rows in (
        ("segmentation", overlay(seen.strip.image, seen.labels), 1),
        ("stixels", draw_stixels(seen.strip, seen.world), 1),
        ("depth", ranges, 2),
    ):
        scaled = cv2.resize(picture, (size[0], rows * size[1]), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / f"{name}.jpg"), scaled, [cv2.IMWRITE_JPEG_QUALITY, 80])


def _tables(options: argparse.Namespace, folder: Path) -> None:
    network = shipped_network()
    if options.model is not None:
        network = replace(network, name=options.model.name, _net=cv2.dnn.readNetFromONNX(str(options.model)))
    tables: dict[str, list[str]] = {key: [] for key in options.only}
    for name in options.scenes:
        rig = scene_rig(name)
        shots = scene_shots(name, options.sets * (2 if name == "buoys" else 1), folder)
        start = time.process_time()
        seen = [estimate(rig, shot, network, not options.no_motion) for shot in shots]
        if options.pictures is not None:
            write_pictures(seen[0], options.pictures)
        print(
            f"{name}: {len(shots)} frame sets, {time.process_time() - start:.1f} CPU-s, "
            f"{'close quarters' if name in CLOSE else 'open water'}{', not seen before' if name in UNSEEN else ''}",
            flush=True,
        )
        for key in options.only:
            tables[key] += ROWS[key](name, seen, rig)
    for key in options.only:
        print(f"\n{key}: {HEADS[key]}" if key == "buoys" else f"\n{key}\n{HEADS[key]}")
        print("\n".join(tables[key]))


if __name__ == "__main__":
    main()
