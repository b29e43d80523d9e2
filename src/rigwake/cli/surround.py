"""`rigwake surround`: panorama, top view, bowl and seam report of a calibrated rig, as pictures, video or live."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rigwake.cli.console import next_step, out, progress_bar, write_json
from rigwake.cli.options import (
    CameraFileOption,
    JsonOption,
    TopicOption,
    TopicsOption,
    completed_from,
    require,
    require_there,
    require_writable,
)
from rigwake.errors import UsageError
from rigwake.extras import require_extra

if TYPE_CHECKING:
    from rigwake.views.prepare import SurroundSetup
    from rigwake.views.present import Decoration
    from rigwake.views.projections import ViewProjection

_VIEWS = ("panorama", "cylinder", "topdown", "bowl", "camera")
_PICTURES, _VIDEOS = (".png", ".jpg", ".jpeg"), (".mp4", ".mov", ".m4v")
_PORT = 8360
_LARGEST_PX = 16384


def command(
    calibration: Annotated[
        Path, typer.Argument(help="calibration.yaml (or its folder), truth.yaml or rig.yaml.")
    ],
    recording: Annotated[
        Path | None, typer.Argument(help="Recording, or a folder with one picture per camera.")
    ] = None,
    port: Annotated[int | None, typer.Argument(help=f"Port of --serve (default {_PORT}; 0: any).")] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", "--output", help="OUT.mp4, OUT.png, OUT.jpg, or a folder for everything."
        ),
    ] = None,
    view: Annotated[
        str, typer.Option(help=f"One of {', '.join(_VIEWS)}.", autocompletion=completed_from(_VIEWS))
    ] = "panorama",
    at: Annotated[
        float | None, typer.Option(help="Seconds after the first picture; default: the middle.")
    ] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Size of the view in pixels.")] = None,
    stabilise: Annotated[str, typer.Option(help="imu (the best there is), horizon or off.")] = "imu",
    surface: Annotated[
        str, typer.Option(help="stixels, shell or water: what the view is drawn on.")
    ] = "shell",
    shell_m: Annotated[
        float | None, typer.Option(help="Distance of the shell, metres; default: estimated.")
    ] = None,
    height_m: Annotated[
        float | None,
        typer.Option(help="Mean height of the cameras above the water, metres; default: estimated."),
    ] = None,
    hull: Annotated[str, typer.Option(help="show or mask the own vessel.")] = "show",
    radius_m: Annotated[float, typer.Option(help="Reach of the top view, metres.")] = 25.0,
    bumper_m: Annotated[float, typer.Option(help="Radius of the bumper in the top view, metres.")] = 5.0,
    vessel: Annotated[
        str | None, typer.Option(metavar="LxW", help="Length and width of the vessel, metres: its outline.")
    ] = None,
    yaw: Annotated[float, typer.Option(help="Views camera and bowl look there: degrees to starboard.")] = 0.0,
    fov: Annotated[float, typer.Option(help="Views camera and bowl: field of view across, degrees.")] = 90.0,
    trajectory: Annotated[Path | None, typer.Option(help="Trajectory of the rig, for its attitude.")] = None,
    serve: Annotated[
        bool, typer.Option("--serve", help="Show it live in a browser instead of writing files.")
    ] = False,
    host: Annotated[
        str, typer.Option(help="Address that --serve listens on; by default only this machine.")
    ] = "127.0.0.1",
    live: Annotated[
        list[str] | None,
        typer.Option("--from", metavar="CAMERA=URL", help="Live source in place of REC; may be repeated."),
    ] = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    camera_file: CameraFileOption = None,
    json_file: JsonOption = None,
) -> None:
    """Draw all cameras as one seamless view, and measure its seams.

    Example: [cyan]rigwake surround OUT/calibration.yaml sail.bag -o pano.png[/cyan]

    Example: [cyan]rigwake surround OUT sail.bag -o top.mp4 --view topdown[/cyan]

    Example: [cyan]rigwake surround OUT sail.bag --serve 8360[/cyan]
    """
    live_port = live and recording is not None and recording.name.isdecimal() and not recording.exists()
    require_there(calibration, None if live_port else recording, topics, trajectory)
    require_writable("--json", json_file)
    from rigwake.readers.topics import TopicMap
    from rigwake.views.prepare import STABILISERS, SURFACES, SurroundOptions, prepare_surround
    from rigwake.views.present import Decoration

    require("--view", view, _VIEWS)
    require("--stabilise", stabilise, STABILISERS)
    require("--surface", surface, SURFACES)
    require("--hull", hull, ("show", "mask"))
    if live_port and recording is not None:
        port = int(recording.name)  # CALIB --serve PORT --from ...
        recording = None
    _check_use(recording, output, serve, live, port)
    options = SurroundOptions(stabilise, surface, shell_m, height_m, hull, trajectory)
    projection = _projection(view, size, radius_m, yaw, fov)
    outline = _two_numbers(vessel, "--vessel") if vessel else None
    topic_map = TopicMap.from_options(topic or (), topics, camera_file or ())
    shown_port = _PORT if port is None else port
    if live:
        require_extra("av", "video", "Showing live sources")
        from rigwake.views.live import serve_live

        decoration = Decoration(bumper_m, outline, hull == "mask")
        serve_live(calibration, live, options, host, shown_port, decoration)
        return
    assert recording is not None
    with progress_bar() as bar:
        task, steps = bar.add_task("reading", total=5), count(1)
        setup = prepare_surround(
            calibration,
            recording,
            options,
            topic_map,
            lambda words: bar.update(task, description=words, completed=next(steps)),
        )
    decoration = Decoration(bumper_m, outline, hull == "mask", setup.wave_std_m, setup.calibration)
    quiet = str(json_file) == "-"
    for line in () if quiet else (setup.leveller.words, *setup.notes):
        out.print(line, markup=False, highlight=False, soft_wrap=True)
    if serve:
        from rigwake.views.serve.server import serve_recording

        serve_recording(setup, decoration, host, shown_port)
        return
    assert output is not None
    _write(setup, projection, decoration, output, at, radius_m)
    _report(setup, output, json_file, recording.name)
    if not quiet:
        words = ["rigwake", "surround", calibration, recording, "--serve"]
        next_step(words, "look around, live in the browser")


def _check_use(
    recording: Path | None, output: Path | None, serve: bool, live: Sequence[str] | None, port: int | None
) -> None:
    if live and not serve:
        raise UsageError("--from shows live sources.", remedy="Use it with --serve.")
    if recording is None and not live:
        raise UsageError("Nothing to show.", remedy="Give a recording, or --serve with --from CAMERA=URL.")
    if recording is not None and live:
        raise UsageError("A recording and --from contradict each other.", remedy="Leave one out.")
    if port is not None and not (serve and 0 <= port < 65536):
        raise UsageError(f"{port} is no port to serve on.", remedy="Write --serve PORT, from 0 to 65535.")
    if serve:
        return
    if output is None:
        raise UsageError("Nothing to write to.", remedy="Give -o OUT.png, OUT.mp4 or a folder, or --serve.")
    require_writable("-o", output, folder=output.is_dir() or not output.suffix)
    if output.suffix and output.suffix.lower() not in (*_PICTURES, *_VIDEOS) and not output.is_dir():
        raise UsageError(
            f"{output}: what should {output.suffix} be?",
            remedy=f"Write {', '.join((*_PICTURES, *_VIDEOS))}, or a folder without a suffix.",
        )
    if output.suffix.lower() in _VIDEOS:
        require_extra("av", "video", "Writing a video")


def _two_numbers(text: str, option: str) -> tuple[float, float]:
    parts = text.lower().split("x")
    try:
        first, second = (float(part) for part in parts)
    except ValueError as error:
        raise UsageError(
            f"{option} {text!r} is not two numbers.", remedy="Write them as 2048x1024."
        ) from error
    if not (0 < first < 1e5 and 0 < second < 1e5):
        raise UsageError(f"{option} {text!r}: both numbers must be positive.")
    return first, second


def _projection(view: str, size: str | None, radius_m: float, yaw: float, fov: float) -> ViewProjection:
    from rigwake.views.projections import Bowl, CylinderView, EquirectangularView, TopDown, VirtualCamera

    wanted = _two_numbers(size, "--size") if size else None
    if wanted is not None and (max(wanted) > _LARGEST_PX or min(wanted) < 16 or any(x % 1 for x in wanted)):
        raise UsageError(f"--size {size}: whole numbers from 16 to {_LARGEST_PX}.")
    if not 10 <= fov <= 150:
        raise UsageError(f"--fov {fov:g} is not between 10 and 150 degrees.")
    if not 1 <= radius_m <= 1000:
        raise UsageError(f"--radius-m {radius_m:g} is not between 1 and 1000 metres.")
    pixels = {} if wanted is None else {"width_px": int(wanted[0]), "height_px": int(wanted[1])}
    if view == "topdown":
        return TopDown(**pixels, radius_m=radius_m)
    if view == "bowl":
        return Bowl(**pixels, azimuth_deg=180.0 + yaw, fov_deg=min(fov, 100.0))
    if view == "camera":
        return VirtualCamera(**pixels, azimuth_deg=yaw, fov_deg=fov)
    return CylinderView(**pixels) if view == "cylinder" else EquirectangularView(**pixels)


def _write(
    setup: SurroundSetup,
    projection: ViewProjection,
    decoration: Decoration,
    output: Path,
    at: float | None,
    radius_m: float,
) -> None:
    """The picture, the video, or a folder with every view."""
    from rigwake.views.present import Presenter, is_sphere, needs_height, write_video
    from rigwake.views.projections import Bowl, CylinderView, EquirectangularView, TopDown
    from rigwake.views.stills import write_picture

    suffix = output.suffix.lower()
    if suffix in _VIDEOS:
        presenter = Presenter.of(setup, projection, decoration)
        with progress_bar() as bar:
            task = bar.add_task("video", total=1)
            for done, total in write_video(setup, presenter, output, at):
                bar.update(task, completed=done, total=total)
        out.print(f"{output}: {output.stat().st_size / 1e6:.1f} MB", markup=False, highlight=False)
        return
    frames = setup.frame_set_at(at)
    attitude = setup.attitude_at(frames)
    surface = setup.surface_at(frames, attitude)
    wanted: dict[Path, ViewProjection] = {output: projection}
    if suffix not in _PICTURES:
        views: tuple[ViewProjection, ...] = (
            EquirectangularView(),
            CylinderView(),
            TopDown(radius_m=radius_m),
            Bowl(),
        )
        names = ("panorama.jpg", "cylinder.jpg", "topdown.png", "bowl.jpg")
        wanted = {
            output / name: v
            for name, v in zip(names, views, strict=True)
            if setup.height is not None or not needs_height(v)
        }
    for path, screen in wanted.items():
        picture = Presenter.of(setup, screen, decoration).picture(frames, attitude, surface, careful=True)
        write_picture(picture, path, is_sphere(screen))
        out.print(str(path), markup=False, highlight=False)


def _report(setup: SurroundSetup, output: Path, json_file: Path | None, title: str) -> None:
    """Seams in words; as JSON and, in a folder, as a page."""
    from rigwake.atomic import write_text_atomic
    from rigwake.views.seam_report import measure_report, report_page, report_to_dict

    report = measure_report(setup)
    if not output.suffix or output.is_dir():
        write_text_atomic(output / "seams.html", report_page(report, setup, title))
        write_json(output / "seams.json", report_to_dict(report, setup))
        out.print(str(output / "seams.html"), markup=False, highlight=False)
    if json_file is not None:
        write_json(json_file, report_to_dict(report, setup))
    if str(json_file) != "-":
        for line in report.lines():
            out.print(line, markup=False, highlight=False, soft_wrap=True)
