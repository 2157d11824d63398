"""The laws of paths over edges as compiled loops over paths and pairs of elements; imported only where numba is there.

:func:`add` sums what :func:`aerpaw_cmp.propagation.field.edges.amplitudes` gives of each path.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...common.units import ComplexArray, FloatArray
from ..edges import EdgePaths
from ..numba_options import kernel, law
from . import dyads, edges, wedge
from . import kernels as kernels  # the laws of dyads and fresnel are made known to numba there
from .edges import Tables

for _one in (
    wedge.transition, wedge.edge_term, wedge.face_matrix, wedge.face_coefficients, wedge.at_face, wedge.along_face,
    wedge.ground_wave, wedge.wedge, edges.dot, edges.unit, edges.mirrored, edges.round_edge, edges.element_place,
    edges.angle_round, edges.mirror_coefficients, edges.end_parts, edges.after_mirror, edges.element_parts,
    edges.into_face, edges.over_one, edges.over_two,
):  # fmt: skip
    law(_one)


@kernel
def _three(v: FloatArray) -> Any:
    return v[0], v[1], v[2]


@kernel
def _edge(t: Tables, edge: int) -> Any:
    """An edge as the laws take it."""
    return (
        _three(t.start[edge]), _three(t.along[edge]), _three(t.inward[edge, 0]), _three(t.inward[edge, 1]),
        _three(t.out[edge]), t.exterior[edge], _three(t.material[t.face[edge, 0]]),
        _three(t.material[t.face[edge, 1]]),
    )  # fmt: skip


@kernel
def _end(t: Tables, place: FloatArray, axes: FloatArray, face: int) -> Any:
    """Centre, axes and mirror's normal of an end where its leg is straight."""
    normal = _three(t.normal[face])
    a, b, c = (
        edges.mirrored(_three(axes[0]), normal, 0.0),
        edges.mirrored(_three(axes[1]), normal, 0.0),
        edges.mirrored(_three(axes[2]), normal, 0.0),
    )
    return edges.mirrored(_three(place), normal, t.offset[face]), (a, b, c), normal


@kernel
def _elements(t: Tables, end: Any, edge: Any, way: Any, cosine: float, face: int, rows: Any, out: Any) -> None:
    """Parts of the field and places of all elements of an end; ``rows`` are places, slants and pattern fields."""
    centre, axes, normal = end
    places, slants, field = rows
    parts, flat = out
    te, tm = edges.mirror_coefficients(way[0], normal, _three(t.material[face]))
    units = edges.end_parts(axes, way, (normal, face >= 0, te, tm), edge[1], cosine)
    for i in range(places.shape[1]):
        given = (1.0, 0.0, 0.0, 0.0)
        if len(field):
            given = (field[0, i], field[1, i], field[2, i], field[3, i])
        parts[0, i], parts[1, i] = edges.element_parts(units, given, (slants[0, i], slants[1, i]))
        flat[0, i], flat[1, i] = edges.element_place(centre, axes, (places[0, i], places[1, i], places[2, i]), edge)


@kernel
def _pairs(w: FloatArray, turns: float) -> None:
    """Rows of pairs (6, pairs): two sides of the length, and the wave, before and after spreading and carrier."""
    x, y, re, im, sum_re, sum_im = w
    for p in range(len(x)):
        total = np.sqrt(x[p] * x[p] + y[p] * y[p])
        sine, cosine = dyads.sine_cosine(total * turns)
        scale = 1.0 / np.sqrt(total)
        a, b = re[p] * scale, im[p] * scale
        re[p], im[p] = a * cosine + b * sine, b * cosine - a * sine
        sum_re[p] += re[p]
        sum_im[p] += im[p]


@kernel
def _add(  # type: ignore[no-untyped-def]
    t, pose, tower, edge, shared, ground, vertices, e_tower, e_uav, lost, h, power
) -> None:
    uavs, ports = t.uav_m.shape[1], t.tower_m.shape[2]
    sent, caught = np.empty((2, ports), np.complex128), np.empty((2, uavs), np.complex128)
    here, there, w = np.empty((2, ports)), np.empty((2, uavs)), np.zeros((6, uavs * ports))
    turns = t.wave_number / (2.0 * math.pi)
    for path in range(len(pose)):
        p, q = pose[path], tower[path]
        edge_1 = _edge(t, edge[path, 0])
        edge_2 = edge_1
        source = _end(t, t.source[q], t.tower_axes[q], ground[path, 0])
        target = _end(t, t.place[p], t.axes[p], ground[path, 1])
        if edge[path, 1] < 0:
            before, after, cosines, joined, turn = edges.over_one(source[0], target[0], edge_1, t.wave_number)
        else:
            edge_2 = _edge(t, edge[path, 1])
            before, after, cosines, joined, turn = edges.over_two(
                source[0], target[0], edge_1, edge_2, _three(vertices[path, 1]), _three(vertices[path, 2]),
                shared[path, 0], shared[path, 1], t.wave_number,
            )  # fmt: skip
        _elements(
            t, source, edge_1, (before, 1.0), cosines[0], ground[path, 0],
            (t.tower_m[q], t.tower_slant[q], e_tower[path % len(e_tower)]), (sent, here),
        )  # fmt: skip
        _elements(
            t, target, edge_2, (after, -1.0), cosines[1], ground[path, 1],
            (t.uav_m, t.uav_slant, e_uav[path % len(e_uav)]), (caught, there),
        )  # fmt: skip
        for j in range(uavs):
            u = turn[0] + turn[1] * there[0, j] + turn[2] * there[1, j]
            v = turn[3] + turn[4] * there[0, j] + turn[5] * there[1, j]
            b = (caught[0, j] * joined[0] + caught[1, j] * joined[2]) * lost[path]
            c = (caught[0, j] * joined[1] + caught[1, j] * joined[3]) * lost[path]
            for i in range(ports):
                a = b * sent[0, i] + c * sent[1, i]
                k = j * ports + i
                w[0, k], w[1, k], w[2, k], w[3, k] = u - here[0, i], v + here[1, i], a.real, a.imag
        _pairs(w, turns)
        link = p * len(t.source) + q
        for k in range(uavs * ports):
            power[link] += (w[2, k] * w[2, k] + w[3, k] * w[3, k]) / (uavs * ports)
        if path + 1 == len(pose) or pose[path + 1] != p or tower[path + 1] != q:
            for k in range(uavs * ports):
                h[link, k // ports, k % ports] += complex(w[4, k], w[5, k])
            w[4:] = 0.0


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

    columns = (paths.pose, paths.tower, paths.edge, paths.shared, paths.ground, paths.vertices_m)
    fields = (np.empty((1, 0, 1)) if e is None else e for e in ends)
    _add(Tables._make(map(writable, tables)), *map(writable, columns), *fields, lost, h, power)


def try_out() -> None:
    """Compile, or read what was compiled before, and sum no paths.

    Raises
    ------
    RuntimeError
        If they add up to something.
    """
    none = np.zeros((0, 3))
    tables = Tables(
        start=none, along=none, inward=np.zeros((0, 2, 3)), out=none, exterior=np.zeros(0),
        face=np.zeros((0, 2), np.int64), normal=np.zeros((1, 3)), offset=np.zeros(1), material=np.zeros((1, 3)),
        source=none, tower_axes=np.zeros((0, 3, 3)), place=none, axes=np.zeros((0, 3, 3)),
        tower_m=np.zeros((0, 3, 1)), tower_slant=np.zeros((0, 2, 1)), uav_m=np.zeros((3, 1)),
        uav_slant=np.zeros((2, 1)), wave_number=1.0,
    )  # fmt: skip
    paths = EdgePaths.of(np.zeros((0, 8), np.int64), np.zeros((0, 4, 3)))
    h = np.zeros((1, 1, 1), np.complex128)
    add(tables, paths, [None, None], np.zeros(0), h, np.zeros(1))
    if h[0, 0, 0] != 0.0:
        raise RuntimeError(f"no path over an edge adds {h[0, 0, 0]}")
