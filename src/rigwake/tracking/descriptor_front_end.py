"""Keypoints matched by descriptor from frame to frame: SIFT, FAST with BRIEF, ORB."""

from __future__ import annotations

from typing import Final

import numpy as np

from rigwake._types import Image, Indices, Mask
from rigwake.tracking.klt_front_end import Observed
from rigwake.tracking.matching import Keypoints, keypoint_detector, match_descriptors
from rigwake.tracking.tracking_options import FrontEndName, TrackingOptions

_STD_PX: Final[dict[FrontEndName, float]] = {"sift": 0.15, "orb": 0.45, "fast-brief": 0.5}
"""Standard deviation of a keypoint of the finest scale; measured in `benchmarks/tracking.py`."""


class DescriptorFrontEnd:
    """Matches the keypoints of each image with the latest sighting of every point still remembered."""

    def __init__(self, options: TrackingOptions) -> None:
        self.options = options
        self.detect = keypoint_detector(options.front_end, options.max_features, options.cell_px)
        self.next_id = 0
        self.forget()

    def forget(self) -> None:
        """Start anew: the next image does not continue the last one."""
        self.ids = np.empty(0, dtype=np.int64)
        self.ages = np.empty(0, dtype=np.int64)
        self.points = Keypoints(np.empty((0, 2)), np.empty(0), np.empty((0, 1), np.float32))

    def prepare(self, image: Image) -> Image:
        """Nothing can be done ahead: where keypoints are looked for differs from image to image."""
        return image

    def step(self, now: Image, usable: Mask, high: Mask | None = None) -> Observed:
        """Observations in the next image; `usable` (H, W) says where points may be; `high` makes no difference."""
        points = self.detect(now, usable)
        ids = np.full(len(points.pixels), -1)
        before, after = self._match(self.points, points)
        ids[after] = self.ids[before]
        new = ids < 0
        ids[new] = self.next_id + np.arange(new.sum())
        self.next_id += int(new.sum())

        unseen = np.setdiff1d(np.flatnonzero(self.ages < self.options.memory), before)
        self.points = _join(points, self.points, unseen)
        self.ids = np.concatenate([ids, self.ids[unseen]])
        self.ages = np.concatenate([np.zeros(len(ids), dtype=np.int64), self.ages[unseen] + 1])
        order = np.argsort(ids)
        return ids[order], points.pixels[order], _STD_PX[self.options.front_end] * points.scales[order]

    def _match(self, before: Keypoints, now: Keypoints) -> tuple[Indices, Indices]:
        options = self.options
        pairs = match_descriptors(
            before.descriptors, now.descriptors, matcher=options.matcher, max_ratio=options.max_ratio
        )
        moved = np.linalg.norm(now.pixels[pairs[:, 1]] - before.pixels[pairs[:, 0]], axis=1)
        kept = (moved >= options.min_displacement_px) & (moved <= options.max_displacement_px)
        return pairs[kept, 0], pairs[kept, 1]


def _join(first: Keypoints, second: Keypoints, chosen: Indices) -> Keypoints:
    if len(first.descriptors) == 0 or len(chosen) == 0:  # an empty one does not know its descriptors' kind
        return first if len(first.descriptors) else second.take(chosen)
    return Keypoints(
        np.concatenate([first.pixels, second.pixels[chosen]]),
        np.concatenate([first.scales, second.scales[chosen]]),
        np.concatenate([first.descriptors, second.descriptors[chosen]]),
    )
