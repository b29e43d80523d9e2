"""Content packed with Zstandard (RFC 8878), within limits: no frame may ask for more than 128 MB at once."""

from __future__ import annotations

import sys
from typing import IO, Any, cast

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZstdError = zstd.ZstdError
MAGIC = b"\x28\xb5\x2f\xfd"
_OPTIONS: dict[Any, int] = {zstd.DecompressionParameter.window_log_max: 27}


def unpack_zstd(stored: bytes, limit_bytes: int) -> bytes:
    """Up to `limit_bytes` of the content of a frame, less where it is cut off. Raises ZstdError if it is damaged."""
    return zstd.ZstdDecompressor(options=_OPTIONS).decompress(stored, limit_bytes)


def open_zstd(file: IO[bytes]) -> IO[bytes]:
    """The content of a file of frames; reading raises ZstdError or EOFError where it is damaged or cut off."""
    return cast("IO[bytes]", zstd.ZstdFile(file, options=_OPTIONS))
