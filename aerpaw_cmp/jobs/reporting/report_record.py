"""From the run of a flight to the record that a report is written from."""

from __future__ import annotations

from collections.abc import Sequence

from ...report.build import report_data
from ...report.data import InputFile, ReportData
from .flight_run import FlightRun
from .foliage_notes import foliage_notes
from .pose_paths import pose_paths


def report_record(flight_run: FlightRun, others: Sequence[InputFile]) -> ReportData:
    """Record of a run, for its page and tables; ``others`` are the files it was made from besides the logs."""
    data, settings = flight_run.data, flight_run.data.settings
    carriers = {replayed.link.carrier_hz for replayed in flight_run.replays.all}
    notes = foliage_notes(len(data.site.trees), settings.rt, carriers)
    return report_data(
        data,
        flight_run.result,
        notes=notes,
        other_inputs=others,
        paths=pose_paths(data, flight_run.replays),
    )
