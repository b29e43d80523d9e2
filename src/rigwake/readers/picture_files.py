"""Images in files of any usual kind: JPEG, PNG, BMP, TIFF, PGM/PPM, WebP. Sizes are known before a pixel is decoded."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from rigwake._types import Image
from rigwake.errors import InputError
from rigwake.readers.images import ImageSize, checked_size, compressed_size, decode_compressed
from rigwake.readers.pixel_encodings import depth_of_sensor
from rigwake.text_files import require_file

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".webp"}
)
_TIFF = (b"II*\0", b"MM\0*")
_PNM = re.compile(
    rb"P([2356])(?:\s|#[^\n]*\n)+(\d{1,6})(?:\s|#[^\n]*\n)+(\d{1,6})(?:\s|#[^\n]*\n)+(\d{1,5})\s"
)
_ORIENTATION, _WIDTH, _HEIGHT = 0x0112, 0x0100, 0x0101
_SWAPPED = (5, 6, 7, 8)
_LARGEST_BYTES = 2**30


def picture_size(encoded: bytes) -> ImageSize:
    """Size as stored, from the header. Raises InputError if it is no known image, cut off or too large."""
    try:
        if encoded.startswith(b"BM"):
            width_px, height_px = struct.unpack_from("<ii", encoded, 18)
            return checked_size(width_px, abs(height_px))
        if encoded.startswith(_TIFF):
            tags = _tiff_tags(encoded)
            return checked_size(tags.get(_WIDTH, 0), tags.get(_HEIGHT, 0))
        if encoded[:4] == b"RIFF" and encoded[8:12] == b"WEBP":
            return _webp_size(encoded)
        pnm = _PNM.match(encoded[:512])
        if pnm is not None:
            return checked_size(int(pnm[2]), int(pnm[3]))
    except (struct.error, IndexError) as error:
        raise InputError("An image is cut off within its header.") from error
    return compressed_size(encoded)


def picture_or_none(path: Path, flags: int = cv2.IMREAD_GRAYSCALE) -> Image | None:
    """What `cv2.imread` gives for a regular file, None for anything else. OpenCV never sees the path: where the locale
    has no words for its characters it ends the process."""
    try:
        require_file(path)
        if path.stat().st_size > _LARGEST_BYTES:
            return None
        encoded = path.read_bytes()
        picture_size(encoded)
        return _decoded(encoded, flags)
    except (InputError, OSError):
        return None


def orientation_of(encoded: bytes) -> int:
    """The orientation of EXIF (1: as stored; 5 to 8: turned by a quarter) of a JPEG or TIFF, 1 if it says none."""
    try:
        if encoded.startswith(_TIFF):
            return _tiff_tags(encoded).get(_ORIENTATION, 1)
        at = encoded.find(b"Exif\0\0", 0, 65536)
        if encoded.startswith(b"\xff\xd8") and at > 0 and encoded[at + 6 : at + 10] in _TIFF:
            return _tiff_tags(encoded[at + 6 : at + 6 + 65536]).get(_ORIENTATION, 1)
    except (struct.error, IndexError):
        pass
    return 1


def swaps_sides(orientation: int) -> bool:
    """Whether an orientation of EXIF shows width as height."""
    return orientation in _SWAPPED


def decode_picture(encoded: bytes, *, colour: bool, used_bits: int = 0, upright: bool = False) -> Image:
    """(H, W) grey or (H, W, 3) BGR of an image file.

    used_bits: of 16-bit samples, how many are in use; the 8 highest of them are kept. upright: turned as EXIF says,
    else as stored. Raises InputError if it is damaged, cut off or too large.
    """
    picture_size(encoded)
    is_plain = encoded.startswith((b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"))
    if is_plain and not used_bits and not upright:
        return decode_compressed(encoded, colour=colour)
    if is_plain:
        decode_compressed(encoded, colour=colour)  # checks that it is whole
    else:
        _check_whole(encoded)
    flags = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
    flags |= 0 if upright else cv2.IMREAD_IGNORE_ORIENTATION
    return eight_bits(_decoded(encoded, flags | cv2.IMREAD_ANYDEPTH), used_bits)


def _decoded(encoded: bytes, flags: int) -> Image:
    try:
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), flags)
    except cv2.error as error:
        raise InputError("An image cannot be decoded.") from error
    if image is None:
        raise InputError("An image cannot be decoded.")
    return image


def eight_bits(image: np.ndarray[tuple[int, ...], np.dtype[np.generic]], used_bits: int) -> Image:
    """The 8 highest of the used bits; InputError for samples that are neither 8 nor 16 bits (depth, floats)."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    if image.dtype != np.uint16:
        raise InputError(f"An image holds {image.dtype} samples: depth or other measurements are no picture.")
    return np.minimum(image.astype(np.uint16) >> max((used_bits or 16) - 8, 0), 255).astype(np.uint8)


def is_deep(encoded: bytes) -> bool:
    """Whether an image may have samples of more than 8 bits."""
    if encoded.startswith(b"\x89PNG\r\n\x1a\n"):
        return encoded[24:25] == b"\x10"
    pnm = _PNM.match(encoded[:512])
    return encoded.startswith(_TIFF) or (pnm is not None and int(pnm[4]) > 255)


def bits_in_use(pictures: Iterable[bytes]) -> int:
    """Bits that the brightest of some 16-bit pictures use: 10, 12, 14 or 16; 0 if they are of 8 bits."""
    largest = 0
    for encoded in pictures:
        try:
            picture_size(encoded)
            image = _decoded(
                encoded, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
            )
        except InputError:
            continue
        if image.dtype == np.uint16:
            largest = max(largest, int(np.percentile(image, 99.99)))
    return depth_of_sensor(largest) if largest else 0


def _check_whole(encoded: bytes) -> None:
    """Formats whose header says how long they are; decoders fill up what is missing without a word."""
    pnm = _PNM.match(encoded[:512])
    if encoded.startswith(b"BM"):
        (announced,) = struct.unpack_from("<I", encoded, 2)
    elif pnm is not None and pnm[1] in b"56":
        samples = int(pnm[2]) * int(pnm[3]) * (3 if pnm[1] == b"6" else 1)
        announced = pnm.end() + samples * (2 if int(pnm[4]) > 255 else 1)
    elif encoded[:4] == b"RIFF":
        announced = 8 + struct.unpack_from("<I", encoded, 4)[0]
    else:
        return
    if len(encoded) < announced:
        raise InputError("An image is cut off.")


def _tiff_tags(encoded: bytes) -> dict[int, int]:
    """Whole-number tags of the first directory of a TIFF (or of the EXIF part of a JPEG)."""
    order = "<" if encoded.startswith(b"II") else ">"
    (at,) = struct.unpack_from(order + "I", encoded, 4)
    (count,) = struct.unpack_from(order + "H", encoded, at)
    tags = {}
    for entry in range(at + 2, at + 2 + 12 * min(count, 512), 12):
        tag, kind, length = struct.unpack_from(order + "HHI", encoded, entry)
        if length == 1 and kind in (3, 4):
            (tags[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), encoded, entry + 8)
    return tags


def _webp_size(encoded: bytes) -> ImageSize:
    if encoded[12:16] == b"VP8X":
        return checked_size(
            1 + int.from_bytes(encoded[24:27], "little"), 1 + int.from_bytes(encoded[27:30], "little")
        )
    if encoded[12:16] == b"VP8L":
        (bits,) = struct.unpack_from("<I", encoded, 21)
        return checked_size(1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF))
    width_px, height_px = struct.unpack_from("<HH", encoded, 26)
    return checked_size(width_px & 0x3FFF, height_px & 0x3FFF)
