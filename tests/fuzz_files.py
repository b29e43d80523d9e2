"""Damaged files are made of these: bags of every kind, and everything that rigwake reads back from what it wrote."""

import gzip
import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import zstandard
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionMode

from onnx_files import constant_network
from report_folders import write_folder
from rigwake.atomic import write_text_atomic
from rigwake.errors import RigwakeError
from rigwake.fleet.collect import table_rows
from rigwake.fleet.fleet_jobs import FleetOutcome
from rigwake.fleet.resume import OUTCOME, read_outcome
from rigwake.intrinsics.board_observations import read_corner_file
from rigwake.logbook.store import Logbook
from rigwake.pipeline.camera_stage import load_outcome, outcome_file
from rigwake.pipeline.stage_files import StageLedger
from rigwake.readers.open import open_recording
from rigwake.report import build_report, load_report_content
from rigwake.tracking.masks import mask_from_file
from rigwake.tracks import Tracks, load_tracks
from rigwake.views.rig_sources import read_rig_source
from rigwake.views.scene.network import external_network
from ros_bags import START_NS, SmallBag


@dataclass(frozen=True)
class FuzzInput:
    """make: writes a valid input into a folder and returns what is read. read: reads it all."""

    name: str
    make: Callable[[Path], Path]
    read: Callable[[Path], object]


def drain(path: Path) -> None:
    recording = open_recording(path)
    for camera in recording.cameras.values():
        for _ in camera.frames(colour=True):
            pass


def small_picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (24, 32), dtype=np.uint8)


# ---- bags


def _fill(bag: SmallBag) -> None:
    """Two cameras with lenses, raw and compressed, an IMU, fixes, poses and transforms."""
    encoded = cv2.imencode(".jpg", small_picture(0))[1].tobytes()
    for k in range(6):
        bag.image(
            "/front/image_raw", k / 10, (small_picture(k).astype(np.uint16) << 4), "mono16", size=(32, 24)
        )
        bag.compressed("/port/image_raw/compressed", k / 10, encoded)
        bag.fix("/fix", k / 10, (53.54 + 1e-5 * k, 9.98, 40.0))
    bag.info("/front/camera_info", size=(32, 24), matrix=[30, 0, 15.5, 0, 30, 11.5, 0, 0, 1])
    bag.info("/port/camera_info", size=(32, 24), matrix=[30, 0, 15.5, 0, 30, 11.5, 0, 0, 1])
    for k in range(30):
        bag.imu("/imu/data", k / 50)
    bag.transform("/tf_static", ("base_link", "imu"), (1, 2, 3))
    bag.transform("/tf", ("odom", "base_link"), (1, 2, 3), 0.1)


def _bag(name: str, ros: int, packing: str = "", **options: object) -> Callable[[Path], Path]:
    """packing: of the file as a whole (`.gz`, `.zstd`)."""

    def make(folder: Path) -> Path:
        path = folder / name
        with SmallBag(path, ros, **options) as bag:  # type: ignore[arg-type]
            _fill(bag)
        if packing == ".gz":
            (folder / f"{name}.gz").write_bytes(gzip.compress(path.read_bytes()))
            path.unlink()
            return folder / f"{name}.gz"
        if packing == ".zstd":
            (file,) = [f for f in path.iterdir() if f.suffix != ".yaml"]
            file.with_name(file.name + packing).write_bytes(zstandard.compress(file.read_bytes()))
            file.unlink()
        return path

    return make


BAGS = [
    FuzzInput("ros1", _bag("a.bag", 1), drain),
    FuzzInput("ros1 bz2", _bag("a.bag", 1, compression=Rosbag1Writer.CompressionFormat.BZ2), drain),
    FuzzInput("ros1 lz4", _bag("a.bag", 1, compression=Rosbag1Writer.CompressionFormat.LZ4), drain),
    FuzzInput("ros1 gz", _bag("a.bag", 1, packing=".gz"), drain),
    FuzzInput("ros2 sqlite3", _bag("a", 2), drain),
    FuzzInput("ros2 sqlite3 zstd", _bag("a", 2, packing=".zstd"), drain),
    FuzzInput("ros2 messages zstd", _bag("a", 2, mode=CompressionMode.MESSAGE), drain),
    FuzzInput("mcap", _bag("a", 2, storage="mcap"), drain),
    FuzzInput("mcap zstd", _bag("a", 2, packing=".zstd", storage="mcap"), drain),
]

# ---- what was written by rigwake


def _written(name: str, content: bytes | str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return folder / name

    return make


def _tracks(folder: Path) -> Path:
    stamps = START_NS + 100_000_000 * np.arange(5)
    ids, frames = np.repeat(np.arange(4), 5), np.tile(np.arange(5), 4)
    order = np.lexsort((ids, frames))
    pixels = np.random.default_rng(0).uniform(0, 24, (20, 2))
    bearings = np.column_stack([pixels / 30, np.ones(20)])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    Tracks("front", stamps, frames[order], ids[order], pixels, bearings, np.full(20, 0.1)).save(
        folder / "front.npz"
    )
    return folder / "front.npz"


def _result(folder: Path) -> Path:
    return write_folder(folder / "OUT", duration_s=3.0, observations=40)


def _report(path: Path) -> None:
    build_report(load_report_content(path))


def _stages(folder: Path) -> Path:
    out = folder / "OUT"
    outcome_file(out, "front").parent.mkdir(parents=True)
    outcome = {"name": "front", "failed": None, "notes": ["a"], "counts": {"tracking": {"frames": 3}}}
    outcome_file(out, "front").write_text(json.dumps(outcome))
    StageLedger(out, resume=False).done("camera front", "key", outcome_file(out, "front"))
    return out


def _resumed(out: Path) -> None:
    StageLedger(out, resume=True).is_done("camera front", "key", outcome_file(out, "front"))
    load_outcome(out, "front")


def _logbook(folder: Path) -> Path:
    result = _result(folder)
    with Logbook(folder / "boat.log", create=True) as book:
        book.add(load_report_content(result).calibration, START_NS)
        book._db.execute("PRAGMA journal_mode = DELETE")
    return folder / "boat.log"


def _read_logbook(path: Path) -> None:
    with Logbook(path, read_only=True) as book:
        for logged in book.calibrations():
            with suppress(RigwakeError):
                book.load(logged.id)
        book.verdicts()


def _fleet(folder: Path) -> Path:
    (folder / "a").mkdir()
    cameras = {"front": {"qw": 1.0, "x_m": 0.5, "state": "steady"}}
    outcome = FleetOutcome("a", "/rec/a.bag", "calibrated", "boat", started_ns=START_NS, cameras=cameras)
    write_text_atomic(folder / "a" / OUTCOME, outcome.to_json())
    return folder / "a"


def _read_fleet(folder: Path) -> None:
    outcome = read_outcome(folder)
    if outcome is not None:
        table_rows(replace(outcome))


def _network(path: Path) -> None:
    external_network(path, ("obstacle", "water", "sky")).probabilities(np.zeros((32, 32, 3), np.uint8))


def _mask(folder: Path) -> Path:
    cv2.imwrite(str(folder / "mask.png"), np.full((24, 32), 255, np.uint8))
    return folder / "mask.png"


_CORNERS = "timestamp_ns,tag_id,corner_idx,u_px,v_px,x_m,y_m,z_m\n" + "".join(
    f"{START_NS + k},{t},{c},{3 + t}.5,{4 + c}.5,{0.1 * t},{0.1 * c},0\n"
    for k in range(3)
    for t in range(3)
    for c in range(4)
)

READ_BACK = [
    FuzzInput("tracks", _tracks, load_tracks),
    FuzzInput("result folder", _result, _report),
    FuzzInput("stages", _stages, _resumed),
    FuzzInput("logbook", _logbook, _read_logbook),
    FuzzInput("fleet", _fleet, _read_fleet),
    FuzzInput("network", _written("a.onnx", constant_network([0.0, 1.0, 0.0])), _network),
    FuzzInput("mask", _mask, lambda path: mask_from_file(path, 32, 24)),
    FuzzInput("corners", _written("corners.csv", _CORNERS), lambda path: read_corner_file(path, 32, 24)),
    FuzzInput("rig source", _result, lambda path: read_rig_source(path / "calibration.yaml")),
]
