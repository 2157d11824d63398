"""Campaigns: many flights and settings, held-out fits, repeatability, failures as rows."""

import csv
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.jobs.campaign import (
    Outcome,
    Task,
    digest_of,
    fitted_to,
    load_campaign,
    repeats,
    run,
    transfer_ranks,
    with_season,
)
from aerpaw_cmp.jobs.options import RunOptions
from aerpaw_cmp.jobs.tasks import OutcomeStore
from aerpaw_cmp.report.campaign import CampaignData, RankRow
from tests.jobs.campaign_rows import rss_row
from tests.json_page import unlisted
from tests.simulated import planned, simulate, write_yaml

CASES = Path(__file__).parents[1] / "parsers" / "cases" / "logs"
YAW_DEG = 110.0
OFFSETS_DB = {"first": 12.3, "second": 9.1}
FADING_DB = 1.0
YAW = "link.rss.tower.yaw_deg"


CORNERS = [(-40, 10, 30), (-250, 60, 30), (-100, 260, 40), (120, 120, 40), (60, -150, 30)]


def flight_settings(name: str, seed: int, yaw_deg: float) -> dict[str, Any]:
    offsets = {"USRP1": OFFSETS_DB[name], "USRP2": OFFSETS_DB[name] - 1.0}
    plan = {"seed": seed, "rss_interval_s": 0.5, "fading_db": FADING_DB, "fading_correlation_s": 0.5}
    link = {"rss": {"carrier_hz": 3.3e9, "tower": {"antenna": {"model": "tr38901"}, "yaw_deg": yaw_deg}}}
    return planned(name, CORNERS, {"LW1": offsets}, plan=plan, link=link, rt={"max_depth": 1})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate two flights over one route. Their flight files then name a wrong azimuth of the tower."""
    place = tmp_path_factory.mktemp("campaign")
    for seed, name in enumerate(OFFSETS_DB, start=1):
        simulate(write_yaml(place / f"{name}.yaml", flight_settings(name, seed, YAW_DEG)))
        write_yaml(place / f"{name}.yaml", flight_settings(name, seed, 0.0))
    return place


def write_campaign(folder: Path, name: str, **keys: Any) -> Path:
    return write_yaml(folder / f"{name}.yaml", {"campaign": name, "flights": ["first.yaml", "second.yaml"], **keys})


def result(folder: Path, name: str, *arguments: str, code: int = 0, **keys: Any) -> dict[str, Any]:
    path = write_campaign(folder, name, **keys)
    out = folder / f"{name}_out"
    assert main(["campaign", str(path), "-o", str(out), *arguments]) == code
    campaign: dict[str, Any] = json.loads((out / "campaign.json").read_text(encoding="utf-8"))
    return campaign


@pytest.fixture(scope="module")
def summary(folder: Path) -> dict[str, Any]:
    """One campaign with everything: two settings, and a flight that is broken."""
    broken = flight_settings("first", 1, 0.0)
    broken["flight"] = {"name": "broken"}
    broken["logs"][1]["path"] = "gone/<b>USRP1.txt"
    write_yaml(folder / "broken.yaml", broken)
    return result(
        folder, "whole", flights=["first.yaml", "second.yaml", "broken.yaml", "missing.yaml"],
        settings={"as written": {}, "right azimuth": {YAW: YAW_DEG}}, code=1,
    )  # fmt: skip


def test_settings_are_run_on_every_flight(summary: dict[str, Any]) -> None:
    rmse = summary["mean_rmse_db"]
    for flight in ("first", "second"):
        assert rmse["as written"][flight] > 4.0
        assert rmse["right azimuth"][flight] == pytest.approx(FADING_DB, abs=0.25)
    assert rmse["as written"]["broken"] is None
    keys = {(r["setting"], r["flight"], r["channel"]) for r in summary["rss"]}
    assert len(keys) == len(summary["rss"]) == 8


def test_one_route_flown_twice_repeats_to_the_fading_of_both(summary: dict[str, Any], folder: Path) -> None:
    """The model has a wrong azimuth, so both flights have the same errors at each position."""
    pairs = pd.read_csv(folder / "whole_out" / "pairs.csv")
    assert pairs[["first", "second", "channel"]].to_numpy().tolist() == [
        ["first", "second", "USRP1"],
        ["first", "second", "USRP2"],
    ]
    assert summary["repeatability"]["table"] == "pairs.csv"
    for _, pair in pairs.iterrows():
        assert pair["share"] > 0.9
        assert pair["rmse_db"] == pytest.approx(FADING_DB * np.sqrt(2), abs=0.35)
        assert pair["single_db"] == pytest.approx(pair["rmse_db"] / np.sqrt(2))
        assert pair["offset_db"] == pytest.approx(OFFSETS_DB["first"] - OFFSETS_DB["second"], abs=0.4)
        assert pair["place_correlation"] > 0.9
        assert abs(pair["height_difference_m"]) < 1.0


def test_broken_flights_are_rows_with_their_message(summary: dict[str, Any], folder: Path) -> None:
    messages = {f["flight"]: f["message"] for f in summary["failures"]}
    assert set(messages) == {"broken", "missing"}
    assert "no such log" in messages["broken"]
    assert "no such file" in messages["missing"]
    with (folder / "whole_out" / "campaign.csv").open(encoding="utf-8", newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert [r["kind"] for r in rows].count("rss") == 8
    ranking = summary["season"]["ranking"]
    best = ranking[0]["setting"]
    errors = [float(r["held_out_rmse_db"]) for r in rows if r["kind"] == "rss" and r["setting"] == best]
    assert sum(errors) / len(errors) == pytest.approx(ranking[0]["mean_db"])
    assert best == "right azimuth"
    assert set(summary["season"]["started"]) == {"first", "second"}
    failed = [r for r in rows if r["kind"] == "failed"]
    assert {(r["flight"], r["setting"]) for r in failed} == {
        ("broken", "as written"),
        ("broken", "right azimuth"),
        ("missing", "every setting"),
    }
    page = (folder / "whole_out" / "campaign.html").read_text(encoding="utf-8")
    assert "gone/&lt;b&gt;USRP1.txt" in page
    assert page.count("<script") == 2  # the data of the charts, and the script that draws them
    assert page.rstrip().endswith("</html>")


def test_a_campaign_of_soundings_alone_needs_no_flight_and_one_of_nothing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "night.csv").write_text((CASES / "aerpaw_monitoring.csv").read_text())
    campaign = write_yaml(tmp_path / "c.yaml", {"campaign": "c", "soundings": ["night.csv"]})
    assert main(["campaign", str(campaign), "-o", str(tmp_path / "out")]) == 0
    (tmp_path / "n.yaml").write_text("campaign: n\n")
    assert main(["campaign", str(tmp_path / "n.yaml")]) == 2


def test_a_lag_estimated_on_the_scored_samples_is_told(folder: Path) -> None:
    """``rss.lag: apply`` fits the clock of every flight on itself."""
    for name in OFFSETS_DB:
        settings = flight_settings(name, 1, YAW_DEG)
        settings["rss"]["lag"] = "apply"
        settings["flight"]["plan"]["clock_shift_s"] = {"LW1": 1.5}
        simulate(write_yaml(folder / f"apply_{name}.yaml", settings), folder / "applied")
    flights = ["apply_first.yaml", "apply_second.yaml"]
    campaign = load_campaign(write_campaign(folder, "apply", flights=flights))
    data = run(campaign, folder, RunOptions(logs_root=folder / "applied"))
    assert any("lag_s" in row.fitted for row in data.rss)
    assert all("offset_db" in row.fitted for row in data.rss)


def test_a_pool_of_processes_gives_the_same_numbers(folder: Path) -> None:
    alone = result(folder, "alone")
    shared = result(folder, "shared", "--workers", "2")
    assert shared["rss"] == alone["rss"]
    assert shared["workers"] == 2


def test_a_flight_that_is_missing_fails_the_campaign(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result(folder, "some", flights=["first.yaml", "missing.yaml"], code=1)
    assert "missing" in capsys.readouterr().err


def test_json_is_alone_on_standard_output(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = result(folder, "quiet", "--json", flights=["first.yaml"])
    printed = json.loads(capsys.readouterr().out)
    assert unlisted("campaign", printed) == []
    assert printed["rss"] == written["rss"]
    assert printed["repeatability"]["table"] is None


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"settings": {"x": {"rt.max_deth": 1}}}, "max_depth"),
        ({"settings": {"x": {"rt.max_depth": 9}}}, "rt.max_depth"),
        ({"settings": {"x": {"rt.max_depth.y": 1}}}, "which has no keys"),
        ({"settings": {"x": {"link.rss.towr.yaw_deg": 10}}}, "tower"),
        ({"settigns": {}}, "did you mean 'settings'"),
        ({"flights": ["first.yaml", "first.yaml"]}, "two flights are named 'first'"),
        ({"calibration": "all"}, "calibration"),
    ],
)
def test_mistakes_in_the_file_are_usage_errors(
    folder: Path, capsys: pytest.CaptureFixture[str], keys: dict[str, Any], message: str
) -> None:
    path = write_campaign(folder, "mistake", **keys)
    out = folder / "mistake_out"
    assert main(["campaign", str(path), "-o", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_a_cluster_needs_distributed(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    path = write_campaign(folder, "cluster")
    for option in ("--cluster", "--scheduler"):
        assert main(["campaign", str(path), "-o", str(folder / "c"), "--fresh", option, "tcp://127.0.0.1:1"]) == 2
        assert "pip install 'aerpaw-cmp[cluster]'" in capsys.readouterr().err


def test_repeatability_is_the_noise_of_both_flights_after_one_constant() -> None:
    rng = np.random.default_rng(5)
    n = 4000
    level = -60 + 10 * np.sin(np.arange(n) / 40)
    first = rss_row("a", "USRP1", level + rng.normal(0, 2.0, n), level)
    second = rss_row("b", "USRP1", level + 6.0 + rng.normal(0, 1.5, n), level)
    (pair,) = repeats([first, second])
    assert pair.n == n
    assert pair.share == 1.0
    assert pair.rmse_db == pytest.approx(2.5, rel=0.05)
    assert pair.residual_rmse_db == pytest.approx(2.5, rel=0.05)
    assert pair.offset_db == pytest.approx(6.0, abs=0.2)
    assert abs(pair.place_correlation) < 0.2  # nothing but noise comes back
    wrong = np.where(np.arange(n) % 400 < 200, 5.0, -5.0)
    (pair,) = repeats([rss_row("a", "USRP1", level + wrong, level), rss_row("b", "USRP1", level + wrong, level)])
    assert pair.rmse_db == pytest.approx(0.0, abs=1e-9)
    assert pair.place_correlation == pytest.approx(1.0)


def test_k_is_chosen_on_the_other_flights() -> None:
    """Only flight c is best with K = 1000. The K that the others choose for it is worse, and the page states this."""
    errors = {"a": (0.1, 0.5), "b": (0.2, 0.4), "c": (0.6, 0.05)}
    rows = [
        RankRow(
            flight=flight, setting="s", tower="LW1", k=k, n=9, n_out_of_coverage=0, agreement=0.5, agreement_ci95=None,
            kappa=tv / 2, total_variation=tv, total_variation_ci95=None, wasserstein=0.0, best_k=k, best_k_ci95=None,
        )
        for flight, both in errors.items()
        for k, tv in zip((10.0, 1000.0), both, strict=True)
    ]  # fmt: skip
    transfers = {t.flight: t for t in transfer_ranks(rows)}
    assert transfers["c"].chosen_on == ("a", "b")
    assert (transfers["c"].k, transfers["c"].total_variation, transfers["c"].kappa) == (10.0, 0.6, 0.3)
    assert (transfers["c"].own_k, transfers["c"].own_total_variation) == (1000.0, 0.05)
    assert (transfers["a"].k, transfers["a"].total_variation) == (
        1000.0,
        0.5,
    )  # (0.4 + 0.05) / 2 against (0.2 + 0.6) / 2
    assert transfer_ranks([r for r in rows if r.flight == "a"]) == []


def test_flights_that_never_meet_have_no_floor() -> None:
    low, high = rss_row("a", "USRP1", np.zeros(50), np.zeros(50)), rss_row("b", "USRP1", np.zeros(50), np.zeros(50))
    up = high.position_m + np.array([0.0, 0.0, 30.0])
    high = rss_row("b", "USRP1", np.zeros(50), np.zeros(50), position_m=up)
    (pair,) = repeats([low, high])
    assert pair.n == 0
    assert np.isnan(pair.rmse_db)
    assert pair.height_difference_m == 30.0
    assert repeats([low, rss_row("b", "USRP2", np.zeros(50), np.zeros(50))]) == []


def test_an_offset_at_the_end_of_its_range_is_a_failed_check(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    narrow = {"narrow": {"rss.span_db": [-0.5, 0.5]}}
    result(folder, "narrow", settings=narrow)  # without --strict it is reported only
    capsys.readouterr()
    result(folder, "narrow", "--strict", "--force", settings=narrow, code=1)
    assert "failed: first, narrow, LW1 USRP1: the best offset is at the end" in capsys.readouterr().err


def test_flights_without_a_sample_that_counts_give_no_number_and_end_nothing(folder: Path) -> None:
    settings = {"as written": {}, "high": {"rss.minimum_height_m": 500}}
    campaign = result(folder, "too_low", "--strict", settings=settings)
    rows = [r for r in campaign["rss"] if r["setting"] == "high"]
    assert [(r["n"], r["offset_db"], r["rmse_db"]) for r in rows] == [(0, None, None)] * 4
    assert campaign["mean_rmse_db"]["high"] == {"first": None, "second": None}
    assert campaign["mean_rmse_db"]["as written"]["first"] > 4.0


def test_a_campaign_of_rank_flights(folder: Path) -> None:
    """Rank alone: no RSS tables, but rank rows, their transfer of K and no figure."""
    for seed, name in enumerate(OFFSETS_DB, start=1):
        settings = flight_settings(name, seed, YAW_DEG)
        settings["flight"]["name"] = f"rank_{name}"
        settings["flight"]["plan"].pop("offsets_db")
        settings["flight"]["plan"].update(rank_k=10, rank_interval_s=1.0, start=f"2025-06-0{seed}T10:00:00")
        if name == "second":  # ranks are simulated without noise: those of one route would be one log
            settings["flight"]["plan"]["waypoints"].reverse()
        track = {**settings["logs"][0], "path": f"rank_{name}/vehicleOut.txt"}  # not over that of the other tests
        settings["logs"] = [track, {"path": f"{name}/ri.csv", "reader": "quectel_ri", "node": "LW1"}]
        settings["rank"] = {"k": [10, 100]}
        simulate(write_yaml(folder / f"rank_{name}.yaml", settings))
    campaign = result(folder, "ranks", flights=["rank_first.yaml", "rank_second.yaml"])
    assert campaign["rss"] == []
    assert {(r["flight"], r["k"]) for r in campaign["rank"]} == {
        (f"rank_{n}", k) for n in OFFSETS_DB for k in (10, 100)
    }
    for transfer in campaign["rank_transfers"]:
        assert transfer["k"] == 10  # the simulated modem's
        assert transfer["total_variation"] < 0.05
    page = (folder / "ranks_out" / "campaign.html").read_text(encoding="utf-8")
    assert "Mean RMSE over towers" not in page
    assert "with a K that was selected on the other flights" in page


def test_the_campaigns_to_copy_from_load_and_name_flights_that_are_there() -> None:
    places = sorted((Path(__file__).parents[1] / "field" / "campaigns").glob("*.yaml"))
    assert [place.stem for place in places] == ["dataset12", "nr_rank"]
    assert all((place.parent / flight).is_file() for place in places for flight in load_campaign(place).flights)


def test_a_dry_run_says_what_is_kept(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = {"as written": {"rss.advanced.lag_window_s": 11}, "level": {"rss.advanced.lag_window_s": 12}}
    path = write_campaign(folder, "kept", flights=["first.yaml", "second.yaml"], settings=settings)
    campaign = load_campaign(path)
    run(
        load_campaign(write_campaign(folder, "part", flights=["first.yaml"], settings=settings)),
        folder,
        keep=folder / "outcomes",
    )
    capsys.readouterr()
    keep = ["--keep", str(folder / "outcomes")]
    assert main(["campaign", str(path), "--dry-run", "--json", "--workers", "2", *keep]) == 0
    plan = json.loads(capsys.readouterr().out)
    stages = {stage["name"]: stage for stage in plan["stages"]}
    store = OutcomeStore(folder / "outcomes", Outcome)
    for label, setting in settings.items():
        stage = stages[f"flights, {label}"]
        assert stage["work"] == "2 tasks, 1 stored"
        task = Task(folder / "first.yaml", "first", label, setting, None)
        assert stage["seconds"] == pytest.approx(store.load(digest_of(task)).seconds / 2)
    run(campaign, folder, keep=folder / "outcomes")
    assert main(["campaign", str(path), "--dry-run", "--json", *keep]) == 0
    again = json.loads(capsys.readouterr().out)["stages"]
    assert [(stage["work"], stage["seconds"]) for stage in again[1:]] == [("2 tasks, 2 stored", 0.0)] * 2
    assert main(["campaign", str(path), "--dry-run", "--fresh", "-o", str(folder / "new")]) == 0
    assert "2 tasks, 0 stored" in capsys.readouterr().out


def test_a_failed_task_leaves_its_traceback_in_a_file(folder: Path) -> None:
    broken = flight_settings("first", 1, 0.0)
    broken["flight"] = {"name": "broken2"}
    broken["logs"][1]["path"] = "gone.txt"
    write_yaml(folder / "broken2.yaml", broken)
    campaign = result(folder, "traced", flights=["broken2.yaml"], code=3)
    assert "traceback" not in campaign["failures"][0]
    text = (folder / "traced_out" / "failures" / "broken2__as_written.txt").read_text(encoding="utf-8")
    assert "there is no such log" in text
    assert "Traceback (most recent call last)" in text


def test_many_settings_are_held_in_the_memory_of_one() -> None:
    """Only the first setting keeps its sample series. Held-out errors of the other settings come from moments."""
    rng, n, names = np.random.default_rng(3), 5000, [f"s{number}" for number in range(40)]
    every, held = [], []
    for flight in ("f", "g"):
        for name in names:
            simulated = np.where(np.arange(n) % 7, rng.normal(-58, 3, n), np.nan)
            measured = rng.normal(-60, 3, n)
            fit = {"rmse_db": np.nanstd(simulated - measured), "heading_deg": rng.normal(90.0, 5.0, n)}
            row = rss_row(flight, "USRP0", measured, simulated, **fit)
            every.append(dataclasses.replace(row, setting=name))
            task = Task(Path("f.yaml"), flight, name, {}, None, reference=name == "s0")
            held.append(fitted_to(task, Outcome(rss=(row,))).rss[0])
    values = [getattr(row, field.name) for row in held for field in dataclasses.fields(row)]
    arrays = {id(value): value.nbytes for value in values if isinstance(value, np.ndarray)}
    assert sum(arrays.values()) < 2 * 16 * 8 * n  # for one setting: at most sixteen numbers per sample of each flight
    data = CampaignData(name="c", title="c", flights=("f", "g"), settings={name: {} for name in names}, rss=tuple(held))
    for a, b in zip(with_season(data).rss, every, strict=True):
        difference = b.simulated_dbm - b.measured_db
        rmse = np.sqrt(np.nanmean((difference - a.held_out_offset_db) ** 2))
        assert a.held_out_rmse_db == pytest.approx(rmse, rel=1e-9)
