"""Virtual views, panoramas, and conversion between models."""

import numpy as np
import pytest

from camera_lenses import LENSES
from rigwake.cameras.model_fitting import convert_camera
from rigwake.cameras.models.lens import Lens
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.cameras.virtual_views import Cylinder, Equirectangular, ViewGeometry, covering_views, remap_table
from rigwake.errors import CameraError
from rigwake.geometry import so3

FISHEYE = LENSES["kb4 195"]
TURN = so3.exp([0.2, -0.9, 0.3])
VIEWS = {
    "pinhole": camera_from_params("pinhole", [150, 150, 99.5, 79.5, *[0] * 6], 200, 160),
    "other lens": camera_from_params("eucm", [60, 60, 99.5, 79.5, 0.6, 1.1], 200, 160),
    "cylinder": Cylinder(300, 120, np.deg2rad(200)),
    "equirectangular": Equirectangular(300, 150),
    "part of a panorama": Equirectangular(300, 100, np.deg2rad(190), np.deg2rad(80)),
}


def direction_image(camera: CameraModel, channel: int) -> np.ndarray:
    """An image whose grey value tells one component of each pixel's ray."""
    grid = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1)
    rays, valid = camera.unproject(grid.reshape(-1, 2).astype(float))
    grey = np.where(valid, 20 + 100 * (1 + rays[:, channel]), 0)
    return grey.reshape(camera.height_px, camera.width_px).round().astype(np.uint8)


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_every_pixel_of_a_view_shows_its_own_ray(view: ViewGeometry, channel: int) -> None:
    table = remap_table(FISHEYE, view, TURN)
    assert table.mask.any()
    shown = table.apply(direction_image(FISHEYE, channel)).astype(float)
    grid = np.stack(np.meshgrid(np.arange(view.width_px), np.arange(view.height_px)), axis=-1)
    rays, _ = view.unproject(grid.reshape(-1, 2).astype(float))
    expected = 20 + 100 * (1 + (rays @ TURN.T)[:, channel]).reshape(shown.shape)
    error = np.abs(shown - expected)[table.mask]
    assert np.percentile(error, 95) < 1.5  # half a grey value of rounding twice
    assert not shown[~table.mask].any()


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())
def test_views_invert_themselves(view: ViewGeometry) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [view.width_px - 1, view.height_px - 1], (200, 2))
    rays, valid = view.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays[valid], axis=1), 1, atol=1e-12)
    again, seen = view.project(3.0 * rays[valid])
    assert seen.all()
    np.testing.assert_allclose(again, pixels[valid], atol=1e-9)


@pytest.mark.parametrize("name", ["kb4 195", "mei 195", "scaramuzza 195", "ds 195", "pinhole", "kb4 ideal"])
def test_covering_views_show_every_ray_of_the_image(name: str) -> None:
    camera = LENSES[name]
    views = covering_views(camera)
    rng = np.random.default_rng(1)
    rays, valid = camera.unproject(rng.uniform([0, 0], [639, 479], (4000, 2)))
    rays = rays[valid]
    seen = np.zeros(len(rays), dtype=bool)
    for virtual in views.values():
        pixels, front = virtual.view.project(rays @ virtual.cam_from_view)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.51).all(axis=1)
            inside &= (pixels <= [virtual.view.width_px - 0.49, virtual.view.height_px - 0.49]).all(axis=1)
        seen |= front & inside
    assert seen.mean() > 0.998  # but for the outermost half pixel
    assert all(np.linalg.det(virtual.cam_from_view) == pytest.approx(1) for virtual in views.values())
    assert (len(views) > 1) == (camera.max_angle > np.deg2rad(50))


def test_outside_the_lens_nothing_is_shown() -> None:
    behind = so3.exp([0, np.pi, 0])
    table = remap_table(FISHEYE, VIEWS["pinhole"], behind)
    assert not table.mask.any()
    assert not table.apply(np.full((480, 640), 200, np.uint8)).any()


@pytest.mark.parametrize(
    ("model", "limit_px"),
    [
        ("kb4", 1e-9),
        ("kb23", 1e-9),
        ("ds", 0.2),
        ("mei", 0.2),
        ("scaramuzza", 0.5),
        ("eucm", 0.6),
        ("fov", 2.0),
    ],
)
def test_conversion_reports_its_true_residual(model: str, limit_px: float) -> None:
    converted = convert_camera(FISHEYE, model)
    rng = np.random.default_rng(3)
    pixels = rng.uniform([0, 0], [639, 479], (3000, 2))
    rays, valid = FISHEYE.unproject(pixels)
    valid[valid] = rays[valid][:, 2] > np.cos(converted.fitted_angle)
    again, _ = converted.camera.project(rays[valid])
    error = np.linalg.norm(again - pixels[valid], axis=1)
    assert converted.max_px < limit_px
    assert error.max() <= 1.1 * converted.max_px + 1e-9
    assert np.sqrt(np.mean(error**2)) == pytest.approx(converted.rms_px, rel=0.2, abs=1e-9)


def test_a_pinhole_takes_only_what_lies_in_front() -> None:
    assert isinstance(FISHEYE, Lens)
    converted = convert_camera(FISHEYE, "pinhole", np.deg2rad(45))
    assert converted.camera.max_angle <= np.deg2rad(45) + 1e-9
    assert converted.max_px < 0.5
    with pytest.raises(CameraError, match="sampled pixels"):
        convert_camera(FISHEYE, "pinhole", np.deg2rad(1))
