"""A draft says which tower, or which place, the levels of a log fit."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.common.yamlfile import parse_yaml
from aerpaw_cmp.compare.locate import LevelModel, LevelTrack, NodeEstimate, Regions, known_cases, level_track
from aerpaw_cmp.flight.data import ground_nodes
from aerpaw_cmp.flight.drafting import proposals as node
from aerpaw_cmp.flight.drafting.draft import DraftOptions, draft
from aerpaw_cmp.flight.drafting.proposals import listed_places
from aerpaw_cmp.flight.gains import sphere_angles
from aerpaw_cmp.flight.settings import FlightFile
from aerpaw_cmp.logs.ingest import IngestedFile, ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import COLUMNS, Stream
from aerpaw_cmp.site.learned import SpherePattern, sphere_grid, unit_mean_gain
from aerpaw_cmp.site.siteyaml import load_site

SITE = load_site("lake_wheeler")
ORIGIN = "2025-06-01T14:00:00Z"


def _track() -> FloatArray:
    """A lawnmower of 300 m by 300 m, once a second: east, north, up from the site's origin."""
    along = np.linspace(0.0, 5.0, 500, endpoint=False)
    leg, part = np.divmod(along, 1.0)
    east = np.where(leg % 2 == 0, part, 1.0 - part) * 300.0 - 250.0
    return np.column_stack([east, leg * 60.0 - 50.0, np.full(500, 30.0)])


def _logs(folder: Path, node: tuple[float, float, float], level_100_m: float, slope: float = 3.0) -> list[IngestedFile]:
    track = _track()
    latitude, longitude = SITE.frame.to_geographic(track[:, 0], track[:, 1])
    rows = zip(range(500), latitude, longitude, track[:, 2], strict=True)
    (folder / "pose.csv").write_text("t,lat,lon,alt\n" + "".join(f"{t},{a:.7f},{o:.7f},{h}\n" for t, a, o, h in rows))
    away = np.linalg.norm(track - np.array(node), axis=1)
    level = level_100_m - 10.0 * slope * np.log10(away / 100.0) + np.random.default_rng(3).normal(0.0, 2.0, 500)
    (folder / "levels.csv").write_text("t,p\n" + "".join(f"{t},{v:.2f}\n" for t, v in enumerate(level)))
    named = {"time": "t", "latitude_deg": "lat", "longitude_deg": "lon", "altitude_m": "alt"}
    of_pose = ReadOptions(time_origin=ORIGIN, kind="telemetry", columns=named)
    of_level = ReadOptions(time_origin=ORIGIN, kind="rss", columns={"time": "t", "rss_db": "p"}, unit="dBm")
    return [
        *ingest([folder / "pose.csv"], reader="generic_csv", options=of_pose),
        *ingest([folder / "levels.csv"], reader="generic_csv", options=of_level),
    ]


def _drafted(folder: Path, node: tuple[float, float, float], level_100_m: float = -60.0) -> tuple[FlightFile, str]:
    text, remarks = draft(_logs(folder, node, level_100_m), folder, DraftOptions(time_origin=ORIGIN))
    return parse_yaml(text, FlightFile), "\n".join(remarks)


@pytest.mark.parametrize(
    ("place", "searched"), [(tuple(SITE.towers["LW1"].position_m), False), ((150.0, 90.0, 2.0), True)]
)
def test_an_airframe_is_searched_for_levels_with_any_name_if_no_tower_fits(
    place: tuple[float, float, float], searched: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    searches: list[object] = []
    monkeypatch.setattr("aerpaw_cmp.flight.drafting.draft.searching_airframe", lambda *each: searches.append(each))
    _drafted(tmp_path, place)
    assert bool(searches) is searched


@pytest.mark.parametrize(("first", "apart_m"), [(True, 400.0), (False, 400.0), (True, 3.0)])
def test_of_two_vehicles_the_levels_name_the_one_that_carried_the_radio(
    tmp_path: Path, first: bool, apart_m: float
) -> None:
    """Another aircraft that flew the same pattern is distinguished from a second log of one aircraft."""
    files = _logs(tmp_path, tuple(SITE.towers["LW1"].position_m), -60.0, slope=2.0)
    (stream,) = files[0].result.streams
    moved = stream.frame.assign(longitude_deg=stream.frame["longitude_deg"] - apart_m / 90_400.0)
    other = replace(
        files[0], path=str(tmp_path / "other.csv"), sha256="0" * 64,
        result=replace(files[0].result, streams=(replace(stream, name="other", frame=moved),)),
    )  # fmt: skip
    (tmp_path / "other.csv").write_text("x")
    both = [files[0], other] if first else [other, files[0]]
    _, remarks = draft([*both, files[1]], tmp_path, DraftOptions(time_origin=ORIGIN))
    asked = [remark for remark in remarks if "which of them carried the radio?" in remark]
    assert len(asked) == (apart_m > 30.0)
    if asked:
        assert "pose.csv" in asked[0]
        assert f"m apart, and the levels fit {stream.name}: which" in asked[0]
        assert "left out: other.csv: the track comes from other telemetry" in remarks


ROVER = (-120.0, 90.0, 1.5)


def test_levels_of_no_tower_are_placed_and_asked_about(tmp_path: Path) -> None:
    settings, remarks = _drafted(tmp_path, ROVER)
    assert settings.logs[1].node == "NODE"
    node = settings.towers["NODE"]
    east, north = SITE.frame.to_local(np.array([node.latitude_deg or 0.0]), np.array([node.longitude_deg or 0.0]))
    assert np.hypot(east[0] - ROVER[0], north[0] - ROVER[1]) < 25.0
    assert "no tower fits the levels" in remarks  # LW1 is outside the region
    assert "where was the node?" in remarks
    ground_nodes(SITE, settings, tmp_path, warnings := list[str]())
    assert [f"(90 % region: {node.region90_m:.0f} m)" in text for text in warnings] == [True]


def test_a_position_list_is_tried_first(tmp_path: Path) -> None:
    places = np.array([ROVER, (60.0, -20.0, 1.5), (-200.0, 300.0, 1.5)])
    latitude, longitude = SITE.frame.to_geographic(places[:, 0], places[:, 1])
    lines = [f"{a:.8f}, {o:.8f}" for a, o in zip(latitude, longitude, strict=True)]
    flipped = [f"{o:.8f}, {a:.8f}" for a, o in zip(latitude, longitude, strict=True)]
    (tmp_path / "rover_positions.txt").write_text("\n".join([lines[1], lines[0], lines[2], "", "flipped", *flipped]))
    assert [place.line for place in listed_places([tmp_path])] == [1, 2, 3, 6, 7, 8]
    settings, remarks = _drafted(tmp_path, ROVER)
    assert settings.towers["NODE"].latitude_deg == pytest.approx(latitude[0], abs=1e-6)
    assert "line 2 of rover_positions.txt" in remarks


@pytest.mark.parametrize(("level_100_m", "moved"), [(-45.0, False), (5.0, True), (-140.0, True)])
def test_the_span_of_offsets_holds_the_expected_one(tmp_path: Path, level_100_m: float, moved: bool) -> None:
    settings, _ = _drafted(tmp_path, tuple(SITE.towers["LW1"].position_m), level_100_m)
    low, high = settings.rss.span_db
    expected = 40.0 - 82.8 - level_100_m  # Friis over 100 m at 3.3 GHz: -82.8 dB
    assert low + 10.0 < expected < high - 10.0
    assert ((low, high) != (-50.0, 50.0)) is moved


def test_relative_levels_are_placed_where_the_track_that_dates_them_was(tmp_path: Path) -> None:
    """Their tower and their span of offsets come from the levels, as those of a log with a clock do."""
    pose, _ = _logs(tmp_path, tuple(SITE.towers["LW1"].position_m), -105.0, slope=2.0)
    rows = zip(*((tmp_path / name).read_text().splitlines()[1:] for name in ("pose.csv", "levels.csv")), strict=True)
    cells = [(*place.split(","), level.split(",")[1]) for place, level in rows]
    lines = [f"{t},{(int(t) - 99) * 1000},{a},{o},{up},3,{p},," for t, a, o, up, p in cells]
    head = "index,rel_time_ms,lat,lon,alt_m,pdsch_rank,nr_rsrp_dbm,nr_sinr_db,wb_cqi"
    (tmp_path / "nemo.csv").write_text("\n".join([head, *lines, ""]))
    text, _ = draft([pose, *ingest(tmp_path / "nemo.csv")], tmp_path, DraftOptions())
    assert "no position fits the levels clearly better than LW1: is it this tower?" in text
    assert parse_yaml(text, FlightFile).rss.span_db == (40.0, 90.0)  # Friis: 62.2 dB at 100 m


def _node_finder(listed: list[node.ListedPlace] | None = None) -> node.NodeFinder:
    track = _track()
    latitude, longitude = SITE.frame.to_geographic(track[:, 0], track[:, 1])
    time = np.datetime64("2025-06-01T14:00:00", "ns") + np.arange(500) * np.timedelta64(1, "s")
    frame = pd.DataFrame({"time": time, "line": 1, "flag": "", "latitude_deg": latitude, "longitude_deg": longitude,
                          "altitude_m": np.where(np.arange(500) < 9, 4.9, track[:, 2])})  # fmt: skip
    nothing = dict.fromkeys(set(COLUMNS["telemetry"]) - set(frame), np.nan)
    return node.NodeFinder(SITE, Stream("telemetry", "x", frame.assign(**nothing)), listed or [])


def _place(at: tuple[float, float], line: int) -> node.ListedPlace:
    latitude, longitude = SITE.frame.to_geographic(np.array([at[0]]), np.array([at[1]]))
    return node.ListedPlace("list.txt", line, float(latitude[0]), float(longitude[0]))


@pytest.mark.parametrize(
    ("towers", "listed", "said"),
    [((-0.5, -3.0), (), "LW1"), ((-0.6, -3.0), (), "estimate"), ((0.0, 7.0), (), "LW2"), ((2.5, 0.0), (2.4, 0.0), "LW1"),
     ((2.4, 0.0), (0.0, 2.4), 8), ((-9.0, -9.0), (-5.1, -6.0), "estimate"), ((-9.0, -9.0), (-5.0, -6.0), 7)],
)  # fmt: skip
def test_a_tower_stands_unless_a_place_wins_and_a_listed_one_wants_as_much_as_any_tower(
    towers: tuple[float, ...], listed: tuple[float, ...], said: str | int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Odds of towers are in their order. A list has lines 7 and 8, and a line 6 km away whose odds are not computed."""
    names = list(SITE.towers)
    finder = _node_finder(
        [_place((-100.0, 50.0), 7), _place((250.0, -90.0), 8), _place((6000.0, 0.0), 9)][: 3 * bool(listed)]
    )
    odds = np.full(len(names), -20.0)
    odds[:2] = towers
    at = np.array([30.0, 40.0, 10.0]) if listed else np.array([*SITE.towers["LW1"].position_m[:2], 10.0])
    estimate = NodeEstimate(
        anywhere=0.0, placed=True,
        place_m=at, radius90_m=77.0, height_m=(1.5, 10.0), slope=3.0, slope_sd=0.2,
        at_edge=False, regions=Regions.of(at[None], np.ones(1)),
    )  # fmt: skip
    asked: list[FloatArray] = []
    monkeypatch.setattr(node, "locate", lambda _: estimate)
    monkeypatch.setattr(node, "place_odds", lambda _, places: asked.append(places) or np.array([*odds, *listed]))
    track = level_track(4.0 * np.arange(20), np.zeros((20, 3)), np.zeros(20))
    proposal = finder.propose(track)
    assert proposal is not None
    assert len(asked[0]) == len(names) + len(listed)
    assert finder.propose(level_track(4.0 * np.arange(19), np.zeros((19, 3)), np.zeros(19))) is None
    if isinstance(said, int):
        assert proposal.tower is not None
        assert (proposal.node, *list(proposal.tower.values())[2:]) == ("NODE", 1.5, 377)  # from line 7 to line 8
        assert f"line {said}" in proposal.question
        assert (f"line {15 - said}" in proposal.question) == (max(listed) - min(listed) < 3.0)
        np.testing.assert_allclose(asked[0][-2:], [[-100.0, 50.0, 1.5], [250.0, -90.0, 1.5]], atol=1e-3)
    elif said == "estimate":
        assert proposal.tower is not None
        east, north = SITE.frame.to_local(*(np.array([proposal.tower[f"{k}_deg"]]) for k in ("latitude", "longitude")))
        assert (east[0], north[0]) == pytest.approx(tuple(at[:2]), abs=0.02)
        near = [n for n, t in SITE.towers.items() if np.hypot(*(np.array(t.position_m) - at)[:2]) <= 77.0]
        assert (f"({', '.join(near)} possible)" if near else "no tower fits") in proposal.question
        assert (proposal.tower["region90_m"], proposal.tower["antenna_height_m"]) == (77, 10.0)
        assert proposal.position_m is not None
        again = finder.propose(track, nodes={proposal.node: proposal.position_m})
        assert again is not None
        assert (again.node, again.tower) == (proposal.node, None)  # the same place has one name
    else:
        assert (proposal.node, proposal.tower) == (names[("LW1", "LW2").index(said)], None)


def test_nodes_a_hundred_metres_apart_have_names_of_their_own() -> None:
    finder = _node_finder()
    names, nodes = [], {}
    for east in (0.0, 99.0, 101.0, 300.0, 102.0):
        placement = node._node(np.array([east, 0.0, 1.5]), (35.0, -78.0, 1.5), "", nodes)
        nodes |= {} if placement.position_m is None else {placement.node: placement.position_m}
        names.append(placement.node)
    assert names == ["NODE", "NODE", "NODE2", "NODE3", "NODE2"]
    for away, near in ((4990.0, True), (5010.0, False)):
        place = _place((finder.track.pose_at(np.array([finder.track.start_ns], "datetime64[ns]")).position_m[0, 0] + away,
                        float(_track()[0, 1])), 1)  # fmt: skip
        assert finder._near(place.latitude_deg, place.longitude_deg) is near
    assert finder.at_site


@pytest.mark.parametrize(("more", "other"), [(7.9, None), (8.1, "LW2")])
def test_another_tower_is_named_where_its_evidence_is_far_above(
    more: float, other: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    evidence = np.arange(len(SITE.towers)) * -30.0
    evidence[1] = more
    monkeypatch.setattr(node, "fit_places", lambda *_: SimpleNamespace(evidence=evidence))
    track = level_track(4.0 * np.arange(20), np.zeros((20, 3)), np.zeros(20))
    assert _node_finder().contradiction(track, "LW1") == other
    assert _node_finder().contradiction(track, "LW2") is None
    assert _node_finder().contradiction(track, "elsewhere") is None
    assert _node_finder().contradiction(level_track([0.0], np.zeros((1, 3)), [1.0]), "LW1") is None


def test_levels_are_taken_in_flight_and_their_offset_is_that_to_free_space() -> None:
    """The transmitter has 40 dBm at 3.3 GHz.

    Samples below five metres are ignored, and levels below the receiver's floor count as the floor.
    """
    finder = _node_finder()
    time = np.datetime64("2025-06-01T14:00:00", "ns") + np.arange(400) * np.timedelta64(1, "s")
    away = np.linalg.norm(_track()[:400] - SITE.towers["LW1"].position_m, axis=1)
    level = 40.0 - 20.0 * np.log10(4.0 * np.pi * away * 3.3e9 / 299792458.0) - 17.0
    frame = pd.DataFrame({"time": time, "line": 1, "flag": "", "rss_db": level})
    track = finder.levels(Stream("rss", "power", frame))
    assert track.time_s.min() - time[0].astype(np.int64) * 1e-9 > 8.0
    assert finder.offset_db(track, "LW1") == pytest.approx(17.0, abs=0.2)
    assert finder.offset_db(track, "nowhere") is None
    frame.loc[200:, "rss_db"] = np.nan
    frame.loc[200:299, "flag"] = "out_of_coverage"
    lost = finder.levels(Stream("rss", "power", frame), -90.0)
    assert lost.below.sum() == 25
    assert lost.time_s.max() - time[0].astype(np.int64) * 1e-9 < 300.0


def test_windows_whose_mean_time_is_in_a_gap_of_the_telemetry_are_ignored() -> None:
    """Their position is the mean of known ones, but their attitude is unknown, and no position of a node would fit."""
    finder = _node_finder()
    row = np.arange(500)
    gaps = finder.telemetry.frame.assign(time=finder.telemetry.frame["time"] + row // 30 * pd.Timedelta("200ms"))
    gaps = gaps[~np.isin(row % 30, (28, 29))].reset_index(drop=True)  # 3.2 s without a position
    finder = node.NodeFinder(SITE, Stream("telemetry", "x", gaps), [])
    time = gaps["time"].to_numpy()
    frame = pd.DataFrame({"time": time, "line": 1, "flag": "", "rss_db": np.linspace(-80.0, -60.0, len(time))})
    track = finder.levels(Stream("rss", "power", frame))
    assert len(track.level_db) == len(track.time_s) == len(track.position_m) > 100
    assert track.rotation is not None
    assert np.isfinite(track.rotation).all()


def _learned_tower() -> node.LearnedTower:
    """Antennas with lobes at both ends, as if learned from flights."""
    _, _, v = sphere_grid()
    tower, uav = (unit_mean_gain(5.0 * v[..., a] - 3.0 * v[..., b]) for a, b in ((0, 1), (1, 0)))
    sd = np.zeros(v.shape[:2])
    model = LevelModel(slope=2.0, slope_sd=0.2, elevation_sd_db=1.0, cases=known_cases(1.6, 1.4))
    return node.LearnedTower(SpherePattern("tower", tower, sd), SpherePattern("uav", uav, sd), model)


def _flown(
    finder: node.NodeFinder, gains: node.LearnedTower, at: str | tuple[float, float, float], part: slice
) -> LevelTrack:
    """Free space and the gains of both ends, 2 dB of noise, along a part of the flight."""
    place = np.array(SITE.towers[at].position_m if isinstance(at, str) else at)
    time = finder.telemetry.frame["time"].to_numpy()[part]
    pose = finder.track.pose_at(time)
    ray = pose.position_m - place
    away = np.linalg.norm(ray, axis=1)
    towards = -ray / away[:, None]
    body = np.einsum("nji,nj->ni", pose.rotation, towards)
    level = gains.tower.gain_dbi(*sphere_angles(-towards)) + gains.uav.gain_dbi(*sphere_angles(body))
    level = level - 20.0 * np.log10(away) + np.random.default_rng(8).normal(0.0, 2.0, len(away))
    return finder.levels(Stream("rss", "power", pd.DataFrame({"time": time, "line": 1, "flag": "", "rss_db": level})))


@pytest.mark.parametrize("part", [slice(100, 220), slice(300, 400), slice(0, 500)])
@pytest.mark.parametrize(("at", "keeps"), [("LW1", True), (ROVER, False), ("LW2", False)])
def test_a_cut_flight_keeps_a_tower_whose_antennas_flights_taught(
    at: str | tuple[float, float, float], keeps: bool, part: slice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For a node elsewhere, the tower's antennas explain nothing."""
    monkeypatch.setattr(node, "place_odds", lambda _, towers: np.full(len(towers), -9.0))
    finder, gains = _node_finder(), _learned_tower()
    placement = finder.propose(_flown(finder, gains, at, part), {"LW1": [gains]})
    assert placement is not None
    assert (placement.node == "LW1") == keeps
    if keeps:
        assert "with its antennas learned from flights" in placement.question
        assert placement.tower is None


@pytest.mark.parametrize(("usual", "said"), [({"LW1"}, "LW1"), ({"LW3"}, "LW2"), (set(), "LW2")])
def test_of_towers_that_fit_alike_the_receivers_own_is_proposed(
    usual: set[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Log odds of the second quarter of a flight about LW1."""
    monkeypatch.setattr(node, "place_odds", lambda _, towers: np.array([1.6, 1.9, -1.2, -1.4, -3.8])[: len(towers)])
    finder, gains = _node_finder(), _learned_tower()
    placement = finder.propose(_flown(finder, gains, "LW1", slice(0, 500)), {name: [] for name in usual})
    assert placement is not None
    assert placement.node == said
    assert f"no position fits the levels clearly better than LW2 or LW1: is it {said}?" in placement.question


@pytest.mark.parametrize(
    ("at", "part", "said"),
    [("LW1", slice(300, 400), "LW1"), ("LW2", slice(100, 220), "LW2"), ("LW2", slice(0, 500), "LW2"),
     (ROVER, slice(100, 220), "NODE"), (ROVER, slice(0, 500), "NODE")],
)  # fmt: skip
def test_a_tower_stands_beside_antennas_of_which_nothing_is_known(
    at: str | tuple[float, float, float], part: slice, said: str
) -> None:
    """With a model of distance alone, antenna lobes look like another position. A node in range is still found."""
    finder, gains = _node_finder(), _learned_tower()
    placement = finder.propose(_flown(finder, gains, at, part))
    assert placement is not None
    assert placement.node == said
    assert ("no position fits the levels clearly better" in placement.question) == (said != "NODE")


@pytest.mark.parametrize("head", ["cell_id,rsrp", "rsrp cell 1,rsrp cell 2"])
def test_cells_without_a_pci_have_the_tower_that_their_levels_fit(head: str, tmp_path: Path) -> None:
    """The number of a cell may be in a separate column or in the names of the levels. It is not always a PCI."""
    track, random, rows = _track(), np.random.default_rng(3), []
    latitude, longitude = SITE.frame.to_geographic(track[:, 0], track[:, 1])
    levels = [
        -20.0 * np.log10(np.linalg.norm(track - SITE.towers[name].position_m, axis=1)) + random.normal(0.0, 1.0, 500)
        for name in ("LW1", "LW2")
    ]
    for t, (lat, lon, up, first, second) in enumerate(zip(latitude, longitude, track[:, 2], *levels, strict=True)):
        pose = f"{1748786400 + t},{lat:.7f},{lon:.7f},{up:.1f}"
        cells = [f"7,{first:.2f}", f"9,{second:.2f}"] if "id" in head else [f"{first:.2f},{second:.2f}"]
        rows += [f"{pose},{cell}" for cell in cells]
    (tmp_path / "x.csv").write_text("\n".join([f"time,lat,lon,alt,{head}", *rows, ""]))
    text, remarks = draft(ingest(tmp_path / "x.csv"), tmp_path)
    (log,) = parse_yaml(text, FlightFile).logs
    assert (log.node, list(log.cells.values())) == (None, ["LW1", "LW2"])
    assert any("which tower has which cell?" in remark for remark in remarks)
    assert remarks[0].endswith("000 samples can be compared")
