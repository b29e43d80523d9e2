"""The second cue of the labels: does what two cameras match lie over the water plane, in it, or under it?

A point under the plane is a mirror image or glitter: water. Points over the plane stand on it, if they reach down to
it. A point alone proves nothing: ripples are matched by chance, now over the plane and now under it. So points count
by what most of them around a pixel say. What has texture but is not matched where two cameras look is hardly solid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Floats
from rigwake.views.attitude import LevelAttitude
from rigwake.views.depth.epipolar import MatchedPoints
from rigwake.views.depth.persistence import EarlierLooks
from rigwake.views.scene.segmentation import NOT_SEEN, OBSTACLE, WATER, Labels
from rigwake.views.strips import StripGrid

_WAVES_M = 0.15  # of the water about its plane, and of everything else that is not modelled
_TEXTURE = 4.0  # grey levels, below which a match proves nothing about the water
_BELOW_DEG = 0.6  # of elevation: higher up the plane is too far away
_CLEARLY = 2.0  # standard deviations
_UNDER_NATS, _OVER_NATS = 3.0, 2.5  # the most that points under and over the water say
_UNMATCHED_NATS = 1.0  # the most that textured places say which two cameras see and do not match
_PLANE_NATS = 0.7  # the most that points in the plane say about the far edge of the water
_AROUND_PX = 1.4  # standard deviation of the window
_FEW = 1.0  # points per pixel that say as much as nothing
_STANDS = 0.35  # balance from which a pixel stands on what is under it
_LEAST_PX = 8  # of a thing on the water
# nats by looks alone, mean over a thing: without support by height, with some, and with much
_SURE, _LIKELY, _POSSIBLE = 1.0, 0.3, -1.6
_FADED = 0.7  # nats by which a thing looked less like one at its place before
_SOME = 0.4  # points per pixel over the plane
_SUPPORTED, _SUPPORTED_PX = 0.25, 4  # share of a thing's pixels that stand, and their least number
_STRONG = 1.5  # points per pixel over the plane
_FOOT = 0.8  # of points in the plane, for each over it, right below a thing
_BOTH_NATS, _LOOKS_NATS = 6.0, 3.0  # of a thing as a whole, with support by height and without
_SOLID = 0.35  # share of what was tried that must be matched over the plane or in it
_LARGE_PX = 40  # smaller things are often not matched


@dataclass(frozen=True, eq=False)
class PlaneEvidence:
    """What matched points say about the water plane, per pixel (rows, columns) of a level strip.

    over, near, under: numbers of points clearly over the plane, near it and clearly under it, averaged over a window.
    tried: number of places where points might have been matched.
    """

    over: Floats
    near: Floats
    under: Floats
    tried: Floats

    @property
    def balance(self) -> Floats:
        """-1..1: points over the water less points under it, of all."""
        return np.asarray((self.over - self.under) / (self.over + self.near + self.under + _FEW), np.float32)

    @property
    def unmatched(self) -> Floats:
        """0..1: of what was tried, what was matched neither over the plane nor in it nor under it."""
        found = self.over + self.near + self.under
        return np.asarray((self.tried - found).clip(0) / (self.tried + _FEW), np.float32)

    def in_plane(self, grid: StripGrid, height_m: float) -> Floats:
        """0..1: of what was matched, what lies in the plane, where a row is so high that an upright thing would clearly
        rise above it from one row to the next: the far edge of the water."""
        down = np.tan(np.maximum(-grid.elevations(), 1e-3))
        rise = height_m / down * np.deg2rad(grid.step_deg)
        share = self.near / (self.over + self.near + self.under + _FEW)
        return np.where((rise > _WAVES_M)[:, None], share, 0).astype(np.float32)

    def standing(self) -> NDArray[np.bool_]:
        """Pixels over the water that reach down to it without a gap. What is matched by chance floats."""
        over = self.balance > _STANDS
        near = (self.near > self.over) & (self.near > self.under) & (self.near > _FEW)
        stands = np.zeros_like(over)
        for row in range(len(over) - 2, -1, -1):
            below = near[row + 1] | stands[row + 1]
            stands[row] = over[row] & (below | np.roll(below, 1) | np.roll(below, -1))
        return stands


def plane_evidence(
    matched: Sequence[MatchedPoints], grid: StripGrid, attitude: LevelAttitude
) -> PlaneEvidence:
    """What matched points say about the water plane; the height above it must be known."""
    points = np.concatenate([m.points_level for m in matched])
    distance = np.linalg.norm(points, axis=1)
    std = np.concatenate([m.inverse_std for m in matched]) * distance**2
    down = -points[:, 2] / distance
    uncertainty = np.sqrt(
        (std * down) ** 2 + (distance * attitude.tilt_std) ** 2 + attitude.height_std_m**2 + _WAVES_M**2
    )
    off = (attitude.height_m + points[:, 2]) / uncertainty
    clear = np.concatenate([m.texture for m in matched]) > _TEXTURE
    # waves travel: to a camera that matches its own earlier picture they may seem to rise from the water
    at_once = np.concatenate([np.full(len(m.texture), m.names[0] != m.names[1]) for m in matched])
    tried = np.concatenate([m.tried_level for m in matched])
    chosen = (
        clear & at_once & (off > _CLEARLY),
        clear & (np.abs(off) <= _CLEARLY),
        clear & (off < -_CLEARLY),
    )
    over, near, under = (_around(_counted(points[c], grid)) for c in chosen)
    return PlaneEvidence(over, near, under, _around(4 * _counted(tried, grid)))


def _counted(points: Array, grid: StripGrid) -> Floats:
    """(rows, columns) how many points lie in each pixel, of those well below the horizon."""
    at = np.round(grid.pixels(points / np.linalg.norm(points, axis=1)[:, None])).astype(np.int64)
    first = int(np.ceil(grid.horizon_row + _BELOW_DEG / grid.step_deg))
    inside = (at[:, 1] >= first) & (at[:, 1] < grid.rows)
    pixel = at[inside, 1] * grid.columns + at[inside, 0] % grid.columns
    size = grid.rows * grid.columns
    return np.bincount(pixel, minlength=size).reshape(grid.rows, grid.columns).astype(np.float32)


def _around(count: Floats) -> Floats:
    pad = int(4 * _AROUND_PX)
    wrapped = np.pad(count, ((0, 0), (pad, pad)), "wrap")
    return np.asarray(cv2.GaussianBlur(wrapped, (0, 0), _AROUND_PX)[:, pad:-pad], np.float32)


def tested_by_height(
    labels: Labels,
    matched: Sequence[MatchedPoints],
    grid: StripGrid,
    attitude: LevelAttitude,
    before: EarlierLooks | None,
) -> Labels:
    """Labels of a level strip, corrected by where matched points lie and by what was seen there before; unchanged
    where the height above the water is unknown."""
    if not (np.isfinite(attitude.height_m) and attitude.height_m > 0) or not matched:
        return labels
    evidence = plane_evidence(matched, grid, attitude)
    balance, standing = evidence.balance, evidence.standing()
    change = np.where(balance < 0, _UNDER_NATS * balance, np.where(standing, _OVER_NATS * balance, 0))
    change -= np.where(standing, 0, _UNMATCHED_NATS * evidence.unmatched)
    change -= np.where(standing, 0, _PLANE_NATS * evidence.in_plane(grid, attitude.height_m))
    logarithm = np.log(np.maximum(labels.probability, 1e-4))
    logarithm[OBSTACLE] += change
    return without_spurious_pieces(
        _relabelled(labels, logarithm), labels, evidence, grid, before, attitude.height_m
    )


def _relabelled(labels: Labels, logarithm: Floats) -> Labels:
    each = np.exp(logarithm - logarithm.max(axis=0))
    probability = (each / each.sum(axis=0)).astype(np.float32)
    classes = np.where(labels.classes == NOT_SEEN, NOT_SEEN, probability.argmax(axis=0)).astype(np.uint8)
    return Labels(classes, probability, labels.words)


def without_spurious_pieces(
    labels: Labels,
    looks: Labels,
    evidence: PlaneEvidence,
    grid: StripGrid,
    before: EarlierLooks | None = None,
    height_m: float = np.nan,
) -> Labels:
    """Labels without pieces of obstacle on open water that are too small, that too little speaks for or that looked
    more like water before; the others are sure in all their pixels.

    looks: the labels before any test by height. height_m: of the viewpoint above the water, for what was before.
    """
    obstacle = labels.classes == OBSTACLE
    number, count = numbered_around(obstacle)

    def total(values: NDArray[np.generic], of: NDArray[np.int32] = number) -> Array:
        return np.bincount(of.ravel(), values.ravel().astype(np.float64), count).astype(np.float64)

    area = np.maximum(total(obstacle), 1)
    far = (np.arange(grid.rows) < grid.horizon_row + _BELOW_DEG / grid.step_deg)[:, None]
    afloat = total(obstacle & far) == 0
    tried, standing = total(evidence.tried), evidence.standing()
    unmatched = (area >= _LARGE_PX) & (tried > area) & (total(evidence.over + evidence.near) < _SOLID * tried)
    # right below a thing that stands, the water is matched in its plane
    below = np.roll(number, 2, axis=0)
    below[:2] = 0
    below[obstacle] = 0
    stands = total(standing)
    supported = (
        (stands > np.maximum(_SUPPORTED * area, _SUPPORTED_PX))
        & (total(np.where(standing, evidence.over, 0)) > _STRONG * stands)
        & (total(evidence.near, below) > _FOOT * total(evidence.over, below))
    )
    odds = np.log(np.maximum(looks.probability, 1e-4))
    mean_odds = total(odds[OBSTACLE] - odds[WATER]) / area
    over, under = total(evidence.over), total(evidence.under)
    partly = (over > _SOME * area) & (under < over)
    likely = (mean_odds > np.where(partly, _LIKELY, _SURE)) & ~unmatched | (mean_odds > _POSSIBLE) & supported
    likely &= area >= _LEAST_PX
    if before is not None:
        # a moving boat is not where it was: what clearly looks like an obstacle now stays one
        then = before.mean_odds(number, count, grid, height_m)
        likely &= ~((mean_odds < _SURE) & (then < np.maximum(_POSSIBLE, mean_odds - _FADED)))
    likely[0], afloat[0] = True, False
    nats = np.where(likely, np.where(supported, _BOTH_NATS, _LOOKS_NATS), -_LOOKS_NATS)
    chosen = afloat[number]
    if not chosen.any():
        return labels
    logarithm = np.log(np.maximum(labels.probability, 1e-4))
    ratio = logarithm[OBSTACLE] - logarithm[WATER]
    wanted = np.where(likely[number], np.maximum(ratio, nats[number]), np.minimum(ratio, nats[number]))
    logarithm[OBSTACLE] += np.where(chosen, wanted - ratio, 0)
    return _relabelled(labels, logarithm)


def numbered_around(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """(H, W) numbers of connected pieces, those at the left and right edge joined (0: none); the number of numbers."""
    count, number = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    same = np.arange(count)
    for a, b in zip(number[:, -1], number[:, 0], strict=True):
        if a and b and same[a] != same[b]:
            same[same == same[a]] = same[b]
    return same[number].astype(np.int32), count
