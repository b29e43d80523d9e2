"""Water, obstacle and sky: in level strips of a calibrated rig, and in plain pictures; smoothed over time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Floats, Image
from rigwake.views.strips import LevelStrip, StripGrid

WATER, OBSTACLE, SKY, NOT_SEEN = 0, 1, 2, 255
COLOURS = ((190, 110, 30), (40, 70, 230), (200, 200, 110))  # BGR of the classes in overlays
_LONG_SIDE_PX = 448  # of a plain picture, as the network sees it: angular steps of about 0.13 degrees
_LEAST = 1e-4  # probability
_MEMORY = 0.45  # weight of the smoothed past
_CHANGED = 24.0  # grey levels: where a pixel changed by more, its past says nothing
_BAND_DEG = (12.0, -1.0)  # of elevation: what stands there shows how far the boat has turned
_MOST_TURN_DEG = 12.0  # from one picture to the next
_DARK = 25.0  # mean grey of a picture in which little can be told


@dataclass(frozen=True, eq=False)
class Labels:
    """classes: (H, W) uint8: 0 water, 1 obstacle, 2 sky, 255 not seen. probability: (3, H, W) float32 of the three;
    1/3 each where nothing is seen. words: why they deserve little trust; empty if nothing speaks against them."""

    classes: NDArray[np.uint8]
    probability: Floats
    words: str = ""

    @property
    def confidence(self) -> Floats:
        """(H, W) probability of the class given, 0 where nothing is seen."""
        return np.where(self.classes == NOT_SEEN, np.float32(0), self.probability.max(axis=0))

    @property
    def mean_confidence(self) -> float:
        """Over what is seen; 0 if that is nothing."""
        seen = self.classes != NOT_SEEN
        return float(self.confidence[seen].mean()) if seen.any() else 0.0


class PixelClassifier(Protocol):
    """What gives probabilities of the classes: a network, or the colour method."""

    def probabilities(
        self,
        image: Image,
        is_seen: NDArray[np.bool_] | None = None,
        elevation_deg: Array | None = None,
        wraps: bool = False,
    ) -> Floats:
        """(3, H, W) probabilities in an (H, W, 3) BGR picture; see `SegmentationNetwork.probabilities`."""


def segment_strip(strip: LevelStrip, classifier: PixelClassifier) -> Labels:
    """Labels (rows, columns) of a level strip; where the own vessel or nothing is seen: 255."""
    elevation = np.rad2deg(strip.grid.elevations())
    probability = classifier.probabilities(strip.image, strip.is_seen, elevation, wraps=True)
    return labels_of(probability, strip.is_seen, strip.image)


def segment_image(
    image: Image,
    classifier: PixelClassifier,
    is_seen: NDArray[np.bool_] | None = None,
    long_side_px: int = _LONG_SIDE_PX,
) -> Labels:
    """Labels (H, W) of a picture (H, W) grey or (H, W, 3) BGR of an ordinary lens, horizon unknown."""
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    rows, columns = colour.shape[:2]
    scale = min(long_side_px / max(rows, columns), 1.0)
    size = (max(round(columns * scale), 8), max(round(rows * scale), 8))
    small = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
    seen = np.ones((rows, columns), np.bool_) if is_seen is None else is_seen
    small_seen = cv2.resize(seen.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
    coarse = classifier.probabilities(small, small_seen)
    probability = np.stack(
        [cv2.resize(plane, (columns, rows), interpolation=cv2.INTER_LINEAR) for plane in coarse]
    )
    return labels_of(probability, seen, colour)


def labels_of(probability: Floats, is_seen: NDArray[np.bool_], image: Image) -> Labels:
    """Labels of probabilities (3, H, W), with words where the picture is too dark to tell much."""
    classes = probability.argmax(axis=0).astype(np.uint8)
    classes[~is_seen] = NOT_SEEN
    probability = np.where(is_seen, probability, np.float32(1 / 3))
    words = ""
    if not is_seen.any():
        words = "nothing is seen"
    elif float(image[is_seen].mean()) < _DARK:
        words = "too dark to tell much"
        probability = (0.5 * probability + 0.5 / 3).astype(np.float32)
    return Labels(classes, probability, words)


@dataclass
class SmoothedLabels:
    """Labels of consecutive level strips of one grid, steadied by those before.

    The past is turned by as much as what stands near the horizon has moved (roll and pitch are already out of a level
    strip), and counts only where the picture has not changed.
    """

    classifier: PixelClassifier
    _logarithm: Floats | None = field(init=False, default=None)
    _grey: Floats | None = field(init=False, default=None)

    def next(self, strip: LevelStrip, fresh: Labels | None = None) -> Labels:
        """Labels of the strip that follows. fresh: what it shows alone, if that is already known."""
        fresh = fresh or segment_strip(strip, self.classifier)
        grey = cv2.cvtColor(strip.image, cv2.COLOR_BGR2GRAY).astype(np.float32)
        grey[~strip.is_seen] = 0
        logarithm = np.log(np.maximum(fresh.probability, _LEAST))
        if self._logarithm is not None and self._grey is not None and self._grey.shape == grey.shape:
            turn = turned_columns(self._grey, grey, strip.grid)
            past, before = np.roll(self._logarithm, turn, axis=2), np.roll(self._grey, turn, axis=1)
            change = cv2.GaussianBlur(np.abs(grey - before), (0, 0), 1.5)
            weight = _MEMORY * np.clip(1 - change / _CHANGED, 0, 1)
            logarithm = (1 - weight) * logarithm + weight * past
        self._logarithm, self._grey = logarithm.astype(np.float32), grey
        probability = np.exp(logarithm - logarithm.max(axis=0))
        probability = (probability / probability.sum(axis=0)).astype(np.float32)
        steadied = labels_of(probability, strip.is_seen, strip.image)
        return Labels(steadied.classes, steadied.probability, fresh.words)


def turned_columns(before: Floats, after: Floats, grid: StripGrid) -> int:
    """By how many columns what stands near the horizon moved to the right, from the circular correlation of (H, W) grey
    strips' column differences."""
    elevation = np.rad2deg(grid.elevations())
    band = (elevation < _BAND_DEG[0]) & (elevation > _BAND_DEG[1])
    rows = [np.diff(strip[band], axis=1, append=strip[band][:, :1]) for strip in (before, after)]
    spectra = [np.fft.rfft(np.clip(row, -40, 40), axis=1) for row in rows]
    score = np.fft.irfft((spectra[1] * spectra[0].conj()).sum(axis=0), before.shape[1])
    shift = (np.arange(len(score)) + len(score) // 2) % len(score) - len(score) // 2
    near = np.abs(shift) * grid.step_deg <= _MOST_TURN_DEG
    best = int(np.argmax(np.where(near, score, -np.inf)))
    return int(shift[best]) if score[best] > 0 else 0


def overlay(image: Image, labels: Labels, strength: float = 0.4) -> Image:
    """The picture with the classes over it, the water's edge in yellow."""
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    painted = np.zeros((256, 3), np.uint8)
    painted[: len(COLOURS)] = COLOURS
    seen = labels.classes != NOT_SEEN
    mixed = cv2.addWeighted(colour, 1 - strength, painted[labels.classes], strength, 0)
    colour[seen] = mixed[seen]
    water = (labels.classes == WATER).astype(np.uint8)
    outlines, _ = cv2.findContours(water, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(colour, outlines, -1, (0, 235, 255), 1)
    return colour
