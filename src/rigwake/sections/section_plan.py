"""From a recording to the sections that are worth calibrating from, without tracking anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from rigwake._progress import CountProgress
from rigwake._types import Array, Image, Indices
from rigwake.ba.rig.rig_values import AdjustmentOptions
from rigwake.errors import UnobservableError
from rigwake.excerpt import camera_between, gnss_between
from rigwake.odometry.imu_alignment import with_noise
from rigwake.plausibility.imu_samples import vet_samples
from rigwake.recording import CameraStream, GnssStream, ImuStream
from rigwake.sections.calibration_cost import CalibrationCost, fixed_cost, machine_speed, stretch_costs
from rigwake.sections.expected_motion import expected_motion
from rigwake.sections.predicted_problem import ForecastSensors, TrackingForecast
from rigwake.sections.section_choice import Precision, SectionChoice, choose_sections, tells_no_place
from rigwake.sections.stretch_information import StretchInformation, stretch_information, stretch_spans

STRETCH_S = 8.0
USE_ALL_BELOW_S = 121.0  # two minutes, the length that is asked for elsewhere
DEFAULT_BUDGET_S = 300.0
_CORNERS = 60  # in a small picture: as many as are worth following
_SMALL_PX = 320
_BORDER_NS = 1_000_000  # spans end just before the next begins


@dataclass(frozen=True)
class SectionWish:
    """What was asked for. everything: use all. budget_s: CPU-seconds, None for `DEFAULT_BUDGET_S` where the recording
    is long. precision: None for as much as is worth it."""

    everything: bool = False
    precision: Precision | None = None
    budget_s: float | None = None

    @property
    def is_default(self) -> bool:
        """Whether nothing in particular was asked for."""
        return not self.everything and self.precision is None and self.budget_s is None


@dataclass(frozen=True, eq=False)
class SectionPlan:
    """information: by stretch; choice: what to use; cost: of that, whole_cost: of everything. is_all: nothing is left
    out."""

    information: StretchInformation
    choice: SectionChoice
    cost: CalibrationCost
    whole_cost: CalibrationCost
    texture: Array

    @property
    def is_all(self) -> bool:
        """Whether nothing is left out."""
        return len(self.choice.stretches) == len(self.information)


def plan_sections(
    cameras: Mapping[str, CameraStream],
    imu: ImuStream | None,
    gnss: GnssStream | None,
    wish: SectionWish,
    adjustment: AdjustmentOptions,
    progress: CountProgress = lambda words, done, total: None,
) -> SectionPlan | None:
    """Predict what each stretch tells, and choose. None where neither an IMU nor a receiver tells how the rig moved.

    One picture per stretch and camera is looked at, for whether it shows anything. Raises UnobservableError where even
    the whole recording tells nothing of any camera.
    """
    models = {name: c.model for name, c in cameras.items() if c.model is not None and len(c)}
    if imu is not None:
        imu = with_noise(vet_samples(imu).imu)
    motion = expected_motion(imu, gnss)
    if motion is None or not models:
        return None
    begin = max(
        min(int(cameras[n].timestamps_ns[0]) for n in models), int(motion.world_from_rig.timestamps_ns[0])
    )
    end = min(
        max(int(cameras[n].timestamps_ns[-1]) for n in models), int(motion.world_from_rig.timestamps_ns[-1])
    )
    if end - begin < STRETCH_S * 0.5e9:
        return None
    spans = stretch_spans(begin, end, STRETCH_S)
    rate_hz = adjustment.state_rate_without_imu_hz if imu is None else adjustment.state_rate_hz
    sensors = ForecastSensors(models, imu, gnss, rate_hz)
    forecast = TrackingForecast(
        tracks_per_second=adjustment.tracks_per_second,
        across_cameras=TrackingForecast.across_cameras if adjustment.cross_camera else 0.0,
    )
    texture = texture_over_time({n: cameras[n] for n in models}, spans, progress)
    information = stretch_information(
        motion, sensors, forecast, spans, texture, lambda done, total: progress("predicting", done, total)
    )
    if tells_no_place(information):
        raise UnobservableError(
            "The vessel hardly turns in this recording: no camera's place could be told.",
            consequence="Not a picture was tracked.",
            remedy="Record turns to both sides, a figure of eight is best; see `rigwake inspect`.",
        )
    fixed, costs = fixed_cost(cameras, across_cameras=adjustment.cross_camera), stretch_costs(cameras, spans)
    long_enough = (end - begin) * 1e-9 > USE_ALL_BELOW_S
    budget = wish.budget_s if wish.budget_s is not None else DEFAULT_BUDGET_S
    choice = choose_sections(
        information,
        costs,
        precision=wish.precision,
        budget=max(budget - fixed, 0.0) if long_enough or wish.budget_s is not None else None,
        in_one_piece=gnss is None,
        use_all="as asked"
        if wish.everything
        else ("it is short" if wish.is_default and not long_enough else ""),
    )
    speed = machine_speed()
    cost = CalibrationCost(fixed, float(costs[choice.stretches].sum()), speed)
    return SectionPlan(information, choice, cost, CalibrationCost(fixed, float(costs.sum()), speed), texture)


def texture_over_time(
    cameras: Mapping[str, CameraStream],
    spans_ns: Indices,
    progress: CountProgress = lambda words, done, total: None,
) -> Array:
    """(S, C) how much a picture in the middle of each stretch shows to follow, 0 to 1; 1 where no picture can be read
    anywhere, and 0 in stretches without frames."""
    found = np.ones((len(spans_ns), len(cameras)))
    for column, (name, camera) in enumerate(cameras.items()):
        bounds = np.searchsorted(camera.timestamps_ns, spans_ns)
        has_frames = bounds[:, 1] > bounds[:, 0]
        rows, middles = np.flatnonzero(has_frames), bounds.mean(axis=1).astype(np.int64)[has_frames]
        row_of = dict(zip(middles.tolist(), rows.tolist(), strict=True))
        counts: dict[int, float] = {}
        for frame in camera.frames(middles):
            counts[row_of[frame.index]] = _texture(frame.image)
            progress(f"looking at {name}", len(counts), len(rows))
        found[:, column] = [counts.get(row, 0.0 if counts else 1.0) for row in range(len(spans_ns))]
        found[~has_frames, column] = 0.0
    return found


def _texture(image: Image) -> float:
    scale = min(1.0, _SMALL_PX / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if float(np.ptp(small)) < 8:
        return 0.0
    strength = cv2.cornerMinEigenVal(small, 5)
    corners = cv2.goodFeaturesToTrack(small, _CORNERS, 0.01, 8, mask=(strength > 1e-4).astype(np.uint8))
    return 0.0 if corners is None else min(len(corners) / _CORNERS, 1.0)


def cut_to_sections(
    plan: SectionPlan, cameras: Mapping[str, CameraStream], gnss: GnssStream | None
) -> tuple[dict[str, CameraStream], GnssStream | None]:
    """Frames and fixes of the chosen sections alone; nothing else is ever decoded. Inertial samples stay: they cost
    nothing, and biases are tied from one section to the next."""
    if plan.is_all:
        return dict(cameras), gnss
    spans = [(begin, end - _BORDER_NS) for begin, end in plan.choice.sections_ns]
    cut = {name: camera_between(camera, spans) for name, camera in cameras.items()}
    return (
        {name: camera for name, camera in cut.items() if len(camera)},
        None if gnss is None else gnss_between(gnss, *spans),
    )
