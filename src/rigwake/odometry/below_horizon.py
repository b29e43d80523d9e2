"""Is it water that lies below the horizon, or ground? Decided from the images, before anything is tracked.

Ground and floors are rigid and keep their looks: points on them are followed as well as points above the horizon, and
agree with the same relative motion of the camera. Waves do neither. Measured over 0.3 s, what is found again and agrees
below the horizon, relative to above it: 0.29 to 0.49 at sea (eight cameras of two simulators), 0.51 to 0.75 on roads.
Where that cannot be told apart it is taken for water: points lost on ground cost less than points on waves. Where
hardly anything lies above the horizon, leaving out what lies below would leave nothing, and it is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from rigwake._types import Array, Indices, Mask
from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError
from rigwake.geometry.two_view import relative_pose
from rigwake.recording import CameraStream
from rigwake.tracking.features import detect_corners
from rigwake.tracking.klt import follow, pyramid
from rigwake.tracking.water import HorizonMask

HorizonChoice = Literal["auto", "on", "off"]
"""Whether what lies below the horizon is left out: decided from the images, always, never."""

_RIGID, _AGREE = 0.55, 0.85  # found again relative to above the horizon; agreeing, of those found again
_ALONE = 0.6  # found again and agreeing, where nothing above can be compared with
_WINDOWS, _SPAN_S, _FRAMES = 8, 0.3, 7  # looked at; how long points are followed, in how many images at most
_BELOW, _ABOVE = np.deg2rad(4.0), np.deg2rad(1.0)  # so far from the horizon: shores are near it
_CORNERS, _FEWEST, _FEWEST_IN_ALL = 120, 12, 60
_GATE_PX, _LEAST_MOTION_PX = 1.0, 1.5
_LEAST_VIEW = 0.02  # part of the image below the horizon, under which leaving it out changes nothing
_LEAST_ABOVE = 0.05  # part of the image above the horizon, under which leaving the rest out leaves nothing
_WINDOW_PX, _LEVELS = 21, 4  # of the search


@dataclass(frozen=True)
class BelowHorizon:
    """What was seen `(below, above)` the horizon: corners looked for, those found again, and those of them that agree
    with one motion of the camera. view: part of the image on either side."""

    corners: tuple[int, int]
    found: tuple[int, int]
    agree: tuple[int, int]
    view: tuple[float, float]

    @property
    def is_rigid(self) -> bool:
        """Whether what lies below is to be used: ground, or all that there is."""
        if self.view[1] < _LEAST_ABOVE:
            return True
        if self.found[0] < _FEWEST_IN_ALL or self.agree[0] < _AGREE * self.found[0]:
            return False
        below = self.agree[0] / self.corners[0]
        if self.corners[1] < _FEWEST_IN_ALL:
            return below >= _ALONE
        return below >= _RIGID * self.agree[1] / self.corners[1]

    @property
    def words(self) -> str:
        """What was decided, and from what."""
        if self.view[0] < _LEAST_VIEW:
            return "hardly any of the image lies below the horizon"
        if self.view[1] < _LEAST_ABOVE:
            return "the horizon is not in view: all of the image is used (--horizon on leaves out what lies below it)"
        low, high = (100 * a / max(n, 1) for a, n in zip(self.agree, self.corners, strict=True))
        seen = f"of the points below the horizon {low:.0f} % were found again and moved rigidly, above {high:.0f} %"
        if self.is_rigid:
            return f"{seen}: ground, used (--horizon on leaves it out)"
        return f"{seen}: left out as water (--horizon off uses it)"


def look_below_horizon(stream: CameraStream, up_cam: Array, usable: Mask) -> BelowHorizon:
    """Follow corners on both sides of the horizon in some short stretches, and count those that agree with one motion.

    up_cam: (F, 3) unit vectors against gravity in the camera's axes, NaN where not known. usable: (H, W).
    """
    assert stream.model is not None
    lower, upper = HorizonMask(stream.model, margin=-_BELOW), HorizonMask(stream.model, margin=_ABOVE)
    rng = np.random.default_rng(0)
    counts, views = np.zeros((3, 2), dtype=np.int64), []
    for window in _windows(stream):
        up = up_cam[window[0]]
        if not np.isfinite(up).all():
            continue
        above = usable & ~upper.below(up)
        regions = (usable & lower.below(up), above & ~upper.high(up))
        views.append([region.sum() / max(int(usable.sum()), 1) for region in (regions[0], above)])
        before, after, kept, side = _followed(stream, window, regions)
        agree = np.zeros(len(side), dtype=bool)
        agree[kept] = _agreeing(stream.model, before[kept], after[kept], rng)
        counts += [np.bincount(side[chosen], minlength=2) for chosen in (slice(None), kept, agree)]
    corners, found, agreed = ((int(a), int(b)) for a, b in counts)
    below, over = np.mean(views, axis=0).tolist() if views else (0.0, 1.0)
    return BelowHorizon(corners, found, agreed, (below, over))


def _windows(stream: CameraStream) -> list[Indices]:
    """Indices of frames, evenly spread over the recording and within each stretch."""
    if len(stream) < 3:
        return []
    period_s = max(float(np.median(np.diff(stream.timestamps_ns))) * 1e-9, 1e-3)
    steps = max(1, round(_SPAN_S / period_s))
    stride = max(1, round(steps / (_FRAMES - 1)))
    reach = stride * max(1, steps // stride)
    last = len(stream) - 1 - reach
    if last < 0:
        return []
    return [
        start + np.arange(0, reach + 1, stride)
        for start in np.unique(np.linspace(0, last, _WINDOWS).astype(int))
    ]


def _followed(
    stream: CameraStream, window: Indices, regions: tuple[Mask, Mask]
) -> tuple[Array, Array, Mask, Indices]:
    """Corners (n, 2) in the first image of the window, where they are in the last, which were followed, and in which
    region each lies. What stays put is left out: the own hull, or anything seen from a standstill."""
    images = [frame.image for frame in stream.frames(window)]
    nothing = np.empty((0, 2))
    if len(images) < 2:
        return nothing, nothing, np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64)
    detected = [
        detect_corners(
            images[0], region, nothing, wanted=_CORNERS, cell_px=48, min_distance_px=10, min_strength=400.0
        )
        for region in regions
    ]
    corners = np.concatenate(detected)
    side = np.repeat(np.arange(2), [len(part) for part in detected])
    pixels, kept = corners, np.ones(len(corners), dtype=bool)
    for earlier, later in pairwise(pyramid(image, _WINDOW_PX, _LEVELS) for image in images):
        landed, believed = follow(
            earlier, later, pixels, pixels, window_px=_WINDOW_PX, max_forward_backward_px=0.5
        )
        kept &= believed
        pixels = np.where(kept[:, None], landed, pixels)
    moved = ~kept | (np.linalg.norm(pixels - corners, axis=1) > _LEAST_MOTION_PX)
    return corners[moved], pixels[moved], kept[moved], side[moved]


def _agreeing(model: CameraModel, before: Array, after: Array, rng: np.random.Generator) -> Mask:
    """Which points (n, 2) agree with the relative motion that most of them agree with."""
    bearings_before, valid = model.unproject(before)
    bearings_after, still_valid = model.unproject(after)
    good = np.flatnonzero(valid & still_valid)
    agree = np.zeros(len(before), dtype=bool)
    if len(good) < _FEWEST:
        return agree
    try:
        found = relative_pose(
            bearings_before[good], bearings_after[good], max_angle=_GATE_PX / axis_focal_px(model), rng=rng
        )
    except EstimationError:
        return agree
    agree[good[found.inliers]] = True
    return agree
