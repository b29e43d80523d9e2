"""What a fleet costs beside the work itself, and how it grows.

python benchmarks/fleet.py overhead   # ms per task of null work: local pool, Dask on loopback, against bare Dask
python benchmarks/fleet.py growth     # tracks-only rigs per worker and CPU-second, from 1 worker to all cores
python benchmarks/fleet.py many       # 100 000 null tasks through a Dask scheduler: memory of the client
python benchmarks/fleet.py again      # a second run over 200 finished recordings
python benchmarks/fleet.py losses     # 200 recordings on 3 workers; one killed with -9, one recording dies, one hangs
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from rigwake.fleet.dask_run import DaskRunner, dask_client
from rigwake.fleet.fleet_jobs import FleetJob, FleetOutcome
from rigwake.fleet.fleet_run import FleetPlan, counts_in_words, run_fleet
from rigwake.fleet.run_jobs import FleetRunner, local_pool, run_jobs

NULL, RIG, BY_NAME = "fleet_work:null_work", "fleet_work:rig_work", "fleet_work:work_by_name"


def jobs(out: str, count: int, work: str) -> Iterator[FleetJob]:
    return (FleetJob(f"/recordings/{k}.bag", out, work=work) for k in range(count))


def timed(runner: FleetRunner, wanted: Iterator[FleetJob]) -> float:
    done: list[FleetOutcome] = []
    begun = time.perf_counter()
    run_jobs(wanted, runner, done.append)
    return (time.perf_counter() - begun) / len(done)


def overhead(out: str) -> None:
    count = 2000
    with local_pool(1) as pool:
        timed(pool, jobs(out, 2, NULL))  # the process starts
        print(
            f"local pool, 1 process     {1e3 * timed(pool, jobs(out, count, NULL)):6.2f} ms a task",
            flush=True,
        )
    with dask_client("local:1") as client:
        runner = DaskRunner(client)
        timed(runner, jobs(out, 2, NULL))
        ours = timed(runner, jobs(out, count, NULL))
        begun = time.perf_counter()
        for future in client.map(abs, range(count), pure=False):
            future.result()
        bare = (time.perf_counter() - begun) / count
    print(f"Dask, 1 worker            {1e3 * ours:6.2f} ms a task; bare Dask {1e3 * bare:.2f} ms", flush=True)


def growth(out: str) -> None:
    cores = os.cpu_count() or 1
    first = None
    for workers in sorted({1, 2, cores} & set(range(1, cores + 1))):
        with local_pool(workers) as pool:
            timed(pool, jobs(out, workers, RIG))  # imports, compiled loops
            before, begun = cpu_of_children(pool), time.perf_counter()
            timed(pool, jobs(out, 6 * workers, RIG))
            wall, cpu = time.perf_counter() - begun, cpu_of_children(pool) - before
        rate = 6 * workers / cpu
        first = first or rate
        print(
            f"{workers} workers: {6 * workers / wall / workers:.3f} rigs per worker and second of wall clock, "
            f"{rate:.3f} per CPU-second ({rate / first:.2f} of one worker)",
            flush=True,
        )


def cpu_of_children(pool: FleetRunner) -> float:
    import psutil

    times = [psutil.Process(p.pid).cpu_times() for p in pool._processes]  # type: ignore[attr-defined]
    return sum(t.user + t.system for t in times)


def many(out: str) -> None:
    """Null tasks without processes of their own: what is measured is the client and the scheduler."""
    count, told = 100_000, Counter[str]()
    with dask_client("local:1") as client:
        runner = NullTasks(client)
        begun = time.perf_counter()
        run_jobs(jobs(out, count, NULL), runner, lambda outcome: told.update([outcome.status]))
        wall = time.perf_counter() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{dict(told)} in {wall:.0f} s, {1e3 * wall / count:.2f} ms a task; client and scheduler {peak:.0f} MB"
    )


class NullTasks(DaskRunner):
    """Tasks that return at once on the worker."""

    def submit(self, job: FleetJob) -> None:
        from fleet_work import null_line

        future = self._client.submit(null_line, job.to_json(), key=f"null-{job.name}", pure=False)
        future.add_done_callback(lambda future: self._done.put((job, future)))

    def slots(self) -> int:
        return 64


def again(out: str) -> None:
    folder = Path(out)
    fleet = written_jobs(folder, [f"r{k}" for k in range(200)])
    run_fleet(fleet, FleetPlan(folder / "out", processes=1))
    begun, cpu = time.perf_counter(), time.process_time()
    result = run_fleet(fleet, FleetPlan(folder / "out", processes=1))
    print(
        f"second run over {result.done_before} finished recordings: {time.perf_counter() - begun:.2f} s, "
        f"{time.process_time() - cpu:.2f} CPU-s"
    )


def losses(out: str) -> None:
    folder = Path(out)
    fleet = written_jobs(folder, ["die", "hang", *(f"slow{k}" for k in range(198))])
    fleet = [FleetJob(j.recording, j.out, work=j.work, timeout_s=20.0) for j in fleet]
    with dask_client("local:3") as client:
        address = client.scheduler.address
        noted = folder / "out" / "begun.txt"

        def kill() -> None:
            while not noted.exists() or len(noted.read_text().split()) < 60:
                time.sleep(0.05)
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

        threading.Thread(target=kill, daemon=True).start()
        begun = time.perf_counter()
        result = run_fleet(fleet, FleetPlan(folder / "out", address))
        wall = time.perf_counter() - begun
        rows = result.tables.csv.read_text().splitlines()[1:]
        names = Counter(row.split(",")[0] for row in rows)
        print(f"{counts_in_words(result.counts, result.causes)} in {wall:.0f} s")
        print(f"{len(rows)} rows, most of one recording: {max(names.values())}")


def written_jobs(folder: Path, names: Sequence[str]) -> list[FleetJob]:
    for name in names:
        (folder / f"{name}.bag").write_text(name)
    return [FleetJob(str(folder / f"{name}.bag"), str(folder / "out"), work=BY_NAME) for name in names]


if __name__ == "__main__":
    chosen = {"overhead": overhead, "growth": growth, "many": many, "again": again, "losses": losses}
    for name in sys.argv[1:] or chosen:
        with tempfile.TemporaryDirectory() as place:
            chosen[name](place)
