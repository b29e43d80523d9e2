"""Shared by all tests: where the real recordings are."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_recordings() -> Path:
    """Folder of the real recordings: RIGWAKE_DATA, or ../shared/data beside the project; else skip."""
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    folder = Path(os.environ.get("RIGWAKE_DATA", beside))
    if not folder.is_dir():
        pytest.skip("no real recordings here: set RIGWAKE_DATA to their folder")
    return folder
