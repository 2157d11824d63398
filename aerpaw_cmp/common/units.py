"""Constants and conversions used by several subpackages.

Logarithmic and angular units are part of every name: ``_db`` is a ratio, ``_dbm`` a power.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

# SciPy imports every name in NumPy's __all__. Remove f2py, whose import takes 0.08 s.
if "f2py" in np.__all__:
    np.__all__.remove("f2py")

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
AnyArray = NDArray[Any]

# Speed of light in vacuum (SI, exact).
SPEED_OF_LIGHT_MPS = 299_792_458.0

# CODATA 2018.
VACUUM_PERMITTIVITY_F_PER_M = 8.854_187_8128e-12

# Poses below this height above ground are raised to this height (arXiv 2502.10324, section V).
MINIMUM_HEIGHT_M = 0.5

# International foot [m] (exact).
FOOT_M = 0.3048

# Range of carriers [Hz] that a setting accepts. A smaller number is probably in MHz or GHz, and a larger number was
# probably converted twice.
LOWEST_CARRIER_HZ, HIGHEST_CARRIER_HZ = 1e6, 1e12

# Thermal noise at 290 K [dBm in 1 Hz]: -173.98 (Boltzmann's constant: SI, exact).
THERMAL_NOISE_DBM_HZ = 10.0 * float(np.log10(1.380_649e-23 * 290.0)) + 30.0


class Printed(float):
    """A number in a sentence. Its minus is printed as a minus sign, and a number that rounds to zero has no sign.

    Examples
    --------
    >>> f"{Printed(-10.4):+.1f}", f"{Printed(-0.04):+.1f} dB"
    ('−10.4', '0.0 dB')
    """

    def __format__(self, form: str) -> str:
        text = super().__format__(form)
        if set(text) <= set("+-0.,e"):
            return text.lstrip("+-")
        return text.replace("-", "\N{MINUS SIGN}")


def unmasked(values: ArrayLike, dtype: Any = np.float64) -> AnyArray:
    """Return an array of numbers with NaN instead of masked values, such as gaps of NetCDF and GeoTIFF.

    Each function that receives arrays from callers calls this function first, because ``np.asarray`` would return the
    values under the mask.

    Examples
    --------
    >>> unmasked(np.ma.masked_values([1.0, -9999.0], -9999.0)), unmasked([2, 3])
    (array([ 1., nan]), array([2., 3.]))
    """
    masks = isinstance(values, np.ma.MaskedArray) or (
        isinstance(values, (list, tuple)) and any(isinstance(item, np.ma.MaskedArray) for item in values)
    )
    return np.ma.array(values, dtype=dtype).filled(np.nan) if masks else np.asarray(values, dtype=dtype)


def noise_floor_dbm(bandwidth_hz: float, noise_figure_db: float = 0.0) -> float:
    """Return the noise power of a receiver [dBm]: k T B F at 290 K (ITU-R P.372, eq. 1 to 4).

    Examples
    --------
    >>> round(noise_floor_dbm(1e6, 5.0), 2)
    -108.98
    """
    return THERMAL_NOISE_DBM_HZ + 10.0 * float(np.log10(bandwidth_hz)) + noise_figure_db


def wavelength_m(frequency_hz: float) -> float:
    """Return the free-space wavelength [m] of a frequency [Hz]."""
    return SPEED_OF_LIGHT_MPS / frequency_hz


def db_from_power(power: ArrayLike) -> FloatArray:
    """Return 10 log10 of a power ratio. Zero returns -inf without a warning."""
    with np.errstate(divide="ignore"):
        return np.asarray(10.0 * np.log10(unmasked(power)))


def power_from_db(level_db: ArrayLike) -> FloatArray:
    """Return the power ratio of a level in dB."""
    return np.asarray(10.0 ** (unmasked(level_db) / 10.0))


def db_from_amplitude(amplitude: ArrayLike) -> FloatArray:
    """Return 20 log10 of a ratio of magnitudes (voltages, fields, singular values). For zero, return -inf.

    Examples
    --------
    >>> db_from_amplitude([10.0, 0.0]).tolist()
    [20.0, -inf]
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(20.0 * np.log10(unmasked(amplitude)))


def amplitude_from_db(level_db: ArrayLike) -> FloatArray:
    """Return the ratio of magnitudes of a level in dB."""
    return np.asarray(10.0 ** (unmasked(level_db) / 20.0))


def wrap_degrees(angle_deg: ArrayLike) -> FloatArray:
    """Return angles wrapped to [-180, 180) degrees."""
    return np.asarray((unmasked(angle_deg) + 180.0) % 360.0 - 180.0)


def finite_mean(values: ArrayLike) -> float:
    """Return the mean of the finite values. NaN if there are none.

    Examples
    --------
    >>> finite_mean([1.0, 3.0, np.nan]), finite_mean([])
    (2.0, nan)
    """
    array = unmasked(values)
    finite = array[np.isfinite(array)]
    return float(finite.mean()) if finite.size else float("nan")


def spread_out(count: int, most: int) -> IntArray:
    """Return indices of at most ``most`` of ``count`` items, evenly spaced, including the first and the last.

    Examples
    --------
    >>> spread_out(9, 3).tolist(), spread_out(2, 5).tolist(), spread_out(0, 3).tolist()
    ([0, 4, 8], [0, 1], [])
    """
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64) if count else np.zeros(0, np.int64)


def carrier_fault(carrier_hz: float) -> str:
    """Return a sentence about an implausible carrier frequency. Empty if the frequency is plausible.

    Examples
    --------
    >>> carrier_fault(3.3)
    '3.3 Hz is not the frequency of a radio link; expected hertz, 1e+06 to 1e+12, such as 3.3e9 for 3.3 GHz'
    >>> carrier_fault(3.3e9)
    ''
    """
    if LOWEST_CARRIER_HZ <= carrier_hz <= HIGHEST_CARRIER_HZ:
        return ""
    return (
        f"{carrier_hz:g} Hz is not the frequency of a radio link; expected hertz, {LOWEST_CARRIER_HZ:g} to "
        f"{HIGHEST_CARRIER_HZ:g}, such as 3.3e9 for 3.3 GHz"
    )
