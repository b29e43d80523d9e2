"""External camera files: round trips, known values, and refusals."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from rigwake.cameras.formats.camera_dicts import camera_to_colmap
from rigwake.cameras.formats.camera_files import WRITERS, read_camera, read_cameras, write_cameras
from rigwake.cameras.formats.camera_info import camera_from_info, info_from_camera
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_dict, camera_from_params, camera_to_dict
from rigwake.errors import CameraError, InputError, UsageError

KB4 = camera_from_params("kb4", [200.4, 201.1, 322.6, 236.9, -0.0115, 0.0062, -0.0034, 0.0005], 640, 480)
PINHOLE = camera_from_params(
    "pinhole", [458.654, 457.296, 367.215, 248.375, 0, -0.283, 0.0739, 1.9e-4, 1.8e-5, 0], 752, 480
)
RATIONAL = camera_from_params(
    "rational", [458.0, 457.0, 367.0, 248.0, 0, 0.3, 0.07, 2e-4, 2e-5, 0.01, 0.02, 0.01, 0.001], 752, 480
)
MEI = camera_from_params("mei", [400.0, 401, 320, 240, 1.4, -0.05, 0.01, 1e-3, -2e-3, 0], 640, 480)
SCARAMUZZA = camera_from_params(
    "scaramuzza", [320.3, 240.2, 1.001, 0.002, -0.003, -200, 0, 1.8e-3, -1e-6, 3e-9], 640, 480
)
EUCM = camera_from_params("eucm", [200.0, 201, 320, 240, 0.6, 1.1], 640, 480)
DOUBLE_SPHERE = camera_from_params("ds", [200.0, 201, 320, 240, -0.2, 0.6], 640, 480)
FOV = camera_from_params("fov", [200.0, 201, 320, 240, 0.93], 640, 480)

CAN_HOLD = {
    "rigwake": [KB4, PINHOLE, RATIONAL, MEI, SCARAMUZZA, EUCM, DOUBLE_SPHERE, FOV],
    "kalibr": [KB4, PINHOLE, MEI, EUCM, DOUBLE_SPHERE, FOV],
    "opencv": [KB4, PINHOLE, RATIONAL],
    "camodocal": [KB4, PINHOLE, MEI, SCARAMUZZA],
    "ocamcalib": [SCARAMUZZA],
    "basalt": [KB4, RATIONAL, EUCM, DOUBLE_SPHERE, FOV],
    "colmap": [KB4, PINHOLE, RATIONAL, FOV],
}


def bearings_of(camera: CameraModel) -> np.ndarray:
    pixels = np.random.default_rng(0).uniform([0, 0], [camera.width_px, camera.height_px], (300, 2))
    bearings, valid = camera.unproject(pixels)
    return bearings[valid]


@pytest.mark.parametrize(
    ("file_format", "camera"),
    [(name, camera) for name, cameras in CAN_HOLD.items() for camera in cameras],
    ids=lambda value: value if isinstance(value, str) else value.model,
)
def test_every_format_gives_back_the_same_lens(file_format: str, camera: CameraModel, tmp_path: Path) -> None:
    path = tmp_path / "front.txt"
    write_cameras(path, {"front": camera}, file_format)
    again = read_camera(path)
    assert again.model == camera.model
    np.testing.assert_allclose(again.params, camera.params, rtol=1e-14, atol=1e-13)
    bearings = bearings_of(camera)
    np.testing.assert_allclose(again.project(bearings)[0], camera.project(bearings)[0], atol=1e-8)


def test_the_table_above_covers_every_writer() -> None:
    assert CAN_HOLD.keys() == WRITERS.keys()


@pytest.mark.parametrize("file_format", sorted(WRITERS.keys() - {"rigwake"}))
def test_a_lens_without_a_form_is_refused(file_format: str, tmp_path: Path) -> None:
    full = [200.0, 201, 320, 240, 1, *[0.01] * 4, *[0.01] * 14]
    with pytest.raises(CameraError, match="no form"):
        write_cameras(tmp_path / "x", {"a": camera_from_params("kb23", full, 640, 480)}, file_format)


def test_own_form_keeps_the_given_angle_and_only_that() -> None:
    limited = camera_from_params("kb4", KB4.params, 640, 480, np.deg2rad(92.5))
    assert camera_to_dict(limited)["max_angle_deg"] == pytest.approx(92.5)
    assert "max_angle_deg" not in camera_to_dict(KB4)
    assert camera_from_dict(camera_to_dict(limited)) == limited
    assert camera_from_dict(camera_to_dict(KB4)) == KB4 != limited


@pytest.mark.parametrize("camera", CAN_HOLD["rigwake"], ids=lambda camera: camera.model)
def test_own_form_takes_parameters_in_any_order(camera: CameraModel) -> None:
    plain = camera_to_dict(camera)
    turned = {**plain, "params": dict(reversed(plain["params"].items()))}
    assert camera_from_dict(turned) == camera
    name = next(iter(plain["params"]))
    renamed = {("odd" if key == name else key): value for key, value in plain["params"].items()}
    with pytest.raises(CameraError, match=f"takes the parameters .*{name}.*the file has odd"):
        camera_from_dict({**plain, "params": renamed})
    with pytest.raises(CameraError, match="not a number"):
        camera_from_dict({**plain, "params": {**plain["params"], name: "wide"}})
    missing = {key: value for key, value in plain["params"].items() if key != name}
    with pytest.raises(CameraError, match="takes"):
        camera_from_dict({**plain, "params": missing})


def test_ocamcalib_rows_are_first_and_its_pixels_are_ours(tmp_path: Path) -> None:
    text = (
        "#polynomial coefficients for the DIRECT mapping function\n\n5 -200 0 1.8e-3 -1e-6 3e-9\n\n"
        "#inverse\n\n2 300 150\n\n#center\n\n241.8 394.5\n\n#affine\n\n1.01 0.02 0.03\n\n#size\n\n480 752\n"
    )
    (tmp_path / "calib_results.txt").write_text(text)
    camera = read_camera(tmp_path / "calib_results.txt")
    assert (camera.width_px, camera.height_px) == (752, 480)
    # the toolbox: row = c x + d y + row0, column = e x + y + column0, ray (x, y, f) with z towards the viewer
    x_down, y_right = 50.0, 80.0
    r = np.hypot(x_down, y_right)
    f = -200 + 1.8e-3 * r**2 - 1e-6 * r**3 + 3e-9 * r**4
    column, row = 0.03 * x_down + y_right + 394.5, 1.01 * x_down + 0.02 * y_right + 241.8
    pixels, _ = camera.project(np.array([[y_right, x_down, -f]]))
    np.testing.assert_allclose(pixels, [[column, row]], atol=1e-9)


def test_camodocal_scaramuzza_follows_its_space_to_plane(tmp_path: Path) -> None:
    write_cameras(tmp_path / "a.yaml", {"a": SCARAMUZZA}, "camodocal")
    plain = yaml.safe_load((tmp_path / "a.yaml").read_text().removeprefix("%YAML:1.0"))
    affine, inverse = plain["affine_parameters"], list(plain["inv_poly_parameters"].values())
    point = np.array([0.4, -0.7, 0.3])
    flat = np.hypot(*point[:2])
    x, y = point[:2] / flat * np.polynomial.polynomial.polyval(np.arctan2(-point[2], flat), inverse)
    expected = [
        x * affine["ac"] + y * affine["ad"] + affine["cx"],
        x * affine["ae"] + y + affine["cy"],
    ]
    # the fitted inverse polynomial is what limits the agreement
    np.testing.assert_allclose(SCARAMUZZA.project(point[None])[0][0], expected, atol=0.05)


def test_colmap_counts_pixels_from_the_corner() -> None:
    name, params = camera_to_colmap(KB4)
    assert (name, params[2], params[3]) == ("OPENCV_FISHEYE", 322.6 + 0.5, 236.9 + 0.5)


def test_euroc_and_opencv_files_of_others(real_recordings: Path) -> None:
    euroc = read_camera(real_recordings / "euroc_v101_micro/mav0/cam0/sensor.yaml")
    assert euroc.model == "pinhole"
    assert euroc.params[:4] == pytest.approx([458.654, 457.296, 367.215, 248.375])
    boat = real_recordings / "marine_boat360/yaml/front.yaml"
    with pytest.raises(CameraError, match="does not say of which model"):
        read_camera(boat)
    lens = read_camera(boat, fisheye=True)
    assert (lens.model, lens.width_px, lens.height_px) == ("kb4", 1280, 960)


@pytest.mark.parametrize("name", ["plumb_bob", "rational_polynomial", "equidistant", "fisheye"])
def test_camera_info_round_trip(name: str) -> None:
    camera = {"plumb_bob": PINHOLE, "rational_polynomial": RATIONAL}.get(name, KB4)
    info = info_from_camera(camera)
    again = camera_from_info(name, info.D, info.K, info.width_px, info.height_px)
    assert again == camera


def test_camera_info_that_says_nothing_is_refused() -> None:
    with pytest.raises(CameraError, match="not calibrated"):
        camera_from_info("plumb_bob", [], [0.0] * 9, 640, 480)
    with pytest.raises(CameraError, match="not known"):
        camera_from_info("thin_prism", [], [1, 0, 1, 0, 1, 1, 0, 0, 1], 640, 480)


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("", InputError),
        ("hello: world\n", InputError),
        ("cam0: {camera_model: omni, intrinsics: [1, 2]}\n", CameraError),
        ("model: kb4\nwidth_px: 3\nheight_px: x\nparams: {fx: 1}\n", CameraError),
        ("model: nosuch\nwidth_px: 3\nheight_px: 3\nparams: {fx: 1}\n", CameraError),
        ("model: !!python/object/apply:os.getcwd []\nparams: {}\n", CameraError),
        ('{"value0": 3}', CameraError),
        ("#polynomial coefficients\n5 1 2\n", CameraError),
        ("1 SIMPLE_PINHOLE 640 480 1 2\n", CameraError),
        ("%YAML:1.0\n---\nmodel_type: MEI\nimage_width: 3\nimage_height: 3\n", CameraError),
    ],
)
def test_broken_files_are_named_errors(content: str, error: type[Exception], tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(content)
    with pytest.raises(error):
        read_cameras(path)


def test_choosing_among_several_cameras(tmp_path: Path) -> None:
    write_cameras(tmp_path / "c.yaml", {"port": KB4, "bow": MEI})
    assert read_camera(tmp_path / "c.yaml", "bow") == MEI
    with pytest.raises(UsageError, match="port, bow"):
        read_camera(tmp_path / "c.yaml")
    with pytest.raises(UsageError, match="one camera per file"):
        write_cameras(tmp_path / "d.yaml", {"port": KB4, "bow": KB4}, "opencv")
