"""Commands before a flight (``predict``, ``plan``, ``channel``) and ``locate``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from ...common.text import counted
from ...jobs.options import HIGHEST_M, RunOptions
from ..app import Flights, command, of_run
from ..shown import answered, print_files, records, say, show, warn_all

_HEIGHT = Option(
    min=0.1,
    max=HIGHEST_M,
    help="Height [m] of a grid, of the tool's own routes, and of route points without a height; repeatable  "
    "[default: 40]",
)


@command(
    "predict",
    examples=[
        "aerpaw-cmp predict plan.kml --with flight1.yaml --with flight2.yaml -o prediction",
        "aerpaw-cmp predict plan.kml --site lake_wheeler -o prediction",
        "aerpaw-cmp predict route.kml --site my_site.yaml --carrier-ghz 3.4 --tx-power-dbm 30",
        "aerpaw-cmp predict next_flight.yaml --with flight1.yaml",
        "aerpaw-cmp predict lake_wheeler --with flight1.yaml --height 40 --height 80 --spacing 30",
    ],
    options=of_run("Output folder  [default: reports/prediction-<WHERE>]", "logs_root", "dry", "force"),
)
def predict(
    options: RunOptions,
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
    height: Annotated[list[float] | None, _HEIGHT] = None,
    spacing: Annotated[float | None, Option(min=1.0, help="Spacing of a grid [m]  [default: 30]")] = None,
    heading: Annotated[
        float | None,
        Option(help="Heading at all points [deg]  [default: heading of the route, or all headings equally]"),
    ] = None,
    carrier_ghz: Annotated[
        float | None, Option(min=0.1, max=100.0, help="Carrier frequency, if no flight is given [GHz].")
    ] = None,
    tx_power_dbm: Annotated[float | None, Option(help="Transmit power, if no flight is given [dBm].")] = None,
) -> None:
    """Predict level and rank with error bars for positions without flights."""
    from ...jobs.predict import run_predict
    from ...jobs.sources import TargetOptions

    target = TargetOptions(
        heights_m=tuple(height or (40.0,)),
        spacing_m=spacing,
        heading_deg=heading,
        site=site,
        carrier_hz=None if carrier_ghz is None else carrier_ghz * 1e9,
        tx_power_dbm=tx_power_dbm,
    )
    outcome = run_predict(where, flights or (), target, options)
    if not answered(outcome.metrics):
        _print_prediction(outcome)


def _print_prediction(outcome: Any) -> None:
    m = outcome.metrics
    show(m["sentence"])
    series = [{"name": name, **numbers} for name, numbers in m["series"].items()]
    columns = {
        "channel": "name", "unit": "unit", "mean level": "mean_level_db:.1f", "mean SD dB": "mean_sd_db:.1f",
        **({"outside flown area": "share_outside_flown:.0%"} if m["flights"] else {}), "points": "points",
    }  # fmt: skip
    records(series, columns, "Prediction")
    for note in m["notes"]:
        say(note)
    warn_all(m["warnings"])
    show(f"page: {outcome.folder / 'prediction.html'}")


_FENCE = Option(metavar="KML", help="Area that may be flown  [default: the area of the site]")
_AVOID = Option(metavar="KML", help="No-fly areas; repeatable.")
_ROUTES = Option("--route", metavar="FILE", help="Another candidate: .plan, KML, CSV or log; repeatable.")


@command(
    "plan",
    examples=[
        "aerpaw-cmp plan sphere --site lake_wheeler --tower LW1 --geofence fence.kml --minutes 12",
        "aerpaw-cmp plan lake_wheeler --with flight1.yaml --with flight2.yaml --geofence fence.kml -o next",
        "aerpaw-cmp plan mission.plan --with flight1.yaml --route a.kml --route b.plan",
    ],
    options=of_run("Output folder  [default: reports/plan-<TARGET>]", "logs_root", "dry", "force"),
)
def plan(
    options: RunOptions,
    target: Annotated[str, Argument(help="Target: sphere (all directions), a site (a grid), a route, or points.")],
    flights: Flights = None,
    site: Annotated[str | None, Option(help="Site, if no flight names it.")] = None,
    tower: Annotated[
        list[str] | None, Option(help="Tower whose antenna is considered, without --with; repeatable  [default: all]")
    ] = None,
    geofence: Annotated[Path | None, _FENCE] = None,
    avoid: Annotated[list[Path] | None, _AVOID] = None,
    routes: Annotated[list[Path] | None, _ROUTES] = None,
    minutes: Annotated[float, Option(min=1.0, max=240.0, help="Longest flight that the battery allows [min].")] = 15.0,
    speed: Annotated[float, Option(min=0.5, max=40.0, help="Speed [m/s].")] = 8.0,
    height: Annotated[list[float] | None, _HEIGHT] = None,
    tower_distance: Annotated[float, Option(min=0.0, help="Smallest distance to towers [m].")] = 30.0,
) -> None:
    """Rank candidate flights by how much they would reduce the prediction's standard deviation."""
    from ...jobs.next_flight import PlanOptions, run_plan
    from ...jobs.sources import TargetOptions

    chosen = PlanOptions(
        minutes=minutes,
        speed_mps=speed,
        heights_m=tuple(height or (40.0,)),
        tower_distance_m=tower_distance,
        fence=geofence,
        avoid=tuple(avoid or ()),
        routes=tuple(routes or ()),
        towers=tuple(tower or ()),
        target=TargetOptions(heights_m=tuple(height or (40.0,)), grid_spacing_m=60.0, site=site),
    )
    outcome = run_plan(target, flights or (), chosen, options)
    if not answered(outcome.metrics):
        _print_plan(outcome)


def _in_km(route: dict[str, Any]) -> dict[str, Any]:
    return {**route, "km": route["length_m"] / 1000.0, "flown": route.get("refused") or "yes"}


def _print_plan(outcome: Any) -> None:
    m = outcome.metrics
    show(m["sentence"])
    length = {"SD dB": "sd_db:.2f", "km": "km:.1f", "min": "minutes:.1f"}
    records([_in_km(c) for c in m["candidates"]], {"route": "name", **length, "may be flown": "flown"}, "Candidates")
    records([_in_km(p) for p in m["length"]], length, "SD after shorter and longer flights")
    warn_all(m["warnings"])
    show(f"page: {outcome.folder / 'plan.html'}")


@command(
    "channel",
    examples=[
        "aerpaw-cmp channel flight.yaml -o channel",
        "aerpaw-cmp channel flight.yaml --route plan.kml --tower LW1 --format netcdf --format csv",
        "aerpaw-cmp channel flight.yaml --link rank --bandwidth 20e6 --subcarriers 64 --step 5",
    ],
    options=of_run("Output folder  [default: reports/channel-<flight>]", "logs_root", "force"),
)
def channel(
    options: RunOptions,
    flight: Annotated[Path, Argument(help="flight.yaml with logs, with a plan, or with --route.")],
    route: Annotated[
        Path | None, Option(metavar="FILE", help="Route instead of the track: .plan, KML, CSV or log.")
    ] = None,
    link: Annotated[
        str | None, Option(help="rss, rank or a channel of the flight file  [default: its first channel, else rss]")
    ] = None,
    tower: Annotated[list[str] | None, Option(help="Tower; repeatable  [default: the towers of the logs]")] = None,
    step: Annotated[float, Option(min=0.001, help="Time between poses [s].")] = 1.0,
    formats: Annotated[
        list[str] | None, Option("--format", help="netcdf, npz, deepmimo, csv, all; repeatable  [default: netcdf]")
    ] = None,
    bandwidth: Annotated[
        float | None, Option(min=1.0, help="Also write H at the subcarriers of a band of this width [Hz] (NetCDF).")
    ] = None,
    subcarriers: Annotated[
        int | None, Option(min=1, max=65536, help="Number of subcarriers of the band  [default: 1024]")
    ] = None,
) -> None:
    """Write the channel along a flight or a route for the next simulation."""
    from ...jobs.channel import ChannelOptions, run_channel

    chosen = ChannelOptions(
        route=route,
        link=link,
        towers=tuple(tower or ()),
        step_s=step,
        formats=tuple(formats or ("netcdf",)),
        bandwidth_hz=bandwidth,
        subcarriers=subcarriers,
    )
    outcome = run_channel(flight, chosen, options)
    m = outcome.metrics
    which = f"Link {m['link']}{'' if link else ' (the default)'}, {m['carrier_hz'] / 1e9:g} GHz"
    size = f"{counted(m['paths'], 'path')}, {counted(m['poses'], 'pose')}"
    _print(outcome, f"{which}: {size}, towers {', '.join(m['towers'])}")


def _print(outcome: Any, sentence: str) -> None:
    """Print a sentence, warnings and paths of files, or only the metrics as JSON if ``--json`` is set."""
    if answered(outcome.metrics):
        return
    show(sentence)
    warn_all(outcome.metrics["warnings"])
    print_files(outcome.files)


@command(
    "locate",
    examples=["aerpaw-cmp locate flight.yaml -o where", "aerpaw-cmp locate flight.yaml --channel USRP1 --follow"],
    options=of_run("Output folder  [default: reports/locate-<flight>]", "logs_root", "force"),
)
def locate(
    options: RunOptions,
    flight: Annotated[Path, Argument(help="flight.yaml with telemetry and a log of levels; its nodes are not used.")],
    channel: Annotated[str | None, Option(help="Channel of the logs  [default: the first]")] = None,
    follow: Annotated[bool, Option("--follow", help="Repeat every 10 s while the logs grow, until Ctrl-C.")] = False,
) -> None:
    """Locate an unknown ground node from the levels of a flight."""
    from ...jobs.locate import run_locate

    while True:
        outcome = run_locate(flight, options, channel)
        _print(outcome, outcome.metrics["sentence"])
        if not follow:
            return
        time.sleep(10.0)
