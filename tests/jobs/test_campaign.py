"""Campaigns: many flights and settings, pooled offsets, held-out fits, repeatability, failures as rows."""

from __future__ import annotations

import csv
import json
import os
import shutil
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.flight.overrides import overridden
from aerpaw_cmp.flight.settings import FlightFile, load_flight
from aerpaw_cmp.jobs.campaigns import campaign_fit
from aerpaw_cmp.jobs.campaigns.campaign import load_campaign, run
from aerpaw_cmp.jobs.campaigns.campaign_fit import goes_round, search
from aerpaw_cmp.jobs.campaigns.over_flights import RepeatSettings, pool_offsets, repeats, transfer_ranks
from aerpaw_cmp.jobs.options import RunOptions
from aerpaw_cmp.report.campaign_data import RankRow, RssRow, place_means
from tests.json_page import unlisted
from tests.simulated import simulate

pytestmark = pytest.mark.usefixtures("few_pictures")

YAW_DEG = 110.0
OFFSETS_DB = {"first": 12.3, "second": 9.1}
FADING_DB = 1.0
START_POSIX_S = 1_748_786_400
"""The start of the plan: 2025-06-01 10:00 in New York, 14:00 UTC."""
YAW = "link.rss.tower.yaw_deg"


def flight_settings(name: str, seed: int, yaw_deg: float) -> dict[str, Any]:
    corners = [(-40, 10, 30), (-250, 60, 30), (-100, 260, 40), (120, 120, 40), (60, -150, 30)]
    waypoints = [{"east_m": e, "north_m": n, "height_m": h} for e, n, h in corners]
    return {
        "flight": {
            "name": name,
            "synthetic": True,
            "plan": {
                "start": "2025-06-01T10:00:00",
                "seed": seed,
                "speed_mps": 10.0,
                "rss_interval_s": 0.5,
                "fading_db": FADING_DB,
                "fading_correlation_s": 0.5,
                "waypoints": waypoints,
                "offsets_db": {"LW1": {"USRP1": OFFSETS_DB[name], "USRP2": OFFSETS_DB[name] - 1.0}},
            },
        },
        "site": {"file": "lake_wheeler", "without_buildings": True},
        "timezone": "America/New_York",
        "logs": [
            {"path": f"{name}/vehicle.txt", "reader": "vehicle_out"},
            *(
                {"path": f"{name}/{c}.txt", "reader": "sounder_log", "node": "LW1", "channel": c}
                for c in ("USRP1", "USRP2")
            ),
        ],
        "link": {"rss": {"carrier_hz": 3.3e9, "tower": {"antenna": {"model": "tr38901"}, "yaw_deg": yaw_deg}}},
        "rt": {"max_depth": 1},
        "rss": {"lag": "off"},
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two simulated flights over one route; their flight files then say a wrong azimuth of the tower."""
    place = tmp_path_factory.mktemp("campaign")
    for seed, name in enumerate(OFFSETS_DB, start=1):
        path = place / f"{name}.yaml"
        path.write_text(yaml.safe_dump(flight_settings(name, seed, YAW_DEG)), encoding="utf-8")
        simulate(path)
        path.write_text(yaml.safe_dump(flight_settings(name, seed, 0.0)), encoding="utf-8")
    return place


def write_campaign(folder: Path, name: str, **keys: Any) -> Path:
    path = folder / f"{name}.yaml"
    entries = {"campaign": name, "flights": ["first.yaml", "second.yaml"], **keys}
    path.write_text(yaml.safe_dump(entries, sort_keys=False), encoding="utf-8")
    return path


def result(folder: Path, name: str, *arguments: str, code: int = 0, **keys: Any) -> dict[str, Any]:
    path = write_campaign(folder, name, **keys)
    out = folder / f"{name}_out"
    assert main(["campaign", str(path), "-o", str(out), *arguments]) == code
    found: dict[str, Any] = json.loads((out / "campaign.json").read_text(encoding="utf-8"))
    return found


@pytest.fixture(scope="module")
def whole(folder: Path) -> dict[str, Any]:
    """One campaign with everything: two settings, shared offsets, a fit on the first flight, a flight that is broken."""
    broken = flight_settings("first", 1, 0.0)
    broken["flight"] = {"name": "broken"}
    broken["logs"][1]["path"] = "gone/<b>USRP1.txt"
    (folder / "broken.yaml").write_text(yaml.safe_dump(broken), encoding="utf-8")
    return result(
        folder,
        "whole",
        flights=["first.yaml", "second.yaml", "broken.yaml", "missing.yaml"],
        settings={"as written": {}, "right azimuth": {YAW: YAW_DEG}},
        calibration="channel",
        held_out={"fit": {YAW: list(range(0, 360, 10))}, "fit_on": ["first"], "samples": 100},
        export=["mat", "kmz"],
    )


def test_the_samples_of_all_flights_are_exported(whole: dict[str, Any], folder: Path) -> None:
    """Read by SciPy: each link's residual gives the RMSE of its row, and its times are those of the plan."""
    from scipy.io import loadmat

    place = folder / "whole_out" / "exports"
    links = loadmat(place / "samples.mat", simplify_cells=True)["rss"]
    rows = {(r["flight"], f"{r['tower']} {r['channel']}"): r for r in whole["rss"] if r["setting"] == "as written"}
    assert {(link["flight"], f"{link['tower']} {link['channel']}") for link in links} == set(rows)
    for link in links:
        rmse = np.sqrt(np.nanmean(link["residual_db"] ** 2))
        assert rmse == pytest.approx(rows[link["flight"], f"{link['tower']} {link['channel']}"]["rmse_db"], abs=1e-3)
        assert link["time_posix_s"][0] == pytest.approx(START_POSIX_S, abs=60)
    with zipfile.ZipFile(place / "samples.kmz") as archive:
        assert archive.read("doc.kml").decode().count("<gx:Track>") == 2
    assert "exports/samples.mat" in (folder / "whole_out" / "campaign.html").read_text(encoding="utf-8")
    assert "exports/samples.mat" in (folder / "whole_out" / "SHA256SUMS").read_text(encoding="utf-8")


def test_the_planted_azimuth_is_recovered_and_holds_on_the_other_flight(whole: dict[str, Any]) -> None:
    (fold,) = whole["held_out"]["folds"]
    assert fold["fitted_on"] == ["first"]
    assert fold["applied_to"] == ["second"]
    assert fold["parameters"] == {YAW: YAW_DEG}
    assert fold["at_bounds"] == []
    for row in fold["scores"]:
        assert row["fitted_here"] == (row["flight"] == "first")
        assert row["start_rmse_db"] > 4.0
        assert row["rmse_db"] == pytest.approx(FADING_DB, abs=0.25)


def test_the_transferred_offset_is_that_of_the_flight_of_the_fit(whole: dict[str, Any]) -> None:
    """With the other flight's offset the RMSE has the difference of the two planted offsets in it, in quadrature."""
    rows = {(r["flight"], r["channel"]): r for r in whole["held_out"]["folds"][0]["scores"]}
    for channel, less in (("USRP1", 0.0), ("USRP2", 1.0)):
        assert rows["first", channel]["transferred_rmse_db"] is None
        row = rows["second", channel]
        assert row["transferred_offset_db"] == pytest.approx(OFFSETS_DB["first"] - less, abs=0.3)
        apart = OFFSETS_DB["first"] - OFFSETS_DB["second"]
        assert row["transferred_rmse_db"] == pytest.approx(np.hypot(FADING_DB, apart), abs=0.4)


def test_settings_are_run_on_every_flight(whole: dict[str, Any]) -> None:
    rmse = whole["mean_rmse_db"]
    for flight in ("first", "second"):
        assert rmse["as written"][flight] > 4.0
        assert rmse["right azimuth"][flight] == pytest.approx(FADING_DB, abs=0.25)
    assert rmse["as written"]["broken"] is None
    keys = {(r["setting"], r["flight"], r["channel"]) for r in whole["rss"]}
    assert len(keys) == len(whole["rss"]) == 8


def test_offsets_are_shared_per_channel(whole: dict[str, Any]) -> None:
    groups = {g["group"]: g for g in whole["calibration"]["groups"] if g["setting"] == "right azimuth"}
    assert set(groups) == {"USRP1", "USRP2"}
    mean = np.mean(list(OFFSETS_DB.values()))
    assert groups["USRP1"]["offset_db"] == pytest.approx(mean, abs=0.3)
    assert groups["USRP2"]["offset_db"] == pytest.approx(mean - 1.0, abs=0.3)
    apart = OFFSETS_DB["first"] - OFFSETS_DB["second"]
    assert groups["USRP1"]["spread_db"] == pytest.approx(apart / np.sqrt(2), abs=0.3)
    assert groups["USRP1"]["pooled_rmse_db"] == pytest.approx(np.hypot(FADING_DB, apart / 2), abs=0.3)


def test_one_route_flown_twice_repeats_to_the_fading_of_both(whole: dict[str, Any]) -> None:
    """The model is right nowhere (its azimuth is wrong), and still both flights err alike in every place."""
    pairs = whole["repeatability"]["pairs"]
    assert [(p["first"], p["second"], p["channel"]) for p in pairs] == [
        ("first", "second", "USRP1"),
        ("first", "second", "USRP2"),
    ]
    for pair in pairs:
        assert pair["share"] > 0.9
        assert pair["rmse_db"] == pytest.approx(FADING_DB * np.sqrt(2), abs=0.35)
        assert pair["single_db"] == pytest.approx(pair["rmse_db"] / np.sqrt(2))
        assert pair["offset_db"] == pytest.approx(OFFSETS_DB["first"] - OFFSETS_DB["second"], abs=0.4)
        assert pair["place_correlation"] > 0.9
        assert abs(pair["height_difference_m"]) < 1.0


def test_broken_flights_are_rows_with_their_message(whole: dict[str, Any], folder: Path) -> None:
    messages = {f["flight"]: f["message"] for f in whole["failures"]}
    assert set(messages) == {"broken", "missing"}
    assert "no such log" in messages["broken"]
    assert "no such file" in messages["missing"]
    with (folder / "whole_out" / "campaign.csv").open(encoding="utf-8", newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert [r["kind"] for r in rows].count("rss") == 8
    ranking = [entry for entry in whole["season"]["ranking"] if not entry["link"]]
    best = ranking[0]["setting"]
    errors = [float(r["held_out_rmse_db"]) for r in rows if r["kind"] == "rss" and r["setting"] == best]
    assert sum(errors) / len(errors) == pytest.approx(ranking[0]["mean_db"])
    assert best == "right azimuth"
    assert set(whole["season"]["started"]) == {"first", "second"}
    failed = [r for r in rows if r["kind"] == "failed"]
    assert {(r["flight"], r["setting"]) for r in failed} == {
        ("broken", "as written"),
        ("broken", "right azimuth"),
        ("missing", "every setting"),
    }
    page = (folder / "whole_out" / "campaign.html").read_text(encoding="utf-8")
    assert "gone/&lt;b&gt;USRP1.txt" in page
    assert page.count("<script") == 2  # its data and its own script
    assert page.rstrip().endswith("</html>")


def test_every_figure_is_there_and_old_ones_are_not(whole: dict[str, Any], folder: Path) -> None:
    figures = folder / "whole_out" / "figures"
    expected = {
        "settings_rmse", "tracks", "distance_LW1_USRP1", "distance_LW1_USRP2", "places_LW1_USRP1", "places_LW1_USRP2",
        "held_out_1", "season_errors", "season_drift", "season_places",
    }  # fmt: skip
    assert {p.stem for p in figures.glob("*.svg")} == {p.stem for p in figures.glob("*.png")} == expected
    shutil.copytree(folder / "whole_out", folder / "again_out")
    result(folder, "again", flights=["first.yaml"])
    names = {p.name for p in (folder / "again_out" / "figures").glob("*")}
    assert "tracks.svg" in names
    assert "held_out_1.svg" not in names


def test_without_fit_on_each_flight_is_left_out_once(folder: Path) -> None:
    path = write_campaign(folder, "left_out", held_out={"fit": {YAW: [0, 60, 110, 160]}, "samples": 60})
    data = run(load_campaign(path), folder)
    assert [(f.fitted_on, f.applied_to) for f in data.held_out] == [
        (("second",), ("first",)),
        (("first",), ("second",)),
    ]
    assert all(fold.parameters == {YAW: YAW_DEG} for fold in data.held_out)


def test_parameters_without_effect_and_at_a_bound_are_named(folder: Path) -> None:
    path = write_campaign(
        folder,
        "flat",
        held_out={
            "fit": {"link.rss.uav.yaw_deg": [0, 90], YAW: [0, 50, 100]},
            "fit_on": ["first"],
            "samples": 60,
        },
    )
    (fold,) = run(load_campaign(path), folder).held_out
    assert fold.without_effect == ("link.rss.uav.yaw_deg",)
    assert YAW in fold.at_bounds


def test_a_planted_clock_shift_is_recovered_on_the_other_flight(folder: Path) -> None:
    """Both radio clocks show 1.5 s too much; the fit on one flight says so, and the other flight agrees."""
    for seed, name in enumerate(OFFSETS_DB, start=1):
        settings = flight_settings(name, seed, YAW_DEG)
        settings["flight"]["plan"]["clock_shift_s"] = {"LW1": 1.5}
        (folder / f"late_{name}.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        simulate(folder / f"late_{name}.yaml", folder / "late")
    path = write_campaign(
        folder,
        "late",
        flights=["late_first.yaml", "late_second.yaml"],
        held_out={"fit": {"rss.lag": [-1.5, 0.0, 0.5, 1.0, 1.5, 2.0]}, "fit_on": ["second"], "samples": 100},
    )
    (fold,) = run(load_campaign(path), folder, RunOptions(logs_root=folder / "late")).held_out
    assert fold.parameters == {"rss.lag": 1.5}
    held = [r for r in fold.rows if not r.fitted_here]
    assert len(held) == 2
    assert all(r.rmse_db < r.start_rmse_db for r in held)
    assert all(r.own == ("offset_db",) for r in held)


def test_a_lag_estimated_on_the_scored_samples_is_told(folder: Path) -> None:
    """``rss.lag: apply`` fits the clock of every flight on itself, held out or not."""
    for name in OFFSETS_DB:
        settings = flight_settings(name, 1, YAW_DEG)
        settings["rss"]["lag"] = "apply"
        settings["flight"]["plan"]["clock_shift_s"] = {"LW1": 1.5}
        (folder / f"apply_{name}.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        simulate(folder / f"apply_{name}.yaml", folder / "applied")
    flights = ["apply_first.yaml", "apply_second.yaml"]
    campaign = load_campaign(
        write_campaign(folder, "apply", flights=flights, held_out={"fit": {YAW: [YAW_DEG]}, "fit_on": ["first"]})
    )
    data = run(campaign, folder, RunOptions(logs_root=folder / "applied"))
    (fold,) = data.held_out
    by = {(r.flight, r.channel): r.fitted for r in data.rss}
    assert {(r.flight, r.channel): r.own for r in fold.rows} == by
    assert any("lag_s" in own for own in by.values())


def test_one_parameter_after_the_other_finds_what_all_combinations_find(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each channel's azimuth touches that channel only, so both searches must end at the same place."""
    grid = list(range(0, 360, 30))
    fit = {f"link.channels.{c}.tower.yaw_deg": grid for c in ("USRP1", "USRP2")}
    path = write_campaign(folder, "sweeps", held_out={"fit": fit, "fit_on": ["first"], "samples": 60})
    campaign = load_campaign(path)
    (product,) = run(campaign, folder).held_out
    monkeypatch.setattr(campaign_fit, "LARGEST_PRODUCT", 10)
    (sweeps,) = run(campaign, folder).held_out
    assert product.method == "every combination"
    assert "after the other" in sweeps.method
    assert sweeps.parameters == product.parameters == dict.fromkeys(fit, 120.0)


def test_a_pool_of_processes_gives_the_same_numbers(folder: Path) -> None:
    alone = result(folder, "alone")
    shared = result(folder, "shared", "--workers", "2")
    assert shared["rss"] == alone["rss"]
    assert shared["workers"] == 2


def test_exit_codes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flights = ["first.yaml", "missing.yaml"]
    result(folder, "some", flights=flights)
    result(folder, "some", "--strict", flights=flights, code=1)
    assert "missing" in capsys.readouterr().err
    result(folder, "none", flights=["missing.yaml"], code=3)


def test_json_is_alone_on_standard_output(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = result(folder, "quiet", "--json", flights=["first.yaml"])
    printed = json.loads(capsys.readouterr().out)
    assert unlisted("campaign", printed) == []
    assert printed["rss"] == written["rss"]
    assert printed["repeatability"]["pairs"] == []


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"settings": {"x": {"rt.max_deth": 1}}}, "max_depth"),
        ({"settings": {"x": {"rt.max_depth": 9}}}, "rt.max_depth"),
        ({"settings": {"x": {"rt.max_depth.y": 1}}}, "which is a value"),
        ({"settings": {"x": {"logs.7.path": "y"}}}, "no element '7'"),
        ({"held_out": {"fit": {YAW: [10, 0]}}}, "increasing"),
        ({"held_out": {"fit": {"rss.advanced.step_db": [1, 2]}}}, "below link, rt or site"),
        ({"held_out": {"fit": {YAW: [0, 10]}, "fit_on": ["frist"]}}, "did you mean 'first'"),
        ({"held_out": {"fit": {YAW: [0, 10]}, "setting": "as writen"}}, "as written"),
        ({"held_out": {"fit": {"link.rss.towr.yaw_deg": [0, 10]}}}, "tower"),
        ({"flights": ["first.yaml", "first.yaml"]}, "two flights are named 'first'"),
        ({"calibratoin": "all"}, "calibration"),
        ({"keep": "s3://lab/season"}, "object stores are not written any more"),
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


def test_a_channel_of_its_own_starts_as_a_copy(folder: Path) -> None:
    flight = load_flight(folder / "first.yaml")
    # the copy has what the same overrides change in its original, whatever their order
    changed = overridden(flight, {"link.channels.USRP2.tower.yaw_deg": 5.0, "link.rss.uav.yaw_deg": 7.0})
    channel = changed.link.channels["USRP2"]
    assert (channel.tower.yaw_deg, channel.uav.yaw_deg) == (5.0, 7.0)
    assert channel.tower.antenna.model == "tr38901"
    assert changed.link.rss.tower.yaw_deg == 0.0
    tower = overridden(flight, {"link.rss.towers.LW1.pitch_deg": 3.0}).link.rss.towers["LW1"]
    assert (tower.pitch_deg, tower.antenna.model) == (3.0, "tr38901")
    assert overridden(flight, {"logs.1.node": "LW2"}).logs[1].node == "LW2"
    assert isinstance(changed, FlightFile)
    with pytest.raises(UsageError, match="no key 'wings'"):
        overridden(flight, {"wings": 2})


def row(flight: str, channel: str, measured: Any, simulated: Any, **keys: Any) -> RssRow:
    """A row with levels and places; numbers that the functions under test do not read are NaN."""
    measured, simulated = np.asarray(measured, float), np.asarray(simulated, float)
    n = len(measured)
    nan = float("nan")
    given: dict[str, Any] = {
        "unit": "dBm", "offset_db": float(np.nanmean(simulated - measured)), "rmse_db": nan, "correlation": nan, "n": n,
        "n_out_of_coverage": 0, "at_search_edge": False, "rmse_ci95_db": None, "offset_ci95_db": None,
        "correlation_ci95": None, "n_effective": nan, "lag_s": nan, "lag_verdict": "", "fitted": (), "baselines": {},
        "step_db": 0.1, "span_db": (-50.0, 50.0), "time_s": np.arange(n) * 1.0,
        "position_m": np.stack([np.arange(n) * 3.0, np.zeros(n), np.full(n, 40.0)], axis=-1),
        "distance_m": np.arange(n) * 3.0,
    }  # fmt: skip
    return RssRow(
        flight=flight, setting="s", tower="LW1", channel=channel, measured_db=measured, simulated_dbm=simulated,
        **{**given, **keys},
    )  # fmt: skip


def test_shared_offsets_have_their_closed_form() -> None:
    """The least squares of everything in a group is the mean difference over its samples, not over its flights."""
    rows = [
        row("a", "USRP1", [0.0, 0.0, 0.0], [3.0, 3.0, 3.0]),
        row("b", "USRP1", [0.0, np.nan], [7.0, 100.0], unit="dB re full scale"),
        row("b", "USRP2", [1.0, 1.0], [0.0, 0.0]),
    ]
    done, groups = pool_offsets(rows, "channel")
    assert [g.group for g in groups] == ["USRP1", "USRP2"]
    assert [r.pooled_offset_db for r in done] == [4.0, 4.0, -1.0]  # (3 * 3 + 7) / 4
    assert [r.pooled_rmse_db for r in done] == [1.0, 3.0, 0.0]
    assert groups[0].pooled_rmse_db == 2.0
    assert groups[0].range_db == (3.0, 7.0)
    assert groups[0].spread_db == pytest.approx(np.sqrt(8.0))
    assert groups[0].units == ("dBm", "dB re full scale")
    everything, (one,) = pool_offsets(rows, "all")
    assert one.offset_db == 2.3  # 14 / 6 on the grid of 0.1 dB
    assert len({r.pooled_offset_db for r in everything}) == 1
    own, single = pool_offsets(rows, "link")
    assert [r.pooled_offset_db for r in own] == [3.0, 7.0, -1.0]
    assert len(single) == 3
    assert np.isnan(single[0].spread_db)


def test_repeatability_is_the_noise_of_both_flights_after_one_constant() -> None:
    rng = np.random.default_rng(5)
    n = 4000
    level = -60 + 10 * np.sin(np.arange(n) / 40)
    first = row("a", "USRP1", level + rng.normal(0, 2.0, n), level)
    second = row("b", "USRP1", level + 6.0 + rng.normal(0, 1.5, n), level)
    (pair,) = repeats([first, second], RepeatSettings(heading_within_deg=None))
    assert pair.n == n
    assert pair.share == 1.0
    assert pair.rmse_db == pytest.approx(2.5, rel=0.05)
    assert pair.residual_rmse_db == pytest.approx(2.5, rel=0.05)
    assert pair.offset_db == pytest.approx(6.0, abs=0.2)
    assert abs(pair.place_correlation) < 0.2  # nothing but noise comes back
    wrong = np.where(np.arange(n) % 400 < 200, 5.0, -5.0)
    (pair,) = repeats(
        [row("a", "USRP1", level + wrong, level), row("b", "USRP1", level + wrong, level)], RepeatSettings()
    )
    assert pair.rmse_db == pytest.approx(0.0, abs=1e-9)
    assert pair.place_correlation == pytest.approx(1.0)


def test_k_is_chosen_on_the_other_flights() -> None:
    """Flight c alone likes K = 1000; what the others choose for it costs it, and that is what is told."""
    errors = {"a": (0.1, 0.5), "b": (0.2, 0.4), "c": (0.6, 0.05)}
    rows = [
        RankRow(
            flight=flight, setting="s", tower="LW1", k=k, n=9, n_out_of_coverage=0, agreement=0.5, agreement_ci95=None,
            kappa=tv / 2, total_variation=tv, total_variation_ci95=None, wasserstein=0.0, best_k=k, best_k_ci95=None,
        )
        for flight, both in errors.items()
        for k, tv in zip((10.0, 1000.0), both, strict=True)
    ]  # fmt: skip
    found = {t.flight: t for t in transfer_ranks(rows)}
    assert found["c"].chosen_on == ("a", "b")
    assert (found["c"].k, found["c"].total_variation, found["c"].kappa) == (10.0, 0.6, 0.3)
    assert (found["c"].own_k, found["c"].own_total_variation) == (1000.0, 0.05)
    assert (found["a"].k, found["a"].total_variation) == (1000.0, 0.5)  # (0.4 + 0.05) / 2 against (0.2 + 0.6) / 2
    assert transfer_ranks([r for r in rows if r.flight == "a"]) == []


def test_flights_that_never_meet_have_no_floor() -> None:
    low, high = row("a", "USRP1", np.zeros(50), np.zeros(50)), row("b", "USRP1", np.zeros(50), np.zeros(50))
    up = high.position_m + np.array([0.0, 0.0, 30.0])
    high = row("b", "USRP1", np.zeros(50), np.zeros(50), position_m=up)
    (pair,) = repeats([low, high], RepeatSettings())
    assert pair.n == 0
    assert np.isnan(pair.rmse_db)
    assert pair.height_difference_m == 30.0
    assert repeats([low, row("b", "USRP2", np.zeros(50), np.zeros(50))], RepeatSettings()) == []


def test_places_are_square_cells_with_mean_residuals() -> None:
    found = place_means(row("a", "c", [1.0, 3.0, np.nan, 9.0], [0.0] * 4, offset_db=0.0, position_m=np.array(
        [[1.0, 1.0, 10.0], [19.0, 19.0, 30.0], [5.0, 5.0, 5.0], [-1.0, 1.0, 7.0]])), 20.0)  # fmt: skip
    assert found == {(0, 0): (2.0, 20.0), (-1, 0): (9.0, 7.0)}


def test_flights_without_a_sample_that_counts_give_no_number_and_end_nothing(folder: Path) -> None:
    found = result(
        folder,
        "too_low",
        "--strict",
        settings={"as written": {}, "high": {"rss.minimum_height_m": 500}},
        calibration="all",
        held_out={"fit": {YAW: [0, 110]}, "fit_on": ["first"], "setting": "high"},
        code=1,
    )
    rows = [r for r in found["rss"] if r["setting"] == "high"]
    assert [(r["n"], r["offset_db"], r["pooled_rmse_db"]) for r in rows] == [(0, None, None)] * 4
    assert "nothing can be fitted on first" in found["held_out"]["failure"]
    assert found["mean_rmse_db"]["high"] == {"first": None, "second": None}
    assert found["mean_rmse_db"]["as written"]["first"] > 4.0


def test_a_campaign_of_rank_flights(folder: Path) -> None:
    """Rank alone: no RSS tables, but rank rows, their transfer of K and the tracks."""
    for seed, name in enumerate(OFFSETS_DB, start=1):
        settings = flight_settings(name, seed, YAW_DEG)
        settings["flight"]["name"] = f"rank_{name}"
        settings["flight"]["plan"].update(rank_k=10, rank_interval_s=1.0, start=f"2025-06-0{seed}T10:00:00")
        track = {**settings["logs"][0], "path": f"rank_{name}/vehicleOut.txt"}  # not over that of the other tests
        settings["logs"] = [track, {"path": f"{name}/ri.csv", "reader": "quectel_ri", "node": "LW1"}]
        settings["rank"] = {"k": [10, 100], "advanced": {"bootstrap": 20}}
        (folder / f"rank_{name}.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        simulate(folder / f"rank_{name}.yaml")
    found = result(folder, "ranks", "--export", "geojson", flights=["rank_first.yaml", "rank_second.yaml"])
    points = json.loads((folder / "ranks_out" / "exports" / "rank.geojson").read_text(encoding="utf-8"))["features"]
    for row in found["rank"]:
        ranks = [p["properties"] for p in points if p["properties"]["flight"] == row["flight"]]
        pairs = [(r["measured_rank"], r[f"simulated_rank_k{row['k']:g}"]) for r in ranks]
        alike = [a == b for a, b in pairs if a is not None and b]
        assert sum(alike) / len(alike) == pytest.approx(row["agreement"], abs=1e-9)
    assert found["rss"] == []
    assert {(r["flight"], r["k"]) for r in found["rank"]} == {(f"rank_{n}", k) for n in OFFSETS_DB for k in (10, 100)}
    for transfer in found["rank_transfers"]:
        assert transfer["k"] == 10  # the simulated modem's
        assert transfer["total_variation"] < 0.05
    assert {p.stem for p in (folder / "ranks_out" / "figures").glob("*.svg")} == {"rank_tv", "tracks"}
    page = (folder / "ranks_out" / "campaign.html").read_text(encoding="utf-8")
    assert "Mean RMSE over towers" not in page
    assert "K chosen on the other flights" in page


FIELD = os.environ.get("AERPAW_CMP_FIELD_DATA", "")
CAMPAIGNS = Path(__file__).parents[1] / "field" / "campaigns"
needs_logs = pytest.mark.skipif(
    not FIELD or not Path(FIELD).is_dir(), reason="AERPAW_CMP_FIELD_DATA is not set: no real logs"
)


def real(name: str, folder: Path, **changes: Any) -> dict[str, Any]:
    """campaign.json of a campaign in tests/field/campaigns, with some of its keys changed; clocks as in the logs."""
    entries = yaml.safe_load((CAMPAIGNS / f"{name}.yaml").read_text(encoding="utf-8"))
    entries["flights"] = [str((CAMPAIGNS / flight).resolve()) for flight in entries["flights"]]
    for key, value in changes.items():
        entries.setdefault(key, {}).update(value)
    for setting in entries["settings"].values():
        setting["rss.lag"] = "off"  # tests/test_field.py estimates the lags of these flights
    (folder / "campaign.yaml").write_text(yaml.safe_dump(entries, sort_keys=False), encoding="utf-8")
    out = folder / "out"
    assert main(["campaign", str(folder / "campaign.yaml"), "-o", str(out), "--logs-root", FIELD, "--strict"]) == 0
    found: dict[str, Any] = json.loads((out / "campaign.json").read_text(encoding="utf-8"))
    return found


@pytest.mark.field
@needs_logs
def test_two_real_flights(tmp_path: Path) -> None:
    """The measured patterns need other azimuths than the paper's, and either flight says so for the other."""
    azimuths = [60, 110, 160, 285]  # the best of a step of 50 degrees, its neighbours, the other side
    fit = {f"link.channels.{channel}.tower.yaw_deg": azimuths for channel in ("USRP1", "USRP2")}
    found = real("dataset12", tmp_path, held_out={"samples": 400, "fit": {"link.rss.uav.yaw_deg": [270, 315], **fit}})
    for name, rmse in (("dataset12_40m", (6.56 + 5.47) / 2), ("dataset12_70m", (7.14 + 6.30) / 2)):
        assert found["mean_rmse_db"]["isotropic, line of sight"][name] == pytest.approx(rmse, abs=0.05)
    assert len(found["held_out"]["folds"]) == 2
    for fold in found["held_out"]["folds"]:
        assert fold["parameters"]["link.rss.uav.yaw_deg"] == 270
        assert fold["parameters"]["link.channels.USRP1.tower.yaw_deg"] == 110
        held = [r for r in fold["scores"] if not r["fitted_here"]]
        assert np.mean([r["rmse_db"] for r in held]) < np.mean([r["start_rmse_db"] for r in held]) - 0.3
        assert np.mean([r["rmse_db"] for r in held]) < 4.8
    for pair in found["repeatability"]["pairs"]:
        assert 3.0 < pair["rmse_db"] < 6.0
        assert pair["share"] < 0.25  # they meet on the way up and down only
        assert pair["height_difference_m"] == pytest.approx(30.0, abs=1.0)


@pytest.mark.field
@needs_logs
def test_two_real_rank_flights_choose_one_k_when_slanted(tmp_path: Path) -> None:
    found = real("nr_rank", tmp_path)
    transferred = {(t["setting"], t["flight"]): t for t in found["rank_transfers"]}
    assert {t["k"] for (setting, _), t in transferred.items() if setting == "slanted"} == {10}
    for (setting, _), t in transferred.items():
        assert (t["total_variation"] < 0.11) == (setting == "slanted")


def test_status_dry_run_and_resume_say_what_is_kept(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = {"as written": {"rss.advanced.lag_window_s": 11}, "level": {"rss.advanced.lag_window_s": 12}}
    path = write_campaign(folder, "kept", flights=["first.yaml", "second.yaml"], settings=settings, keep="outcomes")
    campaign = load_campaign(path)
    run(
        load_campaign(write_campaign(folder, "part", flights=["first.yaml"], settings=settings)),
        folder,
        keep=folder / "outcomes",
    )
    capsys.readouterr()
    assert main(["campaign", "status", str(path), "--json", "--workers", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert unlisted("campaign status", found) == []
    assert (found["tasks"], found["kept"], found["failed"], found["to_do"]) == (4, 2, 0, 2)
    assert {one["flight"] for one in found["to_do_tasks"]} == {"second"}
    assert found["estimate_s"] > 0
    assert main(["campaign", "--dry-run", str(path)]) == 0
    text = capsys.readouterr().out
    assert "4 tasks, 2 kept" in text
    assert "2 to do, about" in text
    run(campaign, folder, keep=folder / "outcomes")
    assert main(["campaign", "status", str(path), "-h"]) == 0
    assert main(["campaign", "status", str(path)]) == 0
    assert "0 to do, nothing to compute" in capsys.readouterr().out
    assert main(["campaign", "statsu", str(path)]) == 2
    assert "campaign status" in capsys.readouterr().err


def test_a_failed_task_leaves_its_traceback_in_a_file(folder: Path) -> None:
    broken = flight_settings("first", 1, 0.0)
    broken["flight"] = {"name": "broken2"}
    broken["logs"][1]["path"] = "gone.txt"
    (folder / "broken2.yaml").write_text(yaml.safe_dump(broken), encoding="utf-8")
    found = result(folder, "traced", flights=["broken2.yaml"], code=3)
    assert "traceback" not in found["failures"][0]
    text = (folder / "traced_out" / "failures" / "broken2__as_written.txt").read_text(encoding="utf-8")
    assert "there is no such log" in text
    assert "Traceback (most recent call last)" in text


def test_what_goes_round() -> None:
    assert goes_round(np.arange(0, 360, 10))
    assert goes_round([-180.0, -60.0, 60.0])
    assert goes_round(np.arange(0, 361, 10))
    assert not goes_round(np.arange(0, 180, 10))
    assert not goes_round([0.0, 10.0, 20.0, 350.0, 700.0])
    assert not goes_round([0.0, 180.0])


def test_an_azimuth_that_goes_round_has_no_bound(folder: Path) -> None:
    """The best of values over the circle is the first of them; of values over a half it would be at a bound."""
    for values, bound in (([110, 200, 290, 380], ()), ([110, 200], (YAW,))):
        path = write_campaign(folder, "round", held_out={"fit": {YAW: values}, "fit_on": ["first"], "samples": 60})
        (fold,) = run(load_campaign(path), folder).held_out
        assert fold.parameters == {YAW: 110.0}
        assert fold.at_bounds == bound


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=5, unique=True), st.integers(1, 3))
def test_the_search_gives_the_least_of_every_combination(values: list[float], keys: int) -> None:
    grids = {str(key): sorted(values) for key in range(keys)}
    found = search(lambda point: sum((x - 0.4) ** 2 for x in point.values()), grids)
    assert set(found.point.values()) == {min(sorted(values), key=lambda x: (x - 0.4) ** 2)}
    assert len(found.tried) == len(values) ** keys
