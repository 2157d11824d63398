"""Parts of a flight's report that surround its numbers: account of the logs, track, waypoints, warnings."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ...common.counting import counted
from ...common.jsonable import named
from ...common.units import FloatArray
from ...common.versions import utc_now, versions
from ...compare.result import APPLIED, NOT_APPLIED, ClockResult, FlightResult, RankResult, RssResult
from ...flight.data import FlightData
from ...flight.gains.memory import antennas_used
from ...flight.replay import FlightReplay, Replayed
from ...flight.settings import LogSettings
from ...logs.ingest import IngestedFile
from . import flight as record

# Poses per tower whose paths are drawn.
POSES = 300

# Paths of each further kind that are drawn of a pose.
SHORTEST = 8


def report_data(
    data: FlightData,
    result: FlightResult,
    *,
    notes: Sequence[str] = (),
    other_inputs: Sequence[record.InputFile] = (),
    paths: Sequence[record.PosePaths] = (),
) -> record.ReportData:
    """Everything a report shows.

    Parameters
    ----------
    data : FlightData
        Settings, site, logs and track.
    result : FlightResult
        The numbers.
    notes : sequence of str
        Remarks beside those of the flight file.
    other_inputs : sequence of InputFile
        Files besides the logs: settings, site, antennas.
    paths : sequence of PosePaths
        Paths at the samples, for the page that shows them.

    Returns
    -------
    ReportData
    """
    settings = data.settings
    warnings = [
        *clock_warnings(result.clocks),
        *data.warnings,
        *(text for item in result.rss for text in rss_warnings(item)),
        *(text for item in result.rank for text in rank_warnings(item)),
    ]
    sources = {
        panel.name: record.Source(files=tuple(log.path for log in settings.logs), file=series.log, line=series.line)
        for panel, series in zip(result.rss, data.rss, strict=True)
        if len(series.line) == len(series.time)
    }
    return record.ReportData(
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
        notes=(*settings.flight.notes, *notes),  # the page adds those of the site
        settings=settings.model_dump(mode="json"),
    )


# --- what must be known before a number is believed ------------------------------------------------------------------


def clock_warnings(clocks: Mapping[str, ClockResult]) -> tuple[str, ...]:
    """Clocks that were corrected, should be, or cannot be judged; a correction that was not made comes first.

    Receivers of one computer have one clock, and one sentence.
    """
    receivers: dict[str, list[str]] = {}
    for receiver in sorted(clocks, key=lambda receiver: clocks[receiver].applied != NOT_APPLIED):
        receivers.setdefault(_clock_warning(clocks[receiver]), []).append(receiver)
    return tuple(f"{', '.join(names)}: {text}" for text, names in receivers.items() if text)


def _clock_warning(clock: ClockResult) -> str:
    """Sentence on what one receiver's clock does to its numbers; "" when there is nothing to know."""
    if clock.applied == NOT_APPLIED:
        return f"rss.lag: apply was asked for, but the radio clock was not corrected: {clock.reason}."
    if clock.applied == APPLIED:
        return f"the radio clock is {clock.in_words}; it was corrected."
    if clock.shifted:
        return f"the radio clock is {clock.in_words}; it was not corrected (rss.lag: apply would)."
    if clock.verdict == "cannot tell":
        return f"the radio clock could not be checked: {clock.reason}."
    return ""


def rss_warnings(result: RssResult) -> tuple[str, ...]:
    """A channel that could not be compared, or whose offset is no result."""
    if result.score.n == 0:
        return (f"{result.name}: no sample could be compared; its numbers are missing, not zero.",)
    if result.score.at_edge:
        return (
            f"{result.name}: the best offset lies at the edge of the searched span, so it and its RMSE are no result. "
            "Widen rss.span_db, and check the transmit power and the unit of the log.",
        )
    return ()


def rank_warnings(result: RankResult) -> tuple[str, ...]:
    """Warnings that the reader must know of the rank of one tower before believing its numbers."""
    out = []
    if left_out := result.n_samples - len(result.time):
        of = counted(result.n_samples, "sample")
        out.append(f"Rank {result.tower}: {left_out} of {of} left out: too low, or without a pose.")
    if result.score.n == 0:
        out.append(f"Rank {result.tower}: the modem reported no rank at any compared pose.")
    if result.score.staleness.verdict == "held":
        out.append(
            f"Rank {result.tower}: the modem holds each report for about {result.score.staleness.hold_s:.1f} s; "
            f"{counted(result.score.n, 'sample')} hold {counted(result.score.staleness.n_reports, 'report')}."
        )
    return tuple(out)


# --- the flight ----------------------------------------------------------------------------------------------------


def _inputs_of(logs: Sequence[LogSettings], files: Sequence[IngestedFile]) -> tuple[record.InputFile, ...]:
    """The account of every log."""
    return tuple(
        record.InputFile(
            path=log.path,
            sha256=file.sha256,
            **named(file.result, "reader lines accepted blank warnings"),
            rejected=file.result.rejected_count,
            role=", ".join(sorted({s.kind for s in file.result.streams})),
            rejected_lines=file.result.rejected,
        )
        for log, file in zip(logs, files, strict=True)
    )


def track_of(data: FlightData) -> record.Track | None:
    """The flown line: telemetry's, or the rank log's own positions."""
    if data.track is not None and len(data.track):
        step_ns = max((data.track.end_ns - data.track.start_ns) // 2000, 500_000_000)
        time = np.arange(data.track.start_ns, data.track.end_ns + 1, step_ns).astype("datetime64[ns]")
        position = data.track.pose_at(time).position_m
    else:
        placed = next((s for s in data.rank if s.position_m is not None), None)
        if placed is None or placed.position_m is None:
            return None
        time, position = placed.time, placed.position_m
    return record.Track(time=time, east_m=position[:, 0], north_m=position[:, 1], up_m=position[:, 2])


def waypoints_of(data: FlightData) -> tuple[record.Waypoint, ...]:
    """Waypoints of the plan or the report settings, each at the moment the track comes nearest."""
    plan = data.settings.flight.plan
    points = data.settings.report.waypoints or (plan.waypoints if plan else [])
    track = track_of(data)
    if track is None:
        return ()
    out, start, line_m = [], 0, np.column_stack([track.east_m, track.north_m, track.up_m])
    for point in points:
        if not point.label:
            continue
        distance = np.linalg.norm(line_m[start:] - (point.east_m, point.north_m, point.height_m), axis=1)
        # the first moment it comes as near as it ever will (within 2 m): later visits belong to later waypoints
        near = np.flatnonzero(distance <= np.nanmin(distance) + 2.0)
        index = start + int(near[0])
        out.append(
            record.Waypoint(
                **named(point, "label east_m north_m"),
                time=track.time[index],
                up_m=point.height_m,
            )
        )
        start = index
    return tuple(out)


def pose_paths(data: FlightData, replays: FlightReplay) -> tuple[record.PosePaths, ...]:
    """Paths of each tower's first series at about :data:`POSES` of its poses, spread over the flight."""
    by_tower: dict[str, record.PosePaths] = {}
    for (_, series), replayed in zip(data.series, replays.all, strict=True):
        if series.tower not in by_tower and replayed.valid.any():
            poses = np.unique(np.linspace(0, len(replayed.poses) - 1, POSES).astype(np.int64))
            time = series.time[replayed.valid][poses]
            tower_m = np.broadcast_to(replayed.source_m(data.site), replayed.poses.position_m.shape)
            lines = tuple(tuple(_lines(replayed, pose, tower_m[pose])) for pose in poses)
            by_tower[series.tower] = record.PosePaths(tower=series.tower, time=time, lines=lines)
    return tuple(by_tower.values())


def _lines(replayed: Replayed, pose: int, tower_m: FloatArray) -> Iterator[tuple[FloatArray, int]]:
    """Polylines of a pose with their kind: number of reflections, or FURTHER."""
    replay, target_m = replayed.replay, replayed.poses.position_m[pose]
    for number, some in enumerate(replay.contributions):
        paths, kind = some.lines(), record.FURTHER if number else None
        start, stop = np.searchsorted(paths.pose, [pose, pose + 1])
        lines = [
            np.concatenate([tower_m[None], paths.vertices_m[row, : paths.depth[row]], target_m[None]])
            for row in range(start, stop)
        ]
        if kind is not None:
            lines = sorted(lines, key=lambda line: float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()))[
                :SHORTEST
            ]
        for line in lines:
            yield line, len(line) - 2 if kind is None else kind
