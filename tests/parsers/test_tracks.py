"""Tracks of receivers and drones: the same positions as other libraries read, and the levels of a telemetry radio."""

from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions, by_name
from tests.parsers import autopilots
from tests.parsers.samples import FILES

NEW_YORK = ReadOptions(timezone="America/New_York")


def sentence(body: str) -> str:
    total = 0
    for letter in body:
        total ^= ord(letter)
    return f"${body}*{total:02X}\n"


def test_pynmea2_reads_the_same_sentences() -> None:
    pynmea2 = pytest.importorskip("pynmea2")
    log = "".join(
        sentence(
            f"GPGGA,1500{i:02d}.50,{3543.8 + 0.013 * i:.4f},S,{7842.0 - 0.7 * i:010.4f},E,2,09,1.1,{90 + i}.5,M,,M,,"
        )
        for i in range(30)
    )
    peers = [pynmea2.parse(line) for line in log.splitlines()]
    options = ReadOptions(time_origin="2025-03-02T00:00:00Z")
    (track,) = by_name("nmea").read(log.encode(), options).streams
    assert np.allclose(track.frame["latitude_deg"], [peer.latitude for peer in peers], rtol=0, atol=1e-9)
    assert np.allclose(track.frame["longitude_deg"], [peer.longitude for peer in peers], rtol=0, atol=1e-9)
    assert np.allclose(track.frame["altitude_m"], [peer.altitude - peers[0].altitude for peer in peers])
    assert [time.time() for time in track.frame["time"]] == [peer.timestamp.replace(tzinfo=None) for peer in peers]


@pytest.mark.parametrize("first", ["GGA", "RMC"])
def test_a_midnight_of_nmea_has_the_date_of_its_own_day(first: str) -> None:
    """The date is in another sentence than the height: before or behind it."""
    log = ""
    for clock, date in (("235959.00", "010325"), ("000000.00", "020325"), ("000001.00", "020325")):
        both = {
            "GGA": sentence(f"GNGGA,{clock},3543.8,N,07842.0,W,1,12,0.9,76.5,M,,M,,"),
            "RMC": sentence(f"GNRMC,{clock},A,3543.8,N,07842.0,W,0.1,0.0,{date},,,A"),
        }
        log += both.pop(first) + both.popitem()[1]
    (track,) = by_name("nmea").read(log.encode(), NEW_YORK).streams
    assert [str(time) for time in track.frame["time"]] == [
        "2025-03-01 23:59:59", "2025-03-02 00:00:00", "2025-03-02 00:00:01",
    ]  # fmt: skip


def test_positions_of_gns_sentences_through_a_stamp_are_read() -> None:
    """A cut sentence is rejected; the logger's own time is not read."""
    stamp = "[2025-03-02 11:00:00] "
    log = stamp + sentence("GNRMC,150000.00,A,3543.8,N,07842.0,W,0.1,0.0,020325,,,A")
    for i, mode in enumerate(("AA", "RR")):
        log += stamp + sentence(f"GNGNS,15000{i}.00,3543.8,N,07842.0,W,{mode},12,0.9,{70 + i}.5,-32.0,,")
    result = by_name("nmea").read((log + stamp + "$GNGNS,150002.00,3543").encode(), NEW_YORK)
    frame = result.streams[0].frame
    assert (result.accepted, result.rejected_count, result.blank) == (2, 1, 1)
    assert [str(time) for time in frame["time"]] == ["2025-03-02 15:00:00", "2025-03-02 15:00:01"]
    assert (frame["altitude_m"].tolist(), frame["fix"].tolist()) == ([0.0, 1.0], [3, 6])


def test_nmea_rows_without_a_fix_have_no_position() -> None:
    log = sentence("GPGGA,145959.00,,,,,0,00,99.9,,,,,,") + FILES["nmea/gga"].decode()
    result = by_name("nmea").read(log.encode(), NEW_YORK)
    assert (result.accepted, result.streams[0].rows) == (2, 2)


def test_gpxpy_reads_the_same_points() -> None:
    gpxpy = pytest.importorskip("gpxpy")
    text = FILES["gpx/track"].decode()
    peers = [point for track in gpxpy.parse(text).tracks for part in track.segments for point in part.points]
    timed = [point for point in peers if point.time is not None]
    frame = by_name("gpx").read(text.encode(), ReadOptions()).streams[0].frame
    assert len(timed) == 2
    assert np.array_equal(frame["latitude_deg"], [point.latitude for point in timed])
    assert np.array_equal(frame["longitude_deg"], [point.longitude for point in timed])
    assert [time.to_pydatetime() for time in frame["time"]] == [point.time.replace(tzinfo=None) for point in timed]
    assert np.allclose(frame["altitude_m"], [point.elevation - timed[0].elevation for point in timed])


def test_a_gpx_without_times_is_no_aborted_run(tmp_path: Path) -> None:
    (tmp_path / "a.gpx").write_text('<gpx><trk><trkseg><trkpt lat="35.7" lon="-78.7"></trkpt></trkseg></trk></gpx>\n')
    with pytest.raises(InputError, match="a GPX track without times"):
        ingest(tmp_path / "a.gpx")


def test_an_rtklib_baseline_is_refused_with_the_option_that_makes_it_readable() -> None:
    data = (
        b"%  GPST   e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns\n2025/03/02 15:00:18.0  1.0  2.0  3.0  1  12\n"
    )
    with pytest.raises(InputError, match=r"e-baseline.*out-solformat"):
        by_name("rtklib_pos").read(data, ReadOptions())


def test_levels_of_a_telemetry_radio_are_those_of_its_scale() -> None:
    """133 steps of 1/1.9 dB from -127 dBm are -57 dBm; 255 is no value."""
    result = by_name("ardupilot_bin").read(autopilots.dataflash(radio=True), ReadOptions())
    streams = {stream.name: stream for stream in result.streams}
    assert result.accepted == 2 * autopilots.COUNT
    assert np.allclose(streams["radio"].frame["rss_db"], -57.0 - np.arange(5) / 1.9)
    assert np.allclose(streams["radio_remote"].frame["rss_db"], [-47.0] * 4)
    assert streams["radio"].attributes["unit"] == "dBm"
    assert np.allclose(streams["radio_noise"].frame["value"], -107.0)
    seconds = (streams["radio"].frame["time"] - streams["vehicle"].frame["time"]).dt.total_seconds()
    assert np.allclose(seconds, 0.2)
