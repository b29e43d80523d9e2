"""Encoded images of a camera for a writer: bytes that the recording holds are handed on, others are encoded."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import cv2
import numpy as np

from rigwake._types import Image
from rigwake.errors import InputError
from rigwake.readers.images import image_kind
from rigwake.recording import CameraStream, EncodedFrameSource, Finding

ImageEncoding = Literal["copy", "jpeg", "png", "raw"]


def encode_image(image: Image, encoding: str) -> bytes:
    """JPEG (quality 95) or PNG bytes; InputError if the image cannot be encoded."""
    suffix, options = {
        "jpeg": (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 95]),
        "png": (".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]),
    }[encoding]
    worked, encoded = cv2.imencode(suffix, image, options)
    if not worked:
        raise InputError(f"An image of shape {image.shape} cannot be encoded as {encoding}.")
    return encoded.tobytes()


def is_grey(camera: CameraStream) -> bool:
    """Whether the camera's first readable image has three equal channels."""
    for frame in camera.frames(colour=True):
        image = frame.image
        return bool((image[..., 0] == image[..., 1]).all() and (image[..., 1] == image[..., 2]).all())
    return True


def _stored_kind(camera: CameraStream) -> str | None:
    """How the first image that can be handed on is encoded in the recording; None if none is."""
    source = camera.source
    if not isinstance(source, EncodedFrameSource) or not source.is_encoded:
        return None
    for _, encoded in source.encoded_frames(np.arange(min(len(camera), 20))):
        return image_kind(encoded)
    return None


def encoded_images(camera: CameraStream, encoding: ImageEncoding) -> Iterator[tuple[int, bytes]]:
    """Stamp and encoded image of every frame. `copy`, or an encoding that the images have already: as they are.

    `copy` encodes others as JPEG; PNG of 16 bits are never handed on, since their bits in use are known here only.
    """
    kind = _stored_kind(camera)
    source = camera.source
    if kind in ("jpeg", "png") and encoding in ("copy", kind) and isinstance(source, EncodedFrameSource):
        for index, encoded in source.encoded_frames(np.arange(len(camera))):
            yield int(camera.timestamps_ns[index]), encoded
        return
    target = "jpeg" if encoding == "copy" else encoding
    for frame in camera.frames(colour=not is_grey(camera)):
        yield frame.timestamp_ns, encode_image(frame.image, target)


def lossy_remark(camera: CameraStream, encoding: ImageEncoding) -> list[Finding]:
    """Says so where images that are not JPEG become JPEG."""
    if encoding not in ("copy", "jpeg") or _stored_kind(camera) in (
        ("jpeg", "png") if encoding == "copy" else ("jpeg",)
    ):
        return []
    words = "its images are encoded as JPEG of quality 95, which loses a little; png loses nothing."
    return [Finding("note", camera.name, words)]


def file_suffix(encoded: bytes) -> str:
    """`.jpg` or `.png`, by the content."""
    return ".jpg" if image_kind(encoded) == "jpeg" else ".png"
