"""`rigwake handeye`: a rig from trajectories that any odometry made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from rigwake.cli.console import err, figures_table, next_step, out, print_looks, print_title, write_json
from rigwake.cli.options import (
    HtmlOption,
    JsonOption,
    completed_from,
    require,
    require_there,
    require_writable,
)
from rigwake.errors import UnobservableError

if TYPE_CHECKING:
    from rigwake.calibration import CalibratedCamera
    from rigwake.handeye.handeye_problem import HandeyeResult
    from rigwake.plausibility.values import SensorCheck
    from rigwake.trajectory import Trajectory

_METHODS = ("ml", "thesis")
_NOISES = ("auto", "estimated", "increments", "poses")


def command(
    reference: Annotated[str, typer.Argument(help="Trajectory of the reference, metric.")],
    others: Annotated[list[str], typer.Argument(help="Trajectories of the others, one file each.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--out", "--output", help="Write calibration.yaml here.")
    ] = None,
    json_file: JsonOption = None,
    html: HtmlOption = None,
    method: Annotated[
        str,
        typer.Option(
            help="`ml`: maximum likelihood; `thesis`: the linear baseline.",
            autocompletion=completed_from(_METHODS),
        ),
    ] = "ml",
    noise: Annotated[
        str,
        typer.Option(
            help="Errors independent in the `increments` (odometry), in the `poses` (GNSS/INS, boards), or "
            "`estimated`; `auto`: as covariances beside the files say, else estimated.",
            autocompletion=completed_from(_NOISES),
        ),
    ] = "auto",
    time_offset: Annotated[
        bool, typer.Option("--time-offset/--no-time-offset", help="Estimate the clocks of the others.")
    ] = True,
    scale: Annotated[
        bool, typer.Option("--scale", help="Estimate a scale of the others although they claim to be metric.")
    ] = False,
    columns: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[FILE=]NAMES",
            help="What the columns hold where the file does not say: `t x y z qw qx qy qz`, `_` for others. "
            "FILE= for one file only. May be repeated.",
        ),
    ] = None,
    frame: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[FILE=]FRAME",
            help="What the poses mean: `enu` (world_from_body, right-handed: as it stands), `inverse`, "
            "`ned`, `left-handed`. FILE= for one file only. May be repeated.",
        ),
    ] = None,
) -> None:
    """Where bodies sit on one rig, from one trajectory of each: no shared view, any clock, any origin.

    Formats: TUM, KITTI, EuRoC, csv with header; pose topics of ROS bags as [cyan]recording.bag:/topic[/cyan].
    Example: [cyan]rigwake handeye imu.tum port.tum starboard.tum -o calibration.yaml[/cyan]
    """
    require("--method", method, _METHODS)
    require("--noise", noise, _NOISES)
    require_writable("-o", output)
    require_writable("--json", json_file)
    require_writable("--html", html)
    inputs = [_Input.parse(text) for text in (reference, *others)]
    require_there(*(one.path for one in inputs))
    from rigwake.calibration import save_calibration
    from rigwake.handeye.handeye_problem import HandeyeOptions
    from rigwake.pipeline.handeye_run import run_handeye
    from rigwake.plausibility.values import checks_to_list

    meanings = [_meaning(one, columns or (), frame or ()) for one in inputs]
    trajectories = [_read(one, *meaning) for one, meaning in zip(inputs, meanings, strict=True)]
    options = HandeyeOptions(
        method="ml" if method == "ml" else "thesis",
        noise=None if noise == "auto" else noise,  # type: ignore[arg-type]
        time_offset=time_offset,
        scale=scale,
    )
    result, checks, noticed = run_handeye(trajectories[0], trajectories[1:], options)
    for finding in noticed:
        err.print(f"[yellow]{escape(finding.message)}[/yellow]")
    if output is not None:
        provenance = {
            "command": "handeye",
            "inputs": [one.fingerprint() for one in inputs],
            "method": method,
            "noise": result.noise,
        }
        save_calibration(result.calibration(provenance), output)
    if json_file is not None:
        write_json(json_file, result_to_json(result) | {"sensor_checks": checks_to_list(checks)})
    if html is not None:
        from rigwake.atomic import write_text_atomic
        from rigwake.report.handeye_page import handeye_page

        write_text_atomic(html, handeye_page(result, trajectories[0], trajectories[1:], checks))
    quiet = str(json_file) == "-"
    if not quiet:
        _print(result)
    if not any(camera.has_figures for camera in result.members.values()):
        raise _nothing_determined(result)
    if not quiet:
        _print_checks(checks)
        options_given = _words_of_options(method, noise, time_offset, scale)
        _name_next_step(output, [reference, *others, *options_given])


def _print_checks(checks: Sequence[SensorCheck]) -> None:
    from rigwake.plausibility.handeye_fit import finding_of

    for check in checks:
        out.print(f"[dim]{escape(finding_of(check))}[/dim]", soft_wrap=True)


def _name_next_step(output: Path | None, words: list[str]) -> None:
    if output is not None:
        why = "a table; mountings without a lens fit json and csv"
        next_step(["rigwake", "export", output, "--to", "csv"], why)
    else:
        next_step(["rigwake", "handeye", *words, "-o", "calibration.yaml"], "keep the result")


def _words_of_options(method: str, noise: str, time_offset: bool, scale: bool) -> list[str]:
    """The same options again, where they are not those by default."""
    words = [] if method == "ml" else ["--method", method]
    words += [] if noise == "auto" else ["--noise", noise]
    return words + ([] if time_offset else ["--no-time-offset"]) + (["--scale"] if scale else [])


def _nothing_determined(result: HandeyeResult) -> UnobservableError:
    remedies = [d.remedy for camera in result.members.values() for d in camera.unobservable if d.remedy]
    return UnobservableError(
        f"The motion determined nothing of {', '.join(result.members)}.",
        consequence="Files and tables hold no number.",
        remedy=remedies[0] if remedies else "Turn about two axes while moving.",
    )


@dataclass(frozen=True)
class _Input:
    """A trajectory file, or a pose topic of a recording (`recording.bag:/topic`)."""

    path: Path
    topic: str | None

    @classmethod
    def parse(cls, text: str) -> _Input:
        before, colon, topic = text.rpartition(":/")
        whole = Path(text)
        return cls(Path(before), "/" + topic) if colon and not whole.exists() else cls(whole, None)

    def fingerprint(self) -> dict[str, Any]:
        """What identifies it in the provenance of a calibration."""
        from rigwake.fingerprint import input_fingerprint

        return input_fingerprint(self.path) | ({"topic": self.topic} if self.topic else {})


def _meaning(source: _Input, columns: Sequence[str], frames: Sequence[str]) -> tuple[str | None, str]:
    """`--columns` and `--frame` of one input: what is said of it by name, else of all."""
    from rigwake.readers.trajectory_frames import FRAME_MEANINGS

    frame = _said_of(source, frames) or "enu"
    require("--frame", frame, FRAME_MEANINGS)
    return _said_of(source, columns), frame


def _said_of(source: _Input, options: Sequence[str]) -> str | None:
    pairs = [text.rpartition("=") for text in options]
    known = (str(source.path), source.path.name, source.path.stem, source.topic)
    own = [value for file, sign, value in pairs if sign and file in known]
    general = [value for _, sign, value in pairs if not sign]
    return own[-1] if own else general[-1] if general else None


def _read(source: _Input, columns: str | None, frame: str) -> Trajectory:
    from rigwake.readers.held_positions import without_held_positions
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap
    from rigwake.readers.trajectories import read_trajectory
    from rigwake.readers.trajectory_frames import in_house_frames

    if source.topic is None:
        read = read_trajectory(source.path, columns=columns, frame=frame)
        trajectory, findings = read.trajectory, read.findings
    else:
        name = source.topic.strip("/").replace("/", "_")
        recording = open_recording(source.path, TopicMap({"pose": {name: source.topic}}))
        trajectory, held = without_held_positions(in_house_frames(recording.poses[name], frame))
        findings = (*(f for f in recording.findings if f.sensor == name), *held)
    for finding in findings:
        err.print(f"[yellow]{escape(source.path.name)}: {escape(finding.message)}[/yellow]")
    return trajectory


def result_to_json(result: HandeyeResult) -> dict[str, Any]:
    """The result as plain values; null wherever the motion determined nothing."""
    return {
        "reference": result.reference,
        "members": {name: _member_to_json(result, camera) for name, camera in result.members.items()},
        "noise": result.noise,
        "steps": result.steps,
        "down_weighted": result.down_weighted,
        "iterations": result.iterations,
    }


def _member_to_json(result: HandeyeResult, camera: CalibratedCamera) -> dict[str, Any]:
    turned = camera.rig_from_cam.rotation
    quaternion = camera.rig_from_cam.quat_wxyz if bool((turned == turned).all()) else [float("nan")] * 4
    return {
        "ref_from_member": {
            "quat_wxyz": _plain(quaternion),
            "translation_m": _plain(camera.rig_from_cam.translation),
        },
        "std": {
            "rotation_deg": _plain(camera.std_rotation_deg),
            "translation_m": _plain(camera.std_translation_m),
        },
        "time_offset_s": camera.time_offset_s,
        "time_offset_std_s": camera.time_offset_std_s,
        "scale": _plain([camera.scale])[0],
        "scale_std": _plain([camera.scale_std])[0],
        "segment_scales": [_plain(pair) for pair in result.scales[camera.name]],
        "unobservable": [
            {"direction": _plain(d.direction), "words": d.words, "remedy": d.remedy}
            for d in camera.unobservable
        ],
        "known_offsets": [
            {"direction": _plain(k.direction_rig), "value_m": k.value_m, "std_m": k.std_m}
            for k in camera.known_offsets
        ],
    }


def _plain(values: Any) -> list[float | None]:
    """Floats, None where not finite."""
    numbers = [None if v is None else float(v) for v in values]
    return [None if v is None or v - v != 0 else v for v in numbers]


def _print(result: HandeyeResult) -> None:
    """Rotation vectors and offsets, then clocks and scales where they were estimated, then what stays open."""
    mountings = figures_table(
        ("member", "axis", "rotation °", "offset mm"),
        words=2,
    )
    others = figures_table(("member", "offset ms", "scale"))
    for name, camera in result.members.items():
        turn = _rotation_vector_deg(camera)
        offset, offset_std = 1e3 * camera.rig_from_cam.translation, 1e3 * camera.std_translation_m
        for i, axis in enumerate("xyz"):
            mountings.add_row(
                escape(name) if i == 0 else "",
                axis,
                _figure(turn[i], camera.std_rotation_deg[i], 4),
                _figure(offset[i], offset_std[i], 1),
            )
        time_offset = None if camera.time_offset_s is None else 1e3 * camera.time_offset_s
        time_offset_std = None if camera.time_offset_std_s is None else 1e3 * camera.time_offset_std_s
        figures = _figure(time_offset, time_offset_std, 3), _figure(camera.scale, camera.scale_std, 4)
        if figures != ("–", "–"):
            others.add_row(escape(name), *figures)
    print_title(f"mountings in {result.reference}: rotation vector and offset, ± one sigma")
    out.print(mountings)
    if others.row_count:
        out.print(others)
    print_looks(result.calibration())
    found = sum(camera.has_figures for camera in result.members.values())
    out.print(f"{found} of {len(result.members)} mountings observable", highlight=False)
    out.print(f"noise: {result.noise}; {result.steps} steps, {result.down_weighted} down-weighted")
    for camera in result.members.values():
        for d in camera.unobservable:
            out.print(f"[yellow]unobservable: {escape(d.words)}.[/yellow] {escape(d.remedy)}")


def _rotation_vector_deg(camera: CalibratedCamera) -> Any:
    """(3,) degrees; NaN where the rotation is unobservable."""
    import numpy as np

    from rigwake.geometry import so3

    rotation = camera.rig_from_cam.rotation
    return np.rad2deg(so3.log(rotation)) if np.isfinite(rotation).all() else np.full(3, np.nan)


def _figure(value: float | None, std: float | None, digits: int) -> str:
    if value is None or value - value != 0:
        return "–"
    if std is None or std - std != 0:
        return f"{value:+.{digits}f}"
    return f"{value:+.{digits}f} ± {std:.{digits}f}"
