"""Recordings packed as whole files (`.db3.zstd`, `.mcap.zstd`, `.bag.gz`, ...): unpacked once, within limits.

The unpacked file lies in the folder for temporary files until the program ends.
"""

from __future__ import annotations

import atexit
import bz2
import gzip
import lzma
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import IO, cast

import lz4.frame

from rigwake.errors import InputError
from rigwake.readers.channels import require_regular_file
from rigwake.readers.chunks import FREE_BYTES, MAX_RATIO
from rigwake.readers.zstandard_frames import MAGIC as ZSTD_MAGIC
from rigwake.readers.zstandard_frames import ZstdError, open_zstd

_BLOCK_BYTES = 2**20
_KEPT_FREE_BYTES = 2**28  # of the disk that holds temporary files


_OPENERS: dict[bytes, tuple[str, Callable[[IO[bytes]], IO[bytes]]]] = {
    ZSTD_MAGIC: ("zstd", open_zstd),
    b"\x1f\x8b": ("gzip", lambda file: cast("IO[bytes]", gzip.GzipFile(fileobj=file))),
    b"BZh": ("bzip2", lambda file: cast("IO[bytes]", bz2.BZ2File(file))),
    b"\xfd7zXZ\x00": ("xz", lambda file: cast("IO[bytes]", lzma.LZMAFile(file))),  # noqa: SIM115
    b"\x04\x22\x4d\x18": ("lz4", lambda file: cast("IO[bytes]", lz4.frame.LZ4FrameFile(file))),
}
PACKED_SUFFIXES = frozenset({".zstd", ".zst", ".gz", ".bz2", ".xz", ".lz4"})


def packing_of(path: Path) -> str | None:
    """How a file is packed as a whole (`zstd`, `gzip`, ...), by its first bytes; None if it is not."""
    require_regular_file(path)
    with path.open("rb") as file:
        start = file.read(8)
    return next((name for magic, (name, _) in _OPENERS.items() if start.startswith(magic)), None)


def unpacked_file(path: Path) -> tuple[Path, str]:
    """Where the unpacked content of a packed file lies, and what was wrong with it ('' if nothing).

    Content before a damaged place is kept. Raises InputError if nothing can be unpacked, if the content would be
    far larger than a recording can be packed, or does not fit onto the disk.
    """
    status = path.stat()
    return _unpacked_once(path.resolve(), status.st_size, status.st_mtime_ns)


@cache
def _unpacked_once(path: Path, stored_bytes: int, _modified_ns: int) -> tuple[Path, str]:
    folder = _temporary_folder(os.getpid())
    target = Path(tempfile.mkdtemp(dir=folder)) / path.stem
    room = shutil.disk_usage(folder).free - _KEPT_FREE_BYTES
    limit = FREE_BYTES + MAX_RATIO * stored_bytes
    written, problem = 0, ""
    with path.open("rb") as stored, target.open("wb") as unpacked:
        start = stored.read(8)
        stored.seek(0)
        opener = next(opener for magic, (_, opener) in _OPENERS.items() if start.startswith(magic))
        try:
            content = opener(stored)
            while block := content.read(_BLOCK_BYTES):
                written += len(block)
                if written > min(limit, room):
                    target.unlink()
                    raise _too_large(path, written > limit)
                unpacked.write(block)
        except (
            OSError,
            EOFError,
            ValueError,
            RuntimeError,
            lzma.LZMAError,
            zlib.error,
            ZstdError,
        ) as error:
            problem = f"{path.name} is cut off or damaged ({error}); what could be unpacked is kept."
    if not written:
        raise InputError(f"{path.name} cannot be unpacked. {problem}")
    return target, problem


def _too_large(path: Path, by_ratio: bool) -> InputError:
    if by_ratio:
        return InputError(f"{path.name} unpacks to far more than a recording packed into its size can hold.")
    return InputError(
        f"{path.name} does not fit onto the disk for temporary files when unpacked.",
        remedy="Unpack it yourself and open the result, or let TMPDIR name a folder with more room.",
    )


@cache
def _temporary_folder(process: int) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="rigwake-"))

    def remove() -> None:
        if os.getpid() == process:  # not in a forked child that ends
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


def private_copy(paths: list[Path]) -> Path:
    """Copies of files that belong together in a folder of their own; the path of the first.

    Raises InputError if they do not fit onto the disk.
    """
    folder = Path(tempfile.mkdtemp(dir=_temporary_folder(os.getpid())))
    if sum(path.stat().st_size for path in paths) > shutil.disk_usage(folder).free - _KEPT_FREE_BYTES:
        raise _too_large(paths[0], False)
    for path in paths:
        shutil.copyfile(path, folder / path.name)
    return folder / paths[0].name
