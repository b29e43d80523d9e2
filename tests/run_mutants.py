"""One-line faults over the main job: how many does the fast suite catch? `make mutants`; the list is `mutants.yaml`.

Each fault is put into a copy of the package, and its tests run there. Anyone may add to the list: file, the text that
stands there once, what it becomes, and the fast test files that should see it.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

ROOT = Path(__file__).parent.parent


def load(path: Path) -> list[dict[str, str]]:
    """The faults; ValueError names one whose text does not stand in its file exactly once."""
    faults = yaml.safe_load(path.read_text(encoding="utf-8"))
    for fault in faults:
        text = (ROOT / "src" / "rigwake" / fault["file"]).read_text(encoding="utf-8")
        if text.count(fault["old"]) != 1:
            raise ValueError(
                f"{fault['file']}: {fault['old']!r} stands there {text.count(fault['old'])} times"
            )
    return list(faults)


def is_caught(fault: dict[str, str], package: Path, seconds: float) -> bool:
    """Whether a test fails with the fault in the copied package."""
    path = package / "rigwake" / fault["file"]
    before = path.read_text(encoding="utf-8")
    stamp = path.stat()
    path.write_text(before.replace(fault["old"], fault["new"]), encoding="utf-8")
    tests = [str(ROOT / "tests" / name) for name in fault["tests"].split()]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-n",
        "0",
        "-m",
        "not slow",
        "-p",
        "no:cacheprovider",
        *tests,
    ]
    try:
        done = subprocess.run(
            command,
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(package)},
            capture_output=True,
            timeout=seconds,
            check=False,
        )
        return done.returncode == 1
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(before, encoding="utf-8")
        os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="faults whose file or text contains this")
    parser.add_argument("--seconds", type=float, default=600.0, help="longest run of the tests of one fault")
    chosen = parser.parse_args()
    faults = [
        f for f in load(ROOT / "tests" / "mutants.yaml") if chosen.only in f["file"] + f["old"] + f["new"]
    ]
    missed = []
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "src"
        shutil.copytree(ROOT / "src", package, copy_function=shutil.copy2)
        for number, fault in enumerate(faults, 1):
            started = time.perf_counter()
            caught = is_caught(fault, package, chosen.seconds)
            missed += [] if caught else [fault]
            word = "caught" if caught else "MISSED"
            print(
                f"{number:3d} {word} {time.perf_counter() - started:5.0f} s  {fault['file']}: {fault['new']}",
                flush=True,
            )
    print(
        f"{len(faults) - len(missed)} of {len(faults)} caught ({1 - len(missed) / max(len(faults), 1):.0%})"
    )
    return int(len(missed) > 0.1 * len(faults))


if __name__ == "__main__":
    sys.exit(main())
