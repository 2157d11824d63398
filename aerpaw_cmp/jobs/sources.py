"""Points and links of a prediction, and the models that predict them.

Points are a grid over a site, a planned route, the plan or track of a flight, or a table. A prediction uses the links
of the named flights, or the links for which the site has learned antennas and levels. Before any flight, it uses the
links of all towers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from ..common.errors import InputError, UsageError, parsing
from ..common.files import opened
from ..common.geodesy import azimuth_rad
from ..common.grouping import lists_by_key
from ..common.text import counted
from ..common.units import BoolArray, FloatArray
from ..compare.calibration import BIN_S, Correction, Observed, Predictor, between_blocks_db, by_degree
from ..compare.gains import NO_SPREAD, LinkSamples, LostLock, Spread, fading_of, link_directions
from ..compare.level import DetectionForecast, nearest_points
from ..flight.data import FlightData, check_place, load_data
from ..flight.drafting.proposals import LearnedLink, latest_learned_links
from ..flight.gains import flight_of, load_with_learned, pair_db
from ..flight.replay import attitude_rotation, replay_poses
from ..flight.route_files import MOST_POINTS, read_route, too_many_points
from ..flight.settings import FlightFile, LinkSettings, RssSettings, RtSettings
from ..flight.simulate import LEAN_DEG_PER_MPS, planned_poses
from ..flight.track import interpolated, raised
from ..logs.readers import HEAD_BYTES
from ..maps.grid import Grid
from ..propagation.field.baselines import free_space_dbm
from ..propagation.geometry import Poses, inside_solids, rotation_from_aircraft, rotation_from_axes
from ..site.site import Site
from ..site.siteyaml import inputs_of_site
from .calibrate import load_calibration
from .tasks import inputs_of_flight

# Distance between points of a route that is given by its corners [m].
STEP_M = 10.0

# Speed along a route without times [m/s].
SPEED_MPS = 8.0

# Upward axis of level flight.
UPRIGHT = np.array([0.0, 0.0, 1.0])

# Points farther from the site are ignored [m].
NEAR_M = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class Targets:
    """Points of a prediction.

    Parameters
    ----------
    kind : {"grid", "route", "points"}
    name : str
    position_m : (n, 3)
        East, north, up [m]. NaN if a position is unknown.
    yaw_deg : (n,)
        Heading, clockwise from north. If it is NaN, all headings have equal weights.
    time_s : (n,)
        Time since the first point.
    up : (3,) or (n, 3), optional
        Upward axis of the aircraft. Default: level flight.
    grid : Grid, optional
        The grid, if the points are its positions, in order of height.
    heights_m : tuple of float
    towers : set of str
        Towers of the levels and ranks of a flight, or the towers that its file names. Empty if the towers are not
        known.
    remarks : tuple of str
    """

    kind: str
    name: str
    position_m: FloatArray
    yaw_deg: FloatArray
    time_s: FloatArray
    up: FloatArray = field(default_factory=lambda: UPRIGHT)
    grid: Grid | None = None
    heights_m: tuple[float, ...] = ()
    towers: frozenset[str] = frozenset()
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def known(self) -> BoolArray:
        """True for points (n,) that have a position near the site."""
        return np.asarray((np.abs(self.position_m) < NEAR_M).all(axis=1))


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetOptions:
    """Options of ``predict`` for its points.

    Parameters
    ----------
    heights_m : tuple of float
        Heights of a grid. The first height is also used for route points without a height.
    spacing_m : float, optional
        Distance between the positions of a grid. Default: ``grid_spacing_m``. Not allowed for a route.
    heading_deg : float, optional
        Heading at all points. Default: the heading of the route, else all headings with equal weights.
    site : str, optional
        The site, if neither flights nor points name it.
    carrier_hz, tx_power_dbm : float, optional
        Carrier and transmit power of a prediction before any flight.
    grid_spacing_m : float
        Default spacing of a grid.
    """

    heights_m: tuple[float, ...] = (40.0,)
    spacing_m: float | None = None
    heading_deg: float | None = None
    site: str | None = None
    carrier_hz: float | None = None
    tx_power_dbm: float | None = None
    grid_spacing_m: float = 30.0


def level_samples(
    end: tuple[str, str],
    tower_m: FloatArray,
    position_m: FloatArray,
    yaw_deg: FloatArray,
    time_s: FloatArray,
    up: FloatArray = UPRIGHT,
) -> LinkSamples:
    """Return poses of an aircraft as samples without a level.

    Parameters
    ----------
    end : (str, str)
        Tower and channel.
    tower_m : (3,)
        Position of the array [m].
    position_m : (n, 3)
    yaw_deg : (n,)
        Heading, clockwise from north.
    time_s : (n,)
    up : (n, 3), optional
        Upward axis. Default: level flight.

    Returns
    -------
    LinkSamples
    """
    at_uav, at_tower = link_directions(tower_m, position_m, rotation_from_axes(yaw_deg, up))
    return LinkSamples(
        flight="",
        tower=end[0],
        channel=end[1],
        time_s=time_s,
        position_m=position_m,
        at_uav=at_uav,
        at_tower=at_tower,
        residual_db=np.zeros(len(yaw_deg)),
    )


def is_settings(path: Path) -> bool:
    """Check whether a path names a YAML file."""
    return path.suffix.lower() in (".yaml", ".yml")


def target_files(where: Path, site: str | None, logs_root: Path | None) -> list[Path]:
    """Return the files from which WHERE and the site of ``--site`` are read."""
    files = [] if site is None else inputs_of_site(site)
    if (flight := flight_of(where)) is not None:
        return [*files, *inputs_of_flight(flight, where, logs_root)]
    if is_settings(where) or not where.exists():
        return [*files, *inputs_of_site(where)]
    return [*files, where]


def find_targets(where: Path, site: Site, options: TargetOptions, logs_root: Path | None = None) -> Targets:
    """Read the points that WHERE names.

    Parameters
    ----------
    where : Path
        site.yaml or a packaged site (a grid), flight.yaml (its plan, else its track), a route, or a CSV of points.
    site : Site
    options : TargetOptions
    logs_root : Path, optional
        Folder to which relative paths of logs in a flight file refer.

    Returns
    -------
    Targets

    Raises
    ------
    UsageError, InputError
        If WHERE has no points that can be predicted. The message names the likely cause.
    """
    flight = flight_of(where)
    if flight is not None:
        targets = _planned(flight, site) if flight.flight.plan is not None else _flown(flight, where, logs_root)
    elif is_settings(where) or not where.exists():
        targets = _grid(site, options)
    elif (local := _local_points(where)) is not None:
        targets = replace(local, remarks=(*local.remarks, *_buried(local, site)))
    else:
        targets = _route(where, site, options)
    if targets.grid is None:
        targets = replace(targets, remarks=(*targets.remarks, *_in_buildings(targets, site)))
    if targets.grid is None and options.spacing_m is not None:
        raise UsageError("--spacing along a route", expected="a site: the spacing is that of a grid")
    if options.heading_deg is not None:
        targets = replace(targets, yaw_deg=np.full(len(targets), options.heading_deg % 360.0))
    if len(targets) > MOST_POINTS:
        raise UsageError(f"{len(targets)} points", expected=f"at most {MOST_POINTS}", cause="too fine a spacing")
    if not targets.known.any():
        places = "east, north and height in metres, or latitude and longitude"
        raise InputError("no point has a position near the site", expected=places, path=where)
    return targets


def _grid(site: Site, options: TargetOptions) -> Targets:
    grid = Grid.over_area(site.area_m, options.spacing_m or options.grid_spacing_m)
    position = np.concatenate([grid.positions_m(h) for h in options.heights_m])
    if site.dem is not None:
        position[:, 2] += site.dem.ground_m(position[:, 0], position[:, 1])
    return Targets(
        kind="grid",
        name=site.name,
        position_m=position,
        yaw_deg=np.full(len(position), np.nan),
        time_s=np.zeros(len(position)),
        grid=grid,
        heights_m=options.heights_m,
    )


def _planned(flight: FlightFile, site: Site) -> Targets:
    assert flight.flight.plan is not None
    time, position, yaw = planned_poses(flight.flight.plan, site.takeoff_ground_m, 1.0)
    up, name = _tilted_axes(position, time), flight.flight.name
    return Targets(
        kind="route", name=name, position_m=position, yaw_deg=yaw % 360.0, time_s=time, up=up, towers=_named(flight)
    )


def _named(flight: FlightFile) -> frozenset[str]:
    return frozenset(name for log in flight.logs for name in (log.node, *log.cells.values()) if name)


def _tilted_axes(position_m: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return the upward axes (n, 3) of a multicopter, which leans into its motion."""
    time = np.maximum.accumulate(time_s)
    # use positions two seconds apart, because logged positions are rounded, and an aircraft does not change its lean
    # faster
    begin, end = np.clip(time - 1.0, time[0], None), np.clip(time + 1.0, None, time[-1])
    moved = interpolated(end, time, position_m) - interpolated(begin, time, position_m)
    up = np.radians(LEAN_DEG_PER_MPS) * moved / np.maximum(end - begin, 1e-9)[:, None]
    # with 1 as the upward component, the horizontal part is the tangent of the lean: a jump of the positions cannot
    # turn the aircraft over
    up[:, 2] = 1.0
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def _flown(flight: FlightFile, where: Path, logs_root: Path | None) -> Targets:
    """Return the track of a flight without a plan. The levels of the flight are not used."""
    data: FlightData = load_data(flight, where.parent, logs_root)
    if data.track is None:
        raise UsageError("a flight file without a plan and without telemetry", expected="flight.plan", path=where)
    start, end = data.track.start_ns, data.track.end_ns
    time = np.arange(start, end, 1_000_000_000).astype("datetime64[ns]")
    pose = data.poses_at(time)
    return Targets(
        kind="route",
        name=flight.flight.name,
        position_m=pose.position_m[pose.valid],
        yaw_deg=pose.heading_deg[pose.valid],
        up=attitude_rotation(pose, data.settings.rss_attitude)[pose.valid][:, :, 2],
        time_s=((time - time[0]) / np.timedelta64(1, "s"))[pose.valid],
        towers=frozenset(series.tower for _, series in data.series) or _named(flight),
        remarks=("The flight file has no plan: its track is the route. Its levels are not used.",),
    )


# Columns of a table of points. The last two are optional.
_COLUMNS = ("east_m", "north_m", "height_m", "yaw_deg", "time_s")


def _local_points(path: Path) -> Targets | None:
    """Read points of a CSV with east_m, north_m and height_m (and yaw_deg, time_s), or return None for other files."""
    if path.suffix.lower() != ".csv":
        return None
    with parsing(path, "columns east_m, north_m, height_m"):
        with opened(path, "a route or points") as file:
            head = file.readline(HEAD_BYTES).decode("utf-8-sig", errors="replace")
        sign = ";" if ";" in head else ","
        if not set(_COLUMNS[:3]) <= {name.strip() for name in head.split(sign)}:
            return None
        # read one row more than allowed: a longer table is then refused before all of it is in memory
        table = pd.read_csv(
            path, skipinitialspace=True, nrows=MOST_POINTS + 1, encoding="utf-8-sig", index_col=False,
            sep=sign, decimal="," if sign == ";" else ".",  # pandas leaves decimal points as text, converted below
            usecols=lambda name: name.strip() in _COLUMNS,
        ).rename(columns=str.strip)  # fmt: skip
        if len(table) > MOST_POINTS:
            raise too_many_points(path)
    numbers = table.reindex(columns=list(_COLUMNS))
    numbers = numbers.apply(pd.to_numeric, errors="coerce")
    position = numbers[["east_m", "north_m", "height_m"]].to_numpy(np.float64)
    lost = int((~(np.abs(position) < NEAR_M).all(axis=1)).sum())
    return Targets(
        kind="points",
        name=path.stem,
        position_m=position,
        yaw_deg=numbers["yaw_deg"].to_numpy(np.float64),
        time_s=time if np.isfinite(time := numbers["time_s"].to_numpy(np.float64)).all() else np.zeros(len(position)),
        remarks=(f"{lost} of {counted(len(position), 'point')} without a position near the site.",) if lost else (),
    )


def _buried(points: Targets, site: Site) -> list[str]:
    """Return a remark about points that are below the ground."""
    east, north, up = points.position_m[points.known].T
    count = int((up < site.ground_under_m(east, north)).sum())
    return [f"{count} of {counted(len(up), 'point')} below the ground, where no path arrives."] if count else []


def _in_buildings(points: Targets, site: Site) -> list[str]:
    """Return a remark about points that are inside buildings."""
    inside = inside_solids(site, points.position_m[points.known])
    where = f"{inside.sum()} of {counted(len(inside), 'point')} inside buildings"
    return [f"{where}, where no path arrives."] if inside.any() else []


def _route(where: Path, site: Site, options: TargetOptions) -> Targets:
    table = read_route(where, height_m=options.heights_m[0])
    check_place(site, where, table, "route")
    east, north = site.frame.to_local(table["latitude_deg"].to_numpy(), table["longitude_deg"].to_numpy())
    takeoff_m = site.takeoff_ground_m
    up = table["altitude_m"].to_numpy(np.float64) + takeoff_m
    up, buried = raised(up, site.ground_under_m(east, north), takeoff_m)
    if buried.any():
        raise InputError(
            f"{int(buried.sum())} of {counted(len(up), 'point')} below the site's ground",
            expected="heights above take-off",
            cause="heights of another datum, or origin.takeoff_ground_m of the site",
            path=where,
        )
    position, yaw = np.column_stack([east, north, up]), table["yaw_deg"].to_numpy(np.float64)
    remarks = tuple(table.attrs.get("remarks", ()))
    time = table["time_s"].to_numpy(np.float64)
    if not np.isfinite(time).all():
        gaps = np.linalg.norm(np.diff(position, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(gaps)])
        count = max(int(along[-1] / STEP_M) + 1, 2) if along[-1] > 0 else 1
        at = np.linspace(0.0, along[-1], count)
        leg = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(position) - 1)
        position = interpolated(at, along, position)
        yaw, time = yaw[leg], at / SPEED_MPS
        if count > 1:
            remarks += (f"The points are {STEP_M:g} m apart, and the times assume a speed of {SPEED_MPS:g} m/s.",)
    up = _tilted_axes(position, time)
    return Targets(kind="route", name=where.stem, position_m=position, yaw_deg=yaw, time_s=time, up=up, remarks=remarks)


_REPLAYED_AT_ONCE = 20_000


@dataclass(frozen=True, slots=True)
class NamedFlight:
    """A flight file of ``--with``."""

    path: Path
    settings: FlightFile

    def load(self, logs_root: Path | None) -> FlightData:
        """Read the logs and the track of the flight."""
        return load_data(self.settings, self.path.parent, logs_root)


def named_flights(paths: Sequence[Path]) -> list[NamedFlight]:
    """Read flight files and the flight files listed in a calibration.yaml.

    Raises
    ------
    UsageError, InputError
        If a file is not a valid settings file.
    """
    out = []
    for path in paths:
        text = path.read_text(encoding="utf-8", errors="replace") if is_settings(path) and path.is_file() else ""
        listed = text.startswith("calibration:") or "\ncalibration:" in text
        each = [path.parent / name for name in load_calibration(path).flights] if listed else [path]
        out += [NamedFlight(file, load_with_learned(file)) for file in each]
    return out


def files_of(flights: Sequence[NamedFlight], logs_root: Path | None) -> list[Path]:
    """Return every file from which the flights are read."""
    return [file for flight in flights for file in inputs_of_flight(flight.settings, flight.path, logs_root)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A link of one tower and channel, as described by its first flight or by the learned models of the site.

    Parameters
    ----------
    tower, channel, unit : str
    link : LinkSettings
    site : Site
    folder : Path
        Folder to which relative paths of antenna files refer.
    rt, rss : RtSettings, RssSettings
        Settings of the replay and of the sum of its paths.
    samples : tuple of LinkSamples
        Samples of all flights with this link.
    """

    tower: str
    channel: str
    unit: str
    link: LinkSettings
    site: Site
    folder: Path = Path()
    rt: RtSettings = field(default_factory=RtSettings)
    rss: RssSettings = field(default_factory=RssSettings)
    samples: tuple[LinkSamples, ...] = ()

    @property
    def antenna(self) -> str:
        """``tower.channel``."""
        return f"{self.tower}.{self.channel}"

    @property
    def tower_m(self) -> FloatArray:
        """Position of the array (3,)."""
        return np.asarray(self.site.towers[self.tower].position_m)

    def free_space_db(self, position_m: FloatArray) -> FloatArray:
        """Return the level (n,) of free space [dBm]."""
        place, link = self.tower_m[None, :], self.link
        return np.asarray(free_space_dbm(place, position_m, link.carrier_hz, link.transmit_power_dbm)[:, 0])

    def targets(self, position_m: FloatArray, yaw_deg: FloatArray, up: FloatArray = UPRIGHT) -> LinkSamples:
        """Return targets (n,) of an aircraft with an upward axis (3,) or (n, 3) as samples without a level."""
        time_s = np.zeros(len(yaw_deg))
        return level_samples((self.tower, self.channel), self.tower_m, position_m, yaw_deg, time_s, up)

    def replayed_db(self, samples: LinkSamples) -> FloatArray:
        """Return the replayed level minus free space (n,) [dB] for level flight, NaN if there is no path."""
        link = self.link.build([self.tower], self.folder)
        turn = azimuth_rad(-samples.at_tower) - azimuth_rad(samples.at_uav)
        flat = np.zeros(len(turn))
        known = self.rt.attitude != "ignored"
        rotation = rotation_from_aircraft(flat, flat, 90.0 - np.degrees(turn) if known else flat + 90.0)
        level = np.empty(len(samples))
        for start in range(0, len(samples), _REPLAYED_AT_ONCE):
            part = slice(start, start + _REPLAYED_AT_ONCE)
            poses = Poses(samples.position_m[part], rotation[part])
            total = replay_poses(self.site, self.rt, link, poses).level_dbm(self.rss.field)
            level[part] = total[:, 0] + pair_db(link, poses, self.tower_m[None, :])
        return np.asarray(level - self.free_space_db(samples.position_m))


def track_m(samples: LinkSamples) -> FloatArray:
    """Return about 500 horizontal positions (n, 2) of a flight, for drawings."""
    return np.asarray(samples.position_m[:: max(1, len(samples) // 500), :2])


def sources_of(known: Sequence[FlightData], observed: Sequence[Observed]) -> dict[str, Source]:
    """Return the links between fixed towers and the channels that a flight received, by antenna."""
    with_level = (o.samples for o in observed if np.isfinite(o.samples.residual_db).any())
    measured = lists_by_key((samples.antenna, samples) for samples in with_level)
    out: dict[str, Source] = {}
    for data, s in [(flight, series) for flight in known for series in flight.rss]:
        source = Source(
            tower=s.tower, channel=s.channel, unit=s.unit, link=s.link, site=data.site, folder=data.folder,
            rt=data.settings.rt.model_copy(update={"attitude": data.settings.rss_attitude}), rss=data.settings.rss,
        )  # fmt: skip
        if source.antenna in measured and s.tower not in data.nodes and s.unit != "dB":
            out.setdefault(source.antenna, replace(source, samples=tuple(measured[source.antenna])))
    if not out:
        raise InputError("no flight has levels of a fixed tower", expected="RSS logs with positions")
    return out


# --- models --------------------------------------------------------------------------------------------------------

# Targets farther than this from every known sample, horizontally or in height, are flagged [m].
_HULL_M, _HULL_UP_M = 60.0, 20.0

# Level above free space and SD of 4 s means, each (n,) [dB], and true where the model extrapolates (n,).
Levels = tuple[FloatArray, FloatArray, BoolArray]


@dataclass(frozen=True, slots=True)
class Flown:
    """The model learned from the named flights: a base, with or without a spatial correction.

    Parameters
    ----------
    trained_on : sequence of sequence of str
        SHA-256 of the training data of the base, in addition to the named flights.
    marks : sequence of sequence of str
        Fingerprints of the same data.
    """

    correction: Correction
    sources: Mapping[str, Source]
    trained_on: Sequence[Sequence[str]] = ()
    marks: Sequence[Sequence[str]] = ()

    def levels(self, each: Sequence[LinkSamples]) -> Levels:
        """Return levels at targets, averaged over the headings ``each``."""
        antenna = each[0].antenna
        level, slow = self.correction.over_headings(each)
        known = self.sources[antenna].samples
        guess = outside(each[0].position_m, known)
        # the held-out errors of several flights already contain the variation between areas
        if len({samples.flight for samples in known}) == 1:
            slow = np.where(guess, np.hypot(slow, between_blocks_db(self.correction.channels[antenna])), slow)
        return level, slow, guess

    def fading(self, antenna: str) -> Spread:
        """Return the error model of samples about their means over 4 s."""
        known = self.sources[antenna].samples
        sd_db, kurtosis = fading_of(known, BIN_S)
        # the noise of a mean of n samples already contains 1/n of the variance of the fading
        count, means = sum(np.isfinite(s.residual_db).sum() for s in known), len(self.correction.channels[antenna].rows)
        sd_db *= math.sqrt(1.0 - min(means / count, 1.0))
        return replace(NO_SPREAD, fading_sd_db=sd_db, fading_kurtosis=kurtosis, bin_s=BIN_S)

    def offset_db(self, antenna: str) -> float:
        """Return the mean of logged minus replayed levels [dB]."""
        source = self.sources[antenna]
        binned = [samples.binned(BIN_S) for samples in source.samples]
        return float(np.nanmean([np.nanmean(b.residual_db - source.replayed_db(b)) for b in binned]))


class Stored:
    """The model that is stored for the site: learned antennas and level of each channel.

    Parameters
    ----------
    known : mapping of str to LearnedLink
        Learned links with a level, by antenna (``tower.channel``).
    site : Site
    """

    def __init__(self, known: Mapping[str, LearnedLink], site: Site) -> None:
        self.known, self._site = known, site
        self._gain_db: Predictor = by_degree(lambda samples: known[samples.antenna].gain_db(samples))

    def levels(self, each: Sequence[LinkSamples]) -> Levels:
        """Return levels in the form of :meth:`Flown.levels`.

        The model extrapolates outside the site, and in directions with few training samples.
        """
        stored = self.known[each[0].antenna]
        gains, sds = (np.stack(part) for part in zip(*map(self._gain_db, each), strict=True))
        level, spread, gain_variance = stored.level, stored.spread, (sds**2).mean(axis=0)
        variance_db2 = spread.own_sd_db**2 + spread.noise_sd_db**2 + level.sd_db**2
        guess = outside_area(each[0].position_m, self._site) | (gain_variance > 0.5 * stored.prior_variance_db2)
        return gains.mean(axis=0) + level.offset_db, np.sqrt(gain_variance + gains.var(axis=0) + variance_db2), guess

    def fading(self, antenna: str) -> Spread:
        """Return the error model of samples about their means over 4 s."""
        return replace(self.known[antenna].spread, own_sd_db=0.0, noise_sd_db=0.0)

    def lost_lock(self, antenna: str, level_db: FloatArray) -> LostLock | None:
        """Return the forecast of a receiver that loses its lock, about levels in lock (n,) [dB]."""
        stored = self.known[antenna]
        lock, level = stored.series.lock, stored.level
        if lock is None:
            return None
        above_db = level_db - level.offset_db - level.transmit_power_dbm - lock.gain_db
        return LostLock(
            probability=DetectionForecast(level_db=0.0, per_db=lock.per_db, share=lock.share).probability(above_db),
            locked_db=lock.locked_db + lock.locked_per_db * above_db - level_db,
            lost_db=lock.lost_db + lock.lost_per_db * above_db - level_db,
            locked_sd_db=float(np.hypot(lock.locked_sd_db, level.sd_db)),
            lost_sd_db=lock.lost_sd_db,
        )

    def sources(self) -> dict[str, Source]:
        """Return one link per learned antenna. Both ends are isotropic, because the model adds the learned gains."""
        out = {}
        for antenna, stored in self.known.items():
            series, level = stored.series, stored.level
            link = LinkSettings(carrier_hz=series.carrier_hz, transmit_power_dbm=level.transmit_power_dbm)
            out[antenna] = Source(
                tower=series.tower, channel=series.channel, unit=level.unit, link=link, site=self._site,
                rss=RssSettings(field="power"),
            )  # fmt: skip
        return out


def stored_model(place: str | Path, site: Site) -> Stored | None:
    """Return the model of the antennas and levels learned for a site. None if no level of its towers was learned."""
    learned = latest_learned_links(place)
    known = {name: m for name, m in learned.items() if m.series.level and m.series.tower in site.towers}
    return Stored(known, site) if known else None


# Standard deviations of a prediction before any flight [dB]. Offset: transmit power, cables and receiver gain, all
# unmeasured. Antennas: the gain of two unknown antennas over directions (a dipole's nulls, mast, airframe).
# Shadowing: 3GPP TR 36.777, table B-3, has 4.2 dB (LoS) and 6 dB (NLoS) for rural aerial links. Fading: Rayleigh's
# 5.6 dB is the worst case. `benchmarks/first_flight_prediction.py` checks the sum on flights.
PRIOR_SD_DB = {"offset": 10.0, "antennas": 8.0, "shadowing": 6.0, "fading": 5.0}


@dataclass(frozen=True, slots=True)
class Prior:
    """The model before any flight: ray tracing with isotropic antennas, and a wide prediction error.

    Parameters
    ----------
    site : Site
        The site. All its towers are predicted.
    link : LinkSettings
        Carrier and transmit power.
    """

    site: Site
    link: LinkSettings

    def sources(self) -> dict[str, Source]:
        """Return one link per tower, with isotropic ends and woods that attenuate."""
        rt, rss = RtSettings(foliage="attenuating"), RssSettings(field="power")
        link = partial(Source, channel="level", unit="dBm", link=self.link, site=self.site, rt=rt, rss=rss)
        return {f"{tower}.level": link(tower=tower) for tower in self.site.towers}

    def levels(self, each: Sequence[LinkSamples]) -> Levels:
        """Return level above free space and standard deviation (n,) [dB]. Isotropic antennas have no heading."""
        level = self.sources()[each[0].antenna].replayed_db(each[0])
        slow_sd_db = math.hypot(*(sd for part, sd in PRIOR_SD_DB.items() if part != "fading"))
        return level, np.where(np.isfinite(level), slow_sd_db, np.nan), np.ones(len(level), dtype=np.bool_)

    def fading(self, _antenna: str) -> Spread:
        """Return the error model of samples about their means over 4 s."""
        return replace(NO_SPREAD, fading_sd_db=PRIOR_SD_DB["fading"])


def outside_area(position_m: FloatArray, site: Site) -> BoolArray:
    """Return true for positions (n, 2 or more) outside the area of the site."""
    west, east, south, north = site.area_m
    easting, northing = position_m[:, 0], position_m[:, 1]
    return (easting < west) | (easting > east) | (northing < south) | (northing > north)


def outside(position_m: FloatArray, flown: Sequence[LinkSamples]) -> BoolArray:
    """Return true for targets (n,) farther than :data:`_HULL_M` or :data:`_HULL_UP_M` from every sample."""
    scaled = np.array([_HULL_M, _HULL_M, _HULL_UP_M])
    places = np.concatenate([s.position_m for s in flown])
    return ~nearest_points(position_m / scaled, places / scaled, 1.0)[1]
