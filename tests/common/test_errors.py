"""Messages are for people: what a file holds does not reach the terminal as a command."""

from aerpaw_cmp.common.errors import InputError, UsageError


def test_control_characters_of_a_file_are_shown_as_escapes() -> None:
    error = InputError("found '\x1b[2J\x00\t'", expected="no \x07", cause="a\nb", path="x\n.txt", line=3)
    assert str(error) == "x\\n.txt, line 3: found '\\x1b[2J\\x00\\t'; expected no \\x07. Likely cause: a\nb"


def test_lists_of_problems_keep_their_lines() -> None:
    assert str(UsageError("2 problems\n  one\n  two")) == "2 problems\n  one\n  two"
