"""One-line faults over the main job: how many does the fast suite catch? `make mutants`; the list is `mutants.yaml`.

Each fault is put into a copy of the package, and its tests run there in a fork of this process, which has the large
libraries loaded. Anyone may add to the list: `file`, the text `old` that stands there once, what it becomes (`new`),
and the fast `tests` that should fail (files, or `file::test`), the likeliest first. Faults in compiled loops run as
plain Python, so name tests there that are small.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2  # noqa: F401
import numba
import pytest
import scipy.optimize
import scipy.stats  # noqa: F401
import yaml

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "rigwake"
LEAST = 0.9


def load(path: Path) -> list[dict[str, str]]:
    """The faults; ValueError names one whose text does not stand in its file exactly once, or changes nothing."""
    faults = yaml.safe_load(path.read_text(encoding="utf-8"))
    for fault in faults:
        count = (PACKAGE / fault["file"]).read_text(encoding="utf-8").count(fault["old"])
        if count != 1 or fault["old"] == fault["new"]:
            raise ValueError(f"{fault['file']}: {fault['old']!r} stands there {count} times")
        for test in fault["tests"].split():
            if not (ROOT / "tests" / test.partition("::")[0]).is_file():
                raise ValueError(f"{fault['file']}: there is no {test}")
    return list(faults)


def run_tests(tests: str, source: Path, is_compiled: bool, seconds: float) -> tuple[int, float]:
    """Exit code of the tests over the package in `source` (-1: no end within the time), and CPU seconds."""
    child = os.fork()
    if child == 0:
        try:
            os.setsid()
            silent = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silent, 1)
            os.dup2(silent, 2)
            numba.config.DISABLE_JIT = int(not is_compiled)
            sys.dont_write_bytecode = True
            sys.path.insert(0, str(source))
            os.environ["PYTHONPATH"] = str(source)
            os.chdir(ROOT)
            chosen = [str(ROOT / "tests" / test) for test in tests.split()]
            code = pytest.main(["-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", "-n", "0", *chosen])
        except BaseException:
            code = 99
        os._exit(int(code))
    started = time.monotonic()
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
        if time.monotonic() - started > seconds:
            os.killpg(child, signal.SIGKILL)
            _, _, usage = os.wait4(child, 0)
            return -1, usage.ru_utime + usage.ru_stime
        time.sleep(0.05)


def try_fault(fault: dict[str, str], source: Path, seconds: float) -> tuple[int, float]:
    """Exit code of the tests with the fault in the copied package, and CPU seconds."""
    path = source / "rigwake" / fault["file"]
    before, stamp = path.read_text(encoding="utf-8"), path.stat()
    path.write_text(before.replace(fault["old"], fault["new"]), encoding="utf-8")
    try:
        return run_tests(fault["tests"], source, "@njit" not in before, seconds)
    finally:
        path.write_text(before, encoding="utf-8")
        os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="faults whose file or text contains this")
    parser.add_argument("--seconds", type=float, default=900.0, help="longest run of the tests of one fault")
    parser.add_argument(
        "--unchanged", action="store_true", help="first show that the tests pass without faults"
    )
    chosen = parser.parse_args()
    faults = [
        f for f in load(ROOT / "tests" / "mutants.yaml") if chosen.only in f["file"] + f["old"] + f["new"]
    ]
    caught, cpu_s = 0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "src"
        shutil.copytree(ROOT / "src", source, copy_function=shutil.copy2)
        if chosen.unchanged:
            tests = " ".join(dict.fromkeys(test for f in faults for test in f["tests"].split()))
            code, _ = run_tests(tests, source, True, 10 * chosen.seconds)
            if code != 0:
                print(f"the tests fail without any fault (exit {code})")
                return 1
        for number, fault in enumerate(faults, 1):
            code, used_s = try_fault(fault, source, chosen.seconds)
            # 1: a test failed, 2: a test file did not even import; no end is a fault seen as well
            word = {0: "MISSED", 1: "caught", 2: "caught", -1: "caught"}.get(code, f"exit {code}")
            caught, cpu_s = caught + (word == "caught"), cpu_s + used_s
            print(f"{number:3d} {word} {used_s:5.1f} CPU-s  {fault['file']}: {fault['new']}", flush=True)
    print(f"{caught} of {len(faults)} caught ({caught / max(len(faults), 1):.0%}), {cpu_s:.0f} CPU-s")
    return int(caught < LEAST * len(faults))


if __name__ == "__main__":
    sys.exit(main())
