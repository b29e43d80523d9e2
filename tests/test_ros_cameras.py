"""Cameras of ROS bags as drivers record them: camera_info, depth, rectified, cropped and binned images, encodings."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rigwake.errors import InputError, UsageError
from rigwake.readers.open import open_recording
from rigwake.readers.pixel_encodings import bits_in_use, decode_pixels
from rigwake.readers.topics import TopicMap, info_topics, sensor_names
from rigwake.recording import Recording
from ros_bags import HEIGHT, WIDTH, K, SmallBag, picture


def words(recording: Recording) -> str:
    return " | ".join(f"{f.severity} {f.sensor}: {f.message}" for f in recording.findings)


DRIVERS = {
    "/camera/color/image_raw": "/camera/color/camera_info",
    "/camera/infra1/image_rect_raw": "/camera/infra1/camera_info",
    "/camera/rgb/image_color": "/camera/rgb/camera_info",
    "/oak/rgb/image_raw/compressed": "/oak/rgb/camera_info",
    "/zed2/zed_node/left_raw/image_raw_color": "/zed2/zed_node/left_raw/camera_info",
    "/zed/zed_node/rgb/color/rect/image": "/zed/zed_node/rgb/color/rect/camera_info",
    "/image_raw": "/camera_info",
    "/front_stereo_camera/left/image_rect": "/front_stereo_camera/left/camera_info_rect",
    "/airsim_node/drone/front/Scene": "/airsim_node/drone/front/Scene/camera_info",
    "/gazebo/front": "/gazebo/camera_info",
    "/carla/ego/rgb_front/image": "/carla/ego/rgb_front/camera_info",
    "/front/rgb/image_raw": "/front/camera_info",
}


@pytest.mark.parametrize("topic", DRIVERS)
def test_camera_info_where_drivers_put_it(tmp_path: Path, topic: str) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        if topic.endswith("/compressed"):
            for at in range(3):
                bag.compressed(topic, at / 10, cv2.imencode(".jpg", picture())[1].tobytes())
            bag.info(DRIVERS[topic])
        else:
            bag.camera(topic, DRIVERS[topic])
    (camera,) = open_recording(tmp_path / "r.bag").cameras.values()
    assert camera.model is not None
    assert camera.model.params[0] == K[0]


def test_image_transports_rule_comes_first_and_the_frame_last(tmp_path: Path) -> None:
    assert info_topics("/a/b/image_raw/compressed")[0] == "/a/b/camera_info"
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/x/front", frame="front_optical")
        bag.camera("/x/rear", frame="rear_optical")
        bag.info("/calibration/one", matrix=[30.0, *K[1:]], frame="rear_optical")
        bag.info("/calibration/two", matrix=[40.0, *K[1:]], frame="front_optical")
    recording = open_recording(tmp_path / "r.bag")
    focal = {n: None if c.model is None else c.model.params[0] for n, c in recording.cameras.items()}
    assert focal == {"front": 40.0, "rear": 30.0}


def test_one_camera_info_beside_two_cameras_is_of_the_one_whose_frame_it_names(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/gazebo/front", frame="front_optical")
        bag.camera("/gazebo/rear", frame="rear_optical")
        bag.info("/gazebo/camera_info", frame="rear_optical")
    cameras = open_recording(tmp_path / "r.bag").cameras
    assert {name for name, camera in cameras.items() if camera.model is not None} == {"rear"}


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "64FC1"])
@pytest.mark.parametrize(
    "topic", ["/camera/depth/image_rect_raw", "/camera/aligned/image_raw", "/x/disparity"]
)
def test_depth_is_no_camera(tmp_path: Path, encoding: str, topic: str) -> None:
    sample = {"16UC1": np.uint16, "32FC1": np.float32, "64FC1": np.float64}[encoding]
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/camera/color/image_raw", "/camera/color/camera_info")
        bag.camera(
            topic,
            f"{topic.rpartition('/')[0]}/camera_info",
            pixels=picture().astype(sample),
            encoding=encoding,
        )
    recording = open_recording(tmp_path / "r.bag")
    assert len(recording.cameras) == 1
    assert f"{topic} holds distances ({encoding})" in words(recording)


def test_compressed_depth_is_no_camera_and_16uc1_can_be_asked_for(tmp_path: Path) -> None:
    png = cv2.imencode(".png", picture().astype(np.uint16) * 16)[1].tobytes()
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.compressed("/d/image/compressedDepth", 0.0, b"\0" * 12 + png, "16UC1; compressedDepth png")
        bag.compressed("/e/image/compressed", 0.0, png, "16UC1; png compressed ")
        bag.camera("/thermal/image_raw", pixels=picture().astype(np.uint16) * 16, encoding="16UC1")
    assert not open_recording(tmp_path / "r.bag").cameras
    chosen = TopicMap.from_options(["camera.thermal=/thermal/image_raw"])
    camera = open_recording(tmp_path / "r.bag", chosen).camera("thermal")
    assert np.array_equal(next(camera.frames([0])).image, picture())


COLLIDING = [
    ("camera", ["/drone/color/image_raw", "/drone/rgb/image_raw"]),
    ("camera", ["/front/image_raw", "/front_camera/image_raw"]),
    ("camera", ["/a/front_cam/image_raw", "/a/cam_front/image_raw", "/b/front/image"]),
    ("imu", ["/imu/data", "/imu/data_raw"]),
    ("imu", ["/imu", "/imu_imu", "/sensors/imu/data"]),
    ("gnss", ["/fix", "/gnss/fix"]),
    ("gnss", ["/fix", "/data", "/raw"]),
    ("pose", ["/odom", "/odom/data", "/x/odom"]),
]


@pytest.mark.parametrize(("role", "topics"), COLLIDING)
def test_names_that_collide_are_kept_apart(role: str, topics: list[str]) -> None:
    names = sensor_names(topics, role)
    assert list(names) == topics
    assert len(set(names.values())) == len(topics)
    assert all(names.values())


def test_two_sensors_of_like_names_both_arrive(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/drone/color/image_raw", "/drone/color/camera_info")
        bag.camera("/drone/rgb/image_raw", "/drone/rgb/camera_info")
        bag.camera("/pair/image_color", frame="left_optical")
        bag.camera("/pair/image_mono", frame="right_optical")
        for at in range(5):
            bag.imu("/imu/data", at / 100)
            bag.imu("/imu/data_raw", at / 100)
            bag.fix("/fix", at / 5, (53.5, 9.9, 40))
            bag.fix("/gnss/fix", at / 5, (53.6, 9.9, 40))
    recording = open_recording(tmp_path / "r.bag")
    assert (len(recording.cameras), len(recording.imus), len(recording.gnss)) == (4, 2, 2)
    assert sum(camera.model is not None for camera in recording.cameras.values()) == 2


def test_topics_of_one_camera_stay_one_camera_and_the_others_are_named(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        for topic in ("image_mono", "image_rect", "image_color", "image_raw"):
            bag.camera(f"/front/{topic}")
        bag.info("/front/camera_info")
    recording = open_recording(tmp_path / "r.bag")
    assert recording.camera("front").topic in ("/front/image_raw", "/front/image_color")
    assert words(recording).count("shows the same camera") == 3


@pytest.mark.parametrize(
    "topic",
    [
        "/front/image_rect",
        "/front/image_rect_color",
        "/rectified/front/image",
        "/front/rect/image",
        "/a/image_undistorted",
    ],
)
def test_rectified_images_have_the_lens_p(tmp_path: Path, topic: str) -> None:
    P = [18.0, 0, 7, -3, 0, 19, 5, 0, 0, 0, 1, 0]
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera(topic)
        bag.info(info_topics(topic)[0], D=[-0.35, 0.1, 0.001, 0, 0], P=P)
    (camera,) = open_recording(tmp_path / "r.bag").cameras.values()
    assert camera.model is not None
    assert camera.model.params.tolist() == [18, 19, 7, 5, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("D", [[], [-0.35, 0.1, 0.0, 0.0, 0.0]])
def test_rectified_images_without_p(tmp_path: Path, D: list[float]) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_rect")
        bag.info("/front/camera_info", D=D, P=[0.0] * 12)
    camera = open_recording(tmp_path / "r.bag").camera("front")
    assert (camera.model is None) == bool(D)  # with D = 0 K is the ideal camera as well


BINNED = {
    "binning 2": ({"size": (32, 24), "binning": (2, 2)}, [10.0, 10.5, 3.75, 2.75]),
    "binning 2 x 1": ({"size": (32, 12), "binning": (2, 1)}, [10.0, 21, 3.75, 6]),
    "roi": ({"size": (32, 24), "roi": (3, 2, 16, 12)}, [20.0, 21, 5, 4]),
    "roi of the binned": (
        {"size": (64, 48), "roi": (4, 6, 32, 24), "binning": (2, 2)},
        [10.0, 10.5, 1.75, -0.25],
    ),
    "size already binned": ({"size": (16, 12), "binning": (2, 2)}, [20.0, 21, 8, 6]),
    "roi is the whole": ({"size": (16, 12), "roi": (0, 0, 16, 12)}, [20.0, 21, 8, 6]),
    "no size": ({"size": (0, 0)}, [20.0, 21, 8, 6]),
}


@pytest.mark.parametrize("kind", BINNED)
def test_binning_and_regions_of_interest(tmp_path: Path, kind: str) -> None:
    options, expected = BINNED[kind]
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw")
        bag.info("/front/camera_info", **options)  # type: ignore[arg-type]
    model = open_recording(tmp_path / "r.bag").camera("front").model
    assert model is not None
    assert model.params[:4] == pytest.approx(expected)


def test_an_image_of_a_size_that_nothing_explains_gets_no_lens(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw")
        bag.info("/front/camera_info", size=(33, 24), binning=(3, 1))
    recording = open_recording(tmp_path / "r.bag")
    assert recording.camera("front").model is None
    assert "33 x 24 binned by 3 x 1" in words(recording)


@pytest.mark.parametrize("uncalibrated", [1, 2, 7])
def test_the_first_calibrated_info_counts(tmp_path: Path, uncalibrated: int) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw", frames=8)
        for number in range(8):
            matrix = [0.0] * 9 if number < uncalibrated else K
            bag.info("/front/camera_info", number / 10, matrix=matrix)
    recording = open_recording(tmp_path / "r.bag")
    model = recording.camera("front").model
    assert model is not None
    assert model.params[0] == K[0]
    assert f"{uncalibrated} messages of /front/camera_info are not calibrated" in words(recording)


@pytest.mark.parametrize(("growth", "known"), [(1.0, True), (1.0005, True), (1.02, False), (1.7, False)])
def test_a_lens_that_changes_is_refused_or_said(tmp_path: Path, growth: float, known: bool) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw", frames=8)
        for number in range(8):
            bag.info("/front/camera_info", number / 10, matrix=[20 * (growth if number > 4 else 1.0), *K[1:]])
    recording = open_recording(tmp_path / "r.bag")
    model = recording.camera("front").model
    assert (model is not None) == known
    assert model is None or model.params[0] == 20
    assert ("changes" in words(recording)) == (growth != 1.0)


def yuyv(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.dstack([grey, np.full_like(grey, 128)]).reshape(grey.shape[0], -1)


def uyvy(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.dstack([np.full_like(grey, 128), grey]).reshape(grey.shape[0], -1)


def planar(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.vstack([grey, np.full((grey.shape[0] // 2, grey.shape[1]), 128, np.uint8)])


def deep(bits: int) -> object:
    return lambda grey: grey.astype(np.uint16) << (bits - 8)


def packed12(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    values = grey.astype(np.uint16) << 4
    bits = np.unpackbits(values.view(np.uint8).reshape(*grey.shape, 2), axis=2, bitorder="little")[..., :12]
    return np.packbits(bits.reshape(grey.shape[0], -1), axis=1, bitorder="little")


ENCODINGS = {
    "yuv422_yuy2": yuyv,
    "yuyv": yuyv,
    "YUY2": yuyv,
    "yuv422": uyvy,
    "uyvy": uyvy,
    "nv12": planar,
    "nv21": planar,
    "yuv420": planar,
    "I420": planar,
    "mono8": lambda grey: grey,
    "8UC1": lambda grey: grey,
    "Y8": lambda grey: grey,
    "mono16": deep(16),
    "mono10": deep(10),
    "mono12": deep(12),
    "mono14": deep(14),
    "mono12p": packed12,
    "bgr8": lambda grey: np.dstack([grey] * 3),
    "rgba8": lambda grey: np.dstack([grey] * 4),
    "bgr16": lambda grey: np.dstack([grey.astype(np.uint16) << 8] * 3),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_gives_the_same_grey(tmp_path: Path, encoding: str) -> None:
    pixels = ENCODINGS[encoding](picture())  # type: ignore[operator]
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw", pixels=pixels, encoding=encoding)
    camera = open_recording(tmp_path / "r.bag").camera("front")
    frames = list(camera.frames())
    assert len(frames) == 3
    assert np.abs(frames[0].image.astype(int) - picture()).max() <= 1
    (colour,) = camera.frames([1], colour=True)
    assert colour.image.shape == (HEIGHT, WIDTH, 3)
    assert np.ptp(colour.image.astype(int), axis=2).max() <= 1  # neutral chroma is grey


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("big_endian", [False, True])
def test_deep_images_keep_the_bits_in_use(tmp_path: Path, bits: int, big_endian: bool) -> None:
    values = (picture().astype(np.uint16) << (bits - 8)).astype(">u2" if big_endian else "<u2")
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw", pixels=values, encoding="mono16", big_endian=big_endian)
        bag.camera("/port/image_raw", pixels=values, encoding="bayer_rggb16", big_endian=big_endian)
    recording = open_recording(tmp_path / "r.bag")
    assert np.array_equal(next(recording.camera("front").frames([1])).image, picture())
    assert next(recording.camera("port").frames([1])).image.mean() == pytest.approx(picture().mean(), abs=12)
    assert ("bits" in words(recording)) == (bits < 16)


def test_bits_in_use_overlook_a_hot_pixel() -> None:
    samples = np.full(3_000_000, 4000, np.uint16)
    samples[7] = 65_535
    assert bits_in_use(samples.view(np.uint8), big_endian=False) == 12


@pytest.mark.parametrize("step", [None, WIDTH + 6, 0])
def test_rows_with_padding_or_without_a_step(step: int | None) -> None:
    rows = picture()
    padded = np.hstack([rows, np.zeros((HEIGHT, (step or WIDTH) - WIDTH), np.uint8)])
    for encoding, pixels in (
        ("mono8", padded),
        ("nv12", np.vstack([padded, padded[: HEIGHT // 2] * 0 + 128])),
    ):
        image = decode_pixels(
            pixels.ravel(),
            (WIDTH, HEIGHT),
            step if step is not None else WIDTH,
            encoding,
            big_endian=False,
            colour=False,
        )
        assert np.array_equal(image, rows)


@pytest.mark.parametrize("encoding", ["yuv411", "mono32", "rgb12p", "h264", "\x1b[31m"])
def test_an_encoding_that_is_not_known_is_named(tmp_path: Path, encoding: str) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw", encoding=encoding)
    recording = open_recording(tmp_path / "r.bag")
    assert not recording.cameras
    assert repr(encoding) in words(recording)
    assert "\x1b" not in words(recording)


@pytest.mark.parametrize("filler", [b"\0" * 200_000, b"\xff" * 9000, b"\x17\xff\xd8\xff\xe0" * 3000, b"\0"])
def test_a_jpeg_may_be_followed_by_anything(tmp_path: Path, filler: bytes) -> None:
    encoded = cv2.imencode(".jpg", picture(), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    thumbnail = b"\xff\xe1" + (len(encoded) + 2).to_bytes(2, "big") + encoded  # an image within a segment
    with SmallBag(tmp_path / "r.bag") as bag:
        for at, content in enumerate([encoded + filler, encoded[:2] + thumbnail + encoded[2:] + filler]):
            bag.compressed("/front/image_raw/compressed", at / 10, content)
        for at, cut in enumerate(
            [encoded[:-40] + filler[:3], encoded[:2] + thumbnail + encoded[2:-40]], start=2
        ):
            bag.compressed("/front/image_raw/compressed", at / 10, cut)
    frames = list(open_recording(tmp_path / "r.bag").camera("front").frames())
    assert [frame.index for frame in frames] == [0, 1]
    assert all(np.abs(frame.image.astype(int) - picture()).mean() < 8 for frame in frames)


@pytest.mark.parametrize(("raw", "packed"), [(10, 1), (1, 10), (3, 3)])
def test_two_types_on_one_topic(tmp_path: Path, raw: int, packed: int) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        for at in range(raw):
            bag.image("/front/image_raw", at / 10)
        for at in range(raw, raw + packed):
            bag.compressed("/front/image_raw", at / 10, cv2.imencode(".jpg", picture())[1].tobytes())
    recording = open_recording(tmp_path / "r.bag")
    assert len(list(recording.camera("front").frames())) == max(raw, packed)
    assert f"{min(raw, packed)} sensor_msgs" in words(recording)


@pytest.mark.parametrize(
    "name", ["../../evil", "a/b", "", ".hidden", "x" * 101, "a\0b", "a\x1b[2Jb", "-rf", "a\\b"]
)
def test_names_from_a_topic_map_stay_where_they_belong(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match=r"cannot name|does not say"):
        TopicMap.from_options([f"camera.{name}=/front/image_raw"])
    with pytest.raises(UsageError):
        TopicMap({"camera": {name: "/front/image_raw"}})


@pytest.mark.parametrize(
    "topic", ["/a\x1b[2J/image_raw", "/../image_raw", f"/{'x' * 400}/image_raw", "/a\u202eb/image_raw"]
)
def test_names_from_topics_are_harmless(tmp_path: Path, topic: str) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera(topic, frame="f\x1b]0;x\x07")
        bag.transform("/tf_static", ("base\x1b[1m", "cam\x07"), (1, 2, 3))
    recording = open_recording(tmp_path / "r.bag")
    (camera,) = recording.cameras.values()
    said = f"{camera.name} {camera.topic} {camera.frame_id} {list(recording.static_transforms)} {words(recording)}"
    assert said.isprintable()
    assert Path(camera.name).name == camera.name
    assert not camera.name.startswith(".")
    assert len(camera.name) <= 100


def test_the_cases_reported_by_users(tmp_path: Path) -> None:
    """The small recordings of `../shared/cases`, where they are at hand."""
    data = os.environ.get("RIGWAKE_DATA", Path(__file__).parents[2] / "shared" / "data")
    folder = Path(data).parent / "cases"
    if not folder.is_dir():
        pytest.skip("no reported cases here")
    for bag in sorted((folder / "12_camera_info_of_common_drivers").glob("*.bag")):
        (camera,) = open_recording(bag).cameras.values()
        assert camera.model is not None
    depth = open_recording(folder / "13_depth_taken_for_camera" / "rs.bag")
    assert [c.model is not None for c in depth.cameras.values()] == [True] * 3
    for bag in sorted((folder / "18_image_encodings").glob("*.bag")):
        (camera,) = open_recording(bag).cameras.values()
        assert np.mean([f.image.mean() for f in camera.frames()]) == pytest.approx(139.3, abs=0.2)
    rec = folder / "20_rosbag2_no_metadata" / "rec"
    shutil.copytree(rec, tmp_path / "rec")
    assert len(open_recording(tmp_path / "rec").camera("front")) == 20
    with pytest.raises(InputError):
        open_recording(tmp_path)
