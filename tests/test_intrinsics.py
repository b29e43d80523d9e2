"""Intrinsic calibration without an initial guess: recovery, uncertainty, outliers, and refusals."""

import gzip
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from board_simulation import centred_points, looking_poses, render_board, simulated_corners
from rigwake.cameras.formats.camera_files import read_camera
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.cli.main import build_app
from rigwake.errors import EstimationError, InputError, UnobservableError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.intrinsics.board_calibration import IntrinsicCalibration, axis_focal_px, calibrate
from rigwake.intrinsics.board_observations import BoardObservations, BoardView, read_corner_file
from rigwake.intrinsics.board_pose import board_pose
from rigwake.intrinsics.boards import Board, parse_board
from rigwake.intrinsics.detect import detect_board, detect_corners
from rigwake.intrinsics.saddles import fitted_saddles, normals_of_grid
from rigwake.intrinsics.select import choose, cross_validate

BOARD = parse_board("aprilgrid:6x6:0.088:0.3")
SMALL_BOARD = parse_board("aprilgrid:4x4:0.132:0.3")
DENSE_BOARD = parse_board("aprilgrid:10x10:0.05:0.3")
NOISE_PX = 0.2
WIDE = {
    "kb4": [190.4, 190.9, 322.6, 236.9, -0.0115, 0.0062, -0.0034, 0.0005],
    "mei": [232, 233, 320, 240, 0.75, -0.05, 0.01, 1e-3, -2e-3, 0],
    "scaramuzza": [321, 239, 1.001, 0, 5e-4, -190, 0, 1.8e-3, -1e-6, 3e-9],
}


def wide_lens(model: str) -> CameraModel:
    return camera_from_params(model, WIDE[model], 640, 480, np.deg2rad(95))


def draw(camera: CameraModel, seed: int, views: int = 20, board: Board = BOARD) -> BoardObservations:
    rng = np.random.default_rng(seed)
    poses = looking_poses(np.deg2rad(70), views, rng, 0.5)
    return simulated_corners(camera, board, poses, NOISE_PX, rng)


def normalised_error(result: IntrinsicCalibration, truth: CameraModel) -> tuple[np.ndarray, float]:
    """Errors of the free parameters in standard deviations, and their NEES."""
    free = np.array([name not in result.fixed for name in truth.param_names])
    error = (result.camera.params - truth.params)[free]
    block = result.covariance[np.ix_(free, free)]
    return error / np.sqrt(np.diag(block)), float(error @ np.linalg.solve(block, error))


@pytest.mark.parametrize("model", WIDE)
def test_a_190_degree_lens_is_found_without_a_guess(model: str) -> None:
    truth = wide_lens(model)
    result = calibrate(draw(truth, 3), model)
    sigmas, _ = normalised_error(result, truth)
    assert np.abs(sigmas).max() < 3
    assert result.sigma_px == pytest.approx(NOISE_PX, rel=0.05)
    assert result.max_observed_angle > np.deg2rad(93)
    assert result.converged
    assert not result.unobservable
    assert not result.dropped_views


@pytest.mark.slow
@pytest.mark.parametrize("model", WIDE)
def test_standard_deviations_are_honest_over_50_draws(model: str) -> None:
    truth = wide_lens(model)
    # Mei's xi, focal length and k1 are nearly exchangeable: it takes more corners for its errors to be small
    # enough that a covariance, which is linear, can describe them
    board = DENSE_BOARD if model == "mei" else BOARD
    sigmas, nees = zip(
        *(normalised_error(calibrate(draw(truth, s, board=board), model), truth) for s in range(50)),
        strict=True,
    )
    unknowns = len(sigmas[0])
    # the mean of 50 chi-squared values: within 3.3 of its own standard deviations
    assert abs(np.mean(nees) - unknowns) < 3.3 * np.sqrt(2 * unknowns / 50)
    assert np.mean(np.abs(np.array(sigmas)) < 3) > 0.985


def sheared(observations: BoardObservations, seed: int, std: float) -> BoardObservations:
    """Each view's picture stretched a little its own way, as a moving board or a shutter does."""
    rng = np.random.default_rng(seed)
    views = tuple(
        replace(
            view, pixels=view.pixels + (view.pixels - view.pixels.mean(axis=0)) @ rng.normal(0, std, (2, 2))
        )
        for view in observations.views
    )
    return replace(observations, views=views)


def test_errors_common_to_the_corners_of_a_view_widen_the_covariance() -> None:
    truth = wide_lens("kb4")
    results = [calibrate(sheared(draw(truth, seed), seed, 3e-3), "kb4") for seed in range(4)]
    nees = np.array([normalised_error(result, truth)[1] for result in results])
    widening = np.array([result.widening for result in results])
    assert np.mean(widening * nees) > 10 * 8  # what independent corners predict: ten times too much
    assert np.mean(nees) < 2 * 8
    assert calibrate(draw(truth, 0), "kb4").widening < 1.3


@pytest.mark.parametrize("model", ["eucm", "ds", "fov", "kb23", "pinhole", "rational"])
def test_other_models_recover_their_own_lens(model: str) -> None:
    params = {
        "eucm": [200, 201, 320, 240, 0.6, 1.1],
        "ds": [200, 201, 320, 240, -0.2, 0.6],
        "fov": [200, 201, 320, 240, 0.93],
        "kb23": [190, 191, 322, 237, 1, -0.01, 0.006, -0.003, 4e-4, *[0.002, 0.001, 0, 1, 0.5, 0.2, 0.1] * 2],
        "pinhole": [420, 421, 322, 238, 0, -0.25, 0.06, 1e-3, -1e-3, 0],
        "rational": [420, 421, 322, 238, 0, 0.3, 0.05, 1e-3, -1e-3, 0, 0.5, 0.05, 0],
    }[model]
    truth = camera_from_params(model, params, 640, 480)
    rng = np.random.default_rng(5)
    poses = looking_poses(np.deg2rad(25 if model in ("pinhole", "rational") else 65), 16, rng, 0.5)
    result = calibrate(simulated_corners(truth, BOARD, poses, 0.05, rng), model)
    # the full model's products of coefficients have local minima that a start from symmetry may end in
    assert 0.045 < result.sigma_px < (0.12 if model == "kb23" else 0.055)
    assert axis_focal_px(result.camera) == pytest.approx(axis_focal_px(truth), rel=0.01)
    rays, seen = truth.unproject(np.concatenate([v.pixels for v in draw(truth, 1, 4).views]))
    rays = rays[seen & (rays[:, 2] > np.cos(result.max_observed_angle))]
    # a turn of the camera against the boards is part of no model: compare angles between rays
    ours, _ = result.camera.unproject(truth.project(rays)[0])
    turn = so3.nearest_rotation(ours.T @ rays)
    assert np.abs(ours @ turn - rays).max() < 5e-3


def test_outlier_views_and_corners_are_left_out_and_named() -> None:
    truth = wide_lens("kb4")
    clean = draw(truth, 4)
    rng = np.random.default_rng(0)
    views = list(clean.views)
    shuffled = views[7].pixels + rng.normal(0, 6, views[7].pixels.shape)
    views[7] = BoardView("blurred.png", views[7].points_board, shuffled)
    moved = views[2].pixels.copy()
    moved[:3] += 15
    views[2] = BoardView(views[2].name, views[2].points_board, moved)
    result = calibrate(replace(clean, views=tuple(views)), "kb4")
    assert [name for name, _ in result.dropped_views] == ["blurred.png"]
    assert result.dropped_corners == 3
    sigmas, _ = normalised_error(result, truth)
    assert np.abs(sigmas).max() < 3.5


def test_board_pose_of_a_board_behind_the_image_plane() -> None:
    cam_from_board = SE3(so3.exp([0.3, -1.9, 0.2]), np.array([0.8, 0.1, -0.35]))
    points = centred_points(BOARD)
    rays = cam_from_board * points
    assert (rays[:, 2] < 0).mean() > 0.5
    found = board_pose(points, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    assert found is not None
    np.testing.assert_allclose(cam_from_board.local(found), 0, atol=1e-9)


def test_cross_validation_prefers_the_model_that_made_the_corners() -> None:
    scores = cross_validate(draw(wide_lens("kb4"), 6, 10), ["fov", "kb4"])
    assert choose(scores) == "kb4"
    held_out = {score.model: score.held_out_px for score in scores}
    assert held_out["kb4"] == pytest.approx(NOISE_PX * np.sqrt(2), rel=0.1)


# ---- what the views cannot tell


def parallel_views(tilt_deg: float) -> BoardObservations:
    camera = camera_from_params("pinhole", [500, 500, 320, 240, *[0] * 6], 640, 480)
    rng = np.random.default_rng(0)
    poses = [
        SE3(
            so3.exp([np.pi, 0, 0]) @ so3.exp(np.deg2rad(tilt_deg) * rng.uniform(-1, 1, 3)),
            np.array([x, y, z]),
        )
        for x, y, z in rng.uniform([-0.1, -0.1, 0.8], [0.1, 0.1, 1.4], (8, 3))
    ]
    points = centred_points(BOARD)
    views = [
        BoardView(f"{k}.png", points, camera.project(pose * points)[0] + rng.normal(0, 0.2, (len(points), 2)))
        for k, pose in enumerate(poses)
    ]
    return BoardObservations(640, 480, tuple(views))


def test_fronto_parallel_views_are_refused() -> None:
    with pytest.raises(UnobservableError, match=r"same tilt|focal length") as caught:
        calibrate(parallel_views(0.3), "pinhole")
    assert caught.value.exit_code == 3
    assert "Tilt" in str(caught.value) or "tilt" in str(caught.value)


def test_one_view_is_refused() -> None:
    with pytest.raises(EstimationError, match="found in 1 usable"):
        calibrate(draw(wide_lens("kb4"), 0).take([3]), "kb4")


def test_a_parameter_without_effect_is_flagged_not_printed() -> None:
    # with l = m = 0 in truth, the asymmetric terms' phases have next to no effect
    truth = camera_from_params("kb4", WIDE["kb4"], 640, 480)
    result = calibrate(
        simulated_corners(
            truth,
            SMALL_BOARD,
            looking_poses(1.1, 8, np.random.default_rng(2), 0.5),
            0,
            np.random.default_rng(0),
        ),
        "kb23",
    )
    flagged = {name for name, std in result.stds.items() if not np.isfinite(std)}
    assert flagged == set(result.unobservable)
    assert flagged


def test_a_wrong_board_is_refused() -> None:
    observations = draw(wide_lens("kb4"), 1)
    bent = [replace(v, points_board=np.roll(v.points_board, 7, axis=0)) for v in observations.views]
    with pytest.raises(EstimationError):
        calibrate(replace(observations, views=tuple(bent)), "kb4")


def test_unknown_parameter_names_are_refused() -> None:
    with pytest.raises(UsageError, match="no parameter k9"):
        calibrate(draw(wide_lens("kb4"), 1), "kb4", fix=["k9"])


# ---- files


def write_corners(path: Path, observations: BoardObservations) -> None:
    rows = ["timestamp_ns,tag_id,corner_idx,u_px,v_px,x_m,y_m,z_m"]
    for k, view in enumerate(observations.views):
        for (u, v), (x, y, z) in zip(view.pixels, view.points_board, strict=True):
            rows.append(f"{k},0,0,{u!r},{v!r},{x!r},{y!r},{z!r}".replace("np.float64(", "").replace(")", ""))
    with gzip.open(path, "wt") as stream:
        stream.write("\n".join(rows) + "\n")


def test_the_verb_reads_corners_and_writes_a_camera(tmp_path: Path) -> None:
    write_corners(tmp_path / "corners.csv.gz", draw(wide_lens("kb4"), 8, 10))
    arguments = [
        *("intrinsics", str(tmp_path / "corners.csv.gz"), "--image-size", "640x480", "--model", "kb4"),
        *("-o", str(tmp_path / "front.yaml"), "--plots", str(tmp_path), "--json", str(tmp_path / "f.json")),
        *("--fov", "190"),
    ]
    outcome = CliRunner().invoke(build_app(), arguments)
    assert outcome.exit_code == 0, outcome.output
    assert "next:" in outcome.output
    camera = read_camera(tmp_path / "front.yaml")
    assert (camera.model, camera.max_angle) == ("kb4", pytest.approx(np.deg2rad(95)))
    entry = yaml.safe_load((tmp_path / "front.yaml").read_text())["cameras"]["front"]["calibration"]
    assert entry["std"]["fx"] > 0
    assert entry["views"] == 10
    for kind in ("coverage", "residuals"):
        assert (tmp_path / f"front_{kind}.png").stat().st_size > 10_000


def test_broken_corner_files_are_named_errors(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="lacks the columns"):
        read_corner_file(path, 640, 480)
    path.write_text("timestamp_ns,tag_id,corner_idx,u_px,v_px,x_m,y_m,z_m\n1,2,3,x,1,1,1,1\n")
    with pytest.raises(InputError, match="corner file"):
        read_corner_file(path, 640, 480)
    path.write_text("timestamp_ns,tag_id,corner_idx,u_px,v_px,x_m,y_m,z_m\n1,2,3,700,1,1,1,1\n")
    with pytest.raises(UsageError, match="true image size"):
        read_corner_file(path, 640, 480)


@pytest.mark.parametrize(
    "text",
    ["chessboard", "chessboard:9x6", "chessboard:9:0.03", "aprilgrid:6x6:0.088", "aprilgrid:6x6:-1:0.3",
     "charuco:5x7:0.03:0.04", "charuco:5x7:0.04:0.03:NO", "circles:3x3:0.1", "chessboard:1x1:0.1",
     "aprilgrid:6x6:nan:0.3"],
)  # fmt: skip
def test_what_is_not_a_board_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="not a board"):
        parse_board(text)


# ---- images


def test_aprilgrid_corners_are_found_to_a_tenth_of_a_pixel_in_a_fisheye_image() -> None:
    camera, board = wide_lens("kb4"), parse_board("aprilgrid:6x6:0.088:0.3")
    cam_from_board = looking_poses(np.deg2rad(50), 9, np.random.default_rng(1), 0.4)[4]
    image = render_board(camera, board, cam_from_board, np.random.default_rng(0))
    ids, pixels = detect_corners(board, image)
    truth, _ = camera.project(cam_from_board * centred_points(board)[ids])
    error = np.linalg.norm(pixels - truth, axis=1)
    assert len(ids) >= 100
    assert np.median(error) < 0.15
    assert np.percentile(error, 95) < 0.6


def test_images_without_a_board_or_of_two_sizes(tmp_path: Path) -> None:
    for k, width in enumerate((640, 640, 320)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((480, width), 128, np.uint8))
    files = sorted(tmp_path.iterdir())
    with pytest.raises(EstimationError, match=r"No chessboard of 9 x 6 inner corners was found in any of 2"):
        detect_board(parse_board("chessboard:9x6:0.03"), files[:2])
    with pytest.raises(UsageError, match=r"differ in size.*640x480"):
        detect_board(parse_board("chessboard:9x6:0.03"), files)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["kb4", "mei", "scaramuzza"])
def test_from_rendered_images_to_a_camera_file(model: str, tmp_path: Path) -> None:
    truth, board = wide_lens(model), parse_board("aprilgrid:6x6:0.088:0.3")
    rng = np.random.default_rng(0)
    poses = looking_poses(np.deg2rad(65), 20, rng, 0.4)
    (tmp_path / "images").mkdir()
    for k in range(len(poses)):
        cv2.imwrite(str(tmp_path / "images" / f"{k:02d}.png"), render_board(truth, board, poses[k], rng))
    arguments = ["intrinsics", str(tmp_path / "images"), "--board", "aprilgrid:6x6:0.088:0.3"]
    outcome = CliRunner().invoke(build_app(), [*arguments, "--model", model, "-o", str(tmp_path / "c.yaml")])
    assert outcome.exit_code == 0, outcome.output
    found = read_camera(tmp_path / "c.yaml")
    assert axis_focal_px(found) == pytest.approx(axis_focal_px(truth), rel=0.005)
    axis = np.array([[0, 0, 1.0]])
    np.testing.assert_allclose(found.project(axis)[0], truth.project(axis)[0], atol=1.0)


# ---- real corners


def test_euroc_corners_fit_better_than_the_published_intrinsics(real_recordings: Path) -> None:
    folder = real_recordings / "euroc_aprilgrid" / "cam_april"
    published = read_camera(real_recordings / "euroc_v101_micro/mav0/cam0/sensor.yaml")
    observations = read_corner_file(folder / "cam0.csv.gz", 752, 480)
    result = calibrate(observations, "pinhole", free=["k3"])
    assert result.rms_px < 0.12
    assert result.converged
    assert result.camera.params[0] == pytest.approx(published.params[0], rel=0.01)
    assert not result.dropped_views


def test_chessboard_corners_are_found_where_they_are() -> None:
    camera, board = wide_lens("kb4"), parse_board("chessboard:8x6:0.06")
    cam_from_board = SE3(so3.exp([0.3, -0.2, 0.1]), np.array([0.05, 0.02, 0.35]))
    image = render_board(camera, board, cam_from_board, np.random.default_rng(0))
    ids, pixels = detect_corners(board, image)
    truth, _ = camera.project(cam_from_board * centred_points(board)[ids])
    assert len(ids) == 48
    # a chessboard may be read from its other end: the same corners, in reverse
    errors = min((np.linalg.norm(pixels - order, axis=1) for order in (truth, truth[::-1])), key=np.median)
    assert np.median(errors) < 0.15
    assert errors.max() < 0.8


def test_charuco_corners_are_found_where_they_are() -> None:
    board = parse_board("charuco:7x5:0.04:0.03:5X5_100")
    image = board.charuco().generateImage((700, 500))
    ids, pixels = detect_corners(board, image)
    assert len(ids) == 24
    # 100 pixels per square; OpenCV's image has its own origin at the corner of the first pixel
    np.testing.assert_allclose(pixels, board.corner_points[ids, :2] * 2500 - 0.5, atol=0.3)


@pytest.mark.parametrize(("blur_px", "within_px"), [(0.0, 0.02), (0.6, 0.008), (1.2, 0.015)])
def test_corners_are_fitted_alike_in_sharp_and_soft_pictures(blur_px: float, within_px: float) -> None:
    """Gradients are off by 0.03 px without blur, and by alike amounts over the view."""
    camera = camera_from_params("pinhole", [420, 421, 162, 118, 0, -0.2, 0.05, 0, 0, 0], 320, 240)
    board, rng = parse_board("chessboard:9x6:0.03"), np.random.default_rng(2)
    cam_from_board = SE3(so3.exp([0.4, -0.3, 0.2]), np.array([0.01, 0.01, 0.5]))
    image = render_board(camera, board, cam_from_board, rng, blur_px=blur_px)
    truth, _ = camera.project(cam_from_board * centred_points(board))
    start = truth + rng.uniform(-0.4, 0.4, truth.shape)
    errors = fitted(image, start.reshape(board.rows, board.columns, 2)) - truth
    assert np.sqrt(np.mean(errors**2)) < within_px
    assert np.abs(errors.mean(axis=0)).max() < within_px / 3


def test_corners_at_the_border_of_the_image_are_left_as_they_are() -> None:
    grid = np.stack(np.meshgrid(np.arange(4) * 20.0 + 2, np.arange(3) * 20.0 + 30), axis=-1)
    x, y = np.meshgrid(np.arange(100), np.arange(100))
    image = np.where((np.floor((x - 2) / 20) + np.floor((y - 30) / 20)) % 2 == 0, 200, 60).astype(np.uint8)
    found = fitted(image, grid).reshape(3, 4, 2)
    assert np.isnan(found[:, 0]).all()
    assert np.isfinite(found[:, 1:]).all()


def fitted(image: np.ndarray, grid: np.ndarray) -> np.ndarray:
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    return fitted_saddles(image, grid.reshape(-1, 2), normals_of_grid(grid), min(sides))


@pytest.mark.parametrize("blur_px", [0.3, 0.6, 1.0])
def test_corners_of_an_aprilgrid_are_fitted_as_those_of_a_chessboard(blur_px: float) -> None:
    """Gradients are off by 0.02 px, and OpenCV's quads by 3 px."""
    camera = camera_from_params("pinhole", [520, 522, 322, 238, 0, -0.2, 0.05, 0, 0, 0], 640, 480)
    board, rng = parse_board("aprilgrid:5x4:0.04:0.3"), np.random.default_rng(2)
    cam_from_board = SE3(so3.exp([0.4 - np.pi, -0.3, 0.2]), np.array([0.01, 0.01, 0.5]))
    ids, pixels = detect_corners(board, render_board(camera, board, cam_from_board, rng, blur_px=blur_px))
    truth, _ = camera.project(cam_from_board * centred_points(board)[ids])
    assert len(ids) >= 72
    assert np.sqrt(np.mean((pixels - truth) ** 2)) < 0.008
    assert np.abs(pixels - truth).max() < 0.04


def test_a_corner_of_a_single_dark_square_is_not_fitted() -> None:
    """As of AprilGrids that are printed without squares between their tags."""
    image = np.full((60, 60), 210, np.uint8)
    image[30:, 30:] = 40
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    at, normals = np.array([[30.0, 30.0]]), [np.array([np.pi / 2]), np.array([0.0])]
    assert np.isnan(fitted_saddles(image, at, normals, 12.0)).all()
    image[:30, :30] = 40
    assert np.isfinite(fitted_saddles(image, at, normals, 12.0)).all()
