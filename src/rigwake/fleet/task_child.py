"""The process that does jobs, one after the other: `python -m rigwake.fleet.task_child`.

It reads jobs, a line of JSON each, from standard input, and writes lines of JSON to what was its standard output:
`{"begun": true}`, `{"progress": [name, what, fraction]}`, `{"outcome": ".."}`. It ends as soon as its input does:
whoever started it is gone then, however that happened.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import queue
import sys
import threading
from collections.abc import Callable
from typing import Any

from rigwake._progress import Progress
from rigwake.fleet.fleet_jobs import FleetJob, FleetOutcome

_SEND_EVERY = 0.02  # of a fraction


def main() -> None:
    """Serve until standard input ends."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _end_first()
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever prints goes to standard error, not among the answers
    jobs: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_read, args=(jobs,), daemon=True, name="jobs").start()

    def send(message: dict[str, Any]) -> None:
        answers.write(json.dumps(message) + "\n")
        answers.flush()

    send({"ready": True})
    while True:
        job = FleetJob.from_json(jobs.get())
        work = _work_named(job.work)
        send({"begun": True})
        outcome = work(job, _ProgressLines(send))
        send({"outcome": outcome.to_json()})


def _read(jobs: queue.Queue[str]) -> None:
    for line in sys.stdin:
        jobs.put(line)
    os._exit(1)


def _end_first() -> None:
    """Where memory runs out, let the system end this process before its parent."""
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as file:
        file.write("1000")


def _work_named(name: str) -> Callable[[FleetJob, Progress], FleetOutcome]:
    module, _, function = name.partition(":")
    work: Callable[[FleetJob, Progress], FleetOutcome] = getattr(importlib.import_module(module), function)
    return work


class _ProgressLines:
    """Passes progress on, but not every frame of it."""

    def __init__(self, send: Callable[[dict[str, Any]], None]) -> None:
        self._send = send
        self._last = ("", "", -1.0)

    def __call__(self, name: str, what: str, fraction: float) -> None:
        if (name, what) != self._last[:2] or fraction - self._last[2] >= _SEND_EVERY:
            self._last = (name, what, fraction)
            self._send({"progress": [name, what, fraction]})


if __name__ == "__main__":
    main()
