"""Run complete reports on real logs, and skip them with a message if AERPAW_CMP_FIELD_DATA is not set."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.compare.result import BASELINE_TITLE
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.replay import replay_rank
from aerpaw_cmp.flight.settings import load_flight, overridden
from aerpaw_cmp.jobs.compare_flight import compare_rank_series
from aerpaw_cmp.logs.ingest import Ingested
from aerpaw_cmp.logs.readers import ReadOptions
from tests.real_logs import REAL

pytestmark = [pytest.mark.usefixtures("few_pictures"), pytest.mark.field]
FLIGHTS = {path.stem: path for path in sorted((Path(__file__).parent / "field").glob("*.yaml"))}
OPTIONS = ReadOptions(timezone="America/New_York")
RANK = ("nr_rank_flight1", "nr_rank_flight3")

Metrics = dict[str, Any]
Report = Callable[..., Metrics]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Metrics of a flight file, through the command line."""

    @cache
    def run(name: str) -> Metrics:
        out = tmp_path_factory.mktemp(name) / "out"
        assert main(["report", str(FLIGHTS[name]), "--logs-root", str(REAL), "-o", str(out), "--audit", "20"]) == 0
        assert "</html>" in (out / "report.html").read_text(encoding="utf-8")
        metrics: Metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        return metrics

    return run


@pytest.mark.parametrize("name", FLIGHTS)
def test_report_completes_with_baselines_and_audit(report: Report, name: str) -> None:
    metrics = report(name)
    for tower in metrics["rss"].values():
        for channel in tower.values():
            # a Nemo table gives its own positions to its 1990 levels, a position a second
            assert channel["n"] > (300 if name == "aadm" else 1500 if name.startswith("nr_rank") else 3000)
            low, high = channel["rmse_ci95_db"]
            assert low is None or low < channel["rmse_db"] < (high or np.inf)
            assert set(channel["baselines"]) == set(BASELINE_TITLE)
            assert not channel["at_search_edge"]
    for tower in metrics["rank"].values():
        assert set(tower["simulated"]) == {"10", "100", "1000"}
    assert metrics["rss"]
    assert bool(metrics["rank"]) == name.startswith("nr_rank")
    audit = metrics["rt"]["audit"]
    assert audit["links"] >= 20
    assert audit["missing_paths"] == 0
    assert audit["rss_max_error_db"] < 0.01
    for file in metrics["inputs"]:
        assert file["lines"] == file["accepted"] + file["rejected"] + file["blank"]


@pytest.mark.parametrize("name", ["dataset12_40m", "dataset12_70m"])
def test_free_space_leaves_what_an_independent_trial_left(report: Report, name: str) -> None:
    expected = {"dataset12_40m": {"USRP1": 6.56, "USRP2": 5.47}, "dataset12_70m": {"USRP1": 7.14, "USRP2": 6.30}}[name]
    rmse_db = {channel: m["baselines"]["free_space"]["rmse_db"] for channel, m in report(name)["rss"]["LW1"].items()}
    assert rmse_db == pytest.approx(expected, abs=0.05)


def test_snr_of_four_towers_is_scored_per_tower(report: Report) -> None:
    """The residual after the mean of the file's noise is the error of the comparison itself."""
    towers = report("aadm")["rss"]
    assert set(towers) == {"LW1", "LW2", "LW3", "LW4"}
    for channels in towers.values():
        score, snr = channels["snr"], channels["snr"]["snr"]
        assert snr["noise_dbm"] == pytest.approx(-93.96, abs=0.01)
        assert snr["n"] == score["n"]
        assert snr["rmse_db"] ** 2 - snr["mean_error_db"] ** 2 == pytest.approx(score["rmse_db"] ** 2, rel=1e-3)


@pytest.mark.parametrize(("name", "limit"), [("nr_rank_flight1", 0.07), ("nr_rank_flight3", 0.10)])
def test_slanted_ports_reproduce_the_histogram_of_measured_rank(report: Report, name: str, limit: float) -> None:
    """The order of the slants was chosen on flight 1. Flight 3 was not used for this choice."""
    assert report(name)["rank"]["LW1"]["simulated"]["10"]["total_variation"] <= limit


def test_vertical_elements_do_not() -> None:
    settings = load_flight(FLIGHTS["nr_rank_flight1"])
    vertical = overridden(settings, {f"link.rank.{end}.slant_deg": 0 for end in ("tower", "uav")})
    data = load_data(vertical, REAL)
    (replayed,) = replay_rank(data)
    score = compare_rank_series(data, data.rank[0], replayed).score
    assert score.simulated[10.0].total_variation > 0.7


@pytest.mark.parametrize("name", RANK)
def test_which_rank_when_is_predicted_little_better_than_by_chance(report: Report, name: str) -> None:
    """Measured at K = 10: kappa 0.23 on both flights (0 is chance, 1 every pose right)."""
    at_10 = report(name)["rank"]["LW1"]["simulated"]["10"]
    assert 0.6 < at_10["agreement"] < 0.75
    assert 0.1 < at_10["kappa"] < 0.35


def test_every_folder_is_read_and_accounted_for(field_logs: Ingested) -> None:
    assert len(field_logs) > 15
    for file in field_logs:
        result = file.result
        assert result.lines == result.accepted + len(result.rejected) + result.blank, file.path
        assert sum(len(s.frame) for s in result.streams if s.kind == "telemetry") <= result.accepted
        assert all(line.reason and line.number >= 1 for line in result.rejected), file.path


def test_what_no_reader_takes_is_named_with_a_reason(field_logs: Ingested) -> None:
    read = {Path(file.path).resolve() for file in field_logs}
    skipped = {Path(file.path).resolve(): file.reason for file in field_logs.skipped}
    there = {path.resolve() for path in REAL.rglob("*") if path.is_file() and not path.name.startswith(".")}
    # a member of an archive stands for it
    outside = {next(p for p in (path, *path.parents) if p.exists()) for path in read | set(skipped)}
    assert outside == there
    assert not read & set(skipped)
    assert all(skipped.values())


def test_ingest_of_the_whole_folder_through_the_command_line(
    field_logs: Ingested, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Each file was read above. Here it is read by the command, and one of six is written."""
    some = Ingested(field_logs[::6], field_logs.skipped)

    def read_above(paths: list[Path], *, options: ReadOptions, reader: str | None) -> Ingested:
        assert (paths, options, reader) == ([REAL], OPTIONS, None)
        return some

    monkeypatch.setattr("aerpaw_cmp.logs.ingest.ingest", read_above)
    assert main(["ingest", str(REAL), "--timezone", "America/New_York", "-o", str(tmp_path / "all.h5"), "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert len(files) == len(some) > 5
    assert all(f["lines"] == f["accepted"] + f["rejected"] + f["blank"] for f in files)
    assert (tmp_path / "all.h5").stat().st_size > 1_000_000
