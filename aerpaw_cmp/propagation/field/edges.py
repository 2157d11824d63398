"""Complex amplitudes of paths over an edge, for every pair of elements.

The length is that of each pair of elements; the diffraction matrix is that of the array centres, as the paths are
those of the centres: the field stays continuous where a direct or reflected path of the centres ends.
"""

from __future__ import annotations

import numpy as np

from ..common.units import ComplexArray, FloatArray, IntArray, wavelength_m
from .arrays import Array, Link, Poses
from .channel import FaceMaterials, radiate, reflect, reflection_coefficients
from .edges import EdgePaths, Edges
from .paths import Faces
from .wedge import Fresnel, wedge_matrix


def edge_field(
    paths: EdgePaths,
    rows: IntArray,
    geometry: tuple[Faces, Edges, FaceMaterials],
    source_m: FloatArray,
    array: Array,
    poses: Poses,
    link: Link,
) -> ComplexArray:
    """Complex amplitudes of some paths of one tower over an edge.

    Parameters
    ----------
    paths : EdgePaths
    rows : (rows,) int
        Which of them.
    geometry : Faces, Edges, FaceMaterials
        Of the scene, at the carrier of the link.
    source_m : (3,)
        Centre of the tower's array [m].
    array : Array
        Of the tower.
    poses : Poses
    link : Link

    Returns
    -------
    (rows, uav elements, tower elements) complex

    Notes
    -----
    ``g_u . M_2 D M_1 . g_t  lambda / (4 pi) / sqrt(k s s' (s + s')) e^{-j k (s + s')}`` with s' and s the lengths before
    and after the edge, D the diffraction matrix times the square root of k, and M the reflections off the ground.
    """
    faces, edges, tables = geometry
    edge, k = paths.edge[rows], 2.0 * np.pi / wavelength_m(link.carrier_hz)
    turn = poses.rotation[paths.pose[rows]] @ link.uav_array.mount
    centre = poses.position_m[paths.pose[rows]]
    normals = [np.where((index >= 0)[:, None], faces.normal[index], 0.0) for index in paths.ground[rows].T]
    offsets = [np.where(index >= 0, faces.offset_m[index], 0.0) for index in paths.ground[rows].T]
    start = source_m + array.positions_m @ array.mount.T
    ends = centre[:, None] + link.uav_array.positions_m @ turn.transpose(0, 2, 1)
    # in the space where the ground's mirror images stand in for bent legs the path is source - edge - target
    images = [
        _image(np.broadcast_to(start, (len(rows), *start.shape)), normals[0], offsets[0]),
        _image(ends, normals[1], offsets[1]),
        _image(np.broadcast_to(source_m, (len(rows), 1, 3)), normals[0], offsets[0]),
        _image(centre[:, None], normals[1], offsets[1]),
    ]
    tower, uav, here, there = (_cylinder(edges, edge, points) for points in images)
    length = np.hypot(uav[0][:, :, None] + tower[0][:, None], uav[2][:, :, None] - tower[2][:, None])
    reach = here[0] + there[0]
    whole = np.hypot(reach, there[2] - here[2])[:, 0]
    sine, cosine = reach[:, 0] / whole, (there[2] - here[2])[:, 0] / whole
    matrix = _matrices(edges, edge, tables, (here, there), cosine, k * (here[0] * there[0])[:, 0] / whole, link)
    point = paths.vertices_m[rows, 1]
    before, after = (_unit(v) for v in (point - images[2][:, 0], images[3][:, 0] - point))
    leaving = _flip(before, normals[0])
    wave = radiate(array, np.broadcast_to(array.mount, (len(rows), 3, 3)), leaving.T[:, :, None, None], 3)
    wave = _off_ground(wave, leaving, normals[0], paths.ground[rows, 0], tables, link)
    along = edges.along[edge]
    into = np.stack([along - cosine[:, None] * before, np.cross(along, before)]) / sine[:, None]
    out = np.stack([along - cosine[:, None] * after, np.cross(along, after)]) / sine[:, None]
    wave = np.einsum("arv,rab,brw,wrij->vrij", out, matrix, into, wave, optimize=True)
    wave = _off_ground(wave, after, normals[1], paths.ground[rows, 1], tables, link)
    arriving = _flip(after, normals[1])
    heard = radiate(link.uav_array, turn, -arriving.T[:, :, None, None], 2)
    near, far = here[0][:, 0] / sine, there[0][:, 0] / sine
    spread = 1.0 / (2.0 * np.sqrt(k * near * far)) / k  # lambda / 4 pi = 1 / 2k
    amplitude = spread[:, None, None] / np.sqrt(length)
    cycles = length * (k / (2.0 * np.pi))
    return np.asarray((heard * wave).sum(axis=0) * amplitude * np.exp(-2j * np.pi * (cycles - np.round(cycles))))


def _matrices(
    edges: Edges,
    edge: IntArray,
    tables: FaceMaterials,
    ends: tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]],
    cosine: FloatArray,
    distance: FloatArray,
    link: Link,
) -> ComplexArray:
    """Diffraction matrices (rows, 2, 2) at the array centres."""
    wavelength = wavelength_m(link.carrier_hz)

    def fresnel(face: IntArray) -> Fresnel:
        return lambda c: reflection_coefficients(c, tables.permittivity[face], tables.thickness_m[face], wavelength)

    face = edges.face[edge]
    angles = [np.mod(end[1][:, 0], 2.0 * np.pi) for end in ends]
    return wedge_matrix(
        angles[0], angles[1], cosine, edges.exterior[edge], distance, fresnel(face[:, 0]), fresnel(face[:, 1])
    )


def _cylinder(edges: Edges, edge: IntArray, points_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Radius, angle and place along the edge (rows, points) of points (rows, points, 3)."""
    local = edges.coordinates(points_m.transpose(1, 0, 2), edge).transpose(1, 0, 2)
    return np.hypot(local[..., 1], local[..., 2]), np.arctan2(local[..., 2], local[..., 1]), local[..., 0]


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def _flip(vector: FloatArray, normal: FloatArray) -> FloatArray:
    """Directions (rows, 3) mirrored at planes; as they are where the normal is zero."""
    return np.asarray(vector - 2.0 * (vector * normal).sum(axis=1)[:, None] * normal)


def _image(points_m: FloatArray, normal: FloatArray, offset: FloatArray) -> FloatArray:
    """Points (rows, points, 3) mirrored in planes (rows,); as they are where the normal is zero."""
    height = np.einsum("rpi,ri->rp", points_m, normal) - offset[:, None]
    return np.asarray(points_m - 2.0 * height[..., None] * normal[:, None])


def _off_ground(
    wave: ComplexArray, direction: FloatArray, normal: FloatArray, ground: IntArray, tables: FaceMaterials, link: Link
) -> ComplexArray:
    """The wave (3, rows, uav, tower) after a reflection that arrives along ``direction``."""
    arriving, upright = direction.T[:, :, None, None], normal.T[:, :, None, None]
    return reflect(wave, arriving, upright, ground, tables, wavelength_m(link.carrier_hz))
