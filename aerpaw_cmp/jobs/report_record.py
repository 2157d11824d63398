"""From the run of a flight to the record that a report is written from."""

from __future__ import annotations

from collections.abc import Sequence

from ..common.stages import Stages
from ..report.build import report_data
from ..report.data import InputFile, ReportData, SpeedRow
from .flight_run import FlightRun
from .pose_paths import pose_paths
from .what_if import foliage_notes


def report_record(ran: FlightRun, others: Sequence[InputFile], stages: Stages) -> ReportData:
    """What a report shows of a run.

    Parameters
    ----------
    ran : FlightRun
    others : sequence of InputFile
        What it was made from besides the logs.
    stages : Stages
        Times "speed", the table of speed against error, where it is asked for.
    """
    data, settings = ran.data, ran.data.settings
    speed: tuple[SpeedRow, ...] = ()
    if settings.report.speed_table and settings.rt.audit_links and settings.report.audit == "now":
        with stages("speed"):
            from .speed_table import speed_rows  # with it comes the other engine

            speed = speed_rows(data, [*ran.replays.rank, *ran.replays.rss][0], stages.progress)
    carriers = {replayed.link.carrier_hz for replayed in ran.replays.all}
    return report_data(
        data,
        ran.result,
        speed=speed,
        notes=foliage_notes(len(data.site.trees), settings.rt, carriers),
        other_inputs=others,
        paths=pose_paths(data, ran.replays),
    )
