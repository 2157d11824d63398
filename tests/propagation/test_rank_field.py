"""Measured NR ranks of two flights against line of sight + ground (needs the real logs)."""

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.propagation.geometry import tower_comparison_array, uav_comparison_array
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.site import Site, Tower
from tests.real_logs import REAL

pytestmark = pytest.mark.field

LW1 = (35.72750947, -78.69595819)
ANTENNA_M = 12.0
ALTERNATE = (45.0, -45.0, 45.0, -45.0)
VERTICAL = (0.0, 0.0, 0.0, 0.0)


def shares(scenes, flight, k, tower_slant=ALTERNATE, uav_slant=None):
    """Measured and simulated shares of rank 1 to 4 above 10 m."""
    log = pd.read_csv(REAL / f"nr_rank/july2_2024_flight{flight}_nemo_nr.csv")
    log = log[(log.alt_m > 10) & log.pdsch_rank.notna()]
    measured = np.bincount(log.pdsch_rank.astype(int), minlength=5)[1:5] / len(log)
    frame = SiteFrame(*LW1)
    east, north = frame.to_local(log.lat.to_numpy(), log.lon.to_numpy())
    site = Site("field", frame, {"LW1": Tower("LW1", *LW1, 0.0, 0.0, ANTENNA_M)})
    uav = uav_comparison_array(wavelength_m(3.4e9), **({} if uav_slant is None else {"slant_deg": uav_slant}))
    link = scenes.link(site, tower_comparison_array(slant_deg=tower_slant), uav, uav_transmits=False)
    poses = scenes.poses(np.column_stack([east, north, log.alt_m]))
    rank = channel_rank(replay(site, link, poses, Search(max_depth=1)).h[:, 0], k)
    return measured, np.bincount(rank, minlength=5)[1:5] / len(log)


def total_variation(measured, simulated):
    return 0.5 * np.abs(measured - simulated).sum()


@pytest.mark.parametrize(("flight", "expected"), [(1, (0.0, 0.79, 0.19, 0.02)), (3, (0.0, 0.77, 0.21, 0.02))])
def test_slants_alternating_along_the_numbering_give_the_known_shares(scenes, flight, expected):
    measured, simulated = shares(scenes, flight, 10, uav_slant=ALTERNATE)
    assert simulated == pytest.approx(expected, abs=0.01)
    assert total_variation(measured, simulated) < 0.11


@pytest.mark.parametrize(("flight", "limit"), [(1, 0.07), (3, 0.10)])
def test_default_arrays_come_within_a_total_variation_of_a_tenth(scenes, flight, limit):
    assert total_variation(*shares(scenes, flight, 10)) <= limit


@pytest.mark.parametrize("flight", [1, 3])
def test_vertical_elements_miss_the_measured_ranks(scenes, flight):
    at_10 = shares(scenes, flight, 10, VERTICAL, VERTICAL)
    assert total_variation(*at_10) > 0.7
    at_1000 = shares(scenes, flight, 1000, VERTICAL, VERTICAL)
    assert total_variation(*at_1000) > 0.15
