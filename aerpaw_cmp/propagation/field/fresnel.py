"""Fresnel coefficients of half-spaces and slabs, and the materials of a scene's faces.

Each formula is written once, for arrays and for numbers. Complex numbers are pairs (re, im): their parts are
evaluated in place, without arrays of complex intermediate results.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.units import ComplexArray, FloatArray
from ...site.materials import material
from ..geometry import Faces
from .dyads import sine_cosine


def half_space(cosine: Any, eta_re: Any, eta_im: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
    """TE and TM coefficients of a half-space and the root ``sqrt(eta - sin^2 theta)``: three complex numbers.

    Source: ITU-R P.2040-3 eq. 37.

    Parameters
    ----------
    cosine : float or (...)
        Cosine of the angle of incidence, from the normal.
    eta_re, eta_im : float or (...)
        Relative permittivity; the imaginary part is negative.

    Returns
    -------
    te_re, te_im, tm_re, tm_im, root_re, root_im
    """
    # the root without cancellation; its imaginary part has the sign of eta's, so that the refracted wave decays
    # eta less the squared sine of incidence
    a = eta_re - (1.0 - cosine * cosine)
    t = np.sqrt(0.5 * (np.sqrt(a * a + eta_im * eta_im) + np.abs(a)))
    q = eta_im / np.maximum(2.0 * t, 1e-300)
    root_re = np.where(a >= 0.0, t, np.abs(q))
    root_im = np.where(a >= 0.0, q, np.copysign(t, eta_im))
    below, above = cosine + root_re, cosine - root_re
    scale = 1.0 / (below * below + root_im * root_im)
    te_re = (above * below - root_im * root_im) * scale
    te_im = -(root_im * below + above * root_im) * scale
    n_re, n_im = eta_re * cosine - root_re, eta_im * cosine - root_im
    d_re, d_im = eta_re * cosine + root_re, eta_im * cosine + root_im
    scale = 1.0 / (d_re * d_re + d_im * d_im)
    tm_re = (n_re * d_re + n_im * d_im) * scale
    tm_im = (n_im * d_re - n_re * d_im) * scale
    return te_re, te_im, tm_re, tm_im, root_re, root_im


def echo(thickness: Any, root_re: Any, root_im: Any) -> tuple[Any, Any]:
    """Factor of a wave's way through a slab and back: ``exp(-4 pi j thickness root)``, thickness in wavelengths."""
    size = np.exp(4.0 * np.pi * thickness * root_im)
    sine, cosine = sine_cosine(-2.0 * thickness * root_re)
    return size * cosine, size * sine


def slab(r_re: Any, r_im: Any, echo_re: Any, echo_im: Any) -> tuple[Any, Any]:
    """Return the coefficient of a slab, ``r (1 - e) / (1 - r^2 e)``. Without an echo e it is r.

    Source: ITU-R P.2040-3 eq. 43.

    Parameters
    ----------
    r_re, r_im : float or (...)
        Coefficient r of a half-space of the material.
    echo_re, echo_im : float or (...)
        e: :func:`echo`.

    Returns
    -------
    re, im : float or (...)
    """
    s_re, s_im = r_re * r_re - r_im * r_im, 2.0 * r_re * r_im
    d_re, d_im = 1.0 - (s_re * echo_re - s_im * echo_im), -(s_re * echo_im + s_im * echo_re)
    n_re = r_re * (1.0 - echo_re) + r_im * echo_im
    n_im = r_im * (1.0 - echo_re) - r_re * echo_im
    scale = 1.0 / (d_re * d_re + d_im * d_im)
    return (n_re * d_re + n_im * d_im) * scale, (n_im * d_re - n_re * d_im) * scale


def returned(thickness: Any, root_re: Any, root_im: Any) -> tuple[Any, Any]:
    """The echo of a slab, 0 of a half-space, whose thickness is infinite."""
    # infinity times the root would be NaN before it is thrown away
    finite = np.isfinite(thickness)
    e_re, e_im = echo(np.where(finite, thickness, 0.0), root_re, root_im)
    return np.where(finite, e_re, 0.0), np.where(finite, e_im, 0.0)


def reflection(cosine: Any, material: Any) -> tuple[Any, Any, Any, Any]:
    """Return TE and TM coefficients (re and im of each) of slabs. Infinite thickness means a half-space.

    ``material`` is a tuple: real and imaginary part of the permittivity, and the thickness in wavelengths.
    """
    eta_re, eta_im, thickness = material
    te_re, te_im, tm_re, tm_im, root_re, root_im = half_space(cosine, eta_re, eta_im)
    e_re, e_im = returned(thickness, root_re, root_im)
    te_re, te_im = slab(te_re, te_im, e_re, e_im)
    tm_re, tm_im = slab(tm_re, tm_im, e_re, e_im)
    return te_re, te_im, tm_re, tm_im


def coefficients(cosine: Any, material: Any) -> tuple[Any, Any, Any, Any]:
    """TE and TM coefficients (re, im each) of faces: the Fresnel coefficients that NumPy's field takes."""
    eta_re, eta_im, thickness = material
    # bare ground has no second face, so its echo is 0 and is not computed
    if np.any(np.isfinite(thickness)):
        return reflection(cosine, material)
    return half_space(cosine, eta_re, eta_im)[:4]


def reflection_coefficients(
    cos_theta: FloatArray, permittivity: ComplexArray, thickness_m: FloatArray, wavelength: float
) -> tuple[ComplexArray, ComplexArray]:
    """Reflection coefficients (TE, TM) of a half-space or a slab in air, as complex numbers.

    Source: ITU-R P.2040-3 eq. 37; ITU-R P.2040-3 eq. 43.

    Parameters
    ----------
    cos_theta : (...)
        Cosine of the angle of incidence, from the normal.
    permittivity : (...) complex
        Relative, negative imaginary part.
    thickness_m : (...)
        Infinite for a half-space.
    wavelength : float
        Wavelength in air [m].

    Returns
    -------
    te, tm : (...) complex
        Coefficients of the electric field across and in the plane of incidence.

    Examples
    --------
    >>> te, tm = reflection_coefficients(np.array(1.0), np.array(4 + 0j), np.array(np.inf), 0.1)
    >>> complex(te.round(6)), complex(tm.round(6))
    ((-0.333333+0j), (0.333333+0j))
    """
    eta, thickness = np.asarray(permittivity), np.asarray(thickness_m) / wavelength
    te_re, te_im, tm_re, tm_im = coefficients(np.asarray(cos_theta), (eta.real, eta.imag, thickness))
    return np.asarray(te_re + 1j * te_im), np.asarray(tm_re + 1j * tm_im)


@dataclass(frozen=True, slots=True)
class FaceMaterials:
    """The permittivity and thickness per face. The last entry (-1) is a placeholder for paths without a face."""

    permittivity: ComplexArray
    thickness_m: FloatArray

    @classmethod
    def of(cls, faces: Faces, carrier_hz: float) -> FaceMaterials:
        """Return the materials of all faces at a carrier."""
        known = {name: material(name) for name in set(faces.material)}
        eta = {name: face.relative_permittivity(carrier_hz) for name, face in known.items()}
        thick = {name: np.inf if face.thickness_m is None else face.thickness_m for name, face in known.items()}
        return cls(
            # the last entry answers for -1, the padding of short paths
            np.array([*(eta[name] for name in faces.material), 2.0 + 0j], dtype=np.complex128),
            np.array([*(thick[name] for name in faces.material), np.inf], dtype=np.float64),
        )

    def table(self, wavelength_m: float) -> FloatArray:
        """Return columns (faces + 1, 3): real and imaginary part of the permittivity, thickness in wavelengths."""
        eta = self.permittivity
        return np.column_stack([eta.real, eta.imag, self.thickness_m / wavelength_m])
