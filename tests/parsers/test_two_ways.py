"""Formats with a fast way must say the same by their slow, strict way: two routes to one result."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.logs.readers import by_name
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_parsers import _table, generic_csv, vehicle_out
from tests.frames import assert_same_frame
from tests.parsers.samples import OPTIONS, SAMPLES

CASES = [(reader, name) for reader in ("vehicle_out", "nemo_csv", "quectel_csv") for name in SAMPLES[reader]]


def by_the_slow_way(reader: str, data: bytes) -> ReadResult:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_table, "numbers", lambda *_, **__: None)
        return by_name(reader).read(data, OPTIONS)


def assert_same(one: ReadResult, other: ReadResult) -> None:
    assert (one.lines, one.accepted, one.blank, one.rejected) == (
        other.lines,
        other.accepted,
        other.blank,
        other.rejected,
    )
    assert one.warnings == other.warnings
    assert len(one.streams) == len(other.streams)
    for a, b in zip(one.streams, other.streams, strict=True):
        # pandas' parser before version 3 may differ from float() in the last place
        assert_same_frame(a.frame, b.frame, rtol=1e-14, atol=0)


@pytest.mark.parametrize(("reader", "sample"), CASES)
def test_samples(reader: str, sample: str) -> None:
    data = SAMPLES[reader][sample][0]
    assert_same(by_name(reader).read(data, OPTIONS), by_the_slow_way(reader, data))


@pytest.mark.parametrize(
    ("reader", "sample", "old", "new"),
    [
        ("vehicle_out", "ten_fields", b"35.7300002", b"35.73(00002"),
        ("vehicle_out", "ten_fields", b"35.7300002", b'35.73"00002'),
        ("vehicle_out", "ten_fields", b'-0.05)","(1.0', b'-0.05,"(1.0'),
        ("vehicle_out", "ten_fields", b"35.7300002", b""),
        ("vehicle_out", "nine_fields", b"35.7300002", b"35.73.0002"),
        ("vehicle_out", "nine_fields", b"35.7300002", b"35 7300002"),
        ("vehicle_out", "nine_fields", b"35.7300002", b"35.7300002("),
        ("vehicle_out", "eight_fields", b"35.7300002", b'35.73"00002'),
        *(
            ("vehicle_out", "ten_fields", b",4,14", b",%s,14" % fix)
            for fix in (b"-0.0", b"1e2", b"1.5e4", b"+4", b"4.")
        ),
        ("vehicle_out", "ten_fields", b"3,-78", b"1.2345678e11,-78"),
        ("vehicle_out", "ten_fields", b"3,-78", b"-3,-78"),
        ("vehicle_out", "ten_fields", b"48.0", b"48.0 "),
        ("nemo_csv", "table", b",4.0,,,", b",NA,,,"),
        ("nemo_csv", "table", b",4.0,,,", b",4.0,--1,,"),
        ("nemo_csv", "table", b"1000.0", b""),
        ("nemo_csv", "table", b",4.0,,,", b",4\r.0,,,"),
        ("quectel_csv", "csi", b"24,4,12,5", b"24,4.,12,NA"),
    ],
)
def test_what_is_wrong_is_rejected_by_both(reader: str, sample: str, old: bytes, new: bytes) -> None:
    data = SAMPLES[reader][sample][0].replace(old, new, 1)
    good = by_name(reader).read(SAMPLES[reader][sample][0], OPTIONS)
    fast, slow = by_name(reader).read(data, OPTIONS), by_the_slow_way(reader, data)
    assert fast.accepted == good.accepted - 1
    assert_same(fast, slow)


@pytest.mark.parametrize(
    ("sample", "old", "new"),
    [("ten_fields", b"48.0", b""), ("nine_fields", b",98,", b",,"), ("eleven_fields", b",48.1,", b",,")],
)
def test_a_row_without_voltage_is_one_by_both(sample: str, old: bytes, new: bytes) -> None:
    data = SAMPLES["vehicle_out"][sample][0]
    fast, slow = (read(data.replace(old, new, 1)) for read in (by_the_fast_way, by_the_slow_vehicle))
    assert fast.accepted == by_the_fast_way(data).accepted
    assert_same(fast, slow)


@pytest.mark.parametrize(
    ("sample", "needed"),
    [("ten_fields", (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13)), ("nine_fields", (0, 1, 2, 3, 6, 7, 8)),
     ("eight_fields", (0, 1, 2, 3, 5, 6, 7)), ("eleven_fields", (0, 1, 2, 3, 4, 5, 6, 8, 9, 10))],
)  # fmt: skip
def test_a_row_with_an_empty_cell_that_it_needs_is_rejected_by_both(sample: str, needed: tuple[int, ...]) -> None:
    data = SAMPLES["vehicle_out"][sample][0]
    first, rest = data.split(b"\n", 1)
    for place in needed:
        cells = first.split(b",")
        cells[place] = re.sub(rb"[^\"()\r]", b"", cells[place])
        fast, slow = (read(b",".join(cells) + b"\n" + rest) for read in (by_the_fast_way, by_the_slow_vehicle))
        assert fast.accepted == by_the_fast_way(data).accepted - 1, place
        assert_same(fast, slow)


@pytest.mark.parametrize("sample", ["ten_fields", "nine_fields", "eight_fields", "eleven_fields"])
def test_why_a_row_of_a_vehicle_is_rejected(sample: str) -> None:
    data = SAMPLES["vehicle_out"][sample][0]
    first, rest = data.split(b"\n", 1)
    for bad, words in (
        (first.replace(b"2025-03-02 ", b""), "no time stamp"),
        (first.replace(b"35.73", b"35:73"), "a field is not of the form"),
        (first.replace(b"35.73", b"35\0.73"), "NUL bytes"),
        (first + b",1,2,3,4", "fields where 8, 9, 10 or 11"),
    ):
        (rejected,) = by_the_fast_way(rest + bad + b"\n").rejected
        assert words in rejected.reason


def by_the_fast_way(data: bytes) -> ReadResult:
    return by_name("vehicle_out").read(data, OPTIONS)


def by_the_slow_vehicle(data: bytes) -> ReadResult:
    return by_the_slow_way("vehicle_out", data)


def test_the_fast_way_is_taken() -> None:
    from aerpaw_parsers import _by_eights, _lines, nemo_csv, quectel_csv

    for name, rows in (("ten_fields", 3), ("nine_fields", 2), ("eight_fields", 2)):
        assert len(vehicle_out._at_once(_lines.split(SAMPLES["vehicle_out"][name][0])).line) == rows
    assert len(nemo_csv._plain(*_by_eights.table(SAMPLES["nemo_csv"]["table"][0], 9))[0]) == 3
    whole = b"".join(
        line for line in SAMPLES["quectel_csv"]["csi"][0].splitlines(keepends=True) if not line.endswith(b",\r\n")
    )
    assert len(quectel_csv._launched(_lines.split(whole))[0]) == 3


@given(st.sampled_from(CASES), st.data())
@settings(max_examples=200, deadline=None)
def test_damaged_samples(case: tuple[str, str], data: st.DataObject) -> None:
    """Rejected or read, a damaged line is so by both ways, or by the slow way only where a number is oddly written."""
    reader, name = case
    sample = bytearray(SAMPLES[reader][name][0] * 2)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(sample) - 1))
        new = data.draw(
            st.sampled_from([b"", b"7", b",", b"-", b"(", b")", b'"', b"e", b"\n", b"x", b"\0", b" ", b"999"])
        )
        sample[at : at + data.draw(st.integers(0, 2))] = new
    fast, slow = by_name(reader).read(bytes(sample), OPTIONS), by_the_slow_way(reader, bytes(sample))
    slow_lines = {line for stream in slow.streams for line in stream.frame["line"]}
    for one in fast.streams:
        frame = one.frame.set_index("line")
        both = sorted({line for s in slow.streams if s.name == one.name for line in s.frame["line"]} & set(frame.index))
        if not both:
            continue
        other = next(s for s in slow.streams if s.name == one.name).frame.set_index("line")
        left, right = frame.loc[both], other.loc[both]
        assert (left["time"] == right["time"]).all()
        numbers = left.select_dtypes("number").columns
        assert np.allclose(left[numbers], right[numbers], rtol=1e-14, atol=0, equal_nan=True)
    # what only one way takes is a spelling such as '.5' or '3.0': never many lines
    fast_lines = {line for stream in fast.streams for line in stream.frame["line"]}
    assert len(fast_lines ^ slow_lines) <= 3
    assert slow_lines <= fast_lines


TABLES = (
    b"Time,Lat,Note,Level\n2025-03-02 10:00:00.250,35.7,a b,-80.5\n2025-03-02 10:00:01.250,,c,-1e1\n2025-03-02 10:00:02,1,nan,\n",
    b"Time;Level\r\n0.5;-80,5\r\n1.5;n/a\r\n2.5;word\r\n3.5;1_0\r\n \r\n",
    b"Level\tTime\n-80.12345678901234\t2025-03-02T10:00:00.25-05:00\n+5.\t2025-03-02T10:00:00.2Z\n.5\t2025/03/02 10:00:00\n-inf\tx\n",
)


@given(st.sampled_from(TABLES), st.data())
@settings(max_examples=200, deadline=None)
def test_mapped_tables_by_columns_and_by_cells(table: bytes, data: st.DataObject) -> None:
    """The whole result, damaged or not: cells that are no numbers, other numbers of fields, other forms of times."""
    sample = bytearray(table)
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(table.index(b"\n") + 1, len(sample) - 1))
        new = data.draw(
            st.sampled_from(
                [b"", b"7", b",", b";", b"-", b".", b"e", b"\n", b"\r", b"x", b" ", b"\xe2\x80\x8b", b"inf"]
            )
        )
        sample[at : at + data.draw(st.integers(0, 2))] = new
    reader = by_name("generic_csv")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generic_csv, "_at_once", lambda *_: None)
        slow = reader.read(bytes(sample), OPTIONS)
    fast = reader.read(bytes(sample), OPTIONS)
    assert (fast.lines, fast.accepted, fast.blank, fast.rejected, fast.warnings) == (
        slow.lines, slow.accepted, slow.blank, slow.rejected, slow.warnings,
    )  # fmt: skip
    for a, b in zip(fast.streams, slow.streams, strict=True):
        assert_same_frame(a.frame, b.frame, check_exact=True)


@pytest.mark.parametrize("rows", [b".5\t0.5\n", b"-80.5\t0.5\n.5\t1.5\n", b".5\t0.5\n-80.5\t1.5\n"])
def test_a_bare_point_is_no_number_wherever_it_stands(rows: bytes) -> None:
    frame = by_name("generic_csv").read(b"Level\tTime\n" + rows, OPTIONS).streams[0].frame
    assert frame["flag"].tolist() == ["no_number" if row.startswith(b".") else "" for row in rows.splitlines()]


def test_mapped_tables_are_read_by_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generic_csv, "_one_by_one", lambda *_: pytest.fail("cell by cell"))
    for table, records in zip(TABLES, (3, 4, 3), strict=True):
        assert by_name("generic_csv").read(table, OPTIONS).accepted == records
