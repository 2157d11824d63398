"""The float64 field of paths as compiled code; imported only where numba is there.

What is evaluated is that of :mod:`aerpaw_cmp.propagation.channel`, pair by pair, but in the space of the last image: a
path over mirrors ``M_1 .. M_d`` is straight there. With ``k`` the unit vector from the image of the tower element to
the UAV element, ``B_i = M_d .. M_i`` and ``n_i`` the normals, reflection ``i`` turns the field vector ``w`` into::

    -r_tm w + (r_te + r_tm) s (s . w) / |s|^2,    s = k x (B_i n_i),    cos theta = |k . B_i n_i|

and the tower's frame becomes ``M_1 .. M_d`` seen from its device axes, so that normals and frames are constants of a
path and only ``k`` is one of a pair. Each path is evaluated alone and added in the order of the path set: results do
not depend on chunks and threads, to the last bit.
"""

from __future__ import annotations

import inspect
import math

import numpy as np

from ..common.units import FloatArray, IntArray
from ..site.antennas import HALF_WAVE_DIPOLE_GAIN
from .numba_options import kernel

LANES = 64
"""Element pairs of a path evaluated at once; a power of two, so that rows of the workspace cannot overlap."""

ISOTROPIC, DIPOLE, TR38901, GAIN_GRID, FIELD_GRID, GIVEN = range(6)
"""Patterns that the kernel knows; ``GIVEN`` ones were evaluated before."""

_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding and taking it off rounds to an integer, ties to even
_TWO_PI = 2.0 * math.pi
_DIPOLE = math.sqrt(HALF_WAVE_DIPOLE_GAIN)


@kernel
def turn_sine_cosine(turns: float) -> tuple[float, float]:
    """Sine and cosine of an angle in turns, -1/2 to 1/2, within 1 ulp (minimax polynomials of fdlibm)."""
    quarter = (4.0 * turns + _ROUND) - _ROUND
    x = (turns - 0.25 * quarter) * _TWO_PI
    z = x * x
    sine = x + x * z * (
        -1.66666666666666324348e-01
        + z
        * (
            8.33333333332248946124e-03
            + z
            * (
                -1.98412698298579493134e-04
                + z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10))
            )
        )
    )
    cosine = 1.0 - (
        0.5 * z
        - z
        * z
        * (
            4.16666666666666019037e-02
            + z
            * (
                -1.38888888888741095749e-03
                + z
                * (
                    2.48015872894767294178e-05
                    + z
                    * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11))
                )
            )
        )
    )
    odd = quarter * quarter == 1.0
    sine_there = cosine if odd else sine
    cosine_there = sine if odd else cosine
    return (
        -sine_there if quarter < 0.0 or quarter > 1.5 else sine_there,
        -cosine_there if quarter > 0.5 or quarter < -1.5 else cosine_there,
    )


@kernel
def fresnel(cosine: float, eta_re: float, eta_im: float) -> tuple[float, float, float, float, float, float]:
    """TE and TM coefficients of a half-space and the root ``sqrt(eta - sin^2 theta)``: three complex numbers.

    Source: ITU-R P.2040-3 eq. 37.
    """
    a = eta_re - (1.0 - cosine * cosine)
    size = math.sqrt(a * a + eta_im * eta_im)
    t = math.sqrt(0.5 * (size + abs(a)))
    q = eta_im / (2.0 * t) if t > 0.0 else 0.0
    root_re = t if a >= 0.0 else abs(q)
    root_im = q if a >= 0.0 else math.copysign(t, eta_im)
    below = cosine + root_re
    scale = 1.0 / (below * below + root_im * root_im)
    above = cosine - root_re
    te_re = (above * below - root_im * root_im) * scale
    te_im = -(root_im * below + above * root_im) * scale
    n_re, n_im = eta_re * cosine - root_re, eta_im * cosine - root_im
    d_re, d_im = eta_re * cosine + root_re, eta_im * cosine + root_im
    scale = 1.0 / (d_re * d_re + d_im * d_im)
    tm_re = (n_re * d_re + n_im * d_im) * scale
    tm_im = (n_im * d_re - n_re * d_im) * scale
    return te_re, te_im, tm_re, tm_im, root_re, root_im


@kernel
def slab(r_re: float, r_im: float, echo_re: float, echo_im: float) -> tuple[float, float]:
    """Coefficient of a slab from that of its first face: ``r (1 - e) / (1 - r^2 e)``.

    Source: ITU-R P.2040-3 eq. 43.

    Parameters
    ----------
    r_re, r_im : float
        Coefficient r of a half-space of the material.
    echo_re, echo_im : float
        e: what a wave takes on through the slab and back.

    Returns
    -------
    re, im : float
    """
    s_re, s_im = r_re * r_re - r_im * r_im, 2.0 * r_re * r_im
    d_re, d_im = 1.0 - (s_re * echo_re - s_im * echo_im), -(s_re * echo_im + s_im * echo_re)
    n_re = r_re * (1.0 - echo_re) + r_im * echo_im
    n_im = r_im * (1.0 - echo_re) - r_re * echo_im
    scale = 1.0 / (d_re * d_re + d_im * d_im)
    return (n_re * d_re + n_im * d_im) * scale, (n_im * d_re - n_re * d_im) * scale


@kernel
def element_amplitude(kind: int, x: float, y: float, z: float) -> float:
    """E_theta of the patterns that are real formulas; ``x, y, z`` is the unit direction in the device frame.

    Parameters
    ----------
    kind : int
        :data:`DIPOLE` or :data:`TR38901`.
    x, y, z : float
        Unit vector.

    Returns
    -------
    float
        Field against that of an isotropic element of the same power.

    Notes
    -----
    Half-wave dipole: ``sqrt(D) cos(pi/2 cos theta) / sin theta``. TR 38.901 table 7.3-1: 8 dBi, beams of 65 degrees,
    30 dB of side and back attenuation.
    """
    across = math.sqrt(x * x + y * y)
    if kind == DIPOLE:
        return _DIPOLE * math.cos(0.5 * math.pi * z) / across if across >= 1e-9 else 0.0
    theta = math.atan2(across, z) * (180.0 / math.pi)
    phi = math.atan2(y, x) * (180.0 / math.pi)
    down = min(12.0 * ((theta - 90.0) / 65.0) ** 2, 30.0) + min(12.0 * (phi / 65.0) ** 2, 30.0)
    return float(10.0 ** ((8.0 - min(down, 30.0)) / 20.0))


@kernel
def grid_value(layer: FloatArray, row: float, column: float) -> float:
    """Cubic B-spline with coefficients ``layer``, periodic in both directions, at a place in samples."""
    rows, columns = layer.shape
    first, second = math.floor(row), math.floor(column)
    t, u = row - first, column - second
    a0, a1 = (1.0 - t) ** 3 / 6.0, (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
    a3 = t * t * t / 6.0
    a2 = 1.0 - a0 - a1 - a3
    b0, b1 = (1.0 - u) ** 3 / 6.0, (4.0 - 6.0 * u * u + 3.0 * u * u * u) / 6.0
    b3 = u * u * u / 6.0
    b2 = 1.0 - b0 - b1 - b3
    i, j = int(first), int(second)
    total = 0.0
    for step in range(4):
        k = (i - 1 + step) % rows
        weight = a0 if step == 0 else (a1 if step == 1 else (a2 if step == 2 else a3))
        total += weight * (
            b0 * layer[k, (j - 1) % columns]
            + b1 * layer[k, j % columns]
            + b2 * layer[k, (j + 1) % columns]
            + b3 * layer[k, (j + 2) % columns]
        )
    return total


@kernel
def unfold(
    normal: FloatArray,
    offset_m: FloatArray,
    sequence: IntArray,
    depth: int,
    source_m: FloatArray,
    mount: FloatArray,
    image_m: FloatArray,
    frame: FloatArray,
    normals: FloatArray,
) -> None:
    """Constants of a path: image of the tower, its frame in the last space (device axes as rows), normals there.

    Parameters
    ----------
    normal, offset_m : (faces, 3), (faces,)
        Planes of the faces.
    sequence : (most,) int
        Faces of the path, the first at the tower.
    depth : int
        How many of them there are.
    source_m, mount : (3,), (3, 3)
        Centre of the tower's array [m] and its rotation.
    image_m, frame : (3,), (3, 3)
        Get image and frame.
    normals : (most, 3)
        Gets the normal of each face in the last space.
    """
    for i in range(3):
        image_m[i] = source_m[i]
        for j in range(3):
            frame[i, j] = mount[j, i]
    for step in range(depth):
        face = sequence[step]
        n0, n1, n2 = normal[face, 0], normal[face, 1], normal[face, 2]
        height = 2.0 * (n0 * image_m[0] + n1 * image_m[1] + n2 * image_m[2] - offset_m[face])
        image_m[0] -= height * n0
        image_m[1] -= height * n1
        image_m[2] -= height * n2
        for row in range(3):
            height = 2.0 * (n0 * frame[row, 0] + n1 * frame[row, 1] + n2 * frame[row, 2])
            frame[row, 0] -= height * n0
            frame[row, 1] -= height * n1
            frame[row, 2] -= height * n2
        for row in range(step):
            height = 2.0 * (n0 * normals[row, 0] + n1 * normals[row, 1] + n2 * normals[row, 2])
            normals[row, 0] -= height * n0
            normals[row, 1] -= height * n1
            normals[row, 2] -= height * n2
        normals[step, 0], normals[step, 1], normals[step, 2] = n0, n1, n2


# rows of the workspace
_X, _Y, _Z, _LENGTH = 0, 1, 2, 3
_TOWER, _UAV = 4, 7
"""Directions in the device frames."""
_E_TOWER, _E_UAV = 10, 14
"""E_theta and E_phi of the elements, real and imaginary parts."""
_WAVE, _HEAR = 18, 24
"""Field vector of the wave and of the UAV element, real parts before imaginary ones."""
_TE, _TM, _ROOT, _SIZE = 30, 32, 34, 36
ROWS = 37


@kernel
def directions(
    pairs: int,
    first: int,
    image_m: FloatArray,
    frame: FloatArray,
    tower_m: FloatArray,
    uav_m: FloatArray,
    turn: FloatArray,
    w: FloatArray,
) -> None:
    """Unit vectors and lengths of the pairs of a path, and their directions in both device frames.

    Parameters
    ----------
    pairs, first : int
        How many pairs, and the first of them in the columns of elements.
    image_m, frame : (3,), (3, 3)
        As :func:`unfold` gives them.
    tower_m : (3, pairs of the link)
        Element positions in the tower's device frame [m].
    uav_m : (3, pairs of the link)
        Element positions of the UAV in the site frame [m].
    turn : (3, 3)
        Device axes of the UAV as rows.
    w : (ROWS * LANES,)
        Workspace: gets unit vector, length [m] and directions.
    """
    i0, i1, i2 = image_m[0], image_m[1], image_m[2]
    f00, f01, f02 = frame[0, 0], frame[0, 1], frame[0, 2]
    f10, f11, f12 = frame[1, 0], frame[1, 1], frame[1, 2]
    f20, f21, f22 = frame[2, 0], frame[2, 1], frame[2, 2]
    for p in range(pairs):
        a, b, c = tower_m[0, first + p], tower_m[1, first + p], tower_m[2, first + p]
        w[_X * LANES + p] = uav_m[0, first + p] - (i0 + f00 * a + f10 * b + f20 * c)
        w[_Y * LANES + p] = uav_m[1, first + p] - (i1 + f01 * a + f11 * b + f21 * c)
        w[_Z * LANES + p] = uav_m[2, first + p] - (i2 + f02 * a + f12 * b + f22 * c)
    t00, t01, t02 = turn[0, 0], turn[0, 1], turn[0, 2]
    t10, t11, t12 = turn[1, 0], turn[1, 1], turn[1, 2]
    t20, t21, t22 = turn[2, 0], turn[2, 1], turn[2, 2]
    for p in range(pairs):
        x, y, z = w[_X * LANES + p], w[_Y * LANES + p], w[_Z * LANES + p]
        length = math.sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 0.0 else 0.0
        x, y, z = x * scale, y * scale, z * scale
        w[_X * LANES + p], w[_Y * LANES + p], w[_Z * LANES + p] = x, y, z
        w[_LENGTH * LANES + p] = length
        w[_TOWER * LANES + p] = f00 * x + f01 * y + f02 * z
        w[(_TOWER + 1) * LANES + p] = f10 * x + f11 * y + f12 * z
        w[(_TOWER + 2) * LANES + p] = f20 * x + f21 * y + f22 * z
        w[_UAV * LANES + p] = -(t00 * x + t01 * y + t02 * z)
        w[(_UAV + 1) * LANES + p] = -(t10 * x + t11 * y + t12 * z)
        w[(_UAV + 2) * LANES + p] = -(t20 * x + t21 * y + t22 * z)


@kernel
def patterns(
    pairs: int,
    first: int,
    at: int,
    out: int,
    kinds: IntArray,
    starts: IntArray,
    grids: FloatArray,
    given: FloatArray,
    given_row: int,
    w: FloatArray,
) -> None:
    """E_theta and E_phi of the elements of one end, in the directions at rows ``at``; to rows ``out``.

    Parameters
    ----------
    pairs, first : int
        How many pairs, and the first of them in the columns of elements.
    at, out : int
        Rows of the workspace: of the directions in the device frame, and of the fields.
    kinds : (pairs of the link,) int
        Pattern of each element.
    starts : (pairs of the link, 3) int
        Start, rows and columns of its grid in ``grids``.
    grids : (coefficients,)
        Splines of all patterns that are grids, one after another.
    given : (rows, pairs of the link)
        Fields of :data:`GIVEN` patterns.
    given_row : int
        First row of this end there.
    w : (ROWS * LANES,)
        Workspace.
    """
    full = 2.0 * math.pi
    for p in range(pairs):
        w[out * LANES + p] = 1.0
        w[(out + 1) * LANES + p] = 0.0
        w[(out + 2) * LANES + p] = 0.0
        w[(out + 3) * LANES + p] = 0.0
    for p in range(pairs):
        kind = kinds[first + p]
        if kind == ISOTROPIC:
            continue
        x, y, z = w[at * LANES + p], w[(at + 1) * LANES + p], w[(at + 2) * LANES + p]
        if kind == GIVEN:
            for row in range(4):
                w[(out + row) * LANES + p] = given[given_row + row, first + p]
        elif kind in (DIPOLE, TR38901):
            w[out * LANES + p] = element_amplitude(kind, x, y, z)
        else:
            start, rows, columns = starts[first + p, 0], starts[first + p, 1], starts[first + p, 2]
            size = rows * columns
            row = (math.atan2(math.sqrt(x * x + y * y), z) % full) * (rows / full)
            column = (math.atan2(y, x) % full) * (columns / full)
            for part in range(1 if kind == GAIN_GRID else 4):
                layer = grids[start + part * size : start + (part + 1) * size].reshape(rows, columns)
                w[(out + part) * LANES + p] = grid_value(layer, row, column)
            if kind == GAIN_GRID:
                w[out * LANES + p] = max(w[out * LANES + p], 0.0)


@kernel
def radiate(
    pairs: int, first: int, at: int, field: int, out: int, real: bool, slants: FloatArray, m: FloatArray, w: FloatArray
) -> None:
    """Field vectors of one end in the last space; ``m`` has the device axes as rows.

    Source: 3GPP TR 38.901 section 7.3.2.

    Parameters
    ----------
    pairs, first : int
        How many pairs, and the first of them in the columns of elements.
    at, field, out : int
        Rows of the workspace: directions in the device frame, E_theta and E_phi, and the field vectors.
    real : bool
        No field has an imaginary part.
    slants : (2, pairs of the link)
        Cosine and sine of the polarisation of each element.
    m : (3, 3)
        Device axes.
    w : (ROWS * LANES,)
        Workspace.
    """
    m00, m01, m02 = m[0, 0], m[0, 1], m[0, 2]
    m10, m11, m12 = m[1, 0], m[1, 1], m[1, 2]
    m20, m21, m22 = m[2, 0], m[2, 1], m[2, 2]
    for part in range(2):
        i, j = (field + part) * LANES, (field + 2 + part) * LANES
        k = (out + 3 * part) * LANES
        if part and real:
            for p in range(3 * LANES):
                w[k + p] = 0.0
            continue
        for p in range(pairs):
            x, y, z = w[at * LANES + p], w[(at + 1) * LANES + p], w[(at + 2) * LANES + p]
            across = math.sqrt(x * x + y * y)
            scale = 1.0 / across if across > 0.0 else 0.0
            cosine = x * scale if across > 0.0 else 1.0
            sine = y * scale
            c, s = slants[0, first + p], slants[1, first + p]
            theta, phi = w[i + p], w[j + p]
            e_theta, e_phi = theta * c - phi * s, theta * s + phi * c
            a = e_theta * (z * cosine) - e_phi * sine
            b = e_theta * (z * sine) + e_phi * cosine
            d = -e_theta * across
            w[_SIZE * LANES + p] = m00 * a + m10 * b + m20 * d
            w[_ROOT * LANES + p] = m01 * a + m11 * b + m21 * d
            w[(_ROOT + 1) * LANES + p] = m02 * a + m12 * b + m22 * d
        for p in range(pairs):
            w[k + p] = w[_SIZE * LANES + p]
            w[k + LANES + p] = w[_ROOT * LANES + p]
            w[k + 2 * LANES + p] = w[(_ROOT + 1) * LANES + p]


@kernel
def reflect(pairs: int, normal: FloatArray, eta_re: float, eta_im: float, thickness: float, w: FloatArray) -> None:
    """The wave after one reflection; ``thickness`` in wavelengths, infinite for a half-space.

    Source: ITU-R P.2040-3 eq. 37; ITU-R P.2040-3 eq. 43.

    Parameters
    ----------
    pairs : int
    normal : (3,)
        Unit normal of the face in the last space.
    eta_re, eta_im : float
        Relative permittivity of the face.
    thickness : float
        Of the slab, in wavelengths.
    w : (ROWS * LANES,)
        Workspace: direction and wave, which is replaced.
    """
    n0, n1, n2 = normal[0], normal[1], normal[2]
    for p in range(pairs):
        cosine = abs(n0 * w[_X * LANES + p] + n1 * w[_Y * LANES + p] + n2 * w[_Z * LANES + p])
        te_re, te_im, tm_re, tm_im, root_re, root_im = fresnel(cosine, eta_re, eta_im)
        w[_TE * LANES + p], w[(_TE + 1) * LANES + p] = te_re, te_im
        w[_TM * LANES + p], w[(_TM + 1) * LANES + p] = tm_re, tm_im
        w[_ROOT * LANES + p], w[(_ROOT + 1) * LANES + p] = root_re, root_im
    if math.isfinite(thickness):
        for p in range(pairs):
            w[_SIZE * LANES + p] = math.exp(2.0 * _TWO_PI * thickness * w[(_ROOT + 1) * LANES + p])
        for p in range(pairs):
            turns = -2.0 * thickness * w[_ROOT * LANES + p]
            sine, cosine = turn_sine_cosine(turns - ((turns + _ROUND) - _ROUND))
            echo_re, echo_im = w[_SIZE * LANES + p] * cosine, w[_SIZE * LANES + p] * sine
            te_re, te_im = slab(w[_TE * LANES + p], w[(_TE + 1) * LANES + p], echo_re, echo_im)
            tm_re, tm_im = slab(w[_TM * LANES + p], w[(_TM + 1) * LANES + p], echo_re, echo_im)
            w[_TE * LANES + p], w[(_TE + 1) * LANES + p] = te_re, te_im
            w[_TM * LANES + p], w[(_TM + 1) * LANES + p] = tm_re, tm_im
    for p in range(pairs):
        x, y, z = w[_X * LANES + p], w[_Y * LANES + p], w[_Z * LANES + p]
        s0, s1, s2 = y * n2 - z * n1, z * n0 - x * n2, x * n1 - y * n0
        scale = 1.0 / max(s0 * s0 + s1 * s1 + s2 * s2, 1e-300)
        tm_re, tm_im = w[_TM * LANES + p], w[(_TM + 1) * LANES + p]
        q_re, q_im = (w[_TE * LANES + p] + tm_re) * scale, (w[(_TE + 1) * LANES + p] + tm_im) * scale
        a0, a1, a2 = w[_WAVE * LANES + p], w[(_WAVE + 1) * LANES + p], w[(_WAVE + 2) * LANES + p]
        b0, b1, b2 = w[(_WAVE + 3) * LANES + p], w[(_WAVE + 4) * LANES + p], w[(_WAVE + 5) * LANES + p]
        a, b = s0 * a0 + s1 * a1 + s2 * a2, s0 * b0 + s1 * b1 + s2 * b2
        c_re, c_im = a * q_re - b * q_im, a * q_im + b * q_re
        w[_WAVE * LANES + p] = c_re * s0 - (tm_re * a0 - tm_im * b0)
        w[(_WAVE + 1) * LANES + p] = c_re * s1 - (tm_re * a1 - tm_im * b1)
        w[(_WAVE + 2) * LANES + p] = c_re * s2 - (tm_re * a2 - tm_im * b2)
        w[(_WAVE + 3) * LANES + p] = c_im * s0 - (tm_re * b0 + tm_im * a0)
        w[(_WAVE + 4) * LANES + p] = c_im * s1 - (tm_re * b1 + tm_im * a1)
        w[(_WAVE + 5) * LANES + p] = c_im * s2 - (tm_re * b2 + tm_im * a2)


@kernel
def receive(pairs: int, wavelength: float, w: FloatArray) -> None:
    """Complex amplitude of each pair, to rows ``_TE``: pattern, spreading and carrier phase."""
    for p in range(pairs):
        a0, a1, a2 = w[_WAVE * LANES + p], w[(_WAVE + 1) * LANES + p], w[(_WAVE + 2) * LANES + p]
        b0, b1, b2 = w[(_WAVE + 3) * LANES + p], w[(_WAVE + 4) * LANES + p], w[(_WAVE + 5) * LANES + p]
        g0, g1, g2 = w[_HEAR * LANES + p], w[(_HEAR + 1) * LANES + p], w[(_HEAR + 2) * LANES + p]
        h0, h1, h2 = w[(_HEAR + 3) * LANES + p], w[(_HEAR + 4) * LANES + p], w[(_HEAR + 5) * LANES + p]
        re = g0 * a0 + g1 * a1 + g2 * a2 - (h0 * b0 + h1 * b1 + h2 * b2)
        im = g0 * b0 + g1 * b1 + g2 * b2 + (h0 * a0 + h1 * a1 + h2 * a2)
        cycles = w[_LENGTH * LANES + p] / wavelength
        amplitude = min(1.0, 1.0 / (2.0 * _TWO_PI * cycles))
        sine, cosine = turn_sine_cosine(cycles - ((cycles + _ROUND) - _ROUND))
        w[_TE * LANES + p] = amplitude * (re * cosine + im * sine)
        w[(_TE + 1) * LANES + p] = amplitude * (im * cosine - re * sine)


@kernel
def fields(
    start: int,
    stop: int,
    pose: IntArray,
    tower: IntArray,
    depth: IntArray,
    sequence: IntArray,
    loss_db: FloatArray,
    normal: FloatArray,
    offset_m: FloatArray,
    eta: FloatArray,
    wavelength: float,
    sources_m: FloatArray,
    mounts: FloatArray,
    tower_m: FloatArray,
    tower_slants: FloatArray,
    tower_kinds: IntArray,
    tower_starts: IntArray,
    positions_m: FloatArray,
    rotations: FloatArray,
    uav_mount: FloatArray,
    uav_m: FloatArray,
    uav_slants: FloatArray,
    uav_kinds: IntArray,
    uav_starts: IntArray,
    grids: FloatArray,
    given: FloatArray,
    real: bool,
    only_directions: bool,
    out: IntArray,
    h: FloatArray,
    path_power: FloatArray,
) -> None:
    """Channel matrices (links, pairs, 2) and path powers of paths ``start`` to ``stop``, added path by path.

    Columns of elements are spread over pairs: ``tower_m`` (towers, 3, pairs), ``tower_slants`` (towers, 2, pairs:
    cosine, sine), ``tower_kinds`` (towers, pairs), ``tower_starts`` (towers, pairs, 3: start, rows, columns in
    ``grids``), and those of the UAV without the first axis. ``out`` (pairs,) is the place of each pair in H. ``eta``
    (faces, 3) has real and imaginary part of the permittivity and the thickness in wavelengths. ``given``
    (paths, 8, pairs) holds the fields of ``GIVEN`` patterns, or takes the directions in which they are wanted
    (``only_directions``).

    Parameters
    ----------
    start, stop : int
        Which paths.
    pose, tower, depth : (paths,) int
        Of each path.
    sequence : (paths, most) int
        Its faces, -1 beyond its depth.
    loss_db : (paths,) or (0,)
        Further loss of each path [dB]; none where empty.
    normal, offset_m : (faces, 3), (faces,)
        Planes of the faces [m].
    eta : (faces, 3)
        See above.
    wavelength : float
        [m]
    sources_m, mounts : (towers, 3), (towers, 3, 3)
        Centres of the tower arrays [m] and their rotations.
    tower_m, tower_slants, tower_kinds, tower_starts
        Elements of the towers, spread over pairs; see above.
    positions_m, rotations : (poses, 3), (poses, 3, 3)
        The UAV.
    uav_mount : (3, 3)
        Rotation of its array in its body.
    uav_m, uav_slants, uav_kinds, uav_starts
        Its elements, spread over pairs.
    grids : (coefficients,)
        Splines of all patterns that are grids.
    given : (rows, 8, pairs)
        See above.
    real : bool
        No pattern has an imaginary part.
    only_directions : bool
        Fill ``given`` with directions, and nothing else.
    out : (pairs,) int
        Place of each pair in H.
    h : (links, pairs, 2)
        Real and imaginary part, added to.
    path_power : (paths,)
        Gets the mean over pairs of ``|h|^2`` of each path alone.
    """
    towers, total = len(sources_m), tower_m.shape[2]
    w = np.empty(ROWS * LANES)
    image, frame, normals = np.empty(3), np.empty((3, 3)), np.empty((max(sequence.shape[1], 1), 3))
    axes, elements = np.empty((3, 3)), np.empty((3, total))
    last = -1
    for path in range(start, stop):
        place, source = pose[path], tower[path]
        if place != last:
            last = place
            for j in range(3):
                for i in range(3):
                    axes[j, i] = (
                        rotations[place, i, 0] * uav_mount[0, j]
                        + rotations[place, i, 1] * uav_mount[1, j]
                        + rotations[place, i, 2] * uav_mount[2, j]
                    )
            for i in range(3):
                for p in range(total):
                    elements[i, p] = positions_m[place, i] + (
                        axes[0, i] * uav_m[0, p] + axes[1, i] * uav_m[1, p] + axes[2, i] * uav_m[2, p]
                    )
        unfold(normal, offset_m, sequence[path], depth[path], sources_m[source], mounts[source], image, frame, normals)
        loss = 10.0 ** (-loss_db[path] / 20.0) if len(loss_db) else 1.0
        power = 0.0
        link = place * towers + source
        for first in range(0, total, LANES):
            pairs = min(LANES, total - first)
            directions(pairs, first, image, frame, tower_m[source], elements, axes, w)
            if only_directions:
                for row in range(6):
                    for p in range(pairs):
                        given[path - start, row, first + p] = w[(_TOWER + row) * LANES + p]
                continue
            at = min(path - start, len(given) - 1)
            patterns(pairs, first, _TOWER, _E_TOWER, tower_kinds[source], tower_starts[source], grids, given[at], 0, w)
            patterns(pairs, first, _UAV, _E_UAV, uav_kinds, uav_starts, grids, given[at], 4, w)
            radiate(pairs, first, _TOWER, _E_TOWER, _WAVE, real, tower_slants[source], frame, w)
            radiate(pairs, first, _UAV, _E_UAV, _HEAR, real, uav_slants, axes, w)
            for step in range(depth[path]):
                face = sequence[path, step]
                reflect(pairs, normals[step], eta[face, 0], eta[face, 1], eta[face, 2], w)
            receive(pairs, wavelength, w)
            for p in range(pairs):
                re, im = loss * w[_TE * LANES + p], loss * w[(_TE + 1) * LANES + p]
                power += re * re + im * im
                h[link, out[first + p], 0] += re
                h[link, out[first + p], 1] += im
        if not only_directions:
            path_power[path] = power / total


FIELD_ARGUMENTS = tuple(inspect.signature(fields.py_func).parameters)


def try_out() -> None:
    """Compile, or read what was compiled before, and evaluate one path.

    Raises
    ------
    RuntimeError
        If its amplitude is not that of free space.
    """
    none, one, row = np.zeros(0), np.ones((1, 1)), np.zeros((1, 3, 1))
    number, kinds, starts = np.zeros(1, np.int64), np.zeros((1, 1), np.int64), np.zeros((1, 1, 3), np.int64)
    h, slants = np.zeros((1, 1, 2)), np.array([[[1.0], [0.0]]])
    fields(
        0, 1, number, number, number, np.zeros((1, 0), np.int64), none, np.zeros((0, 3)), none, np.zeros((1, 3)), 0.1,
        np.zeros((1, 3)), np.eye(3)[None].copy(), row, slants, kinds, starts, np.array([[30.0, 40.0, 0.0]]),
        np.eye(3)[None].copy(), np.eye(3), row[0], slants[0], kinds[0], starts[0], np.zeros(1), np.zeros((1, 8, 1)),
        True, False, number, h, one[0],
    )  # fmt: skip
    size = math.hypot(h[0, 0, 0], h[0, 0, 1])
    if not abs(size * 4.0 * math.pi * 500.0 - 1.0) < 1e-12:
        raise RuntimeError(f"a compiled line of sight of 500 wavelengths has the amplitude {size:g}")
