"""The folder of a result: free, whole, and used by one run at a time."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from rigwake.atomic import remove_leftovers
from rigwake.errors import HostError, UsageError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_LOCK = ".rigwake.lock"
RESULT_FILES = ("calibration.yaml", "report.html")  # those by which others judge that a result is there
_OTHER_FILES = ("initial_rig.yaml", "residuals.npz", "adjustment.npz", "stages.json")
_STAGE_FOLDERS = ("tracks", "odometry", "masks", "trajectories", "pictures")
_LONGEST_NAME = 200  # bytes; the usual limit is 255, and names of files add to the camera's
_TAKEN_NAMES = ("rig",)  # trajectories/rig.tum is the rig's own
_MASK_SUFFIXES = ("lens", "hull", "water", "sky", "file")


def check_out_folder(out: Path, inputs: Iterable[Path], *, force: bool, resume: bool) -> None:
    """Raises UsageError for a folder that cannot be used: a file, inside an input, or with another result in it,
    unless it is to be replaced (`force`) or continued (`resume`). Creates nothing."""
    if str(out) in ("", "."):
        raise UsageError("The folder of the result has no name.", remedy="Give it one: -o OUT")
    if out.exists() and not out.is_dir():
        raise UsageError(
            f"{out} is a file; a folder is wanted for the result.", remedy="Choose another: -o OUT"
        )
    for path in inputs:
        inside = path.resolve() in (out.resolve(), *out.resolve().parents)
        if path.is_dir() and inside:
            raise UsageError(
                f"{out} lies inside of {path}.",
                consequence="At the next reading, masks and pictures of the result would count as cameras.",
                remedy=f"Choose a folder outside: -o {path.resolve().parent / 'OUT'}",
            )
    if force and resume:
        raise UsageError("--force replaces a result, --resume continues it.", remedy="Give one of them.")
    if holds_result(out) and not (force or resume):
        raise UsageError(
            f"{out} holds the result of another run.",
            consequence="It is not overwritten unasked.",
            remedy="Choose another folder with -o, replace the result with --force, or go on with it with --resume.",
        )


def holds_result(out: Path) -> bool:
    """Whether a run has left a result or finished stages in the folder."""
    return any((out / name).is_file() for name in (*RESULT_FILES, "stages.json"))


def check_camera_names(names: Iterable[str]) -> None:
    """Raises UsageError for names of cameras that cannot be names of files, or whose files would be mixed up."""
    known = list(names)
    for name in known:
        plain = name.isprintable() and not set(name) & set('/\\:*?"<>|') and not name.startswith(".")
        if not plain or not name.strip() or len(os.fsencode(name)) > _LONGEST_NAME or name in _TAKEN_NAMES:
            raise UsageError(
                f"The camera name {name[:60]!r} cannot be the name of a file.",
                consequence="What is found for this camera could not be kept.",
                remedy="Give it another, as with --topic camera.front=TOPIC, or rename its folder.",
            )
        others = {f"{name}_{suffix}" for suffix in _MASK_SUFFIXES} & set(known)
        if others:
            raise UsageError(
                f"Files of the cameras {name} and {others.pop()} would be mixed up.",
                remedy="Give one of them another name, or leave it out with --cameras.",
            )


@contextmanager
def used_by_one(out: Path) -> Iterator[None]:
    """Create the folder and keep other runs out of it; what killed runs left half-written is removed.

    Raises UsageError if another run uses the folder or it cannot be written, HostError if it is removed within.
    """
    created = [folder for folder in (out, *out.absolute().parents) if not folder.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = _locked(out / _LOCK)
    except (OSError, ValueError) as error:
        with contextlib.suppress(OSError, ValueError):
            if (out / _LOCK).stat().st_size == 0:  # ours, which could not be filled
                (out / _LOCK).unlink()
            for folder in created:
                folder.rmdir()
        raise UsageError(
            f"{out} cannot be written: {getattr(error, 'strerror', None) or error}.",
            consequence="Nothing was computed.",
            remedy="Choose another folder with -o, or change its permissions.",
        ) from error
    try:
        remove_leftovers(out)
        yield
    except (OSError, HostError, ValueError) as error:
        if not (out / _LOCK).exists():
            raise HostError(
                f"{out} was removed while it was in use.",
                remedy="Run the command again, with a folder that stays.",
            ) from error
        raise
    finally:
        remove_leftovers(out)
        with contextlib.suppress(OSError):
            (out / _LOCK).unlink()
        lock.close()
        for folder in created:  # a run that failed before it wrote anything leaves nothing
            with contextlib.suppress(OSError):
                folder.rmdir()


def clear_results(out: Path, *, everything: bool) -> None:
    """Remove the result of a former run, with `everything` also what its stages left. Nothing else is touched."""
    for name in (*RESULT_FILES, *(_OTHER_FILES if everything else ())):
        (out / name).unlink(missing_ok=True)
    for name in _STAGE_FOLDERS if everything else ():
        if (out / name).is_symlink():
            continue
        if (out / name).is_dir():
            shutil.rmtree(out / name)


def _locked(path: Path) -> IO[Any]:
    """The lock file, open and locked; the system unlocks it when the process ends, however it ends."""
    while True:
        file = path.open("a+", encoding="ascii", errors="replace")
        try:
            _lock(file)
        except BlockingIOError as error:
            file.seek(0)
            who = file.read(20).strip()
            file.close()
            raise UsageError(
                f"Another run{f' (process {who})' if who else ''} writes to {path.parent}.",
                consequence="Two runs in one folder would mix their results.",
                remedy="Wait until it has ended, or choose another folder with -o.",
            ) from error
        try:
            same = os.fstat(file.fileno()).st_ino == path.stat().st_ino
        except FileNotFoundError:
            same = False
        if same:  # else the run before has removed it in this moment
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
            return file
        file.close()


def _lock(file: IO[Any]) -> None:
    """Raises BlockingIOError if another process holds it; where the file system has no locks, nothing happens."""
    try:
        if sys.platform == "win32":
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except PermissionError as error:  # what Windows says
        raise BlockingIOError(*error.args) from error
    except OSError:
        return
