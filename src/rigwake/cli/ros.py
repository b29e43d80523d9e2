"""On board: a ROS node that records, calibrates and watches.

Example: [cyan]rigwake ros node --out /data/rigwake[/cyan]
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rigwake.cli.console import err
from rigwake.cli.options import require_number, require_there, require_writable
from rigwake.errors import UsageError

if TYPE_CHECKING:
    from rigwake.ros.transport import Transport

_STEP_S = 0.1


def node(
    remappings: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME:=VALUE]...", help="As roslaunch gives them.")
    ] = None,
    out_folder: Annotated[Path, typer.Option("-o", "--out", help="Folder for bags and results.")] = Path(
        "rigwake-ros"
    ),
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.yaml whose frames are published from the start.")
    ] = None,
    topic: Annotated[
        list[str] | None, typer.Option(help="Only this topic; may be repeated (default: every sensor).")
    ] = None,
    child_frame: Annotated[
        str, typer.Option(help="Frame of a camera on /tf_static; {name} is the camera's.")
    ] = "{name}_optical_frame",
    monitor_seconds: Annotated[
        float, typer.Option(help="Judge the cameras every so many seconds (0: never).")
    ] = 0.0,
    surround_hz: Annotated[
        float,
        typer.Option(help="Surround pictures per second at most, while somebody receives them (0: never)."),
    ] = 5.0,
    ros: Annotated[
        str, typer.Option(help="1 (rospy), 2 (rclpy), or auto: as ROS_VERSION says, else 1.")
    ] = "auto",
    record: Annotated[bool, typer.Option("--record", help="Record from the start.")] = False,
) -> None:
    """A ROS node: records on `~record`, calibrates on `~calibrate`, publishes transforms, diagnostics, a surround view.

    Example: [cyan]rigwake ros node --out bags[/cyan], then [cyan]rosservice call /rigwake/record true[/cyan]
    """
    for words in remappings or ():
        if ":=" not in words:
            raise UsageError(
                f"{words[:60]!r} is no remapping.", remedy="Write NAME:=VALUE, as in __name:=rig."
            )
    require_there(calibration)
    require_writable("--out", out_folder, folder=True)
    require_number("--monitor-seconds", monitor_seconds, above=-1e-9)
    require_number("--surround-hz", surround_hz, above=-1e-9)
    if ros not in ("auto", "1", "2"):
        raise UsageError(f"--ros {ros[:20]!r} is no version of ROS.", remedy="Give 1, 2 or auto.")
    if "{name}" not in child_frame:
        raise UsageError("--child-frame names all cameras alike.", remedy="Write {name} in it.")
    from rigwake.ros.node import NodeOptions, RigwakeNode

    transport = _transport(ros, remappings or ())
    options = NodeOptions(
        out_folder.absolute(),
        calibration,
        tuple(topic or ()),
        child_frame,
        monitor_s=monitor_seconds,
        surround_hz=surround_hz,
    )
    running = RigwakeNode(transport, options)
    try:
        if record:
            err.print(running.record(True)[1], highlight=False, soft_wrap=True)
        err.print(f"running as {transport.own_name()}; Ctrl-C ends it", highlight=False, soft_wrap=True)
        while True:
            running.step()
            time.sleep(_STEP_S)
    finally:
        running.close()


def _transport(ros: str, remappings: Sequence[str]) -> Transport:
    version = os.environ.get("ROS_VERSION", "1") if ros == "auto" else ros
    if version == "2":
        from rigwake.ros.rclpy_transport import RclpyTransport

        return RclpyTransport("rigwake", remappings)
    from rigwake.ros.rospy_transport import RospyTransport

    return RospyTransport("rigwake", remappings)


COMMANDS = {"node": node}
