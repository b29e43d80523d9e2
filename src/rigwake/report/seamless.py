"""The seamless view in the report: what `rigwake surround OUT REC -o OUT/surround` left in the folder."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from rigwake.readers.picture_files import picture_or_none

_FOLDER = "surround"
_LARGEST_BYTES = 2**24
_WIDTH_PX = 1100


@dataclass(frozen=True)
class SeamRow:
    """One seam: its cameras, misalignment in pixels of a panorama 2048 px around and in degrees, median range of what
    was matched (metres), and how far colours differ (grey levels); None where unknown."""

    cameras: str
    px: float | None
    deg: float | None
    range_m: float | None
    colours: float | None


@dataclass(frozen=True)
class Seamless:
    """Pictures (title, data URI) and the seam table. to_blame: sentences. page: the seam report beside the report."""

    pictures: tuple[tuple[str, str], ...]
    rows: tuple[SeamRow, ...]
    to_blame: tuple[str, ...]
    page: str


def load_seamless(folder: Path) -> Seamless | None:
    """What is there; None if nothing is. Damaged files are left out."""
    place = folder / _FOLDER
    found = (("Panorama", "cylinder.jpg"), ("Top view with distance rings", "topdown.png"))
    pictures = [(title, uri) for title, name in found if (uri := _uri(place / name)) is not None]
    content = _json(place / "seams.json")
    if not pictures and not content:
        return None
    seams = [s for s in _list(content.get("seams")) if isinstance(s, Mapping)]
    cameras = [c for c in _list(content.get("cameras")) if isinstance(c, Mapping)]
    page = f"{_FOLDER}/seams.html" if (place / "seams.html").is_file() else ""
    return Seamless(
        tuple(pictures),
        tuple(_row(s) for s in seams),
        tuple(
            f"{c.get('name')} is turned against what the other cameras agree on"
            for c in cameras
            if c.get("is_to_blame") is True
        ),
        page,
    )


def _row(seam: Mapping[str, Any]) -> SeamRow:
    names = "|".join(str(name) for name in _list(seam.get("cameras")))
    keys = ("misalignment_px", "misalignment_deg", "median_range_m", "colour_difference")
    return SeamRow(names, *(_number(seam.get(key)) for key in keys))


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _json(path: Path) -> Mapping[str, Any]:
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            return {}
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, Mapping) else {}


def _uri(path: Path) -> str | None:
    image = picture_or_none(path, cv2.IMREAD_COLOR)
    if image is None:
        return None
    if image.shape[1] > _WIDTH_PX:
        height = round(image.shape[0] * _WIDTH_PX / image.shape[1])
        image = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
