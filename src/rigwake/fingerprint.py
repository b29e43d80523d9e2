"""What identifies an input of a calibration."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

_HASHED_BYTES = 1 << 20


def input_fingerprint(path: Path) -> dict[str, Any]:
    """What identifies an input: name, size, and SHA-256 of its first and last MiB (of a folder: its listing)."""
    digest = hashlib.sha256()
    if path.is_dir():
        files = sorted(p for p in path.rglob("*") if p.is_file())
        for file in files:
            digest.update(f"{file.relative_to(path)} {file.stat().st_size}\n".encode())
        size = sum(file.stat().st_size for file in files)
    else:
        size = path.stat().st_size
        with path.open("rb") as handle:
            digest.update(handle.read(_HASHED_BYTES))
            if size > _HASHED_BYTES:
                handle.seek(max(size - _HASHED_BYTES, _HASHED_BYTES))
                digest.update(handle.read(_HASHED_BYTES))
    return {"path": path.name, "bytes": size, "sha256_of_ends": digest.hexdigest()}
