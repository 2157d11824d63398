"""Position, height and attitude of the UAV at any time.

Attitude is interpolated as rotation (slerp), never as angles. Telemetry gaps longer than a limit are not bridged, and
poses inside them are invalid, with a reason. A missing attitude is replaced by level flight along the course, and the
pose is flagged. :class:`TrackAccount` counts every row that is not used.
"""

from __future__ import annotations

import copy
import dataclasses
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError
from ..common.geodesy import SiteFrame, bearing_deg
from ..common.text import counted
from ..common.units import MINIMUM_HEIGHT_M, AnyArray, BoolArray, FloatArray, IntArray
from ..logs.ingest import IngestedFile
from ..logs.records import Stream
from ..propagation.geometry import rotation_from_aircraft
from .settings import LogSettings

if TYPE_CHECKING:
    import pandas as pd


# A function that returns the height of the ground [m] at east and north coordinates [m], each (n,).
Ground = Callable[[FloatArray, FloatArray], FloatArray]

# Largest drift of heights above take-off during a flight [m]. Real logs end as low as -3.9 m after landing.
_DRIFT_M = 5.0


def raised(up_m: FloatArray, ground_m: FloatArray, takeoff_m: float) -> tuple[FloatArray, BoolArray]:
    """Return heights, raised to just above the ground after a drift, and a mask of poses below the ground.

    A height slightly below the ground is attributed to drift if it is close to the height of the take-off point. Any
    other height below the ground means that either the height or the ground is wrong.

    Parameters
    ----------
    up_m, ground_m : (n,)
        Heights of the poses and of the ground below them [m].
    takeoff_m : float
        Height of the take-off point [m].

    Returns
    -------
    (n,), (n,) bool

    Examples
    --------
    >>> raised(np.array([-2.0, -20.0, 8.0]), np.zeros(3), 0.0)
    (array([  0.5, -20. ,   8. ]), array([False,  True, False]))
    """
    drift = np.where(ground_m <= takeoff_m + _DRIFT_M, _DRIFT_M, 0.0)
    buried = up_m < ground_m - drift
    return np.where(buried, up_m, np.fmax(up_m, ground_m + MINIMUM_HEIGHT_M)), buried


_IN_NAME = re.compile(r"(?<![A-Za-z0-9.])(\d{1,3}) ?(?:m|meters|metres)(?![A-Za-z0-9])")


def lacks_height(stream: Stream) -> bool:
    """Check whether a stream has positions but no altitudes."""
    frame = stream.frame
    if "latitude_deg" not in frame or not frame["latitude_deg"].notna().any():
        return False
    return "altitude_m" not in frame or not bool(frame["altitude_m"].notna().any())


def at_height(log: LogSettings, file: IngestedFile) -> IngestedFile:
    """Return a log with missing altitudes replaced by ``height_m`` of the flight file.

    Parameters
    ----------
    log : LogSettings
    file : IngestedFile
        The log as it was read.

    Returns
    -------
    IngestedFile
        The unchanged log if the flight file has no ``height_m``.

    Raises
    ------
    UsageError
        If the flight file has ``height_m``, but every stream with positions has altitudes.
    """
    if log.height_m is None:
        return file
    streams = [
        replace(s, frame=s.frame.assign(altitude_m=float(log.height_m))) if lacks_height(s) else s
        for s in file.result.streams
    ]
    if all(after is before for after, before in zip(streams, file.result.streams, strict=True)):
        raise UsageError(
            f"{log.path}: 'height_m' has no effect",
            expected="a log with positions and no altitude",
            cause="the log has altitudes, or no positions",
        )
    note = f"no altitude in the log: {log.height_m:g} m above take-off everywhere (height_m)"
    # omit the reader's warning about the missing height, because height_m replaces it
    warnings = [text for text in file.result.warnings if not text.startswith("no column is known as a height")]
    return replace(file, result=replace(file.result, streams=tuple(streams), warnings=(*warnings, note)))


def height_in_name(path: str) -> float | None:
    """Return the height in the name of a log file [m], if the name contains exactly one.

    Examples
    --------
    >>> height_in_name("urban/60m.csv"), height_in_name("run2_120m_5G.csv"), height_in_name("phone.csv")
    (60.0, 120.0, None)
    """
    # count distinct heights: flight_60m_60m contains one height, 40m_to_60m two
    heights = {float(text) for text in _IN_NAME.findall(Path(path).stem.replace("_", " "))}
    return heights.pop() if len(heights) == 1 else None


# Longest telemetry gap that is interpolated [s]. Rows of vehicleOut are 1.0 s apart.
_MAXIMUM_GAP_S = 3.0

# Sparse telemetry is interpolated by straight lines. If nine of ten steps between fixes are at most this long [m] (a
# step of 14 s at 2 m/s has 28 m), all intervals are interpolated. On a faster flight, an interval is interpolated only
# if one of its ends is this close [m] to the line between the neighbouring fixes. In the field data, nine of ten ends
# are within 7.7 m.
_SPARSE_APART_M, _SPARSE_ERROR_M = 100.0, 10.0

# In sparse telemetry, an interval longer than this multiple of the usual interval is a gap.
_SPARSE_GAP = 2.0

# Below this ground speed the course does not indicate the heading [m/s].
_COURSE_SPEED_MPS = 1.0

# Number of times whose poses are computed together. The number limits the memory on flights of more than half an hour.
AT_ONCE = 100_000

# Velocities are computed from the positions this long before and after [s].
_COURSE_SPAN_S = 2.0

# Reasons why a pose is not valid. Index 0 means a valid pose.
REASONS = (
    "", "before telemetry", "after telemetry", "telemetry gap", "no telemetry", "no time", "no position of the tower",
    "below the site's ground plane",
)  # fmt: skip


# Alternative meanings of a logged attitude: the columns of roll, pitch and yaw, their signs, and degrees to add to
# the yaw. A yaw without a sign is the course.
MISREAD = {
    "the logged yaw has the wrong sign": ([0, 1, 2], [1.0, 1.0, -1.0], 0.0),
    "the logged yaw counts from east, counter-clockwise": ([0, 1, 2], [1.0, 1.0, -1.0], 90.0),
    "the nose follows the course, not the logged yaw": ([0, 1, 2], [0.0, 0.0, 0.0], 0.0),
    "the logged pitch has the wrong sign": ([0, 1, 2], [1.0, -1.0, 1.0], 0.0),
    "the logged roll has the wrong sign": ([0, 1, 2], [-1.0, 1.0, 1.0], 0.0),
    "the columns of pitch and yaw are swapped": ([0, 2, 1], [1.0, 1.0, 1.0], 0.0),
    "the columns of roll and yaw are swapped": ([2, 1, 0], [1.0, 1.0, 1.0], 0.0),
    "the columns of roll and pitch are swapped": ([1, 0, 2], [1.0, 1.0, 1.0], 0.0),
    "the columns of roll, pitch and yaw are shifted by one": ([1, 2, 0], [1.0, 1.0, 1.0], 0.0),
    "the columns of roll, pitch and yaw are shifted by two": ([2, 0, 1], [1.0, 1.0, 1.0], 0.0),
}


@dataclass(frozen=True, slots=True)
class TrackAccount:
    """The numbers of telemetry rows that are used and, by reason, not used.

    Parameters
    ----------
    rows : int
        Rows of the telemetry frame.
    no_time, duplicate_time, backward_time, bad_position : int
        Rows that are not used for positions, by reason: no time stamp, the same stamp as the row before, an earlier
        stamp than some row before, or impossible coordinates (including NaN and -999). If that excludes fewer rows, a
        row counts as backward if some row after it has an earlier stamp.
    steps_sorted : int
        Number of steps back in time in a shuffled file. The rows of such a file are sorted by time, because that makes
        the path shorter.
    unknown_attitude : int
        Used rows without attitude (NaN, or exactly 0, 0, 0, which converters write for "unknown").
    heading_alone : int
        Used rows with a heading but without roll and pitch.
    below_ground : int
        Used rows below the ground plane of the site.
    sparse_s : float
        Usual interval [s] of sparse telemetry, which is interpolated by straight lines. 0 for other telemetry.
    sparse_error_m : (median, 90th percentile)
        Error of the straight lines [m]: half the distance of each fix from the line between its neighbours.
    gaps : int
        Number of intervals between used rows that exceed the limit.
    longest_gap_s : float
        Longest interval [s].
    hour_steps : int
        Number of time steps of full hours between neighbouring rows, as at a change to or from daylight saving time.
    """

    rows: int
    no_time: int
    duplicate_time: int
    backward_time: int
    bad_position: int
    unknown_attitude: int
    gaps: int
    longest_gap_s: float
    hour_steps: int = 0
    steps_sorted: int = 0
    heading_alone: int = 0
    below_ground: int = 0
    sparse_s: float = 0.0
    sparse_error_m: tuple[float, float] = (0.0, 0.0)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The warnings for the user, one sentence each."""
        reasons = (
            (self.hour_steps, "step", "of whole hours between telemetry rows: daylight-saving change or a reset clock"),
            (self.steps_sorted, "step", "back in time between telemetry rows: all rows were sorted by time"),
            (self.backward_time, "telemetry row", "out of time order: ignored"),
            (self.duplicate_time, "telemetry row", "with the time stamp of the row before: ignored"),
            (self.no_time, "telemetry row", "without a time stamp: ignored"),
            (self.bad_position, "telemetry row", "without a position (NaN, -999): ignored"),
            (self.gaps, "telemetry gap", f"(the longest {self.longest_gap_s:.1f} s): not interpolated"),
            (self.unknown_attitude, "telemetry row", "without attitude: level flight along the course is assumed"),
            (self.heading_alone, "telemetry row", "with only a heading: level flight in its direction is assumed"),
            (self.below_ground, "telemetry row", "below the site's ground: not compared (origin.takeoff_ground_m)"),
        )
        usual_m, high_m = self.sparse_error_m
        sparse = (
            f"the telemetry has a fix every {self.sparse_s:.0f} s: positions in between are interpolated, with a "
            f"median error of about {usual_m:.0f} m and {high_m:.0f} m in one case of ten"
        )
        return (*([sparse] if self.sparse_s else []), *(f"{counted(n, noun)} {text}" for n, noun, text in reasons if n))


@dataclass(frozen=True, slots=True)
class TrackPoses:
    """The poses at requested times.

    Parameters
    ----------
    position_m : (n, 3)
        East, north, up in the site frame [m]; NaN if not valid.
    rotation : (n, 3, 3)
        Rotation from the aircraft body (forward-left-up) to east-north-up; NaN if not valid.
    valid : (n,) bool
        False before, after and inside gaps of the telemetry.
    reason_code : (n,) int8
        Index into :data:`REASONS`; 0 if valid.
    attitude_known : (n,) bool
        False if the attitude is unknown and replaced by level flight along the course.
    """

    position_m: FloatArray
    rotation: FloatArray
    valid: BoolArray
    reason_code: AnyArray
    attitude_known: BoolArray

    def __len__(self) -> int:
        return len(self.valid)

    def pick(self, rows: BoolArray) -> TrackPoses:
        """Return the poses of some rows (n,) bool, or this object if all rows are selected."""
        if rows.all():
            return self
        return TrackPoses(**{field.name: getattr(self, field.name)[rows] for field in dataclasses.fields(self)})

    def where(self, known: BoolArray) -> TrackPoses:
        """Return the poses, marked as not valid at times when the position of a moving tower is not ``known`` (n,)."""
        if known.all():
            return self
        lost = self.valid & ~known
        return dataclasses.replace(
            self,
            position_m=np.where(known[:, None], self.position_m, np.nan),
            valid=self.valid & known,
            reason_code=np.where(lost, REASONS.index("no position of the tower"), self.reason_code).astype(np.int8),
        )

    @property
    def reason(self) -> AnyArray:
        """Reasons why poses are not valid (n,), from :data:`REASONS`. Empty for valid poses."""
        return np.asarray(REASONS)[self.reason_code]

    @property
    def heading_deg(self) -> FloatArray:
        """The heading of the nose, clockwise from north, [0, 360) deg."""
        return np.asarray(bearing_deg(self.rotation[:, :, 0]) % 360.0)


def nanoseconds(times: ArrayLike | pd.Series) -> AnyArray:
    """Return UTC times as int64 ns since 1970.

    NaT becomes the smallest integer. Floats are epoch seconds.
    """
    # convert to ns explicitly, because default units differ between versions of pandas and NumPy
    array = np.asarray(times)
    if array.dtype.kind == "M":
        return np.asarray(array.astype("datetime64[ns]").astype(np.int64))
    if array.dtype.kind == "O":
        import pandas as pd

        stamps = pd.DatetimeIndex(pd.to_datetime(array, utc=True)).tz_localize(None)
        return np.asarray(stamps.to_numpy().astype("datetime64[ns]").astype(np.int64))
    seconds = array.astype(np.float64)
    good = np.isfinite(seconds)
    stamp = np.round(np.where(good, seconds, 0.0) * 1e9).astype(np.int64)
    return np.asarray(np.where(good, stamp, np.iinfo(np.int64).min))


# Value of an unknown time.
NO_TIME = np.iinfo(np.int64).min

# Times closer than this are equal [s], because epoch seconds as floats have a resolution of 0.2 microseconds.
_SAME_S = 1e-6


def _forward_rows(stamp: AnyArray) -> tuple[BoolArray, int, int]:
    """Return a mask of rows with strictly increasing times, and the numbers of duplicate and backward rows.

    A row is backward if any row before it has a later time. With this rule, a wrong time in the future excludes all
    rows after it. The mirrored rule (a row is wrong if any row after it has an earlier time) is used if it excludes
    fewer rows.
    """
    if not len(stamp):
        return np.zeros(0, dtype=bool), 0, 0
    # the latest stamp before each row, and the earliest after it
    before = np.concatenate([[NO_TIME], np.maximum.accumulate(stamp)[:-1]])
    after = np.concatenate([np.minimum.accumulate(stamp[::-1])[::-1][1:], [np.iinfo(np.int64).max]])
    onward, mirrored = stamp >= before, stamp <= after
    # in a tie use the first rule, because earlier rows are more likely to be right
    ordered = onward if onward.sum() >= mirrored.sum() else mirrored
    keep = ordered.copy()
    rows = np.flatnonzero(ordered)
    repeated = np.concatenate([[False], np.diff(stamp[rows]) == 0])
    keep[rows[repeated]] = False
    return keep, int(repeated.sum()), int((~ordered).sum())


def _order(stamp: AnyArray, position: FloatArray) -> tuple[IntArray, int]:
    """Return the order in which rows are used, and the number of steps back in time that sorting removes.

    Rows are sorted by time only if the file is shuffled.

    If only the clock stepped back, the rows are in flown order. Sorting would mix two parts of the flight and make the
    path longer. In a file that was sorted by another column or joined from parts, sorting makes the path shorter.
    """
    steps, written = int((np.diff(stamp) < 0).sum()), np.arange(len(stamp))
    if not steps:
        return written, 0
    order = np.argsort(stamp, kind="stable")

    def length_m(path: FloatArray) -> float:
        return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())

    # allow for rounding, because the path of a reversed file has the same length
    shorter = length_m(position[order]) <= length_m(position) * (1 + 1e-9)
    return (order, steps) if shorter else (written, 0)


def _hour_steps(stamp: AnyArray) -> int:
    """Return the number of time steps between rows that are full hours within five seconds, forward or back."""
    step = np.diff(stamp) * 1e-9
    hours = np.round(step / 3600.0)
    # daylight saving time is one hour, in Antarctica two
    return int(((hours != 0) & (np.abs(hours) <= 2) & (np.abs(step - 3600.0 * hours) < 5.0)).sum())


def good_positions(latitude: FloatArray, longitude: FloatArray, altitude: FloatArray) -> BoolArray:
    """Check that coordinates are finite, in range, and neither (0, 0) nor -999, which loggers write without a fix."""
    finite = np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(altitude)
    with np.errstate(invalid="ignore"):
        possible = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 180.0) & (altitude > -900.0)
    return np.asarray(finite & possible & ~((latitude == 0.0) & (longitude == 0.0)))


def positions_over_time(frame: pd.DataFrame) -> tuple[FloatArray, FloatArray]:
    """Return ascending times (n,) [s since 1970], and latitude and longitude (n, 2) [deg] of complete rows."""
    known = frame[["time", "latitude_deg", "longitude_deg"]].dropna().drop_duplicates("time").sort_values("time")
    return nanoseconds(known["time"]) * 1e-9, known[["latitude_deg", "longitude_deg"]].to_numpy(np.float64)


class Track:
    """A flight path from one telemetry stream, in a site frame.

    Parameters
    ----------
    telemetry : pandas.DataFrame
        Records of kind telemetry (see :mod:`aerpaw_cmp.logs.records`), in the order of the file.
    frame : SiteFrame
        Frame of the site.
    maximum_gap_s : float
        Positions are not interpolated in longer gaps [s].
    ground_m : float
        Height of the take-off point above the site origin [m], added to ``altitude_m``.
    ground : callable, optional
        Function that returns the height of the site's ground at east and north [m]. By default it is the height of the
        take-off point everywhere.

    Attributes
    ----------
    account : TrackAccount
        Counts of the rows.
    start_ns, end_ns : int
        First and last used time [ns since 1970, UTC]; both 0 without a row.
    """

    def __init__(
        self,
        telemetry: pd.DataFrame,
        frame: SiteFrame,
        *,
        maximum_gap_s: float = _MAXIMUM_GAP_S,
        ground_m: float = 0.0,
        ground: Ground | None = None,
    ) -> None:
        self.frame = frame
        self.maximum_gap_s = maximum_gap_s
        self.ground_m = ground_m
        self._ground = ground or (lambda east, _: np.full(len(east), ground_m))
        self._load(telemetry)

    def _load(self, telemetry: pd.DataFrame) -> None:
        def column(name: str) -> FloatArray:
            return telemetry[name].to_numpy(dtype=np.float64)

        stamp = nanoseconds(telemetry["time"])
        latitude, longitude, altitude = column("latitude_deg"), column("longitude_deg"), column("altitude_m")
        timed = stamp != NO_TIME
        # positions are interpolated between complete rows, and the account counts all other rows
        placed = timed & good_positions(latitude, longitude, altitude)
        rows = np.flatnonzero(placed)
        east, north = self.frame.to_local(latitude[rows], longitude[rows])
        position = np.column_stack([east, north, altitude[rows] + self.ground_m])
        order, steps_sorted = _order(stamp[rows], position)
        hour_steps = _hour_steps(stamp[rows[order]] if steps_sorted else stamp[timed])
        forward, duplicates, backward = _forward_rows(stamp[rows[order]])
        used = order[forward]
        rows, position = rows[used], position[used]

        self.start_ns = int(stamp[rows[0]]) if len(rows) else 0
        self.end_ns = int(stamp[rows[-1]]) if len(rows) else 0
        self._time_s = (stamp[rows] - self.start_ns) * 1e-9
        self._position = position
        velocity = [column("velocity_east_mps"), column("velocity_north_mps"), -column("velocity_down_mps")]
        self._velocity = _velocities(self._time_s, self._position, np.column_stack(velocity)[rows])
        self._course_deg = _courses(self._velocity)
        self._attitude = np.column_stack([column("roll_deg"), column("pitch_deg"), column("yaw_deg")])[rows]
        turn, yaw = self._attitude[:, :2], self._attitude[:, 2]
        # a column of zeros is not a logged heading, because converters write 0 for "unknown"
        heading_alone = np.isfinite(yaw) & ~np.isfinite(turn).any(axis=1) & bool(np.nan_to_num(yaw).any())
        turn[heading_alone] = 0.0
        known = np.isfinite(self._attitude).all(axis=1) & (np.any(self._attitude != 0.0, axis=1) | heading_alone)
        self._known = known
        interval = np.diff(self._time_s)
        sparse_s, self._turns, sparse_error_m = self._sparse(interval)
        # change the limit last, because the requested limit decides whether telemetry is sparse
        self.maximum_gap_s = max(self.maximum_gap_s, _SPARSE_GAP * sparse_s)
        self._gap = (interval > self.maximum_gap_s) | self._turns
        self._asked = np.zeros(0, np.int64), self._pose_at(np.zeros(0, np.int64))
        self.account = TrackAccount(
            rows=len(stamp),
            no_time=int((~timed).sum()),
            duplicate_time=duplicates,
            backward_time=backward,
            bad_position=int((timed & ~placed).sum()),
            unknown_attitude=int((~known).sum()),
            gaps=int(self._gap.sum()),
            longest_gap_s=float(interval.max()) if len(interval) else 0.0,
            hour_steps=hour_steps,
            steps_sorted=steps_sorted,
            heading_alone=int(heading_alone.sum()),
            below_ground=int(self._raised(position)[1].sum()),
            sparse_s=sparse_s,
            sparse_error_m=sparse_error_m,
        )

    def __len__(self) -> int:
        return len(self._time_s)

    def pose_at(self, times: ArrayLike | pd.Series) -> TrackPoses:
        """Return the poses at requested times.

        Parameters
        ----------
        times : array_like, (n,)
            datetime64 (UTC) or epoch seconds, in any order.

        Returns
        -------
        TrackPoses
        """
        instant = nanoseconds(times).ravel()
        if len(instant) <= AT_ONCE:
            if not np.array_equal(instant, self._asked[0]):  # channels of a log share their times
                poses = self._pose_at(instant)
                for field in dataclasses.fields(poses):
                    getattr(poses, field.name).flags.writeable = False  # callers share these arrays
                self._asked = instant, poses
            return self._asked[1]
        parts = [self._pose_at(part) for part in np.array_split(instant, -(-len(instant) // AT_ONCE))]
        names = [field.name for field in dataclasses.fields(TrackPoses)]
        return TrackPoses(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def rotations_if(self, misread: str, times: ArrayLike | pd.Series) -> FloatArray:
        """Return rotations (n, 3, 3) at times if the logged angles had an alternative meaning of :data:`MISREAD`."""
        order, signs, east_deg = MISREAD[misread]
        other = copy.copy(self)
        other._attitude = self._attitude[:, order] * signs + [0.0, 0.0, east_deg]
        if signs[2] == 0.0:
            other._attitude[:, 2] = self._course_deg
        return other._rotations((nanoseconds(times) - self.start_ns) * 1e-9)[0]

    def why_not(self, pose: TrackPoses) -> str:
        """Return the most frequent reason why times have no pose."""
        reason = REASONS[int(np.bincount(pose.reason_code[~pose.valid], minlength=len(REASONS)).argmax())]
        if reason != "telemetry gap":
            return f"most are {reason}" if reason else "there are no samples"
        long = f"gaps above {self.maximum_gap_s:g} s (rt.advanced.maximum_gap_s)"
        left = "turns between fixes" if self._turns.any() else long
        return f"it has a fix every {np.median(np.diff(self._time_s)):.0f} s; {left} are not interpolated"

    def _pose_at(self, instant: AnyArray) -> TrackPoses:
        """Return poses at times (n,) [ns since 1970]."""
        timed = instant != NO_TIME
        # relative to the first row, because float64 seconds since 1970 have a resolution of only 0.2 microseconds
        t = np.where(timed, instant - self.start_ns, 0) * 1e-9
        code = self._codes(t)
        code[~timed] = REASONS.index("no time")
        valid = code == 0
        n = len(t)
        if len(self):
            # rounding may move a time before the first row
            t = np.clip(t, self._time_s[0], self._time_s[-1])
        position = np.full((n, 3), np.nan)
        rotation = np.full((n, 3, 3), np.nan)
        known = np.zeros(n, dtype=bool)
        if valid.any():
            position[valid] = interpolated(t[valid], self._time_s, self._position)
            rotation[valid], known[valid] = self._rotations(t[valid])
            position[valid, 2], buried = self._raised(position[valid])
            code[np.flatnonzero(valid)[buried]] = REASONS.index("below the site's ground plane")
            valid = code == 0
            position[~valid], rotation[~valid], known[~valid] = np.nan, np.nan, False
        return TrackPoses(
            position_m=position, rotation=rotation, valid=valid, reason_code=code.astype(np.int8), attitude_known=known
        )

    def _sparse(self, interval_s: FloatArray) -> tuple[float, BoolArray, tuple[float, float]]:
        """Return the usual interval of sparse telemetry, a mask of intervals with turns, and the error of lines."""
        usual_s = float(np.median(interval_s)) if len(interval_s) > 1 else 0.0
        turns, step_m = np.zeros(len(interval_s), dtype=bool), np.linalg.norm(np.diff(self._position, axis=0), axis=1)
        if usual_s <= self.maximum_gap_s:
            return 0.0, turns, (0.0, 0.0)
        part = (interval_s[:-1] / (interval_s[:-1] + interval_s[1:]))[:, None]
        line = (1.0 - part) * self._position[:-2] + part * self._position[2:]
        # take half the distance, because a line between the neighbours of a fix spans two intervals
        away_m = 0.5 * np.linalg.norm(line - self._position[1:-1], axis=1)
        if np.quantile(step_m, 0.9) > _SPARSE_APART_M:
            at_ends = np.append(np.inf, away_m), np.append(away_m, np.inf)
            # use the nearer end, because a leg next to a turn is straight at its other end
            nearer_m = np.minimum(*at_ends)
            turns, away_m = nearer_m > _SPARSE_ERROR_M, nearer_m[nearer_m <= _SPARSE_ERROR_M]
            if not len(away_m):
                return 0.0, ~turns, (0.0, 0.0)
            # report the limit as the second error, because intervals that were selected by their nearer end look too
            # straight
            return usual_s, turns, (float(np.median(away_m)), _SPARSE_ERROR_M)
        return usual_s, turns, (float(np.median(away_m)), float(np.quantile(away_m, 0.9)))

    def _raised(self, position: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return heights of positions (n, 3), raised to just above the ground, and whether they were below it."""
        return raised(position[:, 2], self._ground(position[:, 0], position[:, 1]), self.ground_m)

    def _codes(self, t: FloatArray) -> AnyArray:
        """Return the index into :data:`REASONS` for every time."""
        code = np.zeros(len(t), dtype=np.int64)
        if not len(self):
            code[:] = REASONS.index("no telemetry")
            return code
        code[_in_gap(t, self._time_s, self._gap)] = REASONS.index("telemetry gap")
        code[t < self._time_s[0] - _SAME_S] = REASONS.index("before telemetry")
        code[t > self._time_s[-1] + _SAME_S] = REASONS.index("after telemetry")
        return code

    def _rotations(self, t: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the rotation at every time (n, 3, 3), and whether it comes from a logged attitude."""
        at = self._time_s[self._known]
        near = np.zeros(len(t), dtype=bool)
        if len(at):
            # logged attitudes may end before the positions, and have other gaps
            near = (t >= at[0]) & (t <= at[-1]) & ~_in_gap(t, at, np.diff(at) > self.maximum_gap_s)
        if near.all() and len(t):
            return _slerp(t, at, self._attitude[self._known]), near
        course = rotation_from_aircraft(0.0 * t, 0.0 * t, self._course_at(t))
        if near.any():
            course[near] = _slerp(t[near], at, self._attitude[self._known])
        return course, near

    def _course_at(self, t: FloatArray) -> FloatArray:
        """Return the course over ground [deg], interpolated as a direction."""
        # interpolate sine and cosine, because the mean of 350 and 10 degrees is north, not 180 degrees
        angle = np.radians(self._course_deg)
        return bearing_deg(interpolated(t, self._time_s, np.column_stack([np.sin(angle), np.cos(angle)])))


def interpolated(t: FloatArray, at: FloatArray, values: FloatArray) -> FloatArray:
    """Return columns (rows, m) at ascending times ``at`` (rows,), interpolated linearly to times t (n,)."""
    return np.column_stack([np.interp(t, at, values[:, i]) for i in range(values.shape[1])])


def _in_gap(t: FloatArray, at: FloatArray, gap: BoolArray) -> BoolArray:
    """Check whether times are strictly inside a gap. ``gap`` (rows - 1,) marks the intervals that are gaps."""
    later = np.clip(np.searchsorted(at, t, side="left"), 0, len(at) - 1)
    earlier = np.maximum(later - 1, 0)
    # the pose at a row is known, even if a gap follows
    exact = np.minimum(np.abs(at[later] - t), np.abs(at[earlier] - t)) <= _SAME_S
    return np.asarray(np.append(gap, False)[earlier] & (later > earlier) & ~exact)


def _slerp(t: FloatArray, at: FloatArray, attitude_deg: FloatArray) -> FloatArray:
    """Interpolate roll, pitch and yaw (rows, 3), known at times ``at``, as rotations (n, 3, 3) at times t."""
    from scipy.spatial.transform import Rotation, Slerp

    # use only the rows next to each time, because the times may be few in a long flight
    before = np.searchsorted(at, t, side="right") - 1
    rows = np.unique(np.clip([before, before + 1], 0, len(at) - 1))
    at, attitude_deg = at[rows], attitude_deg[rows]
    matrices = rotation_from_aircraft(attitude_deg[:, 0], attitude_deg[:, 1], attitude_deg[:, 2])
    if len(at) == 1:
        return np.broadcast_to(matrices, (len(t), 3, 3))
    return np.asarray(Slerp(at, Rotation.from_matrix(matrices))(t).as_matrix())


def _velocities(t: FloatArray, position: FloatArray, logged: FloatArray) -> FloatArray:
    """Return logged velocities (east, north, up). Missing velocities are replaced by differences of positions over 4 s.

    Differences over shorter times are mainly noise of the positions, so that a hovering UAV would seem to move.
    """
    if len(t) < 2:
        return np.where(np.isfinite(logged), logged, 0.0)
    derived = _differences_mps(t, position, _COURSE_SPAN_S)
    missing = np.asarray(~np.isfinite(logged).all(axis=1))
    if not np.any(logged[~missing]):  # converters write (0, 0, 0) for "unknown"
        missing[:] = True
    return np.where(missing[:, None], derived, logged)


def velocities_mps(time_s: FloatArray, position_m: FloatArray, span_s: float = 1.0, gap_s: float = 3.0) -> FloatArray:
    """Return the velocity (n, 3) from central differences of interpolated positions over twice ``span_s``.

    Parameters
    ----------
    time_s : (n,)
        Ascending times [s].
    position_m : (n, 3)
    span_s : float
        Time before and after [s]. At the ends and next to gaps, only one side is used.
    gap_s : float
        Largest time step that is bridged [s].

    Returns
    -------
    (n, 3)
        Velocity [m/s]; NaN for a time without a neighbour.
    """
    velocity = np.full(position_m.shape, np.nan)
    for part in np.split(np.arange(len(time_s)), np.flatnonzero(~(np.diff(time_s) <= gap_s)) + 1):
        if len(part) >= 2 and (np.diff(time_s[part]) > 0.0).all():
            velocity[part] = _differences_mps(time_s[part], position_m[part], span_s)
    return velocity


def _differences_mps(t: FloatArray, position_m: FloatArray, span_s: float) -> FloatArray:
    """Return the velocity (n, 3) from positions ``span_s`` before and after each time, or in the neighbouring rows."""
    early, late = np.maximum(t - span_s, t[0]), np.minimum(t + span_s, t[-1])
    # use at least one row on each side, because sparse telemetry has no row within the span
    early, late = np.minimum(early, np.append(t[0], t[:-1])), np.maximum(late, np.append(t[1:], t[-1]))
    moved = interpolated(late, t, position_m) - interpolated(early, t, position_m)
    return np.asarray(moved / (late - early)[:, None])


def _courses(velocity: FloatArray) -> FloatArray:
    """Return the course over ground [deg clockwise from north]. At rest, keep the course before, or else the first."""
    course = bearing_deg(velocity)
    moving = np.flatnonzero(np.hypot(velocity[:, 0], velocity[:, 1]) >= _COURSE_SPEED_MPS)
    if not len(moving):
        return np.zeros(len(velocity))
    last = np.searchsorted(moving, np.arange(len(velocity)), side="right") - 1
    return np.asarray(course[moving[np.maximum(last, 0)]])
