"""`rigwake calibrate` on images that show nothing: grey walls, a camera with its cap on."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rigwake.calibration import load_calibration
from rigwake.evaluation.rig_errors import evaluate_calibration
from rigwake.readers.truth_files import rig_in_frame
from rigwake.recording import Frame, FrameSource, Recording
from rigwake.simulation.record import build_world, render_recording
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.setup import Simulation, build_recording, prepare
from rigwake.writers.write import write_recording

SIZE = (420, 315)
LENS = {
    "fx": 132.2,
    "fy": 132.2,
    "cx": 210.9,
    "cy": 156.3,
    "k1": -0.011,
    "k2": 0.006,
    "k3": -0.0034,
    "k4": 0.0005,
}
CAP_ON, FOG = 2.0, 120.0


@dataclass(frozen=True, eq=False)
class Blank:
    """Images of one grey level and the noise of a sensor."""

    level: float
    stamps: NDArray[np.int64]

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for index in indices:
            noise = np.random.default_rng(int(index)).normal(self.level, 1.2, (SIZE[1], SIZE[0]))
            image = np.clip(np.rint(noise), 0, 255).astype(np.uint8)
            yield Frame(
                int(index), int(self.stamps[index]), np.repeat(image[..., None], 3, 2) if colour else image
            )


def simulation() -> Simulation:
    """The demo with two small cameras, 20 s at 5 Hz."""
    document = load_scenario("demo").model_dump()
    document["duration_s"] = 20.0
    document["cameras"] = [
        c | {"width_px": SIZE[0], "height_px": SIZE[1], "params": LENS, "rate_hz": 5.0}
        for c in document["cameras"]
        if c["name"] in ("front", "left")
    ]
    return prepare(build_scenario(document, "test"))


def blanks(simulated: Simulation, level: float) -> dict[str, FrameSource]:
    return {c.name: Blank(level, simulated.camera_stamps(c)) for c in simulated.scenario.cameras}


def calibrate(recording: Recording, folder: Path) -> tuple[int, str]:
    """Exit code of the command, and what it said."""
    bag = folder / "rec.bag"
    write_recording(recording, bag)
    command = [sys.executable, "-c", "from rigwake.cli.main import main; main()"]
    done = subprocess.run(
        [*command, "calibrate", str(bag), "-o", str(folder / "out"), "--jobs", "1"],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, " ".join((done.stdout + done.stderr).replace("│", " ").split())


@pytest.mark.slow
def test_images_without_texture_are_refused_without_numbers(tmp_path: Path) -> None:
    simulated = simulation()
    recording = build_recording(simulated, blanks(simulated, FOG), tmp_path)
    exit_code, output = calibrate(recording, tmp_path)
    assert exit_code == 3, output
    assert "texture" in output
    assert "front" in output
    assert not (tmp_path / "out" / "calibration.yaml").exists()


@pytest.mark.slow
def test_a_camera_with_its_cap_on_is_named_and_the_other_calibrated(tmp_path: Path) -> None:
    simulated = simulation()
    only_front = replace(
        simulated,
        scenario=simulated.scenario.model_copy(
            update={"cameras": tuple(c for c in simulated.scenario.cameras if c.name == "front")}
        ),
    )
    _, renderer = build_world(simulated)
    seen = render_recording(only_front, renderer, tmp_path / "work", workers=2, progress=lambda *_: None)
    sources = blanks(simulated, CAP_ON) | {"front": seen.cameras["front"].source}
    exit_code, output = calibrate(build_recording(simulated, sources, tmp_path), tmp_path)
    assert exit_code == 4, output
    assert "1 of 2 cameras is not calibrated: left" in output
    assert "--allow-partial" in output
    found = load_calibration(tmp_path / "out" / "calibration.yaml")
    assert set(found.cameras) == {"front"}
    assert "left" in found.checks["failed_cameras"]
    assert "left" in output
    truth = rig_in_frame(simulated.rig, found.reference)
    errors = evaluate_calibration(found, truth).cameras["front"]
    assert errors.rotation_error_deg < 0.1
    assert np.abs(errors.translation_error_m).max() < 0.05
