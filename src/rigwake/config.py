"""Settings of a calibration: one frozen tree, from defaults, a YAML file and `--set a.b=c`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from rigwake.ba.rig.intrinsics_refinement import IntrinsicsChoice
from rigwake.ba.rig.rig_values import AdjustmentOptions
from rigwake.ba.rig.search_proposals import AssociationOptions
from rigwake.errors import InputError, UsageError
from rigwake.odometry.below_horizon import HorizonChoice
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.sections.section_words import parse_precision
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.yaml_input import parse_yaml, read_yaml_settings


class ImuNoiseSettings(BaseModel):
    """Noise densities of the IMU (rad/s/sqrt(Hz), m/s^2/sqrt(Hz)) and random walks of its biases.

    None: as the recording says, else typical of a middle-class MEMS sensor.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    gyro_noise_density: float | None = Field(default=None, gt=0)
    accel_noise_density: float | None = Field(default=None, gt=0)
    gyro_bias_walk: float | None = Field(default=None, gt=0)
    accel_bias_walk: float | None = Field(default=None, gt=0)


class CalibrateConfig(BaseModel):
    """Everything that can be chosen about `rigwake calibrate`.

    reference: `imu`, `base_link`, a camera's name, or `auto` (the IMU, else the reference camera).
    cameras: which to calibrate (all by default). start_s, duration_s: the part of the recording to use.
    stretch_s: track in stretches of so many seconds, which a cluster works on side by side (whole by default).
    jobs: processes (0: as many as there are cores). seed: of everything random.
    time_offsets: estimate the cameras' clocks. imu, gnss: whether to use them.
    sensor_checks: compare every sensor with the others; repair: correct units, leave out samples that cannot be right.
    horizon: leave out what lies below the horizon (needs an IMU): on, off, or auto (where it is water).
    intrinsics: fixed (as given), refine (with the rig, about what was given), or find (from the motion, whatever was
    given). fov_deg: full fields of view by camera (`all`: of the others), degrees, for find.
    use_all: use all of the recording; precision: else enough of it for these predicted sigmas of every camera (`5mm`,
    `0.02deg` or both); budget_s: CPU-seconds that it may take.
    line_delay_s: read-out time per row of rolling shutters, by camera; estimate_line_delay: refine it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    reference: str = "auto"
    cameras: tuple[str, ...] = ()
    start_s: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    duration_s: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    stretch_s: float | None = Field(default=None, ge=10, allow_inf_nan=False)
    min_duration_s: float = Field(default=15.0, gt=0, allow_inf_nan=False)
    jobs: int = Field(default=0, ge=0)
    seed: int = 0
    time_offsets: bool = True
    use_all: bool = False
    precision: str | None = None
    budget_s: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    imu: bool = True
    gnss: bool = True
    find_self_mask: bool = True
    sensor_checks: bool = True
    repair: bool = True
    horizon: HorizonChoice = "auto"
    intrinsics: IntrinsicsChoice = "refine"
    fov_deg: dict[str, Annotated[float, Field(gt=0, lt=360, allow_inf_nan=False)]] = Field(
        default_factory=dict
    )
    line_delay_s: dict[str, float] = Field(default_factory=dict)
    estimate_line_delay: bool = False
    imu_noise: ImuNoiseSettings = ImuNoiseSettings()
    tracking: TrackingOptions = TrackingOptions()
    # the rig bundle adjustment follows, so the odometry of a camera need not be perfect
    odometry: OdometryOptions = OdometryOptions(
        adjust_all_frames=False, keyframe_interval_s=0.8, global_growth=2.0
    )
    adjustment: AdjustmentOptions = AdjustmentOptions()
    association: AssociationOptions = AssociationOptions()

    @field_validator("precision")
    @classmethod
    def _is_precision(cls, given: str | None) -> str | None:
        if given is not None:
            parse_precision(given)
        return given


def load_config(file: Path | None = None, assignments: Sequence[str] = (), **options: Any) -> CalibrateConfig:
    """Settings from a YAML file, then `a.b=c` assignments, then options that are not None.

    Values of assignments are YAML (`cameras=[front, port]`). Raises UsageError naming the key that is wrong.
    """
    tree: dict[str, Any] = dict(read_yaml_settings(file)) if file is not None else {}
    for assignment in assignments:
        key, separator, value = assignment.partition("=")
        if not separator:
            raise UsageError(
                f"--set {assignment!r} is not KEY=VALUE.", remedy="Example: --set tracking.max_features=300"
            )
        try:
            parsed = parse_yaml(value, "the value")
        except InputError as error:
            raise UsageError(f"--set {assignment!r}: the value is not YAML.") from error
        _put(tree, key.strip().split("."), parsed, assignment)
    tree.update({key: value for key, value in options.items() if value is not None})
    try:
        return CalibrateConfig.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise UsageError(
            f"Setting {where}: {first['msg']}.",
            remedy="`rigwake calibrate --print-config` shows all settings with their defaults.",
        ) from error


def _put(tree: dict[str, Any], path: list[str], value: Any, assignment: str) -> None:
    for part in path[:-1]:
        inner = tree.setdefault(part, {})
        if not isinstance(inner, dict):
            raise UsageError(f"--set {assignment!r}: {part} is no group of settings.")
        tree = inner
    tree[path[-1]] = value
