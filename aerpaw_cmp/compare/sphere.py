"""Smooth random functions on the sphere: real spherical harmonics with the spectrum of a Gaussian kernel.

A Gaussian process with kernel ``exp(-|d - d'|^2 / (2 l^2))`` of the chord between two directions is, on the sphere, a
sum of spherical harmonics whose coefficients are independent: no inducing points are needed, only a last degree.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from ..common.units import FloatArray

HIGHEST_DEGREE = 40
"""Terms grow with its square; a length of 0.1 needs it."""


def harmonics_on_sphere(direction: FloatArray, degree: int) -> FloatArray:
    """Real spherical harmonics of unit vectors.

    Parameters
    ----------
    direction : (n, 3)
        Unit vectors.
    degree : int
        Highest degree.

    Returns
    -------
    ndarray, (n, (degree + 1) ** 2)
        Ordered by degree, then order -degree..degree; orthonormal over the sphere.

    Notes
    -----
    Recursion of the normalised associated Legendre functions, Holmes and Featherstone, J. Geodesy 76 (2002),
    eq. (11) and (13), doi:10.1007/s00190-002-0216-2. The factor ``sin^m`` is carried by the powers of ``x + iy``, so
    that nothing is divided by zero at the poles.

    Examples
    --------
    >>> y = harmonics_on_sphere(np.array([[0.0, 0.0, 1.0]]), 1)
    >>> bool(np.allclose(y, [[(1 / (4 * np.pi)) ** 0.5, 0, (3 / (4 * np.pi)) ** 0.5, 0]]))
    True
    """
    x, y, z = np.asarray(direction, dtype=np.float64).T
    out = np.empty((len(z), (degree + 1) ** 2))
    swirl = np.ones(len(z), dtype=np.complex128)  # (x + iy)^m
    diagonal = 1.0 / math.sqrt(4.0 * math.pi)
    for m in range(degree + 1):
        if m:
            swirl = swirl * (x + 1j * y)
            diagonal *= math.sqrt((2 * m + 1) / (2 * m))
        before, now = np.zeros(len(z)), np.full(len(z), diagonal)
        for n in range(m, degree + 1):
            if n > m:
                a = math.sqrt((2 * n - 1) * (2 * n + 1) / ((n - m) * (n + m)))
                c = (2 * n + 1) * (n + m - 1) * (n - m - 1) / ((n - m) * (n + m) * (2 * n - 3)) if n > m + 1 else 0.0
                before, now = now, a * z * now - math.sqrt(c) * before
            centre = n * n + n
            if m == 0:
                out[:, centre] = now
            else:
                out[:, centre + m] = math.sqrt(2.0) * now * swirl.real
                out[:, centre - m] = math.sqrt(2.0) * now * swirl.imag
    return out


@lru_cache(maxsize=64)
def gaussian_spectrum(length: float, missing: float = 1e-3) -> tuple[float, ...]:
    """Share of each degree in a Gaussian kernel of the chord.

    Parameters
    ----------
    length : float
        Length of the kernel in chords (2 is the diameter; 0.35 is 20 degrees).
    missing : float
        The series ends where all further degrees together hold less than this share of the variance.

    Returns
    -------
    tuple of float
        ``a_n`` with ``exp((cos t - 1) / l^2) = sum a_n P_n(cos t)``; their sum is 1 but for the missing share.

    Notes
    -----
    ``a_n = (2 n + 1) exp(-z) i_n(z)`` with ``z = 1 / l^2``, the plane-wave expansion with modified spherical Bessel
    functions (NIST DLMF 10.60.8, https://dlmf.nist.gov/10.60.E8).
    """
    from scipy.special import ive

    z = 1.0 / length**2
    share: list[float] = []
    while len(share) <= HIGHEST_DEGREE and (not share or 1.0 - sum(share) > missing):
        n = len(share)
        share.append((2 * n + 1) * math.sqrt(math.pi / (2.0 * z)) * float(ive(n + 0.5, z)))
    return tuple(share)


def gaussian_features(direction: FloatArray, length: float) -> FloatArray:
    """Features (n, terms) whose scalar products are the Gaussian kernel of unit variance."""
    share = gaussian_spectrum(length)
    values = harmonics_on_sphere(direction, len(share) - 1)
    scale = [math.sqrt(4.0 * math.pi * a / (2 * n + 1)) for n, a in enumerate(share) for _ in range(2 * n + 1)]
    return np.asarray(values * np.asarray(scale), dtype=np.float64)


def even_directions(count: int) -> FloatArray:
    """Unit vectors (count, 3) that share the sphere evenly (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    azimuth = np.pi * (1.0 + math.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z * z)
    return np.asarray(np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1), dtype=np.float64)
