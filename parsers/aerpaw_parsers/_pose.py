"""Telemetry from tables with named columns: autopilots of AERPAW and others, DJI, phones."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd

from aerpaw_cmp.common.text import counted
from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray
from aerpaw_cmp.logs.limits import jumps_of
from aerpaw_cmp.readers import Attribute, Lines, ReadOptions, ReadResult, RejectedLine, Rows, Stream, dictionary

from . import _sheet

PLACE = ("latitude_deg", "longitude_deg", "altitude_m")
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
VELOCITIES = ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps")
# Attributes of a stream about the source of its heights.
Height = dict[str, Attribute | None]
# Larger numbers, NaN and infinity are not counts and become -1.
_MOST = 1e9


def from_sheet(rows: Rows, sheet: _sheet.Sheet, *, name: str, source: str) -> Stream | None:
    """Return the telemetry stream of a table, or None if it has no position.

    Rows without a position are omitted, except if no row has a position.

    Parameters
    ----------
    rows : Rows
    sheet : Sheet
    name, source : str
        Name of the stream, and the source of its pose.
    """
    latitude, longitude = sheet.find("latitude_deg"), sheet.find("longitude_deg")
    if latitude is None or longitude is None:
        if (grid := sheet.find("grid")) is not None:
            text = "positions on a grid or in one text are not read: add columns of latitude and longitude"
            rows.warnings.append(f"column {sheet.names[grid]!r}: {text}")
        return None
    # 'rx lat' belongs to 'rx long', in any order of the columns
    latitudes, longitudes = ({_PLACE.sub("", sheet.plain[i]): i for i in _fitting(sheet, name)} for name in PLACE[:2])
    pairs = [(i, longitudes[rest]) for rest, i in latitudes.items() if rest in longitudes]
    if len(pairs) > 1:
        spans_deg = [max(np.nanmax(angle) - np.nanmin(angle) for angle in map(sheet.numbers, pair)) for pair in pairs]
        moving = [pair for pair, span_deg in zip(pairs, spans_deg, strict=True) if span_deg > _AT_REST_DEG]
        latitude, longitude = moving[0] if len(moving) == 1 else (latitude, longitude)
        how = "the only one that moves" if len(moving) == 1 else "which is a guess"
        names = ", ".join(sheet.names[i] for i, _ in pairs)
        rows.warnings.append(f"several columns of positions ({names}): {sheet.names[latitude]!r} was used, {how}")
        # 'rx alt' and 'rx yaw' belong to 'rx lat': find() prefers used columns
        own, pose = {*_PLACE.sub("", sheet.plain[latitude]).split()}, ("height", "angle", "velocity", "count")
        known = ((i, what) for i, what in enumerate(sheet.meanings) if what and own <= {*sheet.plain[i].split()})
        sheet.used |= {i for i, what in known if what.quantity.role in pose}
    sheet.used |= {i for i in (latitude, longitude, sheet.find("altitude_m")) if i is not None}
    values: dict[str, AnyArray] = {key: sheet.numbers(i) for key, i in zip(PLACE, (latitude, longitude), strict=False)}
    written, unfixed = np.isfinite(values[PLACE[0]]) & np.isfinite(values[PLACE[1]]), without_fix(sheet)
    values[PLACE[0]] = np.where(unfixed, np.nan, values[PLACE[0]])
    lost = clean(rows, values)
    if coarse := whole_degrees([sheet.names[latitude], sheet.names[longitude]], values):
        raise _sheet.shifted(coarse, "positions")
    datum, height = _height(rows, sheet)
    if datum not in ("take-off", "ground"):  # such heights come from a barometer and need no fix
        height = np.where(unfixed, np.nan, height)
    values["altitude_m"] = height
    about: Height = {"height_from": rows.height_from}
    if np.isfinite(height).any():
        values["altitude_m"], about = above_takeoff(rows, values, datum, lost)
    elif sheet.find("altitude_m") is not None:
        rows.warnings.append("the column of heights contains no number: heights are unknown")
    values |= _attitude(rows, sheet)
    values |= sheet.found(*VELOCITIES, "battery_v")
    for key, count in sheet.found("fix", "satellites").items():
        values[key] = np.where(np.abs(count) < _MOST, count, -1).astype(np.int64)
    where = None if lost.all() else written  # a row at 0, 0 has no fix
    return rows.stream("telemetry", name, values, where=where, source=source, about=about)


_PLACE = re.compile(r"\b(lat|latitude|lon|lng|long|longitude)\b")
# The positions of a receiver at rest vary by less than this (about 20 m).
_AT_REST_DEG = 2e-4


def _fitting(sheet: _sheet.Sheet, name: str) -> list[int]:
    """Return the columns with values whose names fit a quantity equally well."""
    ranks = {
        i: dictionary.rank_of(what.quantity, sheet.plain[i])
        for i, what in enumerate(sheet.meanings)
        if what and what.quantity.name == name and np.isfinite(sheet.numbers(i)).any()
    }
    return [i for i, rank in ranks.items() if rank == min(ranks.values())]


def without_fix(sheet: _sheet.Sheet) -> BoolArray:
    """Return the mask (n,) of the rows without a fix according to any column about the fix."""
    unfixed = np.zeros(len(sheet), dtype=bool)
    for i, meaning in enumerate(sheet.meanings):
        name = "" if meaning is None else meaning.quantity.name
        words = sheet.plain[i]
        if meaning is None and words in ("status", "state", "mode") and {*sheet.texts(i)} == {"A", "V"}:
            unfixed |= np.array(sheet.texts(i)) == "V"  # as in NMEA sentences
        if name not in ("fix", "satellites", "accuracy"):
            continue
        values = sheet.numbers(i)
        if name == "accuracy":
            # without a fix, receivers write a DOP of 0, 99 or 99.99, or the largest number that they have
            of_dop = "dop" in words and bool((values < _MOST_DOP).any())
            none = (values >= _NO_DOP) | (values == 0) if of_dop else values >= _NO_ACCURACY
        elif name == "satellites":
            none = values == 0
        else:
            # MAVLink writes 1 without a fix and 3 with a fix; the quality of NMEA is 1 with a fix and never 3
            of_mavlink = re.search("type|status|mode", words) is not None and (values >= 3).any()
            none = values <= float(of_mavlink or ((values == 3).any() and "qual" not in words))
        # if a column has this value in every row, the program does not fill the column
        if (values[~none] > 0).any():
            unfixed |= none
    return unfixed


_MOST_DOP, _NO_DOP, _NO_ACCURACY = 20.0, 99.0, 9999.0


def of_readings(
    lines: Lines, readings: Sequence[tuple[int, Mapping[str, str]]], rejected: list[RejectedLine],
    options: ReadOptions, *, reader: str,
) -> ReadResult:  # fmt: skip
    """Return the telemetry ``vehicle`` of readings with a time and a position, by :func:`._sheet.of_readings`."""
    sheet = _sheet.of_readings(lines, readings, rejected)
    rows = _sheet.rows(sheet, options, reader=reader)
    track = from_sheet(rows, sheet, name="vehicle", source=reader)
    rows.warnings += sheet.remarks()
    return rows.result([track])


def whole_degrees(names: Sequence[str], values: dict[str, AnyArray]) -> str:
    """Return a clause that names the angle in whole degrees if only one of two is, and otherwise an empty text."""
    known = [angle[np.isfinite(angle)] for angle in (values[key] for key in PLACE[:2])]
    # a receiver writes decimals even at rest; an index or a count does not
    coarse = [len(angle) > 2 and bool((angle == np.round(angle)).all()) for angle in known]
    return f"{names[coarse.index(True)]!r} has whole degrees only" if coarse[0] != coarse[1] else ""


def clean(rows: Rows, values: dict[str, AnyArray]) -> AnyArray:
    """Replace impossible positions and 0, 0 by NaN in a dictionary of columns, and return their mask."""
    latitude, longitude = values["latitude_deg"], values["longitude_deg"]
    # receivers write 0, 0 before their first fix
    possible = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)
    lost: AnyArray = np.asarray(~possible | ((latitude == 0) & (longitude == 0)))
    values |= {"latitude_deg": np.where(lost, np.nan, latitude), "longitude_deg": np.where(lost, np.nan, longitude)}
    rows.mark(lost, "no_fix")
    return lost


# --- heights ----------------------------------------------------------------------------------------------------------


def _height(rows: Rows, sheet: _sheet.Sheet) -> tuple[str, FloatArray]:
    """Return datum and values of the most useful column of heights, in the order of the dictionary."""
    column = sheet.find("altitude_m")
    if column is None:
        rows.warnings.append("no column is known as a height: heights are unknown (does another log have them?)")
        return "unknown", np.full(len(rows), np.nan)
    meaning = sheet.meanings[column]
    assert meaning is not None
    imperial = next((i for i in range(len(sheet.names)) if sheet.unit(i) in _IMPERIAL), None)
    if imperial is not None and not sheet.unit_read(column):
        text = f"has no unit, while {sheet.names[imperial]!r} is imperial: read as metres; or is it in feet?"
        rows.warnings.append(f"the column of heights, {sheet.names[column]!r}, {text}")
    rows.height_from, datum = "written", meaning.quantity.datum
    if datum == "unknown":
        known = sheet.program.datum if sheet.program is not None else ""
        rows.height_from, datum = ("program", known) if known else ("assumed", datum)
        for i in (i for i, name in enumerate(sheet.plain) if dictionary.PATTERNS["of_datum"].fullmatch(name)):
            said = {dictionary.meaning(f"altitude {text}") for text in sheet.texts(i)}
            if len(said) == 1 and (one := said.pop()) is not None and one.quantity.datum not in ("", "unknown"):
                rows.height_from, datum = "written", one.quantity.datum
    height, time_s = sheet.numbers(column), (rows.time - rows.time[:1]) / np.timedelta64(1, "s")
    home = next((i for i, words in enumerate(sheet.plain) if dictionary.PATTERNS["of_home"].fullmatch(words)), None)
    if datum in ("sea level", "unknown") and home is not None and (is_set := sheet.numbers(home) > UNSET_M).any():
        home_m, lowest_m = sheet.numbers(home)[is_set], np.nanmin(height, initial=np.inf)
        # heights of an unknown datum may already be above home
        if datum == "sea level" or (lowest_m > home_m.min() - _REST_M and lowest_m > home_m.min() / 2):
            sheet.used.add(home)
            return "take-off", above_home(rows, time_s, height, time_s[is_set], home_m)
    if datum != "take-off":
        return datum, height
    for i, what in enumerate(sheet.meanings):
        own = "" if what is None else what.quantity.datum
        if own == "sea level" or (own == "unknown" and sheet.program and sheet.program.datum == "sea level"):
            sheet.used.add(i)
            altitude = sheet.numbers(i)
            above = from_logged_heights(rows, time_s, altitude, height, altitude - height)
            if above is None:
                return "sea level", height
            if above is not height:
                return datum, above
    return datum, height


_IMPERIAL = ("mph", "ft", "feet", "foot", "ft/s")
# Home has moved if its altitude changes by more than ``MOVED_M``; an aircraft has taken off if it climbs by ``_OFF_M``.
MOVED_M, _OFF_M = 0.5, 2.0
# If home is within this distance of sea level [m], it is not set: both heights of a record are then equal after
# rounding.
UNSET_M = 0.01
_UNSET = "home was not set in {}: these have no height, because the altitude jumps when home is set"


def above_home(
    rows: Rows, time_s: FloatArray, altitude: FloatArray, home_s: FloatArray, home_m: FloatArray
) -> FloatArray:
    """Return heights above the home at take-off, from altitudes above sea level of the aircraft and of home."""
    if (known_home := np.abs(home_m) > UNSET_M).any() and not known_home.all():
        # before home is set, the autopilot writes the altitude of its filter as the height above home
        home_s, home_m = home_s[known_home], home_m[known_home]
        begin = int(np.searchsorted(time_s, home_s[0]))
        step_m = altitude[begin - 1] - altitude[begin] if 0 < begin < len(altitude) else 0.0
        leaps = abs(step_m) > _REST_M + _CLIMB_MPS * (time_s[begin] - time_s[begin - 1]) if step_m else False
        altitude = np.where(np.arange(len(altitude)) < begin, np.nan, altitude) if leaps else altitude
        text = _UNSET if leaps else "home was not set in {}: these use the home that was set later"
        rows.warnings.append(text.format(counted(int((~known_home).sum()), "record")))
    known = np.flatnonzero(np.isfinite(altitude))
    climbs = altitude[known] - np.minimum.accumulate(altitude[known]) > _OFF_M
    takeoff_s = time_s[known[int(np.argmax(climbs))]] if climbs.any() else home_s[-1]
    at = max(int(np.searchsorted(home_s, takeoff_s, side="right")) - 1, 0)
    if np.ptp(home_m) > MOVED_M:
        rows.warnings.append(
            f"home moved ({np.min(home_m):.1f} .. {np.max(home_m):.1f} m above sea level): heights count from the home "
            f"at take-off, {home_m[at]:.1f} m"
        )
    return np.asarray(altitude - home_m[at])


def from_logged_heights(
    rows: Rows, time_s: FloatArray, altitude: FloatArray, height: FloatArray, home_m: FloatArray, *,
    one_estimate: bool = False,
) -> FloatArray | None:  # fmt: skip
    """Return heights above the home at take-off from logged heights above home, or None if home was never set.

    Parameters
    ----------
    rows : Rows
    time_s, altitude, height, home_m : float array, shape (n,)
        Time, altitude above sea level, height above home, and altitude of home, which is the difference of the two.
    one_estimate : bool
        True if both heights come from the same estimate.

    Returns
    -------
    float array, shape (n,), or None
        The logged heights, unless home moved in a step: they are then computed from the altitudes and home at take-off.
        None if altitude and height are always equal and do not begin near zero, because home was then never set.
    """
    known = np.flatnonzero(np.isfinite(home_m))
    home_m = home_m[known]
    if not len(known):
        return height
    if np.abs(home_m).max() <= UNSET_M and np.nanmin(np.abs(height), initial=np.inf) >= _NEAR_ZERO_M:
        return None
    steady = np.abs(np.diff(home_m)) < _JITTER_M
    if np.ptp(home_m) <= MOVED_M or not (one_estimate or steady.mean() > _STEADY):
        return height
    return above_home(rows, time_s, altitude, time_s[known], home_m)


# The difference of two heights of the same estimate varies by less than this [m], except in the few rows in which home
# moves.
_JITTER_M, _STEADY = 0.1, 0.9


def above_takeoff(rows: Rows, values: dict[str, AnyArray], datum: str, lost: BoolArray) -> tuple[FloatArray, Height]:
    """Return heights above take-off, and the attributes about their source.

    From heights above sea level or an unknown datum, the height at rest on the ground before the climb is subtracted. A
    hover does not count as rest. If there is no such rest, the height of the first position is subtracted.

    Parameters
    ----------
    rows : Rows
        The rows, whose ``height_from`` states the source of the datum.
    values : dict
        ``latitude_deg``, ``longitude_deg`` and ``altitude_m`` as in the log.
    datum : str
        Datum of the heights, as named in the dictionary.
    lost : bool array, shape (n,)
        Rows without a position.
    """
    altitude: FloatArray = values["altitude_m"]
    about: Height = {"height_from": rows.height_from, "height_datum": datum}
    possible = (altitude > _POSSIBLE_M[0]) & (altitude < _POSSIBLE_M[1])
    known = np.flatnonzero(possible & ~lost & ~astray(rows, values))
    known = known[np.argsort(rows.time[known], kind="stable")]  # exports may begin with the newest row
    seconds = np.maximum(np.diff(rows.time[known]) / np.timedelta64(1, "s"), 0.1)
    rate_mps = np.abs(np.diff(altitude[known])) / seconds
    if 2 * (rate_mps > _FASTEST_MPS).sum() > (rate_mps > 0).sum():
        text = f"most heights change by more than {_FASTEST_MPS:g} m/s, such as {rate_mps.max():.0f} m/s: another unit?"
        rows.warnings.append(text)
    if datum == "take-off":
        altitude = _without_unset_home(rows, altitude)
    if datum in ("take-off", "ground") or not len(known):
        return altitude, about
    altitude = _without_first_zeros(altitude, rows.time if datum == "unknown" else None)
    known, values = known[np.isfinite(altitude[known])], values | {"altitude_m": altitude}
    rest = _ground(*(column[known] for column in (rows.time, *(values[name] for name in PLACE))))
    first = float(altitude[known[0]]) if rest is None else rest
    climbs = rest is not None
    # a log may begin in a hover at any height, so use the lowest height to decide whether 0 is the ground
    if datum == "unknown" and abs(first if climbs else np.abs(altitude[known]).min()) < _NEAR_ZERO_M:
        return altitude, about | {"height_datum": "take-off"}
    if datum == "unknown" and not climbs:
        rows.warnings.append(
            f"altitude begins at {first:.1f} m above an unknown datum (sea level, ground or take-off?), and the track "
            "does not begin on the ground: read as above take-off"
        )
        return altitude, about
    how = "the altitude at rest on the ground" if climbs else "that of the first position"
    if not climbs and (before := int((~lost & (rows.time < rows.time[known[0]])).sum())):
        how += f" with a height, after {counted(before, 'position')} without: was it on the ground there?"
    zero = "the ellipsoid" if datum == "ellipsoid" else "sea level"
    rows.warnings.append(f"altitudes are above {zero}: {first:.1f} m, {how}, was subtracted")
    about |= {"takeoff_from": "rest" if climbs else "first position", "height_taken_off_m": round(first, 3)}
    return altitude - first, about


def astray(rows: Rows, values: Mapping[str, AnyArray]) -> BoolArray:
    """Return the rows (n,) whose position is a jump of the receiver, which cannot be the zero of heights."""
    place = {name: values[name] for name in PLACE}
    return jumps_of(pd.DataFrame({"time": rows.time, "line": rows.row + 1, **place}))[0]


# Fastest climb of a small aircraft [m/s].
_FASTEST_MPS = 60.0
# Heights that begin within this distance of zero are relative to take-off.
_NEAR_ZERO_M = 10.0
# Heights beyond these limits are damaged or placeholders [m].
_POSSIBLE_M = (-1000.0, 20_000.0)
_REST_S, _REST_M, _REST_MPS, _CLIMB_M, _CLIMB_MPS = 2.0, 3.0, 0.3, 5.0, 20.0
_DEGREE_M = 111_000.0


def _without_first_zeros(altitude: FloatArray, time: AnyArray | None) -> FloatArray:
    """Return altitudes with NaN for leading zeros if all other altitudes are far from 0, because they have no fix.

    If times are given, as for an unknown datum, the step must also be faster than any climb.
    """
    # if all heights are 0, argmax is 0 and nothing is removed
    begun = int(np.argmax(np.nan_to_num(altitude) != 0))
    if not begun or np.nanmin(np.abs(altitude[begun:])) < _NEAR_ZERO_M:
        return altitude
    if time is not None:
        rate = np.abs(np.diff(altitude) / (np.diff(time) / np.timedelta64(1, "s")))[begun - 1 :]
        if rate[0] < _CLIMB_MPS or rate[0] < 3 * np.nanmax(rate[1:], initial=0.0):
            return altitude
    return np.where(np.arange(len(altitude)) < begun, np.nan, altitude)


def _without_unset_home(rows: Rows, height: FloatArray) -> FloatArray:
    """Return heights above take-off with NaN for leading altitudes above sea level, written before home was set.

    Such altitudes are all far from 0, and the next height is near 0. The step is faster than any descent.
    """
    fall_m, step_s = -np.diff(height), np.abs(np.diff(rows.time) / np.timedelta64(1, "s"))
    falls = (fall_m > _NEAR_ZERO_M + _CLIMB_MPS * step_s) & (np.abs(height[1:]) < _REST_M)
    begin = int(np.argmax(falls)) + 1 if falls.any() else 0
    if not begin or np.nanmin(np.abs(height[:begin])) < _NEAR_ZERO_M:
        return height
    rows.warnings.append(_UNSET.format(counted(begin, "record")))
    return np.where(np.arange(len(height)) < begin, np.nan, height)


def _ground(*track: AnyArray) -> float | None:
    """Return the height at rest of a track (time, latitude, longitude, altitude) that climbs from it or returns to it.

    A height at which the aircraft hovers is not the ground, because the aircraft also flies lower.
    """
    altitude = track[3]
    for rest in (at_rest(*track), at_rest(*(column[::-1] for column in track))):
        if rest is not None and altitude.max() - rest > _CLIMB_M and altitude.min() - rest > -_REST_M:
            return rest
    return None


def at_rest(time: AnyArray, latitude: FloatArray, longitude: FloatArray, altitude: FloatArray) -> float | None:
    """Return the height of the ground if a track begins at rest, else None."""
    seconds = np.abs((time - time[0]) / np.timedelta64(1, "s"))
    north, east = ((column - column[0]) * _DEGREE_M for column in (latitude, longitude))
    step_s = np.maximum(np.abs(np.diff(seconds, prepend=seconds[0] - 1.0)), 0.1)
    rise = np.abs(np.diff(altitude, prepend=altitude[0])) / step_s
    still = (np.hypot(east, north) < _REST_M) & (rise < _REST_MPS)
    end = len(still) if still.all() else int(np.argmin(still))
    if end < 3 or seconds[end - 1] < _REST_S:
        return None
    last = seconds[:end] >= seconds[end - 1] - 5.0
    return float(np.median(altitude[:end][last]))


# --- angles -----------------------------------------------------------------------------------------------------------


def _attitude(rows: Rows, sheet: _sheet.Sheet) -> dict[str, FloatArray]:
    """Return angles in degrees.

    The unit is read from the column name, known from the program, or guessed from the values.
    """
    values = sheet.found(*ANGLES)
    named = any(sheet.unit(column) for column in map(sheet.find, values) if column is not None)
    if not named and are_radians(values):
        rows.warnings.append("the unit of the angles is unknown: read as radians because of their values, a guess")
        values = {key: np.degrees(value) for key, value in values.items()}
    elif not named and not set(ANGLES) <= set(values) and are_small(values):
        rows.warnings.append(small_angles(values))
    yaw = values.get("yaw_deg")
    # no aircraft points exactly due north in every row
    if yaw is not None and len(yaw) > 2 and np.isfinite(yaw).any() and not np.nan_to_num(yaw).any():
        rows.warnings.append("the yaw is 0 throughout: read as unknown")
        values["yaw_deg"] = np.full(len(yaw), np.nan)
    return values


def small_angles(values: Iterable[str]) -> str:
    """Return the sentence about angles whose unit is neither in their names nor visible in their values."""
    words = " and ".join(name.removesuffix("_deg") for name in values)
    return f"the unit of {words} is unknown; no value is beyond 2 pi: read as degrees (radians? call it 'yaw [rad]')"


def are_small(values: dict[str, FloatArray]) -> bool:
    """Check whether the values of angles are possible both in radians and in degrees."""
    most = max((float(np.nanmax(np.abs(value), initial=0.0)) for value in values.values()), default=0.0)
    return "yaw_deg" in values and 0 < most <= 2 * np.pi + 1e-3


def are_radians(values: dict[str, FloatArray]) -> bool:
    """Check whether roll, pitch and yaw are in the range of radians.

    In degrees, such a flight would never turn more than six degrees away from north.
    """
    if set(values) != set(ANGLES) or not all(np.isfinite(value).any() for value in values.values()):
        return False
    roll, pitch, yaw = (float(np.nanmax(np.abs(values[key]))) for key in ANGLES)
    return roll <= np.pi / 2 and pitch <= np.pi / 2 and yaw <= 2 * np.pi and max(roll, pitch, yaw) > 0
