"""How good a segmentation is, against labels: IoU, the water edge, obstacles by pixel and by object.

The mean IoU alone proves nothing: a straight cut along the horizon scores 0.8 to 0.9. What counts is what stands below
the horizon. Measures follow MODS (Bovcon et al. 2021, *MODS: a USV-oriented object detection and obstacle segmentation
benchmark*), in degrees instead of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.views.scene.segmentation import NOT_SEEN, OBSTACLE, SKY, WATER

ClassMap = NDArray[np.uint8]
BELOW_DEG = 1.5  # obstacles are counted this far below the horizon
_LEAST_DEG = 1.0  # width of an object that must be found
_FOUND = 0.5  # of an object's pixels
_EDGE_DEG = 0.8  # an outline that is off by less is an error of the edge, not another object
DANGER_M = 15.0


@dataclass(frozen=True)
class LabelMeasures:
    """Of one or several pictures together; NaN where there is nothing to measure.

    iou: water, obstacle, sky. water_edge_deg: RMSE over the columns. recall, precision: of obstacle pixels more than
    1.5 deg below the horizon. objects_found, objects, false_objects: connected pieces there, at least 1 deg wide; false
    are those of which more than half lies farther than 0.8 deg from every true obstacle.
    f1, f1_danger: of objects, everywhere below the horizon and where the water is nearer than 15 m. pictures: number.
    """

    iou: tuple[float, float, float]
    water_edge_deg: float
    recall: float
    precision: float
    objects_found: int
    objects: int
    false_objects: int
    f1: float
    f1_danger: float
    pictures: int

    @property
    def mean_iou(self) -> float:
        """Mean over the classes that occur."""
        known = [value for value in self.iou if np.isfinite(value)]
        return float(np.mean(known)) if known else np.nan


@dataclass
class LabelComparison:
    """Collects counts over pictures of one angular step."""

    step_deg: float
    pictures: int = 0

    def __post_init__(self) -> None:
        self._hits = np.zeros((3, 3))  # intersection, predicted, true per class
        self._edge: list[Array] = []
        self._below = np.zeros(3)  # true positive, predicted, true
        self._objects = np.zeros((2, 3), int)  # everywhere, danger zone: found, true, false

    def add(
        self,
        found: ClassMap,
        truth: ClassMap,
        elevation_deg: Array,
        height_m: float = np.nan,
        wraps: bool = False,
    ) -> None:
        """One picture: classes (H, W) found and true, elevations (H,) of its rows, height above the water."""
        scored = (truth != NOT_SEEN) & (found != NOT_SEEN)
        for c in (WATER, OBSTACLE, SKY):
            f, t = (found == c) & scored, (truth == c) & scored
            self._hits[c] += (f & t).sum(), f.sum(), t.sum()
        edges = [water_edge_rows(np.where(scored, m, NOT_SEEN).astype(np.uint8)) for m in (found, truth)]
        self._edge.append((edges[0] - edges[1]) * self.step_deg)
        below = (elevation_deg < -BELOW_DEG)[:, None] & scored
        f, t = (found == OBSTACLE) & below, (truth == OBSTACLE) & below
        self._below += (f & t).sum(), f.sum(), t.sum()
        size = 2 * round(_EDGE_DEG / self.step_deg) + 1
        around = cv2.dilate((truth == OBSTACLE).astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        self._objects[0] += self._count(f, t, around, wraps)
        if np.isfinite(height_m):
            near = (elevation_deg < -np.rad2deg(np.arctan2(height_m, DANGER_M)))[:, None]
            self._objects[1] += self._count(f & near, t & near, around, wraps)
        self.pictures += 1

    def _count(
        self, found: NDArray[np.bool_], truth: NDArray[np.bool_], around: NDArray[np.bool_], wraps: bool
    ) -> tuple[int, int, int]:
        hits, real = self._pieces(truth, found, wraps)
        right, said = self._pieces(found, around, wraps)
        return hits, real, said - right

    def _pieces(self, pieces: NDArray[np.bool_], other: NDArray[np.bool_], wraps: bool) -> tuple[int, int]:
        """How many connected pieces are covered by the other, and how many there are, of those wide enough."""
        columns = pieces.shape[1]
        if wraps:
            free = np.flatnonzero(~pieces.any(axis=0))
            turn = -int(free[0]) if len(free) else 0
            pieces, other = np.roll(pieces, turn, axis=1), np.roll(other, turn, axis=1)
        count, numbered, stats, _ = cv2.connectedComponentsWithStats(pieces.astype(np.uint8), connectivity=8)
        covered = np.bincount(numbered[other], minlength=count)
        wide = stats[:, cv2.CC_STAT_WIDTH] >= min(max(_LEAST_DEG / self.step_deg, 1), columns)
        wide &= stats[:, cv2.CC_STAT_AREA] >= 3
        wide[0] = False
        return int((covered[wide] >= _FOUND * stats[wide, cv2.CC_STAT_AREA]).sum()), int(wide.sum())

    def measures(self) -> LabelMeasures:
        """Over all pictures so far."""
        with np.errstate(invalid="ignore", divide="ignore"):
            union = self._hits[:, 1] + self._hits[:, 2] - self._hits[:, 0]
            iou = np.where(self._hits[:, 2] > 0, self._hits[:, 0] / union, np.nan)
            recall, precision = self._below[0] / self._below[2], self._below[0] / self._below[1]
            f1 = [2 * o[0] / (2 * o[0] + o[2] + o[1] - o[0]) for o in self._objects.astype(float)]
        edge = np.concatenate(self._edge) if self._edge else np.zeros(0)
        edge = edge[np.isfinite(edge)]
        rmse = float(np.sqrt(np.mean(edge**2))) if len(edge) else np.nan
        water, obstacle, sky = (float(v) for v in iou)
        hit, real, wrong = (int(v) for v in self._objects[0])
        return LabelMeasures(
            (water, obstacle, sky), rmse, float(recall), float(precision), hit, real, wrong, float(f1[0]),
            float(f1[1]), self.pictures,
        )  # fmt: skip


def water_edge_rows(classes: ClassMap) -> Array:
    """(W,) row (a fraction) at which the water that begins at the lowest seen pixel of each column ends above; NaN
    where the lowest is not water."""
    rows, _ = classes.shape
    upward = classes[::-1]
    lowest = np.argmax(upward != NOT_SEEN, axis=0)
    stop = (upward != WATER) & (np.arange(rows)[:, None] >= lowest)
    first = np.where(stop.any(axis=0), np.argmax(stop, axis=0), rows)
    return np.where(first > lowest, rows - first - 0.5, np.nan)


def flat_horizon(truth: ClassMap, elevation_deg: Array) -> ClassMap:
    """The baseline: all below the horizon is water, and above it everything is known."""
    flat = truth.copy()
    flat[(elevation_deg < 0)[:, None] & (truth != NOT_SEEN)] = WATER
    return flat
