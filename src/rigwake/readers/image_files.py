"""Cameras whose frames are image files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Stamps
from rigwake.errors import InputError
from rigwake.readers.images import ImageSize, complete_size, image_kind
from rigwake.readers.picture_files import (
    IMAGE_SUFFIXES,
    bits_in_use,
    decode_picture,
    is_deep,
    orientation_of,
    picture_size,
)
from rigwake.recording import Frame
from rigwake.text_files import require_file

_MAX_FILE_BYTES = 2**29


def natural_order(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    """Sort key under which `frame2.png` comes before `frame10.png`."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isascii() and part.isdigit() else (1, part) for part in parts], path.name


def image_files(folder: Path) -> list[Path]:
    """The image files directly in a folder, in natural order."""
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return sorted(found, key=natural_order)


def read_bytes(path: Path) -> bytes:
    """The content of an image file; InputError if it cannot be read or is absurdly large."""
    try:
        return require_file(path, _MAX_FILE_BYTES).read_bytes()
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}).") from error


@dataclass(frozen=True, eq=False)
class FileFrames:
    """One image file per frame. Images of another size than `size` are left out.

    used_bits: of 16-bit samples, how many are in use. upright: images are turned as EXIF says; else as stored.
    """

    folder: Path
    names: tuple[str, ...]
    timestamps_ns: Stamps
    size: ImageSize
    used_bits: int = 0
    upright: bool = False

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`."""
        for index in indices:
            try:
                encoded = read_bytes(self.folder / self.names[index])
                image = decode_picture(encoded, colour=colour, used_bits=self.used_bits, upright=self.upright)
            except InputError:
                continue
            if image.shape[:2] == (self.size.height_px, self.size.width_px):
                yield Frame(int(index), int(self.timestamps_ns[index]), image)

    @property
    def is_encoded(self) -> bool:
        """Whether the first file is a JPEG or a PNG."""
        try:
            return bool(self.names) and image_kind(read_bytes(self.folder / self.names[0])) != ""
        except InputError:
            return False

    def encoded_frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[tuple[int, bytes]]:
        """See `EncodedFrameSource.encoded_frames`."""
        for index in indices:
            try:
                encoded = read_bytes(self.folder / self.names[index])
                if complete_size(encoded) != self.size:
                    continue
            except InputError:
                continue
            yield int(index), encoded


def _spread(paths: Sequence[Path], count: int) -> list[Path]:
    return [paths[at] for at in np.unique(np.linspace(0, len(paths) - 1, count).astype(int))] if paths else []


def first_file_size(paths: Sequence[Path]) -> ImageSize:
    """Size of the first image whose header can be read, of some spread over the folder; InputError if none."""
    return _first_readable(paths)[0]


def _first_readable(paths: Sequence[Path]) -> tuple[ImageSize, bytes]:
    cause = "there are no images"
    for path in _spread(paths, 20):
        try:
            encoded = read_bytes(path)
            return picture_size(encoded), encoded
        except InputError as error:
            cause = error.cause
    raise InputError(f"No image can be read: {cause}")


def file_frames(folder: Path, names: Sequence[str], stamps: Stamps) -> tuple[FileFrames, int]:
    """Frames of the files of a folder as they are stored, and their EXIF orientation (1: as stored).

    Raises InputError if none can be read.
    """
    size, encoded = _first_readable([folder / name for name in names])
    samples = []
    for path in _spread([folder / name for name in names], 5):
        try:
            samples.append(read_bytes(path))
        except InputError:
            continue
    deep = [sample for sample in samples if is_deep(sample)]
    return FileFrames(folder, tuple(names), stamps, size, bits_in_use(deep)), orientation_of(encoded)
