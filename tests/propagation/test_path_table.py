"""Path tables against H, closed forms, numerical derivatives and Sionna."""

from dataclasses import replace

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import SPEED_OF_LIGHT_MPS, wavelength_m
from aerpaw_cmp.flight.replay import part_of
from aerpaw_cmp.propagation.drivers import replay_in_parts, replay_moving
from aerpaw_cmp.propagation.edges import over_edges
from aerpaw_cmp.propagation.field.sum import mean_pair_power
from aerpaw_cmp.propagation.geometry import Poses, rotation_from_aircraft, tower_comparison_array, uav_comparison_array
from aerpaw_cmp.propagation.options import Field, Run, Search
from aerpaw_cmp.propagation.replay import replay, subcarriers_hz
from aerpaw_cmp.site.site import Building

BARN = Building("barn", box(40, -20, 60, 25), 9.0)


def lossy(paths, sources_m, targets_m):
    """Return a loss by depth and position. The line of sight of the third tower is blocked."""
    loss = 3.0 * paths.depth + 0.01 * np.linalg.norm(targets_m[paths.pose] - sources_m[paths.tower], axis=1)
    return np.where((sources_m[paths.tower, 0] < -40.0) & (paths.depth == 0), np.inf, loss)


@pytest.fixture(scope="module")
def case(scenes):
    rng = np.random.default_rng(7)
    site = scenes.site((BARN, *scenes.buildings(rng, 4)), ((0.0, 0.0, 10.0), (3.0, -25.0, 20.0), (-44.0, 2.0, 9.0)))
    position = rng.uniform([-120, -120, 3], [120, 120, 50], (60, 3))
    turn = rng.uniform(-40, 40, (3, 60))
    return site, scenes.poses(position, rotation_from_aircraft(*turn))


def summed(table, h):
    total = np.zeros_like(h)
    np.add.at(total, (table.pose, table.tower), table.gain)
    return total


def link_of(scenes, site, **settings):
    return scenes.link(
        site, tower_comparison_array(), uav_comparison_array(wavelength_m(scenes.carrier_hz)), **settings
    )


@pytest.mark.parametrize("uav_transmits", [True, False])
def test_h_is_the_sum_of_the_gains(scenes, case, uav_transmits):
    site, poses = case
    link = link_of(scenes, site, uav_transmits=uav_transmits, noise_floor_dbm=-60.0)
    result = replay(site, link, poses, Search(further=(over_edges,)), Field(lossy))
    table = result.path_table()
    assert set(np.unique(table.kind)) == {0, 1, 2}
    assert (
        (table.kind == 2) == (table.turns % 10 == 2) | (table.turns // 10 % 10 == 2)
    ).all()  # an edge, whatever else
    assert not result.has_path.all()
    assert summed(table, result.h) == pytest.approx(result.h, rel=0, abs=1e-9 * np.abs(result.h).max())
    a, tau = result.cir()
    axes = (2, 0, 1, 3) if uav_transmits else (0, 2, 1, 3)
    assert a[..., 0].sum(axis=-1).transpose(axes) == pytest.approx(result.h, rel=0, abs=1e-9 * np.abs(result.h).max())
    assert a.shape[0::2][:2] == tau.shape[:2] == ((3, 60) if uav_transmits else (60, 3))


def test_parts_of_a_flight_and_a_tower_that_moves_keep_their_paths(scenes, case):
    site, poses = case
    site = replace(site, towers={"LW1": site.towers["LW1"]})
    link, search = link_of(scenes, site), Search(further=(over_edges,))
    result = replay(site, link, poses, search, Field(lossy))
    parts = replay_in_parts(site, link, poses, search, Field(lossy), Run(), size=13)
    cut = part_of(result, 10, 30)
    places = np.array([0.0, 0.0, 10.0]) + np.outer(np.arange(60) // 5, [0.7, -0.4, 0.0])
    moving = replay_moving(site, link, poses, places, search, Field(lossy))
    for some in (parts, cut, moving, part_of(moving, 10, 30)):
        assert len(some.path_table().pose)
        assert summed(some.path_table(), some.h) == pytest.approx(some.h, rel=0, abs=1e-9 * np.abs(some.h).max())
    assert set(moving.path_table().kind) == {0, 1, 2}


def test_doppler_is_the_derivative_of_the_length(scenes, case):
    site, poses = case
    link, search, step_s = link_of(scenes, site), Search(further=(over_edges,)), 1e-3
    velocity = np.random.default_rng(1).normal(0.0, 6.0, (len(poses), 3))

    def lengths(sign):
        moved = Poses(poses.position_m + sign * step_s * velocity, poses.rotation)
        table = replay(site, link, moved, search).path_table()
        names = np.array(table.names)[table.via]
        keys = zip(table.pose, table.tower, names, table.turns, strict=True)
        return dict(zip(keys, table.length_m, strict=True)), table

    (before, _), (after, _), (now, table) = lengths(-1), lengths(1), lengths(0)
    doppler = dict(zip(now, table.doppler_hz(link.carrier_hz, velocity), strict=True))
    shared = [key for key in now if key in before and key in after]
    assert len(shared) > 300
    slope = np.array([(after[key] - before[key]) / (2.0 * step_s) for key in shared])
    expected = -link.carrier_hz / SPEED_OF_LIGHT_MPS * slope
    assert np.array([doppler[key] for key in shared]) == pytest.approx(
        expected, rel=1e-6, abs=1e-6 * np.abs(expected).max()
    )


def test_an_approaching_uav_and_an_approaching_tower_raise_the_frequency(scenes):
    site = scenes.site()
    table = replay(site, scenes.link(site), scenes.poses([[300.0, 0.0, 10.0]]), Search(max_depth=0)).path_table()
    towards, full = np.array([[-10.0, 0.0, 0.0]]), scenes.carrier_hz * 10.0 / SPEED_OF_LIGHT_MPS
    assert table.doppler_hz(scenes.carrier_hz, towards) == pytest.approx([full])
    assert table.doppler_hz(scenes.carrier_hz, -towards) == pytest.approx([-full])
    assert table.doppler_hz(scenes.carrier_hz, 0.0 * towards, -towards) == pytest.approx([full])


def test_delays_and_angles_of_two_rays(scenes):
    site = scenes.site()
    result = replay(site, scenes.link(site), scenes.poses([[0.0, 300.0, 50.0]]), Search(max_depth=1))
    frame = result.paths_frame()
    assert list(frame.kind) == ["line_of_sight", "reflection"]
    assert list(frame.faces) == ["", "ground"]
    expected = np.hypot(300.0, [40.0, 60.0]) / SPEED_OF_LIGHT_MPS
    assert frame.delay_s.to_numpy() == pytest.approx(expected, rel=1e-14)
    up = np.degrees(np.arctan2([40.0, -60.0], 300.0))
    assert frame.elevation_arrival_deg.to_numpy() == pytest.approx(
        up
    )  # the UAV transmits: its wave arrives at the tower
    assert frame.elevation_departure_deg.to_numpy() == pytest.approx(np.degrees(np.arctan2([-40.0, -60.0], 300.0)))
    assert frame.azimuth_arrival_deg.to_numpy() == pytest.approx([90.0, 90.0])
    assert frame.azimuth_departure_deg.to_numpy() == pytest.approx([-90.0, -90.0])


def test_angles_in_the_frames_of_arrays_that_are_turned_and_rolled(scenes):
    """Tower below, right wing down: it is to the right. A boresight to the north-east sees it overhead all the same."""
    site = scenes.site()
    uav = uav_comparison_array(wavelength_m(scenes.carrier_hz), yaw_deg=0.0, roll_deg=0.0)
    link = scenes.link(site, tower_comparison_array(yaw_deg=45.0), uav)
    turn = rotation_from_aircraft([90.0, 0.0], [0.0, 0.0], [90.0, 90.0])
    table = replay(site, link, scenes.poses([[0, 0, 60.0], [100.0, 0, 10.0]], turn), Search(max_depth=0))
    angles = table.path_table().angles_deg(table.ends)
    assert angles["azimuth_departure_array_deg"] == pytest.approx([-90.0, 180.0])
    assert angles["elevation_departure_array_deg"] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert angles["elevation_arrival_array_deg"] == pytest.approx([90.0, 0.0], abs=1e-9)
    assert angles["azimuth_arrival_array_deg"][1] == pytest.approx(-45.0)
    rolled = scenes.link(
        site, uav_array=uav_comparison_array(wavelength_m(scenes.carrier_hz), yaw_deg=0.0, roll_deg=90.0)
    )
    table = replay(site, rolled, scenes.poses([[0, 0, 60.0]]), Search(max_depth=0))
    assert table.path_table().angles_deg(table.ends)["azimuth_departure_array_deg"] == pytest.approx([-90.0])


def test_over_cycles_of_the_delay_the_mean_power_is_the_power_sum(scenes):
    """Two paths whose phases turn against each other by five cycles within the band: their cross term is zero."""
    site = scenes.site()
    link = link_of(scenes, site)
    result = replay(site, link, scenes.poses([[0.0, 60.0, 50.0]]), Search(max_depth=1))
    table = result.path_table()
    assert len(table.pose) == 2
    offsets = subcarriers_hz(5.0 / np.ptp(table.delay_s), 64)
    h = result.cfr(offsets)
    assert h[..., 32] == pytest.approx(result.h, rel=1e-12)
    mean = mean_pair_power(np.moveaxis(h, -1, 0)).mean(axis=0)
    assert mean == pytest.approx((np.abs(table.gain) ** 2).mean(axis=(1, 2)).sum(), rel=1e-9)
    level = link.transmit_power_dbm + 10.0 * np.log10(mean)
    assert level == pytest.approx(result.rss_power_dbm, abs=1e-9)


def test_time_steps_turn_by_the_doppler_shift(scenes, case):
    site, poses = case
    result = replay(site, link_of(scenes, site), poses)
    velocity = np.tile([3.0, -4.0, 1.0], (len(poses), 1))
    a, _ = result.cir(velocity, [0.0, 1e-3])
    table = result.path_table()
    turn = np.exp(2e-3j * np.pi * table.doppler_hz(scenes.carrier_hz, velocity))
    assert a[table.tower, 0, table.pose, 0, table.number, 1] == pytest.approx(table.gain[:, 0, 0] * turn)


def test_a_band_wider_than_the_model_is_refused(scenes):
    site = scenes.site()
    result = replay(site, scenes.link(site), scenes.poses([[0.0, 60.0, 50.0]]))
    with pytest.raises(UsageError, match="a tenth of the carrier"):
        result.cfr(subcarriers_hz(400e6, 8))


def test_links_without_a_path_have_no_row(scenes):
    site = scenes.site()
    result = replay(site, scenes.link(site), scenes.poses([[np.nan, 0.0, 10.0]]))
    assert len(result.paths_frame()) == 0
    a, tau = result.cir()
    assert a.shape == (1, 1, 1, 1, 0, 1)
    assert tau.shape == (1, 1, 0)
    assert not result.cfr([0.0, 1e6]).any()


@pytest.mark.sionna
def test_delays_are_those_of_sionna(sionna, scenes, case, monkeypatch):
    site, poses = case
    site = replace(site, towers={"LW1": site.towers["LW1"]})
    few = Poses(poses.position_m[:20], poses.rotation[:20])
    found, ask = [], sionna._Finder.trace

    def recorded(finder, *arguments):
        paths = ask(finder, *arguments)
        found.append(paths.cir(normalize_delays=False, out_type="numpy"))
        return paths

    monkeypatch.setattr(sionna._Finder, "trace", recorded)
    traced = replay(site, scenes.link(site), few, Search("sionna", samples=100_000, batch=20), run=Run(cache_dir=""))
    table, compared = traced.path_table(), 0
    a, tau = found[-1]
    for pose in range(20):
        own = np.sort(tau[pose].ravel()[np.abs(a[pose]).max(axis=(0, 1, 2, 4)) > 0.0])
        ours = np.sort(table.delay_s[table.pose == pose])
        assert own == pytest.approx(ours, rel=2e-6)  # float32
        compared += len(ours)
    assert compared > 40
