"""From pictures to stixels: level strip, labels, contacts refined in the native pictures, matched ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from rigwake._types import Array, Image, Mask
from rigwake.views.attitude import LevelAttitude
from rigwake.views.depth.depth_panorama import fuse_depth, matched_points
from rigwake.views.depth.height_check import tested_by_height
from rigwake.views.depth.motion import Earlier
from rigwake.views.depth.persistence import earlier_looks
from rigwake.views.scene.network import shipped_network
from rigwake.views.scene.segmentation import (
    OBSTACLE,
    WATER,
    Labels,
    PixelClassifier,
    SmoothedLabels,
    segment_strip,
)
from rigwake.views.scene.stixel_world import StixelWorld, find_stixels
from rigwake.views.strips import LevelStrip, StripGrid, level_strip
from rigwake.views.surface import SHELL_M, Surface, WaterAndShell, level_directions
from rigwake.views.surround_rig import SurroundRig

_REACH_DEG = 0.4  # a contact is looked for so far above and below
_FINE_DEG = 0.06
_PRIOR_DEG = 0.12  # deviation of the segmentation's edge
_LEAST_STEP = 12.0  # grey levels over the edge, summed over the channels


@dataclass
class StixelEstimator:
    """Stixels of consecutive frame sets. With `smooths` the labels are steadied by those before."""

    rig: SurroundRig
    classifier: PixelClassifier = field(default_factory=shipped_network)
    masks: Mapping[str, Mask] | None = None
    grid: StripGrid = field(default_factory=StripGrid)
    shell_m: float = SHELL_M
    uses_matches: bool = True

    def __post_init__(self) -> None:
        self._smoothed = SmoothedLabels(self.classifier)

    def estimate(
        self,
        images: Mapping[str, Image],
        attitude: LevelAttitude,
        timestamp_ns: int,
        earlier: Earlier | None = None,
    ) -> tuple[LevelStrip, Labels, StixelWorld]:
        """Strip, labels and stixels of the frame set that follows.

        images: by camera name. earlier: pictures that show ranges by motion.
        Raises UsageError if the height above the water is not known.
        """
        surface = WaterAndShell(self.shell_m)
        strip = level_strip(images, self.rig, attitude, surface, self.grid, self.masks, timestamp_ns)
        labels = segment_strip(strip, self.classifier)
        inverse: tuple[Array | None, Array | None] = (None, None)
        if self.uses_matches and (len(images) > 1 or earlier is not None):
            matched = matched_points(images, self.rig, attitude, self.masks, earlier=earlier)
            before = None
            if earlier is not None:
                before = earlier_looks(
                    earlier, self.rig, attitude, surface, self.grid, self.classifier, self.masks
                )
            labels = tested_by_height(labels, matched, self.grid, attitude, before)
            labels = self._smoothed.next(strip, labels)
            inverse = fuse_depth(matched, labels, self.grid, attitude, timestamp_ns).inverse_horizontal()
        else:
            labels = self._smoothed.next(strip, labels)
        shift = contact_shifts(labels, strip, images, self.rig, attitude)
        world = find_stixels(labels, self.grid, attitude, *inverse, shift, timestamp_ns=timestamp_ns)
        return strip, labels, world


def contact_shifts(
    labels: Labels, strip: LevelStrip, images: Mapping[str, Image], rig: SurroundRig, attitude: LevelAttitude
) -> Array:
    """(rows, columns) degrees by which feet of obstacles lie lower than the lower edges of their pixels.

    First the crossing of the class probabilities, then the strongest step in the native picture near it (0.06 deg
    instead of the strip's 0.4), where there is one.
    """
    grid = strip.grid
    shift = np.zeros(labels.classes.shape)
    foot = (labels.classes[:-1] == OBSTACLE) & (labels.classes[1:] == WATER)
    row, column = np.nonzero(foot)
    if not len(row):
        return shift
    odds = labels.probability[1] - labels.probability[0]
    above, below = odds[row, column], odds[row + 1, column]
    with np.errstate(invalid="ignore", divide="ignore"):
        crossing = np.where(
            above > below, above / (above - below), 0.5
        )  # rows below the centre of the upper pixel
    guess = (np.clip(crossing, 0, 1) - 0.5) * grid.step_deg
    shift[row, column] = guess
    elevation = grid.top_deg - (row + 1) * grid.step_deg - guess
    steps = np.arange(-_REACH_DEG, _REACH_DEG + 1e-9, _FINE_DEG)
    fine = np.deg2rad(elevation[:, None] - steps[None, :])
    directions = level_directions(grid.azimuths()[column][:, None], fine)
    camera = strip.camera[row + 1, column]
    for index, cam_from_level in enumerate(rig.cam_from_level(attitude.level_from_rig)):
        mine = np.flatnonzero(camera == index)
        image = images.get(rig.names[index])
        if image is None or not len(mine):
            continue
        rays = directions[mine].reshape(-1, 3)
        depth = WaterAndShell(200.0).range_m(rays, attitude)
        pixels, _ = rig.models[index].project(cam_from_level * (rays * depth[:, None]))
        u, v = (
            np.nan_to_num(pixels[:, k], nan=-1e6).astype(np.float32).reshape(len(mine), -1) for k in (0, 1)
        )
        profile = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
        profile = profile.reshape(len(mine), len(steps), -1)
        step = np.abs(profile[:, 2:] - profile[:, :-2]).sum(axis=2) * (3 / profile.shape[2])
        score = step * np.exp(-0.5 * (steps[1:-1] / _PRIOR_DEG) ** 2)
        best = score.argmax(axis=1)
        clear = step[np.arange(len(mine)), best] > _LEAST_STEP
        moved = np.where(clear, steps[1:-1][best], 0.0)
        shift[row[mine], column[mine]] += moved
    return shift


@dataclass
class StixelSurface:
    """Stixels as what views are drawn on (`SurfaceSource`)."""

    shell_m: float = SHELL_M
    _estimator: StixelEstimator | None = field(init=False, default=None)

    def surface(
        self, images: Mapping[str, Image], rig: SurroundRig, attitude: LevelAttitude, timestamp_ns: int
    ) -> Surface:
        """As `SurfaceSource.surface`."""
        if self._estimator is None or self._estimator.rig is not rig:
            self._estimator = StixelEstimator(rig, shell_m=self.shell_m)
        return self._estimator.estimate(images, attitude, timestamp_ns)[2].surface(self.shell_m)


def stixel_surface_source(shell_m: float = SHELL_M) -> StixelSurface:
    """The source that `--surface stixels` names."""
    return StixelSurface(shell_m)
