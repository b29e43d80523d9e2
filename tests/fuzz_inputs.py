"""Valid inputs of every reader, ways to damage them, and the process that reads what comes of it.

`python fuzz_inputs.py FOLDER SEED COUNT [NAME ...]` damages each input COUNT times and reads it under a limit of
memory; it prints one JSON line for everything that is neither a result nor an error of rigwake's own. A new format is
one more
`FuzzInput` in a list of `INPUTS`.
"""

import json
import resource
import shutil
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import yaml

from fuzz_files import BAGS, READ_BACK, FuzzInput, drain, small_picture
from rigwake.calibration import CalibratedCamera, Calibration, load_calibration, save_calibration
from rigwake.cameras.formats.camera_files import WRITERS, read_cameras, write_cameras
from rigwake.cameras.model_fitting import convert_camera
from rigwake.cameras.registry import camera_from_params
from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.exporters import FORMATS, ExportedImuNoise, ExportOptions, export_calibration, read_calibration
from rigwake.exporters.known_rigs import read_known_rig
from rigwake.geometry.se3 import SE3
from rigwake.pipeline.prior import load_prior
from rigwake.readers.topics import TopicMap
from rigwake.readers.trajectories import read_trajectory
from rigwake.simulation.scenario import parse_scenario
from rigwake.text_files import read_text_file
from rigwake.trajectory import Trajectory
from rigwake.writers.trajectory_writer import write_tum

MEMORY_BYTES = 2**30
SECONDS = 20.0
START_NS = 1_700_000_000_000_000_000


# ---- valid inputs


def _text(name: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return make


def _poses(count: int = 12) -> tuple[np.ndarray, SE3]:
    rng = np.random.default_rng(5)
    return START_NS + 100_000_000 * np.arange(count), SE3.exp(0.3 * rng.normal(size=(count, 6)))


def _rows(separator: str, stamp: Callable[[int], str], order: tuple[int, ...] = (4, 5, 6, 3)) -> str:
    stamps, poses = _poses()
    lines = []
    for at, values in zip(
        stamps.tolist(), np.hstack([poses.translation, poses.quat_wxyz]).tolist(), strict=True
    ):
        lines.append(separator.join([stamp(at), *(f"{values[i]:.9f}" for i in (0, 1, 2, *order))]))
    return "\n".join(lines) + "\n"


def _seconds(at: int) -> str:
    return f"{at // 10**9}.{at % 10**9:09d}"


def _matrices() -> str:
    _, poses = _poses()
    return "\n".join(" ".join(f"{x:.9f}" for x in m[:3].ravel()) for m in poses.matrix) + "\n"


def _with_covariances(folder: Path) -> Path:
    stamps, poses = _poses()
    spread = np.broadcast_to(1e-4 * np.eye(6), (len(stamps), 6, 6)).copy()
    write_tum(Trajectory("a", stamps, poses, spread, "poses"), folder / "a.tum")
    return folder / "a.tum"


TRAJECTORIES = [
    FuzzInput(
        "tum", _text("a.tum", "# timestamp tx ty tz qx qy qz qw\n" + _rows(" ", _seconds)), read_trajectory
    ),
    FuzzInput("euroc", _text("a.csv", _rows(",", str, (3, 4, 5, 6))), read_trajectory),
    FuzzInput("named", _text("a.csv", "time [ns];x;y;z;qx;qy;qz;qw\n" + _rows(";", str)), read_trajectory),
    FuzzInput("kitti", _text("a.txt", _matrices()), read_trajectory),
    FuzzInput("covariances", _with_covariances, read_trajectory),
]


def _checksummed(body: str) -> str:
    value = 0
    for character in body:
        value ^= ord(character)
    return f"${body}*{value:02X}\n"


def nmea_text(count: int = 12) -> str:
    lines = ["# logger\n"]
    for k in range(count):
        time_of_day = f"2359{50 + k % 10:02d}.00" if k < 10 else f"0000{k - 10:02d}.00"
        place = f"5332.{4000 + k:04d},N,00958.{8000 + 2 * k:04d},E"
        lines.append(
            _checksummed(f"GPRMC,{time_of_day},A,{place},3.0,45.0,{'141123' if k < 10 else '151123'},,,A")
        )
        lines.append(_checksummed(f"GPGGA,{time_of_day},{place},2,09,0.9,12.3,M,45.1,M,,"))
        lines.append(_checksummed(f"GPGST,{time_of_day},1.0,,,,0.4,0.5,0.9"))
        lines.append(_checksummed(f"HEHDT,{45 + k}.0,T"))
    return "".join(lines)


def _images(suffix: str, names: Callable[[int], str]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / "rec" / "front").mkdir(parents=True)
        for k in range(4):
            cv2.imwrite(str(folder / "rec" / "front" / f"{names(k)}{suffix}"), small_picture(k))
        return folder / "rec"

    return make


def _tables(folder: Path) -> Path:
    rec = _images(".jpg", lambda k: f"frame{k}")(folder)
    stamps = (START_NS + 33_333_333 * np.arange(4)).tolist()
    (rec / "front" / "timestamps.csv").write_text(
        "timestamp [ns],filename\n" + "".join(f"{t},frame{k}.jpg\n" for k, t in enumerate(stamps))
    )
    (rec / "imu0.csv").write_text(
        "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z\n"
        + "".join(f"{START_NS + k * 5_000_000},0.01,0.02,0.3,0.1,0.1,9.81\n" for k in range(20))
    )
    (rec / "gnss.csv").write_text(
        "timestamp_s,latitude,longitude,altitude,cov_ee,cov_en,cov_eu,cov_nn,cov_nu,cov_uu\n"
        + "".join(f"{1700000000 + k},53.5{k},9.98,40,1,0,0,1,0,4\n" for k in range(6))
    )
    (rec / "attitude.csv").write_text("t,qw,qx,qy,qz\n" + "".join(f"{k},1,0,0,0\n" for k in range(6)))
    (rec / "log.nmea").write_text(nmea_text(4))
    write_cameras(rec / "rig.yaml", {"front": _lens()})
    (rec / "poses").mkdir()
    (rec / "poses" / "base.tum").write_text(_rows(" ", _seconds))
    return rec


def _lens() -> object:
    return camera_from_params("kb4", [100.0, 100.0, 15.5, 11.5, -0.01, 0.02, 0.0, 0.0], 32, 24)


def write_video(path: Path, codec: str, options: dict[str, str], count: int = 12) -> Path:
    """A small video whose frames grow brighter, so that each can be told."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height = 64, 48
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for k in range(count):
            grey = np.full((48, 64, 3), 20 + 200 * k // count, np.uint8)
            frame = av.VideoFrame.from_ndarray(grey, "rgb24")
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
    return path


def _video(name: str, codec: str, options: dict[str, str]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write_video(folder / "rec" / name, codec, options)
        return folder / "rec"

    return make


def _euroc(folder: Path) -> Path:
    cam, imu = folder / "rec" / "mav0" / "cam0", folder / "rec" / "mav0" / "imu0"
    (cam / "data").mkdir(parents=True)
    imu.mkdir()
    rows = []
    for k in range(3):
        stamp = START_NS + 50_000_000 * k
        cv2.imwrite(str(cam / "data" / f"{stamp}.png"), small_picture(k))
        rows.append(f"{stamp},{stamp}.png\n")
    (cam / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(rows))
    matrix = [float(x) for x in np.eye(4).ravel()]
    sensor = {
        "T_BS": {"rows": 4, "cols": 4, "data": matrix},
        "resolution": [32, 24],
        "camera_model": "pinhole",
        "intrinsics": [100.0, 100.0, 15.5, 11.5],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [0.0, 0.0, 0.0, 0.0],
    }
    (cam / "sensor.yaml").write_text(yaml.safe_dump(sensor))
    (imu / "data.csv").write_text(
        "#timestamp [ns],w_RS_S_x [deg s^-1],w_RS_S_y [deg s^-1],w_RS_S_z [deg s^-1],"
        "a_RS_S_x [g],a_RS_S_y [g],a_RS_S_z [g]\n"
        + "".join(f"{START_NS + 5_000_000 * k},0,0,0.1,0,0,1\n" for k in range(20))
    )
    return folder / "rec"


def _kitti_raw(folder: Path) -> Path:
    rec = folder / "rec"
    (rec / "image_00" / "data").mkdir(parents=True)
    (rec / "oxts" / "data").mkdir(parents=True)
    lines = "".join(f"2011-09-26 13:02:2{k}.500000000\n" for k in range(3))
    for part in ("image_00", "oxts"):
        (rec / part / "timestamps.txt").write_text(lines)
    for k in range(3):
        cv2.imwrite(str(rec / "image_00" / "data" / f"{k:010d}.png"), small_picture(k))
        values = [49.0 + 1e-5 * k, 8.4, 112.0, 0.01, 0.0, 1.0, *[0.1] * 24]
        (rec / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, values)) + "\n")
    return rec


RECORDINGS = [
    FuzzInput("nmea", _text("log.nmea", nmea_text()), drain),
    FuzzInput("folder", _tables, drain),
    FuzzInput("stamped names", _images(".png", lambda k: str(START_NS + k * 33_333_333)), drain),
    FuzzInput("tif", _images(".tif", lambda k: f"a{k}"), drain),
    FuzzInput("bmp", _images(".bmp", lambda k: f"a{k}"), drain),
    FuzzInput("pgm", _images(".pgm", lambda k: f"a{k}"), drain),
    FuzzInput("webp", _images(".webp", lambda k: f"a{k}"), drain),
    FuzzInput("mp4", _video("front.mp4", "libx264", {"bf": "2", "g": "6"}), drain),
    FuzzInput("avi", _video("front.avi", "mjpeg", {}), drain),
    FuzzInput("mkv", _video("front.mkv", "libx264", {"g": "6"}), drain),
    FuzzInput("euroc folder", _euroc, drain),
    FuzzInput("kitti raw", _kitti_raw, drain),
]


def small_calibration() -> Calibration:
    """Two cameras with lenses, clocks and covariances in the frame of an IMU."""
    places = {"cam0": [0.1, 0.2, 0.3, 0.5, 0.1, -0.2], "cam1": [-0.3, 0.2, 0.1, -0.5, 0.1, 0.4]}
    cameras = {
        name: CalibratedCamera(
            name, SE3.exp(np.array(place)), 1e-6 * np.eye(6), time_offset_s=0.01, model=_lens()
        )
        for name, place in places.items()
    }
    return Calibration("imu", cameras, 1e-6 * np.eye(12), np.zeros(3), 0.01 * np.eye(3))


def _calibration(folder: Path) -> Path:
    save_calibration(small_calibration(), folder / "calibration.yaml")
    return folder / "calibration.yaml"


def _exported(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        target = folder / FORMATS[name].usual_file.rstrip("/")
        options = ExportOptions(imu=ExportedImuNoise(0.01, 1e-4, 1e-3, 1e-5, 200.0))
        export_calibration(small_calibration(), name, target, options)
        return target

    return make


def _camera_file(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        suffix = {"ocamcalib": ".txt", "colmap": ".txt", "basalt": ".json"}.get(name, ".yaml")
        lens = convert_camera(_lens(), "scaramuzza").camera if name == "ocamcalib" else _lens()
        write_cameras(folder / f"lens{suffix}", {"front": lens}, name)
        return folder / f"lens{suffix}"

    return make


VINS = """%YAML:1.0
---
image0_topic: "/cam0"
cam0_calib: "lens.yaml"
td: 1e-3
body_T_cam0: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: [1., 0., 0., 0.1, 0., 1., 0., 0.2, 0., 0., 1., 0.3, 0., 0., 0., 1.]
"""
ORB_SLAM = """%YAML:1.0
Camera.type: "KannalaBrandt8"
Camera1.fx: 190.9
Camera1.fy: 190.9
Camera1.cx: 254.9
Camera1.cy: 256.8
Camera1.k1: 0.003
Camera1.k2: 7.1e-4
Camera1.k3: -2.e-3
Camera1.k4: 2.0e-4
Camera.width: 512
Camera.height: 512
Stereo.b: 0.11
IMU.T_b_c1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [1.0, 0.0, 0.0, 0.04, 0.0, 1.0, 0.0, -0.02, 0.0, 0.0, 1.0, 0.01, 0.0, 0.0, 0.0, 1.0]
"""
TRUTH = """cameras:
  cam0: {base_from_cam: {quat_wxyz: [1, 0, 0, 0], translation_m: [1, 2, 3]}, time_offset_s: 0.01}
  cam1: {base_from_cam: {quat_wxyz: [0.5, 0.5, -0.5, 0.5], translation_m: [0, 2, 3]}}
imu: {base_from_imu: {quat_wxyz: [1, 0, 0, 0], translation_m: [0, 0, 0]}}
gnss: {antenna_lever_arm_base_m: [0, 0, 1]}
"""
PRIOR = """cameras:
  front:
    rig_from_cam: {quat_wxyz: [1, 0, 0, 0], translation_m: [1, null, 3]}
    std: {rotation_deg: [1, 1, null], translation_m: [0.1, 0.1, 0]}
baselines: [{cameras: [front, port], distance_m: 1.2, std_m: 5e-3}]
antenna: {position_rig_m: [0, 0, 1], std_m: [0.1, 0.1, 0.1]}
"""


def _scenario(path: Path) -> object:
    return parse_scenario(read_text_file(path), path.name)


CALIBRATIONS = [
    FuzzInput("calibration", _calibration, load_calibration),
    *(
        FuzzInput(f"export {name}", _exported(name), read_calibration)
        for name in FORMATS
        if name != "ros-static-tf"
    ),
    FuzzInput("vins", _text("vins.yaml", VINS), read_calibration),
    FuzzInput("orb-slam", _text("orb.yaml", ORB_SLAM), read_calibration),
    FuzzInput("truth", _text("truth.yaml", TRUTH), read_known_rig),
    *(FuzzInput(f"lens {name}", _camera_file(name), read_cameras) for name in WRITERS),
    FuzzInput("prior", _text("prior.yaml", PRIOR), load_prior),
    FuzzInput(
        "settings", _text("settings.yaml", "cameras: [front]\ntracking: {max_features: 300}\n"), load_config
    ),
    FuzzInput(
        "topics",
        _text("topics.yaml", "camera: {front: /a/b}\nimu: /x\n"),
        lambda p: TopicMap.from_options((), p),
    ),
    FuzzInput("scenario", _text("scenario.yaml", "base: demo\n"), _scenario),
]


INPUTS = [*TRAJECTORIES, *RECORDINGS, *CALIBRATIONS, *BAGS, *READ_BACK]


# ---- damage

_CELLS = (
    *(
        "nan",
        "NaN",
        "inf",
        "-inf",
        "1e999",
        "-1",
        "0",
        "1e-400",
        "9" * 400,
        "",
        "null",
        "~",
        "abc",
        "1e30",
        "-0.0",
    ),
    *(
        "true",
        "2023-99-99",
        "0x1f",
        "1,5",
        "[",
        "{",
        "&a",
        "*a",
        "<<: *a",
        "!!python/object:os.system",
        "\0",
        "\u00b0",
    ),
    *(
        "../../../etc/passwd",
        "/dev/zero",
        "99999999999999999999",
        "1e9",
        "[[[[[[[[",
        "- - - -",
        "%",
        "\t",
        "\ufeff",
    ),
)


def _damaged_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 6))):
        at, size = int(rng.integers(len(changed) + 1)), int(rng.integers(1, 9))
        match int(rng.integers(6)):
            case 0 if at < len(changed):
                changed[at] ^= 1 << int(rng.integers(8))
            case 1:
                changed[at : at + size] = rng.bytes(size)
            case 2:
                del changed[at : at + size]
            case 3:
                changed[at:at] = b"\xff" * size
            case 4:
                del changed[at:]
            case _:
                changed[at:at] = changed[at : at + 200]
    return bytes(changed)


def _damaged_text(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.decode("utf-8", "replace").splitlines(keepends=True) or [""]
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(len(lines)))
        cell = _CELLS[int(rng.integers(len(_CELLS)))]
        words = lines[at].replace(",", " , ").split(" ")
        where = int(rng.integers(len(words)))
        match int(rng.integers(7)):
            case 0 | 1 | 2:
                words[where] = cell
                lines[at] = " ".join(words).replace(" , ", ",")
            case 3:
                lines[at] = ""
            case 4:
                lines[at] *= 2
            case 5:
                lines[at] = lines[at][: int(rng.integers(len(lines[at]) + 1))]
            case _:
                other = int(rng.integers(len(lines)))
                lines[at], lines[other] = lines[other], lines[at]
    return "".join(lines).encode()


def _nested_yaml(content: bytes, rng: np.random.Generator) -> bytes:
    """Depth, aliases and merge keys without end, below the keys of a valid file or in place of it."""
    bombs = (
        b"x: " + b"[" * 5000,
        b"x: " + b"{a: " * 3000,
        b"- " * 4000,
        b"a0: &a0 {k: 1}\n"
        + b"".join(
            b"a%d: &a%d {<<: [%s]}\n" % (k, k, b",".join([b"*a%d" % (k - 1)] * 9)) for k in range(1, 12)
        ),
        b"a: &a [*a]\n",
        b"x: " + b"9" * 9000,
    )
    bomb = bombs[int(rng.integers(len(bombs)))]
    return content + b"\n" + bomb if rng.integers(2) else bomb


_TEXTS = {".csv", ".txt", ".tum", ".yaml", ".json", ".nmea", ".urdf", ".cameramodel", ""}


def damages(path: Path, seed: int, count: int) -> Iterator[tuple[Path, str]]:
    """Damages one file of the input at a time and undoes it afterwards; what was done, in words."""
    rng = np.random.default_rng(seed)
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for k in range(count):
        file = files[int(rng.integers(len(files)))]
        content = file.read_bytes()
        kinds = [_damaged_bytes]
        if file.suffix in _TEXTS:
            kinds += [_damaged_text, _damaged_text]
        if file.suffix == ".yaml" and k % 5 == 0:
            kinds = [_nested_yaml]
        damage = kinds[int(rng.integers(len(kinds)))]
        file.write_bytes(damage(content, rng))
        yield file, f"{damage.__name__} {k} of {file.name}"
        file.write_bytes(content)


def limit_memory() -> None:
    """No more than MEMORY_BYTES beyond what is in use, so that a bomb is a MemoryError and no dead machine."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, resource.RLIM_INFINITY))


def main(folder: Path, seed: int, count: int, names: list[str]) -> None:
    """Reads damaged inputs; prints what went wrong, and at last how many were read."""
    warnings.simplefilter("error")
    av.logging.set_level(av.logging.PANIC)
    limit_memory()
    total = 0
    for number, chosen in enumerate(one for one in INPUTS if not names or one.name in names):
        place = folder / f"{number}"
        place.mkdir(parents=True)
        path = chosen.make(place)
        for file, words in damages(path, seed + number, count):
            (folder / "last").write_text(f"{chosen.name}: {words}")
            start = time.monotonic()
            failure = ""
            try:
                chosen.read(path)
            except RigwakeError:
                pass
            except BaseException:
                failure = traceback.format_exc(limit=-4)
            seconds = time.monotonic() - start
            total += 1
            if failure or seconds > SECONDS:
                kept = folder / "failures" / f"{total}_{file.name}"
                kept.parent.mkdir(exist_ok=True)
                shutil.copy(file, kept)
                report = {"input": chosen.name, "damage": words, "seconds": seconds, "failure": failure}
                print(json.dumps(report | {"file": str(kept)}), flush=True)
    print(json.dumps({"total": total}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
