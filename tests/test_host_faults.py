"""What the computer does to a run: full disks, special files, signals, killed processes, odd terminals."""

import errno
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest

import worker_jobs
from cli_runs import run, write_examples
from rigwake.atomic import TEMPORARY_PREFIX, atomic_path, remove_leftovers, write_text_atomic
from rigwake.cli import console
from rigwake.cli.faults import Stopped, signals_raise, words_of
from rigwake.errors import HostError, InputError, RigwakeError, UsageError
from rigwake.fingerprint import files_changed_at, input_fingerprint, unchanged
from rigwake.kernel_cache import VARIABLE, provide_kernel_cache
from rigwake.pipeline.out_folder import check_camera_names, check_out_folder, clear_results, used_by_one
from rigwake.workers import run_in_processes

SOURCE = Path(__file__).parent.parent / "src"


class TestAtomicFiles:
    def test_a_failure_leaves_the_old_file_and_nothing_else(self, tmp_path: Path) -> None:
        file = tmp_path / "a.json"
        write_text_atomic(file, "old")

        def fail_halfway() -> None:
            with atomic_path(file) as temporary:
                temporary.write_text("half")
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            fail_halfway()
        assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
        assert file.read_text() == "old"

    def test_a_symbolic_link_stays_one(self, tmp_path: Path) -> None:
        for target in ("there", "not_there"):
            if target == "there":
                (tmp_path / target).write_text("old")
            link = tmp_path / f"link_to_{target}"
            link.symlink_to(tmp_path / target)
            write_text_atomic(link, "new")
            assert link.is_symlink()
            assert (tmp_path / target).read_text() == "new"

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
    def test_a_pipe_is_written_into_not_replaced(self, tmp_path: Path) -> None:
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        read: list[str] = []
        reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
        reader.start()
        write_text_atomic(pipe, "through")
        reader.join(5)
        assert read == ["through"]
        assert pipe.is_fifo()

    @pytest.mark.skipif(not Path("/dev/null").is_char_device(), reason="no /dev/null here")
    def test_devices_are_written_into(self) -> None:
        write_text_atomic("/dev/null", "gone")
        assert Path("/dev/null").is_char_device()

    @pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="no /dev/full here")
    def test_a_full_device_says_so(self) -> None:
        with pytest.raises(OSError, match="No space") as caught:
            write_text_atomic("/dev/full", "x" * 100_000)
        assert "/dev/full cannot be read or written: the disk is full" in str(words_of(caught.value))

    def test_the_file_that_did_not_fit_is_named(self, tmp_path: Path) -> None:
        def fill() -> None:
            with atomic_path(tmp_path / "front.npz"):
                raise OSError(errno.ENOSPC, "No space left on device")

        with pytest.raises(OSError, match=r"front\.npz"):
            fill()

    def test_long_names_and_names_that_are_no_text(self, tmp_path: Path) -> None:
        write_text_atomic(tmp_path / ("x" * 240 + ".yaml"), "ok")
        write_text_atomic(tmp_path / "a.txt", "name \udc80")
        assert (tmp_path / "a.txt").read_text() == "name \\udc80"

    def test_leftovers_are_removed_and_nothing_else(self, tmp_path: Path) -> None:
        (tmp_path / "tracks").mkdir()
        for name in (
            f"{TEMPORARY_PREFIX}a.npz",
            f"tracks/{TEMPORARY_PREFIX}b.npz",
            "tracks/.mine",
            "kept.npz",
        ):
            (tmp_path / name).write_text("")
        assert remove_leftovers(tmp_path) == 2
        assert sorted(p.name for p in tmp_path.rglob("*")) == [".mine", "kept.npz", "tracks"]


class TestFingerprints:
    @pytest.mark.parametrize("at", [0, 1_500_000, 2_999_999])
    def test_every_byte_counts(self, tmp_path: Path, at: int) -> None:
        file = tmp_path / "a.bag"
        content = bytearray(3_000_000)
        file.write_bytes(content)
        first, folder = input_fingerprint(file), input_fingerprint(tmp_path)
        content[at] ^= 1
        file.write_bytes(content)
        assert input_fingerprint(file)["sha256"] != first["sha256"]
        assert input_fingerprint(tmp_path)["sha256"] != folder["sha256"]
        assert "hashed_bytes" not in first

    def test_of_large_inputs_blocks_count_and_it_is_said(self, tmp_path: Path) -> None:
        file = tmp_path / "a.bag"
        file.write_bytes(bytes(9_000_000))
        first = input_fingerprint(file, most_bytes=3_000_000)
        assert first["hashed_bytes"] < first["bytes"] == 9_000_000
        for at in (0, 8_999_999):
            with file.open("r+b") as handle:
                handle.seek(at)
                handle.write(b"x")
            assert input_fingerprint(file, most_bytes=3_000_000)["sha256"] != first["sha256"]

    def test_times_tell_what_samples_miss(self, tmp_path: Path) -> None:
        file = tmp_path / "a.bag"
        file.write_bytes(b"x")
        before = files_changed_at(file)
        os.utime(file, ns=(1, 1))
        assert files_changed_at(file) != before

    @pytest.mark.parametrize("change", ["grown", "removed", "overwritten"])
    def test_an_input_that_changes_is_the_cause(self, tmp_path: Path, change: str) -> None:
        file = tmp_path / "a.bag"
        file.write_bytes(b"1234")

        def read() -> None:
            with unchanged(file):
                if change == "removed":
                    file.unlink()
                else:
                    file.write_bytes(b"12345" if change == "grown" else b"abcd")
                    os.utime(file, ns=(1, 1))
                raise RigwakeError("only 8 motions fall into the time")

        with pytest.raises(InputError, match=r"while it was read") as caught:
            read()
        assert caught.value.remedy
        assert isinstance(caught.value.__cause__, RigwakeError)

    def test_other_errors_stay(self, tmp_path: Path) -> None:
        (tmp_path / "a").write_text("")
        with pytest.raises(RigwakeError, match="only 8 motions"), unchanged(tmp_path):
            raise RigwakeError("only 8 motions")


class TestOutFolder:
    def test_two_runs_in_one_folder_are_refused(self, tmp_path: Path) -> None:
        out = tmp_path / "deep" / "OUT"
        with used_by_one(out):
            with pytest.raises(UsageError, match=f"process {os.getpid()}"), used_by_one(out):
                pass
            (out / "result").write_text("")
        with used_by_one(out):
            pass
        assert [p.name for p in out.iterdir()] == ["result"]

    def test_a_run_that_fails_at_once_leaves_nothing(self, tmp_path: Path) -> None:
        with pytest.raises(RigwakeError), used_by_one(tmp_path / "deep" / "OUT"):
            raise RigwakeError("no")
        assert list(tmp_path.iterdir()) == []

    def test_a_removed_folder_is_the_cause(self, tmp_path: Path) -> None:
        out = tmp_path / "OUT"

        def lose_it() -> None:
            with used_by_one(out):
                shutil.rmtree(out)
                (out / "x").read_text()

        with pytest.raises(HostError, match="was removed while"):
            lose_it()

    def test_results_are_neither_overwritten_nor_mixed(self, tmp_path: Path) -> None:
        out = tmp_path / "OUT"
        (out / "masks").mkdir(parents=True)
        for name in ("calibration.yaml", "stages.json", "notes.txt", "masks/a.png"):
            (out / name).write_text("")
        with pytest.raises(UsageError, match="another run"):
            check_out_folder(out, [], force=False, resume=False)
        check_out_folder(out, [], force=False, resume=True)
        check_out_folder(out, [], force=True, resume=False)
        clear_results(out, everything=True)
        assert [p.name for p in out.iterdir()] == ["notes.txt"]
        check_out_folder(out, [], force=False, resume=False)

    def test_inside_a_recording_also_through_links(self, tmp_path: Path) -> None:
        (tmp_path / "rec").mkdir()
        (tmp_path / "link").symlink_to(tmp_path / "rec")
        for out in (tmp_path / "rec", tmp_path / "rec" / "a" / "b", tmp_path / "link" / "a"):
            with pytest.raises(UsageError, match="lies inside of"):
                check_out_folder(out, [tmp_path / "rec"], force=True, resume=False)
        check_out_folder(tmp_path / "rec2", [tmp_path / "rec"], force=False, resume=False)

    @pytest.mark.parametrize(
        "name",
        [
            "../up",
            "a/b",
            "a\\b",
            "..",
            ".hidden",
            "",
            " ",
            "nul\0",
            "x" * 250,
            "rig",
            "a\nb",
            "\x1b[31m",
            "a:b",
        ],
    )
    def test_names_that_cannot_be_files(self, name: str) -> None:
        with pytest.raises(UsageError):
            check_camera_names([name])

    def test_names_whose_files_would_be_mixed_up(self) -> None:
        check_camera_names(["front", "davis_left", "Kamera 1", "achtern_süd"])
        with pytest.raises(UsageError, match="front_hull"):
            check_camera_names(["front", "front_hull"])


class TestWorkers:
    def test_results_and_what_is_told(self) -> None:
        known_fraction: list[tuple] = []
        finished: dict[str, int] = {}
        jobs = {str(k): k for k in range(3)}
        results = run_in_processes(
            worker_jobs.square, jobs, 2, lambda *m: known_fraction.append(m), finished.__setitem__
        )
        assert results == finished == {"0": 0, "1": 1, "2": 4}
        assert sorted(m[0] for m in known_fraction) == ["job 0", "job 1", "job 2"]

    def test_a_killed_worker_is_put_into_words(self) -> None:
        with pytest.raises(HostError, match="ended from outside") as caught:
            run_in_processes(worker_jobs.die, {"front": 1, "left": 2}, 2, lambda *m: None)
        assert "front" in caught.value.cause
        assert "--resume" in caught.value.remedy

    def test_errors_of_the_system_come_through(self) -> None:
        with pytest.raises(OSError, match="/full/disk") as caught:
            run_in_processes(worker_jobs.refuse, {"front": 1, "left": 2}, 2, lambda *m: None)
        assert "disk is full" in str(words_of(caught.value))

    @pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGTERM])
    def test_workers_end_with_their_parent(self, tmp_path: Path, signum: int) -> None:
        code = (
            "import worker_jobs\n"
            "from rigwake.workers import run_in_processes\n"
            "if __name__ == '__main__':\n"
            "    run_in_processes(worker_jobs.sleep_long, {'a': 1, 'b': 2}, 2, lambda *m: print(m[1], flush=True))\n"
        )
        script = tmp_path / "parent.py"
        script.write_text(code)
        paths = os.pathsep.join([str(SOURCE), str(Path(__file__).parent)])
        with subprocess.Popen(
            [sys.executable, str(script)],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": paths},
        ) as parent:
            assert parent.stdout is not None
            workers = [int(parent.stdout.readline()) for _ in range(2)]
            assert all(is_running(pid) for pid in workers)
            parent.send_signal(signum)
            parent.wait(10)
        assert ended_within(workers, 5.0)


def is_running(pid: int) -> bool:
    """Whether the process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def ended_within(pids: list[int], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if not any(map(is_running, pids)):
            return True
        time.sleep(0.05)
    return False


class TestWords:
    @pytest.mark.parametrize(
        "number",
        [
            "ENOSPC",
            "EDQUOT",
            "EFBIG",
            "EACCES",
            "EROFS",
            "ENOTDIR",
            "EISDIR",
            "ENAMETOOLONG",
            "EMFILE",
            "EIO",
        ],
    )
    def test_errors_of_the_system(self, number: str) -> None:
        code = getattr(errno, number)
        error = words_of(OSError(code, os.strerror(code), "/data/OUT/tracks/front.npz"))
        assert error.exit_code == 1
        assert "/data/OUT/tracks/front.npz" in error.cause
        assert error.consequence
        assert error.remedy

    def test_memory_and_the_unknown(self) -> None:
        assert "memory" in words_of(MemoryError()).cause
        assert "NUMBA_CACHE_DIR" in words_of(RuntimeError("cannot cache function 'f': no locator")).remedy
        unknown = words_of(KeyError("x"))
        assert unknown.exit_code == 1
        assert "KeyError" in unknown.cause

    def test_signals_raise_and_say_how_to_go_on(self) -> None:
        before = signal.getsignal(signal.SIGTERM)
        with pytest.raises(Stopped) as caught, signals_raise():
            signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) == before
        assert caught.value.exit_code == 143
        words = caught.value.words(["calibrate", "my sail.bag", "-o", "OUT"])
        assert words.remedy == "Go on with: rigwake calibrate 'my sail.bag' -o OUT --resume"

    def test_a_process_that_cannot_tidy_up_ends_in_the_same_words(self) -> None:
        script = """
            import signal, time
            from rigwake.cli import faults
            faults._GRACE_S = 0.1
            try:
                with faults.signals_raise(["calibrate", "my sail.bag"]):
                    try:
                        signal.raise_signal(signal.SIGTERM)
                    finally:
                        time.sleep(60)
            finally:
                print("too late")
        """
        ended = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(script)],
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
        assert ended.returncode == 143
        assert ended.stdout == ""
        assert ended.stderr.startswith("rigwake: Stopped by the signal SIGTERM.")
        assert "Go on with: rigwake calibrate 'my sail.bag' --resume" in ended.stderr


class TestTerminals:
    def test_control_characters_are_shown_not_done(self, capsys: pytest.CaptureFixture) -> None:
        evil = "/front\x1b]0;title\x07\x1b[2J\x9b31m\u202e"
        table = console.figures_table(("name", "n"))
        table.add_row(console.escape(evil), "1")
        console.out.print(table)
        console.out.print(console.escape(evil))
        console.print_error(RigwakeError(evil, consequence=evil, remedy=evil))
        said = "".join(capsys.readouterr())
        assert not set(said) & set("\x1b\x07\x9b\u202e")
        assert r"\x1b" in said

    @pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
    def test_every_character_can_be_written(self, encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
        stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr(sys, "stdout", stream)
        console.adapt_streams()
        print("1.0 ± 0.1 °, → \udc80 Δ")
        stream.flush()
        said = stream.buffer.getvalue().decode(encoding, "replace")
        assert said.startswith("1.0 ")
        assert ("+-" in said) == (encoding == "ascii")

    def test_progress_is_plain_lines_where_there_is_no_terminal(self, capsys: pytest.CaptureFixture) -> None:
        with console.progress_bars() as bars:
            for k in range(100):
                bars("front", "tracking", k / 100)
            bars("front", "odometry", 0.5)
        lines = capsys.readouterr().err.splitlines()
        assert lines == ["front: tracking 0 %", "front: odometry 50 %"]


class TestKernelCache:
    def test_a_private_folder_where_nothing_else_can_be_written(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rigwake.kernel_cache._PACKAGE", Path("/proc/none"))
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        monkeypatch.setenv("XDG_CACHE_HOME", "/proc/none")
        monkeypatch.delenv(VARIABLE, raising=False)
        monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path))
        monkeypatch.delitem(sys.modules, "numba", raising=False)
        chosen = provide_kernel_cache.__wrapped__()
        assert chosen is not None
        assert chosen.parent == tmp_path
        assert chosen.stat().st_mode & 0o777 == 0o700
        assert os.environ[VARIABLE] == str(chosen)
        monkeypatch.delenv(VARIABLE)
        chosen.chmod(0o777)  # as another user would leave it
        assert provide_kernel_cache.__wrapped__() != chosen

    def test_nothing_changes_where_the_installation_can_be_written(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.delenv(VARIABLE, raising=False)
        assert provide_kernel_cache.__wrapped__() is None
        assert VARIABLE not in os.environ


@pytest.mark.parametrize("words", [["--help"], ["calibrate", "-h"]])
def test_help_costs_little(words: list[str]) -> None:
    code = (
        "import os, sys\nfrom rigwake.cli.main import main\ntry:\n    main()\nexcept SystemExit:\n    pass\n"
    )
    code += "heavy = {'numpy', 'cv2', 'numba', 'scipy', 'yaml'} & set(sys.modules)\n"
    code += "print(sum(os.times()[:2]), *heavy, file=sys.stderr)\n"
    code += "status = '/proc/self/status'\n"
    code += "print(open(status).read() if os.path.exists(status) else '', file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(SOURCE)},
    )
    seconds, *heavy = done.stderr.splitlines()[0].split()
    assert heavy == []
    peak = re.search(r"VmHWM:\s+(\d+) kB", done.stderr)
    assert peak is None or int(peak[1]) < 80_000
    assert float(seconds) < 1.2  # 0.2 to 0.3 on a quiet core; more only where others use the caches
    assert "rigwake" in done.stdout


def test_the_module_runs_and_full_output_is_put_into_words(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(SOURCE)}
    command = [sys.executable, "-m", "rigwake", "--version"]
    assert subprocess.run(
        command, capture_output=True, text=True, check=True, env=environment
    ).stdout.startswith("rig")
    if Path("/dev/full").exists():
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(
                command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=environment
            )
        assert done.returncode == 1
        assert "the disk is full" in done.stderr
        assert "Exception ignored" not in done.stderr


def test_json_to_standard_output_and_to_devices(tmp_path: Path) -> None:
    files = write_examples(tmp_path)
    ended = run("diff", files["calibration"], files["calibration"], "--json", "-")
    assert ended.code == 0
    assert ended.out.startswith("{")
    assert run("diff", files["calibration"], files["calibration"], "--json", "/dev/null").code == 0
    assert Path("/dev/null").is_char_device()


def test_a_script_needs_no_main_guard(tmp_path: Path) -> None:
    """Workers do not run the caller's script again: saved as a file it works without `if __name__ == "__main__"`."""
    script = tmp_path / "mine.py"
    script.write_text(
        "import operator\n"
        "from rigwake.workers import run_in_processes\n"
        "print('once')\n"
        "print(sorted(run_in_processes(operator.is_, {'a': 12, 'b': 18}, 2, lambda *_: None).items()))\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("once") == 1
