"""Damaged logs of autopilots, and other libraries on the same bytes. Their poses are in test_truth.py."""

import struct

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.logs.readers import ReadOptions, by_name
from tests.parsers import autopilots
from tests.parsers.autopilots import COUNT

LOGS = {"ardupilot_bin": autopilots.dataflash(), "mavlink_tlog": autopilots.tlog(2), "px4_ulog": autopilots.ulog()}


def test_damage_costs_a_message_and_not_the_log() -> None:
    data = bytearray(LOGS["mavlink_tlog"])
    data[30] ^= 0xFF  # inside the first position: its checksum no longer fits
    result = by_name("mavlink_tlog").read(bytes(data), ReadOptions())
    assert result.accepted == COUNT - 1
    assert len(result.rejected) == 1
    torn = by_name("ardupilot_bin").read(LOGS["ardupilot_bin"][:-7], ReadOptions())
    assert (torn.accepted, len(torn.rejected)) == (COUNT, 1)
    hole = LOGS["ardupilot_bin"].replace(struct.pack("<i", 357_300_002), b"", 1)
    assert len(by_name("ardupilot_bin").read(hole, ReadOptions()).rejected) >= 1


def test_a_home_without_an_altitude_is_no_home() -> None:
    """Its message is there, and the field of its altitude has another name."""
    nameless = LOGS["px4_ulog"].replace(
        b"home_position:uint64_t timestamp;float alt;", b"home_position:uint64_t timestamp;float alx;"
    )
    result = by_name("px4_ulog").read(nameless, ReadOptions())
    assert result.accepted == COUNT
    assert any("no home is known" in text for text in result.warnings)


def test_without_utc_the_times_are_relative() -> None:
    silent = LOGS["px4_ulog"].replace(b"time_utc_usec", b"time_xxx_usec")
    result = by_name("px4_ulog").read(silent, ReadOptions())
    assert result.streams[0].attributes["clock"] == "relative"
    given = by_name("px4_ulog").read(silent, ReadOptions(time_origin="2025-03-02T15:00:00Z"))
    assert given.streams[0].frame["time"][0] == pd.Timestamp("2025-03-02T15:00:30")


def test_pymavlink_reads_the_same_dataflash_log(tmp_path: object) -> None:
    dfreader = pytest.importorskip("pymavlink.DFReader")
    path = f"{tmp_path}/flight.bin"
    with open(path, "wb") as file:  # noqa: PTH123
        file.write(LOGS["ardupilot_bin"])
    log = dfreader.DFReader_binary(path, zero_time_base=False)
    rows = []
    while (message := log.recv_match(type="POS")) is not None:
        rows.append((message.Lat, message.Lng, message.RelHomeAlt))
    log.data_map.close()
    log.filehandle.close()
    frame = by_name("ardupilot_bin").read(LOGS["ardupilot_bin"], ReadOptions()).streams[0].frame
    assert np.allclose(frame[["latitude_deg", "longitude_deg", "altitude_m"]].to_numpy(), rows, atol=1e-9)


def test_pyulog_reads_the_same_px4_log(tmp_path: object) -> None:
    pyulog = pytest.importorskip("pyulog")
    path = f"{tmp_path}/flight.ulg"
    with open(path, "wb") as file:  # noqa: PTH123
        file.write(LOGS["px4_ulog"])
    place = pyulog.ULog(path).get_dataset("vehicle_global_position").data
    frame = by_name("px4_ulog").read(LOGS["px4_ulog"], ReadOptions()).streams[0].frame
    assert np.array_equal(frame["latitude_deg"].to_numpy(), place["lat"])
    assert np.array_equal(frame["longitude_deg"].to_numpy(), place["lon"])


@pytest.mark.parametrize("columns", ["TimeUS,Lat", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt,More"])
def test_a_message_described_anew_keeps_what_was_read_before(columns: str) -> None:
    """The earlier rows were written with the first description.

    The names of the second description must not be applied to their values.
    """
    form = "QL" if columns.count(",") == 1 else "QLLffff"
    size = 3 + struct.calcsize("<" + {"QL": "Qi", "QLLffff": "Qiiffff"}[form])
    anew = struct.pack("<BB4s16s64s", 129, size, b"POS", form.encode(), columns.encode())
    before = by_name("ardupilot_bin").read(LOGS["ardupilot_bin"], ReadOptions()).streams[0].frame
    data = LOGS["ardupilot_bin"] + b"\xa3\x95\x80" + anew
    after = by_name("ardupilot_bin").read(data, ReadOptions()).streams[0].frame
    pd.testing.assert_frame_equal(after, before)


def test_a_message_of_an_unknown_kind_of_value_is_left_unread() -> None:
    """A format with an unknown letter among letters that make up the complete length."""
    names = b"TimeUS,Lat,More,Lng,Alt"
    described = struct.pack("<BB4s16s64s", 129, 3 + struct.calcsize("<Qiif"), b"POS", b"QL?Lf", names)
    row = b"\xa3\x95\x81" + struct.pack("<Qiif", 1_000_000, 357_275_000, -786_960_000, 30.0)
    before = by_name("ardupilot_bin").read(LOGS["ardupilot_bin"], ReadOptions())
    after = by_name("ardupilot_bin").read(LOGS["ardupilot_bin"] + b"\xa3\x95\x80" + described + row, ReadOptions())
    pd.testing.assert_frame_equal(after.streams[0].frame, before.streams[0].frame)
    assert (after.lines, after.rejected) == (before.lines + 2, before.rejected)


@pytest.mark.parametrize(("north_deg", "apart"), [(4e-4, True), (4e-5, False)])
def test_a_filter_far_from_the_receiver_of_its_log_is_reported(north_deg: float, apart: bool) -> None:
    """POS is 40 m (4 m) north of GPS, which the same log contains."""
    moved = struct.pack("<i", round(357_300_000 + north_deg * 1e7))
    data = LOGS["ardupilot_bin"]
    for i in range(COUNT):
        place = struct.pack("<ii", 357_300_000 + i, -787_000_000 - i)
        first = data.index(place)  # POS comes before GPS
        data = data[:first] + moved + data[first + 4 :]
    warnings = by_name("ardupilot_bin").read(data, ReadOptions()).warnings
    assert any("5 of 5 positions are 44 m (median) from those of the receiver" in text for text in warnings) is apart
