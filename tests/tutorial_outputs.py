"""The outputs in docs/tutorial.md, written by the program.

python tests/tutorial_outputs.py FOLDER     runs the tutorial's commands in FOLDER (minutes) and writes their outputs
into the page; tests/test_docs_examples.py compares their words, but not their figures, with a shorter run
"""

import re
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from rigwake.cli.main import main

PAGE = Path(__file__).parent.parent / "docs" / "tutorial.md"
# a command, perhaps other commands after it, and what it said
_BLOCK = re.compile(
    r"^    (rigwake (?:inspect|calibrate|evaluate) [^\n]*)\n\n```text\n(.*?)```", re.MULTILINE | re.DOTALL
)


def shown(output: str) -> str:
    """What the page shows of an output: neither notes on this recording nor the next step."""
    kept = re.split(r"\n\s*next: ", output.strip())[0]
    kept = re.sub(
        r"^note: .*?(?=^(?:note|written|good|usable|unobservable)|\Z)",
        "",
        kept,
        flags=re.MULTILINE | re.DOTALL,
    )
    kept = re.sub(r"^(?:camera|imu|gnss)\.\w+: [^\n]*\n", "", kept, flags=re.MULTILINE)
    return "\n".join(line.rstrip() for line in kept.strip().splitlines()) + "\n"


def words_of(output: str) -> list[str]:
    """The words of an output without its figures, and without the sides that depend on them."""
    return [
        w
        for w in re.findall(r"[A-Za-z]{2,}", shown(output))
        if w not in ("clockwise", "anticlockwise", "left", "right", "rolled")
    ]


def blocks() -> list[tuple[list[str], str]]:
    """Commands of the page with the output it shows."""
    return [(shlex.split(command)[1:], text) for command, text in _BLOCK.findall(PAGE.read_text())]


def rewritten(run: Callable[[Sequence[str]], str]) -> str:
    """The page with the outputs that `run` returns."""

    def replaced(found: re.Match[str]) -> str:
        return f"    {found[1]}\n\n```text\n{shown(run(shlex.split(found[1])[1:]))}```"

    return _BLOCK.sub(replaced, PAGE.read_text())


if __name__ == "__main__":
    import contextlib
    import io
    import os

    os.chdir(sys.argv[1])

    def run_here(words: Sequence[str]) -> str:
        """The output of `rigwake WORDS` in this folder."""
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
            main(words)
        return said.getvalue()

    if not Path("harbour.bag").exists():
        run_here(["simulate", "demo", "-o", "harbour.bag"])
    PAGE.write_text(rewritten(run_here))
