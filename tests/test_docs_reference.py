"""Every public module has a page of the reference, every page stands in the navigation, and nothing else does."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "rigwake"
DOCS = ROOT / "docs"
NAVIGATION = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
SHELL_ONLY = {"cli"}


def public_modules() -> set[str]:
    """Modules and packages directly below rigwake."""
    found = {path.stem for path in PACKAGE.glob("*.py")} | {
        path.parent.name for path in PACKAGE.glob("*/__init__.py")
    }
    return {name for name in found if not name.startswith("_")} - SHELL_ONLY


def test_every_public_module_has_a_page() -> None:
    pages = {path.stem: path.read_text(encoding="utf-8") for path in (DOCS / "reference").glob("*.md")}
    assert set(pages) == public_modules()
    for name, text in pages.items():
        assert re.search(rf"^::: rigwake\.{name}\b", text, re.MULTILINE), name


def test_every_page_stands_in_the_navigation_once() -> None:
    listed = re.findall(r"[:-]\s+([\w/]+\.md)$", NAVIGATION, re.MULTILINE)
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert sorted(listed) == sorted(pages)


def test_every_package_is_one() -> None:
    """A folder without __init__.py is found by the interpreter but not by documentation and type checkers."""
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    assert not [folder for folder in folders if not (folder / "__init__.py").is_file()]


def test_pages_of_measurements_are_those_that_the_results_make() -> None:
    """Nobody edits them by hand, and a benchmark without a result says that it was not run."""
    recorder = runpy.run_path(str(ROOT / "benchmarks" / "record.py"))
    folder = DOCS / "measurements"
    made = recorder["pages"]()
    assert {path.name for path in folder.glob("*.md")} == set(made)
    for name, text in made.items():
        assert (folder / name).read_text(encoding="utf-8") == text, f"{name}: benchmarks/record.py --pages"
    for name in recorder["names"]():
        if not (folder / f"{name}.json").is_file():
            assert "Not run" in made[f"{name}.md"]


def test_a_result_names_no_machine_and_keeps_every_line(tmp_path: Path) -> None:
    recorder = runpy.run_path(str(ROOT / "benchmarks" / "record.py"))
    assert recorder["without_paths"](f"{ROOT}/src and /tmp/abc-1/x") == "./src and /tmp/.../x"
    assert (
        recorder["without_paths"]("/srv/rec/harbour 2/3 https://a.b/c ./x")
        == ".../harbour 2/3 https://a.b/c ./x"
    )
    assert recorder["without_paths"](f"{ROOT.parent}/shared") == "../shared"
    assert set(recorder["machine"]()) == {"cpu", "cores", "system", "python", "libraries", "load_before"}
