"""The ``plan`` job: rank candidate flights by how much they would reduce the prediction's standard deviation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from ..common.errors import InputError, UsageError
from ..common.geodesy import bearing_deg
from ..common.outputs import OutputFolder
from ..common.stages import PlannedStage, Stages
from ..common.text import counted
from ..common.units import FloatArray
from ..compare.calibration import choose
from ..compare.field_gp import FlownFlights, rms_db
from ..compare.gains import GainModel, LinkSamples
from ..flight.route_files import read_areas
from ..flight.routes import (
    NOSES,
    Pattern,
    Route,
    Waypoint,
    allowed_area,
    cut,
    flown,
    plan_text,
    route_of,
    waypoints_csv,
)
from ..flight.training import counted_once
from ..report.plan import PlanPage, plan_metrics, write_plan
from ..report.texts import safe_name
from ..site.mapfiles import MAX_CROSSINGS, is_tangled
from ..site.site import Site
from . import sources
from .calibrate import learned_antennas, observe
from .options import DEFAULT, JobOutcome, RunOptions
from .predict import site_of

# Name of the target that contains all directions between tower and UAV, at all headings.
_SPHERE = "sphere"

_SPHERE_AWAY_M = 150.0
# Number of targets per antenna in the ranking.
_MOST_TARGETS = 600

# Number of headings at target points without a heading.
HEADINGS = 4

# Smallest distance of a route from the walls and the roof of a building [m].
_CLEARANCE_M = 3.0

# Largest number of corners of an area. Geofences are drawn by hand and have far fewer.
_MOST_CORNERS = 10_000
# A target is refused if all of it is farther than this outside the geofence, and so is a geofence outside the site [m].
_FARTHEST_M = 1000.0

# Shares of the battery for the curve over flight time.
SHARES = (0.25, 0.5, 0.75, 1.0, 1.5)

_ALLOWED_OUTSIDE_M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanOptions:
    """Options of ``plan``.

    Parameters
    ----------
    minutes, speed_mps : float
        Flight time of the battery [min], and speed [m/s].
    heights_m : tuple of float
        Heights of the patterns that this command proposes, above take-off.
    tower_distance_m : float
        Smallest horizontal distance to towers.
    fence : Path, optional
        KML of the geofence. Default: the area of the site.
    avoid : tuple of Path
        KMLs of no-fly areas.
    routes : tuple of Path
        Files of additional candidate routes.
    towers : tuple of str
        Towers whose antennas are considered, if no flight names them.
    target : TargetOptions
        Heights, spacing and heading of the grid for which the flight is planned, and the site if no flight names it.
    """

    minutes: float = 15.0
    speed_mps: float = 8.0
    heights_m: tuple[float, ...] = (40.0,)
    tower_distance_m: float = 30.0
    fence: Path | None = None
    avoid: tuple[Path, ...] = ()
    routes: tuple[Path, ...] = ()
    towers: tuple[str, ...] = ()
    target: sources.TargetOptions = field(default_factory=lambda: sources.TargetOptions(grid_spacing_m=60.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A candidate flight: route, pattern (None for a file), reason for a refusal, and SD after the flight [dB]."""

    route: Route
    pattern: Pattern | None = None
    refused: str = ""
    sd_db: float = math.nan

    @property
    def row(self) -> dict[str, Any]:
        """The entry of this candidate in metrics.json."""
        length = {"length_m": self.route.length_m, "minutes": self.route.duration_s / 60.0}
        return {"name": self.route.name, "sd_db": self.sd_db, **length, "refused": self.refused}


def _plan_flight(
    target: str, flights: Sequence[sources.NamedFlight], plan: PlanOptions, logs_root: Path | None, stages: Stages
) -> PlanPage:
    """Rank candidate flights by the standard deviation over a target after each flight.

    Parameters
    ----------
    target : str
        ``sphere``, or a target of :func:`.sources.find_targets`.
    flights : sequence of NamedFlight
        Earlier flights. If there are none, the antennas are unknown.
    plan : PlanOptions
    logs_root : Path or None
    stages : Stages

    Returns
    -------
    PlanPage
        Candidates, best first, the files of the best candidate, and the standard deviation before and after it.

    Raises
    ------
    UsageError, InputError
        If no candidate fits, the target is far outside, or a route cannot be read.
    """
    with stages("read"):
        datas, remarks = counted_once([flight.load(logs_root) for flight in flights])
        observed = observe(datas)[0] if datas else []
        site, _ = site_of(None if target == _SPHERE else Path(target), flights, datas, plan.target.site)
        received = sources.sources_of(datas, observed) if datas else {}
        ends = {a: (s.tower, s.channel) for a, s in received.items()} or _open_ends(site, plan)
        series = [o.samples for o in observed if o.samples.antenna in ends]
        area = _area(site, plan)
    with stages("candidates"):
        candidates = _candidates(plan, area, site)
        points = None if target == _SPHERE else sources.find_targets(Path(target), site, plan.target)
        if points is not None:
            remarks += points.remarks
            _check_near("target", shapely.multipoints(points.position_m[points.known]), area, "that may be flown")
        targets = _targets(points, site, ends)
    work = f"{counted(len(candidates), 'candidate')}: {', '.join(candidate.route.name for candidate in candidates)}"
    stages.checked(lambda: [PlannedStage("learn, rank, curve, map", work)])
    with stages("learn"):
        known = _flown_flights(series)
    few_targets = {a: _thinned(s, _MOST_TARGETS) for a, s in targets.items()}

    def leaves_db(route: Route) -> float:
        return rms_db(known.sd_db(_samples(route, ends, site), few_targets))

    with stages("rank"):
        ranked = _ranked(candidates, leaves_db, stages)
    with stages("curve"):
        curve = _curve(ranked, leaves_db, site, area, plan)
    with stages("map"):
        shown = {a: _thinned(s, 6 * _MOST_TARGETS) for a, s in targets.items()}
        before, after = known.sd_db([], shown), known.sd_db(_samples(ranked[0].route, ends, site), shown)
    best, ways, speed = ranked[0], ranked[0].route.waypoints, plan.speed_mps
    return PlanPage(
        target=target,
        sentence=_sentence(best, curve, rms_db(known.sd_db([], few_targets))),
        antennas=tuple(ends),
        flights=[data.settings.flight.name for data in datas],
        candidates=[candidate.row for candidate in ranked],
        curve=curve,
        outline_m=np.array(area.exterior.coords),
        holes_m=[np.array(ring.coords) for ring in area.interiors],
        track_m=best.route.position_m,
        place_m=next(iter(shown.values())).position_m,
        before_db=_rms_of_antennas(before),
        after_db=_rms_of_antennas(after),
        seen_from_m=np.asarray(site.towers[next(iter(ends.values()))[0]].position_m) if points is None else None,
        site=site,
        files={"route.plan": plan_text(ways, site.frame, speed), "route.csv": waypoints_csv(ways, site.frame)},
        warnings=[*(f"{text}." for text in site.cautions(tower for tower, _ in ends.values())), *remarks],
        stages_s=stages.seconds,
    )


def _candidates(plan: PlanOptions, area: Any, site: Site) -> list[Candidate]:
    """Return the proposed patterns and the routes from files. Raise UsageError if none of them may be flown."""
    flyable = [*_own_patterns(plan, area, site), *_file_routes(plan, area, site)]
    footprints = shapely.STRtree([building.footprint for building in site.buildings])
    candidates = [replace(c, refused=c.refused or _blocked(c.route.position_m, site, footprints)) for c in flyable]
    if all(candidate.refused for candidate in candidates):
        first = f"{candidates[0].route.name} {candidates[0].refused}" if candidates else "no pattern is in the geofence"
        raise UsageError(
            f"no route fits: {first}",
            expected="a route within geofence, battery, distances: another area or --height, or --route FILE",
        )
    return candidates


def _blocked(position_m: FloatArray, site: Site, footprints: shapely.STRtree) -> str:
    """Return the reason for a refusal if a track (n, 3) is too near to a building, otherwise an empty text."""
    legs = np.stack([position_m[:-1], position_m[1:]], axis=1)
    near = footprints.query(shapely.linestrings(legs[..., :2]), predicate="dwithin", distance=_CLEARANCE_M)
    for leg, number in sorted(near.T.tolist(), key=lambda pair: pair[1]):
        building = site.buildings[number]
        if legs[leg, :, 2].min() < building.base_m + building.height_m + _CLEARANCE_M:
            return f"passes less than {_CLEARANCE_M:g} m from building '{building.name}' ({building.height_m:g} m high)"
    return ""


def _sentence(best: Candidate, curve: Sequence[Mapping[str, float]], now_db: float) -> str:
    """Return the opening text of the page."""
    minutes = best.route.duration_s / 60.0
    text = (
        f"Best route: {best.route.name}; {best.route.length_m / 1000.0:.1f} km, {minutes:.0f} min. It lowers the "
        f"standard deviation over the target from {now_db:.1f} to {best.sd_db:.1f} dB."
    )
    for enough in [p for p in curve if p["minutes"] < 0.9 * minutes][-1:]:
        text += f" A flight of {enough['minutes']:.0f} min lowers it to {enough['sd_db']:.1f} dB."
    return text


def _ranked(candidates: Sequence[Candidate], leaves_db: Callable[[Route], float], stages: Stages) -> list[Candidate]:
    """Rank candidates by the standard deviation after them, with refused candidates last."""
    ranked = []
    for number, candidate in enumerate(candidates):
        stages.progress(f"rank {candidate.route.name}", number / len(candidates))
        ranked.append(replace(candidate, sd_db=leaves_db(candidate.route)))
    return sorted(ranked, key=lambda candidate: (bool(candidate.refused), candidate.sd_db))


def _open_ends(site: Site, plan: PlanOptions) -> dict[str, tuple[str, str]]:
    """Return one unmeasured antenna per tower."""
    towers = plan.towers or tuple(site.towers)
    for name in towers:
        if name not in site.towers:
            raise UsageError(f"no tower {name!r}", expected="one of " + ", ".join(site.towers))
    return {f"{name}.level": (name, "level") for name in towers}


def _area(site: Site, plan: PlanOptions) -> Any:
    """Return the area in which a route is allowed."""
    west, east, south, north = site.area_m
    ground = shapely.box(west, south, east, north)
    fence = ground if plan.fence is None else shapely.union_all(_polygons(plan.fence, site))
    _check_near("geofence", fence, ground, f"of site {site.name}")
    avoid = [polygon for path in plan.avoid for polygon in _polygons(path, site)]
    towers = np.array([t.position_m for t in site.towers.values()]).reshape(-1, 3)
    return allowed_area(fence, avoid, towers, plan.tower_distance_m)


def _polygons(path: Path, site: Site) -> list[shapely.Polygon]:
    out = []
    for corners in read_areas(path):
        latitude, longitude = np.array(corners).T
        east, north = site.frame.to_local(latitude, longitude)
        ring = shapely.Polygon(np.column_stack([east, north]))
        if len(corners) > _MOST_CORNERS or is_tangled(ring):  # the repair of such an outline has no time limit
            raise InputError(
                f"an area of {len(corners)} corners that cannot be used",
                expected=f"at most {_MOST_CORNERS} corners and {MAX_CROSSINGS} crossings of the outline with itself",
                cause="a recorded track or an outline drawn by hand: simplify it in the map program",
                path=path,
            )
        out.append(ring.buffer(0))
    if not any(item.area > 0 for item in out):
        raise InputError("areas without an extent", expected="outlines of three corners or more", path=path)
    return out


def _own_patterns(plan: PlanOptions, area: Any, site: Site) -> list[Candidate]:
    """Return the proposed patterns, without those that leave the area between legs."""
    out = []
    for height, (azimuth, turns), nose in product(plan.heights_m, [(0.0, False), (90.0, False), (0.0, True)], NOSES):
        # a pattern with turns contains all headings, so other nose settings would be repetitions
        if turns and nose != "along":
            continue
        pattern = Pattern(azimuth_deg=azimuth, height_m=height, nose=nose, turns=turns)
        try:
            route = _raised(route_of(pattern, area, plan.speed_mps, 60.0 * plan.minutes), site)
        except UsageError:
            continue
        if not _leaves_area(route, area):
            out.append(Candidate(route=route, pattern=pattern))
    return out


def _file_routes(plan: PlanOptions, area: Any, site: Site) -> list[Candidate]:
    """Return routes of files at the speed of the plan, each with the reason for a refusal."""
    out = []
    for path in plan.routes:
        targets = sources.find_targets(path, site, sources.TargetOptions(heights_m=plan.heights_m))
        if targets.kind == "grid" or targets.known.sum() < 2:
            raise InputError("not a route", expected="a .plan, KML, CSV or log with two points or more", path=path)
        place, yaw = targets.position_m[targets.known], targets.yaw_deg[targets.known]
        steps = np.diff(place, axis=0)
        # if the file does not specify the yaw, the nose points along the course
        yaw = np.where(np.isfinite(yaw), yaw, bearing_deg(np.vstack([steps, steps[-1:]])))
        ground = site.takeoff_ground_m
        points = [
            Waypoint(east_m=float(p[0]), north_m=float(p[1]), height_m=float(p[2]) - ground, yaw_deg=float(y))
            for p, y in zip(place, yaw, strict=True)
        ]
        route = _raised(flown(path.name, _corners(points), plan.speed_mps), site)
        if len(route.time_s) < 2:
            raise InputError("the route ends within a second", cause="a hover, or one point twice", path=path)
        refused = "leaves the allowed area" if _leaves_area(route, area) else ""
        if route.duration_s > 60.0 * plan.minutes + 1.0:
            refused = f"takes {route.duration_s / 60.0:.1f} min of {plan.minutes:g} min"
        out.append(Candidate(route=route, refused=refused))
    return out


def _corners(points: Sequence[Waypoint]) -> list[Waypoint]:
    """Return the waypoints, omitting those with unchanged yaw on a straight line between their neighbours."""
    place = np.array([(w.east_m, w.north_m, w.height_m) for w in points])
    corners = [points[0]]
    for i in range(1, len(points) - 1):
        before, after = place[i] - place[i - 1], place[i + 1] - place[i]
        # straight: the course changes by less than about one degree
        straight = float(before @ after) > 0.9998 * float(np.linalg.norm(before) * np.linalg.norm(after))
        if not straight or abs(points[i].yaw_deg - corners[-1].yaw_deg) > 2.0:
            corners.append(points[i])
    return [*corners, points[-1]]


def _raised(route: Route, site: Site) -> Route:
    """Convert heights above take-off to heights of the site."""
    return replace(route, position_m=route.position_m + np.array([0.0, 0.0, site.takeoff_ground_m]))


def _leaves_area(route: Route, area: Any) -> bool:
    line = shapely.LineString(route.position_m[:, :2])
    return not bool(shapely.covers(shapely.buffer(area, _ALLOWED_OUTSIDE_M + 3.0), line))


def _targets(points: sources.Targets | None, site: Site, ends: Mapping[str, tuple[str, str]]) -> dict[str, LinkSamples]:
    """Return target points per antenna (all directions if ``points`` is None), at all headings if unspecified."""
    out = {}
    for antenna, end in ends.items():
        tower = np.asarray(site.towers[end[0]].position_m)
        if points is None:
            direction = _even_directions(800)
            direction = direction[(direction[:, 2] > 0.03) & (direction[:, 2] < 0.98)]
            # multiples of the golden angle distribute headings as evenly as directions
            place, yaw = tower + _SPHERE_AWAY_M * direction, 137.508 * np.arange(len(direction)) % 360.0
        else:
            place, yaw = points.position_m[points.known], points.yaw_deg[points.known]
            step = max(1, len(place) // (2 * _MOST_TARGETS))
            place, yaw = place[::step], yaw[::step]
            if np.isnan(yaw).any():
                turns = np.arange(HEADINGS) * (360.0 / HEADINGS)
                place = np.repeat(place, HEADINGS, axis=0)
                yaw = np.where(np.isnan(yaw)[:, None], turns, yaw[:, None]).ravel()
        out[antenna] = sources.level_samples(end, tower, place, np.asarray(yaw, dtype=np.float64), np.zeros(len(yaw)))
    return out


def _check_near(what: str, place: Any, area: Any, which: str) -> None:
    """Raise UsageError if a shape is farther than :data:`_FARTHEST_M` outside the area."""
    distance_m = shapely.distance(area, place)
    if distance_m > _FARTHEST_M:
        raise UsageError(
            f"the {what} lies {distance_m:.0f} m outside the area {which}",
            expected=f"a {what} within {_FARTHEST_M:g} m of it",
            cause="another site, or swapped coordinates",
        )


def _samples(route: Route, ends: Mapping[str, tuple[str, str]], site: Site) -> list[LinkSamples]:
    return [
        sources.level_samples(
            end, np.asarray(site.towers[end[0]].position_m), route.position_m, route.yaw_deg, route.time_s
        )
        for end in ends.values()
    ]


def _even_directions(count: int) -> FloatArray:
    """Return unit vectors (count, 3) distributed evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    azimuth = np.pi * (1.0 + math.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z * z)
    return np.asarray(np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1), dtype=np.float64)


def _flown_flights(series: Sequence[LinkSamples]) -> FlownFlights:
    """Return the flights with strengths and spatial correction learned from them, else with the model's defaults."""
    model, residual_field = GainModel(), None
    if series:
        model = learned_antennas(series).model
        correction = choose(series, {"learned": lambda train: learned_antennas(train).predict})
        residual_field = correction.model if correction.on else None
    return FlownFlights(series=series, model=model, field=residual_field)


def _thinned(samples: LinkSamples, most: int) -> LinkSamples:
    """Return at most ``most`` samples of a target. Odd steps are used, so that all headings are selected."""
    step = max(1, math.ceil(len(samples) / most))
    step += int(step > 1 and step % 2 == 0)
    return samples.part(np.arange(0, len(samples), step))


def _rms_of_antennas(sd_db: Mapping[str, FloatArray]) -> FloatArray:
    return np.asarray(np.sqrt(np.mean([sd**2 for sd in sd_db.values()], axis=0)))


# Number of best candidates that are tried for each flight time. With less time, another pattern may be the best.
_CURVE_OF = 3


def _curve(
    ranked: Sequence[Candidate], leaves_db: Callable[[Route], float], site: Site, area: Any, plan: PlanOptions
) -> list[dict[str, float]]:
    """Return standard deviations after shorter and longer versions of the best candidates.

    A route from a file can only be cut.
    """
    out: list[dict[str, float]] = []
    best = [r for r in ranked if not r.refused][:_CURVE_OF]
    for share in SHARES:
        tried = []
        for route in filter(None, (_of_length(item, share, area, plan) for item in best)):
            raised = _raised(route, site)
            sd = leaves_db(raised)
            tried.append({"minutes": raised.duration_s / 60.0, "length_m": raised.length_m, "sd_db": sd})
        for point in sorted(tried, key=lambda point: point["sd_db"])[:1]:
            least = min([point["sd_db"], *(p["sd_db"] for p in out)])  # a longer flight can contain a shorter flight
            out.append(point | {"sd_db": least})
    return out


def _of_length(candidate: Candidate, share: float, area: Any, plan: PlanOptions) -> Route | None:
    """Return a candidate for a share of the flight time, or None if the route of a file would have to be longer."""
    if candidate.pattern is not None:
        return route_of(candidate.pattern, area, plan.speed_mps, 60.0 * share * plan.minutes)
    full = flown(candidate.route.name, candidate.route.waypoints, plan.speed_mps)
    return cut(full, share * full.duration_s, plan.speed_mps) if share <= 1.0 else None


def run_plan(target: str, flights: Sequence[Path], plan: PlanOptions, options: RunOptions = DEFAULT) -> JobOutcome:
    """Rank flights and write ``plan.html``, the chosen route, ``sd_map.csv`` and ``metrics.json``.

    Parameters
    ----------
    target : str
        ``sphere``, or a target of :func:`.sources.find_targets`.
    flights : sequence of Path
    plan : PlanOptions
    options : RunOptions
        ``out`` is ``reports/plan-TARGET`` by default.

    Returns
    -------
    JobOutcome
    """
    inputs = sources.target_files(Path(target), plan.target.site, options.logs_root)
    inputs += [path for path in (plan.fence, *plan.avoid, *plan.routes) if path is not None]
    known = sources.named_flights(flights)
    inputs += sources.files_of(known, options.logs_root)
    folder = options.out or Path("reports") / f"plan-{safe_name(Path(target).stem)}"
    stages = options.stages("plan", inputs, folder)
    with OutputFolder(folder, job="plan", inputs=inputs, force=options.force) as output:
        record = _plan_flight(target, known, plan, options.logs_root, stages)
        with output.filling() as place:
            options.progress("page")
            written = write_plan(record, place)
        return JobOutcome(folder=folder, metrics=plan_metrics(record), files=output.placed(written))
