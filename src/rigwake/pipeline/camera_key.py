"""What the stage of one camera depends on, as one short key: another key, and the stage is computed again."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from rigwake import __version__
from rigwake.cameras.registry import camera_to_dict
from rigwake.config import CalibrateConfig
from rigwake.pipeline.camera_stage import CameraOutcome
from rigwake.pipeline.stage_files import stage_key
from rigwake.recording import CameraStream, ImuStream

# of the settings, those of later stages; everything else may change what is tracked
_LATER = {"reference", "cameras", "jobs", "time_offsets", "gnss", "line_delay_s", "estimate_line_delay"}
_LATER |= {"adjustment", "association", "intrinsics", "fov_deg", "min_duration_s"}
# the sections that were chosen count by their stamps
_LATER |= {"use_all", "precision", "budget_s"}


def camera_key(
    stream: CameraStream,
    imu: ImuStream | None,
    config: CalibrateConfig,
    odometry: bool,
    identity: Mapping[str, Any],
    changed_at: str,
) -> str:
    """Key of everything that mask, tracks and odometry of a camera are made from.

    identity: of the recording's content; changed_at: of its files' times, which counts where the content was only
    sampled. The camera and the IMU count by their values (topic, stamps, lens, samples), so that whatever chose
    them - topic maps, files of lenses, a stretch of time - counts too. What is known beforehand of the rig and
    trajectories of another odometry serve later stages, which are always computed.
    """
    return stage_key(
        {key: value for key, value in identity.items() if key != "path"},
        changed_at if "hashed_bytes" in identity else "",
        {
            "name": stream.name,
            "topic": stream.topic,
            "frame_id": stream.frame_id,
            "size": [stream.width_px, stream.height_px],
            "stamps": _values(stream.timestamps_ns),
            "lens": None if stream.model is None else _values(camera_to_dict(stream.model)),
        },
        _values(imu),
        config.model_dump(mode="json", exclude=_LATER),
        odometry,
        # what another version left may lack what this one reads
        [__version__, *(part.name for part in fields(CameraOutcome))],
    )


def _values(value: Any) -> Any:
    """Plain values that tell whether anything differs; arrays by their hash."""
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        return [str(array.dtype), list(array.shape), hashlib.sha256(array.tobytes()).hexdigest()]
    if is_dataclass(value):
        return {part.name: _values(getattr(value, part.name)) for part in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _values(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_values(inner) for inner in value]
    return value.item() if isinstance(value, np.generic) else value
