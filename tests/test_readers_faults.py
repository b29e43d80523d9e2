"""Broken recordings: each a named error or a flagged partial recording; never a traceback of something else."""

import shutil
import sqlite3
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard
from rosbags.rosbag1 import Writer as Rosbag1Writer

from rigwake.cameras.registry import camera_from_params
from rigwake.config import load_config
from rigwake.errors import InputError, RigwakeError, UsageError
from rigwake.inspection.recording_inspection import inspect_recording
from rigwake.odometry.bridged import frames_not_tracked
from rigwake.pipeline.stream_selection import select
from rigwake.readers.images import ImageSize, compressed_size, decode_compressed, decode_raw
from rigwake.readers.open import open_recording
from rigwake.readers.topics import TopicMap
from rigwake.recording import Finding, Recording
from rigwake.tracking.front_ends import track_camera
from rigwake.writers.ros_encoding import MessageFactory
from rigwake.writers.rosbag import _Topic, _write, write_rosbag1
from rigwake.writers.write import write_recording
from test_writers import FRAMES, START_NS, small_recording

IMAGE = "/cam/image_raw/compressed"


def drain(recording: Recording) -> int:
    """Inspect, and read every frame of every camera; the number of frames."""
    inspect_recording(recording)
    return sum(1 for camera in recording.cameras.values() for _ in camera.frames(colour=True))


def has_finding(recording: Recording, *words: str) -> bool:
    return any(all(word in f"{f.sensor} {f.message}" for word in words) for f in recording.findings)


def bag_of(path: Path, topics: list[tuple[str, str, list[tuple[int, bytes]]]]) -> Path:
    written = [
        _Topic(name, kind, iter([(stamp, name, payload) for stamp, payload in messages]))
        for name, kind, messages in topics
    ]
    _write(Rosbag1Writer(path), written, "ros1")
    return path


def compressed(stamp_ns: int, encoded: bytes, topic_stamp: int | None = None) -> bytes:
    header = struct.pack("<III", 0, *divmod(stamp_ns if topic_stamp is None else topic_stamp, 10**9))
    return (
        header
        + struct.pack("<I", 0)
        + struct.pack("<I4s", 4, b"jpeg")
        + struct.pack("<I", len(encoded))
        + encoded
    )


def jpeg(level: int = 90) -> bytes:
    return cv2.imencode(".jpg", np.full((32, 48), level, np.uint8))[1].tobytes()


def png_bomb() -> bytes:
    good = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
    return good[:16] + struct.pack(">II", 100_000, 100_000) + good[24:]


def jpeg_bomb() -> bytes:
    good = jpeg()
    at = good.index(b"\xff\xc0")
    return good[: at + 5] + struct.pack(">HH", 65_500, 65_500) + good[at + 9 :]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same small recording in every format."""
    root = tmp_path_factory.mktemp("good")
    recording = small_recording(("cam0", "cam1"))
    write_recording(recording, root / "rec.bag", image_encoding="jpeg")
    write_rosbag1(recording, root / "lz4.bag", "raw", "lz4")
    write_rosbag1(recording, root / "bz2.bag", "raw", "bz2")
    write_recording(recording, root / "rec.mcap", image_encoding="jpeg")
    write_recording(recording, root / "sqlite", file_format="ros2", image_encoding="png")
    write_recording(recording, root / "euroc", file_format="euroc")
    write_recording(recording, root / "folder", file_format="folder")
    return root


# ---- not a recording at all


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\0" * 4096, b"#ROSBAG V1.2\n", b"PK\x03\x04", b"$GPGGA,,,*00\r\n"]
)
def test_files_that_are_no_recording(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file.bag"
    path.write_bytes(content)
    with pytest.raises(InputError):
        open_recording(path)


def test_paths_that_are_no_recording(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "absent", Path("/dev/null")):
        with pytest.raises(InputError):
            open_recording(path)


# ---- bags


@pytest.mark.parametrize("name", ["rec.bag", "lz4.bag", "bz2.bag", "rec.mcap"])
@pytest.mark.parametrize("fraction", [0.3, 0.6, 0.95, 0.999])
def test_truncated_bags_keep_what_they_hold(good: Path, tmp_path: Path, name: str, fraction: float) -> None:
    content = (good / name).read_bytes()
    path = tmp_path / name
    path.write_bytes(content[: int(fraction * len(content))])
    recording = open_recording(path)
    assert any(f.severity == "error" for f in recording.findings)
    frames = drain(recording)
    assert frames <= 2 * FRAMES
    if fraction > 0.9 and name in ("rec.bag", "rec.mcap"):
        assert frames == 2 * FRAMES  # only the index is gone


@pytest.mark.parametrize("name", ["rec.bag", "lz4.bag", "rec.mcap"])
def test_bags_cut_off_within_their_magic_or_first_records(good: Path, tmp_path: Path, name: str) -> None:
    content = (good / name).read_bytes()
    for size in (8, 13, 14, 20, 40, 100):
        path = tmp_path / name
        path.write_bytes(content[:size])
        try:
            assert not open_recording(path).cameras
        except InputError:
            continue


def test_unindexed_bag_is_read_whole(good: Path, tmp_path: Path) -> None:
    content = bytearray((good / "rec.bag").read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    (index_position,) = struct.unpack_from("<Q", content, at)
    content[at : at + 8] = bytes(8)  # as `rosbag record` leaves it when it is killed
    path = tmp_path / "rec.bag.active"
    path.write_bytes(content[:index_position])
    recording = open_recording(path)
    assert drain(recording) == 2 * FRAMES
    assert len(recording.imus["imu"].gyro) == 70


def test_bag_of_no_messages(tmp_path: Path) -> None:
    recording = open_recording(
        bag_of(tmp_path / "empty.bag", [(IMAGE, "sensor_msgs/msg/CompressedImage", [])])
    )
    assert not recording.cameras
    assert drain(recording) == 0
    with Rosbag1Writer(tmp_path / "none.bag"):
        pass
    assert not open_recording(tmp_path / "none.bag").imus


def stamped_bag(tmp_path: Path, stamps: list[int], images: list[bytes] | None = None) -> Recording:
    images = images or [jpeg(60 + k) for k in range(len(stamps))]
    messages = [
        (START_NS + k * 10**8, compressed(stamp, image))
        for k, (stamp, image) in enumerate(zip(stamps, images, strict=True))
    ]
    return open_recording(bag_of(tmp_path / "r.bag", [(IMAGE, "sensor_msgs/msg/CompressedImage", messages)]))


def test_missing_camera_info(tmp_path: Path) -> None:
    recording = stamped_bag(tmp_path, [START_NS + k * 10**8 for k in range(5)])
    assert recording.camera("cam").model is None
    assert has_finding(recording, "no camera_info")


def test_unreadable_frames_are_counted(tmp_path: Path) -> None:
    """Also where none of them is among the frames that are sampled."""
    images = [jpeg(60 + k % 100) for k in range(300)]
    for bad in (17, 101, 202, 203):
        images[bad] = images[bad][: len(images[bad]) // 2]
    recording = stamped_bag(tmp_path, [START_NS + k * 10**8 for k in range(300)], images)
    findings = inspect_recording(recording).findings
    assert any("4 of 300 encoded frames are cut off" in f.message for f in findings)
    camera = replace(
        recording.camera("cam"), model=camera_from_params("pinhole", [20.0] * 4 + [0.0] * 6, 48, 32)
    )
    tracks = track_camera(camera)
    assert frames_not_tracked(tracks)[-1] == "4 unreadable frames bridged"
    damaged = replace(
        recording, cameras={"cam": camera}, findings=(Finding("error", "cam", "half is gone."),)
    )
    assert "cam: half is gone." in select(damaged, load_config()).notes


def test_stamps_that_go_back_are_sorted_and_flagged(tmp_path: Path) -> None:
    recording = stamped_bag(tmp_path, [START_NS + k * 10**8 for k in (0, 2, 1, 3, 4)])
    assert np.all(np.diff(recording.camera("cam").timestamps_ns) > 0)
    assert has_finding(recording, "time goes back 1 times")
    images = [frame.image.mean() for frame in recording.camera("cam").frames()]
    assert images == pytest.approx([60, 62, 61, 63, 64], abs=1.5)  # each image stays with its stamp


def test_a_clock_that_jumps_back_is_an_error(tmp_path: Path) -> None:
    recording = stamped_bag(tmp_path, [START_NS + k * 10**9 for k in (5, 6, 7, 0, 1)])
    assert any(f.severity == "error" and "time goes back" in f.message for f in recording.findings)


def test_duplicate_stamps_are_dropped_and_flagged(tmp_path: Path) -> None:
    recording = stamped_bag(tmp_path, [START_NS, START_NS, START_NS + 10**8])
    assert len(recording.camera("cam")) == 2
    assert has_finding(recording, "repeat the stamp")


def test_zero_stamps_fall_back_to_bag_time(tmp_path: Path) -> None:
    recording = stamped_bag(tmp_path, [0] * 4)
    assert recording.camera("cam").timestamps_ns.tolist() == [START_NS + k * 10**8 for k in range(4)]
    assert has_finding(recording, "time of recording")


def test_some_zero_stamps_are_dropped(tmp_path: Path) -> None:
    recording = stamped_bag(tmp_path, [START_NS, 0, START_NS + 10**8])
    assert len(recording.camera("cam")) == 2
    assert has_finding(recording, "zero stamp")


@pytest.mark.parametrize("bomb", [png_bomb(), jpeg_bomb()], ids=["png", "jpeg"])
def test_image_header_bombs_are_refused_before_decoding(tmp_path: Path, bomb: bytes) -> None:
    with pytest.raises(InputError, match="claims"):
        compressed_size(bomb)
    with pytest.raises(InputError, match="claims"):
        decode_compressed(bomb, colour=True)
    stamps = [START_NS + k * 10**8 for k in range(5)]
    assert not stamped_bag(tmp_path, stamps, [bomb] * 5).cameras
    (tmp_path / "r.bag").unlink()
    mixed = stamped_bag(tmp_path, stamps, [jpeg(), jpeg(), bomb, jpeg(), jpeg()])
    assert drain(mixed) == 4
    assert any("cannot be decoded" in f.message for f in inspect_recording(mixed).findings)


def test_truncated_jpeg_is_left_out(tmp_path: Path) -> None:
    whole = jpeg()
    for cut in (len(whole) - 2, len(whole) // 2, 20, 3, 0):
        with pytest.raises(InputError):
            decode_compressed(whole[:cut], colour=False)
    recording = stamped_bag(tmp_path, [START_NS, START_NS + 10**8], [whole, whole[:-40]])
    assert drain(recording) == 1


@pytest.mark.parametrize("border", [0, 40, 128, 255])
@pytest.mark.parametrize("colour", [False, True])
def test_jpeg_that_ends_early_with_an_end_marker(border: int, colour: bool) -> None:
    """Decoders fill such an image up; a picture that has a border of one value is whole, whichever value."""
    image = cv2.GaussianBlur(np.random.default_rng(5).integers(0, 255, (96, 128, 3), np.uint8), (0, 0), 2)
    image[64:] = border
    whole = cv2.imencode(".jpg", image if colour else image[..., 0])[1].tobytes()
    assert (decode_compressed(whole, colour=colour)[-1] == border).all()
    for part in (0.3, 0.6, 0.9):
        cut = whole[: int(part * len(whole))] + b"\xff\xd9"
        with pytest.raises(InputError, match="cut off"):
            decode_compressed(cut, colour=colour)


def test_images_that_are_neither_jpeg_nor_png(tmp_path: Path) -> None:
    recording = stamped_bag(tmp_path, [START_NS], [b"RIFF0000WEBP"])
    assert has_finding(recording, "left out", "neither JPEG nor PNG")


def test_images_that_change_size_are_left_out(tmp_path: Path) -> None:
    larger = cv2.imencode(".png", np.zeros((64, 96), np.uint8))[1].tobytes()
    assert drain(stamped_bag(tmp_path, [START_NS, START_NS + 10**8], [jpeg(), larger])) == 1


@pytest.mark.parametrize(
    ("size", "step", "encoding", "count"),
    [
        ((100_000, 100_000), 100_000, "mono8", 10),
        ((48, 32), 48, "mono8", 10),
        ((48, 32), 10, "mono8", 48 * 32),
        ((0, 0), 0, "mono8", 0),
        ((48, 32), 48, "32FC1", 48 * 32),
        ((48, 32), 48, "", 48 * 32),
        ((48, 32), 2**31, "bgr8", 48 * 32 * 3),
    ],
)
def test_raw_images_that_do_not_fit_their_buffer(
    size: tuple[int, int], step: int, encoding: str, count: int
) -> None:
    with pytest.raises(InputError):
        decode_raw(
            np.zeros(count, np.uint8), ImageSize(*size), step, encoding, big_endian=False, colour=False
        )


def test_wrong_type_on_a_topic(tmp_path: Path) -> None:
    imu = MessageFactory("ros1").imu(small_recording().imus["imu"], 0, None)
    as_image = (IMAGE, "sensor_msgs/msg/CompressedImage", [(START_NS, imu)] * 3)
    as_imu = ("/imu/data", "sensor_msgs/msg/Imu", [(START_NS, compressed(START_NS, jpeg()))] * 3)
    recording = open_recording(bag_of(tmp_path / "r.bag", [as_image, as_imu]))
    assert not recording.cameras
    assert any(f.severity == "error" for f in recording.findings)
    drain(recording)


def test_topic_options_of_the_wrong_type(good: Path) -> None:
    with pytest.raises(UsageError, match="could be"):
        open_recording(good / "rec.bag", TopicMap.from_options([f"imu={IMAGE}"]))


def test_a_type_with_another_definition_is_left_out(good: Path, tmp_path: Path) -> None:
    content = (good / "rec.bag").read_bytes()
    digest = b"6a62c6daae103f4ff57a132d6f95cec2"  # of sensor_msgs/Imu
    assert digest in content
    path = tmp_path / "r.bag"
    path.write_bytes(content.replace(digest, digest[::-1]))
    recording = open_recording(path)
    assert not recording.imus
    assert has_finding(recording, "not the standard message")


def test_camera_dead_halfway(tmp_path: Path) -> None:
    recording = small_recording()
    port = recording.camera("port")
    cameras = {**recording.cameras, "port": replace(port, timestamps_ns=port.timestamps_ns[:3])}
    write_recording(replace(recording, cameras=cameras), tmp_path / "r.bag")
    inspection = inspect_recording(open_recording(tmp_path / "r.bag"))
    assert any(f.sensor == "camera.port" and "records only" in f.message for f in inspection.findings)


def test_damaged_imu_messages_are_counted(tmp_path: Path) -> None:
    imu = small_recording().imus["imu"]
    payloads = [MessageFactory("ros1").imu(imu, row, None) for row in range(10)]
    payloads[3] = payloads[3][:8]
    payloads[5] = payloads[5][:-296] + struct.pack("<37d", *[float("nan")] * 37)
    messages = [(int(t), payload) for t, payload in zip(imu.timestamps_ns[:10], payloads, strict=True)]
    recording = open_recording(bag_of(tmp_path / "r.bag", [("/imu/data", "sensor_msgs/msg/Imu", messages)]))
    assert len(recording.imus["imu"].gyro) == 8
    assert has_finding(recording, "1 of 10 messages are damaged")
    assert has_finding(recording, "NaN")


def test_fixes_without_a_fix_or_a_covariance(tmp_path: Path) -> None:
    gnss = small_recording().gnss["gnss"]
    good_fix = [MessageFactory("ros1").fix(gnss, row) for row in range(3)]
    none = [bytearray(payload) for payload in good_fix]
    head = 16  # sequence, stamp, empty frame
    for payload in none:
        struct.pack_into("<b", payload, head, -1)
    topics = [("/a/fix", "sensor_msgs/msg/NavSatFix", [(START_NS, bytes(p)) for p in none])]
    assert has_finding(open_recording(bag_of(tmp_path / "none.bag", topics)), "no valid fix")
    unknown = [bytearray(payload) for payload in good_fix]
    for payload in unknown:
        payload[-1] = 0  # covariance type unknown
    stamps = gnss.timestamps_ns[:3].tolist()
    topics = [("/a/fix", "sensor_msgs/msg/NavSatFix", list(zip(stamps, map(bytes, unknown), strict=True)))]
    recording = open_recording(bag_of(tmp_path / "unknown.bag", topics))
    assert has_finding(recording, "no covariance")
    assert np.allclose(recording.gnss["a"].covariances, 25 * np.eye(3))


def test_chunk_that_claims_to_unpack_to_gigabytes(good: Path, tmp_path: Path) -> None:
    content = bytearray((good / "lz4.bag").read_bytes())
    at = content.index(b"compression=lz4")
    size_at = content.index(b"size=", at - 80) + 5
    content[size_at : size_at + 4] = struct.pack("<I", 2**32 - 1)
    path = tmp_path / "bomb.bag"
    path.write_bytes(content)
    drain(open_recording(path))


# ---- ROS 2


def test_truncated_sqlite_bag(good: Path, tmp_path: Path) -> None:
    for fraction in (0.05, 0.5, 0.9):
        folder = tmp_path / f"cut{fraction}"
        shutil.copytree(good / "sqlite", folder)
        (file,) = folder.glob("*.db3")
        content = file.read_bytes()
        file.write_bytes(content[: int(fraction * len(content))])
        try:
            recording = open_recording(folder)
        except InputError:
            continue
        drain(recording)
        assert any(f.severity == "error" for f in recording.findings)


@pytest.mark.parametrize(
    "metadata",
    [
        "",
        "a: b",
        "[1, 2",
        "rosbag2_bagfile_information: 3",
        "rosbag2_bagfile_information: {relative_file_paths: 7}",
    ],
)
def test_broken_metadata(good: Path, tmp_path: Path, metadata: str) -> None:
    folder = tmp_path / "bag"
    shutil.copytree(good / "sqlite", folder)
    (folder / "metadata.yaml").write_text(metadata)
    with pytest.raises(InputError):
        open_recording(folder)


def test_missing_file_of_a_bag_and_paths_that_leave_the_folder(good: Path, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    shutil.copytree(good / "sqlite", folder)
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("sqlite.db3", "../../../etc/passwd"))
    with pytest.raises(InputError, match="No file"):
        open_recording(folder)


def test_database_that_is_no_bag(tmp_path: Path) -> None:
    path = tmp_path / "x.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE t(a)")
    database.close()
    with pytest.raises(InputError, match="not a ROS 2 bag"):
        open_recording(path)


def test_database_whose_messages_are_not_bytes(good: Path, tmp_path: Path) -> None:
    (file,) = (good / "sqlite").glob("*.db3")
    path = tmp_path / "x.db3"
    shutil.copy(file, path)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET data = 'text' WHERE id % 2 = 0")
        database.execute("UPDATE messages SET timestamp = 'soon' WHERE id % 5 = 0")
    database.close()
    recording = open_recording(path)
    drain(recording)
    assert has_finding(recording, "messages are damaged")


def test_packed_messages_are_unpacked(good: Path, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    shutil.copytree(good / "sqlite", folder)
    text = (folder / "metadata.yaml").read_text()
    text = text.replace("compression_format: ''", "compression_format: zstd")
    (folder / "metadata.yaml").write_text(text.replace("compression_mode: ''", "compression_mode: MESSAGE"))
    (file,) = folder.glob("*.db3")
    with sqlite3.connect(file) as database:
        rows = database.execute("SELECT id, data FROM messages").fetchall()
        packer = zstandard.ZstdCompressor()
        database.executemany(
            "UPDATE messages SET data = ? WHERE id = ?", [(packer.compress(d), i) for i, d in rows]
        )
    database.close()
    assert drain(open_recording(folder)) == 2 * FRAMES


# ---- folders


def append(path: Path, text: str) -> None:
    path.write_text(path.read_text() + text)


Change = Callable[[Path], object]
EUROC: dict[str, tuple[Change, str]] = {
    "no frames table": (lambda p: (p / "mav0/cam0/data.csv").write_text(""), "left out"),
    "missing images": (lambda p: shutil.rmtree(p / "mav0/cam0/data"), "left out"),
    "one image missing": (lambda p: next((p / "mav0/cam0/data").iterdir()).unlink(), "6 there"),
    "settings are no YAML": (
        lambda p: (p / "mav0/cam0/sensor.yaml").write_text("{"),
        "cannot be read as YAML",
    ),
    "mirrored extrinsics": (
        lambda p: (p / "mav0/cam0/sensor.yaml").write_text(
            "T_BS: {data: [-1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}"
        ),
        "not a rigid transform",
    ),
    "other resolution": (
        lambda p: (p / "mav0/cam0/sensor.yaml").write_text("resolution: [7, 7]\nintrinsics: [1, 1, 1, 1]"),
        "intrinsics are not used",
    ),
    "too few intrinsics": (lambda p: (p / "mav0/cam0/sensor.yaml").write_text("intrinsics: [1]"), "damaged"),
    "imu without columns": (lambda p: (p / "mav0/imu0/data.csv").write_text("a,b\n1,2\n"), "left out"),
    "imu with words": (
        lambda p: append(p / "mav0/imu0/data.csv", "x,y,z,a,b,c,d\n"),
        "cannot be read",
    ),
    "image of zeros": (lambda p: next((p / "mav0/cam0/data").iterdir()).write_bytes(bytes(100)), ""),
    "path in place of a name": (
        lambda p: (p / "mav0/cam0/data.csv").write_text(
            "#timestamp [ns],filename\n5,../../../../etc/passwd\n"
        ),
        "left out",
    ),
}


@pytest.mark.parametrize("fault", EUROC)
def test_faulty_euroc_folders(good: Path, tmp_path: Path, fault: str) -> None:
    change, words = EUROC[fault]
    folder = tmp_path / "euroc"
    shutil.copytree(good / "euroc", folder)
    change(folder)
    recording = open_recording(folder)
    drain(recording)
    assert has_finding(recording, words) or not words
    assert "cam1" in recording.cameras


FOLDER: dict[str, tuple[Change, str]] = {
    "stamps in seconds": (
        lambda p: (p / "imu.csv").write_text(
            "t,wx,wy,wz,ax,ay,az\n"
            + "".join(f"{1.7e9 + k / 100:.2f},0,0,0,0,0,{9.8 + k / 1e3}\n" for k in range(60))
        ),
        "",
    ),
    "stamps that go back": (
        lambda p: (p / "imu.csv").write_text(
            "timestamp_ns,wx,wy,wz,ax,ay,az\n" + "".join(f"{k},0,0,0,0,0,9\n" for k in (30, 10, 20))
        ),
        "time goes back",
    ),
    "no times": (lambda p: (p / "cam0/timestamps.csv").unlink(), ""),
    "names without times": (
        lambda p: (
            [f.rename(f.with_name(f"a{f.name[-9:]}")) for f in (p / "cam0").glob("*.jpg")]
            and (p / "cam0/timestamps.csv").unlink()
        ),
        "10 Hz is assumed",
    ),
    "no filename column": (
        lambda p: (p / "cam0/timestamps.csv").write_text("timestamp,a\n1,2\n"),
        "lacks a column",
    ),
    "latitude out of range": (
        lambda p: (p / "gnss.csv").write_text("timestamp_ns,latitude,longitude,altitude\n1,200,0,0\n"),
        "left out",
    ),
    "video that is none": (lambda p: (p / "port.mp4").write_bytes(b"not a video" * 100), "cannot be read"),
    "binary csv": (lambda p: (p / "imu.csv").write_bytes(bytes(range(256)) * 10), "left out"),
}


@pytest.mark.parametrize("fault", FOLDER)
def test_faulty_plain_folders(good: Path, tmp_path: Path, fault: str) -> None:
    change, words = FOLDER[fault]
    folder = tmp_path / "folder"
    shutil.copytree(good / "folder", folder)
    change(folder)
    recording = open_recording(folder)
    drain(recording)
    assert has_finding(recording, words) or not words
    assert "cam1" in recording.cameras


@pytest.mark.parametrize(
    "text",
    [
        "",
        "cameras: 3",
        "cameras: {cam0: {camera: {model: none}}}",
        "a: &a [*a]",
        "!!python/object:os.system {}",
    ],
)
def test_broken_rig_files(good: Path, tmp_path: Path, text: str) -> None:
    folder = tmp_path / "folder"
    shutil.copytree(good / "folder", folder)
    (folder / "rig.yaml").write_text(text)
    with pytest.raises(InputError):
        open_recording(folder)


# ---- fuzz


def mutations(content: bytes, count: int, seed: int) -> list[bytes]:
    """Byte flips, overwritten runs, deletions and insertions."""
    rng = np.random.default_rng(seed)
    changed = []
    for _ in range(count):
        mutated = bytearray(content)
        for _ in range(int(rng.integers(1, 6))):
            at, size = int(rng.integers(len(mutated))), int(rng.integers(1, 9))
            match int(rng.integers(4)):
                case 0:
                    mutated[at] ^= 1 << int(rng.integers(8))
                case 1:
                    mutated[at : at + size] = rng.bytes(size)
                case 2:
                    del mutated[at : at + size]
                case _:
                    mutated[at:at] = b"\xff" * size
        changed.append(bytes(mutated))
    return changed


def survives(path: Path) -> None:
    try:
        recording = open_recording(path)
    except RigwakeError:
        return
    for camera in recording.cameras.values():
        for _ in camera.frames():
            pass


@pytest.mark.parametrize(("name", "count"), [("rec.bag", 30), ("lz4.bag", 15), ("rec.mcap", 30)])
def test_fuzzed_bags_never_crash(good: Path, tmp_path: Path, name: str, count: int) -> None:
    path = tmp_path / name
    for mutated in mutations((good / name).read_bytes(), count, 1):
        path.write_bytes(mutated)
        survives(path)


def test_fuzzed_sqlite_never_crashes(good: Path, tmp_path: Path) -> None:
    (file,) = (good / "sqlite").glob("*.db3")
    path = tmp_path / "x.db3"
    for mutated in mutations(file.read_bytes(), 30, 2):
        path.write_bytes(mutated)
        survives(path)


@pytest.mark.parametrize("kind", ["euroc", "folder"])
def test_fuzzed_folders_never_crash(good: Path, tmp_path: Path, kind: str) -> None:
    folder = tmp_path / kind
    shutil.copytree(good / kind, folder)
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    for at, file in enumerate(files):
        content = file.read_bytes()
        few = file.suffix in (".jpg", ".png")
        for mutated in mutations(content, 1 if few else 4, at):
            file.write_bytes(mutated)
            survives(folder)
        file.write_bytes(content)
