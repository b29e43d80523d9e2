"""What identifies an input of a calibration, and whether it stays the same while it is read."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rigwake.errors import InputError, RigwakeError

_MOST_BYTES = 2 << 30  # read in all; more is sampled evenly
_BLOCK = 1 << 20
_LEAST_PER_FILE = 1 << 16


def input_fingerprint(path: Path, most_bytes: int = _MOST_BYTES) -> dict[str, Any]:
    """What identifies an input: name, size, and SHA-256 of its content (of a folder: of names, sizes and contents).

    Every byte counts up to `most_bytes`. Of a larger input, blocks are hashed that lie evenly over every file, its
    first and last bytes among them, and `hashed_bytes` says how many. Raises OSError.
    """
    digest = hashlib.sha256()
    files = _files_of(path)
    total = sum(size for _, size in files)
    hashed = 0
    for file, size in files:
        if file != path:
            digest.update(f"{file.relative_to(path)} {size}\n".encode(errors="surrogateescape"))
        hashed += _add_content(digest, file, size, max(_LEAST_PER_FILE, most_bytes * size // max(total, 1)))
    content: dict[str, Any] = {"path": path.name, "bytes": total, "sha256": digest.hexdigest()}
    return content if hashed >= total else content | {"hashed_bytes": hashed}


def files_changed_at(path: Path) -> str:
    """Hash of names, sizes and times of change of the file, or of all files of the folder. Raises OSError."""
    digest = hashlib.sha256()
    for file, size in _files_of(path):
        digest.update(f"{file} {size} {file.stat().st_mtime_ns}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


@contextmanager
def unchanged(path: Path) -> Iterator[Callable[[], None]]:
    """Yields a check that raises InputError if the input has changed since; an error within is replaced by that one
    if the input has changed."""
    before = _state(path)
    try:
        yield lambda: _compare(path, before, None)
    except (RigwakeError, OSError, ValueError, IndexError, EOFError) as error:
        _compare(path, before, error)
        raise


def _state(path: Path) -> str | None:
    try:
        return files_changed_at(path)
    except OSError:
        return None


def _compare(path: Path, before: str | None, error: Exception | None) -> None:
    if before is None:
        return
    after = _state(path)
    if after != before:
        raise InputError(
            f"{path} {'was removed' if not path.exists() else 'changed'} while it was read.",
            consequence="What was read does not belong together.",
            remedy="Wait until the recording is complete, or copy it, and run the command again.",
        ) from error


def _files_of(path: Path) -> list[tuple[Path, int]]:
    """Every regular file and its size, in a fixed order."""
    if not path.is_dir():
        return [(path, path.stat().st_size)]
    found = []
    for folder, _, names in os.walk(path):
        files = [Path(folder) / name for name in names]
        found += [(file, file.stat().st_size) for file in files if file.is_file()]
    return sorted(found)


def _add_content(digest: Any, file: Path, size: int, most_bytes: int) -> int:
    """Hash the file, or blocks of it that lie evenly from its first to its last byte; how many bytes."""
    hashed = 0
    with file.open("rb") as handle:
        if size <= most_bytes:
            while block := handle.read(_BLOCK):
                digest.update(block)
                hashed += len(block)
            return hashed
        length = min(_BLOCK, most_bytes // 2)
        count = max(2, most_bytes // length)
        for k in range(count):
            handle.seek((size - length) * k // (count - 1))
            block = handle.read(length)
            digest.update(block)
            hashed += len(block)
    return hashed
