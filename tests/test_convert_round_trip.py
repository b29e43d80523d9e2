"""Every preset of the simulator through every format and back; `rigwake convert` and what it hands on."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rigwake.cameras.formats.camera_files import write_cameras
from rigwake.cameras.formats.camera_info import camera_from_info, info_of_any_camera
from rigwake.cameras.registry import camera_class, camera_from_dict, camera_from_params
from rigwake.cli.main import build_app
from rigwake.config import load_config
from rigwake.errors import InputError, UsageError
from rigwake.excerpt import excerpt, longest_stretch
from rigwake.inspection.inspection_summary import inspection_to_dict
from rigwake.inspection.readiness import judge
from rigwake.inspection.recording_inspection import inspect_recording
from rigwake.pipeline.calibration_run import calibrate
from rigwake.readers.open import open_recording
from rigwake.readers.topics import TopicMap
from rigwake.recording import Frame, Recording, static_transform
from rigwake.simulation.scenario import build_scenario, load_scenario, preset_names
from rigwake.simulation.setup import build_recording, prepare
from rigwake.tracking.front_ends import track_camera
from rigwake.tracks import load_tracks
from rigwake.writers.write import RecordingFormat, write_recording
from test_writers import small_recording
from textured_room import write_room

TARGETS: list[tuple[RecordingFormat, str]] = [
    ("ros1", "rec.bag"),
    ("ros2", "rec"),
    ("mcap", "rec.mcap"),
    ("euroc", "rec"),
    ("folder", "rec"),
]


@cache
def grey_jpeg(width: int, height: int, level: int) -> bytes:
    return cv2.imencode(".jpg", np.full((height, width), level, np.uint8))[1].tobytes()


@dataclass(frozen=True, eq=False)
class StoredFrames:
    """Images that lie encoded, as in a recording; frame i is grey of level 40 + i."""

    stamps: NDArray[np.int64]
    size: tuple[int, int]
    is_encoded: bool = True

    def encoded_frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[tuple[int, bytes]]:
        for index in indices:
            yield int(index), grey_jpeg(*self.size, 40 + int(index) % 50)

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for index, encoded in self.encoded_frames(indices):
            image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR if colour else 0)
            yield Frame(index, int(self.stamps[index]), image)


@cache
def simulated(preset: str, duration_s: float = 1.0) -> Recording:
    """The preset's recording, one second long unless told otherwise, with plain pictures."""
    scenario = load_scenario(preset)
    simulation = prepare(build_scenario(scenario.model_dump() | {"duration_s": duration_s}, preset))
    sources = {
        camera.name: StoredFrames(simulation.camera_stamps(camera), (camera.width_px, camera.height_px))
        for camera in scenario.cameras
    }
    return build_recording(simulation, sources, Path(preset))


def assert_same(again: Recording, first: Recording) -> None:
    """The same sensors, stamps, values, lenses and truth."""
    for kind in ("cameras", "imus", "gnss", "attitudes", "poses", "true_trajectories"):
        assert set(getattr(again, kind)) == set(getattr(first, kind)), kind
        for name, stream in getattr(first, kind).items():
            assert np.array_equal(getattr(again, kind)[name].timestamps_ns, stream.timestamps_ns), (
                kind,
                name,
            )
    for name, camera in first.cameras.items():
        other = again.cameras[name]
        assert other.model == camera.model, name
        assert (other.width_px, other.height_px) == (camera.width_px, camera.height_px)
        pairs = zip(other.frames([0, len(camera) - 1]), camera.frames([0, len(camera) - 1]), strict=True)
        assert all(np.array_equal(a.image, b.image) and a.timestamp_ns == b.timestamp_ns for a, b in pairs)
    for name, imu in first.imus.items():
        other_imu = again.imus[name]
        assert np.array_equal(other_imu.gyro, imu.gyro)
        assert np.array_equal(other_imu.accel, imu.accel)
        assert other_imu.gyro_noise_density == imu.gyro_noise_density
        assert other_imu.accel_bias_walk == imu.accel_bias_walk
    for name, gnss in first.gnss.items():
        other_gnss = again.gnss[name]
        assert np.allclose(other_gnss.position_enu, gnss.position_enu, atol=1e-6)
        assert other_gnss.origin_lla == pytest.approx(gnss.origin_lla, abs=1e-12)
        assert np.allclose(other_gnss.covariances, gnss.covariances, atol=1e-12)
        assert (other_gnss.velocity_enu is None) == (gnss.velocity_enu is None)
        if gnss.velocity_enu is not None and other_gnss.velocity_enu is not None:
            assert np.array_equal(other_gnss.velocity_enu, gnss.velocity_enu)
    for name, attitude in first.attitudes.items():
        assert np.allclose(again.attitudes[name].world_from_body, attitude.world_from_body, atol=1e-12)
        assert np.allclose(again.attitudes[name].covariances, attitude.covariances, atol=1e-12)
    for name, truth in first.true_trajectories.items():
        other_truth = again.true_trajectories[name].world_from_body
        assert np.abs(truth.world_from_body.local(other_truth)).max() < 1e-8
    assert (again.true_rig is None) == (first.true_rig is None)
    if first.true_rig is not None and again.true_rig is not None:
        assert again.true_rig.reference == first.true_rig.reference
        assert again.true_rig.antenna_rig == pytest.approx(first.true_rig.antenna_rig)
        for name, mounted in first.true_rig.cameras.items():
            found = again.true_rig.cameras[name]
            assert np.abs(mounted.rig_from_cam.local(found.rig_from_cam)).max() < 1e-12
            assert found.time_offset_s == mounted.time_offset_s
    assert again.static_transforms.keys() == first.static_transforms.keys()
    assert not [f for f in again.findings if f.severity != "note"]


@pytest.mark.parametrize("preset", preset_names())
def test_every_preset_through_every_format_is_the_same_recording(tmp_path: Path, preset: str) -> None:
    first = simulated(preset)
    for number, (file_format, name) in enumerate(TARGETS):
        path = tmp_path / str(number) / name
        write_recording(first, path, file_format=file_format, image_encoding="copy")
        assert_same(open_recording(path), first)


@pytest.mark.slow
def test_a_chain_of_conversions_changes_no_calibration(tmp_path: Path) -> None:
    """The tracks are the same to the last bit in each format, and so is the calibration at the end of the chain."""
    path = write_room(tmp_path / "0.bag")
    settings = load_config(
        assignments=["adjustment.cross_camera=false", "tracking.max_features=120", "jobs=1"]
    )
    first = calibrate(path, tmp_path / "first", settings).calibration
    chain: list[tuple[RecordingFormat, str]] = [*reversed(TARGETS[1:]), TARGETS[0]]
    for number, (file_format, name) in enumerate(chain, start=1):
        target = tmp_path / str(number) / name
        write_recording(open_recording(path), target, file_format=file_format, image_encoding="copy")
        path = target
        camera = open_recording(path).camera("front")
        again = track_camera(camera, settings.tracking)
        tracked = load_tracks(tmp_path / "first" / "tracks" / "front.npz")
        if number == 1:
            expected = track_camera(open_recording(tmp_path / "0.bag").camera("front"), settings.tracking)
            assert len(expected.pixels) > len(tracked.pixels) / 2
        assert np.array_equal(again.pixels, expected.pixels), file_format
        assert np.array_equal(again.bearings_cam, expected.bearings_cam)
        assert np.array_equal(again.timestamps_ns, expected.timestamps_ns)
    last = calibrate(path, tmp_path / "last", settings).calibration
    assert last.cameras.keys() == first.cameras.keys()
    for name, camera in first.cameras.items():
        found = last.cameras[name]
        assert np.abs(camera.rig_from_cam.local(found.rig_from_cam)).max() < 1e-6
        assert found.time_offset_s == pytest.approx(camera.time_offset_s, abs=1e-7)
        np.testing.assert_allclose(found.covariance, camera.covariance, rtol=1e-3)
        assert found.model is not None
        assert camera.model is not None
        np.testing.assert_allclose(found.model.params, camera.model.params, rtol=1e-6)


def test_a_chain_of_conversions_changes_nothing(tmp_path: Path) -> None:
    """ROS 1 -> folder -> MCAP -> EuRoC -> ROS 2 and back; ferry has the lenses that ROS has no name for."""
    first = simulated("ferry")
    write_recording(first, tmp_path / "0.bag", image_encoding="copy")
    path = tmp_path / "0.bag"
    for number, (file_format, suffix) in enumerate(
        [("folder", ""), ("mcap", ".mcap"), ("euroc", ""), ("ros2", ""), ("ros1", ".bag")], start=1
    ):
        target = tmp_path / f"{number}{suffix}"
        write_recording(open_recording(path), target, file_format=file_format, image_encoding="copy")
        path = target
    assert_same(open_recording(path), first)
    words = [inspection_to_dict(i := inspect_recording(r), judge(i)) for r in (open_recording(path), first)]
    assert words[0]["verdict"] == words[1]["verdict"]


LENSES = {
    "pinhole": [80.0, 81, 40, 30, 0.1, -0.1, 0.01, 1e-3, 2e-3, 0],
    "rational": [80.0, 81, 40, 30, 0, 0.1, 0.01, 1e-3, 2e-3, 0, 0.02, 0.01, 0.001],
    "kb4": [40.0, 41, 40, 30, 0.01, -0.002, 0, 0],
    "kb23": [40.0, 41, 40, 30, 1, 0.1, 0, 0, 0, 1e-3, 0, 0, 1e-3, 0, 0, 0, 0, 1e-3, 0, 0, 0, 0, 1e-3],
    "mei": [80.0, 81, 40, 30, 1.2, -0.1, 0.01, 1e-3, 2e-3, 0.01],
    "scaramuzza": list(camera_class("scaramuzza").nominal_values(40.0, 40.0, 30.0)),
    "eucm": [40.0, 41, 40, 30, 0.6, 1.1],
    "ds": [40.0, 41, 40, 30, -0.2, 0.6],
    "fov": [40.0, 41, 40, 30, 0.9],
}


@pytest.mark.parametrize("model", LENSES)
def test_camera_info_carries_every_lens(model: str) -> None:
    lens = camera_from_params(model, LENSES[model], 80, 60)
    info = info_of_any_camera(lens)
    assert camera_from_info(info.distortion_model, info.D, info.K, 80, 60) == lens


@pytest.mark.parametrize(
    ("name", "D", "model"),
    [
        ("kannala_brandt4", [0.01, 0, 0, 0], "kb4"),
        ("fisheye_kannala_brandt_k3".replace("_k3", "K3"), [0.01], "kb4"),
        ("KannalaBrandt8", [0.01, 0, 0, 0], "kb4"),
        ("pinhole-equi", [0.01, 0, 0, 0], "kb4"),
        ("Brown Conrady", [0.01, 0, 0, 0, 0], "pinhole"),
        ("radial-tangential", [0.01, 0, 0, 0], "pinhole"),
        ("none", [0.0] * 5, "pinhole"),
        ("", [], "pinhole"),
        ("FULL_OPENCV", [0.01] * 8, "rational"),
        ("rational_polynomial", [0.01] * 8 + [0.0] * 6, "rational"),
        ("plumb_bob", [0.01] * 5 + [0.0] * 3, "pinhole"),
        ("double_sphere", [-0.2, 0.6], "ds"),
        ("eucm", [0.6, 1.1], "eucm"),
        ("omni-radtan", [1.2, 0.01, 0, 0, 0], "mei"),
        ("FOV", [0.9], "fov"),
    ],
)
def test_names_of_other_simulators_and_drivers(name: str, D: list[float], model: str) -> None:
    assert camera_from_info(name, D, [40, 0, 40, 0, 41, 30, 0, 0, 1], 80, 60).model == model


def test_stored_images_are_handed_on_as_they_are(tmp_path: Path) -> None:
    first = simulated("thesis")
    camera = next(iter(first.cameras.values()))
    write_recording(first, tmp_path / "rec", image_encoding="copy")
    stored = tmp_path / "rec" / camera.name / f"{camera.timestamps_ns[3]}.jpg"
    assert stored.read_bytes() == next(camera.source.encoded_frames([3]))[1]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("start_s", "duration_s", "every"), [(0.5, None, 1), (0.0, 0.7, 2), (0.31, 1.0, 3), (1.9, 9.0, 1)]
)
def test_a_part_holds_what_was_recorded_in_it(start_s: float, duration_s: float | None, every: int) -> None:
    first = simulated("demo", 2.0)
    begin = min(int(c.timestamps_ns[0]) for c in [*first.cameras.values(), *first.imus.values()])
    low = begin + round(start_s * 1e9)
    high = 2**62 if duration_s is None else low + round(duration_s * 1e9)
    part = excerpt(first, start_s=start_s, duration_s=duration_s, every=every)
    for name, camera in part.cameras.items():
        stamps = first.cameras[name].timestamps_ns
        rows = np.flatnonzero((stamps >= low) & (stamps <= high))[::every]
        assert np.array_equal(camera.timestamps_ns, stamps[rows])
        frames = list(camera.frames())
        assert [f.timestamp_ns for f in frames] == stamps[rows].tolist()
        assert [int(f.image[0, 0]) for f in frames] == [40 + row % 50 for row in rows]
        assert [f.index for f in frames] == list(range(len(rows)))
    imu = next(iter(part.imus.values()))
    assert low <= imu.timestamps_ns[0] <= imu.timestamps_ns[-1] <= high


@pytest.mark.parametrize(
    "options", [{"start_s": 99.0}, {"every": 0}, {"duration_s": -1.0}, {"start_s": float("inf")}]
)
def test_a_part_that_is_not_there_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        excerpt(simulated("demo", 2.0), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("boot_s", [0, 30, 86_400])
@pytest.mark.parametrize("before_s", [0.3, 0.8])
def test_a_clock_that_is_set_while_recording(boot_s: int, before_s: float) -> None:
    first = simulated("demo", 2.0)

    def set_late(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        begin = int(next(iter(first.imus.values())).timestamps_ns[0])
        early = stamps < begin + before_s * 1e9
        since = stamps - begin
        return np.where(early, since + boot_s * 10**9, since + 1_700_000_000 * 10**9)

    cameras = {n: replace(c, timestamps_ns=set_late(c.timestamps_ns)) for n, c in first.cameras.items()}
    imus = {n: replace(i, timestamps_ns=set_late(i.timestamps_ns)) for n, i in first.imus.items()}
    mended = longest_stretch(replace(first, cameras=cameras, imus=imus, gnss={}))
    (finding,) = [f for f in mended.findings if "clock was set" in f.message]
    assert finding.severity == "error"
    for stream in [*mended.cameras.values(), *mended.imus.values()]:
        assert np.ptp(stream.timestamps_ns) * 1e-9 == pytest.approx(2.0 - before_s, abs=0.3)
    assert longest_stretch(first) is first


def test_static_transforms_survive_formats_without_tf(tmp_path: Path) -> None:
    written = small_recording()
    for file_format, name in (("folder", "a"), ("euroc", "b")):
        write_recording(written, tmp_path / name, file_format=file_format)  # type: ignore[arg-type]
        again = open_recording(tmp_path / name)
        found = static_transform(again, "base_link", "front_optical")
        expected = static_transform(written, "base_link", "front_optical")
        assert found is not None
        assert expected is not None
        assert np.abs(expected.local(found)).max() < 1e-12


@pytest.mark.parametrize("way", ["option", "named option", "beside"])
def test_lenses_can_be_given_for_a_bag(tmp_path: Path, way: str) -> None:
    """camera_info without a calibration, and the file that `rigwake intrinsics` writes."""
    recording = small_recording(("front",))
    bare = {n: replace(c, model=None) for n, c in recording.cameras.items()}
    write_recording(replace(recording, cameras=bare, true_rig=None), tmp_path / "k0.bag")
    assert open_recording(tmp_path / "k0.bag").camera("front").model is None
    lens = camera_from_params("kb4", [20, 21, 23.5, 15.5, 0.01, 0, 0, 0], 48, 32)
    file = tmp_path / ("k0.rig.yaml" if way == "beside" else "lens.yaml")
    write_cameras(file, {"front" if way != "option" else "lens": lens})
    options = {"option": [str(file)], "named option": [f"front={file}"], "beside": []}[way]
    again = open_recording(tmp_path / "k0.bag", TopicMap.from_options((), None, options))
    assert again.camera("front").model == lens
    assert not [f for f in again.findings if "must be given" in f.message]


def test_lenses_of_another_camera_or_size_are_refused(tmp_path: Path) -> None:
    write_recording(small_recording(("front", "port")), tmp_path / "r.bag")
    small = camera_from_params("kb4", [20, 21, 23.5, 15.5, 0.01, 0, 0, 0], 40, 32)
    write_cameras(tmp_path / "a.yaml", {"bow": small})
    with pytest.raises(UsageError, match="bow"):
        open_recording(tmp_path / "r.bag", TopicMap.from_options((), None, [str(tmp_path / "a.yaml")]))
    with pytest.raises(InputError, match="40 x 32"):
        open_recording(tmp_path / "r.bag", TopicMap.from_options((), None, [f"port={tmp_path / 'a.yaml'}"]))


def run(*words: object) -> int:
    try:
        build_app()([str(word) for word in words], standalone_mode=False)
    except UsageError as error:
        return error.exit_code
    return 0


def test_convert_on_the_command_line(tmp_path: Path) -> None:
    write_recording(simulated("ferry", 2.0), tmp_path / "a.bag", image_encoding="copy")
    common = ["--cameras", "bow,stern", "--start", 0.5, "--duration", 1, "--every", 2]
    assert (
        run("convert", tmp_path / "a.bag", "-o", tmp_path / "b.mcap", *common, "--json", tmp_path / "j") == 0
    )
    again = open_recording(tmp_path / "b.mcap")
    assert list(again.cameras) == ["bow", "stern"]
    assert {c.model.model for c in again.cameras.values() if c.model} == {"mei", "ds"}
    assert [len(c) for c in again.cameras.values()] == [5, 5]
    known_fraction = json.loads((tmp_path / "j").read_text())
    assert known_fraction["frames"] == 10
    topic = again.cameras["bow"].topic
    given = ["--topic", f"camera.nose={topic}", "--to", "euroc", "--images", "png"]
    assert run("convert", tmp_path / "b.mcap", "-o", tmp_path / "c", *given) == 0
    assert list(open_recording(tmp_path / "c").cameras) == ["nose"]
    assert run("convert", tmp_path / "a.bag", "-o", tmp_path / "c") == 2  # is there
    assert run("convert", tmp_path / "a.bag", "-o", tmp_path / "d", "--images", "gif") == 2
    assert run("convert", tmp_path / "a.bag", "-o", tmp_path / "d", "--start", 99) == 2


def test_the_description_inside_a_bag_cannot_mislead(tmp_path: Path) -> None:
    """A lens for another size, names that lead elsewhere, and text that is no JSON are named or passed over."""
    from rigwake.readers.rig_description import description_of, description_of_text

    with pytest.raises(InputError):
        description_of_text("[" * 100_000)
    with pytest.raises(InputError):
        description_of_text("&a [*a, *a]")
    wild = description_of({"cameras": {"../../x": {"topic": "/a"}, "b": 7}, "imus": 3}, "here")
    assert not wild.lenses
    assert not wild.names["camera"]
    lens = {
        "model": "ds",
        "width_px": 5,
        "height_px": 5,
        "params": {"fx": 1, "fy": 1, "cx": 2, "cy": 2, "xi": 0, "alpha": 0.5},
    }
    assert camera_from_dict(lens).model == "ds"
    write_recording(small_recording(("front",)), tmp_path / "r.bag")
    (tmp_path / "r.rig.yaml").write_text(json.dumps({"cameras": {"front": {"camera": lens}}}))
    again = open_recording(tmp_path / "r.bag")
    assert again.camera("front").model is not None
    assert again.camera("front").width_px == 48
