"""How true the pictures are: corners against projections, image motion against geometry.

Measured by the tests and printed by `benchmarks/simulator.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Floats
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry.se3 import SE3
from rigwake.simulation import shading
from rigwake.simulation.hull_mesh import Hull, Tube
from rigwake.simulation.meshes import join, rectangle
from rigwake.simulation.record import Shot
from rigwake.simulation.render import Renderer
from rigwake.simulation.scenario import Sea, Weather
from rigwake.simulation.scenery import Scenery
from rigwake.simulation.textures import Atlas, build_atlas
from rigwake.simulation.waves import SelfMaskResponse, build_wave_field

_BOARD_M = 2.0
_BOARD_PX = 34.0
_SPACING_PX = 58
_WINDOW_PX = 6
_BLUR_PX = 0.5
_CAMERA_HEIGHT_M = 300.0
_IDEAL_SAMPLES = 8  # per pixel and direction
_FLOW_RIM_PX = 3
_PATCH_PX = 15  # of the tracks
_BLACK, _WHITE = 0.027, 0.9  # of the chequered texture
_OUT_OF_SIGHT = Hull(
    (Tube((0, 0, -2000), (0, 0, -2001), 0.1, 0.1, (1, 1, 1)),), SelfMaskResponse(1, 1, (1, 1, 1), (1, 1, 1))
)


@dataclass(frozen=True, eq=False)
class CornerErrors:
    """Detected minus projected corner positions (N, 2), in the rendered and in an ideal analytic picture; angles
    (N,) off the axis, degrees."""

    rendered_px: Array
    ideal_px: Array
    angles_deg: Array


@dataclass(frozen=True, eq=False)
class _Boards:
    """Chequered boards around a camera at the origin of `world_from_cam`: corner points, axes (N, 3), pixels (N, 2)."""

    centres_cam: Array
    across_cam: Array
    up_cam: Array
    pixels: Array


def corner_errors(model: CameraModel, samples: int, seed: int = 0) -> CornerErrors:
    """Corners of boards all over the image, rendered with `samples` rays per pixel and found by the same detector
    as in an analytic picture of the same boards."""
    boards = _place_boards(model, np.random.default_rng(seed))
    world_from_cam = SE3(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0, 0, _CAMERA_HEIGHT_M]))
    atlas = _unweathered_atlas()
    lower_left = world_from_cam * (boards.centres_cam - (boards.across_cam + boards.up_cam) * _BOARD_M / 2)
    across = boards.across_cam @ world_from_cam.rotation.T * _BOARD_M
    up = boards.up_cam @ world_from_cam.rotation.T * _BOARD_M
    meshes = [
        rectangle(corner, a, b, atlas.number("checker"), cell_m=_BOARD_M)
        for corner, a, b in zip(lower_left, across, up, strict=True)
    ]
    scenery = Scenery(join(meshes), atlas, np.empty((0, 3)))
    renderer = Renderer(scenery, build_wave_field(Sea(hs_m=0.0), seed), Weather(), seed)
    # evenly lit: a shadow's edge across a board would move the corner in any picture
    renderer.surfaces = renderer.surfaces._replace(light=np.ones_like(renderer.surfaces.light))
    view = renderer.view(model, SE3.identity(), _OUT_OF_SIGHT, samples)
    light = renderer.render(view, world_from_cam, renderer.water(0.0))[..., 1]
    rendered = _detect(light, boards.pixels)
    ideal = np.array([_ideal_corner(model, boards, i) for i in range(len(boards.pixels))])
    angles = np.rad2deg(
        np.arccos(boards.centres_cam[:, 2] / np.linalg.norm(boards.centres_cam, axis=1)),
    )
    return CornerErrors(rendered - boards.pixels, ideal - boards.pixels, angles)


@cache
def _unweathered_atlas() -> Atlas:
    """Textures without the pattern that lies over them all: the corner alone is to be measured."""
    atlas = build_atlas(0, contrast=1.0)
    texels = atlas.texels.copy()
    texels[atlas.starts[-1, 0] :] = 1.0
    return replace(atlas, texels=texels)


def _place_boards(model: CameraModel, rng: np.random.Generator) -> _Boards:
    """Boards on a jittered grid of pixels, turned at random, facing the camera, of the same size in the image."""
    u, v = np.meshgrid(
        np.arange(30.0, model.width_px - 30, _SPACING_PX), np.arange(30.0, model.height_px - 30, _SPACING_PX)
    )
    pixels = np.stack([u.ravel(), v.ravel()], 1) + rng.uniform(-4, 4, (u.size, 2))
    ring = 26.0 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    seen = np.all([model.unproject(pixels + step)[1] for step in ring], axis=0)
    pixels = pixels[seen]
    rays, _ = model.unproject(pixels)
    width = np.linalg.norm(model.unproject(pixels + np.array([0.5, 0.0]))[0] - rays, axis=1) * 2
    helper = rng.standard_normal(rays.shape)
    across = np.cross(helper, rays)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    # outside is across x up: towards the camera
    up = np.cross(-rays, across)
    distance = _BOARD_M / (_BOARD_PX * width)
    return _Boards(rays * distance[:, None], across, up, pixels)


def _detect(grey: Floats, near: Array) -> Array:
    blurred = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)
    start = np.round(near).astype(np.float32).reshape(-1, 1, 2).copy()
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    found = cv2.cornerSubPix(blurred.astype(np.float32), start, (_WINDOW_PX, _WINDOW_PX), (-1, -1), criteria)
    return np.asarray(found[:, 0], np.float64)


def _ideal_corner(model: CameraModel, boards: _Boards, i: int) -> Array:
    """The corner of board i in a patch whose every pixel averages exact ray-plane intersections."""
    reach = _WINDOW_PX + 6
    origin = np.round(boards.pixels[i]) - reach
    size = 2 * reach + 1
    fine = (np.arange(size * _IDEAL_SAMPLES) + 0.5) / _IDEAL_SAMPLES - 0.5
    u, v = np.meshgrid(origin[0] + fine, origin[1] + fine)
    rays, _ = model.unproject(np.stack([u.ravel(), v.ravel()], 1))
    normal, centre = np.cross(boards.across_cam[i], boards.up_cam[i]), boards.centres_cam[i]
    points = rays * ((centre @ normal) / (rays @ normal))[:, None] - centre
    a, b = points @ boards.across_cam[i], points @ boards.up_cam[i]
    colour = np.where((a < 0) == (b < 0), _WHITE, _BLACK)
    patch = colour.reshape(size, _IDEAL_SAMPLES, size, _IDEAL_SAMPLES).mean(axis=(1, 3))
    return np.asarray(_detect(patch.astype(np.float32), (boards.pixels[i] - origin)[None])[0] + origin)


@dataclass(frozen=True, eq=False)
class MotionAgreement:
    """How image motion between two frames agrees with the motion that geometry demands of things at rest.

    flow_error_px: (N,) dense optical flow against truth on land. land, water: fraction of KLT tracks that agree to
    1 px; counts of such tracks.
    """

    flow_error_px: Array
    land_fraction: float
    water_fraction: float
    land_tracks: int
    water_tracks: int


def motion_agreement(shot: Shot, truth_shot: Shot, first: int, second: int) -> MotionAgreement:
    """Compare frames `first` and `second` of a camera. `truth_shot`: the same camera with one ray per pixel."""
    renderer = shot.renderer
    times = shot.simulation.scene_times_s(shot.camera)
    seas = [renderer.water(float(times[i])) for i in (first, second)]
    pictures = []
    for index, sea in zip((first, second), seas, strict=True):
        picture = cv2.imdecode(
            np.frombuffer(shot.take(index, float(times[index]), sea), np.uint8), cv2.IMREAD_GRAYSCALE
        )
        assert picture is not None
        pictures.append(picture)
    seen = renderer.truth(truth_shot.view, shot.row_poses(float(times[first])), seas[0])
    later = renderer.truth(truth_shot.view, shot.row_poses(float(times[second])), seas[1])
    turned, expected, visible = _static_motion(
        shot, seen.ranges_m, later.ranges_m, float(times[first]), float(times[second])
    )
    dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dense.setFinestScale(0)
    flow = dense.calc(pictures[0], pictures[1], np.zeros((*pictures[0].shape, 2), np.float32))
    on_land, on_water = seen.labels == shading.LAND, seen.labels == shading.WATER
    flow_error = np.linalg.norm(flow - expected, axis=-1)[_inner(on_land, _FLOW_RIM_PX) & visible]
    land, n_land = _klt_fraction(pictures, turned, expected, _inner(on_land, _PATCH_PX // 2) & visible)
    water, n_water = _klt_fraction(pictures, turned, expected, _inner(on_water, _PATCH_PX // 2))
    return MotionAgreement(flow_error, land, water, n_land, n_water)


def _inner(mask: NDArray[np.bool_], rim_px: int) -> NDArray[np.bool_]:
    """The mask without its rim: a patch on an outline sees two things at once."""
    return cv2.erode(mask.astype(np.uint8), np.ones((2 * rim_px + 1, 2 * rim_px + 1), np.uint8)) > 0


def _static_motion(
    shot: Shot, ranges: Floats, later: Floats, first_s: float, second_s: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Displacement (H, W, 2) in the image by the camera's turn alone, of what each pixel sees, were it at rest, and
    whether it is still seen."""
    camera = shot.simulation.rig.camera(shot.camera.name)
    assert camera.model is not None
    height, width = ranges.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([u.ravel(), v.ravel()], 1)
    rays, valid = camera.model.unproject(pixels)
    motion = shot.simulation.motion
    before, after = (motion.world_from_rig(np.array(t)) * camera.rig_from_cam for t in (first_s, second_s))
    distance = np.where(np.isfinite(ranges), ranges, np.nan).ravel()
    after_from_before = after.inverse() * before
    points = after_from_before * (rays * distance[:, None])
    known = valid & np.isfinite(points).all(axis=1)
    projected, ok = camera.model.project(np.where(known[:, None], points, 1.0))
    ok &= known
    at = np.where(ok[:, None], np.round(projected), 0).astype(int).clip(0, [width - 1, height - 1])
    nearer = later[at[:, 1], at[:, 0]] < 0.97 * np.linalg.norm(points, axis=1) - 0.1
    inside = np.all((projected > 8) & (projected < [width - 9, height - 9]), axis=1)
    visible = ok & inside & ~nearer
    far, _ = camera.model.project(np.where(valid[:, None], rays @ after_from_before.rotation.T, 1.0))
    moved = [(at - pixels).reshape(height, width, 2) for at in (far, projected)]
    return moved[0], moved[1], visible.reshape(height, width)


def _klt_fraction(
    pictures: list[NDArray[np.uint8]], turned: Array, expected: Array, mask: NDArray[np.bool_]
) -> tuple[float, int]:
    """Fraction of forward-backward-checked KLT tracks that move as expected, to 1 px, and their number.

    They start from where the camera's turn alone takes them, as with a gyro, and need no pyramid: in its coarse
    levels the black rim of the image circle, which does not move, would be in many patches.
    """
    first, second = pictures
    corners = cv2.goodFeaturesToTrack(first, 600, 0.005, 7, mask=mask.astype(np.uint8), blockSize=5)
    if corners is None:
        return float("nan"), 0
    at = np.round(corners[:, 0]).astype(int)
    turn = turned[at[:, 1], at[:, 0]][:, None].astype(np.float32)
    window, flags = (_PATCH_PX, _PATCH_PX), cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, corners, corners + turn, winSize=window, maxLevel=0, flags=flags
    )
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, there, there - turn, winSize=window, maxLevel=0, flags=flags
    )
    kept = (found & found_back).ravel().astype(bool) & (np.linalg.norm(back - corners, axis=-1).ravel() < 0.5)
    error = np.linalg.norm((there - corners)[:, 0] - expected[at[:, 1], at[:, 0]], axis=1)
    known = kept & np.isfinite(error)
    return float(np.mean(error[known] < 1.0)) if known.any() else float("nan"), int(known.sum())
