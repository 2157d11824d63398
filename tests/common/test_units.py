"""Check constants against the relations that define them, and conversions against their inverses."""

import numpy as np
import pytest

from aerpaw_cmp.common import units


def test_constants_satisfy_the_relations_between_them() -> None:
    vacuum_permeability = 1.256_637_062_12e-6  # CODATA 2018
    assert units.SPEED_OF_LIGHT_MPS == 299_792_458.0
    product = units.VACUUM_PERMITTIVITY_F_PER_M * vacuum_permeability * units.SPEED_OF_LIGHT_MPS**2
    assert product == pytest.approx(1.0, rel=1e-9)
    assert units.wavelength_m(299_792_458.0) == 1.0
    assert units.wavelength_m(2 * 299_792_458.0) == 0.5
    assert units.MINIMUM_HEIGHT_M == 0.5, "arXiv 2502.10324, section V"


def test_noise_is_boltzmann_times_temperature_times_bandwidth() -> None:
    watt = 1.380_649e-23 * 290.0
    assert pytest.approx(1000 * watt, rel=1e-12) == 10 ** (units.THERMAL_NOISE_DBM_HZ / 10)
    assert 10 ** (units.noise_floor_dbm(20e6) / 10) == pytest.approx(1000 * watt * 20e6, rel=1e-12)
    assert units.noise_floor_dbm(20e6, 7.0) - units.noise_floor_dbm(20e6) == pytest.approx(7.0)


def test_levels_and_ratios_are_each_others_inverse() -> None:
    level = np.array([-123.4, -3.0, 0.0, 0.1, 40.0])
    np.testing.assert_allclose(units.db_from_power(units.power_from_db(level)), level, atol=1e-12)
    np.testing.assert_allclose(units.db_from_amplitude(units.amplitude_from_db(level)), level, atol=1e-12)
    np.testing.assert_allclose(units.amplitude_from_db(level) ** 2, units.power_from_db(level), rtol=1e-14)
    assert (units.amplitude_from_db(level) > 0).all()
    assert units.power_from_db([0.0, 10.0, -20.0]).tolist() == pytest.approx([1.0, 10.0, 0.01])
    assert units.db_from_power([1.0, 100.0, 0.0]).tolist() == [0.0, 20.0, -np.inf]
    assert units.db_from_amplitude([1.0, 100.0, 0.0]).tolist() == [0.0, 40.0, -np.inf]


def test_wrapped_angles_point_the_same_way_within_half_a_turn() -> None:
    angle = np.linspace(-1000.0, 1000.0, 4001)
    wrapped = units.wrap_degrees(angle)
    assert ((wrapped >= -180.0) & (wrapped < 180.0)).all()
    np.testing.assert_allclose(np.cos(np.radians(wrapped)), np.cos(np.radians(angle)), atol=1e-12)
    np.testing.assert_allclose(np.sin(np.radians(wrapped)), np.sin(np.radians(angle)), atol=1e-12)
    assert units.wrap_degrees([180.0, -180.0, 0.0, 179.5]).tolist() == [-180.0, -180.0, 0.0, 179.5]
