"""Paths over one edge of a building: search, contribution to H, and description.

An edge is a line where two faces of a building meet at an exterior angle above 180 degrees: the rim of a flat roof, and
the vertical corners below it. A path runs from the source, or its image in the ground, to a point of the edge, and on
to the target or its image in the ground. At this point, both legs make the same angle with the edge (Keller's cone).
The path exists if the point is on the edge, both legs are free, and the point is not on a wall of another building or
inside one.

A reflected leg is straight in the space of the mirrored end. If both legs are rotated about the edge into one plane,
the complete path is straight. The positions of the elements in that plane determine the path length of each pair.
Paths, directions, patterns and the diffraction matrix are computed for the array centres. The field is therefore
continuous where a direct or reflected path between the centres ends.

The field behind an edge is computed by the uniform theory of diffraction.

Angles are measured around the edge from face 0, through air, to face n. The wedge fills the remaining angle, and its
exterior angle is ``n pi``. ``e`` is the unit vector along the edge for which ``(t, normal, e)`` is right-handed, where
``t`` lies in face 0 and points away from the edge, and ``normal`` points out of face 0. A wave that travels along ``s``
is written in the edge-fixed basis ``beta = (e - cos_beta s) / sin_beta``, ``phi = e x s / sin_beta``, before the edge
and after it. Time factor ``e^{+j omega t}``.

Sources: Kouyoumjian and Pathak, Proc. IEEE 62 (1974) 1448, doi 10.1109/PROC.1974.9651 (the coefficients and their
continuity); Luebbers, IEEE Trans. Antennas Propag. 32 (1984) 70, doi 10.1109/TAP.1984.1143189 (finite conductivity).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.special import wofz

from ..common.errors import UsageError
from ..common.geodesy import unit_vectors
from ..common.units import BoolArray, ComplexArray, FloatArray, IntArray, wavelength_m
from .field import dyads
from .field.fresnel import coefficients, face_table
from .field.sum import Fields, Further, parts_of, pattern_fields, plain, rows_of, summed
from .geometry import Array, Faces, Link, PathSet, Poses, legs, sources_of
from .scene import Scene
from .search.mirror import Occlusion, scene_tolerance_m


def wedge(
    phi_in: FloatArray, phi_out: FloatArray, cos_beta: FloatArray, exterior: FloatArray, distance: FloatArray,
    face_0: Any, face_n: Any,
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:  # fmt: skip
    """Return the diffraction matrix of a wedge in the edge-fixed basis.

    Source: Kouyoumjian and Pathak, Proc. IEEE 62 (1974), 1448-1461, doi:10.1109/PROC.1974.9651.

    Parameters
    ----------
    phi_in, phi_out : (...)
        Angles of source and target around the edge [rad], between 0 and ``exterior * pi``.
    cos_beta : (...)
        Cosine of the angle between ray and edge, the same on both sides (Keller's cone).
    exterior : (...)
        Exterior angle of the wedge over pi: 2 for a screen, 1.5 for the corner of a box.
    distance : (...)
        ``k s s' sin_beta^2 / (s + s')`` for a point source: the distance parameter times the wave number.
    face_0, face_n : tuple of 3 (...)
        Permittivity (real and imaginary part) and thickness in wavelengths of the two faces.

    Returns
    -------
    bb, bp, pp : (...) complex
        Elements (after, before) of the matrix over (beta, phi), times the square root of the wave number. The element
        (phi, beta) is ``-bp``. A wave of amplitude ``e^{-j k s'} / s'`` at the edge becomes
        ``matrix / sqrt(k) * sqrt(s' / (s (s + s'))) e^{-j k s}``.

    Notes
    -----
    ``-e^{-j pi/4} / (2 n sqrt(2 pi) sin_beta) [(T(pi + d) + T(pi - d)) I + T(pi + u) R_n + T(pi - u) R_0]`` with
    ``d = phi_out - phi_in``, ``u = phi_out + phi_in`` and ``T(x) = cot(x / 2n) F(2 distance cos^2(...))``
    (Kouyoumjian and Pathak, eq. 25). As in Luebbers' method, reflection matrices ``R`` of the faces replace the
    factors +1 and -1 of a perfect conductor. A perfectly conducting screen therefore has the original coefficients,
    and the sum with direct and reflected waves is continuous at any obliquity.
    """
    less, more = phi_out - phi_in, phi_out + phi_in
    shadow = edge_term(np.pi + less, exterior, distance) + edge_term(np.pi - less, exterior, distance)
    at_n, at_0 = edge_term(np.pi + more, exterior, distance), edge_term(np.pi - more, exterior, distance)
    upright, across = obliquity(phi_in, phi_out, exterior)
    # sine of the grazing angle, equal to the cosine from the normal in Fresnel's formulas
    sine = upright * np.sqrt(1.0 - cos_beta * cos_beta)
    # seen from face n, both the angles and the direction of the edge are reversed, so the matrix is the same
    (te_n, tm_n), (te_0, tm_0) = coefficients(sine, face_n), coefficients(sine, face_0)
    te, tm = at_n * te_n + at_0 * te_0, at_n * tm_n + at_0 * tm_0
    # angle between the edge-fixed basis and the plane of incidence, whose unit normal is sigma
    askew = cos_beta * upright  # multiplied, like across, by the sine of incidence: -(sigma . phi) and -(sigma . beta)
    size = across * across + askew * askew
    # for a ray along the edge, both components are zero, and any plane of incidence is valid
    weight = 1.0 / np.where(size == 0.0, 1.0, size)
    along, mixed, sideways = np.where(size == 0.0, 1.0, across * across * weight), across * askew * weight, askew**2
    sideways = sideways * weight
    # -e^{-j pi/4} / (2 sqrt(2 pi)) = (j - 1) / (4 sqrt(pi))
    scale = (1j - 1.0) * 0.25 / np.sqrt(np.pi) / (exterior * np.sqrt(1.0 - cos_beta * cos_beta))
    return (
        np.asarray(scale * (shadow + te * along - tm * sideways)),
        np.asarray(scale * (te + tm) * mixed),
        np.asarray(scale * (shadow + tm * along - te * sideways)),
    )


def obliquity(phi_in: FloatArray, phi_out: FloatArray, exterior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return sine and cosine of the assumed angle of incidence on the faces of a wedge, in the plane across the edge.

    The angle of incidence is only defined at the reflection boundary. Elsewhere this function assumes a mirror through
    the edge that sends the ray to the target. The angle on this mirror is half of ``pi - less``, and its sine is
    multiplied by a factor. The factor is 1 on both reflection boundaries (continuity), the same in both directions
    (reciprocity), and 0 if source or target lies in a face, where the field at a face that is not a perfect conductor
    vanishes.

    Parameters
    ----------
    phi_in, phi_out, exterior : (...)
        The same as in :func:`wedge`.

    Returns
    -------
    upright, across : (...)
        The sine is never negative. Otherwise, where the target enters the shadow, cos(less / 2) would change its sign,
        and the wave that a face converts from one polarisation into the other would jump.
    """
    less = phi_out - phi_in
    up, down = (np.abs(np.sin((np.pi + turn) / (2.0 * exterior))) for turn in (less, -less))
    # swapping source and target swaps ``up`` and ``down``, but not the smaller and the larger of the two
    near, far = np.minimum(up, down), np.maximum(up, down)
    # at the shadow boundary, cosine and ``near`` go to 0, and their ratio goes to the exterior angle over pi
    ratio = np.where(near < 1e-9, exterior, np.abs(np.cos(less / 2.0)) / np.maximum(near, 1e-9))
    lifted = np.sin(phi_in / exterior) * np.sin(phi_out / exterior) / np.maximum(far, 1e-9)
    return np.clip(ratio * lifted, 0.0, 1.0), np.sin(less / 2.0)


def edge_term(angle: FloatArray, exterior: FloatArray, distance: FloatArray) -> ComplexArray:
    """Return ``cot(angle / 2n) F(x)``. F cancels the pole of the cotangent at a shadow boundary.

    The angle repeats every 2 pi n around the edge. If it is measured from the nearest boundary, the argument of F is
    ``x = 2 distance sin^2(angle / 2)``, so the factor sin(angle / 2) cancels the pole in closed form.

    Parameters
    ----------
    angle, exterior, distance : (...)
        Angle [rad]; exterior angle and distance as for :func:`wedge`.

    Returns
    -------
    (...) complex
    """
    turns = angle / (2.0 * np.pi * exterior)
    # measure from the nearest boundary: -0.5 and 0.5 turns are the same angle
    turns = turns - np.floor(turns + 0.5)
    above, below = np.abs(np.sin(np.pi * turns * exterior)), np.sin(np.pi * turns)
    # on the boundary itself the ray that grazes the edge counts as visible, so use the limit from the lit side
    ratio = np.where(below == 0.0, exterior, above / np.where(below == 0.0, 1.0, below))
    # use w of a root instead of F of a square, because wofz is accurate both at zero and at large arguments
    reach = np.sqrt(2.0 * distance)
    return np.asarray(transition(reach * above) * np.cos(np.pi * turns) * reach * ratio)


def transition(root: FloatArray) -> ComplexArray:
    """Return the transition function of Kouyoumjian and Pathak at ``x = root^2``, divided by ``root``.

    Source: Abramowitz and Stegun 7.1.3 (the Faddeeva function w).
    """
    return np.asarray(np.sqrt(np.pi) * np.exp(0.25j * np.pi) * wofz(np.exp(0.75j * np.pi) * root))


# If an end is nearer than this to an edge [m], there is no path over the edge, because the end is not in the far field.
NEAREST_M = 0.01

# If the exterior angle is nearer than this to 180 degrees [rad], the two faces count as one plane.
_SHARPEST = 1e-6

# The formula is asymptotic. Faces lower than this number of wavelengths are not treated as wedges, nor their buildings
# as obstacles.
_LEAST_WAVELENGTHS = 0.5

# Distance from an edge point at which the program checks that there is air next to both faces [m]. The distance is far
# above the rounding error of coordinates at 1 km, and far below the gap between two walls of a map.
_PROBE_M = 1e-3

# Number of pairs of edge and pose that are examined together. The number limits the memory, and does not change the
# result.
LINKS_AT_ONCE = 200_000


@dataclass(frozen=True, slots=True)
class EdgePaths(Further):
    """Paths over one edge, sorted by pose and tower.

    Parameters
    ----------
    pose, tower : (paths,) int
    wedge : (paths, 2) int
        Faces 0 and n, which meet in the edge.
    ground : (paths, 2) int
        Ground planes that reflect before and after the edge. -1 means no reflection.
    vertices_m : (paths, 3, 3)
        Ground reflection, edge point and ground reflection of each path between array centres. NaN where unused.
    """

    kind: ClassVar[str] = "over an edge"
    name: ClassVar[str] = "edge"
    missing: ClassVar[str] = (
        "diffraction over two edges, at the tips of edges, after a reflection off a wall, and with more than one "
        "reflection on either side"
    )

    pose: IntArray
    tower: IntArray
    wedge: IntArray
    ground: IntArray
    vertices_m: FloatArray

    def __len__(self) -> int:
        return len(self.pose)

    def lines(self) -> PathSet:
        """Return the paths as polylines without faces."""
        # legs() requires used corners first; the stable sort keeps their order
        used = np.isfinite(self.vertices_m).all(axis=2)
        first = np.argsort(~used, axis=1, kind="stable")
        vertices = np.take_along_axis(self.vertices_m, first[..., None], axis=1)
        nothing = np.full(self.vertices_m.shape[:2], -1, dtype=np.int64)
        return PathSet(self.pose, self.tower, used.sum(axis=1), nothing, vertices)

    @property
    def touched(self) -> IntArray:
        """The ground, both faces of the edge, and the ground again (paths, 4). -1 means no face."""
        return np.column_stack([self.ground[:, :1], self.wedge, self.ground[:, 1:]])

    @property
    def turns(self) -> IntArray:
        """Digits of each path (paths,): 2 for the edge, with a 1 before or after it for a ground reflection."""
        before, after = (self.ground >= 0).T
        return np.asarray(np.where(after, 10 * (2 + 10 * before) + 1, 2 + 10 * before))

    def words(self, faces: Faces) -> list[str]:
        """Return a description of each path's corners, from tower to UAV."""
        label = (*faces.label, "")  # index -1 (no face) selects the last entry
        edges = zip(self.wedge.tolist(), self.vertices_m[:, 1].tolist(), strict=True)
        middle = (f"edge of {label[f]} and {label[n]} at {', '.join(f'{x:.1f}' for x in at)} m" for (f, n), at in edges)
        steps = zip(self.ground.tolist(), middle, strict=True)
        return [", ".join(filter(None, (label[before], edge, label[after]))) for (before, after), edge in steps]

    def fields(
        self, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link, loss_db: FloatArray | None = None
    ) -> Fields:
        """Return the contributions of the paths to H and to the powers.

        Parameters
        ----------
        faces : Faces
        sources_m : (towers, 3) or (poses, towers, 3)
            Centres of the tower arrays, in the order of ``link.tower_arrays`` [m].
        poses : Poses
        link : Link
        loss_db : (paths,), optional
            Further loss of each path, such as foliage.

        Returns
        -------
        Fields
        """

        def evaluated(part: slice) -> ComplexArray:
            some = amplitudes(self.select(part), faces, sources_m, poses, link)
            return some.reshape(len(some), -1)

        return summed(evaluated, self, len(poses), link, loss_db)


# ------------------------------------------------------------------------------------------------------- the search


def over_edges(scene: Scene, poses: Poses, link: Link) -> EdgePaths:
    """Find the paths over one edge of a building, with at most one reflection off the ground on either side.

    Parameters
    ----------
    scene : Scene
    poses : Poses
    link : Link
        The carrier of the link determines which buildings are too low for diffraction.

    Returns
    -------
    EdgePaths

    Raises
    ------
    UsageError
        If the scene consists of triangles.
    """
    if scene.surfaces is not None:
        raise UsageError(
            "diffraction in a scene of triangles",
            expected="buildings with footprints, or diffraction: none",
            cause="a triangle does not show which of its sides is inside a building",
        )
    faces, sources, targets = scene.faces, scene.sources_m, poses.position_m
    known = np.isfinite(targets).all(axis=1)
    search = _Search(faces, Edges.of(faces, wavelength_m(link.carrier_hz)), sources, targets[known])
    none = np.zeros(0, np.int64)
    pieces = [EdgePaths(none, none, np.zeros((0, 2), np.int64), np.zeros((0, 2), np.int64), np.zeros((0, 3, 3)))]
    for tower in range(len(sources)):
        # -1 means no reflection on that side
        grounds = [-1, *np.flatnonzero(scene.usable[tower] & (faces.solid < 0)).tolist()]
        rows = np.flatnonzero(known & ~scene.excluded[tower])
        for ground in itertools.product(grounds, grounds) if len(search.edges) else ():
            pieces += search.of_tower(tower, sources[tower], targets, rows, ground)
    paths = EdgePaths.one_after_another(pieces)
    (before, after), (first, last) = paths.ground.T, paths.wedge.T
    return paths.select(np.lexsort((after, before, last, first, paths.tower, paths.pose)))


# Values of ``rt.diffraction``, and the additional searches of each value.
DIFFRACTION: dict[str, tuple[Callable[..., Further], ...]] = {"none": (), "edges": (over_edges,)}


def diffracted(name: str) -> tuple[Callable[..., Further], ...]:
    """Return the searches for a value of ``rt.diffraction``. Raise :class:`UsageError` for an unknown value."""
    if name not in DIFFRACTION:
        raise UsageError(f"unknown diffraction {name!r}", expected=" or ".join(map(repr, DIFFRACTION)))
    return DIFFRACTION[name]


class Edges(NamedTuple):
    """Convex edges of a scene, one per row.

    ``start_m``, ``end_m``, ``along`` (edges, 3) with ``face_axis x normal = along``; ``face_axis`` lies in face 0, away
    from the edge; ``normal`` and ``normal_n`` point out of faces 0 and n; ``face`` (edges, 2).
    """

    start_m: FloatArray
    end_m: FloatArray
    along: FloatArray
    face_axis: FloatArray
    normal: FloatArray
    normal_n: FloatArray
    face: IntArray

    def __len__(self) -> int:
        return len(self.start_m)

    @property
    def length_m(self) -> FloatArray:
        """Lengths (edges,)."""
        return np.asarray(np.linalg.norm(self.end_m - self.start_m, axis=1))

    @classmethod
    def of(cls, faces: Faces, wavelength: float = 0.0) -> Edges:
        """Return edges of the prisms of a scene, except prisms lower than half a wavelength [m].

        A vertical edge starts at the highest level ground if its wall starts below this ground.
        """
        # walls extend below the ground, where an edge does not diffract
        ground_m = max(0.0, float(faces.offset_m[faces.solid == -1].max(initial=0.0)))
        least_m = _LEAST_WAVELENGTHS * wavelength
        solids = np.unique(faces.solid[faces.solid >= 0])
        rows = [row for solid in solids for row in _of_solid(faces, solid, ground_m, least_m)]
        starts, ends = (np.array([row[i] for row in rows]).reshape(-1, 3) for i in (0, 1))
        pairs = np.array([row[2] for row in rows], dtype=np.int64).reshape(-1, 2)
        normal, normal_n = faces.normal[pairs[:, 0]], faces.normal[pairs[:, 1]]
        along, face_axis, _ = wedge_axes(normal, normal_n)
        return cls(
            start_m=starts, end_m=ends, along=along, face_axis=face_axis, normal=normal, normal_n=normal_n, face=pairs
        )


def wedge_axes(normal: FloatArray, normal_n: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return directions of edges, axes in their faces 0 (edges, 3) and exterior angles over pi, from both normals."""
    cross = np.cross(normal, normal_n)
    sine = np.linalg.norm(cross, axis=1)
    along = cross / sine[:, None]
    exterior = 1.0 + np.arctan2(sine, (normal * normal_n).sum(axis=1)) / np.pi
    return along, np.cross(normal, along), exterior


def _of_solid(
    faces: Faces, solid: int, ground_m: float, least_m: float
) -> list[tuple[FloatArray, FloatArray, tuple[int, int]]]:
    """Return start, end and faces of each edge, in the order that the axes of :class:`Edges` require."""
    # list only edges between faces of the same building, not edges between two touching buildings
    members = np.flatnonzero(faces.solid == solid)
    walls = [int(i) for i in members if faces.normal[i, 2] == 0.0]
    roofs = {float(faces.offset_m[i]): int(i) for i in members if faces.normal[i, 2] == 1.0}
    rows: list[tuple[FloatArray, FloatArray, tuple[int, int]]] = []
    first = {_corner(faces, wall, 0): wall for wall in walls}
    for wall in walls:
        top, low = faces.upper[wall, 1], max(float(faces.lower[wall, 1]), ground_m)
        # skip a low building: the asymptotic formula is not valid for its edges
        if top - low <= least_m:
            continue
        near, far = (_point(faces, wall, end, top) for end in (0, 1))
        if top in roofs:
            # t of the module docstring lies in the wall and points down, so t x normal points along the wall
            rows.append((far, near, (wall, roofs[top])))
        following = first.get(_corner(faces, wall, 1))
        # require a left turn: at an inner corner, the air is on the hollow side, and no wave is diffracted
        if following is not None and np.cross(faces.along[wall], faces.along[following])[2] > np.sin(_SHARPEST):
            # t of the module docstring, the axis in face 0, lies in the wall and points away from the corner
            rows.append((_point(faces, wall, 1, low), _point(faces, wall, 1, top), (wall, following)))
    return rows


def _point(faces: Faces, wall: int, end: int, height_m: float) -> FloatArray:
    """Return the point at a height on a vertical side of a wall: its first (``end`` 0) or last side (``end`` 1)."""
    at = (faces.lower, faces.upper)[end][wall, 0]
    return np.asarray(faces.normal[wall] * faces.offset_m[wall] + at * faces.along[wall] + [0.0, 0.0, height_m])


def _corner(faces: Faces, wall: int, end: int) -> tuple[float, float]:
    """Return a corner of the footprint, rounded to 0.1 mm, as a key."""
    point = _point(faces, wall, end, 0.0)
    # each wall computes the corner from its own plane, so the last digits differ
    return round(float(point[0]), 4), round(float(point[1]), 4)


class _Search:
    """The search for paths over the edges of a scene."""

    def __init__(self, faces: Faces, edges: Edges, sources_m: FloatArray, targets_m: FloatArray) -> None:
        self.faces, self.edges = faces, edges
        self.hiding = Occlusion(faces, scene_tolerance_m(faces, sources_m, targets_m))
        numbers = np.unique(faces.solid[faces.solid >= 0])
        solid = np.searchsorted(numbers, faces.solid[edges.face[:, 0]])
        # use twice the probe distance, to find every building that a probe may enter
        low = np.minimum(edges.start_m, edges.end_m) - 2.0 * _PROBE_M
        high = np.maximum(edges.start_m, edges.end_m) + 2.0 * _PROBE_M
        touch = (self.hiding.low[None] <= high[:, None]) & (self.hiding.high[None] >= low[:, None])
        near = np.asarray(touch.all(axis=2))
        # ignore the building of the edge, which always touches it
        near[np.arange(len(edges)), solid] = False
        # edges at which another building may touch a face
        self.doubtful = np.asarray(near.any(axis=1))
        axis_n = np.cross(edges.along, edges.normal_n)
        # probe along each face, and outwards by a tenth of the distance, because a probe in the plane would graze the
        # wall
        self.sides = np.stack([edges.face_axis + 0.1 * edges.normal, axis_n + 0.1 * edges.normal_n], axis=1)

    def of_tower(
        self, tower: int, source_m: FloatArray, targets_m: FloatArray, poses: IntArray, ground: tuple[int, int]
    ) -> list[EdgePaths]:
        """Return paths of one tower with the given ground reflections before and after the edge."""
        # mirror the ends at their ground, so that each reflected leg is straight
        images = (source_m, targets_m[poses])
        source, ends = (p if g < 0 else self.faces.mirrored(g, p) for g, p in zip(ground, images, strict=True))
        at_source, near = (part[:, 0] for part in self._round_edges(source[None]))
        lit, pieces = np.flatnonzero(near >= 0.0), []
        step = max(1, LINKS_AT_ONCE // max(1, len(lit)))
        for first in range(0, len(poses), step):
            some = ends[first : first + step]
            at_target, far = (part[lit].T for part in self._round_edges(some))
            # unroll Keller's cone: where the straight line crosses the edge, both legs make the same angle with it
            at = at_source[lit] + (at_target - at_source[lit]) * (near[lit] / (near[lit] + far))
            row, column = np.nonzero((at >= 0.0) & (at <= self.edges.length_m[lit]) & (far >= 0.0))
            edge, pose = lit[column], poses[first + row]
            point = self.edges.start_m[edge] + at[row, column][:, None] * self.edges.along[edge]
            spots = [self._on_ground(g, end, point) for g, end in zip(ground, (source, some[row]), strict=True)]
            target, vertices = targets_m[pose], np.stack([spots[0], point, spots[1]], axis=1)
            good = self._free(source_m, vertices, target, edge, ground)
            count = int(good.sum())
            pieces.append(
                EdgePaths(
                    pose=pose[good],
                    tower=np.full(count, tower),
                    wedge=self.edges.face[edge[good]],
                    ground=np.tile(np.array(ground), (count, 1)),
                    vertices_m=vertices[good],
                )
            )
        return pieces

    def _free(
        self,
        source_m: FloatArray,
        vertices_m: FloatArray,
        target_m: FloatArray,
        edge: IntArray,
        ground: tuple[int, int],
    ) -> BoolArray:
        """Check whether paths (paths,) stay above their ground, bend in the air, and nothing cuts their legs."""
        point, good = vertices_m[:, 1], np.ones(len(edge), np.bool_)
        for index, end in zip(ground, (source_m, target_m), strict=True):
            if index >= 0:
                # an edge in the ground has no leg that the ground reflects
                good &= (self.faces.height_m(index, point) > NEAREST_M) & (self.faces.height_m(index, end) > 0.0)
        good[good] &= self._exposed(edge[good], point[good])
        for start, end in legs(source_m, vertices_m, target_m):
            good[good] &= ~self.hiding.segments(start[good], end[good])
        return good

    def _exposed(self, edge: IntArray, points_m: FloatArray) -> BoolArray:
        """Check whether points (paths, 3) of edges (paths,) have air next to both faces."""
        good = np.ones(len(edge), dtype=np.bool_)
        rows = np.flatnonzero(self.doubtful[edge])
        for side in (0, 1):
            # check only the second half of the probe: the first half may lie within the rounding error of the edge
            step = _PROBE_M * self.sides[edge[rows], side]
            good[rows] &= ~self.hiding.segments(points_m[rows] + 0.5 * step, points_m[rows] + step)
        return good

    def _round_edges(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions (edges, points) along edges, and distances from them, -1 inside the wedge or too close."""
        edges = self.edges
        axes = np.stack([edges.along, edges.face_axis, edges.normal, edges.normal_n])
        start = (axes * edges.start_m).sum(axis=2)
        along, down, up, up_n = axes @ points_m.T - start[..., None]
        far = np.hypot(down, up)
        # a point that is not in front of any face is inside the wedge, where there is no wave
        return along, np.where((far >= NEAREST_M) & ((up >= 0.0) | (up_n >= 0.0)), far, -1.0)

    def _on_ground(self, ground: int, image_m: FloatArray, points_m: FloatArray) -> FloatArray:
        """Return where the lines from images to points (paths, 3) cross a ground plane. NaN if ``ground`` is -1."""
        if ground < 0:
            return np.full_like(points_m, np.nan)
        below, above = self.faces.height_m(ground, image_m), self.faces.height_m(ground, points_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.asarray(below / (below - above))
        return np.asarray(image_m + share[..., None] * (points_m - image_m))


# -------------------------------------------------------------------------------------------------------- the field


class _End(NamedTuple):
    """One end of each path, mirrored so that the leg from it to the edge is straight.

    ``centre_m`` (paths, 3); ``axes`` (paths, 3, 3) of the device as rows. ``normal`` (paths, 3) and ``face`` (paths, 3)
    belong to the leg's mirror, and ``bounced`` (paths,) is True if there is a mirror. The positions (paths or 1, 3,
    elements) and slants (paths or 1, 2, elements) belong to the elements.
    """

    centre_m: FloatArray
    axes: FloatArray
    normal: FloatArray
    face: FloatArray
    bounced: BoolArray
    places_m: FloatArray
    slants: FloatArray


def amplitudes(paths: EdgePaths, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link) -> ComplexArray:
    """Return the complex amplitudes (paths, uav elements, tower elements) of paths.

    Parameters
    ----------
    paths : EdgePaths
    faces : Faces
    sources_m : (towers, 3) or (poses, towers, 3)
        Centres of the tower arrays [m].
    poses : Poses
    link : Link

    Returns
    -------
    (paths, uav elements, tower elements) complex

    Notes
    -----
    ``g_u . M_2 D M_1 . g_t  lambda / (4 pi) / sqrt(k s s' (s + s')) e^{-j k (s + s')}`` with s' and s the lengths
    before and after the edge, D the diffraction matrix times the square root of k, and M the dyads of mirrors.
    """
    wavelength = wavelength_m(link.carrier_hz)
    wave_number, table = 2.0 * np.pi / wavelength, face_table(faces, link.carrier_hz)
    face_0, face_n = paths.wedge.T
    # axes of the edge as rows: positions become (along the edge, along face 0, out of face 0)
    along, face_axis, exterior = wedge_axes(faces.normal[face_0], faces.normal[face_n])
    frame, point = np.stack([along, face_axis, faces.normal[face_0]], axis=1), paths.vertices_m[:, 1]
    ends = _ends(paths, faces, table, sources_m, poses, link)
    place = [np.einsum("nij,nj->in", frame, end.centre_m - point) for end in ends]
    near, far = (np.hypot(down, up) for _, down, up in place)
    rise = place[1][0] - place[0][0]
    total = np.hypot(near + far, rise)
    sine, cosine = (near + far) / total, rise / total
    # take the angle modulo 2 pi: it is 0 in face 0 and increases up to the exterior angle, without a jump at pi
    phi_in, phi_out = (np.mod(np.arctan2(up, down), 2.0 * np.pi) for _, down, up in place)
    distance, materials = wave_number * near * far / total, (tuple(table[face].T) for face in (face_0, face_n))
    bb, bp, pp = wedge(phi_in, phi_out, cosine, exterior, distance, *materials)
    # lambda / (4 pi) = 1 / 2k; the lengths of the legs are near / sine and far / sine, and both bases still need a
    # factor 1 / sine
    spread = (1.0 / (2.0 * wave_number * sine * np.sqrt(wave_number * near * far)))[:, None]
    ways = unit_vectors(point - ends[0].centre_m), unit_vectors(ends[1].centre_m - point)
    towers = tuple(link.tower_arrays.values())
    (b_in, p_in), (b_out, p_out) = (
        _round_edge(ends[side], ways[side], 1.0 - 2.0 * side, along, cosine, _patterns(arrays, paths, ends[side], way))
        for side, (arrays, way) in enumerate(((towers, ways[0]), ((link.uav_array,), -ways[1])))
    )
    b_mid = spread * (bb[:, None] * b_in + bp[:, None] * p_in)
    p_mid = spread * (pp[:, None] * p_in - bp[:, None] * b_in)
    (u_s, v_s), (u_t, v_t) = (_element_places(end, point, frame) for end in ends)
    length = np.hypot(u_t[:, :, None] - u_s[:, None, :], v_t[:, :, None] + v_s[:, None, :])
    # remove full cycles before the exponential: at 1 km they would cost five digits of the phase
    cycles = length / wavelength
    carrier = np.exp(-2j * np.pi * (cycles - np.round(cycles))) / np.sqrt(length)
    return np.asarray((b_out[:, :, None] * b_mid[:, None, :] + p_out[:, :, None] * p_mid[:, None, :]) * carrier)


def _ends(
    paths: EdgePaths, faces: Faces, table: FloatArray, sources_m: FloatArray, poses: Poses, link: Link
) -> tuple[_End, _End]:
    """Return the source and target of each path, mirrored if their leg is reflected."""
    arrays, uav = list(link.tower_arrays.values()), link.uav_array
    # transpose, because the formulas need the axes as rows
    mounts = np.stack([array.mount.T for array in arrays])
    axes = np.einsum("nij,jk->nki", poses.rotation[paths.pose], uav.mount)
    places, slants = np.stack([a.positions_m.T for a in arrays]), np.stack([a.slant_parts for a in arrays])
    rows = (
        (sources_of(paths, sources_m), mounts[paths.tower], places[paths.tower], slants[paths.tower]),
        (poses.position_m[paths.pose], axes, uav.positions_m.T[None], uav.slant_parts[None]),
    )
    ends = []
    for side, (centre, turned, place, slant) in enumerate(rows):
        ground = paths.ground[:, side]
        bounced = ground >= 0
        # a zero normal does not mirror, so that one formula is valid for all paths
        normal = np.where(bounced[:, None], faces.normal[ground], 0.0)
        offset = np.where(bounced, faces.offset_m[ground], 0.0)
        centre = centre - 2.0 * ((centre * normal).sum(axis=1) - offset)[:, None] * normal
        turned = turned - 2.0 * np.einsum("nij,nj->ni", turned, normal)[..., None] * normal[:, None]
        mirror = {"normal": normal, "face": table[ground], "bounced": bounced}
        ends.append(_End(centre_m=centre, axes=turned, **mirror, places_m=place, slants=slant))
    return ends[0], ends[1]


def _patterns(
    arrays: tuple[Array, ...], paths: EdgePaths, end: _End, toward: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return E_theta and E_phi (paths, elements) of one end's elements ``toward`` directions (paths, 3)."""
    count = len(arrays[0])
    # use the shape (1, 1), which broadcasts against every path and element
    if all(plain(array.patterns) for array in arrays):
        return np.ones((1, 1), complex), np.zeros((1, 1), complex)
    fields = np.empty((len(paths), 2, count), dtype=np.complex128)
    for number, array in enumerate(arrays):
        rows = np.flatnonzero(paths.tower == number) if len(arrays) > 1 else np.arange(len(paths))
        x, y, z = (np.repeat(part, count, axis=1) for part in parts_of(toward[rows]))
        fields[rows] = pattern_fields(array, np.arange(count), rows_of(end.axes[rows]), (x, y, z))
    return fields[:, 0], fields[:, 1]


def _round_edge(
    end: _End, way: FloatArray, sign: float, along: FloatArray, cosine: FloatArray,
    pattern: tuple[ComplexArray, ComplexArray],
) -> tuple[ComplexArray, ComplexArray]:  # fmt: skip
    """Return fields (paths, elements) of an end in the edge-fixed basis, times the sine of the angle with the edge.

    ``way`` (paths, 3) is the direction of the wave where the leg meets the edge. ``sign`` is 1 at the source. At the
    target it is -1, because the pattern is evaluated against the direction of the wave.
    """
    flat, cross = along - cosine[:, None] * way, np.cross(along, way)
    toward, normal = parts_of(way), parts_of(end.normal)
    mirror = coefficients(dyads.incidence(toward, normal), parts_of(end.face))
    slant_cosine, slant_sine = end.slants[:, 0], end.slants[:, 1]
    # evaluate the pattern in the direction of the array centre, with the slant of each element
    e_theta, e_phi = dyads.slant_rotation(*pattern, slant_cosine, slant_sine)
    beta: ComplexArray = np.zeros(1, complex)
    phi: ComplexArray = np.zeros(1, complex)
    for unit, field in (((1.0, 0.0), e_theta), ((0.0, 1.0), e_phi)):
        wave = dyads.field_vector(rows_of(end.axes), tuple(sign * part for part in toward), *unit)  # type: ignore[arg-type]
        # evaluate the dyad for all legs, but use it only for legs that the ground reflects
        after = np.hstack(dyads.reflected(wave, toward, normal, *mirror))
        vector = np.where(end.bounced[:, None], after, np.hstack(wave))
        beta = beta + field * (vector * flat).sum(axis=1)[:, None]
        phi = phi + field * (vector * cross).sum(axis=1)[:, None]
    return beta, phi


def _element_places(end: _End, point_m: FloatArray, frame: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions of an end's elements along the edge and their distances from it (paths, elements) [m]."""
    places = (end.centre_m - point_m)[:, :, None] + np.einsum("nji,njk->nik", end.axes, end.places_m)
    along, down, up = np.einsum("nij,njk->ink", frame, places)
    return along, np.hypot(down, up)
