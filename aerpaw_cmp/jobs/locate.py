"""The ``locate`` job: estimate the position of the ground end of a link from the levels of a flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import InputError, UsageError
from ..common.jsonable import json_object
from ..common.outputs import OutputFolder
from ..common.stages import Stages
from ..compare.locate import LevelTrack, NodeEstimate, locate
from ..flight.data import check_place, choose_site, is_ratio, read_logs, site_place
from ..flight.drafting.draft import floor_of
from ..flight.drafting.proposals import NodeFinder, searching_airframe, with_antennas
from ..flight.gains import load_with_learned
from ..flight.rows import may_lose_lock
from ..flight.settings import FlightFile
from ..flight.training import among, mark_of
from ..logs.ingest import IngestedFile
from ..logs.records import Stream
from ..report.locate import write_locate
from ..report.page import Made, about
from ..site.antennas import MeasuredPattern
from ..site.learned import SpherePattern
from ..site.site import Site
from .options import DEFAULT, JobOutcome, RunOptions
from .tasks import inputs_of_flight


def run_locate(flight: Path, options: RunOptions = DEFAULT, channel: str | None = None) -> JobOutcome:
    """Estimate the position of an unknown node, and write its regions as a page and numbers.

    Parameters
    ----------
    flight : Path
        flight.yaml with telemetry and a log of levels. The position of its node is not used.
    options : RunOptions
        ``out`` is ``reports/locate-NAME`` by default.
    channel : str, optional
        Channel of the levels, by default the first channel in the logs.

    Returns
    -------
    JobOutcome

    Raises
    ------
    UsageError, InputError
        If there is no telemetry or no channel of this name, there are too few levels, or they do not determine a
        position.
    """
    settings, stages = load_with_learned(flight), Stages(options.progress)
    inputs = inputs_of_flight(settings, flight, options.logs_root)
    folder = options.out or Path("reports") / f"locate-{settings.flight.name}"
    with OutputFolder(folder, job="locate", inputs=inputs, force=options.force) as output:
        with stages("read"):
            site = choose_site(settings.site, flight.parent)
            vehicle, file, level, locks = _streams(settings, flight, options.logs_root, channel)
            check_place(site, flight, vehicle.frame)
            track = NodeFinder(site, vehicle).levels(level, floor_of(level, locks=locks))
        with stages("locate"):
            node, uav = _antennas(settings, flight, options.logs_root, track, (file, level))
            cautions = _cautions(settings, level.channel, uav)
            estimate = locate(with_antennas(track, uav, node))
        if not estimate.placed:
            raise InputError(
                "the levels do not determine a place: they fit a node 30 km away as well",
                expected="levels that decrease with the distance",
                cause="a receiver that logs one value, a hover, or a node far beyond the flight",
                path=flight,
            )
        assumed = "unknown" if node is None else f"{node.name}, learned on other flights"
        ends = f"Antenna of the UAV: {'unknown' if uav is None else uav.name}. Antenna of the node: {assumed}."
        numbers = {"flight": settings.flight.name, "channel": level.channel, **_numbers(site, track, estimate, ends)}
        numbers["warnings"] = (*cautions, *numbers["warnings"])
        metrics = json_object(**numbers, **about(Made()))
        with output.filling() as part:
            written = write_locate(metrics, estimate.regions, track.position_m, site, part)
        return JobOutcome(folder=folder, metrics=metrics, files=output.placed(written))


def _streams(
    settings: FlightFile, flight: Path, logs_root: Path | None, channel: str | None
) -> tuple[Stream, IngestedFile, Stream, bool]:
    """Return the longest telemetry, the file of the chosen levels, these levels, and whether a log contains a lock."""
    streams = [(f, stream) for f in read_logs(settings, flight.parent, logs_root) for stream in f.result.streams]
    vehicles = [s for _, s in streams if s.kind == "telemetry"]
    levels = {s.channel: (f, s) for f, s in reversed(streams) if s.kind == "rss" and not is_ratio(s)}
    if not vehicles or not levels:
        missing = "telemetry" if levels else "levels"
        raise InputError(f"no log has {missing}", expected="telemetry and levels of one flight", path=flight)
    if channel is not None and channel not in levels:
        raise UsageError(f"no channel {channel!r}", expected="one of " + ", ".join(reversed(levels)))
    file, level = levels[channel or list(levels)[-1]]
    locks = any(may_lose_lock(stream) for _, stream in streams)
    return max(vehicles, key=lambda s: len(s.frame)), file, level, locks


def _antennas(
    settings: FlightFile, flight: Path, logs_root: Path | None, track: LevelTrack, log: tuple[IngestedFile, Stream]
) -> tuple[MeasuredPattern | None, MeasuredPattern | None]:
    """Return the antennas of node and airframe in the flight file, else the learned airframe that the levels support.

    An airframe that was learned from this log is not used.
    """
    file, level = log
    # link.rss.tower describes the antennas of an unknown node, not a tower of the site
    known = settings.link.of(level.channel).build(["node"], logs_root or flight.parent)
    node, uav = (array.patterns[0] for array in (known.tower_arrays["node"], known.uav_array))
    mark = mark_of(level.frame["time"].to_numpy(), level.frame["rss_db"].to_numpy(np.float64))
    if isinstance(uav, MeasuredPattern) and not (file.sha256 in uav.trained_on or among(mark, uav.marks)):
        return node if isinstance(node, SpherePattern) else None, uav
    carrier_hz = settings.link.of(level.channel).carrier_hz
    place = site_place(settings.site.file, flight.parent)
    return None, searching_airframe(place, (file.sha256, mark), track, carrier_hz)


def _cautions(settings: FlightFile, channel: str, uav: MeasuredPattern | None) -> list[str]:
    """Return sentences about antennas that the flight file names but the search does not use."""
    own = [c for c in settings.cautions if c.key != "rank.receiver" and c.channel in (None, channel)]
    texts = [f"{caution.key}: {caution.text}." for caution in own]
    texts += [
        f"antennas.{key} is not used: the node is unknown here; link.rss.tower describes its antenna."
        for key in settings.antennas
        if key.endswith(f".{channel}")
    ]
    used = settings.link.of(channel).uav.antenna.file
    if "uav" in settings.antennas and (uav is None or used is None or uav.name not in used):
        texts.append("antennas.uav is not used: it was learned from this log.")
    return list(dict.fromkeys(texts))


def _numbers(site: Site, track: LevelTrack, estimate: NodeEstimate, ends: str) -> dict[str, Any]:
    """Return numbers and sentences about the node for metrics.json and the page. ``ends`` describes the antennas."""
    parts, names = estimate.regions.modes(), ("latitude_deg", "longitude_deg", "east_m", "north_m")
    angles = site.frame.to_geographic(*np.array([mode.place_m for mode in parts]).T)
    modes = [
        dict(zip(names, (*at, *mode.place_m), strict=True)) | {"share": mode.share, "radius_m": mode.radius_m}
        for *at, mode in zip(*angles, parts, strict=True)
    ]
    place = estimate.place_m[:2]
    position = dict(zip(names[:2], (float(v[0]) for v in site.frame.to_geographic(place[:1], place[1:])), strict=True))
    region50_m, region90_m = (estimate.regions.radius_m(place, part) for part in (0.5, 0.9))
    low, high = estimate.height_m
    floor = "not known" if not np.isfinite(track.floor_db) else f"{track.floor_db:.1f} dB; lower levels are not known"
    edge = "The region reaches the edge of the search, 400 m beyond the flight: the node may be farther away."
    return {
        "sentence": _sentence(position, modes, region90_m),
        "position": position,
        "region50_m": region50_m,
        "region90_m": region90_m,
        "modes": modes,
        "assumed": (
            f"Path-loss exponent {estimate.slope:.1f} ± {2.0 * estimate.slope_sd:.1f} (fitted, 95 %).",
            ends,
            f"Height of the node: {low:g} m"
            + ("." if low == high else f" or {high:g} m. The levels do not distinguish them."),
            f"Floor of the receiver: {floor}. Several strengths and correlation lengths of shadowing are weighted by "
            "how well they explain the levels. No path is ray-traced.",
        ),
        "warnings": (edge,) if estimate.at_edge else (),
    }


def _sentence(position: dict[str, float], modes: Sequence[dict[str, Any]], radius_m: float) -> str:
    if len(modes) == 1:
        at = f"{position['latitude_deg']:.6f}, {position['longitude_deg']:.6f}"
        return f"The node is most likely at {at} (latitude, longitude), with 90 % probability within {radius_m:.0f} m."
    places = [
        f"{m['latitude_deg']:.6f}, {m['longitude_deg']:.6f} (within {m['radius_m']:.0f} m, {100.0 * m['share']:.0f} %)"
        for m in modes
    ]
    return f"{len(modes)} places fit the levels: {'; '.join(places)}."
