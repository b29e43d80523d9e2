"""What goes into a calibration: settings, priors, the selected part of a recording, stage files."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration_worlds import first_values, measurements, sail
from rigwake._types import Array
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.rig_values import AdjustmentOptions, InitialRig
from rigwake.ba.solver.rig_problem import PosePrior
from rigwake.calibration import Calibration
from rigwake.cli.calibrate import SETTINGS
from rigwake.cli.console import write_json
from rigwake.config import CalibrateConfig, load_config
from rigwake.errors import InputError, UnobservableError, UsageError
from rigwake.fingerprint import input_fingerprint
from rigwake.geometry.se3 import SE3
from rigwake.pipeline.camera_stage import (
    CameraJob,
    CameraOutcome,
    load_outcome,
    outcome_file,
    process_camera,
)
from rigwake.pipeline.prior import RigPrior, load_prior
from rigwake.pipeline.stage_files import StageLedger, stage_key
from rigwake.pipeline.stream_selection import select
from rigwake.recording import AttitudeStream, CameraStream
from rigwake.report.picture_overlays import horizon_pixels
from rigwake.simulation.tracks_only import SimulatedTracks


@pytest.fixture(scope="module")
def world() -> SimulatedTracks:
    return sail(features=30, duration_s=20)


def first_rig_of(world: SimulatedTracks) -> InitialRig:
    return replace(
        first_values(world), handeye=Calibration("front", {}), reference_camera="front", scale_source="gnss"
    )


class TestSettings:
    def test_assignments_win_over_the_file_and_options_over_both(self, tmp_path: Path) -> None:
        file = tmp_path / "settings.yaml"
        file.write_text("seed: 1\nstart_s: 2\nadjustment: {rounds: 5, state_rate_hz: 2.0}\n")
        config = load_config(file, ["adjustment.rounds=7", "start_s=3"], start_s=4.0, cameras=None)
        assert (config.seed, config.start_s) == (1, 4.0)
        assert (config.adjustment.rounds, config.adjustment.state_rate_hz) == (7, 2.0)

    def test_what_print_config_shows_can_be_read_again(self, tmp_path: Path) -> None:
        file = tmp_path / "all.yaml"
        file.write_text(yaml.safe_dump(CalibrateConfig().model_dump(mode="json")))
        assert load_config(file) == CalibrateConfig()

    @pytest.mark.parametrize(
        ("assignment", "named"),
        [
            ("adjustment.speed=3", "adjustment.speed"),
            ("nonsense=1", "nonsense"),
            ("seed=many", "seed"),
            ("duration_s=-1", "duration_s"),
            ("imu_noise.gyro_noise_density=0", "imu_noise.gyro_noise_density"),
            ("seed", "KEY=VALUE"),
            ("seed=[1", "not YAML"),
            ("seed.inner.more=1", "seed"),
        ],
    )
    def test_wrong_settings_are_named(self, assignment: str, named: str) -> None:
        with pytest.raises(UsageError) as caught:
            load_config(None, [assignment])
        assert named in str(caught.value)

    @pytest.mark.parametrize("option", ["adjustment.rounds=0", "adjustment.min_observations=1"])
    def test_options_out_of_range_are_usage_errors(self, option: str) -> None:
        with pytest.raises(UsageError):
            load_config(None, [option])


class TestPrior:
    def write(self, tmp_path: Path, text: str) -> Path:
        path = tmp_path / "tape.yaml"
        path.write_text(text)
        return path

    def test_null_is_unknown_and_zero_is_fixed(self, tmp_path: Path) -> None:
        prior = load_prior(
            self.write(
                tmp_path,
                "cameras: {front: {rig_from_cam: {translation_m: [1.0, null, 0.7]},"
                " std: {translation_m: [0.01, 0.5, 0]}}}",
            )
        )
        information = np.diag(prior.cameras["front"].information)
        assert (information[:4] == [0, 0, 0, 1 / 0.01**2]).all()
        assert information[4] == 0
        assert information[5] > 1e12

    def test_a_wrong_camera_is_named_with_those_that_are_there(self, world: SimulatedTracks) -> None:
        prior = RigPrior(cameras={"mast": PosePrior.in_axes_of_a(SE3.identity(), np.ones(6))})
        with pytest.raises(UsageError, match=r"mast.*front, left"):
            prior.applied_to(first_rig_of(world), CalibrateConfig())

    @pytest.mark.parametrize(
        "text",
        [
            "cameras: {front: {}}",
            "cameras: {front: {rig_from_cam: {translation_m: [1, 2]}, std: {translation_m: [1, 1, 1]}}}",
            "cameras: {front: {rig_from_cam: {translation_m: [1, x, 2]}, std: {translation_m: [1, 1, 1]}}}",
            "baselines: [{cameras: [left], distance_m: 1, std_m: 0.1}]",
            "antenna: {position_rig_m: [1, 2, 3]}",
            "camera: {}",
            "[1, 2]",
            "cameras: [front]",
        ],
    )
    def test_damaged_files_are_input_errors(self, tmp_path: Path, text: str) -> None:
        with pytest.raises(InputError, match=r"tape\.yaml"):
            load_prior(self.write(tmp_path, text))

    def test_clocks_and_shutters_follow_the_settings(self, world: SimulatedTracks) -> None:
        config = CalibrateConfig(time_offsets=False, line_delay_s={"left": 2e-5}, estimate_line_delay=True)
        cameras = RigPrior().applied_to(first_rig_of(world), config).cameras
        assert cameras["front"].free == {"rig_from_cam"}
        assert cameras["left"].free == {"rig_from_cam", "line_delay"}
        assert (cameras["front"].line_delay_s, cameras["left"].line_delay_s) == (0.0, 2e-5)

    def test_without_sensors_one_state_and_one_length_are_held(self, world: SimulatedTracks) -> None:
        every = replace(measurements(world), imu=None, gnss=None)
        problem = assemble_problem(every, first_values(world), AdjustmentOptions()).problem
        held = RigPrior().constrained(problem)
        assert held.states.fixed is not None
        assert held.states.fixed.sum() == 1
        assert len(held.distances) == 1


class TestSelection:
    def test_the_window_is_cut_by_time(self, world: SimulatedTracks) -> None:
        whole = world.recording.cameras["front"].timestamps_ns
        chosen = select(world.recording, CalibrateConfig(start_s=2.0, duration_s=16.0)).cameras["front"]
        assert chosen.timestamps_ns[0] >= whole[0] + 2_000_000_000
        assert chosen.timestamps_ns[-1] <= whole[0] + 18_000_000_000
        assert len(chosen) == np.sum((whole >= whole[0] + 2e9) & (whole <= whole[0] + 18e9))

    def test_a_short_window_says_which_motion_to_record(self, world: SimulatedTracks) -> None:
        with pytest.raises(UnobservableError, match="turns to both sides"):
            select(world.recording, CalibrateConfig(duration_s=10.0))

    def test_a_camera_without_intrinsics_is_left_out_and_named(self, world: SimulatedTracks) -> None:
        cameras = dict(world.recording.cameras)
        cameras["left"] = replace(cameras["left"], model=None)
        chosen = select(replace(world.recording, cameras=cameras), CalibrateConfig())
        assert list(chosen.cameras) == ["front"]
        assert any("left" in note and "intrinsics" in note for note in chosen.notes)

    def test_without_any_intrinsics_it_says_how_to_find_them(self, world: SimulatedTracks) -> None:
        blind = {name: replace(c, model=None) for name, c in world.recording.cameras.items()}
        with pytest.raises(InputError, match="rigwake intrinsics"):
            select(replace(world.recording, cameras=blind), CalibrateConfig())

    def test_unknown_cameras_and_no_cameras(self, world: SimulatedTracks) -> None:
        with pytest.raises(UsageError, match="front"):
            select(world.recording, CalibrateConfig(cameras=("mast",)))
        with pytest.raises(InputError, match="no cameras"):
            select(replace(world.recording, cameras={}), CalibrateConfig())

    def test_sensors_can_be_left_aside(self, world: SimulatedTracks) -> None:
        chosen = select(world.recording, CalibrateConfig(imu=False, gnss=False))
        assert chosen.imu is None
        assert chosen.gnss is None

    def test_an_attitude_that_is_not_used_is_named(self, world: SimulatedTracks) -> None:
        compass = AttitudeStream(
            "compass", np.arange(2), np.stack([np.eye(3)] * 2), np.stack([np.eye(3)] * 2)
        )
        chosen = select(replace(world.recording, attitudes={"compass": compass}), CalibrateConfig())
        assert any("compass" in note and "not used" in note for note in chosen.notes)


class TestStageFiles:
    def test_a_stage_counts_only_with_its_key_and_its_files(self, tmp_path: Path) -> None:
        file = tmp_path / "tracks.npz"
        file.write_bytes(b"x")
        StageLedger(tmp_path, resume=False).done("camera front", "key")
        again = StageLedger(tmp_path, resume=True)
        assert again.is_done("camera front", "key", file)
        assert not again.is_done("camera front", "other", file)
        assert not again.is_done("camera left", "key", file)
        assert not again.is_done("camera front", "key", tmp_path / "gone.npz")
        assert not StageLedger(tmp_path, resume=False).is_done("camera front", "key", file)

    @pytest.mark.parametrize("content", ["{", "[]", "\0"])
    def test_a_damaged_ledger_starts_anew(self, tmp_path: Path, content: str) -> None:
        (tmp_path / "stages.json").write_text(content)
        assert not StageLedger(tmp_path, resume=True).is_done("camera front", "key")

    def test_the_fingerprint_changes_with_the_input(self, tmp_path: Path) -> None:
        file = tmp_path / "a.bag"
        file.write_bytes(b"1" * 3_000_000)
        first = input_fingerprint(file)
        file.write_bytes(b"1" * 2_999_999 + b"2")
        assert input_fingerprint(file) != first
        folder = input_fingerprint(tmp_path)
        (tmp_path / "b.png").write_bytes(b"")
        assert input_fingerprint(tmp_path) != folder

    def test_keys_depend_on_values_not_on_order(self) -> None:
        assert stage_key({"a": 1, "b": 2}) == stage_key({"b": 2, "a": 1}) != stage_key({"a": 1, "b": 3})


@pytest.mark.parametrize("up", [[0, -1, 0], [0.3, -0.9, 0.2], [0, 0, 1.0]])
def test_horizon_pixels_look_at_right_angles_to_up(world: SimulatedTracks, up: list[float]) -> None:
    model = world.recording.cameras["front"].model
    assert model is not None
    up_cam: Array = np.array(up) / np.linalg.norm(up)
    pixels = horizon_pixels(model, up_cam)
    seen = np.isfinite(pixels).all(axis=1)
    bearings, valid = model.unproject(pixels[seen])
    assert seen.any()
    assert valid.all()
    np.testing.assert_allclose(bearings @ up_cam, 0.0, atol=1e-6)


def test_json_files_hold_no_nan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera of which nothing was placed has residuals that are no number: null in every file."""
    outcome = CameraOutcome("front", None, counts={"odometry": {"inlier_rms_px": np.nan, "inliers": 0}})
    monkeypatch.setattr("rigwake.pipeline.camera_stage._process", lambda job, progress, stretches: outcome)
    stream = CameraStream("front", np.arange(2), None, 4, 4)
    process_camera(CameraJob(stream, None, tmp_path, CalibrateConfig()), lambda words, part: None)
    text = outcome_file(tmp_path, "front").read_text()
    assert "NaN" not in text
    loaded = load_outcome(tmp_path, "front").counts
    assert loaded is not None
    assert loaded["odometry"]["inlier_rms_px"] is None
    write_json(tmp_path / "any.json", {"a": [np.inf, np.float64(np.nan), 1.0], "b": np.array([np.nan])})
    assert json.loads((tmp_path / "any.json").read_text()) == {"a": [None, None, 1.0], "b": [None]}


def test_the_settings_of_the_help_exist() -> None:
    assert len(SETTINGS) == 10
    for setting in SETTINGS:
        assert load_config(assignments=[setting]) != load_config(), setting
