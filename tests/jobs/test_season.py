"""A campaign from its rows: held-out errors against brute force, and a known hill of residuals."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.jobs.campaign import find_reports, rank_settings, soundings, with_season
from benchmarks import fabricated

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def data():
    return fabricated.season(24, 4, 2, 2)


def test_held_out_errors_are_those_of_the_offset_of_the_others(data):
    rows = [r for r in data.rss if (r.setting, r.link) == ("setting 01", "LW2 USRP1")]
    assert len(rows) > 4
    for row in rows[:4]:
        others = [r for r in rows if r.flight != row.flight]
        difference = np.concatenate([r.simulated_dbm - r.measured_db for r in others])
        assert row.held_out_offset_db == pytest.approx(difference.mean(), abs=0.05 + 1e-9)
        left = row.measured_db + row.held_out_offset_db - row.simulated_dbm
        assert row.held_out_rmse_db == pytest.approx(np.sqrt((left**2).mean()), rel=1e-9)
        assert row.held_out_rmse_db >= row.rmse_db - 1e-9


def test_the_best_setting_stands_first_and_the_rest_by_flights_of_both(data):
    ranking = data.season.ranking
    assert ranking[0].setting == "setting 02"
    assert ranking[-1].setting == "setting 00"
    first = {(r.flight, r.link): r.held_out_rmse_db for r in data.rss if r.setting == "setting 02"}
    last = {(r.flight, r.link): r.held_out_rmse_db for r in data.rss if r.setting == "setting 00"}
    by_flight = {}
    for flight, link in set(first) & set(last):
        by_flight.setdefault(flight, []).append(last[flight, link] - first[flight, link])
    assert ranking[-1].n_paired == len(by_flight)
    assert ranking[-1].difference_db == pytest.approx(np.mean([np.mean(v) for v in by_flight.values()]))
    low, high = ranking[-1].difference_ci95_db
    assert 0 < low < ranking[-1].difference_db < high
    assert ranking[-1].verdict == "worse"
    assert len(ranking) == len(data.settings)


def test_settings_that_share_no_flight_have_no_difference(data):
    early = [r for r in data.rss if r.setting == "setting 01" and r.flight < "flight_012"]
    rows = early + [r for r in data.rss if r.setting == "setting 02" and r.flight >= "flight_012"]
    ranking = rank_settings(rows, ["setting 01", "setting 02"], data.flights)
    assert np.isnan(ranking[1].difference_db)
    assert ranking[1].verdict == "no interval"


def test_the_planted_hill_lies_where_it_was_put(data):
    """Mean residual of all links by place: highest near (200 m, 300 m), north not flipped, east not exchanged."""
    residual_db = np.array(list(data.season.places_db.values()))
    east_m, north_m = (np.array(list(data.season.places_db)).T + 0.5) * data.cell_m
    near = np.hypot(east_m - 200, north_m - 300) < 100
    mirror = np.hypot(east_m - 200, north_m + 100) < 100
    assert near.any()
    assert residual_db[near].mean() > residual_db[~near].mean() + 1.0
    if mirror.any():
        assert residual_db[near].mean() > residual_db[mirror].mean() + 1.0


def test_one_flight_has_its_own_errors_only(data):
    alone = with_season(
        dataclasses.replace(
            data, flights=data.flights[:1], rss=tuple(r for r in data.rss if r.flight == data.flights[0])
        )
    )
    assert not alone.season.held_out
    assert all(np.isnan(r.held_out_rmse_db) for r in alone.rss)
    assert alone.season.ranking[0].mean_db > 0


def test_relative_clocks_have_no_date(data):
    bare = with_season(dataclasses.replace(data, rss=tuple(dataclasses.replace(r, start_ns=0) for r in data.rss)))
    assert bare.season.started == {}
    assert all(set(node.night) <= set(data.flights) for node in bare.season.nodes)


def test_a_campaign_without_levels(data):
    assert with_season(dataclasses.replace(data, rss=())).season.ranking == ()


def test_soundings_between_towers_show_a_radio_that_lost_a_decibel_last_night(tmp_path: Path):
    """Names and lines are those of AERPAW's nightly script. ``null`` is the noise without a transmitter."""
    rng, towers = np.random.default_rng(3), ("LW1", "LW2", "LW3", "LW4", "LW5")
    for night in range(1, 16):
        weather = rng.normal()
        for sent in ("null", *towers):
            for received in towers:
                lost = 1.0 if (received, night) == ("LW2", 15) else 0.0
                level = -30.0 + weather - lost + rng.normal(0.0, 0.1)
                for kind in ("power", "quality"):
                    name = f"{sent}:{received}:3235{received[2]}:3.32G:0:2026-06-{night:02}_02_00_05:{kind}_log.txt"
                    line = f"[2026-06-{night:02} 02:00:07.000000] 0000004 {level if kind == 'power' else 3.0:15.6f}\n"
                    if sent != received:
                        (tmp_path / name).write_text(line)
    nodes = soundings([tmp_path], "America/New_York")
    assert len(nodes) == 10
    (stepped,) = (node for node in nodes if node.steps)
    assert (stepped.node, stepped.night[-1]) == ("3320 MHz, LW2 32352:0 receives", "2026-06-15")
    (step,) = stepped.steps
    assert (step.night, step.shown) == ("2026-06-15", "2026-06-15")
    assert step.step_ci95_db[0] < 1.0 < step.step_ci95_db[1]  # lost level: more is added
    with pytest.raises(InputError, match="no log names transmitter and receiver"):
        soundings([ROOT / "sample_logs" / "LW1"], "America/New_York")


def test_reports_beside_the_campaign_are_linked(tmp_path: Path):
    for name in ("first", "third one"):
        folder = tmp_path / "reports" / name
        folder.mkdir(parents=True)
        (folder / "report.html").write_text("")
    links = find_reports(["first", "third one", "absent"], tmp_path / "reports" / "season")
    assert links == {"first": "../first/report.html", "third one": "../third%20one/report.html"}
