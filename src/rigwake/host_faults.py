"""Errors of the system, and those that nobody expected, in the words of `rigwake.errors`."""

from __future__ import annotations

import errno
import os
import traceback

from rigwake.errors import HostError, RigwakeError

SHOW_TRACEBACK = "RIGWAKE_TRACEBACK"

_REMEDIES: dict[int, tuple[str, str]] = {
    errno.ENOSPC: ("the disk is full", "Free some space, or write to another disk with -o."),
    errno.EDQUOT: ("your quota of the disk is used up", "Free some space, or write to another disk with -o."),
    errno.EFBIG: (
        "the file would be larger than allowed",
        "Raise the limit (`ulimit -f`), or write elsewhere.",
    ),
    errno.EACCES: ("access is not permitted", "Change the permissions, or choose another path."),
    errno.EPERM: ("the system does not permit it", "Change the permissions, or choose another path."),
    errno.EROFS: ("it lies on a disk that can only be read", "Choose a path on another disk."),
    errno.ENOTDIR: ("a part of the path is a file, not a folder", "Choose another path."),
    errno.EISDIR: ("it is a folder, where a file is wanted", "Give the path of a file."),
    errno.ENOENT: ("it is not there", "Check the path; was it removed in the meantime?"),
    errno.EEXIST: ("it is already there", "Remove it, or choose another path."),
    errno.ENOTEMPTY: ("the folder is not empty", "Remove it, or choose another path."),
    errno.ENAMETOOLONG: ("the name is too long", "Choose a shorter path or shorter names of cameras."),
    errno.ELOOP: ("its symbolic links lead in a circle", "Give the path of the file itself."),
    errno.EMFILE: ("too many files are open", "Raise the limit (`ulimit -n 1024`), or use --jobs 1."),
    errno.ENFILE: ("too many files are open on this computer", "Close other programs and run it again."),
    errno.EIO: ("the disk reports a fault", "Check the disk and its cable; copy the recording elsewhere."),
    errno.ESTALE: ("the network share was lost", "Mount it again and run the command again."),
    errno.ENOMEM: ("no memory is left", "Close other programs, or use --jobs 1."),
    errno.EAGAIN: (
        "no more processes or threads may be started",
        "Raise the limit (`ulimit -u`), or use --jobs 1.",
    ),
    errno.EPIPE: ("whoever read the output is gone", "Run it again without the pipe."),
    errno.ENXIO: ("nobody reads from that pipe", "Start the reader first, or write to a file."),
}


def words_of(error: BaseException) -> RigwakeError:
    """The error in words: cause, consequence, remedy."""
    if isinstance(error, RigwakeError):
        return error
    if isinstance(error, OSError):
        return _words_of_system_error(error)
    if isinstance(error, MemoryError) or _is_memory_error_of_opencv(error):
        return HostError(
            "No memory is left.",
            consequence="The work was given up.",
            remedy="Close other programs, or use --jobs 1, or less of the recording (--duration 60).",
        )
    if isinstance(error, RuntimeError) and "cannot cache function" in str(error):
        return HostError(
            "There is no folder for compiled loops that can be written.",
            consequence="Nothing can be computed.",
            remedy="export NUMBA_CACHE_DIR=FOLDER, with a folder that only you can write.",
        )
    return _unexpected(error)


def _words_of_system_error(error: OSError) -> RigwakeError:
    path = error.filename2 or error.filename
    what = "Standard output" if path is None and error.errno in (errno.ENOSPC, errno.EPIPE) else "A file"
    what = what if path is None else str(path)
    why, remedy = _REMEDIES.get(
        error.errno or 0,
        (error.strerror or str(error) or type(error).__name__, "Check the path and the disk."),
    )
    return HostError(
        f"{what} cannot be read or written: {why}.",
        consequence="The work was given up; no file is half-written.",
        remedy=remedy,
    )


def _is_memory_error_of_opencv(error: BaseException) -> bool:
    return type(error).__module__ == "cv2" and getattr(error, "code", 0) == -4  # StsNoMem


def _unexpected(error: BaseException) -> RigwakeError:
    """An error of rigwake itself; its traceback is shown on request only."""
    if os.environ.get(SHOW_TRACEBACK):
        traceback.print_exception(error)
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if f"{os.sep}rigwake{os.sep}" in frame.filename] or frames
    where = f" ({os.path.basename(own[-1].filename)}, line {own[-1].lineno})" if own else ""
    return RigwakeError(
        f"rigwake met what it does not know: {type(error).__name__}: {str(error)[:300]}{where}.",
        consequence="This is an error of rigwake, or an input of a kind that it has never seen. Nothing was concluded.",
        remedy=f"Run it again with {SHOW_TRACEBACK}=1 before the command, and report what it prints.",
    )
