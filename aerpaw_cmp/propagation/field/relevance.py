"""Relevance of buildings: those that could be left out without moving any RSS by more than a stated amount.

Judged from the paths that were found and their fields. With ``a_p`` the root-mean-square field of a path over element
pairs and ``F`` that of the link with all of its paths, leaving out paths that add up to ``B`` in amplitude moves the
RSS of the link by less than ``relevance_db`` whenever ``B <= F (1 - 10^(-relevance_db / 20))``. Nothing is left out of
the replay: a bound that is sharp enough to leave sequences out needs to know which poses they reach, and that is what
the search finds out (measured in docs/numerics.md).
"""

from __future__ import annotations

import numpy as np

from ...common.units import FloatArray, amplitude_from_db
from ..paths import Faces, PathSet

MOST_NAMED = 20
"""Objects that are named; the others are counted."""


def idle_objects(
    paths: PathSet, faces: Faces, path_power: FloatArray, link_power: FloatArray, relevance_db: float
) -> tuple[list[str], float]:
    """Objects whose reflections, all together, move no RSS by more than ``relevance_db``.

    Parameters
    ----------
    paths : PathSet
    faces : Faces
    path_power : (paths,)
        Mean over element pairs of ``|h|^2`` of each path alone, losses included.
    link_power : (poses, towers)
        The same of each link with all of its paths.
    relevance_db : float

    Returns
    -------
    labels : list of str
        Of the objects, weakest first; faces of one ``solid`` are one object, the ground is none.
    share : float
        Largest ratio, over the links, of what they add up to and what the link bears; at most 1.
    """
    towers = link_power.shape[1]
    bearable = np.sqrt(link_power).ravel() * float(1.0 - amplitude_from_db(-relevance_db))
    link = paths.pose * towers + paths.tower
    solid = np.append(faces.solid, -1)[paths.faces]
    amplitude = np.sqrt(path_power)
    # each object once per path, however many of its faces the path meets
    rows = np.concatenate([np.full((len(paths), 1), -1, dtype=np.int64), np.sort(solid, axis=1)], axis=1)
    path, place = np.nonzero((rows[:, 1:] != rows[:, :-1]) & (rows[:, 1:] >= 0))
    number = rows[path, place + 1]
    harm = amplitude[path] / np.maximum(bearable[link[path]], 1e-300)
    worst = np.zeros(int(faces.solid.max(initial=-1)) + 1)
    np.maximum.at(worst, number, harm)
    order = np.argsort(number, kind="stable")
    edges = np.searchsorted(number[order], np.arange(len(worst) + 1))
    total = np.zeros(link_power.size)
    idle: list[int] = []
    for solid in np.argsort(worst, kind="stable").tolist():
        if worst[solid] > 1.0:
            break
        mine = order[edges[solid] : edges[solid + 1]]
        touched = link[path[mine]]
        np.add.at(total, touched, harm[mine])
        if len(touched) and total[touched].max() > 1.0:
            np.subtract.at(total, touched, harm[mine])
            continue
        idle.append(solid)
    return _labels(faces, idle), float(total.max(initial=0.0))


def _labels(faces: Faces, solids: list[int]) -> list[str]:
    first: dict[int, str] = {}
    for number, label in zip(faces.solid.tolist(), faces.label, strict=True):
        first.setdefault(number, label)
    return [first[n].rsplit(" wall", 1)[0].rsplit(" face", 1)[0].removesuffix(" roof") for n in solids if n in first]


def in_words(labels: list[str], relevance_db: float) -> list[str]:
    """For the report."""
    if not labels:
        return [f"every building moves the RSS of some link by more than {relevance_db:g} dB"]
    more = "" if len(labels) <= MOST_NAMED else f" and {len(labels) - MOST_NAMED} more"
    return [
        f"{', '.join(labels[:MOST_NAMED])}{more}: without their reflections no RSS would move by more than "
        f"{relevance_db:g} dB (they are in the replay)"
    ]
