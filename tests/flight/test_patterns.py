"""Patterns within an area, and the files of a route: what is written is read back."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.flight.route_files import read_areas, read_route
from aerpaw_cmp.flight.routes import (
    NOSES,
    Pattern,
    Waypoint,
    allowed_area,
    cut,
    flown,
    lawnmower,
    path_within,
    plan_text,
    route_of,
    waypoints_csv,
    waypoints_of,
    with_turns,
)
from aerpaw_cmp.site.siteyaml import load_site

TOWER = np.array([[10.0, 20.0, 10.0]])
SQUARE = shapely.box(-200, -150, 200, 150)
NOTCH = shapely.box(-30, 0, 30, 400)
AREA = allowed_area(SQUARE, [NOTCH], TOWER, 40.0)


@pytest.mark.parametrize("nose", NOSES)
@pytest.mark.parametrize(("azimuth", "turns"), [(0.0, False), (40.0, True)])
def test_routes_stay_within_area_battery_and_away_from_towers(nose, azimuth, turns):
    route = route_of(Pattern(azimuth_deg=azimuth, height_m=35.0, nose=nose, turns=turns), AREA, 8.0, 300.0)
    line = shapely.LineString(route.position_m[:, :2])
    assert shapely.box(-200, -150, 200, 150).covers(line)
    assert line.intersection(NOTCH).length < 5.0
    assert line.distance(shapely.Point(*TOWER[0, :2])) > 38.0
    assert 100.0 < route.duration_s <= 300.0
    step = np.linalg.norm(np.diff(route.position_m, axis=0), axis=1)
    assert step.max() < 8.01
    assert len(np.unique(route.yaw_deg)) == 1 if nose == "fixed" and not turns else len(np.unique(route.yaw_deg)) > 2


def test_the_way_round_an_obstacle_is_the_shorter_one():
    ring = shapely.box(0, 0, 100, 100).difference(shapely.box(30, 20, 70, 70))
    way = path_within(ring, np.array([10.0, 30.0]), np.array([90.0, 30.0]))
    route = shapely.LineString([(10, 30), *way, (90, 30)])
    assert ring.buffer(1.5).covers(route)
    assert route.length == pytest.approx(80.0 + 2 * 10.0, abs=3.0)  # below, not above
    assert path_within(ring, np.array([10.0, 10.0]), np.array([90.0, 10.0])) == []
    for begin, end in (((10.0, 60.0), (90.0, 60.0)), ((90.0, 60.0), (10.0, 60.0)), ((40.0, 10.0), (40.0, 90.0))):
        way = path_within(ring, np.array(begin), np.array(end))
        detour = shapely.LineString([begin, *way, end])
        assert ring.buffer(1.5).covers(detour)
        assert detour.length == pytest.approx(100.0, abs=3.0)  # 80 m, and 10 m aside and back
        assert np.hypot(*(way[0] - begin)) < np.hypot(*(way[-1] - begin))
    legs = [np.array([[0.0, 30.0], [30.0, 30.0]]), np.array([[70.0, 30.0], [100.0, 30.0]])]
    assert len(waypoints_of(legs, ring, 30.0, "along")) == 4 + len(path_within(ring, legs[0][1], legs[1][0]))


def test_legs_of_a_rectangle_are_those_by_hand():
    area = shapely.box(0, 0, 230, 300)
    by_hand = [[(23 + 46 * k, 0), (23 + 46 * k, 300)][:: -1 if k % 2 else 1] for k in range(5)]
    np.testing.assert_allclose(lawnmower(area, 0.0, 45.0), by_hand, atol=1e-9)
    lying = lawnmower(area, 90.0, 150.0)
    np.testing.assert_allclose(np.sort(np.array(lying)[:, :, 1].ravel()), [75, 75, 225, 225], atol=1e-9)
    np.testing.assert_allclose(lying[0][:, 0], lying[1][::-1, 0], atol=1e-9)
    assert sorted(lying[0][:, 0]) == pytest.approx([0, 230])
    np.testing.assert_allclose(lawnmower(area, 0.0, 1000.0), [[(115, 0), (115, 300)]], atol=1e-9)
    notched = area.difference(shapely.box(0, 39, 300, 200))  # 39 m are not a leg, 100 m are
    assert [leg[:, 1].tolist() for leg in lawnmower(notched, 0.0, 115.0)] == [[200, 300], [300, 200]]
    split = area.difference(shapely.box(0, 100, 300, 200))
    assert [leg[:, 1].tolist() for leg in lawnmower(split, 0.0, 115.0)] == [[0, 100], [200, 300], [300, 200], [100, 0]]


def test_noses_turn_as_they_are_named_and_slow_turns_stand_at_four_points():
    legs = [np.array([[100.0 * k, 300.0 * (k % 2)], [100.0 * k, 300.0 * (1 - k % 2)]]) for k in range(5)]
    area = shapely.box(-50, -50, 500, 350)
    course = [0, 90, 180, 90, 0, 90, 180, 90, 0, 0]  # the last point keeps its nose
    leg_of = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    for nose, expected in (
        ("along", course), ("fixed", [0] * 10),
        ("four headings", [(c + 90 * (n % 4)) % 360 for c, n in zip(course, leg_of, strict=True)]),
    ):  # fmt: skip
        points = waypoints_of(legs, area, 30.0, nose)
        assert [(w.east_m, w.north_m, w.height_m) for w in points] == [(*c, 30.0) for leg in legs for c in leg]
        assert [w.yaw_deg for w in points] == pytest.approx(expected)
    turned = with_turns(points)
    assert len(turned) == 10 + 4 * 8
    assert [w for w in turned if not w.hold_s] == points
    for place in (0, 3, 6, 9):
        at = [w for w in turned if w.hold_s and (w.east_m, w.north_m) == (points[place].east_m, points[place].north_m)]
        assert [w.yaw_deg for w in at] == [(points[place].yaw_deg + 45.0 * k) % 360.0 for k in range(8)]
        assert {w.hold_s for w in at} == {8.0}
    assert len(with_turns(points[:2])) == 2 + 2 * 8


def test_what_may_be_flown_is_the_fence_less_what_is_avoided_and_three_metres():
    wide = allowed_area(SQUARE, [shapely.box(100, -150, 120, 150)], TOWER + 1000.0, 40.0)
    assert wide.bounds == pytest.approx((-197.0, -147.0, 97.0, 147.0))  # the larger part
    assert allowed_area(SQUARE, [], TOWER, 0.0).area == pytest.approx(394.0 * 294.0)
    hole = 394.0 * 294.0 - allowed_area(SQUARE, [], TOWER, 40.0).area
    assert hole == pytest.approx(np.pi * 43.0**2, rel=0.01)


def test_a_longer_battery_is_a_denser_lawnmower_and_a_cut_route_ends_in_time():
    pattern = Pattern(azimuth_deg=0.0, height_m=35.0, nose="along")
    lengths = [route_of(pattern, AREA, 8.0, seconds).length_m for seconds in (60.0, 240.0, 600.0)]
    assert lengths[0] < 0.5 * lengths[1] < 0.5 * lengths[2]
    route = flown("r", [Waypoint(east_m=0, north_m=0, height_m=10, yaw_deg=5, hold_s=20),
                        Waypoint(east_m=0, north_m=160, height_m=10, yaw_deg=90)], 8.0)  # fmt: skip
    assert route.duration_s == 40.0
    np.testing.assert_array_equal(route.position_m[:21, 1], 0.0)
    np.testing.assert_allclose(route.position_m[30, 1], 80.0)
    short = cut(route, 30.0, 8.0)
    assert short.duration_s == 30.0
    np.testing.assert_allclose(short.position_m, route.position_m[:31])


@pytest.mark.parametrize("most_s", [np.inf, 13.0])
def test_a_leg_lasts_as_long_as_its_length_at_the_speed(most_s):
    """3, 4 and 5 s at 10 m/s, and 2 s of waiting before the last leg, whose heading the UAV already has."""
    places = ((0.0, 0.0, 30.0, 90.0, 0.0), (30.0, 0.0, 30.0, 0.0, 0.0), (30.0, 40.0, 30.0, -90.0, 2.0))
    names = ("east_m", "north_m", "height_m", "yaw_deg", "hold_s")
    last_one = (30.0, 40.0, 80.0, 45.0, 0.0)
    points = [Waypoint(**dict(zip(names, place, strict=True))) for place in (*places, last_one)]
    route = cut(flown("legs", points, 10.0), most_s, 10.0)
    east, north = [0, 10, 20, *[30] * 12], [*[0] * 4, 10, 20, 30, *[40] * 8]
    by_hand = np.column_stack([east, north, [*[30] * 10, 40, 50, 60, 70, 80]])
    last = int(min(14, most_s))
    np.testing.assert_allclose(route.position_m, by_hand[: last + 1], atol=1e-12)
    np.testing.assert_array_equal(route.time_s, np.arange(last + 1.0))
    np.testing.assert_array_equal(route.yaw_deg, ([90] * 4 + [0] * 4 + [270] * 7)[: last + 1])
    assert (route.duration_s, route.length_m) == pytest.approx((last, 10.0 * (last - 2)))


def test_an_area_without_room_is_refused():
    with pytest.raises(UsageError, match="no area remains"):
        allowed_area(shapely.box(0, 0, 50, 50), [], np.array([[25.0, 25.0, 0.0]]), 60.0)
    with pytest.raises(UsageError, match="no leg of 40 m"):
        route_of(Pattern(azimuth_deg=0.0, height_m=30.0, nose="along"), shapely.box(0, 0, 20, 20), 8.0, 60.0)


def test_files_hold_the_route_that_was_planned(tmp_path: Path):
    frame = load_site("lake_wheeler").frame
    ways = [
        Waypoint(east_m=0.0, north_m=0.0, height_m=35.0, yaw_deg=90.0),
        Waypoint(east_m=120.0, north_m=-40.0, height_m=35.0, yaw_deg=270.0, hold_s=8.0),
        Waypoint(east_m=130.0, north_m=200.0, height_m=45.0, yaw_deg=10.0),
    ]
    for name, text in (("a.plan", plan_text(ways, frame, 8.0)), ("a.csv", waypoints_csv(ways, frame))):
        (tmp_path / name).write_text(text)
        table = read_route(tmp_path / name)
        east, north = frame.to_local(table["latitude_deg"].to_numpy(), table["longitude_deg"].to_numpy())
        np.testing.assert_allclose(east, [w.east_m for w in ways], atol=0.05)
        np.testing.assert_allclose(north, [w.north_m for w in ways], atol=0.05)
        np.testing.assert_allclose(table["altitude_m"], [w.height_m for w in ways])
        np.testing.assert_allclose(table["yaw_deg"], [w.yaw_deg for w in ways])


def test_a_geofence_is_read_and_what_is_none_is_one_message(tmp_path: Path):
    fence = tmp_path / "fence.kml"
    body = "<kml><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>{}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
    fence.write_text(body.format("-78.7,35.72,0 -78.69,35.72,0 -78.69,35.73,0 -78.7,35.72,0"))
    assert read_areas(fence) == [[(35.72, -78.7), (35.72, -78.69), (35.73, -78.69), (35.72, -78.7)]]
    for bad, said in (
        ("nan,x,0", "a coordinate that is not a number"),
        ("-78.7,95,0 -78.69,95,0 -78.69,96,0", "not a position on Earth"),
        ("", "without an area"),
    ):
        fence.write_text(body.format(bad))
        with pytest.raises(InputError, match=said):
            read_areas(fence)
