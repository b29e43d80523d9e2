"""What a calibration is refused for before an image is read, and what makes a finished stage count no more."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrated_rigs import FISHEYE, PINHOLE, boat
from cli_runs import START_NS, run, write_images, write_trajectories
from rigwake.ba.solver.rig_problem import PosePrior
from rigwake.calibration import load_calibration
from rigwake.cameras.registry import camera_from_params
from rigwake.config import CalibrateConfig, load_config
from rigwake.errors import InputError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.inspection.readiness import MIN_SECONDS
from rigwake.pipeline.before_start import (
    check_line_delays,
    check_prior,
    check_reference,
    read_external_trajectories,
    without_cameras,
)
from rigwake.pipeline.calibration_run import CalibrationRun
from rigwake.pipeline.camera_key import camera_key
from rigwake.pipeline.camera_stage import load_outcome
from rigwake.pipeline.prior import Baseline, RigPrior, load_prior
from rigwake.pipeline.stage_files import StageLedger
from rigwake.pipeline.stream_selection import select
from rigwake.readers.imu_units import accel_in_si
from rigwake.recording import CameraStream, ImuStream, Recording
from rigwake.report.report_verdict import judge
from rigwake.tracks import load_tracks


class Unread:
    """Images that nobody may ask for."""

    def frames(self, indices, *, colour: bool = False):
        raise AssertionError("an image was read")


STAMPS = START_NS + np.arange(100) * 200_000_000
IMU = ImuStream(
    "imu", START_NS + np.arange(4000) * 5_000_000, np.zeros((4000, 3)), np.ones((4000, 3)), frame_id="imu"
)


def recording(**fields: object) -> Recording:
    cameras = {
        name: CameraStream(name, STAMPS, Unread(), 640, 480, PINHOLE, f"/{name}/image")
        for name in ("front", "left")
    }
    return Recording(
        **({"path": Path("sail.bag"), "kind": "ros1", "cameras": cameras, "imus": {"imu": IMU}} | fields)
    )


def test_a_unit_that_was_guessed_at_reading_is_refused_without_repair() -> None:
    level = np.tile([0.0, 0.0, 1.0], (100, 1))
    for unit, is_guess in (("", True), ("m/s^2", True), ("g", False)):
        _, said = accel_in_si(level, unit, "imu")
        guessed = recording(findings=tuple(said))
        assert select(guessed, load_config(None, ())).imu is not None
        if not is_guess:
            assert select(guessed, load_config(None, ("repair=false",))).imu is not None
            continue
        with pytest.raises(InputError, match=r"imu: .* g\b.*Name the unit"):
            select(guessed, load_config(None, ("repair=false",)))


def checked_reference(wanted: str, **fields: object) -> None:
    opened = recording(**fields)
    check_reference(opened, select(opened, CalibrateConfig()), wanted)


class TestReferences:
    def test_what_takes_part_is_accepted(self) -> None:
        for wanted in ("auto", "imu", "front", "left"):
            checked_reference(wanted)
        checked_reference("base_link", static_transforms={("base_link", "imu"): SE3.identity()})

    @pytest.mark.parametrize("wanted", ["mast", "Front", ""])
    def test_what_does_not_is_refused_with_the_choice(self, wanted: str) -> None:
        with pytest.raises(UsageError, match="imu, base_link, front, left"):
            checked_reference(wanted)

    def test_without_an_imu_there_is_no_imu(self) -> None:
        with pytest.raises(UsageError, match="front, left"):
            checked_reference("imu", imus={})

    def test_base_link_must_be_known(self) -> None:
        with pytest.raises(InputError, match="where the IMU sits on base_link"):
            checked_reference("base_link")


class TestPriors:
    def check(self, prior: RigPrior) -> None:
        check_prior(prior, select(recording(), CalibrateConfig()))

    def test_names_and_values_are_checked(self) -> None:
        known = PosePrior.in_axes_of_a(SE3.identity(), np.ones(6))
        self.check(RigPrior({"front": known}, (Baseline("front", "left", 1.0, 0.01),)))
        for wrong in (
            RigPrior({"frnt": known}),
            RigPrior(baselines=(Baseline("front", "lefft", 1.0, 0.01),)),
            RigPrior(baselines=(Baseline("front", "front", 1.0, 0.01),)),
            RigPrior(baselines=(Baseline("front", "left", -1.0, 0.01),)),
            RigPrior(baselines=(Baseline("front", "left", float("nan"), 0.01),)),
            RigPrior(baselines=(Baseline("front", "left", 1.0, 0.0),)),
        ):
            with pytest.raises(UsageError):
                self.check(wrong)

    def test_a_camera_that_fails_later_does_not_stop_the_others(self) -> None:
        known = PosePrior.in_axes_of_a(SE3.identity(), np.ones(6))
        prior = RigPrior({"front": known, "left": known}, (Baseline("front", "left", 1.0, 0.01),))
        left = without_cameras(prior, ["left"])
        assert list(left.cameras) == ["front"]
        assert left.baselines == ()

    def test_its_origin_is_kept_for_the_provenance(self, tmp_path: Path) -> None:
        file = tmp_path / "tape.yaml"
        file.write_text("baselines: [{cameras: [front, left], distance_m: 1.2, std_m: 0.1}]\n")
        origin = load_prior(file).origin
        assert origin["path"] == "tape.yaml"
        assert len(origin["sha256"]) == 64
        assert origin["content"]["baselines"][0]["distance_m"] == 1.2

    def test_line_delays_name_cameras_that_are_there(self) -> None:
        config = load_config(None, ["line_delay_s={lefft: 2e-5}"])
        with pytest.raises(UsageError, match="lefft"):
            check_line_delays(config, select(recording(), config))


class TestForeignTrajectories:
    def test_those_of_cameras_are_read(self, tmp_path: Path) -> None:
        write_trajectories(tmp_path)
        (tmp_path / "port.tum").rename(tmp_path / "front.tum")
        found = read_external_trajectories(tmp_path, select(recording(), CalibrateConfig()))
        assert list(found) == ["front"]

    def test_none_or_a_damaged_one_is_refused(self, tmp_path: Path) -> None:
        chosen = select(recording(), CalibrateConfig())
        with pytest.raises(InputError, match=r"front\.tum, left\.tum"):
            read_external_trajectories(tmp_path, chosen)
        (tmp_path / "left.tum").write_text("1 2 3\nx\n")
        with pytest.raises(InputError):
            read_external_trajectories(tmp_path, chosen)
        with pytest.raises(UsageError, match="is no folder"):
            read_external_trajectories(tmp_path / "left.tum", chosen)


def key(
    camera: Callable[[CameraStream], CameraStream] = lambda c: c,
    imu: ImuStream | None = IMU,
    odometry: bool = True,
    sha256: str = "a",
    **settings: object,
) -> str:
    config = load_config(None, **settings)
    identity = {"path": "sail.bag", "bytes": 9, "sha256": sha256}
    return camera_key(camera(recording().cameras["front"]), imu, config, odometry, identity, "now")


class TestKeysOfStages:
    def test_everything_that_a_camera_is_made_from_changes_it(self) -> None:
        off = PINHOLE.params.copy()
        off[0] += 0.01
        others = [
            key(lambda c: replace(c, topic="/left/image")),
            key(lambda c: replace(c, name="left")),
            key(lambda c: replace(c, timestamps_ns=c.timestamps_ns[1:])),
            key(lambda c: replace(c, timestamps_ns=c.timestamps_ns + 1)),
            key(lambda c: replace(c, model=FISHEYE)),
            key(lambda c: replace(c, model=camera_from_params("pinhole", off, 640, 480))),
            key(lambda c: replace(c, model=None)),
            key(imu=None),
            key(imu=replace(IMU, gyro=IMU.gyro + 1e-9)),
            key(imu=replace(IMU, gyro_noise_density=1e-3)),
            key(odometry=False),
            key(sha256="b"),
            key(seed=3),
            key(find_self_mask=False),
            key(tracking={"max_features": 77}),
            key(start_s=1.0),
        ]
        assert len({key(), *others}) == 1 + len(others)

    def test_what_serves_later_stages_does_not(self) -> None:
        assert (
            key() == key(reference="left") == key(jobs=2) == key(adjustment={"rounds": 3}) == key(gnss=False)
        )

    def test_times_of_files_count_where_the_content_was_sampled(self) -> None:
        front, config = recording().cameras["front"], CalibrateConfig()
        keys = {
            camera_key(front, IMU, config, True, {"sha256": "a"} | more, when)
            for more in ({}, {"hashed_bytes": 1})
            for when in ("now", "later")
        }
        assert len(keys) == 3

    def test_a_file_that_was_cut_or_changed_counts_no_more(self, tmp_path: Path) -> None:
        for content in (b"whol", b"", b"wholE"):
            file = tmp_path / "front.tum"
            file.write_bytes(b"whole")
            StageLedger(tmp_path, resume=False).done("camera front", "key", file)
            assert StageLedger(tmp_path, resume=True).is_done("camera front", "key", file)
            file.write_bytes(content)
            assert not StageLedger(tmp_path, resume=True).is_done("camera front", "key", file)

    @pytest.mark.parametrize(
        "ledger", ['{"camera front": "key"}', '{"camera front": {"key": "key", "files": 3}}', "[" * 100_000]
    )
    def test_a_strange_ledger_counts_for_nothing(self, tmp_path: Path, ledger: str) -> None:
        (tmp_path / "stages.json").write_text(ledger)
        assert not StageLedger(tmp_path, resume=True).is_done("camera front", "key")

    @pytest.mark.parametrize(
        "content",
        [
            b"",
            b"{",
            b"[]",
            b'{"name": 1}',
            b"\xff\xfe",
            b'{"name": "a", "failed": null, "notes": 3}',
            b"[" * 99_999,
        ],
    )
    def test_damaged_files_of_stages_are_named(self, tmp_path: Path, content: bytes) -> None:
        (tmp_path / "odometry").mkdir()
        (tmp_path / "odometry" / "front.json").write_bytes(content)
        with pytest.raises(InputError, match=r"front\.json"):
            load_outcome(tmp_path, "front")
        (tmp_path / "front.npz").write_bytes(content)
        with pytest.raises(InputError, match=r"front\.npz"):
            load_tracks(tmp_path / "front.npz")


class TestInspectAgreesWithCalibrate:
    def test_the_same_length_is_asked_for(self) -> None:
        assert CalibrateConfig().min_duration_s == MIN_SECONDS

    def test_sensors_that_do_not_overlap_in_time_are_not_enough(self, tmp_path: Path) -> None:
        write_images(tmp_path / "rec")
        rows = [f"{5 + 0.01 * k:.3f},0.1,0.2,0.3,0,0,9.81" for k in range(3000)]
        (tmp_path / "rec" / "imu.csv").write_text("timestamp_s,wx,wy,wz,ax,ay,az\n" + "\n".join(rows) + "\n")
        ended = run("inspect", tmp_path / "rec", "--json", "-")
        assert "hardly any in common: front and imu: 0.0 s" in ended.out, ended.words
        assert '"not enough"' in ended.out


def test_a_stale_calibration_is_not_left_beside_new_stages(tmp_path: Path) -> None:
    out = tmp_path / "OUT"
    out.mkdir()
    (out / "calibration.yaml").write_text("old")
    write_images(tmp_path / "rec")
    ended = run(
        "calibrate", tmp_path / "rec", "-o", out, "--resume", "--set", "min_duration_s=1", "--jobs", "1"
    )
    assert ended.code in (1, 3), ended.words
    assert not (out / "calibration.yaml").exists()
    with pytest.raises(InputError):
        load_calibration(out / "calibration.yaml")


@pytest.mark.parametrize(
    ("failed", "options", "code"),
    [
        ({}, [], 0),
        ({"mast": "mast: no tracks"}, [], 4),
        ({"mast": "mast: no tracks"}, ["--allow-partial"], 0),
    ],
)
def test_a_missing_camera_is_in_the_headline_and_in_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failed: dict[str, str], options: list[str], code: int
) -> None:
    found = CalibrationRun(boat(lens=PINHOLE), tmp_path / "OUT", failed)
    monkeypatch.setattr("rigwake.pipeline.calibration_run.calibrate", lambda *given, **options: found)
    write_images(tmp_path / "rec")
    ended = run("calibrate", tmp_path / "rec", "-o", tmp_path / "OUT", *options)
    assert ended.code == code, ended.words
    first_line = ended.out.splitlines()[0]
    assert ("1 of 5 cameras is not calibrated: mast" in first_line) == bool(failed)
    assert ("mast is not calibrated: no tracks" in ended.words) == bool(failed)
    assert ("--allow-partial" in ended.err) == (code == 4)
    assert "next: rigwake report" in ended.out


def test_the_report_names_what_is_missing_in_its_headline() -> None:
    assert judge(boat(checks={"failed_cameras": {"mast": "no tracks"}})).sentence.startswith("Without mast.")
    assert "Without" not in judge(boat(checks={"failed_cameras": {}})).sentence
