"""Compiled loops on disk: right whoever compiles beside."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

from rigwake._kernels import KernelFile, njit


def save_at_once(kind: type[IndexDataCacheFile], folder: Path) -> IndexDataCacheFile:
    """Two processes both read the empty index; the second saves while the first is between index and code."""
    first, second = (kind(str(folder), "kernel", "stamp") for _ in range(2))
    save_index, empty = first._save_index, second._load_index()

    def save_index_then_the_other_saves(index: Any) -> None:
        save_index(index)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(second, "_load_index", lambda: dict(empty))
            second.save("floats", "code for floats")

    first._save_index = save_index_then_the_other_saves
    first.save("integers", "code for integers")
    return second


def test_processes_that_compile_at_once_do_not_mix_up_their_code(tmp_path: Path) -> None:
    files = save_at_once(KernelFile, tmp_path)
    assert files.load("integers") in (None, "code for integers")
    assert files.load("floats") in (None, "code for floats")
    files.save("integers", "code for integers")
    files.save("floats", "code for floats")
    assert files.load("floats") == "code for floats"
    assert files.load("integers") == "code for integers"


def test_code_of_former_sources_is_removed(tmp_path: Path) -> None:
    """The file's stamp tells former sources, the line in its name where the kernel stood."""
    for name, stamp in (("kernel-10.py311", "old"), ("kernel-12.py311", "old"), ("other-14.py311", "old")):
        KernelFile(str(tmp_path), name, stamp).save("floats", f"{name} {stamp}")
    new = KernelFile(str(tmp_path), "kernel-12.py311", "new")
    new.save("floats", "new code")
    new.save("integers", "more code")
    assert sorted(path.name.split(".")[0] for path in tmp_path.glob("*.nbi")) == ["kernel-12", "other-14"]
    assert len(list(tmp_path.glob("kernel-*.nbc"))) == 2
    assert (new.load("floats"), new.load("integers")) == ("new code", "more code")


def test_code_of_another_python_is_kept_and_a_damaged_index_is_no_obstacle(tmp_path: Path) -> None:
    other = KernelFile(str(tmp_path), "kernel-12.py310", "new")
    other._version = "another numba"
    other.save("floats", "code of another Python")
    (tmp_path / "kernel-10.py311.nbi").write_bytes(b"cut")
    being_written = tmp_path / "kernel-10.py311.1.nbc.tmp.0a"
    being_written.touch()
    KernelFile(str(tmp_path), "kernel-12.py311", "new").save("floats", "new code")
    assert other.load("floats") == "code of another Python"
    assert not (tmp_path / "kernel-10.py311.nbi").exists()
    assert being_written.exists()


def test_one_file_for_each_set_of_argument_types_of_a_kernel() -> None:
    @njit()
    def doubled(value: Any) -> Any:
        return 2 * value

    files = doubled._cache._cache_file
    assert isinstance(files, KernelFile)
    assert doubled(3) == 6
    np.testing.assert_allclose(doubled(np.arange(3.0)), [0, 2, 4])
    assert len(set(files._load_index().values())) == 2


def test_every_kernel_of_the_package_is_compiled_so() -> None:
    sources = (Path(__file__).parent.parent / "src" / "rigwake").rglob("*.py")
    wrong = [p.name for p in sources if p.name != "_kernels.py" and "cache=True" in p.read_text()]
    assert not wrong


def test_failed_guesses_of_types_are_not_coloured() -> None:
    pytest.importorskip("colorama")  # without it numba has no colours
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"}
    program = "import rigwake; from numba.core import errors; print(type(errors.termcolor()).__name__)"
    printed = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment
    )
    assert printed.stdout.strip() == "NOPColorScheme"
