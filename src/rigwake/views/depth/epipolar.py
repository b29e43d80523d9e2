"""Ranges from two cameras that see the same: equirectangular pictures with the pole on the baseline.

In such a pair a point lies in the same row of both pictures whatever its range, also beyond 90 degrees off the optical
axis. The columns are angles from the baseline; with `theta` of the first camera, `gamma` the difference of the two
angles (the parallax) and `T` the baseline, the range from the first camera is `T sin(theta + gamma) / sin(gamma)`. For
small angles and a disparity of d pixels of step s that is `Z = T f / d` with `f = 1 / s`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image, Mask
from rigwake.views.attitude import LevelAttitude
from rigwake.views.surround_rig import SurroundRig

_STEP = np.deg2rad(0.25)
_AROUND = np.deg2rad(np.array([-32.0, 26.0]))  # rows: about the baseline, from below the horizontal to above
_FROM_BASELINE = np.deg2rad(np.array([18.0, 162.0]))  # columns: nearer to the baseline nothing shows a range
_LEAST_BASELINE_M = 0.1
_LEAST_OVERLAP = 0.05  # of the pair's pixels that both cameras see
_COARSE = 8
_BLOCK = 5
_LAG_PX = 1.5  # between disparities found downwards and upwards
_DISPARITY_STD_PX = 0.45
_LEAST_TEXTURE = 2.5  # grey levels, standard deviation in a window
_FAR_OUTSIDE = -1e6


@dataclass(frozen=True, eq=False)
class MatchedPoints:
    """points_level: (N, 3) from the viewpoint, metres. inverse_std: (N,) standard deviation of the inverse range from
    the first camera, 1/m. texture: (N,) grey levels. names: the two cameras. tried_level: (M, 3) places on the water
    plane that both cameras look at and that have texture (every second pixel): whatever stands there would be matched.
    """

    points_level: Array
    inverse_std: Array
    texture: Array
    names: tuple[str, str]
    tried_level: Array = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class EpipolarPair:
    """Two cameras rectified together. directions: (rows, columns, 3) in the level frame. theta: (columns,) angles from
    the baseline, falling. baseline_m. origin_level: (3,) of the first camera."""

    first: int
    second: int
    directions: Array
    theta: Array
    baseline_m: float
    origin_level: Array


def epipolar_pairs(rig: SurroundRig, attitude: LevelAttitude) -> list[EpipolarPair]:
    """Every two cameras that see enough in common on either side of their baseline."""
    positions = rig.positions_level(attitude.level_from_rig)
    cams = rig.cam_from_level(attitude.level_from_rig)
    found = []
    for i, j in combinations(range(len(rig)), 2):
        baseline = positions[j] - positions[i]
        length = float(np.linalg.norm(baseline))
        if length < _LEAST_BASELINE_M or abs(baseline[2]) > 0.8 * length:
            continue
        pole = baseline / length
        for side in (1.0, -1.0):
            outward = side * np.cross([0.0, 0.0, 1.0], pole)
            outward /= np.linalg.norm(outward)
            if all(_sees(rig, k, cams[k].rotation @ outward) for k in (i, j)):
                found.append(_pair(i, j, pole, outward, length, positions[i]))
    return found


def _sees(rig: SurroundRig, index: int, ray_cam: Array) -> bool:
    """Whether a direction lies inside a camera's picture."""
    model = rig.models[index]
    pixels, valid = model.project(ray_cam[None])
    u, v = pixels[0]
    return bool(valid[0] and 0 <= u <= model.width_px - 1 and 0 <= v <= model.height_px - 1)


def _pair(i: int, j: int, pole: Array, outward: Array, length: float, origin: Array) -> EpipolarPair:
    up = np.cross(pole, outward)
    if up[2] < 0:
        up = -up
    around = np.arange(_AROUND[1], _AROUND[0], -_STEP)
    theta = np.arange(_FROM_BASELINE[1], _FROM_BASELINE[0], -_STEP)
    across = np.cos(around)[:, None, None] * outward + np.sin(around)[:, None, None] * up
    directions = np.cos(theta)[None, :, None] * pole + np.sin(theta)[None, :, None] * across
    return EpipolarPair(i, j, directions, theta, length, origin)


def match_pair(
    pair: EpipolarPair,
    images: Mapping[str, Image],
    rig: SurroundRig,
    attitude: LevelAttitude,
    masks: Mapping[str, Mask] | None = None,
    nearest_m: float = 3.0,
) -> MatchedPoints | None:
    """Points that both cameras of a pair see, by semi-global matching; None if they see too little in common.

    nearest_m: nothing nearer is looked for. Source of the matching: Hirschmueller (2008), as in OpenCV's `StereoSGBM`.
    """
    names = rig.names[pair.first], rig.names[pair.second]
    if any(name not in images for name in names):
        return None
    rotations = rig.cam_from_level(attitude.level_from_rig)
    views = []
    for index, name in zip((pair.first, pair.second), names, strict=True):
        rays_cam = pair.directions @ rotations[index].rotation.T
        mask = None if masks is None else masks.get(name)
        views.append(_rectified(rays_cam, images[name], rig, index, mask))
    (left, seen_left, _), (right, seen_right, _) = views
    if (seen_left & seen_right).mean() < _LEAST_OVERLAP:
        return None
    most = int(np.ceil(2 * np.arctan(pair.baseline_m / (2 * nearest_m)) / _STEP / 16)) * 16
    disparity = _semi_global(left, right, most)
    column = np.arange(left.shape[1])[None, :]
    partner = np.round(column - disparity).astype(np.int64)
    inside = (disparity > 0.5) & (partner >= 0)
    other = np.take_along_axis(seen_right, np.clip(partner, 0, left.shape[1] - 1), axis=1)
    texture = views[0][2]
    good = inside & other & seen_left & (texture > _LEAST_TEXTURE)
    gamma = np.where(good, disparity, 1.0) * _STEP
    theta = np.broadcast_to(pair.theta, gamma.shape)
    inverse = np.sin(gamma) / (pair.baseline_m * np.sin(np.minimum(theta + gamma, np.pi - 1e-3)))
    good &= (inverse > 1e-4) & (theta + gamma < np.pi - 0.1)
    std = _DISPARITY_STD_PX * _STEP / (pair.baseline_m * np.sin(np.clip(theta + gamma, 0.1, np.pi - 0.1)))
    points = pair.origin_level + pair.directions[good] / inverse[good][:, None]
    tried = _tried(pair, seen_left & (texture > _LEAST_TEXTURE), seen_right, attitude.height_m)
    return MatchedPoints(points, std[good], texture[good].astype(np.float64), names, tried)


def _tried(
    pair: EpipolarPair, clear: NDArray[np.bool_], seen_right: NDArray[np.bool_], height_m: float
) -> Array:
    """(M, 3) places on the water plane that `clear` pixels of the first camera look at and the second sees too."""
    directions, theta, clear = pair.directions[::2, ::2], pair.theta[None, ::2], clear[::2, ::2]
    height = height_m + pair.origin_level[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        range_m = np.where(directions[..., 2] < 0, height / -directions[..., 2], np.nan)
        # of the triangle of the two cameras and the place: the parallax
        gamma = np.arctan2(pair.baseline_m * np.sin(theta), range_m - pair.baseline_m * np.cos(theta))
    partner = np.arange(0, seen_right.shape[1], 2)[None, :] - gamma / _STEP
    inside = clear & (partner >= 0) & (partner < seen_right.shape[1])
    rows, columns = np.nonzero(inside)
    there = seen_right[
        2 * rows, np.round(partner[rows, columns]).astype(np.int64).clip(0, seen_right.shape[1] - 1)
    ]
    rows, columns = rows[there], columns[there]
    return np.asarray(pair.origin_level + directions[rows, columns] * range_m[rows, columns, None])


def _rectified(
    rays_cam: Array, image: Image, rig: SurroundRig, index: int, mask: Mask | None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]]:
    """The locally normalised picture, where it is seen, and its local deviation. Looked up exactly on every eighth
    pixel, linear between."""
    rows, columns = rays_cam.shape[:2]
    r = np.minimum(np.arange(-(-rows // _COARSE) + 1) * _COARSE, rows - 1)
    c = np.minimum(np.arange(-(-columns // _COARSE) + 1) * _COARSE, columns - 1)
    pixels, valid = rig.models[index].project(rays_cam[np.ix_(r, c)].reshape(-1, 3))
    pixels = np.where(valid[:, None], pixels, _FAR_OUTSIDE).reshape(len(r), len(c), 2)
    at_rows, at_columns = np.arange(rows) / _COARSE, np.arange(columns) / _COARSE
    grid = np.meshgrid(at_columns.astype(np.float32), at_rows.astype(np.float32))
    u, v = (cv2.remap(pixels[..., k].astype(np.float32), *grid, cv2.INTER_LINEAR) for k in (0, 1))
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    seen = (u >= 0) & (v >= 0) & (u <= grey.shape[1] - 1) & (v <= grey.shape[0] - 1)
    picture = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    if mask is not None:
        seen &= cv2.remap(mask.astype(np.uint8), u, v, cv2.INTER_NEAREST) == 0
    mean = cv2.blur(picture, (15, 15))
    deviation = np.sqrt(np.maximum(cv2.blur(picture**2, (15, 15)) - mean**2, 0))
    scaled = np.clip(128 + 40 * (picture - mean) / (deviation + 3), 0, 255)
    return scaled.astype(np.uint8), seen, deviation


def _semi_global(left: NDArray[np.uint8], right: NDArray[np.uint8], most: int) -> NDArray[np.float32]:
    """Disparities (H, W) of the left picture, -1 where none. The margin that SGBM leaves out is added and taken off.

    Of the three paths one comes from above and none from below: disparities lag behind where they change down the
    picture, on water by 0.3 px. Upside down they lag the other way, so the mean counts, where the two agree.
    """
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=most, blockSize=_BLOCK, P1=8 * _BLOCK**2, P2=32 * _BLOCK**2, disp12MaxDiff=1,
        uniquenessRatio=8, speckleWindowSize=60, speckleRange=2, mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    padded = [cv2.copyMakeBorder(p, 0, 0, most, 0, cv2.BORDER_REFLECT) for p in (left, right)]
    found = []
    for turn in (1, -1):
        pictures = [np.ascontiguousarray(p[::turn]) for p in padded]
        found.append(matcher.compute(*pictures)[::turn, most:].astype(np.float32) / 16)
    down, up = found
    agree = (down >= 0) & (up >= 0) & (np.abs(down - up) < _LAG_PX)
    return np.where(agree, (down + up) / 2, np.float32(-1))
