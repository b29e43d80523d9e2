"""The public functions: names, light import, what each does, and examples that run as they stand."""

import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import rigwake
from cli_runs import write_examples
from rigwake import api
from rigwake.cameras.formats.camera_files import write_cameras
from rigwake.cameras.registry import camera_from_params
from rigwake.cli.main import VERBS
from rigwake.errors import InputError, UnobservableError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.readers.trajectories import read_trajectory

EXAMPLES = Path(__file__).parent.parent / "examples"
SMALL = camera_from_params("pinhole", [125.0, 125.2, 79.5, 60.7, 0, -0.2, 0.08, 0.001, 0.002, 0], 160, 120)

# (script, arguments, words of the output)
RUNS = [
    ("calibrate_recording", "{images} {here}/out", "The motion is not enough: Only 3.0 s"),
    ("inspect_recordings", "{images} {text}", "images: not enough; cameras: front, left"),
    ("rig_from_trajectories", "{rig_tum} {port_tum}", "port in rig: at"),
    ("trajectory_errors", "{port_tum} {port_tum}", "0.0000 m, 0.0000 deg over 300 poses, aligned by se3"),
    ("has_anything_changed", "{calibration} {calibration}", "changed: nothing"),
    ("where_is_a_point_seen", "{calibration} 20 0 0", " of "),
    ("undistort_pictures", "{lens} {here}/flat {picture}", "pinhole"),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("api")
    names = write_examples(folder)
    write_cameras(folder / "lens.yaml", {"front": SMALL})
    picture = folder / "picture.png"
    cv2.imwrite(str(picture), np.full((SMALL.height_px, SMALL.width_px), 128, np.uint8))
    return names | {"lens": folder / "lens.yaml", "picture": picture}


@pytest.mark.parametrize(("script", "arguments", "said"), RUNS, ids=[run[0] for run in RUNS])
def test_examples_run(script, arguments, said, files, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [script, *arguments.format(**files).split()])
    runpy.run_path(str(EXAMPLES / f"{script}.py"), run_name="__main__")
    assert said in capsys.readouterr().out
    assert len((EXAMPLES / f"{script}.py").read_text().splitlines()) <= 60


def test_importing_the_package_is_light():
    code = (
        "import sys, rigwake; print([m for m in ('numpy', 'cv2', 'pydantic', 'numba') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"


def test_names_are_there_and_callable():
    assert set(api.FUNCTIONS) < set(rigwake.__all__)
    assert all(callable(getattr(rigwake, name)) for name in api.FUNCTIONS)
    assert {"Calibration", "Recording", "Trajectory"} <= set(rigwake.__all__) <= set(dir(rigwake))
    shell_only = {"surround", "recalibrate", "log", "convert", "demo", "segment", "stixels", "depth"}
    assert set(VERBS) - shell_only <= set(api.FUNCTIONS)
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        _ = rigwake.calibrat


@pytest.mark.parametrize("name", ["handeye", "intrinsics", "monitor", "odometry", "report"])
def test_a_verb_that_is_also_a_package_is_called_like_the_others(name):
    import inspect as introspection

    package = getattr(rigwake, name)
    assert Path(package.__file__).name == "__init__.py"
    assert introspection.signature(package) == introspection.signature(getattr(api, name))


def test_handeye_and_evaluate_take_values_and_paths(files, tmp_path):
    reference = rigwake.open_recording  # the function, whatever was imported before
    assert reference is api.open_recording
    by_path = rigwake.handeye(files["rig_tum"], files["port_tum"], out=tmp_path / "rig.yaml")
    mounting = SE3.exp(np.array([0.1, 0.2, 0.0, 0.5, 0.1, 0.0]))
    assert by_path.members["port"].rig_from_cam.translation == pytest.approx(mounting.translation, abs=1e-6)
    found = rigwake.load_calibration(tmp_path / "rig.yaml")
    assert set(rigwake.diff(found, tmp_path / "rig.yaml")) == {"port"}
    errors = rigwake.evaluate(found, tmp_path / "rig.yaml")
    assert errors.cameras["port"].rotation_error_deg < 1e-6
    with pytest.raises(UsageError, match="with a rig, not with a trajectory"):
        rigwake.evaluate(found, read_trajectory(files["rig_tum"]).trajectory)


def test_errors_are_those_of_the_verbs(files, tmp_path):
    with pytest.raises(UnobservableError, match="s of images are to be used"):
        rigwake.calibrate(files["images"], tmp_path / "a", cameras=["front", "left"])
    with pytest.raises(UsageError, match="Setting speed"):
        rigwake.calibrate(files["images"], tmp_path / "a", speed=3)
    with pytest.raises(UsageError, match="'xml' is unknown"):
        rigwake.export(files["calibration"], "xml", tmp_path / "x")
    with pytest.raises(UsageError, match="is already there"):
        rigwake.simulate("demo", files["text"])
    with pytest.raises(InputError, match="not of the calibrated vessel"):
        rigwake.monitor(files["calibration"], files["images"])
    with pytest.raises(InputError, match=r"holds no calibration\.yaml"):
        rigwake.report(tmp_path)


def test_export_and_report_write(files, tmp_path):
    rigwake.export(files["calibration"], "kalibr", tmp_path / "camchain.yaml")
    assert "cam0" in (tmp_path / "camchain.yaml").read_text()
    assert rigwake.report(files["taken"]).is_file()
