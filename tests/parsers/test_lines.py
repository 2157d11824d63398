"""Lines as byte ranges: what is blank, what is cut, what is taken at once."""

import re

import numpy as np
import pytest

from aerpaw_cmp.logs import text as _text


@pytest.mark.parametrize("space", [b" ", b"\t", b"\x0b", b"\x0c", b"\r \r", b" \t \x0b"])
def test_a_line_of_any_white_space_is_blank(space: bytes) -> None:
    lines = _text.split(b"a\n" + space + b"\n" + space + b"b\n\n" + space)
    assert lines.blank.tolist() == [False, True, False, True, True]


def test_lines_of_equal_length_and_others_between() -> None:
    lines = _text.split(b"abc\ndef\nlonger\nghi\n\njkl")
    assert [bytes(row) for row in lines.fixed(np.array([0, 1]), 3)] == [b"abc", b"def"]
    assert [bytes(row) for row in lines.fixed(np.array([0, 1, 3, 5]), 3)] == [b"abc", b"def", b"ghi", b"jkl"]
    assert [bytes(row) for row in lines.fixed(np.array([0, 1, 3]), 3)] == [b"abc", b"def", b"ghi"]
    assert [bytes(row) for row in lines.fixed(np.array([1, 3]), 3)] == [b"def", b"ghi"]
    assert [bytes(row) for row in lines.fixed(np.array([5]), 3)] == [b"jkl"]
    assert lines.fixed(np.array([], dtype=np.int64), 3).shape == (0, 3)


@pytest.mark.parametrize(
    ("head", "lines"),
    [
        (b"", []),
        (b"a", [b"a"]),  # a file of one line without an end
        (b"a\nb", [b"a"]),  # the last may be cut
        (b"a\nb\nc", [b"a", b"b"]),
        (b"a\r\n\n b\n", [b"a", b" b"]),
        (b"x" * 16_384, [b"x" * 16_384]),
        (b"x" * 20_000, []),
        (b"a\n" + b"x" * 20_000 + b"\n", [b"a"]),
    ],
)
def test_sniffers_judge_by_whole_lines(head: bytes, lines: list[bytes]) -> None:
    assert _text.first_lines(head) == lines


def test_sniffers_judge_by_forty_lines() -> None:
    assert len(_text.first_lines(b"a\n" * 100)) == 40


@pytest.mark.parametrize(
    ("head", "most"), [(b"1\n2\na\n", True), (b"1\na\n", False), (b"a\n1\n2\n", True), (b"", False)]
)
def test_most_of_the_first_lines_are_more_than_half(head: bytes, most: bool) -> None:
    assert _text.mostly(head, re.compile(rb"\d")) is most


def test_numbers_of_cells_and_of_none() -> None:
    assert _text.numbers(np.zeros(0, dtype="S5")).tolist() == []
    np.testing.assert_array_equal(_text.numbers(np.array([b"", b"1e3", b"-2.5"])), [np.nan, 1000, -2.5])


@pytest.mark.parametrize(("data", "unterminated"), [(b"", False), (b"a", True), (b"a\n", False), (b"a\r", True)])
def test_whether_the_last_line_has_its_end(data: bytes, unterminated: bool) -> None:
    assert _text.split(data).unterminated is unterminated


def test_rejected_lines_are_kept_to_a_length_and_numbered_from_one() -> None:
    lines = _text.split(b"a\n" + b"\xff" + b"x" * 4000 + b"\n")
    (rejected,) = lines.reject_all(np.array([1]), "why")
    assert (rejected.number, rejected.reason) == (2, "why")
    assert rejected.text == "\ufffd" + "x" * (_text.TEXT_LIMIT - 1)
