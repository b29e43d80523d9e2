"""Camera images of ROS bags, decoded one at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image, Stamps
from rigwake.errors import InputError
from rigwake.readers.channels import Channel
from rigwake.readers.images import ImageSize, checked_size, compressed_size, decode_compressed, decode_raw
from rigwake.readers.ros_decoding import decode
from rigwake.recording import Frame

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = frozenset({RAW, COMPRESSED})


@dataclass(frozen=True, eq=False)
class RosFrames:
    """Frames of an image topic: frame `i` is message `rows[i]` of the channel.

    Images of another size than `size` are left out: intrinsics could not hold for them.
    """

    channel: Channel
    rows: Stamps
    timestamps_ns: Stamps
    size: ImageSize

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`."""
        wanted = np.asarray(indices, dtype=np.int64)
        payloads = self.channel.payloads.read(self.rows[wanted])
        for index, payload in zip(wanted, payloads, strict=True):
            try:
                image = decode_image(payload, self.channel, colour=colour)
            except InputError:
                continue
            if image.shape[:2] == (self.size.height_px, self.size.width_px):
                yield Frame(int(index), int(self.timestamps_ns[index]), image)


def decode_image(payload: bytes, channel: Channel, *, colour: bool) -> Image:
    """The image of a sensor_msgs Image or CompressedImage; InputError if it is damaged or too large."""
    message = decode(payload, channel.message_type, channel.encoding)
    if channel.message_type == COMPRESSED:
        return decode_compressed(message.data.tobytes(), colour=colour)
    size = ImageSize(message.width, message.height)
    return decode_raw(
        message.data,
        size,
        message.step,
        message.encoding,
        big_endian=bool(message.is_bigendian),
        colour=colour,
    )


def image_size(payload: bytes, channel: Channel) -> ImageSize:
    """Size of the image in a message, without decoding pixels; InputError as `decode_image`."""
    message = decode(payload, channel.message_type, channel.encoding)
    if channel.message_type == COMPRESSED:
        return compressed_size(message.data[: 2**16].tobytes())
    return checked_size(message.width, message.height)


def first_image_size(channel: Channel, rows: Stamps) -> ImageSize:
    """Size of the first image that can be read, of some spread over the recording; InputError if none can."""
    spread = rows[np.unique(np.linspace(0, len(rows) - 1, 20).astype(np.int64))]
    cause = "it has no images"
    for payload in channel.payloads.read(spread):
        try:
            return image_size(payload, channel)
        except InputError as error:
            cause = error.cause
    raise InputError(f"No image of {channel.topic} can be read: {cause}")
