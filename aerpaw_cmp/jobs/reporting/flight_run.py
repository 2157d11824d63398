"""One flight from its data to its numbers: clocks, replay, comparison, audit. Every job on a flight starts here.

A new stage (a ladder of models, the receiver's chain, a further audit) is a function of what stands before it, one
field of :class:`FlightRun` or of :class:`~aerpaw_cmp.compare.result.FlightResult`, and two lines in :func:`run_flight`.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from ...common.counting import counted
from ...common.stages import PlannedStage, Stages
from ...compare.flight_verdict import is_one_place
from ...compare.judge.causes import OF_DIRECTION, Cause
from ...compare.judge.ladder import series_rows
from ...compare.result import FlightResult
from ...flight.data import FlightData
from ...flight.replay import FlightReplay, replay_flight, try_replay
from .audit_flight import audit_replays
from .compare_flight import compare_flight, fitted_receiver
from .ladder import FlightLadder, flight_ladder


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightRun:
    """Record of what was computed of one flight.

    Parameters
    ----------
    data : FlightData
        As read: settings, site, logs, track, series.
    replays : FlightReplay
        Poses, paths, fields and clock of every series.
    result : FlightResult
        Numbers alone.
    ladder : FlightLadder, optional
        Which models the measurement asks for.
    """

    data: FlightData
    replays: FlightReplay
    result: FlightResult
    ladder: FlightLadder | None = None


def run_flight(
    data: FlightData,
    stages: Stages | None = None,
    *,
    replays: FlightReplay | None = None,
    audit: bool = True,
    anew: bool = False,
    ladder: bool = False,
) -> FlightRun:
    """Clocks, replay, comparison, audit and ladder.

    Parameters
    ----------
    data : FlightData
    stages : Stages, optional
        Times "clocks", "replay", "compare", "audit" and "ladder".
    replays : FlightReplay, optional
        Of this flight, where they were made before (:func:`~aerpaw_cmp.flight.replay.replay_flight`).
    audit : bool
        Also fill ``result.engine``, with the audit by the other engine where ``rt.audit_links`` asks for it.
    anew : bool
        Audit even what this machine audited before.
    ladder : bool
        Also score simpler and richer models of the RSS on stretches left out.

    Returns
    -------
    FlightRun
        Replays, numbers of the comparison, and the ladder where it was asked for.
    """
    stages = stages or Stages()
    replays = replays or replay_flight(data, stages)
    with stages("compare"):
        result = compare_flight(data, replays)
    if audit:
        with stages("audit"):
            result = dataclasses.replace(result, engine=audit_replays(data, replays.all, stages.progress, anew=anew))
    climbed: FlightLadder | None = None
    if ladder:
        with stages("ladder"):
            stages.progress("ladder of models")
            climbed = flight_ladder(data, replays)
            if climbed is not None:
                rows = (series_rows(climbed.ladder, index, name) for index, name in enumerate(climbed.names))
                result = dataclasses.replace(result, ladder=tuple(row for of_series in rows for row in of_series))
    result = dataclasses.replace(result, likely_cause=unrivalled(result.likely_cause, climbed))
    result = dataclasses.replace(result, next_step=next_step(data, result, climbed))
    return FlightRun(data=data, replays=replays, result=result, ladder=climbed)


def report_stages(data: FlightData, figures: str) -> list[PlannedStage]:
    """Return the stages of a report of a flight that was read, for its dry run; ``figures`` as for the report.

    One pose of every series is replayed and the receiver is read, so that a dry run refuses what the run would refuse.
    """
    try_replay(data)
    for series in data.rank:
        fitted_receiver(data, series.tower)
    n_rss, n_rank = (sum(len(item.time) for item in series) for series in (data.rss, data.rank))
    samples, rt = f"{counted(n_rss, 'RSS sample')}, {counted(n_rank, 'rank sample')}", data.settings.rt
    audited = min(rt.audit_links, n_rss + n_rank)
    drawn = 0 if figures == "none" else len(data.rss) + len(data.rank)
    clocked = bool(n_rss) and data.settings.rss.lag in ("estimate", "apply")
    stages = {
        "clocks": counted(len({series.tower for series in data.rss}), "receiver") if clocked else "",
        "replay": f"{samples}, engine {rt.engine}",
        "compare": samples,
        "audit": f"{counted(audited, 'link')} by the other engine" if audited else "",
        "ladder": "simpler and richer models" if n_rss and rt.engine == "image" else "",
        "report": f"page, figures of {counted(drawn, 'channel')}",
    }
    return [PlannedStage(name, work) for name, work in stages.items() if work]


def unrivalled(cause: Cause | None, climbed: FlightLadder | None) -> Cause | None:
    """The likely cause; None of a function of direction where the recommended model gains as much as it does."""
    if cause is None or cause.name not in OF_DIRECTION or climbed is None or climbed.recommended is None:
        return cause
    at, rmse_db = climbed.ladder.recommended, climbed.ladder.rmse_db
    assert at is not None
    return None if rmse_db[-1] - rmse_db[at] >= cause.rmse_db - cause.rmse_with_db else cause


def next_step(data: FlightData, result: FlightResult, climbed: FlightLadder | None) -> str | None:
    """A wider search of the offset, the step against the likely cause, or a model that is better than the one as set.

    Parameters
    ----------
    data : FlightData
    result : FlightResult
    climbed : FlightLadder, optional

    Returns
    -------
    str or None
        A clause; without any of these that of the comparison, and None for a training flight.
    """
    beyond = [panel for panel in result.rss if panel.score.at_edge]
    if beyond:
        # the offset is added to the measurement; ten further decibels, so that no edge is touched again
        missing = [float(np.nanmedian(panel.simulated_dbm - panel.measured_db)) for panel in beyond]
        low, high = data.settings.rss.span_db
        ends = (
            min(low, *(10 * math.floor(m / 10) - 10 for m in missing)),
            max(high, *(10 * math.ceil(m / 10) + 10 for m in missing)),
        )
        return f"`rss: {{span_db: [{ends[0]:.0f}, {ends[1]:.0f}]}}`"
    if any(panel.further.trained_on for panel in result.series):
        return None
    if result.likely_cause is not None:
        return result.likely_cause.next_step or None
    if is_one_place(result.rss):
        return "a flight along a route"
    if climbed is not None and climbed.recommended is not None:
        return "`aerpaw-cmp report FLIGHT --recommend FILE` writes settings significantly better than these"
    return result.next_step
