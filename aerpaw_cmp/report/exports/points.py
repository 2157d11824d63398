"""Tables of points: samples of links with the unit and the meaning of every column, towers, the flown line.

The values are those of ``rss.csv`` and ``rank.csv``, rounded as there, with latitude and longitude beside them. A
missing number is NaN; a rank of 0 is a code, "no path".
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.cf import DB, DBM
from ...common.geodesy import SiteFrame
from ...common.jsonable import named
from ...common.units import FloatArray
from ...logs.records import has_wall_clock
from ...site.site import Site
from ..content.flight import ReportData, Track
from ..names import RANK_COLUMNS, RSS_COLUMNS
from .tables import DECIMALS, rank_tables, rss_tables

# 1 mm.
_DEGREE_DECIMALS = 8

# Meanings of 0 to 4 in a simulated rank.
_RANK_FLAGS = ("out_of_coverage", "rank_1", "rank_2", "rank_3", "rank_4")
_YES_NO = ("no", "yes")

_UNITS = (
    (r"_dbm$|^calibrated_db$", DBM, "dBm"),
    (r"_db$", DB, "dB"),
    (r"_deg$", "degree", "deg"),
    (r"_m$", "m", "m"),
    (r"_s$", "s", "s"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One quantity of the samples.

    Parameters
    ----------
    name : str
        As in the CSV.
    unit : str
        As UDUNITS reads it.
    shown_unit : str
        As people write it: dBm.
    meaning : str
    flags : tuple of str
        Meanings of 0, 1, ...; empty for a number.
    """

    name: str
    unit: str = "1"
    shown_unit: str = ""
    meaning: str
    flags: tuple[str, ...] = ()


# What names a link.
LINK = ("flight", "tower", "channel")
PLACES = {
    "latitude_deg": ("degrees_north", "WGS84 latitude"),
    "longitude_deg": ("degrees_east", "WGS84 longitude"),
    "east_m": ("m", "east of the site origin"),
    "north_m": ("m", "north of the site origin"),
    "up_m": ("m", "height above the ground at the site origin"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """Samples of one kind.

    Parameters
    ----------
    kind : str
        Name of files and layers: ``"rss"``, ``"rank"``.
    table : pandas.DataFrame
        ``time`` (UTC), :data:`LINK`, unit, :data:`PLACES`, ``columns``; links one below the other, each in time order.
    columns : tuple of Column
    """

    kind: str
    table: Any
    columns: tuple[Column, ...]

    def __len__(self) -> int:
        return len(self.table)

    def links(self) -> Iterator[tuple[str, str, str, Any]]:
        """Flight, tower, channel and table of each link, in their order."""
        for key, rows in self.table.groupby(list(LINK), sort=False, observed=True):
            yield *map(str, key), rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """Everything that is exported of a flight.

    Parameters
    ----------
    flight, title : str
    site : Site
        Frame, towers, height of the origin.
    sets : tuple of Points
    track : Track, optional
    clock : bool
        Instants are UTC; else they count from 1970-01-01, because the logs have relative times and no origin.
    synthetic : bool
    """

    flight: str
    title: str
    site: Site
    sets: tuple[Points, ...]
    track: Track | None
    clock: bool
    synthetic: bool

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks that whoever opens a file must know."""
        texts = [
            "Heights (up_m) are metres above the ground at the site origin.",
            "A missing number is out of coverage or unknown; a simulated rank of 0 means that there is no path.",
        ]
        if not self.clock:
            texts.append(
                "The logs have relative times and no origin: instants count from 1970-01-01, the date is none."
            )
        if self.synthetic:
            texts.append("The logs are synthetic: made by simulation, they measure nothing.")
        return tuple(texts)

    def towers(self) -> Iterator[tuple[str, float, float, float]]:
        """Name, latitude, longitude [deg] and height above the ground at the origin [m]."""
        for tower in self.site.towers.values():
            latitude, longitude = latitude_longitude(self.site.frame, tower.east_m, tower.north_m)
            yield tower.name, float(latitude), float(longitude), float(tower.position_m[2])


# --- columns --------------------------------------------------------------------------------------------------------


def column(name: str, unit: str | None = None) -> Column:
    """The column of a name: its unit from the name's end, its meaning as rss.csv and rank.csv have it."""
    meaning = (RANK_COLUMNS | RSS_COLUMNS).get(name, name.replace("_", " "))
    if name.endswith("out_of_coverage"):
        return Column(name=name, meaning=meaning, flags=_YES_NO)
    if name == "measured_rank" or name.startswith("simulated_rank_k"):
        k = name.removeprefix("simulated_rank_k")
        return Column(name=name, meaning=meaning if k == name else f"rank by ray tracing, K = {k}", flags=_RANK_FLAGS)
    if name == "measured_db":
        return Column(name=name, unit=DBM if unit == "dBm" else DB, shown_unit=unit or "dB", meaning=meaning)
    _, udunits, shown = next((known for known in _UNITS if re.search(known[0], name)), ("", "1", ""))
    return Column(name=name, unit=udunits, shown_unit=shown, meaning=meaning)


def points_table(
    kind: str, flight: str, links: Iterable[tuple[Any, dict[str, Any]]], frame: SiteFrame
) -> Iterator[Points]:
    """The points of the links of a flight one below the other; nothing without links.

    Parameters
    ----------
    kind : str
        Name of files and layers.
    flight : str
    links : iterable of (times, dict)
        Instants (n,) of a link and its further columns: arrays (n,), or one value for all rows.
    frame : SiteFrame

    Yields
    ------
    Points
    """
    import pandas as pd

    link = {"channel": "", "unit": "1", "flight": flight}
    parts = [pd.DataFrame({**link, "time": time, **columns}, index=range(len(time))) for time, columns in links]
    if not parts:
        return
    table = pd.concat(parts, ignore_index=True)
    table["time"] = table["time"].to_numpy("datetime64[ns]")
    units = table["unit"].unique()
    names = [name for name in table.columns if name not in {"time", *LINK, "unit", *PLACES}]
    for name in ("east_m", "north_m", "up_m", *names):
        values = np.round(table[name].to_numpy(np.float64, na_value=np.nan), DECIMALS)
        table[name] = np.where(np.isfinite(values), values, np.nan)
    table["latitude_deg"], table["longitude_deg"] = latitude_longitude(
        frame, table["east_m"].to_numpy(), table["north_m"].to_numpy()
    )
    table = table.astype(dict.fromkeys((*LINK, "unit"), "category"))[["time", *LINK, "unit", *PLACES, *names]]
    shared = str(units[0]) if len(units) == 1 else "dB, reference by link"
    yield Points(kind=kind, table=table, columns=tuple(column(name, shared) for name in names))


def latitude_longitude(frame: SiteFrame, east_m: Any, north_m: Any) -> tuple[FloatArray, FloatArray]:
    """WGS84 latitude and longitude [deg] of positions (n,), NaN where a position is unknown."""
    known = np.isfinite(east_m) & np.isfinite(north_m)
    latitude, longitude = frame.to_geographic(np.where(known, east_m, 0.0), np.where(known, north_m, 0.0))
    return (
        np.where(known, np.round(latitude, _DEGREE_DECIMALS), np.nan),
        np.where(known, np.round(longitude, _DEGREE_DECIMALS), np.nan),
    )


# --- from a report --------------------------------------------------------------------------------------------------


def of_report(data: ReportData) -> Export:
    """The samples of a flight."""
    tables = {"rss": rss_tables(data.rss), "rank": rank_tables(data.rank)}
    sets = tuple(p for kind, links in tables.items() for p in points_table(kind, data.flight, links, data.site.frame))
    times = [points.table["time"].to_numpy() for points in sets] + ([] if data.track is None else [data.track.time])
    known = [time.min() for time in (time[~np.isnat(time)] for time in times) if len(time)]
    return Export(
        **named(data, "flight title site track synthetic"),
        sets=sets,
        clock=bool(known) and has_wall_clock(min(known)),
    )
