"""Jobs for worker processes, in a module that they import quickly."""

import os
import signal
import time


def square(job: int, progress) -> int:
    progress(f"job {job}", "squaring", 1.0)
    return job * job


def refuse(job: int, progress) -> int:
    raise OSError(28, "No space left on device", "/full/disk")


def die(job: int, progress) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def sleep_long(job: int, progress) -> int:
    progress("pid", os.getpid(), 0.0)
    time.sleep(120)
    return 0
