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


class StageLedger:
    """Which stage files of OUT are whole, and what they were made from."""

    def __init__(self, folder: Path, *, resume: bool) -> None:
        self.folder = folder
        self._done: dict[str, str] = {}
        path = folder / _LEDGER
        if resume and path.is_file():
            try:
                content = json.loads(path.read_text(encoding="utf-8"))
            except ValueError:
                content = {}
            if isinstance(content, dict):
                self._done = {str(k): str(v) for k, v in content.items()}

    def is_done(self, stage: str, key: str, *files: Path) -> bool:
        """Whether the stage was finished with this key and its files are still there."""
        return self._done.get(stage) == key and all(file.is_file() for file in files)

    def done(self, stage: str, key: str) -> None:
        """Note that the stage's files are whole."""
        self._done[stage] = key
        write_text_atomic(self.folder / _LEDGER, json.dumps(self._done, indent=1) + "\n")
