"""A replay whose tower moves, too: a rover or a second UAV with its own place at every pose.

Every place of the node is a source of its own, so nothing is approximated: the poses are taken in blocks of a few
places, each place a tower that has links to its own poses alone. Poses at one and the same place share a tower, so a
node that stands still is replayed as a fixed tower is, bit by bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...common.counting import counted
from ...common.errors import UsageError
from ...common.units import AnyArray, BoolArray, FloatArray, IntArray
from ...site.site import Site, Tower
from ..geometry.arrays import Link, Poses
from ..options import Field, Job, Run, Search
from ..path_table import Ends
from ..replay import PER_LINK, Replay, replay
from .parts import in_turn

# Places of a node in one block: H of a block has this many times the links that count.
PLACES_AT_ONCE = 64

# Links (poses times places) of a block: some 4 MB of H with 4 x 4 elements.
LINKS_AT_ONCE = 16_384

# Element pairs that NumPy evaluates in the time of one pose with a source of its own.
WORK_PER_POSE = 200


@dataclass(frozen=True, slots=True)
class _Block:
    """Poses (rows of the flight) and their places: ``place`` (rows,) indexes ``places_m`` (places, 3)."""

    rows: IntArray
    places_m: FloatArray
    place: IntArray


def _blocks(sources_m: FloatArray) -> Iterator[_Block]:
    """Poses in blocks, in the order in which their places first occur."""
    unique, first, member = np.unique(sources_m, axis=0, return_index=True, return_inverse=True)
    # unique sorts places by coordinate; blocks follow the flight
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
    """The site with a tower's array at a place (3,) [m], above the ground that it had."""
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
    """Replay a flight against one tower that has a place of its own at every pose.

    Parameters
    ----------
    site : Site
    link : Link
        With one tower; its array keeps its orientation in the site.
    poses : Poses
    sources_m : (poses, 3)
        Centre of the tower's array at each pose, east, north, up [m].
    search, field, run
        As for :func:`aerpaw_cmp.propagation.replay.replay`, engine ``image``.

    Returns
    -------
    Replay
        As of one tower. ``paths`` run from the place that the tower had at their pose.

    Raises
    ------
    UsageError
        Another engine than ``image``, more than one tower; what :func:`replay` raises.

    Notes
    -----
    Exact: each pose is traced from its own place. Paths and fields are those of a fixed tower there.
    """
    if len(link.tower_arrays) != 1:
        raise UsageError(
            f"{counted(len(link.tower_arrays), 'tower')} in a link whose tower moves",
            expected="one tower: links of their own",
        )
    (name,) = link.tower_arrays
    if search.engine != "image":
        raise UsageError(
            f"towers.{name} moves and the engine is {search.engine!r}",
            expected="rt.engine: image (or --engine image)",
            cause="Sionna takes towers that stand still; each place of the node would be a scene of its own",
        )
    progress, run = run.progress, replace(run, progress=None)
    blocks = list(_blocks(sources_m))
    if not blocks:
        return replay(site, link, poses, search, field, run)
    if len(blocks) > 1:
        run = replace(run, job=_shared_by_blocks(link, poses, sources_m))

    def of(block: _Block) -> Replay:
        moved_site, several, some, links = _scene_of(site, link, name, poses, block)
        return _of_one_tower(replay(moved_site, several, some, replace(search, links=links), field, run), name, block)

    # lazily: a block is traced when it is put in, so one scene is alive at a time
    result = in_turn([block.rows for block in blocks], map(of, blocks), progress)
    return replace(result, ends=Ends(link, poses, sources_m[:, None], field))


def _shared_by_blocks(link: Link, poses: Poses, sources_m: FloatArray) -> Job:
    """Properties of all blocks that each must know: one tolerance, and whether compiled code is worth loading."""
    pairs = len(poses) * len(link.uav_array) * sum(map(len, link.tower_arrays.values()))
    points = np.concatenate([poses.position_m, sources_m])
    return Job.of(points, 0, pairs * WORK_PER_POSE)  # each place has few faces in reach: mirror images


def _scene_of(
    site: Site, link: Link, name: str, poses: Poses, block: _Block
) -> tuple[Site, Link, Poses, BoolArray | None]:
    """Site, link and poses of a block, each place a tower; which links count."""
    # one place keeps the tower's own name, so that it is replayed as a fixed tower is
    names = [name] if len(block.places_m) == 1 else [f"{name}@{i}" for i in range(len(block.places_m))]
    towers = {n: _moved(site, site.towers[name], n, at) for n, at in zip(names, block.places_m, strict=True)}
    moved_site = replace(site, towers={**{n: t for n, t in site.towers.items() if n != name}, **towers})
    several = replace(link, tower_arrays=dict.fromkeys(names, link.tower_arrays[name]))
    some = poses[block.rows]
    # each place has links to its own poses alone: all others would be searched for nothing
    links = None if len(names) == 1 else np.arange(len(names))[:, None] == block.place[None, :]
    return moved_site, several, some, links


def _of_one_tower(replayed: Replay, name: str, block: _Block) -> Replay:
    """Replay of a block as of one tower, which had its own place at each pose."""
    row = np.arange(len(block.rows))

    def at_place(values: AnyArray) -> AnyArray:
        return np.ascontiguousarray(values[row, block.place][:, None])

    columns: dict[str, Any] = {name: at_place(getattr(replayed, name)) for name in PER_LINK}
    return replace(
        replayed,
        **columns,
        contributions=tuple(replace(some, tower=np.zeros_like(some.tower)) for some in replayed.contributions),
        towers=(name,),
        omitted=[replace(item, tower=name if item.tower else "") for item in replayed.omitted],
    )
