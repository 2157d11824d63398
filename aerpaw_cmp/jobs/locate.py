"""The ``locate`` job: where the ground end of a link stands, by the levels that a flight measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import InputError, UsageError
from ..common.jsonable import named
from ..common.outputs import OutputFolder
from ..common.stages import Stages
from ..common.units import FloatArray
from ..compare.gains.spread import NO_SPREAD, Spread
from ..compare.learning.locate import FEWEST, UNKNOWN, LevelModel, LevelTrack, NodeEstimate, locate
from ..flight.data import choose_site, is_ratio, read_logs, site_place
from ..flight.drafting.draft import receiver_floor_db
from ..flight.drafting.node import Placer
from ..flight.drafting.remembered import searching_airframe, taught
from ..flight.gains.learned_gain import sphere_angles
from ..flight.gains.memory import load_with_learned
from ..flight.marks import mark_of
from ..flight.rows.lock import LOCK_FLOOR_DB, is_sounder_power
from ..logs.records import Stream
from ..report.pages.locate import LocatePage, locate_metrics, write_locate
from ..site.antenna.antennas import MeasuredPattern
from ..site.antenna.sphere_pattern import SpherePattern
from ..site.site import Site
from .options import DEFAULT, JobOutcome, RunOptions
from .tasks.manifest import inputs_of_flight

# Name under which the link is built; antennas of ``link.rss.tower`` are those of the node.
_NODE = "node"


def run_locate(flight: Path, options: RunOptions = DEFAULT, channel: str | None = None) -> JobOutcome:
    """Place of the unknown node and its regions, as a page and numbers.

    Parameters
    ----------
    flight : Path
        flight.yaml with telemetry and a log of levels; where its node stands is not asked.
    options : RunOptions
        ``out`` is ``reports/locate-NAME`` by default.
    channel : str, optional
        By default the first of the logs.

    Returns
    -------
    JobOutcome

    Raises
    ------
    UsageError, InputError
        No telemetry, no such channel, too few levels.
    """
    settings, stages = load_with_learned(flight), Stages(options.progress)
    inputs = inputs_of_flight(settings, flight, options.logs_root)
    folder = options.out or Path("reports") / f"locate-{settings.flight.name}"
    with OutputFolder(folder, job="locate", inputs=inputs, force=options.force) as output:
        with stages("read"):
            files = read_logs(settings, flight.parent, options.logs_root)
            site = choose_site(settings.site, flight.parent)
            streams = [(file, stream) for file in files for stream in file.result.streams]
            vehicles = [s for _, s in streams if s.kind == "telemetry"]
            levels = [(f, s) for f, s in streams if s.kind == "rss" and not is_ratio(s)]
            names = [_name(s) for _, s in levels]
            if not vehicles or not levels:
                missing = "telemetry" if levels else "levels"
                raise InputError(f"no log has {missing}", expected="telemetry and levels of one flight", path=flight)
            if channel is not None and channel not in names:
                raise UsageError(f"no channel {channel!r}", expected="one of " + ", ".join(names))
            file, level = levels[names.index(channel) if channel else 0]
            link = settings.link.channels.get(_name(level), settings.link.rss)
            known = link.build([_NODE], options.logs_root or flight.parent)
            node, uav = (a.patterns[0] for a in (known.tower_arrays[_NODE], known.uav_array))
            if not isinstance(uav, MeasuredPattern):
                mark = mark_of(level.frame["time"].to_numpy(), level.frame["rss_db"].to_numpy(np.float64))
                series, log = (_name(level), file.result.reader), (file.sha256, mark)
                node, uav = _remembered(site_place(settings.site.file, flight.parent), site, series, log)
        with stages("locate"):
            floor = LOCK_FLOOR_DB if is_sounder_power(level) else receiver_floor_db([level])
            floor = -np.inf if floor is None else floor
            placer = Placer(site, max(vehicles, key=lambda s: len(s.frame)))
            track = placer.levels(level, floor, uav if isinstance(uav, MeasuredPattern) else None)
            if len(track.level_db) < FEWEST:
                raise InputError(
                    f"{len(track.level_db)} bins of 4 s have a level and a position above 5 m",
                    expected=f"{FEWEST}",
                    cause="a short flight, or logs of two flights",
                    path=flight,
                )
            model, assumed = UNKNOWN, "unknown, one gain over the elevation"
            if track.airframe_db is not None and isinstance(node, SpherePattern):
                model, assumed = _model_of(node), f"{node.name}, learned on other flights"
                track = replace(track, airframe_db=_both_ends(track.airframe_db, node))
            airframe = uav.name if track.airframe_db is not None else "unknown"
            estimate = locate(track, model=model)
        ends = f"Antenna of the UAV: {airframe}. Antenna of the node: {assumed}."
        page = _page(settings.flight.name, level, site, track, estimate, ends)
        with output.filling() as part:
            written = write_locate(page, part)
        return JobOutcome(folder=folder, metrics=locate_metrics(page), files=output.placed(written))


def _remembered(place: str | Path, site: Site, series: tuple[str, str], log: tuple[str, str]) -> tuple[Any, Any]:
    """Antennas of a node that flights placed themselves and of their airframe; None where none fits."""
    both = next((t for name, t in taught(place, series, log).items() if name not in site.towers), None)
    return (both.tower, both.uav) if both else (None, searching_airframe(place, site.towers, series, log))


def _model_of(node: SpherePattern) -> LevelModel:
    """Levels about antennas that are known at both ends, near free space."""
    spread = Spread.from_text(node.notes) or NO_SPREAD
    scatter_db = spread.noise_sd_db or UNKNOWN.scatter_sd_db
    return LevelModel(slope=2.0, slope_sd=0.2, elevation_sd_db=spread.own_sd_db, scatter_sd_db=scatter_db)


def _both_ends(
    airframe_db: Callable[[FloatArray], FloatArray], node: SpherePattern
) -> Callable[[FloatArray], FloatArray]:
    return lambda towards: airframe_db(towards) + node.gain_dbi(*sphere_angles(-towards))


def _name(stream: Stream) -> str:
    return str(stream.attributes.get("channel") or stream.name)


def _page(flight: str, level: Stream, site: Site, track: LevelTrack, estimate: NodeEstimate, ends: str) -> LocatePage:
    regions, modes = estimate.regions, list[dict[str, float]]()
    for mode in regions.modes():
        (latitude,), (longitude,) = site.frame.to_geographic(mode.place_m[:1], mode.place_m[1:])
        place = dict(
            zip(
                ("latitude_deg", "longitude_deg", "east_m", "north_m"),
                (latitude, longitude, *mode.place_m),
                strict=True,
            )
        )
        modes.append({name: float(x) for name, x in place.items()} | named(mode, "share radius_m"))
    low, high = estimate.height_m
    floor = "none shows" if not np.isfinite(track.floor_db) else f"{track.floor_db:.1f} dB, below it only that is known"
    edge = "The likeliest place lies at the edge of the search: the node may stand farther away."
    return LocatePage(
        flight=flight,
        channel=_name(level),
        sentence=_sentence(modes, regions.radius_m(regions.modes()[0].place_m, 0.9)),
        position={key: modes[0][key] for key in ("latitude_deg", "longitude_deg")},
        region50_m=regions.radius_m(regions.modes()[0].place_m, 0.5),
        region90_m=regions.radius_m(regions.modes()[0].place_m, 0.9),
        modes=modes,
        assumed=(
            f"Path-loss exponent {estimate.slope:.1f} +- {2.0 * estimate.slope_sd:.1f} (fitted, 95 %).",
            ends,
            f"Height of the node: {low:g} m" + ("." if low == high else f" or {high:g} m; the levels do not decide."),
            f"Floor of the receiver: {floor}. Shadowing is remembered for 30 s; nothing is ray-traced.",
        ),
        warnings=(edge,) if estimate.at_edge else (),
        regions=regions,
        track_m=track.position_m,
        towers={name: tower.position_m for name, tower in site.towers.items()},
    )


def _sentence(modes: Sequence[dict[str, Any]], radius_m: float) -> str:
    places = [
        f"{m['latitude_deg']:.6f}, {m['longitude_deg']:.6f} (within {m['radius_m']:.0f} m, {100.0 * m['share']:.0f} %)"
        for m in modes
    ]
    if len(places) == 1:
        return f"The node most likely stands at {places[0].partition(' (')[0]}, 90 % within {radius_m:.0f} m."
    return f"{len(places)} places fit the levels: {'; '.join(places)}."
