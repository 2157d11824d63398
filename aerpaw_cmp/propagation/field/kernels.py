"""The laws of the field as compiled loops; imported only where numba is there.

:func:`amplitudes` is that of :mod:`aerpaw_cmp.propagation.field.sum`: each stage is a loop over pairs and calls the
same law. Stages are loops of their own over a flat workspace, so that the compiler uses vector instructions.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba.extending import overload

from ...common.units import FloatArray
from ..numba_options import kernel, law
from . import dyads, fresnel
from .geometry import Elements, Ends, Geometry

# Element pairs of a path evaluated at once; a power of two, so that rows of the workspace cannot overlap.
LANES = 64

# rows of the workspace: direction and length, wave, field of the UAV's element, coefficients
_X, _Y, _Z, _LENGTH = (row * LANES for row in range(4))
_WAVE, _UAV, _TE, _TM, _ROOT = (row * LANES for row in (4, 10, 16, 18, 20))
ROWS = 22


@overload(dyads.select, jit_options={"error_model": "numpy"})
def _select(condition, yes, no):  # type: ignore[no-untyped-def]  # noqa: ARG001
    return lambda condition, yes, no: yes if condition else no


@overload(dyads.larger, jit_options={"error_model": "numpy"})
def _larger(a, b):  # type: ignore[no-untyped-def]  # noqa: ARG001
    return lambda a, b: a if a > b else b


@overload(dyads.smaller, jit_options={"error_model": "numpy"})
def _smaller(a, b):  # type: ignore[no-untyped-def]  # noqa: ARG001
    return lambda a, b: a if a < b else b


for _short in (
    dyads.sine_cosine, dyads.turned, dyads.turned_back, dyads.direction, dyads.slant_rotation, dyads.field_vector,
    dyads.incidence, dyads.reflected, dyads.spreading, dyads.received, fresnel.half_space, fresnel.echo, fresnel.slab,
    fresnel.returned, fresnel.reflection,
):  # fmt: skip
    law(_short)


@kernel
def vector(v: FloatArray) -> Any:
    """Three numbers as a tuple, which stays in registers."""
    return v[0], v[1], v[2]


@kernel
def _rotation(m: FloatArray) -> Any:
    """Axes (3, 3) as tuples."""
    return vector(m[0]), vector(m[1]), vector(m[2])


@kernel
def put(w: FloatArray, at: int, v: Any) -> None:
    """Three numbers into rows of the workspace."""
    w[at], w[at + LANES], w[at + 2 * LANES] = v


@kernel
def taken(w: FloatArray, at: int) -> Any:
    """Three numbers out of rows of the workspace."""
    return w[at], w[at + LANES], w[at + 2 * LANES]


@kernel
def _radiate(
    w: FloatArray, pairs: int, first: int, m: Any, sign: float, slant: FloatArray, e: FloatArray, out: int
) -> None:
    """Field vectors of elements in site axes, to rows ``out``; ``e`` (4, all pairs) is empty for 1 along theta."""
    if len(e) == 0:
        for p in range(pairs):
            e_theta, e_phi = dyads.slant_rotation(1.0, 0.0, slant[0, first + p], slant[1, first + p])
            toward = sign * w[_X + p], sign * w[_Y + p], sign * w[_Z + p]
            put(w, out + p, dyads.field_vector(m, toward, e_theta, e_phi))
        # the imaginary half: an isotropic element radiates none
        w[out + 3 * LANES : out + 6 * LANES] = 0.0
        return
    # real parts, then imaginary ones: the law is linear in the field
    for half in range(2):
        for p in range(pairs):
            q = first + p
            e_theta, e_phi = dyads.slant_rotation(e[half, q], e[2 + half, q], slant[0, q], slant[1, q])
            toward = sign * w[_X + p], sign * w[_Y + p], sign * w[_Z + p]
            put(w, out + half * 3 * LANES + p, dyads.field_vector(m, toward, e_theta, e_phi))


@kernel
def _reflect(w: FloatArray, pairs: int, normal: Any, eta_re: float, eta_im: float, thickness: float) -> None:
    """The wave after one reflection."""
    for p in range(pairs):
        cosine = dyads.incidence(taken(w, _X + p), normal)
        te_re, te_im, tm_re, tm_im, root_re, root_im = fresnel.half_space(cosine, eta_re, eta_im)
        w[_TE + p], w[_TE + LANES + p], w[_TM + p], w[_TM + LANES + p] = te_re, te_im, tm_re, tm_im
        w[_ROOT + p], w[_ROOT + LANES + p] = root_re, root_im
    # one test a face, outside the loop over pairs
    if math.isfinite(thickness):
        for p in range(pairs):
            e_re, e_im = fresnel.echo(thickness, w[_ROOT + p], w[_ROOT + LANES + p])
            for at in (_TE, _TM):
                w[at + p], w[at + LANES + p] = fresnel.slab(w[at + p], w[at + LANES + p], e_re, e_im)
    for p in range(pairs):
        re, im = dyads.reflected(
            taken(w, _WAVE + p), taken(w, _WAVE + 3 * LANES + p), taken(w, _X + p), normal,
            w[_TE + p], w[_TE + LANES + p], w[_TM + p], w[_TM + LANES + p],
        )  # fmt: skip
        put(w, _WAVE + p, re)
        put(w, _WAVE + 3 * LANES + p, im)


@kernel
def _fill(
    g: Geometry, elements: Elements, e_tower: FloatArray, e_uav: FloatArray, wavelength: float, out: FloatArray
) -> None:
    """Amplitudes (paths, pairs, 2)."""
    # one workspace a call: it stays in the first cache
    w, total = np.empty(ROWS * LANES), out.shape[1]
    for path in range(len(out)):
        image, place, tower = vector(g.image_m[path]), vector(g.place_m[path]), g.tower[path]
        frame, axes = _rotation(g.frame[path]), _rotation(g.axes[path])
        tower_places, uav_places = elements.tower_m[tower], elements.uav_m
        for first in range(0, total, LANES):
            pairs = min(LANES, total - first)
            for p in range(pairs):
                q = first + p
                tower_m, uav_m = (
                    (tower_places[0, q], tower_places[1, q], tower_places[2, q]),
                    (uav_places[0, q], uav_places[1, q], uav_places[2, q]),
                )
                x, y, z, length = dyads.direction(image, frame, tower_m, place, axes, uav_m)
                put(w, _X + p, (x, y, z))
                w[_LENGTH + p] = length
            # one empty entry stands for all paths where every pattern is 1 along theta
            _radiate(w, pairs, first, frame, 1.0, elements.tower_slant[tower], e_tower[path % len(e_tower)], _WAVE)
            _radiate(w, pairs, first, axes, -1.0, elements.uav_slant, e_uav[path % len(e_uav)], _UAV)
            for step in range(g.depth[path]):
                face = vector(g.face[path, step])
                _reflect(w, pairs, vector(g.normal[path, step]), face[0], face[1], face[2])
            for p in range(pairs):
                re, im = dyads.received(
                    taken(w, _WAVE + p), taken(w, _WAVE + 3 * LANES + p), taken(w, _UAV + p),
                    taken(w, _UAV + 3 * LANES + p), w[_LENGTH + p] / wavelength,
                )  # fmt: skip
                out[path, first + p, 0], out[path, first + p, 1] = re, im


def amplitudes(g: Geometry, elements: Elements, ends: Ends, wavelength: float) -> FloatArray:
    """As :func:`aerpaw_cmp.propagation.field.sum.amplitudes`.

    Parameters
    ----------
    g, elements, ends, wavelength
        As there.

    Returns
    -------
    (paths, pairs, 2)
    """
    out = np.empty((len(g.depth), elements.tower_m.shape[2], 2))
    none = np.empty((1, 0, out.shape[1]))
    # a read-only or sliced column would be compiled for anew
    columns = Geometry._make(np.require(column, requirements=["C", "W"]) for column in g)
    _fill(columns, elements, *(none if e is None else e for e in ends), wavelength, out)
    return out


def try_out() -> None:
    """Compile, or read what was compiled before, and evaluate one path.

    Raises
    ------
    RuntimeError
        If its amplitude is not that of free space.
    """
    turn, zero, column = np.eye(3)[None].copy(), np.zeros(1, np.int64), np.zeros((3, 1))
    none = np.zeros((1, 0, 3))
    place = np.array([[30.0, 40.0, 0.0]])
    g = Geometry(
        image_m=np.zeros((1, 3)), frame=turn, normal=none, face=none, depth=zero, tower=zero, place_m=place, axes=turn
    )
    slant = np.array([[1.0], [0.0]])
    h = amplitudes(g, Elements(column[None].copy(), slant[None].copy(), column, slant), (None, None), 0.1)
    size = math.hypot(h[0, 0, 0], h[0, 0, 1])
    if not abs(size * 4.0 * math.pi * 500.0 - 1.0) < 1e-12:
        raise RuntimeError(f"a compiled line of sight of 500 wavelengths has the amplitude {size:g}")
