"""From the run of a flight to the record that a report is written from."""

from __future__ import annotations

from collections.abc import Sequence

from ..common.stages import Stages
from ..report.build import report_data
from ..report.data import InputFile, ReportData, SpeedRow
from .flight_run import FlightRun
from .pose_paths import pose_paths
from .what_if import foliage_notes


def report_record(flight_run: FlightRun, others: Sequence[InputFile], stages: Stages) -> ReportData:
    """What a report shows of a run.

    Parameters
    ----------
    flight_run : FlightRun
    others : sequence of InputFile
        What it was made from besides the logs.
    stages : Stages
        Times "speed", the table of speed against error, where it is asked for.
    """
    data, settings = flight_run.data, flight_run.data.settings
    speed: tuple[SpeedRow, ...] = ()
    if settings.report.speed_table and settings.rt.audit_links and settings.report.audit == "now":
        with stages("speed"):
            from .speed_table import speed_rows  # with it comes the other engine

            speed = speed_rows(data, [*flight_run.replays.rank, *flight_run.replays.rss][0], stages.progress)
    carriers = {replayed.link.carrier_hz for replayed in flight_run.replays.all}
    return report_data(
        data,
        flight_run.result,
        speed=speed,
        notes=foliage_notes(len(data.site.trees), settings.rt, carriers),
        other_inputs=others,
        paths=pose_paths(data, flight_run.replays),
    )
