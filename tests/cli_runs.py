"""The command line in this process, and small files to run it on."""

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import typer
import yaml

from calibrated_rigs import PINHOLE, boat, without_vertical
from rigwake.calibration import save_calibration
from rigwake.cameras.registry import camera_to_dict
from rigwake.cli.main import build_app, main
from rigwake.geometry.se3 import SE3
from rigwake.trajectory import Trajectory
from rigwake.writers.trajectory_writer import write_tum

START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code, both outputs, and both as one line without frames."""

    code: int
    out: str
    err: str

    @property
    def words(self) -> str:
        return " ".join((self.out + " " + self.err).replace("│", " ").split())


def commands_by_words() -> dict[str, Any]:
    """Every verb's command by its words: `calibrate`, `fleet calibrate`."""
    found = {}
    for name, command in typer.main.get_command(build_app()).commands.items():  # type: ignore[attr-defined]
        inner = getattr(command, "commands", None)
        found |= {name: command} if inner is None else {f"{name} {verb}": c for verb, c in inner.items()}
    return found


def run(*arguments: object) -> Ended:
    """`rigwake ARGUMENTS` in this process."""
    out, err = io.StringIO(), io.StringIO()
    code = -1
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as ended:
            code = int(ended.code or 0)
    return Ended(code, out.getvalue(), err.getvalue())


def write_images(folder: Path, *, cameras: tuple[str, ...] = ("front", "left"), lenses: bool = True) -> Path:
    """A folder of four grey images per camera, at 1 Hz."""
    for name in cameras:
        (folder / name).mkdir(parents=True)
        for k in range(4):
            image = np.full((PINHOLE.height_px, PINHOLE.width_px), 90 + 10 * k, np.uint8)
            cv2.imwrite(str(folder / name / f"{START_NS + k * 1_000_000_000}.png"), image)
    if lenses:
        rig = {"cameras": {name: {"camera": camera_to_dict(PINHOLE)} for name in cameras}}
        (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    return folder


def write_trajectories(folder: Path) -> None:
    """rig.tum, port.tum and starboard.tum of a body that turns about all axes."""
    folder.mkdir(parents=True, exist_ok=True)
    t = np.arange(0, 30, 0.1)
    turns = np.stack([0.3 * np.sin(t), 0.2 * np.cos(0.7 * t), 0.8 * np.sin(0.3 * t)], axis=1)
    along = np.stack([2 * np.sin(0.5 * t), np.cos(0.4 * t), 0.2 * np.sin(t)], axis=1)
    body = SE3(SE3.exp(np.concatenate([turns, 0 * along], axis=1)).rotation, along)
    stamps = START_NS + (t * 1e9).astype(np.int64)
    for k, name in enumerate(("rig", "port", "starboard")):
        mounting = SE3.exp(np.array([0.1 * k, 0.2 * k, 0.0, 0.5 * k, 0.1, 0.0]) * (k > 0))
        write_tum(Trajectory(name, stamps, body * mounting), folder / f"{name}.tum")


def write_examples(folder: Path) -> dict[str, Path]:
    """Small files of every kind, by the names that tables of commands use."""
    save_calibration(boat(lens=PINHOLE), folder / "calibration.yaml")
    save_calibration(without_vertical(boat(lens=PINHOLE), "port"), folder / "open.yaml")
    write_images(folder / "images")
    write_images(folder / "unlensed", lenses=False)
    write_trajectories(folder)
    (folder / "empty").mkdir()
    (folder / "text.txt").write_text("hello\n")
    (folder / "nothing.yaml").write_text("")
    (folder / "list.yaml").write_text("[1, 2]\n")
    (folder / "broken.yaml").write_text("a: [1, 2\n")
    (folder / "prior.yaml").write_text("baselines: [{cameras: [front, lefft], distance_m: 1, std_m: 0.1}]\n")
    (folder / "topics.yaml").write_text("camera: {front: /a/b}\n")
    (folder / "nmea.txt").write_text(
        "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\n" * 3
    )
    (folder / "taken").mkdir()
    save_calibration(boat(lens=PINHOLE), folder / "taken" / "calibration.yaml")
    (folder / "corners.csv").write_text("view,id,x,y\n")
    names = {path.stem: path for path in folder.iterdir() if path.suffix != ".tum"}
    return names | {f"{p.stem}_tum": p for p in folder.glob("*.tum")} | {"here": folder}
