"""Tracks for Google Earth: coloured by level, residual and rank, with towers, legends and a time slider.

One folder per link and quantity; only the first is switched on. A stretch of one colour is one line with its time span;
the flown line is a ``gx:Track`` besides, which the time slider moves along. Out of coverage is grey. A long flight is
thinned, the extremes of every stretch kept, and the description says so.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...common import kml
from ...common.kml import CLASS_COLOURS, xml_text
from ...common.units import AnyArray, FloatArray, IntArray
from ..kit.canvas import keep_extremes
from ..names import iso_time
from .points import Column, Export, latitude_longitude

# Points of all coloured lines together: more, and Google Earth gets slow.
POINTS = 24_000
TRACK_POINTS = 5_000

_LEVELS = {"calibrated_db": "Level measured", "simulated_dbm": "Level replayed", "residual_db": "Residual"}
_AIR = "<altitudeMode>relativeToGround</altitudeMode>"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shown:
    """A link coloured by one quantity."""

    name: str
    column: Column
    scale: Scale
    rows: Any


def write_kmz(export: Export, folder: Path) -> list[Path]:
    """``samples.kmz``."""
    shown = list(_shown(export))
    scales = {item.scale.key: item.scale for item in shown}
    budget = POINTS // max(1, len(shown))
    body = [_towers(export), _flown(export)]
    for number, link in enumerate(shown):
        lines = "".join(_lines(link, budget, clock=export.clock, visible=number == 0))
        body.append(kml.folder(link.name, _legend_name(link.scale), lines, visible=number == 0))
    words = [*export.remarks, "Lines stand at their height above the ground below."]
    if max((len(item.rows) for item in shown), default=0) > budget:
        words.append(
            f"Thinned to about {budget} points per line, with minimum and maximum of every segment; all samples are in "
            "rss.csv and rank.csv."
        )
    path, text = folder / "samples.kmz", "".join([*map(_styles, scales.values()), *body])
    legends = {_legend_name(scale): _legend(scale) for scale in scales.values()}
    return [kml.write_archive(path, export.title, " ".join(words), text, legends)]


def _shown(export: Export) -> Iterator[_Shown]:
    for kind, scales in _scales_of(export).items():
        points = next(item for item in export.sets if item.kind == kind)
        columns = {c.name: c for c in points.columns}
        for (_, tower, channel, rows), (name, scale) in itertools.product(points.links(), scales.items()):
            if name.startswith("simulated_rank") and rows[name].isna().all():  # a K of other links
                continue
            shown = f"{tower} {channel}".strip() + f", {_LEVELS.get(name, columns[name].meaning)}"
            yield _Shown(name=shown, column=columns[name], scale=scale, rows=rows)


def _styles(scale: Scale) -> str:
    """One line style per colour; KML writes alpha, blue, green, red."""
    return "".join(
        f'<Style id="{scale.key}{i}"><LineStyle><color>ff{c[5:7]}{c[3:5]}{c[1:3]}</color><width>4</width></LineStyle>'
        "</Style>"
        for i, c in enumerate(scale.colours)
    )


def _towers(export: Export) -> str:
    marks = [
        kml.mark(name, kml.coordinates(np.array([longitude]), np.array([latitude]), np.array([up]))[0], in_the_air=True)
        for name, latitude, longitude, up in export.towers()
    ]
    return f"<Folder><name>Towers</name>{''.join(marks)}</Folder>"


def _flown(export: Export) -> str:
    """The flown line: with a clock as a track that the time slider moves along; nothing of less than two places."""
    if (line := export.track) is None:
        return ""
    known = np.flatnonzero(np.isfinite(line.east_m) & np.isfinite(line.north_m) & ~np.isnat(line.time))
    if len(known) < 2:
        return ""
    pick = known[keep_extremes([line.up_m[known]], TRACK_POINTS)]
    latitude, longitude = latitude_longitude(export.site.frame, line.east_m[pick], line.north_m[pick])
    at = kml.coordinates(longitude, latitude, line.up_m[pick])
    if export.clock:
        times = "".join(f"<when>{time}</when>" for time in iso_time(line.time[pick]))
        places = "".join(f"<gx:coord>{item.replace(',', ' ')}</gx:coord>" for item in at)
        shape = f"<gx:Track>{_AIR}{times}{places}</gx:Track>"
    else:
        shape = f"<LineString>{_AIR}<coordinates>{' '.join(at)}</coordinates></LineString>"
    name, style = xml_text(export.flight), kml.line_style("99ffffff", 2)
    return f"<Placemark><name>Flown: {name}</name>{style}{shape}</Placemark>"


def _lines(shown: _Shown, budget: int, *, clock: bool, visible: bool) -> Iterator[str]:
    """A link's lines, one a stretch of one colour."""
    rows = shown.rows[shown.rows["latitude_deg"].notna() & shown.rows["time"].notna()]
    if len(rows) < 2:
        return
    rows = rows.iloc[keep_extremes([rows[shown.column.name].to_numpy()], budget)]
    values = rows[shown.column.name].to_numpy()
    at = kml.coordinates(*(rows[name].to_numpy() for name in ("longitude_deg", "latitude_deg", "up_m")))
    times, bins = iso_time(rows["time"].to_numpy()), shown.scale.bin_of(values)
    starts = np.flatnonzero(np.concatenate([[True], bins[1:] != bins[:-1]]))
    for first, after in zip(starts, [*starts[1:], len(rows) - 1], strict=True):
        last = int(after)  # a line ends where the next begins, so that no gap shows
        if last <= first:
            continue
        number = int(bins[first])
        span = f"<TimeSpan><begin>{times[first]}</begin><end>{times[last]}</end></TimeSpan>" if clock else ""
        head = f"<visibility>{int(visible)}</visibility>{span}"
        style = f"<styleUrl>#{shown.scale.key}{number}</styleUrl>"
        name = _label(shown, values[first:last], number)
        yield kml.line(name, at[first : last + 1], _AIR, head=head, style=style)


def _label(shown: _Shown, values: AnyArray, number: int) -> str:
    """Text of a line's balloon: its values, or the name of its class."""
    known = values[np.isfinite(values)]
    if shown.scale.edges is None or not len(known):
        return shown.scale.labels[number]
    low, high = known.min(), known.max()
    return (f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}") + f" {shown.column.shown_unit}"


def _legend_name(scale: Scale) -> str:
    return f"legends/{scale.key}.png"


def _legend(scale: Scale) -> bytes:
    return kml.list_legend(scale.title, dict(zip(scale.labels, scale.colours, strict=True)))


# --- colours ---------------------------------------------------------------------------------------------------------

# Colours of a scale of numbers.
LEVELS = 10
# Grey: no value.
OUT = CLASS_COLOURS[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale:
    """Colours of one quantity: ``edges`` (m + 1,) between them, or none where its values are classes."""

    key: str
    title: str
    colours: tuple[str, ...]
    labels: tuple[str, ...]
    edges: FloatArray | None = None

    def bin_of(self, values: FloatArray) -> IntArray:
        """Number of each value's colour (n,); the last is out of coverage."""
        known = np.isfinite(values)
        if self.edges is None:
            number = np.clip(np.nan_to_num(values).astype(np.int64), 0, len(self.colours) - 2) - 1
            return np.where(known & (number >= 0), number, len(self.colours) - 1)
        number = np.searchsorted(self.edges[1:-1], np.nan_to_num(values), side="right")
        return np.where(known, number, len(self.colours) - 1)


RANKS = Scale(
    key="rank",
    title="Rank",
    colours=(*CLASS_COLOURS[1:5], OUT),
    labels=("rank 1", "rank 2", "rank 3", "rank 4", "no path or no report"),
)


def _scales_of(export: Export) -> dict[str, dict[str, Scale]]:
    """By kind and column: levels share one scale, residuals another, ranks their classes."""
    scales: dict[str, dict[str, Scale]] = {}
    for points in export.sets:
        names = {c.name for c in points.columns}
        by_column = {c: RANKS for c in names if c == "measured_rank" or c.startswith("simulated_rank_k")}
        levels = sorted(names & {"calibrated_db", "simulated_dbm"})
        if levels:
            values = points.table[levels].to_numpy().ravel()
            by_column |= dict.fromkeys(levels, _level_scale(values[np.isfinite(values)]))
        if "residual_db" in names:
            apart = np.abs(points.table["residual_db"].to_numpy())
            by_column["residual_db"] = _residual_scale(apart[np.isfinite(apart)])
        scales[points.kind] = {c.name: by_column[c.name] for c in points.columns if c.name in by_column}
    return scales


def _level_scale(levels: FloatArray) -> Scale:
    """Steps of whole numbers between the 2nd and 98th percentile."""
    low, high = np.percentile(levels, [2, 98]) if len(levels) else (-100.0, -60.0)
    step = _round_step((high - low) / LEVELS)
    edges = (np.floor(low / step) + np.arange(LEVELS + 1)) * step
    return _numbers("level", "Level [dBm]", edges, "viridis")


def _residual_scale(apart: FloatArray) -> Scale:
    """Symmetric about zero, to the 98th percentile of the size."""
    most = float(np.percentile(apart, 98)) if len(apart) else 5.0
    step = _round_step(2 * most / (LEVELS - 1))
    edges = (np.arange(LEVELS) - (LEVELS - 1) / 2) * step
    return _numbers("residual", "Measured minus replayed [dB]", edges, "RdBu_r")


def _round_step(step: float) -> float:
    """The next step up of 1, 2, 5 times a power of ten."""
    if not step > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(step))
    # a step that is 2 but for rounding must not become 5
    return float(next(m for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9)) * power)


def _numbers(key: str, title: str, edges: AnyArray, palette: str) -> Scale:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    count = len(edges) - 1
    colours = [to_hex(colormaps[palette]((i + 0.5) / count)) for i in range(count)]
    labels = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(edges)]
    labels[0], labels[-1] = f"below {edges[1]:g}", f"above {edges[-2]:g}"
    return Scale(
        key=key, title=title, colours=(*colours, OUT), labels=(*labels, "out of coverage"), edges=np.asarray(edges)
    )
