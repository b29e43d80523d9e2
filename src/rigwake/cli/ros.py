"""On board: a ROS node that records, calibrates and watches.

Example: [cyan]rigwake ros node --out /data/rigwake[/cyan]
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from rigwake.cli.console import err
from rigwake.cli.options import require_number, require_there, require_writable
from rigwake.errors import UsageError

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
    record: Annotated[bool, typer.Option("--record", help="Record from the start.")] = False,
) -> None:
    """A ROS 1 node: records on `~record`, calibrates on `~calibrate`, publishes /tf_static and /diagnostics.

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
    if "{name}" not in child_frame:
        raise UsageError("--child-frame names all cameras alike.", remedy="Write {name} in it.")
    from rigwake.ros.node import NodeOptions, RigwakeNode
    from rigwake.ros.rospy_transport import RospyTransport

    transport = RospyTransport("rigwake", remappings or ())
    options = NodeOptions(
        out_folder.absolute(), calibration, tuple(topic or ()), child_frame, monitor_s=monitor_seconds
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


COMMANDS = {"node": node}
