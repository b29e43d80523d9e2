"""Undistorted pictures: what pinholes, a cylinder or a panorama in place of each camera would have seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from rigwake._types import Image
from rigwake.atomic import atomic_path
from rigwake.cameras.formats.camera_files import read_camera, write_cameras
from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.models.pinhole import Pinhole
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.virtual_views import (
    Cylinder,
    Equirectangular,
    RemapTable,
    ViewGeometry,
    covering_views,
    remap_table,
)
from rigwake.errors import InputError, UsageError
from rigwake.readers.image_files import image_files, read_bytes
from rigwake.readers.images import decode_compressed
from rigwake.readers.open import open_recording
from rigwake.readers.picture_files import IMAGE_SUFFIXES
from rigwake.recording import CameraStream, Recording

Target = Literal["pinhole", "cylinder", "equirectangular"]
_MAX_VERTICAL_FOV = np.deg2rad(150.0)  # a cylinder is endless towards its poles
_MAX_SIZE_PX = 16_384


@dataclass(frozen=True, eq=False)
class Undistortion:
    """One camera's views by name, and the table that makes each from the camera's image."""

    camera: CameraModel
    views: dict[str, tuple[ViewGeometry, RemapTable]]

    def apply(self, image: Image) -> dict[str, Image]:
        """The views of one image (H, W) or (H, W, 3). Raises InputError for an image of another size."""
        height, width = image.shape[:2]
        if (width, height) != (self.camera.width_px, self.camera.height_px):
            raise InputError(
                f"The image is {width} x {height} pixels, the camera {self.camera.width_px} x {self.camera.height_px}.",
                remedy="Give the camera file of this lens at this size.",
            )
        return {name: table.apply(image) for name, (_, table) in self.views.items()}


def prepare_undistortion(camera: CameraModel, target: Target, focal_px: float | None = None) -> Undistortion:
    """Tables for one lens. focal_px: of the views, by default that of the lens at its axis, so that no detail is lost.

    A lens wider than 100 degrees becomes several pinholes (`front`, `left`, ...), which together show all it sees.
    Raises UsageError when the views would be absurdly large, CameraError for a lens without an image.
    """
    focal = axis_focal_px(camera) if focal_px is None else focal_px
    if target == "pinhole":
        views = covering_views(camera, focal)
        tables = {name: (v.view, remap_table(camera, v.view, v.cam_from_view)) for name, v in views.items()}
        return Undistortion(camera, tables)
    horizontal = vertical = 2 * camera.max_angle
    horizontal, vertical = min(horizontal, 2 * np.pi), min(vertical, np.pi)
    width_px = round(focal * horizontal)
    view: ViewGeometry
    if target == "equirectangular":
        height_px = round(focal * vertical)
        _require_size(width_px, height_px)
        view = Equirectangular(width_px, height_px, horizontal, vertical)
    else:
        height_px = round(2 * focal * np.tan(min(vertical, _MAX_VERTICAL_FOV) / 2))
        _require_size(width_px, height_px)
        view = Cylinder(width_px, height_px, horizontal)
    return Undistortion(camera, {"view": (view, remap_table(camera, view))})


def _require_size(width_px: int, height_px: int) -> None:
    if not 2 <= min(width_px, height_px) <= max(width_px, height_px) <= _MAX_SIZE_PX:
        raise UsageError(
            f"The view would be {width_px} x {height_px} pixels.",
            remedy=f"Choose --focal so that both sides lie between 2 and {_MAX_SIZE_PX}.",
        )


def undistort_source(
    source: Sequence[Path] | Recording,
    out: Path,
    *,
    camera_file: Path | None = None,
    camera: str | None = None,
    target: Target = "pinhole",
    focal_px: float | None = None,
    every: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Undistort images, folders of images, or one camera of a recording; returns the files written.

    camera_file: the lens, by default the recording's. camera: its name in the file or the recording. every: of a
    recording, every n-th frame. Raises UsageError where the lens or the camera is not known.
    """
    given = None if camera_file is None else read_camera(camera_file, camera)
    if not isinstance(source, Recording):
        if all(path.suffix.lower() in IMAGE_SUFFIXES for path in source) or (given and _only_images(source)):
            if given is None:
                raise UsageError(
                    "Images alone do not say what the lens is.", remedy="Give --camera-file FILE."
                )
            return undistort_files(source, prepare_undistortion(given, target, focal_px), out, progress)
        if len(source) != 1:
            raise UsageError("Give one recording, or images.")
        source = open_recording(source[0])
    stream = source.camera(camera) if camera else next(iter(source.cameras.values()), None)
    if stream is None:
        raise UsageError(f"{source.path} has no camera.", remedy=f"rigwake inspect {source.path}")
    model = given or stream.model
    if model is None:
        raise UsageError(
            f"{source.path} does not say what the lens of {stream.name} is.",
            remedy="Give --camera-file FILE.",
        )
    return undistort_stream(stream, prepare_undistortion(model, target, focal_px), out, every, progress)


def _only_images(source: Sequence[Path]) -> bool:
    """Whether folders hold images and nothing that makes them a recording."""
    return all(path.is_file() or (path.is_dir() and bool(image_files(path))) for path in source)


def undistort_files(
    images: Sequence[Path], undistortion: Undistortion, out: Path, progress: Callable[[int, int], None]
) -> list[Path]:
    """Write the views of image files (and of the images in folders) under their own names, as PNG."""
    files = [file for path in images for file in (image_files(path) if path.is_dir() else [path])]
    if not files:
        raise InputError(
            "There is no image in what was given.", remedy="Name image files or folders of them."
        )

    def read() -> Iterator[tuple[str, Image]]:
        for file in files:
            yield file.stem, decode_compressed(read_bytes(file), colour=True)

    return _write_all(read(), len(files), undistortion, out, progress)


def undistort_stream(
    stream: CameraStream,
    undistortion: Undistortion,
    out: Path,
    every: int,
    progress: Callable[[int, int], None],
) -> list[Path]:
    """Write the views of every n-th frame of a recording's camera, named by its stamp, as PNG."""
    indices = np.arange(0, len(stream), every)
    frames = ((str(frame.timestamp_ns), frame.image) for frame in stream.frames(indices, colour=True))
    return _write_all(frames, len(indices), undistortion, out, progress)


def _write_all(
    images: Iterable[tuple[str, Image]],
    total: int,
    undistortion: Undistortion,
    out: Path,
    progress: Callable[[int, int], None],
) -> list[Path]:
    several = len(undistortion.views) > 1
    written = []
    for done, (stem, image) in enumerate(images, 1):
        for view, picture in undistortion.apply(image).items():
            path = (out / view if several else out) / f"{stem}.png"
            ok, encoded = cv2.imencode(".png", picture)
            if not ok:
                raise InputError(f"{path} could not be encoded.")
            with atomic_path(path) as temporary:
                temporary.write_bytes(encoded.tobytes())
            written.append(path)
        progress(done, total)
    pinholes = {name: v for name, (v, _) in undistortion.views.items() if isinstance(v, Pinhole)}
    if pinholes:
        path = out / "cameras.yaml"
        write_cameras(path, pinholes)
        written.append(path)
    return written
