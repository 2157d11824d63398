"""Where the UAV was and how it was turned at any instant, and whether two clocks agree.

Attitude is interpolated as rotation (slerp), never as angles. Telemetry gaps longer than a stated limit are not
bridged; poses in them are invalid, with a reason. What a log does not say (attitude) is replaced by level flight
along the course and flagged. Nothing is dropped silently: :class:`TrackAccount` counts every row left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.geodesy import SiteFrame
from ..common.units import MINIMUM_HEIGHT_M, AnyArray, BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd

MAXIMUM_GAP_S = 3.0
"""Telemetry gaps longer than this are not bridged [s]; vehicleOut rows come every 1.0 s."""

COURSE_SPEED_MPS = 1.0
"""Below this ground speed the course says nothing about the heading [m/s]."""

REASONS = ("", "before telemetry", "after telemetry", "telemetry gap", "no telemetry", "no time")
"""Why a pose is not valid; index 0 is a valid pose."""


@dataclass(frozen=True, slots=True)
class TrackAccount:
    """What became of the telemetry rows.

    Parameters
    ----------
    rows : int
        Rows of the telemetry frame.
    no_time, duplicate_time, backward_time, bad_position : int
        Rows not used for position: no time stamp; the stamp of the row before; a stamp earlier than one before it
        (or, where fewer rows are lost that way, later than one after it); NaN, -999 or impossible coordinates.
    unknown_attitude : int
        Used rows without attitude (NaN, or exactly 0, 0, 0: written by converters for "unknown").
    gaps : int
        Intervals between used rows that are longer than the limit.
    longest_gap_s : float
        The longest interval [s].
    hour_steps : int
        Steps of whole hours between neighbouring rows of the file: a clock that changed to or from daylight saving.
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

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know, one sentence each."""
        told = (
            (self.hour_steps, "step(s) of whole hours between telemetry rows: daylight-saving change or a reset clock"),
            (self.backward_time, "telemetry row(s) out of time order were left out"),
            (self.duplicate_time, "telemetry row(s) repeat the time stamp before them and were left out"),
            (self.no_time, "telemetry row(s) without a time stamp were left out"),
            (self.bad_position, "telemetry row(s) without a position (NaN, -999) were left out"),
            (self.gaps, f"telemetry gap(s), the longest {self.longest_gap_s:.1f} s, were not bridged"),
            (self.unknown_attitude, "telemetry row(s) without attitude: level flight along the course stands in"),
        )
        return tuple(f"{count} {text}" for count, text in told if count)


@dataclass(frozen=True, slots=True)
class TrackPoses:
    """Poses at asked instants.

    Parameters
    ----------
    position_m : (n, 3)
        East, north, up in the site frame [m]; NaN where not valid.
    rotation : (n, 3, 3)
        Aircraft body (forward-left-up) to east-north-up; NaN where not valid.
    valid : (n,) bool
        False before, after and inside gaps of the telemetry.
    reason : (n,) str
        Empty where valid, else one of :data:`REASONS`.
    attitude_known : (n,) bool
        False where level flight along the course stands in for the attitude.
    raised : (n,) bool
        The height was below the minimum and was raised to it.
    velocity_mps : (n, 3)
        East, north, up [m/s]; NaN where not valid.
    """

    position_m: FloatArray
    rotation: FloatArray
    valid: BoolArray
    reason: AnyArray
    attitude_known: BoolArray
    raised: BoolArray
    velocity_mps: FloatArray

    def __len__(self) -> int:
        return len(self.valid)

    @property
    def heading_deg(self) -> FloatArray:
        """Heading of the nose, clockwise from north, [0, 360) deg."""
        return np.asarray(np.degrees(np.arctan2(self.rotation[:, 0, 0], self.rotation[:, 1, 0])) % 360.0)


def _nanoseconds(times: ArrayLike | pd.Series) -> AnyArray:
    """UTC instants as int64 ns since 1970; NaT becomes the smallest integer. Floats are epoch seconds."""
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


_NAT = np.iinfo(np.int64).min

_SAME_S = 1e-6
"""Instants nearer than this are one: epoch seconds as floats carry 0.2 microseconds [s]."""


def _forward_rows(stamp: AnyArray) -> tuple[BoolArray, int, int]:
    """Rows of a strictly increasing clock, and how many are duplicates and backward.

    A stamp is backward when an earlier row is later. One wild stamp in the future would then condemn all rows
    after it, so the mirrored rule (a stamp later than a later row's is wrong) is used where it loses fewer rows.
    """
    if not len(stamp):
        return np.zeros(0, dtype=bool), 0, 0
    before = np.concatenate([[_NAT], np.maximum.accumulate(stamp)[:-1]])
    after = np.concatenate([np.minimum.accumulate(stamp[::-1])[::-1][1:], [np.iinfo(np.int64).max]])
    onward, mirrored = stamp >= before, stamp <= after
    ordered = onward if onward.sum() >= mirrored.sum() else mirrored
    keep = ordered.copy()
    kept = np.flatnonzero(ordered)
    repeated = np.concatenate([[False], np.diff(stamp[kept]) == 0])
    keep[kept[repeated]] = False
    return keep, int(repeated.sum()), int((~ordered).sum())


def _hour_steps(stamp: AnyArray) -> int:
    """Steps between rows that are whole hours, forward or back, give or take five seconds."""
    step = np.diff(stamp) * 1e-9
    hours = np.round(step / 3600.0)
    return int(((hours != 0) & (np.abs(hours) <= 2) & (np.abs(step - 3600.0 * hours) < 5.0)).sum())


def _good_positions(latitude: FloatArray, longitude: FloatArray, altitude: FloatArray) -> BoolArray:
    """Coordinates that can be: finite, in range, not (0, 0) and not the -999 that loggers write without a fix."""
    finite = np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(altitude)
    with np.errstate(invalid="ignore"):
        possible = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 180.0) & (altitude > -900.0)
    return np.asarray(finite & possible & ~((latitude == 0.0) & (longitude == 0.0)))


def body_rotation(roll_deg: ArrayLike, pitch_deg: ArrayLike, yaw_deg: ArrayLike) -> FloatArray:
    """Rotations from the aircraft body (forward-left-up) to east-north-up.

    Parameters
    ----------
    roll_deg, pitch_deg, yaw_deg : array_like, (n,)
        Right wing down +, nose up +, heading clockwise from north.

    Returns
    -------
    ndarray, (n, 3, 3)
    """
    from scipy.spatial.transform import Rotation

    angles = np.stack(
        [
            90.0 - np.asarray(yaw_deg, dtype=np.float64),  # counter-clockwise from east
            -np.asarray(pitch_deg, dtype=np.float64),  # turning about "left": nose up is negative
            np.asarray(roll_deg, dtype=np.float64),
        ],
        axis=-1,
    )
    return np.asarray(Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())


class Track:
    """The flight path of one telemetry stream in a site frame.

    Parameters
    ----------
    telemetry : pandas.DataFrame
        Records of kind telemetry (see :mod:`aerpaw_cmp.logs.records`), file order.
    frame : SiteFrame
        The site's frame.
    maximum_gap_s : float
        Longer gaps are not bridged [s].
    minimum_height_m : float
        Lower poses are raised to this height above the take-off ground [m].
    ground_m : float
        Height of the take-off point above the site origin [m], added to ``altitude_m``.
    method : {"linear", "pchip"}
        Interpolation of positions.

    Attributes
    ----------
    account : TrackAccount
        What became of the rows.
    start_ns, end_ns : int
        First and last used instant [ns since 1970, UTC]; both 0 without a row.
    """

    def __init__(
        self,
        telemetry: pd.DataFrame,
        frame: SiteFrame,
        *,
        maximum_gap_s: float = MAXIMUM_GAP_S,
        minimum_height_m: float = MINIMUM_HEIGHT_M,
        ground_m: float = 0.0,
        method: Literal["linear", "pchip"] = "linear",
    ) -> None:
        if not maximum_gap_s > 0:
            raise ValueError(f"maximum_gap_s must be positive, found {maximum_gap_s}")
        self.frame = frame
        self.maximum_gap_s = maximum_gap_s
        self.minimum_height_m = minimum_height_m
        self.ground_m = ground_m
        self.method = method
        self._load(telemetry)

    def _load(self, telemetry: pd.DataFrame) -> None:
        def column(name: str) -> FloatArray:
            return telemetry[name].to_numpy(dtype=np.float64)

        stamp = _nanoseconds(telemetry["time"])
        latitude, longitude, altitude = column("latitude_deg"), column("longitude_deg"), column("altitude_m")
        timed = stamp != _NAT
        placed = timed & _good_positions(latitude, longitude, altitude)
        rows = np.flatnonzero(placed)
        forward, duplicates, backward = _forward_rows(stamp[rows])
        rows = rows[forward]

        self.start_ns = int(stamp[rows[0]]) if len(rows) else 0
        self.end_ns = int(stamp[rows[-1]]) if len(rows) else 0
        self._time_s = (stamp[rows] - self.start_ns) * 1e-9
        east, north = self.frame.to_local(latitude[rows], longitude[rows])
        self._position = np.column_stack([east, north, altitude[rows] + self.ground_m])
        velocity = [column("velocity_east_mps"), column("velocity_north_mps"), -column("velocity_down_mps")]
        self._velocity = _velocities(self._time_s, self._position, np.column_stack(velocity)[rows])
        self._course_deg = _courses(self._velocity)
        self._attitude = np.column_stack([column("roll_deg"), column("pitch_deg"), column("yaw_deg")])[rows]
        known = np.isfinite(self._attitude).all(axis=1) & np.any(self._attitude != 0.0, axis=1)
        self._known = known
        interval = np.diff(self._time_s)
        self.account = TrackAccount(
            rows=len(stamp),
            no_time=int((~timed).sum()),
            duplicate_time=duplicates,
            backward_time=backward,
            bad_position=int((timed & ~placed).sum()),
            unknown_attitude=int((~known).sum()),
            gaps=int((interval > self.maximum_gap_s).sum()),
            longest_gap_s=float(interval.max()) if len(interval) else 0.0,
            hour_steps=_hour_steps(stamp[timed]),
        )

    def __len__(self) -> int:
        return len(self._time_s)

    def pose_at(self, times: ArrayLike | pd.Series) -> TrackPoses:
        """Poses at instants.

        Parameters
        ----------
        times : array_like, (n,)
            datetime64 (UTC) or epoch seconds; any order.

        Returns
        -------
        TrackPoses
        """
        instant = _nanoseconds(times).ravel()
        timed = instant != _NAT
        t = np.where(timed, instant - self.start_ns, 0) * 1e-9
        code = self._codes(t)
        code[~timed] = REASONS.index("no time")
        valid = code == 0
        n = len(t)
        if len(self):
            t = np.clip(t, self._time_s[0], self._time_s[-1])
        position = np.full((n, 3), np.nan)
        rotation = np.full((n, 3, 3), np.nan)
        velocity = np.full((n, 3), np.nan)
        known, raised = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        if valid.any():
            position[valid] = self._positions(t[valid])
            velocity[valid] = _interpolate(t[valid], self._time_s, self._velocity)
            rotation[valid], known[valid] = self._rotations(t[valid])
            floor = self.ground_m + self.minimum_height_m
            raised[valid] = position[valid, 2] < floor
            position[raised, 2] = floor
        reason = np.asarray(REASONS)[code]
        return TrackPoses(position, rotation, valid, reason, known, raised, velocity)

    def _codes(self, t: FloatArray) -> AnyArray:
        """Index into :data:`REASONS` for every instant."""
        code = np.zeros(len(t), dtype=np.int64)
        if not len(self):
            code[:] = REASONS.index("no telemetry")
            return code
        code[_in_gap(t, self._time_s, self.maximum_gap_s)] = REASONS.index("telemetry gap")
        code[t < self._time_s[0] - _SAME_S] = REASONS.index("before telemetry")
        code[t > self._time_s[-1] + _SAME_S] = REASONS.index("after telemetry")
        return code

    def _positions(self, t: FloatArray) -> FloatArray:
        if self.method == "pchip" and len(self) > 1:
            from scipy.interpolate import PchipInterpolator

            return np.asarray(PchipInterpolator(self._time_s, self._position, axis=0)(t))
        return _interpolate(t, self._time_s, self._position)

    def _rotations(self, t: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Rotation at every instant (n, 3, 3) and whether it comes from logged attitude."""
        course = body_rotation(0.0 * t, 0.0 * t, self._course_at(t))
        at = self._time_s[self._known]
        if not len(at):
            return course, np.zeros(len(t), dtype=bool)
        near = (t >= at[0]) & (t <= at[-1]) & ~_in_gap(t, at, self.maximum_gap_s)
        if near.any():
            course[near] = _slerp(t[near], at, self._attitude[self._known])
        return course, near

    def _course_at(self, t: FloatArray) -> FloatArray:
        """Course over ground [deg], interpolated as a direction."""
        angle = np.radians(self._course_deg)
        mixed = _interpolate(t, self._time_s, np.column_stack([np.sin(angle), np.cos(angle)]))
        return np.asarray(np.degrees(np.arctan2(mixed[:, 0], mixed[:, 1])))


def _interpolate(t: FloatArray, at: FloatArray, values: FloatArray) -> FloatArray:
    """Linear interpolation of columns (rows, m) at t (n,)."""
    return np.column_stack([np.interp(t, at, values[:, i]) for i in range(values.shape[1])])


def _in_gap(t: FloatArray, at: FloatArray, limit_s: float) -> BoolArray:
    """Whether an instant lies strictly inside an interval longer than the limit."""
    right = np.clip(np.searchsorted(at, t, side="left"), 0, len(at) - 1)
    left = np.maximum(right - 1, 0)
    exact = np.minimum(np.abs(at[right] - t), np.abs(at[left] - t)) <= _SAME_S
    return np.asarray((at[right] - at[left] > limit_s) & ~exact)


def _slerp(t: FloatArray, at: FloatArray, attitude_deg: FloatArray) -> FloatArray:
    """Rotations at t (n, 3, 3) from roll, pitch, yaw (rows, 3) at ``at``."""
    from scipy.spatial.transform import Rotation, Slerp

    matrices = body_rotation(attitude_deg[:, 0], attitude_deg[:, 1], attitude_deg[:, 2])
    if len(at) == 1:
        return np.broadcast_to(matrices, (len(t), 3, 3))
    return np.asarray(Slerp(at, Rotation.from_matrix(matrices))(t).as_matrix())


def _velocities(t: FloatArray, position: FloatArray, logged: FloatArray) -> FloatArray:
    """Logged velocities (east, north, up); where missing or never moving, differences of position."""
    if len(t) < 2:
        return np.where(np.isfinite(logged), logged, 0.0)
    derived = np.gradient(position, t, axis=0)
    missing = np.asarray(~np.isfinite(logged).all(axis=1))
    if not np.any(logged[~missing]):  # converters write (0, 0, 0) for "unknown"
        missing[:] = True
    return np.where(missing[:, None], derived, logged)


def _courses(velocity: FloatArray) -> FloatArray:
    """Course over ground [deg clockwise from north]; at rest the last one holds (before the first: the first)."""
    course = np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1]))
    moving = np.flatnonzero(np.hypot(velocity[:, 0], velocity[:, 1]) >= COURSE_SPEED_MPS)
    if not len(moving):
        return np.zeros(len(velocity))
    last = np.searchsorted(moving, np.arange(len(velocity)), side="right") - 1
    return np.asarray(course[moving[np.maximum(last, 0)]])


# --- do the clocks agree? ------------------------------------------------------------------------------------------

LAG_WINDOW_S = 12.0
"""Lags searched on either side of zero [s]."""

LAG_LIMIT_S = 1.0
"""An interval wider than this on either side is no answer, and another optimum farther than this is a rival [s]."""

DRIFT_LIMIT = 10e-3 / 60.0
"""Drifts searched on either side of zero [s/s]: 10 ms per minute."""

_RIVAL = 10.83
"""Log-likelihood ratio (chi-squared, one degree) at 0.001 that a rival lag must lose by."""

_SCANNED = 6000
"""The search runs on at most this many samples; the refinement on all."""

_INDEPENDENT = 0.7
"""Share of the evidence of several channels that counts: one airframe and one path make their residuals alike."""

_NEAR_EDGE = 0.86
"""A best lag beyond this share of the window may be the slope of a valley outside it."""

_FEWEST = 30
"""Fewer samples tell nothing about a lag."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LagFit:
    """Offset and drift between the radio and the telemetry clock.

    Parameters
    ----------
    radio_minus_telemetry_s : float
        The lag [s] at ``reference``: positive where the radio's clock shows later times, to be **subtracted from radio
        times**; NaN if failed.
    interval_s : (low, high)
        95 % interval of ``radio_minus_telemetry_s``; the whole window where the data say nothing.
    drift_s_per_s : float
        Growth of the lag; 0 where it was not fitted.
    drift_interval_s_per_s : (low, high)
        95 % interval of the drift; NaN where it was not fitted.
    verdict : {"ok", "ambiguous", "failed"}
        Only "ok" should be applied, and only when the user asks for it.
    reason : str
        Why not ok.
    reference : float
        Instant at which the lag is ``radio_minus_telemetry_s``: seconds after the first radio sample.
    n : int
        Samples used.
    rmse_db, rmse_unshifted_db : float
        Residual with the lag and without, each after its best offset, on the samples used [dB].
    window_s : float
        Lags searched on either side [s].
    curve_lag_s, curve_rmse_db : (m,)
        Residual against lag (without drift), of the same sign.
    evidence : (m,)
        Log-likelihood ratio by which every lag of the curve is worse than the best one.
    """

    radio_minus_telemetry_s: float
    interval_s: tuple[float, float]
    drift_s_per_s: float
    drift_interval_s_per_s: tuple[float, float]
    verdict: Literal["ok", "ambiguous", "failed"]
    reason: str
    reference: float
    n: int
    rmse_db: float
    rmse_unshifted_db: float
    window_s: float
    curve_lag_s: FloatArray = field(repr=False)
    curve_rmse_db: FloatArray = field(repr=False)
    evidence: FloatArray = field(repr=False)

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json; NaN becomes None, the curve is left out."""
        names = {
            "radio_minus_telemetry_s": self.radio_minus_telemetry_s,
            "ci95_s": list(self.interval_s),
            "drift_ms_per_min": self.drift_s_per_s * 60e3,
            "drift_ci95_ms_per_min": [60e3 * v for v in self.drift_interval_s_per_s],
            "verdict": self.verdict,
            "reason": self.reason,
            "window_s": self.window_s,
            "n": self.n,
            "rmse_db": self.rmse_db,
            "rmse_unshifted_db": self.rmse_unshifted_db,
        }

        def known(value: Any) -> Any:
            if isinstance(value, list):
                return [known(item) for item in value]
            return None if isinstance(value, float) and not np.isfinite(value) else value

        return {name: known(value) for name, value in names.items()}

    def at(self, times: AnyArray) -> FloatArray:
        """Radio minus telemetry clock (n,) [s] at radio times (n,), datetime64 or seconds, in any order."""
        array = np.asarray(times)
        if not len(array):
            return np.zeros(0)
        since = array - array.min()
        elapsed = since / np.timedelta64(1, "s") if array.dtype.kind == "M" else since
        return np.asarray(self.radio_minus_telemetry_s + self.drift_s_per_s * (elapsed - self.reference))

    def apply(self, times: AnyArray) -> AnyArray:
        """Radio times (n,), datetime64 or seconds, on the telemetry clock."""
        array, lag = np.asarray(times), self.at(times)
        if array.dtype.kind == "M":
            return np.asarray(array - np.round(lag * 1e9).astype("timedelta64[ns]"))
        return np.asarray(array - lag)


class _Prediction:
    """A predicted level over the flight, sampled once and shifted as often as needed."""

    def __init__(self, first: float, step: float, columns: FloatArray) -> None:
        self.first, self.step, self.level = first, step, columns[:, 0]
        self.slope = np.gradient(self.level, step)
        self.terms = columns[:, 1:]
        self.term_slopes = np.gradient(self.terms, step, axis=0) if self.terms.shape[1] else self.terms

    def terms_at(self, t: FloatArray, values: FloatArray | None = None) -> FloatArray:
        """The free terms at t, a constant first (n, 1 + terms); NaN as for :meth:`at`."""
        source = self.terms if values is None else values
        place = (t - self.first) / self.step
        left = np.floor(place).astype(np.int64)
        inside = (left >= 0) & (left < len(source) - 1)
        left = np.where(inside, left, 0)
        result = np.empty((len(t), 1 + source.shape[1]))
        result[:, 0] = 1.0 if values is None else 0.0
        if source.shape[1]:
            weight = (place - left)[:, None]
            result[:, 1:] = source[left] * (1.0 - weight) + source[left + 1] * weight
            result[~inside, 1:] = np.nan
        return result

    def at(self, t: FloatArray, values: FloatArray | None = None) -> FloatArray:
        """Linear interpolation at t; NaN outside and next to NaN."""
        source = self.level if values is None else values
        place = (t - self.first) / self.step
        left = np.floor(place).astype(np.int64)
        inside = (left >= 0) & (left < len(source) - 1)
        left = np.where(inside, left, 0)
        weight = place - left
        level = source[left] * (1.0 - weight) + source[left + 1] * weight
        return np.where(inside, level, np.nan)

    def smooth_at(self, t: FloatArray) -> FloatArray:
        """Cubic (Catmull-Rom) interpolation at t: linear pieces would bias a lag where fades are steep."""
        place = (t - self.first) / self.step
        left = np.floor(place).astype(np.int64)
        inside = (left >= 0) & (left < len(self.level) - 1)
        left = np.where(inside, left, 0)
        u = place - left
        a, b = self.level[left], self.level[left + 1]
        da, db = self.slope[left] * self.step, self.slope[left + 1] * self.step
        level = a + u * (da + u * (3.0 * (b - a) - 2.0 * da - db + u * (2.0 * (a - b) + da + db)))
        return np.where(inside, level, np.nan)

    def common(self, t: FloatArray, reach: float) -> BoolArray:
        """Instants whose prediction exists for every shift up to ``reach``."""
        bad = np.concatenate([[0], np.cumsum(~np.isfinite(self.level))])
        low = np.floor((t - reach - self.first) / self.step).astype(np.int64)
        high = np.ceil((t + reach - self.first) / self.step).astype(np.int64) + 1
        inside = (low >= 0) & (high <= len(self.level))
        low, high = np.clip(low, 0, len(self.level)), np.clip(high, 0, len(self.level))
        return np.asarray(inside & (bad[high] == bad[low]))


def estimate_lag(
    times: ArrayLike | pd.Series,
    measured_db: ArrayLike,
    predictor: Callable[[AnyArray], ArrayLike],
    *,
    window_s: float = LAG_WINDOW_S,
    resolution_s: float = 0.05,
    limit_s: float = LAG_LIMIT_S,
    drift: bool | None = None,
) -> LagFit:
    """Clock offset and drift between a radio log and the telemetry, from the data.

    Parameters
    ----------
    times : array_like, (n,)
        Instants of the radio samples, datetime64 (UTC) or seconds.
    measured_db : array_like, (n,)
        Levels [dB]; NaN does not count.
    predictor : callable
        ``predictor(times) -> level_db``: what should be measured at instants of the **telemetry** clock (free space,
        two-ray or a replay), in the kind of ``times``; NaN where there is no pose or no path. Called once. It may
        give columns (n, 1 + terms): the level, and terms whose coefficients are fitted anew at every lag, such as
        :func:`direction_terms` for antenna patterns that are not known.
    window_s : float
        Lags from ``-window_s`` to ``window_s`` are searched [s].
    resolution_s : float
        Spacing at which the predictor is sampled [s]; lags are resolved finer than that.
    limit_s : float
        Half width of the interval, and distance of a rival optimum, beyond which the verdict is "ambiguous" [s].
    drift : bool, optional
        Fit a drift too; by default for flights of ten minutes and more.

    Returns
    -------
    LagFit
        Nothing is applied here.

    Notes
    -----
    The residual's offset is free at every lag. A search over lags (and drifts) finds the valley, Gauss-Newton the
    bottom. Neighbouring residuals resemble each other (patterns, obstacles), so both run on residuals whitened by
    their AR(1) coefficient (Cochrane and Orcutt 1949, doi:10.1080/01621459.1949.10483290), and the standard error is a
    block sandwich. A lag is "ok" only if every lag farther than ``limit_s`` away is worse by a likelihood ratio of
    0.1 % significance.
    """
    stamp, levels = _nanoseconds(times).ravel(), np.asarray(measured_db, dtype=np.float64).ravel()
    if stamp.shape != levels.shape:
        raise ValueError(f"{len(stamp)} times and {len(levels)} levels")
    used = (stamp != _NAT) & np.isfinite(levels)
    origin = int(stamp[stamp != _NAT][0]) if np.any(stamp != _NAT) else 0
    order = np.argsort(stamp[used], kind="stable")
    t, m = ((stamp[used] - origin) * 1e-9)[order], levels[used][order]
    lags = _symmetric(window_s, max(0.1, resolution_s))
    if len(t) < _FEWEST:
        return _no_lag("too few samples", len(t), window_s, lags)
    reach = window_s + 2.0 + DRIFT_LIMIT * (t[-1] - t[0])
    grid = np.arange(t[0] - reach, t[-1] + reach + resolution_s, resolution_s)
    as_time = np.asarray(times).dtype.kind != "f" and np.asarray(times).dtype.kind not in "iu"
    nanoseconds = np.round(grid * 1e9).astype(np.int64) + origin
    asked = nanoseconds.astype("datetime64[ns]") if as_time else nanoseconds * 1e-9
    columns = np.asarray(predictor(asked), dtype=np.float64)
    columns = columns[:, None] if columns.ndim == 1 else columns
    if len(columns) != len(grid):
        raise ValueError(f"the predictor gave {len(columns)} levels for {len(grid)} instants")
    columns = np.where(np.isfinite(columns).all(axis=1, keepdims=True), columns, np.nan)
    prediction = _Prediction(float(grid[0]), resolution_s, columns)
    keep = prediction.common(t, window_s + resolution_s)
    if keep.sum() < max(_FEWEST, 0.3 * len(t)):  # a short or gappy flight: let the samples vary with the lag
        keep = np.isfinite(prediction.at(t))
    if keep.sum() < _FEWEST:
        return _no_lag("no prediction at the radio samples: the two logs do not overlap", 0, window_s, lags)
    t, m = t[keep], m[keep]
    drifting = (t[-1] - t[0]) >= 600.0 if drift is None else drift
    return _fit_lag(t, m, prediction, lags, limit_s, drifting)


def _symmetric(window: float, step: float) -> FloatArray:
    count = int(np.floor(window / step + 1e-9))
    return np.asarray(np.arange(-count, count + 1) * step, dtype=np.float64)


def _no_lag(reason: str, n: int, window_s: float, lags: FloatArray) -> LagFit:
    nan = float("nan")
    return LagFit(
        radio_minus_telemetry_s=nan,
        interval_s=(-window_s, window_s),
        drift_s_per_s=0.0,
        drift_interval_s_per_s=(nan, nan),
        verdict="failed",
        reason=reason,
        reference=0.0,
        n=n,
        rmse_db=nan,
        rmse_unshifted_db=nan,
        window_s=window_s,
        curve_lag_s=lags,
        curve_rmse_db=np.full(len(lags), nan),
        evidence=np.zeros(len(lags)),
    )


def _whitened(residual: FloatArray, phi: float) -> FloatArray:
    """Residual without its mean and without what the sample before tells; NaN (no prediction) left out."""
    r = residual[np.isfinite(residual)]
    r = r - r.mean() if len(r) else r
    return r[1:] - phi * r[:-1]


def _cost(residual: FloatArray, phi: float, least: int) -> float:
    """Mean square of the whitened residual about its mean; infinite where too few samples have a prediction."""
    w = _whitened(residual, phi)
    return float(w.var()) if len(w) >= least else float("inf")


def _phi(residual: FloatArray) -> float:
    r = residual[np.isfinite(residual)]
    r = r - r.mean()
    power = float(r @ r)
    return float(np.clip(r[1:] @ r[:-1] / power, 0.0, 0.99)) if power > 0 else 0.0


def _explained(y: FloatArray, terms: FloatArray, phi: float) -> FloatArray:
    """What free terms (n, q) explain of y (n,), by least squares on values whitened with ``phi``."""
    ok = np.isfinite(y) & np.isfinite(terms).all(axis=1)
    a, b = terms[ok], y[ok]
    a, b = a[1:] - phi * a[:-1], b[1:] - phi * b[:-1]
    return np.asarray(np.einsum("ni,i->n", terms, _on_terms(a, b[None])[0]))


def _on_terms(terms: FloatArray, rows: FloatArray) -> FloatArray:
    """Least-squares coefficients (k, q) of each row (k, n) on terms (n, q).

    Normal equations, as the few terms are of order one, with a floor under the rank. By einsum: for products this
    small, BLAS wakes threads and waits for them, which on a busy machine took hundred times longer.
    """
    normal, right = np.einsum("ni,nj->ij", terms, terms), np.einsum("ni,kn->ik", terms, rows)
    return np.asarray(np.linalg.lstsq(normal, right, rcond=1e-12)[0].T)


def direction_terms(azimuth_deg: ArrayLike, elevation_deg: ArrayLike, relative_deg: ArrayLike) -> FloatArray:
    """Smooth terms that stand in for unknown antenna patterns when a lag is estimated.

    Parameters
    ----------
    azimuth_deg, elevation_deg : array_like, (n,)
        Direction of the UAV from the tower (clockwise from north; above the horizon).
    relative_deg : array_like, (n,)
        Direction of the tower relative to the UAV's nose; it turns when the UAV does, which is what ties a level to
        the telemetry clock.

    Returns
    -------
    ndarray, (n, 12)
        Two harmonics of either azimuth, elevation and its square, and the first harmonic of the relative direction
        times elevation.
    """
    azimuth, elevation, relative = (
        np.radians(np.asarray(a, dtype=np.float64)) for a in (azimuth_deg, elevation_deg, relative_deg)
    )
    waves = [f(k * angle) for angle in (azimuth, relative) for k in (1, 2) for f in (np.cos, np.sin)]
    tilted = [f(relative) * elevation for f in (np.cos, np.sin)]
    return np.column_stack([elevation, elevation**2, *waves, *tilted])


def _fit_lag(
    t: FloatArray, m: FloatArray, prediction: _Prediction, lags: FloatArray, limit_s: float, drifting: bool
) -> LagFit:
    """Search, refine, judge."""
    middle = 0.5 * float(t[0] + t[-1])
    few = slice(None, None, -(-len(t) // _SCANNED))
    ts, ms = t[few], m[few]
    least = max(_FEWEST, len(ts) // 2)

    def residual(lag: float, rate: float, phi: float = 0.0) -> FloatArray:
        at = ts - lag - rate * (ts - middle)
        y = ms - prediction.at(at)
        return y - _explained(y, prediction.terms_at(at), phi) if prediction.terms.shape[1] else y

    def scan(phi: float, rate: float) -> FloatArray:
        return np.array([_cost(residual(lag, rate, phi), phi, least) for lag in lags])

    plain = scan(0.0, 0.0)
    if not np.isfinite(plain).any():
        return _no_lag("no prediction at the radio samples: the two logs do not overlap", 0, float(lags[-1]), lags)
    phi = _phi(residual(lags[_best(plain, lags)], 0.0))
    # free terms bend towards a drift before a scan can tell; the refinement fits it from zero then
    scanned = drifting and not prediction.terms.shape[1]
    rates = _rates(float(t[-1] - t[0]), float(lags[1] - lags[0])) if scanned else np.zeros(1)
    table = np.stack([scan(phi, rate) for rate in rates])
    row, column = divmod(_best(table, np.broadcast_to(lags, table.shape)), len(lags))
    still = len(rates) // 2
    if len(ts) * np.log(table[still].min() / table[row, column]) <= _RIVAL:  # no drift where none shows
        row, column = still, _best(table[still], lags)
    near = _between(table[row], lags, lambda lag: _cost(residual(lag, float(rates[row]), phi), phi, least))
    start = np.array([near, rates[row]])[: 2 if drifting else 1]
    (lag, rate), (width, rate_width), rmse = _refine(t, m, prediction, middle, start)
    # last entry: a constant instead of the prediction
    cost = np.append(table.min(axis=0), _cost(np.where(np.isfinite(residual(lag, rate)), ms, np.nan), phi, least))
    ratio = _likelihood_ratios(cost, _whitened(residual(float(lags[column]), float(rates[row]), phi), phi))
    verdict, reason, interval = _judge(lag, width, ratio[:-1], lags, limit_s)
    if verdict == "ok" and ratio[-1] <= _RIVAL:
        verdict, reason = "ambiguous", "at its best lag the prediction explains no more than a constant"
    nan = float("nan")
    return LagFit(
        radio_minus_telemetry_s=lag,
        interval_s=interval,
        drift_s_per_s=rate,
        drift_interval_s_per_s=(rate - rate_width, rate + rate_width) if drifting else (nan, nan),
        verdict=verdict,
        reason=reason,
        reference=middle,
        n=len(t),
        rmse_db=rmse,
        rmse_unshifted_db=float(np.sqrt(plain[len(lags) // 2])),
        window_s=float(lags[-1]),
        curve_lag_s=lags,
        curve_rmse_db=np.sqrt(plain),
        evidence=ratio[:-1],
    )


def _between(cost: FloatArray, lags: FloatArray, cost_at: Callable[[float], float]) -> float:
    """Best lag on a ten times finer grid around the five best of the scan: interference makes valleys narrower."""
    step = float(lags[1] - lags[0])
    coarse = lags[np.argsort(np.where(np.isfinite(cost), cost, np.inf), kind="stable")[:5]]
    fine = (coarse[:, None] + np.arange(-6, 7) * (step / 10.0)).ravel()
    return float(fine[_best(np.array([cost_at(float(lag)) for lag in fine]), fine)])


def _rates(span_s: float, lag_step_s: float) -> FloatArray:
    """Drifts to try: from one to the next, the lag at the ends of the flight changes by about one lag step."""
    return _symmetric(DRIFT_LIMIT, min(DRIFT_LIMIT, 2.0 * lag_step_s / span_s))


def _best(cost: FloatArray, lags: FloatArray) -> int:
    """Flat index of the least cost; costs that are equal but for rounding go to the lag nearest zero."""
    flat = cost.ravel()
    near = np.flatnonzero(flat <= np.nanmin(flat) * (1.0 + 1e-12))
    return int(near[np.argmin(np.abs(np.asarray(lags).ravel()[near]))])


def _refine(
    t: FloatArray, m: FloatArray, prediction: _Prediction, middle: float, start: FloatArray
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Gauss-Newton from the scan's optimum: (lag, drift), half widths of their 95 % intervals, RMSE [dB].

    Variable projection: constant and free terms are solved for at every step, so only lag and drift iterate.
    """
    scale = np.array([1.0, max(1.0, 0.5 * float(t[-1] - t[0]))])[: len(start)]
    relative = np.stack([np.ones(len(t)), (t - middle) / scale[-1]])[: len(start)]

    def evaluate(shift: FloatArray, phi: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residual (n,); residual and Jacobian whitened, without what a constant and the free terms explain."""
        at = t - shift @ relative
        y, slope, terms = m - prediction.smooth_at(at), prediction.at(at, prediction.slope), prediction.terms_at(at)
        ok = np.isfinite(y) & np.isfinite(slope) & np.isfinite(terms).all(axis=1)
        y, slope, terms, along = y[ok], slope[ok], terms[ok], relative[:, ok]
        base, b = terms[1:] - phi * terms[:-1], y[1:] - phi * y[:-1]
        coefficients = _on_terms(base, b[None])[0]
        if terms.shape[1] > 1:  # the free terms move with the lag too
            moved = prediction.terms_at(at, prediction.term_slopes)[ok]
            slope = slope + np.einsum("ni,i->n", moved, coefficients)
        jacobian = slope * along  # of the residual: the lag is subtracted from the time
        columns = np.vstack([b, jacobian[:, 1:] - phi * jacobian[:, :-1]])
        columns = columns - np.einsum("ki,ni->kn", _on_terms(base, columns), base)
        return y - np.einsum("ni,i->n", terms, coefficients), columns[0], columns[1:]

    shift = start * scale
    phi = _phi(evaluate(shift, 0.0)[0])
    for _ in range(20):
        _, rw, jw = evaluate(shift, phi)
        step = -_on_terms(jw.T, rw[None])[0]
        size = float(np.abs(step).max())
        shift = shift + step * min(1.0, 0.3 / max(size, 1e-12))  # the valley is no wider than fractions of a second
        if size < 1e-5:
            break
    beyond = len(shift) > 1 and abs(shift[1] / scale[1]) > 1.2 * DRIFT_LIMIT
    if beyond or np.abs(shift - start * scale).max() > 0.5:  # no valley here: keep what the scan found
        shift = start * scale
    r, rw, jw = evaluate(shift, phi)
    width = _sandwich(rw, jw) / scale
    found = np.zeros(2)
    found[: len(start)] = shift / scale
    reach = np.full(2, np.nan)
    reach[: len(start)] = width
    return (float(found[0]), float(found[1])), (float(reach[0]), float(reach[1])), float(np.sqrt(np.mean(r**2)))


def _blocks(values: FloatArray) -> FloatArray:
    """Sums over blocks of 2 n^(1/3) neighbours along the last axis; the remainder is left out."""
    n = values.shape[-1]
    length = max(4, round(2.0 * n ** (1.0 / 3.0)))
    count = max(1, n // length)
    return np.asarray(values[..., : count * length].reshape(*values.shape[:-1], count, -1).sum(axis=-1))


def _sandwich(residual: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Half widths of 95 % intervals of least-squares parameters whose residuals remember each other."""
    from scipy.special import stdtrit

    normal = jacobian @ jacobian.T
    if np.linalg.matrix_rank(normal) < len(normal):
        return np.full(len(normal), np.inf)
    scores = _blocks(jacobian * residual)
    count = scores.shape[1]
    bread = np.linalg.inv(normal)
    covariance = bread @ (scores @ scores.T) @ bread * count / max(count - 1, 1)
    return np.asarray(stdtrit(max(count - 1, 1), 0.975) * np.sqrt(np.diag(covariance)))


def _likelihood_ratios(cost: FloatArray, whitened: FloatArray) -> FloatArray:
    """Log-likelihood ratio (times two) by which every lag, and last a constant, is worse than the best lag."""
    sums = _blocks(whitened - whitened.mean())
    long_run = float(np.mean(sums**2)) * len(sums) / len(whitened)
    # correlation that AR(1) left over takes evidence away; anticorrelation does not add any
    size = len(whitened) * min(1.0, float(whitened.var()) / long_run) if long_run > 0 else len(whitened)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = size * np.log(cost / np.min(cost[:-1]))
    return np.asarray(np.where(np.isfinite(cost), np.nan_to_num(ratio, nan=0.0, posinf=np.inf), np.inf))


def _judge(
    lag: float, width: float, ratio: FloatArray, lags: FloatArray, limit_s: float
) -> tuple[Literal["ok", "ambiguous", "failed"], str, tuple[float, float]]:
    """Verdict, reason and interval from the width of the valley and from its rivals."""
    possible = lags[ratio <= 3.84]
    low, high = min(lag - width, float(possible.min())), max(lag + width, float(possible.max()))
    interval = (max(low, float(lags[0])), min(high, float(lags[-1])))
    far = np.abs(lags - lag) > limit_s
    rivals = lags[far & (ratio <= _RIVAL)]
    if max(lag - low, high - lag) > limit_s or len(rivals):
        flat = np.median(ratio[np.isfinite(ratio)]) <= _RIVAL if np.isfinite(ratio).any() else True
        why = (
            "the level hardly depends on the lag (a flat flight, or a model that explains too little)"
            if flat
            else f"other lags explain the data as well, such as {rivals[0]:+.1f} s" if len(rivals)
            else "the interval is too wide"
        )  # fmt: skip
        return "ambiguous", why, interval
    if abs(lag) > _NEAR_EDGE * float(lags[-1]):
        return "failed", "the best lag lies near the edge of the window: widen it, or look at the clocks", interval
    return "ok", "", interval


def combine_lags(fits: Sequence[LagFit], *, limit_s: float = LAG_LIMIT_S) -> LagFit:
    """One lag for channels that share a clock, from the evidence of all of them.

    Parameters
    ----------
    fits : sequence of LagFit
        Of the same window, such as the channels of one receiver. Failed ones take no part.
    limit_s : float
        As in :func:`estimate_lag`.

    Returns
    -------
    LagFit
        Log-likelihood ratios add up; RMSE is pooled, the drift is that of the channel with the narrowest interval.

    Raises
    ------
    ValueError
        If there is no fit, or windows differ.
    """
    if not fits or any(len(fit.curve_lag_s) != len(fits[0].curve_lag_s) for fit in fits):
        raise ValueError("lags to combine must be at least one, and searched over the same window")
    heard = [fit for fit in fits if np.isfinite(fit.radio_minus_telemetry_s)]
    if len(heard) < 2:
        return heard[0] if heard else fits[0]
    lags = heard[0].curve_lag_s
    total = np.sum([np.minimum(fit.evidence, 1e6) for fit in heard], axis=0) * _INDEPENDENT
    total = total - total.min()
    sharp = min(heard, key=lambda fit: fit.interval_s[1] - fit.interval_s[0])
    best = float(lags[_best(np.where(total > 0, total, 0.0) + 1.0, lags)])
    near = abs(sharp.radio_minus_telemetry_s - best) <= lags[1] - lags[0]  # the sharpest fit is finer than the grid
    lag = sharp.radio_minus_telemetry_s if near else best
    width = 0.5 * float(lags[1] - lags[0])
    if near and sharp.verdict == "ok":
        width = 0.5 * (sharp.interval_s[1] - sharp.interval_s[0])
    verdict, reason, interval = _judge(lag, width, total, lags, limit_s)
    count = sum(fit.n for fit in heard)

    def pooled(name: str) -> float:
        return float(np.sqrt(sum(fit.n * getattr(fit, name) ** 2 for fit in heard) / count))

    curve = np.sqrt(np.sum([fit.n * fit.curve_rmse_db**2 for fit in heard], axis=0) / count)
    return LagFit(
        radio_minus_telemetry_s=lag,
        interval_s=interval,
        drift_s_per_s=sharp.drift_s_per_s,
        drift_interval_s_per_s=sharp.drift_interval_s_per_s,
        verdict=verdict,
        reason=reason,
        reference=sharp.reference,
        n=count,
        rmse_db=pooled("rmse_db"),
        rmse_unshifted_db=pooled("rmse_unshifted_db"),
        window_s=heard[0].window_s,
        curve_lag_s=lags,
        curve_rmse_db=curve,
        evidence=total,
    )


# --- whole hours ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ClockTrap:
    """Two logs of one flight that only overlap after a shift of whole (or half) hours.

    Parameters
    ----------
    hours : float
        To be added to radio times (whole hours of a time zone, no lag).
    overlap_s, shifted_overlap_s : float
        Overlap with the telemetry before and after the shift [s].
    explanation : str
        What this looks like.
    """

    hours: float
    overlap_s: float
    shifted_overlap_s: float
    explanation: str


def clock_trap(
    radio_span: tuple[Any, Any], telemetry_span: tuple[Any, Any], timezone: str | None = None
) -> ClockTrap | None:
    """Recognise a clock that is off by whole hours, such as local time stored as if it were UTC.

    Parameters
    ----------
    radio_span, telemetry_span : (first, last)
        datetime64 (UTC) or epoch seconds.
    timezone : str, optional
        IANA zone of the site: a shift that equals its offset from UTC on that day is named so.

    Returns
    -------
    ClockTrap or None
        None if the logs overlap as they are, or if no shift of up to 14 h (in half hours) brings them together.

    Examples
    --------
    >>> trap = clock_trap((0.0, 600.0), (4 * 3600.0, 4 * 3600.0 + 620.0), "America/New_York")
    >>> trap.hours
    4.0
    """
    radio = _nanoseconds(np.asarray(radio_span)) * 1e-9
    telemetry = _nanoseconds(np.asarray(telemetry_span)) * 1e-9

    def overlap(hours: FloatArray) -> FloatArray:
        start = np.maximum(radio[0] + 3600.0 * hours, telemetry[0])
        return np.asarray(np.maximum(0.0, np.minimum(radio[1] + 3600.0 * hours, telemetry[1]) - start))

    shifts = np.asarray(np.arange(-28, 29) * 0.5, dtype=np.float64)
    shared = overlap(shifts)
    now = float(overlap(np.zeros(1))[0])
    # whole hours before half hours, near ones before far ones
    order = [(-round(float(shared[i])), shifts[i] % 1 != 0, abs(float(shifts[i])), i) for i in range(len(shifts))]
    best = min(order)[-1]
    shorter = min(radio[1] - radio[0], telemetry[1] - telemetry[0])
    if now >= 0.5 * shorter or shared[best] < max(0.5 * shorter, 1e-9):
        return None
    hours = float(shifts[best])
    return ClockTrap(hours, now, float(shared[best]), _explain_hours(hours, float(telemetry[0]), timezone))


def _explain_hours(hours: float, instant: float, timezone: str | None) -> str:
    if timezone is not None:
        from datetime import datetime
        from datetime import timezone as utc
        from zoneinfo import ZoneInfo

        moment = datetime.fromtimestamp(instant, utc.utc).astimezone(ZoneInfo(timezone))
        offset = moment.utcoffset()
        east = offset.total_seconds() / 3600.0 if offset else 0.0
        if east and hours == -east:
            return f"radio times are local time ({timezone}) stored as if they were UTC"
        if east and hours == east:
            return f"telemetry times are local time ({timezone}) stored as if they were UTC"
        if abs(hours) == 1.0:
            return "one hour: daylight saving taken into account in one log only"
    return f"the clocks differ by {hours:+g} h: a time zone was taken into account in one log only"
