"""What an export holds: samples by link with the unit and the meaning of every column, towers, flown lines.

The values are those of ``rss.csv`` and ``rank.csv``, rounded as there, with latitude and longitude beside them. A
missing number is NaN; a rank of 0 is a code, "no path".
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...common.cf import DB, DBM
from ...common.errors import one_line
from ...common.geodesy import SiteFrame
from ...common.units import AnyArray, FloatArray
from ...logs.records import has_wall_clock
from ...site.site import Site
from ..campaign_data import CampaignData, FlownRank, RssRow
from ..data import RankPanel, ReportData, RssPanel
from ..names import k_key

DECIMALS = 4
"""As in rss.csv and rank.csv."""
DEGREE_DECIMALS = 8
"""1 mm."""

RANK_FLAGS = ("out_of_coverage", "rank_1", "rank_2", "rank_3", "rank_4")
"""Meanings of 0 to 4 in a simulated rank."""
YES_NO = ("no", "yes")

_UNITS = (
    (r"_dbm$", DBM, "dBm"),
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
    unit: str
    shown_unit: str
    meaning: str
    flags: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Samples (n,) of one link, in time order: ``values`` by column name; positions in the site frame [m]."""

    flight: str
    tower: str
    channel: str
    unit: str
    time: AnyArray
    east_m: FloatArray
    north_m: FloatArray
    up_m: FloatArray
    values: Mapping[str, FloatArray]

    def __len__(self) -> int:
        return len(self.time)

    @property
    def name(self) -> str:
        """Tower and channel, as one label."""
        return f"{self.tower} {self.channel}".strip()


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleSet:
    """All series of one kind, ``rss`` or ``rank``, with the columns that they share."""

    kind: str
    columns: tuple[Column, ...]
    series: tuple[Series, ...]

    def __len__(self) -> int:
        return sum(map(len, self.series))


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A flown line (n,): instants and positions in the site frame [m]."""

    flight: str
    time: AnyArray
    east_m: FloatArray
    north_m: FloatArray
    up_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """Everything that is exported.

    Parameters
    ----------
    name, title : str
    site : Site
        Frame, towers, height of the origin.
    sets : tuple of SampleSet
        Those that have series.
    lines : tuple of Line
    clock : bool
        Instants are UTC; else they count from 1970-01-01, because the logs have relative times and no origin.
    synthetic : bool
    attributes : mapping
        What made it: generated, version.
    """

    name: str
    title: str
    site: Site
    sets: tuple[SampleSet, ...]
    lines: tuple[Line, ...]
    clock: bool
    synthetic: bool = False
    attributes: Mapping[str, str] = field(default_factory=dict)

    def set(self, kind: str) -> SampleSet | None:
        """The set of a kind, where there is one."""
        return next((one for one in self.sets if one.kind == kind), None)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What whoever opens a file must know."""
        said = [
            "Heights (up_m) are metres above the ground at the site origin.",
            "A missing number is out of coverage or unknown; a simulated rank of 0 means that there is no path.",
        ]
        if not self.clock:
            said.append("The logs have relative times and no origin: instants count from 1970-01-01, the date is none.")
        if self.synthetic:
            said.append("The logs are synthetic: made by simulation, they measure nothing.")
        return tuple(said)


# --- columns --------------------------------------------------------------------------------------------------------

_RSS_MEANINGS = {
    "measured_db": "level as logged",
    "calibrated_db": "level as logged plus the fitted offset of the link",
    "simulated_dbm": "level by ray tracing",
    "residual_db": "calibrated minus simulated level",
    "measured_out_of_coverage": "whether the log has no signal here",
    "simulated_out_of_coverage": "whether the ray tracing has no path here",
}


def column(name: str, unit: str | None = None) -> Column:
    """The column of a name: its unit from the name's end, its meaning from what is known of it."""
    if name.endswith("out_of_coverage"):
        return Column(name=name, unit="1", shown_unit="", meaning=_RSS_MEANINGS[name], flags=YES_NO)
    if name == "measured_rank":
        meaning = "rank reported by the modem, missing where it reported none"
        return Column(name=name, unit="1", shown_unit="", meaning=meaning, flags=RANK_FLAGS)
    if re.match(r"(simulated_)?rank_", name):
        k = name.rsplit("_k", 1)[-1]
        what = name.removeprefix("simulated_").removeprefix("rank_").rsplit("k" + k, 1)[0].strip("_").replace("_", " ")
        meaning = f"rank by ray tracing, K = {k}" + (f", {what}" if what else "")
        return Column(name=name, unit="1", shown_unit="", meaning=meaning, flags=RANK_FLAGS)
    meaning = _RSS_MEANINGS.get(name, name.replace("_", " "))
    if name == "calibrated_db":
        return Column(name=name, unit=DBM, shown_unit="dBm", meaning=meaning)
    if name == "measured_db":
        known = (DBM, "dBm") if unit == "dBm" else (DB, unit or "dB")
        return Column(name=name, unit=known[0], shown_unit=known[1], meaning=meaning)
    for end, udunits, shown in _UNITS:
        if re.search(end, name):
            return Column(name=name, unit=udunits, shown_unit=shown, meaning=meaning)
    return Column(name=name, unit="1", shown_unit="", meaning=meaning)


def _set(kind: str, series: Sequence[Series]) -> Iterator[SampleSet]:
    """The set of some series, with every column that one of them has; nothing without series."""
    if not series:
        return
    units = {one.unit for one in series}
    names = dict.fromkeys(name for one in series for name in one.values)
    shared = units.pop() if len(units) == 1 else "dB, reference by link"
    yield SampleSet(kind=kind, columns=tuple(column(name, shared) for name in names), series=tuple(series))


# --- from a report --------------------------------------------------------------------------------------------------


def of_report(data: ReportData) -> Export:
    """The samples of a flight."""
    rss = [_rss_series(data.flight, panel) for panel in data.rss]
    rank = [_rank_series(data.flight, panel) for panel in data.rank]
    track = data.track
    lines = (
        ()
        if track is None
        else (Line(flight=data.flight, time=track.time, east_m=track.east_m, north_m=track.north_m, up_m=track.up_m),)
    )
    return Export(
        name=data.flight,
        title=data.title,
        site=data.site,
        sets=(*_set("rss", rss), *_set("rank", rank)),
        lines=lines,
        clock=_clock([*(one.time for one in (*rss, *rank)), *(line.time for line in lines)]),
        synthetic=data.synthetic,
        attributes=_made(data.generated, data.versions),
    )


def _made(generated: str, versions: Mapping[str, str]) -> dict[str, str]:
    return {"generated": generated, "version": versions.get("aerpaw-cmp", "")}


def _clock(times: Iterable[AnyArray]) -> bool:
    """Whether the first known instant is a time of day."""
    known = [time[~np.isnat(time)] for time in times]
    first = [time.min() for time in known if len(time)]
    return bool(first) and has_wall_clock(min(first))


def _rounded(values: AnyArray) -> FloatArray:
    """As in the CSV, infinite values as missing."""
    rounded = np.round(np.asarray(values, dtype=np.float64), DECIMALS)
    return np.asarray(np.where(np.isfinite(rounded), rounded, np.nan))


def _times(time: AnyArray) -> AnyArray:
    return np.asarray(time, dtype="datetime64[ns]")


def _rss_series(flight: str, panel: RssPanel) -> Series:
    nowhere = np.full(len(panel.time), np.nan)
    values: dict[str, AnyArray] = {
        "measured_db": panel.measured_db,
        "calibrated_db": panel.calibrated_db,
        "simulated_dbm": panel.simulated_dbm,
        "residual_db": panel.residual_db,
        "measured_out_of_coverage": panel.measured_out_of_coverage,
        "simulated_out_of_coverage": panel.simulated_out_of_coverage,
        **{f"{one.name}_dbm": one.level_dbm for one in panel.baselines},
        **panel.per_sample,
    }
    return Series(
        flight=flight,
        tower=panel.tower,
        channel=panel.channel,
        unit=panel.unit,
        time=_times(panel.time),
        east_m=_rounded(nowhere if panel.east_m is None else panel.east_m),
        north_m=_rounded(nowhere if panel.north_m is None else panel.north_m),
        up_m=_rounded(nowhere if panel.up_m is None else panel.up_m),
        values={name: _rounded(one) for name, one in values.items()},
    )


def _rank_series(flight: str, panel: RankPanel) -> Series:
    values: dict[str, AnyArray] = {
        "measured_rank": panel.measured,
        **{f"simulated_rank_k{k_key(at.k)}": at.rank for at in panel.simulated},
        **panel.per_sample,
        **panel.values,
    }
    return Series(
        flight=flight,
        tower=panel.tower,
        channel="",
        unit="1",
        time=_times(panel.time),
        east_m=_rounded(panel.east_m),
        north_m=_rounded(panel.north_m),
        up_m=_rounded(panel.up_m),
        values={name: _rounded(one) for name, one in values.items()},
    )


# --- from a campaign ------------------------------------------------------------------------------------------------


def of_campaign(data: CampaignData) -> Export | None:
    """The samples of all flights under the reference setting; None where no flight could be read."""
    if data.site is None:
        return None
    rss = [_row_series(row) for row in data.reference_rows]
    rank = [_flown_series(one) for one in data.flown_ranks]
    lines = []
    for track in data.tracks:
        start = next((one.time[0] for one in (*rss, *rank) if one.flight == track.flight and len(one)), None)
        if start is not None:
            east, north, up = track.position_m.T
            time = start + _nanoseconds(track.time_s)
            lines.append(Line(flight=track.flight, time=time, east_m=east, north_m=north, up_m=up))
    return Export(
        name=data.name,
        title=data.title,
        site=data.site,
        sets=(*_set("rss", rss), *_set("rank", rank)),
        lines=tuple(lines),
        clock=_clock(one.time for one in (*rss, *rank)),
        synthetic=bool(data.synthetic),
        attributes=_made(data.generated, data.versions),
    )


def _nanoseconds(seconds: FloatArray) -> AnyArray:
    return np.round(seconds * 1e9).astype("timedelta64[ns]")


def _row_series(row: RssRow) -> Series:
    east, north, up = row.position_m.T
    placed = np.isfinite(row.position_m).all(axis=1)
    values: dict[str, AnyArray] = {
        "measured_db": row.measured_db,
        "calibrated_db": row.measured_db + row.offset_db,
        "simulated_dbm": row.simulated_dbm,
        "residual_db": row.residual_db,
        "measured_out_of_coverage": placed & ~np.isfinite(row.measured_db),
        "simulated_out_of_coverage": placed & ~np.isfinite(row.simulated_dbm),
    }
    return Series(
        flight=row.flight,
        tower=row.tower,
        channel=row.channel,
        unit=row.unit,
        time=np.datetime64(row.start_ns, "ns") + _nanoseconds(row.time_s),
        east_m=_rounded(east),
        north_m=_rounded(north),
        up_m=_rounded(up),
        values={name: _rounded(one) for name, one in values.items()},
    )


def _flown_series(one: FlownRank) -> Series:
    east, north, up = one.position_m.T
    values: dict[str, AnyArray] = {
        "measured_rank": one.rank,
        **{f"simulated_rank_k{k_key(k)}": rank for k, rank in one.simulated.items()},
    }
    return Series(
        flight=one.flight,
        tower=one.tower,
        channel="",
        unit="1",
        time=np.datetime64(one.start_ns, "ns") + _nanoseconds(one.time_s),
        east_m=_rounded(east),
        north_m=_rounded(north),
        up_m=_rounded(up),
        values={name: _rounded(rank) for name, rank in values.items()},
    )


# --- what several formats need --------------------------------------------------------------------------------------


def latitude_longitude(frame: SiteFrame, east_m: FloatArray, north_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """WGS84 latitude and longitude [deg] of positions (n,), NaN where a position is unknown."""
    known = np.isfinite(east_m) & np.isfinite(north_m)
    latitude, longitude = frame.to_geographic(np.where(known, east_m, 0.0), np.where(known, north_m, 0.0))
    return (
        np.where(known, np.round(latitude, DEGREE_DECIMALS), np.nan),
        np.where(known, np.round(longitude, DEGREE_DECIMALS), np.nan),
    )


def pieces(series: Series, rows: int = 20_000) -> Iterator[slice]:
    """Slices of a series that bound what a writer holds at once."""
    for start in range(0, len(series), rows):
        yield slice(start, min(start + rows, len(series)))


def iso_text(time: AnyArray) -> list[str]:
    """Instants (n,) as ISO 8601 in UTC with milliseconds, rounded; empty where unknown."""
    text = np.datetime_as_string((time + np.timedelta64(500_000, "ns")).astype("datetime64[ms]"), timezone="UTC")
    texts: list[str] = np.where(np.isnat(time), "", text).tolist()
    return texts


def xml_text(text: str) -> str:
    """Text for an XML element or attribute: characters that XML cannot hold as escapes."""
    from xml.sax.saxutils import escape

    return escape(one_line(text), {'"': "&quot;"})
