"""Shared by all tests: where the real recordings are."""

from __future__ import annotations

import gc
import os
from pathlib import Path
from typing import Any

# one worker per core runs already: more threads would only wait for each other, also in processes that tests start
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# as the program does before it imports numba; a test may import that first
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

import pytest
from hypothesis import HealthCheck, settings

# a machine with other work is no fault of the code: wall time judges nothing
settings.register_profile("rigwake", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rigwake")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Which worker runs what, with -n 2."""
    from work_units import FileScheduling

    return FileScheduling(config, log)


def pytest_collection_finish() -> None:
    """Three thousand tests and all libraries stay to the end: no collection of garbage need look at them again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def real_recordings() -> Path:
    """Folder of the real recordings: RIGWAKE_DATA, or ../shared/data beside the project; else skip."""
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    folder = Path(os.environ.get("RIGWAKE_DATA", beside))
    if not folder.is_dir():
        pytest.skip("no real recordings here: set RIGWAKE_DATA to their folder")
    return folder
