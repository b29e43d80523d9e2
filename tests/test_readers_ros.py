"""ROS bags become recordings: real bags, and the names of ROS."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from rigwake.errors import InputError, UsageError
from rigwake.readers.open import open_recording
from rigwake.readers.topics import TopicMap, camera_base, sensor_names


def test_thesis_layout_is_recognised_without_options(real_recordings: Path) -> None:
    recording = open_recording(real_recordings / "harbour_a" / "harbour_a.bag")
    assert sorted(recording.cameras) == ["back", "front", "left", "right"]
    assert recording.findings == ()
    for camera in recording.cameras.values():
        assert len(camera) == 400
        assert (camera.width_px, camera.height_px) == (640, 480)
        assert camera.model is not None
        assert camera.model.model == "kb4"
        assert np.median(np.diff(camera.timestamps_ns)) == pytest.approx(1e8)
    (imu,), (gnss,) = recording.imus.values(), recording.gnss.values()
    assert len(imu.timestamps_ns) == 4000
    assert np.mean(imu.accel[:, 2]) == pytest.approx(9.81, abs=0.1)
    assert len(gnss.timestamps_ns) == 200
    assert not recording.attitudes  # the driver marks the orientation as absent


def test_gnss_positions_agree_with_the_truth(real_recordings: Path) -> None:
    folder = real_recordings / "harbour_a"
    (gnss,) = open_recording(folder / "harbour_a.bag").gnss.values()
    truth = np.genfromtxt(folder / "truth_gnss_enu.csv", delimiter=",", names=True)
    true_position = np.column_stack([truth[name] for name in truth.dtype.names[1:4]])
    moved = gnss.position_enu - gnss.position_enu[0]
    assert np.abs(moved - (true_position - true_position[0])).max() < 0.15  # 2 cm noise, planes 20 m apart


def test_frames_stream_in_another_process_and_at_random(real_recordings: Path) -> None:
    camera = open_recording(real_recordings / "harbour_a" / "harbour_a.bag").camera("front")
    again = pickle.loads(pickle.dumps(camera))
    frames = list(again.frames([3, 17, 399], colour=True))
    assert [frame.index for frame in frames] == [3, 17, 399]
    assert [frame.timestamp_ns for frame in frames] == camera.timestamps_ns[[3, 17, 399]].tolist()
    assert all(frame.image.shape == (480, 640, 3) for frame in frames)


def test_real_bags_have_the_right_counts(real_recordings: Path) -> None:
    husky = open_recording(real_recordings / "rosbags" / "husky_imu_odom_gps.bag")
    assert len(husky.imus["imu"].timestamps_ns) == 11865
    assert len(husky.poses["odom"]) == 3952
    assert len(husky.gnss["gnss"].timestamps_ns) == 989
    ardrone = open_recording(real_recordings / "rosbags" / "ardrone_imu.bag")
    assert len(ardrone.imus["imu"].timestamps_ns) == 4308


def test_topics_can_be_given(real_recordings: Path) -> None:
    path = real_recordings / "harbour_a" / "harbour_a.bag"
    topic = "/wamv/sensors/cameras/front_camera/image_raw/compressed"
    recording = open_recording(path, TopicMap.from_options([f"camera.bow={topic}"]))
    assert list(recording.cameras) == ["bow"]
    assert list(recording.imus) == ["imu"]
    with pytest.raises(UsageError, match="/absent"):
        open_recording(path, TopicMap.from_options(["imu=/absent"]))


@pytest.mark.parametrize("option", ["camera=/a", "front", "camera.front=", "lidar=/a"])
def test_wrong_topic_options_are_refused(option: str) -> None:
    with pytest.raises(UsageError):
        TopicMap.from_options([option])


def test_topics_from_a_mapping_file(tmp_path: Path) -> None:
    file = tmp_path / "topics.yaml"
    file.write_text("camera: {front: /a, back: /b}\nimu: /c\n")
    topics = TopicMap.from_options(["camera.back=/d"], file)
    assert topics.chosen("camera") == {"front": "/a", "back": "/d"}
    assert topics.chosen("imu") == {"imu": "/c"}
    assert topics.chosen("gnss") is None
    file.write_text("- a\n- b\n")
    with pytest.raises(InputError):
        TopicMap.from_options([], file)


def test_names_are_short_and_unique() -> None:
    topics = ["/davis/left/image_raw", "/flir/left/image_raw", "/rear_camera/image_raw/compressed"]
    assert list(sensor_names(topics, "camera").values()) == ["davis_left", "flir_left", "rear"]
    assert sensor_names(["/wamv/sensors/imu/imu/data"], "imu") == {"/wamv/sensors/imu/imu/data": "imu"}
    assert camera_base("/cam0/image_raw") == "/cam0"
