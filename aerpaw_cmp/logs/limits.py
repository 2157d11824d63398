"""The possible range of each quantity of the record model. For all readers, rows outside the range are flagged.

A value outside its range becomes NaN. For a position, an attitude or a velocity, all three components become NaN. The
row gets a flag, and a warning states the number of these rows and the first row. Rows with a flag of
:data:`UNSCORED` stay in the records and are not compared.

The ranges follow from physics and from the performance of small aircraft. The ranges are wide, because they should find
impossible values (a corrupted digit, an overflow, a sentinel) and not unusual values.

Speeds reveal wrong clocks and positions: no small aircraft flies faster than 100 m/s, or gains 10 m/s in a second.

If a few positions cannot be reached in time from the rows around them, the receiver jumped. These positions are flagged
and read as missing. A distant position at which a log begins or ends at rest, such as the origin of an autopilot's
filter, is treated in the same way. Positions that do not change although a speed is logged are stale. Stale positions
are also flagged and read as missing. If a track is too fast throughout, its times are in another unit. If a track is at
two positions at the same time, it belongs to two vehicles. Both cases are reported, and the values are not changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from ..common.geodesy import rough_m
from ..common.text import counted
from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from . import dictionary
from .records import ReadResult, Stream
from .text import UNTERMINATED, add_flag

FASTEST_MPS = 100.0
FLAG, STALE = "position_jump", "position_stale"
PLACE = ("latitude_deg", "longitude_deg", "altitude_m")

# A distance above this between two rows at nearly the same time is not receiver jitter [m].
_JITTER_M = 15.0

# Largest share of rows that are jumps. If the share is larger, the rows are several tracks, or their times are wrong.
_FEW_JUMPS_SHARE = 0.2

# Largest acceleration of an aircraft [m/s^2].
_GAIN_MPS2 = 10.0

# Number of moves on either side of a step from which the speed is estimated.
_AROUND = 3

# Positions are stale if they stay the same for longer than the first number [s] although the mean speed is above the
# second number [m/s]. A receiver reports once a second.
_STALE_S, _STALE_MPS = 3.0, 1.0

# A step back in time is shorter than this share of the neighbouring steps.
_STEP_BACK_SHARE = 0.2

# Mistakes in the unit of times, and the factor by which the track is slower in the right unit.
_OTHER_UNITS = {
    "minutes, read as seconds": 60.0,
    "seconds, read as milliseconds": 1e3,
    "hours, read as seconds": 3600.0,
}


def jumps_of(frame: pd.DataFrame, what: str = "") -> tuple[BoolArray, str]:
    """Return the rows (n,) of a stream whose position is a jump, and a sentence about them or about the track.

    Parameters
    ----------
    frame : DataFrame
        Records of the stream.
    what : str
        Kind and name of the stream, for the sentence.
    """
    none = np.zeros(len(frame), dtype=np.bool_)
    if not {*PLACE[:2]} <= set(frame.columns) or len((path := path_of(frame))[0]) < 3:
        return none, ""
    rows, time_s, place_m = path
    speed_mps = typical_speed_mps(time_s, place_m)
    if speed_mps > FASTEST_MPS and not _comes_back(time_s, place_m):
        slower = {unit: speed_mps / factor for unit, factor in _OTHER_UNITS.items()}
        units = "; ".join(f"{unit}: {mps:.1f} m/s" for unit, mps in slower.items() if 0.5 < mps <= FASTEST_MPS)
        return none, (
            f"{what}: its positions imply {speed_mps:.0f} m/s throughout: are its times in another unit"
            f"{units and f' ({units})'}? If so, write it into the name of their column, such as 'time [min]'"
        )
    astray, at_rest, fast_mps, at = _off_track(time_s, place_m)
    if not astray.any() and speed_mps <= FASTEST_MPS:
        return none, ""
    if speed_mps > FASTEST_MPS or float((astray & ~at_rest).mean()) > _FEW_JUMPS_SHARE:
        return none, (
            f"{what}: its positions jump between places that cannot be reached in time: two vehicles, or two "
            "receivers, in one table?"
        )
    out = none.copy()
    out[rows[astray]] = True
    line = int(frame["line"].iloc[rows[at]])
    return out, (
        f"{what}: {counted(int(out.sum()), 'row is', 'rows are')} flagged {FLAG}; the first: {fast_mps:.0f} m/s to the "
        f"position in line {line}; read as missing"
    )


def path_of(frame: pd.DataFrame) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the rows with time and position, their times [s], and east, north, up [m] from the first position."""
    time = frame["time"].to_numpy("datetime64[ns]")
    latitude, longitude = (frame[name].to_numpy(np.float64) for name in PLACE[:2])
    known = np.isfinite(latitude) & np.isfinite(longitude) & ~np.isnat(time) & ((latitude != 0) | (longitude != 0))
    rows = np.flatnonzero(known)
    if not len(rows):
        return rows, np.zeros(0), np.zeros((0, 3))
    up = frame[PLACE[2]].to_numpy(np.float64)[rows] if PLACE[2] in frame else np.zeros(len(rows))
    known_up = np.flatnonzero(up > -900.0)  # loggers write -999 without a fix
    up = np.interp(np.arange(len(up)), known_up, up[known_up]) if len(known_up) else np.zeros(len(up))
    flat = rough_m(latitude[rows], longitude[rows], (float(np.median(latitude[rows])), longitude[rows[0]]))
    return rows, (time[rows] - time[rows[0]]) / np.timedelta64(1, "s"), np.column_stack([flat, up])


def typical_speed_mps(time_s: FloatArray, place_m: FloatArray) -> float:
    """Return the median speed of the moving part, over steps that are longer than a burst of rows."""
    # take steps of a fiftieth of the track, because a logger may write the rows of a second in one burst
    apart = max(1, len(time_s) // 50)
    step_m = np.linalg.norm(place_m[apart:] - place_m[:-apart], axis=1)
    step_s = np.abs(time_s[apart:] - time_s[:-apart])
    # a hover does not show the unit of times
    moving = (step_s > 0) & (step_m > 1.0)
    return float(np.median(step_m[moving] / step_s[moving])) if moving.sum() >= 3 else 0.0


def _out_of_reach(time_s: FloatArray, place_m: FloatArray) -> Callable[[IntArray, IntArray], BoolArray]:
    """Return a function ``(first, second) -> mask`` of pairs of rows between which no aircraft can fly in the time.

    Two speeds are the limits: that of the fastest aircraft, and that of this aircraft around these rows plus the
    increase that its thrust allows.

    Parameters
    ----------
    time_s : (n,)
    place_m : (n, 3)
    """
    usual_mps, interval_s = np.full(len(time_s), FASTEST_MPS), 0.0
    step_m = np.linalg.norm(np.diff(place_m[:, :2], axis=0), axis=1)
    moves = np.flatnonzero(step_m > 0)
    if len(moves) >= 2 * _AROUND:
        # a receiver may report more rarely than the logger writes
        interval_s = float(np.median(np.abs(np.diff(time_s[moves]))))
        step_s = np.maximum(np.abs(np.diff(time_s)), interval_s)[moves]
        speed = np.pad(step_m[moves] / np.maximum(step_s, 1e-9), _AROUND, mode="reflect")
        around = np.lib.stride_tricks.sliding_window_view(speed, 2 * _AROUND + 1)
        usual = np.median(np.delete(around, _AROUND, axis=1), axis=1)
        usual_mps = usual[np.searchsorted(moves, np.arange(len(time_s))).clip(0, len(moves) - 1)]

    def beyond(first: IntArray, second: IntArray) -> BoolArray:
        # ignore the sign of the time, because a clock that steps back is not a jump of the position
        seconds, apart_m = np.abs(time_s[second] - time_s[first]), place_m[second] - place_m[first]
        usual_s = np.maximum(seconds, interval_s)
        flown_m = (usual_mps[np.minimum(first, second)] + _GAIN_MPS2 * usual_s) * usual_s
        too_far = np.linalg.norm(apart_m, axis=1) > FASTEST_MPS * seconds + _JITTER_M
        return np.asarray(too_far | (np.linalg.norm(apart_m[:, :2], axis=1) > flown_m + _JITTER_M))

    return beyond


def _runs(time_s: FloatArray, place_m: FloatArray) -> tuple[IntArray, IntArray]:
    """Divide a track at its fast steps. Return the first row of each run, and the row after its last row."""
    rows = np.arange(len(time_s))
    begins = np.concatenate([[0], np.flatnonzero(_out_of_reach(time_s, place_m)(rows[:-1], rows[1:])) + 1])
    return begins, np.append(begins[1:], len(time_s))


def stale_of(frame: pd.DataFrame, what: str) -> tuple[BoolArray, str]:
    """Return the rows (n,) whose position does not change although the aircraft moves, and a sentence about them.

    The logged speed shows that the aircraft moves. Without a speed, the position must catch up in one step that is too
    fast for the track, but not for the time since the position changed last.

    Parameters
    ----------
    frame : DataFrame
        Records of the stream.
    what : str
        Kind and name of the stream, for the sentence.
    """
    none = np.zeros(len(frame), dtype=np.bool_)
    if not {*PLACE[:2]} <= set(frame.columns) or len((path := path_of(frame))[0]) < 3:
        return none, ""
    rows, time_s, place_m = path
    logged = [np.nan_to_num(frame[name].to_numpy(np.float64)[rows]) for name in _SPEEDS if name in frame.columns]
    steps_m = np.hypot(*logged)[1:] * np.abs(np.diff(time_s)) if len(logged) == 2 else np.zeros(len(rows) - 1)
    travel_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    begins = np.concatenate([[0], np.flatnonzero((np.diff(place_m[:, :2], axis=0) != 0).any(axis=1)) + 1])
    last = np.append(begins[1:], len(rows)) - 1
    lasts_s, moved_m = np.abs(time_s[last] - time_s[begins]), travel_m[last] - travel_m[begins]
    if not (lasts_s > _STALE_S).any():
        return none, ""
    if not steps_m.any():
        leaps = np.isin(begins, _runs(time_s, place_m)[0])[1:]
        step_m = np.linalg.norm(np.diff(place_m[begins, :2], axis=0), axis=1) * leaps
        moved_m = np.append(np.where(step_m < FASTEST_MPS * lasts_s[:-1], step_m, 0.0), 0.0)
    runs = (lasts_s > _STALE_S) & (moved_m > _JITTER_M) & (moved_m > _STALE_MPS * lasts_s)
    if not runs.any():
        return none, ""
    for first, end in zip(begins[runs], last[runs], strict=True):
        none[rows[first + 1 : end + 1]] = True  # the position in the first row is right
    longest = int(np.argmax(np.where(runs, lasts_s, 0.0)))
    line, speed_mps = int(frame["line"].iloc[rows[begins[longest]]]), moved_m[longest] / lasts_s[longest]
    return none, (
        f"{what}: {counted(int(none.sum()), 'row is', 'rows are')} flagged {STALE}: positions "
        f"do not change for {lasts_s[longest]:.0f} s from line {line} on, at a speed of {speed_mps:.1f} m/s; "
        "read as missing"
    )


# A change of height was not flown if it exceeds the first number [m] and a climb at the second number [m/s].
_HEIGHT_M, _CLIMB_MPS = 5.0, 10.0
_SPEEDS = ("velocity_north_mps", "velocity_east_mps")


def _comes_back(time_s: FloatArray, place_m: FloatArray) -> bool:
    """Check whether fast steps return to an earlier position, which shows that the rows mix several vehicles."""
    begins, ends = _runs(time_s, place_m)
    apart_m = [
        float(np.median(np.linalg.norm(place_m[begins[lag:]] - place_m[ends[:-lag] - 1], axis=1)))
        for lag in (1, 2, 3) if len(begins) > lag + 1
    ]  # fmt: skip
    return len(apart_m) > 1 and min(apart_m[1:]) < _STEP_BACK_SHARE * apart_m[0]


def _off_track(time_s: FloatArray, place_m: FloatArray) -> tuple[BoolArray, BoolArray, float, int]:
    """Return masks (n,) of rows off the track and of rows at rest at an end, and speed and row of the first jump.

    Rows between two fast steps form a run. The longest run that moves is the track. A run that the track cannot reach
    in time is off the track if it is short, or if it does not move and the log begins or ends with it. Any other run
    continues the track elsewhere, for example after a time without fixes.
    """
    count = len(time_s)
    astray, at_rest = np.zeros((2, count), dtype=np.bool_)
    begins, ends = _runs(time_s, place_m)
    if len(begins) == 1:
        return astray, at_rest, 0.0, 0
    extent_m = np.array([np.ptp(place_m[a:b], axis=0).max() for a, b in zip(begins, ends, strict=True)])
    still = extent_m < _JITTER_M
    # the longest run that moves is the track: jumps are short, but the log may be at rest for longer than the flight
    main = int(np.argmax((ends - begins) * (~still | still.all())))
    few, beyond = max(3.0, 0.05 * count), _out_of_reach(time_s, place_m)

    def walk(runs: range, near: IntArray, far: IntArray) -> None:
        last = far[main]
        for run in runs:
            short, end = ends[run] - begins[run] <= few, still[run] and run in (0, len(begins) - 1)
            if (short or end) and beyond(np.array([last]), near[run : run + 1])[0]:
                astray[begins[run] : ends[run]] = True
                at_rest[begins[run] : ends[run]] = not short
            else:
                last = far[run]

    walk(range(main + 1, len(begins)), begins, ends - 1)
    walk(range(main - 1, -1, -1), ends - 1, begins)
    at = int(np.argmax(astray))
    step_m = np.linalg.norm(np.diff(place_m, axis=0), axis=1)
    step_s = np.maximum(np.abs(np.diff(time_s)), 1e-3)
    run = int(np.searchsorted(begins, at, side="right")) - 1
    around = [max(begins[run] - 1, 0), min(ends[run], count - 1) - 1]  # the steps into and out of the first jump
    return astray, at_rest, float((step_m / step_s)[around].max()), at


# The flag of rows beyond a limit, and the smallest and largest possible value of each column [unit of its name]. The
# columns of a flag become NaN together. Levels (by unit) and times have their own rules below.
LIMITS: dict[str, dict[str, tuple[float, float]]] = {
    flag: {name: (float(low), float(high)) for name, (low, high) in ranges.items()}
    for flag, ranges in dictionary.LIMITS.items()
}

# Possible levels by unit. Thermal noise in 1 Hz is -174 dBm, and no receiver in flight receives 30 dBm. The range of a
# ratio to the noise is wider.
LEVEL_DB = {"dBm": (-200.0, 30.0), "dB": (-200.0, 200.0)}

# Possible levels re full scale minus the gain. Real sounder logs reach 33 dB.
_LEVEL_OTHER_DB = (-200.0, 100.0)

# If a few rows are more than a day from all other rows, their time stamps are damaged, because no log pauses for a day.
_APART_S = 86_400.0

_FEW_SHARE = 0.01

# A computer whose clock has no battery starts in 1970, 1980 or 2000, until GNSS or the network sets the clock. AERPAW
# began to operate later.
_CLOCK_SET_NS = int(np.datetime64("2010-01-01", "ns").astype(np.int64))

# "A few" rows are at most this number, or at most a small share of the rows.
_FEW_ROWS = 3

# Flags of rows that no comparison scores (``flight/rows.py``). For other flags, the doubtful value is set to NaN.
UNSCORED = ("level_out_of_range", "level_lost", "time_out_of_range", "rank_above_ports", "no_number",
            "unterminated_line", "marked_invalid")  # fmt: skip


def check(result: ReadResult) -> ReadResult:
    """Return a read result with its impossible values flagged, or the same object if all values are possible.

    Parameters
    ----------
    result : ReadResult

    Returns
    -------
    ReadResult
        Streams with flags and NaN, and one more warning per stream and flag.
    """
    checks = [_Check(stream) for stream in result.streams]
    warnings = [text for check in checks for text in check.run()]
    streams = tuple(replace(check.stream, frame=check.frame) for check in checks)
    return replace(result, streams=streams, warnings=(*result.warnings, *warnings)) if warnings else result


# AERPAW's sites, Lake Wheeler and Centennial Campus: latitude, longitude, and the radius of a site, all in degrees.
SITES_DEG, NEAR_DEG = ((35.727, -78.696), (35.773, -78.677)), 0.3
# Report a flight whose median height is this far below the take-off point [m]: few take-offs are on such a hill.
_BELOW_M = 15.0
# Highest possible level in flight, by quantity. Reports of RSRP end at -31 dBm (3GPP TS 38.133, 10.1.6). Reports of
# RSRQ and SINR have higher values.
_MOST_DBM = {"RSRP": -20.0}
# A value is a placeholder for a lost level if it is within the first limit of 0 dB, is one of the values below, or
# repeats the lowest or highest level, and if it is farther than the second limit from all other levels. The third
# number is the largest share of placeholders. No path gains 20 dB from one level to the next and loses them again.
_LOST_DB, _FAR_DB, _LOST_SHARE, _CUT_DB = 1.0, 20.0, 0.4, 15.0
# Lowest values of phones, modems and 8-bit integers, which programs write for a missing level.
_LEAST_DB = (-127.0, -128.0, -140.0, -141.0, -150.0, -156.0, -157.0)
# Levels of two devices alternate from record to record: they differ by more than fading, and return to the same value
# with the next record.
_APART_DB, _BACK_SHARE, _FEW_ALTERNATE, _MOST_TURNS = 10.0, 0.2, 6, 5
# Levels at one time stamp come from several sources if they differ by more than fading within one second.
_AT_ONCE_DB = 6.0


class _Check:
    """A stream, its records with their flags, and the sentences about them."""

    def __init__(self, stream: Stream) -> None:
        self.stream, self.frame, self._said = stream, stream.frame, list[str]()
        self._about, self._what = stream.attributes, f"{stream.kind} {stream.name!r}"

    def run(self) -> list[str]:
        """Run all checks and return their sentences."""
        kind, limits = self.stream.kind, LIMITS
        if kind == "rss":
            if self._about.get("unit") == "dBm":
                self._no_index()
            bounds = LEVEL_DB.get(str(self._about.get("unit")), _LEVEL_OTHER_DB)
            limits = {**LIMITS, "level_out_of_range": {"rss_db": bounds}}
        for flag, ranges in limits.items():
            self._within(flag, ranges)
        if kind == "rank":
            self._within_ports()
        if kind == "telemetry":
            self._mostly_above_zero()
            self._lost_heights()
        self._near_in_time()
        if kind == "rss":
            self._all_silent()
            self._lost_readings()
            self._two_levels()
        self._check_exchanged_angles()
        for flag, check_of in ((STALE, stale_of), (FLAG, jumps_of)):
            bad, sentence = check_of(self.frame, self._what)
            if bad.any():
                self.frame = _marked(self.frame, bad, flag, [name for name in PLACE if name in self.frame.columns])
            self._said += [sentence] if sentence else []
        return self._said

    def _values(self, name: str) -> FloatArray:
        return self.frame[name].to_numpy(dtype=np.float64)

    def _flag(self, bad: BoolArray, flag: str, first: str, why: str, void: Sequence[str] = ()) -> None:
        """Flag rows, set some of their columns to NaN, and add a sentence with number, first row and reason."""
        rows = counted(int(bad.sum()), "row is", "rows are")
        line = int(self.frame["line"].iloc[int(np.argmax(bad))])
        end = "not scored" if flag in UNSCORED else "read as missing"
        self._said.append(f"{self._what}: {rows} flagged {flag}; the first: {first} in line {line}, {why}; {end}")
        self.frame = _marked(self.frame, bad, flag, void)

    def _within(self, flag: str, ranges: Mapping[str, tuple[float, float]]) -> None:
        names = [name for name in ranges if name in self.frame.columns]
        beyond: dict[str, BoolArray] = {}
        for name in names:
            value, (low, high) = self._values(name), ranges[name]
            # test the smallest and largest value first: masks of all columns of a large log would take longer than
            # reading the log
            least = np.fmin.reduce(value) if len(value) else np.nan
            if not np.isnan(least) and not (low <= least and np.fmax.reduce(value) <= high):
                beyond[name] = (value < low) | (value > high)
        if not beyond:
            return
        name = min(beyond, key=lambda name: int(np.argmax(beyond[name])))
        bad, (low, high) = np.any([*beyond.values()], axis=0), ranges[name]
        first, hint = f"{name} {self._values(name)[int(np.argmax(bad))]:.6g}", ""
        if "latitude_deg" in names:
            latitude, longitude = (np.abs(self._values(name)[bad]) for name in PLACE[:2])
            if ((latitude > 90.0) & (latitude <= 180.0) & (longitude <= 90.0)).all():
                hint = "; are latitude and longitude swapped?"
        self._flag(bad, flag, first, f"where {low:g} .. {high:g} can be{hint}", names)

    def _check_exchanged_angles(self) -> None:
        """Report positions that would be at a site of AERPAW if angles were swapped or had another sign or unit."""
        if not {*PLACE[:2]} <= set(self.frame.columns):
            return
        # use the median, which is not affected by jumps of the receiver
        place = self.frame[[*PLACE[:2]]].median().to_numpy(dtype=np.float64)
        for how, other in (
            ("latitude and longitude swapped", place[::-1]),
            ("western longitudes written without their sign", place * [1, -1]),
            ("they radians", np.degrees(place)),
            ("they 1e-6 deg, read as 1e-7 deg", place * 10),
        ):
            if (np.abs(np.array(SITES_DEG) - other) < NEAR_DEG).all(axis=1).any():
                self._said.append(
                    f"{self._what}: the positions lie at latitude {place[0]:.3f}, longitude {place[1]:.3f}; "
                    f"read differently, they lie at a site of AERPAW: are {how}?"
                )

    def _within_ports(self) -> None:
        """Flag ranks above the number of ports in the log, or above the four ports whose ranks are compared."""
        ports, rank = self._about.get("ports"), self._values("rank")
        whose = "the log has"
        if not isinstance(ports, (int, float)) or isinstance(ports, bool):
            ports, whose = 4, "ranks are compared for"
        if (bad := rank > float(ports)).any():
            why = f"but {whose} at most {ports:g} ports (a wrong base of the indicator, or another cell?)"
            self._flag(bad, "rank_above_ports", f"rank {rank[int(np.argmax(bad))]:g}", why, ["rank"])

    def _no_index(self) -> None:
        """Flag levels that are mostly too high: an index of the standard (0 .. 127), another unit, or a ratio."""
        level, quantity = self._values("rss_db"), str(self._about.get("quantity"))
        bad = level >= _MOST_DBM.get(quantity, 0.0)
        if 2 * bad.sum() <= np.isfinite(level).sum() or not bad.any():
            return
        known = "another unit, an RSRQ, or an index?" if quantity in _MOST_DBM else "another unit, or an index?"
        first = f"{level[int(np.argmax(bad))]:g} dBm"
        self._flag(bad, "level_out_of_range", first, f"which no receiver measures ({known})", ["rss_db"])

    def _mostly_above_zero(self) -> None:
        """Report heights that are mostly below the take-off, such as heights that count downwards."""
        height = self._values("altitude_m")
        if np.isfinite(height).any() and (middle := float(np.nanmedian(height))) < -_BELOW_M:
            self._said.append(
                f"{self._what}: half of its heights are more than {-middle:.0f} m below the take-off: do they count "
                "downwards, or from another datum?"
            )

    def _all_silent(self) -> None:
        """Report a series without any level: with a wrong unit, all levels may be below the floor of the reader."""
        heard = np.isfinite(self._values("rss_db")).any()
        silent = 0 if heard else int(self.frame["flag"].str.contains("out_of_coverage").sum())
        if silent and silent == len(self.frame):
            levels = "the only level is" if silent == 1 else f"all {silent} levels are"
            self._said.append(f"{self._what}: {levels} below the floor of the reader (no signal, or another unit?)")

    def _lost_readings(self) -> None:
        """Flag a few placeholders far from all other levels, which programs write for lost levels."""
        level = self._values("rss_db")
        # -92 at the end of a file may have become -9, -127 may have become -12
        most = np.where(self.frame["flag"].to_numpy() == UNTERMINATED, _CUT_DB, _LOST_DB)
        # -1 is also a common placeholder
        for of_program, sign, word in ((np.abs(level) <= most, 1, "above"), (np.isin(level, _LEAST_DB), -1, "below")):
            known, end = np.isfinite(level).sum(), level == sign * np.fmax.reduce(sign * level, initial=-np.inf)
            lost = of_program if of_program.any() or end.sum() < _FEW_ROWS else end
            if not lost.any() or lost.sum() > max(1, _LOST_SHARE * known) or known < _FEW_ROWS:
                continue
            nearest = sign * float(np.nanmax(sign * level[~lost]))
            varies = of_program.any() or len(np.unique(level[~lost])) > _FEW_ROWS
            if varies and np.min(sign * (level[lost] - nearest)) > _FAR_DB:
                first = f"{level[int(np.argmax(lost))]:g} dB"
                why = f"far {word} all others, which end at {nearest:.1f} dB (a lost reading?)"
                self._flag(lost, "level_lost", first, why, ["rss_db"])
                level = self._values("rss_db")

    def _two_levels(self) -> None:
        """Report a series whose levels take turns or differ at one time: it has several devices, SIMs or networks."""
        # test only the beginning, because two devices alternate in the complete log
        level, time = self._values("rss_db")[:10_000], self.frame["time"].to_numpy("datetime64[ns]")[:10_000]
        level, time = level[np.isfinite(level)], time[np.isfinite(level)]
        if len(level) < _FEW_ALTERNATE:
            return
        lags = [lag for lag in range(1, _MOST_TURNS + 1) if len(level) >= 3 * lag]
        steps = (float(np.median(np.abs(level[lag:] - level[:-lag]))) for lag in lags)
        # two devices: the level returns within the next records, more exactly than after fading
        turns = (step := next(steps)) > _APART_DB and min(steps) < _BACK_SHARE * step
        apart_db, when = (step, "from record to record") if turns else (_at_once_db(level, time), "at the same time")
        if not (turns or apart_db >= _AT_ONCE_DB):
            return
        self._said.append(
            f"{self._what}: its levels alternate, {apart_db:.0f} dB apart {when}: several devices, SIMs or networks in "
            "one series, without a known column that names them"
        )

    def _lost_heights(self) -> None:
        """Flag heights that leap to one value and back, such as 0 in flight."""
        height, time = self.frame[PLACE[2]].dropna(), self.frame["time"].to_numpy("datetime64[ns]")
        begins = np.concatenate([[0], np.flatnonzero(np.diff(height)) + 1])
        if len(begins) < 2 * _AROUND:
            return
        step_s = np.abs(np.diff(time[height.index]) / np.timedelta64(1, "s"))[begins[1:] - 1]
        # a receiver may report more rarely than the logger writes
        step_s = np.maximum(step_s, np.median(step_s * np.diff(begins)))
        rise_m, rows = np.diff(height.to_numpy()[begins]), np.diff(begins)[1:]
        leaps = np.abs(rise_m) / (_HEIGHT_M + _CLIMB_MPS * step_s)
        # require a larger leap of a single row than of a value that is repeated
        back = (np.minimum(leaps[:-1], leaps[1:]) > np.where(rows > 1, 1, _AROUND)) & (rise_m[:-1] * rise_m[1:] < 0)
        lost = np.zeros(len(time), dtype=np.bool_)
        lost[height.index] = np.repeat([False, *back, False], np.diff(begins, append=len(height)))
        if 0 < lost.mean() <= _FEW_JUMPS_SHARE:
            first = f"{height[int(np.argmax(lost))]:g} m"
            self._flag(lost, "height_lost", first, "a jump and return faster than any climb", [PLACE[2]])

    def _near_in_time(self) -> None:
        """Flag a few time stamps that are more than a day from all other time stamps."""
        # subtract as floats, because int64 would overflow for NaT and for stamps 300 years apart
        time = self.frame["time"].to_numpy("datetime64[ns]")
        stamp: IntArray = time.view(np.int64)
        timed = ~np.isnat(time)
        if timed.sum() < 2 or float(stamp[timed].max()) - float(stamp[timed].min()) <= _APART_S * 1e9:
            return
        # sort NaT last, although it is the smallest integer
        order = np.argsort(np.where(timed, stamp, np.iinfo(np.int64).max), kind="stable")[: int(timed.sum())]
        group = np.concatenate(([0], np.cumsum(np.diff(stamp[order].astype(np.float64)) > _APART_S * 1e9)))
        size = np.bincount(group)
        few = size <= max(_FEW_ROWS, _FEW_SHARE * len(order))
        # the largest group is the log
        few[int(np.argmax(size))] = False
        # if no group is dominant, the file contains two flights, not a few bad time stamps
        few &= 2 * size.max() > len(order)
        last = stamp[order][np.append(np.flatnonzero(np.diff(group)), len(order) - 1)]
        unset = last < _CLOCK_SET_NS  # flag any number of rows that were written before the clock was set
        few |= unset & ~unset.all()
        bad = np.zeros(len(stamp), dtype=np.bool_)
        bad[order[few[group]]] = True
        if bad.any():
            row = int(np.argmax(bad))
            why = "written before the clock was set" if stamp[row] < _CLOCK_SET_NS else "days from all other records"
            self._flag(bad, "time_out_of_range", np.datetime_as_string(time[row], unit="s"), why)


def _at_once_db(level: FloatArray, time: AnyArray) -> float:
    """Return the median difference (max - min) of levels (n,) at one time (n,) [dB]. NaN if most times occur once."""
    order = np.argsort(time, kind="stable")[: np.count_nonzero(~np.isnat(time))]  # NaT is last
    begins = np.flatnonzero(np.append(True, np.diff(time[order]).astype(np.int64)))[: len(order)]
    repeated, levels = np.diff(begins, append=len(order)) > 1, level[order]
    if 2 * repeated.sum() < max(len(begins), 1):
        return np.nan
    return float(np.median((np.maximum.reduceat(levels, begins) - np.minimum.reduceat(levels, begins))[repeated]))


def _marked(frame: pd.DataFrame, bad: BoolArray, flag: str, void: Sequence[str]) -> pd.DataFrame:
    column: AnyArray = frame["flag"].to_numpy(dtype=object).copy()
    add_flag(column, bad, flag)
    out: pd.DataFrame = frame.copy(deep=False)  # copy the columns that get flags
    out["flag"] = pd.Series(column, index=frame.index, dtype=object)
    for name in void:
        out[name] = np.where(bad, np.nan, frame[name].to_numpy(dtype=np.float64))
    return out
