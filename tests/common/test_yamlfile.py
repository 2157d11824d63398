from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.yamlfile import StrictModel, load_yaml, parse_yaml


class Mast(StrictModel):
    height_m: float = 1.0
    label: str = ""


class Settings(StrictModel):
    name: str = ""
    start: str = ""
    power: float = 0.0
    masts: dict[str, Mast] = Field(default_factory=dict)
    lists: list[Mast] = Field(default_factory=list)
    anything: object = None
    pair: tuple[float, float] = (0.0, 1.0)
    lag: Literal["off", "on"] | float = "off"
    code: str = Field("a", pattern="^[a-z]+$")


def failure(text: str) -> UsageError:
    with pytest.raises(UsageError) as caught:
        parse_yaml(text, Settings, "f.yaml")
    return caught.value


def test_words_numbers_and_clocks_stay_what_was_written() -> None:
    got = parse_yaml("name: no\nstart: 11:48:16\npower: 1e6\nmasts: {1: {height_m: 0x10, label: '12'}}", Settings)
    assert (got.name, got.start, got.power) == ("no", "11:48:16", 1e6)
    assert got.masts["1"] == Mast(height_m=16, label="12")


def test_duplicate_key_names_both_lines() -> None:
    error = failure("name: a\nmasts:\n  LW1: {height_m: 1}\n  LW1: {height_m: 2}\n")
    assert (error.line, error.exit_code) == (4, 2)
    assert "duplicate key 'LW1' (first on line 3)" in error.found


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("nmae: a", 1, "did you mean 'name'"),
        ("name: a\nmasts:\n  LW1:\n    heigth_m: 3", 4, "did you mean 'height_m'"),
        ("lists:\n- {}\n- {labl: x}", 3, "did you mean 'label'"),
        ("qqqq: 1", 1, "valid keys are 'name', 'start'"),
        ("name: a\npower: loud", 2, "power: found 'loud'; expected a number"),
        ("pair: [1]", 1, "pair: entry 2 of the list is missing"),
        (
            "lag: maybe",
            None,
            "lag: found 'maybe'; expected 'off' or 'on'\n  line 1: lag: found 'maybe'; expected a number",
        ),
        ("code: ../x", 1, "expected text of the form ^[a-z]+$"),
        ("lists: 5", 1, "lists: found 5; expected a list"),
        ("masts: {a: 5}", 1, "masts.a: found 5; expected keys with values"),
        ("name: a\n\tpower: 1", 2, "tabs"),
        ("name: [a", 2, "not YAML"),
        ("name: a\n---\nname: b", 2, "second document"),
        ("name: !!python/object/apply:os.system [id]", 1, "not allowed"),
        ("name: *nothing", 1, "names no anchor"),
        ("anything: &a [*a]", 1, "contains itself"),
        ("- a\n- b", 1, "not a list"),
        ("", None, "no settings"),
    ],
)
def test_each_mistake_has_its_line(text: str, line: int | None, words: str) -> None:
    error = failure(text)
    assert words in str(error)
    assert error.line == line


def test_all_mistakes_at_once() -> None:
    message = str(failure("power: loud\nmasts:\n  a: {height_m: x}\n  b: {lable: y}"))
    assert "3 problems" in message
    assert all(f"line {n}" in message for n in (1, 3, 4))


def test_alias_bomb_and_deep_nesting_are_refused() -> None:
    rows = ["a0: &a0 [1,1,1,1,1,1,1,1,1,1]"]
    rows += [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 9)]
    assert "expands to more than" in failure("\n".join(rows)).found
    assert "nested deeper" in failure("anything: " + "[" * 100_000).found


def test_anchors_work_and_merge_keys_are_refused() -> None:
    got = parse_yaml("masts:\n  a: &base {height_m: 2, label: x}\n  b: *base", Settings)
    assert got.masts["b"] == Mast(height_m=2, label="x")
    for merging in ("b: {<<: *base}", "<<: {c: *base}"):
        refused = failure(f"masts:\n  a: &base {{label: x}}\n  {merging}")
        assert (refused.line, "merge key '<<' is not supported" in refused.found) == (3, True)
    assert "unknown key '<<'" in failure("'<<': 1").found


def test_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_yaml(tmp_path / "absent.yaml", Settings)
    with pytest.raises(UsageError, match="folder"):
        load_yaml(tmp_path, Settings)
    file = tmp_path / "f.yaml"
    file.write_bytes(b"name: a\n\xff\xfe\x00")
    with pytest.raises(UsageError, match="line 2: not UTF-8"):
        load_yaml(file, Settings)
    file.write_bytes(b"\xef\xbb\xbfname: b\r\npower: 2\r\n")
    assert load_yaml(file, Settings) == Settings(name="b", power=2)


@given(st.text(max_size=60))
def test_any_text_is_settings_or_one_message(text: str) -> None:
    try:
        parse_yaml(text, Settings)
    except UsageError as error:
        message = str(error)
    else:
        message = "read"
    assert message
