"""Gain that mast and airframe add to an antenna."""

from __future__ import annotations

import numpy as np
import pytest

from aerpaw_cmp.flight.settings import AntennaSettings, load_pattern
from aerpaw_cmp.site.antennas import HalfWaveDipole
from aerpaw_cmp.site.installed import InstalledPattern


def test_the_pattern_gains_what_the_harmonics_say_on_the_horizon_and_nothing_at_the_poles() -> None:
    bare = HalfWaveDipole()
    turned = InstalledPattern(bare, (3.0, 0.0, 0.0, 1.0))
    phi = np.linspace(-np.pi, np.pi, 9)
    theta = np.full(9, np.pi / 2)

    def gain_db(pattern, theta, phi):
        return 10 * np.log10(sum(np.abs(e) ** 2 for e in pattern.field(theta, phi)))

    added = gain_db(turned, theta, phi) - gain_db(bare, theta, phi)
    assert added == pytest.approx(3 * np.cos(phi) + np.sin(2 * phi), abs=1e-9)
    near = np.full(9, 0.1)
    assert np.ptp(gain_db(turned, near, phi)) < 1.0


def test_settings_wrap_the_pattern_and_refuse_half_a_pair(tmp_path) -> None:
    pattern = load_pattern(AntennaSettings(model="dipole", installed_db=[1.0, 0.0]), tmp_path)
    assert isinstance(pattern, InstalledPattern)
    assert not isinstance(load_pattern(AntennaSettings(model="dipole"), tmp_path), InstalledPattern)
    with pytest.raises(ValueError, match="pairs"):
        AntennaSettings(model="dipole", installed_db=[1.0])
