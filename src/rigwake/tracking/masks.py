"""Which pixels of a camera can hold static scene points: masks by named source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from rigwake._types import Array, Mask
from rigwake.atomic import atomic_path
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError, UsageError
from rigwake.readers.picture_files import picture_or_none
from rigwake.recording import CameraStream

_DARK = 12  # grey levels: what a lens leaves outside its image circle, with stray light and noise


@dataclass(frozen=True, eq=False)
class CameraMask:
    """Regions of one camera that must not be used, by what they are.

    excluded: `(H, W)` bool arrays by source (`lens`, `hull`, `water`, `sky`, `file`), True where excluded.
    """

    width_px: int
    height_px: int
    excluded: Mapping[str, Mask] = field(default_factory=dict)

    @property
    def usable(self) -> Mask:
        """(H, W), True where no source excludes the pixel."""
        usable = np.ones((self.height_px, self.width_px), dtype=bool)
        for region in self.excluded.values():
            usable &= ~region
        return usable

    def with_region(self, source: str, region: Mask) -> CameraMask:
        """The same mask, with `region` (H, W) excluded as `source`."""
        if region.shape != (self.height_px, self.width_px):
            raise UsageError(
                f"The {source} mask is {region.shape[1]}x{region.shape[0]} pixels, "
                f"the images are {self.width_px}x{self.height_px}.",
                remedy="Give a mask of the size of the images.",
            )
        return replace(self, excluded={**self.excluded, source: np.asarray(region, dtype=bool)})

    def save(self, folder: Path, camera: str) -> list[Path]:
        """Write `<camera>.png` (white: usable) and one `<camera>_<source>.png` each (white: excluded)."""
        images = {camera: self.usable}
        images |= {f"{camera}_{source}": region for source, region in self.excluded.items()}
        written = []
        for stem, region in images.items():
            path = folder / f"{stem}.png"
            _, encoded = cv2.imencode(".png", region.astype(np.uint8) * 255)
            with atomic_path(path) as temporary:
                temporary.write_bytes(encoded.tobytes())
            written.append(path)
        return written


def mask_from_file(path: Path, width_px: int, height_px: int) -> CameraMask:
    """A mask drawn by hand: black pixels are excluded. Raises InputError, UsageError if the size is another."""
    image = picture_or_none(path)
    if image is None:
        raise InputError(
            f"{path} is not an image.",
            remedy="A mask is a PNG of the size of the images, black where excluded.",
        )
    return CameraMask(width_px, height_px).with_region("file", image < 128)


def pixel_grid(width_px: int, height_px: int) -> Array:
    """Centres of all pixels, row by row: (H * W, 2)."""
    x, y = np.meshgrid(np.arange(width_px, dtype=np.float64), np.arange(height_px, dtype=np.float64))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def beyond_lens(model: CameraModel, margin: float = np.deg2rad(1.0)) -> Mask:
    """(H, W), True where no ray of the model within `max_angle - margin` lands (margin in radians)."""
    bearings, valid = model.unproject(pixel_grid(model.width_px, model.height_px))
    valid &= np.nan_to_num(bearings[:, 2], nan=-1.0) > np.cos(min(model.max_angle - margin, np.pi))
    return np.asarray(~valid.reshape(model.height_px, model.width_px))


def beyond_image_circle(stream: CameraStream, frames: int = 20) -> Mask:
    """(H, W), True where a lens throws no light: what stays dark in all of the frames looked at, reaches the edge of
    the image and lies outside the convex hull of what does not, widened by 1 % of the image height. A lens lights a
    convex region; darkness between lit things is that of the scene. Nothing if the whole image stays dark, as at
    night."""
    indices = np.unique(np.linspace(0, max(len(stream) - 1, 0), frames).astype(np.int64))
    brightest = np.zeros((stream.height_px, stream.width_px), np.uint8)
    for frame in stream.frames(indices):
        np.maximum(brightest, cv2.blur(frame.image, (3, 3)), out=brightest)
    dark = brightest < _DARK
    if dark.mean() > 0.7:
        return np.zeros_like(dark)
    _, labels = cv2.connectedComponents(dark.astype(np.uint8))
    rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    outside = np.isin(labels, rim[rim > 0]) & ~_convex_hull(~dark)
    reach = 2 * max(stream.height_px // 100, 1) + 1
    return np.asarray(cv2.dilate(outside.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0)


def _convex_hull(region: Mask) -> Mask:
    """(H, W), True within the convex hull of a region without its specks."""
    solid = cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8))
    points = cv2.findNonZero(solid)
    filled = np.zeros(region.shape, np.uint8)
    if points is not None:
        cv2.fillConvexPoly(filled, cv2.convexHull(points), 1)
    return np.asarray(filled > 0)


def lens_mask(stream: CameraStream) -> CameraMask:
    """What the lens of a camera does not show, from its model (if known) and from its images, as `lens`."""
    region = beyond_image_circle(stream)
    if stream.model is not None:
        region |= beyond_lens(stream.model)
    return CameraMask(stream.width_px, stream.height_px).with_region("lens", region)


def inside(usable: Mask, pixels: Array) -> Mask:
    """Which pixels (N, 2) lie on the image and where `usable` is True: (N,)."""
    height, width = usable.shape
    nearest = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64)
    x, y = nearest[:, 0], nearest[:, 1]
    on_image = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.asarray(on_image & usable[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)])


def shrunk(region: Mask, by_px: int) -> Mask:
    """The region (H, W) without what lies within `by_px` of its outside; the edge of the image is no outside."""
    size = 2 * by_px + 1
    padded = np.pad(region.astype(np.uint8), by_px, constant_values=1)
    eroded = cv2.erode(padded, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    return np.asarray(eroded[by_px : by_px + region.shape[0], by_px : by_px + region.shape[1]] > 0)
