"""Possible range of each quantity of the record model: rows beyond it are flagged, whatever the reader.

One table for all formats. A value beyond its range becomes NaN (of a position, an attitude or a velocity all three
components do: they are one quantity), its row gets a flag, and a warning names how many there are and the first of
them. Rows with a flag of :data:`UNSCORED` are kept in the records and left out of every comparison.

The ranges are those of physics and of small aircraft, wide on purpose: they catch what cannot be (a corrupted digit, an
overflow, a sentinel), not what is unusual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from ..common.counting import counted
from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from .jumps import FLAG, PLACE, STALE, jumps_of, stale_of
from .records import COLUMNS, ReadResult, Stream


@dataclass(frozen=True, slots=True)
class Limit:
    """Possible values of one quantity.

    Parameters
    ----------
    columns : tuple of str
        Components that are void together.
    ranges : tuple of (low, high)
        One per column, both ends possible, in the unit of the column's name.
    flag : str
        What rows beyond it get.
    """

    columns: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]
    flag: str


# Quantities that mean the same in every stream. Levels (by unit) and times have their own rules below.
LIMITS: tuple[Limit, ...] = (
    Limit(PLACE, ((-90.0, 90.0), (-180.0, 180.0), (-1000.0, 20_000.0)), "position_out_of_range"),
    Limit(COLUMNS["telemetry"][3:6], ((-180.0, 180.0), (-180.0, 180.0), (-360.0, 360.0)), "attitude_out_of_range"),
    Limit(COLUMNS["telemetry"][6:9], ((-200.0, 200.0),) * 3, "velocity_out_of_range"),
    Limit(("rsrp_dbm",), ((-200.0, 50.0),), "rsrp_out_of_range"),
    Limit(("sinr_db",), ((-100.0, 100.0),), "sinr_out_of_range"),
)

# Levels by unit: thermal noise of 1 Hz is -174 dBm, no receiver in flight meets 30 dBm; a ratio to the noise is wider.
LEVEL_DB = {"dBm": (-200.0, 30.0), "dB": (-200.0, 200.0)}

# Levels re full scale, gain taken off: real sounder logs reach 33 dB.
_LEVEL_OTHER_DB = (-200.0, 100.0)

# A few rows further than a day from all others have a damaged stamp: no log is silent for a day and goes on.
_APART_S = 86_400.0

_FEW_SHARE = 0.01

# A computer without a battery of its clock begins in 1970 and is set by GNSS or network.
# Some begin in 1980 or 2000; AERPAW is younger than all of these.
_CLOCK_SET_NS = int(np.datetime64("2010-01-01", "ns").astype(np.int64))

# At most this share, or this many, are "a few".
_FEW_ROWS = 3

# Flags of rows that no comparison scores (`flight/scored.py`). The other flags void the doubtful value itself.
UNSCORED = ("level_out_of_range", "level_lost", "time_out_of_range", "rank_above_ports", "no_number",
            "unterminated_line", "marked_invalid")  # fmt: skip


def check(result: ReadResult) -> ReadResult:
    """A read result with its impossible values flagged; the same object where there are none.

    Parameters
    ----------
    result : ReadResult
        Of any reader.

    Returns
    -------
    ReadResult
        Streams with flags and NaN, and one more warning per stream and flag.
    """
    checks = [_Check(stream) for stream in result.streams]
    warnings = [text for check in checks for text in check.run()]
    streams = tuple(
        check.stream if check.frame is check.stream.frame else replace(check.stream, frame=check.frame)
        for check in checks
    )
    return replace(result, streams=streams, warnings=(*result.warnings, *warnings)) if warnings else result


# AERPAW's sites, Lake Wheeler and Centennial Campus: latitude, longitude, and how far from them positions are theirs.
SITES_DEG, NEAR_DEG = ((35.727, -78.696), (35.773, -78.677)), 0.3
# No receiver in flight meets such levels: reports of RSRP end at -31 dBm (3GPP TS 38.133, 10.1.6), those of RSRQ and
# SINR do not.
_MOST_DBM = {"RSRP": -20.0}
# A lost reading is this near 0 dB and this far above all others, and at most this share of the readings is lost: no
# path gains 20 dB from one reading to the next and loses it again.
_LOST_DB, _FAR_DB, _LOST_SHARE = 1.0, 20.0, 0.2
# Levels that alternate from record to record: further apart than fading, and back with the next.
_APART_DB, _BACK_SHARE, _FEW_ALTERNATE, _MOST_TURNS = 10.0, 0.2, 6, 5


class _Check:
    """A stream, its records as they are marked, and what is said of them."""

    def __init__(self, stream: Stream) -> None:
        self.stream, self.frame, self._said = stream, stream.frame, list[str]()
        self._about, self._what = stream.attributes, f"{stream.kind} {stream.name!r}"

    def run(self) -> list[str]:
        """Check everything; sentences."""
        kind, limits = self.stream.kind, LIMITS
        if kind == "rss":
            if self._about.get("unit") == "dBm":
                self._no_index()
            bounds = LEVEL_DB.get(str(self._about.get("unit")), _LEVEL_OTHER_DB)
            limits = (*LIMITS, Limit(("rss_db",), (bounds,), "level_out_of_range"))
        for limit in limits:
            self._within(limit)
        if kind == "rank":
            self._within_ports()
        self._near_in_time()
        if kind == "rss":
            self._lost_readings()
            self._two_levels()
        self._at_a_site_if_otherwise()
        for flag, check_of in ((STALE, stale_of), (FLAG, jumps_of)):
            bad, sentence = check_of(replace(self.stream, frame=self.frame))
            if bad.any():
                self.frame = _marked(self.frame, bad, flag, [name for name in PLACE if name in self.frame.columns])
            self._said += [sentence] if sentence else []
        return self._said

    def _values(self, name: str) -> FloatArray:
        return self.frame[name].to_numpy(dtype=np.float64)

    def _flag(self, bad: BoolArray, flag: str, first: str, why: str, void: Sequence[str] = ()) -> None:
        """Flag rows, void some of their columns, and say how many there are, what the first is, and why."""
        rows = counted(int(bad.sum()), "row is", "rows are")
        line = int(self.frame["line"].iloc[int(np.argmax(bad))])
        end = "not scored" if flag in UNSCORED else "read as missing"
        self._said.append(f"{self._what}: {rows} flagged {flag}; the first: {first} in line {line}, {why}; {end}")
        self.frame = _marked(self.frame, bad, flag, void)

    def _within(self, limit: Limit) -> None:
        names = [name for name in limit.columns if name in self.frame.columns]
        ranges = dict(zip(limit.columns, limit.ranges, strict=True))
        beyond: dict[str, BoolArray] = {}
        for name in names:
            value, (low, high) = self._values(name), ranges[name]
            # least and greatest first: a mask of every column of a large log would cost more than reading it
            least = np.fmin.reduce(value) if len(value) else np.nan
            if not np.isnan(least) and not (low <= least and np.fmax.reduce(value) <= high):
                beyond[name] = (value < low) | (value > high)
        if not beyond:
            return
        name = min(beyond, key=lambda name: int(np.argmax(beyond[name])))
        bad, (low, high) = np.any([*beyond.values()], axis=0), ranges[name]
        first = f"{name} {self._values(name)[int(np.argmax(bad))]:.6g}"
        swap = self._exchanged(bad) if "latitude_deg" in names else ""
        self._flag(bad, limit.flag, first, f"where {low:g} .. {high:g} can be{swap}", names)

    def _exchanged(self, bad: BoolArray) -> str:
        """A hint where every impossible position would be possible with its angles exchanged."""
        latitude, longitude = (np.abs(self._values(name)[bad]) for name in PLACE[:2])
        fits = (latitude > 90.0) & (latitude <= 180.0) & (longitude <= 90.0)
        return "; are latitude and longitude exchanged?" if fits.all() else ""

    def _at_a_site_if_otherwise(self) -> None:
        """Say where positions that can be would lie at a site of AERPAW, were they written otherwise."""
        if not {*PLACE[:2]} <= set(self.frame.columns):
            return
        # the median: one receiver's jump is no other way of writing
        place = self.frame[[*PLACE[:2]]].median().to_numpy(dtype=np.float64)
        for how, other in (
            ("latitude and longitude exchanged", place[::-1]),
            ("western longitudes without their sign", place * [1, -1]),
            ("they radians", np.degrees(place)),
        ):
            if (np.abs(np.array(SITES_DEG) - other) < NEAR_DEG).all(axis=1).any():
                self._said.append(
                    f"{self._what}: the positions lie at latitude {place[0]:.3f}, longitude {place[1]:.3f}; "
                    f"otherwise they lie at a site of AERPAW: are {how}?"
                )

    def _within_ports(self) -> None:
        """No rank is above the number of ports that the log itself tells."""
        ports, rank = self._about.get("ports"), self._values("rank")
        if not isinstance(ports, (int, float)) or isinstance(ports, bool) or not (bad := rank > float(ports)).any():
            return
        why = f"on at most {ports:g} ports by the log itself; a wrong base of the indicator, or another cell"
        self._flag(bad, "rank_above_ports", f"rank {rank[int(np.argmax(bad))]:g}", why, ["rank"])

    def _no_index(self) -> None:
        """Flag levels that mostly cannot be received: an index of the standard (0 .. 127), another unit, or a ratio."""
        level, quantity = self._values("rss_db"), str(self._about.get("quantity"))
        bad = level >= _MOST_DBM.get(quantity, 0.0)
        if 2 * bad.sum() <= np.isfinite(level).sum() or not bad.any():
            return
        known = "another unit, an RSRQ, or an index?" if quantity in _MOST_DBM else "another unit, or an index?"
        first = f"{level[int(np.argmax(bad))]:g} dBm"
        self._flag(bad, "level_out_of_range", first, f"which is received nowhere ({known})", ["rss_db"])

    def _lost_readings(self) -> None:
        """Flag a few levels near 0 dB far above all others: what a program writes for a reading that it lost."""
        level = self._values("rss_db")
        near = np.abs(level) < _LOST_DB
        if not near.any() or near.sum() > _LOST_SHARE * np.isfinite(level).sum():
            return
        if (highest := float(np.nanmax(level[~near]))) < -_LOST_DB - _FAR_DB:
            first = f"{level[int(np.argmax(near))]:g} dB"
            why = f"far above all others, which end at {highest:.1f} dB (a reading that was lost?)"
            self._flag(near, "level_lost", first, why, ["rss_db"])

    def _two_levels(self) -> None:
        """Report a series whose levels take turns, or are several at one time: of several devices, SIMs or networks."""
        # the beginning: two devices alternate all along
        level, time = self._values("rss_db")[:10_000], self.frame["time"].to_numpy("datetime64[ns]")[:10_000]
        level, time = level[np.isfinite(level)], time[np.isfinite(level)]
        if len(level) < _FEW_ALTERNATE:
            return
        lags = [lag for lag in range(1, _MOST_TURNS + 1) if len(level) >= 3 * lag]
        step, *back = (float(np.median(np.abs(level[lag:] - level[:-lag]))) for lag in lags)
        # with one of the next records it is back: fading does not come back so closely
        turns = step > _APART_DB and min(back) < _BACK_SHARE * step
        at_once = pd.Series(level).groupby(time).agg(["min", "max", "size"])
        apart_db = (at_once["max"] - at_once["min"])[at_once["size"] > 1]
        if not turns and (2 * len(apart_db) < len(at_once) or apart_db.median() < _APART_DB):
            return
        how = f"{step:.0f} dB apart from record to record" if turns else f"{apart_db.median():.0f} dB apart at one time"
        self._said.append(
            f"{self._what}: its levels alternate, {how}: several devices, SIMs or networks in one series, which no "
            "column known as a name tells apart"
        )

    def _near_in_time(self) -> None:
        """Flag a few stamps that lie days from all the others."""
        # differences as floats: those of int64 would wrap for NaT and for stamps 300 years apart
        time = self.frame["time"].to_numpy("datetime64[ns]")
        stamp: IntArray = time.view(np.int64)
        if len(stamp) < 2 or one_run(stamp):
            return
        timed = ~np.isnat(time)
        if timed.sum() < 2 or float(stamp[timed].max()) - float(stamp[timed].min()) <= _APART_S * 1e9:
            return
        # NaT last: it is the smallest of all integers
        order = np.argsort(np.where(timed, stamp, np.iinfo(np.int64).max), kind="stable")[: int(timed.sum())]
        group = np.concatenate(([0], np.cumsum(np.diff(stamp[order].astype(np.float64)) > _APART_S * 1e9)))
        size = np.bincount(group)
        few = size <= max(_FEW_ROWS, _FEW_SHARE * len(order))
        # the largest group is the log
        few[int(np.argmax(size))] = False
        few &= 2 * size.max() > len(order)  # without a main part: two flights in one file, not a few bad stamps
        last = stamp[order][np.append(np.flatnonzero(np.diff(group)), len(order) - 1)]
        unset = last < _CLOCK_SET_NS  # rows before the clock was set, however many
        few |= unset & ~unset.all()
        bad = np.zeros(len(stamp), dtype=np.bool_)
        bad[order[few[group]]] = True
        if bad.any():
            row = int(np.argmax(bad))
            why = "written before the clock was set" if stamp[row] < _CLOCK_SET_NS else "days from all others"
            self._flag(bad, "time_out_of_range", np.datetime_as_string(time[row], unit="s"), why)


def one_run(stamp: IntArray) -> bool:
    """Check whether all stamps [ns] lie within a day, or each within a day of the next; nothing beside them is held."""
    low, high = int(stamp.min()), int(stamp.max())
    if low == np.iinfo(np.int64).min:  # a record without a time
        return False
    if high - low <= _APART_S * 1e9:
        return True
    step = 1 << 20
    parts = (np.diff(stamp[first : first + step + 1].astype(np.float64)) for first in range(0, len(stamp) - 1, step))
    return all(np.abs(part).max() <= _APART_S * 1e9 for part in parts)


def _marked(frame: pd.DataFrame, bad: BoolArray, flag: str, void: Sequence[str]) -> pd.DataFrame:
    column: AnyArray = frame["flag"].to_numpy(dtype=object).copy()
    for i in np.flatnonzero(bad):
        words = str(column[i]).split(";") if column[i] else []
        column[i] = ";".join([*words, flag] if flag not in words else words)
    out: pd.DataFrame = frame.copy(deep=False)  # what is marked gets new columns
    out["flag"] = pd.Series(column, index=frame.index, dtype=object)
    for name in void:
        out[name] = np.where(bad, np.nan, frame[name].to_numpy(dtype=np.float64))
    return out
