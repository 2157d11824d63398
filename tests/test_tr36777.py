"""Scenarios of TR 36.777 by the rows of its annex B, and its calibration in sight by the figures of nine companies."""

import numpy as np
import pytest

from benchmarks import tr36777


def test_probability_of_sight_by_hand() -> None:
    """Annex B-1 at 30 m has p1 = 6135 m and d1 = 393 m (RMa-AV). For UMa-AV, p1 = 2552 m and d1 = 18 m."""
    far = np.array([1000.0])
    assert tr36777.sight_probability("RMa-AV", far, 30.0) == pytest.approx(
        0.393 + np.exp(-1000 / 6135) * 0.607, abs=1e-3
    )
    assert tr36777.sight_probability("UMa-AV", far, 30.0) == pytest.approx(
        0.018 + np.exp(-1000 / 2552) * 0.982, abs=1e-3
    )
    near = np.array([10.0])
    assert [tr36777.sight_probability(name, near, 30.0)[0] for name in tr36777.SCENARIOS] == [1.0, 1.0]
    assert tr36777.sight_probability("RMa-AV", far, 40.1) == tr36777.sight_probability("UMa-AV", far, 100.1) == 1.0


def test_losses_and_shadowing_by_hand() -> None:
    """Annex B-2 and B-3 at 1 km, 1 GHz, 100 m: 20 log10(40 pi / 3) = 32.44."""
    far = np.array([1000.0])
    rural, urban = (tr36777.path_loss_db(name, far, 100.0, 1e9) for name in ("RMa-AV", "UMa-AV"))
    assert np.ravel(rural) == pytest.approx([3 * 20.3 + 32.44, -12 + 3 * 24.4 + 32.44], abs=0.01)
    assert np.ravel(urban) == pytest.approx([28 + 66, -17.5 + 3 * 32 + 32.44], abs=0.01)
    assert tr36777.shadowing_db("RMa-AV", 100.0) == pytest.approx((2.651, 6.0), abs=1e-3)
    assert tr36777.shadowing_db("UMa-AV", 100.0) == pytest.approx((2.398, 6.0), abs=1e-3)


def test_the_calibration_in_sight_is_that_of_nine_companies() -> None:
    proof = tr36777.calibration(2000, np.random.default_rng(3))
    for percentile, (least, most) in tr36777.PUBLISHED_DB.items():
        assert least - 0.2 < proof[f"p{percentile}"] < most + 0.2
