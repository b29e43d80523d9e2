"""Tracks on real pictures, beside OpenCV's: corners, Lucas-Kanade, a check backwards, a fundamental matrix.

    python benchmarks/tracking_real.py [FOLDER OF REAL RECORDINGS] [--only NAME ...] [--dim]

Every stretch of 60 frames of the recordings that are there is tracked anew by both. Counted are the tracks of at
least ten frames, and how long the track of an average observation is (sum of squared lengths / sum of lengths).
`--dim` darkens every picture as a camera in the dark would show it: little light and gain noise, as in `darkened`.
No number here is accuracy: for that see `benchmarks/tracking.py`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image
from rigwake.cameras.models.pinhole import Pinhole
from rigwake.readers.open import open_recording
from rigwake.recording import CameraStream, Frame
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.tracking_options import TrackingOptions

STRETCH = 60
LONG = 10
RECORDINGS = (
    "handheld_mono_imu",
    "kitti_03_split",
    "kitti_03_first_300",
    "euroc_v101_micro",
    "marine_river_sequence",
)


@dataclass(frozen=True)
class Score:
    """Tracks of at least ten frames, and the length of the track of an average observation."""

    long_tracks: int
    weighted_length: float
    cpu_ms_per_frame: float

    @classmethod
    def of(cls, track_ids: NDArray[np.int64], cpu_s: float, frames: int) -> Score:
        lengths = np.unique(track_ids, return_counts=True)[1]
        lengths = lengths[lengths > 1]
        weighted = float((lengths**2).sum() / max(lengths.sum(), 1))
        return cls(int((lengths >= LONG).sum()), weighted, 1e3 * cpu_s / frames)


def opencv_track_ids(images: Sequence[Image], most: int = 400) -> NDArray[np.int64]:
    """The peer: the track of each observation, first frame of each track included."""
    ids, pixels, next_id = np.empty(0, np.int64), np.empty((0, 2), np.float32), 0
    seen, before = [], None
    flow = {
        "winSize": (21, 21),
        "maxLevel": 3,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
    }
    for image in images:
        if before is not None and len(pixels):
            landed, there, _ = cv2.calcOpticalFlowPyrLK(before, image, pixels, None, **flow)
            returned, back, _ = cv2.calcOpticalFlowPyrLK(image, before, landed, None, **flow)
            kept = (there[:, 0] > 0) & (back[:, 0] > 0)
            kept &= np.linalg.norm(returned - pixels, axis=1) < 1.0
            kept &= (landed >= 0).all(axis=1) & (landed < image.shape[::-1]).all(axis=1)
            if kept.sum() >= 8:
                agrees = cv2.findFundamentalMat(pixels[kept], landed[kept], cv2.FM_RANSAC, 1.0, 0.99)[1]
                kept[kept] = agrees[:, 0] > 0 if agrees is not None else True
            ids, pixels = ids[kept], landed[kept]
        if len(pixels) < most:
            free = np.full(image.shape, 255, np.uint8)
            for x, y in np.rint(pixels).astype(int):
                cv2.circle(free, (int(x), int(y)), 10, 0, -1)
            corners = cv2.goodFeaturesToTrack(image, most - len(pixels), 0.01, 10, mask=free)
            new = np.empty((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
            ids = np.r_[ids, next_id + np.arange(len(new))]
            pixels = np.concatenate([pixels, new])
            next_id += len(new)
        seen.append(ids)
        before = image
    return np.concatenate(seen)


@dataclass(frozen=True)
class Stretch:
    """Consecutive images of one camera, in memory, as a source of frames."""

    name: str
    images: Sequence[Image]
    stamps: NDArray[np.int64]

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for index in indices:
            yield Frame(int(index), int(self.stamps[index]), self.images[index])


def rigwake_track_ids(stretch: Stretch, stream: CameraStream, options: TrackingOptions) -> NDArray[np.int64]:
    tracks = track_camera(replace(stream, timestamps_ns=stretch.stamps, source=stretch), options)
    return tracks.track_ids


def darkened(image: Image, rng: np.random.Generator, light: float = 0.25, gain_noise: float = 6.0) -> Image:
    """The picture with so much of its light, amplified again: shot noise and so much read noise (grey levels)."""
    value = image.astype(np.float32)
    std = np.sqrt(gain_noise**2 / 2 + gain_noise**2 / 2 * value / 128)
    noisy = 0.6 * value + std * rng.normal(size=image.shape).astype(np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def stretches(stream: CameraStream, dim: bool) -> Iterator[Stretch]:
    """Every 60 frames in a row, the last stretch ending with the recording."""
    count = len(stream)
    starts = list(range(0, max(count - STRETCH, 0) + 1, STRETCH))
    if count > STRETCH and starts[-1] + STRETCH < count:
        starts.append(count - STRETCH)
    for start in starts:
        frames = list(stream.frames(np.arange(start, min(start + STRETCH, count))))
        rng = np.random.default_rng(start)
        images = [darkened(f.image, rng) if dim else f.image for f in frames]
        stamps = np.array([f.timestamp_ns for f in frames], dtype=np.int64)
        yield Stretch(f"{stream.name} {start}-{start + len(frames) - 1}", images, stamps)


def with_model(stream: CameraStream) -> CameraStream:
    """The stream with its model, or, where it has none, a pinhole of 65 degrees across."""
    if stream.model is not None:
        return stream
    focal = 0.5 * stream.width_px / np.tan(np.deg2rad(32.5))
    centre = ((stream.width_px - 1) / 2, (stream.height_px - 1) / 2)
    values = (focal, focal, *centre, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return replace(stream, model=Pinhole(values, stream.width_px, stream.height_px))


def compare(stream: CameraStream, options: TrackingOptions, dim: bool) -> Iterator[tuple[str, Score, Score]]:
    """Per stretch its name, the peer's score and ours."""
    for stretch in stretches(stream, dim):
        frames = len(stretch.images)
        started = time.process_time()
        peer = opencv_track_ids(stretch.images)
        middle = time.process_time()
        ours = rigwake_track_ids(stretch, stream, options)
        ended = time.process_time()
        yield stretch.name, Score.of(peer, middle - started, frames), Score.of(ours, ended - middle, frames)


def main() -> None:
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", default=Path(os.environ.get("RIGWAKE_DATA", beside)))
    parser.add_argument("--only", nargs="+", default=RECORDINGS, choices=RECORDINGS)
    parser.add_argument("--dim", action="store_true", help="darken the pictures")
    asked = parser.parse_args()
    print(
        "| recording | stretch | OpenCV: long tracks, weighted length | rigwake | ratios | CPU ms per frame |"
    )
    print("|---|---|---|---|---|---|")
    worst = [np.inf, np.inf]
    for name in asked.only:
        if not (asked.folder / name).is_dir():
            print(f"| {name} | not there | | | | |")
            continue
        for camera in open_recording(asked.folder / name).cameras.values():
            for stretch, peer, ours in compare(with_model(camera), TrackingOptions(), asked.dim):
                ratios = (
                    ours.long_tracks / max(peer.long_tracks, 1),
                    ours.weighted_length / max(peer.weighted_length, 1.0),
                )
                worst = [min(a, b) for a, b in zip(worst, ratios, strict=True)]
                print(
                    f"| {name} | {stretch} | {peer.long_tracks}, {peer.weighted_length:.1f} "
                    f"| {ours.long_tracks}, {ours.weighted_length:.1f} | {ratios[0]:.2f}, {ratios[1]:.2f} "
                    f"| {peer.cpu_ms_per_frame:.0f}, {ours.cpu_ms_per_frame:.0f} |",
                    flush=True,
                )
    print(f"\nworst ratios: {worst[0]:.2f} of the long tracks, {worst[1]:.2f} of the weighted length")


if __name__ == "__main__":
    main()
