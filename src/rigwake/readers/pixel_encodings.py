"""Pixel encodings of ROS images: what each name means, and the pixels of one image.

Names as in `sensor_msgs/image_encodings.h` of ROS 1 and ROS 2, and those that V4L2, GStreamer and GenICam
drivers write into the same field.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image
from rigwake.errors import InputError

Buffer = NDArray[np.uint8]

DEPTH_ENCODINGS = frozenset({"16uc1", "32fc1", "64fc1", "16sc1", "32sc1"})
"""Encodings of one number per pixel that is not a brightness: distances, disparities, labels."""

_ALIASES = {
    "8uc1": "mono8",
    "16uc1": "mono16",
    "8uc3": "bgr8",
    "8uc4": "bgra8",
    "16uc3": "bgr16",
    "16uc4": "bgra16",
    "grey": "mono8",
    "gray": "mono8",
    "gray8": "mono8",
    "grey8": "mono8",
    "gray16": "mono16",
    "grey16": "mono16",
    "y8": "mono8",
    "y10": "mono10",
    "y12": "mono12",
    "y16": "mono16",
    "mono": "mono8",
    "rgb": "rgb8",
    "bgr": "bgr8",
    "rgba": "rgba8",
    "bgra": "bgra8",
    "yuv422": "uyvy",
    "yuv422_uyvy": "uyvy",
    "yuv422_yuy2": "yuyv",
    "yuv422_yuyv": "yuyv",
    "yuy2": "yuyv",
    "i420": "yuv420",
    "yuv420p": "yuv420",
    "nv12_8": "nv12",
}
# packed 4:2:2: offset of the brightness in each pair of bytes, and OpenCV's conversion to colour
_PACKED_YUV = {
    "uyvy": (1, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": (0, cv2.COLOR_YUV2BGR_YUYV),
    "yvyu": (0, cv2.COLOR_YUV2BGR_YVYU),
}
# planar 4:2:0: a plane of brightness, then half as many bytes of colour
_PLANAR_YUV = {
    "nv12": cv2.COLOR_YUV2BGR_NV12,
    "nv21": cv2.COLOR_YUV2BGR_NV21,
    "yuv420": cv2.COLOR_YUV2BGR_I420,
    "yv12": cv2.COLOR_YUV2BGR_YV12,
}
# ROS names a Bayer pattern by its first row, OpenCV 4 and 5 by the second
_BAYER_BGR = {
    "bayer_rggb": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg": cv2.COLOR_BayerGB2BGR,
}
_CHANNELS = {"mono": 1, "bgr": 3, "rgb": 3, "bgra": 4, "rgba": 4, **dict.fromkeys(_BAYER_BGR, 1)}
_SAMPLED = re.compile(r"(?P<name>[a-z_]+?)(?P<bits>8|10|12|14|16)(?P<packed>p|packed)?")


class Samples(NamedTuple):
    """An encoding of separate samples: its name without depth, channels, bits of a sample, whether packed."""

    name: str
    channels: int
    bits: int
    packed: bool


def plain_encoding(encoding: str) -> str:
    """The encoding's one name here; InputError, which names it, if it cannot be decoded."""
    wanted = encoding.strip().lower()
    name = _ALIASES.get(wanted, wanted)
    if name not in _PACKED_YUV and name not in _PLANAR_YUV and _samples(name) is None:
        raise InputError(
            f"Image encoding {encoding[:40]!r} cannot be decoded.",
            remedy="Known are mono, bgr(a), rgb(a) and Bayer of 8 to 16 bit, YUV 4:2:2 and 4:2:0.",
        )
    return name


def _samples(name: str) -> Samples | None:
    match = _SAMPLED.fullmatch(name)
    if match is None or match["name"] not in _CHANNELS:
        return None
    channels = _CHANNELS[match["name"]]
    packed = match["packed"] is not None
    if packed and (channels != 1 or match["bits"] not in ("10", "12")):
        return None
    return Samples(match["name"], channels, int(match["bits"]), packed)


def sample_bits(encoding: str) -> int:
    """Bits of a sample as the encoding states them: 8 for every YUV encoding."""
    found = _samples(plain_encoding(encoding))
    return 8 if found is None else found.bits


def bits_in_use(pixels: Buffer, *, big_endian: bool) -> int:
    """How many bits 16-bit samples use: 10, 12 or 14 where data is right-aligned in them, 16 otherwise.

    Data of 8 bits or fewer count as 8. The largest sample decides; one hot pixel in a million is ignored.
    """
    samples = pixels[: len(pixels) // 2 * 2].view(">u2" if big_endian else "<u2")
    if not len(samples):
        return 16
    keep = len(samples) - 1 - len(samples) // 1_000_000
    largest = int(np.partition(samples, keep)[keep])
    return depth_of_sensor(largest, least=8)


def depth_of_sensor(largest: int, *, least: int = 10) -> int:
    """Bits of the sensor whose largest sample is this: one of 8, 10, 12, 14, 16, and at least `least`."""
    return next((bits for bits in (8, 10, 12, 14) if bits >= least and largest < 1 << bits), 16)


def decode_pixels(
    pixels: Buffer,
    size: tuple[int, int],
    row_bytes: int,
    encoding: str,
    *,
    big_endian: bool,
    colour: bool,
    used_bits: int | None = None,
) -> Image:
    """(H, W) grey or (H, W, 3) BGR from the buffer of an image of size (width, height).

    used_bits: of samples of 16 bits, how many are in use; the 8 highest of them are kept. The brightness of YUV
    is taken as it is. Raises InputError if the buffer does not fit what is declared.
    """
    name = plain_encoding(encoding)
    width_px, height_px = size
    if name in _PACKED_YUV:
        return _packed_yuv(_rows(pixels, size, row_bytes, 2 * width_px, encoding), size, name, colour)
    if name in _PLANAR_YUV:
        return _planar_yuv(pixels, size, row_bytes, name, encoding, colour)
    samples = _samples(name)
    assert samples is not None
    count = width_px * samples.channels
    if samples.packed or (samples.bits in (10, 12) and samples.channels == 1 and 0 < row_bytes < 2 * count):
        used = (count * samples.bits + 7) // 8
        image = _unpacked(_rows(pixels, size, row_bytes, used, encoding), width_px, samples)[..., None]
    elif samples.bits == 8:
        image = _rows(pixels, size, row_bytes, count, encoding).reshape(height_px, width_px, samples.channels)
    else:
        rows = np.ascontiguousarray(_rows(pixels, size, row_bytes, 2 * count, encoding))
        values = rows.view(">u2" if big_endian else "<u2").reshape(height_px, width_px, samples.channels)
        image = eight_bits(values, used_bits or samples.bits)
    return _converted(np.ascontiguousarray(image), samples.name, colour=colour)


def eight_bits(values: NDArray[np.uint16], used_bits: int) -> Image:
    """The 8 highest bits of `used_bits`; larger values are white."""
    if used_bits == 16:
        return (values >> 8).astype(np.uint8)
    return np.minimum(values >> (used_bits - 8), 255).astype(np.uint8)


def _rows(pixels: Buffer, size: tuple[int, int], row_bytes: int, used: int, encoding: str) -> Buffer:
    """(H, used) the bytes of each row, without its padding."""
    width_px, height_px = size
    row_bytes = row_bytes or used
    if row_bytes < used or len(pixels) < row_bytes * (height_px - 1) + used:
        raise InputError(f"An image of {width_px} x {height_px} {encoding} holds only {len(pixels)} bytes.")
    return np.lib.stride_tricks.as_strided(pixels, (height_px, used), (row_bytes, 1))


def _packed_yuv(rows: Buffer, size: tuple[int, int], name: str, colour: bool) -> Image:
    offset, code = _PACKED_YUV[name]
    if not colour:
        return np.ascontiguousarray(rows[:, offset::2])
    width_px, height_px = size
    if width_px % 2:
        raise InputError(f"A {name} image has an odd width of {width_px} pixels.")
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows).reshape(height_px, width_px, 2), code))


def _planar_yuv(
    pixels: Buffer, size: tuple[int, int], row_bytes: int, name: str, encoding: str, colour: bool
) -> Image:
    """Drivers state the row of the brightness, of all planes together (1.5 widths), or nothing."""
    width_px, height_px = size
    padded = row_bytes if row_bytes > width_px and len(pixels) >= row_bytes * height_px * 3 // 2 else width_px
    if not colour:
        return np.ascontiguousarray(_rows(pixels, size, padded, width_px, encoding))
    if width_px % 2 or height_px % 2:
        raise InputError(f"A {name} image has an odd size of {width_px} x {height_px} pixels.")
    all_rows = (width_px, height_px * 3 // 2)
    planes = _rows(pixels, all_rows, padded, width_px, encoding)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(planes), _PLANAR_YUV[name]))


def _unpacked(rows: Buffer, width_px: int, samples: Samples) -> Image:
    """Samples of 10 or 12 bits that follow one another without gaps, least significant bits first (PFNC)."""
    bits = np.unpackbits(rows, axis=1, bitorder="little")[:, : width_px * samples.bits]
    weights = (1 << np.arange(samples.bits)).astype(np.uint16)
    values = (bits.reshape(len(rows), width_px, samples.bits) * weights).sum(axis=2, dtype=np.uint16)
    return eight_bits(values, samples.bits)


def _converted(image: Image, name: str, *, colour: bool) -> Image:
    if name == "mono":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)) if colour else image[..., 0]
    if name in _BAYER_BGR:
        image = np.asarray(cv2.cvtColor(image[..., 0], _BAYER_BGR[name]))
    elif name in ("rgb", "rgba", "bgra"):
        code = {"rgb": cv2.COLOR_RGB2BGR, "rgba": cv2.COLOR_RGBA2BGR}.get(name, cv2.COLOR_BGRA2BGR)
        image = np.asarray(cv2.cvtColor(image, code))
    return image if colour else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
