"""Simulated views of boards through wide lenses, as corners or as rendered images."""

from functools import lru_cache

import cv2
import numpy as np

from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3, stack
from rigwake.intrinsics.board_observations import BoardObservations, BoardView
from rigwake.intrinsics.boards import Board


def looking_poses(max_angle: float, count: int, rng: np.random.Generator, distance: float) -> SE3:
    """`cam_from_board` of boards spread over directions up to `max_angle` off the axis, facing the camera
    with up to 35 degrees of tilt; the board's own origin lies at its centre."""
    poses = []
    for k in range(count):
        angle, phi = max_angle * np.sqrt((k + 0.5) / count), 2.4 * k + rng.uniform(0, 0.5)
        direction = np.array([np.sin(angle) * np.cos(phi), np.sin(angle) * np.sin(phi), np.cos(angle)])
        # x right of the board, y up it, z towards the camera
        z = -direction
        x = np.cross([0.3, 1.0, 0.2], z)
        x /= np.linalg.norm(x)
        facing = np.column_stack([x, np.cross(z, x), z])
        tilt = so3.exp(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-3, 3)))
        poses.append(SE3(facing @ tilt, direction * distance * rng.uniform(0.8, 1.3)))
    return stack(poses)


def centred_points(board: Board) -> np.ndarray:
    points = board.corner_points
    return points - (points.min(axis=0) + points.max(axis=0)) / 2


def simulated_corners(
    camera: CameraModel, board: Board, poses: SE3, noise_px: float, rng: np.random.Generator
) -> BoardObservations:
    points, views = centred_points(board), []
    for k in range(len(poses)):
        pixels, valid = camera.project(poses[k] * points)
        with np.errstate(invalid="ignore"):
            seen = valid & (pixels >= 0).all(axis=1)
            seen &= (pixels <= [camera.width_px - 1, camera.height_px - 1]).all(axis=1)
        if seen.sum() >= 12:
            noisy = pixels[seen] + rng.normal(0, noise_px, (int(seen.sum()), 2))
            views.append(BoardView(f"view{k:02d}", points[seen], noisy))
    return BoardObservations(camera.width_px, camera.height_px, tuple(views))


def board_texture(board: Board, pixels_per_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A printed board with a white rim, and the position (2,) in the texture of its first corner; rows run
    down while the board's y of an aprilgrid runs up."""
    rim = 0.6 * board.size_m
    extent = board.corner_points[:, :2].max(axis=0)
    if board.kind == "chessboard":
        rim, extent = 1.6 * board.size_m, extent
    height, width = (np.ceil((extent[::-1] + 2 * rim) * pixels_per_m)).astype(int)
    rows, columns = np.mgrid[0:height, 0:width]
    x, y = (columns + 0.5) / pixels_per_m - rim, (rows + 0.5) / pixels_per_m - rim
    if board.kind == "chessboard":
        i, j = np.floor(x / board.size_m).astype(int), np.floor(y / board.size_m).astype(int)
        on_board = (i >= -1) & (i < board.columns) & (j >= -1) & (j < board.rows)
        return np.where(on_board & ((i + j) % 2 == 0), 0, 255).astype(np.uint8), np.array([rim, rim])
    return _aprilgrid_texture(board, x, extent[1] - y), np.array([rim, rim])


def _aprilgrid_texture(board: Board, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Kalibr's print: tags with a border of two bits and black squares between their corners."""
    step, gap = board.size_m * (1 + board.spacing), board.size_m * board.spacing
    texture = np.full(x.shape, 255, dtype=np.uint8)
    i, j = np.floor(x / step).astype(int), np.floor(y / step).astype(int)
    local_x, local_y = (x - i * step) / board.size_m, (y - j * step) / board.size_m
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for row in range(board.rows):
        for column in range(board.columns):
            bits = cv2.aruco.generateImageMarker(dictionary, row * board.columns + column, 100, borderBits=2)
            inside = (i == column) & (j == row) & (local_x < 1) & (local_y < 1)
            texture[inside] = bits[
                ((1 - local_y[inside]) * 100).astype(int).clip(0, 99), (local_x[inside] * 100).astype(int)
            ]
    gap_x, gap_y = x + gap, y + gap
    a, b = np.floor(gap_x / step).astype(int), np.floor(gap_y / step).astype(int)
    square = (gap_x - a * step < gap) & (gap_y - b * step < gap)
    square &= (a >= 0) & (a <= board.columns) & (b >= 0) & (b <= board.rows)
    texture[square] = 0
    return texture


_texture = lru_cache(maxsize=2)(board_texture)  # many pictures are made of one board with one lens


@lru_cache(maxsize=2)
def _rays(
    model: str, params: tuple[float, ...], size: tuple[int, int], limit: float | None, oversample: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rays (H, W, 3) of all parts of all pixels, and which the lens sees; they take longer than all the rest."""
    offsets = (np.arange(oversample) + 0.5) / oversample - 0.5
    columns, rows = ((np.arange(count)[:, None] + offsets).ravel() for count in size)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    rays, valid = camera_from_params(model, params, *size, limit).unproject(grid.reshape(-1, 2))
    return np.nan_to_num(rays).reshape(*grid.shape[:2], 3), valid.reshape(grid.shape[:2])


def render_board(
    camera: CameraModel,
    board: Board,
    cam_from_board: SE3,
    rng: np.random.Generator,
    oversample: int = 3,
    blur_px: float = 0.0,
) -> np.ndarray:
    """A grey image (H, W) of the board (its own origin at its centre) before a mid-grey background.

    blur_px: standard deviation of the lens's blur; without it, only the pixels' own area blurs.
    """
    pixels_per_m, background = 2000.0, 90
    texture, rim = _texture(board, pixels_per_m)
    extent = board.corner_points[:, :2].max(axis=0)
    size = camera.width_px, camera.height_px
    limit = getattr(camera, "angle_limit", None)
    rays, valid = _rays(camera.model, tuple(camera.params.tolist()), size, limit, oversample)
    place = _place_in_image(camera, cam_from_board, extent, rim, 2 + 5 * blur_px)
    part = tuple(slice(s.start * oversample, s.stop * oversample) for s in place)
    rays, valid = rays[part], valid[part]
    board_from_cam = cam_from_board.inverse()
    origin, directions = board_from_cam.translation, rays @ board_from_cam.rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -origin[2] / directions[..., 2]
        hits = np.nan_to_num(origin + depth[..., None] * directions, nan=1e6, posinf=1e6, neginf=1e6)
    hits = np.where((valid & (depth > 0))[..., None], hits, 1e6)[..., :2] + extent / 2
    if board.kind == "aprilgrid":
        hits[..., 1] = extent[1] - hits[..., 1]
    maps = ((hits + rim) * pixels_per_m - 0.5).clip(-10, 1e5).astype(np.float32)
    fine = cv2.remap(
        texture,
        maps[..., 0],
        maps[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=background,
    )
    if blur_px > 0:
        fine = cv2.GaussianBlur(fine, (0, 0), blur_px * oversample)
    image = np.full((camera.height_px, camera.width_px), background, np.uint8)
    wanted = (place[1].stop - place[1].start, place[0].stop - place[0].start)
    image[place] = cv2.resize(fine, wanted, interpolation=cv2.INTER_AREA)
    return (image + rng.normal(0, 1.5, image.shape)).clip(0, 255).astype(np.uint8)


def _place_in_image(
    camera: CameraModel, cam_from_board: SE3, extent: np.ndarray, rim: np.ndarray, margin_px: float
) -> tuple[slice, slice]:
    """Rows and columns that hold the board; all where the lens does not see its whole outline."""
    along = np.linspace(0, 1, 41)
    ones = np.ones_like(along)
    edges = [(along, 0 * ones), (along, ones), (0 * ones, along), (ones, along)]
    unit = np.concatenate([np.stack(edge, axis=1) for edge in edges])
    plane = (unit - 0.5) * (extent + 2 * rim)
    pixels, valid = camera.project(cam_from_board * np.column_stack([plane, np.zeros(len(plane))]))
    size = np.array([camera.width_px, camera.height_px])
    if not valid.all():
        return slice(0, int(size[1])), slice(0, int(size[0]))
    low = np.floor(pixels.min(axis=0) - margin_px).clip(0, size - 1).astype(int)
    high = np.ceil(pixels.max(axis=0) + margin_px + 1).clip(low + 1, size).astype(int)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
