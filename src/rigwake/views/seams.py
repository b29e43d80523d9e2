"""How well two cameras agree where they overlap: the visible proof of a calibration.

Around every seam both cameras are drawn into the same window of a panorama (2048 px around); corners of the one are
followed into the other. What remains between them is misalignment. A match is triangulated, so that every one has its
range, and matches that lie on or below the water (it mirrors) are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image
from rigwake.views.attitude import LevelAttitude
from rigwake.views.colour import ColourModel
from rigwake.views.frames import FrameSet
from rigwake.views.lookup import CoarseLookup, extended_pixels, interpolated_pixels
from rigwake.views.surface import Surface, level_directions
from rigwake.views.surround_rig import SurroundRig
from rigwake.views.surround_view import SurroundView
from rigwake.views.weights import camera_quality

PX_PER_RAD = 2048 / (2 * np.pi)
RANGE_EDGES_M = (3.0, 6.0, 15.0, 50.0, np.inf)
_HALF_WIDTH_DEG = 16.0
_TOP_DEG, _BOTTOM_DEG = 28.0, -36.0
_LEAST_OVERLAP_DEG = 4.0
_CORNERS = 200
_BACKWARD_PX = 0.4
_PATCH = 11
_CORRELATION = 0.75
_ABOVE_WATER_M = 0.25
_LEAST_ELEVATION = np.deg2rad(-1.0)  # of a match, where the height is unknown


@dataclass(frozen=True)
class SeamWindow:
    """A part of an equirectangular panorama of 2048 px around, as a projection."""

    equal_angles: ClassVar[bool] = True

    azimuth: float
    half_width: float
    top: float
    bottom: float

    @property
    def width_px(self) -> int:
        """Width of the window."""
        return round(2 * self.half_width * PX_PER_RAD)

    @property
    def height_px(self) -> int:
        """Height of the window."""
        return round((self.top - self.bottom) * PX_PER_RAD)

    def directions(self, pixels: Array) -> Array:
        """(N, 3) unit vectors in the level frame."""
        azimuth = self.azimuth - self.half_width + (pixels[:, 0] + 0.5) / PX_PER_RAD
        return level_directions(azimuth, self.top - (pixels[:, 1] + 0.5) / PX_PER_RAD)

    def points_level(self, pixels: Array, attitude: LevelAttitude, surface: Surface) -> Array:
        """As `ViewProjection.points_level`."""
        d = self.directions(pixels)
        return d * surface.range_m(d, attitude)[:, None]


@dataclass(frozen=True, eq=False)
class SeamMatches:
    """Matches across one seam.

    first, second: camera indices. azimuth: of the seam. directions: (N, 3) level frame, where the first camera's corner
    is drawn. misalignment_px: (N, 2) how far right and down the second camera draws the same thing. range_m: (N,)
    triangulated (infinite where the rays do not meet). bearings_first, bearings_second: (N, 3) unit vectors, rig axes.
    difference: mean absolute difference of the two pictures above the horizon, grey levels, colours corrected;
    difference_raw: the same of the pictures as they are; NaN where nothing can be compared.
    overlap_deg: width of the overlap at the horizon.
    """

    first: int
    second: int
    azimuth: float
    overlap_deg: float
    directions: Array
    misalignment_px: Array
    range_m: Array
    bearings_first: Array
    bearings_second: Array
    difference: float
    difference_raw: float


def overlapping_pairs(rig: SurroundRig, attitude: LevelAttitude) -> list[tuple[int, int, float, float]]:
    """Neighbours: first, second camera, azimuth in the middle of their overlap at the horizon, and its width (radians).

    Only pairs between which no third camera shows the middle better are neighbours.
    """
    azimuth = np.deg2rad(np.arange(-180.0, 180.0, 0.5))
    points = 1000.0 * level_directions(azimuth, np.zeros_like(azimuth))
    seen, along = [], []
    for model, cam_from_level in zip(rig.models, rig.cam_from_level(attitude.level_from_rig), strict=True):
        points_cam = cam_from_level * points
        pixels = extended_pixels(model, points_cam)
        _, valid = model.project(points_cam)
        margin = 0.02 * model.width_px
        inside = valid & (pixels >= margin).all(axis=1) & (pixels[:, 0] < model.width_px - margin)
        seen.append(inside & (pixels[:, 1] < model.height_px - margin))
        along.append(points_cam[:, 2] / np.linalg.norm(points_cam, axis=1))
    quality = np.where(np.array(seen), np.array(along), -2.0)
    pairs = []
    for a, b in combinations(range(len(rig)), 2):
        both = seen[a] & seen[b]
        if both.sum() * 0.5 < _LEAST_OVERLAP_DEG:
            continue
        gap = np.where(both, np.abs(quality[a] - quality[b]), np.inf)
        at = int(gap.argmin())
        if quality[:, at].max() > max(quality[a, at], quality[b, at]) + 1e-3:
            continue
        pairs.append((a, b, float(azimuth[at]), np.deg2rad(0.5 * _run_length(both, at))))
    return pairs


def _run_length(flags: NDArray[np.bool_], at: int) -> int:
    rolled = np.roll(flags, len(flags) // 2 - at)
    if rolled.all():
        return len(flags)
    middle = len(flags) // 2
    left = int(np.argmin(rolled[: middle + 1][::-1])) if not rolled[: middle + 1].all() else middle
    right = int(np.argmin(rolled[middle:])) if not rolled[middle:].all() else len(flags) - middle
    return left + right


class SeamMeter:
    """Measures all seams of frame sets. colour: undoes gains and vignetting before pictures are compared."""

    def __init__(self, rig: SurroundRig, colour: ColourModel | None = None) -> None:
        self._rig, self._colour, self._quality = rig, colour, camera_quality(rig)

    def measure(self, frames: FrameSet, attitude: LevelAttitude, surface: Surface) -> list[SeamMatches]:
        """Matches across every seam whose two cameras are there."""
        found = []
        for a, b, azimuth, overlap in overlapping_pairs(self._rig, attitude):
            if frames.is_missing[[a, b]].any():
                continue
            half = min(overlap / 2, np.deg2rad(_HALF_WIDTH_DEG))
            window = SeamWindow(azimuth, half, np.deg2rad(_TOP_DEG), np.deg2rad(_BOTTOM_DEG))
            found.append(self._seam(frames, attitude, surface, a, b, window, float(np.rad2deg(overlap))))
        return found

    def _seam(
        self,
        frames: FrameSet,
        attitude: LevelAttitude,
        surface: Surface,
        a: int,
        b: int,
        window: SeamWindow,
        overlap_deg: float,
    ) -> SeamMatches:
        view = SurroundView(
            self._rig, window, colour=self._colour, feather_deg=0.5, known_quality=self._quality
        )
        plain = SurroundView(self._rig, window, feather_deg=0.5, known_quality=self._quality)
        first, second = (drawn_alone(view, frames, attitude, surface, c) for c in (a, b))
        raw = [drawn_alone(plain, frames, attitude, surface, c) for c in (a, b)]
        start, end = followed_corners(first, second)
        rows = _Geometry(self._rig, attitude, view.lookup(attitude, surface), window, a, b).resolve(
            start, end
        )
        return SeamMatches(
            a,
            b,
            window.azimuth,
            overlap_deg,
            window.directions(start)[rows.kept],
            (end - start)[rows.kept],
            rows.range_m,
            rows.bearings_first,
            rows.bearings_second,
            _difference(first, second, window),
            _difference(raw[0], raw[1], window),
        )


def drawn_alone(
    view: SurroundView, frames: FrameSet, attitude: LevelAttitude, surface: Surface, camera: int
) -> Image:
    """What one camera alone shows in the view."""
    others = np.ones(len(view.rig), dtype=np.bool_)
    others[camera] = False
    names = {name: "left out" for name, lost in zip(view.rig.names, others, strict=True) if lost}
    only = FrameSet(frames.timestamp_ns, frames.names, frames.stack, names, frames.offsets_s)
    return view.picture(only, attitude, surface)


def followed_corners(first: Image, second: Image) -> tuple[Array, Array]:
    """Corners (N, 2) of the first picture and where the second shows them."""
    a, b = (cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in (first, second))
    seen = ((a > 0) & (b > 0)).astype(np.uint8)
    seen = cv2.erode(seen, np.ones((_PATCH + 4, _PATCH + 4), np.uint8), borderValue=0)
    corners = cv2.goodFeaturesToTrack(a, _CORNERS, 0.01, 5, mask=seen)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    there, found, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None, winSize=(15, 15), maxLevel=3)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, winSize=(15, 15), maxLevel=3)
    start, end = corners.reshape(-1, 2), there.reshape(-1, 2)
    good = (found.ravel() == 1) & (found_back.ravel() == 1)
    good &= np.linalg.norm(back.reshape(-1, 2) - start, axis=1) < _BACKWARD_PX
    inside = ((end > _PATCH) & (end < np.array(a.shape[::-1]) - _PATCH - 1)).all(axis=1)
    rows = np.flatnonzero(good & inside)
    alike = np.array([_correlation(a, b, start[k], end[k]) > _CORRELATION for k in rows], dtype=np.bool_)
    rows = rows[alike] if len(rows) else rows
    return start[rows].astype(np.float64), end[rows].astype(np.float64)


def _correlation(a: Image, b: Image, start: Array, end: Array) -> float:
    p, q = (
        cv2.getRectSubPix(x, (_PATCH, _PATCH), (float(at[0]), float(at[1]))).astype(np.float64)
        for x, at in ((a, start), (b, end))
    )
    p, q = p - p.mean(), q - q.mean()
    return float((p * q).sum() / np.sqrt(max((p * p).sum() * (q * q).sum(), 1e-9)))


@dataclass(frozen=True, eq=False)
class _Resolved:
    kept: NDArray[np.bool_]
    range_m: Array
    bearings_first: Array
    bearings_second: Array


@dataclass(frozen=True, eq=False)
class _Geometry:
    rig: SurroundRig
    attitude: LevelAttitude
    lookup: CoarseLookup
    window: SeamWindow
    first: int
    second: int

    def resolve(self, start: Array, end: Array) -> _Resolved:
        """Triangulate matches; those on the water or below it are left out."""
        rays, places = [], []
        valid = np.ones(len(start), dtype=np.bool_)
        for camera, at in ((self.first, start), (self.second, end)):
            pixels = interpolated_pixels(self.lookup, camera, at)
            bearings, good = self.rig.models[camera].unproject(pixels)
            valid &= good
            rays.append(np.nan_to_num(bearings) @ self.rig.rig_from_cam[camera].rotation.T)
            places.append(self.rig.rig_from_cam[camera].translation)
        a, b = rays
        baseline = places[1] - places[0]
        normal = np.cross(a, b)
        squared = np.maximum((normal**2).sum(axis=1), 1e-12)
        along_a = (np.cross(baseline, b) * normal).sum(axis=1) / squared
        along_b = (np.cross(baseline, a) * normal).sum(axis=1) / squared
        meets = (along_a > 0.3) & (along_b > 0.3) & (squared > (2e-4) ** 2)
        points = (places[0] + along_a[:, None] * a + places[1] + along_b[:, None] * b) / 2
        points_level = (points - self.rig.viewpoint_rig) @ self.attitude.level_from_rig.T
        elevation = np.arcsin(np.clip(self.window.directions(start)[:, 2], -1, 1))
        kept = valid & (elevation > _LEAST_ELEVATION)
        if np.isfinite(self.attitude.height_m):
            standing = meets & (points_level[:, 2] + self.attitude.height_m > _ABOVE_WATER_M)
            kept = valid & (kept | standing) & ~(meets & ~standing)
        distance = np.where(meets, np.hypot(points_level[:, 0], points_level[:, 1]), np.inf)
        return _Resolved(kept, distance[kept], a[kept], b[kept])


def _difference(first: Image, second: Image, window: SeamWindow) -> float:
    """Difference of the mean colours above the horizon, grey levels, mean over channels and patches of 4 degrees."""
    rows = int(window.top * PX_PER_RAD)
    a, b = first[:rows].astype(np.float64), second[:rows].astype(np.float64)
    seen = (a.max(axis=2) > 0) & (b.max(axis=2) > 0) & (np.maximum(a, b).max(axis=2) < 250)
    if seen.sum() < 200:
        return float("nan")
    step = round(np.deg2rad(4.0) * PX_PER_RAD)
    values, weights = [], []
    for i in range(0, a.shape[0], step):
        for j in range(0, a.shape[1], step):
            part = seen[i : i + step, j : j + step]
            if part.sum() < 50:
                continue
            mean = (a[i : i + step, j : j + step][part] - b[i : i + step, j : j + step][part]).mean(axis=0)
            values.append(np.abs(mean).mean())
            weights.append(part.sum())
    return float(np.average(values, weights=weights)) if values else float("nan")
