"""The sum over paths: channel matrices in float64 for every pair of elements, and levels.

For a pair (tower element ``t``, UAV element ``u``) and a path over the faces ``f1 .. fd``, the image of ``t``
determines the length ``L`` and all directions. The entry of the channel matrix is::

    g_u . M_d ... M_1 . g_t   *   min(1, lambda / (4 pi L))   *   exp(-j 2 pi L / lambda)   *   10^(-loss / 20)

Here ``g`` is the complex field of an element as a vector. ``M_k`` is the dyad of reflection ``k`` with the Fresnel
coefficients of ITU-R P.2040 at this pair's angle (:mod:`dyads`, :mod:`fresnel`). The time factor is ``e^{+j omega t}``.
The pattern of the receiving element is not conjugated (reciprocity), so swapping the ends of a link transposes H. Each
path is evaluated separately, and added in the order of the path set, so results do not depend on chunks and threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ...common.errors import UsageError
from ...common.units import AnyArray, ComplexArray, FloatArray, IntArray, amplitude_from_db, db_from_power, wavelength_m
from ...site.antennas import Isotropic
from ..geometry import Array, Faces, Link, PathSet, Pattern, Poses, Rows, sources_of
from . import dyads
from .fresnel import coefficients, face_table

# Number of element pairs that NumPy evaluates at a time, so that their columns stay in the cache of a core.
PAIRS_PER_CHUNK = 8_000

# Number of paths that are evaluated together. The number limits the memory, and does not change the result.
PATHS_PER_PART = 4096


class Geometry(NamedTuple):
    """Columns of paths, each in the space of its last image.

    ``image_m`` (paths, 3) is the image of the tower, and ``frame`` (paths, 3, 3) contains its device axes as rows.
    ``normal`` (paths, most, 3) contains the normals of the faces, and ``face`` (paths, most, 3) their rows of
    :func:`face_table`. ``place_m`` and ``axes`` are the position and the device axes of the UAV. ``depth`` and
    ``tower`` (paths,) are those of the path set.
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
        """Return the paths of a mask, of indices or of a slice."""
        return Geometry._make(column[rows] for column in self)


class Elements(NamedTuple):
    """The elements of both ends for each pair of a link: pair p joins UAV element p // ports and port p % ports.

    Positions (towers, 3, pairs) and (3, pairs) are in the device frames [m]. Slants (towers, 2, pairs) and (2, pairs)
    are stored as their cosine and sine.
    """

    tower_m: FloatArray
    tower_slant: FloatArray
    uav_m: FloatArray
    uav_slant: FloatArray

    @classmethod
    def of(cls, link: Link) -> Elements:
        """Return the elements of a link whose towers have the same number of ports."""
        arrays, uav = list(link.tower_arrays.values()), link.uav_array
        pair = np.arange(len(arrays[0]) * len(uav))
        port, element = pair % len(arrays[0]), pair // len(arrays[0])
        towers = [_columns(array, port) for array in arrays]
        return cls(np.stack([t[0] for t in towers]), np.stack([t[1] for t in towers]), *_columns(uav, element))


def _columns(array: Array, element: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return positions (3, pairs) and slants (2, pairs) of the given elements."""
    return np.ascontiguousarray(array.positions_m[element].T), np.ascontiguousarray(array.slant_parts[:, element])


# Pattern fields of tower and UAV; None for 1 along theta in all directions.
Ends = tuple[ComplexArray | None, ComplexArray | None]


def geometry(
    paths: PathSet, faces: Faces, table: FloatArray, sources_m: FloatArray, poses: Poses, link: Link
) -> Geometry:
    """Return the columns of paths that the sum needs.

    Parameters
    ----------
    paths : PathSet
    faces : Faces
    table : (faces + 1, 3)
        Materials of the faces: :func:`face_table`.
    sources_m : (towers, 3) or (poses, towers, 3)
        Centres of the tower arrays [m]. The second shape is for towers that move.
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
        normal = normals[:, step]  # a zero normal means that there is no face, so that the point is not mirrored
        offset = np.where(sequence[:, step] >= 0, faces.offset_m[sequence[:, step]], 0.0)
        image = image - 2.0 * ((image * normal).sum(axis=1) - offset)[:, None] * normal
        # mirror earlier faces, too, because in the space of the last image they are mirrored
        for vectors in (frame, normals[:, :step]):
            # the arrays are copies, so they can be changed in place
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
    """Return rotations (n, 3, 3) in the form that the formulas need, for broadcasting with (n, pairs)."""
    return tuple(tuple(matrix[:, i, j, None] for j in range(3)) for i in range(3))  # type: ignore[return-value]


def parts_of(vector: AnyArray) -> dyads.Vector:
    """Return vectors (n, 3) in the form that the formulas need, for broadcasting with (n, pairs)."""
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
    # evaluate each pattern once, because elements often share a pattern object
    for pattern in {id(p): p for p in patterns}.values():
        pairs = np.flatnonzero([patterns[e] is pattern for e in element])
        fields[:, 0, pairs], fields[:, 1, pairs] = pattern.field(theta[:, pairs], phi[:, pairs])
    return fields


def plain(patterns: tuple[Pattern, ...]) -> bool:
    """Check whether every pattern is 1 along theta in all directions. Subclasses of Isotropic are excluded."""
    return all(type(pattern) is Isotropic for pattern in patterns)


@dataclass(frozen=True, slots=True)
class Fields:
    """The sums over the paths of a replay.

    Parameters
    ----------
    h : (poses, towers, n_rx, n_tx) complex
        Coherent sum over paths; zero without a path.
    path_power : (paths,)
        Mean over element pairs of ``|h|^2`` of each path alone.
    power : (poses, towers)
        Sum of ``path_power``: the mean power at a receiver if the phases of the paths are random.
    """

    h: ComplexArray
    path_power: FloatArray
    power: FloatArray


class Further(Rows):
    """Paths of a kind other than reflections, one path per row, with the data for replays, drawings and descriptions.

    ``kind`` is written after the word "path" in descriptions, and ``name`` is used in tables. ``missing`` is the part
    of the kind that is not modelled.
    """

    __slots__ = ()
    kind: ClassVar[str]
    name: ClassVar[str]
    missing: ClassVar[str]

    def lines(self) -> PathSet:
        """Return the paths as polylines without faces, for terrain, foliage and drawings."""
        raise NotImplementedError

    def fields(
        self, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link, loss_db: FloatArray | None = None
    ) -> Fields:
        """Return the contributions of the paths to H and to the powers, like :func:`channel_matrices`.

        Parameters
        ----------
        faces, sources_m, poses, link, loss_db
            The same as in :func:`channel_matrices`.

        Returns
        -------
        Fields
        """
        raise NotImplementedError

    def words(self, faces: Faces) -> list[str]:
        """Return a description of each path's corners, from tower to UAV."""
        raise NotImplementedError

    @property
    def touched(self) -> IntArray:
        """The faces (paths, n) that each path touches, from tower to UAV. -1 means no face."""
        return np.full((len(self.pose), 1), -1)

    @property
    def turns(self) -> IntArray:
        """One digit per corner (paths,), from tower to UAV: 1 is a reflection, 2 a diffraction or another bend."""
        return 2 * self.lines().turns


def fields_of(
    paths: Any, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link, loss_db: FloatArray | None = None
) -> Fields:
    """Return the part of H and of the powers that comes from paths of any kind.

    Parameters
    ----------
    paths : PathSet or Further
    faces, sources_m, poses, link, loss_db
        The same as in :func:`channel_matrices`.

    Returns
    -------
    Fields
    """
    # reflections are a separate class, because every engine finds them
    evaluate = channel_matrices if isinstance(paths, PathSet) else type(paths).fields
    return evaluate(paths, faces, sources_m, poses, link, loss_db)


def channel_matrices(
    paths: PathSet, faces: Faces, sources_m: FloatArray, poses: Poses, link: Link, loss_db: FloatArray | None = None
) -> Fields:
    """Return the channel matrices of a path set.

    Source: arXiv 2502.10324 eq. 1; arXiv 2502.10324 eq. 6.

    Parameters
    ----------
    paths : PathSet
    faces : Faces
        Faces to which the paths refer.
    sources_m : (towers, 3) or (poses, towers, 3)
        Array centres, in the order of ``link.tower_arrays`` [m]. The second shape is for towers that move.
    poses : Poses
    link : Link
    loss_db : (paths,), optional
        Further loss of each path, such as foliage.

    Returns
    -------
    Fields

    Raises
    ------
    UsageError
        If the towers' arrays have different numbers of elements, or an array has patterns for some elements only.
    """
    arrays = list(link.tower_arrays.values())
    _check_ports(arrays)
    _check_patterns([*arrays, link.uav_array])
    elements, wavelength = Elements.of(link), wavelength_m(link.carrier_hz)
    table, key = face_table(faces, link.carrier_hz), paths.pose * len(arrays) + paths.tower
    if (np.diff(key) < 0).any():
        # the paths of a link must be consecutive, because reduceat adds consecutive rows
        order = np.argsort(key, kind="stable")
        some_db = None if loss_db is None else loss_db[order]
        sorted_fields = channel_matrices(paths.select(order), faces, sources_m, poses, link, some_db)
        power = np.empty(len(paths))
        power[order] = sorted_fields.path_power
        return replace(sorted_fields, path_power=power)
    if paths.terrain_db.any():
        loss_db = paths.terrain_db if loss_db is None else loss_db + paths.terrain_db

    def evaluated(part: slice) -> ComplexArray:
        columns = geometry(paths.select(part), faces, table, sources_m, poses, link)
        return amplitudes(columns, elements, pattern_ends(columns, elements, link), wavelength)

    return summed(evaluated, paths, len(poses), link, loss_db)


def summed(
    evaluated: Callable[[slice], ComplexArray], paths: Rows, poses: int, link: Link, loss_db: FloatArray | None
) -> Fields:
    """Return the sums of the amplitudes of paths.

    Parameters
    ----------
    evaluated : callable
        Returns the amplitudes (paths, pairs) of a part of the paths.
    paths : Rows
        Paths, sorted by pose and tower.
    poses : int
        Number of poses.
    link : Link
    loss_db : (paths,) or None
        Further loss of each path.

    Returns
    -------
    Fields
    """
    arrays = list(link.tower_arrays.values())
    key, ends = paths.pose * len(arrays) + paths.tower, (len(link.uav_array), len(arrays[0]))
    h = np.zeros((poses * len(arrays), ends[0] * ends[1]), dtype=np.complex128)
    power = np.zeros(len(key))
    for part in parts_between_poses(paths.pose):
        amplitude = evaluated(part)
        if loss_db is not None:
            amplitude *= amplitude_from_db(-loss_db[part])[:, None]
        power[part] = (np.abs(amplitude) ** 2).mean(axis=1)
        first = np.flatnonzero(np.diff(key[part], prepend=-1))
        # parts end between poses, so no link is written twice
        h[key[part][first]] = np.add.reduceat(amplitude, first, axis=0)
    matrices = h.reshape(poses, len(arrays), *ends)
    # H is (receiver, transmitter). By reciprocity, the other direction is the transpose.
    matrices = np.ascontiguousarray(matrices.swapaxes(2, 3)) if link.uav_transmits else matrices
    total = np.bincount(key, weights=power, minlength=len(h)).astype(np.float64)
    return Fields(matrices, power, total.reshape(poses, len(arrays)))


def amplitudes(
    g: Geometry,
    elements: Elements,
    ends: Ends,
    wavelength: float,
    record: Callable[[str, AnyArray], None] | None = None,
) -> ComplexArray:
    """Return the complex amplitudes of some paths: the contribution of each path to H, before further losses.

    Parameters
    ----------
    g : Geometry
    elements : Elements
    ends : (paths, 2, pairs) complex or None, twice
        Pattern fields of tower and UAV: :func:`pattern_ends`.
    wavelength : float
        Wavelength [m].
    record : callable, optional
        Called with the power (paths, pairs) of the "wave" after the tower and after each reflection, the "spreading" of
        the amplitude, and the power of the "uav". With this argument, all paths must have the same depth.

    Returns
    -------
    (paths, pairs) complex
    """
    pairs = elements.tower_m.shape[2]
    out = np.empty((len(g.depth), pairs), dtype=np.complex128)
    step = max(1, PAIRS_PER_CHUNK // pairs)
    # evaluate paths of one depth together, so that no step is computed in vain for shorter paths
    for depth in np.unique(g.depth):
        rows = np.flatnonzero(g.depth == depth)
        for start in range(0, len(rows), step):
            few = rows[start : start + step]
            tower, uav = (None if e is None else e[few] for e in ends)
            slant = elements.tower_slant[g.tower[few]]
            slants = (slant[:, 0], slant[:, 1]), elements.uav_slant
            out[few] = of_one_depth(g.some(few), elements, (tower, uav), slants, wavelength, record)
    return out


def of_one_depth(
    g: Geometry,
    elements: Elements,
    ends: Ends,
    slants: tuple[Any, Any],
    wavelength: float,
    record: Callable[[str, AnyArray], None] | None = None,
) -> ComplexArray:
    """Compute the same as :func:`amplitudes`, for paths of one depth.

    Parameters
    ----------
    g, elements, ends, wavelength, record
        The same as in :func:`amplitudes`.
    slants : twice (cosine, sine)
        Slants of tower and UAV, broadcast with (paths, pairs). Additional leading axes are the first axes of the
        result. Parts that do not depend on them are evaluated once.

    Returns
    -------
    (..., paths, pairs) complex
    """
    x, y, z, length = directions(g, elements)
    toward = x, y, z
    wave = _vectors(rows_of(g.frame), toward, ends[0], *slants[0])
    for step in range(g.depth[0]):
        if record is not None:
            record("wave", _power(wave))
        normal, face = parts_of(g.normal[:, step]), parts_of(g.face[:, step])
        wave = dyads.reflected(wave, toward, normal, *coefficients(dyads.incidence(toward, normal), face))
    uav = _vectors(rows_of(g.axes), (-x, -y, -z), ends[1], *slants[1])
    cycles = length / wavelength
    with np.errstate(divide="ignore"):
        if record is not None:
            record("wave", _power(wave))
            record("spreading", dyads.spreading(cycles))
            record("uav", _power(uav))
        return np.asarray(dyads.received(wave, uav, cycles))


def _vectors(
    m: dyads.Rotation, toward: dyads.Vector, fields: ComplexArray | None, cosine: FloatArray, sine: FloatArray
) -> dyads.Vector:
    """Return field vectors of elements in site axes."""
    theta, phi = (1.0, 0.0) if fields is None else fields.swapaxes(0, 1)
    return dyads.field_vector(m, toward, *dyads.slant_rotation(theta, phi, cosine, sine))


def _power(wave: dyads.Vector) -> FloatArray:
    return np.asarray(sum(np.abs(part) ** 2 for part in wave))


def pattern_ends(g: Geometry, elements: Elements, link: Link) -> Ends:
    """Return pattern fields (paths, 4, pairs) of both ends along the paths. None if all of an end are 1 along theta."""
    arrays, uav = list(link.tower_arrays.values()), link.uav_array
    plain_towers, plain_uav = all(plain(array.patterns) for array in arrays), plain(uav.patterns)
    # patterns that are 1 along theta do not depend on the direction
    if plain_towers and plain_uav:
        return None, None
    x, y, z, _ = directions(g, elements)
    ports, pair = len(arrays[0]), np.arange(x.shape[1])
    towers = None if plain_towers else np.empty((len(x), 2, len(pair)), dtype=np.complex128)
    if towers is not None:
        for number, array in enumerate(arrays):
            rows = np.flatnonzero(g.tower == number)
            towers[rows] = pattern_fields(array, pair % ports, rows_of(g.frame[rows]), (x[rows], y[rows], z[rows]))
    toward_tower = (-x, -y, -z)
    return towers, None if plain_uav else pattern_fields(uav, pair // ports, rows_of(g.axes), toward_tower)


def _check_patterns(arrays: Sequence[Array]) -> None:
    for array in arrays:
        if len(array.patterns) not in (1, len(array)):
            raise UsageError(
                f"{len(array.patterns)} patterns for {len(array)} elements",
                expected="one shared pattern or one per element",
            )


def _check_ports(arrays: Sequence[Array]) -> None:
    counts = {len(array) for array in arrays}
    if len(counts) != 1:
        raise UsageError(
            f"tower arrays of {sorted(counts)} elements",
            expected="the same number of elements at every tower of a link",
        )


def parts_between_poses(pose: IntArray, most: int = PATHS_PER_PART) -> list[slice]:
    """Return slices of about ``most`` paths that end between poses (paths,), so that no link is in two slices."""
    edges = [0]
    while edges[-1] < len(pose):
        stop = min(edges[-1] + most, len(pose))
        if stop < len(pose):  # extend the slice to the end of the pose
            stop = int(np.searchsorted(pose, pose[stop - 1], side="right"))
        edges.append(stop)
    return [slice(start, stop) for start, stop in pairwise(edges)]


def rss_dbm(power: FloatArray, transmit_power_dbm: float, noise_floor_dbm: float = -np.inf) -> FloatArray:
    """Return the received power [dBm]. NaN if ``power`` is zero (no path) or the level is below the noise floor [dBm].

    ``power`` is the mean over element pairs of ``|h|^2``. The transmitting ports share the transmit power equally and
    send independent signals. The received power is the mean over the receiving ports.
    """
    level = transmit_power_dbm + db_from_power(power)
    return np.asarray(np.where((power > 0.0) & (level >= noise_floor_dbm), level, np.nan))


def mean_pair_power(h: ComplexArray) -> FloatArray:
    """Return the mean over the last two axes of ``|h|^2``, without underflow or overflow."""
    # sum the squares of real and imaginary parts, which does not need roots
    parts = np.ascontiguousarray(h).view(np.float64).reshape(*h.shape[:-2], 2 * h.shape[-2] * h.shape[-1])
    pairs = max(parts.shape[-1] // 2, 1)
    with np.errstate(over="ignore", under="ignore"):
        power = np.asarray(np.einsum("...i,...i->...", parts, parts) / pairs)
    odd = ~((power > 1e-280) & (power < 1e280))  # squares may have lost digits: scale by the largest entry
    if odd.any():
        some = h[odd]
        scale = np.abs(some).max(axis=(-2, -1), keepdims=True, initial=0.0)
        safe = np.where(scale > 0.0, scale, 1.0)
        power[odd] = (np.abs(some / safe) ** 2).mean(axis=(-2, -1)) * scale[..., 0, 0] ** 2
    return power
