"""Before a verb runs: the list of verbs and the completion of the shell are quick, and extras that are missing are
named."""

from __future__ import annotations

import importlib.util
import io
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rich.console import Console

from cli_runs import run
from rigwake.cli.console import figures_table
from rigwake.cli.main import GROUPS, VERBS, build_app, main

_HEAVY = ("numpy", "cv2", "scipy", "numba", "av")


def test_the_list_of_verbs_is_the_same_without_their_options() -> None:
    full, outline = (
        typer.main.get_command(app).commands  # type: ignore[attr-defined]
        for app in (build_app(), build_app(outline=True))
    )
    assert list(full) == list(outline) == [*VERBS, *GROUPS]
    assert [c.get_short_help_str(200) for c in full.values()] == [
        c.get_short_help_str(200) for c in outline.values()
    ]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("rigwake cal", ["calibrate"]),
        ("rigwake ", [*VERBS, *GROUPS]),
        ("rigwake --ver", ["--version"]),
        ("rigwake calibrate --intr", ["--intrinsics"]),
        ("rigwake calibrate sail.bag --start 3 --set a=b --dur", ["--duration"]),
        ("rigwake fleet cal", ["calibrate"]),
        ("rigwake export x --to urd", ["urdf"]),
    ],
)
def test_the_shell_completes(
    line: str, expected: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_RIGWAKE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().out.split() == expected


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["calibrate", "--help"]])
def test_help_loads_nothing_heavy_and_stays_small(words: list[str]) -> None:
    program = (
        "import re, sys\nfrom rigwake.cli.main import main\ntry: main(sys.argv[1:])\nexcept SystemExit: pass\n"
        "peak = re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1]\n"
        f"print('peak:', peak, *sorted(set(sys.modules) & set({_HEAVY!r})), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, check=True)
    peak_kb, *heavy = done.stderr.split("peak:")[1].split()
    assert heavy == []
    assert int(peak_kb) / 1024 < 80


def test_completion_loads_nothing_that_only_work_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    late = (*_HEAVY, "rich.progress", "rich.panel", "pydantic")
    program = (
        "import sys\nfrom rigwake.cli.main import main\ntry: main([])\nexcept SystemExit: pass\n"
        f"print(*sorted(set(sys.modules) & set({late!r})), file=sys.stderr)"
    )
    monkeypatch.setenv("_RIGWAKE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "rigwake calibrate --intr")
    monkeypatch.setenv("COMP_CWORD", "2")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["--intrinsics"]
    assert done.stderr.split() == []


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "sail"
    folder.mkdir()
    (folder / "front.mp4").write_bytes(b"not read")
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "av" else found(name, *rest)
    )
    for words in (["inspect", folder], ["surround", tmp_path, folder, "-o", tmp_path / "top.mp4"]):
        ended = run(*words)
        assert ended.code == 2
        assert "pip install 'rigwake[video]'" in ended.words


@pytest.mark.parametrize("width", [80, 40, 24])
def test_a_narrow_terminal_keeps_the_camera_and_every_figure(width: int) -> None:
    table = figures_table(["camera", "rotation deg", "offset mm", "sigma deg", "sigma mm"])
    rows = [
        ["starboard_aft", "0.0123", "12.3", "0.0100", "4.0"],
        ["front", "0.0456", "[red]78.9[/red]", "1", "2"],
    ]
    for row in rows:
        table.add_row(*row)
    console = Console(width=width, file=io.StringIO())
    console.print(table)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, shown.splitlines())) <= width
    figures = [cell.replace("[red]", "").replace("[/red]", "") for row in rows for cell in row]
    assert all(cell in shown for cell in figures)
    assert shown.index("starboard_aft") < shown.index("0.0123") < shown.index("front") < shown.index("78.9")
