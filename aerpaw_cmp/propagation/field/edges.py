"""Complex amplitudes of paths over an edge, for every pair of elements.

As with reflections a bent leg is straight in the space of the mirrored end. The length is that of each pair of
elements. Directions, patterns and the diffraction matrix are those of the array centres, as the paths are: the field
stays continuous where a direct or reflected path of the centres ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.units import ComplexArray, FloatArray, IntArray, wavelength_m
from ..arrays import Array, Link, Poses
from ..edges import EdgePaths, Edges
from ..paths import Faces
from . import dyads
from .fresnel import FaceMaterials, reflection_coefficients
from .sum import radiated
from .wedge import Fresnel, wedge_matrix

PATHS_PER_CHUNK = 4096


def edge_channels(
    paths: EdgePaths,
    edges: Edges,
    faces: Faces,
    sources_m: FloatArray,
    poses: Poses,
    link: Link,
    loss_db: FloatArray | None = None,
) -> tuple[ComplexArray, FloatArray]:
    """What paths over edges add to the channel matrices.

    Parameters
    ----------
    paths : EdgePaths
    edges : Edges
    faces : Faces
        Of the scene.
    sources_m : (towers, 3)
        Centres of the tower arrays, in the order of ``link.tower_arrays`` [m].
    poses : Poses
    link : Link
    loss_db : (paths,), optional
        Further loss of each path, such as foliage.

    Returns
    -------
    h : (poses, towers, n_rx, n_tx) complex
    power : (poses, towers)
        Sum over paths of the mean of ``|h|^2`` over element pairs.
    """
    arrays = list(link.tower_arrays.values())
    ports, uavs = len(arrays[0]), len(link.uav_array)
    h = np.zeros((len(poses) * len(arrays), uavs, ports), dtype=np.complex128)
    power = np.zeros(len(poses) * len(arrays))
    for tower in range(len(arrays)):
        mine = np.flatnonzero(paths.tower == tower)
        for start in range(0, len(mine), PATHS_PER_CHUNK):
            rows = mine[start : start + PATHS_PER_CHUNK]
            some = amplitudes(paths.select(rows), edges, faces, sources_m, poses, link)
            if loss_db is not None:
                some *= 10.0 ** (-loss_db[rows] / 20.0)[:, None, None]
            key = paths.pose[rows] * len(arrays) + tower
            np.add.at(h, key, some)
            np.add.at(power, key, (np.abs(some) ** 2).mean(axis=(1, 2)))
    matrices = h.swapaxes(1, 2) if link.uav_transmits else h
    shape = (len(poses), len(arrays))
    return np.ascontiguousarray(matrices).reshape(*shape, *matrices.shape[1:]), power.reshape(shape)


def amplitudes(
    paths: EdgePaths, edges: Edges, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link
) -> ComplexArray:
    """Complex amplitudes (paths, uav elements, tower elements) of paths of one tower.

    Parameters
    ----------
    paths : EdgePaths
    edges : Edges
    faces : Faces
    sources_m : (towers, 3)
    poses : Poses
    link : Link

    Returns
    -------
    (paths, uav elements, tower elements) complex

    Notes
    -----
    ``g_u . M_2 D M_1 . g_t  lambda / (4 pi) / sqrt(k s s' (s + s')) e^{-j k (s + s')}`` with s' and s the lengths
    before and after the edge, D the diffraction matrix times the square root of k, and M the dyads of the ground.
    """
    array = list(link.tower_arrays.values())[paths.tower[0]]
    wavelength = wavelength_m(link.carrier_hz)
    k, tables = 2.0 * np.pi / wavelength, FaceMaterials.of(faces, link.carrier_hz)
    mount = np.broadcast_to(array.mount, (len(paths), 3, 3))
    here = _end(paths, 0, edges, faces, sources_m[paths.tower], mount, array)
    turn = poses.rotation[paths.pose] @ link.uav_array.mount
    there = _end(paths, 1, edges, faces, poses.position_m[paths.pose], turn, link.uav_array)
    point, edge = paths.vertices_m[:, 1], edges.along[paths.edge]
    before, after = _unit(point - here.centre_m), _unit(there.centre_m - point)
    sent = _off_ground(radiated(array, here.turn, before.T), before, here, tables, wavelength)
    caught = _off_ground(radiated(link.uav_array, there.turn, -after.T), after, there, tables, wavelength)
    near, far, rise = here.radius[:, 0], there.radius[:, 0], there.along[:, 0] - here.along[:, 0]
    total = np.hypot(near + far, rise)
    sine, cosine = (near + far) / total, rise / total
    matrix = wedge_matrix(
        here.angle, there.angle, cosine, edges.exterior[paths.edge], k * near * far / total,
        *(_fresnel(tables, face, wavelength) for face in edges.face[paths.edge].T),
    )  # fmt: skip
    into, out = (np.stack([edge - cosine[:, None] * way, np.cross(edge, way)], axis=1) for way in (before, after))
    joined = np.einsum("iru,rai,rab,rbj,jrt->rut", caught, out, matrix, into, sent, optimize=True)
    # into and out lack a factor 1 / sine each; the legs are near / sine and far / sine long
    spread = 1.0 / (2.0 * k * sine * np.sqrt(k * near * far))
    length = np.hypot(
        there.radius[:, 1:, None] + here.radius[:, None, 1:], there.along[:, 1:, None] - here.along[:, None, 1:]
    )
    cycles = length / wavelength
    carrier = np.exp(-2j * np.pi * (cycles - np.round(cycles)))
    return np.asarray(joined * spread[:, None, None] / np.sqrt(length) * carrier)


@dataclass(frozen=True, slots=True)
class _End:
    """One end of paths in the space where its leg is straight, and its place round the edge.

    ``radius, along`` (paths, 1 + elements) are of the centre, then of each element [m], ``angle`` (paths,) of the
    centre; ``normal`` (paths, 3) of the ground is zero where none reflects.
    """

    centre_m: FloatArray
    turn: FloatArray
    normal: FloatArray
    ground: IntArray
    radius: FloatArray
    along: FloatArray
    angle: FloatArray


def _end(
    paths: EdgePaths, side: int, edges: Edges, faces: Faces, centre_m: FloatArray, turn: FloatArray, array: Array
) -> _End:
    """Source (side 0) or target (1) of paths, mirrored in the ground where that reflects its leg."""
    ground = paths.ground[:, side]
    normal = np.where((ground >= 0)[:, None], faces.normal[ground], 0.0)
    height = (centre_m * normal).sum(axis=1) - np.where(ground >= 0, faces.offset_m[ground], 0.0)
    centre_m = centre_m - 2.0 * height[:, None] * normal
    turn = turn - 2.0 * np.einsum("ni,nj,njk->nik", normal, normal, turn)
    places = np.concatenate(
        [centre_m[:, None], centre_m[:, None] + array.positions_m @ turn.transpose(0, 2, 1)], axis=1
    )
    along, down, out = np.moveaxis(edges.coordinates(places, paths.edge), -1, 0)
    angle = np.mod(np.arctan2(out[:, 0], down[:, 0]), 2.0 * np.pi)
    return _End(
        centre_m=centre_m,
        turn=turn,
        normal=normal,
        ground=ground,
        radius=np.hypot(down, out),
        along=along,
        angle=angle,
    )


def _off_ground(
    wave: ComplexArray, toward: FloatArray, end: _End, tables: FaceMaterials, wavelength: float
) -> ComplexArray:
    """Field vectors (3, paths, elements) after the ground's dyad; as they are where no ground reflects."""
    ray, normal = (v.T[:, :, None] for v in (toward, end.normal))
    te, tm = _fresnel(tables, end.ground[:, None], wavelength)(dyads.incidence(tuple(ray), tuple(normal)))  # type: ignore[arg-type]
    re, im = dyads.reflected(
        tuple(wave.real), tuple(wave.imag), tuple(ray), tuple(normal), te.real, te.imag, tm.real, tm.imag  # type: ignore[arg-type]
    )  # fmt: skip
    after = np.stack([a + 1j * b for a, b in zip(re, im, strict=True)])
    return np.asarray(np.where((end.ground >= 0)[:, None], after, wave))


def _fresnel(tables: FaceMaterials, face: IntArray, wavelength: float) -> Fresnel:
    eta, thickness = tables.permittivity[face], tables.thickness_m[face]
    return lambda cosine: reflection_coefficients(cosine, eta, thickness, wavelength)


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector, axis=1, keepdims=True))
