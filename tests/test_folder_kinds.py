"""Folders as people have them: names and lists of any form, image kinds, videos, tables, equal names."""

import socket
import struct
from collections.abc import Callable
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from fuzz_inputs import nmea_text
from rigwake.cameras.formats.camera_files import write_cameras
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import InputError
from rigwake.readers.frame_names import stamps_of_names
from rigwake.readers.imu_units import inertial_columns
from rigwake.readers.open import open_recording
from rigwake.readers.picture_files import decode_picture, orientation_of, picture_size
from rigwake.readers.video_files import VideoFrames, index_video
from rigwake.recording import Recording

START_NS = 1_700_000_000_000_000_000
TIMES = (START_NS + 33_333_333 * np.arange(10)).tolist()
COUNT = len(TIMES)


def picture(k: int, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    return np.full(size, 20 + 20 * k, np.uint8)


def folder(path: Path, names: list[str], suffix: str = ".png", camera: str = "front") -> Path:
    (path / camera).mkdir(parents=True)
    for k, name in enumerate(names):
        image = cv2.cvtColor(picture(k), cv2.COLOR_GRAY2BGR) if suffix == ".ppm" else picture(k)
        assert cv2.imwrite(str(path / camera / f"{name}{suffix}"), image)
    return path


def said(recording: Recording, *words: str) -> bool:
    return any(all(word in finding.message for word in words) for finding in recording.findings)


def utc(form: str, digits: int) -> list[str]:
    return [
        datetime.fromtimestamp(t // 10**9, UTC).strftime(form) + f"{t % 10**9:09d}"[:digits] for t in TIMES
    ]


STAMPED: dict[str, list[str]] = {
    "ns": [str(t) for t in TIMES],
    "us": [str(t // 1000) for t in TIMES],
    "ms": [str(t // 10**6) for t in TIMES],
    "s": [f"{t // 10**9}.{t % 10**9 // 1000:06d}" for t in TIMES],
    "s, 9 digits": [f"{t // 10**9}.{t % 10**9:09d}" for t in TIMES],
    "word before": [f"front_{t}" for t in TIMES],
    "word behind": [f"{t}_left" for t in TIMES],
    "counter before": [f"{k:06d}_{t}" for k, t in enumerate(TIMES)],
    "counter and seconds": [f"frame{k}-{t // 10**9}.{t % 10**9 // 1000:06d}" for k, t in enumerate(TIMES)],
    "cam0": [f"cam0_{t // 10**6}" for t in TIMES],
    "sec-nsec": [f"{t // 10**9}-{t % 10**9:09d}" for t in TIMES],
    "sec_nsec not padded": [f"{t // 10**9}_{t % 10**9}" for t in TIMES],
    "sec_usec": [f"{t // 10**9}_{t % 10**9 // 1000:06d}" for t in TIMES],
    "sec_ms": [f"{t // 10**9}_{t % 10**9 // 10**6:03d}" for t in TIMES],
    "date": utc("%Y%m%dT%H%M%S.", 6),
    "date with dashes": utc("%Y-%m-%d_%H-%M-%S-", 6),
    "date of a telephone": utc("IMG_%Y%m%d_%H%M%S", 3),
    "since the start, ns": [f"{t - START_NS:019d}" for t in TIMES],
    "since the start, s": [f"{(t - START_NS) / 1e9:.6f}" for t in TIMES],
    "uptime, us": [str(5_000_000_000 + (t - START_NS) // 1000) for t in TIMES],
}
COUNTERS: dict[str, list[str]] = {
    "16 digits": [f"{k:016d}" for k in range(COUNT)],
    "19 digits": [f"{k:019d}" for k in range(COUNT)],
    "plain": [str(k) for k in range(COUNT)],
    "every tenth": [f"frame_{10 * k:06d}" for k in range(COUNT)],
    "camera and counter": [f"cam0_{k}" for k in range(COUNT)],
    "day and counter": [f"20231114_{k:04d}" for k in range(COUNT)],
    "version and counter": [f"v1.2_{k}" for k in range(COUNT)],
    "serial number": [f"40012345_{k:08d}" for k in range(COUNT)],
    "one second": [f"20231114_221320-{k}" for k in range(COUNT)],
}


@pytest.mark.parametrize("form", STAMPED)
def test_names_that_are_times(tmp_path: Path, form: str) -> None:
    recording = open_recording(folder(tmp_path, STAMPED[form]))
    camera = recording.cameras["front"]
    assert len(camera) == COUNT
    assert abs(int(camera.timestamps_ns[-1] - camera.timestamps_ns[0]) - (TIMES[-1] - TIMES[0])) < 1_100_000
    if not form.startswith(("since", "uptime")):
        assert abs(int(camera.timestamps_ns[0]) - START_NS) < 1_100_000
    assert [int(frame.image.mean()) for frame in camera.frames()] == [20 + 20 * k for k in range(COUNT)]
    assert not said(recording, "assumed")


@pytest.mark.parametrize("form", COUNTERS)
def test_names_that_are_counters(tmp_path: Path, form: str) -> None:
    assert stamps_of_names(COUNTERS[form]) is None
    recording = open_recording(folder(tmp_path, COUNTERS[form]))
    assert [int(f.image.mean()) for f in recording.cameras["front"].frames()] == [
        20 + 20 * k for k in range(COUNT)
    ]
    assert said(recording, "10 Hz is assumed")


def test_a_strange_name_among_times_is_left_out_and_said(tmp_path: Path) -> None:
    recording = open_recording(folder(tmp_path, [*STAMPED["ns"], "preview"]))
    assert len(recording.cameras["front"]) == COUNT
    assert said(recording, "1 of 11 file names are no times")


FILES = [f"image{k}.png" for k in range(COUNT)]
ROWS = "".join(f"{t},{file}\n" for t, file in zip(TIMES, FILES, strict=True))
DATES = [
    datetime.fromtimestamp(t // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S.") + f"{t % 10**9:09d}" for t in TIMES
]
LISTS: dict[str, tuple[str, str]] = {
    "csv": (
        "front/timestamps.csv",
        "timestamp,filename\n" + ROWS,
    ),
    "asl": (
        "front/data.csv",
        "#timestamp [ns],filename\n" + ROWS,
    ),
    "csv without a header": (
        "front/timestamps.csv",
        "".join(f"{t},{f}\n" for t, f in zip(TIMES, FILES, strict=True)),
    ),
    "file first": ("front_timestamps.csv", "".join(f"{f},{t}\n" for t, f in zip(TIMES, FILES, strict=True))),
    "TUM RGB-D": (
        "front.txt",
        "# color images\n# timestamp filename\n"
        + "".join(f"{t // 10**9}.{t % 10**9:09d} front/{f}\n" for t, f in zip(TIMES, FILES, strict=True)),
    ),
    "times alone": ("front/times.txt", "".join(f"{t // 10**9}.{t % 10**9:09d}\n" for t in TIMES)),
    "times of all": ("timestamps.txt", "".join(f"{t // 1000}\n" for t in TIMES)),
    "dates": ("front/timestamps.txt", "\n".join(DATES)),
    "a header alone": ("front/timestamps.csv", "timestamp_ms\n" + "".join(f"{t / 1e6:.6f}\n" for t in TIMES)),
    "spaces": (
        "front/timestamps.txt",
        "timestamp_ns filename\n" + ROWS.replace(",", " "),
    ),
}


@pytest.mark.parametrize("form", LISTS)
def test_lists_of_times(tmp_path: Path, form: str) -> None:
    path, text = LISTS[form]
    folder(tmp_path, [f"image{k}" for k in range(COUNT)])
    (tmp_path / path).write_text(text)
    camera = open_recording(tmp_path).cameras["front"]
    assert np.abs(camera.timestamps_ns - np.array(TIMES)).max() <= 1000
    assert [int(frame.image.mean()) for frame in camera.frames()] == [20 + 20 * k for k in range(COUNT)]


@pytest.mark.parametrize("suffix", [".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".jpg", ".png", ".webp", ".BMP"])
def test_image_kinds(tmp_path: Path, suffix: str) -> None:
    recording = open_recording(folder(tmp_path, STAMPED["ns"], suffix))
    camera = recording.cameras["front"]
    frames = list(camera.frames())
    assert len(frames) == COUNT
    assert (camera.width_px, camera.height_px) == (32, 24)
    assert max(abs(int(frame.image.mean()) - 20 - 20 * k) for k, frame in enumerate(frames)) < 4


@pytest.mark.parametrize("suffix", [".bmp", ".tif", ".pgm", ".jpg", ".png"])
def test_half_an_image_is_refused(suffix: str) -> None:
    image = np.random.default_rng(0).integers(0, 255, (64, 80), dtype=np.uint8)
    encoded = cv2.imencode(suffix, cv2.GaussianBlur(image, (0, 0), 2))[1].tobytes()
    assert picture_size(encoded) == (80, 64)
    assert decode_picture(encoded, colour=True).shape == (64, 80, 3)
    for kept in (0.3, 0.5, 0.8):
        half = encoded[: int(kept * len(encoded))]
        for end in (b"", b"\xff\xd9" if suffix == ".jpg" else b""):
            with pytest.raises(InputError):
                decode_picture(half + end, colour=False)


def test_a_dark_lower_half_is_no_damage() -> None:
    image = np.random.default_rng(0).integers(0, 255, (64, 80), dtype=np.uint8)
    image[30:] = 7
    encoded = cv2.imencode(".jpg", image)[1].tobytes()
    assert decode_picture(encoded, colour=False).shape == (64, 80)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
def test_deep_images_are_read_by_the_bits_in_use(tmp_path: Path, bits: int, suffix: str) -> None:
    (tmp_path / "front").mkdir()
    grey = np.linspace(10, 250, 32 * 24).reshape(24, 32)
    deep = np.round(grey / 255 * ((1 << bits) - 1)).astype(np.uint16)
    for k in range(3):
        cv2.imwrite(str(tmp_path / "front" / f"{TIMES[k]}{suffix}"), deep)
    (frame, *_) = open_recording(tmp_path).cameras["front"].frames()
    assert np.abs(frame.image.astype(float) - grey).max() < 3


def with_exif(jpeg: bytes, orientation: int) -> bytes:
    tiff = b"MM\0*\0\0\0\x08\0\x01" + struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0) + b"\0\0\0\0"
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("lens", [None, (32, 24), (24, 32)])
def test_exif_turns_are_said_and_followed_where_the_lens_is_so(
    tmp_path: Path, orientation: int, lens: tuple[int, int] | None
) -> None:
    image = np.tile(np.linspace(20, 230, 32).astype(np.uint8), (24, 1))
    encoded = with_exif(cv2.imencode(".jpg", image)[1].tobytes(), orientation)
    assert orientation_of(encoded) == orientation
    (tmp_path / "front").mkdir()
    for t in TIMES[:3]:
        (tmp_path / "front" / f"{t}.jpg").write_bytes(encoded)
    if lens is not None:
        model = camera_from_params("pinhole", [30.0, 30.0, 10.0, 10.0, *[0.0] * 6], *lens)
        write_cameras(tmp_path / "rig.yaml", {"front": model})
    recording = open_recording(tmp_path)
    camera = recording.cameras["front"]
    turned = orientation in (6, 8) and lens == (24, 32)
    assert (camera.width_px, camera.height_px) == ((24, 32) if turned else (32, 24))
    (frame, *_) = camera.frames()
    assert frame.image.shape == (camera.height_px, camera.width_px)
    if turned:  # 6: turn clockwise, so that the left column (dark) comes to the top
        assert (frame.image[0].mean() < frame.image[-1].mean()) == (orientation == 6)
    assert said(recording, "EXIF orientation") == (orientation > 1)
    assert (camera.model is not None) == (lens == (camera.width_px, camera.height_px))


def video(
    path: Path, count: int, codec: str = "libx264", times: list[int] | None = None, **options: str
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for k in range(count):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 10 + 235 * k // count, np.uint8), "rgb24")
            if times is not None:
                frame.pts, frame.time_base = times[k], stream.codec_context.time_base
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
    return path


def set_rotation(path: Path, clockwise_deg: int) -> None:
    """The matrix that a phone writes into an MP4 when it is held upright."""
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 4 + 4 + 20 + 16
    one = 1 << 16
    turns = {90: (0, one, -one, 0), 180: (-one, 0, 0, -one), 270: (0, -one, one, 0)}
    a, b, c, d = turns[clockwise_deg]
    content[matrix : matrix + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("clockwise_deg", [90, 180, 270])
@pytest.mark.parametrize("lens", [None, (64, 48), (48, 64)])
def test_rotation_flags_of_videos_are_said_and_followed_where_the_lens_is_so(
    tmp_path: Path, clockwise_deg: int, lens: tuple[int, int] | None
) -> None:
    shades = np.linspace(20, 220, 48).astype(np.uint8)  # dark at the top as stored
    path = tmp_path / "rec" / "front.mp4"
    path.parent.mkdir()
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"qp": "10"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(4):
            image = np.repeat(np.repeat(shades[:, None, None], 64, 1), 3, 2)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        container.mux(stream.encode(None))
    set_rotation(path, clockwise_deg)
    if lens is not None:
        model = camera_from_params("pinhole", [50, 50, lens[0] / 2, lens[1] / 2, *[0] * 6], *lens)
        write_cameras(path.with_name("rig.yaml"), {"front": model})
    recording = open_recording(path.parent)
    camera = recording.camera("front")
    turned = clockwise_deg != 180 and lens == (48, 64)
    assert (camera.width_px, camera.height_px) == ((48, 64) if turned else (64, 48))
    assert said(recording, "rotation by")
    frames = list(camera.frames())
    assert len(frames) == 4
    image = frames[0].image.astype(float)
    assert image.shape == ((64, 48) if turned else (48, 64))
    along = image.mean(axis=0 if turned else 1)  # clockwise: what was on top is at the right
    assert (along[0] > along[-1]) == (turned and clockwise_deg == 90)
    assert (camera.model is not None) == (turned or lens == (64, 48))


def levels(path: Path, indices: list[int], count: int) -> list[int]:
    """Which frame each picture is, by its grey."""
    index = index_video(path)
    frames = VideoFrames(path, index, index.stamps_ns()).frames(indices)
    return [round((float(frame.image.mean()) - 10) * count / 235) for frame in frames]


@pytest.mark.parametrize("name", ["a.avi", "a.mp4", "a.mkv", "a.mov"])
@pytest.mark.parametrize("options", [{"bf": "0"}, {"bf": "3"}, {"bf": "2", "g": "5"}, {"g": "1"}])
def test_videos_show_each_frame_at_its_time(tmp_path: Path, name: str, options: dict[str, str]) -> None:
    count = 40
    path = video(tmp_path / name, count, **options)
    stamps = index_video(path).stamps_ns()
    assert np.abs(stamps - np.arange(count) * 1e9 / 30).max() < 1.1e6
    for chosen in (list(range(count)), [0, 17, 39], [38], list(range(5, 40, 7))):
        assert np.abs(np.array(levels(path, chosen, count)) - chosen).max() <= 1
    assert len(levels(path, list(range(count)), count)) == count


def test_keyframes_far_apart_do_not_hang(tmp_path: Path) -> None:
    count = 200
    path = video(tmp_path / "far.mp4", count, g="1000", keyint_min="1000", sc_threshold="0")
    for chosen in ([0, 100, 199], [150], [10, 190]):
        assert np.abs(np.array(levels(path, chosen, count)) - chosen).max() <= 1


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_a_variable_rate_is_kept(tmp_path: Path, name: str) -> None:
    times = np.cumsum(np.random.default_rng(0).integers(20, 90, 40)).tolist()
    path = video(tmp_path / name, 40, times=times, bf="2")
    since_first = (np.array(times) - times[0]) * 10**6
    assert np.abs(index_video(path).stamps_ns() - since_first).max() < 1.1e6
    assert levels(path, list(range(40)), 40) == pytest.approx(list(range(40)), abs=1)


@pytest.mark.parametrize("name", ["a.avi", "a.mkv"])
def test_a_video_cut_off_is_said(tmp_path: Path, name: str) -> None:
    path = video(tmp_path / name, 120, g="10")
    assert index_video(path).missing == ""
    content = path.read_bytes()
    path.write_bytes(content[: int(0.6 * len(content))])
    recording = open_recording(tmp_path)
    assert said(recording, "cut off", "announces")


def test_a_file_named_like_an_address_opens_no_connection(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        server.settimeout(0.3)
        name = f"tcp:127.0.0.1:{server.getsockname()[1]}?timeout=100000&x.mp4"
        (tmp_path / name).write_bytes(b"#EXTM3U\nhttp://127.0.0.1/x.ts\n" * 20)
        monkeypatch.chdir(tmp_path)
        with pytest.raises(InputError, match="cannot be read"):
            index_video(Path(name))
        with pytest.raises(TimeoutError):
            server.accept()


TABLES: dict[str, str] = {
    "kalibr": "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z\n",
    "asl": "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],"
    "a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n",
    "short": "t,gx,gy,gz,ax,ay,az\n",
    "ros": "field.header.stamp,field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z,"
    "field.linear_acceleration.x,field.linear_acceleration.y,field.linear_acceleration.z\n",
    "none": "",
}
UNITS: dict[str, tuple[str, float, str, float]] = {
    "deg/s and g": ("deg/s", 180 / np.pi, "g", 1 / 9.80665),
    "dps and mg": ("dps", 180 / np.pi, "mg", 1000 / 9.80665),
    "°/s and m/s²": ("°/s", 180 / np.pi, "m/s²", 1.0),
    "rad/s and m/s^2": ("rad/s", 1.0, "m/s^2", 1.0),
    "deg s^-1 and m s^-2": ("deg s^-1", 180 / np.pi, "m s^-2", 1.0),
}


def imu_rows(gyro: float = 1.0, accel: float = 1.0, separator: str = ",", swap: bool = False) -> str:
    parts = ([0.01 * gyro, 0.02 * gyro, 0.3 * gyro], [0.1 * accel, 0.1 * accel, 9.81 * accel])
    first, second = parts[::-1] if swap else parts
    return "".join(
        separator.join([str(START_NS + 5_000_000 * k), *map(repr, first), *map(repr, second)]) + "\n"
        for k in range(40)
    )


def imu_of(path: Path, text: str, encoding: str = "utf-8") -> Recording:
    path.write_text(text, encoding=encoding)
    recording = open_recording(path.parent)
    (imu,) = recording.imus.values()
    np.testing.assert_allclose(imu.gyro, np.tile([0.01, 0.02, 0.3], (40, 1)), rtol=1e-4)
    np.testing.assert_allclose(imu.accel, np.tile([0.1, 0.1, 9.81], (40, 1)), rtol=1e-3)
    return recording


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("name", ["imu.csv", "imu0.csv", "imu_bow.csv", "IMU.CSV"])
def test_inertial_tables(tmp_path: Path, table: str, name: str) -> None:
    recording = imu_of(tmp_path / name, TABLES[table] + imu_rows())
    assert said(recording, "no header") == (table == "none")


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-16"])
def test_units_of_inertial_tables(tmp_path: Path, unit: str, encoding: str) -> None:
    of_gyro, gyro, of_accel, accel = UNITS[unit]
    names = [f"gyro_{a} [{of_gyro}]" for a in "xyz"] + [f"accel_{a} [{of_accel}]" for a in "xyz"]
    recording = imu_of(
        tmp_path / "imu.csv", "timestamp [ns]," + ",".join(names) + "\n" + imu_rows(gyro, accel), encoding
    )
    assert said(recording, "converted to rad/s") == (gyro != 1)
    assert said(recording, "converted to m/s^2") == (accel != 1)
    named = "timestamp,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,acc_x_g,acc_y_g,acc_z_g\n"
    imu_of(tmp_path / "imu.csv", named + imu_rows(180 / np.pi, 1 / 9.80665))


def test_gravity_tells_the_unit_and_the_order_where_the_header_does_not(tmp_path: Path) -> None:
    recording = imu_of(tmp_path / "imu.csv", TABLES["short"] + imu_rows(accel=1 / 9.80665))
    assert said(recording, "size", "that of gravity")
    recording = imu_of(tmp_path / "imu.csv", imu_rows(swap=True))
    assert said(recording, "accelerometer, gyroscope")
    for separator in (";", "\t", " "):
        imu_of(tmp_path / "imu.csv", TABLES["kalibr"].replace(",", separator) + imu_rows(separator=separator))
    assert inertial_columns(["gyro_x", "gyro_y", "gyro_z"]) is None


def test_equal_names_are_kept_apart_and_said(tmp_path: Path) -> None:
    folder(tmp_path, STAMPED["ns"])
    video(tmp_path / "front.mp4", 5)
    video(tmp_path / "front.mkv", 5)
    (tmp_path / "gnss.csv").write_text(
        "timestamp_s,lat,lon,alt\n1700000000,53,9,1\n1700000001,53.00001,9,1\n"
    )
    (tmp_path / "gnss.nmea").write_text(nmea_text(4))
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    recording = open_recording(tmp_path)
    assert set(recording.cameras) == {"front", "front_mp4", "front_mkv"}
    assert set(recording.gnss) == {"gnss", "gnss_nmea"}
    assert said(recording, "gnss.nmea has the name of another sensor")
    assert said(recording, "other.csv is not read")


LENS_WRITERS: dict[str, Callable[[Path], None]] = {
    "intrinsics": lambda p: write_cameras(p / "rig.yaml", {"front": LENS}),
    "kalibr": lambda p: write_cameras(p / "camchain.yaml", {"front": LENS}, "kalibr"),
    "cameras": lambda p: write_cameras(p / "cameras.yaml", {"front": LENS}),
}
LENS = camera_from_params("kb4", [100.0, 100.0, 15.5, 11.5, 0.0, 0.0, 0.0, 0.0], 32, 24)


@pytest.mark.parametrize("kind", LENS_WRITERS)
def test_lens_files_of_a_folder(tmp_path: Path, kind: str) -> None:
    camera = "cam0" if kind == "kalibr" else "front"
    folder(tmp_path, STAMPED["ns"], camera=camera)
    LENS_WRITERS[kind](tmp_path)
    model = open_recording(tmp_path).cameras[camera].model
    assert model is not None
    np.testing.assert_allclose(model.params, LENS.params)


PLACES = {
    "degrees": ("t,lat_deg,lon_deg,alt_m", lambda lat, lon: f"{lat:.9f},{lon:.9f},40"),
    "longitude first": ("time,lon,lat,height", lambda lat, lon: f"{lon:.9f},{lat:.9f},40"),
    "radians": (
        "t,lat [rad],lon [rad],h [m]",
        lambda lat, lon: f"{np.radians(lat):.12f},{np.radians(lon):.12f},40",
    ),
    "u-blox": (
        "t,lat [1e-7 deg],lon [1e-7 deg],alt [mm]",
        lambda lat, lon: f"{lat * 1e7:.0f},{lon * 1e7:.0f},40000",
    ),
    "u-blox without a word": ("t,lat,lon,alt_mm", lambda lat, lon: f"{lat * 1e7:.0f},{lon * 1e7:.0f},40000"),
    "decimal commas": ("t;lat;lon;alt", lambda lat, lon: f"{lat:.9f};{lon:.9f};40".replace(".", ",")),
    "feet": ("t,lat,lon,alt_ft", lambda lat, lon: f"{lat:.9f},{lon:.9f},131.2336"),
}


@pytest.mark.parametrize("form", PLACES)
@pytest.mark.parametrize("time", ["seconds", "dates"])
def test_tables_of_positions(tmp_path: Path, form: str, time: str) -> None:
    header, cells = PLACES[form]
    separator = ";" if ";" in header else ","
    rows = [header]
    for k in range(10):
        at = str(1_700_000_000 + k) if time == "seconds" else f"2023-11-14 22:13:{20 + k}"
        rows.append(f"{at}{separator}{cells(53.54 + 1e-6 * k, 9.98 + 1e-6 * k)}")
    (tmp_path / "gnss.csv").write_text("\n".join(rows) + "\n")
    gnss = open_recording(tmp_path).gnss["gnss"]
    assert (np.diff(gnss.timestamps_ns) == 10**9).all()
    assert gnss.timestamps_ns[0] == 1_700_000_000 * 10**9
    np.testing.assert_allclose(gnss.position_enu[-1, :2], [0.5965, 1.0018], atol=2e-3)
    assert gnss.origin_lla == pytest.approx((53.54, 9.98, 40.0), abs=1e-4)


@pytest.mark.parametrize("name", ["imu", "imu0", "imu_port"])
def test_a_table_in_a_folder_of_its_own(tmp_path: Path, name: str) -> None:
    folder(tmp_path, [str(START_NS)])
    (tmp_path / name).mkdir()
    (tmp_path / name / "data.csv").write_text(imu_rows())
    assert list(open_recording(tmp_path).imus) == [name]


@pytest.mark.parametrize("name", ["front.mp4", "front.AVI", "front.mkv"])
def test_a_video_alone(tmp_path: Path, name: str) -> None:
    path = video(tmp_path / name, 6)
    recording = open_recording(path)
    assert list(recording.cameras) == ["front"]
    assert len(list(recording.camera("front").frames())) == 6
    path.write_bytes(b"no video")
    with pytest.raises(InputError, match="cannot be read"):
        open_recording(path)
