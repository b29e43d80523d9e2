"""docs/cli: one page per verb, made from the program.

python tests/cli_reference.py      writes the pages; tests/test_cli_reference.py compares them with the program
"""

import re
from pathlib import Path
from typing import Any

import typer

from cli_runs import commands_by_words
from rigwake.cli.main import EXIT_CODES

FOLDER = Path(__file__).parent.parent / "docs" / "cli"


def page_of(words: str, command: Any) -> str:
    """The page of one verb: what it does, examples, arguments, options, exit codes."""
    context = typer.Context(command, info_name=f"rigwake {words}")
    pieces = " ".join(command.collect_usage_pieces(context))
    usage = re.sub(r"\{(\w+)\}", lambda found: found[1].upper(), pieces)
    text, examples = _parts(command.help or "")
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and not getattr(p, "hidden", False)]
    lines = [f"# rigwake {words}", "", text, "", f"    rigwake {words} {usage}", ""]
    if examples:
        lines += ["For example:", "", *(f"    {example}" for example in examples), ""]
    if arguments:
        lines += ["| argument | |", "|---|---|"]
        lines += [f"| `{p.name.upper()}` | {_cell(getattr(p, 'help', '') or '')} |" for p in arguments]
        lines.append("")
    lines += ["| option | | default |", "|---|---|---|"]
    for option in options:
        names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
        lines.append(f"| {names} | {_cell(option.help or '')} | {_default(option)} |")
    return "\n".join([*lines, "", EXIT_CODES, ""])


def _parts(help_text: str) -> tuple[str, list[str]]:
    """The description as paragraphs, and the examples, without the terminal's colours."""
    plain = re.sub(r"\[/?[a-z][a-z ]*\]", "`", help_text.strip())
    paragraphs = [" ".join(p.split()) for p in re.split(r"\n\s*\n", plain)]
    found = re.findall(r"Example: `(.*?)`", " ".join(paragraphs))
    described = [re.sub(r"\s*Example: `.*?`", "", p).strip() for p in paragraphs]
    return "\n\n".join(p for p in described if p), found


def _cell(text: str) -> str:
    return " ".join(re.sub(r"\[/?[a-z][a-z ]*\]", "`", text).split()).replace("|", "\\|")


def _default(option: Any) -> str:
    value = option.default
    if option.required:
        return "required"
    if value is None or value is False or callable(value) or value in ("", [], ()):
        return ""
    if value is True:
        return f"`{option.opts[0]}`" if option.secondary_opts else "yes"
    return f"`{value}`"


def index_of(verbs: list[str]) -> str:
    """The list of verbs, each with its first sentence."""
    commands = commands_by_words()
    rows = [f"| [{words}]({_file(words)}) | {_first_sentence(commands[words])} |" for words in verbs]
    head = [
        "# Commands",
        "",
        "Made from the program: the same words as `rigwake VERB --help`.",
        "",
        "| verb | |",
        "|---|---|",
    ]
    return "\n".join([*head, *rows, "", EXIT_CODES, ""])


def _first_sentence(command: Any) -> str:
    text = _parts(command.help or "")[0].split("\n\n")[0]
    return _cell(text)


def _file(words: str) -> str:
    return f"{words.replace(' ', '_')}.md"


def pages() -> dict[str, str]:
    """All pages by the names of their files."""
    commands = commands_by_words()
    made = {_file(words): page_of(words, command) for words, command in commands.items()}
    return made | {"index.md": index_of(list(commands))}


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for old in FOLDER.glob("*.md"):
        old.unlink()
    for name, text in pages().items():
        (FOLDER / name).write_text(text)
