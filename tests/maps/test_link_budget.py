"""The link budget of a map against the textbook noise floor, and thresholds that cannot hold."""

import math

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps.grid import PAPER_BUDGET, LinkBudget

BOLTZMANN, ROOM_K = 1.380649e-23, 290.0


@pytest.mark.parametrize("bandwidth_mhz", [0.18, 1.4, 20.0, 100.0])
def test_noise_floor_is_boltzmann_noise_times_noise_factor(bandwidth_mhz: float) -> None:
    budget = LinkBudget(bandwidth_mhz=bandwidth_mhz, noise_figure_db=5.0)
    expected = 10 * math.log10(BOLTZMANN * ROOM_K * bandwidth_mhz * 1e6 * 1000) + 5.0
    assert budget.noise_dbm == pytest.approx(expected, abs=0.05)


def test_an_snr_threshold_is_the_same_as_its_level() -> None:
    by_snr = LinkBudget(bandwidth_mhz=20, noise_figure_db=7, threshold_snr_db=3)
    assert by_snr.level_dbm is not None
    by_level = LinkBudget(bandwidth_mhz=20, noise_figure_db=7, threshold_dbm=by_snr.level_dbm)
    levels = np.linspace(-120.0, -60.0, 601)
    np.testing.assert_array_equal(by_snr.covered(levels), by_level.covered(levels))


def test_missing_levels_are_not_covered_and_every_path_counts_without_a_threshold() -> None:
    levels = np.array([np.nan, -300.0, -100.0, -99.9])
    assert PAPER_BUDGET.covered(levels).tolist() == [0.0, 1.0, 1.0, 1.0]
    assert LinkBudget(threshold_dbm=-100.0).covered(levels).tolist() == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"threshold_dbm": -100.0, "threshold_snr_db": 0.0, "bandwidth_mhz": 20.0}, "one of the two"),
        ({"threshold_snr_db": 0.0}, "without a bandwidth"),
        ({"threshold_dbm": -120.0, "bandwidth_mhz": 20.0}, "below the noise floor of -101.0 dBm"),
        ({"noise_figure_db": 7.0}, "without a bandwidth"),
        ({"bandwidth_mhz": 20e6}, "Hz instead of MHz"),
        ({"tx_power_dbm": math.nan}, "transmit power"),
        ({"tx_power_dbm": 40_000.0}, "watts instead of dBm"),
    ],
)
def test_a_budget_that_cannot_hold_is_refused(change: dict[str, float], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        LinkBudget(**change)  # type: ignore[arg-type]
