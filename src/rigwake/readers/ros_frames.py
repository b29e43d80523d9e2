"""Camera images of ROS bags, decoded one at a time."""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image, Stamps
from rigwake.errors import InputError
from rigwake.readers.channels import Channel, Encoding
from rigwake.readers.images import (
    ImageSize,
    checked_size,
    complete_size,
    compressed_size,
    decode_compressed,
    decode_raw,
    is_deep_png,
)
from rigwake.readers.pixel_encodings import DEPTH_ENCODINGS, bits_in_use, plain_encoding, sample_bits
from rigwake.readers.ros_decoding import decode, read_header
from rigwake.recording import Frame

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = frozenset({RAW, COMPRESSED})
_ENCODED = ("jpeg", "jpg", "mjpeg", "mjpg", "png")  # drivers that put encoded images into a raw Image


@dataclass(frozen=True, eq=False)
class RosFrames:
    """Frames of an image topic: frame `i` is message `rows[i]` of the channel.

    Images of another size than `size` are left out: intrinsics could not hold for them. used_bits: of samples
    of more than 8 bits, how many hold data.
    """

    channel: Channel
    rows: Stamps
    timestamps_ns: Stamps
    size: ImageSize
    used_bits: int | None = None

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`."""
        wanted = np.asarray(indices, dtype=np.int64)
        payloads = self.channel.payloads.read(self.rows[wanted])
        for index, payload in zip(wanted, payloads, strict=True):
            try:
                channel = self.channel
                image = image_of_message(
                    payload, channel.message_type, channel.encoding, colour=colour, used_bits=self.used_bits
                )
            except InputError:
                continue
            if image.shape[:2] == (self.size.height_px, self.size.width_px):
                yield Frame(int(index), int(self.timestamps_ns[index]), image)

    @property
    def is_encoded(self) -> bool:
        """Whether this is a topic of compressed images."""
        return self.channel.message_type == COMPRESSED

    def encoded_frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[tuple[int, bytes]]:
        """See `EncodedFrameSource.encoded_frames`; nothing of a topic of raw images."""
        if not self.is_encoded:
            return
        wanted = np.asarray(indices, dtype=np.int64)
        for index, payload in zip(wanted, self.channel.payloads.read(self.rows[wanted]), strict=True):
            try:
                encoded = decode(payload, COMPRESSED, self.channel.encoding).data.tobytes()
                if complete_size(encoded) != self.size:
                    continue
            except InputError:
                continue
            yield int(index), encoded


def image_of_message(
    payload: bytes, message_type: str, encoding: Encoding, *, colour: bool, used_bits: int | None = None
) -> Image:
    """The image of a sensor_msgs Image or CompressedImage; InputError if it is damaged or too large."""
    message = decode(payload, message_type, encoding)
    if message_type == COMPRESSED or message.encoding.lower() in _ENCODED:
        return decode_compressed(message.data.tobytes(), colour=colour, used_bits=used_bits)
    return decode_raw(
        message.data,
        ImageSize(message.width, message.height),
        message.step,
        message.encoding,
        big_endian=bool(message.is_bigendian),
        colour=colour,
        used_bits=used_bits,
    )


class ImageFormat(NamedTuple):
    """What the first readable image of a topic says of all of them.

    encoding: as the driver names it. is_depth: its numbers are distances, not brightness.
    """

    size: ImageSize
    encoding: str
    is_depth: bool


def image_format(payload: bytes, channel: Channel) -> ImageFormat:
    """Size and encoding of the image in a message, without decoding pixels; InputError as `image_of_message`."""
    message = decode(payload, channel.message_type, channel.encoding)
    if channel.message_type == COMPRESSED:
        # image_transport writes `bgr8; jpeg compressed bgr8`, `16UC1; compressedDepth`; others `jpeg`, `png`
        encoding, _, transport = str(message.format).partition(";")
        encoding = encoding.strip()
        if encoding.lower() in DEPTH_ENCODINGS or "depth" in transport.lower():
            return ImageFormat(ImageSize(0, 0), encoding, True)
        return ImageFormat(compressed_size(message.data[: 2**16].tobytes()), encoding, False)
    encoding = str(message.encoding)
    is_deep_grey = encoding.strip().lower() in ("mono16", "y16") and "depth" in re.split(
        r"[/_]", channel.topic.lower()
    )
    if is_deep_grey or encoding.strip().lower() in DEPTH_ENCODINGS:
        return ImageFormat(checked_size(message.width, message.height), encoding, True)
    if encoding.lower() in _ENCODED:
        return ImageFormat(compressed_size(message.data[: 2**16].tobytes()), encoding, False)
    plain_encoding(encoding)
    return ImageFormat(checked_size(message.width, message.height), encoding, False)


def first_image_format(channel: Channel, rows: Stamps) -> ImageFormat:
    """Of the first image that can be read, of some spread over the recording; InputError if none can."""
    spread = rows[np.unique(np.linspace(0, len(rows) - 1, 20).astype(np.int64))]
    cause = "it has no images"
    for payload in channel.payloads.read(spread):
        try:
            return image_format(payload, channel)
        except InputError as error:
            cause = error.cause
    raise InputError(f"No image of {channel.topic} can be read: {cause}")


def other_formats(starts: Sequence[bytes], channel: Channel) -> int:
    """How many raw images differ from most in size, encoding, bytes per row or in all, from the first bytes of
    all messages.

    Of compressed images nothing is known before they are decoded.
    """
    if channel.message_type != RAW:
        return 0
    layouts = Counter(layout for start in starts if (layout := _raw_layout(start, channel)) is not None)
    return sum(layouts.values()) - max(layouts.values(), default=0)


def _raw_layout(start: bytes, channel: Channel) -> tuple[int, int, bytes, int, int] | None:
    """Height, width, encoding, bytes per row and in all; None if they do not lie within the first bytes."""
    header = read_header(start, channel.encoding)
    if header is None:
        return None
    is_cdr = channel.encoding == "cdr"  # which aligns numbers of four bytes
    order = ">" if is_cdr and not start[1] & 1 else "<"
    at = header.end + (-header.end % 4 if is_cdr else 0)
    try:
        height_px, width_px, count = struct.unpack_from(f"{order}III", start, at)
        name = start[at + 12 : at + 12 + count]
        at += 12 + count + 1
        step, size = struct.unpack_from(f"{order}II", start, at + (-at % 4 if is_cdr else 0))
    except struct.error:
        return None
    return height_px, width_px, name, step, size


def used_sample_bits(channel: Channel, rows: Stamps, encoding: str) -> int | None:
    """How many bits the samples of a topic of deep images use, of five spread over the recording.

    Sensors of 10, 12 or 14 bits are often recorded right-aligned in 16: the high byte alone would be all but
    black. None for images of 8 bits.
    """
    if channel.message_type == RAW and (encoding.lower() in _ENCODED or sample_bits(encoding) == 8):
        return None
    used = []
    for payload in channel.payloads.read(rows[np.unique(np.linspace(0, len(rows) - 1, 5).astype(np.int64))]):
        try:
            message = decode(payload, channel.message_type, channel.encoding)
            bits = _bits_of(message, channel)
        except InputError:
            continue
        if bits is None:
            return None
        used.append(bits)
    return max(used, default=None)


def _bits_of(message: Any, channel: Channel) -> int | None:
    if channel.message_type == RAW:
        stated = sample_bits(message.encoding)
        return bits_in_use(message.data, big_endian=bool(message.is_bigendian)) if stated == 16 else stated
    encoded = message.data.tobytes()
    if not is_deep_png(encoded):
        return None
    compressed_size(encoded)
    try:
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if image is None or image.dtype != np.uint16:
        return None
    return bits_in_use(np.ascontiguousarray(image).reshape(-1).view(np.uint8), big_endian=False)
