"""What rigwake exports it reads back; what it must not export it refuses; what it cannot read it names."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from calibrated_rigs import FISHEYE, PINHOLE, boat, camera, without_vertical
from geometry_strategies import transforms
from rigwake.calibration import Calibration, save_calibration
from rigwake.cameras.registry import camera_from_params
from rigwake.cli.main import build_app
from rigwake.errors import CameraError, InputError, RigwakeError, UnobservableError, UsageError
from rigwake.exporters import (
    FORMATS,
    ExportedImuNoise,
    ExportOptions,
    export_calibration,
    in_common_frame,
    read_calibration,
)
from rigwake.exporters.basalt import read_imu_noise
from rigwake.exporters.export_base import refer_to_camera
from rigwake.geometry.euler import rotation_from_yaw_pitch_roll, yaw_pitch_roll
from rigwake.geometry.se3 import SE3

OPTIONS = ExportOptions(imu=ExportedImuNoise(0.01, 0.001, 0.002, 0.0001, 200.0))
HOLD_NO_NULL = [name for name, f in FORMATS.items() if not f.holds_null]
TF_SUFFIXES = ("tf.launch", "tf.launch.py", "tf.bag", "tf.mcap", "tf_folder")
FILES = [(name, f.usual_file.rstrip("/")) for name, f in FORMATS.items()] + [
    ("ros-static-tf", suffix) for suffix in TF_SUFFIXES
]


def pairs_of(first: Calibration, second: Calibration) -> list[tuple[SE3, SE3]]:
    """The cameras of both; formats without names keep the order."""
    names = list(first.cameras)
    by_name = set(names) == set(second.cameras)
    others = names if by_name else list(second.cameras)
    return [
        (first.cameras[a].rig_from_cam, second.cameras[b].rig_from_cam)
        for a, b in zip(names, others, strict=True)
    ]


@pytest.mark.parametrize(("name", "file"), FILES)
def test_what_is_written_is_read_back(tmp_path: Path, name: str, file: str) -> None:
    rig = boat(lens=PINHOLE)
    export_calibration(rig, name, tmp_path / file, OPTIONS)
    read = read_calibration(tmp_path / file)
    a, b, _ = in_common_frame(rig, read)
    for before, after in pairs_of(a, b):
        np.testing.assert_allclose(before.matrix, after.matrix, atol=1e-9)
    for camera_read in read.cameras.values():
        if camera_read.model is not None:
            bearing = np.array([[0.3, -0.2, 1.0]])
            found, wanted = camera_read.model.project(bearing)[0], PINHOLE.project(bearing)[0]
            np.testing.assert_allclose(found, wanted, atol=1e-8)


@given(transforms(), transforms())
@settings(max_examples=15)
def test_any_rotation_survives_every_text_format(tmp_path_factory, first: SE3, second: SE3) -> None:
    folder = tmp_path_factory.mktemp("exports")
    rig = Calibration("imu", {"a": camera("a", first, PINHOLE), "b": camera("b", second, PINHOLE)})
    for name, file in FILES:
        if file in ("tf.bag", "tf.mcap", "tf_folder"):
            continue
        export_calibration(rig, name, folder / file, OPTIONS)
        a, b, _ = in_common_frame(rig, FORMATS[name].read(folder / file))
        for before, after in pairs_of(a, b):
            np.testing.assert_allclose(before.matrix, after.matrix, atol=1e-9, err_msg=name)


@given(
    st.floats(-3.1, 3.1),
    st.sampled_from([-np.pi / 2, np.pi / 2, 0.3]) | st.floats(-1.57, 1.57),
    st.floats(-3.1, 3.1),
)
@settings(max_examples=100)
def test_yaw_pitch_roll_composes_also_at_gimbal_lock(yaw: float, pitch: float, roll: float) -> None:
    rotation = rotation_from_yaw_pitch_roll([yaw, pitch, roll])
    np.testing.assert_allclose(rotation_from_yaw_pitch_roll(yaw_pitch_roll(rotation)), rotation, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_topics_clocks_and_names_survive(tmp_path: Path) -> None:
    rig = boat()
    export_calibration(rig, "kalibr", tmp_path / "chain.yaml")
    for name, read in read_calibration(tmp_path / "chain.yaml").cameras.items():
        assert (read.topic, read.time_offset_s) == (f"/cameras/{name}/image_raw", 0.0121)


def test_cameras_of_kalibrs_own_files_are_named_by_their_topics(tmp_path: Path) -> None:
    rig = boat()
    export_calibration(rig, "kalibr", tmp_path / "chain.yaml")
    lines = (tmp_path / "chain.yaml").read_text().splitlines()
    (tmp_path / "chain.yaml").write_text("\n".join(x for x in lines if "camera_name" not in x))
    assert list(read_calibration(tmp_path / "chain.yaml").cameras) == list(rig.cameras)


@pytest.mark.parametrize("name", HOLD_NO_NULL)
def test_unobservable_cameras_are_refused_or_left_out(tmp_path: Path, name: str) -> None:
    rig = without_vertical(boat(), "port")
    if name == "mrcal":
        rig = without_vertical(boat(lens=PINHOLE), "port")
    target = tmp_path / FORMATS[name].usual_file.rstrip("/")
    with pytest.raises(UnobservableError, match="vertical offset of port") as refused:
        export_calibration(rig, name, target, OPTIONS)
    assert "record where waves roll the boat" in refused.value.remedy
    assert not target.exists()
    notes = export_calibration(rig, name, target, OPTIONS, allow_unobservable=True)
    assert any("left out" in note and "vertical offset of port" in note for note in notes)
    assert len(read_calibration(target).cameras) == 3
    texts = [target] if target.is_file() else list(target.iterdir())
    assert not any(re.search(r"\bnan\b", text.read_text(), re.IGNORECASE) for text in texts)
    if name in ("kalibr", "openvins", "ros-static-tf", "urdf", "opencv", "mrcal"):
        assert "vertical offset of port" in texts[0].read_text(), "the file itself says what is missing"


@pytest.mark.parametrize("name", ["json", "csv"])
def test_tables_hold_what_is_determined(tmp_path: Path, name: str) -> None:
    rig = without_vertical(boat(), "port")
    export_calibration(rig, name, tmp_path / f"rig.{name}")
    assert not re.search(r"\bnan\b", (tmp_path / f"rig.{name}").read_text(), re.IGNORECASE)
    port = read_calibration(tmp_path / f"rig.{name}").cameras["port"]
    np.testing.assert_allclose(port.rig_from_cam.translation, [0.41, 0.83, np.nan])
    assert not port.is_observable


def test_nothing_determined_is_refused_even_when_allowed(tmp_path: Path) -> None:
    rig = boat()
    for name in rig.cameras:
        rig = without_vertical(rig, name)
    with pytest.raises(UnobservableError, match="No camera is left"):
        export_calibration(rig, "urdf", tmp_path / "rig.urdf", allow_unobservable=True)


def test_lenses_are_converted_with_their_residual(tmp_path: Path) -> None:
    lens = camera_from_params("pinhole", [500.0, 501, 318, 243, 0, -0.2, 0.1, 0.001, 0.002, 0.01], 640, 480)
    rig = Calibration("imu", {"front": camera("front", SE3.identity(), lens)})
    notes = export_calibration(rig, "kalibr", tmp_path / "chain.yaml")
    assert len(notes) == 1
    assert "pinhole written as" in notes[0]
    written = read_calibration(tmp_path / "chain.yaml").cameras["front"].model
    stated_px = float(notes[0].split("at most ")[1].split(" px")[0])
    corners = np.array([[0.0, 0], [639, 0], [320, 240], [0, 479]])
    assert np.abs(written.project(lens.unproject(corners)[0])[0] - corners).max() < 1.1 * stated_px + 1e-3
    with pytest.raises(CameraError, match=r"more than the 0\.001 px allowed"):
        export_calibration(rig, "openvins", tmp_path / "chain.yaml", ExportOptions(max_fit_error_px=0.001))


def test_a_fisheye_is_not_cut_down_to_a_pinhole(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="reaches the edge"):
        export_calibration(boat(lens=FISHEYE), "mrcal", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_refusal_leaves_nothing_and_old_files_are_named(tmp_path: Path) -> None:
    mixed = {"a": camera("a", SE3.identity(), PINHOLE), "b": camera("b", SE3.identity(), FISHEYE)}
    with pytest.raises(CameraError):
        export_calibration(Calibration("imu", mixed), "mrcal", tmp_path)
    assert list(tmp_path.iterdir()) == []
    export_calibration(boat(), "opencv", tmp_path)
    (note,) = export_calibration(
        without_vertical(boat(), "aft"), "opencv", tmp_path, allow_unobservable=True
    )[1:]
    assert "aft.yaml was there before" in note


def test_colmap_warns_of_its_fisheye(tmp_path: Path) -> None:
    wide = camera_from_params("kb4", FISHEYE.params, 640, 480, np.deg2rad(95))
    notes = export_calibration(boat("front", lens=wide), "colmap", tmp_path)
    assert any("beyond 90 degrees" in note for note in notes)


def broken_boat(**changes) -> Calibration:
    names = {"front": camera("front", SE3.identity())}
    return Calibration(changes.get("reference", "imu"), changes.get("cameras", names))


@pytest.mark.parametrize(
    ("name", "rig", "options", "message"),
    [
        ("openvins", broken_boat(reference="base_link"), OPTIONS, "relative to the imu"),
        ("basalt", broken_boat(), ExportOptions(), "imu.yaml"),
        (
            "basalt",
            broken_boat(
                cameras={n: camera(n, SE3.identity(), time_offset_s=t) for n, t in (("a", 0.0), ("b", 0.01))}
            ),
            OPTIONS,
            "differ by 10.00 ms",
        ),
        ("kalibr", broken_boat(cameras={"a": camera("a", SE3.identity(), None)}), OPTIONS, "no lens for a"),
        ("ros-static-tf", broken_boat(), ExportOptions(child_frame="two words"), "no name for a ROS frame"),
        ("urdf", boat(), ExportOptions(child_frame="camera"), "twice"),
        ("camodocal", broken_boat(cameras={"../a": camera("../a", SE3.identity())}), OPTIONS, "file name"),
        ("opencv", broken_boat(cameras={"../a": camera("../a", SE3.identity())}), OPTIONS, "file name"),
        ("bundler", broken_boat(), OPTIONS, "Known: kalibr"),
    ],
)
def test_wrong_usage_is_named(tmp_path: Path, name, rig, options, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        export_calibration(rig, name, tmp_path / "out" / "file", options)
    assert not list(tmp_path.rglob("*.yaml"))


GOOD_URDF = '<robot name="r"><link name="a"/>{}</robot>'


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("a.yaml", "cam0: {T_cam_imu: [[1, 0], [0, 1]]}", "3 x 4 or 4 x 4"),
        ("a.yaml", f"cam0: {{T_cam_imu: {np.diag([2.0, 2, 2, 1]).tolist()}}}", "not a rotation"),
        ("a.yaml", "cam0: 7", "not a mapping"),
        ("a.yaml", "cam0: {camera_name: x}\ncam1: {camera_name: x}", "T_cn_cnm1"),
        ("a.yaml", "cam0: {T_cam_imu: [[1,0,0,a],[0,1,0,0],[0,0,1,0]]}", "not a number"),
        ("a.yaml", "a: [1, 2", "cannot be read as YAML"),
        ("a.yaml", "!!python/object/apply:os.system ['true']", "cannot be read as YAML"),
        ("a.json", "{", "not JSON"),
        ("a.json", "[" * 100_000, "not JSON"),
        ("a.yaml", "[" * 5000, "cannot be read as YAML"),
        ("a.csv", "camera\n" + "x" * 200_000, "not a table"),
        ("a.json", '{"value0": {}}', "not a Basalt"),
        ("a.json", "[]", "not a rig config"),
        ("a.json", "{}", "not a rigwake calibration"),
        ("a.txt", "front\n1 0 0 0\n", "a name and three rows"),
        ("a.txt", "front\n1 0 0 0\n0 1 0\n0 0 1 0\n", "four numbers"),
        ("a.cameramodel", "__import__('os').system('true')", "not a cameramodel"),
        ("a.cameramodel", "{'lensmodel': 'LENSMODEL_PINHOLE', 'extrinsics': [1]}", "not a cameramodel"),
        ("a.cameramodel", "(" * 5000, "not a cameramodel"),
        ("a.urdf", "<robot>", "not XML"),
        ("a.urdf", '<!DOCTYPE x [<!ENTITY a "b">]><robot/>', "entities"),
        ("a.urdf", GOOD_URDF.format(""), "no fixed joint"),
        ("a.urdf", GOOD_URDF.format('<joint name="j" type="fixed"/>'), "no parent link"),
        ("a.launch", "<launch>", "not XML"),
        (
            "a.launch",
            '<launch><node type="static_transform_publisher" args="1 2"/></launch>',
            "arguments where",
        ),
        ("a.launch", "<launch/>", "0 roots"),
        ("a.py", "TRANSFORMS = open('/etc/passwd')", "not a launch file"),
        ("a.csv", "a,b\n1,2\n", "lacks the columns"),
        ("a.csv", "camera,x_m,y_m,z_m,qw,qx,qy,qz\nf,1,2,x,1,0,0,0\n", "numbers or empty"),
        ("a.csv", "camera,x_m,y_m,z_m,qw,qx,qy,qz\nf,1,2,3,2,0,0,0\n", "unit quaternion"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, file: str, content: str, message: str) -> None:
    (tmp_path / file).write_text(content)
    with pytest.raises(RigwakeError, match=message):
        read_calibration(tmp_path / file)


def test_missing_and_unknown_paths(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="There is no"):
        read_calibration(tmp_path / "nothing.yaml")
    with pytest.raises(InputError, match="no folder of calibrations"):
        read_calibration(tmp_path)


def test_imu_noise_of_kalibr_and_openvins(tmp_path: Path) -> None:
    values = {
        "accelerometer_noise_density": 0.01,
        "accelerometer_random_walk": 1e-3,
        "gyroscope_noise_density": 2e-3,
        "gyroscope_random_walk": 1e-4,
        "update_rate": 200,
    }
    (tmp_path / "imu.yaml").write_text(json.dumps(values))
    (tmp_path / "chain.yaml").write_text(json.dumps({"imu0": values}))
    expected = ExportedImuNoise(0.01, 1e-3, 2e-3, 1e-4, 200.0)
    assert read_imu_noise(tmp_path / "imu.yaml") == expected
    assert read_imu_noise(tmp_path / "chain.yaml") == expected
    (tmp_path / "imu.yaml").write_text("update_rate: 200")
    with pytest.raises(InputError, match=r"not an imu\.yaml"):
        read_imu_noise(tmp_path / "imu.yaml")


def test_frames_that_cannot_be_brought_together() -> None:
    with pytest.raises(InputError, match="different frames"):
        in_common_frame(boat("imu"), boat("base_link"))
    seen_from_front = refer_to_camera(boat("imu"), "front")
    a, b, (note,) = in_common_frame(boat("imu"), seen_from_front)
    assert "relative to front" in note
    for before, after in pairs_of(a, b):
        np.testing.assert_allclose(before.matrix, after.matrix, atol=1e-12)


def test_the_verb_exports_and_diff_reads_it(tmp_path: Path) -> None:
    save_calibration(boat(lens=PINHOLE), tmp_path / "calibration.yaml")
    run = CliRunner().invoke
    written = run(build_app(), ["export", str(tmp_path / "calibration.yaml"), "--to", "colmap"])
    assert written.exit_code == 0, written.output
    folder = tmp_path / "exports" / "colmap"
    assert (folder / "rig_config.json").is_file()
    compared = run(build_app(), ["diff", str(tmp_path / "calibration.yaml"), str(folder), "--json", "-"])
    differences = json.loads(compared.output)["cameras"]
    assert set(differences) == {"front", "port", "starboard", "aft"}
    assert max(d["rotation_deg"] for d in differences.values()) < 1e-6
    assert "csv" in run(build_app(), ["export", "--help"]).output
