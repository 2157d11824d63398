"""Numbers taken eight characters at a time are what ``float`` reads, and what is no plain decimal is odd."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_parsers import _by_eights, _lines, _table

PLAIN = re.compile(rb"[-+]?\d+(\.\d*)?")
FLOATS = st.floats(-1e9, 1e9).map(lambda x: repr(x).encode())
FIXED = st.tuples(st.integers(0, 8), st.floats(-1e7, 1e7)).map(lambda pair: b"%.*f" % pair)
CELLS = st.one_of(
    FLOATS, FIXED, st.integers(-(10**17), 10**17).map(lambda n: b"%d" % n), st.just(b""),
    st.text("0123456789.+-eEn", max_size=22).map(str.encode),
)  # fmt: skip


def read(cells: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
    data = b"head\n" + b"\n".join(cells) + b"\n"
    lines, found = _by_eights.table(data, 1)
    made = _by_eights.decimals(lines, found.take(found.rows > 0), [0])
    return made.value[0], made.odd[0]


def check(cells: list[bytes]) -> int:
    """Each cell against ``float``; gives how many were odd although they are decimals."""
    left = 0
    for cell, value, odd in zip(cells, *read(cells), strict=True):
        if cell and not PLAIN.fullmatch(cell):
            assert odd, cell
        elif odd:
            left += 1
        else:
            expected = float(cell) if cell else np.nan
            assert np.array_equal(value, expected, equal_nan=True), cell
            assert not cell or np.signbit(value) == np.signbit(expected), cell
    return left


@given(st.lists(CELLS, min_size=1, max_size=60))
@settings(max_examples=150, deadline=None)
def test_any_cells(cells: list[bytes]) -> None:
    check(cells)


@pytest.mark.parametrize("decimals", range(9))
def test_columns_of_one_layout_are_never_odd(decimals: int) -> None:
    values = np.random.default_rng(decimals).uniform(-999, 9999, 300)
    assert check([b"%.*f" % (decimals, value) for value in values]) == 0


def test_all_digits_of_a_float64_round_once() -> None:
    rng = np.random.default_rng(3)
    values = np.concatenate([rng.uniform(10, 200, 4000), rng.uniform(-1e6, 1e6, 4000)])
    assert check([repr(value).encode() for value in values.tolist()]) == 0
    between = [b"%d" % (2 * int(n) + 1) for n in rng.integers(2**52, 2**55, 4000)]  # many lie half-way of two float64
    assert check(between) == 0


@pytest.mark.parametrize(
    "data", [b"1,2\n3,4\n", b"1,2\r\n3,4\r\n", b"1,2\n3\n5,6\n", b"1,2\n\n3,4", b"", b"1\n2,3,4\n"]
)
def test_one_look_finds_the_same_fields(data: bytes) -> None:
    lines, found = _by_eights.table(data, 2)
    plain = _lines.split(data)
    other = _table.fields(plain, 2)
    for a, b in ((lines.starts, plain.starts), (lines.ends, plain.ends), (found.rows, other.rows)):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(found.begin, other.begin)
    np.testing.assert_array_equal(found.ends, other.ends)


def test_short_texts_and_decimal_commas() -> None:
    assert check([b"1"]) == 0
    lines, found = _by_eights.table(b"1,5;2\n-0,25;3", 2, ord(";"))
    np.testing.assert_array_equal(_by_eights.decimals(lines, found, [0, 1], comma=True).value, [[1.5, -0.25], [2, 3]])


@pytest.mark.parametrize(
    "cell",
    [b".5", b"-.5", b".2345678", b".23456789", b"-", b"+", b".", b"1.2.3", b"1.2345678.9", b"--5", b"1 ", b"\xff"],
)
def test_what_is_no_decimal_is_odd_alone_and_among_others(cell: bytes) -> None:
    for others in ([], [cell], [b"1.5"], [b"12", b""], [b"123456789.25"], [b"35.72959158368319"]):
        assert check([cell, *others]) == 0


@pytest.mark.parametrize("separator", [b",", b";", b"\t", b"|"])
@pytest.mark.parametrize("number", [b"7", b"12.5", b"123456.25", b"35.72959158368319"])
def test_an_empty_cell_is_no_zero_whatever_separates_it(separator: bytes, number: bytes) -> None:
    """Alone among positive numbers: nothing but the separator behind it tells."""
    text = b"head;x;y\n1,%s,2\n2,,3\n3,%s,4\n" % (number, number)
    lines, found = _by_eights.table(text.replace(b",", separator).replace(b";", separator), 3, separator[0])
    made = _by_eights.decimals(lines, found.take(found.rows > 0), [1], comma=separator != b",")
    np.testing.assert_array_equal(made.value[0], [float(number), np.nan, float(number)])
    assert not made.odd[0].any()
