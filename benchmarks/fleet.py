"""What a fleet costs beside the work itself, and how it grows.

python benchmarks/fleet.py overhead   # ms per task of null work: local pool, Dask on loopback, against bare Dask
python benchmarks/fleet.py growth     # tracks-only rigs per worker and CPU-second, from 1 worker to all cores
python benchmarks/fleet.py many       # 100 000 null tasks through a Dask scheduler: memory (many=20000 for fewer)
python benchmarks/fleet.py streamed   # the same through an imitated scheduler, and the tables of 100 000 results
python benchmarks/fleet.py again      # a second run over 200 finished recordings
python benchmarks/fleet.py losses     # 200 on 3 workers: a worker and the client are killed; one dies, one hangs
"""

from __future__ import annotations

import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from dask_cluster import PATHS, loopback_cluster, worker_pids
from fleet_work import null_line
from rigwake.fleet.collect import write_tables
from rigwake.fleet.dask_run import DaskRunner, dask_client
from rigwake.fleet.fleet_jobs import FleetJob, FleetOutcome, outcome_of
from rigwake.fleet.fleet_run import FleetPlan, run_fleet
from rigwake.fleet.run_jobs import FleetRunner, local_pool, run_jobs

NULL, RIG, BY_NAME = "fleet_work:null_work", "fleet_work:rig_work", "fleet_work:work_by_name"


def jobs(out: str, count: int, work: str) -> Iterator[FleetJob]:
    return (FleetJob(f"/recordings/{k}.bag", out, work=work) for k in range(count))


def timed(runner: FleetRunner, wanted: Iterator[FleetJob]) -> float:
    done: list[FleetOutcome] = []
    begun = time.perf_counter()
    run_jobs(wanted, runner, done.append)
    return (time.perf_counter() - begun) / len(done)


def overhead(out: str, count: int = 2000) -> None:
    """Per task: seconds of the clock, and CPU of all processes together, which a busy machine does not change."""
    with local_pool(1) as pool:
        timed(pool, jobs(out, 2, NULL))  # the process starts
        said("local pool, 1 process", lambda: timed(pool, jobs(out, count, NULL)), count)
    with dask_client("local:1") as client:
        runner = DaskRunner(client)
        timed(runner, jobs(out, 2, NULL))
        said("Dask, 1 worker", lambda: timed(runner, jobs(out, count, NULL)), count)

        def bare() -> None:
            for future in client.map(abs, range(count), pure=False):
                future.result()

        said("Dask itself, no work", bare, count)


def said(what: str, work: Callable[[], object], count: int) -> None:
    before, begun = cpu_of_all(), time.perf_counter()
    work()
    wall, cpu = time.perf_counter() - begun, cpu_of_all() - before
    print(f"{what:24s} {1e3 * wall / count:6.2f} ms a task, {1e3 * cpu / count:5.2f} ms CPU", flush=True)


def cpu_of_all() -> float:
    """Seconds of CPU of this process and all that it has started and that still run."""
    import psutil

    this = psutil.Process()
    times = [process.cpu_times() for process in (this, *this.children(recursive=True))]
    return sum(t.user + t.system for t in times)


def growth(out: str, each: int = 3) -> None:
    cores = os.cpu_count() or 1
    first = None
    for workers in sorted({1, 2, cores} & set(range(1, cores + 1))):
        with local_pool(workers) as pool:
            timed(pool, jobs(out, workers, RIG))  # imports, compiled loops
            before, begun = cpu_of_children(pool), time.perf_counter()
            timed(pool, jobs(out, each * workers, RIG))
            wall, cpu = time.perf_counter() - begun, cpu_of_children(pool) - before
        rate = each * workers / cpu
        first = first or rate
        print(
            f"{workers} workers: {each * workers / wall / workers:.3f} rigs per worker and second of wall clock, "
            f"{rate:.3f} per CPU-second ({rate / first:.2f} of one worker)",
            flush=True,
        )


def cpu_of_children(pool: FleetRunner) -> float:
    import psutil

    times = [psutil.Process(p.pid).cpu_times() for p in pool._processes]  # type: ignore[attr-defined]
    return sum(t.user + t.system for t in times)


def many(out: str, count: int = 100_000) -> None:
    """Null tasks through a real scheduler, without processes of their own: memory of client and scheduler together."""
    with dask_client("local:1") as client:
        through(out, NullTasks(client), count)


def streamed(out: str, count: int = 100_000) -> None:
    """The same with a scheduler that is only imitated, and the tables of so many results with four cameras each."""
    imitated = ImitatedClient()
    through(out, NullTasks(imitated), count)
    imitated.threads.shutdown()
    print(f"most tasks that were submitted and not done: {imitated.most}", flush=True)
    folder = Path(out) / "tables"
    folder.mkdir()
    fleet = list(jobs(str(folder), count, NULL))
    begun = time.perf_counter()
    write_tables(folder, fleet, Invented(fleet))
    print(f"tables: {time.perf_counter() - begun:.0f} s; {peak_mb():.0f} MB", flush=True)


def through(out: str, runner: FleetRunner, count: int) -> None:
    told = Counter[str]()
    begun = time.perf_counter()

    def finished(outcome: FleetOutcome) -> None:
        told[outcome.status] += 1
        done = told.total()
        if done % (count // 5) == 0:
            ms = 1e3 * (time.perf_counter() - begun) / done
            print(f"{done:7d} tasks, {ms:.2f} ms each, {peak_mb():.0f} MB at most", flush=True)

    run_jobs(jobs(out, count, NULL), runner, finished)
    assert told == Counter(calibrated=count), told


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class NullTasks(DaskRunner):
    """Tasks that return at once on the worker."""

    def submit(self, job: FleetJob) -> None:
        future = self._client.submit(null_line, job.to_json(), key=f"null-{job.name}", pure=False)
        future.add_done_callback(lambda future: self._done.put((job, future)))

    def slots(self) -> int:
        return 64


class ImitatedClient:
    """What `DaskRunner` needs of a client, in this process. most: tasks that were there at the same time."""

    def __init__(self) -> None:
        self.threads = ThreadPoolExecutor(2)
        self.waiting, self.most, self._lock = 0, 0, threading.Lock()

    def submit(self, work: Callable[[str], str], line: str, *, key: str, pure: bool) -> Future[str]:
        with self._lock:
            self.waiting += 1
            self.most = max(self.most, self.waiting)
        future = self.threads.submit(work, line)
        future.status = "finished"  # type: ignore[attr-defined]
        future.add_done_callback(self._ended)
        return future

    def _ended(self, future: Future[str]) -> None:
        with self._lock:
            self.waiting -= 1


class Invented(dict[str, FleetOutcome]):
    """Results of ten vessels, made when they are asked for."""

    def __init__(self, fleet: Sequence[FleetJob]) -> None:
        self._jobs = {job.name: k for k, job in enumerate(fleet)}
        self._fleet = fleet

    def get(self, name: str, otherwise: object = None) -> FleetOutcome:  # type: ignore[override]
        k = self._jobs[name]
        turned = 1e-4 * (k % 7)
        camera = {
            "quat_wxyz": [math.cos(turned), 0.0, math.sin(turned), 0.0],
            "translation_m": [0.1, 0.2, 0.3],
            "std_rotation_deg": [0.01, 0.01, 0.02],
            "std_translation_m": [0.01, 0.01, 0.01],
            "time_offset_s": 0.01,
        }
        cameras = {n: dict(camera) for n in ("front", "port", "starboard", "aft")}
        outcome = outcome_of(self._fleet[k], "calibrated", started_ns=10**18 + k, cameras=cameras)
        return replace(outcome, vessel=f"boat{k % 10}", reference="imu")


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


CLIENT = """
import sys
from pathlib import Path
from rigwake.fleet.fleet_jobs import FleetJob
from rigwake.fleet.fleet_run import FleetPlan, counts_in_words, run_fleet
folder, address = Path(sys.argv[1]), sys.argv[2]
paths = sorted(folder.glob("*.bag"))
jobs = [FleetJob(str(p), str(folder / "out"), work="fleet_work:work_by_name", timeout_s=20.0) for p in paths]
result = run_fleet(jobs, FleetPlan(folder / "out", address))
print(counts_in_words(result.counts, result.causes), "| done before the restart:", result.done_before)
"""


def losses(out: str) -> None:
    """Three real workers, 198 rigs from simulated tracks, one recording that dies and one that hangs; a worker is
    killed with -9, later the client is as well, and started again."""
    folder = Path(out)
    written_jobs(folder, ["die", "hang", *(f"rig{k}" for k in range(198))])
    noted = folder / "out" / "begun.txt"

    def wait_for(count: int) -> None:
        while not noted.exists() or len(noted.read_text().split()) < count:
            time.sleep(0.05)

    with loopback_cluster(folder, 3) as address:
        words = [sys.executable, "-c", CLIENT, str(folder), address]
        environment = {**os.environ, "PYTHONPATH": PATHS}
        begun = time.perf_counter()
        client = subprocess.Popen(words, env=environment)
        wait_for(60)
        os.kill(worker_pids(address)[0], signal.SIGKILL)
        wait_for(110)
        client.kill()
        client.wait()
        print("a worker and the client were killed; the client is started again", flush=True)
        subprocess.run(words, env=environment, check=True)
        wall = time.perf_counter() - begun
        rows = (folder / "out" / "fleet.csv").read_text().splitlines()[1:]
        names = Counter(row.split(",")[0] for row in rows)
        print(f"{len(rows)} rows, most of one recording: {max(names.values())}; {wall:.0f} s in all")
        begun = time.perf_counter()
        subprocess.run(words, env=environment, check=True)
        print(f"once more, nothing to do: {time.perf_counter() - begun:.1f} s with the start of the program")


def written_jobs(folder: Path, names: Sequence[str]) -> list[FleetJob]:
    for name in names:
        (folder / f"{name}.bag").write_text(name)
    return [FleetJob(str(folder / f"{name}.bag"), str(folder / "out"), work=BY_NAME) for name in names]


if __name__ == "__main__":
    chosen = {
        "overhead": overhead,
        "growth": growth,
        "many": many,
        "streamed": streamed,
        "again": again,
        "losses": losses,
    }
    for words in sys.argv[1:] or chosen:
        name, _, number = words.partition("=")
        with tempfile.TemporaryDirectory() as place:
            chosen[name](place, *([int(number)] if number else []))
