"""Lookups, the fused composition and what pictures of the views show."""

import json
import struct
import zlib
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrated_rigs import boat
from rigwake.errors import InputError, UsageError
from rigwake.tracking.masks import pixel_grid
from rigwake.views.blend import blended_still
from rigwake.views.compose import compose
from rigwake.views.draw import WaterUncertainty, near_sectors, ring_distances, water_uncertainty
from rigwake.views.frames import FrameSet, place
from rigwake.views.lookup import STEP, coarse_maps, interpolated_pixels
from rigwake.views.present import Decoration, Presenter
from rigwake.views.projections import (
    Bowl,
    CylinderView,
    EquirectangularView,
    TopDown,
    ViewProjection,
    VirtualCamera,
)
from rigwake.views.sphere_metadata import mark_picture, spherical_v1_box
from rigwake.views.surface import WaterAndShell, WaterAndStixels
from rigwake.views.surround_rig import SurroundRig
from rigwake.views.surround_view import SurroundView
from rigwake.views.video import video_file
from rigwake.views.weights import blending_weights, camera_quality
from view_scenes import HEIGHT_M, attitude, four_cameras, photograph, water_and_ring

VIEWS: list[ViewProjection] = [
    EquirectangularView(256, 128),
    CylinderView(256, 96),
    TopDown(128, 128, 9.0),
    Bowl(160, 96),
    VirtualCamera(160, 96, 40.0),
]


@pytest.fixture(scope="module")
def scene() -> tuple[SurroundRig, FrameSet]:
    rig = four_cameras()
    return rig, frame_set(rig, photograph(rig, attitude(5.0, -3.0), water_and_ring(12.0)))


STAND = attitude(5.0, -3.0)
RING = WaterAndStixels(np.full((360, 1), 12.0), np.full((360, 1), 4.0))


def frame_set(rig: SurroundRig, images: dict, missing: dict | None = None) -> FrameSet:
    stack = np.zeros((len(rig), 480, 640, 3), dtype=np.uint8)
    for index, name in enumerate(rig.names):
        if name in images and name not in (missing or {}):
            place(stack[index], images[name])
    return FrameSet(0, rig.names, stack, missing or {}, np.zeros(len(rig)))


def reference_picture(stack, lookup, usable) -> np.ndarray:
    """The same composition with float arithmetic, pixel by pixel, without any cleverness."""
    out = np.zeros((lookup.height_px, lookup.width_px, 3))
    total = np.zeros((lookup.height_px, lookup.width_px))
    v, u = np.indices(total.shape)
    i, j = v // STEP, u // STEP
    fy, fx = (v % STEP) / STEP, (u % STEP) / STEP
    corners = [
        ((0, 0), (1 - fx) * (1 - fy)),
        ((0, 1), fx * (1 - fy)),
        ((1, 0), (1 - fx) * fy),
        ((1, 1), fx * fy),
    ]
    for c in range(len(stack)):
        at = interpolated_pixels(lookup, c, np.stack([u, v], -1).reshape(-1, 2)).reshape(*u.shape, 2)
        weight = sum(lookup.weights[c][i + a, j + b] * w for (a, b), w in corners)
        x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
        inside = (x >= 0) & (y >= 0) & (x < stack.shape[2] - 1) & (y < stack.shape[1] - 1)
        shown = cv2.remap(usable[c], np.floor(x), np.floor(y), cv2.INTER_NEAREST) > 0
        weight = np.where(inside & shown, weight, 0.0)
        out += cv2.remap(stack[c].astype(np.float32), x, y, cv2.INTER_LINEAR) * weight[..., None]
        total += weight
    return out / np.maximum(total, 1e-9)[..., None]


@pytest.mark.parametrize("projection", VIEWS, ids=lambda p: type(p).__name__)
def test_fused_pass_equals_plain_arithmetic(scene, projection: ViewProjection) -> None:
    rig, frames = scene
    quality = camera_quality(rig)
    lookup = coarse_maps(rig, STAND, projection, WaterAndShell(), quality)
    fused = compose(frames.stack, lookup, quality.usable)
    plain = reference_picture(frames.stack, lookup, quality.usable)
    error = np.abs(fused.astype(float) - plain)
    assert np.median(error) < 1.0
    assert np.mean(error > 4.0) < 2e-3  # a pixel at the edge of the lens may fall on either side


@pytest.mark.parametrize(
    "projection", [EquirectangularView(), TopDown(), CylinderView()], ids=lambda p: type(p).__name__
)
def test_coarse_lookup_is_exact_to_a_twentieth_of_a_pixel(projection: ViewProjection) -> None:
    """Away from folds of the surface, where the water ends at the shell."""
    rig = four_cameras()
    surface, stand = WaterAndShell(60.0), STAND
    lookup = coarse_maps(rig, stand, projection, surface, camera_quality(rig))
    rng = np.random.default_rng(2)
    at = rng.integers(0, [projection.width_px - STEP, projection.height_px - STEP], (20_000, 2))
    points = projection.points_level(at.astype(float), stand, surface)
    out = np.hypot(points[:, 0], points[:, 1])
    fold = np.abs(out - 60.0) < 1e-6
    fold &= np.abs(np.arctan2(points[:, 2], out) + np.arctan2(HEIGHT_M, 60.0)) < np.deg2rad(1.6)
    fold |= (points[:, 2] < 0) & (out > 35) & (out < 59.9)
    i, j = at[:, 1] // STEP, at[:, 0] // STEP
    errors = []
    for c, cam_from_level in enumerate(rig.cam_from_level(stand.level_from_rig)):
        exact, valid = rig.models[c].project(cam_from_level * points)
        between = interpolated_pixels(lookup, c, at.astype(float))
        weight = np.min([lookup.weights[c][i + a, j + b] for a in (0, 1) for b in (0, 1)], axis=0)
        used = valid & (weight > 0) & ~fold & (out > 2.0)  # outside the own vessel
        errors.append(np.linalg.norm(between - exact, axis=1)[used])
    error = np.concatenate(errors)
    assert len(error) > 5000
    assert np.percentile(error, 99) < 0.05
    assert error.max() < 0.2


def test_panorama_shows_the_world_from_the_viewpoint(scene) -> None:
    rig, frames = scene
    view = SurroundView(rig, EquirectangularView(512, 256))
    picture = view.picture(frames, STAND, RING)
    pixels = pixel_grid(512, 256).astype(float)
    directions = EquirectangularView(512, 256).directions(pixels)
    expected = water_and_ring(12.0)(np.zeros_like(directions), directions).reshape(256, 512, 3)
    rows = slice(95, 160)
    assert np.median(np.abs(picture.astype(float) - expected)[rows]) < 3
    far = view.picture(frames, STAND, WaterAndShell(40.0))
    right, wrong = (np.abs(p.astype(float) - expected)[rows].mean() for p in (picture, far))
    assert wrong > 1.3 * right


def test_gains_brighten_and_saturate(scene) -> None:
    rig, frames = scene
    quality = camera_quality(rig)
    lookup = coarse_maps(rig, STAND, CylinderView(256, 96), WaterAndShell(), quality)
    plain = compose(frames.stack, lookup, quality.usable).astype(float)
    gains = np.tile(np.float32([1.5, 1.0, 0.5]), (4, 1))
    shading = np.full(lookup.weights.shape, 1.2, np.float32)
    changed = compose(frames.stack, lookup, quality.usable, gains, shading).astype(float)
    expected = np.minimum(plain * [1.8, 1.2, 0.6], 255)
    assert np.abs(changed - expected).mean() < 0.8
    assert np.abs(changed - expected).max() < 4


@given(st.integers(1, 5), st.floats(0.1, 20))
@settings(max_examples=20)
def test_weights_sum_to_one_or_zero(cameras: int, feather_deg: float) -> None:
    quality = np.random.default_rng(cameras).random((cameras, 9, 7)).astype(np.float32)
    quality[:, 0] = 0
    weights = blending_weights(quality, feather_deg)
    assert np.allclose(weights.sum(axis=0)[1:], 1, atol=1e-5)
    assert not weights[:, 0].any()
    best = quality[:, 1:].argmax(axis=0)
    assert (np.take_along_axis(weights[:, 1:], best[None], 0)[0] >= weights[:, 1:].max(axis=0) - 1e-6).all()


def test_missing_camera_is_named_and_replaced(scene) -> None:
    rig, frames = scene
    lost = frame_set(rig, frames.images(rig), {"front": "black"})
    presenter = Presenter(SurroundView(rig, CylinderView(512, 160)), Decoration())
    whole = presenter.picture(frames, STAND, RING)
    picture = presenter.picture(lost, STAND, RING)
    sectors = presenter.view.missing_sectors(lost, STAND, RING)
    assert set(np.unique(sectors)) == {-1, 0}
    columns = np.flatnonzero((sectors == 0).any(axis=0))
    assert 150 < columns.min() < columns.max() < 362  # ahead is in the middle
    assert (picture[sectors == 0] == (60, 150, 230)).all(axis=-1).mean() > 0.08  # hatched
    untouched = np.ones(512, dtype=bool)
    untouched[columns.min() - 60 : columns.max() + 60] = False
    assert np.array_equal(picture[:, untouched], whole[:, untouched])
    assert presenter.view.blind_azimuths_deg(frames, STAND) == []


def test_rig_of_one_camera(scene) -> None:
    rig, frames = scene
    one = SurroundRig(
        rig.names[:1], rig.models[:1], rig.rig_from_cam[:1], (0.0,), rig.viewpoint_rig, rig.forward_rig
    )
    view = SurroundView(one, EquirectangularView(256, 128))
    single = FrameSet(0, one.names, frames.stack[:1], {}, np.zeros(1))
    picture = view.picture(single, STAND, WaterAndShell())
    assert picture[64, 128].any()
    assert not picture[64, 0].any()
    blind = view.blind_azimuths_deg(single, STAND)
    assert len(blind) == 1
    begin, end = blind[0]
    assert 150 < end - begin < 210
    assert 60 < begin < 120


def test_careful_still_is_as_good_and_closes_astern(scene) -> None:
    rig, frames = scene
    view = SurroundView(rig, EquirectangularView(512, 256))
    careful = blended_still(view, frames, STAND, RING, wraps=True)
    live = view.picture(frames, STAND, RING)
    both = (careful.max(axis=2) > 0) & (live.max(axis=2) > 0)
    assert both.mean() > 0.95 * (live.max(axis=2) > 0).mean()
    assert np.median(np.abs(careful.astype(int) - live)[both]) <= 5
    step = np.abs(careful[100:150, 0].astype(int) - careful[100:150, -1]).mean()
    usual = np.abs(np.diff(careful[100:150].astype(int), axis=1)).mean()
    assert step < 3 * usual


def test_rings_bumper_and_uncertainty() -> None:
    assert ring_distances(25.0) == [5, 10, 15, 20, 25]
    assert all(len(ring_distances(r)) <= 6 for r in np.geomspace(1, 900, 60))
    uncertainty = WaterUncertainty(height_std_m=0.04, tilt_std=0.01)
    rng = np.random.default_rng(0)
    height = 2.0 + rng.normal(0, 0.04, 20_000)
    depression = np.arctan2(2.0, 20.0) + rng.normal(0, 0.001, 20_000)
    small = WaterUncertainty(height_std_m=0.04, tilt_std=0.001)
    assert np.std(height / np.tan(depression)) == pytest.approx(small.distance_std_m(20.0, 2.0), rel=0.05)
    assert uncertainty.distance_std_m(20, 2) > small.distance_std_m(20, 2)
    calibrated = water_uncertainty(attitude(), boat("base_link"), 0.05)
    assert calibrated.camera_tilt_std > 0
    assert calibrated.camera_height_std_m == pytest.approx(0.011, rel=0.6)
    distance = np.full((360, 1), np.nan)
    distance[90] = 3.0  # port: -90 + half a degree
    near = near_sectors(WaterAndStixels(distance, np.full((360, 1), 2.0)), 5.0)
    assert near.sum() == 1
    assert near[6]
    assert not near_sectors(WaterAndStixels(distance, np.full((360, 1), 2.0)), 2.0).any()


def test_top_view_puts_things_where_they_are(scene) -> None:
    """The foot of the ring stands at 12 m."""
    rig, frames = scene
    top = TopDown(400, 400, 16.0)
    presenter = Presenter(SurroundView(rig, top), Decoration())
    picture = presenter.picture(frames, STAND, RING)
    assert picture.shape == (400, 400, 3)
    assert np.allclose(top.metres(top.pixels(np.array([[3.0, -2.0]]))), [[3.0, -2.0]])
    near = SurroundView(rig, top).picture(frames, STAND, RING)
    for turn in np.deg2rad([20, 110, 200, 290]):
        out = np.arange(9.0, 15.0, 0.05)
        at = np.round(top.pixels(np.stack([out * np.cos(turn), out * np.sin(turn)], axis=1))).astype(int)
        grey = near[at[:, 1], at[:, 0]].mean(axis=1)
        # water in this world is chequered between 60 and 120 grey levels, times colours
        expected = water_and_ring(12.0)
        rays = np.stack([out * np.cos(turn), out * np.sin(turn), np.full(len(out), -HEIGHT_M)], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        seen = expected(np.zeros_like(rays), rays).mean(axis=1)
        wet = out < 11.5
        assert np.corrcoef(grey[wet], seen[wet])[0, 1] > 0.8


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_marked_pictures_hold_their_packet_and_still_decode(suffix: str) -> None:
    picture = np.random.default_rng(1).integers(0, 255, (64, 128, 3), dtype=np.uint8)
    encoded = cv2.imencode(suffix, picture)[1].tobytes()
    marked = mark_picture(encoded, 128, 64)
    assert np.array_equal(
        cv2.imdecode(np.frombuffer(marked, np.uint8), 1), cv2.imdecode(np.frombuffer(encoded, np.uint8), 1)
    )
    assert b"GPano:ProjectionType>equirectangular<" in marked
    if suffix == ".png":
        at = marked.index(b"iTXt")
        length = struct.unpack(">I", marked[at - 4 : at])[0]
        assert struct.unpack(">I", marked[at + 4 + length : at + 8 + length])[0] == zlib.crc32(
            marked[at : at + 4 + length]
        )
    with pytest.raises(InputError):
        mark_picture(b"GIF89a", 1, 1)


def boxes(content: bytes) -> list[tuple[bytes, bytes]]:
    found, at = [], 0
    while at + 8 <= len(content):
        size = struct.unpack(">I", content[at : at + 4])[0]
        if size < 8:
            break
        found.append((content[at + 4 : at + 8], content[at + 8 : at + size]))
        at += size
    return found


def inner(content: bytes, *path: bytes) -> bytes:
    for kind in path:
        content = dict(boxes(content))[kind]
    return content


def test_video_is_a_sphere_for_players(tmp_path: Path) -> None:
    path = tmp_path / "pano.mp4"
    with video_file(path, 128, 64, 10.0, is_sphere=True) as video:
        for k in range(12):
            video.write(np.full((64, 128, 3), 20 * k, np.uint8), 10**18 + k * 10**8)
    content = path.read_bytes()
    track = inner(content, b"moov", b"trak")
    assert any(kind == b"uuid" and b"<GSpherical:Spherical>true" in c for kind, c in boxes(track))
    entry = boxes(inner(track, b"mdia", b"minf", b"stbl", b"stsd")[8:])[0]
    assert entry[0] == b"avc1"
    visual = dict(boxes(entry[1][78:]))
    assert {b"avcC", b"st3d", b"sv3d"} <= visual.keys()
    projection = inner(visual[b"sv3d"], b"proj")
    assert {b"prhd", b"equi"} <= dict(boxes(projection)).keys()
    with av.open(str(path)) as video:
        frames = list(video.decode(video=0))
    assert len(frames) == 12
    assert frames[-1].time == pytest.approx(1.1, abs=1e-3)
    assert abs(int(frames[6].to_ndarray(format="bgr24").mean()) - 120) < 6
    assert spherical_v1_box()[4:8] == b"uuid"
    with pytest.raises(UsageError, match="even"), video_file(tmp_path / "odd.mp4", 127, 64, 10.0, False):
        pass
    assert json.dumps([p.name for p in tmp_path.iterdir()]) == '["pano.mp4"]'
