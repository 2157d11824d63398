"""Knife edges against closed forms and exact solutions."""

import numpy as np
import pytest

from aerpaw_cmp.propagation.field.foliage import Profile, deygout_db, knife_edge_db


def grazed(*shares: float) -> tuple[np.ndarray, np.ndarray]:
    """Edges that just touch the line, in deep ground."""
    share = np.linspace(0.0, 1.0, 1201)
    touched = np.isclose(share[:, None], shares, atol=1e-9).any(axis=1)
    assert touched.sum() == len(shares)
    return share[:, None], np.where(touched, 0.0, -200.0)[:, None]


def test_one_edge_is_a_knife_edge() -> None:
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
    there, back = (deygout_db(Profile(length, share, heights[::step]), 0.1) for step in (1, -1))
    assert there == pytest.approx(back, abs=1e-6)
    assert (there > 0).all()


def test_unknown_ground_is_no_edge() -> None:
    (share, intrusion), length = grazed(0.5), np.array([900.0])
    known = deygout_db(Profile(length, share, intrusion), 0.1)
    assert deygout_db(Profile(length, share, np.where(share < 0.3, np.nan, intrusion)), 0.1) == pytest.approx(known)
    assert deygout_db(Profile(length, share, np.full_like(share, np.nan)), 0.1).tolist() == [0.0]
