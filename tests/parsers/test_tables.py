"""Tables with named columns: widths of rows, what whole columns decide, cells of phones, exports read back."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions, by_name
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_parsers import _sheet
from tests.parsers import samples
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
    sheets = [
        _sheet.read(("\n".join([head, *lines]) + "\n").encode(), lambda names: "lat" in names)
        for lines in (bare, quoted)
    ]
    quick, slow = sheets
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
    sheet = sheet.part(np.array([True, False, True]))
    np.testing.assert_array_equal(sheet.numbers(1), [2, np.nan])
    np.testing.assert_array_equal(sheet.numbers(2), [3, 7])


# --- what whole columns decide ----------------------------------------------------------------------------------------


def test_a_midnight_is_a_day_more() -> None:
    rows = [pose(i, time=f"{22 + i if i < 2 else i - 2}:59:00") for i in range(5)]
    result = read("pose_csv", POSES + b"".join(rows), file_name="2025-03-02_flight.csv")
    time = result.streams[0].frame["time"].to_numpy()
    assert (np.diff(time) == np.timedelta64(1, "h")).all()


@pytest.mark.parametrize(
    ("yaws", "pitch", "known"),
    [((1.0, 3.0), "0.2", np.degrees([1, 3])), ((1.0, 200.0), "0.2", [1, 200]), ((1.0, 3.0), "-2", [1, 3]), ((1.0, 3.0), "", [1, 3])],
)  # fmt: skip
def test_all_three_angles_must_look_like_radians(yaws: tuple[float, float], pitch: str, known: list[float]) -> None:
    rows = [pose(i, yaw=yaw).strip() + f",0.1,{pitch}\n".encode() for i, yaw in enumerate(yaws)]
    result = read("pose_csv", POSES.strip() + b",Roll,Pitch\n" + b"".join(rows))
    assert any("a guess" in text for text in result.warnings) == (known[0] != 1)
    np.testing.assert_allclose(result.streams[0].frame["yaw_deg"], known, rtol=1e-14)


def test_a_header_far_below_is_none() -> None:
    with pytest.raises(InputError, match="no header with a time"):
        read("pose_csv", b"a line of talk\n" * 70 + POSES + pose(0) + pose(1))


PHONE = b"Timestamp,LTEPCI,RSRP,RSRQ,EARFCN,N1 LTE RSRP,N1 LTE PCI\n"


def phone(i: int, pci: str, level: str = "-90", quality: str = "-9", arfcn: str = "1300", other: str = "") -> bytes:
    return f"2025-03-02 10:00:{i:02d},{pci},{level},{quality},{arfcn},{'-99' if other else ''},{other}\n".encode()


def levels(*rows: bytes) -> dict[str, list[float]]:
    result = read("drive_test", PHONE + b"".join(rows))
    return {stream.name: stream.frame["rss_db"].tolist() for stream in result.streams if stream.kind == "rss"}


def test_every_reading_of_a_cell_is_a_record() -> None:
    """Two carriers of one PCI are two cells.

    If a row names a cell twice, both readings are kept, and the second is flagged.
    """
    assert levels(phone(0, "7"), phone(1, "7", arfcn="2000", level="-80"), phone(2, "8")) == {
        "lte_pci7_arfcn1300": [-90.0], "lte_pci7_arfcn2000": [-80.0], "lte_pci8": [-90.0]
    }  # fmt: skip
    assert levels(phone(0, "5"), phone(0, "5", level="-91")) == {"lte_pci5": [-90.0, -91.0]}, "one second, two readings"
    (cell,) = read("drive_test", PHONE + phone(1, "5", arfcn="", other="5")).streams
    assert cell.frame["rss_db"].tolist() == [-90.0, -99.0]
    assert cell.frame["flag"].tolist() == ["", "cell_twice"]


def test_a_quality_that_has_rows_of_its_own_is_a_stream() -> None:
    rows = [phone(0, "7"), phone(1, "", "", "-12"), phone(2, "7", quality="")]
    result = read("drive_test", PHONE + b"".join(rows))
    assert [(stream.name, len(stream.frame)) for stream in result.streams if stream.kind == "kpi"] == [("rsrq", 2)]


def test_a_cell_serves_until_another_does() -> None:
    head = b"Timestamp,PCI,RSRP,N1 PCI,N1 RSRP\n"
    rows = [b"2025-03-02 10:00:00,5,-90,20,-99\n", b"2025-03-02 10:00:01,,,5,-90\n", b"2025-03-02 10:00:02,,,20,-90\n"]
    streams = {stream.name: stream.frame for stream in read("drive_test", head + b"".join(rows)).streams}
    assert {name: frame["serving"].tolist() for name, frame in streams.items()} == {"pci5": [1, 1], "pci20": [0, 0]}


# --- tables that a person or a program wrote anew ---------------------------------------------------------------------

SIX_COLUMNS = "Time,Latitude,Longitude,Altitude (m),RSRP (dBm)\n"


def six_rows(row: str, *, head: str = SIX_COLUMNS) -> bytes:
    """Six rows, ``{i}`` in them the number of the row."""
    return (head + "".join(row.replace("{i}", str(i)) + "\n" for i in range(6))).encode()


def drive_test(data: bytes, **options: str) -> ReadResult:
    return read("drive_test", data, **options)


def column_of(result: ReadResult, kind: str, name: str) -> list[float]:
    return next(stream.frame[name].tolist() for stream in result.streams if stream.kind == kind)


GOOD = "2025-03-02 10:00:0{i},35.72{i},-78.69,3{i},-8{i}"


def test_units_of_cells_are_read_and_words_are_said() -> None:
    result = drive_test(six_rows(GOOD.replace("-8{i}", "-11{i} dBW")))
    assert column_of(result, "rss", "rss_db") == [-80.0 - i for i in range(6)]
    result = drive_test(six_rows(GOOD.replace("-8{i}", "-8{i} bars")))
    assert not any(stream.kind == "rss" for stream in result.streams)
    assert any("'RSRP (dBm)': 6 cells without a number (the first: '-80 bars')" in text for text in result.warnings)
    assert not any("without a number" in text for text in drive_test(six_rows(GOOD)).warnings)


def test_the_minus_sign_of_typesetting_is_one() -> None:
    assert column_of(drive_test(six_rows(GOOD.replace("-8{i}", "\u22128{i}"))), "rss", "rss_db") == [
        -80.0 - i for i in range(6)
    ]


def test_commas_of_thousands_are_no_decimal_commas() -> None:
    """With decimal points, a quoted 1,300 is thirteen hundred. In a table with commas, 30,5 is thirty and a half."""
    heights = column_of(drive_test(six_rows(GOOD.replace("3{i}", '"1,30{i}"'))), "telemetry", "altitude_m")
    assert heights == [1300.0 + i for i in range(6)]
    commas = '2025-03-02 10:00:0{i},"35,72{i}","-78,69","30,{i}","-8{i},5"'
    assert column_of(drive_test(six_rows(commas)), "telemetry", "altitude_m") == [30.0 + i / 10 for i in range(6)]


def test_speeds_in_centimetres_per_second() -> None:
    head = "Time,Latitude,Longitude,Height (m),xSpeed(cm/s),ySpeed [cm/s]\n"
    result = read("pose_csv", six_rows("2025-03-02 10:00:0{i},35.72{i},-78.69,3{i},1{i},-250", head=head))
    np.testing.assert_allclose(column_of(result, "telemetry", "velocity_north_mps"), [0.1 + i / 100 for i in range(6)])
    np.testing.assert_allclose(column_of(result, "telemetry", "velocity_east_mps"), -2.5)


@pytest.mark.parametrize("first", [0, 1_200_000_000])
def test_microseconds_count_from_the_origin(first: int) -> None:
    """The micro sign is not a letter.

    After a quarter of an hour, a column of microseconds reaches 1e9, which could be an epoch in seconds.
    """
    head = SIX_COLUMNS.replace("Time", "Time [\u00b5s]")
    data = (head + "".join(f"{first + 1_000_000 * i},35.72,-78.69,30,-80\n" for i in range(6))).encode()
    time = next(s.frame["time"] for s in drive_test(data, time_origin="2025-03-02T15:00:00Z").streams)
    assert time.iloc[0].isoformat() == ("2025-03-02T15:20:00" if first else "2025-03-02T15:00:00")
    assert (time.diff().iloc[1:].dt.total_seconds() == 1.0).all()


@pytest.mark.parametrize(("first", "step", "unit_s"), [
    (0, 1, 1.0), (100_000, 1, 1.0), (0, 30, 1.0), (0, 1000, 1e-3), (5000, 100, 1e-3), (0, 1_000_000, 1e-6),
    (31_000_000, 1_000_000, 1e-6), (1_200_000_000, 100_000, 1e-6), (31_000_000, 20_000, 1e-6),
    (2 * 10**12, 10**9, 1e-9),
])  # fmt: skip
def test_the_unit_of_bare_numbers_makes_steps_and_length_those_of_a_flight(
    first: int, step: int, unit_s: float
) -> None:
    rows = "".join(f"{first + step * i},35.72,-78.69,30,-80\n" for i in range(1000 if step == 20_000 else 60))
    result = drive_test((SIX_COLUMNS + rows).encode(), time_origin="2025-03-02T15:00:00Z")
    time = result.streams[0].frame["time"]
    np.testing.assert_allclose(time.diff().iloc[1:].dt.total_seconds(), step * unit_s)
    assert any("without a unit" in text for text in result.warnings) == (step > 1)


def test_the_unit_of_a_program_is_not_read_where_its_steps_would_be_of_no_log() -> None:
    head = "time;cc;earfcn;pci;rsrp;pl;cfo\n"
    for step, step_s in ((1, 1.0), (1000, 1.0), (100, 0.1)):
        data = head + "".join(f"{step * i};0;3350;1;-80.5;90.1;12\n" for i in range(20))
        result = drive_test(data.encode(), time_origin="2025-03-02T15:00:00Z")
        np.testing.assert_allclose(result.streams[0].frame["time"].diff().iloc[1:].dt.total_seconds(), step_s)
        assert any("read as seconds" in text for text in result.warnings) == (step == 1)


@pytest.mark.parametrize(("name", "other", "cell"), [
    ("time_unix_usec", "time_boot_ms", "17409276{i:02d}000000,{i}000"), ("UTC", "Time (s)", "2025-03-02T15:00:{i:02d}Z,{i}"),
    ("wall_clock", "time", "2025-03-02T15:00:{i:02d}Z,{i}"), ("utc_datetime", "elapsed", "2025-03-02 15:00:{i:02d},{i}"),
    ("gps_time", "millis", "17409276{i:02d},{i}000"), ("Recorded", "t", "17409276{i:02d}000,{i}"),
])  # fmt: skip
def test_a_time_with_a_date_is_read_and_not_the_one_without(name: str, other: str, cell: str) -> None:
    head = f"{name},{other},Latitude,Longitude,Altitude (m),RSRP\n"
    result = drive_test((head + "".join(cell.format(i=i) + ",35.72,-78.69,30,-80\n" for i in range(20))).encode())
    time = result.streams[0].frame["time"]
    assert time.iloc[0].isoformat() == "2025-03-02T15:00:00"
    assert (time.diff().iloc[1:].dt.total_seconds() == 1.0).all()
    assert any(f"not read, though they look like levels, identities, positions, times or flags: {other!r}" in text
               for text in result.warnings)  # fmt: skip


@pytest.mark.parametrize("form", ["lines", "array", "indented"])
def test_json_records_are_a_table_with_a_column_per_value(form: str) -> None:
    entries = [
        {
            "ts": f"{1740927600 + i}000", "gps": {"lat": 35.72, "lon": -78.69, "alt": 30.5},
            "serving": {"pci": 14, "rsrp": -80.5},
            "neighbors": [{"pci": 15, "rsrp": -90 - i % 3}, {"pci": 16, "rsrp": -95}][: i % 3],
        }
        for i in range(30)
    ]  # fmt: skip
    indent = 2 if form == "indented" else None
    text = "\n".join(map(json.dumps, entries)) if form == "lines" else json.dumps(entries, indent=indent)
    result = drive_test((text + "\n").encode())
    cells = {s.attributes["pci"]: len(s.frame["rss_db"].dropna()) for s in result.streams if s.kind == "rss"}
    assert cells == {14: 30, 15: 20, 16: 10}
    track = next(s for s in result.streams if s.kind == "telemetry")
    assert track.frame["time"].iloc[0].isoformat() == "2025-03-02T15:00:00"
    assert set(track.frame["altitude_m"]) == {30.5}
    assert not result.rejected


def test_a_clock_that_never_moves_gives_way_to_one_without_dates() -> None:
    head = "gps_time,time_boot_ms,Latitude,Longitude,Altitude (m),RSRP\n"
    rows = "".join(f"2025-03-02T15:00:00Z,{i}000,35.72,-78.69,30,-80\n" for i in range(20))
    result = drive_test((head + rows).encode())
    assert (result.streams[0].frame["time"].diff().iloc[1:].dt.total_seconds() == 1.0).all()
    assert any("'gps_time' stops" in text for text in result.warnings)


def test_microvolts_become_dbm_with_the_impedance_in_a_warning() -> None:
    head = SIX_COLUMNS.replace("dBm", "dB\u00b5V")
    result = drive_test(six_rows(GOOD.replace("-8{i}", "2{i}"), head=head))
    level = next(s.frame["rss_db"] for s in result.streams if s.kind == "rss")
    np.testing.assert_allclose(level.dropna(), [20 + i - 106.99 for i in range(6)], atol=0.01)
    assert any("50 ohm" in text for text in result.warnings)


def test_times_of_the_day_in_digits_are_told_from_counts() -> None:
    stamps = [f"14{i // 60:02d}{i % 60:02d}" for i in range(100)]
    rows = "".join(f"{stamp},35.72,-78.69,30,-80\n" for stamp in stamps)
    time = drive_test((SIX_COLUMNS + rows).encode(), time_origin="2025-03-02").streams[0].frame["time"]
    assert time.iloc[0].isoformat() == "2025-03-02T19:00:00"
    assert (time.diff().iloc[1:].dt.total_seconds() == 1.0).all()


def test_text_without_a_doubt_about_units_is_not_reported() -> None:
    rows = "".join(f"2025-03-02T15:00:0{i}Z,35.72,-78.69,30,-80\n" for i in range(6))
    units = "UTC,deg,deg,m,dB\n"
    result = drive_test(f"# receiver 3, levels in dBm\n{SIX_COLUMNS}{units}{rows}Written by a logger\n".encode())
    assert "is not read" not in " ".join(result.warnings)


def test_day_numbers_under_utc_are_utc() -> None:
    rows = "".join(f"{45718 + (36_000 + i) / 86_400:.9f},35.72,-78.69,30,-80\n" for i in range(6))
    time = drive_test((SIX_COLUMNS.replace("Time", "Time (UTC)") + rows).encode()).streams[0].frame["time"]
    assert abs((time.iloc[0] - np.datetime64("2025-03-02T10:00:00")).total_seconds()) < 1e-3


@pytest.mark.parametrize(("zero", "program"), [(45718, "a spreadsheet"), (739678, "MATLAB")])
def test_day_numbers_are_local_dates(zero: int, program: str) -> None:
    """Day 45718 of a spreadsheet and datenum(2025, 3, 2) are both 2 March 2025."""
    rows = "".join(f"{zero + (36_000 + i) / 86_400:.9f},35.72,-78.69,30,-80\n" for i in range(6))
    result = drive_test((SIX_COLUMNS + rows).encode())
    time = result.streams[0].frame["time"]
    assert abs((time.iloc[0] - np.datetime64("2025-03-02T15:00:00")).total_seconds()) < 1e-3
    assert any(program in text for text in result.warnings)


@pytest.mark.parametrize("time", ["1.74093E+12", "1,740931e+09"])
def test_epochs_that_a_spreadsheet_rounded_are_refused(time: str) -> None:
    with pytest.raises(InputError, match="rounded"):
        drive_test(six_rows(GOOD.replace("2025-03-02 10:00:0{i}", f'"{time}"')))
    exact = drive_test(six_rows(GOOD.replace("2025-03-02 10:00:0{i}", "1.7409312{i}000E+09"))).streams[0].frame["time"]
    assert (exact.diff().iloc[1:].dt.total_seconds() == 10.0).all()


def test_times_without_seconds_are_said() -> None:
    result = drive_test(six_rows(GOOD.replace("2025-03-02 10:00:0{i}", "3/22/2025 10:00")))
    assert any("no seconds" in text for text in result.warnings)
    assert not any("no seconds" in text for text in drive_test(six_rows(GOOD)).warnings)


def test_levels_in_another_unit_are_said() -> None:
    """RSRP as the index of the standard or in tenths would be out of coverage everywhere, without a reason."""
    result = drive_test(six_rows(GOOD.replace("-8{i}", "5{i}")))
    assert any("6 of 6 levels outside" in text for text in result.warnings)


def test_two_phone_lines_glued_by_a_torn_one_are_rejected() -> None:
    """The cells of the second would get the time of the first."""
    first, second = samples.FILES["pawprints/text_of_2023"].split(b"\n")[:2]
    result = read("pawprints", first[:40] + second + b"\n" + second + b"\n")
    assert (result.accepted, [line.number for line in result.rejected]) == (1, [1])


def test_rows_that_a_bare_decimal_comma_shifts_are_rejected() -> None:
    """Such rows have one more field.

    If the last column is empty, the row would fit with every value in the next column.
    """
    head = "Time,Latitude,Longitude,Altitude (m),RSRP (dBm),Note\n"
    rows = [f"2025-03-02 10:00:0{i},25,35.72,-78.69,30,-8{i},{'' if i % 2 else 'x'}" for i in range(6)]
    result = drive_test((head + "\n".join(rows) + "\n").encode())
    assert (result.accepted, result.rejected_count) == (0, 6)


def test_an_empty_field_more_in_every_row_is_nothing() -> None:
    data = six_rows(GOOD + ",")
    assert column_of(drive_test(data), "rss", "rss_db") == column_of(drive_test(six_rows(GOOD)), "rss", "rss_db")
    odd_row = drive_test(six_rows(GOOD) + b"2025-03-02 10:00:06,35.72,-78.69,30,-86,\n")
    assert (odd_row.accepted, [line.number for line in odd_row.rejected]) == (6, [8])


def test_mapped_columns_count_as_read_and_rows_without_a_fix_have_no_position() -> None:
    rows = [
        f"2025-06-10T14:00:0{i}Z,{35.9 if i == 0 else 35.7275},-78.696,{i},-8{i},{int(i > 0)},-9{i}" for i in (0, 1)
    ]
    table = "when,Lat.,Lon.,H,Lev,gps_valid,signal_B\n" + "\n".join(rows) + "\n"
    pairs = {"time": "when", "latitude_deg": "Lat.", "longitude_deg": "Lon.", "altitude_m": "H", "rss_db": "Lev"}
    options = ReadOptions(columns=pairs, kind="rss", unit="dBm")
    result = by_name("generic_csv").read(table.encode(), options)
    _, track = result.streams
    assert np.isnan(track.frame["latitude_deg"]).tolist() == [True, False]
    (left,) = [text for text in result.warnings if "not read" in text]
    assert left.endswith(": 'signal_B'")


@pytest.mark.parametrize("first", [3_700_000, 4_000_000, 54_000_000, 80_000_000])
def test_milliseconds_count_from_a_complete_origin_and_else_are_a_time_of_the_day(first: int) -> None:
    rows = "".join(f"{first + 100 * i},35.72,-78.69,30,-80\n" for i in range(100))
    for origin, zone, zero in (
        ("2025-03-02T15:00:00Z", None, "2025-03-02T15:00:00"), ("2025-03-02", "America/New_York", "2025-03-02T05:00:00"),
    ):  # fmt: skip
        options = replace(OPTIONS, time_origin=origin, timezone=zone, file_name="x.csv")
        result = by_name("drive_test").read((SIX_COLUMNS + rows).encode(), options)
        expected = np.datetime64(zero, "ms") + np.timedelta64(first, "ms")
        assert result.streams[0].frame["time"].iloc[0] == expected
        assert any(
            "read as milliseconds, which is a guess" in text and "'time [s]'" in text for text in result.warnings
        )


@pytest.mark.parametrize(("step", "unit_s", "named", "remedy"), [
    (900, 1.0, "read as seconds", "'time [ms]'"), (3600, 1.0, "read as seconds", "'time [ms]'"),
    (300, 1e-3, "read as milliseconds", "'time [s]'"), (1 / 60, 1.0, "as minutes", "'time [min]'"),
    (0.25, 1.0, "as minutes", "'time [min]'"), (1 / 3600, 1.0, "as hours", "'time [min]'"),
    (0.01, 1.0, "as hours", "'time [min]'"),
])  # fmt: skip
def test_a_guessed_unit_is_reported_with_the_other_units_and_the_remedy(
    step: float, unit_s: float, named: str, remedy: str
) -> None:
    rows = "".join(f"{round(step * i, 5):g},35.72,-78.69,30,-80\n" for i in range(60))
    result = drive_test((SIX_COLUMNS + rows).encode(), time_origin="2025-03-02T15:00:00Z")
    steps = result.streams[0].frame["time"].diff().iloc[1:].dt.total_seconds()
    np.testing.assert_allclose(steps, step * unit_s, atol=2e-5)
    (text,) = (text for text in result.warnings if "without a unit" in text)
    assert named in text
    assert remedy in text


def test_seconds_of_a_whole_minute_are_read_without_a_question() -> None:
    rows = "".join(f"{0.5 * i},35.72,-78.69,30,-80\n" for i in range(200))
    result = drive_test((SIX_COLUMNS + rows).encode(), time_origin="2025-03-02T15:00:00Z")
    assert not any("without a unit" in text for text in result.warnings)


# --- what the lines above a table, other columns and the last line decide ----------------------------------------------


@pytest.mark.parametrize(
    ("title", "hours", "line"),
    [("# recording date: 2025-03-14 UTC", 0, 1), ("Messung\n# date 2025-03-14, by X", 4, 2), ("20250314 GMT", 0, 1)],
)
def test_times_of_the_day_have_the_date_above_the_table(title: str, hours: int, line: int) -> None:
    data = f"{title}\ntod,pci,rsrp_dbm\n23:59:58,12,-80\n23:59:59.5,12,-81\n00:00:00,12,-82\n".encode()
    result = by_name("drive_test").read(data, ReadOptions(timezone="America/New_York"))
    began = np.datetime64("2025-03-14T23:59:58", "ns") + np.timedelta64(hours, "h")
    seconds = (result.streams[0].frame["time"].to_numpy() - began) / np.timedelta64(1, "s")
    assert seconds.tolist() == [0, 1.5, 2]
    assert any(f"that in line {line} is used" in text for text in result.warnings)


def test_two_dates_above_a_table_are_not_used() -> None:
    data = b"# made 2025-03-14\n# calibrated 2024-01-02\ntod,pci,rsrp_dbm\n10:00:00,12,-80\n10:00:01,12,-81\n"
    assert by_name("drive_test").read(data, ReadOptions()).streams[0].frame["time"][0].year == 1970


@pytest.mark.parametrize(
    ("fractions", "seconds"),
    [
        ([100, 400, 900], [0.1, 0.4, 0.9]),  # within one second
        ([700, 900, 100], [0.7, 0.9, 1.1]),
        ([237, 238, 239], [0.237, 1.238, 2.239]),
    ],
)
def test_milliseconds_below_a_second_are_fractions(fractions: list[int], seconds: list[float]) -> None:
    whole = [int(value) for value in seconds]
    rows = "".join(
        f"2025-03-02 10:00:0{s},{ms},35.73,-78.7,{i}\n" for i, (s, ms) in enumerate(zip(whole, fractions, strict=True))
    )
    time = read("pose_csv", f"datetime(utc),ms,lat,lon,alt\n{rows}".encode()).streams[0].frame["time"].to_numpy()
    assert ((time - np.datetime64("2025-03-02T10:00:00")) / np.timedelta64(1, "s")).tolist() == pytest.approx(seconds)


def test_a_last_level_that_was_cut_off_is_not_scored(tmp_path: Path) -> None:
    path, rows = tmp_path / "x.csv", "".join(f"{1749564000 + i},11,{-90 - i % 3}\n" for i in range(20))
    for last, flag in (("-9", "unterminated_line;level_lost"), ("-92", "unterminated_line")):
        path.write_text(f"time,pci,rsrp\n{rows}1749564020,11,{last}")
        (file,) = ingest([path])
        assert file.result.streams[0].frame["flag"].iloc[-1] == flag
        assert any("level_lost" in text for text in file.result.warnings) is ("lost" in flag)


def test_the_carrier_of_a_scan_is_that_of_all_its_cells() -> None:
    rows = "".join(f"{1749564000 + i};{(1300, 2850)[i // 6]};11;{-70 - i % 2};12;-90\n" for i in range(12))
    result = read("drive_test", f"time;EARFCN;PCI_1;RSRP_1;PCI_2;RSRP_2\n{rows}".encode())
    assert {(s.attributes["pci"], s.attributes["arfcn"]) for s in result.streams} == {
        (pci, arfcn) for pci in (11, 12) for arfcn in (1300, 2850)
    }


def test_words_in_a_column_of_levels_are_counted() -> None:
    data = b"time,pci,rsrp\n1749564000,11,-80\n1749564001,11,<-110\n1749564002,11,-81\n"
    assert any("'<-110'" in text for text in read("drive_test", data).warnings)


@pytest.mark.parametrize(
    ("name", "text", "first"),
    [
        ("drive_test", '{{"_index": "m", "_source": {{"@timestamp": "{time}Z", "modem": {{"pci": 11, "rsrp": -80}}}}}}', "2025-03-02T15:00:00"),
        ("drive_test", "@timestamp,pci,rsrp\n\"Mar 2, 2025 @ 10:00:00.000\",11,-80", "2025-03-02T15:00:00"),
        ("pose_csv", "%time,field.header.stamp,field.latitude,field.longitude,field.altitude\n1740927600120000000,1740927600000000000,35.7,-78.7,80", "2025-03-02T15:00:00"),
    ],
)  # fmt: skip
def test_times_of_other_programs(name: str, text: str, first: str) -> None:
    data = f"{text.format(time=first)}\n".encode()
    assert by_name(name).sniff(data)
    assert read(name, data).streams[0].frame["time"][0] == np.datetime64(first)


def test_a_height_of_zeros_hides_no_other_height() -> None:
    rows = "".join(f"2025-03-02 10:00:{i:02d},35.73,-78.7,{120 + 2 * i},0\n" for i in range(12))
    (track,) = read("pose_csv", f"datetime(utc),latitude,longitude,altitude(m),ascent(m)\n{rows}".encode()).streams
    assert track.frame["altitude_m"].iloc[-1] - track.frame["altitude_m"].iloc[0] == 22


def test_the_day_comes_first_in_europe() -> None:
    data = b"time,pci,rsrp\n03/04/2025 10:00:00,11,-80\n03/04/2025 10:00:01,11,-81\n"
    months = {
        zone: read("drive_test", data, timezone=zone).streams[0].frame["time"][0].month
        for zone in ("Europe/Paris", "America/New_York")
    }
    assert months == {"Europe/Paris": 4, "America/New_York": 3}


@pytest.mark.parametrize("names", [
    "azimuth,elevation", "azimuth_deg,elev", "elevation_deg,x", "altitude_m,elevation", "altitude_m,cmd_alt",
    "x,desired_alt", "rtl_alt,x", "fence altitude,x",
])  # fmt: skip
def test_an_angle_the_ground_or_a_wish_is_no_height(names: str) -> None:
    rows = "".join(f"2025-03-02 10:00:{i:02d},35.73,-78.7,{100 + i},{40 + i % 2}\n" for i in range(12))
    (track,) = read("pose_csv", f"time utc,lat,lon,{names}\n{rows}".encode()).streams
    heights = track.frame["altitude_m"].dropna().tolist()
    assert [height - 100 for height in heights] == ([] if "altitude_m" not in names else [*range(12)])


def test_a_header_again_below_units_keeps_its_columns() -> None:
    lines = ["1749564000,35.73,-78.7,10", "1749564001,35.73,-78.7,11"]
    for units in ("s,deg,deg,m", "UTC,deg,deg,m"):
        rows = [line.replace("17495640", "2025-03-02T10:00:") if "UTC" in units else line for line in lines]
        text = "\n".join(["time,lat,lon,alt", units, *rows, "time,lat,lon,alt", *rows]) + "\n"
        assert read("pose_csv", text.encode()).accepted == 4


def test_the_order_of_rows_does_not_change_heights() -> None:
    rows = [f"2025-03-02T15:00:{i:02d}Z,{35.73 + 1e-5 * max(0, i - 5)},-78.7,{120 + max(0, i - 5)}" for i in range(40)]
    heights = [
        read("pose_csv", "\n".join(["time,lat,lon,alt msl", *listed, ""]).encode()).streams[0].frame["altitude_m"]
        for listed in (rows, rows[::-1])
    ]
    assert heights[0].tolist() == heights[1].tolist()[::-1]


@pytest.mark.parametrize("name", ["dl_ri_avg", "ri_avg", "ri_cap", "prev_ri"])
def test_another_rank_next_to_a_rank_is_not_reported_by_the_modem(name: str) -> None:
    data = f"time,{name},ri\n1749564000,4,2\n1749564001,4,3\n".encode()
    assert [s.frame["rank"].tolist() for s in read("drive_test", data).streams if s.kind == "rank"] == [[2, 3]]


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("# all altitudes in feet\ntime utc,lat,lon,alt agl\n2025-03-02 10:00:00,35.73,-78.7,100\n", "in feet"),
        ("local_epoch,pci,rsrp\n1749564000,11,-80\n", "local_as_utc"),
        ("time,timezoneOffset,pci,rsrp\n2025-03-02 10:00:00,240,11,-80\n", "JavaScript"),
    ],
)
def test_what_the_reader_cannot_know_is_said(text: str, word: str) -> None:
    reader = "drive_test" if "rsrp" in text else "pose_csv"
    assert any(word in warning for warning in read(reader, text.encode()).warnings)


def test_logfmt_is_a_table_in_any_order_of_names() -> None:
    names = ["ts", "msg", "pci", "rsrp", "lat", "lon"]
    lines = [
        f'ts=2025-03-02T15:00:{i:02d}Z msg="a b" pci={11 + i % 2} rsrp={-80 - 9 * (i % 2)} lat=35.{7000 + i} lon=-78.7'
        for i in range(20)
    ]
    turned = [
        " ".join(sorted(line.replace("a b", "ab").split(), key=lambda pair: names.index(pair.split("=")[0]) % 4))
        for line in lines
    ]
    for listed in (lines, turned):
        data = ("\n".join([*listed[:10], "restarted", *listed[10:]]) + "\n").encode()
        assert by_name("drive_test").sniff(data)
        result = read("drive_test", data)
        assert (result.accepted, result.blank, len(result.rejected)) == (20, 1, 0)
        assert {s.attributes["pci"]: set(s.frame["rss_db"]) for s in result.streams if s.kind == "rss"} == {
            11: {-80},
            12: {-89},
        }
