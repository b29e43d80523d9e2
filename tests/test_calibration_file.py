import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings

from geometry_strategies import transforms
from rigwake.calibration import (
    CalibratedCamera,
    Calibration,
    UnobservableDirection,
    load_calibration,
    save_calibration,
)
from rigwake.calibration.yaml_file import calibration_from_dict, calibration_to_dict
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import InputError, UsageError
from rigwake.geometry.se3 import SE3

LENS = camera_from_params(
    "kb4", np.array([200.4, 200.4, 322.6, 236.9, -0.0115, 0.0062, -0.0034, 0.0005]), 640, 480
)
STD = np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03])


def calibrated(name: str = "front", **fields) -> CalibratedCamera:
    rig_from_cam = SE3.exp(np.array([0.1, 1.2, -0.4, 0.75, -0.2, 1.5]))
    return CalibratedCamera(name, rig_from_cam, np.diag(STD**2), model=LENS, topic="/cam/front", **fields)


def vertical_lost(
    camera: str = "front", direction: tuple[float, ...] = (0, 0, 0, 0, 0, 1)
) -> UnobservableDirection:
    return UnobservableDirection(
        np.array(direction, float), f"vertical offset of {camera}", "record in waves"
    )


@given(transforms())
@settings(max_examples=30)
def test_transforms_survive_the_file(rig_from_cam: SE3) -> None:
    camera = replace(calibrated(), rig_from_cam=rig_from_cam)
    text = yaml.safe_dump(calibration_to_dict(Calibration("imu", {"front": camera})), sort_keys=False)
    read = calibration_from_dict(yaml.safe_load(text)).camera("front").rig_from_cam
    np.testing.assert_allclose(read.matrix, rig_from_cam.matrix, atol=1e-12)


def test_everything_survives_the_file(tmp_path: Path) -> None:
    written = Calibration(
        reference="imu",
        cameras={
            "front": calibrated(time_offset_s=0.012, time_offset_std_s=1e-4, statistics={"observations": 10}),
            "port": calibrated("port", scale=2.5, scale_std=0.1, unobservable=(vertical_lost("port"),)),
        },
        joint_covariance=np.diag(np.tile(STD**2, 2)),
        antenna_rig=np.array([-0.6, 0.3, 2.1]),
        antenna_covariance=np.diag([1e-4, 1e-4, 1e-3]),
        checks={"split_half": {"front": [0.1, math.nan]}},
        provenance={"inputs": [{"path": "rec.bag", "sha256": "abc"}]},
    )
    save_calibration(written, tmp_path / "deep" / "calibration.yaml")
    read = load_calibration(tmp_path / "deep" / "calibration.yaml")
    save_calibration(read, tmp_path / "again.yaml")
    again = load_calibration(tmp_path / "again.yaml")
    assert list(calibration_to_dict(again)) == list(calibration_to_dict(written))
    np.testing.assert_allclose(again.joint_covariance, written.joint_covariance)
    np.testing.assert_allclose(again.antenna_rig, written.antenna_rig)
    np.testing.assert_allclose(again.antenna_covariance, written.antenna_covariance)
    assert again.provenance == written.provenance
    port = again.camera("port")
    assert (port.scale, port.scale_std, port.time_offset_s) == (2.5, 0.1, None)
    assert [d.words for d in port.unobservable] == ["vertical offset of port"]
    front = read.camera("front")
    np.testing.assert_allclose(front.model.params, LENS.params)
    np.testing.assert_allclose(front.covariance, written.camera("front").covariance)
    np.testing.assert_allclose(front.std_translation_m, written.camera("front").std_translation_m)
    assert read.checks["split_half"]["front"] == [0.1, None]
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["calibration.yaml"]


def test_a_lost_axis_has_no_number_anywhere() -> None:
    camera = calibrated(unobservable=(vertical_lost(),))
    assert np.isnan(camera.rig_from_cam.translation[2])
    assert np.isfinite(camera.rig_from_cam.translation[:2]).all()
    assert np.isfinite(camera.rig_from_cam.rotation).all()
    assert np.isnan(camera.std_translation_m[2])
    assert not camera.is_observable
    content = calibration_to_dict(Calibration("imu", {"front": camera}))["cameras"]["front"]
    assert content["rig_from_cam"]["translation_m"][2] is None
    assert content["std_rig_axes"]["translation_m"][2] is None
    assert content["known_offsets"] == []


def test_an_oblique_lost_direction_keeps_the_known_combination() -> None:
    """A reference camera pitched down 30 degrees: the rig's y and z both contain the vertical."""
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    whole = calibrated()
    camera = calibrated(unobservable=(vertical_lost(direction=(0, 0, 0, 0, c, s)),))
    np.testing.assert_array_equal(np.isnan(camera.rig_from_cam.translation), [False, True, True])
    (known,) = camera.known_offsets
    np.testing.assert_allclose(np.abs(known.direction_rig @ [0, -s, c]), 1.0)
    assert known.value_m == pytest.approx(float(known.direction_rig @ whole.rig_from_cam.translation))
    assert 0.01 < known.std_m < 0.04


def test_a_lost_rotation_takes_the_whole_quaternion() -> None:
    camera = calibrated(unobservable=(UnobservableDirection(np.eye(6)[2], "heading of front"),))
    content = calibration_to_dict(Calibration("imu", {"front": camera}))["cameras"]["front"]
    assert content["rig_from_cam"]["quat_wxyz"] is None
    assert np.isnan(camera.std_rotation_deg).all()


def test_the_file_is_not_written_half(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(Calibration("imu", {"front": calibrated()}), path)
    before = path.read_text()
    with pytest.raises(yaml.YAMLError):
        save_calibration(Calibration("imu", {}, provenance={"bad": object()}), path)
    assert path.read_text() == before


def good() -> dict:
    return calibration_to_dict(Calibration("imu", {"front": calibrated()}))


def without(*keys: str) -> dict:
    content = good()
    inner = content
    for key in keys[:-1]:
        inner = inner[key]
    del inner[keys[-1]]
    return content


def changed(value: object, *keys: str) -> dict:
    content = good()
    inner = content
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "not a rigwake calibration"),
        ([1, 2], "not a rigwake calibration"),
        (without("rigwake_calibration"), "not a rigwake calibration"),
        (changed(99, "rigwake_calibration"), "schema version 99"),
        (without("cameras"), "damaged"),
        (changed([], "cameras"), "damaged"),
        (without("cameras", "front", "rig_from_cam"), "damaged"),
        (changed([1, 0, 0], "cameras", "front", "rig_from_cam", "quat_wxyz"), "shape"),
        (changed([2, 0, 0, 0], "cameras", "front", "rig_from_cam", "quat_wxyz"), "norm 2"),
        (changed("abc", "cameras", "front", "rig_from_cam", "translation_m"), "numbers or null"),
        (changed("soon", "cameras", "front", "time_offset_s"), "must be a number"),
        (changed([[1]], "cameras", "front", "covariance_cam_axes"), "shape"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, content: object, message: str) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    with pytest.raises(InputError, match=message):
        load_calibration(path)


def test_the_folder_that_holds_it_is_read_as_well(tmp_path: Path) -> None:
    save_calibration(calibration_from_dict(good()), tmp_path / "calibration.yaml")
    assert load_calibration(tmp_path).reference == load_calibration(tmp_path / "calibration.yaml").reference
    with pytest.raises(InputError, match="regular file"):
        load_calibration(tmp_path.parent)


def test_missing_and_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file"):
        load_calibration(tmp_path / "nothing.yaml")
    (tmp_path / "bad.yaml").write_text("a: [1, 2")
    with pytest.raises(InputError, match="cannot be read as YAML"):
        load_calibration(tmp_path / "bad.yaml")
    (tmp_path / "evil.yaml").write_text("!!python/object/apply:os.system ['true']")
    with pytest.raises(InputError, match="cannot be read as YAML"):
        load_calibration(tmp_path / "evil.yaml")


def test_names_are_listed_when_one_is_wrong() -> None:
    with pytest.raises(UsageError, match="It has: front"):
        Calibration("imu", {"front": calibrated()}).camera("aft")
