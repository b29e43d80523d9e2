"""A fleet on real Dask workers on loopback: lost workers, restarted clients, the same bytes as the local pool."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

import rigwake
from dask_cluster import PATHS, free_port, loopback_cluster, worker_pids
from rigwake.errors import HostError, UsageError
from rigwake.fleet.dask_run import check_workers, dask_client
from rigwake.fleet.fleet_run import FleetPlan, run_fleet
from rigwake.fleet.resume import read_outcome
from test_fleet_pool import begun, jobs_named

pytestmark = [
    pytest.mark.xdist_group("fleet"),
    pytest.mark.filterwarnings("default"),
    # every worker collects this file: importing takes its time
    pytest.mark.skipif(find_spec("distributed") is None, reason="the extra `fleet` is not installed"),
]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a scheduler with three workers."""
    with loopback_cluster(tmp_path_factory.mktemp("dask")) as address:
        yield address


@pytest.mark.slow
class TestCluster:
    def test_lost_workers_hangs_and_deaths_cost_only_the_guilty(self, cluster: str, tmp_path: Path) -> None:
        """A worker is killed with -9 in mid-run; one recording always kills its worker, one hangs."""
        names = ["worker", "hang", "die", *(f"slow{k}" for k in range(20))]
        fleet = jobs_named(tmp_path, *names, timeout_s=3.0)

        def kill() -> None:
            while sum(begun(tmp_path).values()) < 6:
                time.sleep(0.05)
            os.kill(worker_pids(cluster)[-1], signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        result = run_fleet(fleet, FleetPlan(tmp_path / "out", cluster))
        killer.join()
        assert result.counts == Counter(calibrated=20, failed=3)
        assert result.causes == Counter({"killed": 2, "time-out": 1})
        assert all(read_outcome(job.result_folder) for job in fleet)
        again = run_fleet(fleet, FleetPlan(tmp_path / "out", cluster))
        assert again.done_before == 23

    def test_a_client_that_is_killed_and_started_again(self, cluster: str, tmp_path: Path) -> None:
        names = [f"slow{k}" for k in range(15)]
        script = (
            "from pathlib import Path; from test_fleet_pool import jobs_named, run_fleet, FleetPlan\n"
            f"p = Path({str(tmp_path)!r})\n"
            f"run_fleet(jobs_named(p, *{names!r}), FleetPlan(p / 'out', {cluster!r}))\n"
        )
        client = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": PATHS})
        while sum(begun(tmp_path).values()) < 5 and client.poll() is None:
            time.sleep(0.05)
        client.kill()
        client.wait()
        fleet = jobs_named(tmp_path, *names)
        result = run_fleet(fleet, FleetPlan(tmp_path / "out", cluster))
        assert result.counts == Counter(calibrated=15)
        rows = result.tables.csv.read_text().splitlines()[1:]
        assert len(rows) == 15
        assert len(set(rows)) == 15

    def test_own_workers_on_this_machine(self, tmp_path: Path) -> None:
        fleet = jobs_named(tmp_path, *(f"r{k}" for k in range(4)))
        result = run_fleet(fleet, FleetPlan(tmp_path / "out", "local:1"))
        assert result.counts == Counter(calibrated=4)

    def test_the_folder_must_be_shared(
        self, cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rigwake.fleet.fleet_run._token", lambda out: "0" * 32)  # as if written elsewhere
        with pytest.raises(HostError, match="does not see"):
            run_fleet(jobs_named(tmp_path, "a"), FleetPlan(tmp_path / "out", cluster))
        assert not begun(tmp_path)


def test_a_scheduler_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rigwake.fleet.dask_run._CONNECT_S", 0.5)
    with pytest.raises(HostError, match="No scheduler answers"):
        run_fleet(jobs_named(tmp_path, "a"), FleetPlan(tmp_path / "out", f"tcp://127.0.0.1:{free_port()}"))


@pytest.mark.parametrize("words", ["local:0", "local:x", "here", "http://x:1", "tcp:127.0.0.1", ""])
def test_words_that_are_no_scheduler(words: str) -> None:
    with pytest.raises(UsageError, match="no address"), dask_client(words):
        pass


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        (("0.0.1", "t"), "runs rigwake 0.0.1"),
        ((rigwake.__version__, ""), "does not see"),
        ((rigwake.__version__, "other"), "does not see"),
        (ModuleNotFoundError("No module named 'rigwake'"), "cannot run rigwake's fleet"),
    ],
)
def test_workers_that_are_not_fit(seen: object, said: str) -> None:
    fit = (rigwake.__version__, "t")
    check_workers({"tcp://a": fit}, "t", Path("/out"))
    with pytest.raises(HostError, match=said):
        check_workers({"tcp://a": fit, "tcp://b": seen}, "t", Path("/out"))
