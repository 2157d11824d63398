"""Tables with named columns: by columns as cell by cell, in blocks as in one piece, times at once as one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.logs import blocks
from aerpaw_cmp.logs.readers import by_name
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_parsers import _alike, _decided, _sheet, _stamps
from tests.logs.test_blocks import in_two, same
from tests.parsers.samples import OPTIONS

POSES = b"timestamp,Lat,Lng,Alt,Yaw\n"


def pose(i: int, *, altitude: float = 120.0, yaw: float = 1.0, time: str = "2025-03-02 10:{:02d}:00") -> bytes:
    return f"{time.format(i)},35.7{i:02d},-78.7,{altitude + i},{yaw}\n".encode()


def in_parts(reader: str, data: bytes) -> ReadResult:
    """What a reader says of a table of which each line comes by itself."""
    return in_two(reader, data.splitlines(keepends=True), OPTIONS)


# --- two ways through a table -----------------------------------------------------------------------------------------

CELLS = st.sampled_from(
    ["", "nan", "-", "5", "-7.25", "+3", ".5", "5.", "1e3", " 12", "12 ", "1,5", "0", "-0", "1.2.3", "x", "é", "n/a",
     "123456789.25", "12345678901234567890123", "\u0663"]
)  # fmt: skip


@given(st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=20), st.sampled_from([",", ";", "\t", "|"]))
@settings(max_examples=120, deadline=None)
def test_quoted_cells_are_read_as_bare_ones(rows: list[tuple[str, str]], separator: str) -> None:
    """Quotes send a row to be read cell by cell: both ways must give the same numbers and texts."""
    bare, quoted = [], []
    for a, b in rows:
        cells = ["10:00:00", a.replace(separator, ""), b.replace(separator, "")]
        bare.append(separator.join(cells))
        quoted.append(separator.join(f'"{cell}"' for cell in cells))
    head = separator.join(("time", "lat", "lon"))
    found = [
        _sheet.read(("\n".join([head, *lines]) + "\n").encode(), lambda names: "lat" in names, _decided.Decided())
        for lines in (bare, quoted)
    ]
    quick, slow = found
    assert quick is not None
    assert slow is not None
    assert (len(quick.quick.rows) > 0, len(slow.quick.rows)) == (True, 0)
    for column in range(3):
        np.testing.assert_array_equal(quick.numbers(column), slow.numbers(column))
        assert quick.texts(column) == slow.texts(column)


@pytest.mark.parametrize(
    ("rows", "accepted"),
    [
        ([b"1,2,3,", b"2,2,3,"], 2),  # a separator behind each row
        ([b"1,2,3,", b"2,2,3,", b"3,2,3,2"], 2),
        ([b"1,2,3", b"time,lat,lon", b"2,2,3"], 2),  # files joined by hand
        ([b"1,2,3", b'"2","2","3"', b"3,2"], 2),  # a torn row
        ([b"1,2,3", b"", b"2,2,3", b"made by a program"], 2),
    ],
)
def test_rows_of_other_widths(rows: list[bytes], accepted: int) -> None:
    data = b"\n".join([b"time,lat,lon", *rows]) + b"\n"
    result = by_name("pose_csv").read(data, OPTIONS)
    assert result.accepted == accepted
    assert len(result.rejected) == sum(row.startswith(b"3,") for row in rows)


def test_cells_of_rows_that_do_not_count_are_empty() -> None:
    sheet = _sheet.read(b'time;a;b\n1;2;3\n2;"4";5\n3;6;7\n', lambda names: "a" in names, _decided.Decided())
    assert sheet is not None
    sheet.silence(np.array([False, True, True]), [1])
    np.testing.assert_array_equal(sheet.numbers(1), [2, np.nan, np.nan])
    assert sheet.texts(1) == ["2", "", ""]
    sheet.keep(np.array([True, False, True]))
    np.testing.assert_array_equal(sheet.numbers(1), [2, np.nan])
    np.testing.assert_array_equal(sheet.numbers(2), [3, 7])


# --- times ------------------------------------------------------------------------------------------------------------

FORMS = (
    "2025-03-02 10:{m:02d}:{s:02d}", "2025-03-02T10:{m:02d}:{s:02d}.{f}Z", "{d}/3/2025 9:{m:02d}:{s:02d} PM",
    "3/{d}/2025 {h}:{m:02d}:{s:02d}.{f} am", "{d:02d}.03.2025 10:{m:02d}", "{d}-Mar-25 10.{m:02d}.{s:02d}",
    "2025.03.{d:02d}_10.{m:02d}.{s:02d}", "10:{m:02d}:{s:02d}.{f}", "{h}:{m:02d}:{s:02d} PM UTC", "20250302_10{m:02d}{s:02d}",
    "17409{s:02d}{m:02d}0.{f}", "1740{s:02d}{m:02d}00123", "{s},{f}", "", "n/a", "2025-13-45 25:61:61 GMT", "\u0661\u0662:00:00",
)  # fmt: skip
TIMES = st.builds(
    lambda form, d, h, m, s, f: form.format(d=d, h=h, m=m, s=s, f=f),
    st.sampled_from(FORMS), st.integers(1, 28), st.integers(1, 12), st.integers(0, 59), st.integers(0, 59),
    st.sampled_from(["5", "25", "125000"]),
)  # fmt: skip


def understood(texts: Sequence[str]) -> tuple[str, list[object], list[str]]:
    clock, cells, warnings = _stamps.read(texts, OPTIONS)
    return clock, [None if cell != cell else cell for cell in cells.tolist()], warnings


@given(st.lists(TIMES, min_size=1, max_size=40), st.integers(1, 3))
@settings(max_examples=200, deadline=None)
def test_times_at_once_are_those_one_by_one(texts: list[str], repeats: int) -> None:
    column = [text for text in texts for _ in range(repeats)]
    at_once = understood(column)
    if all(text.isascii() for text in column) and any(column):
        assert understood(_alike.Cells(np.array([text.encode() for text in column]))) == at_once
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_alike, "_FEW", 10**9)
        assert understood(column) == at_once


def test_many_equal_forms_are_taken_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    column = [f"2025-03-02 10:{i % 60:02d}:00.5" for i in range(100)]
    monkeypatch.setattr(_stamps, "_dated", None)  # no call of it is made
    assert _stamps.read(column, OPTIONS)[1].tolist()[61] == b"2025-03-02 10:01:00.5"


# --- blocks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "rows",
    [
        [pose(i) for i in range(6)],  # above sea level: the first of all is taken off
        [pose(i, altitude=2.0) for i in range(20)],
        [pose(i, yaw=1.0 if i < 4 else 200.0) for i in range(6)],  # degrees, as the last rows tell
        [pose(0).replace(b"35.700,-78.7", b"0,0"), *(pose(i) for i in range(1, 5))],
        [pose(i).replace(b"35.7", b"95.7") for i in range(4)],  # no position anywhere
        [pose(i, time=f"{22 + i if i < 2 else i - 2}:59:00") for i in range(5)],  # past midnight, no date
    ],
)
def test_what_all_rows_tell_is_settled_at_the_end(rows: list[bytes]) -> None:
    data = POSES + b"".join(rows)
    options = replace(OPTIONS, file_name="2025-03-02_flight.csv")
    whole = by_name("pose_csv").read(data, options)
    assert whole.accepted == len(rows)
    same(in_two("pose_csv", data.splitlines(keepends=True), options), whole)


def test_a_midnight_between_two_blocks_is_a_day_more() -> None:
    rows = [pose(i, time=f"{22 + i if i < 2 else i - 2}:59:00") for i in range(5)]
    options = replace(OPTIONS, file_name="2025-03-02_flight.csv")
    result = in_two("pose_csv", [POSES, *rows], options)
    time = result.streams[0].frame["time"].to_numpy()
    assert (np.diff(time) == np.timedelta64(1, "h")).all()


@pytest.mark.parametrize(("yaws", "known"), [((1.0, 3.0), np.degrees([1, 3])), ((1.0, 200.0), [1, 200])])
def test_the_largest_yaw_of_the_table_tells_radians(yaws: tuple[float, float], known: list[float]) -> None:
    result = in_parts("pose_csv", POSES + b"".join(pose(i, yaw=yaw) for i, yaw in enumerate(yaws)))
    np.testing.assert_allclose(result.streams[0].frame["yaw_deg"], known, rtol=1e-14)


@pytest.mark.parametrize(
    "rows",
    [
        [pose(0), pose(1), pose(2, time="1740927{:03d}")],  # texts, then seconds
        [pose(0), b"made by a program\n", pose(1)],  # words below a table that goes on
        [pose(0, time="13/03/2025 10:{:02d}:00"), pose(1, time="03/13/2025 10:{:02d}:00")],
    ],
)
def test_blocks_that_decide_otherwise_send_the_table_to_be_read_in_one_piece(rows: list[bytes]) -> None:
    with pytest.raises(blocks.Whole):
        in_parts("pose_csv", POSES + b"".join(rows))


def test_a_header_far_below_is_none_in_blocks_either() -> None:
    data = b"a line of talk\n" * 70 + POSES + pose(0) + pose(1)
    assert by_name("pose_csv").read(data, OPTIONS).accepted == 0
    lines = data.splitlines(keepends=True)
    with pytest.raises(blocks.Whole):
        in_two("pose_csv", [b"".join(lines[:65]), b"".join(lines[65:])], OPTIONS)


PHONE = b"Timestamp,LTEPCI,RSRP,RSRQ,EARFCN,N1 LTE RSRP,N1 LTE PCI\n"


def phone(i: int, pci: str, level: str = "-90", quality: str = "-9", arfcn: str = "1300", other: str = "") -> bytes:
    return f"2025-03-02 10:00:{i:02d},{pci},{level},{quality},{arfcn},{'-99' if other else ''},{other}\n".encode()


@pytest.mark.parametrize(
    "rows",
    [
        [phone(0, "20"), phone(1, "5", other="20"), phone(2, "", "", "", "", "5"), phone(3, "20", other="5")],
        [phone(0, "7"), phone(1, "7", arfcn="2000"), phone(2, "8")],  # two carriers of one cell
        [phone(0, "", "", "-12"), phone(1, "7"), phone(2, "7", quality="")],  # a quality in a row of its own
        [phone(0, "7", quality=""), phone(1, "7"), phone(2, "3.5")],
    ],
)
def test_cells_of_a_drive_test_in_blocks(rows: list[bytes]) -> None:
    data = PHONE + b"".join(rows)
    same(in_parts("drive_test", data), by_name("drive_test").read(data, OPTIONS))


def test_a_quality_that_has_rows_of_its_own_later_sends_the_table_to_be_read_in_one_piece() -> None:
    rows = [phone(0, "7"), phone(1, "", "", "-12"), phone(2, "7", quality="")]
    with pytest.raises(blocks.Whole):
        in_parts("drive_test", PHONE + b"".join(rows))
    whole = by_name("drive_test").read(PHONE + b"".join(rows), OPTIONS)
    assert [(stream.name, len(stream.frame)) for stream in whole.streams if stream.kind == "kpi"] == [("rsrq", 2)]


def test_the_cell_that_serves_is_known_from_the_block_before() -> None:
    head = b"Timestamp,PCI,RSRP,N1 PCI,N1 RSRP\n"
    rows = [b"2025-03-02 10:00:00,5,-90,20,-99\n", b"2025-03-02 10:00:01,,,5,-90\n", b"2025-03-02 10:00:02,,,20,-90\n"]
    streams = {stream.name: stream.frame for stream in in_parts("drive_test", head + b"".join(rows)).streams}
    assert {name: frame["serving"].tolist() for name, frame in streams.items()} == {"pci5": [1, 1], "pci20": [0, 0]}


def test_a_cell_told_twice_at_one_instant_behind_a_cut() -> None:
    """Which of the two counts the cell that serves decides, and that the block before tells."""
    cut = [PHONE + phone(0, "5"), phone(1, "", "", "", "", "5") + phone(1, "5")]
    whole = by_name("drive_test").read(b"".join(cut), OPTIONS)
    assert [stream.frame["rss_db"].tolist() for stream in whole.streams] == [[-90, -99]]
    same(in_two("drive_test", cut, OPTIONS), whole)


def test_exports_read_back_in_blocks() -> None:
    head = b"time_utc,time_s,tower,channel,unit,measured_db\n"
    rows = [f"2025-03-02T15:00:{i:02d}Z,{i},LW{3 - i % 3},USRP1,{'dB' if i else 'dBm'},{-50 - i}\n" for i in range(7)]
    data = head + "".join(rows).encode()
    whole = by_name("own_csv").read(data, OPTIONS)
    same(in_parts("own_csv", data), whole)
    assert [stream.name for stream in whole.streams] == ["LW3_USRP1", "LW2_USRP1", "LW1_USRP1"]
    assert [stream.attributes["unit"] for stream in whole.streams] == ["dBm", "dB", "dB"]
    assert [stream.name for stream in in_parts("own_csv", data).streams] == ["LW3_USRP1", "LW2_USRP1", "LW1_USRP1"]


@pytest.mark.parametrize("kind", ["rss", "rank"])
def test_a_name_that_ends_in_nul_loses_no_row(kind: str) -> None:
    """NumPy takes the last NULs off a text that it compares with: a table of levels ended in an IndexError."""
    head, cells = {
        "rss": (b"time_utc,time_s,tower,channel,unit,measured_db", b"LW\0,USRP1\0,dBm,-81.5"),
        "rank": (b"time_utc,time_s,tower,measured_rank", b"LW\0,2"),
    }[kind]
    data = head + b"\n2025-03-02T15:00:00Z,0," + cells + b"\n2025-03-02T15:00:01Z,1," + cells + b"\n"
    result = by_name("own_csv").read(data, OPTIONS)
    assert result.accepted == 2
    assert [len(stream.frame) for stream in result.streams] == [2]
