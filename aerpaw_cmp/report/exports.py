"""Export of the samples along a flight as files for other programs.

An :class:`Export` contains one table of points per kind (``rss``, ``rank``), with one row per sample: link, time,
position and values. The values are those of ``rss.csv`` and ``rank.csv`` with the same rounding. Latitude and longitude
are added. A missing number is NaN, and a rank of 0 means that there is no path.

Each format is one function ``write_X(export, folder)``. NetCDF follows CF-1.11. The KMZ contains tracks for Google
Earth, coloured by level, residual and rank. There is one folder per link and quantity, and only the first is visible at
first. Samples out of coverage are grey. Maps over a grid are written by :mod:`aerpaw_cmp.maps.export`.
"""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common import kml
from ..common.cf import DB, DBM, Dataset, file_attributes, netcdf_bytes, wgs84
from ..common.errors import UsageError
from ..common.geodesy import SiteFrame
from ..common.kml import xml_text
from ..common.stages import Progress, logged
from ..common.units import AnyArray, FloatArray
from ..logs.records import has_wall_clock
from ..maps.export import Scale, class_scale, number_scale
from .canvas import keep_extremes
from .columns import DECIMALS, RANK, RSS, Column, tables
from .flight_data import ReportData
from .texts import iso_time

# 8 decimals of a degree are 1 mm.
_DEGREE_DECIMALS = 8

# Units in the notation of UDUNITS. Levels that are not in dBm count as ratios.
_UDUNITS = {"": "1", "m": "m", "s": "s", "dBm": DBM}

# Columns that identify a link.
LINK = ("flight", "tower", "channel")
# Columns of positions, with the name and attributes of their variable in NetCDF.
PLACES = {
    "latitude_deg": ("latitude", {"long_name": "WGS84 latitude", "units": "degrees_north",
                                  "standard_name": "latitude", "axis": "Y"}),
    "longitude_deg": ("longitude", {"long_name": "WGS84 longitude", "units": "degrees_east",
                                    "standard_name": "longitude", "axis": "X"}),
    "east_m": ("east", {"long_name": "east of the site origin", "units": "m"}),
    "north_m": ("north", {"long_name": "north of the site origin", "units": "m"}),
    "up_m": ("up", {"long_name": "height above the ground at the site origin", "units": "m",
                    "standard_name": "height", "axis": "Z", "positive": "up"}),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """The samples of one kind.

    Parameters
    ----------
    kind : str
        Name of files and layers: ``"rss"``, ``"rank"``.
    table : pandas.DataFrame
        Table with ``time`` (UTC), :data:`LINK`, unit, :data:`PLACES` and ``columns``. The rows of each link are
        contiguous and in time order.
    columns : tuple of Column
    """

    kind: str
    table: Any
    columns: tuple[Column, ...]

    def links(self) -> Iterator[tuple[str, str, str, Any]]:
        """Yield flight, tower, channel and table of each link, in their order."""
        for key, rows in self.table.groupby(list(LINK), sort=False, observed=True):
            yield *map(str, key), rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """The exported content of a flight.

    ``clock`` is True if times are UTC. If the logs have relative times, it is False, and times count from 1970-01-01.
    """

    data: ReportData
    sets: tuple[Points, ...]
    clock: bool

    @property
    def remarks(self) -> list[str]:
        """The remarks in every file."""
        texts = [
            "Heights (up_m) are metres above the ground at the site origin.",
            "A missing number is out of coverage or unknown; a simulated rank of 0 means that there is no path.",
        ]
        if not self.clock:
            texts.append(
                "The logs have relative times and no origin: times count from 1970-01-01, which is not the date."
            )
        if self.data.synthetic:
            texts.append("The logs are synthetic: they were simulated, not measured.")
        return texts


def latitude_longitude(frame: SiteFrame, east_m: Any, north_m: Any) -> list[FloatArray]:
    """Return WGS84 latitude and longitude of positions (n,) [deg], NaN if a position is unknown."""
    known = np.isfinite(east_m) & np.isfinite(north_m)
    degrees = frame.to_geographic(np.where(known, east_m, 0.0), np.where(known, north_m, 0.0))
    return [np.where(known, np.round(axis, _DEGREE_DECIMALS), np.nan) for axis in degrees]


# --- from a report --------------------------------------------------------------------------------------------------


def of_report(data: ReportData) -> Export:
    """Return the samples of a flight."""
    kinds = {"rss": tables(RSS, data.rss), "rank": tables(RANK, data.rank)}
    sets = tuple(points_table(kind, data, *of) for kind, of in kinds.items() if of[1])
    times = [points.table["time"].to_numpy() for points in sets] + ([] if data.track is None else [data.track.time])
    known = [time.min() for time in (time[~np.isnat(time)] for time in times) if len(time)]
    return Export(data=data, sets=sets, clock=bool(known) and has_wall_clock(min(known)))


def points_table(
    kind: str, data: ReportData, columns: Sequence[Column], links: Sequence[tuple[Any, dict[str, Any]]]
) -> Points:
    """Return the samples of one kind as points.

    Parameters
    ----------
    kind : str
        ``rss`` or ``rank``.
    data : ReportData
    columns : sequence of Column
    links : sequence of (times, columns)
        Times of each link, and its columns by name.

    Returns
    -------
    Points
    """
    import pandas as pd

    link = {"channel": "", "unit": "1", "flight": data.flight}
    parts = [pd.DataFrame({**link, "time": time, **values}, index=range(len(time))) for time, values in links]
    table = pd.concat(parts, ignore_index=True)
    table["time"] = table["time"].to_numpy("datetime64[ns]")
    columns = [column for column in columns if column.name not in {*LINK, "unit", *PLACES}]
    names = [column.name for column in columns]
    for name in ("east_m", "north_m", "up_m", *names):
        values = np.round(table[name].to_numpy(np.float64, na_value=np.nan), DECIMALS)
        table[name] = np.where(np.isfinite(values), values, np.nan)
    degrees = latitude_longitude(data.site.frame, table["east_m"].to_numpy(), table["north_m"].to_numpy())
    table["latitude_deg"], table["longitude_deg"] = degrees
    table = table.astype(dict.fromkeys((*LINK, "unit"), "category"))[["time", *LINK, "unit", *PLACES, *names]]
    units = table["unit"].unique()
    shared = str(units[0]) if len(units) == 1 else "dB, reference by link"
    known = (replace(column, unit=shared) if column.name == "measured_db" else column for column in columns)
    return Points(kind=kind, table=table, columns=tuple(known))


# --- NetCDF ---------------------------------------------------------------------------------------------------------

# Code of a missing value in NetCDF (attribute ``_FillValue``).
_NO_CODE = -1

_TITLES = {"rss": "Received level, measured and replayed", "rank": "Channel rank, reported and replayed"}


def write_netcdf(export: Export, folder: Path) -> list[Path]:
    """Write ``<kind>.nc``: trajectories as a contiguous ragged array, one per link."""
    files = {folder / f"{points.kind}.nc": points for points in export.sets}
    for path, points in files.items():
        path.write_bytes(netcdf_bytes(_points_dataset(export, points)))
    return list(files)


def _points_dataset(export: Export, points: Points) -> Dataset:
    """Return the samples of one kind as variables with dimensions trajectory (links) and obs."""
    links = list(points.links())
    texts = {
        "link": ("flight, tower and channel", [f"{f} {f'{t} {c}'.strip()}" for f, t, c, _ in links]),
        **{name: (f"name of the {name}", [link[i] for link in links]) for i, name in enumerate(LINK)},
        "unit_of_measured": ("unit of the level as logged", [str(rows["unit"].iloc[0]) for *_, rows in links]),
    }
    variables: dict[str, Any] = {
        name: ("trajectory", np.array(values, dtype=object), {"long_name": meaning})
        for name, (meaning, values) in texts.items()
    }
    variables["link"][2]["cf_role"] = "trajectory_id"
    size = {"long_name": "number of samples of this link", "sample_dimension": "obs"}
    variables["row_size"] = ("trajectory", np.array([len(rows) for *_, rows in links], dtype=np.int32), size)
    variables["time"] = ("obs", *_seconds(export, points.table["time"].to_numpy()))
    for name, (short, attributes) in PLACES.items():
        variables[short] = ("obs", points.table[name].to_numpy(), attributes)
    variables["crs"] = ((), np.int32(0), wgs84())
    for item in points.columns:
        variables[item.name.replace(".", "p")] = ("obs", *_values(item, points.table[item.name].to_numpy()))
    about = file_attributes(
        title=f"{_TITLES[points.kind]}: {export.data.title}",
        source="field logs, replayed by ray tracing",
        comment=" ".join(export.remarks),
    )
    return Dataset(variables, {**about, "featureType": "trajectory"})


def _seconds(export: Export, times: Any) -> tuple[Any, dict[str, str]]:
    """Return seconds after the first whole second, and their attributes."""
    known = times[~np.isnat(times)]
    start = known.min().astype("datetime64[s]") if len(known) and export.clock else np.datetime64("1970-01-01", "s")
    attributes = {
        "standard_name": "time", "long_name": "time of the sample", "axis": "T",
        "units": f"seconds since {str(start).replace('T', ' ')} UTC", "calendar": "standard",
        "units_metadata": "leap_seconds: none",
        **({} if export.clock else {"comment": "the logs have relative times and no origin: the date is not real"}),
    }  # fmt: skip
    return np.where(np.isnat(times), np.nan, (times - start) / np.timedelta64(1, "s")), attributes


def _values(column: Column, values: Any) -> tuple[Any, ...]:
    """Return values, attributes and encoding of a quantity or of codes."""
    shared = {"long_name": column.meaning, "coordinates": "time latitude longitude up", "grid_mapping": "crs"}
    if column.flags:
        codes = np.where(np.isfinite(values), values, _NO_CODE).astype(np.int8)
        flags = {"flag_values": np.arange(len(column.flags), dtype=np.int8), "flag_meanings": " ".join(column.flags)}
        return codes, shared | flags, {"_FillValue": np.int8(_NO_CODE)}
    unit = _UDUNITS.get(column.unit, DB)
    comment = {} if column.unit in ("", unit) else {"comment": f"unit: {column.unit}"}
    return values, {**shared, "units": unit, **comment}, {"_FillValue": np.nan}


# --- KMZ --------------------------------------------------------------------------------------------------------------

# Largest number of points of all coloured lines, because Google Earth becomes slow with more.
POINTS = 24_000
TRACK_POINTS = 5_000

_LEVELS = {"calibrated_db": "Level measured", "simulated_dbm": "Level replayed", "residual_db": "Residual"}
_AIR = "<altitudeMode>relativeToGround</altitudeMode>"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shown:
    """A link with the quantity that colours it."""

    name: str
    column: Column
    scale: Scale
    rows: Any


def write_kmz(export: Export, folder: Path) -> list[Path]:
    """Write ``samples.kmz``."""
    shown = [item for points in export.sets for item in _shown(points)]
    scales = {item.scale.key: item.scale for item in shown}
    budget = POINTS // max(1, len(shown))
    body = [*(_style(scale) for scale in scales.values()), _towers(export), _flown(export)]
    for number, link in enumerate(shown):
        lines = "".join(_lines(link, budget, clock=export.clock, visible=number == 0))
        body.append(kml.folder(link.name, f"legends/{link.scale.key}.png", lines, visible=number == 0))
    words = [*export.remarks, "Lines are drawn at their height above the ground below."]
    if max((len(item.rows) for item in shown), default=0) > budget:
        words.append(
            f"Thinned to about {budget} points per line, with minimum and maximum of every segment; all samples are in "
            "rss.csv and rank.csv."
        )
    legends = {name: picture for scale in scales.values() for name, picture in scale.legend().items()}
    path = folder / "samples.kmz"
    return [kml.write_archive(path, export.data.title, " ".join(words), "".join(body), legends)]


def _shown(points: Points) -> Iterator[_Shown]:
    """Yield every link with each of its coloured quantities."""
    scales = _scales_of(points)
    columns = {c.name: c for c in points.columns if c.name in scales}
    for (_, tower, channel, rows), (name, column) in itertools.product(points.links(), columns.items()):
        if name.startswith("simulated_rank") and rows[name].isna().all():  # this K occurs only on other links
            continue
        shown = f"{tower} {channel}".strip() + f", {_LEVELS.get(name, column.meaning)}"
        yield _Shown(name=shown, column=column, scale=scales[name], rows=rows)


def _style(scale: Scale) -> str:
    """Return one KML line style per colour. The order in KML is alpha, blue, green, red."""
    return "".join(
        f'<Style id="{scale.key}{i}"><LineStyle><color>ff{c[5:7]}{c[3:5]}{c[1:3]}</color><width>4</width></LineStyle>'
        "</Style>"
        for i, c in enumerate(scale.colours)
    )


def _towers(export: Export) -> str:
    towers, frame = export.data.site.towers.values(), export.data.site.frame
    east, north, up = np.array([tower.position_m for tower in towers]).reshape(-1, 3).T
    latitude, longitude = latitude_longitude(frame, east, north)
    places = kml.coordinates(longitude, latitude, up)
    marks = [kml.mark(tower.name, at, in_the_air=True) for tower, at in zip(towers, places, strict=True)]
    return f"<Folder><name>Towers</name>{''.join(marks)}</Folder>"


def _flown(export: Export) -> str:
    """Return the track as KML, with times if they are known. Empty if there are fewer than two positions."""
    if (line := export.data.track) is None:
        return ""
    known = np.flatnonzero(np.isfinite(line.position_m[:, :2]).all(axis=1) & ~np.isnat(line.time))
    if len(known) < 2:
        return ""
    pick = known[keep_extremes([line.position_m[known, 2]], TRACK_POINTS)]
    east, north, up = line.position_m[pick].T
    latitude, longitude = latitude_longitude(export.data.site.frame, east, north)
    at = kml.coordinates(longitude, latitude, up)
    if export.clock:
        times = "".join(f"<when>{time}</when>" for time in iso_time(line.time[pick]))
        places = "".join(f"<gx:coord>{item.replace(',', ' ')}</gx:coord>" for item in at)
        shape = f"<gx:Track>{_AIR}{times}{places}</gx:Track>"
    else:
        shape = f"<LineString>{_AIR}<coordinates>{' '.join(at)}</coordinates></LineString>"
    name, style = xml_text(export.data.flight), kml.line_style("99ffffff", 2)
    return f"<Placemark><name>Flown: {name}</name>{style}{shape}</Placemark>"


def _lines(shown: _Shown, budget: int, *, clock: bool, visible: bool) -> Iterator[str]:
    """Yield the lines of a link. Each line has one colour."""
    rows = shown.rows[shown.rows["latitude_deg"].notna() & shown.rows["time"].notna()]
    if len(rows) < 2:
        return
    rows = rows.iloc[keep_extremes([rows[shown.column.name].to_numpy()], budget)]
    values = rows[shown.column.name].to_numpy()
    at = kml.coordinates(*(rows[name].to_numpy() for name in ("longitude_deg", "latitude_deg", "up_m")))
    times, bins = iso_time(rows["time"].to_numpy()), shown.scale.bin_of(values)
    starts = np.flatnonzero(np.concatenate([[True], bins[1:] != bins[:-1]]))
    for first, after in zip(starts, [*starts[1:], len(rows) - 1], strict=True):
        last = int(after)  # end a line where the next begins, so that there is no gap
        if last <= first:
            continue
        number = int(bins[first])
        span = f"<TimeSpan><begin>{times[first]}</begin><end>{times[last]}</end></TimeSpan>" if clock else ""
        head = f"<visibility>{int(visible)}</visibility>{span}"
        style = f"<styleUrl>#{shown.scale.key}{number}</styleUrl>"
        name = _label(shown, values[first:last], number)
        yield kml.line(name, at[first : last + 1], _AIR, head=head, style=style)


def _label(shown: _Shown, values: AnyArray, number: int) -> str:
    """Return the text of a line: its values, or the name of its class."""
    known = values[np.isfinite(values)]
    if shown.column.flags or not len(known):
        return shown.scale.labels[number]
    low, high = known.min(), known.max()
    return (f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}") + f" {shown.column.unit}"


# --- colours ---------------------------------------------------------------------------------------------------------


RANKS = class_scale("rank", "Rank", ("Z", "rank 1", "rank 2", "rank 3", "rank 4"))


def _scales_of(points: Points) -> dict[str, Scale]:
    """Return the scale of each coloured column. Levels share one scale, residuals another, and ranks have classes."""
    if points.kind == "rank":
        names = [c.name for c in points.columns if c.name.startswith(("measured_rank", "simulated_rank"))]
        return dict.fromkeys(names, RANKS)
    names = ["calibrated_db", "simulated_dbm"]
    level = number_scale("level", "Level [dBm]", points.table[names].to_numpy().ravel())
    apart = points.table["residual_db"].to_numpy()
    residual = number_scale("residual", "Measured minus replayed [dB]", apart, "RdBu_r", centred=True)
    return dict.fromkeys(names, level) | {"residual_db": residual}


# --- files of a report ------------------------------------------------------------------------------------------------

# Writers, and modules that a format needs in addition to the default installation.
_WRITERS = {"kmz": write_kmz, "netcdf": write_netcdf}
_NEEDS = {"netcdf": ("netCDF4", "xarray")}
FORMATS = tuple(_WRITERS)

ALL = "all"
FOLDER = "exports"


def chosen_formats(names: Iterable[str], known: Iterable[str] = FORMATS) -> tuple[str, ...]:
    """Return the formats that a user chose. Names may be joined by commas, and ``all`` means every format.

    Raises
    ------
    UsageError
        If a name is unknown, or the library of a format is not installed.

    Examples
    --------
    >>> chosen_formats(["netcdf,kmz", "kmz"])
    ('kmz', 'netcdf')
    """
    chosen = [part.strip().lower() for name in names for part in name.split(",") if part.strip()]
    if unknown := [name for name in chosen if name not in (*known, ALL)]:
        raise UsageError(f"format {unknown[0]!r}", expected=", ".join((*known, ALL)))
    for name in chosen:
        if missing := _missing_module(name):
            raise UsageError(
                f"format {name} needs {missing}, which is not installed",
                expected="pip install 'aerpaw-cmp[geo]', or another format",
            )
    return tuple(name for name in known if name in chosen or ALL in chosen)


def _missing_module(name: str) -> str:
    """Return the name of a module that a format needs and that is not installed, or an empty text."""
    return next((module for module in _NEEDS.get(name, ()) if importlib.util.find_spec(module) is None), "")


def write_exports(export: Export, folder: Path, formats: Iterable[str], progress: Progress = logged) -> list[Path]:
    """Write the files of some formats into ``folder / "exports"``.

    Parameters
    ----------
    export : Export
    folder : Path
        Folder of the results, in which the folder of the exports is created.
    formats : iterable of str
        Names of :data:`FORMATS`.
    progress : Progress
        Receives a message for each format of ``all`` whose library is missing.

    Returns
    -------
    list of Path

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    place = folder / FOLDER
    written: list[Path] = []
    for name in formats:
        if missing := _missing_module(name):
            progress(f"export {name} left out: {missing} is not installed (pip install 'aerpaw-cmp[geo]')")
            continue
        place.mkdir(exist_ok=True)
        written += _WRITERS[name](export, place)
    return written
