"""Tracked pictures: a recording in which nothing moved, the same with a camera turned halfway, and its new mounting."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from rigwake.calibration import Calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.monitor.monitor_page import render_page
from rigwake.monitor.monitor_report import result_to_dict, verdict_line
from rigwake.monitor.recalibration import recalibrate
from rigwake.monitor.rig_motion import rig_motion
from rigwake.monitor.run import MonitorResult, monitor, track_rig
from rigwake.monitor.states import CameraState
from rigwake.monitor.vessel_rig import prepare_rig
from rigwake.readers.open import open_recording
from rigwake.recording import Frame, FrameSource, Recording
from rigwake.rig import Rig, RigCamera
from rigwake.simulation.watch import calibration_of
from rigwake.tracking.hull_picture import HullPicture, mean_picture, spread_frames
from rigwake.tracking.masks import lens_mask, pixel_grid
from rigwake.tracking.self_mask import find_self_mask
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracks import Tracks

pytestmark = pytest.mark.slow
TURN = np.deg2rad(0.5) * np.array([0.6, 0.0, 0.8])


@dataclass(frozen=True, eq=False)
class TurnedFrames:
    """The frames of a camera that turned: from `first` on every picture is what the turned camera would have seen.

    A turn about the optical centre changes a picture without regard to how far things are.
    """

    source: FrameSource
    model: CameraModel
    old_from_new: np.ndarray
    first: int

    def frames(self, indices: Sequence[int] | np.ndarray, *, colour: bool = False) -> Iterator[Frame]:
        bearings, valid = self.model.unproject(pixel_grid(self.model.width_px, self.model.height_px))
        pixels, seen = self.model.project(np.nan_to_num(bearings, nan=1.0) @ self.old_from_new.T)
        shown = np.where((valid & seen)[:, None], pixels, -100.0).astype(np.float32)
        maps = shown.reshape(self.model.height_px, self.model.width_px, 2)
        for frame in self.source.frames(indices, colour=colour):
            if frame.index < self.first:
                yield frame
            else:
                yield replace(frame, image=cv2.remap(frame.image, maps, None, cv2.INTER_LANCZOS4))


def true_calibration(folder: Path, recording: Recording) -> Calibration:
    """The true rig, in the IMU's frame, that claims 0.02 deg and 2 cm."""
    truth = yaml.safe_load((folder / "truth.yaml").read_text())

    def transform(content: dict[str, list[float]]) -> SE3:
        return SE3.from_quat_wxyz(np.array(content["quat_wxyz"]), np.array(content["translation_m"]))

    imu_from_base = transform(truth["imu"]["base_from_imu"]).inverse()
    antenna = imu_from_base * np.array(truth["gnss"]["antenna_lever_arm_base_m"])
    cameras = {
        name: RigCamera(
            name,
            imu_from_base * transform(c["base_from_cam"]),
            recording.cameras[name].model,
            c["time_offset_s"],
        )
        for name, c in truth["cameras"].items()
    }
    return calibration_of(Rig("imu", cameras, tuple(antenna)), std_deg=0.02, std_m=0.02)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Harbour:
    recording: Recording
    calibration: Calibration
    tracks: dict[str, Tracks]


@pytest.fixture(scope="module")
def harbour(real_recordings: Path) -> Harbour:
    folder = real_recordings / "harbour_a"
    recording = open_recording(folder / "harbour_a.bag")
    calibration = true_calibration(folder, recording)
    rig = prepare_rig(calibration, recording)
    motion = rig_motion(rig.imu, rig.gnss, calibration.antenna_rig)
    return Harbour(recording, calibration, track_rig(rig, motion, TrackingOptions()))


def turned(
    harbour: Harbour, camera: str, turn: np.ndarray, first: int
) -> tuple[Recording, dict[str, Tracks]]:
    """The recording with one camera turned from a frame on, and its tracks."""
    stream = harbour.recording.cameras[camera]
    mounted = harbour.calibration.cameras[camera].rig_from_cam.rotation
    assert stream.model is not None
    source = TurnedFrames(stream.source, stream.model, mounted.T @ so3.exp(turn) @ mounted, first)
    changed = replace(
        harbour.recording, cameras={**harbour.recording.cameras, camera: replace(stream, source=source)}
    )
    rig = prepare_rig(harbour.calibration, changed)
    alone = replace(rig, streams={camera: rig.streams[camera]})
    motion = rig_motion(rig.imu, rig.gnss, harbour.calibration.antenna_rig)
    return changed, {**harbour.tracks, **track_rig(alone, motion, TrackingOptions())}


def test_nothing_moved(harbour: Harbour) -> None:
    result = monitor(harbour.calibration, harbour.recording, tracks=harbour.tracks)
    assert {v.state for v in result.verdicts.values()} == {CameraState.OK}
    assert result.exit_code == 0
    assert np.rad2deg(np.abs(result.judgement.step)).max() < 0.06  # against the truth, by ten seconds each


def test_a_camera_turned_halfway(harbour: Harbour) -> None:
    """Half a degree about an oblique axis after 20 s: found, when, how much, with pictures before and after."""
    turn = TURN
    first = int(
        np.searchsorted(
            harbour.recording.cameras["left"].timestamps_ns,
            harbour.recording.cameras["left"].timestamps_ns[0] + 20_000_000_000,
        )
    )
    changed, tracks = turned(harbour, "left", turn, first)
    stream = harbour.recording.cameras["left"]
    picture, region = (
        mean_picture(stream, spread_frames(np.arange(first))),
        find_self_mask(stream, lens_mask(stream).usable),
    )
    assert picture is not None
    hull = {"left": HullPicture(picture, region, "of the first half")}
    result = monitor(harbour.calibration, changed, tracks=tracks, hull=hull)
    rotation = result.hull["left"].rotation
    assert result.hull["left"].moved
    assert rotation is not None
    assert np.rad2deg(np.linalg.norm(rotation - turn)) < 0.03
    assert any("own hull" in note for note in result.notes)
    _check_verdict(result, turn, int(changed.cameras["left"].timestamps_ns[first]))
    page = render_page(result, changed)
    assert "before: horizon" in page
    assert "after: mean" in page
    assert page.count("data:image/jpeg") == 4


def test_a_camera_turned_before_the_recording_is_recalibrated(harbour: Harbour) -> None:
    """Its new mounting from 40 s; all others as they were, to the bit."""
    turn = TURN
    changed, tracks = turned(harbour, "left", turn, 0)
    result = monitor(harbour.calibration, changed, tracks=tracks)
    assert result.blamed == ("left",)
    found = recalibrate(harbour.calibration, result)
    assert found.camera == "left"
    old, new = (
        harbour.calibration.cameras["left"].rig_from_cam,
        found.calibration.cameras["left"].rig_from_cam,
    )
    error = so3.log(so3.exp(-turn) @ new.rotation @ old.rotation.T)
    assert np.rad2deg(np.linalg.norm(error)) < 0.03
    for name in ("front", "back", "right"):
        before, after = harbour.calibration.cameras[name], found.calibration.cameras[name]
        assert before.rig_from_cam.rotation.tobytes() == after.rig_from_cam.rotation.tobytes()
        assert before.rig_from_cam.translation.tobytes() == after.rig_from_cam.translation.tobytes()
        assert before.covariance.tobytes() == after.covariance.tobytes()


def _check_verdict(result: MonitorResult, turn: np.ndarray, since_ns: int) -> None:
    assert result.blamed == ("left",)
    assert result.exit_code == 5
    verdict = result.verdicts["left"]
    assert verdict.rotation is not None
    assert verdict.size_deg is not None
    assert verdict.since_ns is not None
    assert abs(verdict.size_deg - 0.5) < 0.05
    assert np.rad2deg(np.linalg.norm(verdict.rotation - turn)) < 0.05
    assert abs(verdict.since_ns - since_ns) <= 10e9
    assert "DRIFTED" in verdict_line(verdict, "rigwake recalibrate ..")
    assert result_to_dict(result)["cameras"]["left"]["kind"] == "step"
