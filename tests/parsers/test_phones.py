"""Phones, drive tests, tables of positions and consoles: what each value means."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.logs import dictionary
from aerpaw_cmp.logs.readers import ReadOptions, by_name
from aerpaw_cmp.logs.records import ReadResult, Stream
from aerpaw_parsers import _stamps, drive_test
from tests.parsers import samples
from tests.parsers.samples import OPTIONS

PLAIN = ReadOptions(timezone="America/New_York")


def read(reader: str, data: bytes, options: ReadOptions = PLAIN) -> ReadResult:
    return by_name(reader).read(data, options)


def stream(result: ReadResult, name: str) -> Stream:
    return next(candidate for candidate in result.streams if candidate.name == name)


def test_neighbours_are_of_the_radio_access_that_the_table_names_alone() -> None:
    """A cell that was a neighbour and served later was two streams, ``pci6`` and ``lte_pci6``."""
    rows = b"2025-03-02 10:00:00,5,-90,6,-99\n2025-03-02 10:00:01,6,-91,5,-98\n"
    lte = read("drive_test", b"Time,LTEPCI,RSRP,N1 PCI,N1 RSRP\n" + rows)
    assert {cell.name: cell.frame["rss_db"].tolist() for cell in lte.streams} == {
        "lte_pci5": [-90.0, -98.0], "lte_pci6": [-99.0, -91.0],
    }  # fmt: skip
    assert stream(lte, "lte_pci6").frame["serving"].tolist() == [0.0, 1.0]
    lte_and_nr = read(
        "drive_test", b"Time,LTE PCI,LTE RSRP,NR PCI,NR RSRP,N1 PCI,N1 RSRP\n2025-03-02 10:00:00,5,-90,6,-80,7,-99\n"
    )
    assert {cell.name for cell in lte_and_nr.streams} == {"lte_pci5", "nr_pci6", "pci7"}, (
        "it is unknown which of the two is meant"
    )


def test_a_bare_rank_beside_a_level_is_the_rank_of_the_channel() -> None:
    result = read("drive_test", b"Time,PCI,RSRP,Rank\n2025-03-02 10:00:00,5,-90,2\n2025-03-02 10:00:01,5,-91,0\n")
    rank = stream(result, "rank_indicator")
    assert (rank.kind, rank.frame["flag"].tolist()) == ("rank", ["", "no_csi"])
    assert rank.frame["rank"][0] == 2.0
    assert not drive_test.READERS[0].sniff(b"Time,Rank,Latitude,Longitude\n2025-03-02 10:00:00,5,35.7,-78.7\n"), (
        "a list's"
    )


def test_nemo_times_of_the_day_take_the_date_of_the_file_name() -> None:
    data = samples.FILES["drive_test/nemo"].replace(b"2025-03-02 ", b"")
    named = read("drive_test", data, replace(PLAIN, file_name="25Mar02_100000.1.csv"))
    assert named.streams[0].frame["time"][0] == pd.Timestamp("2025-03-02T15:00:00.250")
    nobody = read("drive_test", data, replace(PLAIN, file_name="60m.csv"))
    assert nobody.streams[0].frame["time"][0] == pd.Timestamp("1970-01-01T10:00:00.250")
    assert nobody.streams[0].attributes["clock"] == "relative"


def test_a_neighbour_that_nobody_names_is_no_level_of_the_serving_cell() -> None:
    """G-NetTrack's NRxRSRP as public data sets have it: it was left out, and N1 RSRP filled the gaps of RSRP."""
    for name in (b"NRxRSRP", b"N1 RSRP"):
        data = (
            b"Timestamp,NetworkMode,RSRP," + name + b"\n2025.03.02_10.00.00,LTE,-90,-99\n2025.03.02_10.00.01,LTE,,-98\n"
        )
        result = read("drive_test", data)
        assert stream(result, "lte_rsrp").frame["rss_db"].tolist() == [-90.0]
        other = stream(result, name.decode().lower().replace(" ", "_"))
        assert (other.kind, other.frame["value"].tolist()) == ("kpi", [-99.0, -98.0]), "no report compares it"


@pytest.mark.parametrize(
    ("name", "unit", "value"),
    [
        ("LTE PDSCH throughput (Mbit/s)", "bit/s", 3e6),
        ("LTE PDSCH throughput [kbps]", "bit/s", 3e3),
        ("LTE PDSCH throughput", "unknown", 3.0),
        ("DL_bitrate", "bit/s", 3e3),  # G-NetTrack's
        ("LTE BLER [%]", "%", 3.0),
        ("LTE SINR [dB]", "dB", 3.0),
        ("LTE RSSI [dBm]", "dBm", 3.0),
    ],
)
def test_values_are_in_the_unit_that_their_stream_says(name: str, unit: str, value: float) -> None:
    """A throughput in Mbit/s was given in bit/s and called mbit/s."""
    result = read("drive_test", f"Time,NetworkTech,NR-PCI,NR RSRP,{name}\n2025-03-02 10:00:00,LTE,1,-80,3\n".encode())
    (quantity,) = (quantity for quantity in result.streams if "pci1" not in quantity.name)
    assert (quantity.attributes["unit"], quantity.frame["value" if quantity.kind == "kpi" else "rss_db"][0]) == (
        unit,
        value,
    )


@pytest.mark.parametrize(("written", "flag"), [("0", "no_csi"), ("9", "ri_out_of_range"), ("1,5", "rank_is_a_mean")])
def test_a_rank_that_is_none_says_why(written: str, flag: str) -> None:
    result = read(
        "drive_test", samples.FILES["drive_test/xcal"].replace(b'"-81,5";"2"', b'"-81,5";"%s"' % written.encode())
    )
    (rank,) = (series for series in result.streams if series.kind == "rank")
    assert rank.frame["rank"].isna().all()
    assert rank.frame["flag"].tolist() == [flag]


def test_g_nettrack_pro_rssi_is_beside_its_level_and_steps_are_none() -> None:
    rows = samples.FILES["drive_test/g_nettrack_pro"].splitlines(keepends=True)
    result = read("drive_test", b"".join([*rows[:2], rows[1].replace(b"|-70|", b"|17|").replace(b"00.00|", b"00.02|")]))
    (cell,) = (series for series in result.streams if series.name == "lte_pci42")
    assert cell.frame["rssi_dbm"].tolist()[:1] == [-70.0]
    assert np.isnan(cell.frame["rssi_dbm"].to_numpy()[1:]).all(), "older phones: steps from 0, no level"


@pytest.mark.parametrize("columns", [lambda names: names[::-1], lambda names: names[3:] + names[:3]])
def test_columns_in_any_order(columns: object) -> None:
    lines = [line.split(b",") for line in samples.FILES["drive_test/nemo"].strip().split(b"\n")[:-1]]
    turned = b"\n".join(b",".join(columns(line)) for line in lines) + b"\n"  # type: ignore[operator]
    usual, reordered = read("drive_test", samples.FILES["drive_test/nemo"]), read("drive_test", turned)
    for name in ("lte_pci110", "lte_pci22", "phone"):
        pd.testing.assert_frame_equal(stream(usual, name).frame, stream(reordered, name).frame)


def test_milliseconds_beyond_any_time_stamp_are_left_out() -> None:
    first = samples.FILES["pose_csv/airdata"].splitlines(keepends=True)[1]
    wild = samples.FILES["pose_csv/airdata"].replace(first, b"9" * 16 + first[first.index(b",") :])
    result = read("pose_csv", wild)
    assert any("column of milliseconds" in text for text in result.warnings)
    assert (result.streams[0].frame["time"].to_numpy().astype("int64") % 1_000_000_000 == 0).all()


def test_title_lines_in_front_of_a_table() -> None:
    data = b"Flight of the second\nexported by x\n\n" + samples.FILES["pose_csv/airdata"]
    assert read("pose_csv", data).accepted == 2
    assert by_name("pose_csv").sniff(data)


@pytest.mark.parametrize(
    ("name", "quantity"),
    [
        ("RSRP (NR SpCell)", "RSRP"), ("NR5G SS-RSRP[0]", "RSRP"), ("RS SNR", "SINR"), ("SINR (LTE pcell)", "SINR"),
        ("WB CQI (NR)", "CQI"), ("LTE PDSCH rank (NR)", "rank"), ("5G KPI PCell RF RI", "rank"),
        ("Application throughput downlink", "throughput"), ("LTE PDSCH throughput (NR)", "throughput"), ("E-UTRAN carrier RSSI", "RSSI"),
    ],
)  # fmt: skip
def test_names_of_quantities(name: str, quantity: str) -> None:
    known = dictionary.meaning(name)
    assert known is not None
    assert known.quantity.name == quantity


@pytest.mark.parametrize("name", ["Longitude", "Grid", "Carrier", "Direction", "Priority", "Time", "Primary"])
def test_names_that_only_look_like_one(name: str) -> None:
    known = dictionary.meaning(name)
    assert known is None or known.quantity.role not in ("rss", "rank", "kpi")


@pytest.mark.parametrize(
    "text",
    [
        "2025-03-02 10:00:00.250", "2025/03/02T10:00:00.250", "02.03.2025 10:00:00.250", "2025.03.02_10.00.00.250",
        "20250302100000.250", "02-Mar-2025 10:00:00.250", "2025-03-02T15:00:00.250Z", "2025-03-02 10:00:00.250-05:00",
        "1740927600.250", "1740927600250", "1740927600250000",
    ],
)  # fmt: skip
def test_every_form_of_one_time(text: str) -> None:
    clock, cells, _ = _stamps.read([text, text.replace("02.03", "22.03")] if "02.03." in text else [text], PLAIN)
    from aerpaw_cmp.logs import rows as _rows

    _, instants, valid = _rows.instants_of(cells, PLAIN, clock=clock, reader="x")
    assert valid[0]
    assert instants.time[0] == np.datetime64("2025-03-02T15:00:00.250")


def test_dates_that_can_be_read_two_ways_are_told() -> None:
    _, cells, warnings = _stamps.read(["03/02/2025 10:00:00"], PLAIN)
    assert cells[0] == b"2025-03-02 10:00:00"
    assert any("month" in text for text in warnings)
    _, cells, warnings = _stamps.read(["02/03/2025 10:00:00", "13/03/2025 10:00:00"], PLAIN)
    assert cells[0] == b"2025-03-02 10:00:00"
    assert not warnings


@pytest.mark.parametrize("zone", ["ET", "America/New_York"])
def test_each_time_has_the_offset_of_its_own_hour(zone: str) -> None:
    _, cells, _ = _stamps.read([f"2025/11/02 0{hour}:30:00 {zone}" for hour in (0, 3)], PLAIN)
    assert cells.tolist() == [b"2025-11-02 00:30:00-04:00", b"2025-11-02 03:30:00-05:00"]


def test_past_midnight() -> None:
    _, cells, _ = _stamps.read(["23:59:59.5", "00:00:00.5"], replace(PLAIN, file_name="2025-03-02_x.csv"))
    assert cells.tolist() == [b"2025-03-02T23:59:59.500000", b"2025-03-03T00:00:00.500000"]


def test_a_local_clock_without_a_zone_is_asked_for() -> None:
    for reader, data in (
        ("drive_test", samples.FILES["drive_test/nemo"]),
        ("srsue_log", samples.FILES["srsue_log/console"]),
        ("pose_csv", samples.FILES["pose_csv/dji"]),
    ):
        with pytest.raises(UsageError, match="timezone:"):
            read(reader, data, replace(OPTIONS, timezone=None, time_origin=None))
