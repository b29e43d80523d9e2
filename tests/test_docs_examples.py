"""The examples of the documentation run, and the messages that it explains exist."""

import ast
import re
import runpy
import shlex
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import tutorial_outputs
from calibrated_rigs import PINHOLE, boat, without_vertical
from rigwake.calibration import load_calibration, save_calibration
from rigwake.cameras.registry import camera_to_dict
from rigwake.cli.main import build_app
from rigwake.evaluation.rig_errors import evaluate_calibration
from rigwake.readers.truth_files import read_true_rig, rig_in_frame

ROOT = Path(__file__).parent.parent
WHOLE_WAY, *EXAMPLES = re.findall(
    r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL
)


@pytest.mark.parametrize("code", EXAMPLES, ids=range(len(EXAMPLES)))
def test_examples_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, code: str
) -> None:
    save_calibration(boat(lens=PINHOLE), tmp_path / "OUT" / "calibration.yaml")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "docs/python.md", "exec"), {})
    assert capsys.readouterr().out.strip()


def test_there_are_three_examples() -> None:
    assert len(EXAMPLES) >= 3
    assert "rigwake.calibrate(" in WHOLE_WAY


def test_the_whole_way_says_what_a_recording_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    cameras = {}
    for name in ("front", "left"):
        folder = tmp_path / "harbour.bag" / name  # recordings are known by their content, not by their name
        folder.mkdir(parents=True)
        for k in range(4):
            cv2.imwrite(
                str(folder / f"{k}.png"), np.full((PINHOLE.height_px, PINHOLE.width_px), 100, np.uint8)
            )
        cameras[name] = {"camera": camera_to_dict(PINHOLE)}
    (tmp_path / "harbour.bag" / "rig.yaml").write_text(yaml.safe_dump({"cameras": cameras}))
    monkeypatch.chdir(tmp_path)
    exec(compile(WHOLE_WAY, "docs/python.md", "exec"), {})
    said = capsys.readouterr().out
    assert "s of images are to be used." in said
    assert "Record one to two minutes with turns to both sides." in said


def test_a_notebook_shows_a_table_without_made_up_numbers() -> None:
    rig = without_vertical(boat(), "port")
    assert rig._repr_html_().count("<tr>") == 5
    assert rig._repr_html_().count("<circle") == len(rig.cameras)
    assert "port: x y z 410.0 ± 4, 830.0 ± 11, unobservable mm" in repr(rig)
    assert "nan" not in rig._repr_html_() + repr(rig)


@cache
def syntax_of_package() -> list[ast.AST]:
    """Strings and raised errors of the whole package."""
    kinds = (ast.JoinedStr, ast.Constant, ast.Raise)
    files = (ROOT / "src" / "rigwake").rglob("*.py")
    return [
        node for path in files for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kinds)
    ]


def source_text() -> str:
    """All string literals of the package, adjacent ones joined, what is inserted left out."""
    literals = []
    for node in syntax_of_package():
        if isinstance(node, ast.JoinedStr):
            literals += [part.value for part in node.values if isinstance(part, ast.Constant)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            literals.append(node.value)
    return "\n".join(literals)


def test_messages_in_the_faq_are_messages_of_the_program() -> None:
    rows = re.findall(r"^\| `(.+?)`", (ROOT / "docs" / "faq.md").read_text(), re.MULTILINE)
    assert len(rows) > 10
    known = source_text()
    for message in rows:
        fragments = [f for f in re.split(r"\.\.\.|\d[\d.]*", message) if len(f.split()) >= 2]
        assert fragments, message
        for fragment in fragments:
            assert fragment.strip() in known, message


def causes_of(error: str) -> list[list[str]]:
    """The words, without what is inserted, of every cause that is raised as this error."""
    found = []
    for node in syntax_of_package():
        raised = node.exc if isinstance(node, ast.Raise) else None
        if isinstance(raised, ast.Call) and raised.args and ast.unparse(raised.func) == error:
            parts = [n for n in ast.walk(raised.args[0]) if isinstance(n, ast.Constant)]
            words = [str(part.value).strip() for part in parts]
            found.append([text for text in words if len(text.split()) >= 2])
    return found


def test_every_message_of_exit_code_3_is_explained() -> None:
    faq = (ROOT / "docs" / "faq.md").read_text()
    causes = [words for words in causes_of("UnobservableError") if words]
    assert len(causes) > 12
    for words in causes:
        longest = max(words, key=len)
        assert any(text.lstrip(": ")[:40] in faq for text in words), f"docs/faq.md lacks: {longest}"


def test_the_example_exports_what_the_formats_can_hold(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_calibration(boat(), tmp_path / "calibration.yaml")
    monkeypatch.setattr(
        "sys.argv", ["export_everywhere.py", str(tmp_path / "calibration.yaml"), str(tmp_path / "out")]
    )
    runpy.run_path(str(ROOT / "examples" / "export_everywhere.py"), run_name="__main__")
    said = capsys.readouterr().out
    refused = {line.split()[0] for line in said.splitlines() if " refused: " in line}
    assert refused == {"basalt", "mrcal"}  # noise of the IMU is missing; no fisheye
    assert len(list((tmp_path / "out").iterdir())) == 9


@pytest.mark.slow
def test_the_motions_of_the_picture_determine_what_the_page_says(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["motions.py", str(tmp_path / "motions.png")])
    runpy.run_path(str(ROOT / "examples" / "motions.py"), run_name="__main__")
    straight, circle, calm, waves = capsys.readouterr().out.splitlines()
    assert "rotation unobservable; offset unobservable" in straight
    assert "rotation unobservable; offset unobservable" in circle
    assert "rotation ±" in calm
    assert "z –" in calm
    assert re.search(r"rotation ± .*x [\d.]+ cm, y [\d.]+ cm, z [\d.]+ cm", waves)
    assert (tmp_path / "motions.png").stat().st_size > 10_000


def test_pages_of_the_site_exist_and_links_between_them_hold() -> None:
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    named = re.findall(r"[\w/]+\.md", str(site["nav"]))
    assert len(named) > 10
    assert [page for page in named if not (ROOT / "docs" / page).is_file()] == []
    for page in (ROOT / "docs").glob("*.md"):
        for link in re.findall(r"\]\(([^)#\s]+)\)", page.read_text()):
            if "://" not in link:
                assert (page.parent / link).exists(), f"{page.name}: {link}"


def commands_of(page: Path) -> list[list[str]]:
    """The words of every `rigwake ...` line of a code block."""
    lines = re.findall(r"^ {4,}(rigwake [a-z].*)$", page.read_text(), re.MULTILINE)
    return [shlex.split(line, comments=True)[1:] for line in lines if "..." not in line.split("#")[0]]


def test_the_tutorial_shows_what_the_commands_print() -> None:
    shown = tutorial_outputs.blocks()
    assert [words[0] for words, _ in shown] == ["inspect", "calibrate", "evaluate"]
    known = source_text()
    for _, block in shown:  # sentences of the page are sentences of the program
        for sentence in re.findall(r"^[a-z]+: ([A-Za-z ]{20,})", block, re.MULTILINE):
            assert sentence.strip() in known


def run_commands(commands: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Run `rigwake ...` one after the other, without opening a browser; what they said."""
    monkeypatch.setattr("webbrowser.open", lambda address: True)
    said = []
    for words in commands:
        done = CliRunner().invoke(build_app(), words)
        assert done.exit_code == 0, (words, done.output, done.exception)
        said.append(done.output)
    return said


def test_the_tutorial_runs_from_its_result_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for path in ("OUT/calibration.yaml", "OUT2/calibration.yaml", "harbour_truth/truth.yaml"):
        save_calibration(boat(), Path(path))
    commands = commands_of(ROOT / "docs" / "tutorial.md")
    assert [words[0] for words in commands[:3]] == ["simulate", "inspect", "calibrate"]
    said = "\n".join(run_commands(commands[3:], monkeypatch))
    assert "USABLE" in said
    assert "camera to camera, worst pair: 0.0000°" in said
    assert Path("cameras.launch").read_text().startswith("<launch>")
    assert yaml.safe_load(Path("camchain.yaml").read_text())["cam0"]["camera_name"] == "front"


@pytest.mark.slow
def test_the_whole_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    commands = commands_of(ROOT / "docs" / "tutorial.md")
    commands[0] += ["--duration", "20"]  # shorter than the page's, to save time
    again = next(i for i, words in enumerate(commands) if "OUT2/calibration.yaml" in words)
    commands[again] = ["diff", "OUT/calibration.yaml", "OUT/calibration.yaml"]
    said = run_commands(commands, monkeypatch)
    assert "Enough to calibrate." in "\n".join(said)
    spoken = {word for output in said for word in tutorial_outputs.words_of(output)}
    for command, block in tutorial_outputs.blocks():
        assert tutorial_outputs.words_of(block), command
        sides = set(tutorial_outputs.words_of(block)) - spoken
        assert not sides, f"{command}: the page says {sides}: python tests/tutorial_outputs.py FOLDER"
    exec(compile(WHOLE_WAY, "docs/python.md", "exec"), {})
    assert set(load_calibration(Path("OUT3/calibration.yaml")).cameras) == {"front", "left"}
    truth = read_true_rig(tmp_path / "harbour_truth" / "truth.yaml")
    found = load_calibration(tmp_path / "OUT" / "calibration.yaml")
    for error in evaluate_calibration(found, rig_in_frame(truth, found.reference)).cameras.values():
        assert error.rotation_error_deg < 0.1
        assert error.translation_error_norm_m < 0.05


def test_every_page_is_in_the_site_and_linked_from_its_start() -> None:
    docs = ROOT / "docs"
    pages = {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")}
    named = set(re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text()))
    assert pages == named | {
        page for page in pages if page.startswith("cli/")
    }  # its index links to a page per verb
    linked = set(re.findall(r"\]\(([\w/]+\.md)\)", (docs / "index.md").read_text()))
    assert {page for page in pages if "/" not in page} - linked == {"index.md"}
    assert {"reference/api.md", "measurements/index.md"} <= linked  # the ways to pages made by programs
