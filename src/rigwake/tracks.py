"""The `Tracks` value: observations of the same points over time in one camera."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._tables import take_rows
from rigwake._types import Array, Indices
from rigwake.atomic import atomic_path
from rigwake.errors import InputError


@dataclass(frozen=True)
class TrackingReport:
    """What happened while tracking one camera.

    frames: given; of these `frames_used` were tracked, `frames_black` showed nothing, `frames_repeated` were
    copies of a frame before, `frames_missing` could not be decoded. tracks, observations: what was found.
    frames_per_second: wall-clock speed, decoding included.
    """

    frames: int
    frames_used: int
    frames_black: int
    frames_repeated: int
    frames_missing: int
    tracks: int
    observations: int
    frames_per_second: float


@dataclass(frozen=True, eq=False)
class CrossViews:
    """M points that one camera tracked for about a second and another one saw, too.

    source, target: (M,) indices into `cameras`. first_ns, later_ns: (M,) when the source saw it, its clock. seen_ns:
    (M,) when the target did, its clock. first, later, seen: (M, 3) bearings in the frames of these cameras. std: (M, 3)
    radians of the three. cluster: (M,) which track of all.
    """

    cameras: tuple[str, ...]
    source: Indices
    target: Indices
    first_ns: Indices
    later_ns: Indices
    seen_ns: Indices
    first: Array
    later: Array
    seen: Array
    std: Array
    cluster: Indices

    def __len__(self) -> int:
        return len(self.source)

    def take(self, index: Indices) -> CrossViews:
        """The chosen views."""
        return take_rows(self, index, keep=("cameras",))

    @classmethod
    def nothing(cls, cameras: tuple[str, ...]) -> CrossViews:
        """Of cameras that see nothing in common."""
        none, empty = np.empty(0, dtype=np.int64), np.empty((0, 3))
        return cls(cameras, none, none, none, none, none, empty, empty, empty, empty, none)

    def rig_times_ns(self, offsets_s: Mapping[str, float]) -> tuple[Indices, Indices, Indices]:
        """(M,) times of the three sightings on the rig's clock. offsets_s: of the cameras' clocks."""
        offsets = np.array([round(offsets_s[name] * 1e9) for name in self.cameras], dtype=np.int64)
        source, target = offsets[self.source], offsets[self.target]
        return self.first_ns + source, self.later_ns + source, self.seen_ns + target


@dataclass(frozen=True, eq=False)
class Tracks:
    """Feature observations of one camera, sorted by frame, then by track.

    camera: its name. timestamps_ns: (F,) camera clock, one per processed frame.
    frame_indices: (M,) row of `timestamps_ns` of each observation. track_ids: (M,) which point it is.
    pixels: (M, 2). bearings_cam: (M, 3) unit vectors. std_px: (M,) predicted standard deviation of a pixel
    coordinate. An observation appears at most once per (frame, track).
    report: what happened while tracking, if known.
    """

    camera: str
    timestamps_ns: Indices
    frame_indices: Indices
    track_ids: Indices
    pixels: Array
    bearings_cam: Array
    std_px: Array
    report: TrackingReport | None = None

    def __post_init__(self) -> None:
        m = len(self.frame_indices)
        shapes = (self.track_ids.shape, self.pixels.shape, self.bearings_cam.shape, self.std_px.shape)
        if shapes != ((m,), (m, 2), (m, 3), (m,)):
            raise InputError(f"tracks of {self.camera}: arrays disagree in length: {shapes}")
        if m and (self.frame_indices.min() < 0 or self.frame_indices.max() >= len(self.timestamps_ns)):
            raise InputError(f"tracks of {self.camera}: frame index out of range")

    def __len__(self) -> int:
        return len(self.frame_indices)

    def take(self, index: Indices | NDArray[np.bool_]) -> Tracks:
        """The chosen observations."""
        return take_rows(self, index, keep=("camera", "timestamps_ns", "report"))

    def same_tracks(self, rows: Indices, frames: Indices) -> tuple[Indices, Indices]:
        """Those of the rows (N,) whose track is observed in `frames` (N,) too, and the rows where it is."""
        width = int(self.track_ids.max(initial=0)) + 1
        keys = self.frame_indices * width + self.track_ids
        wanted = frames * width + self.track_ids[rows]
        at = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
        found = keys[at] == wanted
        return rows[found], at[found]

    def save(self, path: Path) -> None:
        """Write a compressed .npz, whole or not at all."""
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(
                file,
                camera=np.array(self.camera),
                timestamps_ns=self.timestamps_ns,
                frame_indices=self.frame_indices,
                track_ids=self.track_ids,
                pixels=self.pixels,
                bearings_cam=self.bearings_cam,
                std_px=self.std_px,
                report=np.array(json.dumps(asdict(self.report)) if self.report else ""),
            )


def load_tracks(path: Path) -> Tracks:
    """Read what `Tracks.save` wrote; nothing in the file is executed. Raises InputError."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            report = str(arrays["report"])
            return Tracks(
                str(arrays["camera"]),
                arrays["timestamps_ns"].astype(np.int64),
                arrays["frame_indices"].astype(np.int64),
                arrays["track_ids"].astype(np.int64),
                arrays["pixels"].astype(np.float64),
                arrays["bearings_cam"].astype(np.float64),
                arrays["std_px"].astype(np.float64),
                TrackingReport(**json.loads(report)) if report else None,
            )
    except Exception as error:  # of damaged bytes, numpy and zipfile make almost any error
        raise InputError(
            f"{path} holds no tracks ({type(error).__name__}: {error}).",
            remedy="Delete it and run the command again: tracks are recomputed from the recording.",
        ) from error
