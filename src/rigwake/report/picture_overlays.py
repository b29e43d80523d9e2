"""Images inside the page: reduced to a budget, with what the calibration predicts drawn over them as SVG."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from rigwake._types import Array
from rigwake.cameras.protocol import CameraModel
from rigwake.readers.picture_files import picture_or_none
from rigwake.report.content import OverlayPoint, Picture

BUDGET_BYTES = 8_000_000
_WIDTHS_PX = (960, 720, 540, 400, 300)
_PATCH_WIDTH_PX, _MOST_PATCHES = 480, 400
_QUALITY = 78
# unused grey, hull orange, water blue, sky light blue: BGRA
_MASK_COLOURS = np.array(
    [[0, 0, 0, 0], [120, 120, 120, 150], [0, 94, 213, 170], [178, 114, 0, 170], [233, 180, 86, 130]], np.uint8
)


@dataclass(frozen=True)
class EmbeddedPicture:
    """A picture as a data URI, its size in the recording, and its overlay in the pixels of that size.

    lines: the horizon's pieces as `points` of SVG polylines.
    """

    picture: Picture
    uri: str
    width_px: int
    height_px: int
    lines: tuple[str, ...]
    points: tuple[OverlayPoint, ...]
    median_px: float


def embed_pictures(pictures: Sequence[Picture]) -> tuple[list[EmbeddedPicture], list[str]]:
    """All pictures within the budget, and the names of those that cannot be read."""
    embedded, unreadable = [], []
    whole = sum(picture.kind != "patches" for picture in pictures)  # patches are small however many
    fraction = BUDGET_BYTES * 3 // 4 // max(whole, 1)  # base64 makes four bytes of three
    patches = 0
    for picture in pictures:
        patches += picture.kind == "patches"
        if picture.kind == "patches" and patches > _MOST_PATCHES:
            continue
        image = picture_or_none(picture.file, cv2.IMREAD_COLOR)
        if image is None:
            unreadable.append(picture.file.name)
            continue
        height_px, width_px = image.shape[:2]
        points = tuple(p for p in picture.points if np.isfinite([*p.predicted_px, *p.observed_px]).all())
        if picture.kind == "patches":
            if not picture.tile_px > 0 or len(points) != 1:
                unreadable.append(picture.file.name)
                continue
            width = min(width_px, _PATCH_WIDTH_PX)
            image = cv2.resize(image, (width, max(1, round(height_px * width / width_px))))
        embedded.append(
            EmbeddedPicture(
                picture,
                _uri(_jpeg_within(image, fraction), "jpeg"),
                width_px,
                height_px,
                _pieces(picture.horizon_px),
                points,
                _median(picture.points),
            )
        )
    return embedded, unreadable


def _jpeg_within(image: np.ndarray, fraction_bytes: int) -> bytes:
    """The widest of the sizes that fits, else the smallest."""
    encoded = b""
    for width in _WIDTHS_PX:
        scale = min(1.0, width / image.shape[1])
        size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        if len(encoded) <= fraction_bytes:
            break
    return encoded


def mask_uri(mask: np.ndarray) -> str:
    """A mask (values as in `ReportContent`) as a transparent PNG."""
    return _uri(
        cv2.imencode(".png", _MASK_COLOURS[np.minimum(mask, len(_MASK_COLOURS) - 1)])[1].tobytes(), "png"
    )


def _uri(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _pieces(line: Sequence[tuple[float, float]]) -> tuple[str, ...]:
    """Polylines of a horizon that NaN breaks into pieces."""
    pieces: list[list[str]] = [[]]
    for u, v in line:
        if np.isfinite([u, v]).all():
            pieces[-1].append(f"{u:.1f},{v:.1f}")
        elif pieces[-1]:
            pieces.append([])
    return tuple(" ".join(piece) for piece in pieces if len(piece) > 1)


def _median(points: Sequence[OverlayPoint]) -> float:
    errors = [
        np.hypot(p.predicted_px[0] - p.observed_px[0], p.predicted_px[1] - p.observed_px[1]) for p in points
    ]
    return float(np.median(errors)) if errors else float("nan")


def horizon_pixels(model: CameraModel, up_cam: Array) -> Array:
    """(N, 2) pixels of directions at right angles to `up_cam` (3,), in order round the horizon; NaN where the lens
    does not see it."""
    side = np.cross(up_cam, np.eye(3)[np.argmin(np.abs(up_cam))])
    side /= np.linalg.norm(side)
    ahead = np.cross(up_cam, side)
    angle = np.linspace(0, 2 * np.pi, 361)[:, None]
    pixels, valid = model.project(np.cos(angle) * ahead + np.sin(angle) * side)
    inside = valid & (pixels > -0.5).all(axis=1)
    inside &= (pixels < np.array([model.width_px, model.height_px]) - 0.5).all(axis=1)
    return np.asarray(np.where(inside[:, None], pixels, np.nan))
