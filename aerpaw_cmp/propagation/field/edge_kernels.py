"""The laws of paths over edges as compiled loops over paths and pairs of elements; imported only where numba is there.

:func:`add` sums what :func:`aerpaw_cmp.propagation.field.edges.amplitudes` gives of each path. Stages are loops over
paths on a flat workspace, as those over pairs of elements in :mod:`aerpaw_cmp.propagation.field.kernels`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...common.units import ComplexArray, FloatArray, IntArray
from ..edges import EdgePaths
from ..numba_options import kernel, law
from . import dyads, edges, fresnel, wedge
from .edges import Tables
from .kernels import LANES, put, taken, vector  # the laws of dyads and fresnel are made known to numba there too

# rows of the workspace: an edge, the last edge's line, both ends with their mirrors (columns of Tables, then 1 where
# there is a mirror), and what the stages make of them
_EDGE, _LAST, _SOURCE, _TARGET, _MIRROR, _WAYS, _COSINES, _ANGLES, _DISTANCE, _SPREAD, _TERMS, _OBLIQUE, _FACES = (
    row * LANES for row in (0, 22, 37, 57, 12, 77, 83, 85, 87, 88, 89, 101, 103)
)
_JOINED, _TURN, _PARTS, _ELEMENT, _MIDDLE, _LOST, _POWER, _ALL = (
    row * LANES for row in (115, 123, 129, 145, 154, 160, 161, 162)
)
_EXTERIOR, _MATERIAL_0, _MATERIAL_N = (row * LANES for row in (15, 16, 19))
# Rows of an element: its field along beta and phi, its place along the edge and its distance from it.
EACH = 6 * LANES

for _short in (
    dyads.arctangent, wedge.transition, wedge.pole, wedge.edge_term, wedge.obliquity, wedge.matrix, wedge.coupled,
    wedge.of_wave, wedge.along_face, wedge.ground_wave, edges.dot, edges.distance, edges.unit, edges.mirrored,
    edges.round_edge, edges.element_place, edges.angle_round, edges.end_parts, edges.after_mirror,
    edges.element_parts, edges.into_face, edges.over_one, edges.over_two,
):  # fmt: skip
    law(_short)
for _long in (wedge.sector, wedge.quadrant, wedge.at_face):  # called some times each
    law(_long, inline=False)


class Rows(NamedTuple):
    """Columns of :class:`aerpaw_cmp.propagation.edges.EdgePaths`, factors, and fields of patterns of both ends."""

    pose: IntArray
    tower: IntArray
    edge: IntArray
    shared: IntArray
    ground: IntArray
    vertices: FloatArray
    lost: FloatArray
    fields: tuple[FloatArray, FloatArray]


@kernel
def _nine(w: FloatArray, at: int) -> Any:
    """Axes out of rows of the workspace."""
    return taken(w, at), taken(w, at + 3 * LANES), taken(w, at + 6 * LANES)


@kernel
def _line(w: FloatArray, at: int) -> Any:
    """An edge as laws for its coordinates take it."""
    return (*_nine(w, at), taken(w, at + 9 * LANES), taken(w, at + 12 * LANES))


@kernel
def _copy(w: FloatArray, at: int, row: FloatArray) -> None:
    for k in range(len(row)):
        w[at + k * LANES] = row[k]


@kernel
def _gather(w: FloatArray, t: Tables, r: Rows, first: int, many: int) -> None:
    for p in range(many):
        path = first + p
        e, g = r.edge[path, 0], r.edge[path, 1]
        _copy(w, _EDGE + p, t.edge[e])
        _copy(w, _LAST + p, t.edge[e if g < 0 else g, :15])
        _copy(w, _SOURCE + p, t.source[r.tower[path]])
        _copy(w, _TARGET + p, t.target[r.pose[path]])
        for at, side in ((_SOURCE, 0), (_TARGET, 1)):
            face = r.ground[path, side]  # -1 is the last row of the mirrors, which mirrors nothing
            _copy(w, at + _MIRROR + p, t.mirror[face])
            w[at + _MIRROR + 7 * LANES + p] = 1.0 if face >= 0 else 0.0
        w[_LOST + p] = r.lost[path]


@kernel
def _mirror(w: FloatArray, at: int) -> None:
    """An end into the space where its leg is straight."""
    for p in range(LANES):
        normal, place = taken(w, at + _MIRROR + p), taken(w, at + p)
        put(w, at + p, edges.mirrored(place, normal, w[at + _MIRROR + 3 * LANES + p]))
    for axis in range(1, 4):
        row = w[at + 3 * axis * LANES : at + 3 * (axis + 1) * LANES]
        for p in range(LANES):
            put(row, p, edges.mirrored(taken(row, p), taken(w, at + _MIRROR + p), 0.0))


@kernel
def _bend(w: FloatArray, wave_number: float) -> None:
    """Rows of paths over one edge: directions, angles and the parts of the wedge's matrix."""
    for p in range(LANES):
        before, after, cosines, distance, spread, angles = edges.over_one(
            taken(w, _SOURCE + p), taken(w, _TARGET + p), _line(w, _EDGE + p), wave_number
        )
        put(w, _WAYS + p, before)
        put(w, _WAYS + 3 * LANES + p, after)
        w[_COSINES + p], w[_COSINES + LANES + p] = cosines
        w[_ANGLES + p], w[_ANGLES + LANES + p] = angles
        w[_DISTANCE + p], w[_SPREAD + p] = distance, spread
    for k, turn_in, turn_out in ((0, -1.0, 1.0), (1, 1.0, -1.0), (2, 1.0, 1.0), (3, -1.0, -1.0)):
        row = w[_TERMS + 3 * k * LANES : _TERMS + 3 * (k + 1) * LANES]
        for p in range(LANES):
            angle = np.pi + turn_in * w[_ANGLES + p] + turn_out * w[_ANGLES + LANES + p]
            put(row, p, wedge.edge_term(angle, w[_EXTERIOR + p], w[_DISTANCE + p]))
    for p in range(LANES):
        upright, across = wedge.obliquity(
            w[_ANGLES + p], w[_ANGLES + LANES + p], w[_EXTERIOR + p], w[_TERMS + 2 * LANES + p],
            w[_TERMS + 5 * LANES + p],
        )  # fmt: skip
        cosine = w[_COSINES + p]
        w[_OBLIQUE + p], w[_OBLIQUE + LANES + p] = upright, across
        sine = np.abs(upright) * np.sqrt(1.0 - cosine * cosine)
        w[_FACES + p], w[_FACES + 6 * LANES + p] = sine, sine


@kernel
def _face(w: FloatArray, at: int, material: int) -> None:
    """Coefficients TE and TM of faces, into rows ``at``, whose first holds the cosine."""
    row, stuff = w[at : at + 6 * LANES], w[material : material + 3 * LANES]
    for p in range(LANES):
        te_re, te_im, tm_re, tm_im, root_re, root_im = fresnel.half_space(row[p], stuff[p], stuff[LANES + p])
        put(row, p, (te_re, te_im, tm_re))
        put(row, 3 * LANES + p, (tm_im, root_re, root_im))
    for p in range(LANES):
        thickness = stuff[2 * LANES + p]
        if math.isfinite(thickness):
            e_re, e_im = fresnel.echo(thickness, row[4 * LANES + p], row[5 * LANES + p])
            for k in (p, 2 * LANES + p):
                row[k], row[LANES + k] = fresnel.slab(row[k], row[LANES + k], e_re, e_im)


@kernel
def _four(w: FloatArray, at: int) -> Any:
    return w[at], w[at + LANES], w[at + 2 * LANES], w[at + 3 * LANES]


@kernel
def _join(w: FloatArray) -> None:
    """The wedge's matrix of paths over one edge."""
    for p in range(LANES):
        terms = (
            w[_TERMS + p], w[_TERMS + LANES + p], w[_TERMS + 3 * LANES + p], w[_TERMS + 4 * LANES + p],
            w[_TERMS + 6 * LANES + p], w[_TERMS + 7 * LANES + p], w[_TERMS + 9 * LANES + p],
            w[_TERMS + 10 * LANES + p],
        )  # fmt: skip
        angles = w[_OBLIQUE + p], w[_OBLIQUE + LANES + p], w[_COSINES + p], w[_EXTERIOR + p]
        bb_re, bb_im, bp_re, bp_im, pp_re, pp_im = wedge.matrix(
            terms, angles, _four(w, _FACES + p), _four(w, _FACES + 6 * LANES + p)
        )
        spread = w[_SPREAD + p]
        put(w, _JOINED + p, (bb_re * spread, bb_im * spread, bp_re * spread))
        put(w, _JOINED + 3 * LANES + p, (bp_im * spread, -bp_re * spread, -bp_im * spread))
        w[_JOINED + 6 * LANES + p], w[_JOINED + 7 * LANES + p] = pp_re * spread, pp_im * spread


@kernel
def _edge_of_row(row: FloatArray) -> Any:
    """An edge as the laws take it."""
    return (
        vector(row), vector(row[3:]), vector(row[6:]), vector(row[9:]), vector(row[12:]), row[15], vector(row[16:]),
        vector(row[19:]),
    )  # fmt: skip


@kernel
def _over_pairs(w: FloatArray, t: Tables, r: Rows, first: int, many: int) -> None:
    """Rows of paths over two edges in place of those over one."""
    for p in range(many):
        path = first + p
        if r.edge[path, 1] < 0:
            put(w, _TURN + p, (0.0, 1.0, 0.0))
            put(w, _TURN + 3 * LANES + p, (0.0, 0.0, 1.0))
            continue
        before, after, cosines, joined, turn = edges.over_two(
            taken(w, _SOURCE + p), taken(w, _TARGET + p), _edge_of_row(t.edge[r.edge[path, 0]]),
            _edge_of_row(t.edge[r.edge[path, 1]]),
            vector(r.vertices[path, 1]), vector(r.vertices[path, 2]), (r.shared[path, 0], r.shared[path, 1]),
            t.wave_number,
        )  # fmt: skip
        put(w, _WAYS + p, before)
        put(w, _WAYS + 3 * LANES + p, after)
        w[_COSINES + p], w[_COSINES + LANES + p] = cosines
        for k, entry in enumerate(joined):
            w[_JOINED + 2 * k * LANES + p], w[_JOINED + (2 * k + 1) * LANES + p] = entry.real, entry.imag
        for k, number in enumerate(turn):
            w[_TURN + k * LANES + p] = number


@kernel
def _unit_fields(w: FloatArray, at: int, side: int) -> None:
    """Unit fields of an end over its leg, in the edge-fixed basis."""
    way, out, edge = _WAYS + 3 * side * LANES, _PARTS + 8 * side * LANES, _LAST if side else _EDGE
    for p in range(LANES):
        w[_FACES + p] = dyads.incidence(taken(w, way + p), taken(w, at + _MIRROR + p))
    _face(w, _FACES, at + _MIRROR + 4 * LANES)
    for p in range(LANES):
        mirror = taken(w, at + _MIRROR + p), w[at + _MIRROR + 7 * LANES + p] > 0.0, _four(w, _FACES + p)
        parts = edges.end_parts(
            _nine(w, at + 3 * LANES + p), (taken(w, way + p), 1.0 - 2.0 * side), mirror,
            taken(w, edge + 3 * LANES + p), w[_COSINES + side * LANES + p],
        )  # fmt: skip
        for k in range(8):
            w[out + k * LANES + p] = parts[k]


@kernel
def _elements(w: FloatArray, at: int, array: Any, index: IntArray, span: tuple[int, int], out: FloatArray) -> None:
    """Fields and places of all elements of an end."""
    places, slants, fields, side = array
    parts, edge, (first, many) = _PARTS + 8 * side * LANES, _LAST if side else _EDGE, span
    # 1 along theta: the other end's pattern stood here
    w[_ELEMENT + 5 * LANES : _ELEMENT + 9 * LANES] = 0.0
    w[_ELEMENT + 5 * LANES : _ELEMENT + 6 * LANES] = 1.0
    for i in range(places.shape[2]):
        row = out[i * EACH : (i + 1) * EACH]
        for p in range(many):
            q = 0 if side else index[first + p]
            put(w, _ELEMENT + p, (places[q, 0, i], places[q, 1, i], places[q, 2, i]))
            w[_ELEMENT + 3 * LANES + p], w[_ELEMENT + 4 * LANES + p] = slants[q, 0, i], slants[q, 1, i]
            if len(fields):
                _copy(w, _ELEMENT + 5 * LANES + p, fields[first + p, :, i])
        for p in range(LANES):
            unit = _four(w, parts + p), _four(w, parts + 4 * LANES + p)
            b_re, b_im, p_re, p_im = edges.element_parts(
                (*unit[0], *unit[1]), _four(w, _ELEMENT + 5 * LANES + p),
                (w[_ELEMENT + 3 * LANES + p], w[_ELEMENT + 4 * LANES + p]),
            )  # fmt: skip
            along, radius = edges.element_place(
                taken(w, at + p), _nine(w, at + 3 * LANES + p), taken(w, _ELEMENT + p), _line(w, edge + p)
            )
            put(row, p, (b_re, b_im, p_re))
            put(row, 3 * LANES + p, (p_im, along, radius))


@kernel
def _pairs(w: FloatArray, turns: float, sent: FloatArray, caught: FloatArray, out: FloatArray) -> None:
    """Amplitudes (2 x pairs x LANES) of all pairs of elements, and the sum of their powers."""
    w[_POWER : _POWER + LANES] = 0.0
    ports = len(sent) // EACH
    for j in range(len(caught) // EACH):
        target = caught[j * EACH : (j + 1) * EACH]
        for p in range(LANES):
            b_re, b_im, p_re, p_im = _four(target, p)
            along, radius, lost = target[4 * LANES + p], target[5 * LANES + p], w[_LOST + p]
            bb_re, bb_im, bp_re, bp_im = _four(w, _JOINED + p)
            pb_re, pb_im, pp_re, pp_im = _four(w, _JOINED + 4 * LANES + p)
            w[_MIDDLE + p] = (b_re * bb_re - b_im * bb_im + p_re * pb_re - p_im * pb_im) * lost
            w[_MIDDLE + LANES + p] = (b_re * bb_im + b_im * bb_re + p_re * pb_im + p_im * pb_re) * lost
            w[_MIDDLE + 2 * LANES + p] = (b_re * bp_re - b_im * bp_im + p_re * pp_re - p_im * pp_im) * lost
            w[_MIDDLE + 3 * LANES + p] = (b_re * bp_im + b_im * bp_re + p_re * pp_im + p_im * pp_re) * lost
            u, v = taken(w, _TURN + p), taken(w, _TURN + 3 * LANES + p)
            w[_MIDDLE + 4 * LANES + p] = u[0] + u[1] * along + u[2] * radius
            w[_MIDDLE + 5 * LANES + p] = v[0] + v[1] * along + v[2] * radius
        for i in range(ports):
            source, k = sent[i * EACH : (i + 1) * EACH], 2 * (j * ports + i) * LANES
            row = out[k : k + 2 * LANES]
            for p in range(LANES):
                b_re, b_im, c_re, c_im = _four(w, _MIDDLE + p)
                s_re, s_im, t_re, t_im = _four(source, p)
                x, y = (
                    w[_MIDDLE + 4 * LANES + p] - source[4 * LANES + p],
                    w[_MIDDLE + 5 * LANES + p] + source[5 * LANES + p],
                )
                total = np.sqrt(x * x + y * y)
                sine, cosine = dyads.sine_cosine(total * turns)
                scale = 1.0 / np.sqrt(total)
                re = (b_re * s_re - b_im * s_im + c_re * t_re - c_im * t_im) * scale
                im = (b_re * s_im + b_im * s_re + c_re * t_im + c_im * t_re) * scale
                row[p], row[LANES + p] = re * cosine + im * sine, im * cosine - re * sine
                w[_POWER + p] += re * re + im * im


@kernel
def _add(t: Tables, r: Rows, h: FloatArray, power: FloatArray) -> None:
    towers, ports, uavs = len(t.source), t.tower_m.shape[2], t.uav_m.shape[2]
    pairs = ports * uavs
    w, out = np.zeros(_ALL), np.zeros(2 * pairs * LANES)
    sent, caught = np.zeros(ports * EACH), np.zeros(uavs * EACH)
    for first in range(0, len(r.pose), LANES):
        many = min(LANES, len(r.pose) - first)
        _gather(w, t, r, first, many)
        _mirror(w, _SOURCE)
        _mirror(w, _TARGET)
        _bend(w, t.wave_number)
        _face(w, _FACES, _MATERIAL_0)
        _face(w, _FACES + 6 * LANES, _MATERIAL_N)
        _join(w)
        _over_pairs(w, t, r, first, many)
        _unit_fields(w, _SOURCE, 0)
        _unit_fields(w, _TARGET, 1)
        _elements(w, _SOURCE, (t.tower_m, t.tower_slant, r.fields[0], 0), r.tower, (first, many), sent)
        _elements(w, _TARGET, (t.uav_m, t.uav_slant, r.fields[1], 1), r.tower, (first, many), caught)
        _pairs(w, t.wave_number / (2.0 * math.pi), sent, caught, out)
        for p in range(many):
            link = r.pose[first + p] * towers + r.tower[first + p]
            power[link] += w[_POWER + p] / pairs
            row = h[link]
            for k in range(2 * pairs):
                row[k] += out[k * LANES + p]


def add(
    tables: Tables,
    paths: EdgePaths,
    ends: list[FloatArray | None],
    lost: FloatArray,
    h: ComplexArray,
    power: FloatArray,
) -> None:
    """Add amplitudes of paths to channel matrices, and their powers.

    Parameters
    ----------
    tables : Tables
    paths : EdgePaths
    ends : list of (paths, 4, elements) or None
        Pattern fields of tower and UAV.
    lost : (paths,)
        Factors of the amplitudes.
    h : (links, uav elements, tower elements) complex
        Added to.
    power : (links,)
        Added to.
    """

    def writable(value: Any) -> Any:
        return np.require(value, requirements=["C", "W"]) if isinstance(value, np.ndarray) else value

    columns = paths.pose, paths.tower, paths.edge, paths.shared, paths.ground, paths.vertices_m, lost
    fields = tuple(np.empty((0, 4, 0)) if e is None else writable(e) for e in ends)
    rows = Rows._make((*map(writable, columns), fields))
    _add(Tables._make(map(writable, tables)), rows, h.reshape(len(h), -1).view(np.float64), power)


def try_out() -> None:
    """Compile, or read what was compiled before, and sum no paths.

    Raises
    ------
    RuntimeError
        If they add up to something.
    """
    shapes = (0, 22), (1, 7), (0, 12), (0, 12), (0, 3, 1), (0, 2, 1), (1, 3, 1), (1, 2, 1)
    tables = Tables._make((*map(np.zeros, shapes), 1.0))
    paths = EdgePaths.of(np.zeros((0, 8), np.int64), np.zeros((0, 4, 3)))
    h = np.zeros((1, 1, 1), np.complex128)
    add(tables, paths, [None, None], np.zeros(0), h, np.zeros(1))
    if h[0, 0, 0] != 0.0:
        raise RuntimeError(f"no path over an edge adds {h[0, 0, 0]}")
