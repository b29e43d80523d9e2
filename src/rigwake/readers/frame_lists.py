"""When the images of a folder were taken: lists beside or inside it, else the names of the files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rigwake._types import Stamps
from rigwake.errors import InputError
from rigwake.readers.csv_tables import read_table
from rigwake.readers.frame_names import stamps_of_names
from rigwake.readers.image_files import image_files
from rigwake.readers.picture_files import IMAGE_SUFFIXES
from rigwake.readers.stamp_units import stamps_from_text
from rigwake.readers.trajectory_rows import cells_of, is_number
from rigwake.recording import Finding
from rigwake.text_files import read_text_file

_NOMINAL_PERIOD_NS = 100_000_000
_INSIDE = ("timestamps.csv", "timestamps.txt", "times.txt", "times.csv", "data.csv", "image_timestamps.txt")
LIST_ENDINGS = ("_timestamps.csv", "_timestamps.txt", ".csv", ".txt", "_times.txt")
_FILE_COLUMNS = ("filename", "file", "image", "frame", "name", "path")
_MAX_LIST_BYTES = 2**28
_COUNTERS = {"index", "id", "seq", "frame_number", "frame_id", "camera", ""}


@dataclass(frozen=True, eq=False)
class FrameList:
    """Stamps (N,), -1 where unreadable; the files they are of, or None (then in the order of the names); cameras, where
    one list serves several."""

    path: Path
    stamps: Stamps
    files: tuple[str, ...] | None
    cameras: tuple[str, ...] | None = None
    dropped_rows: int = 0


def frames_of_folder(
    folder: Path, root: Path, name: str, findings: list[Finding]
) -> tuple[list[str], Stamps]:
    """Files of the images in a folder and their stamps, not ordered. Adds what is uncertain to `findings`.

    Raises InputError for a list that does not fit the folder.
    """
    files = [file.name for file in image_files(folder)]
    for path in _list_paths(folder, root, name):
        frames = read_frame_list(path)
        if frames is not None:
            return _listed(frames, name, folder, files, findings)
    named = stamps_of_names([Path(file).stem for file in files])
    if named is not None:
        rows, stamps = named
        if len(rows) < len(files):
            message = f"{len(files) - len(rows)} of {len(files)} file names are no times; they were left out."
            findings.append(Finding("warning", name, message))
        return [files[at] for at in rows], stamps
    findings.append(
        Finding("warning", name, "no timestamps.csv and no times in the names: 10 Hz is assumed.")
    )
    return files, np.arange(len(files), dtype=np.int64) * _NOMINAL_PERIOD_NS


def _list_paths(folder: Path, root: Path, name: str) -> list[Path]:
    inside = [folder / file for file in _INSIDE]
    beside = [root / f"{name}{ending}" for ending in LIST_ENDINGS]
    shared = [root / file for file in _INSIDE if file != "data.csv"] if folder != root else []
    return [path for path in dict.fromkeys([*inside, *beside, *shared]) if path.is_file()]


def read_frame_list(path: Path) -> FrameList | None:
    """A list of frames, with a header or without; None if it holds no times. Raises InputError if it is no text."""
    first = next(
        (line for line in read_text_file(path, _MAX_LIST_BYTES).splitlines() if _is_content(line)), ""
    )
    has_header = bool(first) and not any(is_number(cell) or _moment(cell) for cell in cells_of(first)[0])
    if has_header and not _moment(first):
        table = read_table(path)
        column = table.find(*_FILE_COLUMNS)
        column = column or next((c for c in table.columns if _names_images(table.columns[c])), None)
        try:
            stamps = table.stamps_ns()
        except InputError:
            return None
        if column is None and table.columns.keys() - _COUNTERS - {table.stamp_column}:
            raise InputError(f"{path} lacks a column filename.")
        cameras = table.columns.get("camera")
        files = None if column is None else tuple(table.columns[column])
        return FrameList(path, stamps, files, None if cameras is None else tuple(cameras), table.dropped_rows)
    return _without_header(path)


def _is_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(("#", "%", "//"))


def _without_header(path: Path) -> FrameList | None:
    """Rows of a time and perhaps a file, in any order; a time is a number or a date."""
    stamps: list[str] = []
    files: list[str] = []
    dropped = 0
    moments: list[int] = []
    for line in filter(_is_content, read_text_file(path, _MAX_LIST_BYTES).splitlines()):
        moment = _moment(line)
        cells = [] if moment else cells_of(line)[0]
        number = next((cell for cell in cells if is_number(cell)), None)
        if number is None and not moment:
            dropped += 1
            continue
        moments.append(moment or 0)
        stamps.append(number or "")
        words = [word for word in re.split(r"[\s,;]+", line) if Path(word).suffix.lower() in IMAGE_SUFFIXES]
        files += words[:1]
    if not stamps or dropped > len(stamps):
        return None
    exact = np.array(moments, dtype=np.int64) if all(moments) else stamps_from_text(stamps)
    return FrameList(path, exact, tuple(files) if len(files) == len(stamps) else None, None, dropped)


def _moment(text: str) -> int:
    """Nanoseconds since 1970 of a date and time in ISO form (UTC); 0 if there is none."""
    found = re.search(r"(\d{4})-(\d\d)-(\d\d)[T ](\d\d):(\d\d):(\d\d)(?:[.,](\d{1,9}))?", text)
    if found is None:
        return 0
    try:
        moment = datetime(*(int(found[i]) for i in range(1, 7)), tzinfo=UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return 0
    return int(moment.timestamp()) * 10**9 + int((found[7] or "0").ljust(9, "0"))


def _names_images(cells: Sequence[str]) -> bool:
    return bool(cells) and Path(cells[0]).suffix.lower() in IMAGE_SUFFIXES


def _listed(
    frames: FrameList, name: str, folder: Path, present: list[str], findings: list[Finding]
) -> tuple[list[str], Stamps]:
    rows = [r for r in range(len(frames.stamps)) if frames.cameras is None or frames.cameras[r] == name]
    if frames.files is None:
        if len(rows) != len(present):
            raise InputError(
                f"{frames.path.name} holds {len(rows)} times, {folder.name} {len(present)} images."
            )
        files = present
    else:
        files = [_file_in(folder, frames.files[row], present) for row in rows]
    there = set(present)
    kept = [at for at, row in enumerate(rows) if frames.stamps[row] >= 0 and files[at] in there]
    if len(kept) < len(rows) or frames.dropped_rows:
        message = f"{len(rows)} frames listed, {len(kept)} usable; the rest is left out."
        findings.append(Finding("warning", name, message))
    unlisted = len(there - set(files))
    if unlisted:
        message = f"{unlisted} images are not in {frames.path.name}; they were left out."
        findings.append(Finding("warning", name, message))
    return [files[at] for at in kept], frames.stamps[[rows[at] for at in kept]]


def _file_in(folder: Path, listed: str, present: Sequence[str]) -> str:
    """The file of a listed name; a name without its suffix is completed."""
    file = Path(listed.replace("\0", "").replace("\\", "/")).name
    if Path(file).suffix.lower() in IMAGE_SUFFIXES or not file:
        return file
    return next((known for known in present if Path(known).stem == file), file)
