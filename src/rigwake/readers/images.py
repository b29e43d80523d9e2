"""Decoding of single images from untrusted bytes: sizes are read from the header before a pixel is decoded."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image
from rigwake.errors import InputError
from rigwake.readers.jpeg_fill import is_filled_up
from rigwake.readers.pixel_encodings import decode_pixels, eight_bits

MAX_PIXELS = 2**27
"""134 megapixels: above any machine-vision sensor, below what endangers memory."""

_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_JPEG_FRAME_MARKERS = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_JPEG_END = 0xD9
_JPEG_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]", re.DOTALL)  # neither data nor a restart


class ImageSize(NamedTuple):
    """Width and height in pixels."""

    width_px: int
    height_px: int


def checked_size(width_px: int, height_px: int) -> ImageSize:
    """The size, unless it is empty or larger than MAX_PIXELS (InputError)."""
    if width_px <= 0 or height_px <= 0 or width_px * height_px > MAX_PIXELS:
        raise InputError(
            f"An image claims {width_px} x {height_px} pixels.",
            consequence="It is not decoded.",
            remedy=f"Sizes from 1 up to {MAX_PIXELS} pixels are read.",
        )
    return ImageSize(width_px, height_px)


def compressed_size(encoded: bytes) -> ImageSize:
    """Size of a JPEG or PNG image from its header; InputError if it is neither, cut off or too large."""
    try:
        if encoded.startswith(_PNG) and encoded[12:16] == b"IHDR":
            return checked_size(*struct.unpack_from(">II", encoded, 16))
        if encoded.startswith(_JPEG):
            return _jpeg_size(encoded)
    except (struct.error, IndexError) as error:
        raise InputError("An image is cut off within its header.") from error
    raise InputError("A compressed image is neither JPEG nor PNG.")


def complete_size(encoded: bytes) -> ImageSize:
    """The same of an image that is whole; InputError also where its end is missing."""
    size = compressed_size(encoded)
    _check_complete(encoded)
    return size


def image_kind(encoded: bytes) -> str:
    """`jpeg`, `png`, or `deep png` for one of 16 bits per sample; InputError for anything else."""
    if is_deep_png(encoded):
        return "deep png"
    if encoded.startswith(_PNG):
        return "png"
    if encoded.startswith(_JPEG):
        return "jpeg"
    raise InputError("A compressed image is neither JPEG nor PNG.")


def _jpeg_size(encoded: bytes) -> ImageSize:
    at = 2
    while True:
        if encoded[at] != 0xFF:
            raise InputError("A JPEG header is damaged.")
        marker = encoded[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in _JPEG_FRAME_MARKERS:
            height_px, width_px = struct.unpack_from(">HH", encoded, at + 5)
            return checked_size(width_px, height_px)
        at += 2 + struct.unpack_from(">H", encoded, at + 2)[0]


def _check_complete(encoded: bytes) -> None:
    """Decoders fill what is missing with grey without a word, so ask for the end marker."""
    complete = _png_end(encoded) if encoded.startswith(_PNG) else _jpeg_end(encoded)
    if not complete:
        raise InputError("A compressed image is cut off.")


def _png_end(encoded: bytes) -> bool:
    """Whether the chunks of a PNG lead to its end; what follows it does not matter."""
    at = len(_PNG)
    while at + 12 <= len(encoded):
        (content_bytes,) = struct.unpack_from(">I", encoded, at)
        if encoded[at + 4 : at + 8] == b"IEND":
            return True
        at += 12 + content_bytes
    return False


def _jpeg_end(encoded: bytes) -> bool:
    """Whether the segments and scans of a JPEG lead to its end marker; what follows it does not matter.

    V4L2 drivers deliver whole buffers: behind the image stand zeros, or the rest of an earlier image.
    """
    at = 2
    while (found := _JPEG_MARKER.search(encoded, at)) is not None:
        marker = encoded[found.start() + 1]
        if marker == _JPEG_END:
            return True
        if found.start() + 4 > len(encoded):
            return False
        at = found.start() + 2 + struct.unpack_from(">H", encoded, found.start() + 2)[0]
    return False


def decode_compressed(encoded: bytes, *, colour: bool, used_bits: int | None = None) -> Image:
    """Decode a JPEG or PNG image as stored (EXIF rotation ignored: intrinsics refer to stored pixels).

    used_bits: of a PNG of 16 bits, how many are in use; the 8 highest of them are kept.
    Returns (H, W) grey, or (H, W, 3) BGR. Raises InputError if it is damaged, cut off or too large.
    """
    compressed_size(encoded)
    _check_complete(encoded)
    flags = (cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE) | cv2.IMREAD_IGNORE_ORIENTATION
    is_deep = used_bits is not None and is_deep_png(encoded)
    if is_deep:
        flags |= cv2.IMREAD_ANYDEPTH
    try:
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), flags)
    except cv2.error as error:
        raise InputError("A compressed image cannot be decoded.") from error
    if image is None:
        raise InputError("A compressed image cannot be decoded.")
    if is_filled_up(encoded, image):
        raise InputError("A compressed image is cut off, although it has an end marker.")
    return eight_bits(image, used_bits) if is_deep and used_bits and image.dtype == np.uint16 else image


def is_deep_png(encoded: bytes) -> bool:
    """Whether this is a PNG of 16 bits per sample."""
    return encoded.startswith(_PNG) and encoded[24:25] == b"\x10"


def decode_raw(
    pixels: NDArray[np.uint8],
    size: ImageSize,
    row_bytes: int,
    encoding: str,
    *,
    big_endian: bool,
    colour: bool,
    used_bits: int | None = None,
) -> Image:
    """Convert a ROS `sensor_msgs/Image` buffer; of deeper samples the 8 highest of `used_bits` are kept.

    Returns (H, W) grey, or (H, W, 3) BGR. Raises InputError if the buffer does not fit what is declared, or
    the encoding cannot be decoded.
    """
    return decode_pixels(
        pixels,
        checked_size(*size),
        row_bytes,
        encoding,
        big_endian=big_endian,
        colour=colour,
        used_bits=used_bits,
    )
