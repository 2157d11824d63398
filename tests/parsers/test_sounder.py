"""Sounder logs: the fast way takes od's own lines and no other, runs of '*' have the length their ends say."""

import re

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_parsers import sounder_log
from tests.parsers.samples import OPTIONS

# 10:00 in New York.
BEGIN = np.datetime64("2025-03-02T15:00:00")


def line(second: int, rest: str) -> str:
    return f"[2025-03-02 10:00:{second:02d}.000000] {rest}\n"


def sample(second: int, offset: int, value: float = -50.0) -> str:
    return line(second, f"{offset:07o} {value:15.4f}")


def star(second: int) -> str:
    return line(second, "*")


def read(*lines: str) -> ReadResult:
    return sounder_log.READER.read("".join(lines).encode(), OPTIONS)


def seconds(result: ReadResult) -> list[float]:
    return ((result.streams[0].frame["time"].to_numpy() - BEGIN) / np.timedelta64(1, "s")).tolist()


# --- the fast way -----------------------------------------------------------------------------------------------------

GOOD = [sample(3, 0o17, -20.5), sample(4, 0o7777777, 3.25), line(5, f"10000000 {-788.5956:15.4f}")]
LONG = [line(n, f"1{0:0{n}o} {-20.5:15.4f}") for n in range(9, 12)]  # 33 million samples have ten digits


def test_lines_of_od_are_read_at_once() -> None:
    layout, _ = sounder_log._fixed_layout(_text.split("".join(GOOD).encode()))
    assert layout.line.tolist() == [0, 1, 2]
    assert layout.offset.tolist() == [0o17, 0o7777777, 0o10000000]
    assert layout.value.tolist() == [-20.5, 3.25, -788.5956]
    assert np.diff(layout.wall).tolist() == [10**9, 10**9]
    assert sounder_log._fixed_layout(_text.split("".join(LONG).encode()))[0].offset.tolist() == [8**9, 8**10, 8**11]


@pytest.mark.parametrize("row", [0, 2], ids=["seven digits", "eight digits"])
@pytest.mark.parametrize(
    ("place", "sign"),
    [(0, "("), (27, ")"), (28, "\t"), (29, "8"), (30, "9"), (35, "8"), (36, "x"), (11, "x"), (3, "x"), (26, "x")],
)
def test_lines_with_one_sign_changed_are_left_to_the_strict_way(row: int, place: int, sign: str) -> None:
    """Brackets, spaces, octal digits, the time: each at its place."""
    good = GOOD[row]
    if row == 2 and place == 36:
        place += 1  # the space behind the offset
    bad = good[:place] + sign + good[place + 1 :]
    assert len(sounder_log._fixed_layout(_text.split(bad.encode()))[0].line) == 0
    result = read(*GOOD, bad)
    assert (result.accepted, len(result.rejected)) == (3, 1)


def test_levels_are_the_numbers_that_python_reads() -> None:
    """Numbers are read exactly, among texts of the same characters that are not numbers."""
    rng = np.random.default_rng(0)
    texts = [f"{value:16.{n}f}"[-16:] for n in range(10) for value in rng.normal(0.0, 10.0 ** (5 - n), 200)]
    texts += ["".join(rng.choice(list("   -.0123456789e"), 9)).rjust(16) for _ in range(20_000)]
    values, plain = sounder_log._decimals(np.array(texts, dtype="S16").view(np.uint8).reshape(-1, 16))
    expected = [re.fullmatch(r" *-?\d+(?:\.\d+)?", text) is not None for text in texts]
    assert 2000 < sum(expected) < len(texts) - 10_000
    assert plain.tolist() == expected
    read_by_python = [float(text) if good else 0.0 for text, good in zip(texts, expected, strict=True)]
    assert values.tobytes() == np.array(read_by_python).tobytes()
    # all texts together contain damaged ones, so also read a text alone
    for text, good in [*zip(texts[-3000:], expected[-3000:], strict=True), (f"{5.:.1f} ".rjust(16), False),
                       ("5.".rjust(16), False), (".123456789012345", False)]:  # fmt: skip
        _, (alone,) = sounder_log._decimals(np.array([text], dtype="S16").view(np.uint8).reshape(1, 16))
        assert alone == good, text


def test_why_lines_are_rejected() -> None:
    bad = [
        line(6, "0000001\0 -50.0000"), "2025-03-02 10:00:07.000000 0000014        -50.0000\n",
        "[2025-03-02 10:00] 0000014        -50.0000\n", line(8, "what the console said"),
        "[2025-02-30 10:00:07.000000] 0000014        -50.0000\n",
    ]  # fmt: skip
    words = [
        "NUL bytes",
        "does not begin with '[time]'",
        "time stamp is incomplete",
        "neither 'offset value'",
        "not a date",
    ]
    result = read(*GOOD, *bad)
    assert [word in reject.reason for word, reject in zip(words, result.rejected, strict=True)] == [True] * len(bad)


@pytest.mark.parametrize(
    ("lines", "claimed"),
    [
        ([sample(1, 0)], True),
        ([sample(1, 0), star(2), star(3), "talk\n", "talk\n"], True),
        ([sample(1, 0), "talk\n"], False),  # half of them is not most
        ([star(1), star(2), star(3)], False),  # no sample at all
        ([], False),
    ],
)
def test_what_the_sniffer_claims(lines: list[str], claimed: bool) -> None:
    assert sounder_log.sniff("".join(lines).encode()) is claimed


# --- runs of equal samples --------------------------------------------------------------------------------------------


def test_a_run_has_as_many_samples_as_its_offsets_say_at_even_times() -> None:
    result = read(sample(0, 0, -50.0), star(1), sample(4, 16, -60.0), star(5), sample(7, 28, -70.0))
    frame = result.streams[0].frame
    assert seconds(result) == [0, 1, 2, 3, 4, 5, 6, 7]
    assert frame["rss_db"].tolist() == [-50.0] * 4 + [-60.0] * 3 + [-70.0]
    assert (frame["flag"] == "repeated").tolist() == [False, True, True, True, False, True, True, False]
    assert frame["line"].tolist() == [1, 2, 2, 2, 3, 4, 4, 5]
    assert result.rejected == (), "no offset jumps: the suppressed samples have theirs"
    assert not [text for text in result.warnings if "jump" in text or "step back" in text]


def test_offsets_of_a_run_go_on_from_the_sample_before() -> None:
    lines = _text.split("".join((sample(0, 8), star(1), sample(4, 24))).encode())
    piece = sounder_log._piece(lines, _text.Rejects())
    repeats, used, bad = sounder_log._expand(piece.samples, piece.marks)
    assert (repeats.offset.tolist(), used.tolist(), bad) == ([12, 16, 20], [1], [])


@pytest.mark.parametrize("first", [0, 4])
def test_a_foot_bounds_the_last_run_by_its_offset_and_its_time(first: int) -> None:
    result = read(sample(0, first), star(1), line(3, f"{first + 12:07o}"))
    assert seconds(result) == [0, 1, 2]
    assert [reject.reason[:8] for reject in result.rejected] == ["no value"], "the foot line is not a sample"


@pytest.mark.parametrize("offset", [0, 4])
def test_a_foot_at_the_beginning_of_a_file_is_one(offset: int) -> None:
    result = read(line(0, f"{offset:07o}"), sample(1, offset), sample(2, offset + 4))
    assert (result.accepted, [reject.number for reject in result.rejected]) == (2, [1])
    assert "no value after the offset" in result.rejected[0].reason


@pytest.mark.parametrize(
    ("lines", "number", "words"),
    [
        ([star(0), sample(1, 0), sample(2, 4)], 1, "without a sample before it"),
        ([sample(0, 0), sample(1, 4), star(2)], 3, "or an offset after it"),
        ([sample(0, 0), star(1), star(2), sample(4, 16)], 3, "a second '*' in one run"),
        ([sample(0, 0), sample(1, 4), star(2), star(2), sample(4, 16)], 4, "a second '*' in one run"),
        ([sample(0, 8), star(1), sample(4, 0)], 2, "do not bound a run of plausible length"),
        ([sample(0, 0), star(1), sample(4, 4 * 5_000_002)], 2, "do not bound a run of plausible length"),
    ],
)
def test_stars_that_say_no_length(lines: list[str], number: int, words: str) -> None:
    result = read(*lines)
    assert [(reject.number, words in reject.reason) for reject in result.rejected] == [(number, True)]
    assert result.lines == result.accepted + result.blank + len(result.rejected)


def test_a_foot_at_offset_zero_bounds_no_run() -> None:
    result = read(sample(0, 8), star(1), line(2, "0000000"))
    assert "do not bound a run" in next(reject.reason for reject in result.rejected if reject.number == 2)


def test_a_star_that_stands_for_no_sample_is_accepted() -> None:
    result = read(sample(0, 0), star(1), sample(2, 4))
    assert (result.accepted, seconds(result)) == (3, [0, 2])


def test_offsets_of_two_widths_stay_in_the_order_of_the_file() -> None:
    """A second run in one file begins again with seven digits."""
    result = read(sample(0, 0o10000000), sample(1, 0), sample(2, 0o10000000), sample(3, 0))
    assert seconds(result) == [0, 1, 2, 3]


def test_offsets_that_jump_are_lost_samples() -> None:
    result = read(sample(0, 0), sample(1, 4), sample(2, 16), sample(3, 0))
    assert result.streams[0].frame["flag"].tolist() == ["", "", "samples_lost_before", ""]
    assert "offsets jump at 1 place: 2 samples missing" in result.warnings
    assert any("step back at 1 place" in text for text in result.warnings)


def test_samples_of_both_ways_come_in_the_order_of_the_file() -> None:
    wide = line(1, "0000004 -51")  # not od's columns
    result = read(sample(0, 0, -50.0), wide, sample(2, 8, -52.0))
    assert result.streams[0].frame["rss_db"].tolist() == [-50.0, -51.0, -52.0]
    assert result.streams[0].frame["time"].tolist() == [
        pd.Timestamp("2025-03-02 15:00") + pd.Timedelta(seconds=i) for i in range(3)
    ]


@pytest.mark.parametrize(
    ("value", "counts"), [("          2e-05", True), ("         2e-05", False), ("          2e-0", False)]
)
def test_a_last_line_without_its_end_counts_where_it_has_its_whole_width(value: str, counts: bool) -> None:
    """A value with an exponent is not accepted. A value that is one character shorter may be a truncated number."""
    result = read(sample(1, 0), line(2, f"0000004 {value}").rstrip("\n"))
    assert result.accepted == 1 + counts
    assert [reject.number for reject in result.rejected] == ([] if counts else [2])
    if counts:
        assert result.streams[0].frame["flag"].tolist() == ["", _text.UNTERMINATED]


def test_a_level_at_the_floor_is_out_of_coverage_and_one_above_is_not() -> None:
    floor = OPTIONS.floor_db
    frame = read(sample(1, 0, floor), sample(2, 4, floor + 1e-4), sample(3, 8, floor - 1e-4)).streams[0].frame
    assert frame["flag"].tolist() == ["out_of_coverage", "", "out_of_coverage"]
    assert frame["rss_db"].isna().tolist() == [True, False, True]
