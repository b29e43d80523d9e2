"""A process that does jobs, watched over: it is ended when a job takes too long or too much memory.

`rigwake.workers` ends all jobs of one run when one fails. Here jobs are strangers to each other: one that hangs, or
takes the process with it, costs only itself. The process stays from job to job, so that a job costs milliseconds.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from rigwake._progress import Progress
from rigwake.errors import RigwakeError
from rigwake.fleet.fleet_jobs import (
    KILLED,
    OUT_OF_MEMORY,
    TIME_OUT,
    FleetJob,
    FleetOutcome,
    failure,
)

_LOOK_EVERY_S = 0.1
_START_S = 300.0  # for imports on a machine that is very busy
_LAST_WORDS = 400  # characters of what a lost process printed


def _silent(name: str, what: str, fraction: float) -> None:
    """Progress that nobody asked for."""


class TaskProcess:
    """Does one job at a time: `attend(job)`. Not for several threads at once."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._answers: queue.Queue[str | None] = queue.Queue()
        self._printed: IO[bytes] | None = None

    @property
    def pid(self) -> int | None:
        """Of the process, if it runs."""
        return None if self._process is None else self._process.pid

    def attend(self, job: FleetJob, progress: Progress = _silent) -> FleetOutcome:
        """What comes of the job. Loss of the process, time-out and memory become outcomes that are not yet stored."""
        begun = time.monotonic()
        outcome = self._attended(job, progress)
        return replace(outcome, seconds=outcome.seconds or round(time.monotonic() - begun, 3))

    def _attended(self, job: FleetJob, progress: Progress) -> FleetOutcome:
        if not self._running():
            self._start()
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(job.to_json() + "\n")
            self._process.stdin.flush()
        except OSError:
            return self._lost(job)
        deadline, limited = time.monotonic() + _START_S, False
        while True:
            try:
                line = self._answers.get(timeout=_LOOK_EVERY_S)
            except queue.Empty:
                line = ""
            if line is None:
                return self._lost(job)
            message = _parsed(line)
            if "outcome" in message:
                try:
                    return FleetOutcome.from_json(message["outcome"])
                except RigwakeError as error:
                    self.end()
                    return failure(job, KILLED, str(error), stored=False)
            if "begun" in message:
                limited = True
                deadline = time.monotonic() + (job.timeout_s or float("inf"))
            if "progress" in message:
                progress(*message["progress"])
            if time.monotonic() > deadline:
                self.end()
                return _too_long(job, job.timeout_s if limited else _START_S)
            if job.memory_bytes and line == "" and _memory_of(self._process.pid) > job.memory_bytes:
                self.end()
                return _too_large(job)

    def _running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def _start(self) -> None:
        self.end()
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115 - closed in `end`
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rigwake.fleet.task_child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._printed,
            encoding="utf-8",
            env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
            start_new_session=True,  # Ctrl-C reaches all: whoever attends decides
        )
        self._answers = queue.Queue()
        threading.Thread(
            target=_pass_on, args=(self._process.stdout, self._answers), daemon=True, name="answers"
        ).start()

    def _lost(self, job: FleetJob) -> FleetOutcome:
        """The process has ended without an answer."""
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(5.0)
        code, words = self._process.returncode, self._last_words()
        self.end()
        how = f"with code {code}"
        if code is not None and code < 0:
            how = f"by the signal {signal.Signals(-code).name}"
        hint = " Usually the system had no memory left." if code == -signal.SIGKILL else ""
        return failure(
            job, KILLED, f"The process that worked on it was ended {how}.{hint}{words}", stored=False
        )

    def _last_words(self) -> str:
        if self._printed is None:
            return ""
        with contextlib.suppress(OSError):
            size = self._printed.seek(0, os.SEEK_END)
            self._printed.seek(max(0, size - _LAST_WORDS))
            words = self._printed.read().decode("utf-8", "replace").strip()
            return f" It last printed: {words}" if words else ""
        return ""

    def end(self) -> None:
        """End the process and what it has started, by force."""
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(OSError, AttributeError):
                os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    with contextlib.suppress(OSError, ValueError):
                        stream.close()
        if self._printed is not None:
            self._printed.close()
            self._printed = None


def _pass_on(answers: Any, to: queue.Queue[str | None]) -> None:
    with contextlib.suppress(OSError, ValueError):
        for line in answers:
            to.put(line)
    to.put(None)


def _parsed(line: str) -> dict[str, Any]:
    try:
        message = json.loads(line) if line else {}
    except ValueError:
        return {}
    return message if isinstance(message, dict) else {}


def _too_long(job: FleetJob, limit_s: float | None) -> FleetOutcome:
    return failure(
        job,
        TIME_OUT,
        f"It was not done after {limit_s or 0:g} s and was given up. If it is only long, raise --timeout.",
        stored=False,
    )


def _too_large(job: FleetJob) -> FleetOutcome:
    return failure(
        job,
        OUT_OF_MEMORY,
        f"It took more memory than the {(job.memory_bytes or 0) / 2**30:.3g} GiB allowed and was given up. Raise "
        "--memory, or calibrate less of it with --set duration_s=60.",
        stored=False,
    )


def _memory_of(pid: int) -> int:
    """Bytes of memory that the process and those it has started hold; 0 where the system does not tell (Linux does)."""
    total, todo = 0, [pid]
    while todo:
        process = Path("/proc") / str(todo.pop())
        try:
            total += int((process / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            for thread in (process / "task").iterdir():
                todo += [int(word) for word in (thread / "children").read_text().split()]
        except (OSError, ValueError, IndexError):
            continue
    return total
