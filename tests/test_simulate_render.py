"""Pictures of the simulator: corners, image motion, noise, determinism, and the way through files."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from camera_lenses import LENSES
from rigwake.cameras.registry import CAMERA_CLASSES
from rigwake.cli.main import build_app
from rigwake.readers.open import open_recording
from rigwake.readers.truth_files import read_true_rig
from rigwake.simulation.hull_mesh import build_hull
from rigwake.simulation.imaging import develop, vignetting
from rigwake.simulation.record import Shot, build_world, render_recording, work_folder
from rigwake.simulation.render import Renderer
from rigwake.simulation.scenario import ImageNoise, Scenario, Scene, Sea, build_scenario, load_scenario
from rigwake.simulation.scene_layout import build_layout
from rigwake.simulation.scenery import KeepClear, build_scenery
from rigwake.simulation.sea_surface import meet_water, water_at
from rigwake.simulation.setup import Simulation, prepare
from rigwake.simulation.shading import HULL, LAND, SKY, WATER
from rigwake.simulation.skyline import gather_boxes, in_band, seen_band
from rigwake.simulation.textures import build_atlas
from rigwake.simulation.truth_writer import truth_to_dict, write_truth
from rigwake.simulation.waves import build_wave_field
from simulation_selfcheck import corner_errors, motion_agreement


def small(**changes: object) -> Scenario:
    """A bare harbour seen by two small cameras for a second and a half: quick to build and to render."""
    plain = load_scenario("demo").model_dump()
    shrunk = {"width_px": 160, "height_px": 120, "rate_hz": 4.0}
    lens = {"fx": 50.0, "fy": 50.0, "cx": 79.5, "cy": 59.5, "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}
    plain["cameras"] = [camera | shrunk | {"params": lens} for camera in plain["cameras"][:2]]
    plain |= {"duration_s": 1.5, "scene": plain["scene"] | {"density": 0.15}} | changes
    return build_scenario(plain)


@pytest.mark.slow
def test_textures_keep_their_mean_colour_at_any_distance() -> None:
    atlas = build_atlas(3, contrast=1.0)
    for number in range(len(atlas.names)):
        full, coarsest = atlas.starts[number, 0], atlas.starts[number, -1]
        count = atlas.sizes[number, 0] ** 2
        np.testing.assert_allclose(
            atlas.texels[full : full + count].mean(0), atlas.texels[coarsest], rtol=1e-3
        )
        assert atlas.sizes[number, -1] == 1


@cache
def sea_at_three_seconds():  # type: ignore[no-untyped-def]
    return water_at(SEA, 3.0), SEA.components()


@settings(max_examples=40)
@given(
    east=st.floats(-300, 300),
    north=st.floats(-300, 300),
    azimuth=st.floats(0, 6.28),
    down_deg=st.floats(12, 90),
)
def test_rays_end_on_the_surface_of_the_sea(
    east: float, north: float, azimuth: float, down_deg: float
) -> None:
    water, (k, omega, amplitude) = sea_at_three_seconds()
    down = np.deg2rad(down_deg)
    ray = np.array([np.cos(azimuth) * np.cos(down), np.sin(azimuth) * np.cos(down), -np.sin(down)])
    t = meet_water(water, east, north, 2.0, *ray, 1e-4, 0.5)[0]
    at = np.array([east, north, 2.0]) + t * ray
    phase = k @ at[:2] - omega * 3.0
    height = (amplitude * np.exp(1j * phase)).real
    long_waves = np.linalg.norm(k, axis=1) < 2 * np.pi / 37.3 * 64  # what the two longer tiles resolve well
    assert at[2] == pytest.approx(height[long_waves].sum(), abs=0.02)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    spread_m=st.sampled_from([4.0, 40.0, 900.0]),
    size_m=st.sampled_from([0.5, 6.0, 80.0]),
    height_m=st.floats(-1.0, 30.0),
)
def test_rays_that_are_not_cast_would_hit_nothing(
    seed: int, spread_m: float, size_m: float, height_m: float
) -> None:
    """Whatever lies on a triangle above the water is inside the band of elevations that is cast."""
    rng = np.random.default_rng(seed)
    triangles = rng.uniform(-spread_m, spread_m, (40, 1, 3)) * [1, 1, 0.1]
    triangles = (triangles + rng.uniform(-size_m, size_m, (40, 3, 3))).astype(np.float32)
    centres = np.array([0.3, -1.0, height_m]) + rng.uniform(-0.1, 0.1, (5, 3))
    depth_m = 1.0
    band = seen_band(gather_boxes(triangles), centres, depth_m)
    corners = rng.dirichlet(np.ones(3), (20, 40))
    points = np.einsum("pnc,nca->pna", corners, triangles).reshape(-1, 3)
    rays = (points - centres[rng.integers(5, size=len(points))])[points[:, 2] > -depth_m]
    assert all(in_band(band, *ray) for ray in (rays / np.linalg.norm(rays, axis=1, keepdims=True)).tolist())


def test_the_open_sky_and_the_water_at_the_bow_are_not_cast() -> None:
    quay = np.array([[[50.0, -20, 0], [50, 20, 0], [50, 0, 8]]], np.float32)
    band = seen_band(gather_boxes(quay), np.array([[0.0, 0, 2]]), 0.3)
    assert in_band(band, 1.0, 0.0, 0.05)
    assert not in_band(band, 1.0, 0.0, 0.3)
    assert not in_band(band, 1.0, 0.0, -0.2)
    assert not in_band(band, -1.0, 0.0, 0.0)


SEA = build_wave_field(Sea(hs_m=0.3, tp_s=3.5), 5)


def test_a_picture_has_the_noise_that_was_asked_for() -> None:
    rng = np.random.default_rng(0)
    grey = np.full((200, 300, 3), 0.3, np.float32)
    flat = np.ones((200, 300), np.float32)
    noise = ImageNoise(read_std=2.0, shot=0.05, blur_px=0.0)
    picture = develop(grey, noise, flat, 0.0, 0.0, rng).astype(float)
    expected = np.hypot(np.sqrt(2.0**2 + 0.05 * picture.mean()), np.sqrt(1 / 12))
    assert picture.std() == pytest.approx(expected, rel=0.03)


def test_vignetting_and_exposure_darken_as_asked() -> None:
    lens = LENSES["kb4 195"]
    loss = vignetting(lens, 0.4)
    assert loss.max() == pytest.approx(1.0, abs=1e-3)
    edge, valid = lens.project(np.array([[np.sin(1.2), 0.0, np.cos(1.2)]]))
    assert valid.all()
    at = loss[round(edge[0, 1]), round(edge[0, 0])]
    assert at == pytest.approx(1 - 0.4 * (1.2 / lens.max_angle) ** 2, abs=5e-3)
    quiet = ImageNoise(read_std=0, shot=0, gain=1.0, gain_drift=0.2)
    light = np.full((40, 40, 3), 0.2, np.float32)
    flat = np.ones((40, 40), np.float32)
    means = [develop(light, quiet, flat, t, 0.0, np.random.default_rng(0)).mean() for t in (0.0, 5.75, 17.25)]
    assert means[2] < means[0] < means[1]


def test_the_layouts_have_the_asked_size() -> None:
    layout = build_layout(Scene(layout="canal", size_m=(200, 60)))
    assert layout.clearance(np.array([0.0, 0.0])) == pytest.approx(30)
    assert layout.clearance(np.array([99.0, 0.0])) == pytest.approx(1)
    assert layout.clearance(np.array([0.0, 31.0])) < 0


@pytest.mark.parametrize("kind", ["catamaran", "ferry", "workboat", "sailboat"])
def test_a_hull_is_solid_where_it_is(kind: str) -> None:
    hull = build_hull(kind)
    reach = np.array([hull.response.length_m, hull.response.beam_m, 2.0]) / 2
    points = np.random.default_rng(0).uniform(-reach, reach, (3000, 3))
    inside = np.array([hull.contains(p) for p in points])
    assert 0 < inside.mean() < 0.9
    assert not hull.contains(np.array([0.0, 0.0, 30.0]))
    assert hull.response.length_m > hull.response.beam_m > 0


def test_truth_can_be_read_by_the_reader_of_truth(tmp_path: Path) -> None:
    simulation = prepare(load_scenario("ferry"))
    write_truth(simulation, np.array([[1.0, 2.0, 3.0]]), tmp_path)
    rig = read_true_rig(tmp_path / "truth.yaml")
    for name, camera in simulation.rig.cameras.items():
        assert np.linalg.norm(camera.rig_from_cam.local(rig.camera(name).rig_from_cam)) < 1e-9
        assert rig.camera(name).time_offset_s == camera.time_offset_s
    assert rig.antenna_rig == simulation.rig.antenna_rig
    assert truth_to_dict(simulation, np.empty((0, 3)))["clock_t0_s"] == 20.0


def test_frames_of_another_scenario_are_never_taken_for_this_one(tmp_path: Path) -> None:
    output = tmp_path / "a.bag"
    folders = {work_folder(output, small(seed=seed)) for seed in range(3)} | {
        work_folder(output, small(seed=0))
    }
    assert len(folders) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pinhole", *(n for n in LENSES if n.endswith("195"))])
def test_corners_are_where_the_lens_puts_them(name: str) -> None:
    lens = LENSES[name]
    errors = corner_errors(lens, samples=4)
    assert len(errors.angles_deg) > 25
    if lens.max_angle > 1.6:
        assert errors.angles_deg.max() > 80
    rms, ideal = (np.sqrt(np.mean(e**2)) for e in (errors.rendered_px, errors.ideal_px))
    assert np.abs(errors.rendered_px.mean(axis=0)).max() < 0.02
    assert rms < 1.2 * ideal + 1e-3


@pytest.mark.slow
def test_the_corners_of_every_model_are_measured() -> None:
    assert {lens.model for lens in LENSES.values()} == set(CAMERA_CLASSES)


@pytest.fixture(scope="module")
def demo_world() -> tuple[Simulation, Renderer]:
    simulation = prepare(load_scenario("demo"))
    return simulation, build_world(simulation)[1]


@pytest.mark.slow
def test_land_moves_as_geometry_says_and_water_does_not(demo_world: tuple[Simulation, Renderer]) -> None:
    simulation, renderer = demo_world
    flow, land, water = [], [], []
    for number in range(4):
        shot, exact = (Shot.prepare(simulation, renderer, number, samples) for samples in (None, 1))
        agreement = motion_agreement(shot, exact, 20 + 15 * number, 21 + 15 * number)
        flow.append(agreement.flow_error_px)
        land.append((agreement.land_fraction, agreement.land_tracks))
        water.append((agreement.water_fraction, agreement.water_tracks))
    assert np.median(np.concatenate(flow)) < 0.1
    on_land, on_water = np.array(land), np.array(water)
    assert np.average(on_land[:, 0], weights=on_land[:, 1]) >= 0.98
    assert np.average(on_water[:, 0], weights=on_water[:, 1]) < 0.65
    assert on_water[:, 1].sum() > 200  # it offers plenty to track


@pytest.mark.slow
def test_labels_show_land_sky_water_and_the_own_hull(demo_world: tuple[Simulation, Renderer]) -> None:
    simulation, renderer = demo_world
    shot = Shot.prepare(simulation, renderer, 0, samples=1)
    seen = renderer.truth(shot.view, shot.row_poses(5.0), renderer.water(5.0))
    fraction = {label: float(np.mean(seen.labels == label)) for label in (LAND, SKY, WATER, HULL)}
    assert fraction[LAND] > 0.05
    assert fraction[SKY] > 0.2
    assert fraction[WATER] > 0.2
    assert 0.01 < fraction[HULL] < 0.3
    assert np.isfinite(seen.ranges_m[seen.labels == LAND]).all()
    assert np.isnan(seen.ranges_m[seen.labels == HULL]).all()


@pytest.mark.slow
def test_workers_and_interruptions_change_nothing(tmp_path: Path) -> None:
    simulation = prepare(small())
    _, renderer = build_world(simulation)

    def silent(text: str, done: int, total: int) -> None:
        return

    def broken_off(text: str, done: int, total: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    render_recording(simulation, renderer, tmp_path / "one", workers=1, progress=silent)
    with pytest.raises(KeyboardInterrupt):
        render_recording(simulation, renderer, tmp_path / "two", workers=2, progress=broken_off)
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "two").rglob("*.jpg")}
    assert 5 <= len(kept) < 12
    recording = render_recording(simulation, renderer, tmp_path / "two", workers=2, progress=silent)
    assert all(p.stat().st_mtime_ns == then for p, then in kept.items())
    first = sorted((tmp_path / "one").rglob("*.jpg"))
    second = sorted((tmp_path / "two").rglob("*.jpg"))
    assert [p.name for p in first] == [p.name for p in second]
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]
    frames = list(recording.camera("front").frames(colour=True))
    assert [frame.image.shape for frame in frames] == [(120, 160, 3)] * 6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rec.bag", "rec.mcap", "rec"])
def test_the_command_writes_a_recording_with_its_truth(tmp_path: Path, name: str) -> None:
    scenario = tmp_path / "small.yaml"
    scenario.write_text(small().model_dump_json())
    done = CliRunner().invoke(
        build_app(), ["simulate", str(scenario), "-o", str(tmp_path / name), "--truth-images"]
    )
    assert done.exit_code == 0, done.output
    recording = open_recording(tmp_path / name)
    simulation = prepare(small())
    assert len(recording.cameras) == 2
    for camera in recording.cameras.values():
        assert len(list(camera.frames())) == 6
        assert camera.model is not None
    (imu,) = recording.imus.values()
    assert len(imu.gyro) == 150
    assert (
        read_true_rig(tmp_path / "rec_truth" / "truth.yaml").cameras.keys() == simulation.rig.cameras.keys()
    )
    assert len(list((tmp_path / "rec_truth" / "labels").rglob("*.png"))) == 12
    assert not list(tmp_path.glob(".rec-*"))  # the work folder is gone


@pytest.mark.slow
def test_a_rolling_shutter_shows_later_rows_later() -> None:
    """Every row of a rolling-shutter picture equals that row of an instant picture taken at the row's own time."""
    plain = small().model_dump()
    plain["cameras"] = [plain["cameras"][0] | {"rolling_shutter_ms": 60.0}]
    simulation = prepare(build_scenario(plain))
    _, renderer = build_world(simulation)
    shot = Shot.prepare(simulation, renderer, 0)
    sea = renderer.water(1.0)
    rolled = renderer.render(shot.view, shot.row_poses(1.0), sea)
    for row in (10, 60, 110):
        instant = simulation.motion.world_from_rig(np.array(1.0 + row / 119 * 0.060))
        at_once = renderer.render(shot.view, instant, sea)
        free = np.setdiff1d(np.arange(160), shot.view.hull_pixel[shot.view.hull_pixel // 160 == row] % 160)
        np.testing.assert_allclose(rolled[row, free], at_once[row, free], rtol=1e-4, atol=1e-5)


def test_showing_a_preset_prints_a_scenario_that_loads(tmp_path: Path) -> None:
    done = CliRunner().invoke(build_app(), ["simulate", "mast", "--show"])
    assert done.exit_code == 0
    copy = tmp_path / "copy.yaml"
    copy.write_text(done.output)
    assert load_scenario(copy) == load_scenario("mast")


@pytest.mark.slow
@pytest.mark.parametrize("size_m", [(110, 30), (30, 30), (30, 200)])
def test_narrow_water_has_hills_all_around(size_m: tuple[float, float]) -> None:
    scene = Scene(layout="marina", size_m=size_m, density=0.6)
    scenery = build_scenery(scene, 5, KeepClear(np.zeros((1, 2)), 4.0))
    reach = np.abs(scenery.mesh.triangles[..., :2]).max(axis=(0, 1))
    assert (reach > 800).all()
