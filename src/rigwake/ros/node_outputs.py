"""What the node publishes of a calibration and of the monitor's verdicts."""

from __future__ import annotations

from typing import Any

import numpy as np

from rigwake.calibration import Calibration
from rigwake.ros.transport import NodeStatus, StatusLevel

_STATE_LEVELS = {"OK": StatusLevel.OK, "DRIFTED": StatusLevel.ERROR}


def static_edges(calibration: Calibration, child_frame: str) -> dict[tuple[str, str], Any]:
    """`rig_from_cam` by (reference, camera's frame), of the cameras of which all is known."""
    return {
        (calibration.reference, child_frame.replace("{name}", name)): camera.rig_from_cam
        for name, camera in calibration.cameras.items()
        if np.isfinite(camera.rig_from_cam.matrix).all()
    }


def camera_states(answer: dict[str, Any]) -> list[NodeStatus]:
    """What `rigwake monitor --json` says of every camera."""
    entries = []
    for name, verdict in answer["cameras"].items():
        state = str(verdict["state"])
        level = _STATE_LEVELS.get(state, StatusLevel.WARN)
        entries.append(NodeStatus(f"camera {name}", level, f"{state}: {verdict['words']}", {"state": state}))
    return entries
