"""Water, obstacle and sky from colour and height alone: needs no network, finds little of what stands in the water.

Each class is a Gaussian in colour and texture with a prior that depends on the row; a few rounds of expectation
maximisation adapt them to the picture (after Kristan et al. 2015, *Fast image-based obstacle detection from unmanned
surface vehicles*). White and dark boats in front of mirrored quays look like neither class: expect to lose most.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Floats, Image

_ROUNDS = 4
_SMALL_PX = 320  # pictures are worked on at this width
_SPREAD = np.array([4.0, 3.0, 3.0, 3.0])  # least deviation of L, a, b and texture
_GUESSED_HORIZON = 0.45  # fraction of the rows from the top, where nobody knows it
_GUESSED_FIELD_DEG = 45.0  # over the rows


@dataclass(frozen=True)
class ColourClassifier:
    """A `PixelClassifier` without a network."""

    def probabilities(
        self,
        image: Image,
        is_seen: NDArray[np.bool_] | None = None,
        elevation_deg: Array | None = None,
        wraps: bool = False,
    ) -> Floats:
        """(3, H, W) probabilities in an (H, W, 3) BGR picture; see `SegmentationNetwork.probabilities`."""
        rows, columns = image.shape[:2]
        if elevation_deg is None:
            elevation_deg = (_GUESSED_HORIZON - (np.arange(rows) + 0.5) / rows) * _GUESSED_FIELD_DEG
        scale = min(_SMALL_PX / columns, 1.0)
        size = (max(round(columns * scale), 8), max(round(rows * scale), 8))
        seen = np.ones((rows, columns), np.bool_) if is_seen is None else is_seen
        small_seen = cv2.resize(seen.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).ravel() > 0
        features = _features(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        elevation = np.interp(
            (np.arange(size[1]) + 0.5) / size[1], (np.arange(rows) + 0.5) / rows, elevation_deg
        )
        prior = np.repeat(_prior(elevation)[:, :, None], size[0], axis=2).reshape(3, -1)
        belief = prior.copy()
        if small_seen.any():
            for _ in range(_ROUNDS):
                belief = _round(features, prior, belief, small_seen)
        planes = belief.reshape(3, size[1], size[0]).astype(np.float32)
        return np.stack([cv2.resize(plane, (columns, rows)) for plane in planes])


def _features(small: Image) -> Array:
    """(N, 4) L, a, b and texture."""
    lab = cv2.cvtColor(small, cv2.COLOR_BGR2LAB).astype(np.float64)
    across = cv2.Sobel(lab[..., 0], cv2.CV_64F, 1, 0)
    texture = np.sqrt(cv2.GaussianBlur(across**2, (0, 0), 2.0))
    return np.concatenate([lab, texture[..., None]], axis=2).reshape(-1, 4)


def _prior(elevation_deg: Array) -> Array:
    """(3, rows): water below the horizon, sky well above it, obstacles most likely around it."""
    below = 1 / (1 + np.exp(np.clip((elevation_deg + 0.5) / 0.6, -50, 50)))
    high = 1 / (1 + np.exp(np.clip(-(elevation_deg - 8) / 3, -50, 50)))
    near = 0.12 + 0.3 * np.exp(-((elevation_deg / 5) ** 2))
    water, sky = below * (1 - near), (1 - below) * (0.15 + 0.75 * high)
    obstacle = np.maximum(1 - water - sky, 0.02)
    return np.stack([water, obstacle, sky]) / (water + obstacle + sky)


def _round(features: Array, prior: Array, belief: Array, seen: NDArray[np.bool_]) -> Array:
    scores = np.empty_like(prior)
    for k in range(3):
        w = belief[k, seen]
        total = max(float(w.sum()), 1e-9)
        mean = w @ features[seen] / total
        off = features[seen] - mean
        covariance = (off * w[:, None]).T @ off / total + np.diag(_SPREAD**2)
        away = features - mean
        distance = np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
        scores[k] = (
            np.log(prior[k] + 1e-9) - 0.5 * np.minimum(distance, 60) - 0.5 * np.linalg.slogdet(covariance)[1]
        )
    scores -= scores.max(axis=0)
    found = np.exp(scores)
    return np.asarray(found / found.sum(axis=0))
