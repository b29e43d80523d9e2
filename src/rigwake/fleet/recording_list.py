"""The recordings of a fleet: from list files, folders, patterns and paths."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigwake.errors import InputError, UsageError
from rigwake.readers.euroc_folder import euroc_root
from rigwake.readers.folder import is_plain_folder
from rigwake.readers.kitti import is_kitti_odometry, is_kitti_raw
from rigwake.readers.rosbag2 import METADATA

_BAG_SUFFIXES = (".bag", ".mcap", ".db3")
_LIST_SUFFIXES = (".txt", ".csv", ".list", ".lst")
_DEEPEST = 6
_MOST_LIST_BYTES = 256 << 20


@dataclass(frozen=True)
class ListedRecording:
    """A recording that was asked for, by absolute path, and whose it is."""

    path: str
    vessel: str


def list_recordings(
    arguments: Sequence[str], vessel: str = "", out: Path | None = None
) -> tuple[list[ListedRecording], int]:
    """Every recording that is named, once, in a fixed order, and how many were named again.

    arguments: a recording; a folder of them, searched to a depth of 6; a pattern (`boats/*/*.bag`, `**`); a text file
    of `PATH` or `PATH,VESSEL` per line, relative to that file, `#` for comments. The vessel is what the list says, else
    `vessel`, else the name of the recording's folder. Paths of a list need not be there. Raises InputError for an
    argument that is not there, UsageError where nothing is left. out: the folder of the results, never searched;
    UsageError if it lies in a recording.
    """
    found: dict[str, ListedRecording] = {}
    again = 0
    left_out = None if out is None else out.resolve()
    for path, named in _all(arguments, left_out):
        absolute = os.path.realpath(path)
        again += absolute in found
        found.setdefault(
            absolute,
            ListedRecording(absolute, named or vessel or os.path.basename(os.path.dirname(absolute))),
        )
    if not found:
        raise UsageError(
            f"No recording is in {', '.join(arguments)[:200] or 'nothing'}.",
            remedy="Name recordings, folders of them, patterns in quotes, or a text file of paths.",
        )
    for path in [] if left_out is None else [*map(str, (left_out, *left_out.parents))]:
        if path in found:
            raise UsageError(
                f"{out} lies in the recording {path}.",
                consequence="At the next run, pictures of the result would count as cameras.",
                remedy="Choose a folder outside of the recordings with --out.",
            )
    return list(found.values()), again


def _all(arguments: Iterable[str], out: Path | None) -> Iterator[tuple[str, str]]:
    for argument in arguments:
        if "\0" in argument or not argument:
            raise UsageError("An empty name is no path.")
        path = Path(argument)
        if path.is_dir():
            yield from ((found, "") for found in _in_folder(path, 0, out))
        elif path.is_file():
            yield from _in_list(path) if _is_list(path) else [(argument, "")]
        elif glob.has_magic(argument):
            for match in sorted(glob.glob(argument, recursive=True)):
                if Path(match).is_dir():
                    yield from ((found, "") for found in _in_folder(Path(match), 0, out))
                else:
                    yield match, ""
        else:
            raise InputError(
                f"There is no file or folder {argument[:120]}.",
                remedy="Check the path; put patterns in quotes.",
            )


def _is_list(path: Path) -> bool:
    return path.suffix.lower() in _LIST_SUFFIXES


def _in_list(path: Path) -> Iterator[tuple[str, str]]:
    if path.stat().st_size > _MOST_LIST_BYTES:
        raise InputError(f"{path} is too large for a list of paths.")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is no text.",
            remedy="A list holds one path per line, in UTF-8; commas divide it from the vessel.",
        ) from error
    for number, line in enumerate(lines, 1):
        text, _, vessel = (
            line.partition(",") if not os.path.exists(path.parent / line.strip()) else (line, "", "")
        )
        text = text.strip()
        if not text or text.startswith("#"):
            continue
        if "\0" in text:
            raise InputError(f"{path}, line {number}: a path holds a zero byte.")
        yield str(path.parent / text), vessel.strip()


def _in_folder(folder: Path, depth: int, out: Path | None) -> Iterator[str]:
    """Recordings below a folder; one that is a recording itself is not searched."""
    try:
        if _is_recording_folder(folder):
            yield str(folder)
            return
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise InputError(
            f"{folder} cannot be read: {error.strerror}.", remedy="Change its permissions."
        ) from error
    for entry in entries:
        if entry.name.startswith(".") or entry.resolve() == out:
            continue
        if entry.suffix in _BAG_SUFFIXES and entry.is_file():
            yield str(entry)
        elif entry.is_dir() and depth < _DEEPEST and not entry.is_symlink():
            yield from _in_folder(entry, depth + 1, out)


def _is_recording_folder(folder: Path) -> bool:
    if any(entry.suffix in _BAG_SUFFIXES for entry in folder.iterdir()) and not (folder / METADATA).is_file():
        return False
    recognised = (euroc_root, is_kitti_odometry, is_kitti_raw, is_plain_folder)
    return (folder / METADATA).is_file() or any(look(folder) for look in recognised)
