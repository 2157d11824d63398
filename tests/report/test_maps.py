import dataclasses
import json
import re

import numpy as np
import pytest

from aerpaw_cmp.report import canvas
from aerpaw_cmp.report import maps as maps_figures
from aerpaw_cmp.report import maps as maps_html
from aerpaw_cmp.report.maps import MapsData
from aerpaw_cmp.report.texts import percent


@pytest.fixture
def few_maps(maps_data):
    """One height and one K: enough to draw every kind of figure."""
    return dataclasses.replace(maps_data, rss=maps_data.rss[:6], rank=maps_data.rank[:2])


def test_files(few_maps, tmp_path):
    files = maps_html.write_maps(few_maps, tmp_path, "svg")
    assert {file.suffix for file in files} == {".html", ".json", ".svg"}
    assert len(maps_html.write_maps(few_maps, tmp_path / "plain")) == 2  # none are drawn where nobody asks
    assert files[0].name == "map.html"
    page = files[0].read_text()
    names = {p.name for p in maps_figures.figure_specs(few_maps)}
    assert {file.stem for file in files if file.suffix == ".svg"} == names
    panels = [panel for plate in maps_figures.plates(few_maps) for panel in plate.panels]
    assert page.count("data-plot=") == len(panels) > len(list(maps_figures.plates(few_maps))) > 3
    assert not re.search(r'(?:src|href)="(?!data:|#|\$\{)', page)
    assert page.count("<script") == 2  # its data and its one script
    assert max(f.stat().st_size for f in files if f.suffix == ".svg") < 500_000
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["grid"]["positions"] == 2556
    assert metrics["fit"]["rmse"] == 0.0153
    assert sum(metrics["rank"][0]["share"].values()) == pytest.approx(1.0)


def test_every_map_figure_has_units_and_a_legend(few_maps):
    specs = list(maps_figures.figure_specs(few_maps))
    assert len(specs) > 3
    for spec in specs:
        with canvas.style():
            fig = spec.draw()
        labels = [ax.get_xlabel() + ax.get_ylabel() for ax in fig.axes]
        assert any("[" in label or "Number" in label for label in labels), spec.name
        assert fig.legends or any(ax.get_legend() for ax in fig.axes), spec.name


def test_north_is_up_and_east_is_right(maps_data):
    """The only bright cell of a map must be at its tower."""
    values = np.full((len(maps_data.north_m), len(maps_data.east_m)), -100.0)
    values[70, 0] = 0.0  # north-west corner
    with canvas.style():
        _, (ax,) = maps_figures.map_axes(maps_data, 1)
        image = maps_figures.draw_map(ax, maps_data, values)
    west, east, south, north = image.get_extent()
    assert (west, east, south, north) == (-540.0, 540.0, -1065.0, 1065.0)
    assert image.origin == "lower"
    assert image.get_cursor_data(_event(ax, -525.0, 1050.0)) == 0.0
    assert image.get_cursor_data(_event(ax, 525.0, 1050.0)) == -100.0


def _event(ax, east, north):
    from types import SimpleNamespace

    x, y = ax.transData.transform((east, north))
    return SimpleNamespace(x=x, y=y, xdata=east, ydata=north, inaxes=ax)


def test_cdf_counts_positions_out_of_coverage_as_below(maps_data):
    maps = [m for m in maps_data.rss if m.antennas == "SISO"]
    plate = next(maps_figures.plates(dataclasses.replace(maps_data, rss=maps)))
    assert len(plate.panels) > 1
    for title, content in plate.panels.items():
        layers = [layer for layer in maps if f"{layer.height_m:g} m" == title]
        for line, layer in zip(content["marks"], layers, strict=True):
            assert line["y"][0] == pytest.approx(100 * (1 - layer.coverage), abs=200 / layer.values.size)
            assert line["y"][-1] == 100.0


def test_shares_of_ranks_are_read_at_their_heights(maps_data):
    members = [m for m in maps_data.rank if m.k == maps_data.rank[0].k]
    bands = maps_figures.rank_shares(members)["marks"]
    assert len(members) > 1
    for member in members:
        here = [int(np.flatnonzero(band["x"] <= member.height_m)[-1]) for band in bands]
        shares = [band["high"][at] - band["low"][at] for band, at in zip(bands, here, strict=True)]
        np.testing.assert_allclose(shares, 100 * np.asarray(member.share), atol=1e-9)
    assert bands[0]["x"][0] >= 0.0
    (lonely,) = {tuple(band["x"]) for band in maps_figures.rank_shares(members[:1])["marks"]}
    assert lonely[0] < members[0].height_m < lonely[1]


def test_borders_only_where_towers_share_the_area(maps_data):
    with canvas.style():
        _, axes = maps_figures.map_axes(maps_data, 2)
        maps_figures.draw_map(axes[0], maps_data, maps_data.rss[0].values, highlight="LW1")
        maps_figures.draw_map(axes[1], maps_data, maps_data.rss[0].values)
    triangles = [sum(line.get_marker() == "^" for line in ax.get_lines()) for ax in axes]
    assert triangles == [1, 5]
    assert len(axes[1].get_lines()) - len(axes[0].get_lines()) == 2 * len(maps_data.borders_m) + 4


def test_tables(maps_data):
    coverage = maps_html.coverage_table(maps_html.coverage_rows(maps_data))
    assert list(coverage.columns)[3:] == ["30 m", "70 m", "110 m"]
    assert len(coverage.rows) == 12
    assert coverage.rows[5][:3] == ("SISO", "opaque", "joint")
    table = maps_html.error_table(maps_data.errors)
    assert list(table.columns) == ["Evaluation", "Method", "K = 10", "K = 100", "K = 1000"]
    evaluation, method, *means = table.rows[0]
    assert (evaluation, method) == ("leave one out", "Kriging")
    for k, mean in zip((10.0, 100.0, 1000.0), means, strict=True):
        some = [e.mae for e in maps_data.errors if (e.evaluation, e.method, e.k) == (evaluation, method, k)]
        assert len(some) == 9
        assert mean == pytest.approx(np.mean(some))


@pytest.mark.parametrize("all_full", [True, False])
def test_rows_in_full_coverage_are_one(maps_data, all_full):
    """A map in which every path arrives does not distinguish the towers."""
    full = [dataclasses.replace(m, coverage=1.0 if all_full or m.tower != "LW4" else 0.98765) for m in maps_data.rss]
    shares = maps_html.coverage_rows(dataclasses.replace(maps_data, rss=tuple(full)))
    rows = maps_html.coverage_table(shares).rows
    towers = len({m.tower for m in full})
    whose = "every antenna, foliage and tower" if all_full else f"the other {2 * (towers - 1)} rows"
    assert [row[0] for row in rows] == ([whose] if all_full else ["SISO", "MIMO", whose])
    assert {row[-1] for row in rows if row[0] == whose} == {percent(1.0, 1)}
    assert all(row[-1] == percent(0.98765, 1) for row in rows if row[0] != whose)


def test_hostile_names_are_escaped(maps_data):
    text = "<script>alert(1)</script>"
    data = dataclasses.replace(
        maps_data, title=text, name=text, warnings=(text,), notes=(text,),
        site=dataclasses.replace(maps_data.site, name=text),
        errors=(dataclasses.replace(maps_data.errors[0], method=text, evaluation=text),),
        paper=(dataclasses.replace(maps_data.paper[0], what=text, figure=text),),
    )  # fmt: skip
    page = maps_html.maps_page(data, [text])
    assert "alert(1)</script>" not in page
    assert page.count("<script") == 2


@pytest.mark.parametrize("missing", ["rss", "rank", "layers", "correlation", "errors", "paper", "borders_m"])
def test_a_part_may_be_missing(maps_data, missing):
    data = dataclasses.replace(maps_data, **{missing: ()})
    maps_html.maps_page(data, [])
    json.dumps(maps_html.maps_metrics(data), allow_nan=False)


def test_nothing_at_all_and_nothing_covered(maps_data):
    empty = MapsData(
        title="t", name="n", site=maps_data.site, generated="", east_m=maps_data.east_m, north_m=maps_data.north_m
    )
    maps_html.maps_page(empty, [])
    dark = dataclasses.replace(maps_data.rss[0], values=np.full_like(maps_data.rss[0].values, np.nan), coverage=0.0)
    for spec in maps_figures.figure_specs(dataclasses.replace(empty, rss=(dark,))):
        canvas.render(spec)
