"""Boards in recordings, and the uncertainty of the lens that comes of them."""

import cv2
import numpy as np
import pytest

from board_simulation import board_texture, looking_poses, simulated_corners
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.intrinsics.board_calibration import calibrate
from rigwake.intrinsics.board_search import find_board, frame_name, frame_of
from rigwake.intrinsics.boards import parse_board
from rigwake.intrinsics.projection_uncertainty import projection_std_px
from rigwake.recording import CameraStream, Frame

BOARD = parse_board("chessboard:5x4:0.03")


class BoardFrames:
    """Frames of a board that stands still in the first half and moves in the second."""

    def __init__(self, count: int, is_there: bool = True) -> None:
        self.count = count
        texture, _ = board_texture(BOARD, 500.0)
        self.texture = texture if is_there else np.full_like(texture, 200)

    def frames(self, indices, *, colour: bool = False):
        for index in indices:
            image = np.full((240, 320), 120, np.uint8)
            left = 10 + 12 * max(0, int(index) - self.count // 2)
            height, width = self.texture.shape
            image[40 : 40 + height, left : left + width] = self.texture
            yield Frame(int(index), int(index) * 10**8, cv2.GaussianBlur(image, (0, 0), 0.7))


def stream(count: int = 12, is_there: bool = True) -> CameraStream:
    return CameraStream("front", np.arange(count) * 10**8, BoardFrames(count, is_there), 320, 240)


def test_a_board_that_stands_still_is_one_view() -> None:
    seen = find_board(BOARD, stream())
    names = [view.name for view in seen.views]
    assert names[0] == frame_name(0)
    assert len(names) == 6  # the first, and each of the five frames in which it has moved
    assert [why for _, why in seen.unused] == ["the board has hardly moved"] * 6
    frame = frame_of(stream(), names[-1])
    assert frame is not None
    assert frame.index == 11


def test_no_board_is_an_error_with_the_name_of_the_camera() -> None:
    with pytest.raises(EstimationError, match="front: no chessboard"):
        find_board(BOARD, stream(is_there=False))


def test_uncertainty_of_the_projection_is_that_of_drawn_lenses() -> None:
    lens = camera_from_params("kb4", [200, 201, 322, 238, 0.02, -0.005, 0.001, -0.0005], 640, 480)
    rng = np.random.default_rng(2)
    board = parse_board("aprilgrid:6x6:0.044:0.3")
    result = calibrate(simulated_corners(lens, board, looking_poses(0.9, 12, rng, 0.3), 0.2, rng), "kb4")
    u, v = np.meshgrid(np.linspace(60, 580, 9), np.linspace(40, 440, 7))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    predicted = projection_std_px(result, pixels)
    bearings, seen = result.camera.unproject(pixels)
    assert np.isfinite(predicted[seen]).all()
    free = np.diag(result.covariance) > 0
    root = np.linalg.cholesky(result.covariance[np.ix_(free, free)])
    draws = []
    for _ in range(300):
        params = result.camera.params
        params[free] += root @ rng.normal(size=int(free.sum()))
        drawn = result.camera.with_params(params)
        theirs, _ = drawn.unproject(pixels)
        reached = np.arccos(np.clip(bearings[:, 2], -1, 1)) <= result.max_observed_angle
        turn = so3.nearest_rotation(theirs[reached].T @ bearings[reached])  # the drawn lens's turn taken out
        draws.append(drawn.project(bearings @ turn.T)[0] - pixels)
    scatter = np.sqrt([np.linalg.eigvalsh(np.cov(d.T))[-1] for d in np.swapaxes(draws, 0, 1)])
    middle = np.linalg.norm(pixels - [322, 238], axis=1) < 200
    np.testing.assert_allclose(predicted[middle], scatter[middle], rtol=0.35)
    assert predicted[~middle].mean() > predicted[middle].mean()
