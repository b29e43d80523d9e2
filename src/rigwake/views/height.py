"""How high the cameras are above the water: from its ripples, or from waterlines of things whose distance is known.

A calibration does not hold it. Ripples that two cameras match tell it best (`ripples`); where the water is too smooth
or too far away, waterlines do. Where an upright thing at the horizontal distance D touches the water, its waterline is
seen at the depression `delta` from the viewpoint, and the height is `D tan(delta)`. Which level edge is a waterline is
not known beforehand: every level edge below something whose distance two cameras agree on votes, and only waterlines
agree on one height whatever their distance. Edges of wet stripes and of mirror images vote beside it; that is why the
standard deviation is never below 12 per cent. Waterlines that are known to be some (from stixels) go straight to
`height_from_contacts`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from rigwake._types import Array, Floats, Image, Mask
from rigwake.errors import EstimationError
from rigwake.views.attitude import LevelAttitude
from rigwake.views.frames import FrameSet
from rigwake.views.levelling import Leveller
from rigwake.views.ripples import RIPPLES_STD, height_of_ripples, ripple_heights
from rigwake.views.strips import StripGrid, camera_strips
from rigwake.views.surface import Shell
from rigwake.views.surround_rig import SurroundRig

_GRID = StripGrid(step_deg=0.25, top_deg=4.0, rows=88)
_INVERSE_M = np.linspace(1 / 22.0, 1 / 4.0, 28)  # farther away a degree of depression is too much height
_WINDOW = 9  # pixels, of the correlation
_CORRELATION = 0.8
_LEAST_EDGE = 25.0  # of a Sobel filter, in both cameras
_LEAST_DEPRESSION = np.deg2rad(1.5)
_LEAST_VOTES = 60
_WIDTH = 0.03  # of a kernel, relative to the height
_LEAST_FRACTION = 0.15  # of all votes that must lie within the mode
_HIGHER = 6  # rows
_UPRIGHT = 0.3  # of the growth that the water would show
_SETS = 6  # frame sets that are looked at
_UNKNOWN_EDGES_STD = 0.12  # relative: which edge the mode stands for; measured on two simulators


@dataclass(frozen=True)
class HeightEstimate:
    """Height of the viewpoint (mean of the cameras) above the mean water, its standard deviation, and the number of
    waterlines, or of points on ripples, it comes from (0: given). why_not_ripples: a sentence, where those were tried
    first."""

    height_m: float
    std_m: float
    contacts: int
    by_ripples: bool = False
    why_not_ripples: str = ""


def estimate_height(
    rig: SurroundRig,
    samples: Sequence[FrameSet],
    leveller: Leveller,
    masks: Mapping[str, Mask] | None = None,
) -> HeightEstimate:
    """The height that most ripples agree on, else the one that most waterlines agree on.

    masks: of the own vessel, by camera name. Raises EstimationError if neither stands out; it says why of both.
    """
    usable = [frames for frames in samples if (~frames.is_missing).sum() > 1]
    chosen = usable[:: max(len(usable) // _SETS, 1)][:_SETS]
    if not chosen:
        raise EstimationError("No two cameras have pictures.")
    seen = [(images, leveller.at(f.timestamp_ns, images)) for f in chosen if (images := f.images(rig))]
    tilt = seen[0][1].tilt_std
    try:
        heights = [ripple_heights(images, rig, attitude, masks) for images, attitude in seen]
        height, points = height_of_ripples(heights)
    except EstimationError as error:
        why_not = error.cause
    else:
        return HeightEstimate(height, height * float(np.hypot(RIPPLES_STD, tilt / 0.3)), points, True)
    edges = [edges_below_things(images, rig, attitude) for images, attitude in seen]
    try:
        found = height_from_contacts(*(np.concatenate([e[k] for e in edges]) for k in (0, 1)))
    except EstimationError as error:
        raise EstimationError(f"{why_not} {error.cause}", consequence=error.consequence) from error
    std = found.height_m * float(
        np.hypot(_UNKNOWN_EDGES_STD, tilt / 0.2)
    )  # edges are seen about 0.2 rad down
    return HeightEstimate(
        found.height_m, float(np.hypot(std, found.std_m)), found.contacts, why_not_ripples=why_not
    )


def height_from_contacts(distance_m: Array, depression: Array) -> HeightEstimate:
    """The mode of `distance tan(depression)` over (N,) contacts with the water, and its standard deviation.

    distance_m: horizontal, from the viewpoint. Contacts that are none (up to most of them) do not matter as long as
    they do not agree. Raises EstimationError with too few, or if no height stands out.
    """
    heights = distance_m * np.tan(depression)
    heights = heights[np.isfinite(heights) & (heights > 0.05)]
    if len(heights) < _LEAST_VOTES:
        raise EstimationError(
            f"Only {len(heights)} level edges have a range that two cameras agree on.",
            consequence="Nothing near enough stands in the water.",
        )
    logs = np.log(heights)
    grid = np.arange(logs.min() - 0.1, logs.max() + 0.1, _WIDTH / 4)
    counts = np.histogram(logs, np.append(grid, grid[-1] + _WIDTH / 4))[0].astype(np.float64)
    density = cv2.GaussianBlur(counts[None, :], (0, 0), 4.0, borderType=cv2.BORDER_CONSTANT)[0]
    mode = float(grid[int(density.argmax())] + _WIDTH / 8)
    for _ in range(5):
        near = np.abs(logs - mode) < 2 * _WIDTH
        mode = float(np.mean(logs[near]))
    near = np.abs(logs - mode) < 2 * _WIDTH
    if near.mean() < _LEAST_FRACTION:
        raise EstimationError(
            f"The level edges do not agree on one height (at most {100 * near.mean():.0f} % of them do).",
            consequence="Which of them are waterlines cannot be told.",
        )
    spread = max(float(logs[near].std()), 1e-3)
    # edges of one thing are alike: count them as a few
    independent = max(near.sum() / 30.0, 1.0)
    height = float(np.exp(mode))
    return HeightEstimate(height, height * spread / float(np.sqrt(independent)), int(near.sum()))


def edges_below_things(
    images: dict[str, Image], rig: SurroundRig, attitude: LevelAttitude
) -> tuple[Array, Array]:
    """Horizontal distances (N,) and depressions (N,) of level edges right below patches whose distance is known.

    Patches of neighbouring cameras are compared in strips drawn for 28 distances (plane sweep; normalised correlation,
    parabola through the best); the edge has to be seen by both cameras.
    """
    grey = {n: cv2.cvtColor(i, cv2.COLOR_BGR2GRAY) if i.ndim == 3 else i for n, i in images.items()}
    layers = []
    for inverse in _INVERSE_M:
        strips = camera_strips(grey, rig, attitude, Shell(1 / inverse), _GRID)
        layers.append({i: (strip[..., 0].astype(np.float32), np.isfinite(q)) for i, strip, q in strips})
    distances, depressions = [np.zeros(0)], [np.zeros(0)]
    for a, b in combinations(layers[0], 2):
        columns = np.flatnonzero((layers[0][a][1] & layers[0][b][1]).sum(axis=0) > _GRID.rows // 2)
        if len(columns) < 10:
            continue
        pictures = [(layer[a][0][:, columns], layer[b][0][:, columns]) for layer in layers]
        seen = [layer[a][1][:, columns] & layer[b][1][:, columns] for layer in layers]
        cost = np.array([_correlation(p, q, s) for (p, q), s in zip(pictures, seen, strict=True)])
        distance, depression = _edges(cost, pictures)
        distances.append(distance)
        depressions.append(depression)
    return np.concatenate(distances), np.concatenate(depressions)


def _correlation(a: Floats, b: Floats, seen: Mask) -> Floats:
    window = (_WINDOW, _WINDOW)
    mean_a, mean_b = cv2.blur(a, window), cv2.blur(b, window)
    variance_a = cv2.blur(a * a, window) - mean_a * mean_a
    variance_b = cv2.blur(b * b, window) - mean_b * mean_b
    product = cv2.blur(a * b, window) - mean_a * mean_b
    result = product / np.sqrt(np.maximum(variance_a, 4.0) * np.maximum(variance_b, 4.0))
    return np.asarray(np.where(seen, result, -1.0), dtype=np.float32)


def _is_upright(inverse: Array, clear: Mask, elevation: Array) -> Mask:
    """Where the distance is the same a little higher up; on the water it would have grown."""
    upright = np.zeros(clear.shape, dtype=np.bool_)
    change = np.abs(np.log(inverse[_HIGHER:] / inverse[:-_HIGHER]))
    slope = np.tan(np.minimum(elevation, -0.004))
    grown = np.log(slope[_HIGHER:] / slope[:-_HIGHER])[:, None]
    upright[_HIGHER:] = clear[_HIGHER:] & clear[:-_HIGHER] & (change < _UPRIGHT * grown)
    return upright


def _edges(cost: Floats, pictures: list[tuple[Floats, Floats]]) -> tuple[Array, Array]:
    """Edges half a window below pixels whose distance is clear."""
    best, value = cost.argmax(axis=0), cost.max(axis=0)
    inner = np.clip(best, 1, len(cost) - 2)
    before, at, after = (np.take_along_axis(cost, (inner + k)[None], 0)[0] for k in (-1, 0, 1))
    offset = np.clip(0.5 * (before - after) / np.minimum(before - 2 * at + after, -1e-6), -0.5, 0.5)
    inverse = _INVERSE_M[inner] + offset * (_INVERSE_M[1] - _INVERSE_M[0])
    clear = (value > _CORRELATION) & (best > 0) & (best < len(cost) - 1)
    reach = _WINDOW // 2 + 1
    elevation = _GRID.elevations()
    clear &= _is_upright(inverse, clear, elevation)
    distances, depressions = [], []
    for level in range(1, len(cost) - 1):
        rows, columns = np.nonzero(clear & (best == level))
        keep = (rows + reach + 1 < cost.shape[1]) & (rows + reach >= 1)
        rows, columns = rows[keep], columns[keep]
        if not len(rows):
            continue
        edge = np.minimum(*(np.abs(cv2.Sobel(p, cv2.CV_32F, 0, 1, ksize=3)) for p in pictures[level]))
        peak = cv2.dilate(edge, np.ones((7, 1), np.uint8))
        there = rows + reach
        strength = edge[there, columns]
        chosen = (strength >= _LEAST_EDGE) & (strength >= peak[there, columns])
        there, columns, rows = there[chosen], columns[chosen], rows[chosen]
        above, here, below = (edge[there + k, columns] for k in (-1, 0, 1))
        shift = np.clip(0.5 * (above - below) / np.minimum(above - 2 * here + below, -1e-6), -0.5, 0.5)
        depression = -elevation[there] + shift * np.deg2rad(_GRID.step_deg)
        distances.append(1 / inverse[rows, columns])
        depressions.append(depression)
    if not distances:
        return np.zeros(0), np.zeros(0)
    distance, depression = np.concatenate(distances), np.concatenate(depressions)
    low = depression > _LEAST_DEPRESSION
    return distance[low], depression[low]
