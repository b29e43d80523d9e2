"""What a camera sees of its own boat: the mean of frames, in which only what stays put is sharp."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rigwake._types import Array, Indices, Mask
from rigwake.atomic import atomic_path
from rigwake.errors import InputError
from rigwake.recording import CameraStream

_SCALE = 256.0  # of grey levels in the file: 16 bits keep what a mean of frames is better known to
_FRAMES = 24


@dataclass(frozen=True, eq=False)
class HullPicture:
    """picture: (H, W) mean grey levels. region: (H, W), True on the own boat. origin: where it is from, in words."""

    picture: Array
    region: Mask
    origin: str


def mean_picture(stream: CameraStream, indices: Indices) -> Array | None:
    """(H, W) mean grey levels of some frames, float32; None if none of them can be read."""
    total, count = np.zeros((stream.height_px, stream.width_px), np.float32), 0
    for frame in stream.frames(indices):
        total += frame.image
        count += 1
    return total / count if count else None


def spread_frames(rows: Indices, most: int = _FRAMES) -> Indices:
    """Up to `most` of the frames, evenly spread."""
    if not len(rows):
        return rows
    return np.asarray(rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.int64))])


def save_hull_picture(stream: CameraStream, folder: Path) -> Path | None:
    """Write `CAMERA_mean.png` (16 bits) beside the masks, for a later comparison; None if no frame can be read."""
    picture = mean_picture(stream, spread_frames(np.arange(len(stream))))
    if picture is None:
        return None
    _, encoded = cv2.imencode(".png", np.round(picture * _SCALE).clip(0, 65535).astype(np.uint16))
    path = folder / f"{stream.name}_mean.png"
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded.tobytes())
    return path


def load_hull_picture(folder: Path, camera: str) -> HullPicture | None:
    """What `save_hull_picture` and the mask `CAMERA_hull.png` hold; None where they are not kept or no hull is in view.

    Raises InputError if a file is broken or their sizes differ.
    """
    paths = folder / f"{camera}_mean.png", folder / f"{camera}_hull.png"
    if not all(path.is_file() for path in paths):
        return None
    pictures = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths]
    for path, picture in zip(paths, pictures, strict=True):
        if picture is None or picture.ndim != 2:
            raise InputError(
                f"{path} is not a grey picture.",
                consequence="The own hull cannot be compared with it.",
                remedy="Delete it, or calibrate again.",
            )
    mean, region = pictures
    assert mean is not None
    assert region is not None
    if mean.shape != region.shape or mean.dtype != np.uint16:
        raise InputError(
            f"{paths[0].name} and {paths[1].name} in {folder} do not belong together.",
            consequence="The own hull cannot be compared with them.",
            remedy="Delete them, or calibrate again.",
        )
    if not (region > 127).any():
        return None
    return HullPicture(mean.astype(np.float32) / _SCALE, region > 127, "kept with the calibration")


def load_hull_pictures(calibration: Path, cameras: Iterable[str]) -> dict[str, HullPicture]:
    """Of all cameras of which a picture is kept with a calibration: its file, or the folder that `calibrate` leaves."""
    folder = (calibration if calibration.is_dir() else calibration.parent) / "masks"
    found = {name: load_hull_picture(folder, name) for name in cameras}
    return {name: picture for name, picture in found.items() if picture is not None}
