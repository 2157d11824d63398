"""Geometry of paths and arrays for the field, as columns: the space of the last image, elements spread over pairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.units import AnyArray, ComplexArray, FloatArray, IntArray
from ...site.antennas import Isotropic
from ..geometry import Array, Faces, Link, PathSet, Pattern, Poses, sources_of
from . import dyads


class Geometry(NamedTuple):
    """Some paths, each in the space of its last image.

    ``image_m`` (paths, 3) is the tower there, ``frame`` (paths, 3, 3) its device axes as rows, ``normal`` (paths, most,
    3) those of the faces and ``face`` (paths, most, 3) the row of :func:`face_table` of each; ``place_m`` and
    ``axes`` are the UAV's. ``depth`` and ``tower`` (paths,) are those of the path set.
    """

    image_m: FloatArray
    frame: FloatArray
    normal: FloatArray
    face: FloatArray
    depth: IntArray
    tower: IntArray
    place_m: FloatArray
    axes: FloatArray

    def some(self, rows: AnyArray | slice) -> Geometry:
        """Those of a mask, of indices or of a slice."""
        return Geometry._make(column[rows] for column in self)


class Elements(NamedTuple):
    """Elements of both ends, spread over the pairs of a link: pair p joins UAV element p // ports and port p % ports.

    Places (towers, 3, pairs) and (3, pairs) in the devices [m]; cosine and sine of the slants (towers, 2, pairs) and
    (2, pairs).
    """

    tower_m: FloatArray
    tower_slant: FloatArray
    uav_m: FloatArray
    uav_slant: FloatArray

    @classmethod
    def of(cls, link: Link) -> Elements:
        """The elements of a link whose towers have one number of ports."""
        arrays, uav = list(link.tower_arrays.values()), link.uav_array
        pair = np.arange(len(arrays[0]) * len(uav))
        port, element = pair % len(arrays[0]), pair // len(arrays[0])
        towers = [_columns(array, port) for array in arrays]
        return cls(np.stack([t[0] for t in towers]), np.stack([t[1] for t in towers]), *_columns(uav, element))


def _columns(array: Array, element: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return places (3, pairs) and slants (2, pairs) of chosen elements."""
    return np.ascontiguousarray(array.positions_m[element].T), np.ascontiguousarray(array.slant_parts[:, element])


# Pattern fields of tower and UAV; None for 1 along theta in all directions.
Ends = tuple[ComplexArray | None, ComplexArray | None]


def geometry(
    paths: PathSet, faces: Faces, table: FloatArray, sources_m: FloatArray, poses: Poses, link: Link
) -> Geometry:
    """Return columns of some paths.

    Parameters
    ----------
    paths : PathSet
    faces : Faces
    table : (faces + 1, 3)
        Their materials: :func:`face_table`.
    sources_m : (towers, 3) or (poses, towers, 3)
        Centres of the tower arrays [m]; the latter for towers that move.
    poses : Poses
    link : Link

    Returns
    -------
    Geometry
    """
    depth = int(paths.depth.max(initial=0))
    sequence = paths.faces[:, :depth]
    mounts = np.stack([array.mount.T for array in link.tower_arrays.values()])
    image = sources_of(paths, sources_m)
    frame = mounts[paths.tower]
    normals = np.where((sequence >= 0)[..., None], faces.normal[sequence], 0.0)
    for step in range(depth):
        normal = normals[:, step]  # a zero normal means no face: the point is not mirrored
        offset = np.where(sequence[:, step] >= 0, faces.offset_m[sequence[:, step]], 0.0)
        image = image - 2.0 * ((image * normal).sum(axis=1) - offset)[:, None] * normal
        # mirror earlier faces, too, because the last image sees their mirror images
        for vectors in (frame, normals[:, :step]):
            # in place, because frame and normals are copies
            vectors -= 2.0 * np.einsum("nij,nj->ni", vectors, normal)[..., None] * normal[:, None, :]
    # rotate only arrays of poses between the first and last of these paths
    first, last = paths.pose.min(initial=len(poses)), paths.pose.max(initial=0)
    axes = np.einsum("nij,jk->nki", poses.rotation[first : last + 1], link.uav_array.mount)
    return Geometry(
        image_m=image,
        frame=frame,
        normal=normals,
        face=table[sequence],
        depth=paths.depth,
        tower=paths.tower,
        place_m=poses.position_m[paths.pose],
        axes=axes[paths.pose - first],
    )


def rows_of(matrix: FloatArray) -> dyads.Rotation:
    """Return rotations (n, 3, 3) in the form that the formulas take, for broadcasting with (n, pairs)."""
    return tuple(tuple(matrix[:, i, j, None] for j in range(3)) for i in range(3))  # type: ignore[return-value]


def parts_of(vector: AnyArray) -> dyads.Vector:
    """Return vectors (n, 3) in the form that the formulas take, for broadcasting with (n, pairs)."""
    return vector[:, 0, None], vector[:, 1, None], vector[:, 2, None]


def directions(g: Geometry, elements: Elements) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return unit vectors and lengths (paths, pairs) from the towers' images to the UAV."""
    tower_m = elements.tower_m[g.tower]
    ways = dyads.direction(
        parts_of(g.image_m), rows_of(g.frame), (tower_m[:, 0], tower_m[:, 1], tower_m[:, 2]),
        parts_of(g.place_m), rows_of(g.axes), tuple(elements.uav_m),  # type: ignore[arg-type]
    )  # fmt: skip
    return ways  # type: ignore[no-any-return]


def pattern_fields(array: Array, element: IntArray, m: dyads.Rotation, toward: dyads.Vector) -> ComplexArray:
    """Return E_theta and E_phi (paths, 2, pairs) of chosen elements ``toward`` site directions.

    Parameters
    ----------
    array : Array
    element : (pairs,) int
    m : Rotation
        Device axes as rows.
    toward : Vector
        Unit vectors (paths, pairs) away from the device.

    Returns
    -------
    (paths, 2, pairs) complex
    """
    x, y, z = dyads.turned(m, toward)
    theta, phi = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)  # arccos would lose half of the digits at the poles
    fields = np.empty((len(theta), 2, theta.shape[1]), dtype=np.complex128)
    patterns = array.patterns if len(array.patterns) > 1 else array.patterns * len(array)
    # elements often share one pattern object: evaluate it once for all of them
    for pattern in {id(p): p for p in patterns}.values():
        pairs = np.flatnonzero([patterns[e] is pattern for e in element])
        fields[:, 0, pairs], fields[:, 1, pairs] = pattern.field(theta[:, pairs], phi[:, pairs])
    return fields


def plain(patterns: tuple[Pattern, ...]) -> bool:
    """Check whether every pattern is 1 along theta in all directions. Subclasses of Isotropic are excluded."""
    return all(type(pattern) is Isotropic for pattern in patterns)
