"""JPEG images that end early but have an end marker: decoders fill what is missing with one grey, without a word."""

from __future__ import annotations

import av
import av.error
import numpy as np

from rigwake._types import Image


def is_filled_up(encoded: bytes, image: Image) -> bool:
    """Whether the decoder made up the lower part of this JPEG.

    A last row of one value raises the suspicion (a dark border does, too); then a strict decoder is asked.
    """
    if (
        not encoded.startswith(b"\xff\xd8")
        or int(np.ptp(image[-1].reshape(-1, *image.shape[2:]), axis=0).max()) > 0
    ):
        return False
    try:
        context = av.CodecContext.create("mjpeg", "r")
        context.options = {"err_detect": "explode"}
        return not (context.decode(av.Packet(encoded)) or context.decode(None))
    except (av.error.FFmpegError, ValueError):
        return True
