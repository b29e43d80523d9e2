"""The one YAML loader: what the tools of the field write is read, what is without end is refused at once."""

import re
from pathlib import Path

import pytest

from rigwake.errors import InputError
from rigwake.yaml_input import MAX_DEPTH, parse_yaml, read_yaml, read_yaml_settings

PACKAGE = Path(__file__).parent.parent / "src" / "rigwake"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-5", 1e-5),
        ("-1e-05", -1e-5),
        ("1E5", 1e5),
        ("2.e-3", 2e-3),
        (".5", 0.5),
        ("-.5e1", -5.0),
        ("1_000", 1000),
        ("+3", 3),
        ("0x1F", 31),
        ("-.inf", float("-inf")),
        ("2023-99-99", "2023-99-99"),
        ("2023-11-14", "2023-11-14"),
        ("22:13:20", "22:13:20"),
        ("007", "007"),
        ("true", True),
        ("null", None),
        ("~", None),
    ],
)
def test_numbers_are_numbers_and_dates_are_text(text: str, value: object) -> None:
    assert parse_yaml(f"a: {text}", "file") == {"a": value}


def test_what_opencv_writes_is_read() -> None:
    text = "%YAML:1.0\n---\nm: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: d\n   data: [ 1., 2.e+00 ]\n"
    assert parse_yaml("\ufeff" + text, "file")["m"]["data"] == [1.0, 2.0]
    assert parse_yaml(text.replace("---\n", ""), "file")["m"]["rows"] == 1


NINE = ",".join(["*a{0}"] * 9)
BOMBS = {
    "flow sequences": "x: " + "[" * 200_000,
    "flow mappings": "{a: " * 50_000,
    "block sequences": "- " * 50_000,
    "indented": "".join(" " * k + "a:\n" for k in range(500)),
    "merge keys": "a0: &a0 {k: 1}\n"
    + "".join(f"a{k}: &a{k} {{<<: [{NINE.format(k - 1)}]}}\n" for k in range(1, 15)),
    "aliases": "a0: &a0 [1]\n" + "".join(f"a{k}: &a{k} [{NINE.format(k - 1)}]\n" for k in range(1, 15)),
    "a value within itself": "a: &a [1, *a]",
    "a mapping within itself": "a: &a {b: {<<: *a}}",
    "many values": "[" + "1," * 600_000 + "]",
    "a long file": "# " + "x" * (17 * 2**20),
    "python": "!!python/object/apply:os.system ['true']",
    "unknown tag": "a: !thing {b: 1}",
    "unhashable key": "? [a, b]\n: c",
    "bad number": "a: !!int x",
    "bad truth value": "a: !!bool x",
    "no yaml": "a: b: c",
    "tab": "a:\n\t- b",
    "undefined alias": "a: *b",
    "two documents": "a: 1\n---\nb: 2\n",
}


@pytest.mark.parametrize("kind", BOMBS)
def test_what_is_without_end_or_sense_is_refused_and_named(kind: str, tmp_path: Path) -> None:
    (tmp_path / "settings.yaml").write_text(BOMBS[kind])
    with pytest.raises(InputError, match=r"settings\.yaml"):
        read_yaml(tmp_path / "settings.yaml")


def test_what_is_deep_but_sane_is_read() -> None:
    depth = MAX_DEPTH - 1
    value = parse_yaml("a: " + "[" * depth + "1" + "]" * depth, "file")["a"]
    for _ in range(depth):
        (value,) = value
    assert value == 1
    assert parse_yaml("a: &a {x: 1}\nb: {<<: *a, y: 2}", "file")["b"] == {"x": 1, "y": 2}


def test_settings_must_be_named(tmp_path: Path) -> None:
    for text in ("- 1\n", "", "text"):
        (tmp_path / "a.yaml").write_text(text)
        with pytest.raises(InputError, match="no mapping"):
            read_yaml_settings(tmp_path / "a.yaml")
    with pytest.raises(InputError, match="There is no file"):
        read_yaml(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="not a regular file"):
        read_yaml(tmp_path)
    with pytest.raises(InputError, match="not a regular file"):
        read_yaml(Path("/dev/zero"))


def test_no_other_module_loads_yaml() -> None:
    """Whoever calls PyYAML itself has none of these limits."""
    calls = re.compile(r"yaml\.(load|safe_load|full_load|parse|compose)\b")
    for path in PACKAGE.rglob("*.py"):
        assert path.name == "yaml_input.py" or not calls.search(path.read_text()), path
