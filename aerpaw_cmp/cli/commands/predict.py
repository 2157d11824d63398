"""``predict``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from ...jobs.options import RunOptions
from ..app import Flights, Force, Json, LogsRoot, command, output
from ..shown import print_json, records, say, show, warn_all


@command(
    "predict",
    examples=[
        "aerpaw-cmp predict plan.kml --with flight1.yaml --with flight2.yaml -o prediction",
        "aerpaw-cmp predict plan.kml --site lake_wheeler -o prediction",
        "aerpaw-cmp predict next_flight.yaml --with flight1.yaml",
        "aerpaw-cmp predict lake_wheeler --with flight1.yaml --height 40 --height 80 --spacing 30",
    ],
)
def predict(
    where: Annotated[
        Path,
        Argument(
            metavar="WHERE",
            help="A route (.plan, KML, CSV, a vehicle log), flight.yaml (its plan), points (CSV with east_m, north_m, "
            "height_m), or a site (a grid).",
        ),
    ],
    flights: Flights = None,
    site: Annotated[str | None, Option(help="Site of a route or of points, without --with.")] = None,
    out: Annotated[Path | None, output("Output folder  [default: reports/prediction-<WHERE>]")] = None,
    height: Annotated[
        list[float] | None,
        Option(help="Height of a grid [m], repeatable; of route points without one  [default: 40]"),
    ] = None,
    spacing: Annotated[float, Option(min=1.0, help="Spacing of a grid [m].")] = 30.0,
    heading: Annotated[
        float | None,
        Option(help="Heading at all points [deg]  [default: that of the route; where it says none, all count alike]"),
    ] = None,
    logs_root: LogsRoot = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Predict level and rank with error bars where nobody has flown yet."""
    from ...jobs.prediction.predict import run_predict
    from ...jobs.prediction.where import TargetOptions

    outcome = run_predict(
        where,
        flights or (),
        TargetOptions(heights_m=tuple(height or (40.0,)), spacing_m=spacing, heading_deg=heading, site=site),
        RunOptions(out=out, logs_root=logs_root, force=force, progress=say),
    )
    print_json(outcome.metrics) if as_json else _print_summary(outcome)


def _print_summary(outcome: Any) -> None:
    m = outcome.metrics
    show(m["sentence"])
    series = [{"name": name, **numbers} for name, numbers in m["series"].items()]
    columns = {
        "series": "name", "unit": "unit", "mean level": "mean_level_db:.1f", "mean SD dB": "mean_sd_db:.1f",
        "outside flown": "share_outside_flown:.0%", "points": "points",
    }  # fmt: skip
    records(series, columns, "Prediction")
    warn_all(m["warnings"])
    show(f"page: {outcome.folder / 'prediction.html'}")
