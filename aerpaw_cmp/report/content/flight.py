"""Parts of a flight's report that surround its numbers (:mod:`aerpaw_cmp.compare.result`).

:mod:`aerpaw_cmp.report.content.flight_parts` fills these records; the rest of the room turns them into files.
Whatever a flight may lack is optional: a flight with rank only has ``rss=()``, one without a path anywhere has NaN
numbers, never invented ones.
Times are naive ``datetime64[ns]`` in UTC. A missing number is NaN (in ``metrics.json``: ``null``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ...common.units import AnyArray, FloatArray, IntArray
from ...compare.result import FlightResult
from ...logs.records import RejectedLine
from ...site.site import Site

if TYPE_CHECKING:  # loads half of what a prediction is scored by
    from .against import Against

# Ranks of a 4 x 4 channel, the bars of every histogram.
RANKS = (1, 2, 3, 4)

# Quantities that residuals are drawn against, and their axis labels.
GEOMETRY = {
    "distance_m": "Distance tower to UAV [m]",
    "elevation_deg": "Elevation of the UAV seen from the tower [deg]",
    "azimuth_deg": "Azimuth of the UAV in the frame of the tower antenna [deg]",
    "heading_deg": "UAV heading [deg clockwise from north]",
    "altitude_m": "Height of the UAV above ground [m]",
    "uav_azimuth_deg": "Azimuth of the tower,\nUAV antenna frame [deg]",
    "uav_elevation_deg": "Elevation of the tower,\nUAV antenna frame [deg]",
    "foliage_depth_m": "Path length inside tree crowns [m]",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class InputFile:
    """An input; the account of a log has ``lines == accepted + rejected + blank``.

    ``rejected_lines`` may hold all of them or a sample; ``rejected`` is the count.
    """

    path: str
    sha256: str
    reader: str = ""
    lines: int = 0
    accepted: int = 0
    rejected: int = 0
    blank: int = 0
    role: str = ""
    warnings: tuple[str, ...] = ()
    rejected_lines: tuple[RejectedLine, ...] = ()
    learned_on: tuple[str, ...] = ()
    """SHA-256 of the logs that this file was learned from; none of other files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """The flown line: ``time`` (n,), positions (n,) in the site frame [m]."""

    time: AnyArray
    east_m: FloatArray
    north_m: FloatArray
    up_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """A named moment of the flight, e.g. ``A`` to ``F`` of the paper."""

    label: str
    time: np.datetime64
    east_m: float
    north_m: float
    up_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Origin of samples in the logs: names of the files, and per sample its file's number and its line, (n,)."""

    files: tuple[str, ...]
    file: IntArray
    line: IntArray


# Kind of drawn paths beside a number of reflections: any further one, as over an edge.
FURTHER = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class PosePaths:
    """Propagation paths of some poses of a tower, to be drawn.

    Parameters
    ----------
    tower : str
    time : (poses,) datetime64[ns]
        Samples of the tower's first channel.
    lines : tuple of tuples
        Per pose its paths: points (corners, 3) [m] from tower to UAV, and the number of reflections or another kind.
    """

    tower: str
    time: AnyArray
    lines: tuple[tuple[tuple[FloatArray, int], ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportData(FlightResult):
    """Everything a report shows: the numbers of the flight, and what stands around them.

    Parameters
    ----------
    title, flight : str
        Headline, and the short name that is the folder's name too.
    site : Site
    generated : str
        UTC, ISO 8601.
    versions : mapping of str to str
    inputs : tuple of InputFile
    track, waypoints
        The flown line, and its named moments.
    sources : mapping of str to Source
        Where the samples stand in the logs, by tower and channel.
    synthetic : bool
        The logs were made by ``aerpaw-cmp simulate``; said on the first screen.
    warnings : tuple of str
        What the reader must know before believing a number, one sentence each.
    doubts : tuple of str
        Clauses on clocks and heights for the first words.
    cautions : tuple of str
        Sentences on settings that do not fit; they come before all other cautions.
    antennas : tuple of str
        Sentences that name the antennas of the replay.
    notes : tuple of str
        Remarks for the end of the report.
    settings : mapping
        The checked flight.yaml, nested mappings of plain values.
    stages_s : mapping of str to float
        Seconds per named stage.
    extra_metrics : mapping
        Merged into ``metrics.json`` last, key by key.
    """

    title: str
    flight: str
    site: Site
    generated: str
    versions: Mapping[str, str] = field(default_factory=dict)
    inputs: tuple[InputFile, ...] = ()
    track: Track | None = None
    waypoints: tuple[Waypoint, ...] = ()
    sources: Mapping[str, Source] = field(default_factory=dict)
    synthetic: bool = False
    warnings: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()
    antennas: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    stages_s: Mapping[str, float] = field(default_factory=dict)
    extra_metrics: Mapping[str, Any] = field(default_factory=dict)
    paths: tuple[PosePaths, ...] = ()
    against: Against | None = None
    """What was predicted before the flight, where a prediction is named."""

    @property
    def moments(self) -> list[tuple[str, np.datetime64]]:
        """Label and instant of each waypoint."""
        return [(waypoint.label, waypoint.time) for waypoint in self.waypoints]


def start_of(data: ReportData) -> np.datetime64:
    """The instant that is zero on every time axis: the first of the track, or of any panel."""
    times = [] if data.track is None or not len(data.track.time) else [data.track.time[0]]
    times += [item.time[0] for item in data.series if len(item.time)]
    if not times:
        return np.datetime64(0, "ns")
    return times[0] if data.track is not None and len(data.track.time) else min(times)


def used_towers(data: ReportData) -> list[str]:
    """Towers that a panel of the report names, or all."""
    used = dict.fromkeys(item.tower for item in data.series)
    return [name for name in used if name in data.site.towers] or list(data.site.towers)
