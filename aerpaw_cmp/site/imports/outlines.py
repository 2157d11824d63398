"""Contents of map files before cleaning: outlines, single trees, tree rows; and checks of their positions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import Polygon

from ...common.errors import InputError

# As OpenStreetMap's licence asks for it.
OSM_CREDIT = "(c) OpenStreetMap contributors, ODbL"

# Latitude, longitude [deg].
Position = tuple[float, float]

# What reading one element may raise: the element is left out and listed, the others stay.
BROKEN_ELEMENT = (InputError, TypeError, KeyError, AttributeError, IndexError, ValueError, OverflowError)


@dataclass(slots=True)
class Outline:
    """One area of a map file.

    Parameters
    ----------
    name : str
        Its name, or file and id.
    source : str
        File name and id.
    tags : mapping of str to str
        As in the file.
    parts : list of (outer ring, hole rings)
        Positions in degrees, as written.
    broken : list of str
        What was wrong while reading it.
    """

    name: str
    source: str
    tags: Mapping[str, str]
    parts: list[tuple[list[Position], list[list[Position]]]] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class TreeLine:
    """A single tree (one position) or a tree row (the corners of its line), with its tags."""

    source: str
    tags: Mapping[str, str]
    positions: tuple[Position, ...]


@dataclass(slots=True)
class MapFile:
    """All outlines and trees of a file, sentences about what is neither, and whose data they are where that shows."""

    kind: str
    credit: str = ""
    outlines: list[Outline] = field(default_factory=list)
    trees: list[TreeLine] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def take(self, other: MapFile) -> None:
        """Everything of a part of the file."""
        self.outlines += other.outlines
        self.trees += other.trees
        self.notes += other.notes

    def note_no_areas(self, name: str, lines: Counter[str]) -> None:
        """A note on what of a file ``name`` bounds no area, counted by its kind."""
        if lines:
            listed = ", ".join(f"{count} {what}" for what, count in lines.most_common())
            self.notes.append(f"{name}: left out, not areas: {listed}")


# A ring that crosses itself more often is no outline that could be repaired: the time to try grows without bound.
MAX_CROSSINGS = 1000


def is_tangled(ring: Polygon) -> bool:
    """Check whether a ring crosses itself at more than :data:`MAX_CROSSINGS` places; in pieces, with an early end."""
    line = np.asarray(ring.exterior.coords)[:, :2]
    segments = shapely.linestrings(np.stack([line[:-1], line[1:]], axis=1))
    # too few pairs to cross so often
    if len(segments) * (len(segments) - 1) // 2 <= MAX_CROSSINGS:
        return False
    tree, crossings = shapely.STRtree(segments), 0
    for start in range(0, len(segments), 64):
        crossings += tree.query(segments[start : start + 64], predicate="crosses").shape[1]
        if crossings > 2 * MAX_CROSSINGS:  # every place is seen from both sides
            return True
    return False


def lonlat(point: Any, where: str, path: Path) -> Position:
    """A position written longitude first; InputError when it is none."""
    try:
        longitude, latitude = float(point[0]), float(point[1])
    except (TypeError, ValueError, IndexError, KeyError, OverflowError):
        raise InputError(f"{where}: the position {str(point)[:40]} is not longitude, latitude", path=path) from None
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        raise InputError(f"{where}: a coordinate is not a number", path=path)
    return latitude, longitude


def reason(error: Exception) -> str:
    """Give the reason why an element cannot be used, in words."""
    if isinstance(error, InputError):
        return error.found
    if isinstance(error, KeyError):
        return f"it is not as it should be: no {error}"
    return "it is not as it should be"


def left_out(path: Path, line: int | None, what: str, error: Exception) -> str:
    """The line of the list about an element that cannot be used.

    Parameters
    ----------
    path : Path
        The map.
    line : int or None
        Where the element stands.
    what : str
        The element.
    error : Exception
        Why it cannot be used.

    Returns
    -------
    str
    """
    place = path.name if line is None else f"{path.name}, line {line}"
    why = reason(error).removeprefix(f"{path.name}: ").removeprefix(f"{what}: ")
    return f"warning: {place}: {what} was left out: {why}"
