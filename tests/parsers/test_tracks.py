"""Tracks of receivers and drones: the same positions as other libraries read, and the levels of a telemetry radio."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from aerpaw_cmp import open_flight, read
from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.jobs.run import run_ingest
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
    """A truncated sentence is rejected. The logger's own time is not read."""
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


def test_an_rtklib_baseline_is_refused_with_the_option_that_makes_it_readable() -> None:
    data = (
        b"%  GPST   e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns\n2025/03/02 15:00:18.0  1.0  2.0  3.0  1  12\n"
    )
    with pytest.raises(InputError, match=r"e-baseline.*out-solformat"):
        by_name("rtklib_pos").read(data, ReadOptions())


def test_levels_of_a_telemetry_radio_are_those_of_its_scale() -> None:
    """133 steps of 1/1.9 dB from -127 dBm are -57 dBm. 255 is a missing value."""
    result = by_name("ardupilot_bin").read(autopilots.dataflash(radio=True), ReadOptions())
    streams = {stream.name: stream for stream in result.streams}
    assert result.accepted == 2 * autopilots.COUNT
    assert np.allclose(streams["radio"].frame["rss_db"], -57.0 - np.arange(5) / 1.9)
    assert np.allclose(streams["radio_remote"].frame["rss_db"], [-47.0] * 4)
    assert streams["radio"].attributes["unit"] == "dBm"
    seconds = (streams["radio"].frame["time"] - streams["vehicle"].frame["time"]).dt.total_seconds()
    assert np.allclose(seconds, 0.2)


def recording(folder: Path, samples: np.ndarray, kind: str, **captures: object) -> list[str]:
    """Warnings of a SigMF recording of one second."""
    meta = {
        "global": {"core:datatype": kind, "core:sample_rate": len(samples)},
        "captures": [{"core:sample_start": 0, "core:datetime": "2025-06-01T14:00:00Z", **captures}],
    }
    (folder / "a.sigmf-meta").write_text(json.dumps(meta))
    samples.tofile(folder / "a.sigmf-data")
    (file,) = ingest(folder / "a.sigmf-meta")
    return list(file.result.warnings)


def test_clipping_and_dc_of_a_recording_are_reported(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    noise = rng.normal(size=(5000, 2))
    clipped = np.clip(np.round(noise * 32767), -32768, 32767).astype("<i2")
    share = f"{(np.abs(noise) >= 0.999).mean():.1%} of the values are at full scale"  # some 32 %
    assert any(share in text for text in recording(tmp_path, clipped, "ci16_le"))
    assert not recording(tmp_path, np.round(noise * 6000).astype("<i2"), "ci16_le")
    assert not recording(tmp_path, (noise * 500).astype("<f4"), "cf32_le")  # floats of another scale
    offset = (0.001 * noise + [0.05, 0.0]).astype("<f4")  # 0.05^2 over 2 x 0.001^2: 31 dB
    assert any("a DC part 31 dB above the rest" in text for text in recording(tmp_path, offset, "cf32_le"))
    carrier = (noise + np.array([1.8, 0.0])).astype("<f4")  # 1.8^2 over 2: 2 dB, which the signal itself may have
    assert not recording(tmp_path, carrier, "cf32_le")


def test_a_position_per_capture_is_a_track_and_one_for_all_is_not(tmp_path: Path) -> None:
    places = [{"type": "Point", "coordinates": [-78.696, 35.7275 + i / 1000, 150.0 + i]} for i in range(2)]
    meta: dict[str, Any] = {
        "global": {"core:datatype": "ru8", "core:sample_rate": 1000},
        "captures": [
            {"core:sample_start": 500 * i, "core:datetime": f"2025-06-01T14:00:0{i}Z", "core:geolocation": places[i]}
            for i in range(2)
        ],
    }
    (tmp_path / "a.sigmf-meta").write_text(json.dumps(meta))
    (tmp_path / "a.sigmf-data").write_bytes(bytes(range(100, 150)) * 20)
    (file,) = ingest(tmp_path / "a.sigmf-meta")
    (track,) = [stream for stream in file.result.streams if stream.kind == "telemetry"]
    assert track.frame["latitude_deg"].tolist() == [35.7275, 35.7285]
    assert track.frame["altitude_m"].tolist() == [0.0, 1.0]
    meta["global"]["core:geolocation"] = places[0]
    for capture in meta["captures"]:
        del capture["core:geolocation"]
    (tmp_path / "a.sigmf-meta").write_text(json.dumps(meta))
    (file,) = ingest(tmp_path / "a.sigmf-meta")
    assert [stream.kind for stream in file.result.streams] == ["rss"]


def test_an_autopilots_telemetry_radio_is_no_tower_beside_levels_of_the_experiment(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(autopilots.dataflash(20, radio=True))
    line = "[2025-03-02 10:00:{:02d}.250000] {:07o} {:15.4f}\n"
    power = "".join(line.format(i, 4 * i, -40.0 - i) for i in range(20))
    (tmp_path / "LW1").mkdir()
    (tmp_path / "LW1" / "power_log.txt").write_text(power)
    run_ingest([tmp_path], draft=tmp_path / "flight.yaml", timezone="America/New_York")
    settings = yaml.safe_load((tmp_path / "flight.yaml").read_text())
    (autopilot,) = [log for log in settings["logs"] if log["path"] == "a.bin"]
    assert autopilot == {"path": "a.bin", "reader": "ardupilot_bin", "skip": ["radio", "radio_remote"]}
    text = (tmp_path / "flight.yaml").read_text().replace(", skip: [radio, radio_remote]", "")
    (tmp_path / "old.yaml").write_text(text)  # a flight file of before, whose autopilot logged the radio, too
    assert open_flight(tmp_path / "old.yaml").rss["tower"].unique().tolist() == ["LW1"]


def test_a_fix_type_of_one_has_no_position(tmp_path: Path) -> None:
    """MAVLink's fix type 1 means no fix. The NMEA quality 1 means a fix."""
    rows = [f"2025-06-11T14:30:{i:02d}Z,{1 if i < 3 else 3},35.7{i:04d},-78.6960,{30 + i}" for i in range(10)]
    for name, positions in (("fix_type", 7), ("GPS quality", 10)):
        (tmp_path / "log.csv").write_text("\n".join([f"utc,{name},lat,lon,alt_agl_m", *rows]) + "\n")
        (frame,) = read(tmp_path / "log.csv").values()
        assert frame["latitude_deg"].notna().sum() == positions
