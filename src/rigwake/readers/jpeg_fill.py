"""JPEG images that end early but have an end marker: decoders fill what is missing with one grey, without a word."""

from __future__ import annotations

import cv2
import numpy as np

from rigwake._types import Image

_FILL = 128  # of all channels: blocks without data have no coefficients
_END = b"\xff\xd9"
_MORE = bytes(range(1, 255)) * 2


def is_filled_up(encoded: bytes, image: Image) -> bool:
    """Whether the decoder made up the lower part of this JPEG.

    A last row of the grey of empty blocks raises the suspicion (a grey border does, too); then the image is decoded
    with more data before its end: only a decoder that ran out of data takes notice of it.
    """
    if not encoded.startswith(b"\xff\xd8") or (image[-1] != _FILL).any():
        return False
    end = encoded.rfind(_END)
    prolonged = encoded[:end] + _MORE + encoded[end:]
    before, after = (
        cv2.imdecode(np.frombuffer(e, np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8) for e in (encoded, prolonged)
    )
    return before is None or after is None or not np.array_equal(before, after)
