"""Simulation of a planned flight: logs in the formats of real loggers, and a file of the true values.

``flight.plan`` of a flight.yaml specifies the route and the simulated errors (offsets, fading, clock shifts, bad
lines). The ``logs`` of that file specify the names and formats (by ``reader``) of the logs. The written folder contains
a flight.yaml for ``aerpaw-cmp report``, which must recover the simulated errors.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..common.errors import UsageError
from ..common.files import inside
from ..common.geodesy import SiteFrame, bearing_deg
from ..common.outputs import SUMS, OutputFolder
from ..common.stages import PlannedStage, Stages
from ..common.units import MINIMUM_HEIGHT_M, FloatArray, IntArray
from ..common.yamlfile import dump_yaml
from ..compare.rank import channel_rank
from ..logs.writers import format_power_log, format_ri_csv, format_vehicle_out
from ..propagation.geometry import Link, Poses, rotation_from_aircraft
from ..site.site import Site
from .data import site_place
from .replay import replay_poses
from .settings import LOG_EXAMPLE, FlightFile, LogSettings, PlanSettings, files_of
from .track import interpolated

# Name of the file of the true values.
_TRUTH = "truth.json"
# Name of the flight file that is written next to its logs.
FLIGHT = "flight.yaml"
# Readers whose logs can be written.
_WRITTEN = ("vehicle_out", "sounder_log", "quectel_ri")
# Simulated levels below this count as no signal.
_LOWEST_DBM = -400.0


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A planned trajectory, stored as corner points with times.

    ``time_s`` (corners,) is relative to the start. ``position_m`` (corners, 3) is east, north, and height above the
    ground at the origin. Between corners the UAV moves in a straight line at constant speed.
    """

    time_s: FloatArray
    position_m: FloatArray

    @property
    def duration_s(self) -> float:
        """Time from the first to the last corner [s]."""
        return float(self.time_s[-1])

    def position_at(self, time_s: FloatArray) -> FloatArray:
        """Return positions (n, 3) [m] at times [s]."""
        return interpolated(time_s, self.time_s, self.position_m)

    def velocity_at(self, time_s: FloatArray) -> FloatArray:
        """Return velocities (n, 3) to east, north and up [m/s]. Velocities are zero while the UAV waits."""
        # assign the time of the last corner to the last leg
        leg = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(self.time_s) - 2)
        return np.asarray((np.diff(self.position_m, axis=0) / np.diff(self.time_s)[:, None])[leg])


# Largest number of samples of a simulated log: 140 h at 10 samples per second.
_MAXIMUM_SAMPLES = 5_000_000


def plan_trajectory(plan: PlanSettings) -> Trajectory:
    """Return the trajectory of a plan. The times of the corners follow from speeds, climb rates and waiting times.

    Examples
    --------
    >>> from datetime import datetime
    >>> ends = [{"east_m": 0, "north_m": 0, "height_m": 10}, {"east_m": 80, "north_m": 0, "height_m": 10}]
    >>> plan_trajectory(PlanSettings(start=datetime(2025, 6, 1), waypoints=ends, speed_mps=8)).duration_s
    10.0
    """
    first = plan.waypoints[0]
    times, positions = [0.0], [(first.east_m, first.north_m, first.height_m)]
    for point in plan.waypoints:
        corner, last = (point.east_m, point.north_m, point.height_m), positions[-1]
        horizontal = np.hypot(corner[0] - last[0], corner[1] - last[1])
        duration = max(horizontal / plan.speed_mps, abs(corner[2] - last[2]) / plan.climb_mps)
        if duration > 0:
            times.append(times[-1] + float(duration))
            positions.append(corner)
        if point.hold_s > 0:
            times.append(times[-1] + point.hold_s)
            positions.append(corner)
    shortest = min(plan.telemetry_interval_s, plan.rss_interval_s, plan.rank_interval_s)
    if times[-1] / shortest > _MAXIMUM_SAMPLES:
        raise UsageError(
            f"the plan lasts {times[-1]:.3g} s, with a sample every {shortest:g} s",
            expected=f"at most {_MAXIMUM_SAMPLES} samples of a log",
            cause="a misplaced waypoint, a speed or an interval with too few digits",
        )
    if len(times) < 2:
        raise UsageError("the plan does not move and does not wait", expected="waypoints that differ, or hold_s")
    return Trajectory(np.array(times), np.array(positions, dtype=np.float64))


# Tilt of multicopters per speed, without wind. Fits to nine flights of two airframes have slopes of 0.51 to 0.62.
LEAN_DEG_PER_MPS = 0.6


def plan_attitude(trajectory: Trajectory, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return roll, pitch and yaw [deg] of a multirotor whose nose points along the course and which leans forward.

    While the UAV waits, it keeps its last heading.
    """
    velocity = trajectory.velocity_at(time_s)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    # a hover has no course, so it keeps the heading of the leg before it, or else of the first leg
    yaw = pd.Series(np.where(speed > 0.1, bearing_deg(velocity), np.nan))
    return np.zeros(len(time_s)), -LEAN_DEG_PER_MPS * speed, yaw.ffill().bfill().fillna(0.0).to_numpy()


def planned_poses(plan: PlanSettings, ground_m: float, step_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (n,) [s], positions (n, 3) [m] and headings (n,) [deg] of a plan. Take-off is at ``ground_m``."""
    trajectory = plan_trajectory(plan)
    # slightly longer, so that the end of the flight is sampled if the duration is a multiple of the step
    time_s = np.arange(0.0, trajectory.duration_s + 1e-9, step_s)
    position = trajectory.position_at(time_s)
    position[:, 2] = np.maximum(position[:, 2] + ground_m, MINIMUM_HEIGHT_M)
    return time_s, position, plan_attitude(trajectory, time_s)[2]


def telemetry_frame(
    trajectory: Trajectory, start_utc: pd.Timestamp, interval_s: float, frame: SiteFrame
) -> pd.DataFrame:
    """Return telemetry records of the trajectory. Altitudes are relative to the first position of the trajectory.

    Parameters
    ----------
    trajectory : Trajectory
    start_utc : Timestamp
        Time of the first row.
    interval_s : float
        Interval between rows [s].
    frame : SiteFrame
        Frame that converts local to geographic coordinates.

    Returns
    -------
    DataFrame
        Columns of a telemetry stream (:mod:`aerpaw_cmp.logs.records`), one row per time.
    """
    time_s = np.arange(0.0, trajectory.duration_s + 1e-9, interval_s)
    position = trajectory.position_at(time_s)
    velocity = trajectory.velocity_at(time_s)
    roll, pitch, yaw = plan_attitude(trajectory, time_s)
    latitude, longitude = frame.to_geographic(position[:, 0], position[:, 1])
    records: pd.DataFrame = pd.DataFrame(
        {
            "time": _times_after(start_utc, time_s),
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "altitude_m": position[:, 2],
            "roll_deg": roll,
            "pitch_deg": pitch,
            "yaw_deg": yaw,
            "velocity_north_mps": velocity[:, 1],
            "velocity_east_mps": velocity[:, 0],
            # autopilots log the velocity downwards
            "velocity_down_mps": -velocity[:, 2],
            "fix": 4,
            "satellites": 18,
        }
    )
    return records


def _times_after(start_utc: pd.Timestamp, seconds: FloatArray) -> pd.Series:
    """Return naive UTC times, rounded to the microsecond of the log formats."""
    stamps: pd.Series = pd.Series(
        start_utc + pd.to_timedelta(np.round(np.asarray(seconds) * 1e6).astype(np.int64), unit="us")
    )
    return stamps


def correlated_noise(
    generator: np.random.Generator, count: int, standard_deviation: float, step_s: float, correlation_s: float
) -> FloatArray:
    """Return first-order autoregressive Gaussian noise with a standard deviation and a correlation time.

    Parameters
    ----------
    generator : Generator
    count : int
        Number of samples.
    standard_deviation : float
        Standard deviation of each sample.
    step_s, correlation_s : float
        Interval between samples, and time after which the correlation is 1/e [s].

    Returns
    -------
    (count,)
    """
    from scipy.signal import lfilter

    if count == 0 or standard_deviation == 0:
        return np.zeros(count)
    keep = np.exp(-step_s / correlation_s)
    white = generator.standard_normal(count) * np.sqrt(1 - keep**2)
    # the first sample has the full standard deviation, because the process is stationary
    white[0] /= np.sqrt(1 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white) * standard_deviation)


def _local_start(start: datetime, timezone: str) -> pd.Timestamp:
    """Return the start in its time zone. Refuse a local time that does not exist or is ambiguous."""
    try:
        # request NaT in both cases, because pandas would otherwise raise two kinds of exceptions
        local: Any = pd.Timestamp(start.replace(tzinfo=None)).tz_localize(timezone, ambiguous="NaT", nonexistent="NaT")
        if not 1980 <= start.year <= 2200:
            why = "a year outside 1980 to 2200"
        elif not pd.isna(local):
            start_there: pd.Timestamp = local
            return start_there
        else:
            why = "the clocks changed then: this time does not exist or exists twice"
    except (ValueError, OverflowError) as error:
        why = str(error)
    raise UsageError(f"flight.plan.start {start} in {timezone}", expected="a wall time", cause=why)


class FlightSimulator:
    """The writer of the logs of one planned flight.

    Parameters
    ----------
    settings : FlightFile
        Settings with ``flight.plan``.
    site : Site
        The site of the flight.
    folder : Path
        Folder of the antenna files of the link.

    Attributes
    ----------
    truth_ : dict
        Content of truth.json: the true values of all simulated errors. The dictionary is complete after :meth:`run`.
    """

    def __init__(self, settings: FlightFile, site: Site, folder: Path) -> None:
        self.settings = settings
        self.site = site
        self.folder = folder

    def run(
        self, out: Path, *, inputs: Iterable[Path] = (), force: bool = False, stages: Stages | None = None
    ) -> list[Path]:
        """Write a folder with all logs of the flight file, a flight file and truth.json, and return the written paths.

        Parameters
        ----------
        out : Path
            Folder that is created or replaced; see :class:`~aerpaw_cmp.common.outputs.OutputFolder`.
        inputs : iterable of Path
            Files that must not be in this folder: the flight file and the files that it names.
        force : bool
            True to replace files that were changed after this tool wrote them.
        stages : Stages, optional
            Receives the path of each log as progress.

        Returns
        -------
        list of Path
            Logs in the order of the flight file, the flight file, truth.json.

        Raises
        ------
        UsageError
            If the plan or the time zone is missing, a reader has no writer, a tower is unknown, or the folder contains
            files that this tool did not write.
        OutputError
            If the files cannot be written.
        """
        plan = self.settings.flight.plan
        if plan is None:
            raise UsageError("the flight file has no plan", expected="flight.plan with start and waypoints")
        if not self.settings.logs:
            expected = f"entries under 'logs', such as {LOG_EXAMPLE}"
            raise UsageError("the flight file lists no log to write", expected=expected)
        if self.settings.timezone is None:
            raise UsageError("the flight file names no time zone", expected="such as timezone: America/New_York")
        self.plan = plan
        # include the name in the seed: with equal fading, two flights would be recognised as copies of one log
        self.generator = np.random.default_rng([plan.seed, *self.settings.flight.name.encode()])
        self.trajectory = plan_trajectory(plan)
        start = _local_start(plan.start, self.settings.timezone)
        self.start_utc = start.tz_convert("UTC").tz_localize(None)
        self.truth_: dict[str, Any] = {"flight": self.settings.flight.name, "synthetic": True, "rss": {}, "rank": {}}
        self._check_names(out)
        self._check_plan()
        writers = {log.path: self._writer(log) for log in self.settings.logs}
        stages = stages or Stages()
        with OutputFolder(out, job="simulate", inputs=inputs, force=force) as output:
            lasts = f"{self.trajectory.duration_s:.0f} s of flight: "
            stages.checked(lambda: [PlannedStage("logs", lasts + ", ".join(writers))])
            contents: dict[str, bytes] = {}
            for name, write in writers.items():
                stages.progress(name)
                contents[name], damage = self._with_bad_lines(write())
                self.truth_.setdefault("bad_lines", {})[name] = damage
            self.truth_["plan"] = plan.model_dump(mode="json")
            contents |= {
                FLIGHT: dump_yaml(self._flight_file()).encode("utf-8"),
                _TRUTH: (json.dumps(self.truth_, indent=1) + "\n").encode("utf-8"),
            }
            with output.filling() as folder:
                for name, content in contents.items():
                    # create only subfolders: if the folder was removed during the run, it must not be created again
                    for parent in reversed(Path(name).parents[:-1]):
                        (folder / parent).mkdir(exist_ok=True)
                    (folder / name).write_bytes(content)
            return [out / name for name in contents]

    def _flight_file(self) -> dict[str, Any]:
        """Return the settings for a flight file in another folder: paths of site and antenna files are absolute."""
        # write only the settings of the user, because defaults may change
        content: dict[str, Any] = self.settings.model_dump(mode="json", exclude_unset=True)
        place = site_place(self.settings.site.file, self.folder)
        content["site"] = {**content.get("site", {}), "file": place if isinstance(place, str) else str(place.resolve())}
        return content | files_of({"link": content["link"]} if "link" in content else {}, self.folder)

    def _check_names(self, out: Path) -> None:
        """Refuse a log whose path is outside ``out``, and two logs with the same name."""
        names = [log.path for log in self.settings.logs]
        for name in names:
            inside(out, name, out / FLIGHT, error=UsageError)
            if names.count(name) > 1 or name in (_TRUTH, FLIGHT, SUMS):
                raise UsageError(f"two files of this flight are named {name!r}", expected="different names")

    def _check_plan(self) -> None:
        """Refuse offsets and clock shifts for towers or channels that no simulated log has."""
        links = [f"{log.node}.{log.channel}" for log in self.settings.logs if log.node and log.channel]
        towers = [log.node for log in self.settings.logs if log.node]
        asked = {f"{tower}.{channel}": links for tower, each in self.plan.offsets_db.items() for channel in each}
        for name, valid in {**asked, **dict.fromkeys(self.plan.clock_shift_s, towers)}.items():
            if name not in valid:
                key = "clock_shift_s" if valid is towers else "offsets_db"
                raise UsageError(
                    f"flight.plan.{key}: there is no log of {name!r}",
                    expected="one of " + ", ".join(dict.fromkeys(valid)),
                )

    def _writer(self, log: LogSettings) -> Callable[[], bytes]:
        """Return the function that computes a log. Raise UsageError if the log cannot be simulated."""
        if log.reader not in _WRITTEN:
            raise UsageError(
                f"no writer for log {log.path!r} with reader {log.reader!r}", expected="one of " + ", ".join(_WRITTEN)
            )
        if log.reader == "vehicle_out":
            return partial(self._telemetry_log, log)
        if log.reader == "sounder_log" and (log.node is None or log.channel is None):
            raise UsageError(f"log {log.path!r} has no tower or no channel", expected="'node' and 'channel'")
        links, tower = self.settings.link, log.node or self.settings.rank.tower
        if tower not in self.site.towers:
            raise UsageError(f"the site has no tower {tower!r}", expected="one of " + ", ".join(self.site.towers))
        if log.reader == "quectel_ri":
            return partial(self._rank_log, log, tower, self._tried(links.rank.build([tower], self.folder)))
        link = self._tried(links.of(str(log.channel)).build([tower], self.folder))
        return partial(self._rss_log, log, tower, link)

    def _tried(self, link: Link) -> Link:
        """Replay one pose with a link and return the link, so that a dry run finds the errors of the simulation."""
        replay_poses(self.site, self.settings.rt, link, self._poses(np.zeros(1)))
        return link

    def _telemetry_log(self, log: LogSettings) -> bytes:
        frame = telemetry_frame(self.trajectory, self.start_utc, self.plan.telemetry_interval_s, self.site.frame)
        return format_vehicle_out(frame, str(log.timezone or self.settings.timezone))

    def _poses(self, time_s: FloatArray) -> Poses:
        position = self.trajectory.position_at(time_s)
        # raise low positions, as the replay does: on the ground, the direct and the reflected ray cancel
        position[:, 2] = np.maximum(position[:, 2], MINIMUM_HEIGHT_M)
        if self.settings.rt.attitude == "ignored":
            return Poses(position, np.broadcast_to(np.eye(3), (len(time_s), 3, 3)))
        roll, pitch, yaw = plan_attitude(self.trajectory, time_s)
        if self.settings.rt.attitude == "level":
            roll, pitch = np.zeros_like(roll), np.zeros_like(pitch)
        return Poses(position, rotation_from_aircraft(roll, pitch, yaw))

    def _rss_log(self, log: LogSettings, tower: str, link: Link) -> bytes:
        plan = self.plan
        time_s = np.arange(0.0, self.trajectory.duration_s, plan.rss_interval_s)
        result = replay_poses(self.site, self.settings.rt, link, self._poses(time_s))
        offset = plan.offsets_db.get(tower, {}).get(str(log.channel), 0.0)
        level = result.level_dbm(self.settings.rss.field)[:, 0] - offset
        level = level + correlated_noise(
            self.generator, len(level), plan.fading_db, plan.rss_interval_s, plan.fading_correlation_s
        )
        out_of_coverage = ~np.isfinite(level) | (level < _LOWEST_DBM)
        # the log contains times of the tower's clock, but levels at the true times
        shift = plan.clock_shift_s.get(tower, 0.0)
        self.truth_["rss"].setdefault(tower, {})[str(log.channel)] = {
            "offset_db": offset,
            "fading_db": plan.fading_db,
            "clock_shift_s": shift,
            "samples": len(level),
            "out_of_coverage": int(out_of_coverage.sum()),
        }
        return format_power_log(
            _times_after(self.start_utc, time_s + shift),
            np.where(out_of_coverage, np.nan, level),
            str(log.timezone or self.settings.timezone),
        )

    def _rank_log(self, log: LogSettings, tower: str, link: Link) -> bytes:
        plan = self.plan
        time_s = np.arange(0.0, self.trajectory.duration_s, plan.rank_interval_s)
        poses = self._poses(time_s)
        result = replay_poses(self.site, self.settings.rt, link, poses)
        truth = channel_rank(result.h[:, 0], plan.rank_k)
        reported = self._reported(truth, min(result.h.shape[-2:]))
        latitude, longitude = self.site.frame.to_geographic(poses.position_m[:, 0], poses.position_m[:, 1])
        self.truth_["rank"][tower] = {
            "k": plan.rank_k,
            "error_share": plan.rank_error_share,
            "no_csi_share": plan.no_csi_share,
            "samples": len(truth),
            "histogram": {str(r): int((truth == r).sum()) for r in range(5)},
        }
        records = pd.DataFrame(
            {
                "time": _times_after(self.start_utc, time_s),
                "rank": reported,
                "latitude_deg": latitude,
                "longitude_deg": longitude,
                "altitude_m": poses.position_m[:, 2],
            }
        )
        return format_ri_csv(records, str(log.timezone or self.settings.timezone))

    def _reported(self, rank: IntArray, layers: int) -> IntArray:
        """Return the rank that the modem reports: sometimes wrong by one layer, and 0 without CSI."""
        generator, plan = self.generator, self.plan
        off = generator.random(len(rank)) < plan.rank_error_share
        step = np.where(generator.random(len(rank)) < 0.5, -1, 1)
        # at least 1, because 0 means no CSI
        reported = np.where(off, np.clip(rank + step, 1, layers), rank)
        return np.where(generator.random(len(rank)) < plan.no_csi_share, 0, reported)

    def _with_bad_lines(self, data: bytes) -> tuple[bytes, list[str]]:
        """Insert ``plan.bad_lines`` broken lines at random positions, but not in the first line."""
        lines = data.splitlines(keepends=True)
        count = min(self.plan.bad_lines, len(lines) - 10)
        # do not damage a shorter log, because it would consist mainly of broken lines
        if count == 0 or len(lines) < 20:
            return data, []
        end = b"\r\n" if lines[0].endswith(b"\r\n") else b"\n"
        places = sorted(
            self.generator.choice(np.arange(10, len(lines)), size=count, replace=False).tolist(), reverse=True
        )
        damage = []
        for number, place in enumerate(places):
            # insert a line cut off by a killed logger, or console output
            torn = lines[place].rstrip()[: max(4, len(lines[place]) // 3)]
            text = torn if number % 2 == 0 else b"Killed by signal 15 " + torn[:8]
            lines.insert(place, text + end)
            damage.append(text.decode("utf-8", errors="replace"))
        return b"".join(lines), damage[::-1]
