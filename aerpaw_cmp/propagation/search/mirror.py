"""Every specular path by the image method: exhaustive, float64, vectorised over poses.

For a sequence of faces ``f1 .. fd`` the source is mirrored face by face. A path exists when

1. each image lies in front of the next face, and the target in front of the last (decided per sequence);
2. going back from the target, each line to the current image meets its face inside the polygon;
3. no segment is cut by a solid.

A sequence is followed only while the beam from the image through its last face can still reach the next one.
Sides are decided with a tolerance relative to the size of the scene, far above the rounding of a reflection point.
A solid hides with its open inside (:mod:`aerpaw_cmp.propagation.search.occlusion`), so a path along a wall stays, and
there is no crack between two walls. An end that lies on a face reflects there like one a hair before it: nothing jumps
when a UAV lands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.counting import counted
from ...common.errors import UsageError
from ...common.units import BoolArray, FloatArray, IntArray
from ..geometry.faces import corners, inside
from ..geometry.paths import Faces, Links, PathSet
from ..options import Progress
from .occlusion import Occlusion

# Of the largest coordinate: some thousand times the rounding error of a plane equation.
RELATIVE_TOLERANCE = 1e-12

# A link shorter than this has no path: there is no far field, and no direction when it is zero.
MINIMUM_LENGTH_M = 0.01

# Face sequences per tower beyond which the ``image`` engine gives up.
_SEQUENCE_BUDGET = 200_000

# Bounds the memory of every dense step (8 MB per array).
CELLS_PER_CHUNK = 1_000_000

# Targets whose heights over all faces are held.
TARGETS_AT_ONCE = 1024

# Margin of :class:`Mirrors` [m]: far above the tolerance of any search that it thins out.
REACH_SLACK_M = 1e-3


def find_paths(
    faces: Faces,
    links: Links,
    *,
    max_depth: int = 2,
    budget: int = _SEQUENCE_BUDGET,
    extent_m: FloatArray | None = None,
    progress: Progress | None = None,
) -> PathSet:
    """All paths with at most ``max_depth`` reflections.

    Parameters
    ----------
    faces : Faces
        Closed solids and ground planes.
    links : Links
    max_depth : int
        0 to 3.
    budget : int
        Largest number of sequences followed per tower.
    extent_m : (points, 3), optional
        Points that set the tolerance in place of the targets: those of the whole, where the targets are a part.
    progress : callable, optional
        Called with the share done.

    Returns
    -------
    PathSet
        Sorted by pose, tower, depth, faces.

    Raises
    ------
    UsageError
        If the scene has more sequences than the budget.
    """
    if not 0 <= max_depth <= 3:
        raise UsageError(f"max_depth {max_depth}", expected="0, 1, 2 or 3 reflections")
    sources_m, targets_m, usable = links.sources_m, links.targets_m, links.usable
    # a part of a flight has the tolerance of the whole, or its paths might differ
    known = targets_m[np.isfinite(targets_m).all(axis=1)] if extent_m is None else extent_m
    tolerance_m = scene_tolerance_m(faces, sources_m, known)
    hiding = Occlusion(faces, tolerance_m)
    box = _Bounds.of(faces, float(max(1.0, *(np.abs(p).max(initial=0.0) for p in (known, sources_m)))))
    growth = _Growth(
        faces=faces,
        bounds=box,
        # pairs of faces are asked for from the second reflection on
        facing=_facing(faces, box, tolerance_m) if max_depth > 1 else np.zeros((0, len(faces)), np.bool_),
        tolerance_m=tolerance_m,
        max_depth=max_depth,
        budget=budget,
    )
    alive = searched_links(links)
    pieces: list[PathSet] = []
    for tower, source in enumerate(sources_m):
        poses = np.flatnonzero(alive[tower])
        reflecting = np.ones(len(faces), np.bool_) if usable is None else usable[tower]
        levels = growth.sequences(source, reflecting, targets_m[poses]) if len(poses) else []
        for level in levels:
            pieces.append(_paths_of_level(faces, level, source, targets_m, poses, tower, max_depth, hiding))
        if progress:
            progress((tower + 1) / len(sources_m))
    return merge(pieces, max_depth, faces)


def searched_links(links: Links) -> BoolArray:
    """Links (towers, poses) that may have paths: with a pose, long enough and not excluded."""
    alive = np.empty((len(links.sources_m), len(links.targets_m)), dtype=np.bool_)
    with np.errstate(invalid="ignore"):
        # tower by tower: an array of all pairs and three coordinates would be the largest of the search
        for tower, source in enumerate(links.sources_m.reshape(-1, 3)):
            apart = links.targets_m - source
            gap2 = np.einsum("ij,ij->i", apart, apart)
            alive[tower] = (gap2 >= MINIMUM_LENGTH_M**2) & (gap2 < np.inf)
    return np.asarray(alive if links.excluded is None else alive & ~links.excluded)


def scene_tolerance_m(faces: Faces, *points_m: FloatArray) -> float:
    """Absolute tolerance [m] of side tests in this scene."""
    sizes = [np.abs(p).max(initial=0.0, where=np.isfinite(p)) for p in (*points_m, faces.lower, faces.upper)]
    return RELATIVE_TOLERANCE * max(1.0, *(float(s) for s in sizes))


@dataclass(frozen=True, slots=True)
class _Bounds:
    """In-plane bounds of the faces.

    Parameters
    ----------
    corners_m : (faces, 4, 3)
        In order round the face; infinite ones are cut far away.
    centre_m : (faces, 3)
    reach_m : (faces, 2, 3)
        Half of each side.
    """

    corners_m: FloatArray
    centre_m: FloatArray
    reach_m: FloatArray

    @classmethod
    def of(cls, faces: Faces, farthest_m: float) -> _Bounds:
        """Bounds of faces, the infinite ones cut at ten times the farthest point."""
        # far beyond any reflection point between two points of the scene
        box = corners(faces, 10.0 * farthest_m)
        first, second, third, fourth = box.transpose(1, 0, 2)
        return cls(box, (first + third) / 2, np.stack([second - first, fourth - first], axis=1) / 2)


@dataclass(frozen=True, slots=True)
class Sequences:
    """Face sequences of one length with their images.

    Parameters
    ----------
    faces : (sequences, depth) int
    images_m : (sequences, depth, 3)
        The source mirrored at the first 1, 2, ... faces.
    """

    faces: IntArray
    images_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class _Growth:
    """Growth of face sequences, face by face, wherever the tower stands.

    Parameters
    ----------
    faces : Faces
    bounds : _Bounds
        Of the faces.
    facing : (faces, faces) bool
        Faces that can follow each other.
    tolerance_m : float
        A point this far behind a face still counts as before it [m].
    max_depth, budget : int
        Most reflections; most sequences of one tower.
    """

    faces: Faces
    bounds: _Bounds
    facing: BoolArray
    tolerance_m: float
    max_depth: int
    budget: int

    def sequences(self, source: FloatArray, usable: BoolArray, targets_m: FloatArray) -> list[Sequences]:
        """Sequences from the line of sight on that geometry does not rule out for all targets, by their lengths."""
        level = Sequences(np.zeros((1, 0), np.int64), np.zeros((1, 0, 3)))
        levels, left = [level], self.budget - 1
        for _ in range(self.max_depth):
            level = self._one_face_longer(level, source, usable, left)
            left -= len(level.faces)
            if not len(level.faces):
                break
            levels.append(level)
        normal, starts = self.faces.normal, range(0, len(targets_m), TARGETS_AT_ONCE)
        highest = [(normal @ targets_m[start : start + TARGETS_AT_ONCE].T).max(axis=1) for start in starts]
        lit = np.max(highest, axis=0) - self.faces.offset_m >= -self.tolerance_m
        low, high = targets_m.min(axis=0), targets_m.max(axis=0)
        # the box round all poses: a beam that misses it misses each
        hull = (low + high)[None] / 2, np.diag(high - low)[None] / 2
        return [levels[0], *(self._reaching(level, lit, hull) for level in levels[1:])]

    def _one_face_longer(self, level: Sequences, source: FloatArray, usable: BoolArray, left: int) -> Sequences:
        """Sequences one face longer, at most ``left`` of them."""
        faces, box, depth = self.faces, self.bounds, level.faces.shape[1]
        grown: list[IntArray] = []
        images: list[FloatArray] = []
        # eight arrays of this size live at once
        step = max(1, CELLS_PER_CHUNK // (8 * len(faces)))
        for start in range(0, len(level.faces), step):
            now, past = level.faces[start : start + step], level.images_m[start : start + step]
            last_image = past[:, -1] if depth else np.broadcast_to(source, (len(now), 3))
            height = last_image @ faces.normal.T - faces.offset_m
            # the source itself may lie on the face, an image may not: its reflection would be an edge of two faces
            good = usable & (height > self.tolerance_m if depth else height >= -self.tolerance_m)
            hit = good & self.facing[now[:, -1]] if depth else good
            row, face = np.divmod(np.flatnonzero(hit), len(faces))
            if depth:
                before = now[row, -1]
                beam = last_image[row], box.corners_m[before], box.centre_m[face], box.reach_m[face]
                keep = _beam_meets(*beam, self.tolerance_m)
                # the ground is met by any beam that goes down, and its cut corners are no outline
                keep |= ~np.isfinite(faces.lower[face, 0]) | ~np.isfinite(faces.lower[before, 0])
                row, face = row[keep], face[keep]
            # the image counts for every target, so it is made once a sequence
            mirrored = last_image[row] - 2.0 * height[row, face][:, None] * faces.normal[face]
            grown.append(np.concatenate([now[row], face[:, None]], axis=1))
            images.append(np.concatenate([past[row], mirrored[:, None]], axis=1))
            left -= len(row)
            if left < 0:
                raise UsageError(
                    f"the scene has more than {self.budget} face sequences of up to {depth + 1} reflections "
                    f"({counted(len(faces), 'face')})",
                    expected="a rural scene with few faces",
                    cause="many buildings: engine 'sionna', a smaller max_depth, or pip install 'aerpaw-cmp[fast]'",
                )
        return Sequences(np.concatenate(grown), np.concatenate(images))

    def _reaching(self, level: Sequences, lit: BoolArray, hull_m: tuple[FloatArray, FloatArray]) -> Sequences:
        """Sequences whose last face is ``lit`` by a target, with a beam through it that reaches their box.

        ``hull_m`` (1, 3), (1, 3, 3) is the centre of that box, and half of each of its sides.
        """
        last = level.faces[:, -1]
        keep = lit[last]
        row = np.flatnonzero(keep & np.isfinite(self.faces.lower[last, 0]))
        for part in np.array_split(row, max(1, len(row) // 20_000)):
            window = self.bounds.corners_m[last[part]]
            keep[part] = _beam_meets(level.images_m[part, -1], window, *hull_m, self.tolerance_m)
        return Sequences(level.faces[keep], level.images_m[keep])


class Mirrors:
    """Faces that one reflection may reach a box over; built once for many boxes.

    Parameters
    ----------
    faces : Faces
    extent_m : (points, 3)
        Points that span sources and boxes.
    """

    def __init__(self, faces: Faces, extent_m: FloatArray) -> None:
        bounds = _Bounds.of(faces, float(max(1.0, np.abs(extent_m).max(initial=0.0))))
        none = np.zeros((0, len(faces)), np.bool_)
        self._growth = _Growth(
            faces=faces, bounds=bounds, facing=none, tolerance_m=REACH_SLACK_M, max_depth=1, budget=len(faces) + 1
        )

    def toward(self, source_m: FloatArray, box_m: FloatArray) -> IntArray:
        """Every face of a path from a source (3,) over one face into a box (lowest and highest corner, 3)."""
        points = np.array(np.meshgrid(*box_m.T)).reshape(3, -1).T
        levels = self._growth.sequences(source_m, np.ones(len(self._growth.faces), np.bool_), points)
        return levels[1].faces[:, 0] if len(levels) > 1 else np.zeros(0, np.int64)


def _facing(faces: Faces, box: _Bounds, tolerance_m: float) -> BoolArray:
    """Pairs (first, second) of which each has a point in front of the other."""
    highest = faces.normal @ box.centre_m.T - faces.offset_m[:, None]
    for half in box.reach_m.transpose(1, 2, 0):
        highest += np.abs(faces.normal @ half)
    ahead = highest > tolerance_m
    return np.asarray(ahead & ahead.T)


def _beam_meets(
    apex: FloatArray, window: FloatArray, centre: FloatArray, reach: FloatArray, tolerance_m: float
) -> BoolArray:
    """Check whether the beam from ``apex`` through the quadrilateral ``window`` may meet a parallelogram or a box.

    apex (n, 3), window (n, 4, 3), centre (n or 1, 3), reach (n or 1, axes, 3): half of each side. Conservative: True
    unless one side plane of the beam has all of it outside.
    """
    # components first, then corners: each step is one pass over contiguous rows of sequences
    ray = np.ascontiguousarray((window - apex[:, None, :]).transpose(2, 1, 0))
    following = ray[:, _NEXT_CORNER]
    side = ray[_SECOND] * following[_THIRD] - ray[_THIRD] * following[_SECOND]
    # the sense in which the window goes round decides which way the side planes point
    sense = np.sign((side.sum(axis=1) * ray.sum(axis=1)).sum(axis=0))
    ahead = (side * (centre - apex).T[:, None]).sum(axis=0) * sense
    ahead += np.abs((side * reach.transpose(1, 2, 0)[:, :, None]).sum(axis=1)).sum(axis=0)
    # side planes are not normalised, so the tolerance takes their length instead
    size = np.sqrt((side * side).sum(axis=0))
    return np.asarray((ahead >= -tolerance_m * size).all(axis=0))


_NEXT_CORNER, _SECOND, _THIRD = [1, 2, 3, 0], [1, 2, 0], [2, 0, 1]


def _paths_of_level(
    faces: Faces,
    level: Sequences,
    source: FloatArray,
    targets: FloatArray,
    poses: IntArray,
    tower: int,
    max_depth: int,
    hiding: Occlusion,
) -> PathSet:
    """Paths of all sequences of one length."""
    depth = level.faces.shape[1]
    pieces: list[PathSet] = []
    pose_step = min(len(poses), 4096)
    sequence_step = max(1, CELLS_PER_CHUNK // pose_step)
    for first in range(0, len(poses), pose_step):
        some = poses[first : first + pose_step]
        for start in range(0, len(level.faces), sequence_step):
            part = slice(start, start + sequence_step)
            if depth:
                row, column = _meets_last_face(
                    faces, level.faces[part], level.images_m[part, -1], targets[some], hiding.tolerance_m
                )
            else:
                row, column = np.zeros(len(some), np.int64), np.arange(len(some))
            # taken: an index in brackets costs four times as much for rows of three
            sequence, images, pose = level.faces[part].take(row, 0), level.images_m[part].take(row, 0), some[column]
            # after the cheap test of the last face, which few pairs pass
            vertices, good = trace_back(faces, sequence, images, targets.take(pose, 0), hiding.tolerance_m)
            sequence, pose, vertices = sequence[good], pose[good], vertices[good]
            # last, since it is the dearest: on what geometry has left
            free = ~hiding.any_segment(np.broadcast_to(source, (len(pose), 3)), vertices, targets[pose])
            pieces.append(PathSet.from_tower(tower, pose[free], sequence[free], vertices[free], max_depth))
    return merge(pieces, max_depth, None)


def _meets_last_face(
    faces: Faces, sequence: IntArray, image: FloatArray, targets: FloatArray, tolerance_m: float
) -> tuple[IntArray, IntArray]:
    """(sequence, target) pairs whose line from the last image meets the bounds of the last face.

    The in-plane coordinates of the meeting point are linear in those of the target, which are shared by all
    sequences that end on the face.

    Parameters
    ----------
    faces : Faces
    sequence : (s, depth)
    image : (s, 3)
        Image of the source in all faces of the sequence [m].
    targets : (n, 3)
        [m].
    tolerance_m : float
        Bounds are taken this much larger [m].

    Returns
    -------
    sequence, target : (m,)
        Numbers of the pairs that are left.
    """
    last = sequence[:, -1]
    used, position = np.unique(last, return_inverse=True)
    height = (faces.normal[used] @ targets.T - faces.offset_m[used, None])[position]
    below = np.einsum("ij,ij->i", faces.normal[last], image) - faces.offset_m[last]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = below[:, None] / (below[:, None] - height)
    good = height >= -tolerance_m
    # a target behind the face would put the point anywhere
    share[~good] = 0.0
    for axis, which in ((faces.along, 0), (faces.across, 1)):
        start = np.einsum("ij,ij->i", axis[last], image)[:, None]
        point = (axis[used] @ targets.T)[position]
        point -= start
        point *= share
        point += start
        good &= point >= faces.lower[last, which, None] - tolerance_m
        good &= point <= faces.upper[last, which, None] + tolerance_m
    if sequence.shape[1] > 1:
        # the ground as the last face meets every line: tracing each back would take most of a search
        often = np.flatnonzero(good.sum(axis=1) > _OFTEN * len(targets))
        good[often] &= _passes_first_faces(faces, sequence[often], image[often], targets)
    row, column = np.divmod(np.flatnonzero(good), len(targets))
    return row, column


# Share of the targets from which on a sequence's first faces are tested for all of them at once.
_OFTEN = 0.1

# Heights over a plane that differ by less [m] give no sure place on it.
_SURE_M = 1e-4


def _passes_first_faces(faces: Faces, sequence: IntArray, image: FloatArray, targets: FloatArray) -> BoolArray:
    """Check whether lines (sequences, targets) from last images may pass all faces but the last, with a margin.

    Each face is mirrored at those after it, so that the path is one straight line.
    """
    good = np.ones((len(sequence), len(targets)), dtype=np.bool_)
    for step in range(sequence.shape[1] - 1):
        face = sequence[:, step]
        axes = np.stack([faces.normal[face], faces.along[face], faces.across[face]])
        shift = np.stack([-faces.offset_m[face], *np.zeros((2, len(face)))])
        for later in sequence[:, step + 1 :].T:
            across = np.einsum("ksi,si->ks", axes, faces.normal[later])
            axes -= 2.0 * across[..., None] * faces.normal[later]
            shift += 2.0 * across * faces.offset_m[later]
        height, *ends = axes @ targets.T + shift[..., None]
        below, *starts = (np.einsum("ksi,si->ks", axes, image) + shift)[..., None]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = below / (below - height)
            meets = abs(below - height) >= _SURE_M
            for which, (start, end) in enumerate(zip(starts, ends, strict=True)):
                place = start + share * (end - start)
                meets &= place >= faces.lower[face, which, None] - REACH_SLACK_M
                meets &= place <= faces.upper[face, which, None] + REACH_SLACK_M
        # where the place is not sure, the exact tracing decides
        good &= meets | (abs(below - height) < _SURE_M)
    return good


def trace_back(
    faces: Faces,
    sequence: IntArray,
    images_m: FloatArray,
    targets_m: FloatArray,
    tolerance_m: float,
    edge_m: float | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Reflection points of sequences, from the target back to the source.

    Source: arXiv 2502.10324 eq. 4.

    Parameters
    ----------
    faces : Faces
    sequence : (paths, depth) int
    images_m : (paths, depth, 3)
    targets_m : (paths, 3)
    tolerance_m : float
        For sides.
    edge_m : float, optional
        How far outside its face a point may lie (default: ``tolerance_m``).

    Returns
    -------
    vertices_m : (paths, depth, 3)
    good : (paths,) bool
        Every point inside its face, and the sides in order.
    """
    count, depth = sequence.shape
    vertices = np.zeros((count, depth, 3))
    good = np.ones(count, dtype=np.bool_)
    point = targets_m
    for step in range(depth - 1, -1, -1):
        face, image = sequence[:, step], images_m[:, step]
        normal, offset = faces.normal.take(face, 0), faces.offset_m[face]
        ahead = np.einsum("ij,ij->i", normal, point) - offset
        behind = offset - np.einsum("ij,ij->i", normal, image)
        # an end may lie on its face, the other reflection points lie before it
        good &= ahead >= -tolerance_m if step == depth - 1 else ahead > tolerance_m
        good &= (behind >= -tolerance_m if step == 0 else behind > 0.0) & (ahead + behind > tolerance_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = behind / (behind + ahead)
        share = np.where(good, share, 0.0)
        point = image + share[:, None] * (point - image)
        vertices[:, step] = point
        good &= inside(faces, face, point, tolerance_m if edge_m is None else edge_m)
    return vertices, good


def images_of(faces: Faces, sequence: IntArray, sources_m: FloatArray) -> FloatArray:
    """Images (paths, depth, 3) of the sources (paths, 3) at the faces of ``sequence`` (paths, depth)."""
    images = np.zeros((*sequence.shape, 3))
    point = sources_m
    for step in range(sequence.shape[1]):
        normal = faces.normal[sequence[:, step]]
        height = np.einsum("ij,ij->i", normal, point) - faces.offset_m[sequence[:, step]]
        point = point - 2.0 * height[:, None] * normal
        images[:, step] = point
    return images


def merge(pieces: list[PathSet], max_depth: int, faces: Faces | None) -> PathSet:
    """One sorted set of several.

    Parameters
    ----------
    pieces : list of PathSet
    max_depth : int
        Of the set where there is no path at all.
    faces : Faces or None
        Where given, of paths over coplanar faces that overlap only one is kept.

    Returns
    -------
    PathSet
        Sorted by pose, tower, depth, faces.
    """
    pieces = [piece for piece in pieces if len(piece)]
    if not pieces:
        return PathSet.empty(max_depth)
    paths = PathSet.one_after_another(pieces)
    order = _order(paths)
    if faces is not None:
        order = order[~_repeated(paths, order, faces)[order]]
    same = len(order) == len(paths) and bool((np.diff(order) == 1).all())
    return paths if same else paths.select(order)


def _order(paths: PathSet) -> IntArray:
    """Rows by pose, tower, depth, faces; at once where they lie so."""
    keys = [paths.pose, paths.tower, paths.depth, *paths.faces.T]
    sorted_, tied = np.ones(max(len(paths) - 1, 0), np.bool_), np.ones(max(len(paths) - 1, 0), np.bool_)
    for key in keys:
        step = np.diff(key)
        sorted_ &= ~tied | (step >= 0)
        tied &= step == 0
    return np.arange(len(paths)) if sorted_.all() else np.lexsort(keys[::-1])


def _repeated(paths: PathSet, order: IntArray, faces: Faces) -> BoolArray:
    """Paths (paths,) over the same planes as one before them in ``order``, with the same ends."""
    plane = planes_of(faces)
    # most scenes have no two faces in a plane, and then no path can repeat
    shared = np.append(np.bincount(plane)[plane] > 1, False)
    repeated = np.zeros(len(paths), dtype=np.bool_)
    rows = order[shared[paths.faces[order]].any(axis=1)] if shared.any() else order[:0]
    if len(rows):
        same = np.append(plane, -1)[paths.faces[rows]]
        key = np.column_stack([paths.pose[rows], paths.tower[rows], same])
        by_key = np.lexsort(key.T[::-1])  # stable: the first in order stays
        twin = (np.diff(key[by_key], axis=0) == 0).all(axis=1)
        repeated[rows[by_key[1:][twin]]] = True
    return repeated


def planes_of(faces: Faces) -> IntArray:
    """Number (faces,) of the plane each face lies in; coplanar faces that look the same way share it."""
    # coplanar to the rounding of a map: a nanometre of tilt, a micrometre of offset
    key = np.column_stack([faces.normal / 1e-9, faces.offset_m / 1e-6]).round()
    order = np.lexsort(key.T)
    plane = np.empty(len(key), dtype=np.int64)
    plane[order] = np.cumsum((np.diff(key[order], axis=0, prepend=np.nan) != 0.0).any(axis=1))
    return plane - 1


def plane_keys(paths: PathSet, planes: IntArray) -> list[tuple[int, ...]]:
    """(pose, tower, planes) of each path, ``planes`` (faces,) being the number of each face's: equal for the same path.

    The padding is left out: two sets may have different depths.
    """
    rows = np.column_stack([paths.pose, paths.tower, np.append(planes, -1)[paths.faces]])
    # tuples, to be keys of sets
    return [tuple(number for number in row if number >= 0) for row in rows.tolist()]
