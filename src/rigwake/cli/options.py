"""Options that several verbs share.

def command(recording: Path, topic: TopicOption = None, topics: TopicsOption = None) -> None:
    opened = open_recording(recording, TopicMap.from_options(topic or (), topics))

Choices stand here as plain words, so that --help and completion need no import of what computes; a test compares them
with what there is.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from rigwake.errors import InputError, UsageError

EXPORT_FORMATS = (
    "kalibr",
    "openvins",
    "basalt",
    "camodocal",
    "colmap",
    "mrcal",
    "opencv",
    "ros-static-tf",
    "urdf",
    "json",
    "csv",
)
LENS_MODELS = ("pinhole", "rational", "kb4", "kb23", "mei", "scaramuzza", "eucm", "ds", "fov")
PRESETS = tuple(
    sorted(p.stem for p in (Path(__file__).parent.parent / "simulation" / "scenarios").glob("*.yaml"))
)

if TYPE_CHECKING:
    from rigwake.odometry.below_horizon import HorizonChoice

TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SENSOR=TOPIC",
        help="Which topic is which sensor: camera.front=/a/b, imu=/x, gnss=/y. May be repeated.",
    ),
]
TopicsOption = Annotated[
    Path | None, typer.Option(help="YAML file of the same: camera: {front: /a/b}, imu: /x.")
]
CameraFileOption = Annotated[
    list[str] | None,
    typer.Option(
        "--camera-file",
        metavar="[CAMERA=]FILE",
        help="Lenses from a file of any known format, instead of the recording's. May be repeated.",
    ),
]
FovOption = Annotated[
    list[str] | None,
    typer.Option(
        "--fov",
        metavar="[CAMERA=]DEGREES",
        help="Full field of view, if known, of one camera or of all: front=185. May be repeated.",
    ),
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Write the result as JSON ('-': print).")]
HtmlOption = Annotated[Path | None, typer.Option(help="Write one HTML page with plots.")]
CamerasOption = Annotated[str | None, typer.Option(help="Only these cameras, separated by commas.")]
SettingOption = Annotated[
    list[str] | None, typer.Option("--set", help="One setting: adjustment.cross_camera=false.")
]
RepairOption = Annotated[
    bool,
    typer.Option("--repair/--no-repair", help="Correct units, leave out samples that cannot be right."),
]
AllowPartialOption = Annotated[
    bool,
    typer.Option("--allow-partial", help="Exit with 0, not 4, though a camera is missing from the result."),
]


def completed_from(words: Sequence[str]) -> Callable[[str], list[str]]:
    """For the shell's completion of an option that takes one of these words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


def topic_words(topic: Sequence[str] | None, topics: Path | None) -> list[str]:
    """The same choice of topics again, for a command that is named as the next step."""
    words = [word for assignment in topic or () for word in ("--topic", assignment)]
    return words + (["--topics", str(topics)] if topics is not None else [])


HorizonOption = Annotated[
    str,
    typer.Option(
        "--horizon",
        help="Leave out what lies below the horizon (with an IMU): on, off, or auto: where it is water.",
    ),
]


def horizon_choice(value: str) -> HorizonChoice:
    """`auto`, `on` or `off`; UsageError else."""
    from rigwake.odometry.below_horizon import HorizonChoice

    require("--horizon", value, get_args(HorizonChoice))
    return cast("HorizonChoice", value)


def fields_of_view(assignments: Sequence[str] | None) -> dict[str, float]:
    """Degrees by camera of `--fov front=185`, `all` those of `--fov 185`; UsageError for what is no possible angle."""
    found = {}
    for assignment in assignments or ():
        name, equals, words = assignment.rpartition("=")
        try:
            degrees = float(words)
        except ValueError:
            raise UsageError(
                f"--fov {assignment[:60]!r} is no number of degrees.", remedy="Example: --fov front=185"
            ) from None
        require_number("--fov", degrees, above=0.0, below=360.0)
        if equals and not name.strip():
            raise UsageError(f"--fov {assignment[:60]!r} names no camera.", remedy="Example: --fov front=185")
        found[name.strip() or "all"] = degrees
    return found


def require(option: str, value: str, known: Sequence[str]) -> None:
    """UsageError, with the words to choose from, for a value that an option does not know."""
    if value not in known:
        raise UsageError(f"{option} {value[:60]!r} is unknown.", remedy=f"Choose from {', '.join(known)}.")


def require_number(
    option: str, value: float | None, *, above: float | None = None, below: float = math.inf
) -> None:
    """UsageError for a value that is no finite number, not above `above`, or not below `below`."""
    if value is None:
        return
    if not math.isfinite(value) or (above is not None and value <= above) or value >= below:
        wanted = "a number" if above is None else f"a number above {above:g}"
        wanted += "" if math.isinf(below) else f" and below {below:g}"
        raise UsageError(f"{option} {value:g} is not possible.", remedy=f"Give {wanted}.")


def require_scheduler(words: str) -> None:
    """UsageError for what is neither empty nor an address of a cluster."""
    if words and not re.fullmatch(r"local:[1-9]\d{0,3}|(tcp|tls|ucx|wss?)://\S+", words):
        raise UsageError(
            f"--scheduler {words[:80]!r} is no address.", remedy="Give tcp://HOST:PORT or local:N."
        )


def require_there(*paths: Path | None) -> None:
    """InputError for the first path that is given but not there: said before what computes is imported."""
    for path in paths:
        if path is None:
            continue
        text = str(path)
        if text in ("", ".") or "\0" in text:
            raise UsageError("An empty name is no path." if "\0" not in text else "A path holds a zero byte.")
        if not os.path.exists(path):
            raise InputError(f"There is no file or folder {text[:_LONGEST_SHOWN]}.", remedy=_nearby(path))
        if not (path.is_file() or path.is_dir()):
            raise InputError(
                f"{text} is neither a file nor a folder.",
                consequence="A pipe or a device cannot be read twice, and may never end.",
                remedy="Copy what it gives into a file, and name that.",
            )


def _nearby(path: Path) -> str:
    """What the path may have been meant to be."""
    folder = next((above for above in path.parents if above.is_dir()), Path())
    if folder != path.parent:
        return f"Check the path: {str(folder)[:_LONGEST_SHOWN]} is the last part of it that is there."
    try:
        similar = difflib.get_close_matches(path.name, sorted(os.listdir(folder))[:_MOST_NAMES], n=1)
    except OSError:
        similar = []
    return f"Is {folder / similar[0]} meant?" if similar else "Check the path."


def require_writable(option: str, path: Path | None, *, folder: bool = False) -> None:
    """UsageError for a file (or folder) that could not be written at the end of the work; creates nothing."""
    if path is None or str(path) == "-":
        return
    if str(path) in ("", "."):
        raise UsageError(
            f"{option} names no {'folder' if folder else 'file'}.", remedy=f"Give a path to {option}."
        )
    longest = max(len(os.fsencode(part)) for part in path.absolute().parts)
    if longest > _LONGEST_NAME or "\0" in str(path):
        raise UsageError(
            f"{option} {str(path)[:60]!r} is no possible path.", remedy="Choose a shorter, plain name."
        )
    if path.is_dir() != folder and path.exists():
        found, wanted = ("a folder", "a file") if path.is_dir() else ("a file", "a folder")
        raise UsageError(f"{option} {path} is {found}, {wanted} is wanted.", remedy="Choose another path.")
    if path.exists() and not path.is_file() and not folder:
        return  # a terminal, a pipe: only opening it would tell
    above = next(p for p in (path.absolute(), *path.absolute().parents) if p.is_dir() or p.is_file())
    why = _why_not_writable(above.parent if above == path.absolute() and path.is_file() else above)
    if why:
        raise UsageError(
            f"{option} {path} cannot be written: {above} {why}.",
            consequence="Nothing was computed.",
            remedy="Choose another path, or change the permissions.",
        )


def _why_not_writable(folder: Path) -> str:
    """What speaks against new files in this folder; nothing stays in it. Permissions alone do not tell that."""
    if not folder.is_dir():
        return "is a file, not a folder"
    try:
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return f"takes no new files ({error.strerror})"


_LONGEST_SHOWN = 120  # characters of a path in a message
_MOST_NAMES = 10_000  # of a folder, to look for a similar one
_LONGEST_NAME = 200  # bytes; the usual limit is 255, and temporary names are longer
