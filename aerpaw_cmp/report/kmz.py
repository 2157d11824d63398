"""The file samples.kmz of a report: the samples along the flight for Google Earth and QGIS.

The tracks are coloured by level, residual and rank. There is one folder per link and quantity. When the file is opened,
only the first folder is visible. Samples out of coverage are grey. Maps over a grid are written by
:mod:`aerpaw_cmp.maps.export`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..common import kml
from ..common.geodesy import SiteFrame
from ..common.kml import xml_text
from ..common.units import AnyArray, FloatArray
from ..compare.result import RankResult, RssResult
from ..logs.records import has_wall_clock
from ..maps.export import Scale, class_scale, number_scale
from .canvas import keep_extremes
from .flight_data import ReportData, start_of
from .texts import iso_time, k_key

# Largest number of points of all coloured lines, because Google Earth becomes slow with more.
POINTS = 24_000
TRACK_POINTS = 5_000

_AIR = "<altitudeMode>relativeToGround</altitudeMode>"

RANKS = class_scale("rank", "Rank", ("Z", "rank 1", "rank 2", "rank 3", "rank 4"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Coloured:
    """A quantity along a link. The track is coloured by its ``values`` (n,). ``unit`` is empty for ranks."""

    name: str
    scale: Scale
    unit: str
    series: RssResult | RankResult
    values: FloatArray


def write_kmz(data: ReportData, folder: Path) -> Path:
    """Write ``samples.kmz``, and return its path."""
    shown, clock = list(coloured(data)), bool(has_wall_clock(start_of(data)))
    scales = {item.scale.key: item.scale for item in shown}
    budget = POINTS // max(1, len(shown))
    body = [*(_style(scale) for scale in scales.values()), _towers(data), _flown(data, clock=clock)]
    for number, item in enumerate(shown):
        lines = "".join(_lines(item, data.site.frame, budget, clock=clock, visible=number == 0))
        body.append(kml.folder(item.name, f"legends/{item.scale.key}.png", lines, visible=number == 0))
    legends = {name: picture for scale in scales.values() for name, picture in scale.legend().items()}
    words = " ".join(_remarks(data, shown, budget, clock=clock))
    return kml.write_archive(folder / "samples.kmz", data.title, words, "".join(body), legends)


def coloured(data: ReportData) -> Iterator[Coloured]:
    """Yield every link with each of its quantities. All levels share a colour scale, and all residuals share another.

    A rank of 0 means that there is no path.
    """
    every = [values for item in data.rss for values in (item.calibrated_db, item.simulated_dbm)]
    level = number_scale("level", "Level [dBm]", np.concatenate([np.zeros(0), *every]))
    apart = np.concatenate([np.zeros(0), *(item.residual_db for item in data.rss)])
    residual = number_scale("residual", "Measured minus replayed [dB]", apart, "RdBu_r", centred=True)
    for item in data.rss:
        quantities = (
            ("Level measured", level, "dBm", item.calibrated_db),
            ("Level replayed", level, "dBm", item.simulated_dbm),
            ("Residual", residual, "dB", item.residual_db),
        )
        for name, scale, unit, values in quantities:
            yield Coloured(name=f"{item.name}, {name}", scale=scale, unit=unit, series=item, values=values)
    for rank in data.rank:
        ranks: dict[str, Any] = {"Rank reported": rank.measured}
        ranks |= {f"Rank replayed, K = {k_key(k)}": simulated for k, simulated in rank.rank.items()}
        for name, numbers in ranks.items():
            each = np.asarray(numbers, dtype=np.float64)
            yield Coloured(name=f"{rank.tower}, {name}", scale=RANKS, unit="", series=rank, values=each)


def _remarks(data: ReportData, shown: list[Coloured], budget: int, *, clock: bool) -> Iterator[str]:
    yield "Lines are drawn at their height above the ground below. Grey means out of coverage or unknown."
    if not clock:
        yield "The logs have relative times and no origin, so the lines have no times."
    if data.synthetic:
        yield "The logs are synthetic: they were simulated, not measured."
    if max((len(item.values) for item in shown), default=0) > budget:
        yield (
            f"Thinned to about {budget} points per line, with minimum and maximum of every segment; all samples are in "
            "rss.csv and rank.csv."
        )


def _style(scale: Scale) -> str:
    """Return one KML line style per colour. The order in KML is alpha, blue, green, red."""
    return "".join(
        f'<Style id="{scale.key}{i}"><LineStyle><color>ff{c[5:7]}{c[3:5]}{c[1:3]}</color><width>4</width></LineStyle>'
        "</Style>"
        for i, c in enumerate(scale.colours)
    )


def _coordinates(frame: SiteFrame, position_m: FloatArray) -> list[str]:
    east, north, up = position_m.T
    latitude, longitude = frame.to_geographic(east, north)
    return kml.coordinates(longitude, latitude, up)


def _towers(data: ReportData) -> str:
    towers = data.site.towers.values()
    places = _coordinates(data.site.frame, np.array([tower.position_m for tower in towers]).reshape(-1, 3))
    marks = [kml.mark(tower.name, at, in_the_air=True) for tower, at in zip(towers, places, strict=True)]
    return f"<Folder><name>Towers</name>{''.join(marks)}</Folder>"


def _flown(data: ReportData, *, clock: bool) -> str:
    """Return the track as KML, with times if they are known. Empty if there are fewer than two positions."""
    if (track := data.track) is None:
        return ""
    known = np.flatnonzero(_placed(track.time, track.position_m))
    if len(known) < 2:
        return ""
    pick = known[keep_extremes([track.position_m[known, 2]], TRACK_POINTS)]
    at = _coordinates(data.site.frame, track.position_m[pick])
    if clock:
        times = "".join(f"<when>{time}</when>" for time in iso_time(track.time[pick]))
        places = "".join(f"<gx:coord>{item.replace(',', ' ')}</gx:coord>" for item in at)
        shape = f"<gx:Track>{_AIR}{times}{places}</gx:Track>"
    else:
        shape = f"<LineString>{_AIR}<coordinates>{' '.join(at)}</coordinates></LineString>"
    name, style = xml_text(data.flight), kml.line_style("99ffffff", 2)
    return f"<Placemark><name>Flown: {name}</name>{style}{shape}</Placemark>"


def _placed(time: AnyArray, position_m: FloatArray) -> AnyArray:
    """Return whether the time and the horizontal position of each sample are known (n,)."""
    return np.isfinite(position_m[:, :2]).all(axis=1) & ~np.isnat(time)


def _lines(item: Coloured, frame: SiteFrame, budget: int, *, clock: bool, visible: bool) -> Iterator[str]:
    """Yield the lines of a link. Each line has one colour."""
    known = np.flatnonzero(_placed(item.series.time, item.series.position_m))
    if len(known) < 2:
        return
    known = known[keep_extremes([item.values[known]], budget)]
    values = item.values[known]
    at = _coordinates(frame, item.series.position_m[known])
    times, bins = iso_time(item.series.time[known]), item.scale.bin_of(values)
    starts = np.flatnonzero(np.concatenate([[True], bins[1:] != bins[:-1]]))
    for first, after in zip(starts, [*starts[1:], len(known) - 1], strict=True):
        last = int(after)  # end a line at the first point of the next line to avoid a gap
        if last <= first:
            continue
        number = int(bins[first])
        span = f"<TimeSpan><begin>{times[first]}</begin><end>{times[last]}</end></TimeSpan>" if clock else ""
        head = f"<visibility>{int(visible)}</visibility>{span}"
        style = f"<styleUrl>#{item.scale.key}{number}</styleUrl>"
        yield kml.line(_label(item, values[first:last], number), at[first : last + 1], _AIR, head=head, style=style)


def _label(item: Coloured, values: FloatArray, number: int) -> str:
    """Return the text of a line: its values, or the name of its class."""
    known = values[np.isfinite(values)]
    if not item.unit or not len(known):
        return item.scale.labels[number]
    low, high = known.min(), known.max()
    return (f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}") + f" {item.unit}"
