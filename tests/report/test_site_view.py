import dataclasses
import json
import re

import numpy as np
import pytest
from shapely.geometry import Polygon, box

from aerpaw_cmp.report import canvas
from aerpaw_cmp.report import packed as shapes
from aerpaw_cmp.report import site as site_view
from aerpaw_cmp.site.site import Building, Forest, Geofence, Site, Trees


def scene_of(page: str):
    return json.loads(re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.S).group(1))


def test_writes_plan_picture_and_page(report_data, tmp_path):
    files = site_view.write_site_view(report_data.site, tmp_path)
    assert [f.suffix for f in files] == [".html", ".svg", ".png"]
    for file in files:
        if file.suffix == ".png":
            assert file.read_bytes().startswith(b"\x89PNG")
    page = files[0].read_text()
    assert not re.search(r"(?:src|href)=(?!.\$)|@import|url\((?!#)|fetch\(|XMLHttp|import\(", page), "nothing is loaded"
    assert f"Map {report_data.site.credit}" in page
    scene = scene_of(page)
    assert [t["name"] for t in scene["towers"]] == list(report_data.site.towers)


def test_a_hostile_name_stays_a_name(report_data):
    name = "</script><script>alert(1)</script>"
    tower = dataclasses.replace(report_data.site.towers["LW1"], name=name)
    site = dataclasses.replace(report_data.site, name=name, towers={name: tower})
    page = site_view.viewer(site)
    assert page.count("<script") == 2
    assert "alert(1)<" not in page
    assert scene_of(page)["towers"][0]["name"] == name


def test_walls_enclose_the_prism():
    """Areas of walls with holes: perimeter times height, and one roof."""
    shape = Polygon([(0, 0), (10, 0), (10, 6), (0, 6)], [[(2, 2), (2, 4), (4, 4), (4, 2)]])
    faces = shapes.walls(Building("b", shape, 5.0, base_m=2.0))
    area = sum(np.linalg.norm(np.cross(f[1] - f[0], f[3] - f[0])) for f in faces[:-1])
    assert area == pytest.approx((32 + 8) * 5.0)
    assert {z for f in faces for z in f[:, 2]} == {2.0, 7.0}


def test_limits_hold_everything(report_data):
    limits = site_view.view_limits(report_data.site)
    for tower in report_data.site.towers.values():
        assert (limits[:, 0] <= tower.position_m).all()
        assert (tower.position_m <= limits[:, 1]).all()


def test_an_empty_site_can_be_shown(report_data):
    bare = Site("nothing", report_data.site.frame, {})
    with canvas.style():
        canvas.save_as(site_view.plan(bare), ("png",))
    assert scene_of(site_view.viewer(bare))["trees"] == []


def test_ten_thousand_trees_keep_the_files_small(report_data):
    n = 10_000
    rng = np.random.default_rng(0)
    full = np.full
    trees = Trees(
        rng.uniform(-500, 500, n),
        rng.uniform(-1000, 1000, n),
        np.zeros(n),
        full(n, 20.0),
        full(n, 10.0),
        full(n, 5.0),
        full(n, 0.4),
    )
    site = dataclasses.replace(
        report_data.site,
        trees=trees,
        buildings=tuple(Building(f"b{i}", box(i, 0, i + 1, 1), 5.0) for i in range(0, 200, 2)),
    )
    page = site_view.viewer(site)
    assert len(page) < 500_000
    assert f"10\N{NARROW NO-BREAK SPACE}000 trees ({site_view.TREES_IN_PAGE} drawn)" in page


def test_holes_stay_empty_and_fences_are_drawn(report_data):
    """Filling the outline of an area with holes covers exactly the area. The page and the pictures show geofences."""
    ring = Polygon([(0, 0), (30, 0), (30, 30), (0, 30)], [[(10, 10), (10, 20), (20, 20), (20, 10)]])
    line = shapes.outline(ring)
    east, north = line.T
    assert abs(np.sum(east * np.roll(north, -1) - np.roll(east, -1) * north)) / 2 == pytest.approx(ring.area)
    site = dataclasses.replace(
        report_data.site, forests=(Forest("wood", ring),), geofences=(Geofence("fence", box(-900, -900, 900, 1900)),)
    )
    scene = scene_of(site_view.viewer(site))
    assert scene["forests"] == [line.tolist()]
    assert scene["fences"][0][0] == [900.0, -900.0]
    assert site_view.view_limits(site)[0, 0] < -900
    with canvas.style():
        labels = site_view.plan(site).axes[0].get_legend_handles_labels()[1]
    assert "geofence" in labels


def test_crowns_on_the_plan_are_to_scale(report_data):
    trees = Trees(*(np.array([v]) for v in (5.0, 7.0, 0.0, 30.0, 14.0, 7.5, 0.4)))
    with canvas.style():
        ax = site_view.plan(dataclasses.replace(report_data.site, trees=trees)).axes[0]
    [crowns] = [c for c in ax.collections if type(c).__name__ == "EllipseCollection"]
    assert crowns.get_offsets().tolist() == [[5.0, 7.0]]
    assert crowns.get_widths().tolist() == [14.0]
