"""Zoomed patches of held-out landmarks: as seen before, as predicted in another image, and as found there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigwake._types import Array, Image, Indices
from rigwake.atomic import atomic_path
from rigwake.ba.rig.search_proposals import AssociationOptions, Searches, predicted_pixels, with_warps
from rigwake.ba.rig.split_checks import first_cameras
from rigwake.ba.solver.rig_problem import Observations, RigProblem
from rigwake.recording import CameraStream

TILE_PX, _ZOOM = 31, 5  # side of a tile in pixels of the recording, and how much larger it is drawn
_MOST_PATCHES = 24


def write_patches(
    folder: Path, problem: RigProblem, streams: Mapping[str, CameraStream], unused: Observations
) -> list[dict[str, Any]]:
    """Of every pair of cameras the held-out landmarks that lie worst and in the middle, 24 in all: a JPEG each with
    the three tiles side by side. Returns their entries for `pictures.json`."""
    rows = _chosen(problem, unused)
    searches = with_warps(problem, _searches(problem, unused.take(rows)), AssociationOptions())
    found = {
        (int(c), int(t), int(k)): unused.pixels[row]
        for c, t, k, row in zip(
            unused.camera_indices[rows],
            unused.timestamps_ns[rows],
            unused.landmark_indices[rows],
            rows,
            strict=True,
        )
    }
    before = _tiles(problem, streams, searches.source_cameras, searches.source_stamps, searches, "seen")
    after = _tiles(problem, streams, searches.cameras, searches.stamps, searches, "found")
    entries: list[dict[str, Any]] = []
    for k in sorted(before.keys() & after.keys()):
        camera, stamp = int(searches.cameras[k]), int(searches.stamps[k])
        name = f"patch_{len(entries)}.jpg"
        if not _write(folder / name, [*before[k], *after[k]]):
            continue
        landmark = int(searches.landmarks[k])
        point = {
            "predicted_px": searches.pixels[k].round(2).tolist(),
            "observed_px": found[camera, stamp, landmark].round(2).tolist(),
            "from_camera": problem.cameras[searches.source_cameras[k]].name,
            "landmark": str(landmark),
        }
        entry = {"camera": problem.cameras[camera].name, "file": name, "timestamp_ns": stamp}
        entries.append({**entry, "kind": "patches", "tile_px": TILE_PX, "horizon_px": [], "points": [point]})
    return entries


def _chosen(problem: RigProblem, unused: Observations) -> Indices:
    """Rows: by ordered pair of cameras the worst and the middle one, of different cameras first."""
    off = np.linalg.norm(predicted_pixels(problem, unused) - unused.pixels, axis=1)
    first = first_cameras(problem)[unused.landmark_indices]
    counts = np.bincount(problem.observations.landmark_indices, minlength=len(problem.landmarks))
    off[counts[unused.landmark_indices] == 0] = np.nan  # nothing is left that could be shown as seen
    cameras = len(problem.cameras)
    apart: list[int] = []
    same: list[int] = []
    for a in range(cameras):
        for b in range(cameras):
            rows = np.flatnonzero((first == a) & (unused.camera_indices == b) & np.isfinite(off))
            rows = rows[np.argsort(off[rows], kind="stable")]
            picked = dict.fromkeys([int(rows[-1]), int(rows[len(rows) // 2])]) if len(rows) else {}
            (same if a == b else apart).extend(picked)
    return np.array([*apart, *same][:_MOST_PATCHES], dtype=np.int64)


def _searches(problem: RigProblem, found: Observations) -> Searches:
    """What was looked for: the patch is that of the middle observation of the camera that saw the landmark first."""
    observations, first = problem.observations, first_cameras(problem)
    source = []
    for landmark in found.landmark_indices:
        own = observations.camera_indices == first[landmark]
        rows = np.flatnonzero(own & (observations.landmark_indices == landmark))
        source.append(int(rows[np.argsort(observations.timestamps_ns[rows])[len(rows) // 2]]))
    at, n = np.array(source, dtype=np.int64), len(found)
    return Searches(
        found.landmark_indices,
        observations.camera_indices[at],
        observations.timestamps_ns[at],
        observations.pixels[at],
        observations.std_px[at],
        found.camera_indices,
        found.timestamps_ns,
        predicted_pixels(problem, found),
        np.tile(np.eye(2), (n, 1, 1)),
        np.zeros((n, 2, 3)),
    )


def _tiles(
    problem: RigProblem,
    streams: Mapping[str, CameraStream],
    cameras: Indices,
    stamps: Indices,
    searches: Searches,
    what: str,
) -> dict[int, list[Image]]:
    """By search: of the source's image the patch as it is and as the prediction warps it (`seen`), of the other
    image the patch about the prediction (`found`). Every image is read once."""
    tiles: dict[int, list[Image]] = {}
    for index in np.unique(cameras).tolist():
        stream, rows = streams[problem.cameras[index].name], np.flatnonzero(cameras == index)
        wanted, which = np.unique(stamps[rows], return_inverse=True)
        frames = np.searchsorted(stream.timestamps_ns, wanted)
        for frame in stream.frames(frames, colour=True):
            for k in rows[which == int(np.searchsorted(frames, frame.index))].tolist():
                if what == "found":
                    tiles[k] = [_tile(frame.image, searches.pixels[k], np.eye(2))]
                else:
                    at = searches.source_pixels[k]
                    back = np.linalg.inv(searches.warps[k])
                    tiles[k] = [_tile(frame.image, at, np.eye(2)), _tile(frame.image, at, back)]
    return tiles


def _tile(image: Image, centre: Array, source_by_tile: Array) -> Image:
    """The patch about a pixel, enlarged; source_by_tile: (2, 2) derivative of the image's pixels by the tile's."""
    size = TILE_PX * _ZOOM
    linear = source_by_tile / _ZOOM
    middle = np.full(2, (size - 1) / 2)
    matrix = np.column_stack([linear, centre - linear @ middle])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, matrix, (size, size), flags=flags))


def _write(path: Path, tiles: list[Image]) -> bool:
    coloured = [t if t.ndim == 3 else cv2.cvtColor(t, cv2.COLOR_GRAY2BGR) for t in tiles]
    ok, encoded = cv2.imencode(".jpg", np.hstack(coloured), [cv2.IMWRITE_JPEG_QUALITY, 85])
    if ok:
        with atomic_path(path) as temporary:
            temporary.write_bytes(encoded.tobytes())
    return bool(ok)
