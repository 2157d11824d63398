"""Fresnel coefficients of half-spaces and slabs, and the materials of a scene's faces."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...common.units import ComplexArray, FloatArray, wavelength_m
from ...site.materials import material
from ..geometry import Faces

# Real and imaginary part of the permittivity, and the thickness in wavelengths, which is infinite for a half-space.
FaceMaterial = Any


def half_space(cosine: FloatArray, eta: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return the TE and TM coefficients of a half-space, and the root ``sqrt(eta - sin^2 theta)``.

    Source: ITU-R P.2040-3 eq. 37.

    Parameters
    ----------
    cosine : (...)
        Cosine of the angle of incidence, from the normal.
    eta : (...) complex
        Relative permittivity; the imaginary part is negative.

    Returns
    -------
    te, tm, root : (...) complex
    """
    # root and eta have imaginary parts of the same sign, so the refracted wave decays
    root: ComplexArray = np.sqrt(eta - (1.0 - cosine * cosine))
    return (cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root), root


def echo(thickness: FloatArray, root: ComplexArray) -> ComplexArray:
    """Return the factor of a round trip through a slab, 0 for half-spaces. Thickness is in wavelengths."""
    finite = np.isfinite(thickness)
    # avoid infinity times the root, which would be NaN
    return np.where(finite, np.exp(-4j * np.pi * np.where(finite, thickness, 0.0) * root), 0.0)


def slab(r: ComplexArray, e: ComplexArray) -> ComplexArray:
    """Return the coefficient of a slab, ``r (1 - e) / (1 - r^2 e)``. Without an echo e, the coefficient is r.

    Source: ITU-R P.2040-3 eq. 43.

    Parameters
    ----------
    r : (...) complex
        Coefficient of a half-space of the material.
    e : (...) complex
        Echo of the second face: :func:`echo`.

    Returns
    -------
    (...) complex
    """
    return np.asarray(r * (1.0 - e) / (1.0 - r * r * e))


def coefficients(cosine: FloatArray, material: FaceMaterial) -> tuple[ComplexArray, ComplexArray]:
    """Return the TE and TM coefficients of faces, for the cosine of incidence and the columns of :func:`face_table`."""
    eta_re, eta_im, thickness = material
    te, tm, root = half_space(cosine, eta_re + 1j * eta_im)
    # bare ground has no second face, so its echo is 0 and is not computed
    if not np.any(np.isfinite(thickness)):
        return te, tm
    e = echo(thickness, root)
    return slab(te, e), slab(tm, e)


def reflection_coefficients(
    cos_theta: FloatArray, permittivity: ComplexArray, thickness_m: FloatArray, wavelength: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return the reflection coefficients (TE, TM) of a half-space or a slab in air.

    Source: ITU-R P.2040-3 eq. 37; ITU-R P.2040-3 eq. 43.

    Parameters
    ----------
    cos_theta : (...)
        Cosine of the angle of incidence, from the normal.
    permittivity : (...) complex
        Relative permittivity. The imaginary part is negative.
    thickness_m : (...)
        Thickness of the slab [m], infinite for a half-space.
    wavelength : float
        Wavelength in air [m].

    Returns
    -------
    te, tm : (...) complex
        Coefficients of the electric field perpendicular to the plane of incidence, and in it.

    Examples
    --------
    >>> te, tm = reflection_coefficients(np.array(1.0), np.array(4 + 0j), np.array(np.inf), 0.1)
    >>> complex(te.round(6)), complex(tm.round(6))
    ((-0.333333+0j), (0.333333+0j))
    """
    eta = np.asarray(permittivity)
    return coefficients(np.asarray(cos_theta), (eta.real, eta.imag, np.asarray(thickness_m) / wavelength))


def face_table(faces: Faces, carrier_hz: float) -> FloatArray:
    """Return the materials of all faces at a carrier, shape (faces + 1, 3).

    The columns are those of :data:`FaceMaterial`. The last row, which index -1 selects, is a placeholder for paths
    without a face.
    """
    rows: dict[str, tuple[float, float, float]] = {}
    for name in set(faces.material):
        known = material(name)
        eta, thickness = known.relative_permittivity(carrier_hz), known.thickness_m
        rows[name] = eta.real, eta.imag, np.inf if thickness is None else thickness / wavelength_m(carrier_hz)
    return np.array([*(rows[name] for name in faces.material), (2.0, 0.0, np.inf)])
