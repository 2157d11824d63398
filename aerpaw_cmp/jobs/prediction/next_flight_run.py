"""The ``plan`` command as named stages: rank, then write page, route files and map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...common.outputs import OutputFolder
from ...common.stages import Stages
from ...report.names import safe_name
from ...report.plan_html import plan_metrics, write_plan
from ..options import DEFAULT, JobOutcome, RunOptions
from .next_flight import PlanAsked, plan_flight
from .sources import files_of, named_flights


def run_plan(target: str, flights: Sequence[Path], asked: PlanAsked, options: RunOptions = DEFAULT) -> JobOutcome:
    """Rank flights and write ``plan.html``, the chosen route, ``sd_map.csv``, ``metrics.json`` and figures.

    Parameters
    ----------
    target : str
        As for :func:`.next_flight.plan_flight`.
    flights : sequence of Path
    asked : PlanAsked
    options : RunOptions
        ``out`` is ``reports/plan-TARGET`` by default.

    Returns
    -------
    JobOutcome

    Raises
    ------
    UsageError, InputError
        With what was found, expected, and the likely cause.
    """
    inputs = [p for p in (Path(target), asked.fence, *asked.avoid, *asked.routes) if p is not None and p.is_file()]
    known = named_flights(flights)
    inputs += files_of(known, options.logs_root)
    stages = Stages(options.progress)
    folder = options.out or Path("reports") / f"plan-{safe_name(Path(target).stem)}"
    with OutputFolder(folder, job="plan", inputs=inputs, force=options.force) as output:
        record = plan_flight(target, known, asked, logs_root=options.logs_root, stages=stages)
        with output.filling() as place:
            options.progress("page")
            written = write_plan(record, place)
    files = tuple(folder / path.relative_to(place) for path in written)
    return JobOutcome(folder=folder, metrics=plan_metrics(record), files=files)
