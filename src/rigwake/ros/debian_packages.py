"""Debian's ROS packages for the interpreter that runs rigwake."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

from rigwake.errors import HostError

DIST_PACKAGES = Path("/usr/lib/python3/dist-packages")
NEEDED = ("rospy", "rosgraph", "tf2_msgs", "std_srvs", "diagnostic_msgs", "geometry_msgs", "sensor_msgs")


def provide_rospy() -> None:
    """Make `rospy` and its messages importable. Raises HostError with what to install.

    Debian's folder is appended: packages of rigwake's own environment (numpy, yaml) keep their place.
    """
    if _missing() and DIST_PACKAGES.is_dir() and str(DIST_PACKAGES) not in sys.path:
        sys.path.append(str(DIST_PACKAGES))
    missing = _missing()
    if missing:
        raise HostError(
            f"ROS 1 is not installed: {', '.join(missing)} not found.",
            consequence="The node cannot run; everything else of rigwake can.",
            remedy="On Debian and Ubuntu: apt-get install python3-rospy python3-tf2-msgs python3-std-srvs "
            "python3-diagnostic-msgs python3-geometry-msgs python3-sensor-msgs; or source the setup.bash of ROS.",
        )


def _missing() -> list[str]:
    return [name for name in NEEDED if importlib.util.find_spec(name) is None]
