"""Possible range of each quantity of the record model: rows beyond it are flagged, whatever the reader.

One table for all formats. A value beyond its range becomes NaN (of a position, an attitude or a velocity all three
components do: they are one quantity), its row gets a flag, and a warning names how many there are and the first of
them. Rows with a flag of :data:`UNSCORED` are kept in the records and left out of every comparison.

The ranges are those of physics and of small aircraft, wide on purpose: they catch what cannot be (a corrupted digit, an
overflow, a sentinel), not what is unusual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from ..common.units import AnyArray, BoolArray, IntArray
from .jumps import FLAG, PLACE, jumps_of
from .records import ReadResult, Stream


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
    Limit(
        ("latitude_deg", "longitude_deg", "altitude_m"),
        ((-90.0, 90.0), (-180.0, 180.0), (-1000.0, 20_000.0)),
        "position_out_of_range",
    ),
    Limit(
        ("roll_deg", "pitch_deg", "yaw_deg"),
        ((-180.0, 180.0), (-180.0, 180.0), (-360.0, 360.0)),
        "attitude_out_of_range",
    ),
    Limit(
        ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps"),
        ((-200.0, 200.0),) * 3,
        "velocity_out_of_range",
    ),
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
UNSCORED = ("level_out_of_range", "time_out_of_range", "rank_above_ports", "no_number", "unterminated_line")


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
    warnings: list[str] = []
    streams = tuple(_checked(stream, warnings) for stream in result.streams)
    return replace(result, streams=streams, warnings=(*result.warnings, *warnings)) if warnings else result


def _checked(stream: Stream, warnings: list[str]) -> Stream:
    frame, present = stream.frame, set(stream.frame.columns)
    if stream.kind == "rss" and stream.attributes.get("unit") == "dBm":
        frame = _no_index(stream, frame, warnings)
    for limit in _limits_of(stream):
        if not present.isdisjoint(limit.columns):
            frame = _apply(stream, frame, limit, warnings)
    if stream.kind == "rank":
        frame = _within_ports(stream, frame, warnings)
    frame = _near_in_time(stream, frame, warnings)
    if stream.kind == "rss":
        _two_levels(stream, frame, warnings)
    _at_a_site_if_exchanged(stream, frame, warnings)
    bad, sentence = jumps_of(stream if frame is stream.frame else replace(stream, frame=frame))
    if bad.any():
        frame = _marked(frame, bad, FLAG, [name for name in PLACE if name in frame.columns])
    warnings += [sentence] if sentence else []
    return stream if frame is stream.frame else replace(stream, frame=frame)


def _limits_of(stream: Stream) -> tuple[Limit, ...]:
    if stream.kind != "rss":
        return LIMITS
    bounds = LEVEL_DB.get(str(stream.attributes.get("unit")), _LEVEL_OTHER_DB)
    return (*LIMITS, Limit(("rss_db",), (bounds,), "level_out_of_range"))


def _apply(stream: Stream, frame: pd.DataFrame, limit: Limit, warnings: list[str]) -> pd.DataFrame:
    names = [name for name in limit.columns if name in frame.columns]
    first: tuple[int, str, tuple[float, float]] | None = None
    bad = np.zeros(len(frame), dtype=np.bool_)
    for name, (low, high) in zip(limit.columns, limit.ranges, strict=True):
        if name not in names:
            continue
        value = frame[name].to_numpy(dtype=np.float64)
        least = np.fmin.reduce(value) if len(value) else np.nan
        if np.isnan(least) or (low <= least and np.fmax.reduce(value) <= high):
            continue
        beyond = (value < low) | (value > high)
        if beyond.any() and (first is None or int(np.argmax(beyond)) < first[0]):
            first = int(np.argmax(beyond)), name, (low, high)
        bad |= beyond
    if first is None:
        return frame
    row, name, (low, high) = first
    shown = (
        f"{name} {frame[name].iloc[row]:.6g} in line {int(frame['line'].iloc[row])}, where {low:g} .. {high:g} can be"
    )
    scored = "; not scored" if limit.flag in UNSCORED else "; read as missing"
    swap = _exchanged(frame, bad) if "latitude_deg" in names else ""
    warnings.append(_sentence(stream, int(bad.sum()), limit.flag, f"the first: {shown}{swap}{scored}"))
    return _marked(frame, bad, limit.flag, names)


def _exchanged(frame: pd.DataFrame, bad: BoolArray) -> str:
    """A hint where every impossible position would be possible with its angles exchanged."""
    latitude = np.abs(frame["latitude_deg"].to_numpy(dtype=np.float64)[bad])
    longitude = np.abs(frame["longitude_deg"].to_numpy(dtype=np.float64)[bad])
    fits = (latitude > 90.0) & (latitude <= 180.0) & (longitude <= 90.0)
    return "; are latitude and longitude exchanged?" if fits.all() else ""


# AERPAW's sites, Lake Wheeler and Centennial Campus: latitude, longitude, and how far from them positions are theirs.
SITES_DEG, NEAR_DEG = ((35.727, -78.696), (35.773, -78.677)), 0.3


def _at_a_site_if_exchanged(stream: Stream, frame: pd.DataFrame, warnings: list[str]) -> None:
    """Say where positions that can be would lie at a site of AERPAW with their angles exchanged."""
    if not {"latitude_deg", "longitude_deg"} <= set(frame.columns):
        return
    place = frame[["latitude_deg", "longitude_deg"]].median().to_numpy(dtype=np.float64)
    if (np.abs(np.array(SITES_DEG) - place[::-1]) < NEAR_DEG).all(axis=1).any():
        warnings.append(
            f"{stream.kind} {stream.name!r}: the positions lie at latitude {place[0]:.3f}, longitude {place[1]:.3f}; "
            "exchanged they lie at a site of AERPAW: are latitude and longitude exchanged?"
        )


def _within_ports(stream: Stream, frame: pd.DataFrame, warnings: list[str]) -> pd.DataFrame:
    """No rank is above the number of ports that the log itself tells."""
    ports = stream.attributes.get("ports")
    if not isinstance(ports, (int, float)) or isinstance(ports, bool):
        return frame
    rank = frame["rank"].to_numpy(dtype=np.float64)
    bad = rank > float(ports)
    if not bad.any():
        return frame
    row = int(np.argmax(bad))
    text = (
        f"the first: rank {rank[row]:g} in line {int(frame['line'].iloc[row])}, on at most {ports:g} ports by the log "
        "itself; a wrong base of the indicator, or another cell; not scored"
    )
    warnings.append(_sentence(stream, int(bad.sum()), "rank_above_ports", text))
    return _marked(frame, bad, "rank_above_ports", ["rank"])


# No receiver in flight meets such levels: reports of RSRP end at -31 dBm (3GPP TS 38.133, 10.1.6), those of RSRQ and
# SINR do not.
_MOST_DBM = {"RSRP": -20.0}


def _no_index(stream: Stream, frame: pd.DataFrame, warnings: list[str]) -> pd.DataFrame:
    """Flag levels that mostly cannot be received: an index of the standard (0 .. 127), another unit, or a ratio."""
    level = frame["rss_db"].to_numpy(dtype=np.float64)
    quantity = str(stream.attributes.get("quantity"))
    bad = level >= _MOST_DBM.get(quantity, 0.0)
    if 2 * bad.sum() <= np.isfinite(level).sum() or not bad.any():
        return frame
    row = int(np.argmax(bad))
    known = "another unit, an RSRQ, or an index?" if quantity in _MOST_DBM else "another unit, or an index?"
    text = (
        f"the first: {level[row]:g} dBm in line {int(frame['line'].iloc[row])}, which is received nowhere "
        f"({known}); not scored"
    )
    warnings.append(_sentence(stream, int(bad.sum()), "level_out_of_range", text))
    return _marked(frame, bad, "level_out_of_range", ["rss_db"])


# Levels that alternate from record to record: further apart than fading, and back with the next.
_APART_DB, _BACK_SHARE, _FEW_ALTERNATE = 10.0, 0.2, 6


def _two_levels(stream: Stream, frame: pd.DataFrame, warnings: list[str]) -> None:
    """Say where the levels of a series alternate between two: of two devices, SIMs or networks."""
    level = frame["rss_db"].to_numpy(dtype=np.float64)[:10_000]
    level = level[np.isfinite(level)]
    if len(level) < _FEW_ALTERNATE:
        return
    step, back = (float(np.median(np.abs(level[lag:] - level[:-lag]))) for lag in (1, 2))
    if step > _APART_DB and back < _BACK_SHARE * step:
        warnings.append(
            f"rss {stream.name!r}: its levels alternate, {step:.0f} dB apart from record to record: two devices, SIMs "
            "or networks in one series, which no column known as a name tells apart"
        )


def _near_in_time(stream: Stream, frame: pd.DataFrame, warnings: list[str]) -> pd.DataFrame:
    """Flag a few stamps that lie days from all the others."""
    stamp: IntArray = frame["time"].to_numpy("datetime64[ns]").view(np.int64)
    if len(stamp) < 2 or _one_run(stamp):
        return frame
    timed = ~np.isnat(frame["time"].to_numpy("datetime64[ns]"))
    if timed.sum() < 2 or float(stamp[timed].max()) - float(stamp[timed].min()) <= _APART_S * 1e9:
        return frame
    order = np.argsort(np.where(timed, stamp, np.iinfo(np.int64).max), kind="stable")[: int(timed.sum())]
    group = np.concatenate(([0], np.cumsum(np.diff(stamp[order].astype(np.float64)) > _APART_S * 1e9)))
    size = np.bincount(group)
    few = size <= max(_FEW_ROWS, _FEW_SHARE * len(order))
    few[int(np.argmax(size))] = False
    few &= 2 * size.max() > len(order)  # without a main part: two flights in one file, not a few bad stamps
    last = stamp[order][np.append(np.flatnonzero(np.diff(group)), len(order) - 1)]
    unset = last < _CLOCK_SET_NS  # rows before the clock was set, however many
    few |= unset & ~unset.all()
    bad = np.zeros(len(frame), dtype=np.bool_)
    bad[order[few[group]]] = True
    if not bad.any():
        return frame
    row = int(np.argmax(bad))
    shown = f"the first: {np.datetime_as_string(frame['time'].to_numpy('datetime64[ns]')[row], unit='s')}"
    why = "written before the clock was set" if stamp[row] < _CLOCK_SET_NS else "days from all others"
    text = f"{shown} in line {int(frame['line'].iloc[row])}, {why}; not scored"
    warnings.append(_sentence(stream, int(bad.sum()), "time_out_of_range", text))
    return _marked(frame, bad, "time_out_of_range", [])


def _one_run(stamp: IntArray) -> bool:
    """Check whether all stamps [ns] lie within a day, or each within a day of the next; nothing beside them is held."""
    low, high = int(stamp.min()), int(stamp.max())
    if low == np.iinfo(np.int64).min:  # a record without a time
        return False
    if high - low <= _APART_S * 1e9:
        return True
    step = 1 << 20
    for first in range(0, len(stamp) - 1, step):
        part = np.diff(stamp[first : first + step + 1].astype(np.float64))
        if np.abs(part).max() > _APART_S * 1e9:
            return False
    return True


def _sentence(stream: Stream, count: int, flag: str, text: str) -> str:
    rows = "1 row is" if count == 1 else f"{count} rows are"
    return f"{stream.kind} {stream.name!r}: {rows} flagged {flag}; {text}"


def _marked(frame: pd.DataFrame, bad: BoolArray, flag: str, void: list[str]) -> pd.DataFrame:
    column: AnyArray = frame["flag"].to_numpy(dtype=object).copy()
    for i in np.flatnonzero(bad):
        words = str(column[i]).split(";") if column[i] else []
        column[i] = ";".join([*words, flag] if flag not in words else words)
    out: pd.DataFrame = frame.copy(deep=False)  # what is marked gets new columns
    out["flag"] = pd.Series(column, index=frame.index, dtype=object)
    for name in void:
        out[name] = np.where(bad, np.nan, frame[name].to_numpy(dtype=np.float64))
    return out
