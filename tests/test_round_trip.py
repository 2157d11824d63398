"""Simulate, ingest, report: what was planted must come back, through the command line and the real formats."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.compare.result import RssResult
from aerpaw_cmp.flight.data import gather, load_data, read_logs
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.flight_run import run_flight
from aerpaw_cmp.report.flight import metrics
from aerpaw_cmp.report.flight_data import report_data
from tests.simulated import simulate

SAMPLE = Path(__file__).parents[1] / "sample_logs" / "flight.yaml"
OFFSETS = {"LW1": {"USRP1": 12.3, "USRP2": -8.7}, "LW2": {"USRP1": 38.6}}


def flight(folder: Path, **plan: object) -> Path:
    """The sample flight with two towers and what is planted changed."""
    content = yaml.safe_load(SAMPLE.read_text())
    content["flight"]["plan"] |= {"fading_db": 0.0, "bad_lines": 0, "clock_shift_s": {}, "offsets_db": OFFSETS, **plan}
    content["logs"] = [
        log for log in content["logs"] if "node" not in log or log.get("channel") in OFFSETS.get(log["node"], {})
    ]
    content["rt"] = {"engine": "image", "audit_links": 0}
    content["rss"] = {"lag": "apply" if plan.get("clock_shift_s") else "off"}
    path = folder / "flight.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def round_trip(folder: Path, **plan: object) -> dict[str, dict[str, RssResult]]:
    """Simulate by the command line, read the files back, and compare. Return the results by tower and channel."""
    path = flight(folder, **plan)
    simulate(path)
    data = load_data(load_flight(path), folder)
    results: dict[str, dict[str, RssResult]] = {}
    for result in run_flight(data, audit=False).result.rss:
        results.setdefault(result.tower, {})[result.channel] = result
    return results


def test_planted_offsets_come_back_to_a_tenth_without_noise(tmp_path: Path) -> None:
    rss = round_trip(tmp_path)
    for tower, channels in OFFSETS.items():
        for channel, planted in channels.items():
            result = rss[tower][channel]
            assert abs(result.score.offset_db - planted) < 0.1 + 1e-9, (tower, channel, result.score.offset_db)
            assert not result.score.at_edge


def test_planted_offsets_lie_in_their_intervals_with_noise(tmp_path: Path) -> None:
    inside, widths = [], []
    for seed in (1, 2):
        folder = tmp_path / str(seed)
        folder.mkdir()
        rss = round_trip(folder, fading_db=3.0, seed=seed, rank_interval_s=5.0)
        for tower, channels in OFFSETS.items():
            for channel, planted in channels.items():
                low, high = rss[tower][channel].score.intervals.offset_db
                widths.append(high - low)
                inside.append(low <= planted <= high)
    assert np.sum(inside) >= 5  # of six intervals of 95 %
    assert np.median(widths) < 3.0


@pytest.mark.parametrize("shift", [3.25, -1.5])
def test_planted_clock_shift_is_found_and_applied(tmp_path: Path, shift: float) -> None:
    """Check LW1, because the level at LW2 hardly depends on the position on this flight."""
    (result, *_) = round_trip(tmp_path, clock_shift_s={"LW1": shift})["LW1"].values()
    clock = result.further.clock
    assert clock.verdict == "shifted"
    assert clock.applied == "estimated and applied"
    low, high = clock.ci95_s
    assert low <= shift <= high
    assert abs(clock.radio_minus_telemetry_s - shift) < 0.15
    assert abs(result.score.offset_db - OFFSETS["LW1"]["USRP1"]) < 0.2


def test_the_clock_has_one_sign_on_every_path(tmp_path: Path) -> None:
    """A radio that is 2.5 s ahead: simulated, estimated, given by hand, compared, written."""
    path = flight(tmp_path, clock_shift_s={"LW1": 2.5}, offsets_db={"LW1": {"USRP1": 12.3}})
    content = yaml.safe_load(path.read_text())
    content["logs"] = [log for log in content["logs"] if log.get("node", "LW1") == "LW1"]
    path.write_text(yaml.safe_dump(content))
    simulate(path)
    settings = load_flight(path)
    files = read_logs(settings, tmp_path)
    by_lag = {}
    for lag in ("apply", 2.5, 0.0, -2.5):
        changed = settings.model_copy(update={"rss": settings.rss.model_copy(update={"lag": lag})})
        data = gather(changed, tmp_path, files)
        result = run_flight(data, audit=False).result
        by_lag[lag] = metrics(report_data(data, result))["rss"]["LW1"]["USRP1"]
    assert abs(by_lag["apply"]["lag_s"] - 2.5) < 0.05
    low, high = by_lag["apply"]["clock"]["ci95_s"]
    assert low <= 2.5 <= high
    for lag in (2.5, 0.0, -2.5):
        assert by_lag[lag]["lag_s"] == by_lag[lag]["clock"]["radio_minus_telemetry_s"] == lag
    rmse = {lag: numbers["rmse_db"] for lag, numbers in by_lag.items()}
    assert rmse["apply"] < 0.3, rmse  # corners of the plan lie between telemetry rows
    assert rmse[2.5] < 0.3, rmse
    assert rmse[2.5] < 0.3 * rmse[0.0] < 0.3 * rmse[-2.5]


def test_bad_lines_are_rejected_and_counted(tmp_path: Path) -> None:
    path = flight(tmp_path, bad_lines=5, fading_db=2.0)
    simulate(path)
    truth = json.loads((tmp_path / "truth.json").read_text())
    settings = load_flight(path)
    for log, file in zip(settings.logs, read_logs(settings, tmp_path), strict=True):
        assert len(file.result.rejected) == 5 == len(truth["bad_lines"][log.path])


def with_logs(path: Path, *logs: dict[str, str]) -> None:
    """Write the flight file with other logs after its track. Ranks are those of LW3."""
    content = yaml.safe_load(path.read_text())
    content |= {"logs": [content["logs"][0], *logs], "rank": {"tower": "LW3"}}
    content["flight"]["plan"].pop("offsets_db", None)
    content["flight"]["plan"].pop("clock_shift_s", None)
    path.write_text(yaml.safe_dump(content))


RANKS = {"path": "bare.csv", "reader": "quectel_ri"}


def test_ranks_are_of_the_tower_that_the_log_names_or_else_of_that_of_the_flight(tmp_path: Path) -> None:
    path = flight(tmp_path, rank_interval_s=20.0)
    with_logs(path, RANKS | {"path": "named.csv", "node": "LW2"}, RANKS)
    simulate(path)
    assert list(json.loads((tmp_path / "truth.json").read_text())["rank"]) == ["LW2", "LW3"]


def test_reported_ranks_are_one_layer_off_or_without_csi_as_often_as_planned(tmp_path: Path) -> None:
    reported = {}
    for wrong, silent in ((0.0, 0.0), (1.0, 0.0), (0.5, 0.0), (0.0, 1.0)):
        path = flight(tmp_path, rank_interval_s=0.5, rank_error_share=wrong, no_csi_share=silent)
        with_logs(path, RANKS)
        simulate(path)
        reported[wrong, silent] = np.loadtxt(tmp_path / "bare.csv", delimiter=",", skiprows=1, usecols=5)
        histogram = json.loads((tmp_path / "truth.json").read_text())["rank"]["LW3"]["histogram"]
        right = reported[0.0, 0.0]
        assert histogram == {str(r): int((right == r).sum()) for r in range(5)}
    off = reported[1.0, 0.0] - right
    assert set(np.abs(off)) <= {0.0, 1.0}
    assert set(right[off == 0]) <= {1.0, 4.0}  # of the lowest and highest rank there is nothing beyond
    assert 0.4 < (off[(right > 1) & (right < 4)] > 0).mean() < 0.6
    between = (right > 1) & (right < 4)
    assert between.sum() > 100
    assert 0.35 < (reported[0.5, 0.0] != right)[between].mean() < 0.65
    assert (reported[0.0, 1.0] == 0).all()


@pytest.mark.parametrize(
    ("log", "words"),
    [
        ({"path": "p.txt", "reader": "sounder_log", "node": "LW1"}, "has no tower or no channel"),
        ({"path": "p.txt", "reader": "sounder_log", "channel": "USRP1"}, "has no tower or no channel"),
        ({"path": "p.txt", "reader": "sounder_log", "node": "LW9", "channel": "USRP1"}, "the site has no tower 'LW9'"),
        ({"path": "p.txt", "reader": "aadm_snr"}, "no writer for log"),
        (RANKS | {"path": "../p.csv"}, "no file of its folder"),
        (RANKS | {"path": "truth.json"}, "two files of this flight are named"),
    ],
)
def test_logs_that_cannot_be_written_are_named_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], log: dict[str, str], words: str
) -> None:
    path = flight(tmp_path)
    with_logs(path, log)
    assert main(["simulate", str(path), "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_sample_logs_are_what_simulate_writes(tmp_path: Path) -> None:
    """The logs in git are made by the command that the README names, not by hand, and have not gone stale."""
    out = tmp_path / "out"
    assert main(["simulate", str(SAMPLE), "-o", str(out)]) == 0
    settings = load_flight(SAMPLE)
    in_git, simulated = (read_logs(settings, folder) for folder in (SAMPLE.parent, out))
    for log, shipped, remade in zip(settings.logs, in_git, simulated, strict=True):
        assert (shipped.result.lines, len(shipped.result.rejected)) == (
            remade.result.lines,
            len(remade.result.rejected),
        ), log.path
        for old, new in zip(shipped.result.streams, remade.result.streams, strict=True):
            for column in old.frame.columns:
                if old.frame[column].dtype.kind == "f":
                    np.testing.assert_allclose(old.frame[column], new.frame[column], atol=2e-3, err_msg=log.path)
    truths = [json.loads((folder / "truth.json").read_text()) for folder in (out, SAMPLE.parent)]
    assert truths[0] == truths[1]
