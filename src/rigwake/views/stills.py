"""Pictures on disk: one picture per camera as a recording, and views written as PNG or JPEG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from rigwake._types import Image
from rigwake.atomic import atomic_path
from rigwake.errors import InputError
from rigwake.readers.image_files import FileFrames, first_file_size, image_files
from rigwake.recording import CameraStream, Recording
from rigwake.views.sphere_metadata import mark_picture

_JPEG_QUALITY = 92


def picture_per_camera(folder: Path, names: Sequence[str]) -> Recording | None:
    """A recording of one moment from a folder with one picture per camera, named by it (`front.png`); None if the
    folder has no such pictures."""
    if not folder.is_dir():
        return None
    by_name = {file.stem: file for file in image_files(folder)}
    cameras = {}
    for name in names:
        if name in by_name:
            size = first_file_size([by_name[name]])
            stamps = np.zeros(1, dtype=np.int64)
            source = FileFrames(folder, (by_name[name].name,), stamps, size)
            cameras[name] = CameraStream(name, stamps, source, size.width_px, size.height_px)
    return Recording(folder, "one picture per camera", cameras) if cameras else None


def write_picture(picture: Image, path: Path, is_sphere: bool) -> None:
    """Write a (H, W, 3) BGR view as PNG or JPEG, marked as a sphere if it is one. Raises InputError for other names."""
    suffix = path.suffix.lower()
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"{path}: pictures are written as .png or .jpg.")
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if suffix != ".png" else []
    _, encoded = cv2.imencode(".png" if suffix == ".png" else ".jpg", picture, options)
    content = encoded.tobytes()
    if is_sphere:
        content = mark_picture(content, picture.shape[1], picture.shape[0])
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
