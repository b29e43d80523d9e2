"""`rigwake convert REC -o OUT`: a recording in another format, or a part of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.markup import escape

from rigwake.cli.console import next_step, out, progress_bar, write_json
from rigwake.cli.options import (
    CameraFileOption,
    CamerasOption,
    JsonOption,
    TopicOption,
    TopicsOption,
    require,
)
from rigwake.errors import UsageError

if TYPE_CHECKING:
    from rigwake.recording import CameraStream, Finding, Recording
    from rigwake.writers.encoded_images import ImageEncoding
    from rigwake.writers.write import RecordingFormat

_FORMATS = ("ros1", "ros2", "mcap", "euroc", "folder")
_IMAGES = ("copy", "jpeg", "png", "raw")


def command(
    recording: Annotated[
        Path, typer.Argument(help="ROS bag, MCAP, EuRoC or KITTI folder, folder of images, NMEA log.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--out", "--output", help="OUT.bag (ROS 1), OUT.mcap (ROS 2) or a folder.")
    ],
    to: Annotated[
        str | None, typer.Option(help=f"{', '.join(_FORMATS)}; by default as the suffix of OUT says.")
    ] = None,
    images: Annotated[
        str,
        typer.Option(help="copy (stored JPEG and PNG as they are, others as JPEG), jpeg, png or raw."),
    ] = "copy",
    cameras: CamerasOption = None,
    start: Annotated[float, typer.Option(help="Skip so many seconds.")] = 0.0,
    duration: Annotated[float | None, typer.Option(help="Take so many seconds.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Of each camera only every so many-th frame.")] = 1,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    camera_file: CameraFileOption = None,
    json_file: JsonOption = None,
) -> None:
    """Write a recording, or a part of it, in another format; lenses and names come along.

    Example: [cyan]rigwake convert sail.bag -o sail.mcap[/cyan]

    Example: [cyan]rigwake convert images/ -o sail.bag --camera-file rig.yaml --start 10 --duration 60[/cyan]
    """
    from rigwake.excerpt import excerpt
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap

    require("--images", images, _IMAGES)
    if to is not None:
        require("--to", to, _FORMATS)
    if output.exists():
        raise UsageError(f"{output} is already there.", remedy="Remove it, or choose another name.")
    opened = open_recording(recording, TopicMap.from_options(topic or (), topics, camera_file or ()))
    before = len(opened.findings)
    part = excerpt(_with_cameras(opened, cameras), start_s=start, duration_s=duration, every=every)
    findings = [*part.findings[before:], *_write(part, output, to, images)]
    frames = sum(len(camera) for camera in part.cameras.values())
    if json_file is not None:
        write_json(json_file, _summary(part, output, frames, findings))
    if str(json_file) == "-":
        return
    sensors = (
        f"{len(part.cameras)} cameras, {frames} frames, {len(part.imus)} IMUs, {len(part.gnss)} receivers"
    )
    out.print(f"{escape(str(output))}: {sensors}.", soft_wrap=True)
    for finding in opened.findings:
        out.print(f"[dim]read: {escape(finding.sensor)}: {escape(finding.message)}[/dim]", soft_wrap=True)
    for finding in findings:
        out.print(f"[yellow]{escape(finding.sensor)}: {escape(finding.message)}[/yellow]", soft_wrap=True)
    next_step(f"rigwake inspect {output}", "see what it holds")


def _with_cameras(recording: Recording, names: str | None) -> Recording:
    if names is None:
        return recording
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    return replace(recording, cameras={name: recording.camera(name) for name in wanted})


def _write(part: Recording, output: Path, to: str | None, images: str) -> list[Finding]:
    """Write with a progress bar; what the format cannot hold, and frames that could not be read."""
    from rigwake.excerpt import CountedFrames
    from rigwake.recording import Finding
    from rigwake.writers.write import write_recording

    written: dict[str, set[int]] = {name: set() for name in part.cameras}
    with progress_bar() as bar:
        task = bar.add_task("converting", total=sum(len(camera) for camera in part.cameras.values()))

        def counted(camera: CameraStream) -> CameraStream:
            def count(index: int) -> None:
                written[camera.name].add(index)
                bar.update(task, completed=sum(len(indices) for indices in written.values()))

            return replace(camera, source=CountedFrames(camera.source, count))

        watched = replace(part, cameras={name: counted(camera) for name, camera in part.cameras.items()})
        findings = write_recording(
            watched,
            output,
            file_format=cast("RecordingFormat | None", to),
            image_encoding=cast("ImageEncoding", images),
        )
    lost = [
        Finding(
            "error", name, f"{len(camera) - len(written[name])} of {len(camera)} frames could not be read."
        )
        for name, camera in part.cameras.items()
        if len(written[name]) < len(camera)
    ]
    return [*findings, *lost]


def _summary(part: Recording, output: Path, frames: int, findings: list[Finding]) -> dict[str, object]:
    return {
        "output": str(output),
        "cameras": {name: len(camera) for name, camera in part.cameras.items()},
        "frames": frames,
        "imus": {name: len(imu.timestamps_ns) for name, imu in part.imus.items()},
        "gnss": {name: len(gnss.timestamps_ns) for name, gnss in part.gnss.items()},
        "findings": [
            {"severity": f.severity, "sensor": f.sensor, "message": f.message}
            for f in (*part.findings, *findings)
        ],
    }
