"""Gates that follow the noise of a stream, the scale of soft pictures, and patches renewed where points die young."""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
from rigwake.cameras.models.pinhole import Pinhole
from rigwake.errors import UsageError
from rigwake.geometry import so3
from rigwake.readers.open import open_recording
from rigwake.readers.truth_files import read_true_rig
from rigwake.recording import Recording
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.gates import StreamQuality, believed, largest_std_px
from rigwake.tracking.masks import lens_mask
from rigwake.tracking.picture_scale import ReducedRays, noise_std, octaves_to_skip, reduced, softness
from rigwake.tracking.registration import Registration
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracking.warps import rotation_warps, stencil_bearings
from semi_real import Cut, cut_recording, virtual_views, write_cut
from test_tracking_front_ends import errors_px
from tracking_scene import fisheye, random_texture, stream_of, turning_scene

OPTIONS = TrackingOptions()
PICTURE = cv2.resize(random_texture(5)[:1008, :1554], (740, 480), interpolation=cv2.INTER_AREA)


def soft(image, sigma):
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma)


def grey(image, noise=0.0, seed=0):
    noisy = image + np.random.default_rng(seed).normal(0, noise, image.shape) if noise else image
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def registration(correlation, noise, std_px=0.1, warp=1.0):
    return Registration(
        np.zeros((1, 2)), np.eye(2)[None] * warp, np.array([True]), np.array([correlation]), np.array([std_px]),
        np.array([noise]),
    )  # fmt: skip


def test_residuals_no_larger_than_the_streams_noise_are_believed():
    clean, noisy = StreamQuality(variance=1.0), StreamQuality(variance=64.0)
    doubtful = registration(correlation=0.85, noise=7.0)
    assert not believed(doubtful, clean, OPTIONS).any()
    assert believed(doubtful, noisy, OPTIONS).all()
    assert not believed(registration(correlation=0.85, noise=20.0), noisy, OPTIONS).any()
    # a patch that is all noise is not found again, however noisy the stream
    assert not believed(registration(correlation=0.4, noise=7.0), noisy, OPTIONS).any()
    assert not believed(registration(correlation=0.99, noise=0.5, warp=2.0), noisy, OPTIONS).any()


def test_the_largest_deviation_follows_the_stream_within_bounds():
    assert largest_std_px(StreamQuality(std_px=0.02), OPTIONS) == OPTIONS.max_std_px
    assert largest_std_px(StreamQuality(std_px=0.14), OPTIONS) == pytest.approx(0.35)
    assert largest_std_px(StreamQuality(std_px=5.0), OPTIONS) < 1.0
    known = StreamQuality(std_px=0.14)
    assert believed(registration(0.99, 1.0, std_px=0.3), known, OPTIONS).all()
    assert not believed(registration(0.99, 1.0, std_px=0.3), StreamQuality(), OPTIONS).any()


def test_a_streams_quality_is_learnt_from_medians_and_not_from_a_handful():
    rng = np.random.default_rng(0)
    start = StreamQuality()
    assert start.with_residuals(np.full(5, 50.0), np.full(5, 1.0)) is start
    variance = np.r_[rng.uniform(24, 26, 60), np.full(20, 1e4)]  # a quarter saw something else
    learnt = start.with_residuals(variance, np.full(80, 0.1))
    assert 24 < learnt.variance < 26.5
    assert learnt.std_px == pytest.approx(0.1)
    assert start.with_losses(np.ones(5, bool)) is start
    restless = start
    for _ in range(20):
        restless = restless.with_losses(np.arange(100) < 20)
    assert restless.lost == pytest.approx(0.2, abs=0.01)
    assert (restless.haste, start.haste) == (1.0, 0.0)


@pytest.mark.parametrize("noise", [0.0, 6.0])
def test_softness_tells_blur_whatever_the_noise(noise):
    assert softness(grey(PICTURE, noise)) < 1.6
    assert softness(grey(soft(PICTURE, 3.0), noise)) > 1.9
    flat = np.full((300, 400), 90.0)
    assert np.isnan(softness(grey(flat, noise)))
    assert noise_std(grey(flat, noise)) == pytest.approx(noise, rel=0.1)


def test_soft_streams_are_followed_at_half_their_size_and_small_ones_are_not():
    chosen = np.arange(3)
    streams = [stream_of([grey(image)] * 3) for image in (PICTURE, soft(PICTURE, 3.0))]
    assert [octaves_to_skip(stream, chosen) for stream in streams] == [0, 1]
    assert octaves_to_skip(stream_of([grey(soft(PICTURE, 3.0))[:300, :400]] * 3), chosen) == 0
    assert octaves_to_skip(streams[1], chosen[:0]) == 0


def test_reduced_rays_are_those_of_the_model():
    model = fisheye(640, 480)
    rays = ReducedRays(model, 2)
    pixels = np.array([[100.0, 90], [150, 120]])
    bearings, valid = rays.unproject(pixels)
    assert valid.all()
    np.testing.assert_allclose(rays.project(bearings)[0], pixels, atol=1e-9)
    np.testing.assert_array_equal(bearings, model.unproject(2 * pixels)[0])
    # a ramp keeps its values where `ReducedRays` says the pixels are
    ramp = np.tile(np.arange(0, 200, dtype=np.uint8), (200, 1))
    np.testing.assert_array_equal(reduced(ramp, 1)[50, 5:95], ramp[100, 10:190:2])


def test_points_of_soft_pictures_lie_where_they_are():
    scene = replace(turning_scene(4), model=fisheye(640, 480))
    images = [grey(soft(scene.image(k), 2.5), 1.5, seed=k) for k in range(4)]
    stream = stream_of(images, scene.model)
    assert octaves_to_skip(stream, np.arange(4)) == 1
    tracks = track_camera(stream, TrackingOptions(max_features=150))
    error, later = errors_px(scene, tracks)
    error, std = error[later], tracks.std_px[later]
    assert later.sum() > 200
    assert np.linalg.norm(np.median(error, axis=0)) < 0.03
    assert np.sqrt(np.median((error**2).sum(axis=1))) < 0.15
    assert 0.3 < np.median((error**2).sum(axis=1) / 2 / std**2) / np.log(2) < 3.0


def test_noise_blur_and_jpeg_cost_less_than_a_third_of_the_tracks():
    scene = turning_scene(14)
    clean = [scene.image(k) for k in range(14)]
    worn = []
    for k, image in enumerate(clean):
        encoded = cv2.imencode(".jpg", grey(soft(image, 0.7), 6.0, seed=k), [cv2.IMWRITE_JPEG_QUALITY, 70])[1]
        worn.append(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE))
    options = TrackingOptions(max_features=150)
    tracks = [track_camera(stream_of(images, scene.model), options) for images in (clean, worn)]
    long = [int((np.bincount(t.track_ids) >= 10).sum()) for t in tracks]
    assert long[0] > 60
    assert long[1] >= 0.7 * long[0]
    error, later = errors_px(scene, tracks[1])
    std = tracks[1].std_px[later]
    assert np.median(std) > 2 * np.median(tracks[0].std_px)
    assert 0.4 < np.median((error[later] ** 2).sum(axis=1) / 2 / std**2) / np.log(2) < 2.5


def approach(frames, growth):
    """A camera that runs at a wall: everything grows about the middle of the picture."""
    middle, texture = np.array([160.0, 120.0]), soft(random_texture(7)[200:680, 200:840], 1.2)
    images = []
    for k in range(frames):
        scale = 2.0 / growth**k
        matrix = np.array([[scale, 0, 320 - scale * 160], [0, scale, 240 - scale * 120]])
        image = cv2.warpAffine(texture, matrix, (320, 240), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
        images.append(grey(image, 1.0, seed=k))
    return stream_of(images, Pinhole((300.0, 300, *middle, *(6 * (0.0,))), 320, 240)), middle


def test_points_outlive_their_first_patch_where_patches_serve_only_for_a_few_frames():
    growth = 1.06
    stream, middle = approach(24, growth)
    tracks = track_camera(stream)
    _, first, track = np.unique(tracks.track_ids, return_index=True, return_inverse=True)
    age = tracks.frame_indices - tracks.frame_indices[first][track]
    assert growth ** age.max() > 1.2 * OPTIONS.max_stretch  # the first patch is refused long before
    truth = middle + (tracks.pixels[first][track] - middle) * growth ** age[:, None]
    error = np.linalg.norm(tracks.pixels - truth, axis=1)
    old = growth**age > 1.9
    assert old.sum() > 100
    assert np.median(error[old]) < 0.4
    # what renewed patches have added to the error is in the deviation
    assert np.median(tracks.std_px[old]) > 1.2 * np.median(tracks.std_px[(age > 0) & (age < 4)])
    assert np.median(error[old] ** 2 / 2 / tracks.std_px[old] ** 2) / np.log(2) < 4.0


def test_a_frame_that_shows_none_of_the_points_starts_anew():
    other = [grey(soft(random_texture(seed)[:240, :320], 1.0)) for seed in (1, 2)]
    stream = stream_of(
        [other[0], other[0].T.copy().reshape(240, 320), other[1], np.roll(other[1], 1, axis=1)]
    )
    tracks = track_camera(replace(stream, model=fisheye()), TrackingOptions(max_features=80))
    assert set(tracks.frame_indices) >= {2, 3}
    before, after = (set(tracks.track_ids[tracks.frame_indices == row]) for row in (0, 3))
    assert not before & after
    model, none = fisheye(), np.empty((0, 2))
    stencils, valid = stencil_bearings(model, none)
    warps, second_order, good = rotation_warps(model, stencils, np.empty((0, 3, 3)), np.empty((0, 3)))
    assert [len(a) for a in (stencils, valid, warps, second_order, good)] == [0] * 5


def test_a_dark_corner_of_a_room_is_not_taken_for_the_edge_of_the_lens():
    image = np.full((240, 320), 4, np.uint8)
    image[20:110, 20:300] = 120  # a wall; below it a dark floor with a bright thing on it
    image[200:225, 30:60] = 90
    image[195:230, 260:290] = 90
    room = lens_mask(stream_of([image] * 2)).excluded["lens"]
    assert not room[120:190, 40:280].any()
    circle = np.zeros((240, 320), np.uint8)
    cv2.circle(circle, (160, 120), 118, 120, -1)
    lens = lens_mask(stream_of([circle] * 2)).excluded["lens"]
    assert lens[5, 5]
    assert lens[120, 10]
    assert not lens[120, 160]


@pytest.mark.parametrize("lens", ["pinhole", "kb4"])
def test_views_cut_from_one_camera_do_not_meet_and_lie_in_its_picture(lens, tmp_path):
    real = Pinhole((300.0, 300, 319.5, 179.5, *(6 * (0.0,))), 640, 360)
    picture = grey(soft(PICTURE[:360, :640], 1.0))
    made, truth = cut_recording(
        Recording(tmp_path, "folder", {"front": stream_of([picture] * 2, real)}),
        "front", Cut(2, lens), antenna=np.zeros(3),
    )  # fmt: skip
    write_cut(made, truth, tmp_path / "cut")
    rig, read = read_true_rig(tmp_path / "cut" / "truth.yaml"), open_recording(tmp_path / "cut")
    assert read.true_rig is None  # the answer is not in the question
    left_from_right = rig.cameras["left"].rig_from_cam.inverse() * rig.cameras["right"].rig_from_cam
    np.testing.assert_array_equal(left_from_right.translation, 0)
    apart = np.linalg.norm(left_from_right.log()[:3])
    reaches = []
    for name, stream in read.cameras.items():
        image = next(stream.frames()).image
        height, width = image.shape
        bearings, valid = stream.model.unproject(np.array([[0.0, height / 2], [width - 1, height / 2]]))
        reaches.append(np.arccos(bearings[valid][:, 2]).max() if valid.any() else stream.model.max_angle)
        # what the view shows is what the real camera saw along the same rays
        pixel = np.array([[width / 2 - 20, height / 2 + 10.0]])
        turned = rig.cameras[name].rig_from_cam.rotation @ stream.model.unproject(pixel)[0][0]
        half = so3.exp(np.array([0.0, -apart / 2, 0.0]))
        seen = real.project((half @ turned)[None])[0][0]
        expected = cv2.getRectSubPix(picture, (1, 1), tuple(seen))[0, 0]
        x, y = pixel[0].astype(int)
        assert abs(int(image[y, x]) - int(expected)) <= 8
    assert apart > sum(reaches)


def test_too_many_views_are_refused():
    with pytest.raises(UsageError, match="do not make a rig"):
        virtual_views(Pinhole((1200.0, 1200, 319.5, 179.5, *(6 * (0.0,))), 640, 360), Cut(4))
