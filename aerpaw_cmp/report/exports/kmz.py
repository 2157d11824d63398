"""Tracks for Google Earth: coloured by level, residual and rank, with towers, legends and a time slider.

One folder per link and quantity; only the first is switched on. A stretch of one colour is one line with its time span;
the flown line is a ``gx:Track`` besides, which the time slider moves along. Out of coverage is grey. A long flight is
thinned, the extremes of every stretch kept, and the description says so.
"""

from __future__ import annotations

import io
import itertools
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...common.units import AnyArray, FloatArray, IntArray
from ...maps.export import CLASS_COLOURS, ZIP_DATE
from ..explorer import keep_extremes
from .samples import Column, Export, Series, iso_text, latitude_longitude, xml_text

POINTS = 24_000
"""Points of all coloured lines together: more, and Google Earth gets slow."""
TRACK_POINTS = 5_000
LEVELS = 10
"""Colours of a scale of numbers."""
OUT = CLASS_COLOURS[0]
"""Grey: no value."""


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
        number = np.clip(np.searchsorted(self.edges[1:-1], np.nan_to_num(values), side="right"), 0, None)
        return np.where(known, number, len(self.colours) - 1)


def write_kmz(export: Export, folder: Path) -> list[Path]:
    """``samples.kmz``."""
    shown = list(_shown(export))
    scales = {scale.key: scale for scale, _, _ in shown}
    budget = POINTS // max(1, len(shown))
    thinned = max((len(series) for _, _, series in shown), default=0) > budget
    body = [_towers(export), *_flown(export)]
    body += [
        _folder(export, scale, column, series, budget, visible=number == 0)
        for number, (scale, column, series) in enumerate(shown)
    ]
    words = [*export.remarks, "Lines stand at their height above the ground below."]
    if thinned:
        words.append(
            f"Thinned to about {budget} points per line, with the extremes of every stretch kept; all samples stand in "
            "rss.csv and rank.csv."
        )
    path = folder / "samples.kmz"
    document = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>'
        f"<name>{xml_text(export.title)}</name><open>1</open><description>{xml_text(' '.join(words))}</description>"
        f"{''.join(map(_styles, scales.values()))}{''.join(body)}</Document></kml>\n"
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in [
            ("doc.kml", document.encode()),
            *((_legend_name(s), _legend(s)) for s in scales.values()),
        ]:
            entry = zipfile.ZipInfo(name, ZIP_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    return [path]


# --- what is shown --------------------------------------------------------------------------------------------------

_LEVELS = {"calibrated_db": "Level measured", "simulated_dbm": "Level replayed", "residual_db": "Residual"}


def _shown(export: Export) -> Iterator[tuple[Scale, Column, Series]]:
    """Scale, column and series of each folder: levels share one scale, residuals another, ranks their classes."""
    rss, rank = export.set("rss"), export.set("rank")
    if rss is not None:
        levels = np.concatenate([s.values[c][np.isfinite(s.values[c])] for s in rss.series for c in tuple(_LEVELS)[:2]])
        apart = np.concatenate([np.abs(s.values["residual_db"]) for s in rss.series])
        scales = {"calibrated_db": _level_scale(levels), "residual_db": _residual_scale(apart[np.isfinite(apart)])}
        scales["simulated_dbm"] = scales["calibrated_db"]
        for series in rss.series:
            for column in rss.columns:
                if column.name in scales and column.name in series.values:
                    yield scales[column.name], column, series
    if rank is not None:
        classes = Scale(
            key="rank",
            title="Rank",
            colours=(*CLASS_COLOURS[1:5], OUT),
            labels=("rank 1", "rank 2", "rank 3", "rank 4", "no path or no report"),
        )
        for series in rank.series:
            for column in rank.columns:
                if column.name == "measured_rank" or column.name.startswith("simulated_rank_k"):
                    yield classes, column, series


def _level_scale(levels: FloatArray) -> Scale:
    """Steps of whole numbers between the 2nd and 98th percentile."""
    low, high = np.percentile(levels, [2, 98]) if len(levels) else (-100.0, -60.0)
    step = _round_step((high - low) / LEVELS)
    first = np.floor(low / step)
    edges = (first + np.arange(LEVELS + 1)) * step
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


# --- elements -------------------------------------------------------------------------------------------------------


def _styles(scale: Scale) -> str:
    """One line style per colour; KML writes alpha, blue, green, red."""
    return "".join(
        f'<Style id="{scale.key}{i}"><LineStyle><color>ff{c[5:7]}{c[3:5]}{c[1:3]}</color><width>4</width></LineStyle>'
        "</Style>"
        for i, c in enumerate(scale.colours)
    )


def _coordinates(export: Export, east_m: FloatArray, north_m: FloatArray, up_m: FloatArray) -> list[str]:
    latitude, longitude = latitude_longitude(export.site.frame, east_m, north_m)
    up = np.maximum(np.nan_to_num(up_m), 0.0)
    return [f"{a:.7f},{b:.7f},{h:.1f}" for a, b, h in zip(longitude, latitude, up, strict=True)]


def _towers(export: Export) -> str:
    places = [t.position_m for t in export.site.towers.values()]
    east, north, up = np.array(places, dtype=np.float64).reshape(-1, 3).T
    marks = "".join(
        f"<Placemark><name>{xml_text(name)}</name><Point><extrude>1</extrude>"
        f"<altitudeMode>relativeToGround</altitudeMode><coordinates>{at}</coordinates></Point></Placemark>"
        for name, at in zip(export.site.towers, _coordinates(export, east, north, up), strict=True)
    )
    return f"<Folder><name>Towers</name>{marks}</Folder>"


def _flown(export: Export) -> Iterator[str]:
    """The flown lines: with a clock as tracks that the time slider moves along."""
    for line in export.lines:
        known = np.flatnonzero(np.isfinite(line.east_m) & np.isfinite(line.north_m) & ~np.isnat(line.time))
        pick = known[keep_extremes([line.up_m[known]], TRACK_POINTS)] if len(known) else known
        if len(pick) < 2:
            continue
        at = _coordinates(export, line.east_m[pick], line.north_m[pick], line.up_m[pick])
        mode = "<altitudeMode>relativeToGround</altitudeMode>"
        if export.clock:
            times = "".join(f"<when>{time}</when>" for time in iso_text(line.time[pick]))
            places = "".join(f"<gx:coord>{one.replace(',', ' ')}</gx:coord>" for one in at)
            shape = f"<gx:Track>{mode}{times}{places}</gx:Track>"
        else:
            shape = f"<LineString>{mode}<coordinates>{' '.join(at)}</coordinates></LineString>"
        yield (
            f"<Placemark><name>Flown: {xml_text(line.flight)}</name><Style><LineStyle><color>99ffffff</color>"
            f"<width>2</width></LineStyle></Style>{shape}</Placemark>"
        )


def _folder(export: Export, scale: Scale, column: Column, series: Series, budget: int, *, visible: bool) -> str:
    """Lines of one link coloured by one quantity, and its legend."""
    shown = int(visible)
    what = _LEVELS.get(column.name, column.meaning)
    name = f"{series.flight}: {series.name}, {what}" if len(export.lines) > 1 else f"{series.name}, {what}"
    lines = "".join(_lines(export, scale, column, series, budget, shown))
    return (
        f"<Folder><name>{xml_text(name)}</name><visibility>{shown}</visibility>"
        f"<ScreenOverlay><name>legend</name><visibility>{shown}</visibility>"
        f"<Icon><href>{_legend_name(scale)}</href></Icon>"
        '<overlayXY x="0" y="1" xunits="fraction" yunits="fraction"/>'
        '<screenXY x="0.01" y="0.97" xunits="fraction" yunits="fraction"/>'
        f'<size x="0" y="0" xunits="pixels" yunits="pixels"/></ScreenOverlay>{lines}</Folder>'
    )


def _lines(export: Export, scale: Scale, column: Column, series: Series, budget: int, shown: int) -> Iterator[str]:
    values = series.values[column.name]
    known = np.flatnonzero(np.isfinite(series.east_m) & np.isfinite(series.north_m) & ~np.isnat(series.time))
    if len(known) < 2:
        return
    pick = known[keep_extremes([values[known]], budget)]
    at = _coordinates(export, series.east_m[pick], series.north_m[pick], series.up_m[pick])
    times, bins = iso_text(series.time[pick]), scale.bin_of(values[pick])
    starts = np.flatnonzero(np.concatenate([[True], bins[1:] != bins[:-1]]))
    for first, after in zip(starts, [*starts[1:], len(pick) - 1], strict=True):
        last = int(after)  # a line ends where the next begins, so that no gap shows
        if last <= first:
            continue
        number = int(bins[first])
        span = f"<TimeSpan><begin>{times[first]}</begin><end>{times[last]}</end></TimeSpan>" if export.clock else ""
        yield (
            f"<Placemark><name>{xml_text(_label(scale, column, values[pick[first:last]], number))}</name>"
            f"<visibility>{shown}</visibility>{span}<styleUrl>#{scale.key}{number}</styleUrl>"
            f"<LineString><altitudeMode>relativeToGround</altitudeMode><coordinates>{' '.join(at[first : last + 1])}"
            "</coordinates></LineString></Placemark>"
        )


def _label(scale: Scale, column: Column, values: AnyArray, number: int) -> str:
    """What a line's balloon says: its values, or the name of its class."""
    known = values[np.isfinite(values)]
    if scale.edges is None or not len(known):
        return scale.labels[number]
    low, high = known.min(), known.max()
    return (f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}") + f" {column.shown_unit}"


def _legend_name(scale: Scale) -> str:
    return f"legends/{scale.key}.png"


def _legend(scale: Scale) -> bytes:
    """PNG of the colours and what they mean."""
    return legend_png(scale.title, scale.colours, scale.labels)


def legend_png(title: str, colours: Sequence[str], labels: Sequence[str]) -> bytes:
    """A list of colours as PNG, drawn without touching pyplot's state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(2.6, 0.38 + 0.155 * len(colours)), dpi=110)
    FigureCanvasAgg(figure)
    figure.patch.set_alpha(0.9)
    figure.suptitle(title, fontsize=9, y=0.98, va="top")
    patches = [Patch(color=c, label=n) for c, n in zip(colours, labels, strict=True)]
    figure.legend(handles=patches, loc="lower left", fontsize=8, frameon=False, borderaxespad=0.3, labelspacing=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": "aerpaw-cmp"})
    return buffer.getvalue()
