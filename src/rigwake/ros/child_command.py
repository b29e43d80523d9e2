"""A command of rigwake in a process of its own: the node goes on while it works, and outlives it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence

_NICENESS = 10
_KEPT_LINES = 30


class ChildCommand:
    """`rigwake WORDS`, at low priority. progress: its last line of progress. finished is called with the exit code and
    its last words, from a thread."""

    def __init__(
        self, words: Sequence[str], finished: Callable[[int, str], None], program: Sequence[str] = ()
    ) -> None:
        self.progress = "starting"
        self._finished = finished
        self._lines: list[str] = []
        self._process = subprocess.Popen(
            [*(program or (sys.executable, "-P", "-m", "rigwake")), *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "NO_COLOR": "1"},
            start_new_session=True,
        )
        with contextlib.suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICENESS)
        self._thread = threading.Thread(target=self._follow, daemon=True, name="child")
        self._thread.start()

    def _follow(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            words = " ".join(re.sub("[│╭╮╰╯─]", " ", line).split())
            if words.endswith("%"):
                self.progress = words
            elif words:
                self._lines = [*self._lines, words][-_KEPT_LINES:]
        code = self._process.wait()
        self._process.stderr.close()
        self._finished(code, " ".join(self._lines))

    def end(self) -> None:
        """End it, and wait until it has."""
        if self._process.poll() is None:
            with contextlib.suppress(OSError):
                os.killpg(self._process.pid, signal.SIGTERM)
            try:
                self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(OSError):
                    os.killpg(self._process.pid, signal.SIGKILL)
        self._thread.join(10.0)
