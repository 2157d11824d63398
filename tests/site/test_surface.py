"""The ground through points of known height, by limits and closed forms."""

from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.site.relief import surface_through
from aerpaw_cmp.site.siteyaml import known_grounds, load_site

FRAME = SiteFrame(35.7275, -78.696)
REACH = (-500.0, 500.0, -500.0, 500.0)


def hills(count: int, error_m: float, seed: int = 1) -> np.ndarray:
    """Points on a wave of 4 m and 600 m, with errors."""
    random = np.random.default_rng(seed)
    place = random.uniform(-450, 450, (count, 2))
    height = 100 + 4 * np.sin(place[:, 0] / 95) + 2 * np.cos(place[:, 1] / 95) + random.normal(0, error_m, count)
    return np.column_stack([place, height, np.full(count, error_m)])


def test_goes_through_exact_points_and_is_smooth_between() -> None:
    points = hills(120, 0.01)
    surface = surface_through(points, FRAME, REACH)
    dem = surface.dem()
    np.testing.assert_allclose(surface.sd_m(points[:, 0], points[:, 1]), 0.01, atol=0.01)
    at = np.random.default_rng(2).uniform(-400, 400, (500, 2))
    truth = 100 + 4 * np.sin(at[:, 0] / 95) + 2 * np.cos(at[:, 1] / 95)
    error = dem.absolute_m(at[:, 0], at[:, 1]) - truth
    assert np.sqrt(np.mean(error**2)) < 0.25
    assert dem.ground_m(0.0, 0.0) == 0.0  # up counts from the ground at the origin


def test_its_standard_deviation_is_that_of_its_errors() -> None:
    points = hills(60, 0.3)
    surface = surface_through(points, FRAME, REACH)
    at = np.random.default_rng(3).uniform(-450, 450, (2000, 2))
    truth = 100 + 4 * np.sin(at[:, 0] / 95) + 2 * np.cos(at[:, 1] / 95)
    off = (surface.dem().absolute_m(at[:, 0], at[:, 1]) - truth) / surface.sd_m(at[:, 0], at[:, 1])
    assert 0.4 < np.sqrt(np.mean(off**2)) < 1.6


def test_far_from_all_points_only_the_process_is_known() -> None:
    surface = surface_through(hills(40, 0.1) * [0.1, 0.1, 1, 1], FRAME, REACH)
    assert surface.sd_m(np.array([1e5]), np.array([0.0]))[0] == pytest.approx(surface.deviation_m)
    assert surface.dem().absolute_m(500.0, 500.0) == pytest.approx(surface.level_m, abs=3 * surface.deviation_m)


def test_draws_spread_as_the_surface_says() -> None:
    surface = surface_through(hills(25, 0.3), FRAME, REACH)
    at = np.array([[-300.0, 200.0], [0.0, 0.0], [250.0, -350.0], [480.0, 480.0]])
    drawn = np.array([surface.dem(np.random.default_rng(k)).absolute_m(*at.T) for k in range(100)])
    together = [dem.absolute_m(*at.T) for dem in surface.dems(map(np.random.default_rng, range(3)))]
    np.testing.assert_array_equal(together, drawn[:3])
    np.testing.assert_allclose(drawn.mean(axis=0), surface.dem().absolute_m(*at.T), atol=0.25 * surface.deviation_m)
    np.testing.assert_allclose(drawn.std(axis=0), surface.sd_m(*at.T), rtol=0.2, atol=0.05)


def test_two_heights_at_one_place_are_refused() -> None:
    points = np.vstack([hills(10, 0.1), [[0, 0, 100, 0.1], [0.5, 0, 104, 0.1]]])
    with pytest.raises(UsageError, match="ground_points 11 and 12 disagree: 100 and 104 m at one place"):
        surface_through(points, FRAME, REACH)
    points[-1, 3] = 5.0  # an error that admits it
    surface_through(points, FRAME, REACH)


def test_a_site_without_points_has_no_surface(tmp_path: Path) -> None:
    text = "name: t\norigin: {latitude_deg: 35.7275, longitude_deg: -78.696}\ntower_ground: surface\n"
    text += "towers: {T: {latitude_deg: 35.7275, longitude_deg: -78.696}}\n"
    (tmp_path / "site.yaml").write_text(text)
    with pytest.raises(UsageError, match=r"ground_points has 0 points; expected 3 or more"):
        load_site(tmp_path / "site.yaml")
    assert known_grounds(tmp_path / "site.yaml") == ("flat",)


def test_the_packaged_ground_agrees_with_what_was_surveyed() -> None:
    assert known_grounds("lake_wheeler") == ("flat", "offsets", "surface")
    flat, site = load_site("lake_wheeler"), load_site("lake_wheeler", tower_ground="surface")
    assert flat.dem is None
    assert site.dem is not None
    # a pond or flat, and a control point, above LW1's ground
    assert site.dem.ground_m(330.0, 210.0) == pytest.approx(-18, abs=1.5)
    assert site.dem.ground_m(-127.0, -145.0) == pytest.approx(-6.6, abs=1.0)
    assert site.towers["LW2"].ground_m == pytest.approx(-4.45, abs=1.0)
    assert any("smooth surface through" in note for note in site.notes)
