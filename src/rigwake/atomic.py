"""Files that are either whole or not there."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TEMPORARY_PREFIX = ".rigwake-tmp-"
_LONGEST_STEM = (
    40  # of a temporary name, in characters: the whole name must fit a file system's limit of 255 bytes
)


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """A temporary path beside `path`; renamed to it on success, removed on failure.

    The temporary name keeps the suffix, for writers that choose a format by it. The content has reached the disk
    before the name does. A symbolic link stays one: the file it points to is replaced. What is no regular file (a
    pipe, a terminal, /dev/null) is never replaced: the content is copied into it.
    """
    target = Path(path)
    if _takes_content_only(target):
        with _copied_into(target) as temporary:
            yield temporary
        return
    target = Path(os.path.realpath(target))
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    prefix = f"{TEMPORARY_PREFIX}{target.stem[:_LONGEST_STEM]}-"
    descriptor, name = tempfile.mkstemp(
        dir=target.parent, prefix=prefix, suffix=target.suffix[-_LONGEST_STEM:]
    )
    os.close(descriptor)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        _reach_disk(temporary)
        temporary.replace(target)
        _reach_disk(target.parent)
    except OSError as error:  # a full disk does not say which file did not fit; nobody knows temporary names
        if error.filename is None or str(error.filename) == str(temporary):
            error.filename = str(target)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text_atomic(path: Path | str, text: str) -> None:
    """Write UTF-8 text so that `path` is never half-written; bytes of names that are no text are written out."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def remove_leftovers(folder: Path) -> int:
    """Remove the temporary files that a killed run left below `folder`, if no other run uses it; their number."""
    removed = 0
    for path in folder.rglob(f"{TEMPORARY_PREFIX}*"):
        with contextlib.suppress(OSError):
            if stat.S_ISREG(path.lstat().st_mode):
                path.unlink()
                removed += 1
    return removed


def _takes_content_only(target: Path) -> bool:
    """Whether the target is there and is neither a regular file nor a folder, or belongs to an open file."""
    try:
        mode = target.stat().st_mode
    except OSError:
        return False
    is_open_file = target.is_symlink() and target.absolute().parts[:2] in (("/", "dev"), ("/", "proc"))
    return is_open_file or not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


@contextmanager
def _copied_into(target: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="rigwake-") as folder:
        temporary = Path(folder) / f"content{target.suffix}"
        temporary.touch()
        yield temporary
        try:
            with temporary.open("rb") as content, target.open("wb") as file:
                shutil.copyfileobj(content, file)
        except OSError as error:
            error.filename = str(target)
            raise


def _reach_disk(path: Path) -> None:
    """Wait until the file or the entries of the folder are on the disk; not every file system can say so."""
    if path.is_dir() and os.name == "nt":
        return  # folders cannot be opened there
    try:
        descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EROFS):
            raise
    finally:
        os.close(descriptor)
