"""The whole way on the recorded harbour, against its truth."""

from pathlib import Path

import numpy as np
import pytest

from rigwake.calibration import Calibration
from rigwake.config import load_config
from rigwake.evaluation.rig_errors import RigErrors, evaluate_calibration
from rigwake.pipeline.calibration_run import CalibrationRun, calibrate
from rigwake.readers.truth_files import read_true_rig, rig_in_frame

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("harbour_a")


def run(real_recordings: Path, out: Path, *settings: str, resume: bool = False) -> CalibrationRun:
    folder = real_recordings / "harbour_a"
    return calibrate(folder / "harbour_a.bag", out, load_config(None, settings), resume=resume)


def errors_of(calibration: Calibration, real_recordings: Path) -> RigErrors:
    truth = read_true_rig(real_recordings / "harbour_a" / "truth.yaml")
    return evaluate_calibration(calibration, rig_in_frame(truth, "imu"))


def assert_within_sigmas(calibration: Calibration, errors: RigErrors, most: float) -> None:
    for name, camera in calibration.cameras.items():
        error = errors.cameras[name]
        assert (np.abs(error.translation_error_m) < most * camera.std_translation_m).all(), name
        assert error.rotation_error_deg < most * np.linalg.norm(camera.std_rotation_deg), name


def test_the_harbour_with_and_without_landmarks_handed_over(real_recordings: Path, out: Path) -> None:
    full = run(real_recordings, out).calibration
    assert (out / "calibration.yaml").is_file()
    errors = errors_of(full, real_recordings)
    assert set(full.cameras) == {"front", "left", "back", "right"}
    for error in errors.cameras.values():
        assert error.rotation_error_deg <= 0.05
        assert np.linalg.norm(error.translation_error_m[:2]) <= 0.02
        assert abs(error.translation_error_m[2]) <= 0.04
        assert error.time_offset_error_s is not None
        assert abs(error.time_offset_error_s) <= 1e-3
    for pair in errors.pairs:
        assert pair.rotation_error_deg <= 0.04
        assert pair.translation_error_m <= 0.015
    assert_within_sigmas(full, errors, 3.0)

    tracked = (out / "tracks" / "front.npz").stat().st_mtime_ns
    alone = run(real_recordings, out, "adjustment.cross_camera=false", resume=True).calibration
    assert (out / "tracks" / "front.npz").stat().st_mtime_ns == tracked
    errors = errors_of(alone, real_recordings)
    for error in errors.cameras.values():
        assert error.rotation_error_deg <= 0.1
        assert error.translation_error_norm_m <= 0.05
    assert_within_sigmas(alone, errors, 3.0)
