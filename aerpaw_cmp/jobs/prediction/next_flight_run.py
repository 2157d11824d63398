"""The ``plan`` command as named stages: rank, then write page, route files and map."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from ...common.outputs import OutputFolder
from ...common.stages import Stages
from ...common.versions import versions
from ...flight.route_files import kml_text, plan_text, waypoints_csv
from ...report.names import safe_name
from ...report.plan_html import PlanPage, plan_metrics, write_plan
from ..options import DEFAULT, JobOutcome, RunOptions
from .next_flight import FlightPlan, PlanAsked, plan_flight
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
        plan = plan_flight(target, known, asked, logs_root=options.logs_root, stages=stages)
        record = page_of(plan, stages.seconds)
        with output.filling() as place:
            options.progress("page")
            written = write_plan(record, place)
    files = tuple(folder / path.relative_to(place) for path in written)
    return JobOutcome(folder=folder, metrics=plan_metrics(record), files=files)


def sentence(plan: FlightPlan) -> str:
    """Opening text of the page."""
    best, minutes = plan.best, plan.best.route.duration_s / 60.0
    text = (
        f"Fly {best.route.name}: {best.route.length_m / 1000.0:.1f} km, {minutes:.0f} min. It lowers the standard "
        f"deviation over the target from {plan.now_db:.1f} to {best.sd_db:.1f} dB."
    )
    shorter = [p for p in plan.curve if p.minutes < 0.9 * minutes]
    if shorter:
        enough = shorter[-1]
        text += f" A flight of {enough.minutes:.0f} min leaves {enough.sd_db:.1f} dB."
    return text


def page_of(plan: FlightPlan, seconds: dict[str, float]) -> PlanPage:
    """The record of the page."""
    best, speed = plan.best, plan.asked.speed_mps
    ways, frame = best.route.waypoints, plan.site.frame
    return PlanPage(
        target=plan.target,
        sentence=sentence(plan),
        antennas=plan.antennas,
        flights=plan.flights,
        candidates=[
            {
                "name": c.route.name,
                "sd_db": c.sd_db,
                "length_m": c.route.length_m,
                "minutes": c.route.duration_s / 60.0,
                "refused": c.refused,
            }
            for c in plan.candidates
        ],
        curve=[{"minutes": p.minutes, "length_m": p.length_m, "sd_db": p.sd_db} for p in plan.curve],
        outline_m=np.array(plan.area.exterior.coords),
        holes_m=[np.array(ring.coords) for ring in plan.area.interiors],
        track_m=best.route.position_m,
        place_m=plan.place_m,
        before_db=plan.before_db,
        after_db=plan.after_db,
        towers={name: np.asarray(t.position_m) for name, t in plan.site.towers.items()},
        files={
            "route.plan": plan_text(ways, frame, speed),
            "route.kml": kml_text(ways, frame, best.route.name),
            "route.csv": waypoints_csv(ways, frame),
        },
        warnings=plan.warnings,
        generated=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        versions=versions(),
        stages_s=dict(seconds),
    )
