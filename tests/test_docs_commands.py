"""Every command and every block of Python in README and docs: run on small files, or, with a reason in
`docs_commands.yaml`, parsed as the program would."""

from __future__ import annotations

import ast
import importlib
import re
import shutil
from pathlib import Path

import pytest
import typer
import yaml

from calibrated_rigs import PINHOLE, boat, without_vertical
from cli_runs import run, write_images, write_trajectories
from rigwake.calibration import save_calibration
from rigwake.cli.main import build_app
from test_docs_examples import ROOT, commands_of

NOT_RUN: dict[str, str] = yaml.safe_load((Path(__file__).parent / "docs_commands.yaml").read_text())
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = [
    pytest.param(words, id=f"{page.stem}: rigwake {' '.join(words)}")
    for page in PAGES
    for words in commands_of(page)
]
BLOCKS = [
    pytest.param(code, id=f"{page.stem}-{k}")
    for page in PAGES
    for k, code in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
]


def reason_of(words: list[str]) -> str | None:
    """Why a command is not run; None if it is."""
    line = " ".join(["rigwake", *words])
    return next((NOT_RUN[start] for start in NOT_RUN if line.startswith(start)), None)


def bare(words: list[str]) -> list[str]:
    """The words of a command without `> FILE`."""
    return words[: words.index(">")] if ">" in words else words


@pytest.fixture(scope="module")
def small_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the commands name: recordings of four pictures, calibrations, trajectories, a history."""
    folder = tmp_path_factory.mktemp("docs")
    write_images(folder / "images", cameras=("front", "port"))
    shutil.copytree(folder / "images", folder / "pictures")
    assert run("convert", folder / "images", "-o", folder / "sail.bag").code == 0
    for name in ("later.bag", "today.bag", "harbour.bag", "REC"):
        shutil.copyfile(folder / "sail.bag", folder / name)
    write_trajectories(folder)
    (folder / "rig.tum").rename(folder / "imu.tum")
    for path in ("OUT", "OUT2", "harbour_truth"):
        (folder / path).mkdir()
        save_calibration(boat(lens=PINHOLE), folder / path / "calibration.yaml")
    shutil.copyfile(folder / "OUT" / "calibration.yaml", folder / "calibration.yaml")
    shutil.copyfile(folder / "OUT" / "calibration.yaml", folder / "harbour_truth" / "truth.yaml")
    save_calibration(without_vertical(boat(lens=PINHOLE), "port"), folder / "before.yaml")
    for month, name in (("03", "before"), ("04", "calibration")):
        added = (
            "log",
            "add",
            folder / "vessel.db",
            folder / f"{name}.yaml",
            "--from",
            f"2026-{month}-01T08:00",
        )
        assert run(*added).code == 0
    return folder


@pytest.mark.parametrize("words", COMMANDS)
def test_the_command_runs_or_is_parsed(
    words: list[str], small_files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(small_files)
    words = bare(words)
    if reason_of(words) is None:
        if words[0] == "convert":
            shutil.rmtree(words[words.index("-o") + 1], ignore_errors=True)
            Path(words[words.index("-o") + 1]).unlink(missing_ok=True)
        ended = run(*words)
        assert ended.code == 0, ended.words
        return
    command = typer.main.get_command(build_app([words[0]]))
    context = command.make_context("rigwake", [words[0]], resilient_parsing=True)
    rest = words
    while (inner := getattr(command, "commands", None)) is not None:
        command, rest = inner[rest[0]], rest[1:]
    command.make_context(words[0], list(rest), parent=context)


def test_reasons_belong_to_commands() -> None:
    used = {reason_of(bare(parameter.values[0])) for parameter in COMMANDS}
    assert set(NOT_RUN.values()) <= used
    for reason in NOT_RUN.values():
        for module in re.findall(r"test_\w+", reason):
            assert (Path(__file__).parent / f"{module}.py").is_file(), module


@pytest.mark.parametrize("code", BLOCKS)
def test_names_that_blocks_of_python_import_exist(code: str) -> None:
    """Those of docs/python.md run in test_docs_examples."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rigwake"):
            module = importlib.import_module(node.module or "")
            assert [alias.name for alias in node.names if not hasattr(module, alias.name)] == []
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id == "rigwake"
        ):
            assert hasattr(importlib.import_module("rigwake"), node.attr), node.attr


def test_targets_of_make_exist() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        assert set(re.findall(r"^ {4}make ([a-z-]+)", page.read_text(), re.MULTILINE)) <= targets, page.name
