"""Every lens: inverse of itself, right derivatives, right edge, and agreement with other libraries."""

import pickle

import cv2  # before pycolmap: the other way round its PNG reader aborts the process
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_lenses import LENSES, lens, rays_within, reach_of
from rigwake.cameras.models.lens import Lens
from rigwake.cameras.models.projection_kernels import build_kernels
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import CAMERA_CLASSES, camera_from_params
from rigwake.errors import CameraError

every_lens = pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES.keys())
fractions = st.floats(0, 1, allow_subnormal=False)
azimuths = st.floats(-np.pi, np.pi)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ni,ni->n", a, b))


def test_every_model_is_tested() -> None:
    assert {camera.model for camera in LENSES.values()} == CAMERA_CLASSES.keys()
    assert all(isinstance(camera, CameraModel) for camera in LENSES.values())


@every_lens
@given(fraction=fractions, phi=azimuths, depth=st.floats(0.01, 1e4))
@settings(max_examples=40)
def test_a_ray_comes_back_from_its_pixel(camera: Lens, fraction: float, phi: float, depth: float) -> None:
    theta = fraction * reach_of(camera)
    ray = np.array([[np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]])
    pixels, valid = camera.project(depth * ray)
    bearings, found = camera.unproject(pixels)
    assert valid.all()
    assert found.all()
    assert angle_between(bearings, ray)[0] <= 1e-10
    assert np.linalg.norm(bearings[0]) == pytest.approx(1, abs=1e-14)


@every_lens
def test_a_pixel_comes_back_from_its_ray_over_the_whole_image(camera: Lens) -> None:
    columns, rows = np.meshgrid(np.linspace(-20, 660, 120), np.linspace(-20, 500, 90))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    bearings, valid = camera.unproject(pixels)
    assert valid.mean() > 0.5
    again, seen = camera.project(bearings[valid])
    assert seen.all()
    assert np.abs(again - pixels[valid]).max() <= 1e-8
    assert np.isnan(bearings[~valid]).all()
    assert (
        angle_between(bearings[valid], np.tile([0.0, 0, 1], (valid.sum(), 1))) <= camera.max_angle + 1e-9
    ).all()


@every_lens
def test_derivatives_agree_with_central_differences(camera: Lens) -> None:
    points = rays_within(0.99 * reach_of(camera), 200) * np.linspace(0.3, 20, 200)[:, None]
    result = camera.project_with_jacobians(points)
    assert result.valid.all()
    np.testing.assert_array_equal(result.pixels, camera.project(points)[0])

    def differences(move) -> np.ndarray:  # fourth order: exact to rounding
        near, far = (move(1) - move(-1)) / 2, (move(2) - move(-2)) / 4
        return (4 * near - far) / 3

    norms = np.linalg.norm(points, axis=1, keepdims=True)
    for k, axis in enumerate(np.eye(3)):
        step = 1e-4 * norms * np.minimum(1.0, np.abs(points[:, 2:]) / norms + 0.02)
        numeric = differences(lambda s, a=axis, h=step: camera.project(points + s * h * a)[0]) / step
        scale = np.abs(result.d_point).max(axis=(1, 2))[:, None]
        assert np.nanmax(np.abs(numeric - result.d_point[:, :, k]) / scale) <= 1e-6, camera.param_names[k]
    for k, name in enumerate(camera.param_names):
        effect = np.abs(result.d_params[:, :, k]).max()
        h = min(1e-3 / max(effect, 1e-9), 0.1)

        def moved(s: int, k: int = k, h: float = h) -> np.ndarray:
            values = camera.params
            values[k] += s * h
            return camera.with_params(values).project(points)[0]

        numeric = differences(moved) / h
        assert np.nanmax(np.abs(numeric - result.d_params[:, :, k])) <= 1e-6 * max(effect, 1.0), name


@every_lens
def test_beyond_its_end_a_lens_sees_nothing(camera: Lens) -> None:
    beyond = np.deg2rad(np.array([0.01, 1, 5, 30])) + camera.max_angle
    beyond = beyond[beyond < np.pi]
    points = np.column_stack([np.sin(beyond), 0 * beyond, np.cos(beyond)])
    result = camera.project_with_jacobians(points)
    assert not result.valid.any()
    assert np.isnan(result.pixels).all()
    assert not result.d_point.any()
    assert not result.d_params.any()


@every_lens
def test_points_that_have_no_pixel_are_invalid(camera: Lens) -> None:
    points = np.array([[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1], [0, 0, -1.0], [0, 0, 2.0]])
    pixels, valid = camera.project(points)
    np.testing.assert_array_equal(valid, [False, False, False, False, True])
    assert np.isnan(pixels[:4]).all()
    bearings, found = camera.unproject(np.array([[np.nan, 0], [np.inf, 3]]))
    assert not found.any()
    assert np.isnan(bearings).all()


@every_lens
def test_the_end_lies_where_the_radius_still_grows(camera: Lens) -> None:
    theta = np.linspace(1e-3, reach_of(camera), 4000)
    pixels, valid = camera.project(np.column_stack([np.sin(theta), 0 * theta, np.cos(theta)]))
    assert valid.all()
    assert (np.diff(pixels[:, 0]) > 0).all()


@every_lens
def test_lenses_are_values(camera: Lens) -> None:
    same = type(camera)(camera.values, camera.width_px, camera.height_px, camera.angle_limit)
    other = camera.with_params(camera.params * (1 + 1e-12))
    assert same == camera == pickle.loads(pickle.dumps(camera))
    assert hash(same) == hash(camera)
    assert other != camera


def test_folding_lenses_end_at_their_fold() -> None:
    # r = theta - 0.05 theta^3 - 0.01 theta^5 turns where 1 - 0.15 t^2 - 0.05 t^4 = 0
    squared = (-0.15 + np.sqrt(0.15**2 + 4 * 0.05)) / 0.1
    assert LENSES["kb4 folding"].max_angle == pytest.approx(np.sqrt(squared), abs=0.02)
    assert LENSES["kb4 folding"].max_angle < np.sqrt(squared)
    assert LENSES["kb4 ideal"].max_angle == pytest.approx(np.pi)


def test_opencv_pinhole_agrees() -> None:
    for name in ("pinhole", "rational"):
        camera = LENSES[name]
        plain = camera.with_params([*camera.params[:4], 0.0, *camera.params[5:]])  # OpenCV ignores skew
        rays = rays_within(np.deg2rad(60), 2000)
        K = np.array(
            [[plain.params[0], 0, plain.params[2]], [0, plain.params[1], plain.params[3]], [0, 0, 1]]
        )
        theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, plain.params[5:])[0].reshape(-1, 2)
        assert np.abs(plain.project(rays)[0] - theirs).max() <= 1e-6


def test_opencv_fisheye_agrees_as_far_as_it_is_right() -> None:
    camera = LENSES["kb4 195"]
    rays = rays_within(np.deg2rad(80), 2000)
    fx, fy, cx, cy, *D = camera.params
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    theirs = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), K, np.array(D))[0]
    assert np.abs(camera.project(rays)[0] - theirs.reshape(-1, 2)).max() <= 1e-6


def test_opencv_omnidir_agrees_beyond_90_degrees() -> None:
    camera = lens("mei", [400, 401, 320, 240, 1.4, -0.05, 0.01, 1e-3, -2e-3, 0], 195)
    rays = rays_within(np.deg2rad(97), 2000)
    fx, fy, cx, cy, xi, *D = camera.params
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    theirs = cv2.omnidir.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), K, xi, np.array(D[:4]))[0]
    assert np.abs(camera.project(rays)[0] - theirs.reshape(-1, 2)).max() <= 1e-6


@pytest.mark.parametrize("name", ["pinhole", "rational", "kb4 195", "fov 195"])
def test_colmap_agrees(name: str) -> None:
    from rigwake.cameras.formats.camera_dicts import camera_to_colmap

    camera = LENSES[name]
    if "skew" in camera.param_names:
        camera = camera.with_params([*camera.params[:4], 0.0, *camera.params[5:]])
    model, params = camera_to_colmap(camera)
    other = pycolmap.Camera(model=model, width=640, height=480, params=params)
    rays = rays_within(np.deg2rad(60 if "skew" in camera.param_names else 80), 500)
    theirs = np.array(other.img_from_cam(rays)) - 0.5
    assert np.abs(camera.project(rays)[0] - theirs).max() <= 1e-6


@pytest.mark.parametrize(
    ("model", "params", "angle", "message"),
    [
        ("kb4", [200, 200, 320], None, "takes 8 parameters"),
        ("kb4", [200, 200, 320, 240, np.nan, 0, 0, 0], None, "finite"),
        ("kb4", [-200, 200, 320, 240, 0, 0, 0, 0], None, "fx"),
        ("kb4", [200, 200, 320, 240, -0.05, -0.01, 0, 0], np.deg2rad(120), "holds to"),
        ("pinhole", [200, 200, 320, 240, 0, 0, 0, 0, 0, 0], np.deg2rad(95), "holds to"),
        ("eucm", [200, 200, 320, 240, 1.5, 1.0], None, "alpha"),
        ("scaramuzza", [320, 240, 1, 0, 0, 200, 0, 1e-3], None, "a0 must be negative"),
        ("nosuch", [1.0], None, "no camera model"),
    ],
)
def test_what_is_not_a_lens_is_refused(model: str, params: list[float], angle: float, message: str) -> None:
    with pytest.raises(CameraError, match=message):
        camera_from_params(model, params, 640, 480, angle)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(CameraError, match="shape"):
        LENSES["kb4 195"].project(np.zeros((3, 2)))
    with pytest.raises(CameraError, match="shape"):
        LENSES["kb4 195"].unproject(np.zeros(2))


def test_an_edited_lens_is_compiled_anew(tmp_path) -> None:
    source = "def project_point(*a): pass\ndef unproject_point(*a): return False\n"
    versions = []
    for content in (source, source + "# edited\n"):
        path = tmp_path / "lens.py"
        path.write_text(content)
        scope: dict = {}
        exec(compile(content, str(path), "exec"), scope)
        kernels = build_kernels(scope["project_point"], scope["unproject_point"])
        versions.append(kernels.project.py_func.__closure__)
    cells = [
        {cell.cell_contents for cell in closure if isinstance(cell.cell_contents, str)}
        for closure in versions
    ]
    assert cells[0] != cells[1]
