"""rigwake: calibrate a camera rig from the wake it leaves.

import rigwake

calibration = rigwake.calibrate("sail.bag", "OUT")
calibration.camera("front").rig_from_cam.translation
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigwake.kernel_cache import provide_kernel_cache

if TYPE_CHECKING:
    from rigwake.calibration import Calibration

__version__ = "0.1.0"
__all__ = ["__version__", "calibrate", "load_calibration"]

provide_kernel_cache()  # before any module with compiled loops is imported


def calibrate(
    recording: Path | str,
    out: Path | str = "rigwake-out",
    *,
    force: bool = False,
    resume: bool = False,
    **settings: Any,
) -> Calibration:
    """Find where every camera of a recording sits and looks; what `rigwake calibrate` does.

    out: folder for the result and what its stages leave; one that holds another result is refused unless `force`
    (replace it) or `resume` (keep its finished stages). settings: fields of `rigwake.config.CalibrateConfig`
    (`reference="front"`, `duration_s=60`). Cameras that failed are named in `checks["failed_cameras"]`.
    Raises the errors of `rigwake.errors`, UnobservableError when the motion cannot tell.
    """
    from rigwake.config import load_config
    from rigwake.pipeline.calibration_run import calibrate as run

    return run(recording, out, load_config(**settings), force=force, resume=resume).calibration


def load_calibration(path: Path | str) -> Calibration:
    """Read a `calibration.yaml`."""
    from rigwake.calibration import load_calibration as load

    return load(path)
