"""A Dask scheduler and its workers on loopback, in processes of their own as a cluster has them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rigwake
from rigwake.fleet.dask_run import dask_client

PATHS = os.pathsep.join([str(Path(rigwake.__file__).parent.parent), str(Path(__file__).parent)])


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def loopback_cluster(folder: Path, workers: int = 3) -> Iterator[str]:
    """The address of a scheduler with so many workers; their logs are in `folder`."""
    address = f"tcp://127.0.0.1:{free_port()}"
    environment = {**os.environ, "PYTHONPATH": PATHS, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    port = address.rpartition(":")[2]
    scheduler = ["dask_scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"]
    worker = ["dask_worker", address, "--nworkers", str(workers), "--nthreads", "1", "--no-dashboard"]
    worker += ["--memory-limit", "0", "--local-directory", str(folder)]
    with (folder / "log.txt").open("w") as log:
        running = [
            subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{words[0]}", *words[1:]],
                stdout=log,
                stderr=log,
                env=environment,
                cwd=folder,
                start_new_session=True,
            )
            for words in (scheduler, worker)
        ]
        try:
            yield address
        finally:
            for process in reversed(running):
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def worker_pids(address: str) -> list[int]:
    """Processes of the workers that are there now, once there is one."""
    with dask_client(address) as client:
        client.wait_for_workers(1, timeout=60)
        return list(client.run(os.getpid).values())
