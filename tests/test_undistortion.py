"""`rigwake undistort`: views of images and of recordings, in the place where geometry puts them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from basin_recording import basin, basin_recording
from rigwake.cameras.formats.camera_files import read_cameras, write_cameras
from rigwake.cli.main import main
from rigwake.errors import InputError, UsageError
from rigwake.pipeline.undistortion import prepare_undistortion
from rigwake.writers.write import write_recording
from tracking_scene import fisheye

DOT = 5


def run(*arguments: object) -> int:
    import sys

    before, sys.argv = sys.argv, ["rigwake", *map(str, arguments)]
    try:
        main()
    except SystemExit as done:
        return int(done.code or 0)
    finally:
        sys.argv = before
    return 0


@pytest.mark.parametrize("target", ["pinhole", "cylinder", "equirectangular"])
def test_a_dot_lands_where_its_ray_meets_the_view(target: str) -> None:
    camera = fisheye()
    at = np.array([[210.0, 95.0]])
    image = np.zeros((240, 320), np.uint8)
    cv2.circle(image, (210, 95), DOT, 255, -1)
    bearing, _ = camera.unproject(at)
    undistortion = prepare_undistortion(camera, target)  # type: ignore[arg-type]
    name = "front" if target == "pinhole" else "view"
    view, _ = undistortion.views[name]
    picture = undistortion.apply(image)[name]
    rows, columns = np.nonzero(picture > 128)
    expected, valid = view.project(bearing)
    assert valid.all()
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected[0], atol=1.0)


def test_a_wide_lens_becomes_pinholes_that_show_all_of_it(tmp_path: Path) -> None:
    write_cameras(tmp_path / "front.yaml", {"front": fisheye()})
    cv2.imwrite(str(tmp_path / "one.png"), np.full((240, 320), 200, np.uint8))
    assert (
        run(
            "undistort",
            tmp_path / "one.png",
            "--camera-file",
            tmp_path / "front.yaml",
            "-o",
            tmp_path / "out",
        )
        == 0
    )
    cameras = read_cameras(tmp_path / "out" / "cameras.yaml")
    assert {"front", "left", "right", "up", "down"} <= set(cameras)
    for name, camera in cameras.items():
        picture = cv2.imread(str(tmp_path / "out" / name / "one.png"))
        assert picture.shape[:2] == (camera.height_px, camera.width_px)
        assert picture.max() == 200


def test_frames_of_a_recording_are_named_by_their_stamps(tmp_path: Path) -> None:
    recording = basin_recording(basin(seconds=2.0), tmp_path / "memory")
    write_recording(recording, tmp_path / "rec")
    out = tmp_path / "out"
    assert (
        run("undistort", tmp_path / "rec", "--camera", "left", "--to", "cylinder", "--every", 4, "-o", out)
        == 0
    )
    stamps = recording.cameras["left"].timestamps_ns[::4]
    assert sorted(p.stem for p in out.glob("*.png")) == sorted(str(s) for s in stamps)


def test_what_cannot_be_undistorted_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "one.png"), np.zeros((240, 320), np.uint8))
    assert run("undistort", tmp_path / "one.png", "-o", tmp_path / "out") == 2
    assert "--camera-file" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(InputError, match="100 x 50"):
        prepare_undistortion(fisheye(), "cylinder").apply(np.zeros((50, 100), np.uint8))
    with pytest.raises(UsageError, match="focal"):
        prepare_undistortion(fisheye(), "equirectangular", 1e6)
