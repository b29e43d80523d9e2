"""One name, one thing: no file or class name stands in two packages, and no word of the old dialect comes back."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest
import yaml

import rigwake

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "rigwake"
MODULES = sorted(PACKAGE.rglob("*.py"))
SOURCES = {path: path.read_text() for path in MODULES}
TEXTS = SOURCES | {
    path: path.read_text()
    for path in [*PACKAGE.rglob("*.j2"), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
}

# a verb of the command line is a file named after it
AGREED_FILES = {"__init__", "__main__"}

# word -> the field's term
OLD_WORDS = {
    r"hand(ed|ing)?[- _]over": "cross-camera association",
    r"HandOver": "CrossCameraMatches",
    r"promise[ds]?": "assumed, predicted",
    r"doubt(s|ful|ed|ed_at)?": "uncertainty, suspected",
    r"feign(s|ed)?": "spurious",
    r"foreign(?!_keys)": "external",
    r"kept[- _]back": "held-out",
    r"rig adjustment": "rig bundle adjustment",
    r"(not |un)determined(?! entry)": "unobservable",
    r"seed (method|pipeline)": "thesis baseline",
    r"hull mask": "self mask",
    r"leader": "reference camera",
    r"without_swing|drawn_by_bend|with_priors_of|_felt|to_be_continued": "see docs/conventions.md",
    r"FirstRig|RigStart|start_rig": "one initial guess",
    r"ShareBars|share_bars|_Teller": "Progress",
    r"Of everything random": "Random seed",
    r"InitialValues": "InitialRig",
    r"FleetProgress|report_share|told_progress": "Progress of rigwake._progress",
    r"handeye_result|noise_selection|thesis_handeye\.py|se3_kernels|closed_forms": "see rigwake/handeye",
}
# keys of files that others read stay as they are; new ones stand beside them
# words of the old dialect that a name of a test must not hold either
OLD_WORDS_OF_TESTS = re.compile(
    r"_(doubt|feigns?|promised?|fractions?_(it|no|the_noise|is_not)|tells?_of)(_|$)"
)
# a name for observations that says no more than that something was looked at
FRAGMENTS = {"seen", "felt", "told"}
KEYS_OF_FILES = re.compile(
    r"[\"'`.](hand_over|undetermined|leader)\b|\bundetermined:"
    r"|hand_over\.|hand_over=association|kind `?hand_over|\.hand_over"
)


def test_no_file_name_stands_in_two_packages() -> None:
    places = defaultdict(list)
    for path in MODULES:
        places[path.stem].append(str(path.relative_to(PACKAGE)))
    twice = {stem: found for stem, found in places.items() if len(found) > 1 and stem not in AGREED_FILES}
    assert not twice, twice


def test_no_class_name_stands_in_two_files() -> None:
    places = defaultdict(list)
    for path in MODULES:
        for name in re.findall(r"^class (\w+)", SOURCES[path], re.MULTILINE):
            places[name].append(str(path.relative_to(PACKAGE)))
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert not twice, twice


def test_the_version_is_written_once() -> None:
    """In the package; the citation repeats it, as it is read without the program."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert str(cited["version"]) == rigwake.__version__
    assert 'dynamic = ["version"]' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.parametrize("word", OLD_WORDS)
def test_the_old_dialect_is_gone(word: str) -> None:
    pattern = re.compile(rf"(?<![A-Za-z])(?:{word})(?![A-Za-z])")
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:80]}"
        for path, text in sorted(TEXTS.items())
        if re.search(word, text) and pattern.search(text)  # the first is fast
        for number, line in enumerate(text.splitlines(), 1)
        if pattern.search(KEYS_OF_FILES.sub("", line))
    ]
    assert not found, f"say {OLD_WORDS[word]}:\n" + "\n".join(found)


def test_names_of_tests_are_in_the_fields_words() -> None:
    found = [
        f"{path.name}: {name}"
        for path in sorted((ROOT / "tests").glob("test_*.py"))
        for name in re.findall(r"def (test_\w+)", path.read_text())
        if OLD_WORDS_OF_TESTS.search(name)
    ]
    assert not found, found


def _pairs(node: ast.Assign) -> list[tuple[ast.expr, ast.expr]]:
    target, value = node.targets[0], node.value
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        return list(zip(target.elts, value.elts, strict=True))
    return [(target, value)]


def test_observations_are_called_observations() -> None:
    found = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in MODULES
        if ".observations" in SOURCES[path]
        for node in ast.walk(ast.parse(SOURCES[path]))
        if isinstance(node, ast.Assign)
        for target, value in _pairs(node)
        if isinstance(target, ast.Name)
        and target.id in FRAGMENTS
        and isinstance(value, ast.Attribute)
        and value.attr == "observations"
    ]
    assert not found, found


def test_callbacks_of_progress_stand_in_one_place() -> None:
    defined = [
        str(path.relative_to(PACKAGE))
        for path in MODULES
        if re.search(r"^\w*Progress = Callable", SOURCES[path], re.MULTILINE)
    ]
    assert defined == ["_progress.py"]
