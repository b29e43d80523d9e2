"""The pages of docs/cli say what the program says."""

from cli_reference import FOLDER, pages


def test_the_pages_of_all_verbs_are_those_of_the_program() -> None:
    made = pages()
    written = {path.name: path.read_text() for path in FOLDER.glob("*.md")}
    stale = sorted(name for name in made.keys() | written.keys() if made.get(name) != written.get(name))
    assert stale == [], "write them again: python tests/cli_reference.py"
