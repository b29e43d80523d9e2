"""The `Rig` value: which cameras there are and where they sit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rigwake.cameras.protocol import CameraModel
from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3


@dataclass(frozen=True, eq=False)
class RigCamera:
    """One camera of a rig.

    rig_from_cam: maps the camera's optical frame to the rig frame.
    model: its lens, if known.
    time_offset_s: `t_rig = t_cam + time_offset_s`.
    topic: where a recording holds its images, if known.
    """

    name: str
    rig_from_cam: SE3
    model: CameraModel | None = None
    time_offset_s: float = 0.0
    topic: str = ""


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras fixed to one body.

    reference: the name of the frame called `rig` (`imu`, `base_link`, or a camera's name).
    cameras: by name. antenna_rig: (3,) position of the GNSS antenna in the rig frame, if known.
    rig_from_imu: where the IMU sits, if known.
    """

    reference: str
    cameras: Mapping[str, RigCamera] = field(default_factory=dict)
    antenna_rig: tuple[float, float, float] | None = None
    rig_from_imu: SE3 | None = None

    def camera(self, name: str) -> RigCamera:
        """The camera of this name; UsageError lists what is there."""
        if name not in self.cameras:
            raise UsageError(f"No camera {name!r} in this rig.", remedy=f"It has: {', '.join(self.cameras)}.")
        return self.cameras[name]
