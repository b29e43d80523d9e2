"""Bags as recorders, crashes and other programs leave them: order, packing, logs, transforms, split IMUs, damage."""

import bz2
import gzip
import lzma
import os
import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionMode

from rigwake.config import CalibrateConfig
from rigwake.errors import InputError
from rigwake.inspection.recording_inspection import inspect_recording
from rigwake.pipeline.rig_stage import reference_frame
from rigwake.pipeline.stream_selection import select
from rigwake.readers.chunks import FREE_BYTES
from rigwake.readers.open import open_recording
from rigwake.readers.topics import TopicMap
from rigwake.recording import Recording, main_gnss, main_imu, static_transform
from ros_bags import START_NS, SmallBag, picture
from test_ros_cameras import words
from test_writers import small_recording


def fill(bag: SmallBag, frames: int = 10) -> None:
    """A camera with its lens, an IMU and transforms."""
    bag.camera("/front/image_raw", "/front/camera_info", frames=frames)
    for at in range(5 * frames):
        bag.imu("/imu/data", at / 50)
    bag.transform("/tf_static", ("base_link", "imu"), (1, 2, 3))


def counts(recording: Recording) -> tuple[int, int, int]:
    """Frames that can be read, IMU samples, static transforms."""
    frames = sum(1 for camera in recording.cameras.values() for _ in camera.frames())
    samples = sum(len(imu.timestamps_ns) for imu in recording.imus.values())
    return frames, samples, len(recording.static_transforms)


@pytest.mark.parametrize("publishers", ["ABA", "ABAB", "AABBCC", "ABC"])
@pytest.mark.parametrize("ros", [1, 2])
def test_publishers_in_turn_are_joined_by_the_time_of_recording(
    tmp_path: Path, publishers: str, ros: int
) -> None:
    with SmallBag(tmp_path / ("r.bag" if ros == 1 else "r"), ros) as bag:
        for at, publisher in enumerate(publishers):
            for number in range(3):
                bag.image("/front/image_raw", at + number / 10, publisher=ord(publisher))
    recording = open_recording(tmp_path / ("r.bag" if ros == 1 else "r"))
    camera = recording.camera("front")
    assert "time goes back" not in words(recording)
    assert [f.timestamp_ns for f in camera.frames()] == camera.timestamps_ns.tolist()
    assert len(camera) == 3 * len(publishers)


def split_imu(
    bag: SmallBag, gyro: str, accel: str, frames: tuple[str, str] = ("imu", "imu"), **how: object
) -> None:
    """Gyroscope at 100 Hz, accelerometer at 25 Hz with a = (t, 0, 9.8); the other half empty."""
    empty = (np.nan,) * 3 if how.get("nan") else (0.0,) * 3
    marked = bool(how.get("marked"))
    for at in range(200):
        bag.imu(gyro, at / 100, (0.1, 0.0, at / 100), empty, frames[0], (False, marked))
        if at % 4 == 0:
            bag.imu(accel, at / 100 + 0.003, empty, (at / 100 + 0.003, 0.0, 9.8), frames[1], (marked, False))


@pytest.mark.parametrize("how", [{}, {"nan": True}, {"marked": True}])
@pytest.mark.parametrize(
    ("gyro", "accel"),
    [
        ("/camera/gyro/sample", "/camera/accel/sample"),
        ("/gyro", "/accel"),
        ("/imu/gyro/data", "/imu/accel/data"),
    ],
)
def test_an_imu_in_two_topics_is_one(tmp_path: Path, gyro: str, accel: str, how: dict[str, object]) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        split_imu(bag, gyro, accel, **how)
    recording = open_recording(tmp_path / "r.bag")
    (imu,) = recording.imus.values()
    seconds = (imu.timestamps_ns - START_NS) * 1e-9
    assert len(seconds) == pytest.approx(195, abs=3)
    assert np.allclose(imu.gyro[:, 2], seconds, atol=1e-9)
    assert np.allclose(imu.accel[:, 0], seconds, atol=1e-7)  # interpolated, not held
    assert "joined" in words(recording)
    inspect_recording(recording)


def test_halves_of_two_imus_find_each_other_and_tf_turns_them(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        split_imu(bag, "/left/gyro", "/left/accel", ("l_gyro", "l_accel"))
        split_imu(bag, "/right/gyro", "/right/accel", ("r_gyro", "r_accel"))
        bag.transform("/tf_static", ("l_gyro", "l_accel"), (0, 0, 0.1), quat_xyzw=(0, 0, 0.5**0.5, 0.5**0.5))
    recording = open_recording(tmp_path / "r.bag")
    assert len(recording.imus) == 2
    turned = next(imu for imu in recording.imus.values() if imu.topic == "/left/gyro")
    assert np.allclose(turned.accel[:, 1], (turned.timestamps_ns - START_NS) * 1e-9, atol=1e-7)


def test_halves_of_different_devices_are_not_joined(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        split_imu(bag, "/ahrs/rates", "/camera/accel", ("ahrs_link", "camera_link"))
    recording = open_recording(tmp_path / "r.bag")
    assert not recording.imus
    assert words(recording).count("left out") == 2


@pytest.mark.parametrize("half", ["gyro", "accel", "neither"])
def test_half_an_imu_is_none(tmp_path: Path, half: str) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw", "/front/camera_info", frames=30)
        for at in range(100):
            gyro = (0.1, 0, 0) if half == "gyro" else (0, 0, 0)
            bag.imu("/imu/data", at / 100, gyro, (0, 0, 9.8) if half == "accel" else (0, 0, 0))
    recording = open_recording(tmp_path / "r.bag")
    assert not recording.imus
    assert "left out" in words(recording)
    inspect_recording(recording)


@pytest.mark.parametrize("order", [("/a/data", "/b/data"), ("/b/data", "/a/data")])
def test_one_rule_for_the_imu_and_the_receiver(tmp_path: Path, order: tuple[str, str]) -> None:
    """The one that lasts, then the one with more samples: not the first, not a short burst of many samples."""
    with SmallBag(tmp_path / "r.bag") as bag:
        for topic in order:
            for at in range(300):
                bag.imu(topic, at / 100 if topic == "/a/data" else at / 3000)
            for at in range(30):
                bag.fix(topic.replace("data", "fix"), at / (10 if topic == "/a/data" else 100), (53, 9, 40))
    recording = open_recording(tmp_path / "r.bag")
    imu, gnss = main_imu(recording), main_gnss(recording)
    assert imu is not None
    assert gnss is not None
    assert (imu.topic, gnss.topic) == ("/a/data", "/a/fix")


CHAINS: dict[
    str, tuple[list[tuple[tuple[str, str], tuple[float, float, float]]], tuple[float, float, float]]
] = {
    "chain": ([(("base_link", "mast"), (1, 0, 0)), (("mast", "imu_link"), (0, 0, 2))], (1, 0, 2)),
    "slashes": ([(("/base_link", "/imu_link"), (1, 0, 0))], (1, 0, 0)),
    "some slashes": ([(("/base_link", "mast"), (1, 0, 0)), (("/mast", "imu_link"), (0, 1, 0))], (1, 1, 0)),
    "upside down": ([(("imu_link", "base_link"), (1, 0, 0))], (-1, 0, 0)),
    "newest wins": (
        [(("base_link", "imu_link"), (1, 0, 0)), (("base_link", "imu_link"), (0, 3, 0))],
        (0, 3, 0),
    ),
    "one parent": (
        [
            (("base_link", "imu_link"), (1, 0, 0)),
            (("base_link", "mast"), (0, 0, 5)),
            (("mast", "imu_link"), (0, 4, 0)),
        ],
        (0, 4, 5),
    ),
    "parent back again": (
        [
            (("mast", "imu_link"), (0, 4, 0)),
            (("base_link", "mast"), (0, 0, 5)),
            (("base_link", "imu_link"), (1, 0, 0)),
        ],
        (1, 0, 0),
    ),
}


@pytest.mark.parametrize("kind", CHAINS)
@pytest.mark.parametrize("publishers", ["one", "each its own"])
@pytest.mark.parametrize("ros", [1, 2])
def test_transforms_as_tf2_has_them(tmp_path: Path, kind: str, publishers: str, ros: int) -> None:
    edges, expected = CHAINS[kind]
    path = tmp_path / ("r.bag" if ros == 1 else "r")
    with SmallBag(path, ros) as bag:
        for at in range(10):
            bag.imu("/imu/data", at / 100, frame="/imu_link")
        for at, (edge, position) in enumerate(edges):
            publisher = -at if publishers != "one" else 0  # publishers in the other order than the messages
            bag.transform("/tf_static", edge, position, at / 100, publisher)
    recording = open_recording(path)
    (imu,) = recording.imus.values()
    found = static_transform(recording, "base_link", imu.frame_id)
    assert found is not None
    assert found.translation.tolist() == pytest.approx(expected)
    assert static_transform(recording, "elsewhere", imu.frame_id) is None


def test_joints_of_tf_that_never_move_yield_to_tf_static(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        for at in range(10):
            bag.imu("/imu/data", at / 100)
            bag.transform("/tf", ("base_link", "imu"), (9, 9, 9), at / 100)
            bag.transform("/tf", ("base_link", "mast"), (1, 0, 0), at / 100)
            bag.transform("/tf", ("odom", "base_link"), (at, 0, 0), at / 100)
        bag.transform("/tf_static", ("base_link", "imu"), (1, 2, 3))
    recording = open_recording(tmp_path / "r.bag")
    found = {edge: joint.translation.tolist() for edge, joint in recording.static_transforms.items()}
    assert found == {("base_link", "imu"): [1, 2, 3], ("base_link", "mast"): [1, 0, 0]}
    assert list(recording.poses) == ["odom/base_link"]


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    ".gz": gzip.compress,
    ".bz2": bz2.compress,
    ".xz": lzma.compress,
    ".zst": lambda content: zstandard.ZstdCompressor().compress(content),
    ".zstd": lambda content: zstandard.ZstdCompressor(write_content_size=False).compress(content),
}


@pytest.mark.parametrize("suffix", PACKERS)
@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
def test_files_packed_as_a_whole(tmp_path: Path, suffix: str, kind: str) -> None:
    if kind == "bag":
        with SmallBag(tmp_path / "r.bag") as bag:
            fill(bag)
        plain = tmp_path / "r.bag"
    else:
        with SmallBag(tmp_path / "r", 2, "mcap" if kind == "mcap" else "sqlite3") as bag:
            fill(bag)
        plain = next((tmp_path / "r").glob(f"*.{kind}"))
    packed = tmp_path / (plain.name + suffix)
    packed.write_bytes(PACKERS[suffix](plain.read_bytes()))
    assert counts(open_recording(packed)) == (10, 50, 1)
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size * 2 // 3])
    try:
        cut = open_recording(packed)
    except InputError:
        return  # not even the beginning could be unpacked
    assert "cut off" in words(cut)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("mode", ["MESSAGE", "FILE"])
@pytest.mark.parametrize("metadata", [True, False])
def test_rosbag2_packed_with_or_without_metadata(
    tmp_path: Path, storage: str, mode: str, metadata: bool
) -> None:
    with SmallBag(tmp_path / "r", 2, "sqlite3") as bag:
        fill(bag)
    folder = tmp_path / "r"
    if storage == "mcap":
        shutil.rmtree(folder)
        with SmallBag(folder, 2, "mcap") as bag:
            fill(bag)
    (file,) = [p for p in folder.iterdir() if p.suffix != ".yaml"]
    if mode == "FILE":
        file.with_name(f"{file.name}.zstd").write_bytes(PACKERS[".zstd"](file.read_bytes()))
        file.unlink()
        named = (folder / "metadata.yaml").read_text().replace(file.name, f"{file.name}.zstd")
        (folder / "metadata.yaml").write_text(named.replace("compression_mode: ''", "compression_mode: FILE"))
    elif storage == "sqlite3":
        with closing(sqlite3.connect(file)) as database:
            for row, data in database.execute("SELECT id, data FROM messages").fetchall():
                packed = zstandard.ZstdCompressor().compress(data)
                database.execute("UPDATE messages SET data = ? WHERE id = ?", (packed, row))
            database.commit()
    else:
        shutil.rmtree(folder)
        with SmallBag(folder, 2, "mcap", mode=CompressionMode.MESSAGE) as bag:
            fill(bag)
    if not metadata:
        (folder / "metadata.yaml").unlink()
    recording = open_recording(folder)
    if mode == "FILE" and metadata:  # as `ros2 bag play` leaves it: unpacked beside, the metadata as before
        shutil.move(file.with_name(f"{file.name}.zstd"), tmp_path / "packed.zstd")
        unpacked = (
            zstandard.ZstdDecompressor().decompressobj().decompress((tmp_path / "packed.zstd").read_bytes())
        )
        file.write_bytes(unpacked)
        assert counts(open_recording(folder)) == (10, 50, 1)
    assert counts(recording) == (10, 50, 1)
    assert ("metadata.yaml is missing" in words(recording)) == (not metadata)


@pytest.mark.parametrize("parts", [2, 3, 12])
def test_files_of_a_bag_without_metadata_come_in_natural_order(tmp_path: Path, parts: int) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for part in range(parts):
        with SmallBag(tmp_path / f"p{part}", 2) as bag:
            for number in range(3):
                bag.image("/front/image_raw", part + number / 10)
        shutil.copy(tmp_path / f"p{part}" / f"p{part}.db3", folder / f"split_{part}.db3")
    recording = open_recording(folder)
    assert len(recording.camera("front")) == 3 * parts
    assert "time goes back" not in words(recording)


@pytest.mark.parametrize("kept", ["wal", "wal without shm", "read-only"])
def test_a_recorder_that_was_killed_leaves_its_last_writes_in_a_log(tmp_path: Path, kept: str) -> None:
    with SmallBag(tmp_path / "r", 2) as bag:
        fill(bag, frames=4)
    source = tmp_path / "r" / "r.db3"
    target = tmp_path / "killed"
    target.mkdir()
    with closing(sqlite3.connect(source)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        topic, data = database.execute(
            "SELECT t.id, m.data FROM topics t JOIN messages m ON m.topic_id = t.id WHERE t.name = '/imu/data'"
        ).fetchone()
        for at in range(30):
            stamped = data[:4] + struct.pack("<II", START_NS // 10**9 + 5, at * 10**7) + data[12:]
            row = (topic, START_NS + 5 * 10**9 + at * 10**7, stamped)
            database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
        database.commit()
        for suffix in ("", "-wal", *(() if kept == "wal without shm" else ("-shm",))):
            shutil.copy(f"{source}{suffix}", target / f"r.db3{suffix}")
    before = {path.name: path.read_bytes() for path in target.iterdir()}
    if kept == "read-only":
        target.chmod(0o555)
    recording = open_recording(target / "r.db3")
    assert counts(recording) == (4, 50, 1)
    assert "not closed" in words(recording)
    target.chmod(0o755)
    assert {path.name: path.read_bytes() for path in target.iterdir()} == before


LLA = (53.54, 9.98, 40.0)


def walk(at: int, height: float = 40.0) -> tuple[float, float, float]:
    return LLA[0] + at * 1e-5, LLA[1] + at * 1e-5, height


@pytest.mark.parametrize("absent", [range(30), range(5), range(3, 30, 2)])
def test_fixes_without_altitude_keep_their_position(tmp_path: Path, absent: range) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        for at in range(30):
            bag.fix("/fix", at / 5, walk(at, float("nan") if at in absent else 40.0))
    recording = open_recording(tmp_path / "r.bag")
    gnss = recording.gnss["gnss"]
    assert len(gnss.timestamps_ns) == 30
    assert gnss.position_enu[-1, :2] == pytest.approx([19.23, 32.28], abs=0.05)
    assert ((gnss.covariances[:, 2, 2] > 1e5) == [at in absent for at in range(30)]).all()
    assert (gnss.covariances[:, 0, 0] == 1).all()
    assert f"{len(absent)} fixes have no altitude" in words(recording)
    assert np.abs(gnss.position_enu[:, 2]).max() < 0.01


@pytest.mark.parametrize("status", [0, -1, 2])
@pytest.mark.parametrize("zeros", [range(5), range(10, 14), range(0, 30, 7)])
def test_null_island_is_no_position(tmp_path: Path, status: int, zeros: range) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        for at in range(30):
            bag.fix("/fix", at / 5, (0, 0, 0) if at in zeros else walk(at), status if at in zeros else 0)
    recording = open_recording(tmp_path / "r.bag")
    gnss = recording.gnss["gnss"]
    assert len(gnss.timestamps_ns) == 30 - len(zeros)
    assert np.abs(gnss.position_enu).max() < 60
    assert f"{len(zeros)} " in words(recording)


def chunked(path: Path, kind: str, *, compression: str = "none", crc: bool = True) -> Path:
    """A bag of several small chunks, with an index; MCAP with the checksums that rosbags leaves out."""
    if kind == "ros1":
        with SmallBag(path) as bag:
            bag.writer.chunk_threshold = 2000
            fill(bag, frames=20)
        return path
    with SmallBag(path.with_suffix(".tmp"), 2) as bag:
        fill(bag, frames=20)
    packing = CompressionType.ZSTD if compression == "zstd" else CompressionType.NONE
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=2000, compression=packing, enable_crcs=crc)
        writer.start("ros2", "test")
        channels = {}
        with closing(sqlite3.connect(next(path.with_suffix(".tmp").glob("*.db3")))) as database:
            rows = database.execute(
                "SELECT t.name, t.type, m.timestamp, m.data FROM messages m JOIN topics t ON m.topic_id = t.id"
            )
            for name, message_type, stamp, data in rows.fetchall():
                if name not in channels:
                    schema = writer.register_schema(message_type, "ros2msg", b"")
                    channels[name] = writer.register_channel(name, "cdr", schema)
                writer.add_message(channels[name], stamp, data, stamp)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("kind", "crc"),
    [("ros1", False), ("mcap", True), ("mcap", False)],
    ids=["ros1", "mcap", "mcap without crc"],
)
def test_no_flipped_bit_loses_anything_without_a_word(tmp_path: Path, kind: str, crc: bool) -> None:
    """Only a picture whose own content is damaged shows first when it is decoded."""
    file = chunked(tmp_path / ("r.bag" if kind == "ros1" else "r.mcap"), kind, crc=crc)
    content = file.read_bytes()
    whole = counts(open_recording(file))
    assert whole == (20, 100, 1)
    rng = np.random.default_rng(3)
    places = rng.choice(np.arange(13, len(content)), 25, replace=False)
    index = content.rindex(b"op=\x07") if kind == "ros1" else len(content) - 2000
    places = np.concatenate([places, rng.choice(np.arange(index, len(content)), 15, replace=False)])
    target = tmp_path / f"flipped{file.suffix}"
    for place in places.tolist():
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        target.write_bytes(flipped)
        try:
            recording = open_recording(target)
        except InputError:
            continue
        frames, *others = counts(recording)
        lost = frames < whole[0] - 1 or any(n < w for n, w in zip(others, whole[1:], strict=True))
        assert not lost or recording.findings, f"byte {place}"


@pytest.mark.parametrize("place", ["image", "imu", "chunk end"])
@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_chunks_that_fail_their_checksum_are_named(tmp_path: Path, place: str, compression: str) -> None:
    file = chunked(tmp_path / "r.mcap", "mcap", compression=compression)
    content = bytearray(file.read_bytes())
    if compression == "none":
        found = {
            "image": content.index(picture().tobytes()[:32]) + 5,
            "imu": content.index(struct.pack("<d", 9.8)) + 2,
            "chunk end": content.index(struct.pack("<d", 9.8)) + 11,
        }
        content[found[place]] ^= 4
    else:
        starts = [at for at in range(len(content)) if content.startswith(b"\x28\xb5\x2f\xfd", at)]
        content[starts[{"image": 0, "imu": 1, "chunk end": -1}[place]] + 30] ^= 4
    file.write_bytes(content)
    said = words(open_recording(file))
    assert "checksum" in said or "unpacked" in said or "damaged" in said


@cache
def _packed_zeros() -> bytes:
    return bz2.compress(bytes(2**24))


def bombs(path: Path, count: int, claimed: int, compression: str) -> Path:
    """A ROS 1 bag of chunks that claim, and hold, far more than their size."""
    zeros = _packed_zeros() if compression == "bz2" else b"\x04\x22\x4d\x18" + bytes(60)
    parts = [b"#ROSBAG V2.0\n"]
    for _ in range(count):
        fields = [b"op=\x05", b"compression=" + compression.encode(), b"size=" + struct.pack("<I", claimed)]
        header = b"".join(struct.pack("<I", len(f)) + f for f in fields)
        parts += [struct.pack("<I", len(header)), header, struct.pack("<I", len(zeros)), zeros]
    path.write_bytes(b"".join(parts))
    return path


@pytest.mark.parametrize("count", [1, 40, 200])
@pytest.mark.parametrize("claimed", [2**32 - 1, 2**30 - 1, FREE_BYTES // 4 + 10**6])
def test_what_is_packed_too_tightly_is_not_unpacked(tmp_path: Path, count: int, claimed: int) -> None:
    recording = open_recording(bombs(tmp_path / "r.bag", count, claimed, "bz2"))
    assert not recording.cameras
    assert "claim to hold far more" in words(recording)


def test_packed_files_and_messages_that_explode_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("packed_files", "rosbag2"):
        monkeypatch.setattr(f"rigwake.readers.{module}.FREE_BYTES", 2**20)
    bomb = zstandard.ZstdCompressor(level=1).compress(bytes(2**25))
    (tmp_path / "r.mcap.zstd").write_bytes(bomb)
    with pytest.raises(InputError, match="far more"):
        open_recording(tmp_path / "r.mcap.zstd")
    with SmallBag(tmp_path / "r", 2) as bag:
        fill(bag)
    with closing(sqlite3.connect(tmp_path / "r" / "r.db3")) as database:
        database.execute("UPDATE messages SET data = ?", (bomb,))
        database.commit()
    recording = open_recording(tmp_path / "r")
    assert counts(recording) == (0, 0, 0)
    assert "error" in words(recording)


GENERATED = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB AS (zeroblob(900000000)))"
)
VIEWS = {
    "generated column": ("DROP TABLE messages", GENERATED),
    "view": (
        "ALTER TABLE messages RENAME TO m",
        "CREATE VIEW messages AS SELECT id, topic_id, timestamp, zeroblob(900000000) AS data FROM m",
    ),
    "virtual table": (
        "DROP TABLE messages",
        "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
    ),
}


@pytest.mark.parametrize("kind", VIEWS)
def test_tables_that_are_computed_are_refused(tmp_path: Path, kind: str) -> None:
    with SmallBag(tmp_path / "r", 2) as bag:
        fill(bag)
    with closing(sqlite3.connect(tmp_path / "r" / "r.db3")) as database:
        for statement in VIEWS[kind]:
            database.execute(statement)
        database.commit()
    with pytest.raises(InputError, match=r"computed|not a ROS 2 bag"):
        open_recording(tmp_path / "r" / "r.db3")


def test_a_table_without_a_key_is_read_in_linear_time(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r", 2) as bag:
        fill(bag)
    with closing(sqlite3.connect(tmp_path / "r" / "r.db3")) as database:
        database.execute("CREATE TABLE copy AS SELECT * FROM messages")
        database.execute("DROP TABLE messages")
        database.execute("ALTER TABLE copy RENAME TO messages")
        plan = database.execute("EXPLAIN QUERY PLAN SELECT data FROM messages WHERE rowid = 1").fetchall()
        database.commit()
    assert "SCAN" not in str(plan)
    assert counts(open_recording(tmp_path / "r")) == (10, 50, 1)


@pytest.mark.parametrize("name", ["r.bag", "r.mcap", "r.db3", "r.nmea"])
def test_pipes_and_devices_are_no_recordings(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="not a regular file"):
        open_recording(tmp_path / name)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("/dev/zero")
    with pytest.raises(InputError, match="not a regular file"):
        open_recording(tmp_path / name)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_bag_folder_with_a_pipe_or_a_device(tmp_path: Path, kind: str) -> None:
    with SmallBag(tmp_path / "r", 2) as bag:
        fill(bag)
    (tmp_path / "r" / "r.db3").unlink()
    if kind == "pipe":
        os.mkfifo(tmp_path / "r" / "r.db3")
    else:
        (tmp_path / "r" / "r.db3").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="No file"):
        open_recording(tmp_path / "r")


def test_stored_pictures_of_other_kinds_in_compressed_topics_are_named(tmp_path: Path) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.compressed("/front/image_raw/compressed", 0.0, b"RIFF0000WEBPVP8 ", "webp")
        bag.compressed("/port/image_raw/compressed", 0.0, cv2.imencode(".png", picture())[1].tobytes(), "png")
    recording = open_recording(tmp_path / "r.bag", TopicMap())
    assert list(recording.cameras) == ["port"]
    assert "neither JPEG nor PNG" in words(recording)


def test_small_recordings_of_ours_open_without_findings(tmp_path: Path) -> None:
    from rigwake.writers.write import write_recording

    for name, file_format in (("a.bag", "ros1"), ("b.mcap", "mcap"), ("c", "ros2")):
        write_recording(small_recording(), tmp_path / name, file_format=file_format, image_encoding="png")  # type: ignore[arg-type]
        assert not open_recording(tmp_path / name).findings


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("base_link", (1, 0, 2)),
        ("/base_link", (1, 0, 2)),
        ("mast", (0, 0, 2)),
        ("imu", (0, 0, 0)),
        ("imu_link", (0, 0, 0)),
        ("elsewhere", None),
        ("camera_link", "refused"),
    ],
)
def test_the_reference_may_be_any_frame_of_a_chain(tmp_path: Path, wanted: str, expected: object) -> None:
    with SmallBag(tmp_path / "r.bag") as bag:
        bag.camera("/front/image_raw", "/front/camera_info", frames=200)
        for at in range(200):
            bag.imu("/imu/data", at / 10, frame="/imu_link")
        bag.transform("/tf_static", ("base_link", "mast"), (1, 0, 0))
        bag.transform("/tf_static", ("mast", "/imu_link"), (0, 0, 2), publisher=1)
        bag.transform("/tf_static", ("mount", "camera_link"), (0, 0, 2), publisher=2)
    recording = open_recording(tmp_path / "r.bag")
    selection = select(recording, CalibrateConfig())
    if expected == "refused":
        with pytest.raises(InputError, match="where the IMU sits on camera_link"):
            reference_frame(recording, selection, None, wanted)  # type: ignore[arg-type]
        return
    frame = reference_frame(recording, selection, None, wanted)  # type: ignore[arg-type]
    found = None if frame.reference_from_rig is None else frame.reference_from_rig.translation.tolist()
    assert found == (None if expected is None else pytest.approx(expected))
