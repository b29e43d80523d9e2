"""Registration of patches: against exact warps, other libraries and finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from rigwake.geometry import so3
from rigwake.tracking.interpolation import sample, sample_with_gradient, spline_coefficients
from rigwake.tracking.references import PatchShape, make_references
from rigwake.tracking.registration import register
from rigwake.tracking.warps import _nearest_rotation, dominant_rotation, rotation_warps, stencil_bearings
from tracking_scene import fisheye

SHAPE = PatchShape.disc(8)


def waves(x, y):
    """A smooth picture with detail down to 5 px, known everywhere."""
    total = np.zeros_like(x)
    for fx, fy, phase in (
        (1.1, 0.3, 0.1),
        (-0.5, 0.9, 1.0),
        (0.25, 0.6, 2.0),
        (0.8, -0.7, 0.5),
        (0.15, -0.2, 3.0),
    ):
        total = total + np.sin(fx * x + fy * y + phase)
    return 120 + 18 * total


GRID_X, GRID_Y = np.meshgrid(np.arange(120.0), np.arange(100.0))


def test_spline_coefficients_agree_with_scipy():
    image = np.random.default_rng(0).integers(0, 256, (40, 57)).astype(np.uint8)
    expected = ndimage.spline_filter(image.astype(float), 3, mode="mirror")
    np.testing.assert_allclose(spline_coefficients(image), expected, atol=2e-4)


@given(st.floats(2, 50), st.floats(2, 35))
@settings(max_examples=30)
def test_sampling_agrees_with_scipy_and_with_its_own_gradient(x, y):
    image = np.random.default_rng(1).integers(0, 256, (40, 57)).astype(np.uint8)
    coefficients = spline_coefficients(image).astype(float)
    value, by_x, by_y = sample_with_gradient(coefficients, x, y)
    expected = ndimage.map_coordinates(image.astype(float), [[y], [x]], order=3, mode="mirror")[0]
    assert value == pytest.approx(expected, abs=1e-3)
    assert sample(coefficients, np.float32(x), np.float32(y)) == pytest.approx(expected, abs=0.02)

    def slope(dx, dy):
        """Central difference per pixel; in single precision a smaller step would show rounding."""
        ahead = sample_with_gradient(coefficients, x + dx, y + dy)[0]
        return (ahead - sample_with_gradient(coefficients, x - dx, y - dy)[0]) / (2 * (dx + dy))

    h = 1e-2  # two steps, so that the third derivative (up to 4000) cancels; rounding leaves up to 0.1
    assert by_x == pytest.approx((4 * slope(h / 2, 0) - slope(h, 0)) / 3, abs=0.25)
    assert by_y == pytest.approx((4 * slope(0, h / 2) - slope(0, h)) / 3, abs=0.25)


small = st.floats(-0.08, 0.08)


@given(
    st.tuples(small, small, small, small),
    st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
    st.floats(0.6, 1.3),
    st.floats(-15, 15),
    st.tuples(st.floats(-0.006, 0.006), st.floats(-0.006, 0.006)),
)
@settings(max_examples=40)
def test_recovers_position_and_warp_whatever_the_light_does(bend, shift, gain, bias, falloff):
    centres = np.array([[40.0, 40.0], [70.0, 55.0], [55.0, 30.0]])
    first = waves(GRID_X, GRID_Y)
    warp = np.eye(2) + np.reshape(bend, (2, 2))
    # second(p) = light(p) * first(inverse warp of p), about the middle of the picture
    middle = np.array([55.0, 45.0])
    p = np.stack([GRID_X, GRID_Y], -1) - middle - shift
    source = p @ np.linalg.inv(warp).T + middle
    light = gain * (1 + falloff[0] * (GRID_X - 60) + falloff[1] * (GRID_Y - 50))
    second = light * waves(source[..., 0], source[..., 1]) * 0.8 + bias
    truth = (centres - middle) @ warp.T + middle + shift

    references, good = make_references(spline_coefficients(first), centres, SHAPE)
    assert good.all()
    start = truth + np.array([[0.7, -0.6], [-0.5, 0.8], [0.3, 0.4]])
    same = np.broadcast_to(np.eye(2), (3, 2, 2))
    seen = register(spline_coefficients(second), references, SHAPE, start, same, warp_prior_std=1.0)
    assert seen.found.all()
    assert np.abs(seen.pixels - truth).max() < 0.02
    assert np.abs(seen.warps - warp).max() < 0.01
    assert seen.correlation.min() > 0.99


def test_predicted_deviation_is_the_true_one():
    """Monte Carlo: the normalised squared error of the position averages to one."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(30, 95, 12.0), np.arange(30, 75, 12.0))
    centres = np.stack([x.ravel(), y.ravel()], 1)
    same = np.broadcast_to(np.eye(2), (len(centres), 2, 2))
    clean = waves(GRID_X, GRID_Y)
    scores = []
    for _ in range(25):
        first, second = (clean + rng.normal(0, 4, clean.shape) for _ in range(2))
        references, _ = make_references(spline_coefficients(first), centres, SHAPE)
        seen = register(spline_coefficients(second), references, SHAPE, centres, same, warp_prior_std=0.02)
        error = (seen.pixels - centres)[seen.found]
        scores.append((error**2).sum(axis=1) / 2 / seen.std_px[seen.found] ** 2)
    mean = np.concatenate(scores).mean()
    assert 0.7 < mean < 1.4


def test_patches_without_texture_or_outside_are_refused():
    flat = spline_coefficients(np.full((60, 80), 90, np.uint8))
    _, good = make_references(flat, np.array([[40.0, 30.0]]), SHAPE)
    assert not good.any()
    _, good = make_references(
        spline_coefficients(waves(GRID_X, GRID_Y)), np.array([[2.0, 30], [60, 99]]), SHAPE
    )
    assert not good.any()


def test_a_patch_that_left_the_image_or_went_dark_is_not_found():
    coefficients = spline_coefficients(waves(GRID_X, GRID_Y))
    references, _ = make_references(coefficients, np.array([[40.0, 40.0], [60.0, 60.0]]), SHAPE)
    same = np.broadcast_to(np.eye(2), (2, 2, 2))
    outside = np.array([[1.0, 40.0], [np.nan, 60.0]])
    assert not register(coefficients, references, SHAPE, outside, same, warp_prior_std=0.02).found.any()
    dark = spline_coefficients(np.zeros((100, 120)))
    here = np.array([[40.0, 40.0], [60.0, 60.0]])
    assert not register(dark, references, SHAPE, here, same, warp_prior_std=0.02).found.any()


@given(st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)))
@settings(max_examples=25)
def test_rotation_warp_is_the_derivative_of_where_pixels_go(turn):
    model = fisheye(640, 480)
    pixels = np.array([[330.0, 250.0], [200, 150], [450, 330]])
    rotation = so3.exp(np.array(turn))
    stencils, valid = stencil_bearings(model, pixels)
    assert valid.all()
    bearings, _ = model.unproject(pixels)
    warps, second_order, good = rotation_warps(
        model, stencils, np.broadcast_to(rotation, (3, 3, 3)), bearings @ rotation.T
    )
    assert good.all()

    def moved(offset):
        return model.project(model.unproject(pixels + offset)[0] @ rotation.T)[0]

    h = 0.01
    numeric = np.stack([(moved([h, 0]) - moved([-h, 0])), (moved([0, h]) - moved([0, -h]))], axis=2) / (2 * h)
    np.testing.assert_allclose(warps, numeric, atol=2e-3)
    here, h = moved([0, 0]), 0.5
    second_xx, second_yy = ((moved(h * e) + moved(-h * e) - 2 * here) / h**2 for e in np.eye(2))
    corners = [moved([h * x, h * y]) * x * y for x in (-1, 1) for y in (-1, 1)]
    second = np.stack([second_xx, sum(corners) / (2 * h) ** 2, second_yy], axis=2)
    np.testing.assert_allclose(second_order, second, atol=2e-4)


@given(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), st.integers(0, 100))
@settings(max_examples=20)
def test_dominant_rotation_outvotes_a_third_that_moves_otherwise(turn, seed):
    rng = np.random.default_rng(seed)
    before = rng.normal(size=(60, 3))
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    rotation = so3.exp(np.array(turn))
    after = before @ rotation.T
    after[:20] += 0.05 * rng.normal(size=(20, 3))
    after /= np.linalg.norm(after, axis=1, keepdims=True)
    found = dominant_rotation(before, after)
    assert np.linalg.norm(so3.log(found.T @ rotation)) < 2e-3
    np.testing.assert_array_equal(dominant_rotation(np.empty((0, 3)), np.empty((0, 3))), np.eye(3))


@pytest.mark.parametrize("kind", ["any", "mirrored", "of two bearings", "nothing"])
def test_the_nearest_rotation_is_that_of_the_singular_values(kind):
    rng = np.random.default_rng(3)
    for _ in range(50):
        moment = rng.normal(size=(3, 3)) if kind != "nothing" else np.zeros((3, 3))
        if kind == "mirrored":
            moment *= -np.sign(np.linalg.det(moment))
        if kind == "of two bearings":
            moment = rng.normal(size=(3, 2)) @ rng.normal(size=(2, 3))
        found = np.full((3, 3), np.nan)
        _nearest_rotation(moment, found)
        u, _, vt = np.linalg.svd(moment)
        u[:, 2] *= np.linalg.det(u) * np.linalg.det(vt)
        np.testing.assert_allclose(found, u @ vt, atol=1e-9)
