"""Are the standard deviations of `rigwake intrinsics` honest on pictures of boards? Monte Carlo over rendered boards.

    python benchmarks/board_pictures.py [--draws 12] [--blur 0.6]

Each draw renders up to 24 chessboards, then as many AprilGrids, through one known lens, finds their corners as the verb
does and calibrates. Mean NEES per degree of freedom is 1 if the covariance is honest. blur: standard deviation of the
lens's blur in pixels; 0 makes pictures sharper than any lens does, whose corners are twice as bad for want of grey
values at the edges.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from board_simulation import centred_points, looking_poses, render_board
from rigwake.cameras.registry import camera_from_params
from rigwake.intrinsics.board_calibration import calibrate
from rigwake.intrinsics.board_observations import BoardObservations, BoardView
from rigwake.intrinsics.boards import Board, parse_board
from rigwake.intrinsics.detect import detect_corners

BOARDS = ("chessboard:9x6:0.03", "aprilgrid:5x4:0.04:0.3")
LENS = camera_from_params("pinhole", [520, 522, 322, 238, 0, -0.2, 0.05, 0.001, -0.0005, 0], 640, 480)
RIM_PX = 15


def draw(board: Board, seed: int, blur_px: float) -> tuple[float, float, int, float]:
    """NEES per degree of freedom, RMS error of a coordinate (px), views, widening."""
    rng = np.random.default_rng(seed)
    poses = looking_poses(0.35, 24, rng, 0.5)
    views, errors = [], []
    for k in range(len(poses)):
        true, valid = LENS.project(poses[k] * centred_points(board))
        inside = (true > RIM_PX).all() and (true < [LENS.width_px - RIM_PX, LENS.height_px - RIM_PX]).all()
        if not (valid.all() and inside):
            continue
        ids, pixels = detect_corners(board, render_board(LENS, board, poses[k], rng, blur_px=blur_px))
        if len(ids) == 0:
            continue
        # a chessboard may be read from its other end
        nearest = np.linalg.norm(pixels[:, None] - true[None], axis=2).argmin(axis=1)
        errors.append(pixels - true[nearest])
        views.append(BoardView(str(k), board.corner_points[ids], pixels))
    result = calibrate(BoardObservations(LENS.width_px, LENS.height_px, tuple(views)), LENS.model)
    free = np.array([name not in result.fixed for name in LENS.param_names])
    error = (result.camera.params - LENS.params)[free]
    nees = error @ np.linalg.solve(result.covariance[np.ix_(free, free)], error) / free.sum()
    return float(nees), float(np.sqrt(np.mean(np.concatenate(errors) ** 2))), len(views), result.widening


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--blur", type=float, default=0.6)
    wanted = parser.parse_args()
    for name in BOARDS:
        print(
            f"\n{name}\n\n| seed | views | corner error, px | widening | NEES / dof |\n|---|---|---|---|---|"
        )
        ratios = []
        for seed in range(wanted.draws):
            nees, error_px, views, widening = draw(parse_board(name), seed, wanted.blur)
            ratios.append(nees)
            print(f"| {seed} | {views} | {error_px:.4f} | {widening:.2f} | {nees:.2f} |", flush=True)
        spread = np.std(ratios) / np.sqrt(len(ratios))
        print(f"\nmean NEES / dof of {name}: {np.mean(ratios):.2f} (honest: 1) +- {spread:.2f}")


if __name__ == "__main__":
    main()
