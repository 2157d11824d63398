"""Formulas for one element pair over one path: directions, element field, dyad of a reflection, and reception.

A path over mirrors ``M_1 .. M_d`` is straight in the space of the last image. ``k`` is the unit vector from the
image of the tower element to the UAV element, and ``n`` the normal of a face in that space. A reflection changes the
field vector ``w`` into::

    -r_tm w + (r_te + r_tm) s (s . w) / |s|^2,    s = k x n,    cos theta = |k . n|

This is ``r_te e_s + r_tm e_p'`` of textbooks in mirrored coordinates. At normal incidence ``s`` is not defined, but
there ``r_te + r_tm`` is zero. Every formula accepts arrays or numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

# A real or complex number, or an array of any shape.
Number = Any
Vector = tuple[Number, Number, Number]
# Axes of a device, as rows.
Rotation = tuple[Vector, Vector, Vector]


def turned(m: Rotation, v: Vector) -> Vector:
    """Return a site vector in device axes."""
    x, y, z = (row[0] * v[0] + row[1] * v[1] + row[2] * v[2] for row in m)
    return x, y, z


def turned_back(m: Rotation, v: Vector) -> Vector:
    """Return a device vector in site axes."""
    return turned(((m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2])), v)


def direction(image_m: Vector, frame: Rotation, tower_m: Vector, place_m: Vector, axes: Rotation, uav_m: Vector) -> Any:
    """Return the unit vector from the image of a tower element to a UAV element, and their distance [m].

    Parameters
    ----------
    image_m, place_m : Vector
        Image of the tower's array, and centre of the UAV's array [m].
    frame, axes : Rotation
        Device axes of the tower in the last space, and of the UAV.
    tower_m, uav_m : Vector
        Positions of the elements in their device frames [m].

    Returns
    -------
    x, y, z, length
        All are 0 if the two positions coincide.
    """
    ends = zip(place_m, turned_back(axes, uav_m), image_m, turned_back(frame, tower_m), strict=True)
    x, y, z = (place + uav - (image + tower) for place, uav, image, tower in ends)
    length = np.sqrt(x * x + y * y + z * z)
    # limit the divisor, because np.where evaluates both branches
    scale = np.where(length > 0.0, 1.0 / np.maximum(length, 1e-300), 0.0)
    return x * scale, y * scale, z * scale, length


def slant_rotation(e_theta: Number, e_phi: Number, cosine: Number, sine: Number) -> tuple[Number, Number]:
    """Return the field of an element slanted from vertical: its polarisation is rotated in the (theta, phi) basis.

    Source: 3GPP TR 38.901 section 7.3.2.

    Parameters
    ----------
    e_theta, e_phi : Number
        Field components of the pattern.
    cosine, sine : Number
        Cosine and sine of the slant: 0 is vertical, pi/2 horizontal.

    Returns
    -------
    e_theta, e_phi : Number
    """
    return e_theta * cosine - e_phi * sine, e_theta * sine + e_phi * cosine


def field_vector(m: Rotation, toward: Vector, e_theta: Number, e_phi: Number) -> Vector:
    """Return the field ``e_theta theta + e_phi phi`` of a device with axes ``m`` as a vector in site axes.

    Sines and cosines of theta and phi are ratios of the direction's components; at a pole, phi is 0.

    Parameters
    ----------
    m : Rotation
        Device axes as rows, in the space of ``toward``.
    toward : Vector
        Unit vector away from the device.
    e_theta, e_phi : Number

    Returns
    -------
    Vector
    """
    x, y, z = turned(m, toward)
    across = np.sqrt(x * x + y * y)
    # at a pole phi is undefined: use 0, like atan2(0, 0)
    off_pole = across > 0.0
    scale = np.where(off_pole, 1.0 / np.maximum(across, 1e-300), 0.0)
    cosine, sine = np.where(off_pole, x * scale, 1.0), y * scale
    a = e_theta * (z * cosine) - e_phi * sine
    b = e_theta * (z * sine) + e_phi * cosine
    return turned_back(m, (a, b, -e_theta * across))


def incidence(toward: Vector, normal: Vector) -> Number:
    """Return the cosine of the angle of incidence."""
    return np.abs(normal[0] * toward[0] + normal[1] * toward[1] + normal[2] * toward[2])


def reflected(wave: Vector, toward: Vector, normal: Vector, te: Number, tm: Number) -> Vector:
    """Return the field vector of a wave after the dyad of one reflection.

    Parameters
    ----------
    wave : Vector
        Field vector before the reflection.
    toward, normal : Vector
        Unit vectors of the ray and of the face, in the last space.
    te, tm : Number
        Coefficients of the face at this angle.

    Returns
    -------
    Vector
    """
    (x, y, z), (n0, n1, n2) = toward, normal
    s0, s1, s2 = y * n2 - z * n1, z * n0 - x * n2, x * n1 - y * n0
    # at normal incidence s is zero, and so is te + tm, which multiplies it
    scale = 1.0 / np.maximum(s0 * s0 + s1 * s1 + s2 * s2, 1e-300)
    q = (te + tm) * (scale * (s0 * wave[0] + s1 * wave[1] + s2 * wave[2]))
    return q * s0 - tm * wave[0], q * s1 - tm * wave[1], q * s2 - tm * wave[2]


def spreading(cycles: Number) -> Number:
    """Return ``lambda / (4 pi L)`` for a length in wavelengths, at most 1, because spreading is not a gain."""
    # two elements may coincide: the length is then zero, and infinity becomes 1
    return np.minimum(1.0, 1.0 / (4.0 * np.pi * cycles))


def received(wave: Vector, uav: Vector, cycles: Number) -> Number:
    """Return the complex amplitude of a pair: the UAV's pattern, spreading and carrier phase.

    The pattern of the receiving element is not conjugated, because of reciprocity.

    Parameters
    ----------
    wave : Vector
        Field vector of the incoming wave.
    uav : Vector
        Field vector that the UAV's element would radiate back.
    cycles : Number
        Length of the path in wavelengths.

    Returns
    -------
    Number
    """
    # remove full cycles before the exponential: at 1 km they would cost five digits of the phase
    carrier = np.exp(-2j * np.pi * (cycles - np.round(cycles)))
    return spreading(cycles) * carrier * (uav[0] * wave[0] + uav[1] * wave[1] + uav[2] * wave[2])
