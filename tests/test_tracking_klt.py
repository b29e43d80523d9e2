"""Lucas-Kanade between two images: against known motion and OpenCV."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rigwake import parallel
from rigwake._types import Array
from rigwake.tracking.klt import follow, pyramid
from tracking_scene import random_texture

WINDOW_PX, LEVELS = 21, 4
GRID = np.stack(np.meshgrid(np.arange(3.0, 318, 15), np.arange(3.0, 238, 15)), axis=-1).reshape(-1, 2)


def warped(matrix: Array) -> NDArray[np.uint8]:
    texture = cv2.GaussianBlur(random_texture(3)[200:600, 200:700], (0, 0), 1.0)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.clip(cv2.warpAffine(texture, matrix, (320, 240), flags=flags), 0, 255).astype(np.uint8)


BEFORE = warped(np.array([[1.0, 0, 50], [0, 1, 50]]))


def followed(before: NDArray[np.uint8], after: NDArray[np.uint8], start: Array, guess: Array) -> tuple:
    scales = [pyramid(image, WINDOW_PX, LEVELS) for image in (before, after)]
    return follow(*scales, start, guess, window_px=WINDOW_PX, max_forward_backward_px=1.0)


def well_inside(pixels: Array) -> NDArray[np.bool_]:
    return np.all((pixels > 12) & (pixels < [307, 227]), axis=1)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -0.81), (6.5, 4.2), (-21.3, 11.6)])
def test_points_are_found_where_the_image_has_moved(shift: tuple[float, float]) -> None:
    after = warped(np.array([[1.0, 0, 50 - shift[0]], [0, 1, 50 - shift[1]]]))
    landed, believed = followed(BEFORE, after, GRID, GRID)
    inner = well_inside(GRID) & well_inside(GRID + shift)
    assert believed[inner].mean() > 0.97
    error = np.linalg.norm(landed - GRID - shift, axis=1)[believed & inner]
    assert np.median(error) < 0.08  # bilinear interpolation, and a search that ends at steps of 0.03 px
    assert np.quantile(error, 0.95) < 0.15


def test_agrees_with_opencv() -> None:
    turn = cv2.getRotationMatrix2D((160, 120), 2.0, 1.01)
    turn[:, 2] += [50.0, 50.0]
    after = warped(turn)
    landed, believed = followed(BEFORE, after, GRID, GRID)
    start = GRID.astype(np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        BEFORE, after, start, None, winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS - 1,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.03),
    )  # fmt: skip
    # at the edge OpenCV takes the image's derivatives beyond it as zero
    both = believed & (found[:, 0] > 0) & well_inside(GRID) & well_inside(there)
    assert both.mean() > 0.7
    assert np.median(np.linalg.norm(landed - there, axis=1)[both]) < 1e-3
    assert np.quantile(np.linalg.norm(landed - there, axis=1)[both], 0.95) < 0.05


def test_what_cannot_be_followed_is_not_believed() -> None:
    flat = np.full_like(BEFORE, 90)
    assert not followed(flat, flat, GRID, GRID)[1].any()
    assert not followed(BEFORE, flat, GRID, GRID)[1].any()
    outside = np.array([[-300.0, 10], [1e6, 50], [np.nan, 3]])
    assert not followed(BEFORE, BEFORE, outside, outside)[1].any()
    assert followed(BEFORE, BEFORE, np.empty((0, 2)), np.empty((0, 2)))[0].shape == (0, 2)


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    after = warped(np.array([[1.0, 0.01, 47.3], [-0.01, 1, 52.1]]))
    alone, many = [], []
    for workers, into in ((1, alone), (4, many)):
        with ThreadPoolExecutor(workers) as pool, monkeypatch.context() as patch:
            patch.setattr(parallel, "_threads", lambda pool=pool: pool)
            into += followed(BEFORE, after, GRID, GRID)
    assert np.array_equal(alone[0], many[0])
    assert np.array_equal(alone[1], many[1])
