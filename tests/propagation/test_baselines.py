"""Closed-form baselines of recommendations against their own limits and hand-worked values."""

import numpy as np
import pytest

from aerpaw_cmp.propagation.field.baselines import p1411_loss_db, tr36777_loss_db

NEAR, FAR = np.array([200.0]), np.array([400.0])
HIGH = np.array([50.0])


def test_slopes_are_those_of_the_tables() -> None:
    """Decibels per decade: 22.9 (P.1411), 22 (UMa-AV), 23.9 - 1.8 log10 50 (RMa-AV)."""
    decade = np.log10(FAR / NEAR)
    assert (p1411_loss_db(FAR, 3.3e9) - p1411_loss_db(NEAR, 3.3e9)) / decade == pytest.approx(22.9)
    for scenario, slope in (("UMa-AV", 22.0), ("RMa-AV", 23.9 - 1.8 * np.log10(50.0))):
        far, near = (tr36777_loss_db(scenario, d, HIGH, 3.3e9) for d in (FAR, NEAR))
        assert (far - near) / decade == pytest.approx(slope)


def test_values_by_hand_lie_near_free_space() -> None:
    """At 200 m and 3.3 GHz free space loses 88.8 dB; every model of a path in sight is within 4 dB of it."""
    free = 20.0 * np.log10(4.0 * np.pi * 200.0 * 3.3e9 / 299_792_458.0)
    assert free == pytest.approx(88.83, abs=0.01)
    assert p1411_loss_db(NEAR, 3.3e9) == pytest.approx(91.46, abs=0.01)  # 52.69 + 28.6 + 10.16
    assert tr36777_loss_db("UMa-AV", NEAR, HIGH, 3.3e9) == pytest.approx(88.99, abs=0.01)  # 28 + 50.62 + 10.37
    for loss in (p1411_loss_db(NEAR, 3.3e9), tr36777_loss_db("RMa-AV", NEAR, HIGH, 3.3e9)):
        assert abs(loss - free) < 4.0


def test_low_terminals_count_as_ten_metres() -> None:
    low, ten = (tr36777_loss_db("RMa-AV", NEAR, np.array([h]), 3.3e9) for h in (2.0, 10.0))
    assert low == ten
