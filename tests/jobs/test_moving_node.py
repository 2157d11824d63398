"""A flight against a rover that drives: from its log of positions to the report's numbers."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.replay import FlightReplay, replay_rank, replay_rss
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.audit_flight import standing
from aerpaw_cmp.jobs.compare_flight import compare_rank_series, compare_rss_series
from aerpaw_cmp.jobs.explain import run_explain
from aerpaw_cmp.jobs.flight_run import flight_comparison
from aerpaw_cmp.propagation.field.baselines import two_ray_dbm
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.report import explorer
from aerpaw_cmp.report.columns import RANK, RSS, csv_text
from aerpaw_cmp.site.siteyaml import load_site
from tests.simulated import write_yaml
from tests.tables import ORIGIN, POSITIONS, rank_log, rss_log, table_log, write_csv

FRAME = load_site("lake_wheeler").frame
SECONDS = 120


def uav(t: np.ndarray) -> np.ndarray:
    return np.stack([-200 + 4.0 * t, 100 + 1.0 * t, 40.0 + 0 * t], axis=1)


def rover(t: np.ndarray) -> np.ndarray:
    return np.stack([60.0 - 1.5 * t, -40.0 + 0.8 * t, 2.0 + 0 * t], axis=1)


def positions(path: Path, t: np.ndarray, places: np.ndarray) -> dict:
    latitude, longitude = FRAME.to_geographic(places[:, 0], places[:, 1])
    write_csv(path, "t,lat,lon,alt", t, latitude, longitude, places[:, 2])
    return table_log(path.name, "telemetry", POSITIONS)


def flown(
    folder: Path, *, engine: str = "image", gap: tuple[float, float] = (50.0, 60.0), start: float = 0.0, origin=ORIGIN
) -> Path:
    """Logs whose level is the closed form of two rays between the two ends, less 20 dB."""
    t, at = np.arange(0.0, SECONDS + 1), np.arange(0.0, SECONDS, 0.5)
    logged = t[(t <= gap[0]) | (t >= gap[1])]
    level = [two_ray_dbm(r[None], u[None], 3.3e9, 40.0)[0, 0] for r, u in zip(rover(at), uav(at), strict=True)]
    track = positions(folder / "rover.csv", logged + start, rover(logged)) | {"time_origin": origin}
    return write_yaml(folder / "flight.yaml", {
        "flight": "rover", "site": {"file": "lake_wheeler", "without_buildings": True}, "timezone": "America/New_York",
        "towers": {"ROVER": {"track": {k: v for k, v in track.items() if v}, "antenna_height_m": 2}},
        "logs": [
            positions(folder / "track.csv", t, uav(t)), rss_log(folder, "a", at, np.array(level) - 20.0, "ROVER"),
            rank_log(folder, t, np.ones(len(t)), "ROVER"),
        ],
        "rt": {"engine": engine, "max_depth": 1, "audit_links": 0}, "rss": {"lag": "off", "span_db": [-100, 100]},
        "rank": {"tower": "ROVER"},
    })  # fmt: skip


def data_of(path: Path) -> FlightData:
    return load_data(load_flight(path), path.parent)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rover")
    path = flown(folder)
    data = data_of(path)
    return path, data, replay_rss(data), replay_rank(data)


def test_the_closed_form_along_both_tracks(case):
    _, data, (replayed,), _ = case
    compared = compare_rss_series(data, data.rss[0], replayed)
    t = np.arange(0.0, SECONDS, 0.5)
    lost = (t > 50) & (t < 60)
    np.testing.assert_array_equal(
        compared.posed, ~lost
    )  # there is no pose in a gap of the rover's log, as in one of the UAV's
    assert compared.score.n == (~lost).sum()
    error = compared.measured_db - compared.simulated_dbm
    # the track is linear between rows, and so is the way: what is left is the rounding of the coordinates
    assert np.nanmax(np.abs(error + 20.0)) < 0.02
    assert compared.score.rmse_db < 0.02
    np.testing.assert_allclose(compared.tower_m[~lost], rover(t)[~lost], atol=1e-3)
    away = np.linalg.norm(uav(t) - rover(t), axis=1)
    np.testing.assert_allclose(compared.geometry["distance_m"][~lost], away[~lost], atol=2e-3)
    assert compared.baselines["two_ray"].rmse_db < 0.02
    # from the rover's middle the same levels are far off
    assert compared.baselines["free_space"].rmse_db > 0.5


def test_rank_and_ladder_have_the_place_of_each_sample(case):
    _, data, rss, rank = case
    assert rank[0].tower_m.shape == (len(rank[0].poses), 3)
    np.testing.assert_allclose(rank[0].tower_m, rover(np.r_[0:51, 60:121].astype(float)), atol=1e-3)
    comparison = flight_comparison(data, FlightReplay(rss=tuple(rss), rank=()))
    names = [candidate.model for candidate in comparison.scores.candidates]
    coherent = names.index(next(n for n in names if n.startswith("coherent ground reflection")))
    assert comparison.scores.rmse_db[coherent] < 0.02
    assert comparison.scores.rmse_db[0] > 0.5


def test_explain_stands_where_the_rover_was(case):
    path, _, (replayed,), _ = case
    explained = run_explain(path, time="30.0", tower="ROVER", channel="a")
    assert explained.level_dbm == pytest.approx(replayed.spread(replayed.replay.rss_dbm[:, 0])[60], abs=1e-9)
    assert any("ROVER moves: it was at 15.0 m east, -16.0 m north, 2.0 m up" in note for note in explained.notes)


def test_the_audit_takes_moments_at_which_the_rover_stands_where_it_was(case):
    _, data, (replayed,), _ = case
    moments = list(standing(data, [replayed]))
    assert len(moments) == 6
    for site, moment, _expected, _rt in moments:
        at = int(np.argmin(np.linalg.norm(replayed.poses.position_m - moment.poses.position_m, axis=1)))
        np.testing.assert_allclose(site.towers["ROVER"].position_m, replayed.tower_m[at], atol=1e-9)
        again = replay(site, moment.link, moment.poses, Search(max_depth=1))
        assert again.rss_dbm[0, 0] == pytest.approx(moment.replay.rss_dbm[0, 0], abs=1e-9)
        assert len(again.paths) == len(moment.replay.paths)


def test_the_tables_carry_the_place(case):
    _, data, (replayed,), (rank,) = case
    rss = "".join(csv_text(RSS, [compare_rss_series(data, data.rss[0], replayed)])).splitlines()
    ranks = "".join(csv_text(RANK, [compare_rank_series(data, data.rank[0], rank)])).splitlines()
    for head, first, *_ in (rss, ranks):
        row = dict(zip(head.split(","), first.split(","), strict=True))
        place = [float(row[f"tower_{axis}_m"]) for axis in ("east", "north", "up")]
        assert place == pytest.approx([60, -40, 2], abs=0.01)


def test_the_drawings_show_the_way(case):
    """The plan and the figures show the node's position at each sample, not only the middle of its track."""
    _, data, (replayed,), (rank,) = case
    rss = compare_rss_series(data, data.rss[0], replayed)
    ranks = compare_rank_series(data, data.rank[0], rank)
    t = np.arange(0.0, SECONDS, 0.5)
    known = (t <= 50) | (t >= 60)
    columns: list[np.ndarray] = []
    arrays = SimpleNamespace(add=lambda values, *_: columns.append(values) or len(columns) - 1)
    drawn = explorer._place(rss, np.arange(0, len(t), 3), arrays)
    places = np.stack([columns[drawn[f"tower_{axis}"]] for axis in ("east", "north", "up")], axis=1)
    np.testing.assert_allclose(places[known[::3]], rover(t)[::3][known[::3]], atol=1e-3)
    assert np.isnan(places[~known[::3]]).all()
    for result in (rss, ranks):
        assert np.nanmax(result.tower_m, axis=0)[:2] == pytest.approx([60.0, 56.0], abs=0.5)


def test_what_cannot_be_is_one_message(tmp_path, capsys):
    with pytest.raises(InputError, match=r"no overlap in time: RSS of ROVER .* the track of this tower"):
        data_of(flown(tmp_path, start=5000.0))
    assert main(["report", str(flown(tmp_path, engine="sionna")), "-o", str(tmp_path / "out")]) == 2
    assert "towers.ROVER moves and the engine is 'sionna'" in capsys.readouterr().err
    with pytest.raises(InputError, match="no overlap in time") as caught:
        data_of(flown(tmp_path, origin=None))
    assert "time_origin" in str(caught.value)
