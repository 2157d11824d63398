"""The content of a report: the numbers of :mod:`aerpaw_cmp.compare.result` and their context.

A flight with only rank has ``rss=()``. A missing number is NaN here, and ``null`` in ``metrics.json``. Times are naive
``datetime64[ns]`` in UTC.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.grouping import lists_by_key
from ..common.text import counted
from ..common.units import AnyArray, FloatArray, IntArray
from ..common.versions import utc_now, versions
from ..compare.result import APPLIED, NOT_APPLIED, Cause, ClockResult, FlightResult, RankResult, RssResult
from ..flight.gains import antennas_used
from ..logs.records import RejectedLine
from ..site.site import Site

if TYPE_CHECKING:  # import only for type checks, because these modules load pandas
    from ..flight.data import FlightData
    from ..flight.replay import FlightReplay, Replayed
    from ..flight.settings import LogSettings
    from ..logs.ingest import IngestedFile


# Ranks of a 4 x 4 channel, the bars of every histogram.
RANKS = (1, 2, 3, 4)

# Quantities against which residuals are plotted, with their axis labels.
GEOMETRY = {
    "distance_m": "Distance tower to UAV [m]",
    "elevation_deg": "Elevation of the UAV seen from the tower [deg]",
    "azimuth_deg": "Azimuth of the UAV in the frame of the tower antenna [deg]",
    "heading_deg": "UAV heading [deg clockwise from north]",
    "altitude_m": "Height of the UAV above ground [m]",
    "uav_azimuth_deg": "Azimuth of the tower, UAV antenna frame [deg]",
    "uav_elevation_deg": "Elevation of the tower, UAV antenna frame [deg]",
    "foliage_depth_m": "Path length inside tree crowns [m]",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class InputFile:
    """An input file. For a log, ``lines == accepted + rejected + blank``.

    ``rejected`` is the number of all rejected lines. ``rejected_lines`` may contain only some of them.

    Parameters
    ----------
    learned_on : tuple of str
        SHA-256 of the logs from which this file was learned. Empty for files that were not learned.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnTrack:
    """The track of the UAV: ``time`` (n,), and positions (n, 3) east, north and up in the site frame [m]."""

    time: AnyArray
    position_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnPoint:
    """A named point of the flight, such as ``A`` to ``F`` of the paper."""

    label: str
    time: np.datetime64
    east_m: float
    north_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """The origin of samples in the logs: names of the files, and file and line number of each sample (n,)."""

    files: tuple[str, ...]
    file: IntArray
    line: IntArray


# Kind of a path that does not consist of reflections only, such as a diffracted path.
FURTHER = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class PosePaths:
    """The propagation paths that a page draws for some poses of a tower.

    Parameters
    ----------
    tower : str
    time : (poses,) datetime64[ns]
        Times of the poses, from the first channel of the tower.
    lines : tuple of tuples
        Paths of each pose. A path has points (corners, 3) from tower to UAV [m], and its number of reflections or
        :data:`FURTHER`.
    """

    tower: str
    time: AnyArray
    lines: tuple[tuple[tuple[FloatArray, int], ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportData(FlightResult):
    """The content of a report: the numbers of the flight and their context.

    Parameters
    ----------
    title, flight : str
        Headline, and the short name, which is also the name of the folder.
    site : Site
    generated : str
        Time at which the report was made (UTC, ISO 8601).
    versions : mapping of str to str
    inputs : tuple of InputFile
    track, waypoints
        The track of the UAV, and the named points of the flight.
    sources : mapping of str to Source
        Origin of the samples in the logs, by tower and channel.
    synthetic : bool
        True if ``aerpaw-cmp simulate`` wrote the logs. The page then says so at the top.
    warnings : tuple of str
        Sentences about limits of the numbers.
    doubts : tuple of str
        Clauses about clocks and heights for the summary.
    cautions : tuple of str
        Sentences about settings that do not fit the flight, which are shown before all warnings.
    antennas : tuple of str
        Sentences that name the antennas of the replay.
    notes : tuple of str
        Remarks for the end of the report.
    settings : mapping
        The checked flight.yaml as nested mappings of plain values.
    stages_s : mapping of str to float
        Seconds of each stage.
    extra_metrics : mapping
        Additional content of ``metrics.json``, merged last, key by key.
    """

    title: str
    flight: str
    site: Site
    generated: str
    versions: Mapping[str, str] = field(default_factory=dict)
    inputs: tuple[InputFile, ...] = ()
    track: DrawnTrack | None = None
    waypoints: tuple[DrawnPoint, ...] = ()
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


def start_of(data: ReportData) -> np.datetime64:
    """Return the zero of all time axes: the first time of the track, or of any series."""
    times = [] if data.track is None or not len(data.track.time) else [data.track.time[0]]
    times += [item.time[0] for item in data.series if len(item.time)]
    if not times:
        return np.datetime64(0, "ns")
    return times[0] if data.track is not None and len(data.track.time) else min(times)


def used_towers(data: ReportData) -> list[str]:
    """Return the towers with a series in the report, or all towers."""
    used = dict.fromkeys(item.tower for item in data.series)
    return [name for name in used if name in data.site.towers] or list(data.site.towers)


# Number of poses per tower whose paths are drawn.
POSES = 300

# Largest number of paths of kind :data:`FURTHER` that are drawn per pose. The shortest are drawn.
SHORTEST = 8


def report_data(
    data: FlightData,
    result: FlightResult,
    *,
    notes: Sequence[str] = (),
    other_inputs: Sequence[InputFile] = (),
    paths: Sequence[PosePaths] = (),
) -> ReportData:
    """Return the content of a report.

    Parameters
    ----------
    data : FlightData
        Settings, site, logs and track.
    result : FlightResult
        Numbers of the flight.
    notes : sequence of str
        Remarks in addition to the notes of the flight file.
    other_inputs : sequence of InputFile
        Files other than logs: settings, site, antennas.
    paths : sequence of PosePaths
        Paths that the page draws.

    Returns
    -------
    ReportData
    """
    settings = data.settings
    warnings = [
        *clock_warnings(result.clocks, result.likely_cause),
        *data.warnings,
        *(text for item in result.rss for text in rss_warnings(item)),
        *(text for item in result.rank for text in rank_warnings(item)),
    ]
    sources = {
        panel.name: Source(files=tuple(log.path for log in settings.logs), file=series.log, line=series.line)
        for panel, series in zip(result.rss, data.rss, strict=True)
        if len(series.line) == len(series.time)
    }
    return ReportData(
        **{field.name: getattr(result, field.name) for field in dataclasses.fields(result)},
        title=settings.flight.title or settings.flight.name,
        flight=settings.flight.name,
        site=data.site,
        generated=utc_now(),
        versions=versions(),
        inputs=(*_inputs_of(settings.logs, data.files), *other_inputs),
        track=track_of(data),
        waypoints=waypoints_of(data),
        paths=tuple(paths),
        sources=sources,
        synthetic=settings.flight.synthetic,
        warnings=tuple(dict.fromkeys(warnings)),
        doubts=data.doubts,
        cautions=data.cautions,
        antennas=antennas_used([(s.tower, s.channel, s.link) for s in data.rss]),
        notes=(*settings.flight.notes, *notes),  # the page adds the notes of the site
        settings=settings.model_dump(mode="json"),
    )


# --- warnings --------------------------------------------------------------------------------------------------------


def clock_warnings(clocks: Mapping[str, ClockResult], cause: Cause | None = None) -> tuple[str, ...]:
    """Return sentences about clocks that were or should be corrected, or could not be checked.

    Requested corrections that were not made come first. There is one sentence per clock, because receivers of one
    computer share a clock. A clock that is the likely cause is omitted, because the summary names it.
    """
    named = cause.channels if cause is not None and "clock" in cause.name.split(" or ") else ()
    late = {channel.partition(" ")[0] for channel in named}
    clocks = {receiver: clock for receiver, clock in clocks.items() if not (clock.shifted and receiver in late)}
    ordered = sorted(clocks, key=lambda receiver: clocks[receiver].applied != NOT_APPLIED)
    receivers = lists_by_key((_clock_warning(clocks[receiver]), receiver) for receiver in ordered)
    return tuple(f"{', '.join(names)}: {text}" for text, names in receivers.items() if text)


def _clock_warning(clock: ClockResult) -> str:
    """Return the sentence about the clock of one receiver. Empty if the clock is right."""
    if clock.applied == NOT_APPLIED:
        return f"rss.lag: apply is set, but the radio clock was not corrected: {clock.reason}."
    if clock.applied == APPLIED:
        return f"the radio clock is {clock.in_words}; it was corrected."
    if clock.shifted:
        return f"the radio clock is {clock.in_words}; it was not corrected. Set rss.lag: apply to correct it."
    if clock.verdict == "cannot tell":
        return f"the radio clock could not be checked: {clock.reason}."
    return ""


def rss_warnings(result: RssResult) -> tuple[str, ...]:
    """Return warnings about a channel that could not be compared, or whose offset is at the end of the search range."""
    if result.score.n == 0:
        return (f"{result.name}: no sample could be compared; its numbers are missing, not zero.",)
    if result.score.at_edge:
        return (
            f"{result.name}: the best offset is at the end of its search range, so offset and RMSE are not valid. "
            "Widen rss.span_db, and check the transmit power and the unit of the log.",
        )
    return ()


def rank_warnings(result: RankResult) -> tuple[str, ...]:
    """Return warnings about the rank at one tower."""
    out = []
    if left_out := result.n_samples - len(result.time):
        of = counted(result.n_samples, "sample")
        out.append(
            f"Rank {result.tower}: {left_out} of {of} were not used: the UAV was too low, or its position is unknown."
        )
    if result.score.n == 0:
        out.append(f"Rank {result.tower}: the modem reported no rank at any compared pose.")
    if result.score.staleness.verdict == "held":
        out.append(
            f"Rank {result.tower}: the modem holds each report for about {result.score.staleness.hold_s:.1f} s; "
            f"{counted(result.score.n, 'sample')} contain {counted(result.score.staleness.n_reports, 'report')}."
        )
    return tuple(out)


# --- the flight ----------------------------------------------------------------------------------------------------


def _inputs_of(logs: Sequence[LogSettings], files: Sequence[IngestedFile]) -> tuple[InputFile, ...]:
    """Return the record of every log, with its numbers of lines."""
    return tuple(
        InputFile(
            path=log.path,
            sha256=file.sha256,
            reader=file.result.reader, lines=file.result.lines, accepted=file.result.accepted,
            blank=file.result.blank, warnings=file.result.warnings,
            rejected=file.result.rejected_count,
            role=", ".join(sorted({s.kind for s in file.result.streams})),
            rejected_lines=file.result.rejected,
        )
        for log, file in zip(logs, files, strict=True)
    )  # fmt: skip


def track_of(data: FlightData) -> DrawnTrack | None:
    """Return the track from the telemetry, or from positions in the rank log."""
    if data.track is not None and len(data.track):
        step_ns = max((data.track.end_ns - data.track.start_ns) // 2000, 500_000_000)
        time = np.arange(data.track.start_ns, data.track.end_ns + 1, step_ns).astype("datetime64[ns]")
        position = data.track.pose_at(time).position_m
    else:
        placed = next((s for s in data.rank if s.position_m is not None), None)
        if placed is None or placed.position_m is None:
            return None
        time, position = placed.time, placed.position_m
    return DrawnTrack(time=time, position_m=position)


def waypoints_of(data: FlightData) -> tuple[DrawnPoint, ...]:
    """Return the waypoints of the plan or of the report settings, each at the time when the track is nearest to it."""
    plan = data.settings.flight.plan
    points = data.settings.report.waypoints or (plan.waypoints if plan else [])
    track = track_of(data)
    if track is None:
        return ()
    out, start, line_m = [], 0, track.position_m
    for point in points:
        distance = np.linalg.norm(line_m[start:] - (point.east_m, point.north_m, point.height_m), axis=1)
        if not point.label or np.isnan(distance).all():
            continue
        # use the first time within 2 m of the smallest distance, because later visits belong to later waypoints
        near = np.flatnonzero(distance <= np.nanmin(distance) + 2.0)
        index = start + int(near[0])
        out.append(DrawnPoint(label=point.label, time=track.time[index], east_m=point.east_m, north_m=point.north_m))
        start = index
    return tuple(out)


def pose_paths(data: FlightData, replays: FlightReplay) -> tuple[PosePaths, ...]:
    """Return paths of the first series of each tower at about :data:`POSES` poses, spread over the flight."""
    by_tower: dict[str, PosePaths] = {}
    for (_, series), replayed in zip(data.series, replays.all, strict=True):
        if series.tower not in by_tower and replayed.valid.any():
            poses = np.unique(np.linspace(0, len(replayed.poses) - 1, POSES).astype(np.int64))
            time = series.time[replayed.valid][poses]
            tower_m = np.broadcast_to(replayed.source_m(data.site), replayed.poses.position_m.shape)
            lines = tuple(tuple(_lines(replayed, pose, tower_m[pose])) for pose in poses)
            by_tower[series.tower] = PosePaths(tower=series.tower, time=time, lines=lines)
    return tuple(by_tower.values())


def _lines(replayed: Replayed, pose: int, tower_m: FloatArray) -> Iterator[tuple[FloatArray, int]]:
    """Yield the lines of a pose with their kind: the number of reflections, or FURTHER."""
    replay, target_m = replayed.replay, replayed.poses.position_m[pose]
    for number, some in enumerate(replay.contributions):
        paths = some.lines()
        start, stop = np.searchsorted(paths.pose, [pose, pose + 1])
        lines = [
            np.concatenate([tower_m[None], paths.vertices_m[row, : paths.depth[row]], target_m[None]])
            for row in range(start, stop)
        ]
        if number:
            lines = sorted(lines, key=lambda line: float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()))[
                :SHORTEST
            ]
        yield from ((line, FURTHER if number else len(line) - 2) for line in lines)
