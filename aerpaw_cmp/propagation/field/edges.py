"""Complex amplitudes of paths over edges, for every pair of elements.

As with reflections a bent leg is straight in the space of the mirrored end, and over an edge a path is straight once
both legs are turned into one plane: places of elements in that plane give the length of each pair. Directions, patterns
and the diffraction matrix are those of the array centres, as the paths are: the field stays continuous where a direct
or reflected path of the centres ends. Small jobs run in NumPy, large ones in
:mod:`aerpaw_cmp.propagation.field.edge_kernels`, by the same laws.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...common.units import ComplexArray, FloatArray, IntArray, amplitude_from_db, wavelength_m
from .. import compiled
from ..arrays import Link, Poses
from ..edges import EdgePaths, Edges
from ..paths import Faces
from . import dyads
from .dyads import Number, Rotation, Vector
from .fresnel import FaceMaterials, coefficients
from .geometry import parts_of, pattern_fields, plain, rows_of
from .sum import parts_between_poses
from .wedge import along_face, at_face, coupled, wedge

PATHS_PER_CHUNK = 4096


class Tables(NamedTuple):
    """Edges, mirrors and ends as the laws take them, a row each.

    ``edge`` (edges, 22): start, direction, axes of faces 0 and n, normal of face 0, exterior angle, materials of faces
    0 and n. ``mirror`` (faces + 1, 7): normal, offset, material; the last stands for no face. ``source`` (towers, 12)
    and ``target`` (poses, 12): place and axes. Places (towers or 1, 3, elements) and slants (towers or 1, 2, elements).
    """

    edge: FloatArray
    mirror: FloatArray
    source: FloatArray
    target: FloatArray
    tower_m: FloatArray
    tower_slant: FloatArray
    uav_m: FloatArray
    uav_slant: FloatArray
    wave_number: float

    @classmethod
    def of(cls, edges: Edges, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link) -> Tables:
        """Tables of a replay.

        Parameters
        ----------
        edges : Edges
        faces : Faces
        sources_m : (towers, 3)
        poses : Poses
        link : Link

        Returns
        -------
        Tables
        """
        wavelength = wavelength_m(link.carrier_hz)
        arrays, uav = list(link.tower_arrays.values()), link.uav_array
        material = FaceMaterials.of(faces, link.carrier_hz).table(wavelength)
        inward_n = np.cross(edges.along, edges.normal_n)
        lines = edges.start_m, edges.along, edges.face_axis, inward_n, edges.normal, edges.exterior[:, None]
        axes = np.einsum("nij,jk->nki", poses.rotation, uav.mount)
        mounts = np.stack([array.mount.T for array in arrays])
        return cls(
            edge=np.hstack([*lines, *(material[edges.face[:, side]] for side in (0, 1))]),
            mirror=np.column_stack([np.vstack([faces.normal, np.zeros(3)]), np.append(faces.offset_m, 0.0), material]),
            source=np.hstack([sources_m, mounts.reshape(-1, 9)]),
            target=np.hstack([poses.position_m, axes.reshape(-1, 9)]),
            tower_m=np.stack([array.positions_m.T for array in arrays]),
            tower_slant=np.stack([array.slant_parts for array in arrays]),
            uav_m=uav.positions_m.T[None],
            uav_slant=uav.slant_parts[None],
            wave_number=2.0 * np.pi / wavelength,
        )


def edge_channels(
    paths: EdgePaths, edges: Edges, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link,
    loss_db: FloatArray | None, threads: int | None,
) -> tuple[ComplexArray, FloatArray]:  # fmt: skip
    """Contribution of paths over edges to the channel matrices.

    Parameters
    ----------
    paths : EdgePaths
        Sorted by pose and tower.
    edges : Edges
    faces : Faces
        Of the scene.
    sources_m : (towers, 3)
        Centres of the tower arrays, in the order of ``link.tower_arrays`` [m].
    poses : Poses
    link : Link
    loss_db : (paths,) or None
        Further loss of each path, such as foliage.
    threads : int or None
        Of compiled code.

    Returns
    -------
    h : (poses, towers, n_rx, n_tx) complex
    power : (poses, towers)
        Sum over paths of the mean of ``|h|^2`` over element pairs.
    """
    tables = Tables.of(edges, faces, sources_m, poses, link)
    shape = (len(poses), len(sources_m))
    uavs, ports = tables.uav_m.shape[2], tables.tower_m.shape[2]
    h = np.zeros((shape[0] * shape[1], uavs, ports), dtype=np.complex128)
    power = np.zeros(len(h))
    lost = np.ones(len(paths)) if loss_db is None else amplitude_from_db(-loss_db)
    kernels = compiled.edge_field_for(len(paths))

    def run(part: slice) -> None:
        some = paths.select(part)
        if kernels is not None:
            kernels.add(tables, some, pattern_ends(some, tables, link), lost[part], h, power)
            return
        amplitude = amplitudes(some, tables, link) * lost[part, None, None]
        key = some.pose * shape[1] + some.tower
        first = np.flatnonzero(np.diff(key, prepend=-1))
        h[key[first]] = np.add.reduceat(amplitude, first, axis=0)
        power[key[first]] = np.add.reduceat((np.abs(amplitude) ** 2).mean(axis=(1, 2)), first)

    many, workers = (PATHS_PER_CHUNK, 1) if kernels is None else (4 * PATHS_PER_CHUNK, threads)
    compiled.in_threads(run, parts_between_poses(paths.pose, many), workers)
    matrices = h.swapaxes(1, 2) if link.uav_transmits else h
    return np.ascontiguousarray(matrices).reshape(*shape, *matrices.shape[1:]), power.reshape(shape)


def amplitudes(paths: EdgePaths, tables: Tables, link: Link) -> ComplexArray:
    """Complex amplitudes (paths, uav elements, tower elements) of paths.

    Parameters
    ----------
    paths : EdgePaths
    tables : Tables
    link : Link

    Returns
    -------
    (paths, uav elements, tower elements) complex

    Notes
    -----
    ``g_u . M_2 D M_1 . g_t  lambda / (4 pi) / sqrt(k s s' (s + s')) e^{-j k (s + s')}`` with s' and s the lengths
    before and after the edge, D the diffraction matrix times the square root of k, and M the dyads of mirrors.
    """
    out = np.empty((len(paths), tables.uav_m.shape[2], tables.tower_m.shape[2]), dtype=np.complex128)
    fields = pattern_ends(paths, tables, link)
    for double in (False, True):
        rows = np.flatnonzero((paths.edge[:, 1] >= 0) == double)
        if len(rows):
            out[rows] = _alike(paths.select(rows), tables, [None if f is None else f[rows] for f in fields], double)
    return out


def _alike(paths: EdgePaths, t: Tables, fields: list[FloatArray | None], double: bool) -> ComplexArray:
    """Amplitudes of paths that all cross one edge, or all two."""
    first, last = paths.edge[:, 0], paths.edge[:, 1 if double else 0]
    source, target = (_end(paths, t, side) for side in (0, 1))
    edge_1, edge_2 = (_edge(t, e) for e in (first, last))
    if double:
        before, after, cosines, joined, turn = over_two(
            source[0], target[0], edge_1, edge_2, parts_of(paths.vertices_m[:, 1]), parts_of(paths.vertices_m[:, 2]),
            (paths.shared[:, 0, None], paths.shared[:, 1, None]), t.wave_number,
        )  # fmt: skip
    else:
        before, after, cosines, distance, spread, angles = over_one(source[0], target[0], edge_1, t.wave_number)
        bb, bp, pp = wedge(angles[0], angles[1], cosines[0], edge_1[5], distance, edge_1[6], edge_1[7])
        joined, turn = (bb * spread, bp * spread, -bp * spread, pp * spread), _STRAIGHT
    parts = []
    for side, (end, edge, way) in enumerate(((source, edge_1, before), (target, edge_2, after))):
        mirrors = coefficients(dyads.incidence(way, end[2]), parts_of(t.mirror[paths.ground[:, side], 4:]))
        mirror = end[2], (paths.ground[:, side] >= 0)[:, None], mirrors
        pattern = (1.0, 0.0, 0.0, 0.0) if fields[side] is None else tuple(fields[side].swapaxes(0, 1))  # type: ignore[union-attr]
        units = end_parts(end[1], (way, 1.0 - 2.0 * side), mirror, edge[1], cosines[side])
        b_re, b_im, p_re, p_im = element_parts(units, pattern, (end[4][..., 0, :], end[4][..., 1, :]))
        parts.append((b_re + 1j * b_im, p_re + 1j * p_im))
    u_s, v_s = _in_edge(source, edge_1)
    along, radius = _in_edge(target, edge_2)
    u_t, v_t = turn[0] + turn[1] * along + turn[2] * radius, turn[3] + turn[4] * along + turn[5] * radius
    total = np.hypot(u_t[:, :, None] - u_s[:, None, :], v_t[:, :, None] + v_s[:, None, :])
    # whole cycles go before the exponential: at 1 km they would take five digits of the phase
    cycles = total * (t.wave_number / (2.0 * np.pi))
    carrier = np.exp(-2j * np.pi * (cycles - np.round(cycles))) / np.sqrt(total)
    (b_in, p_in), (b_out, p_out) = parts
    b_mid, p_mid = joined[0] * b_in + joined[1] * p_in, joined[2] * b_in + joined[3] * p_in
    return np.asarray((b_out[:, :, None] * b_mid[:, None, :] + p_out[:, :, None] * p_mid[:, None, :]) * carrier)


def _end(paths: EdgePaths, t: Tables, side: int) -> tuple[Vector, Rotation, Vector, FloatArray, FloatArray]:
    """An end of paths in the space where its leg is straight: centre, axes, normal of its mirror; elements, slants."""
    mirror = t.mirror[paths.ground[:, side]]
    row = t.target[paths.pose] if side else t.source[paths.tower]
    normal = parts_of(mirror[:, :3])
    centre = mirrored(parts_of(row[:, :3]), normal, mirror[:, 3, None])
    turned = tuple(mirrored(axis, normal, 0.0) for axis in rows_of(row[:, 3:].reshape(-1, 3, 3)))
    if side:
        return centre, turned, normal, t.uav_m, t.uav_slant  # type: ignore[return-value]
    return centre, turned, normal, t.tower_m[paths.tower], t.tower_slant[paths.tower]  # type: ignore[return-value]


def _edge(t: Tables, edge: IntArray) -> Any:
    """Edges (paths,) as the laws take them: start, direction, both faces' axes, normal of face 0, angle, materials."""
    row = t.edge[edge]
    vectors = [parts_of(row[:, k : k + 3]) for k in (0, 3, 6, 9, 12, 16, 19)]
    return (*vectors[:5], row[:, 15, None], *vectors[5:])


def _in_edge(end: Any, edge: Any) -> tuple[FloatArray, FloatArray]:
    return element_place(end[0], end[1], tuple(end[3][..., axis, :] for axis in range(3)), edge)  # type: ignore[return-value]


def pattern_ends(paths: EdgePaths, t: Tables, link: Link) -> list[FloatArray | None]:
    """Pattern fields (paths, 4, elements) of both ends along the paths of the centres; None for 1 along theta.

    Parameters
    ----------
    paths : EdgePaths
    t : Tables
    link : Link

    Returns
    -------
    list of (paths, 4, elements) or None
        Of towers and UAV.
    """
    arrays, uav = list(link.tower_arrays.values()), link.uav_array
    fields: list[FloatArray | None] = [None, None]
    last = np.where(np.isfinite(paths.vertices_m[:, 2, :1]), paths.vertices_m[:, 2], paths.vertices_m[:, 1])
    for side, corner in enumerate((paths.vertices_m[:, 1], last)):
        if all(plain(array.patterns) for array in ((uav,) if side else arrays)):
            continue
        centre, axes, *_ = _end(paths, t, side)
        way = unit(centre, parts_of(corner))
        columns = np.empty((len(paths), 4, len(uav if side else arrays[0])))
        for tower, array in enumerate((uav,) if side else arrays):
            rows = slice(None) if side else np.flatnonzero(paths.tower == tower)
            turned = tuple(tuple(part[rows] for part in axis) for axis in axes)
            spread = tuple(np.repeat(part[rows], len(array), axis=1) for part in way)
            columns[rows] = pattern_fields(array, np.arange(len(array)), turned, spread)  # type: ignore[arg-type]
        fields[side] = columns
    return fields


# ------------------------------------------------------------------------------- laws, of numbers or of arrays


def dot(a: Vector, b: Vector) -> Number:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def distance(start: Vector, end: Vector) -> Number:
    """Distance between two points."""
    return np.sqrt((end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2 + (end[2] - start[2]) ** 2)


def unit(start: Vector, end: Vector) -> Vector:
    """Unit vector from one point to another."""
    x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    scale = 1.0 / np.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


def mirrored(point: Vector, normal: Vector, offset: Number) -> Vector:
    """A point mirrored in a plane, or with offset 0 a vector; as it is where the normal is zero."""
    twice = 2.0 * (dot(point, normal) - offset)
    return point[0] - twice * normal[0], point[1] - twice * normal[1], point[2] - twice * normal[2]


def round_edge(point: Vector, edge: Any) -> Vector:
    """Coordinates of a point round an edge: along it, in face 0 away from it, out of face 0."""
    x = point[0] - edge[0][0], point[1] - edge[0][1], point[2] - edge[0][2]
    return dot(x, edge[1]), dot(x, edge[2]), dot(x, edge[4])


def element_place(centre: Vector, axes: Rotation, element: Vector, edge: Any) -> tuple[Number, Number]:
    """Place of an element along an edge and its distance from it [m].

    Parameters
    ----------
    centre, axes : Vector, Rotation
        Of the array, where its leg is straight.
    element : Vector
        In the array [m].
    edge : tuple

    Returns
    -------
    along, radius : Number
    """
    x, y, z = dyads.turned_back(axes, element)
    along, down, out = round_edge((centre[0] + x, centre[1] + y, centre[2] + z), edge)
    return along, np.sqrt(down * down + out * out)


def angle_round(place: Vector) -> Number:
    """Angle of a point round an edge from face 0 [rad]."""
    angle = dyads.arctangent(place[2], place[1])
    return dyads.select(angle < 0.0, angle + 2.0 * np.pi, angle)


def end_parts(axes: Rotation, way: Any, mirror: Any, along: Vector, cosine: Number) -> Any:
    """Unit fields along theta and phi of a device over its leg, in the edge-fixed basis times the sine with the edge.

    Parameters
    ----------
    axes : Rotation
        Device axes in the space where the leg is straight.
    way : (Vector, Number)
        Direction of the wave, and 1 at the source, -1 at the target, which radiates against it.
    mirror : tuple
        Normal of the leg's mirror, whether there is one, and its coefficients TE and TM (four real numbers).
    along : Vector
        Direction of the edge.
    cosine : Number
        Of the angle between ray and edge.

    Returns
    -------
    tuple of 8 Number
        Real and imaginary parts of theta's field along beta and phi, then of phi's.
    """
    (x, y, z), sign = way
    toward = sign * x, sign * y, sign * z
    flat = along[0] - cosine * x, along[1] - cosine * y, along[2] - cosine * z
    cross = along[1] * z - along[2] * y, along[2] * x - along[0] * z, along[0] * y - along[1] * x
    theta = after_mirror(dyads.field_vector(axes, toward, 1.0, 0.0), way[0], mirror)
    phi = after_mirror(dyads.field_vector(axes, toward, 0.0, 1.0), way[0], mirror)
    return (
        dot(theta[0], flat), dot(theta[1], flat), dot(theta[0], cross), dot(theta[1], cross),
        dot(phi[0], flat), dot(phi[1], flat), dot(phi[0], cross), dot(phi[1], cross),
    )  # fmt: skip


def after_mirror(wave: Vector, way: Vector, mirror: Any) -> tuple[Vector, Vector]:
    """Real and imaginary part of a real field vector after the mirror of its leg, or as it is."""
    normal, bounced, (te_re, te_im, tm_re, tm_im) = mirror
    re, im = dyads.reflected(wave, (0.0, 0.0, 0.0), way, normal, te_re, te_im, tm_re, tm_im)
    x, y, z = wave
    return (
        (dyads.select(bounced, re[0], x), dyads.select(bounced, re[1], y), dyads.select(bounced, re[2], z)),
        (dyads.select(bounced, im[0], 0.0), dyads.select(bounced, im[1], 0.0), dyads.select(bounced, im[2], 0.0)),
    )


def element_parts(parts: Any, field: Any, slant: Any) -> tuple[Number, Number, Number, Number]:
    """Field of an element along beta and phi (re, im each) from those of unit fields, its pattern and its slant."""
    a_re, c_re = dyads.slant_rotation(field[0], field[2], slant[0], slant[1])
    a_im, c_im = dyads.slant_rotation(field[1], field[3], slant[0], slant[1])
    return (
        a_re * parts[0] - a_im * parts[1] + c_re * parts[4] - c_im * parts[5],
        a_re * parts[1] + a_im * parts[0] + c_re * parts[5] + c_im * parts[4],
        a_re * parts[2] - a_im * parts[3] + c_re * parts[6] - c_im * parts[7],
        a_re * parts[3] + a_im * parts[2] + c_re * parts[7] + c_im * parts[6],
    )


def over_one(source: Vector, target: Vector, edge: Any, wave_number: float) -> Any:
    """A path over one edge between array centres.

    Parameters
    ----------
    source, target : Vector
        Mirrored where their leg is bent.
    edge : tuple
        Start, direction, axes of faces 0 and n, normal of face 0, exterior angle, materials of faces 0 and n.
    wave_number : float

    Returns
    -------
    before, after : Vector
        Directions of the legs.
    cosines : (Number, Number)
        Of the angles between legs and edges.
    distance : Number
        As for :func:`aerpaw_cmp.propagation.field.wedge.wedge`.
    spread : Number
        Factor of the wedge's matrix, but for one over the root of the length.
    angles : (Number, Number)
        Of source and target round the edge [rad].
    """
    source_place, target_place = round_edge(source, edge), round_edge(target, edge)
    near, far = (
        np.sqrt(source_place[1] ** 2 + source_place[2] ** 2),
        np.sqrt(target_place[1] ** 2 + target_place[2] ** 2),
    )
    rise = target_place[0] - source_place[0]
    total = np.sqrt((near + far) ** 2 + rise * rise)
    sine, cosine = (near + far) / total, rise / total
    at, start, along = source_place[0] + rise * near / (near + far), edge[0], edge[1]
    point = start[0] + at * along[0], start[1] + at * along[1], start[2] + at * along[2]
    # lambda / (4 pi) = 1 / 2k; the legs are near / sine and far / sine long, both bases lack a factor 1 / sine
    spread = 1.0 / (2.0 * wave_number * sine * np.sqrt(wave_number * near * far))
    return (
        unit(source, point), unit(point, target), (cosine, cosine), wave_number * near * far / total, spread,
        (angle_round(source_place), angle_round(target_place)),
    )  # fmt: skip


# ``turn`` of :func:`over_two` for a path over one edge, whose legs lie in one plane as they are.
_STRAIGHT = (0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def over_two(
    source: Vector, target: Vector, edge_1: Any, edge_2: Any, point_1: Vector, point_2: Vector,
    shared: tuple[Number, Number], wave_number: float,
) -> Any:  # fmt: skip
    """A path over two edges of one plane face, along that face between them.

    Sources: Luebbers, IEEE Trans. Antennas Propag. 37 (1989) 206, doi 10.1109/8.18707 (slope term); Albani, Capolino,
    Maci and Tiberio, IEEE AP-S Symposium 1999, vol. 4, "Double diffraction at a pair of coplanar skew wedges".

    Parameters
    ----------
    source, target : Vector
    edge_1, edge_2 : tuple
    point_1, point_2 : Vector
        Where the path meets the edges.
    shared : tuple of 2 Number
        Which face of each edge the two share: 0, or 1 for face n.
    wave_number : float

    Returns
    -------
    before, after, cosines
        As of :func:`over_one`.
    joined : tuple of 4 complex
        Matrix over (after, before) and (beta, phi) with spreading, but for one over the root of the length.
    turn : tuple of 6 Number
        Place of a target element where the path is straight: ``turn[0] + turn[1] along + turn[2] radius`` and so on.

    Notes
    -----
    ``(S_1 (1 - W) + X H_1) (S_2 (1 - W) + X H_2) / (2 j k s) / k / sqrt(s_0 s s_2 (s_0 + s + s_2))`` for each
    polarisation, with :func:`at_face` (S and H by the height of the ray over the face), :func:`along_face` and, for
    the products, :func:`coupled`. On a perfect conductor that is half of two hard wedges, ``2 H_1 H_2``; on a face
    where waves cancel the slope carries on.
    """
    way, (shared_1, shared_2) = unit(point_1, point_2), shared
    gap = distance(point_1, point_2)
    source_place, target_place = round_edge(source, edge_1), round_edge(target, edge_2)
    near, far = (
        np.sqrt(source_place[1] ** 2 + source_place[2] ** 2),
        np.sqrt(target_place[1] ** 2 + target_place[2] ** 2),
    )
    cos_1, cos_2 = dot(way, edge_1[1]), dot(way, edge_2[1])
    sin_1, sin_2 = np.sqrt(1.0 - cos_1 * cos_1), np.sqrt(1.0 - cos_2 * cos_2)
    first, last = near / sin_1, far / sin_2
    on_n = shared_1 > 0
    material = (
        dyads.select(on_n, edge_1[7][0], edge_1[6][0]), dyads.select(on_n, edge_1[7][1], edge_1[6][1]),
        dyads.select(on_n, edge_1[7][2], edge_1[6][2]),
    )  # fmt: skip
    wedge_1 = at_face(
        np.abs(shared_1 * np.pi * edge_1[5] - angle_round(source_place)), edge_1[5],
        wave_number * first * gap * sin_1 * sin_1 / (first + gap), sin_1, first / distance(source, point_2), material,
    )  # fmt: skip
    wedge_2 = at_face(
        np.abs(shared_2 * np.pi * edge_2[5] - angle_round(target_place)), edge_2[5],
        wave_number * last * gap * sin_2 * sin_2 / (last + gap), sin_2, last / distance(point_1, target), material,
    )  # fmt: skip
    # matrices lack one factor 1 / sine each, bases another, and the height of a ray over the face gains one
    spread = 1.0 / (2.0 * wave_number**2 * (sin_1 * sin_2) ** 2 * np.sqrt(first * gap * last))
    # the bases of both edges lie in the face and across it: they differ by a sign
    spread = dyads.select(dot(edge_1[1], edge_2[1]) - cos_1 * cos_2 < 0.0, -spread, spread) / (2j * wave_number * gap)
    te, tm = along_face(wave_number * gap, material)
    coupling, conductor = np.sqrt(first * last / ((first + gap) * (gap + last))), 4j * wave_number * gap
    soft, (mixed_te, hard_te), (mixed_tm, hard_tm) = coupled(wedge_1, wedge_2, coupling)
    soft_te, soft_tm = 1.0 - te * te / conductor, 1.0 - tm * tm / conductor
    beta = spread * (soft_te * (soft_te * soft + te * mixed_te) + te * te * hard_te)
    phi = spread * (soft_tm * (soft_tm * soft + tm * mixed_tm) + tm * tm * hard_tm)
    joined = beta, 0.0 * beta, 0.0 * phi, phi
    inward_1, inward_2 = into_face(edge_1, shared_1), into_face(edge_2, shared_2)
    apart = edge_2[0][0] - edge_1[0][0], edge_2[0][1] - edge_1[0][1], edge_2[0][2] - edge_1[0][2]
    turn = (
        dot(apart, edge_1[1]), dot(edge_2[1], edge_1[1]), -dot(inward_2, edge_1[1]),
        dot(apart, inward_1), dot(edge_2[1], inward_1), -dot(inward_2, inward_1),
    )  # fmt: skip
    return unit(source, point_1), unit(point_2, target), (cos_1, cos_2), joined, turn


def into_face(edge: Any, shared: Number) -> Vector:
    """Unit vector in face 0 (``shared`` 0) or n (1) of an edge, away from it."""
    a, b, on_n = edge[2], edge[3], shared > 0
    return dyads.select(on_n, b[0], a[0]), dyads.select(on_n, b[1], a[1]), dyads.select(on_n, b[2], a[2])
