"""The files that stages leave, so that a run can be looked into, resumed, and fed with external results."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from rigwake.atomic import write_text_atomic

_LEDGER = "stages.json"


def stage_key(*parts: Any) -> str:
    """A short hash of everything that a stage's result depends on (JSON-able values)."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def content_hash(path: Path) -> str:
    """A short hash of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


class StageLedger:
    """Which stage files of OUT are whole, what they were made from, and what they hold."""

    def __init__(self, folder: Path, *, resume: bool) -> None:
        self.folder = folder
        self._done: dict[str, dict[str, Any]] = {}
        path = folder / _LEDGER
        if resume and path.is_file():
            try:
                content = json.loads(path.read_text(encoding="utf-8"))
            except (ValueError, RecursionError):
                content = {}
            if isinstance(content, dict):
                self._done = {str(k): v for k, v in content.items() if isinstance(v, dict)}

    def is_done(self, stage: str, key: str, *files: Path) -> bool:
        """Whether the stage was finished with this key and its files are still there as it left them."""
        entry = self._done.get(stage)
        if entry is None or entry.get("key") != key or not all(file.is_file() for file in files):
            return False
        known = entry.get("files")
        if not isinstance(known, dict):
            return False
        try:
            return all(content_hash(self.folder / name) == known[name] for name in known)
        except (OSError, ValueError):
            return False

    def done(self, stage: str, key: str, *files: Path) -> None:
        """Note that the stage is finished, and what its files hold."""
        hashes = {file.relative_to(self.folder).as_posix(): content_hash(file) for file in files}
        self._done[stage] = {"key": key, "files": hashes}
        write_text_atomic(self.folder / _LEDGER, json.dumps(self._done, indent=1) + "\n")
