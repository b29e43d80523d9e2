"""Calibrations of other tools in the forms that people have, read, compared and taken for truth."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from fuzz_inputs import ORB_SLAM, VINS, small_calibration
from rigwake.calibration import load_calibration, save_calibration
from rigwake.calibration.yaml_file import calibration_to_dict
from rigwake.cameras.formats.camera_files import read_cameras
from rigwake.cli.main import build_app
from rigwake.errors import InputError, RigwakeError, UnobservableError
from rigwake.exporters import FORMATS, ExportedImuNoise, ExportOptions, export_calibration, read_calibration
from rigwake.exporters.known_rigs import read_known_rig, rig_in_house_frames
from rigwake.geometry.se3 import SE3

RNG = np.random.default_rng(7)
IMU_FROM_CAM = [SE3.exp(0.4 * RNG.normal(size=6)) for _ in range(3)]
LENS = {
    "camera_model": "pinhole",
    "intrinsics": [400.1, 400.2, 320.5, 240.5],
    "distortion_model": "equidistant",
    "distortion_coeffs": [-0.01, 0.02, -0.003, 0.0004],
    "resolution": [640, 480],
}


def rows(transform: SE3) -> list[list[float]]:
    return [[float(x) for x in row] for row in transform.matrix]


def camchain(to_imu: tuple[int, ...], links: tuple[int, ...], **more: Any) -> dict[str, Any]:
    """A chain of three cameras: which of them have T_cam_imu, which T_cn_cnm1."""
    chain: dict[str, Any] = {}
    for k, imu_from_cam in enumerate(IMU_FROM_CAM):
        entry = {**LENS, **more}
        if k in to_imu:
            entry["T_cam_imu"] = rows(imu_from_cam.inverse())
        if k in links:
            entry["T_cn_cnm1"] = rows(imu_from_cam.inverse() * IMU_FROM_CAM[k - 1])
        chain[f"cam{k}"] = entry
    return chain


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


@pytest.mark.parametrize("to_imu", [(0, 1, 2), (0,), (1,), (2,), (0, 2)])
@pytest.mark.parametrize("name", ["camchain.yaml", "camchain.yml", "camchain.txt", "CAMCHAIN.YAML"])
def test_partial_chains_of_kalibr(tmp_path: Path, to_imu: tuple[int, ...], name: str) -> None:
    calibration = read_calibration(write(tmp_path / name, camchain(to_imu, (1, 2))))
    assert calibration.reference == "imu"
    for camera, expected in zip(calibration.cameras.values(), IMU_FROM_CAM, strict=True):
        np.testing.assert_allclose(camera.rig_from_cam.matrix, expected.matrix, atol=1e-9)


def test_chains_without_imu_and_chains_that_are_broken(tmp_path: Path) -> None:
    calibration = read_calibration(write(tmp_path / "a.yaml", camchain((), (1, 2))))
    assert calibration.reference == "cam0"
    expected = (IMU_FROM_CAM[0].inverse() * IMU_FROM_CAM[2]).matrix
    np.testing.assert_allclose(calibration.camera("cam2").rig_from_cam.matrix, expected, atol=1e-9)
    for to_imu, links, lost in (((0,), (1,), "cam2"), ((), (2,), "cam1"), ((0, 2), (), "cam1")):
        with pytest.raises(InputError, match=f"{lost}.* neither"):
            read_calibration(write(tmp_path / "b.yaml", camchain(to_imu, links)))


@pytest.mark.parametrize("text", ["-1e-5", "-1.0e-05", "-1E-5", "'-1e-5'", "-0.00001"])
def test_numbers_that_yaml_takes_for_text(tmp_path: Path, text: str) -> None:
    chain = yaml.safe_dump(camchain((0, 1, 2), (), timeshift_cam_imu=12345.0)).replace("12345.0", text)
    for camera in read_calibration(write(tmp_path / "a.yaml", chain)).cameras.values():
        assert camera.time_offset_s == pytest.approx(-1e-5)
    for wrong in (".nan", "soon", "[1]"):
        broken = yaml.safe_dump(camchain((0, 1, 2), (), timeshift_cam_imu=12345.0)).replace("12345.0", wrong)
        with pytest.raises(InputError, match="number"):
            read_calibration(write(tmp_path / "b.yaml", broken))


def test_cameras_of_a_chain_may_have_names(tmp_path: Path) -> None:
    chain = dict(zip(("left", "mid", "right"), camchain((0, 1, 2), ()).values(), strict=True))
    assert list(read_calibration(write(tmp_path / "a.yaml", chain)).cameras) == ["left", "mid", "right"]


def test_vins_fusion_and_mono(tmp_path: Path) -> None:
    calibration = read_calibration(write(tmp_path / "vins.yaml", VINS))
    assert calibration.reference == "imu"
    camera = calibration.camera("cam0")
    np.testing.assert_allclose(camera.rig_from_cam.translation, [0.1, 0.2, 0.3])
    assert camera.time_offset_s == 1e-3
    assert camera.model is None
    kannala = (
        "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\ncamera_name: c\nimage_width: 640\nimage_height: 480\n"
        "projection_parameters:\n   k2: 0.1\n   k3: 0.\n   k4: 0.\n   k5: 0.\n"
        "   mu: 400.\n   mv: 401.\n   u0: 320.\n   v0: 240.\n"
    )
    write(tmp_path / "lens.yaml", kannala)
    model = read_calibration(tmp_path / "vins.yaml").camera("cam0").model
    assert model is not None
    assert (model.model, model.params[0]) == ("kb4", 400.0)
    matrix = "!!opencv-matrix\n   rows: 3\n   cols: {}\n   dt: d\n   data: [{}]\n"
    mono = kannala + "extrinsicRotation: " + matrix.format(3, "0, -1, 0, 1, 0, 0, 0, 0, 1")
    mono += "extrinsicTranslation: " + matrix.format(1, "0.1, 0.2, 0.3") + "td: 0.0\n"
    camera = read_calibration(write(tmp_path / "mono.yaml", mono)).camera("cam0")
    np.testing.assert_allclose(camera.rig_from_cam.matrix[:2], [[0, -1, 0, 0.1], [1, 0, 0, 0.2]], atol=1e-12)
    assert camera.model is not None


def test_orb_slam_settings(tmp_path: Path) -> None:
    calibration = read_calibration(write(tmp_path / "orb.yaml", ORB_SLAM))
    assert calibration.reference == "imu"
    assert list(calibration.cameras) == ["cam0", "cam1"]
    np.testing.assert_allclose(calibration.camera("cam1").rig_from_cam.translation, [0.15, -0.02, 0.01])
    (lens,) = read_cameras(tmp_path / "orb.yaml").values()
    assert (lens.model, lens.width_px) == ("kb4", 512)
    old = "%YAML:1.0\nCamera.fx: 500.\nCamera.fy: 500.\nCamera.cx: 320.\nCamera.cy: 240.\nCamera.k1: -0.3\n"
    old += "Camera.k2: 0.1\nCamera.p1: 0.\nCamera.p2: 1e-4\nCamera.width: 640\nCamera.height: 480\n"
    calibration = read_calibration(write(tmp_path / "old.yaml", old))
    assert calibration.reference == "cam0"
    assert calibration.camera("cam0").model is not None


DAMAGE: dict[str, Callable[[dict[str, Any]], None]] = {
    "negative variance": lambda c: c["cameras"]["cam0"]["covariance_cam_axes"][0].__setitem__(0, -1e-6),
    "correlation above one": lambda c: [
        c["cameras"]["cam0"]["covariance_cam_axes"][i].__setitem__(1 - i, 5e-6) for i in (0, 1)
    ],
    "not symmetric": lambda c: c["cameras"]["cam0"]["covariance_cam_axes"][0].__setitem__(1, 5e-7),
    "infinite": lambda c: c["cameras"]["cam0"]["covariance_cam_axes"][0].__setitem__(0, float("inf")),
    "null beside the diagonal": lambda c: c["cameras"]["cam0"]["covariance_cam_axes"][0].__setitem__(1, None),
    "joint": lambda c: c["joint_covariance"][0].__setitem__(0, -1.0),
    "antenna": lambda c: c["antenna"]["covariance"][0].__setitem__(0, -1.0),
    "time offset": lambda c: c["cameras"]["cam0"].__setitem__("time_offset_s", float("inf")),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_impossible_numbers_of_a_calibration_are_refused(tmp_path: Path, kind: str) -> None:
    content = json.loads(json.dumps(calibration_to_dict(small_calibration())))
    write(tmp_path / "good.yaml", content)
    load_calibration(tmp_path / "good.yaml")
    DAMAGE[kind](content)
    with pytest.raises(InputError, match=r"covariance|number"):
        load_calibration(write(tmp_path / "bad.yaml", content))


@pytest.mark.parametrize("lost", [(0,), (2,), (0, 1, 2), "rotation"])
def test_a_null_without_an_entry_is_not_determined(tmp_path: Path, lost: Any) -> None:
    content = json.loads(json.dumps(calibration_to_dict(small_calibration())))
    transform = content["cameras"]["cam0"]["rig_from_cam"]
    if lost == "rotation":
        transform["quat_wxyz"] = None
    else:
        for axis in lost:
            transform["translation_m"][axis] = None
    calibration = load_calibration(write(tmp_path / "a.yaml", content))
    camera = calibration.camera("cam0")
    expected = [0, 1, 2] if lost == "rotation" else [3 + axis for axis in lost]
    assert np.flatnonzero(~camera.observable_axes).tolist() == expected
    for name in ("kalibr", "urdf", "colmap"):
        with pytest.raises(UnobservableError, match="cam0"):
            export_calibration(calibration, name, tmp_path / "out")


def run(*arguments: object) -> tuple[int, dict[str, Any], str]:
    result = CliRunner().invoke(build_app(), [str(a) for a in arguments] + ["--json", "-"])
    code = 0 if result.exception is None else getattr(result.exception, "exit_code", 1)
    return code, json.loads(result.stdout) if code == 0 else {}, str(result.exception)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n == "mrcal" else []) for n in sorted(FORMATS)]
)
def test_any_format_may_be_the_truth(tmp_path: Path, name: str) -> None:
    save_calibration(small_calibration(), tmp_path / "found.yaml")
    target = tmp_path / FORMATS[name].usual_file.rstrip("/")
    options = ExportOptions(imu=ExportedImuNoise(0.01, 1e-4, 1e-3, 1e-5, 200.0))
    try:
        export_calibration(small_calibration(), name, target, options)
        truth = read_known_rig(target)
    except RigwakeError as error:
        pytest.fail(f"{name}: {error}")
    names = dict(zip(truth.cameras, small_calibration().cameras, strict=True))
    code, errors, _ = run("evaluate", tmp_path / "found.yaml", "--truth", target)
    if set(names) & set(names.values()):
        assert code == 0
        for camera in errors["cameras"].values():
            assert camera["rotation_error_deg"] < 1e-4
            assert camera["translation_error_norm_m"] < 1e-6
            held = name in ("kalibr", "openvins", "json", "csv", "basalt", "opencv")
            assert camera["time_offset_error_s"] == (pytest.approx(0.0, abs=1e-9) if held else None)


def test_frames_of_a_truth() -> None:
    rig = small_calibration().rig
    inverse = rig_in_house_frames(rig, "inverse")
    twice = rig_in_house_frames(inverse, "inverse")
    for name, camera in rig.cameras.items():
        np.testing.assert_allclose(
            inverse.cameras[name].rig_from_cam.matrix, camera.rig_from_cam.inverse().matrix
        )
        np.testing.assert_allclose(twice.cameras[name].rig_from_cam.matrix, camera.rig_from_cam.matrix)
        ned = rig_in_house_frames(rig, "ned").cameras[name].rig_from_cam.translation
        np.testing.assert_allclose(ned, camera.rig_from_cam.translation * [1, -1, -1])


@pytest.mark.parametrize("shift_ms", [0.0, 12.3, -3.0])
@pytest.mark.parametrize("focal", [1.0, 1.01, 1.1])
def test_diff_compares_lenses_and_time_offsets(tmp_path: Path, shift_ms: float, focal: float) -> None:
    first = camchain((0, 1, 2), (), timeshift_cam_imu=0.01)
    second = camchain((0, 1, 2), (), timeshift_cam_imu=0.01 + 1e-3 * shift_ms)
    for entry in second.values():
        entry["intrinsics"] = [focal * entry["intrinsics"][0], focal * entry["intrinsics"][1], 320.5, 240.5]
    a, b = write(tmp_path / "a.yaml", first), write(tmp_path / "b.yaml", second)
    code, differences, _ = run("diff", a, b)
    assert code == 0
    for camera in differences["cameras"].values():
        assert camera["time_offset_ms"] == pytest.approx(shift_ms, abs=1e-6)
        assert (camera["lens_px"]["max"] > 1) == (focal > 1)
        assert camera["rotation_deg"] < 1e-9
    result = CliRunner().invoke(build_app(), ["diff", str(a), str(b)])
    assert ("are the same" in result.stdout) == (shift_ms == 0 and focal == 1)


@pytest.mark.parametrize("value", ["nan", "inf", "-1", "0"])
def test_a_range_must_be_a_distance(tmp_path: Path, value: str) -> None:
    path = write(tmp_path / "a.yaml", camchain((0, 1, 2), ()))
    code, _, message = run("diff", path, path, "--range", value)
    assert code == 2
    assert "above 0" in message


def test_all_pairs_of_formats_agree(tmp_path: Path) -> None:
    """The same rig through any two formats is the same rig."""
    chain = read_calibration(write(tmp_path / "chain.yaml", camchain((0, 1, 2), ())))
    read = []
    for name in ("kalibr", "urdf", "json", "csv"):
        target = tmp_path / f"{name}_{FORMATS[name].usual_file.rstrip('/')}"
        export_calibration(chain, name, target)
        read.append(read_calibration(target))
    for a, b in itertools.combinations(read, 2):
        for x, y in zip(a.cameras.values(), b.cameras.values(), strict=True):
            np.testing.assert_allclose(x.rig_from_cam.matrix, y.rig_from_cam.matrix, atol=1e-6)


def test_the_folder_that_calibrate_leaves(tmp_path: Path) -> None:
    calibration = small_calibration()
    save_calibration(calibration, tmp_path / "calibration.yaml")
    assert read_calibration(tmp_path).cameras.keys() == calibration.cameras.keys()
