"""The pool of a fleet: every recording once, whatever hangs, dies or eats memory among them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import rigwake
from rigwake.errors import HostError
from rigwake.fleet import fleet_run
from rigwake.fleet.collect import outcomes_of
from rigwake.fleet.fleet_jobs import FleetJob, FleetOutcome, failure, job_name, outcome_of, shard_of
from rigwake.fleet.fleet_run import FleetPlan, FleetResult, counts_in_words, run_fleet
from rigwake.fleet.resume import finished_outcome, read_outcome, result_in_place, store_outcome
from rigwake.fleet.run_jobs import run_jobs
from rigwake.fleet.task_process import TaskProcess

pytestmark = pytest.mark.xdist_group("fleet")


def jobs_named(folder: Path, *names: str, **values: object) -> list[FleetJob]:
    folder.mkdir(exist_ok=True)
    jobs = []
    for name in names:
        path = folder / f"{name}.bag"
        if not name.startswith("missing"):
            path.write_bytes(name.encode())
        jobs.append(
            FleetJob(str(path), str(folder / "out"), "boat", work="fleet_work:work_by_name", **values)  # type: ignore[arg-type]
        )
    return jobs


def begun(folder: Path) -> Counter[str]:
    path = folder / "out" / "begun.txt"
    return Counter(path.read_text().split() if path.exists() else ())


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[FleetJob], FleetResult, list[str]]:
    """A fleet in which everything goes wrong once, and the words of its progress."""
    folder = tmp_path_factory.mktemp("mixed")
    names = ["a", "hang", "die", "eat", "broken", "calm", "missing", *(f"good{k}" for k in range(6))]
    fleet = jobs_named(folder, *names, timeout_s=60.0)
    fleet[1] = replace(fleet[1], timeout_s=1.5)
    fleet[3] = replace(fleet[3], memory_bytes=200 << 20)
    told: list[str] = []
    result = run_fleet(
        fleet,
        FleetPlan(folder / "out", processes=2),
        lambda done, total, words: told.append(f"{done}/{total} {words}"),
    )
    return folder, fleet, result, told


class TestMixedFleet:
    def test_every_recording_is_counted_once_by_what_came_of_it(self, mixed) -> None:
        _, fleet, result, told = mixed
        assert result.counts == Counter({"calibrated": 7, "failed": 5, "not observable": 1})
        assert set(result.causes) == {"time-out", "killed", "out of memory", "damaged bag", "missing path"}
        assert result.total == len(fleet)
        assert len(told) == len(fleet)
        assert told[-1].startswith("13/13 7 calibrated")

    def test_what_kills_its_process_is_tried_again_alone_the_rest_once(self, mixed) -> None:
        folder, _, _, _ = mixed
        assert begun(folder)["die"] == 2
        assert {name: n for name, n in begun(folder).items() if n != 1} == {"die": 2}

    def test_failures_say_what_a_person_would_have_seen(self, mixed) -> None:
        _, fleet, _, _ = mixed
        messages = {
            Path(j.recording).stem: (o.message if (o := read_outcome(j.result_folder)) else "") for j in fleet
        }
        assert "not done after 1.5 s" in messages["hang"]
        assert "SIGKILL" in messages["die"]
        assert "more memory than the 0.195 GiB" in messages["eat"]
        outcome = read_outcome(fleet[2].result_folder)
        assert outcome is not None
        assert outcome.attempts == 2

    def test_a_second_run_does_nothing_but_what_may_have_changed(self, mixed) -> None:
        folder, fleet, first, _ = mixed
        before, started = begun(folder), time.process_time()
        again = run_fleet(
            fleet,
            FleetPlan(folder / "out", scheduler="tcp://127.0.0.1:1"),
        )  # it would not answer
        assert begun(folder) == before
        assert again.done_before == again.total - 1  # the missing one
        assert time.process_time() - started < 2
        assert first.tables.csv.read_text().count("\n") >= 12

    def test_nothing_is_left_but_results_and_tables(self, mixed) -> None:
        folder, _, result, _ = mixed
        assert not list((folder / "out" / ".work").rglob("*"))
        page = result.tables.page.read_text()
        assert "time-out" in page
        assert "SIGKILL" in page
        assert "Fleet: 1" in page


def test_what_changed_or_failed_is_done_again(tmp_path: Path) -> None:
    fleet = jobs_named(tmp_path, "a", "b", "die")
    plan = FleetPlan(tmp_path / "out", processes=1, retries=0)
    run_fleet(fleet, plan)
    Path(fleet[0].recording).write_bytes(b"another")
    run_fleet(fleet, plan)
    assert begun(tmp_path) == Counter(a=2, b=1, die=1)
    run_fleet(fleet, replace(plan, retry_failed=True))
    assert begun(tmp_path)["die"] == 2
    run_fleet([replace(job, settings='{"seed": 1}') for job in fleet[:2]], plan)
    assert begun(tmp_path) == Counter(a=3, b=2, die=2)


@pytest.mark.slow
def test_a_client_that_is_killed_leaves_every_recording_to_be_done_once(tmp_path: Path) -> None:
    names = [f"slow{k}" for k in range(12)]
    fleet = jobs_named(tmp_path, *names)
    script = (
        "import sys; from pathlib import Path; from test_fleet_pool import jobs_named, run_fleet, FleetPlan\n"
        f"p = Path({str(tmp_path)!r}); run_fleet(jobs_named(p, *{names!r}), FleetPlan(p / 'out', processes=2))\n"
    )
    paths = os.pathsep.join([str(Path(rigwake.__file__).parent.parent), str(Path(__file__).parent)])
    client = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": paths})
    deadline = time.monotonic() + 120
    while sum(begun(tmp_path).values()) < 4 and time.monotonic() < deadline:
        time.sleep(0.05)
    client.kill()
    client.wait()
    done = sum(finished_outcome(replace(j, changed_at=_changed(j))) is not None for j in fleet)
    assert 0 < done < 12
    result = run_fleet(fleet, FleetPlan(tmp_path / "out", processes=2))
    assert result.counts == Counter(calibrated=12)
    assert result.done_before >= done
    assert len(list(outcomes_of(fleet, {}))) == 12


def _changed(job: FleetJob) -> str:
    from rigwake.fingerprint import files_changed_at

    return files_changed_at(Path(job.recording))


class Counting:
    """A runner that does nothing, and counts how many jobs it holds."""

    def __init__(self, outcome=lambda job, times: outcome_of(job, "calibrated", stored=False)) -> None:  # type: ignore[no-untyped-def]
        self.held: list[FleetJob] = []
        self.most = 0
        self.times: Counter[str] = Counter()
        self.outcome = outcome

    def slots(self) -> int:
        return 3

    def submit(self, job: FleetJob) -> None:
        self.held.append(job)
        self.most = max(self.most, len(self.held))

    def next_outcome(self) -> tuple[FleetJob, FleetOutcome]:
        job = self.held.pop(0)
        self.times[job.recording] += 1
        return job, self.outcome(job, self.times[job.recording])


class TestRunJobs:
    def test_jobs_are_drawn_as_slots_become_free(self) -> None:
        drawn = 0

        def many() -> Iterator[FleetJob]:
            nonlocal drawn
            for k in range(2000):
                drawn += 1
                yield FleetJob(f"/r/{k}", "/out")

        runner, ahead = Counting(), []
        run_jobs(many(), runner, lambda outcome: ahead.append(drawn - len(ahead)))
        assert len(ahead) == 2000
        assert runner.most <= 12
        assert max(ahead) <= 13

    def test_suspects_are_tried_again_alone(self, tmp_path: Path) -> None:
        def lost(job: FleetJob, times: int) -> FleetOutcome:
            guilty, suspect = job.recording.endswith("7"), int(job.recording[-1]) > 4
            if guilty or (suspect and times == 1):
                return failure(job, "killed", "lost", stored=False)
            return outcome_of(job, "calibrated", stored=False)

        runner, found = Counting(lost), []
        run_jobs([FleetJob(f"/r/{k}", str(tmp_path)) for k in range(10)], runner, found.append, retries=2)
        assert Counter(o.status for o in found) == Counter(calibrated=9, failed=1)
        assert runner.times["/r/7"] == 3
        assert runner.times["/r/5"] == 2
        kept = read_outcome(FleetJob("/r/7", str(tmp_path)).result_folder)
        assert kept is not None
        assert kept.attempts == 3

    def test_a_full_disk_ends_the_run_with_what_was_done(self) -> None:
        def full(job: FleetJob, times: int) -> FleetOutcome:
            if job.recording == "/r/3":
                return failure(job, "disk full", "No space.", stored=False)
            return outcome_of(job, "calibrated", stored=False)

        runner, found = Counting(full), []
        with pytest.raises(HostError, match=r"disk full.*finished results are kept"):
            run_jobs((FleetJob(f"/r/{k}", "/out") for k in range(1000)), runner, found.append)
        assert 4 <= len(found) <= 16


class TestOutcomes:
    def test_a_result_is_replaced_as_a_whole(self, tmp_path: Path) -> None:
        (job,) = jobs_named(tmp_path, "a")
        store_outcome(job, outcome_of(job, "calibrated", key="1"))
        (job.result_folder / "old.txt").write_text("old")
        made = job.working_folder / "result"
        made.mkdir(parents=True)
        with pytest.raises(ValueError, match="stop"), result_in_place(job, made):
            raise ValueError("stop")
        assert (job.result_folder / "old.txt").is_file()
        with result_in_place(job, made) as folder:
            (folder / "new.txt").write_text("new")
        assert [p.name for p in job.result_folder.iterdir()] == ["new.txt"]

    @pytest.mark.parametrize(
        "content", ["", "{", "[]", '{"name": 3}', '{"name": "a", "cameras": 5}', "\0" * 50, "null"]
    )
    def test_a_broken_outcome_is_none(self, tmp_path: Path, content: str) -> None:
        (job,) = jobs_named(tmp_path, "a")
        job.result_folder.mkdir(parents=True)
        (job.result_folder / "outcome.json").write_text(content)
        assert read_outcome(job.result_folder) is None
        assert finished_outcome(job) is None

    def test_names_are_safe_and_tell_recordings_apart(self) -> None:
        names = {
            job_name(p)
            for p in ("/a/x.bag", "/b/x.bag", "/a/../x", "/a/.hidden", "/ä/ö ü.bag", "/a/" + "x" * 300)
        }
        assert len(names) == 6
        assert all(n.isascii() and "/" not in n and not n.startswith(".") and len(n) < 80 for n in names)

    def test_shards_divide_all_recordings_evenly(self) -> None:
        shards = Counter(shard_of(f"/boat/{k}.bag", 8) for k in range(4000))
        assert set(shards) == set(range(1, 9))
        assert max(shards.values()) < 1.25 * min(shards.values())


def test_shards_together_do_all_and_the_whole_collects(tmp_path: Path) -> None:
    fleet = jobs_named(tmp_path, *(f"r{k}" for k in range(9)))
    for i in (1, 2, 3):
        run_fleet(fleet, FleetPlan(tmp_path / "out", processes=1, shard=(i, 3)))
    assert begun(tmp_path) == Counter({f"r{k}": 1 for k in range(9)})
    whole = run_fleet(fleet, FleetPlan(tmp_path / "out"))
    assert whole.done_before == 9
    assert (tmp_path / "out" / "fleet-2-of-3.csv").is_file()


def test_counts_are_words() -> None:
    counts = Counter({"calibrated": 187, "not observable": 9, "failed": 4})
    causes = Counter({"truncated bag": 2, "time-out": 1, "out of memory": 1})
    assert counts_in_words(counts, causes) == (
        "187 calibrated, 9 not observable, 4 failed (2 truncated bags, 1 time-out, 1 out of memory)"
    )


def test_a_process_ends_with_whoever_started_it(tmp_path: Path) -> None:
    process = TaskProcess()
    (job,) = jobs_named(tmp_path, "a")
    (tmp_path / "out").mkdir()
    assert process.attend(job).status == "calibrated"
    assert process._process is not None
    child = process._process
    assert child.stdin is not None
    child.stdin.close()  # what the system does for a parent that is gone
    child.wait(20)
    process.end()


def test_a_token_is_shared_by_shards(tmp_path: Path) -> None:
    assert fleet_run._token(tmp_path) == fleet_run._token(tmp_path)
