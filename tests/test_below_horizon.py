"""Water or ground below the horizon: real pictures of a road, and the same with waves in place of the road."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigwake.odometry.below_horizon import BelowHorizon, look_below_horizon
from rigwake.readers.open import open_recording
from rigwake.recording import CameraStream, Frame, FrameSource


@dataclass(frozen=True, eq=False)
class OnWaves:
    """The frames of another source with a texture that is new in every image below row `row`."""

    source: FrameSource
    row: int

    def frames(self, indices: Sequence[int], *, colour: bool = False) -> Iterator[Frame]:
        for frame in self.source.frames(indices, colour=colour):
            image = frame.image.copy()
            noise = np.random.default_rng(frame.index).uniform(0, 255, image[self.row :].shape)
            image[self.row :] = cv2.GaussianBlur(noise, (0, 0), 2.0).astype(np.uint8)
            yield replace(frame, image=image)


@pytest.fixture
def road(real_recordings: Path) -> CameraStream:
    return next(iter(open_recording(real_recordings / "kitti_00_stereo_20").cameras.values()))


def below(stream: CameraStream) -> BelowHorizon:
    usable = np.ones((stream.height_px, stream.width_px), dtype=bool)
    return look_below_horizon(stream, np.tile([0.0, -1.0, 0.0], (len(stream), 1)), usable)


def test_a_road_is_used(road: CameraStream) -> None:
    found = below(road)
    assert found.is_rigid
    assert "ground" in found.words


def test_waves_are_left_out(road: CameraStream) -> None:
    assert road.model is not None
    found = below(replace(road, source=OnWaves(road.source, round(road.model.params[3]))))
    assert not found.is_rigid
    assert "water" in found.words


def test_a_camera_that_sees_no_horizon_uses_all_of_the_image(road: CameraStream) -> None:
    usable = np.ones((road.height_px, road.width_px), dtype=bool)
    looking_down = np.tile([0.0, -0.5, -np.sqrt(0.75)], (len(road), 1))
    found = look_below_horizon(road, looking_down, usable)
    assert found.view[1] < 0.05
    assert found.is_rigid


def test_what_cannot_be_told_is_left_out() -> None:
    assert not BelowHorizon((900, 900), (50, 800), (50, 780), (0.5, 0.4)).is_rigid
    assert not BelowHorizon((0, 0), (0, 0), (0, 0), (0.0, 1.0)).is_rigid
