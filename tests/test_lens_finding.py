"""Lenses found from a field of view, what was tracked, and the gyroscope."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from rigwake._types import Array
from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.moved_lens import moved_lens
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import RigwakeError, UsageError
from rigwake.geometry import so3
from rigwake.pipeline.lens_finding import field_across_deg, lens_from_tracks, starting_lens
from rigwake.plausibility.view_pairs import pixel_distances, rays_of
from rigwake.recording import CameraStream, Frame, main_imu
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.tracks_only import SimulatedTracks, simulate_tracks

KB4 = {
    "fx": 176.3,
    "fy": 176.2,
    "cx": 281.2,
    "cy": 208.4,
    "k1": -0.011,
    "k2": 0.006,
    "k3": -0.0034,
    "k4": 5e-4,
}
MEI = {
    "fx": 350.0,
    "fy": 350.4,
    "cx": 275.0,
    "cy": 214.0,
    "xi": 1.0,
    "k1": -0.02,
    "k2": 4e-3,
    "p1": 2e-4,
    "p2": -3e-4,
}
PINHOLE = {
    "fx": 300.0,
    "fy": 300.5,
    "cx": 284.0,
    "cy": 204.0,
    "k1": -0.06,
    "k2": 0.02,
    "p1": 3e-4,
    "p2": -2e-4,
}
SEEN_BY = {"kb4": (KB4, 186.0), "mei": (MEI, 170.0), "pinhole": (PINHOLE, 110.0)}


def world_seen_by(model: str) -> SimulatedTracks:
    document = load_scenario("demo").model_dump()
    params, fov_deg = SEEN_BY[model]
    held = {"pinhole": {"skew": 0.0, "k3": 0.0}, "mei": {"k3": 0.0}}.get(model, {})
    lens = {"model": model, "params": params | held, "fov_deg": fov_deg}
    document["cameras"] = [{**document["cameras"][0], **lens}]
    document["tracking"] |= {"features": 100, "landmarks": 1500, "outliers": 0.01, "water": 0.0}
    return simulate_tracks(build_scenario(document, "test"))


def off_px(true: CameraModel, found: CameraModel, pixels: Array) -> float:
    """RMS distance over the pixels in use, less the turn of the camera that takes most of it up."""
    (true_rays, seen), (rays, also) = true.unproject(pixels), found.unproject(pixels)
    both = seen & also
    assert both.mean() > 0.9
    turn = so3.nearest_rotation(rays[both].T @ true_rays[both])
    landed, valid = found.project(true_rays[both] @ turn.T)
    return float(np.sqrt(np.mean(np.sum((landed - pixels[both])[valid] ** 2, axis=1))))


@dataclass(frozen=True)
class LitCircle:
    """Pictures of a lens that lights a circle about `centre`."""

    centre: tuple[float, float] = (300.0, 200.0)
    radius_px: float = 230.0

    def frames(self, indices, *, colour=False):
        x, y = np.meshgrid(np.arange(560), np.arange(420))
        lit = np.hypot(x - self.centre[0], y - self.centre[1]) <= self.radius_px
        for index in indices:
            yield Frame(int(index), int(index), np.where(lit, 90, 0).astype(np.uint8))


@pytest.mark.slow
@pytest.mark.parametrize(("model", "wrong"), [("kb4", 1.1), ("kb4", 0.9), ("mei", 0.9), ("pinhole", 1.1)])
def test_a_lens_is_found_from_a_field_of_view_ten_per_cent_off(model: str, wrong: float) -> None:
    world = world_seen_by(model)
    stream, tracks = world.recording.cameras["front"], world.tracks["front"]
    imu, true = main_imu(world.recording), stream.model
    assert imu is not None
    assert true is not None
    lit = replace(stream, source=LitCircle(radius_px=1e6), model=None)
    start = starting_lens(lit, wrong * field_across_deg(true))
    found = lens_from_tracks(tracks, start, imu)
    assert abs(axis_focal_px(start) / axis_focal_px(true) - 1) > 0.05
    # near enough for the rig to refine it: the noise of tracks at 6 Hz pulls it
    assert off_px(true, found.found.lens, tracks.pixels) < 4.0
    assert abs(axis_focal_px(found.found.lens) / axis_focal_px(true) - 1) < 0.025
    judged = {score.model: score.held_out_px for score in found.scores if score.found is not None}
    assert judged[found.found.lens.model] <= 1.02 * min(judged.values())
    assert found.found.lens.model in found.words


def stream_of(source: object, model: CameraModel | None = None) -> CameraStream:
    return CameraStream("bow", np.arange(20), source, 560, 420, model)  # type: ignore[arg-type]


def test_an_image_circle_tells_centre_and_scale() -> None:
    lens = starting_lens(stream_of(LitCircle()), 200.0)
    assert lens.model == "kb4"
    pixels, _ = lens.project(np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(pixels[0], [300.0, 200.0], atol=4.0)
    assert axis_focal_px(lens) == pytest.approx(230.0 / np.deg2rad(100.0), rel=0.03)
    assert axis_focal_px(starting_lens(stream_of(LitCircle()), None)) == pytest.approx(
        230.0 / (np.pi / 2), rel=0.03
    )


def test_nothing_tells_where_to_start() -> None:
    with pytest.raises(UsageError, match="--fov bow=90"):
        starting_lens(stream_of(LitCircle(radius_px=1e6)), None)


def test_distances_of_pairs_are_in_pixels() -> None:
    lens = camera_from_params("kb4", list(KB4.values()), 560, 420)
    pixels = np.random.default_rng(3).uniform([20, 20], [540, 400], (2, 60, 2))
    R, t, pair = so3.exp(np.array([[0.1, -0.2, 0.05]])), np.array([[0.6, 0.0, 0.8]]), np.zeros(60, np.int64)
    a, b = (rays_of(lens, p) for p in pixels)
    assert (a.seen & b.seen).all()
    moved, _ = lens.unproject(pixels[0] + [1e-4, 0.0])
    np.testing.assert_allclose((moved - a.bearings) / 1e-4, a.by_pixels[:, :, 0], atol=1e-6)
    # a lens twice as long sees the same things twice as far off: in angles they would be equal
    longer = moved_lens(lens, 2.0, [0.0, 0.0])
    centre = lens.params[2:4]
    doubled = (rays_of(longer, centre + 2 * (p - centre)) for p in pixels)
    np.testing.assert_allclose(
        pixel_distances(*doubled, R, t, pair), 2 * pixel_distances(a, b, R, t, pair), rtol=1e-6
    )


def test_a_gyroscope_of_another_vessel_tells_no_lens() -> None:
    world = world_seen_by("kb4")
    imu, stream = main_imu(world.recording), world.recording.cameras["front"]
    assert imu is not None
    assert stream.model is not None
    other = replace(imu, gyro=np.random.default_rng(1).normal(0, 0.3, imu.gyro.shape))
    with pytest.raises(RigwakeError):
        lens_from_tracks(world.tracks["front"], stream.model, other)
