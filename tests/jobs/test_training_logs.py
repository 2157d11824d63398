"""Learned models are not scored on their training logs, for any name or archive of the log."""

import bz2
import dataclasses
import gzip
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

import aerpaw_cmp as ac
from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common import content as provenance
from aerpaw_cmp.common.content import trained_on
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.gains import load_with_learned
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.flight.training import counted_once, flight_logs, learned_here, marks_of
from aerpaw_cmp.jobs.calibrate import CalibrationFile
from aerpaw_cmp.jobs.calibrate_rank import FittedReceiver, RankCalibration, RankSamples, rank_samples, read_receiver
from aerpaw_cmp.jobs.calibration_files import Calibrated, write_files
from aerpaw_cmp.jobs.diff_reports import run_diff
from aerpaw_cmp.site.learned import folder_of
from tests.jobs.calibrated import calibrated, past_sector_antenna, settings
from tests.real_logs import REAL
from tests.simulated import write_yaml

pytestmark = pytest.mark.usefixtures("few_pictures")

LOG = "first/LW1_USRP1.txt"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two flights that antennas were learned from, and a third flight that was not used."""
    place = past_sector_antenna(tmp_path_factory.mktemp("training"))
    assert main(["calibrate", str(place / "calibration.yaml"), "-o", str(place / "calibrated.yaml")]) == 0
    return place


def renamed(source: Path) -> str:
    shutil.copy(source, source.with_name("other_name.txt"))
    return "first/other_name.txt"


def gzipped(source: Path) -> str:
    source.with_name("g.gz").write_bytes(gzip.compress(source.read_bytes()))
    return "first/g.gz"


def zipped_twice(source: Path) -> str:
    with zipfile.ZipFile(source.with_name("z.zip"), "w", zipfile.ZIP_DEFLATED) as book:
        book.writestr("deep/down/log.bz2", bz2.compress(source.read_bytes()))
    return "first/z.zip/deep/down/log.bz2"


def ingested(source: Path) -> str:
    target = source.with_name("flight.h5")
    packed = source.parent / gzipped(source).split("/")[1]
    assert main(["ingest", str(packed), "-o", str(target), "--force", "--timezone", "America/New_York"]) == 0
    return "first/flight.h5"


COPIES = [renamed, gzipped, zipped_twice, ingested]


def copy_of(folder: Path, copy: Callable[[Path], str], **rest: Any) -> Path:
    """A flight of another name whose log is a copy of the first flight's."""
    content = settings("first", {"model": "iso"}, **rest)
    content["flight"]["name"] = "nobody_knows_me"
    content["flight"].pop("plan")
    content["logs"][1]["path"] = copy(folder / LOG)
    return write_yaml(folder / f"copy_{copy.__name__}.yaml", content)


def report(folder: Path, flight: Path) -> tuple[dict[str, Any], str]:
    """Numbers of a report, and its first sentences."""
    assert main(["report", str(flight), "-o", str(folder / "out"), "--audit", "none", "--figures", "none"]) == 0
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    begin = page.index(">", page.index('class="verdict"')) + 1
    return json.loads((folder / "out" / "metrics.json").read_text()), page[begin : page.index("</p>", begin)]


def test_every_learned_file_names_the_logs_by_content(folder: Path) -> None:
    flights = [load_data(load_flight(folder / f"{name}.yaml"), folder) for name in ("first", "second")]
    logs = {digest for data in flights for digest in flight_logs(data)}
    assert len(logs) == 2
    own = set(marks_of(flights))
    assert len(own) == 2
    place = folder / "calibrated"
    files = [folder / "calibrated.yaml", *place.glob("LW1*.csv"), *place.glob("*.msi"), place / "metrics.json"]
    assert len(files) == 7
    for file in files:
        text = file.read_text(encoding="utf-8")
        assert set(trained_on(text)) == logs, file
        assert set(provenance.marks(text)) == own, file


@pytest.mark.parametrize("copy", COPIES)
def test_a_copy_of_a_training_log_is_not_scored(folder: Path, copy: Callable[[Path], str]) -> None:
    learned = yaml.safe_load((folder / "calibrated.yaml").read_text())
    metrics, words = report(folder, copy_of(folder, copy, link=learned["link"]))
    assert words.startswith("Training flight: the antennas of LW1 USRP1 were learned from this flight")
    here = metrics["rss"]["LW1"]["USRP1"]
    assert [here[key] for key in ("rmse_db", "correlation", "rmse_ci95_db")] == [None, None, [None, None]]
    assert (here["compared_with"], here["averaged"]) == ({}, {})
    assert len(here["trained_on"]) == 1
    assert set(here["trained_on"]) < set(metrics["trained_on"])
    assert here["baselines"]["free_space"]["rmse_db"] > 1  # nothing of it was learned
    inputs = [entry for entry in metrics["inputs"] if entry.get("learned_on")]
    assert {Path(entry["path"]).suffix for entry in inputs} == {".csv"}
    rungs = [row for row in metrics["ladder"] if "learned" in row["model"]]
    assert len(rungs) >= 2
    assert all(row["rmse_heldout_db"] is None and not row["recommended"] for row in rungs)


def test_no_residual_and_no_difference_of_a_training_flight(folder: Path) -> None:
    """rss.csv lists no residual of the learned model, and two such reports are not compared by their errors."""
    learned = yaml.safe_load((folder / "calibrated.yaml").read_text())
    places = []
    for depth in (0, 1):
        flight = copy_of(folder, renamed, link=learned["link"], rt={"max_depth": depth})
        places.append(folder / f"diff{depth}")
        assert main(["report", str(flight), "-o", str(places[-1]), "--audit", "none", "--figures", "none"]) == 0
        table = pd.read_csv(places[-1] / "rss.csv", comment="#")
        assert len(table) > 100
        assert table["residual_db"].isna().all()
    difference = run_diff(*places)
    assert difference.levels == ()
    assert difference.pooled is None
    assert sum("learned from this flight's own log" in text for text in difference.remarks) == 2


def retyped(source: Path, target: Path, decimals: int = 2) -> None:
    """A pattern's numbers alone, no word on where they come from, 1 dB weaker, rounded."""
    lines = [line for line in source.read_text().splitlines() if not line.startswith(("#", "COMMENT"))]
    if source.suffix == ".msi":
        lines[2] = f"GAIN {float(lines[2].split()[1]) - 1.0:.2f} dBi"
        lines = [f"{a} {float(b):.{decimals}f}" if (a := line.split()[0]).isdigit() and (b := line.split()[1]) else line
                 for line in lines]  # fmt: skip
    target.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("how", ["as written", "without comments", "one decimal", "a table without comments"])
def test_an_export_of_learned_antennas_is_not_scored_on_its_training_log(folder: Path, how: str) -> None:
    """MSI files of a calibration, and copies of its files that name no log, known by their numbers."""
    place = folder / "calibrated"
    ends = {}
    for end in ("tower", "uav"):
        # no sphere results from cuts next to the lobe of the tower's antenna: such a copy is refused
        sphere = how.startswith("a table") or (how != "as written" and end == "tower")
        source = place / f"LW1.USRP1.{end}{'.csv' if sphere else '.msi'}"
        target = source if how == "as written" else folder / f"mine_{how.replace(' ', '_')}_{end}{source.suffix}"
        if target != source:
            retyped(source, target, 1 if how == "one decimal" else 2)
        ends[end] = {"antenna": {"model": "sphere" if sphere else "file", "file": str(target)}}
    link = {"channels": {"USRP1": {"carrier_hz": 3.3e9, **ends}}}
    metrics, words = report(folder, copy_of(folder, renamed, link=link))
    assert words.startswith("Training flight: the antennas of LW1 USRP1 were learned from this flight")
    assert metrics["rss"]["LW1"]["USRP1"]["rmse_db"] is None
    metrics, words = report(folder, write_yaml(folder / "u.yaml", settings("aside", {"model": "iso"}, link=link)))
    assert "Training flight" not in words
    assert metrics["rss"]["LW1"]["USRP1"]["rmse_db"] > 0


def test_an_unseen_flight_is_scored_with_the_same_antennas(folder: Path) -> None:
    learned = yaml.safe_load((folder / "calibrated.yaml").read_text())
    metrics, words = report(
        folder, write_yaml(folder / "u.yaml", settings("aside", {"model": "iso"}, link=learned["link"]))
    )
    assert "Training flight" not in words
    assert metrics["rss"]["LW1"]["USRP1"]["rmse_db"] > 0
    assert "trained_on" not in metrics["rss"]["LW1"]["USRP1"]
    assert len(metrics["trained_on"]) == 2


def test_settings_that_were_learned_count_as_antennas_do(folder: Path) -> None:
    """Fitted numbers in a flight file (a mount, a reflection loss) have no file that could say where they come from."""
    own = settings("first", {"model": "iso"}, trained_on=list(trained_on((folder / "calibrated.yaml").read_text())))
    metrics, words = report(folder, write_yaml(folder / "own.yaml", own))
    assert words.startswith("Training flight")
    assert metrics["rss"]["LW1"]["USRP1"]["rmse_db"] is None
    as_set = [row for row in metrics["ladder"] if row["model"].startswith("as set")]
    assert [row["rmse_heldout_db"] for row in as_set] == [None]


def test_calibrate_counts_a_copy_once(folder: Path) -> None:
    flights = ["first.yaml", copy_of(folder, ingested).name]
    calibration, notes = calibrated(write_yaml(folder / "twice.yaml", {"calibration": "twice", "flights": flights}))
    assert [data.settings.flight.name for data in calibration.flights] == ["first"]
    assert not any(calibration.scores.values())
    assert "nobody_knows_me contains the same log as first (SHA-256 " in notes[0]
    three, _ = calibrated(
        write_yaml(folder / "three.yaml", {"calibration": "three", "flights": [*flights, "second.yaml"]})
    )
    assert {score.flight for score in three.scores["flight_left_out"]} == {"first", "second"}


@pytest.mark.parametrize("rows_kept", [slice(-160, None), slice(None, None, 2)])
def test_a_part_of_a_training_log_in_another_layout_is_known_by_its_readings(folder: Path, rows_kept: slice) -> None:
    """Another digest: a half or every other row, other line ends, fewer decimals, times moved by 0.2 s, 1 dB more."""
    learned = yaml.safe_load((folder / "calibrated.yaml").read_text())

    def half(source: Path) -> str:
        rows = [line.split() for line in source.read_text().splitlines()[rows_kept]]
        moved = [f"{day} {time[:-7]}2{time[-6:]} {place} {float(level) + 1.0:.2f}" for day, time, place, level in rows]
        source.with_name("half.txt").write_text("\r\n".join(moved))
        return "first/half.txt"

    metrics, words = report(folder, copy_of(folder, half, link=learned["link"]))
    assert words.startswith("Training flight: the antennas of LW1 USRP1 were learned from this flight")
    assert metrics["rss"]["LW1"]["USRP1"]["rmse_db"] is None
    assert all(row["rmse_heldout_db"] is None for row in metrics["ladder"] if "learned" in row["model"])
    data = load_data(load_with_learned(copy_of(folder, half, link=learned["link"])), folder)
    noise = np.random.default_rng(1).normal(-70.0, 3.0, len(data.rss[0].time))
    series = dataclasses.replace(data.rss[0], channel="another", measured_db=noise)
    for rss, logs in (((*data.rss, series), flight_logs(data)), ((series,), ())):  # one series identifies the flight
        assert learned_here(dataclasses.replace(data, rss=rss), series, data.link_of(data.rss[0])) == logs
    names = ["first.yaml", copy_of(folder, half).name, "second.yaml", "aside.yaml"]
    counted, notes = counted_once([load_data(load_flight(folder / name), folder) for name in names])
    assert [data.settings.flight.name for data in counted] == ["first", "second", "aside"]
    assert notes == ["nobody_knows_me contains readings of first in another log: they are counted once"]


def test_two_logs_of_one_flight_in_two_flight_files(folder: Path) -> None:
    """Only the series of the repeated log is excluded. The other series of the later flight count."""
    both = settings("aside", {"model": "iso"})
    both["logs"].append({"path": LOG, "reader": "sounder_log", "node": "LW2", "channel": "USRP9"})
    flights = [load_data(load_flight(folder / "first.yaml"), folder)]
    counted, notes = counted_once([*flights, load_data(load_flight(write_yaml(folder / "both.yaml", both)), folder)])
    assert [[(s.tower, s.channel) for s in data.rss] for data in counted] == [[("LW1", "USRP1")], [("LW1", "USRP1")]]
    assert len(notes) == 1


def test_campaign_counts_a_copy_once(folder: Path, tmp_path: Path) -> None:
    flights = ["first.yaml", copy_of(folder, zipped_twice).name, "second.yaml"]
    path = write_yaml(folder / "campaign.yaml", {"campaign": "copies", "flights": flights})
    assert main(["campaign", str(path), "-o", str(tmp_path / "out"), "--fresh"]) == 1
    campaign = json.loads((tmp_path / "out" / "campaign.json").read_text())
    assert [row["flight"] for row in campaign["rss"]] == ["first", "second"]
    (failure,) = campaign["failures"]
    assert failure["flight"] == "nobody_knows_me"
    assert failure["message"].startswith("it contains the same log as first (SHA-256 ")


def test_campaign_counts_a_thinned_copy_once(folder: Path, tmp_path: Path) -> None:
    def thinned(source: Path) -> str:
        source.with_name("thin.txt").write_text("\n".join(source.read_text().splitlines()[::2]) + "\n")
        return "first/thin.txt"

    flights = ["first.yaml", copy_of(folder, thinned).name, "second.yaml"]
    variants = {
        "campaign": "thinned",
        "flights": flights,
        "settings": {"a": {}, "b": {"rss": {"minimum_height_m": 25}}},
    }
    assert (
        main(["campaign", str(write_yaml(folder / "thin.yaml", variants)), "-o", str(tmp_path / "out"), "--fresh"]) == 1
    )
    campaign = json.loads((tmp_path / "out" / "campaign.json").read_text())
    assert sorted((row["flight"], row["setting"]) for row in campaign["rss"]) == [
        (flight, setting) for flight in ("first", "second") for setting in "ab"
    ]
    assert {f["message"] for f in campaign["failures"]} == {
        "it contains readings of first in another log, which is counted once"
    }


def test_campaign_scores_no_flight_that_its_antennas_were_learned_from(folder: Path, tmp_path: Path) -> None:
    learned = yaml.safe_load((folder / "calibrated.yaml").read_text())
    names = [copy_of(folder, gzipped, link=learned["link"]).name]
    for name in ("aside", "second"):
        names.append(write_yaml(folder / f"l_{name}.yaml", settings(name, {"model": "iso"}, link=learned["link"])).name)
    path = write_yaml(folder / "campaign.yaml", {"campaign": "learned", "flights": names})
    assert main(["campaign", str(path), "-o", str(tmp_path / "out"), "--fresh"]) == 0
    campaign = json.loads((tmp_path / "out" / "campaign.json").read_text())
    errors = {row["flight"]: (row["rmse_db"], row["held_out_rmse_db"]) for row in campaign["rss"]}
    assert set(errors) == {"nobody_knows_me", "aside", "second"}
    assert np.isfinite(errors.pop("aside")[0])
    assert set(errors.values()) == {(None, None)}
    page = (tmp_path / "out" / "campaign.html").read_text(encoding="utf-8")
    assert page.count("its antennas were learned from this log, so it is not scored") == 2


def test_a_receiver_knows_its_reports_by_content() -> None:
    def reports_of(flight: str, *logs: str) -> RankSamples:
        return RankSamples(
            flight=flight, tower="LW1", tower_m=np.zeros(3), poses=None, rank=np.zeros(0), link=None,  # type: ignore[arg-type]
            time_s=np.zeros(0), logs=logs,
        )  # fmt: skip

    def receiver(**more: Any) -> FittedReceiver:
        return FittedReceiver(tower="LW1", geometries=(), tied=1, flights=("a",), mixture=None, **more)  # type: ignore[arg-type]

    by_content = receiver(trained_on=("1" * 64,))
    assert by_content.knows(reports_of("b", "2" * 64, "1" * 64))
    assert not by_content.knows(reports_of("a", "2" * 64))


def test_what_was_learned_from_ranks_alone_names_its_logs_too(tmp_path: Path) -> None:
    sample = Path(__file__).parents[2] / "sample_logs"
    flights = (load_data(load_flight(sample / "flight.yaml"), sample),)
    (tmp_path / "calibrated").mkdir()
    ranked = RankCalibration(receivers={}, scores={}, warnings=())
    learned = Calibrated(
        CalibrationFile(calibration="c", flights=["flight.yaml"]),
        flights,
        (),
        None,
        ranked,
        "calibrate",
        dict.fromkeys((f.settings.flight.name for f in flights), "c"),
    )
    _, text = write_files(learned, tmp_path / "calibrated", "calibrated", {})
    (tmp_path / "calibrated.yaml").write_text(text)
    assert set(trained_on(text)) == set(flight_logs(flights[0]))
    assert set(provenance.marks(text)) == set(marks_of(flights))
    joined = load_with_learned(sample / "flight.yaml", tmp_path / "calibrated.yaml")
    assert set(joined.trained_on) == set(flight_logs(flights[0]))
    assert joined.rank.receiver == str(tmp_path / "calibrated" / "receiver.json")


@pytest.mark.field
def test_a_quarter_of_an_nr_flight_is_not_scored_by_the_receiver_that_learned_from_it(tmp_path: Path) -> None:
    """The packaged receiver was fitted on NR flights 1 and 3. A quarter of flight 3 has another digest."""
    rows = (REAL / "nr_rank" / "july2_2024_flight3_nemo_nr.csv").read_text().splitlines()
    content = yaml.safe_load((Path(__file__).parents[1] / "field" / "nr_rank_flight3.yaml").read_text())
    flights: list[FlightData] = []
    for name, part in {"whole": rows[1:], "quarter": rows[len(rows) // 2 : 3 * len(rows) // 4]}.items():
        (tmp_path / f"{name}.csv").write_text("\n".join([rows[0], *part]) + "\n")
        content |= {"flight": {"name": name}, "logs": [{"path": f"{name}.csv", "node": "LW1"}]}
        flights.append(load_data(load_flight(write_yaml(tmp_path / f"{name}.yaml", content)), tmp_path))
    receiver = read_receiver(folder_of("lake_wheeler") / "nr_rank.receiver.json.gz")["LW1"]
    for data in flights:
        assert set(receiver.trained_on).isdisjoint(flight_logs(data))  # other line ends
        assert receiver.knows(rank_samples(data, data.rank[0]))
    counted, notes = counted_once(flights)
    assert [data.settings.flight.name for data in counted] == ["whole"]
    assert notes == ["quarter contains readings of whole in another log: they are counted once"]


@pytest.mark.field
def test_channel_states_that_a_converted_training_flight_is_not_predicted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The packaged antennas of LW1 were learned from this flight, which has other bytes as a CSV."""
    logs = ac.read(REAL / "dataset12" / "70m_fs20MHz.mat", timezone="America/New_York")
    names = {"time": "Time", "latitude_deg": "Latitude", "longitude_deg": "Longitude", "altitude_m": "RelHomeAlt"}
    table = logs["vehicle"][list(names)].rename(columns=names)
    table["LW1 USRP1 power [dB]"] = logs["USRP1"]["rss_db"]
    table.to_csv(tmp_path / "flight.csv", index=False)
    link = {"carrier_hz": 3.3e9, "transmit_power_dbm": 40, "uav_transmits": True}
    content = {"flight": "other_bytes", "site": "lake_wheeler", "logs": [{"path": "flight.csv"}], "link": {"rss": link}}
    flight = write_yaml(tmp_path / "flight.yaml", content)
    assert main(["channel", str(flight), "-o", str(tmp_path / "c"), "--format", "csv", "--step", "60", "--json"]) == 0
    assert any(
        "also learned from this flight's logs" in text for text in json.loads(capsys.readouterr().out)["warnings"]
    )
