"""Run the readers on real logs, and skip the tests with a message if AERPAW_CMP_FIELD_DATA is not set."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from aerpaw_cmp.logs.ingest import Ingested, ingest
from aerpaw_cmp.logs.limits import LIMITS, UNSCORED
from aerpaw_cmp.logs.readers import ReadOptions, by_name
from tests.real_logs import REAL

pytestmark = pytest.mark.field
OPTIONS = ReadOptions(timezone="America/New_York")


def test_every_known_log_is_read_to_the_last_line(field_logs: Ingested) -> None:
    results = {str(Path(file.path).relative_to(REAL)): file.result for file in field_logs}
    expected = {
        "telemetry/2022-01-13_13_57_23_vehicleOut.txt": ("vehicle_out", 1089, 0),
        "telemetry/2022-06-10_19_52_44_vehicleOut.txt": ("vehicle_out", 1662, 0),
        "telemetry/2024-07-02_flight3_vehicleOut.txt": ("vehicle_out", 1006, 0),
        "telemetry/2025-05-24_vehicleOut.txt": ("vehicle_out", 404, 0),
        "sounder/2023-12-13_12_33_02_power_log.txt": ("sounder_log", 21716, 0),
        "sounder/results_useful_ori_exp_288_loc_1.mat": ("flight_mat", 20523, 0),
        "dataset12/40m_fs10MHz.mat": ("flight_mat", 3304, 0),
        "dataset12/70m_fs20MHz.mat": ("flight_mat", 3503, 0),
        "nr_rank/july2_2024_flight1_nemo_nr.csv": ("nemo_csv", 1911, 0),
        "nr_rank/july2_2024_flight3_nemo_nr.csv": ("nemo_csv", 1999, 0),
        "nr_rank/flight3_pdsch_rank.kml.gz": ("nemo_kml", 1983, 0),
        "modem/derived/Basic_and_Other_Params.csv": ("quectel_csv", 3, 0),
        "modem/derived/Serving_cell_Params_ENDC.csv": ("quectel_csv", 2, 0),
        "modem/derived/Serving_cell_Params_LTE_only.csv": ("quectel_csv", 2, 0),
        "srsran/2022-06-10_19_52_35_radio_enb_log.txt": ("srsenb_log", 1690, 0),
        "srsran/2022-12-01_12-27-19_two_ports_radio_enb_log.txt": ("srsenb_log", 1611, 0),
        "aadm/snr_log.csv": ("aadm_snr", 331, 0),
    }
    for path, account in expected.items():
        result = results[path]
        assert (result.reader, result.accepted, len(result.rejected)) == account, path


def test_two_ports_of_srsenb_report_rank_two(field_logs: Ingested) -> None:
    """`int(dl_ri)` is 0 without a report and never above the two ports that the console says it opened."""
    (file,) = (f for f in field_logs if "two_ports" in f.path)
    (stream,) = file.result.streams
    rank = stream.frame["rank"]
    assert ((rank == 2).sum(), (rank == 1).sum(), rank.isna().sum()) == (1277, 3, 331)
    assert stream.attributes["ports"] == 2
    assert not stream.frame["flag"].str.contains("rank_above_ports").any()


def test_no_real_value_is_beyond_the_limits(field_logs: Ingested) -> None:
    """Limits flag what cannot be: nothing in the real logs but placeholders of G-NetTrack (-164 and -24 dBm)."""
    flags = {w for file in field_logs for s in file.result.streams for t in s.frame["flag"] for w in t.split(";")}
    assert flags & {*LIMITS, *UNSCORED} == {"level_lost"}


def test_other_files_are_not_taken_for_logs(field_logs: Ingested) -> None:
    skipped = {str(Path(file.path).relative_to(REAL)) for file in field_logs.skipped}
    assert {"telemetry/AERPAW_Big_Geofence.kml", "antennas/rad_pat.mat", "sounder/rover_positions.txt"} <= skipped
    (ue,) = [file for file in field_logs if file.path.endswith("2022-06-10_19_52_44_radio_log.txt")]
    assert {stream.kind for stream in ue.result.streams} == {"rss", "kpi"}, "srsUE prints no rank"


def test_the_power_log_holds_the_merged_flight_exactly() -> None:
    """Two independent routes to 20 523 levels: our reader of the raw log, the authors' own merge."""
    folder = REAL / "sounder"
    (log,) = ingest(folder / "2023-12-13_12_33_02_power_log.txt", options=OPTIONS)
    (mat,) = ingest(folder / "results_useful_ori_exp_288_loc_1.mat", options=OPTIONS)
    raw = log.result.streams[0].frame.set_index("time")["rss_db"]
    merged = next(stream for stream in mat.result.streams if stream.name == "power").frame
    joined = raw.reindex(merged["time"])
    assert len(merged) == 20_523
    table = scipy.io.loadmat(folder / "results_useful_ori_exp_288_loc_1.mat")
    assert np.array_equal(joined.to_numpy(), table["mpower"].ravel()), "bit for bit"
    assert np.array_equal(merged["rss_db"].to_numpy(), table["mpower"].ravel())


@pytest.mark.parametrize("flight", ["40m_fs10MHz.mat", "70m_fs20MHz.mat"])
def test_velocity_of_merged_flights_is_north_east_down(flight: str) -> None:
    (file,) = ingest(REAL / "dataset12" / flight, options=OPTIONS)
    frame = file.result.streams[0].frame
    seconds = frame["time"].to_numpy().astype(np.int64) / 1e9
    for position, velocity, sign in (
        ("latitude_deg", "velocity_north_mps", 1),
        ("longitude_deg", "velocity_east_mps", 1),
        ("altitude_m", "velocity_down_mps", -1),
    ):
        rate = np.gradient(frame[position].to_numpy(), seconds)
        assert sign * np.corrcoef(rate, frame[velocity])[0, 1] > 0.95
    assert file.result.streams[1].attributes["channel"] == "USRP1"


def test_vehicle_out_velocity_and_attitude() -> None:
    (file,) = ingest(REAL / "telemetry" / "2024-07-02_flight3_vehicleOut.txt", options=OPTIONS)
    frame = file.result.streams[0].frame
    seconds = frame["time"].to_numpy().astype(np.int64) / 1e9
    east = np.gradient(frame["longitude_deg"].to_numpy(), seconds)
    assert np.corrcoef(east, frame["velocity_east_mps"])[0, 1] > 0.95
    yaw = np.radians(frame["yaw_deg"])
    forward = frame["velocity_north_mps"] * np.cos(yaw) + frame["velocity_east_mps"] * np.sin(yaw)
    right = -frame["velocity_north_mps"] * np.sin(yaw) + frame["velocity_east_mps"] * np.cos(yaw)
    assert np.corrcoef(forward, frame["pitch_deg"])[0, 1] < -0.3, "flying forward puts the nose down"
    assert np.corrcoef(right, frame["roll_deg"])[0, 1] > 0.3, "flying right puts the right wing down"


def test_the_two_nemo_formats_tell_the_same_ranks() -> None:
    (table,) = ingest(REAL / "nr_rank" / "july2_2024_flight3_nemo_nr.csv")
    (kml,) = ingest(REAL / "nr_rank" / "flight3_pdsch_rank.kml.gz")
    ranks = table.result.streams[0].frame.dropna(subset="rank")
    places_of_kml = kml.result.streams[0].frame
    assert ranks["rank"].tolist() == places_of_kml["rank"].tolist()
    assert set(ranks["rank"]) == {1.0, 2.0, 3.0, 4.0}
    # a place belongs to a time in both; which time a rank belongs to differs by some four seconds between
    # the two exports (the table's times start again after nine rows), so nothing is claimed about that
    places = ranks.drop_duplicates("time").set_index("time")["latitude_deg"]
    others = places_of_kml.set_index("time")["latitude_deg"]
    both = places.index.intersection(others.index)
    assert len(both) > 1900
    assert (places[both] == others[both]).all()
    assert any("steps back" in text for text in table.result.warnings)


def test_controller_console_and_its_csv_agree() -> None:
    console, table = ingest([REAL / "aadm" / "controller_log.txt", REAL / "aadm" / "snr_log.csv"], options=OPTIONS)
    spoken = next(stream for stream in console.result.streams if stream.name == "LW1").frame["rss_db"]
    written = next(stream for stream in table.result.streams if stream.name == "LW1").frame["rss_db"]
    assert spoken.between(written.min() - 5, written.max() + 5).mean() > 0.9


@pytest.mark.parametrize("name", ["2023-12-13_12_31_07_power_log.txt"])
def test_real_logs_cut_at_every_byte_of_their_end(name: str) -> None:
    data = (REAL / "sounder" / name).read_bytes()
    for end in range(len(data) - 120, len(data)):
        result = by_name("sounder_log").read(data[:end], OPTIONS)
        assert result.lines == result.accepted + len(result.rejected) + result.blank


def _numbers(path: str, wanted: str, separator: str) -> int:
    """Numeric cells of the columns whose names a pattern finds, counted by Python's csv module."""
    with (REAL / path).open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.reader(file, delimiter=separator))
    head = next(i for i, row in enumerate(rows) if len(row) > 10)
    columns = [i for i, name in enumerate(rows[head]) if re.search(wanted, name)]
    cells = [row[i].strip() for row in rows[head + 1 :] if len(row) > 10 for i in columns]
    return sum(re.fullmatch(r"-?[0-9.,]+", cell) is not None for cell in cells)


def _json_cells(path: str) -> int:
    """Levels of all cells and NR legs of a PawPrints session."""
    count = 0
    for line in (REAL / path).read_text().splitlines():
        entry = json.loads(line)
        for leg in [*entry.get("cells", []), entry.get("nr_signal_strength") or {}]:
            count += re.fullmatch(r"-\d+", str(leg.get("rsrp", leg.get("ss_rsrp")))) is not None
    return count


READINGS = {
    "urban_lte/120m.csv": lambda path: _numbers(path, "^RSRP", ","),
    "urban_lte/60m.csv": lambda path: _numbers(path, "^RSRP", ","),
    "gnettrack/Orange_log.txt": lambda path: len(re.findall(r"\t4G\t-\d+\t", (REAL / path).read_text())),
    "pawprints/2023-08-26_test2_log.txt": lambda path: (REAL / path).read_text().count("BS_INFO_START"),
    "pawprints/2024-04-09_flight1_pawprints.jsonl": _json_cells,
    "pawprints/2024-07-02_flight1_pawprints.jsonl": _json_cells,
}


@pytest.mark.parametrize("path", READINGS)
def test_every_reading_of_the_file_is_a_record(field_logs: Ingested, path: str) -> None:
    """Levels of cells, counted by other means."""
    (file,) = [file for file in field_logs if file.path.endswith(path)]
    levels = [s for s in file.result.streams if s.attributes.get("quantity") == "RSRP"]
    assert sum(len(stream.frame) for stream in levels) == READINGS[path](path) > 60


def test_clocks_and_heights_of_the_new_dialects(field_logs: Ingested) -> None:
    files = {str(Path(file.path).relative_to(REAL)): file.result for file in field_logs}
    merged = files["aadm/vehicleOut_snr_merged.csv"].streams[0]
    assert merged.frame["altitude_m"][0] == pytest.approx(24.3002636, abs=1e-6), "above take-off, begun in the air"
    assert merged.attributes["height_from"] == "program"
    nemo = files["nemo/24Feb09_172055.zip/24Feb09_172055.1.gpx"].streams[0]
    assert str(nemo.frame["time"][0]) == "2024-02-09 22:20:56.086000", "17:20:56 in New York, as name and summary say"
    assert nemo.attributes["clock_from"] == "assumed"
    emulator = files["emulator/vehicleOut_lw1_snr_merged.csv"].streams[0].frame
    assert float((emulator["time"].iloc[-1] - emulator["time"][0]).total_seconds()) == pytest.approx(2.614)
    assert files["emulator/lw1_snr.txt"].streams[0].attributes["quantity"] == "SNR"
