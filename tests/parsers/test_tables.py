"""Tables with named columns: widths of rows, what whole columns decide, cells of phones, exports read back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.logs.readers import by_name
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_parsers import _sheet
from tests.parsers.samples import OPTIONS

POSES = b"timestamp,Lat,Lng,Alt,Yaw\n"


def pose(i: int, *, altitude: float = 120.0, yaw: float = 1.0, time: str = "2025-03-02 10:{:02d}:00") -> bytes:
    return f"{time.format(i)},35.7{i:02d},-78.7,{altitude + i},{yaw}\n".encode()


def read(reader: str, data: bytes, **options: str) -> ReadResult:
    return by_name(reader).read(data, replace(OPTIONS, **options))


# --- two ways through a table -----------------------------------------------------------------------------------------

CELLS = st.sampled_from(
    ["", "nan", "-", "5", "-7.25", "+3", ".5", "5.", "1e3", " 12", "12 ", "1,5", "0", "-0", "1.2.3", "x", "é", "n/a",
     "123456789.25", "12345678901234567890123", "\u0663"]
)  # fmt: skip


@given(st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=20), st.sampled_from([",", ";", "\t", "|"]))
@settings(max_examples=120, deadline=None)
def test_quoted_cells_are_read_as_bare_ones(rows: list[tuple[str, str]], separator: str) -> None:
    """Quotes send a row through the csv module: both ways must give the same numbers and texts."""
    bare, quoted = [], []
    for a, b in rows:
        cells = ["10:00:00", a.replace(separator, ""), b.replace(separator, "")]
        bare.append(separator.join(cells))
        quoted.append(separator.join(f'"{cell}"' for cell in cells))
    head = separator.join(("time", "lat", "lon"))
    found = [
        _sheet.read(("\n".join([head, *lines]) + "\n").encode(), lambda names: "lat" in names)
        for lines in (bare, quoted)
    ]
    quick, slow = found
    assert quick is not None
    assert slow is not None
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
    sheet = _sheet.read(b'time;a;b\n1;2;3\n2;"4";5\n3;6;7\n', lambda names: "a" in names)
    assert sheet is not None
    sheet.silence(np.array([False, True, True]), [1])
    np.testing.assert_array_equal(sheet.numbers(1), [2, np.nan, np.nan])
    assert sheet.texts(1) == ["2", "", ""]
    sheet.keep(np.array([True, False, True]))
    np.testing.assert_array_equal(sheet.numbers(1), [2, np.nan])
    np.testing.assert_array_equal(sheet.numbers(2), [3, 7])


# --- what whole columns decide ----------------------------------------------------------------------------------------


def test_a_midnight_is_a_day_more() -> None:
    rows = [pose(i, time=f"{22 + i if i < 2 else i - 2}:59:00") for i in range(5)]
    result = read("pose_csv", POSES + b"".join(rows), file_name="2025-03-02_flight.csv")
    time = result.streams[0].frame["time"].to_numpy()
    assert (np.diff(time) == np.timedelta64(1, "h")).all()


@pytest.mark.parametrize(("yaws", "known"), [((1.0, 3.0), np.degrees([1, 3])), ((1.0, 200.0), [1, 200])])
def test_the_largest_yaw_of_the_table_tells_radians(yaws: tuple[float, float], known: list[float]) -> None:
    result = read("pose_csv", POSES + b"".join(pose(i, yaw=yaw) for i, yaw in enumerate(yaws)))
    np.testing.assert_allclose(result.streams[0].frame["yaw_deg"], known, rtol=1e-14)


def test_a_header_far_below_is_none() -> None:
    assert read("pose_csv", b"a line of talk\n" * 70 + POSES + pose(0) + pose(1)).accepted == 0


PHONE = b"Timestamp,LTEPCI,RSRP,RSRQ,EARFCN,N1 LTE RSRP,N1 LTE PCI\n"


def phone(i: int, pci: str, level: str = "-90", quality: str = "-9", arfcn: str = "1300", other: str = "") -> bytes:
    return f"2025-03-02 10:00:{i:02d},{pci},{level},{quality},{arfcn},{'-99' if other else ''},{other}\n".encode()


def levels(*rows: bytes) -> dict[str, list[float]]:
    result = read("drive_test", PHONE + b"".join(rows))
    return {stream.name: stream.frame["rss_db"].tolist() for stream in result.streams if stream.kind == "rss"}


def test_every_reading_of_a_cell_is_a_record() -> None:
    """Two carriers of one PCI are two cells; a cell that a row names twice is kept twice, the second one flagged."""
    assert levels(phone(0, "7"), phone(1, "7", arfcn="2000", level="-80"), phone(2, "8")) == {
        "lte_pci7_arfcn1300": [-90.0], "lte_pci7_arfcn2000": [-80.0], "lte_pci8": [-90.0]
    }  # fmt: skip
    assert levels(phone(0, "5"), phone(0, "5", level="-91")) == {"lte_pci5": [-90.0, -91.0]}, "one second, two readings"
    (cell,) = read("drive_test", PHONE + phone(1, "5", arfcn="", other="5")).streams
    assert cell.frame["rss_db"].tolist() == [-90.0, -99.0]
    assert cell.frame["flag"].tolist() == ["", "cell_twice"]


def test_a_quality_that_has_rows_of_its_own_is_a_stream() -> None:
    rows = [phone(0, "7"), phone(1, "", "", "-12"), phone(2, "7", quality="")]
    whole = read("drive_test", PHONE + b"".join(rows))
    assert [(stream.name, len(stream.frame)) for stream in whole.streams if stream.kind == "kpi"] == [("rsrq", 2)]


def test_a_cell_serves_until_another_does() -> None:
    head = b"Timestamp,PCI,RSRP,N1 PCI,N1 RSRP\n"
    rows = [b"2025-03-02 10:00:00,5,-90,20,-99\n", b"2025-03-02 10:00:01,,,5,-90\n", b"2025-03-02 10:00:02,,,20,-90\n"]
    streams = {stream.name: stream.frame for stream in read("drive_test", head + b"".join(rows)).streams}
    assert {name: frame["serving"].tolist() for name, frame in streams.items()} == {"pci5": [1, 1], "pci20": [0, 0]}


def test_exports_read_back_keep_the_order_of_the_table() -> None:
    head = b"time_utc,time_s,tower,channel,unit,measured_db\n"
    rows = [f"2025-03-02T15:00:{i:02d}Z,{i},LW{3 - i % 3},USRP1,{'dB' if i else 'dBm'},{-50 - i}\n" for i in range(7)]
    whole = read("own_csv", head + "".join(rows).encode())
    assert [stream.name for stream in whole.streams] == ["LW3_USRP1", "LW2_USRP1", "LW1_USRP1"]
    assert [stream.attributes["unit"] for stream in whole.streams] == ["dBm", "dB", "dB"]


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
