"""The map job: the engine behind it by physics and by the replay itself, the command by what it writes."""

import json
import re
import types
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import Polygon

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.common.stages import Stages
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.jobs import coverage_map
from aerpaw_cmp.jobs.paper_table import paper_rows
from aerpaw_cmp.maps.grid import PAPER_BUDGET, RATIO_LIMIT_DB, Grid, LinkBudget, rank_of_singular_values
from aerpaw_cmp.maps.variogram import PAPER_BIEXPONENTIAL
from aerpaw_cmp.propagation.field.foliage import CrownIndex, Opaque, foliage_loss_db
from aerpaw_cmp.propagation.geometry import Link, Poses, linear_array, single_element
from aerpaw_cmp.propagation.options import Field
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.relief import Dem
from aerpaw_cmp.site.site import Building, Site, Tower, Trees
from aerpaw_cmp.site.siteyaml import join_trees, load_site
from tests.jobs.sent_by_pickle import SentByPickle
from tests.json_page import unlisted

pytestmark = pytest.mark.usefixtures("few_pictures")

CARRIER_HZ = 3.4e9


def tower(name, east, north):
    return Tower(name, 35.7, -78.7, east, north)


def row_of_trees(east_m=100.0):
    """A hedge without gaps, 20 m high, from north -200 to 200."""
    north = np.arange(-200.0, 201.0, 4.0)
    like = np.ones_like(north)
    return Trees(east_m * like, north, 0 * like, 20 * like, 10 * like, 2 * like, 0.4 * like)


@pytest.fixture
def site():
    barn = Building("barn", Polygon([(-60, 40), (-30, 40), (-30, 60), (-60, 60)]), 8.0)
    towers = {"A": tower("A", 0.0, 0.0), "B": tower("B", 10.0, 250.0)}
    area = (-200.0, 300.0, -200.0, 300.0)
    return Site("field", SiteFrame(35.7, -78.7), towers, (barn,), trees=row_of_trees(), area_m=area)


def settings(**change):
    some = {"spacing_m": 50.0, "rss_altitudes_m": (30.0,), "rank_altitudes_m": (3.0, 30.0, 60.0)}
    return coverage_map.MapSettings(**{**some, **change})


def test_every_mode_is_what_a_replay_with_its_loss_says(site):
    chosen = settings()
    channels = coverage_map.SiteChannels(site, chosen)
    position = Grid.over_area(site.area_m, 50.0).positions_m(6.0)
    poses = Poses(position, np.broadcast_to(np.eye(3), (len(position), 3, 3)))
    line = linear_array(4, wavelength_m(CARRIER_HZ) / 2, 0.0)
    crowns = CrownIndex(site.trees)
    maps = {}
    for mode in coverage_map.FOLIAGE:
        model = None if mode == "none" else coverage_map.foliage_model(mode, CARRIER_HZ)

        def loss(paths, source, target, model=model):
            if model is None:
                return np.zeros(len(paths))
            return foliage_loss_db(source[paths.tower], paths.vertices_m, target[paths.pose], crowns, model)

        link = Link(CARRIER_HZ, dict.fromkeys(site.towers, line), line, 40.0, uav_transmits=False)
        single = Link(CARRIER_HZ, dict.fromkeys(site.towers, single_element()), single_element(), 40.0)
        expected, siso = (replay(site, wanted, poses, field=Field(loss=loss)) for wanted in (link, single))
        mapped = maps[mode] = channels.of(mode)(position)
        np.testing.assert_allclose(mapped.rss_siso_dbm, siso.rss_dbm, atol=1e-9)
        for k in (10.0, 1000.0):
            rank = channel_rank(expected.h, k)
            np.testing.assert_array_equal(rank_of_singular_values(mapped.singular_values, [k])[..., 0], rank)
        assert np.array_equal(np.isfinite(mapped.rss_siso_dbm), expected.has_path)
        with np.errstate(divide="ignore"):
            beam = 40 + 10 * np.log10((np.abs(expected.h.sum(axis=-1)) ** 2 / 4).mean(axis=-1))
        np.testing.assert_allclose(mapped.rss_mimo_dbm, np.where(expected.has_path, beam, np.nan), atol=1e-9)
    shaded = np.isnan(maps["opaque"].rss_siso_dbm) & np.isfinite(maps["none"].rss_siso_dbm)
    assert 0.1 < shaded.mean() < 0.6
    assert np.array_equal(np.isnan(maps["attenuating"].rss_siso_dbm), np.isnan(maps["none"].rss_siso_dbm))
    assert (maps["attenuating"].singular_values[shaded] > 0).any()


def test_a_broadside_beam_gains_the_number_of_elements():
    # free space far away: 4 elements in phase, each with a quarter of the power, give 4 times the power broadside
    # (east of a line along north) and next to nothing along the line
    site = Site("air", SiteFrame(35.7, -78.7), {"A": tower("A", 0.0, 0.0)})
    channels = coverage_map.SiteChannels(site, settings(max_depth=0, foliage=("none",)))
    places = np.array([[3000.0, 0.0, 10.0], [0.0, 3000.0, 10.0]])
    channels_there = channels.of("none")(places)
    gain = channels_there.rss_mimo_dbm[:, 0] - channels_there.rss_siso_dbm[:, 0]
    assert gain[0] == pytest.approx(10 * np.log10(4), abs=1e-3)
    assert gain[1] < -40
    np.testing.assert_allclose(
        channels_there.rss_siso_dbm[0], 40 - 20 * np.log10(4 * np.pi * 3000 / wavelength_m(CARRIER_HZ))
    )


def test_modes_share_one_search_and_nothing_is_kept(site, monkeypatch):
    monkeypatch.setattr(coverage_map, "_MANY_BUILDINGS", 0)  # the stage begins with a line about its buildings
    lines: list[str] = []
    outcome = coverage_map.make_maps(site, settings(), Stages(lambda text, *_: lines.append(text)))
    assert lines[:2] == ["maps", "walls and roofs of 1 building"]
    alone = coverage_map.make_maps(site, settings(foliage=("opaque",)), Stages())
    assert outcome.paths == alone.paths > 0
    np.testing.assert_array_equal(outcome.maps["opaque"].rank, alone.maps["opaque"].rank)
    np.testing.assert_array_equal(outcome.maps["opaque"].rss_mimo_dbm, alone.maps["opaque"].rss_mimo_dbm)
    assert list(dict(outcome.ordered())) == ["opaque", "attenuating", "none"]
    channels = coverage_map.SiteChannels(site, settings())
    position = np.array([[20.0, 20.0, 30.0]])
    for mode in coverage_map.FOLIAGE:
        channels.of(mode)(position)
    assert not channels._ready


def test_the_path_search_of_each_chunk_moves_the_progress(site) -> None:
    told: list[float] = []
    channels = coverage_map.SiteChannels(site, settings(foliage=("none", "opaque")))
    channels.tile(coverage_map.TileOrder(site="field", settings=channels.settings, cells=1000, number=0), told.append)
    # three heights in one chunk each; the search reports each of the two towers
    assert told == pytest.approx([share / 6 for share in range(1, 7)])


def test_heights_are_above_the_ground_of_the_elevation_model():
    frame = SiteFrame(35.7, -78.7)
    east = np.arange(-1000.0, 1001.0, 10.0)
    slope = Dem(np.tile(0.01 * east, (201, 1)), -1000.0, -1000.0, 10.0, 10.0, "local", frame)
    flat = Site("flat", frame, {"A": tower("A", 0.0, 0.0)})
    hilly = replace(flat, dem=slope)
    line_of_sight = settings(max_depth=0, foliage=("none",))
    there = np.array([[500.0, 40.0, 30.0]])
    raised = there + np.array([0.0, 0.0, 5.0])  # 1 % over 500 m
    sloping = coverage_map.SiteChannels(hilly, line_of_sight).of("none")(there)
    expected = coverage_map.SiteChannels(flat, line_of_sight).of("none")(raised)
    assert sloping.rss_siso_dbm[0, 0] == pytest.approx(expected.rss_siso_dbm[0, 0], abs=1e-9)
    level = coverage_map.SiteChannels(flat, line_of_sight).of("none")(there)
    assert abs(sloping.rss_siso_dbm[0, 0] - level.rss_siso_dbm[0, 0]) > 1e-4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"foliage": ("leafy",)}, "leafy"),
        ({"foliage": ()}, "none given"),
        ({"rank_altitudes_m": (0.0,)}, "above 0"),
        ({"rss_altitudes_m": (1e7,)}, "up to 10000"),
        ({"ks": (1.0,)}, "K"),
        ({"carrier_hz": 0.0}, "carrier"),
    ],
)
def test_settings_that_make_no_map_are_refused(change, said):
    with pytest.raises(UsageError, match=said):
        coverage_map.MapSettings(**change)


# --- the command ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """One coarse map of the packaged site through the command line."""
    import contextlib
    import io

    from aerpaw_cmp.cli import main

    folder = tmp_path_factory.mktemp("map")
    said = io.StringIO()
    wish = ["--quick", "--foliage", "none", "--foliage", "opaque", "--spacing", "180", "-k", "10", "-k", "1000"]
    wish += ["--rss-altitude", "30", "--figures", "png"]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        code = main(["map", "lake_wheeler", "-o", str(folder), "--json", *wish])
    assert code == 0
    return folder, json.loads(said.getvalue())


def test_the_command_prints_one_object_that_is_the_metrics(made):
    folder, printed = made
    assert unlisted("map", printed) == []
    assert printed == {"schema": 1, **json.loads((folder / "metrics.json").read_text())}
    assert printed["grid"] == {"columns": 6, "rows": 11, "positions": 66}
    assert {(m["antennas"], m["foliage"]) for m in printed["coverage"]} == {
        (a, f) for a in ("SISO", "MIMO") for f in ("none", "opaque")
    }
    for entry in printed["rank"]:
        assert sum(entry["share"].values()) == pytest.approx(1)
    assert set(printed["stages"]) >= {"maps_s", "leave one out_s", "export_s"}


def test_foliage_only_takes_coverage_away(made):
    coverage = {(m["foliage"], m["antennas"], m["tower"], m["altitude_m"]): m["coverage"] for m in made[1]["coverage"]}
    for (mode, *rest), share in coverage.items():
        if mode == "opaque":
            assert share <= coverage[("none", *rest)]
    assert coverage[("opaque", "SISO", "LW5", 30.0)] < 0.9


def test_files_agree_with_each_other_and_with_the_page(made):
    import pandas as pd

    folder, printed = made
    table = pd.read_csv(folder / "layers.csv")
    assert len(table) == 66
    share = float((table["rank_k10_h003m_joint_opaque"] == 0).mean())
    shown = next(m for m in printed["rank"] if (m["foliage"], m["k"], m["altitude_m"]) == ("opaque", 10.0, 3.0))
    assert shown["share"]["Z"] == pytest.approx(share)
    ratios = table[[name for name in table if name.startswith(("condition", "spread"))]].to_numpy()
    assert np.nanmin(ratios) >= 0
    assert np.nanmax(ratios) == RATIO_LIMIT_DB  # two collinear paths: what is below is rounding
    with zipfile.ZipFile(folder / "maps.kmz") as archive:
        assert "maps/rank_k1000_h110m_joint_opaque.png" in archive.namelist()


def test_the_page_shows_every_figure_of_the_paper_rows(made):
    folder, printed = made
    html = (folder / "map.html").read_text()
    stems = {path.stem for path in (folder / "figures").glob("*.png")}
    named = {row["figure"] for row in printed["paper"]} - {""}
    assert named
    assert named <= stems
    assert "(c) OpenStreetMap contributors, ODbL" in html
    what = {row["what"] for row in printed["paper"]}
    assert {"out of coverage at 3 m", "c1 of the bi-exponential model"} <= what
    states = next(row for row in printed["paper"] if row["what"] == "UAV locations")
    assert (states["paper"], states["ours"]) == ("36 x 71 = 2556", "6 x 11 = 66")
    # one draw of random samples proves nothing: the range over several is printed
    wins = next(row for row in printed["paper"] if "least MAE, M random" in row["what"])["ours"]
    assert re.fullmatch(r"(\d+ to )?\d+ of \d+ in 10 draws", wins)


def test_another_site_is_not_held_against_the_paper():
    towers = {"A": None, "LW1": None}
    assert list(paper_rows(types.SimpleNamespace(site=types.SimpleNamespace(towers=towers)))) == []


def test_the_paper_page_has_the_rows_that_a_run_prints(made):
    docs = Path(__file__).parents[2] / "docs"
    page = (docs / "paper.md").read_text() + (docs / "research" / "paper_numbers.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")]
    numbers = {tuple(row[:3]) for row in rows if len(row) == 5}
    printed = {(row["where"], row["what"], row["paper"]) for row in made[1]["paper"]}
    assert printed <= numbers
    figures = {row[0] for row in rows}
    assert {"Table I", "Table II", "Fig. 1", "Fig. 2", "Fig. 3", "Fig. 4", "Fig. 5, 6"} <= figures
    assert {f"Fig. {n}" for n in range(7, 16)} <= figures


def test_netcdf_is_written_where_its_library_is(made):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("netCDF4")
    import pandas as pd

    table = pd.read_csv(made[0] / "layers.csv")
    with xarray.open_dataset(made[0] / "maps.nc") as data:
        for mode in ("none", "opaque"):
            here = data.sel(foliage=mode, y=xarray.DataArray(table["north_m"]), x=xarray.DataArray(table["east_m"]))
            rank = here["rank"].sel(k=10.0, height_of_rank=30.0, tower="LW3")
            np.testing.assert_array_equal(rank, table[f"rank_k10_h030m_LW3_{mode}"])
            level = here["rss_mimo_joint"].sel(height=30.0)
            np.testing.assert_allclose(level, table[f"rss_mimo_h030m_joint_{mode}"], atol=1e-5)
        assert data.attrs["Conventions"] == "CF-1.11"
        assert "T" in data.attrs["history"].split()[0], "when it was made"


def test_a_missing_library_costs_its_own_file_alone(site, tmp_path, monkeypatch):
    import sys

    chosen = settings(spacing_m=250.0, rank_altitudes_m=(30.0,), ks=(10.0,), foliage=("none",), study=False)
    outcome = coverage_map.make_maps(site, chosen, Stages())
    monkeypatch.setitem(sys.modules, "netCDF4", None)
    messages = []
    coverage_map.export_maps(outcome, tmp_path, lambda text, *_: messages.append(text))
    assert {path.name for path in tmp_path.iterdir()} == {"layers.csv", "maps.kmz"}
    assert any("netCDF4" in text and "aerpaw-cmp[geo]" in text for text in messages)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--foliage", "leafy"], "leafy"),
        (["--spacing", "5000"], "no cell"),
        (["--quick", "--rank-altitude", "30"], "rank height"),
        # before the search, which takes minutes in a town
        (["--quick", "--carrier-ghz", "28", "--dry-run"], r"'medium_dry_ground' \(ground_material\) at 28 GHz"),
    ],
)
def test_wrong_wishes_are_one_message(words, said, tmp_path):
    from aerpaw_cmp.cli import main

    with pytest.raises(UsageError, match=said):
        main(["map", "lake_wheeler", "-o", str(tmp_path / "out"), *words])


def test_the_notes_say_where_p833_is_continued():
    def notes(**change):
        bare = types.SimpleNamespace(trees=())
        return " ".join(coverage_map._notes(types.SimpleNamespace(settings=settings(**change), site=bare, tiles={})))

    assert "Trees at 3.4 GHz: an extrapolation of ITU-R P.833" in notes(foliage=("opaque", "attenuating"))
    assert "extrapolation" not in notes(foliage=("opaque", "none"))
    assert "extrapolation" not in notes(foliage=("attenuating",), carrier_hz=1.8e9)


def test_workers_evaluate_the_tiles_to_the_same_digit() -> None:
    some, crew = settings(spacing_m=300.0, rank_altitudes_m=(30.0,), foliage=("none", "opaque")), SentByPickle()
    alone = coverage_map.make_maps(load_site("lake_wheeler"), some, Stages())
    shared = coverage_map.make_maps(load_site("lake_wheeler"), some, Stages(), workers=crew, name="lake_wheeler")
    assert len(crew.sizes) > 1
    assert max(crew.sizes) < 3000
    assert shared.paths == alone.paths
    for mode in some.foliage:
        assert np.array_equal(shared.maps[mode].rss_siso_dbm, alone.maps[mode].rss_siso_dbm, equal_nan=True)
        assert np.array_equal(shared.maps[mode].rank, alone.maps[mode].rank)


def test_the_stated_curve_is_the_one_that_maps_are_held_against(made):
    stated = {
        row["what"].split()[0]: float(row["paper"]) for row in made[1]["paper"] if "bi-exponential" in row["what"]
    }
    assert len(stated) == 5
    for name, value in stated.items():
        assert getattr(PAPER_BIEXPONENTIAL, name.lower()) == value


def test_paths_of_infinite_loss_are_no_paths(site):
    behind = np.array([[180.0, 0.0, 3.0], [50.0, 0.0, 3.0]])  # behind the hedge; in front of it
    poses = Poses(behind, np.broadcast_to(np.eye(3), (2, 3, 3)))
    link = Link(CARRIER_HZ, {"A": single_element()}, single_element(), 40.0)

    def loss(paths, source, target):
        return foliage_loss_db(source[paths.tower], paths.vertices_m, target[paths.pose], site.trees, Opaque())

    result = replay(site, link, poses, field=Field(loss=loss))
    assert result.has_path[:, 0].tolist() == [False, True]
    assert np.isnan(result.rss_dbm[0, 0])
    assert np.isnan(result.rss_power_dbm[0, 0])
    assert (result.h[0] == 0).all()
    assert np.isfinite(result.rss_dbm[1, 0])


def test_coverage_is_the_share_of_levels_at_the_threshold(site, tmp_path):
    """With free space alone, the covered positions are a disc around the tower with the radius of Friis' equation."""
    open_site = replace(site, buildings=(), trees=join_trees([]))
    budget = LinkBudget(tx_power_dbm=20.0, bandwidth_mhz=10.0, noise_figure_db=5.0, threshold_snr_db=30.0)
    chosen = settings(foliage=("none",), budget=budget, max_depth=0, study=False)
    outcome = coverage_map.make_maps(open_site, chosen, Stages(lambda *_: None))
    level = outcome.shown.rss("siso", "A")[0]
    grid = outcome.shown.grid.positions_m(30.0)
    away = np.linalg.norm(grid - open_site.towers["A"].position_m, axis=1)
    reach_m = wavelength_m(CARRIER_HZ) / (4 * np.pi) * 10 ** ((20.0 - budget.level_dbm) / 20)
    np.testing.assert_array_equal(budget.covered(level) > 0, away <= reach_m)
    record = coverage_map.maps_record(outcome, name="open", stages_s={}, paper=paper_rows(outcome))
    shares = {(m.tower, m.antennas): m.coverage for m in record.rss}
    assert 0.2 < shares["A", "SISO"] < 0.8
    assert shares["A", "SISO"] == pytest.approx(np.mean(away <= reach_m))
    layers = {layer.column: layer for layer in coverage_map._further_layers(outcome)}
    assert {"margin_mimo_h030m_joint_none", "snr_mimo_h030m_joint_none"} <= set(layers)
    apart = layers["snr_mimo_h030m_joint_none"].values - layers["margin_mimo_h030m_joint_none"].values
    np.testing.assert_allclose(apart, 30.0, atol=0.011)


def test_options_replace_the_link_budget_of_the_site(tmp_path):
    file = tmp_path / "site.yaml"
    file.write_text(
        "name: a\norigin: {latitude_deg: 35.7, longitude_deg: -78.7}\n"
        "towers: {A: {latitude_deg: 35.7, longitude_deg: -78.7}}\n"
        "coverage: {tx_power_dbm: 23, bandwidth_mhz: 10, noise_figure_db: 6, threshold_snr_db: 3}\n"
    )
    assert (
        coverage_map.map_settings(str(file), {})
        .budget.sentence()
        .startswith("Transmit power 23 dBm; noise floor −98.0 dBm")
    )
    with pytest.raises(UsageError, match="below the noise floor") as refused:
        coverage_map.map_settings(str(file), {"threshold_dbm": -130.0})
    assert refused.value.path is None  # the option is wrong, not the file
    changed = coverage_map.map_settings(str(file), {"threshold_dbm": -90.0, "tx_power_dbm": None}).budget
    assert (changed.tx_power_dbm, changed.threshold_snr_db, changed.level_dbm) == (23, None, -90.0)
    assert coverage_map.map_settings("lake_wheeler", {}).budget == PAPER_BUDGET
    studied = (("lake_wheeler", {}), (str(file), {}), (str(file), {"study": True}))
    assert [coverage_map.map_settings(*words).study for words in studied] == [True, False, True]
    file.write_text(file.read_text().replace("bandwidth_mhz: 10, ", ""))
    with pytest.raises(UsageError, match="without a bandwidth") as refused:
        coverage_map.map_settings(str(file), {})
    assert (str(refused.value.path), refused.value.line) == (str(file), 4)
    assert coverage_map.map_settings(str(file), {"bandwidth_mhz": 10.0}).budget.threshold_snr_db == 3
