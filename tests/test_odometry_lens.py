"""A lens that is described wrong is noticed, and refined, by the motion alone."""

from dataclasses import replace

import numpy as np
import pytest

from odometry_worlds import circling, fisheye, tracks_of
from rigwake.odometry.monocular import estimate_monocular
from rigwake.odometry.self_calibration import refine_lens

FRAMES = 60


def seen_by(given, camera_truth, path):
    """Tracks of a camera that is believed to be `given`."""
    tracks = tracks_of(path, camera_truth, longest=40)
    bearings, valid = given.unproject(tracks.pixels)
    assert valid.all()
    return replace(tracks, bearings_cam=bearings)


@pytest.fixture(scope="module")
def seen_wrongly():
    """The true lens, the one given, tracks by the one given and what odometry makes of them."""
    true = fisheye()
    named = dict(zip(true.param_names, true.params, strict=True)) | {"k1": 0.02, "cx": 323.0}
    given = true.with_params(np.array(list(named.values())))
    tracks = seen_by(given, true, circling(FRAMES))
    return true, given, tracks, estimate_monocular(tracks, given)


def test_a_wrong_lens_is_refined_towards_the_true_one(seen_wrongly):
    true, given, tracks, visual = seen_wrongly
    lens = refine_lens(tracks, given, visual)
    assert lens is not None
    assert lens.gain > 0.1
    before = np.linalg.norm(given.project(tracks_bearings(true, tracks))[0] - tracks.pixels, axis=1)
    after = np.linalg.norm(lens.camera.project(tracks_bearings(true, tracks))[0] - tracks.pixels, axis=1)
    assert np.sqrt(np.mean(after**2)) < 0.3 * np.sqrt(np.mean(before**2))
    np.testing.assert_array_equal(lens.camera.params[:2], given.params[:2])  # the focal length is held
    np.testing.assert_allclose(lens.camera.unproject(tracks.pixels)[0], lens.tracks.bearings_cam)


def test_the_prior_stays_about_the_lens_believed_in_however_far_the_rounds_have_gone(seen_wrongly):
    true, given, tracks, visual = seen_wrongly
    about_given = refine_lens(tracks, given, visual)
    about_true = refine_lens(tracks, given, visual, believed=true)
    assert about_given is not None
    assert about_true is not None
    errors = [np.abs(lens.camera.params - true.params)[[2, 4]] for lens in (about_true, about_given)]
    assert np.all(errors[0] < errors[1])  # cx and k1


def tracks_bearings(camera, tracks):
    return camera.unproject(tracks.pixels)[0]


def test_the_right_lens_is_left_alone():
    tracks = tracks_of(circling(FRAMES), fisheye(), longest=40)
    assert refine_lens(tracks, fisheye(), estimate_monocular(tracks, fisheye())) is None
