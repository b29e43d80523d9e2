"""Every public module has a page of the reference, every page stands in the navigation, and nothing else does."""

from __future__ import annotations

import re
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
    listed = re.findall(r":\s+([\w/]+\.md)$", NAVIGATION, re.MULTILINE)
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert sorted(listed) == sorted(pages)


def test_every_package_is_one() -> None:
    """A folder without __init__.py is found by the interpreter but not by documentation and type checkers."""
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    assert not [folder for folder in folders if not (folder / "__init__.py").is_file()]
