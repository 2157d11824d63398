"""Knife edges of the terrain against closed forms and the ITU's validation examples."""

from dataclasses import replace

import numpy as np
import pytest

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.propagation.field.ridges import (
    Profile,
    Ridges,
    bullington_db,
    deygout_db,
    knife_edge_db,
    ridge_loss_db,
)
from aerpaw_cmp.site.dem import Dem

# ITU-R study group 3, validation examples for the delta-Bullington method, path 2 (132.3 km, heights above the sea):
# the two ends and the highest points of the profile; the others change no maximum. Its ends: 569 m and 528 m.
PATH_2_KM_M = np.array([
    [0.0, 569], [2.05, 572], [12.0, 556], [22.65, 551], [28.4, 550], [31.8, 551], [32.3, 553], [32.65, 555],
    [32.95, 556], [36.0, 553], [38.3, 552], [42.9, 551], [46.65, 551], [60.75, 525], [61.35, 523], [65.1, 509],
    [65.3, 509], [67.6, 508], [68.9, 505], [69.8, 499], [72.1, 488], [75.4, 481], [79.25, 479], [80.85, 476],
    [82.25, 475], [83.7, 468], [87.6, 456], [89.45, 453], [99.0, 429], [109.5, 446], [113.55, 486], [113.6, 486],
    [115.05, 483], [124.35, 495], [130.75, 530], [131.65, 539], [132.315397, 528],
])  # fmt: skip
PATH_2 = [(30, 30, 1000, 36.20419305), (50, 10, 2500, 44.81240928), (20, 20, 600, 34.43917939),
          (40, 50, 200, 28.37368149), (70, 5, 150, 34.61746032)]  # fmt: skip


@pytest.mark.parametrize(("sent_m", "received_m", "mhz", "expected_db"), PATH_2)
def test_bullington_gives_the_losses_of_the_itu_examples(
    sent_m: float, received_m: float, mhz: float, expected_db: float
) -> None:
    km, height = PATH_2_KM_M.T
    length = km[-1]
    line = (height[0] + sent_m) * (1 - km / length) + (height[-1] + received_m) * km / length
    bulge = 500.0 / 8500.0 * km * (length - km)  # the examples take an Earth of 8500 km, and 3e8 m/s
    loss = bullington_db(
        Profile(np.array([1000 * length]), (km / length)[:, None], (height + bulge - line)[:, None]), 3e8 / (1e6 * mhz)
    )
    assert loss[0] == pytest.approx(expected_db, abs=0.001)


def grazed(*shares: float) -> tuple[np.ndarray, np.ndarray]:
    """Edges that just touch the line, in deep ground."""
    share = np.linspace(0.0, 1.0, 1201)
    touched = np.isclose(share[:, None], shares, atol=1e-9).any(axis=1)
    assert touched.sum() == len(shares)
    return share[:, None], np.where(touched, 0.0, -200.0)[:, None]


def test_one_edge_is_a_knife_edge_whatever_the_method() -> None:
    share, _ = grazed(0.25)
    for height in (0.0, 3.0, 40.0):
        intrusion = np.where(np.isclose(share, 0.25), height, -500.0)
        nu = height * np.sqrt(2 * 2000.0 / (0.1 * 500.0 * 1500.0))
        assert deygout_db(Profile(np.array([2000.0]), share, intrusion), 0.1)[0] == pytest.approx(
            knife_edge_db(nu), abs=1e-9
        )
    # P.526 eq. 31 against the Fresnel integral of the half-plane
    assert knife_edge_db(np.array([0.0, 1.0, 2.4])) == pytest.approx([6.02, 13.8, 20.5], abs=0.15)
    assert knife_edge_db(np.array([-0.78, -5.0, -np.inf])).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("first", [0.1, 0.25, 0.4])
@pytest.mark.parametrize("second", [0.5, 0.75, 0.9])
def test_two_grazed_edges_lose_what_the_exact_solution_says(first: float, second: float) -> None:
    # Millington et al. (1962): two edges in a line pass 1/2 - alpha / (2 pi), tan(alpha)^2 = d2 d / (d1 d3)
    d1, d2, d3 = first, second - first, 1 - second
    exact = -20 * np.log10(0.5 - np.arctan(np.sqrt(d2 / (d1 * d3))) / (2 * np.pi))
    share, intrusion = grazed(first, second)
    corrected = deygout_db(Profile(np.array([3000.0]), share, intrusion), 0.1)[0]
    assert corrected == pytest.approx(exact, abs=0.75)
    assert abs(corrected - exact) < abs(12.04 - exact), "without the correction two edges always lose 12 dB"


def test_three_edges_and_both_directions() -> None:
    # n edges in a line at equal distances pass 1 / (n + 1) (Lee, 1978); a hair decides which is the main one
    share, intrusion = grazed(0.25, 0.5, 0.75)
    intrusion[600] = 1e-3
    assert deygout_db(Profile(np.array([3000.0]), share, intrusion), 0.1)[0] == pytest.approx(12.04, abs=1.1)
    random = np.random.default_rng(3)
    heights = random.uniform(-60.0, 25.0, (1201, 20))
    length, share = random.uniform(500.0, 5000.0, 20), np.repeat(share, 20, axis=1)
    for law in (deygout_db, bullington_db):
        there, back = (law(Profile(length, share, heights[::step]), 0.1) for step in (1, -1))
        assert there == pytest.approx(back, abs=1e-6)
        assert (there > 0).all()


def test_unknown_ground_is_no_edge() -> None:
    (share, intrusion), length = grazed(0.5), np.array([900.0])
    for law in (deygout_db, bullington_db):
        known = law(Profile(length, share, intrusion), 0.1)
        assert law(Profile(length, share, np.where(share < 0.3, np.nan, intrusion)), 0.1) == pytest.approx(known)
        assert law(Profile(length, share, np.full_like(share, np.nan)), 0.1).tolist() == [0.0]


@pytest.mark.parametrize("method", ["deygout", "bullington"])
def test_the_loss_has_no_step_at_the_line_of_sight(method: Ridges) -> None:
    east = np.arange(-20.0, 1021.0, 10.0)
    crest = np.where(np.abs(east - 400.0) < 5.0, 30.0, 0.0) + 0.02 * east
    dem = Dem(
        height_m=np.tile(crest, (5, 1)), west=-20.0, south=-20.0, step_x=10.0, step_y=10.0, crs="local",
        frame=SiteFrame(35.7, -78.7), anchored=False,
    )  # fmt: skip
    # lines from deep in the shadow to well above the crest, a millimetre apart round the line of sight
    up = np.concatenate([np.linspace(20.5, 37.9, 180), np.linspace(37.9, 38.1, 201), np.linspace(38.1, 60.0, 220)])
    ends = np.column_stack([np.zeros_like(up), np.zeros_like(up), up]), np.column_stack([up * 0 + 1000.0, up * 0, up])
    loss = ridge_loss_db(dem, *ends, 0.1, method)
    assert np.abs(np.diff(loss)).max() < 0.5
    assert (np.diff(loss) <= 1e-9).all()
    assert loss[-1] == 0.0
    grazing = loss[np.abs(up - 38.0).argmin()]
    assert grazing == pytest.approx({"deygout": 6.03, "bullington": 12.4}[method], abs=0.2)
    moved = replace(dem, west=680.0, south=-320.0, height_m=dem.height_m + 50.0)
    shift = np.array([700.0, -300.0, 50.0])
    assert ridge_loss_db(moved, ends[0] + shift, ends[1] + shift, 0.1, method) == pytest.approx(loss, abs=1e-6)
    # a plane, sloped or level, is a mirror and no edge, however low the line
    plane = replace(dem, height_m=np.tile(0.02 * east, (5, 1)))
    low = np.array([[0.0, 0.0, 1.5]]), np.array([[1000.0, 0.0, 21.5]])
    assert ridge_loss_db(plane, *low, 0.1, method).tolist() == [0.0]
