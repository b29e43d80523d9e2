"""Signals in words; those of the system's errors are in `rigwake.host_faults`."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from rigwake.errors import RigwakeError
from rigwake.host_faults import SHOW_TRACEBACK, words_of

_GRACE_S = 4.0  # for tidying up after a signal, before the process ends without

__all__ = ["SHOW_TRACEBACK", "Stopped", "signals_raise", "silence_output", "words_of"]


class Stopped(BaseException):
    """The user or the system asked the process to end."""

    def __init__(self, signum: int) -> None:
        self.signum = signum
        super().__init__(signum)

    @property
    def exit_code(self) -> int:
        """128 and the number of the signal, as shells have it."""
        return 128 + self.signum

    def words(self, arguments: Sequence[str]) -> RigwakeError:
        """Who stopped it, and how to go on."""
        who = "Ctrl-C" if self.signum == signal.SIGINT else f"the signal {signal.Signals(self.signum).name}"
        again = ["rigwake", *arguments]
        if "calibrate" in arguments[:1]:
            again = [word for word in again if word not in ("--resume", "--force")] + ["--resume"]
        return RigwakeError(
            f"Stopped by {who}.",
            consequence="No file is half-written.",
            remedy=f"Go on with: {shlex.join(again)}",
        )


@contextmanager
def signals_raise(arguments: Sequence[str] = ()) -> Iterator[None]:
    """Within it, SIGINT, SIGTERM and SIGHUP raise Stopped, so that files and processes are tidied up.

    arguments: of the command, for the words if the process has to be ended before it has tidied up.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    former = {number: signal.getsignal(number) for number in numbers}
    deadline: list[threading.Timer] = []

    def stop(signum: int, frame: FrameType | None) -> None:
        for number in numbers:  # `timeout` sends it twice; a second Ctrl-C ends without tidying up
            signal.signal(number, signal.SIG_DFL if number == signal.SIGINT else signal.SIG_IGN)
        timer = threading.Timer(_GRACE_S, _end_now, (Stopped(signum), arguments))
        timer.daemon = True
        timer.start()
        deadline.append(timer)
        raise Stopped(signum)

    for number, handler in former.items():
        if handler != signal.SIG_IGN:  # as nohup wants it
            signal.signal(number, stop)
    try:
        yield
    finally:
        for timer in deadline:
            timer.cancel()
        for number, handler in former.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


def _end_now(stopped: Stopped, arguments: Sequence[str]) -> None:
    """End at once, in the same words: the main thread is in a long calculation that no signal interrupts."""
    for process in multiprocessing.active_children():
        with contextlib.suppress(OSError, ValueError):
            process.kill()
    with contextlib.suppress(OSError):
        os.write(2, f"rigwake: {stopped.words(arguments)}\n".encode(errors="backslashreplace"))
    os._exit(stopped.exit_code)


def silence_output() -> None:
    """Let the interpreter's last flush go nowhere: standard output cannot be written any more."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
