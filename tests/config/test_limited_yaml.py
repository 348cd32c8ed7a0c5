import time
from pathlib import Path
from typing import Any

import pytest

from tensorsim.config.limited_yaml import dump_limited_yaml, load_limited_yaml
from tensorsim.errors import TensorsimError
from tensorsim.radar.presets import load_scene_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a: 77e9", 77e9),
        ("a: 7.7e+10", 77e9),
        ("a: -.5", -0.5),
        ("a: 010", 10),
        ("a: 1_000", 1000),
        ("a: 1:30", "1:30"),
        ("a: 0x10", "0x10"),
        ("a: 2001-01-01", "2001-01-01"),
        ("a: .inf", ".inf"),
        ("a: null", None),
        ("a: true", True),
        ("a: [1, 2.5]", [1, 2.5]),
        ("a: {b: x y}", {"b": "x y"}),
        ("a: 'x'", "x"),
    ],
)
def test_values_are_those_of_python(text: str, value: Any) -> None:
    assert load_limited_yaml(text, "file") == {"a": value}
    assert type(load_limited_yaml(text, "file")["a"]) is type(value)


@pytest.mark.parametrize(
    "value",
    [
        "1e5",
        "1e+3",
        "7",
        "-.5",
        "1_000",
        "0x10",
        "1:30",
        "2001-01-01",
        "on",
        "null",
        "=",
        "/" + 300 * "a",
        7e10,
        1e-12,
    ],
)
def test_what_is_written_is_read(value: Any) -> None:
    assert load_limited_yaml(dump_limited_yaml({"a": value}), "file") == {"a": value}
    assert type(load_limited_yaml(dump_limited_yaml({"a": value}), "file")["a"]) is type(value)


ALIASES = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ALIASES, "line 1 has an anchor"),
        ("a: *b", "anchor|undefined"),
        ("a: !!python/object:os.system x", "a tag"),
        ("a: !!timestamp 2001-01-01", "a tag"),
        ("a: " + "[" * 3000 + "]" * 3000, "line 1 is nested deeper than 20"),
        ("a: " + "9" * 5000, "a value of 5000 characters"),
        ("a: 1\nb: 2\na: 3", "duplicate key a"),
        ("a: [1", "not valid YAML"),
        ("a: b\n" * 30_000, "150000 characters, expected at most"),
        ("\x00", "not valid YAML"),
        ("? {a: b}\n: c", "not valid YAML"),
    ],
    ids=range(11),
)
def test_what_is_refused_is_refused_at_once(text: str, message: str, tmp_path: Path) -> None:
    start = time.perf_counter()
    with pytest.raises(TensorsimError, match=f"file: .*({message})"):
        load_limited_yaml(text, "file")
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(TensorsimError, match=r"scene\.yaml"):
        load_scene_yaml(path)
    assert time.perf_counter() - start < 5.0
