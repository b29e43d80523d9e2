"""One name, one thing: no file or class name stands in two packages, and no word of the old dialect comes back."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "rigwake"
MODULES = sorted(PACKAGE.rglob("*.py"))

# a verb of the command line is a file named after it
AGREED_FILES = {"__init__", "__main__"}

# word -> the field's term
OLD_WORDS = {
    r"hand(ed|ing)?[- _]over": "cross-camera association",
    r"HandOver": "CrossCameraMatches",
    r"promise[ds]?": "assumed, predicted",
    r"doubt(s|ful)?": "uncertainty",
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
}
# keys of files that others read stay as they are; new ones stand beside them
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
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(str(path.relative_to(PACKAGE)))
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert not twice, twice


@pytest.mark.parametrize("word", OLD_WORDS)
def test_the_old_dialect_is_gone(word: str) -> None:
    pattern = re.compile(rf"(?<![A-Za-z])(?:{word})(?![A-Za-z])")
    texts = [*MODULES, *PACKAGE.rglob("*.j2"), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:80]}"
        for path in sorted(texts)
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if pattern.search(KEYS_OF_FILES.sub("", line))
    ]
    assert not found, f"say {OLD_WORDS[word]}:\n" + "\n".join(found)
