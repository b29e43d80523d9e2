"""Everything at once on pictures: black and repeated frames, an outage, gaps of IMU and GNSS, a vessel that crosses."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rigwake.evaluation.trajectory_errors import absolute_error
from rigwake.odometry.camera_odometry import run_camera
from rigwake.readers.open import open_recording
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import Frame

BLACK, REPEATED, OUTAGE, VESSEL = (60, 64), 90, range(150, 180), range(300, 340)


class Suffering:
    """Frames of a camera, with some of them spoilt and a painted vessel that passes."""

    def __init__(self, stream) -> None:
        self.stream = stream
        self.kept = np.array([k for k in range(len(stream)) if k not in OUTAGE])
        texture = np.random.default_rng(5).integers(0, 255, (6, 18)).astype(np.uint8)
        self.vessel = cv2.resize(texture, (90, 30), interpolation=cv2.INTER_NEAREST)

    def frames(self, indices, *, colour=False):
        wanted = self.kept[np.asarray(indices)]
        shown = np.where(wanted == REPEATED, REPEATED - 1, wanted)
        for index, original, frame in zip(indices, wanted, self.stream.frames(shown), strict=True):
            image = frame.image.copy()
            if original in BLACK:
                image[:] = 0
            if original in VESSEL:
                left = 120 + 9 * (int(original) - VESSEL.start)
                image[205:235, left : left + 90] = self.vessel
            yield Frame(int(index), int(self.stream.timestamps_ns[original]), image)


def without(stream, *spans_s):
    """A sensor's samples outside the spans, in seconds from its first."""
    seconds = (stream.timestamps_ns - stream.timestamps_ns[0]) * 1e-9
    kept = np.all([(seconds < a) | (seconds > b) for a, b in spans_s], axis=0)
    arrays = {
        name: value[kept]
        for name, value in vars(stream).items()
        if isinstance(value, np.ndarray) and len(value) == len(kept)
    }
    return replace(stream, **arrays)


@pytest.mark.slow
def test_a_recording_full_of_holes_keeps_its_path_and_says_what_was_missing(real_recordings):
    recording = open_recording(real_recordings / "harbour_a" / "harbour_a.bag")
    whole = recording.camera("right")
    source = Suffering(whole)
    stream = replace(whole, timestamps_ns=whole.timestamps_ns[source.kept], source=source)
    imu = without(next(iter(recording.imus.values())), (10.0, 10.3), (25.0, 25.2))
    gnss = without(next(iter(recording.gnss.values())), (20.0, 22.0))
    result = run_camera(stream, imu, gnss)
    truth = read_trajectory(real_recordings / "harbour_a" / "truth_cam_right.tum").trajectory
    truth = replace(truth, timestamps_ns=whole.timestamps_ns)
    error = absolute_error(truth, result.trajectory, alignment="se3")
    said = "\n".join(result.notes)
    print(
        f"ATE {error.rmse_m:.3f} m, {error.rotation_rmse_deg:.3f} deg, {len(result.trajectory)} poses\n{said}"
    )
    assert error.rmse_m < 0.05
    assert error.rotation_rmse_deg < 0.2
    assert len(result.trajectory) == len(stream)
    for words in (
        "2 black or empty frames bridged",
        "1 repeated frame bridged",
        "1 gap in the images bridged, the longest of 3.1 s",
        "2 gaps in the IMU samples bridged, the longest of 0.3 s",
        "1 gap in the GNSS fixes bridged",
    ):
        assert words in said
    assert result.visual is not None
    on_vessel = np.isin(result.tracks.frame_indices, [k - len(OUTAGE) for k in VESSEL])
    left = 120 + 9 * (result.tracks.frame_indices + len(OUTAGE) - VESSEL.start)
    x, y = result.tracks.pixels.T
    on_vessel &= (x > left + 5) & (x < left + 85) & (y > 210) & (y < 230)
    assert (result.visual.inliers & on_vessel).sum() < 0.02 * result.visual.inliers.sum()
    print(
        f"on the vessel: {on_vessel.sum()} observations, {(result.visual.inliers & on_vessel).sum()} inliers"
    )
