"""The meaning of each format: units, order, missing values, clocks."""

import gzip
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.text import counted
from aerpaw_cmp.logs import limits
from aerpaw_cmp.logs.readers import ReadOptions, by_name, identify
from aerpaw_cmp.logs.records import ReadResult, Stream
from tests.parsers import samples
from tests.parsers.samples import CASES, OPTIONS, SAMPLES


def read(reader: str, data: bytes, options: ReadOptions = OPTIONS) -> ReadResult:
    return by_name(reader).read(data, options)


def stream(result: ReadResult, name: str) -> Stream:
    return next(candidate for candidate in result.streams if candidate.name == name)


def utc(text: str) -> pd.Timestamp:
    return pd.Timestamp(text)


@pytest.mark.parametrize(
    ("indices", "said"),
    [
        ((1, 2, 3, 4, 5), None),
        ((1, 2, 3, 7, 8), 1),
        ((1, 2, 9, 1, 2), 2),
        ((5, 4, 3, 2, 1), 4),
        ((0, 1, 2, 3, 4), None),
    ],
)
def test_a_row_index_that_jumps_is_told_once_per_place(indices: tuple[int, ...], said: int | None) -> None:
    rest = samples.FILES["vehicle_out/ten_fields"].splitlines()[0].split(b",", 1)[1].decode()
    rows = [f"{n},{rest.replace('00.250000', f'0{i}.250000')}\n" for i, n in enumerate(indices)]
    warnings = [text for text in read("vehicle_out", "".join(rows).encode()).warnings if "index" in text]
    expected = (
        [f"the row index jumps at {counted(said, 'place')}: rows are missing or files were joined"] if said else []
    )
    assert warnings == expected


@pytest.mark.parametrize(
    "data",
    [
        samples.FILES["vehicle_out/ten_fields"],
        samples.FILES["vehicle_out/nine_fields"],
        samples.FILES["vehicle_out/eight_fields"],
        samples.FILES["vehicle_out/eleven_fields"],
        samples.FILES["vehicle_out/utc_offset"],
    ],
    ids=["10", "9", "8", "11", "utc"],
)
def test_all_generations_of_telemetry_agree(data: bytes) -> None:
    first = read("vehicle_out", data).streams[0].frame.iloc[0]
    # New York is at UTC-5 on 2 March
    assert first["time"] == utc("2025-03-02 15:00:00.25")
    assert (first["longitude_deg"], first["latitude_deg"], first["altitude_m"]) == (-78.7000001, 35.7300002, 0.5)
    assert first["satellites"] == 12
    if not np.isnan(first["pitch_deg"]):
        assert np.allclose(first[["pitch_deg", "yaw_deg", "roll_deg"]].astype(float), np.degrees([0.1, 1.5, -0.05]))


@pytest.mark.parametrize(
    ("longitude", "latitude", "altitude", "fix", "flag"),
    [
        ("180.0", "90.0", "19999", "2", ""),
        ("-180.0", "-90.0", "-998.5", "3", ""),  # the sentinel is -999
        ("180.01", "35", "1", "3", "position_out_of_range"),
        ("-78", "90.01", "1", "3", "position_out_of_range"),
        ("-78", "35", "100000", "3", "position_out_of_range"),
        ("-78", "35", "-998.6", "3", "no_fix"),
        ("-901", "35", "1", "3", "no_fix"),
        ("0.0", "0.0", "1", "3", "no_fix"),
        ("-78", "35", "1", "1", "no_fix"),
    ],
)
def test_limits_of_a_vehicles_position(longitude: str, latitude: str, altitude: str, fix: str, flag: str) -> None:
    row = f"0,{longitude},{latitude},{altitude},48.1,2025-03-02 10:00:00.250000,{fix},12\n"
    result = limits.check(by_name("vehicle_out").read(row.encode(), OPTIONS))
    (stream,) = result.streams
    assert stream.frame["flag"].tolist() == [flag]
    assert np.isnan(stream.frame["altitude_m"][0]) == bool(flag)
    notes = [text for text in result.warnings if "without a position fix" in text]
    assert notes == (["1 row without a position fix: position NaN, flagged no_fix"] if flag == "no_fix" else [])


@pytest.mark.parametrize(
    ("index", "fix", "rows"), [("999999999999", "999", 1), ("1000000000000", "3", 0), ("1", "1000", 0)]
)
def test_counts_of_a_vehicle_have_their_digits(index: str, fix: str, rows: int) -> None:
    good = "2,-78,35,1,48.1,2025-03-02 10:00:00.250000,3,12\n"
    row = f"{index},-78,35,1,48.1,2025-03-02 10:00:00.250000,{fix},12\n"
    assert by_name("vehicle_out").read((good + row).encode(), OPTIONS).accepted == 1 + rows


def test_zero_attitude_is_flagged_and_unknown_where_it_is_all_there_is() -> None:
    result = read("vehicle_out", samples.FILES["vehicle_out/ten_fields"])
    assert result.streams[0].frame["flag"].iloc[2] == "zero_attitude"
    third = samples.FILES["vehicle_out/ten_fields"].splitlines(keepends=True)[2]
    converted = read("vehicle_out", third * 3)
    assert converted.streams[0].frame[["yaw_deg", "velocity_north_mps"]].isna().all(axis=None)
    assert any("unknown" in text for text in converted.warnings)


def test_torn_and_impossible_telemetry_says_why() -> None:
    lines = samples.FILES["vehicle_out/ten_fields"].splitlines(keepends=True)
    data = lines[0] + b"2,-78.7,35.7\r\n" + lines[2].replace(b"03-02", b"13-02") + lines[2].replace(b"1.5", b"x", 1)
    result = read("vehicle_out", data)
    assert [(line.number, line.reason.split(" ")[0]) for line in result.rejected] == [(2, "3"), (3, "the"), (4, "a")]
    assert result.rejected[0].text == "2,-78.7,35.7"


def test_digital_twin_is_named() -> None:
    line = b"%d,-78.7000001,35.7300002,0.5,48.1,99,2025-03-02 10:00:%02d.250000,6,10\r\n"
    twin = b"".join(line % (i + 1, i) for i in range(20))
    assert any("digital twin" in text for text in read("vehicle_out", twin).warnings)


def test_sounder_offsets_are_octal_and_runs_come_back() -> None:
    result = read("sounder_log", samples.FILES["sounder_log/runs_and_foot"])
    frame = result.streams[0].frame
    # offsets 0, 4, 010 = 8, then 030 = 24: samples 3, 4 and 5 were suppressed
    assert len(frame) == 3 + 3 + 2
    assert frame["flag"].str.contains("repeated").sum() == 3
    assert result.accepted == 6, "five samples and the '*'; the repeats come on top"
    assert result.streams[0].attributes["repeated_samples"] == 3
    spacing = frame["time"].diff().iloc[1:7].dt.total_seconds()
    assert np.allclose(spacing, 0.03276, atol=1e-6), "repeats are spread between their neighbours"


@pytest.mark.parametrize("width", [7, 8, 9])
@pytest.mark.parametrize(
    "text", ["-17.210482", "0.42979813", "10.51112", "-0", "5", "-123.45678", "6.0000001", "-123.4567890123"]
)
def test_sounder_numbers_are_read_as_python_reads_them(text: str, width: int) -> None:
    data = f"[2025-03-02 10:00:00.000000] {0o1234:0{width}o}{text:>16}\n".encode()
    frame = read("sounder_log", data).streams[0].frame
    assert frame["rss_db"].iloc[0] == float(text)


@pytest.mark.parametrize("text", ["- 5", "1 5", "1-5", "1.2.3", "", "-", ".", "1x", "-.5"])
def test_sounder_rejects_what_is_no_number(text: str) -> None:
    data = f"[2025-03-02 10:00:00.000000] 0001234{text:>16}\n".encode()
    result = read("sounder_log", samples.FILES["sounder_log/grown_offset"] + data)
    assert (result.accepted, len(result.rejected)) == (4, 1)


def test_sounder_offset_outgrows_seven_digits() -> None:
    result = read("sounder_log", samples.FILES["sounder_log/grown_offset"])
    assert not [text for text in result.warnings if "jump" in text]
    assert (result.streams[0].frame["flag"] == "").all()


def test_sounder_channel_names_the_stream() -> None:
    quality = read(
        "sounder_log", samples.FILES["sounder_log/runs_and_foot"], replace(OPTIONS, channel="quality", unit=None)
    ).streams[0]
    power = read("sounder_log", samples.FILES["sounder_log/runs_and_foot"], replace(OPTIONS, unit=None))
    assert (quality.name, quality.attributes["unit"]) == ("quality", "dB")
    assert (power.streams[0].name, power.streams[0].attributes["unit"]) == ("power", "dB re full scale")
    assert any("one layout" in text for text in power.warnings)


def test_mat_epoch_of_local_time() -> None:
    """Without the text the epoch is wall clock stored as UTC, unless the user knows better."""
    data = samples.mat_flight(timestamp_power_for_csv=None)
    local = read("flight_mat", data)
    assert local.streams[0].frame["time"].iloc[0] == utc("2025-03-02 15:00:00.25")
    assert any("local wall clock" in text for text in local.warnings)
    true_utc = read("flight_mat", data, replace(OPTIONS, clock="utc", timezone=None))
    assert true_utc.streams[0].frame["time"].iloc[0] == utc("2025-03-02 10:00:00.25")


@pytest.mark.parametrize(("later_s", "warns"), [(0.0, False), (18_000.0, True)])
def test_mat_epoch_that_differs_from_its_text_is_reported(later_s: float, warns: bool) -> None:
    start = np.datetime64("2025-03-02T10:00:00.250").astype(np.int64) / 1e3
    epoch = start + later_s + 0.26 * np.arange(5)
    result = read("flight_mat", samples.mat_flight(timestamp_power=epoch[:, None]))
    assert result.streams[0].frame["time"].iloc[0] == utc("2025-03-02 15:00:00.25")
    assert any("differ by 18000 s" in text for text in result.warnings) == warns


def test_mat_row_without_a_time_is_rejected() -> None:
    times = np.array(["2025-03-02 10:00:00.250", "nonsense", "2025-03-02 10:00:00.750", "NaT", "2025-02-30 10:00:00.0"])
    result = read("flight_mat", samples.mat_flight(timestamp_power_for_csv=times))
    assert (result.lines, result.accepted) == (5, 2)
    assert [line.number for line in result.rejected] == [2, 4, 5]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mX": np.zeros((3, 1))}, "differ in length .3 rows: mX; 5 rows: "),
        ({"succes": np.ones((4, 1))}, "differ in length .4 rows: succes; 5 rows: "),
        ({"timestamp_power": None, "timestamp_power_for_csv": None}, "no clock"),
        ({"mpower1": np.array(["a", "b", "c", "d", "e"])}, "not numeric"),
    ],
)
def test_mat_that_is_no_flight(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read("flight_mat", samples.mat_flight(**changes))


def test_mat_of_another_kind_is_not_sniffed() -> None:
    import io

    import scipy.io

    file = io.BytesIO()
    scipy.io.savemat(file, {"pattern": np.zeros((4, 4))})
    assert not by_name("flight_mat").sniff(file.getvalue())


@pytest.mark.parametrize(
    ("reader", "data"),
    [("nemo_csv", samples.FILES["nemo_csv/table"]), ("nemo_kml", samples.FILES["nemo_kml/placemarks"])],
)
def test_nemo_relative_times(reader: str, data: bytes) -> None:
    result = read(reader, data)
    frame = result.streams[0].frame
    assert frame["time"].iloc[0] == utc("2025-03-02 14:59:58.49975")
    assert frame["rank"].iloc[0] == 2
    assert frame["rank"].iloc[-1] == 4
    assert result.streams[0].attributes["clock"] == "utc"
    relative = read(reader, data, replace(OPTIONS, time_origin=None))
    assert relative.streams[0].frame["time"].iloc[0] == utc("1969-12-31 23:59:58.49975")
    assert relative.streams[0].attributes["clock"] == "relative"
    assert any("relative" in text for text in relative.warnings)


def test_nemo_calls_one_level_alike_in_both_exports() -> None:
    """Learned levels of one export apply to the other: same channel, technology and quantity."""
    table = next(s for s in read("nemo_csv", samples.FILES["nemo_csv/table"]).streams if s.kind == "rss")
    placemarks = samples.FILES["nemo_kml/placemarks"].replace(b"PDSCH rank (NR) = 2.0", b"RSRP (NR SpCell) = -80.5 dBm")
    level = next(s for s in read("nemo_kml", placemarks).streams if s.kind == "rss")
    for name in ("channel", "rat", "quantity", "unit"):
        assert level.attributes[name] == table.attributes[name]
    assert level.frame["rss_db"].dropna().tolist() == [-80.5]


def test_nemo_local_origin() -> None:
    local = read("nemo_csv", samples.FILES["nemo_csv/table"], replace(OPTIONS, time_origin="2025-03-02 10:00:00"))
    zoned = read("nemo_csv", samples.FILES["nemo_csv/table"])
    assert local.streams[0].frame["time"].equals(zoned.streams[0].frame["time"])
    with pytest.raises(UsageError, match="timezone:"):
        read("nemo_csv", samples.FILES["nemo_csv/table"], ReadOptions(time_origin="2025-03-02 10:00:00"))
    with pytest.raises(UsageError, match="time_origin"):
        read("nemo_csv", samples.FILES["nemo_csv/table"], replace(OPTIONS, time_origin="yesterday"))


def test_kml_with_styles_in_front_is_still_known() -> None:
    styles = b"    <Style id='8'><width>3</width></Style>\n" * 2000
    data = samples.FILES["nemo_kml/placemarks"].replace(b"  <Document>\n", b"  <Document>\n" + styles)
    assert not by_name("nemo_kml").sniff(data[:65536])
    assert identify(data).name == "nemo_kml"
    fence = (
        b"<?xml version='1.0'?>\n<kml><Document><Style/><Placemark><name>fence</name></Placemark></Document></kml>\n"
    )
    assert not by_name("nemo_kml").sniff(fence)


def test_srsenb_layout_with_a_pci_column_reads_the_same_numbers() -> None:
    """Newer versions print the cell's PCI before the RNTI. An RNTI of decimal digits must not be read as the PCI."""
    before = read("srsenb_log", samples.FILES["srsenb_log/console"]).streams[0].frame
    newer = (
        samples.FILES["srsenb_log/console"]
        .replace(b"rat rnti", b"rat  pci rnti")
        .replace(b"lte   46", b"lte    1   46")
    )
    assert by_name("srsenb_log").sniff(newer)
    after = read("srsenb_log", newer).streams[0].frame
    columns = ["rank", "ri_raw", "cqi", "mcs", "flag"]
    assert after[columns].equals(before[columns])
    assert len(after) == 3


def test_generic_columns() -> None:
    level = read("generic_csv", samples.FILES["generic_csv/mapped"]).streams[0]
    assert level.frame["rss_db"].tolist() == [-81.5, -82.5]
    assert level.frame["time"].iloc[0] == utc("2025-03-02 15:00:00.5")
    epoch = read("generic_csv", b"Time,Level\n1740927600.5,-81.5\n", replace(OPTIONS, time_origin=None))
    assert epoch.streams[0].frame["time"].iloc[0] == utc("2025-03-02 15:00:00.5")
    wall = read(
        "generic_csv", b"Time,Level\n1740909600.5,-81.5\n", replace(OPTIONS, time_origin=None, clock="local_as_utc")
    )
    assert wall.streams[0].frame["time"].iloc[0] == utc("2025-03-02 15:00:00.5")
    since = read("generic_csv", b"Time,Level\n0.5,-81.5\n")
    assert since.streams[0].frame["time"].iloc[0] == utc("2025-03-02 15:00:00.5")
    for text in ("02.03.2025 10:00:00,5", "02/03/2025 10:00:00,5", "2025/3/2 10:00:00.5", "2-Mar-2025 10:00:00.5"):
        european = read("generic_csv", f"Level;Time\n-81,5;{text}\n".encode())
        assert european.streams[0].frame["time"].iloc[0] == utc("2025-03-02 15:00:00.5"), text
        assert european.streams[0].frame["rss_db"].iloc[0] == -81.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": None}, "kind:"),
        ({"columns": {"time": "Time"}}, "lacks rss_db"),
        ({"columns": {"time": "Time", "rss_db": "Levle"}}, "did you mean 'Level'"),
        ({"columns": {"time": "Time", "rss_dbm": "Level"}}, "did you mean 'rss_db'"),
        ({"kind": "rank", "columns": {"time": "Time", "ri_raw": "Level"}}, "ri_base:"),
    ],
)
def test_generic_says_what_is_missing(change: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        read("generic_csv", samples.FILES["generic_csv/mapped"], replace(OPTIONS, **change))


@pytest.mark.parametrize(("base", "expected"), [("one", [np.nan, 1, 2]), ("zero", [1, 2, 3])])
def test_generic_rank_base(base: str, expected: list[float]) -> None:
    options = replace(OPTIONS, kind="rank", ri_base=base, columns={"time": "t", "ri_raw": "ri"})
    frame = read("generic_csv", b"t,ri\n1,0\n2,1\n3,2\n", options).streams[0].frame
    assert np.array_equal(frame["rank"], expected, equal_nan=True)


@pytest.mark.parametrize(
    ("reader", "sample"),
    [case for case in CASES if case[0] not in samples.WITHOUT_ZONE and case not in samples.WITHOUT_ZONE],
)
def test_a_clock_without_zone_names_the_key(reader: str, sample: str) -> None:
    with pytest.raises(UsageError, match="timezone:"):
        read(reader, SAMPLES[reader][sample][0], replace(OPTIONS, timezone=None))


def test_a_clock_with_offset_needs_no_zone() -> None:
    frame = read("vehicle_out", samples.FILES["vehicle_out/utc_offset"], ReadOptions()).streams[0].frame
    assert frame["time"].iloc[0] == utc("2025-03-02 15:00:00.25")


def test_gzip_is_transparent(tmp_path) -> None:
    from aerpaw_cmp.logs.ingest import ingest

    (tmp_path / "a.kml.gz").write_bytes(gzip.compress(samples.FILES["nemo_kml/placemarks"]))
    assert ingest(tmp_path / "a.kml.gz", options=OPTIONS)[0].result.accepted == 2
