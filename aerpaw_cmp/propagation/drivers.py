"""Replays in parts, replays of a tower that moves, and channels of many antenna geometries.

A long flight is replayed in parts, which limits the memory.

A tower that moves is a rover or a second UAV with a separate position at every pose. Every position of the node is a
separate source, so there is no approximation. The poses are processed in blocks of a few positions. Each position is a
tower that has links only to the poses at that position. Poses at the same position share a tower, so a node that does
not move is replayed exactly as a fixed tower.

Channels of many antenna geometries are computed at once, for line of sight and ground reflection. The orientation of a
modem's antennas and the slants of its ports are rarely documented. Thousands of geometries can be tried without a
separate replay for each geometry. The field of an element slanted by ``s`` is ``cos s`` times the field of a vertical
element plus ``sin s`` times the field of a horizontal element at the same position. Therefore, one evaluation with both
elements at every port (:func:`aerpaw_cmp.propagation.field.sum.of_one_depth`, float64, every pair of elements) is
enough for all slants. The ground reflection is one ray, which can be added at any strength.

The rank that a modem reports is for its complete band. If the ground ray is 3 m longer than the direct ray, their phase
difference changes by about one cycle over 100 MHz. Instead of the coherent sum at the carrier, the power sum ``L L^H +
g^2 G G^H`` over the receiving ports can therefore be used. Its eigenvalues are the mean squared singular values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import Any

import numpy as np

from ..common.errors import UsageError
from ..common.text import counted
from ..common.units import AnyArray, BoolArray, ComplexArray, FloatArray, IntArray, wavelength_m
from ..site.site import Site, Tower
from .field.fresnel import face_table
from .field.sum import PAIRS_PER_CHUNK, Elements, geometry, of_one_depth, pattern_ends
from .geometry import Array, Faces, Link, PathSet, Poses, RowsT, joined, rotation_from_yaw_pitch_roll
from .options import Field, Progress, Run, Search, extent_of
from .replay import PER_LINK, Ends, Replay, replay
from .scene import Omission
from .search.terrain import TERRAIN


def replay_in_parts(
    site: Site, link: Link, poses: Poses, search: Search, field: Field, run: Run, *, size: int
) -> Replay:
    """Replay a flight in parts of at most ``size`` poses.

    Parameters
    ----------
    site, link, poses, search, field, run
        The same as in :func:`aerpaw_cmp.propagation.replay.replay`. The engine must be ``image``.
    size : int
        Largest number of poses per part. The parts have about the same size.

    Returns
    -------
    Replay
        The replay of all poses, the same as without parts.
    """
    rows = np.array_split(np.arange(len(poses)), max(1, -(-len(poses) // size)))
    if len(rows) == 1:
        return replay(site, link, poses, search, field, run)
    # Do not pass the callback on, because each part would report its own progress from 0 to 1.
    progress, run = run.progress, replace(run, progress=None, extent_m=extent_of(poses.position_m))

    def of(at: IntArray) -> Replay:
        return replay(site, link, poses[at], search, field, run)

    result = in_turn(rows, map(of, rows), progress)
    return replace(result, ends=replace(result.ends, poses=poses))


def in_turn(rows: list[IntArray], parts: Iterable[Replay], progress: Progress | None) -> Replay:
    """Join partial replays into one replay as they are produced. ``rows`` contains the poses of each part."""
    replays: list[Replay] = []
    finished, count = 0, max(1, sum(map(len, rows)))
    for at, part in zip(rows, parts, strict=True):
        replays.append(part)
        finished += len(at)
        if progress is not None:
            progress(finished / count)
    first = replays[0]
    # each part numbers its terrain planes in order of first use, so the same number means different planes in two parts
    faces, shifted = _joined_faces(replays)
    pieces = [shifted, *zip(*(part.further for part in replays), strict=True)]
    further: dict[str, Any] = {
        "faces": faces,
        "seconds": sum(part.seconds for part in replays),
        "search_seconds": sum(part.search_seconds for part in replays),
        "omitted": added_up(item for part in replays for item in part.omitted),
        "contributions": tuple(_in_flight(piece, rows) for piece in pieces),
    }
    columns = {name: [getattr(part, name) for part in replays] for name in PER_LINK}
    replays.clear()
    arrays: dict[str, Any] = {}
    # join one array at a time and free its parts, so that the peak memory exceeds the result by only one array
    for name in PER_LINK:
        values = columns.pop(name)
        arrays[name] = np.empty((count, *values[0].shape[1:]), dtype=values[0].dtype)
        for at, value in zip(rows, values, strict=True):
            arrays[name][at] = value
    return replace(first, **arrays, **further)


def _in_flight(parts: Sequence[RowsT], rows: list[IntArray]) -> RowsT:
    """Return the paths of all parts as one set, sorted by pose, with the pose numbers of the flight."""
    numbered = [replace(part, pose=at[part.pose]) for at, part in zip(rows, parts, strict=True)]  # type: ignore[type-var]
    paths = numbered[0].one_after_another(numbered)
    # use a stable sort, which keeps the order by tower, depth and faces within a pose
    return paths.select(np.argsort(paths.pose, kind="stable")) if (np.diff(paths.pose) < 0).any() else paths


def _joined_faces(parts: list[Replay]) -> tuple[Faces, list[PathSet]]:
    """Return the faces of all parts without duplicates, and the path set of each part with the new face numbers."""
    # all parts begin with the faces of the site; planes of the terrain follow
    common = int((parts[0].faces.solid != TERRAIN).sum())
    if all(len(part.faces) == common for part in parts):
        return parts[0].faces, [part.paths for part in parts]
    faces, out = parts[0].faces.select(np.arange(common)), []
    for part in parts:
        shift = len(faces) - common
        numbers = part.paths.faces
        out.append(replace(part.paths, faces=np.where(numbers >= common, numbers + shift, numbers)))
        faces = joined(faces, part.faces.select(np.arange(common, len(part.faces))))
    return faces, out


def added_up(omissions: Iterable[Omission]) -> list[Omission]:
    """Return the omissions of all parts of a replay without duplicates, with their counts added up."""
    added: dict[tuple[str, str], Omission] = {}
    for item in omissions:
        key = item.tower, item.what
        before = added.get(key)
        counts = item.counts if before is None else tuple(map(sum, zip(before.counts, item.counts, strict=True)))
        added[key] = replace(item, counts=counts)
    return list(added.values())


# Largest number of node positions per block. H of a block has a tower for each position, although a pose uses only one
# of these towers.
PLACES_AT_ONCE = 64

# Largest number of links (poses times positions) per block: about 4 MB of H with 4 x 4 elements.
LINKS_AT_ONCE = 16_384


@dataclass(frozen=True, slots=True)
class _Block:
    """Some poses (rows of the flight) and the node's positions ``places_m`` (places, 3).

    ``place`` (rows,) is the index of the node's position at each pose.
    """

    rows: IntArray
    places_m: FloatArray
    place: IntArray


def _blocks(sources_m: FloatArray) -> Iterator[_Block]:
    """Yield the poses in blocks, in the order in which the positions of the node first occur."""
    unique, first, member = np.unique(sources_m, axis=0, return_index=True, return_inverse=True)
    # np.unique sorts positions by coordinate, but blocks must follow the order of the flight
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    place, places_m = rank[member.ravel()], unique[order]
    rows = np.argsort(place, kind="stable")
    count = np.bincount(place, minlength=len(order))
    ends = np.cumsum(count)
    start = 0
    while start < len(order):
        stop = start + 1
        before = ends[start] - count[start]
        while (
            stop < len(order)
            and stop - start < PLACES_AT_ONCE
            and (ends[stop] - before) * (stop + 1 - start) <= LINKS_AT_ONCE
        ):
            stop += 1
        some = rows[before : ends[stop - 1]]
        yield _Block(some, places_m[start:stop], place[some] - start)
        start = stop


def site_with_tower_at(site: Site, tower: str, place_m: AnyArray) -> Site:
    """Return the site with one tower moved to a position (3,) [m]. The ground height of the tower does not change."""
    return replace(site, towers={**site.towers, tower: _moved(site, site.towers[tower], tower, place_m)})


def _moved(site: Site, tower: Tower, name: str, place_m: AnyArray) -> Tower:
    east, north, up = (float(x) for x in place_m)
    latitude, longitude = site.frame.to_geographic(np.array([east]), np.array([north]))
    return replace(
        tower,
        name=name,
        latitude_deg=float(latitude[0]),
        longitude_deg=float(longitude[0]),
        east_m=east,
        north_m=north,
        antenna_height_m=up - tower.ground_m,
    )


def replay_moving(
    site: Site, link: Link, poses: Poses, sources_m: FloatArray,
    search: Search = Search(), field: Field = Field(), run: Run = Run(),
) -> Replay:  # fmt: skip
    """Replay a flight with one tower that has a separate position at every pose.

    Parameters
    ----------
    site : Site
    link : Link
        Link with one tower. The array of the tower keeps its orientation in the site.
    poses : Poses
    sources_m : (poses, 3)
        Centre of the tower's array at each pose, east, north, up [m].
    search, field, run
        The same as in :func:`aerpaw_cmp.propagation.replay.replay`. The engine must be ``image``.

    Returns
    -------
    Replay
        The replay of one tower. ``paths`` start at the position that the tower has at each pose.

    Raises
    ------
    UsageError
        If the engine is not ``image``, or there is more than one tower. :func:`replay` may raise further errors.

    Notes
    -----
    The result is exact: each pose is traced from the tower's position at that pose, as if the tower were fixed there.
    """
    if len(link.tower_arrays) != 1:
        raise UsageError(
            f"{counted(len(link.tower_arrays), 'tower')} in a link whose tower moves",
            expected="only one tower in the link",
        )
    (name,) = link.tower_arrays
    if search.engine != "image":
        raise UsageError(
            f"towers.{name} moves and the engine is {search.engine!r}",
            expected="rt.engine: image (or --engine image)",
            cause="Sionna requires fixed towers; each position of the node would need a separate scene",
        )
    progress, run = run.progress, replace(run, progress=None)
    blocks = list(_blocks(sources_m))
    if not blocks:
        return replay(site, link, poses, search, field, run)
    if len(blocks) > 1:
        # use one extent for all blocks, so that all have the same tolerances
        run = replace(run, extent_m=extent_of(np.concatenate([poses.position_m, sources_m])))

    def of(block: _Block) -> Replay:
        moved_site, several, some, links = _scene_of(site, link, name, poses, block)
        return _of_one_tower(replay(moved_site, several, some, replace(search, links=links), field, run), name, block)

    # ``map`` is lazy: a block is traced when it is joined, so that only one scene is in memory
    result = in_turn([block.rows for block in blocks], map(of, blocks), progress)
    return replace(result, ends=Ends(link, poses, sources_m[:, None], field))


def _scene_of(
    site: Site, link: Link, name: str, poses: Poses, block: _Block
) -> tuple[Site, Link, Poses, BoolArray | None]:
    """Return site, link and poses of a block with one tower per position, and a mask of the links to search."""
    # a single position keeps the name of the tower, so that the tower is replayed as a fixed tower
    names = [name] if len(block.places_m) == 1 else [f"{name}@{i}" for i in range(len(block.places_m))]
    towers = {n: _moved(site, site.towers[name], n, at) for n, at in zip(names, block.places_m, strict=True)}
    moved_site = replace(site, towers={**{n: t for n, t in site.towers.items() if n != name}, **towers})
    several = replace(link, tower_arrays=dict.fromkeys(names, link.tower_arrays[name]))
    some = poses[block.rows]
    # search only the links between a position and its own poses, because no other links are used
    links = None if len(names) == 1 else np.arange(len(names))[:, None] == block.place[None, :]
    return moved_site, several, some, links


def _of_one_tower(replayed: Replay, name: str, block: _Block) -> Replay:
    """Return the replay of a block as a replay of one tower with a separate position at each pose."""
    at = np.arange(len(block.rows)), block.place
    columns: dict[str, Any] = {key: np.ascontiguousarray(getattr(replayed, key)[at][:, None]) for key in PER_LINK}
    return replace(
        replayed,
        **columns,
        contributions=tuple(replace(some, tower=np.zeros_like(some.tower)) for some in replayed.contributions),
        towers=(name,),
        omitted=[replace(item, tower=name if item.tower else "") for item in replayed.omitted],
    )


# Material of the default ground of a site. The strength of its reflection is fitted.
_GROUND_MATERIAL = "itu_medium_dry_ground"


@dataclass(frozen=True, slots=True, kw_only=True)
class Geometry:
    """One possible mounting of the antennas, and the strength of the ground reflection.

    Parameters
    ----------
    uav_yaw_deg, uav_pitch_deg, uav_roll_deg : float
        Rotation of the UAV's array relative to the body, or to the site axes if the attitude is not known.
    tower_slant_deg, uav_slant_deg : tuple of float
        Polarisation of each port from vertical.
    ground : float
        Amplitude factor of the ground reflection: 1 for a smooth half-space, 0 for no reflection.
    """

    uav_yaw_deg: float
    uav_pitch_deg: float
    uav_roll_deg: float
    tower_slant_deg: tuple[float, ...]
    uav_slant_deg: tuple[float, ...]
    ground: float

    @property
    def mount_deg(self) -> tuple[float, float, float]:
        """Yaw, pitch and roll of the UAV's array."""
        return self.uav_yaw_deg, self.uav_pitch_deg, self.uav_roll_deg

    def in_words(self) -> str:
        """Return a description for tables."""
        slants = "/".join(f"{s:g}" for s in self.uav_slant_deg)
        tower = "/".join(f"{s:g}" for s in self.tower_slant_deg)
        turn = f"yaw {self.uav_yaw_deg:g}, pitch {self.uav_pitch_deg:g}, roll {self.uav_roll_deg:g} deg"
        return f"{turn}; slants UAV {slants}, tower {tower}; ground x {self.ground:g} (incoherent)"


def every_geometry(
    mounts_deg: Sequence[tuple[float, float, float]],
    tower_slants_deg: Sequence[tuple[float, ...]],
    uav_slants_deg: Sequence[tuple[float, ...]],
    grounds: Sequence[float],
) -> tuple[Geometry, ...]:
    """Return the geometries for all combinations of the values. Geometries with the same mount are adjacent.

    Parameters
    ----------
    mounts_deg : sequence of (yaw, pitch, roll)
        Mounts of the UAV's array [deg].
    tower_slants_deg, uav_slants_deg : sequence of tuple of float
        Polarisation of each port from vertical [deg].
    grounds : sequence of float
        Strength of the ground reflection relative to Fresnel's coefficient.

    Returns
    -------
    tuple of Geometry
    """
    return tuple(
        Geometry(
            uav_yaw_deg=yaw, uav_pitch_deg=pitch, uav_roll_deg=roll, tower_slant_deg=tower, uav_slant_deg=uav,
            ground=ground,
        )
        for (yaw, pitch, roll), tower, uav, ground in product(mounts_deg, tower_slants_deg, uav_slants_deg, grounds)
    )  # fmt: skip


def singular_values_of(
    geometries: Sequence[Geometry], tower: Array, tower_m: FloatArray, uav: Array, poses: Poses, carrier_hz: float
) -> Iterator[FloatArray]:
    """Yield the singular values (n, ports) of each geometry, in descending order.

    Parameters
    ----------
    geometries : sequence of Geometry
        Geometries, grouped by mount. Each group needs one evaluation of the field, or two with the ground.
    tower : Array
        Positions, pattern and mount of the tower. The slants are taken from each geometry instead.
    tower_m : (3,)
        Array centre, east, north, up over flat ground at 0 [m].
    uav : Array
        Array of the UAV. The slants and the mount are taken from each geometry instead.
    poses : Poses
    carrier_hz : float

    Yields
    ------
    (n, ports)
        Singular values of the next geometry, one row per pose.

    Notes
    -----
    The UAV receives. Direct ray and ground ray are added as powers. The singular values are the roots of the
    eigenvalues of ``L L^H + g^2 G G^H``. This sum is the mean of ``H H^H`` over a band in which the phase between
    ground ray and direct ray takes all values.
    """
    for mount, several in groupby(geometries, lambda g: g.mount_deg):
        run = list(several)
        turned = dataclasses.replace(uav, mount=np.asarray(rotation_from_yaw_pitch_roll(*map(np.radians, mount))))
        fields = basis_fields(tower, tower_m, turned, poses, carrier_hz, any(g.ground for g in run))
        for g in run:
            los, ground = (slanted(field, g.uav_slant_deg, g.tower_slant_deg) for field in fields)
            covariance = sum(field @ field.conj().swapaxes(-1, -2) for field in (los, g.ground * ground))
            # reverse the order, because eigvalsh returns ascending eigenvalues. Rounding can make a zero eigenvalue
            # slightly negative.
            yield np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[..., ::-1], 0.0)))


def basis_fields(
    tower: Array, tower_m: FloatArray, uav: Array, poses: Poses, carrier_hz: float, with_ground: bool = True
) -> tuple[ComplexArray, ComplexArray]:
    """Return separate channel matrices of line of sight and ground reflection, for vertical and horizontal ports.

    Parameters
    ----------
    tower, uav : Array
        Arrays of both ends. The slants of these arrays are not used.
    tower_m : (3,)
        Centre of the tower's array [m].
    poses : Poses
    carrier_hz : float
    with_ground : bool
        If false, ``bounced`` contains zeros.

    Returns
    -------
    direct, bounced : (2, 2, n, uav ports, tower ports) complex
        The first two axes are the polarisation (vertical, horizontal) at the UAV and at the tower. :func:`slanted`
        combines them.
    """
    link, wavelength = Link(carrier_hz, {"tower": tower}, uav, uav_transmits=False), wavelength_m(carrier_hz)
    faces = Faces(np.array([[0.0, 0.0, 1.0]]), np.zeros(1), (_GROUND_MATERIAL,), ("ground",))
    table, elements = face_table(faces, carrier_hz), Elements.of(link)
    n, ports = len(poses), (len(uav), len(tower))
    index, zero, step = np.arange(n), np.zeros(n, dtype=np.int64), max(1, PAIRS_PER_CHUNK // (len(uav) * len(tower)))
    # cosine and sine of the slant of a vertical and of a horizontal port, in shapes that broadcast with (tower's slant,
    # paths, pairs) and (UAV's slant, tower's slant, paths, pairs)
    upright, level = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    slants = [(upright.reshape(shape), level.reshape(shape)) for shape in ((2, 1, 1), (2, 1, 1, 1))]
    fields = np.zeros((2, 2, 2, n, *ports), dtype=np.complex128)
    for depth in (0, 1) if with_ground else (0,):
        # the reflection point can be NaN, because the field depends only on images
        path = PathSet(index, zero, zero + depth, np.full((n, 1), depth - 1), np.full((n, 1, 3), np.nan))
        columns = geometry(path, faces, table, np.asarray(tower_m)[None, :], poses, link)
        for start in range(0, n, step):
            some = columns.some(slice(start, start + step))
            parts = of_one_depth(some, elements, pattern_ends(some, elements, link), (slants[0], slants[1]), wavelength)
            fields[depth, :, :, start : start + step] = parts.reshape(2, 2, -1, *ports)
    return fields[0], fields[1]


def slanted(field: ComplexArray, uav_slant_deg: Sequence[float], tower_slant_deg: Sequence[float]) -> ComplexArray:
    """Combine :func:`basis_fields` into channel matrices (n, uav ports, tower ports) for slants of the ports [deg]."""
    at_uav, at_tower = (np.radians(slant) for slant in (uav_slant_deg, tower_slant_deg))
    upright, level = field[:, 0] * np.cos(at_tower) + field[:, 1] * np.sin(at_tower)
    return np.asarray(np.cos(at_uav)[:, None] * upright + np.sin(at_uav)[:, None] * level)
