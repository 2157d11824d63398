"""A replay in parts of its poses, put together again: bounds the memory of long flights."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...common.units import IntArray
from ...site.site import Site
from ..geometry.arrays import Link, Poses
from ..geometry.paths import Faces, PathSet, RowsT, joined
from ..options import Field, Job, Progress, Run, Search
from ..replay import PER_LINK, Replay, replay
from ..scene import Omission


def replay_in_parts(
    site: Site, link: Link, poses: Poses, search: Search, field: Field, run: Run, *, size: int
) -> Replay:
    """Replay at most ``size`` poses at once.

    Parameters
    ----------
    site, link, poses, search, field, run
        As for :func:`aerpaw_cmp.propagation.replay.replay`, engine ``image``.
    size : int
        Most poses of a part; the parts are of about one size.

    Returns
    -------
    Replay
        That of all poses at once.
    """
    rows = np.array_split(np.arange(len(poses)), max(1, -(-len(poses) // size)))
    if len(rows) == 1:
        return replay(site, link, poses, search, field, run)
    links = len(poses) * len(link.tower_arrays)
    pairs = links * len(link.uav_array) * len(next(iter(link.tower_arrays.values())))
    # each part would count from 0 to 1 again
    progress, run = run.progress, replace(run, progress=None, job=Job.of(poses.position_m, links, pairs))

    def of(at: IntArray) -> Replay:
        return replay(site, link, poses[at], search, field, run)

    result = in_turn(rows, map(of, rows), progress)
    return replace(result, ends=replace(result.ends, poses=poses))


def in_turn(rows: list[IntArray], parts: Iterable[Replay], progress: Progress | None) -> Replay:
    """One replay of parts that are made as they are asked for; ``rows`` are their poses."""
    replays: list[Replay] = []
    finished, count = 0, max(1, sum(map(len, rows)))
    for at, part in zip(rows, parts, strict=True):
        replays.append(part)
        finished += len(at)
        if progress is not None:
            progress(finished / count)
    return _put_together(replays, rows)


def _put_together(parts: list[Replay], rows: list[IntArray]) -> Replay:
    """One replay of parts, poses in their order; the parts are taken apart, so that memory holds them once."""
    first, count = parts[0], sum(map(len, rows))
    # planes of terrain are numbered as they are met: other blocks have others
    faces, shifted = _joined_faces(parts)
    pieces = [shifted, *zip(*(part.further for part in parts), strict=True)]
    further: dict[str, Any] = {
        "faces": faces,
        "seconds": sum(part.seconds for part in parts),
        "search_seconds": sum(part.search_seconds for part in parts),
        "omitted": added_up(item for part in parts for item in part.omitted),
        "contributions": tuple(_in_flight(piece, rows) for piece in pieces),
    }
    columns = {name: [getattr(part, name) for part in parts] for name in PER_LINK}
    parts.clear()
    arrays: dict[str, Any] = {}
    # one array at a time, whose parts are freed before the next: the peak is one array more
    for name in PER_LINK:
        values = columns.pop(name)
        arrays[name] = np.empty((count, *values[0].shape[1:]), dtype=values[0].dtype)
        for at, value in zip(rows, values, strict=True):
            arrays[name][at] = value
    return replace(first, **arrays, **further)


def _in_flight(parts: Sequence[RowsT], rows: list[IntArray]) -> RowsT:
    """Paths of all parts as one set: their poses are numbered as in the flight, and in order."""
    numbered = [replace(part, pose=at[part.pose]) for at, part in zip(rows, parts, strict=True)]  # type: ignore[type-var]
    paths = numbered[0].one_after_another(numbered)
    # stable: within a pose the order by tower, depth and faces stays
    return paths.select(np.argsort(paths.pose, kind="stable")) if (np.diff(paths.pose) < 0).any() else paths


def _joined_faces(parts: list[Replay]) -> tuple[Faces, list[PathSet]]:
    """Faces of all blocks and their paths over them; faces that all blocks share are held once."""
    common = min(_shared(parts[0].faces, part.faces) for part in parts)
    if all(len(part.faces) == common for part in parts):
        return parts[0].faces, [part.paths for part in parts]
    faces, out = parts[0].faces.select(np.arange(common)), []
    for part in parts:
        shift = len(faces) - common
        numbers = part.paths.faces
        out.append(replace(part.paths, faces=np.where(numbers >= common, numbers + shift, numbers)))
        faces = joined(faces, part.faces.select(np.arange(common, len(part.faces))))
    return faces, out


def _shared(first: Faces, second: Faces) -> int:
    """Number of faces, from the first on, that are the same in both."""
    count = min(len(first), len(second))
    same = (first.normal[:count] == second.normal[:count]).all(axis=1)
    same &= first.offset_m[:count] == second.offset_m[:count]
    # faces of two buildings may lie in one plane, and are two
    same &= np.array([a == b for a, b in zip(first.label, second.label, strict=False)], dtype=np.bool_)
    # argmin of booleans is the first that differs
    return count if same.all() else int(np.argmin(same))


def added_up(omissions: Iterable[Omission]) -> list[Omission]:
    """Omissions of the parts of a replay, each once, counts added up."""
    added: dict[tuple[str, str], Omission] = {}
    for item in omissions:
        key = item.tower, item.what
        before = added.get(key)
        counts = item.counts if before is None else tuple(map(sum, zip(before.counts, item.counts, strict=True)))
        added[key] = replace(item, counts=counts)
    return list(added.values())
