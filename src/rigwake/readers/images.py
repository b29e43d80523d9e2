"""Decoding of single images from untrusted bytes: sizes are read from the header before a pixel is decoded."""

from __future__ import annotations

import struct
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image
from rigwake.errors import InputError
from rigwake.readers.jpeg_fill import is_filled_up

MAX_PIXELS = 2**27
"""134 megapixels: above any machine-vision sensor, below what endangers memory."""

_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_JPEG_FRAME_MARKERS = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_TAIL_BYTES = 4096  # an end marker may be followed by padding

# ROS names a Bayer pattern by its first row, OpenCV 4 and 5 by the second
_BAYER_BGR = {
    "bayer_rggb": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg": cv2.COLOR_BayerGB2BGR,
}
_CHANNELS = {"mono": 1, "bgr": 3, "rgb": 3, "bgra": 4, "rgba": 4, **dict.fromkeys(_BAYER_BGR, 1)}
_GENERIC = {"8UC1": "mono8", "16UC1": "mono16", "8UC3": "bgr8", "8UC4": "bgra8", "16UC3": "bgr16"}


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
    end = b"IEND" if encoded.startswith(_PNG) else b"\xff\xd9"
    if end not in encoded[-_TAIL_BYTES:]:
        raise InputError("A compressed image is cut off.")


def decode_compressed(encoded: bytes, *, colour: bool) -> Image:
    """Decode a JPEG or PNG image as stored (EXIF rotation ignored: intrinsics refer to stored pixels).

    Returns (H, W) grey, or (H, W, 3) BGR. Raises InputError if it is damaged, cut off or too large.
    """
    compressed_size(encoded)
    _check_complete(encoded)
    flags = (cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE) | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), flags)
    except cv2.error as error:
        raise InputError("A compressed image cannot be decoded.") from error
    if image is None:
        raise InputError("A compressed image cannot be decoded.")
    if is_filled_up(encoded, image):
        raise InputError("A compressed image is cut off, although it has an end marker.")
    return image


def _pixel_layout(encoding: str) -> tuple[str, int, int]:
    """Name without bit depth, channels and bytes per sample of a ROS image encoding."""
    named = _GENERIC.get(encoding, encoding)
    name = named.rstrip("0123456789")
    bits = named.removeprefix(name)
    if name not in _CHANNELS or bits not in ("8", "16"):
        raise InputError(f"Image encoding {encoding!r} is not mono, bgr(a), rgb(a) or Bayer of 8 or 16 bit.")
    return name, _CHANNELS[name], int(bits) // 8


def decode_raw(
    pixels: NDArray[np.uint8],
    size: ImageSize,
    row_bytes: int,
    encoding: str,
    *,
    big_endian: bool,
    colour: bool,
) -> Image:
    """Convert a ROS `sensor_msgs/Image` buffer; of 16-bit samples the high byte is kept.

    Returns (H, W) grey, or (H, W, 3) BGR. Raises InputError if the buffer does not fit what is declared.
    """
    name, channels, sample_bytes = _pixel_layout(encoding)
    width_px, height_px = checked_size(*size)
    used = width_px * channels * sample_bytes
    row_bytes = row_bytes or used
    if row_bytes < used or len(pixels) < row_bytes * (height_px - 1) + used:
        raise InputError(f"An image of {width_px} x {height_px} {encoding} holds only {len(pixels)} bytes.")
    rows = np.lib.stride_tricks.as_strided(pixels, (height_px, used), (row_bytes, 1))
    samples = rows.reshape(height_px, width_px, channels, sample_bytes)
    image = samples[..., 0 if big_endian or sample_bytes == 1 else 1]
    return _converted(np.ascontiguousarray(image), name, colour=colour)


def _converted(image: Image, name: str, *, colour: bool) -> Image:
    if name == "mono":
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if colour else image[..., 0]
    if name in _BAYER_BGR:
        image = cv2.cvtColor(image[..., 0], _BAYER_BGR[name])
    elif name in ("rgb", "rgba", "bgra"):
        code = {"rgb": cv2.COLOR_RGB2BGR, "rgba": cv2.COLOR_RGBA2BGR}.get(name, cv2.COLOR_BGRA2BGR)
        image = cv2.cvtColor(image, code)
    return image if colour else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
