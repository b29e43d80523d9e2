"""An intrinsic calibration as plain values, for the camera file and for JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rigwake.atomic import write_text_atomic
from rigwake.cameras.formats.camera_files import HEADER
from rigwake.cameras.registry import camera_to_dict
from rigwake.intrinsics.board_calibration import IntrinsicCalibration
from rigwake.intrinsics.select import ModelScore


def calibration_to_dict(
    result: IntrinsicCalibration, unused: Sequence[tuple[str, str]] = (), scores: Sequence[ModelScore] = ()
) -> dict[str, Any]:
    """The camera, and under `calibration` how well it is known; null stands for what was unobservable."""
    calibration: dict[str, Any] = {
        "rms_px": round(result.rms_px, 6),
        "sigma_px": round(result.sigma_px, 6),
        "views": len(result.view_names),
        "corners": int(result.corners.used.sum()),
        "dropped_corners": result.dropped_corners,
        "dropped_views": dict(result.dropped_views),
        "unused_images": dict(unused),
        "max_observed_angle_deg": round(float(np.rad2deg(result.max_observed_angle)), 3),
        "std": {name: _finite(std) for name, std in result.stds.items()},
        "fixed": list(result.fixed),
        "undetermined": list(result.unobservable),
        "converged": result.converged,
        "covariance": [[_finite(value) for value in row] for row in result.covariance.tolist()],
    }
    if scores:
        calibration["cross_validation"] = [
            {
                "model": score.model,
                "held_out_px": _finite(score.held_out_px),
                "std_error_px": _finite(score.std_error_px),
                "failure": score.failure or None,
            }
            for score in scores
        ]
    return {**camera_to_dict(result.camera), "calibration": calibration}


def save_intrinsics(path: Path, contents: Mapping[str, dict[str, Any]]) -> None:
    """Write the camera file of the calibrated cameras, by name, atomically."""
    body = yaml.safe_dump(
        {"cameras": dict(contents)}, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
    )
    write_text_atomic(path, HEADER + body)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
