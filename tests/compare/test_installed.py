"""Gain that mast and airframe add: planted, found again, and never chosen by another flight."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from aerpaw_cmp.compare.installed import LinkAngles, fit_installed
from aerpaw_cmp.flight.settings import AntennaSettings, load_pattern
from aerpaw_cmp.site.antennas import HalfWaveDipole
from aerpaw_cmp.site.installed import InstalledPattern, harmonics


@pytest.fixture
def angles() -> dict[str, LinkAngles]:
    wander = [turns * np.linspace(0, 2 * np.pi, 4000) + 0.5 for turns in (17, 5, 3)]
    level = np.full(4000, np.pi / 2)
    return {f"USRP{i}": LinkAngles(wander[0], level, wander[i], level) for i in (1, 2)}


def test_planted_gain_is_found_for_the_shared_and_the_own_antennas(angles: dict[str, LinkAngles], tmp_path) -> None:
    rng = np.random.default_rng(6)
    uav, tower = (
        np.array([2.0, -1.0, 0.5, 1.5]),
        {"USRP1": np.array([1.0, 0, 0, 2.0]), "USRP2": np.array([-2.0, 1, 1, 0])},
    )
    residual = {
        c: 7.0 + harmonics(a.uav_azimuth, 2) @ uav + harmonics(a.tower_azimuth, 2) @ tower[c] + rng.normal(0, 1, 4000)
        for c, a in angles.items()
    }
    found = fit_installed(residual, angles, orders=(0, 2))
    assert found.order == 2
    assert found.uav_db == pytest.approx(uav, abs=0.25)  # the ridge pulls towards zero
    for channel, planted in tower.items():
        assert found.tower_db[channel] == pytest.approx(planted, abs=0.25)
    assert found.block_rmse_db[2] == pytest.approx(1.0, abs=0.2)
    assert found.block_rmse_db[0] > 2.0


def test_noise_with_memory_earns_no_harmonics(angles: dict[str, LinkAngles]) -> None:
    rng = np.random.default_rng(7)
    residual = {c: 20 * gaussian_filter1d(rng.normal(size=4000), 20) for c in angles}
    assert fit_installed(residual, angles).order <= 1


def test_samples_without_a_level_do_not_count(angles: dict[str, LinkAngles]) -> None:
    rng = np.random.default_rng(8)
    residual = {c: 3 * np.cos(a.uav_azimuth) + rng.normal(0, 0.1, 4000) for c, a in angles.items()}
    holes = {c: np.where(rng.random(4000) < 0.5, np.nan, r) for c, r in residual.items()}
    assert fit_installed(holes, angles, [1]).uav_db == pytest.approx(
        fit_installed(residual, angles, [1]).uav_db, abs=0.1
    )
    with pytest.raises(ValueError, match="fewer than 16"):
        fit_installed({c: np.full(4000, np.nan) for c in angles}, angles)


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
