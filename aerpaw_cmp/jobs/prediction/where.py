"""Places asked for in a prediction: a grid over a site, a planned route, the plan or track of a flight, points."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from ...common.counting import counted
from ...common.errors import InputError, UsageError, parsing
from ...common.units import BoolArray, FloatArray
from ...compare.gains.direction_gain import LinkSamples, link_directions
from ...flight.data import FAR_M, FlightData, load_data, nearest_m
from ...flight.gains.memory import flight_of
from ...flight.pose.heights import raised
from ...flight.pose.track import interpolated
from ...flight.replay import attitude_rotation
from ...flight.settings import FlightFile
from ...flight.simulate import LEAN_DEG_PER_MPS, planned_poses
from ...logs.readers import HEAD_BYTES
from ...logs.route import MOST_POINTS, read_route, too_many_points
from ...maps.grid import Grid
from ...propagation.geometry.arrays import rotation_from_axes
from ...site.inputs import inputs_of_site
from ...site.site import Site
from ..tasks.manifest import inputs_of_flight

# Between points of a route that is given by its corners [m].
STEP_M = 10.0

# Of a route without times.
SPEED_MPS = 8.0

# Upward axis of level flight.
UPRIGHT = np.array([0.0, 0.0, 1.0])

# Points further away are none [m].
NEAR_M = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class Targets:
    """Points of a prediction.

    Parameters
    ----------
    kind : {"grid", "route", "points"}
    name : str
    position_m : (n, 3)
        East, north, up [m]; NaN where a position is not known.
    yaw_deg : (n,)
        Clockwise from north; NaN: unknown, all headings count alike.
    time_s : (n,)
        Since the first point.
    up : (3,) or (n, 3), optional
        Upward axis of the aircraft; level flight without.
    grid : Grid, optional
        Of a grid: the points are its positions, height after height.
    heights_m : tuple of float
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
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def known(self) -> BoolArray:
        """Points (n,) that have a position near the site."""
        return np.asarray((np.abs(self.position_m) < NEAR_M).all(axis=1))


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetOptions:
    """Options of ``predict`` that say where.

    Parameters
    ----------
    heights_m : tuple of float
        Of a grid; the first also of route points without a height.
    spacing_m : float
        Of a grid.
    heading_deg : float, optional
        At all points; without it that of the route, and where none is said all headings count alike.
    site : str, optional
        Where neither flights nor the place name it.
    carrier_hz, tx_power_dbm : float, optional
        Of a prediction before any flight.
    """

    heights_m: tuple[float, ...] = (40.0,)
    spacing_m: float = 30.0
    heading_deg: float | None = None
    site: str | None = None
    carrier_hz: float | None = None
    tx_power_dbm: float | None = None


def level_samples(
    end: tuple[str, str],
    tower_m: FloatArray,
    position_m: FloatArray,
    yaw_deg: FloatArray,
    time_s: FloatArray,
    up: FloatArray = UPRIGHT,
) -> LinkSamples:
    """Poses of an aircraft as samples without a level.

    Parameters
    ----------
    end : (str, str)
        Tower and channel.
    tower_m : (3,)
        Place of the array [m].
    position_m : (n, 3)
    yaw_deg : (n,)
        Clockwise from north.
    time_s : (n,)
    up : (n, 3), optional
        Upward axis; level flight without.

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
    """Files that WHERE and the site of ``--site`` are read from."""
    files = [] if site is None else inputs_of_site(site)
    if (flight := flight_of(where)) is not None:
        return [*files, *inputs_of_flight(flight, where, logs_root)]
    if is_settings(where) or not where.exists():
        return [*files, *inputs_of_site(where)]
    return [*files, where]


def find_targets(where: Path, site: Site, options: TargetOptions, logs_root: Path | None = None) -> Targets:
    """Points that WHERE names.

    Parameters
    ----------
    where : Path
        site.yaml or a packaged site (a grid), flight.yaml (its plan, else its track), a route, or a CSV of points.
    site : Site
    options : TargetOptions
    logs_root : Path, optional
        Where the logs of a flight file resolve.

    Returns
    -------
    Targets

    Raises
    ------
    UsageError, InputError
        What is no place to predict, with the likely cause.
    """
    flight = flight_of(where)
    if flight is not None:
        targets = _planned(flight, site) if flight.flight.plan is not None else _flown(flight, where, logs_root)
    elif is_settings(where) or not where.exists():
        targets = _grid(site, options)
    elif (local := _local_points(where)) is not None:
        targets = local
    else:
        targets = _route(where, site, options)
    if targets.grid is None and options.spacing_m != TargetOptions().spacing_m:
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
    grid = Grid.over_area(site.area_m, options.spacing_m)
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
    up, name = _leaning(position, time), flight.flight.name
    return Targets(kind="route", name=name, position_m=position, yaw_deg=yaw % 360.0, time_s=time, up=up)


def _leaning(position_m: FloatArray, time_s: FloatArray) -> FloatArray:
    """Upward axes (n, 3) of a multicopter on its way: it leans into its motion."""
    time = np.maximum.accumulate(time_s)
    # over two seconds: positions of a log are rounded, and aircraft lean no faster
    begin, end = np.clip(time - 1.0, time[0], None), np.clip(time + 1.0, None, time[-1])
    moved = interpolated(end, time, position_m) - interpolated(begin, time, position_m)
    up = np.radians(LEAN_DEG_PER_MPS) * moved / np.maximum(end - begin, 1e-9)[:, None]
    # the angle stands for its tangent: a jump of the positions turns no aircraft over
    up[:, 2] = 1.0
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def _flown(flight: FlightFile, where: Path, logs_root: Path | None) -> Targets:
    """Track of a flight without a plan: its levels are not looked at."""
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
        up=attitude_rotation(pose, data.settings.rt.attitude)[pose.valid][:, :, 2],
        time_s=((time - time[0]) / np.timedelta64(1, "s"))[pose.valid],
        remarks=("The flight file has no plan: its track is the route. Its levels are not used.",),
    )


# Columns of a table of points; the last two may be missing.
_COLUMNS = ("east_m", "north_m", "height_m", "yaw_deg", "time_s")


def _local_points(path: Path) -> Targets | None:
    """Points of a CSV with east_m, north_m and height_m (and yaw_deg, time_s); None for another file."""
    if path.suffix.lower() != ".csv":
        return None
    with parsing(path, "columns east_m, north_m, height_m"):
        with path.open("rb") as file:
            head = file.readline(HEAD_BYTES).decode("utf-8-sig", errors="replace")
        if not set(_COLUMNS[:3]) <= {name.strip() for name in head.split(",")}:
            return None
        # a longer table is refused when its limit is passed, not when all of it is in memory
        table = pd.read_csv(
            path, skipinitialspace=True, nrows=MOST_POINTS + 1, encoding="utf-8-sig", index_col=False,
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


def _route(where: Path, site: Site, options: TargetOptions) -> Targets:
    table = read_route(where, height_m=options.heights_m[0])
    place = table["latitude_deg"].to_numpy(), table["longitude_deg"].to_numpy()
    east, north = site.frame.to_local(*place)
    if (away_m := nearest_m(site, *place)) > FAR_M:
        exchanged = nearest_m(site, *place[::-1]) <= FAR_M
        raise InputError(
            f"the route comes no nearer than {away_m / 1000.0:.0f} km to any tower of site {site.name!r}",
            expected="latitude, longitude near the site",
            cause="latitude and longitude are exchanged" if exchanged else "a route of another place",
            path=where,
        )
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
        remarks += (f"Points every {STEP_M:g} m; times by a speed of {SPEED_MPS:g} m/s.",)
    up = _leaning(position, time)
    return Targets(kind="route", name=where.stem, position_m=position, yaw_deg=yaw, time_s=time, up=up, remarks=remarks)
