"""Keypoints with descriptors, and how they are matched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._tables import take_rows
from rigwake._types import Array, Image, Mask
from rigwake.errors import UsageError
from rigwake.tracking.features import balanced
from rigwake.tracking.tracking_options import FrontEndName, MatcherName

Descriptors = NDArray[np.uint8] | NDArray[np.float32]

_SURPLUS = 4  # so many times more keypoints are detected than kept, so that there is a choice per cell
_FLANN_KD_TREE, _FLANN_LSH = 1, 6


@dataclass(frozen=True, eq=False)
class Keypoints:
    """pixels: (N, 2). scales: (N,) size relative to the finest the detector knows. descriptors: (N, D)."""

    pixels: Array
    scales: Array
    descriptors: Descriptors

    def take(self, index: NDArray[np.int64]) -> Keypoints:
        """The chosen keypoints."""
        return take_rows(self, index)


Detector = Callable[[Image, Mask], Keypoints]


def keypoint_detector(front_end: FrontEndName, max_features: int, cell_px: int) -> Detector:
    """The detector and descriptor of a front end, keeping `max_features` keypoints balanced over a grid."""
    detector: Any
    extractor: Any
    if front_end == "sift":
        detector = extractor = cv2.SIFT.create(_SURPLUS * max_features)
        finest = 1.6
    elif front_end == "orb":
        detector = extractor = cv2.ORB.create(_SURPLUS * max_features)
        finest = 31.0
    elif front_end == "fast-brief":
        detector, extractor, finest = cv2.FastFeatureDetector.create(threshold=15), _brief(), 7.0
    else:
        raise UsageError(f"The front end {front_end} has no descriptors.")

    def detect(image: Image, usable: Mask) -> Keypoints:
        found = sorted(
            detector.detect(image, usable.astype(np.uint8) * 255),
            key=lambda k: (-k.response, k.pt, k.size, k.angle),
        )
        pixels = np.array([k.pt for k in found], dtype=np.float64).reshape(-1, 2)
        order = balanced(pixels, np.empty((0, 2)), image.shape[1], cell_px)[:max_features]
        kept, descriptors = extractor.compute(image, [found[i] for i in order])
        if descriptors is None:
            descriptors = np.empty((0, 1), np.float32)
        return Keypoints(
            np.array([k.pt for k in kept], dtype=np.float64).reshape(-1, 2),
            np.array([max(k.size / finest, 1.0) for k in kept]),
            descriptors,
        )

    return detect


def _brief() -> Any:
    if not hasattr(cv2, "xfeatures2d"):
        raise UsageError(
            "This OpenCV has no BRIEF descriptor.",
            remedy="Install opencv-contrib-python-headless in place of opencv-python, or use another front end.",
        )
    return cv2.xfeatures2d.BriefDescriptorExtractor.create()


def match_descriptors(
    first: Descriptors, second: Descriptors, *, matcher: MatcherName, max_ratio: float
) -> NDArray[np.int64]:
    """Pairs (M, 2) of rows of two descriptor arrays: best match, Lowe's ratio test, each row used once.

    Float descriptors are compared by L2, binary (uint8) ones by Hamming distance. Rows come in increasing order
    of the first. FLANN is approximate: it may miss matches.
    """
    if len(first) == 0 or len(second) < 2:
        return np.empty((0, 2), dtype=np.int64)
    candidates = _matcher(matcher, binary=first.dtype == np.uint8).knnMatch(first, second, k=2)
    best: dict[int, tuple[float, int]] = {}
    for pair in candidates:
        if len(pair) < 2 or pair[0].distance >= max_ratio * pair[1].distance:
            continue
        claim = (float(pair[0].distance), int(pair[0].queryIdx))
        target = int(pair[0].trainIdx)
        if target not in best or claim < best[target]:
            best[target] = claim
    pairs = sorted((query, target) for target, (_, query) in best.items())
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _matcher(matcher: MatcherName, *, binary: bool) -> Any:
    if matcher == "brute-force":
        return cv2.BFMatcher(cv2.NORM_HAMMING if binary else cv2.NORM_L2)
    if binary:
        index = {"algorithm": _FLANN_LSH, "table_number": 6, "key_size": 12, "multi_probe_level": 1}
    else:
        index = {"algorithm": _FLANN_KD_TREE, "trees": 5}
    return cv2.FlannBasedMatcher(index, {"checks": 50})
