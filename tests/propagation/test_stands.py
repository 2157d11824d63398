"""Forests as a medium against closed forms and against counting points along the rays."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
from scipy.special import fresnel
from shapely.geometry import Polygon, box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.flight.gains import path_loss, sight_shares
from aerpaw_cmp.flight.settings import RtSettings
from aerpaw_cmp.propagation.field.foliage import (
    P833,
    TRUNKS,
    FoliageModel,
    Opaque,
    foliage_model,
    over_stands,
    stand_loss_db,
)
from aerpaw_cmp.propagation.geometry import Link, Poses, single_element
from aerpaw_cmp.propagation.options import Field
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.relief import Dem
from aerpaw_cmp.site.site import Building, Forest, Site, Tower
from aerpaw_cmp.site.siteyaml import load_site

FRAME, WAVELENGTH = SiteFrame(35.7, -78.7), 0.09
# Loss in proportion to depth, too weak for a detour to matter; and so much that detours alone are left.
WEAK, WALL = P833(1e-3, 1e3), P833(1e9, 1e9)


def wood(area: Polygon, height: float = 20.0, **more: Any) -> Site:
    forest = Forest("wood", area, height_m=height, crown_base_fraction=0.25)
    return Site("s", FRAME, {"T": Tower("T", 35.7, -78.7, 0.0, 0.0)}, forests=(forest,), **more)


def loss(site: Site, source: Any, target: Any, model: FoliageModel = WEAK) -> np.ndarray:
    start, end = (np.atleast_2d(np.asarray(x, dtype=np.float64)) for x in (source, target))
    return stand_loss_db(site, start, np.zeros((len(start), 0, 3)), end, model, WAVELENGTH)


def knife_edge(height: float, before: float, after: float) -> float:
    nu = height * np.sqrt(2 * (before + after) / (WAVELENGTH * before * after))
    return float(6.9 + 20 * np.log10(np.sqrt((nu - 0.1) ** 2 + 1) + nu - 0.1))


def test_the_length_in_crowns_and_between_trunks_counts() -> None:
    site = wood(box(100.0, -900.0, 200.0, 900.0))
    # 3 and 15 m: between the trunks and in the crowns of a canopy from 5 to 20 m; the detours lie 60 m and more off
    per_metre = 1e-3
    assert loss(site, [0, 0, 15], [400, 0, 15]) == pytest.approx(100 * per_metre, abs=3e-3)
    assert loss(site, [0, 0, 3], [400, 0, 3]) == pytest.approx(TRUNKS * 100 * per_metre, abs=3e-3)
    # from 2 m to 34 m over 400 m the ray is at 5 m where it is 37.5 m far, and leaves the top at 225 m
    assert loss(site, [0, 0, 2], [400, 0, 34], P833(0.01, 1e3)) == pytest.approx(
        0.01 * 100 * np.hypot(400, 32) / 400, abs=0.05
    )
    assert loss(site, [0, 0, 25], [400, 0, 25]) == 0.0
    assert loss(site, [150, 0, 1], [150, 0, 40]) == pytest.approx((15 + TRUNKS * 4) * per_metre, abs=1e-6), "upright"


def test_random_rays_through_a_stand_with_a_glade_lose_what_counted_points_say() -> None:
    area = Polygon(
        [(0, 0), (120, 0), (120, 50), (60, 50), (60, 130), (0, 130)], [[(15, 15), (45, 15), (45, 40), (15, 40)]]
    )
    random = np.random.default_rng(4)
    ends = random.uniform([-80, -60, 0.5], [200, 190, 25], (2, 80, 3))
    losses_db = loss(wood(area), ends[0], ends[1])
    share = (np.arange(40_000) + 0.5) / 40_000
    crossed = 0
    for start, end, db in zip(*ends, losses_db, strict=True):
        point = start + share[:, None] * (end - start)
        inside = shapely.contains_xy(area, point[:, 0], point[:, 1])
        crown, trunk = (point[:, 2] > 5) & (point[:, 2] < 20), point[:, 2] <= 5
        depth = np.linalg.norm(end - start) * ((inside & crown).mean() + TRUNKS * (inside & trunk).mean())
        # where all is below a decibel the detours can only take from it; near the top the Fresnel zone is in the crowns
        zone = 0.55 * 0.5 * np.sqrt(WAVELENGTH * np.linalg.norm(end - start))
        near = inside.any() and (np.abs(point[inside, 2] - 20.0) < zone).any()
        assert db <= (np.linalg.norm(end - start) * inside.mean() if near else depth) * 1e-3 + 1e-4
        if any(shapely.contains_xy(area, *e[:2]) and e[2] < 20 for e in (start, end)):
            assert db == pytest.approx(depth * 1e-3, abs=1e-4), "no detour where an end is inside"
        crossed += depth > 1.0
    assert crossed > 15


def test_over_the_top_is_a_knife_edge_where_the_stand_is_thin() -> None:
    site = wood(box(100.0, -5000.0, 100.001, 5000.0))
    assert loss(site, [0, 0, 8], [300, 0, 14], WALL) == pytest.approx(knife_edge(10.0, 100, 200), abs=0.15), (
        "both rims count"
    )


def test_around_both_sides_is_the_power_of_two_knife_edges() -> None:
    site = wood(box(100.0, -12.0, 100.001, 12.0), height=2000.0)
    assert loss(site, [0, 0, 8], [300, 0, 14], WALL) == pytest.approx(knife_edge(12.0, 100, 200) - 3.01, abs=0.15)


def test_what_gets_through_adds_to_what_gets_over() -> None:
    site = wood(box(100.0, -5000.0, 100.001, 5000.0))
    total = loss(site, [0, 0, 8], [300, 0, 14], P833(2.5e4, 1e6))[0]  # 25 dB in a millimetre
    alone = 25.0 * np.hypot(300, 6) / 300
    power = 10 ** (-alone / 10) + 10 ** (-knife_edge(10.0, 100, 200) / 10)
    assert total == pytest.approx(-10 * np.log10(power), abs=0.05)


@pytest.mark.parametrize("tilt_m", [0.0, 0.5, 3.0, 10.0])
@pytest.mark.parametrize("width_m", [0.001, 100.0])
def test_the_level_has_no_step_where_a_ray_leaves_the_canopy(tilt_m: float, width_m: float) -> None:
    """In fine sweeps over the top there is no step, no gain, and no loss above 0.55 Fresnel radii.

    Rays are level and tilted.
    """
    site = wood(box(100.0, -900.0, 100.0 + width_m, 900.0))
    heights = np.arange(12.0, 28.0, 0.01)
    for model in (foliage_model("attenuating", 3.4e9), WALL):
        start = np.column_stack([0.0 * heights, 0.0 * heights, heights])
        loss_db = loss(site, start, start + np.array([400.0, 0.0, tilt_m]), model)
        assert np.abs(np.diff(loss_db)).max() < 0.1
        assert loss_db.min() == loss_db[-1] == 0.0
        if model is WALL:
            assert loss_db[0] > 10.0


def test_near_the_top_of_a_thin_stand_the_level_is_that_of_a_half_transparent_screen() -> None:
    """The half-plane that lets a tenth of the field through, by the exact Fresnel integral of the free half."""
    site = wood(box(100.0, -5000.0, 100.001, 5000.0))
    heights = np.linspace(12.0, 28.0, 161)
    start = np.column_stack([0.0 * heights, 0.0 * heights, heights])
    loss_db = loss(site, start, start + np.array([300.0, 0.0, 0.0]), P833(2e4, 1e6))  # 20 dB in a millimetre
    nu = (20.0 - heights) * np.sqrt(2 * 300 / (WAVELENGTH * 100 * 200))
    sine, cosine = fresnel(nu)
    free = 0.5 * (1 + 1j) * ((0.5 - cosine) - 1j * (0.5 - sine))
    exact = -20 * np.log10(np.abs(0.1 + 0.9 * free))
    assert np.abs(loss_db - exact)[np.abs(nu) < 0.8].max() < 1.5, "deeper the two waves beat; their powers add here"
    assert np.abs(loss_db - exact)[nu < -0.8].max() < 1.5, "the exact field swings about that of free space"


def test_laws() -> None:
    random = np.random.default_rng(8)
    ends = random.uniform([-80, -60, 0.5], [300, 190, 40], (2, 60, 3))
    site = wood(box(0.0, 0.0, 150.0, 90.0))
    model = foliage_model("attenuating", 3.4e9)
    there, back = loss(site, *ends, model), loss(site, *ends[::-1], model)
    assert there == pytest.approx(back, abs=1e-9)
    assert (there > 1).sum() > 15
    bare = loss(site, *ends, foliage_model("attenuating", 3.4e9, in_leaf=False))
    assert (bare <= there + 1e-9).all()
    assert (bare < there - 0.1).any()
    assert (there <= model.loss_db(np.linalg.norm(ends[1] - ends[0], axis=1)) + 1e-9).all()
    assert np.isinf(loss(site, *ends, Opaque())[there > 0.5]).all()
    # a ray that grazes the canopy has the loss of two grazed edges, not that of 75 m of crowns
    grazed = loss(site, [-50, 40, 19.999], [250, 40, 20.001], model)[0]
    assert 6.0 < grazed < 12.1 < model.loss_db(np.array(75.0))


def test_the_reflection_off_the_ground_beneath_loses_what_its_own_way_takes() -> None:
    """P.833's ground-reflected component: from 4 m over a specular point in the middle it runs between trunks alone."""
    site, middle = wood(box(100.0, -900.0, 300.0, 900.0)), np.array([[[200.0, 0.0, 0.0]]])
    ends = np.array([[0.0, 0.0, 4.0]]), np.array([[400.0, 0.0, 4.0]])
    under = stand_loss_db(site, ends[0], middle, ends[1], WEAK, WAVELENGTH)
    assert under == pytest.approx(TRUNKS * 200.0 * np.hypot(200.0, 4.0) / 200.0 * 1e-3, rel=1e-4)
    ends = np.array([[0.0, 0.0, 20.0]]), np.array([[400.0, 0.0, 20.0]])
    # from 20 m each leg passes 5 m, where the crowns begin, 50 m before the middle: 50 m in crowns, 50 m between trunks
    mixed = stand_loss_db(site, ends[0], middle, ends[1], WEAK, WAVELENGTH)
    assert mixed == pytest.approx(2.0 * (50.0 + TRUNKS * 50.0) * np.hypot(200.0, 20.0) / 200.0 * 1e-3, rel=1e-4)


def test_a_stand_stands_on_the_terrain() -> None:
    axis = np.arange(-400.0, 401.0, 10.0)
    dem = Dem(np.full((81, 81), 7.0) + 0.05 * (axis + 400.0), -400.0, -400.0, 10.0, 10.0, "local", FRAME)
    site = wood(box(100.0, -300.0, 110.0, 300.0), dem=dem)
    assert loss(site, [0, 0, 24], [300, 0, 24], WALL)[0] > 6.0
    assert loss(site, [0, 0, 28], [300, 0, 28], WALL)[0] == 0.0


def test_a_forest_of_a_site_file_with_a_height_is_a_medium(tmp_path: Any) -> None:
    file = tmp_path / "site.yaml"
    file.write_text(
        "name: s\norigin: {latitude_deg: 35.7, longitude_deg: -78.7}\n"
        "towers: {T: {latitude_deg: 35.7, longitude_deg: -78.7}}\n"
        "forests: [{name: w, polygon_m: [[50, -300], [90, -300], [90, 300], [50, 300]], height_m: 18}]\n"
    )
    site = load_site(file)
    assert len(site.trees) == 0
    assert site.wooded
    link = Link(3.4e9, {"T": single_element()}, single_element())
    poses = Poses(np.array([[200.0, 0.0, 12.0], [200.0, 0.0, 60.0]]), np.tile(np.eye(3), (2, 1, 1)))
    shaded = replay(site, link, poses, field=Field(path_loss(site, RtSettings(foliage="attenuating"), 3.4e9)))
    clear = replay(site, link, poses)
    fall = clear.rss_power_dbm - shaded.rss_power_dbm
    assert fall[0, 0] > 5.0
    assert shaded.rss_dbm[1, 0] == pytest.approx(clear.rss_dbm[1, 0], abs=3.0)


def test_the_evergreen_share_keeps_its_leaves() -> None:
    """Out of leaf a stand loses between what leafless trees lose and what trees in leaf do, in proportion."""
    ends = np.array([[0.0, 0, 15]]), np.zeros((1, 0, 3)), np.array([[400.0, 0, 15]])
    leafed, bare = WEAK, P833(0.8e-3, 1e3)

    def lost(share: float) -> float:
        site = wood(box(100.0, -900.0, 200.0, 900.0))
        site = replace(site, forests=(replace(site.forests[0], evergreen_share=share),))
        return float(stand_loss_db(site, *ends, bare, WAVELENGTH, leafed)[0])

    assert lost(0.0) == pytest.approx(0.08, abs=3e-3)
    assert lost(1.0) == pytest.approx(0.10, abs=3e-3)
    assert lost(0.5) == pytest.approx((lost(0.0) + lost(1.0)) / 2)


def test_sight_lines_through_woods_and_behind_buildings_are_counted() -> None:
    """Of eight poses around a tower, two are behind a wood, and two behind a barn, one of them behind both."""
    site = wood(box(100.0, -300.0, 200.0, 300.0))
    site = replace(
        site, buildings=(Building("barn", box(-60, -20, -50, 20), 12.0), Building("shed", box(50, -5, 60, 5), 12.0))
    )
    angle = np.radians([0, 10, 90, 120, 150, 180, 240, 270])
    poses = np.column_stack([400 * np.cos(angle), 400 * np.sin(angle), np.full(8, 10.0)])
    assert sight_shares(site, "T", poses) == (2 / 8, 2 / 8)
    above = poses + np.array([0.0, 0.0, 500.0])
    assert sight_shares(site, "T", above) == (0.0, 0.0)
    seen = over_stands(site, np.tile([0.0, 0.0, 10.0], (8, 1)), np.zeros((8, 0, 3)), above)
    assert seen.tolist() == [True, True] + [False] * 6  # at any height
