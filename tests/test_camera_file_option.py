"""Intrinsics from files win over the recording's: by name, one for one, NAME=FILE, with a board's covariance."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from rigwake.cameras.formats.camera_files import write_cameras
from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.cameras.registry import camera_to_dict
from rigwake.errors import InputError, UsageError
from rigwake.readers.lens_choice import lenses_from_options, with_chosen_lenses
from rigwake.recording import CameraStream, Finding, Recording

LENS = KannalaBrandt4((100.0, 100.0, 31.5, 23.5, 0.0, 0.0, 0.0, 0.0), 64, 48)
OTHER = replace(LENS, values=(90.0, 91.0, 30.0, 24.0, 0.01, 0.0, 0.0, 0.0))


def recording(*names: str) -> Recording:
    cameras = {name: CameraStream(name, np.arange(2), None, 64, 48, LENS) for name in names}
    return Recording(Path("rec.bag"), "ros1", cameras)


def with_camera_files(recording: Recording, files: list[str]) -> Recording:
    return with_chosen_lenses(recording, lenses_from_options(files))


@pytest.mark.parametrize("file_format", ["rigwake", "kalibr", "opencv"])
def test_one_camera_for_one_camera_whatever_its_name(tmp_path: Path, file_format: str) -> None:
    write_cameras(tmp_path / "lens.yaml", {"other": OTHER}, file_format)
    found = with_camera_files(recording("front"), [str(tmp_path / "lens.yaml")])
    np.testing.assert_allclose(found.cameras["front"].model.params, OTHER.params)


def test_by_name_and_by_assignment(tmp_path: Path) -> None:
    both, single = tmp_path / "both.yaml", tmp_path / "single.yaml"
    write_cameras(both, {"front": OTHER, "mast": OTHER})
    write_cameras(single, {"any": OTHER})
    found = with_camera_files(recording("front", "port"), [str(both)])
    assert found.cameras["front"].model == OTHER
    assert found.cameras["port"].model == LENS
    found = with_camera_files(recording("front", "port"), [f"port={single}"])
    assert found.cameras["port"].model == OTHER
    with pytest.raises(UsageError, match="is for stern"):
        with_camera_files(recording("front", "port"), [f"stern={single}"])
    with pytest.raises(UsageError, match="CAMERA=FILE"):
        with_camera_files(recording("front", "port"), [str(single)])


def test_another_resolution_is_refused(tmp_path: Path) -> None:
    write_cameras(tmp_path / "lens.yaml", {"front": replace(OTHER, width_px=128)})
    with pytest.raises(InputError, match="128 x 48"):
        with_camera_files(recording("front"), [str(tmp_path / "lens.yaml")])
    with pytest.raises(InputError):
        with_camera_files(recording("front"), [str(tmp_path / "missing.yaml")])


def test_the_covariance_of_a_board_comes_along(tmp_path: Path) -> None:
    covariance = np.diag(np.arange(1.0, 9)).tolist()
    covariance[7][7] = None
    calibration = {"std": dict.fromkeys(LENS.param_names, 1.0), "covariance": covariance}
    content = {"cameras": {"front": {**camera_to_dict(OTHER), "calibration": calibration}}}
    (tmp_path / "front.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    given = replace(recording("front"), findings=(Finding("warning", "front", "no intrinsics in rig.yaml"),))
    found = with_camera_files(given, [str(tmp_path / "front.yaml")])
    spread = found.cameras["front"].intrinsics_covariance
    assert spread is not None
    np.testing.assert_array_equal(np.diag(spread)[:7], np.arange(1.0, 8))
    assert np.isnan(spread[7, 7])
    assert found.findings == ()
