"""Masks: lens, own hull, horizon, sky and files."""

import cv2
import numpy as np
import pytest

from rigwake.errors import EstimationError, InputError, UnobservableError, UsageError
from rigwake.readers.open import open_recording
from rigwake.tracking.masks import (
    CameraMask,
    beyond_image_circle,
    beyond_lens,
    inside,
    lens_mask,
    mask_from_file,
)
from rigwake.tracking.self_mask import find_self_mask
from rigwake.tracking.water import HorizonMask
from tracking_scene import fisheye, stream_of, turning_scene


def scrolling(frames: int = 30) -> np.ndarray:
    """A random picture that scrolls by, in changing light."""
    wide = np.random.default_rng(0).normal(90, 60, (120, 160 + 6 * frames))
    wide = cv2.GaussianBlur(wide, (0, 0), 1.5)
    gains = 1 + 0.3 * np.sin(np.arange(frames))
    return np.clip([wide[:, 6 * k : 6 * k + 160] * gains[k] for k in range(frames)], 0, 255).astype(np.uint8)


def test_hull_is_what_stays_put():
    images = scrolling()
    truth = np.zeros((120, 160), np.uint8)
    cv2.fillPoly(truth, [np.array([[60, 119], [80, 70], [110, 119]])], 1)
    images[:, truth > 0] = np.where(np.arange(120) % 20 < 10, 230, 190)[:, None].repeat(160, 1)[truth > 0]
    hull = find_self_mask(stream_of(images), np.ones((120, 160), dtype=bool))
    assert hull[truth > 0].mean() > 0.98
    assert hull[truth == 0].mean() < 0.06


def test_without_a_hull_nothing_is_masked():
    hull = find_self_mask(stream_of(scrolling()), np.ones((120, 160), dtype=bool))
    assert hull.mean() < 0.01


def test_a_boat_that_does_not_turn_shows_no_hull():
    still = np.repeat(scrolling(1), 20, axis=0)
    with pytest.raises(UnobservableError, match="stands still"):
        find_self_mask(stream_of(still), np.ones((120, 160), dtype=bool))


def test_too_few_frames_for_a_hull():
    with pytest.raises(EstimationError, match="only 5 images"):
        find_self_mask(stream_of(scrolling(5)), np.ones((120, 160), dtype=bool))


def test_image_circle_is_found_by_its_darkness():
    images = scrolling()
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    outside = np.hypot(x - 80, y - 60) > 75
    images[:, outside] = 3
    found = beyond_image_circle(stream_of(images))
    assert found[outside].mean() > 0.99
    assert found[np.hypot(x - 80, y - 60) < 72].mean() < 0.01
    assert not beyond_image_circle(stream_of(np.zeros_like(images))).any()


def test_lens_mask_follows_the_model():
    stream = turning_scene(2).stream()
    region = lens_mask(stream).excluded["lens"]
    assert region[0, 0]
    assert not region[120, 160]
    assert (region | ~beyond_lens(fisheye())).all()


def test_horizon_of_a_level_camera():
    model = fisheye()
    below = HorizonMask(model, margin=0.0).below(np.array([0.0, -1, 0]))  # y down: up is -y
    assert below[122:, 160].all()
    assert not below[20:119, 160].any()
    tilted = HorizonMask(model).below(np.array([1.0, 0, 0]))  # lies on its side
    assert tilted[120, :150].all()
    assert not tilted[120, 175:300].any()


def test_high_is_fifteen_degrees_above_the_horizon():
    model = fisheye()
    high = HorizonMask(model).high(np.array([0.0, -1, 0]))
    bearings, _ = model.unproject(np.array([[160.0, row] for row in range(240)]))
    elevation = np.rad2deg(np.arcsin(-bearings[:, 1]))
    assert high[elevation > 17, 160].all()
    assert not high[elevation < 13, 160].any()


def test_sky_is_smooth_and_reaches_up_but_houses_stay():
    model = fisheye()
    image = np.full((240, 320), 180, np.uint8)
    rng = np.random.default_rng(0)
    image[90:] = rng.integers(0, 255, (150, 320))
    image[60:90, 100:140] = rng.integers(0, 255, (30, 40))
    sky = HorizonMask(model).sky(image, np.array([0.0, -1, 0]))
    assert sky[20:55, 120:200].all()
    assert sky[65:85, 160:200].all()
    assert sky[62:88, 102:138].mean() < 0.1
    assert not sky[92:].any()


def test_mask_files_round_trip(tmp_path):
    region = np.zeros((24, 32), dtype=bool)
    region[10:, 5:9] = True
    mask = CameraMask(32, 24).with_region("hull", region)
    written = mask.save(tmp_path, "front")
    assert sorted(p.name for p in written) == ["front.png", "front_hull.png"]
    loaded = mask_from_file(tmp_path / "front.png", 32, 24)
    np.testing.assert_array_equal(loaded.usable, ~region)
    assert list(loaded.excluded) == ["file"]


def test_wrong_mask_files_are_refused(tmp_path):
    (tmp_path / "text.png").write_text("no picture")
    for name in ("text.png", "missing.png"):
        with pytest.raises(InputError, match="not an image"):
            mask_from_file(tmp_path / name, 32, 24)
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((5, 5), np.uint8))
    with pytest.raises(UsageError, match="5x5 pixels"):
        mask_from_file(tmp_path / "small.png", 32, 24)


def test_inside_asks_image_and_mask():
    usable = np.ones((10, 20), dtype=bool)
    usable[5, 7] = False
    pixels = np.array([[0, 0], [7.2, 4.9], [19.4, 9.4], [19.6, 3], [-0.6, 3], [np.nan, 2]])
    np.testing.assert_array_equal(inside(usable, pixels), [True, False, True, False, False, False])


@pytest.mark.parametrize("camera", ["front", "left", "back", "right"])
def test_hull_of_the_harbour_recording(real_recordings, camera):
    folder = real_recordings / "harbour_a"
    recording = open_recording(folder / "harbour_a.bag")
    stream = next(s for name, s in recording.cameras.items() if camera in name)
    labels = cv2.imread(str(folder / f"truth_labels_{camera}.png"), cv2.IMREAD_GRAYSCALE)
    usable = lens_mask(stream).usable
    hull = find_self_mask(stream, usable)
    assert (hull | ~usable)[labels == 240].mean() > 0.97
    assert hull[labels == 60].mean() < 0.01
    assert hull[labels == 180].mean() < 0.08
