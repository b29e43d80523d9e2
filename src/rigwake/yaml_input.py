"""The one YAML loader: plain values only, bounded in size, depth, nodes and aliases.

It reads what the tools of the field write: OpenCV's `%YAML:1.0` line and its matrices, and numbers such as `1e-5`
that YAML 1.1 takes for text. Dates, sexagesimal numbers and digits after a zero (`007`) stay text. Files are checked
event by event before anything is built, since PyYAML itself recurses without end and expands merge keys without
bound.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from rigwake.errors import InputError
from rigwake.text_files import read_text_file

MAX_YAML_BYTES = 16 * 2**20
MAX_DEPTH = 40
MAX_NODES = 500_000
"""Nodes with every alias written out: a joint covariance of 20 cameras has 14 400."""

_REMEDY = "Check the file: no settings or calibration is built like this."


class _Loader(yaml.CSafeLoader):
    """PyYAML's safe loader with the numbers of YAML 1.2, without dates, with OpenCV's matrices as mappings."""


_NUMBER = re.compile(
    r"""^(?:[-+]?(?:[0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)(?:[eE][-+]?[0-9]+)?
    |[-+]?[0-9]+[eE][-+]?[0-9]+|[-+]?[1-9][0-9]{31,}
    |[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN|Nan))$""",
    re.VERBOSE,
)
_INTEGER = re.compile(r"^(?:[-+]?0b[01_]+|[-+]?0x[0-9a-fA-F]+|[-+]?(?:0|[1-9][0-9_]{0,30}))$")
_REPLACED = ("float", "int", "timestamp")
_TAGS = frozenset(
    f"tag:yaml.org,2002:{name}"
    for name in ["str", "int", "float", "bool", "null", "map", "seq", "opencv-matrix", "opencv-nd-matrix"]
)
_Loader.yaml_implicit_resolvers = {
    first: kept
    for first, resolvers in yaml.CSafeLoader.yaml_implicit_resolvers.items()
    if (kept := [(tag, form) for tag, form in resolvers if tag.rpartition(":")[2] not in _REPLACED])
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:int", _INTEGER, list("-+0123456789"))
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+0123456789."))


def _opencv_matrix(loader: yaml.CSafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _opencv_matrix)


def parse_yaml(text: str, where: str) -> Any:
    """The plain value of one YAML document. Raises InputError, naming `where` and the line."""
    if len(text) > MAX_YAML_BYTES:
        raise InputError(f"{where} is too large for a YAML file.", remedy=_REMEDY)
    text = _without_directives(text)
    try:
        _check_events(text, where)
        return yaml.load(text, Loader=_Loader)
    except InputError:
        raise
    except (yaml.YAMLError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        words = " ".join(str(error).split())
        raise InputError(f"{where} cannot be read as YAML: {words:.300}.") from error


def read_yaml(path: Path | str, max_bytes: int = MAX_YAML_BYTES) -> Any:
    """The plain value of a YAML file; InputError if it is no regular file or no YAML."""
    path = Path(path)
    return parse_yaml(read_text_file(path, max_bytes), str(path))


def read_yaml_settings(path: Path | str) -> dict[str, Any]:
    """A YAML file that holds named settings (a mapping with text keys); InputError otherwise."""
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(
            f"{path} holds no mapping at its top level.", remedy="Write it as `name: value` lines."
        )
    return {str(key): value for key, value in content.items()}


def _without_directives(text: str) -> str:
    """OpenCV writes `%YAML:1.0`, which is no directive of YAML; none of them changes what is read here."""
    lines = text.removeprefix("\ufeff").splitlines()
    for at, line in enumerate(lines):
        if line.startswith("%"):
            lines[at] = ""
        elif line.strip() and not line.startswith("#"):
            break
    return "\n".join(lines) + "\n"


class _Budget:
    """Depth, nodes and aliases of the events so far. `sizes` are nodes with aliases written out."""

    def __init__(self, where: str) -> None:
        self.where = where
        self.open: list[tuple[str | None, int]] = []
        self.size = 0
        self.anchors: dict[str, int] = {}

    def refuse(self, what: str, line: int) -> InputError:
        return InputError(f"{self.where} cannot be read as YAML: line {line}: {what}.", remedy=_REMEDY)

    def start(self, event: Any) -> None:
        self.open.append((event.anchor, self.size))
        self.add(1, event)
        if len(self.open) > MAX_DEPTH:
            raise self.refuse(f"more than {MAX_DEPTH} levels inside each other", _line(event))

    def end(self, event: Any) -> None:
        anchor, before = self.open.pop()
        if anchor is not None:
            self.anchors[anchor] = self.size - before

    def scalar(self, event: Any) -> None:
        self.add(1, event)
        if event.anchor is not None:
            self.anchors[event.anchor] = 1

    def alias(self, event: Any) -> None:
        if any(anchor == event.anchor for anchor, _ in self.open):
            raise self.refuse(f"{event.anchor!r} refers to itself", _line(event))
        self.add(self.anchors.get(event.anchor, 1), event)

    def add(self, count: int, event: Any) -> None:
        tag = getattr(event, "tag", None)
        if tag is not None and tag not in _TAGS and tag != "!":
            raise self.refuse(f"the tag {tag!r} is not read", _line(event))
        self.size += count
        if self.size > MAX_NODES:
            raise self.refuse(f"more than {MAX_NODES} values, aliases counted", _line(event))


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1


def _check_events(text: str, where: str) -> None:
    budget = _Budget(where)
    handlers: dict[type[Any], Callable[[Any], None]] = {
        yaml.ScalarEvent: budget.scalar,
        yaml.AliasEvent: budget.alias,
        yaml.SequenceStartEvent: budget.start,
        yaml.MappingStartEvent: budget.start,
        yaml.SequenceEndEvent: budget.end,
        yaml.MappingEndEvent: budget.end,
    }
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        handler = handlers.get(type(event))
        if handler is not None:
            handler(event)
