"""The data of the linked views: what the page's script draws, as one block of packed arrays.

Every number of the page's script comes from here; it computes only what a span or a switch changes (offset, RMSE,
correlation and histograms of the chosen samples), by the same formulas as :mod:`aerpaw_cmp.compare`.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..common.units import BoolArray, FloatArray, IntArray
from ..logs.records import has_wall_clock
from ..site.scenes import drawn_buildings
from ..site.site import Site
from .canvas import seconds_since, spread_out, start_of
from .data import GEOMETRY, PosePaths, RankPanel, ReportData, RssPanel, tower_way
from .names import k_key
from .packed import PackedArrays
from .shapes import listed, outline, walls
from .words import pretty

POINTS = 50_000
"""Samples of all series together that the page holds; beyond them each series is thinned, extremes kept."""

TREES = 1500
TRACK_POINTS = 4000


def keep_extremes(values: Sequence[FloatArray], limit: int) -> IntArray:
    """Indices of at most about ``limit`` samples, with the smallest and largest of each array in each stretch.

    Parameters
    ----------
    values : sequence of (n,)
        Arrays whose extremes must stay; NaN counts as no extreme.
    limit : int
        Samples wanted.

    Returns
    -------
    (m,) int
        Rising; all of them when n <= limit.

    Examples
    --------
    >>> keep_extremes([np.array([0.0, 5.0, 1.0, 0.0, -7.0, 0.0])], 3).tolist()
    [0, 1, 4, 5]
    """
    n = len(values[0])
    if n <= limit:
        return np.arange(n)
    stretches = max(1, limit // (2 * len(values)))
    edges = np.linspace(0, n, stretches + 1).astype(np.int64)
    kept = [np.array([0, n - 1])]
    for array in values:
        low, high = np.nan_to_num(array, nan=np.inf), np.nan_to_num(array, nan=-np.inf)
        for start, stop in itertools.pairwise(edges):
            kept.append(np.array([start + low[start:stop].argmin(), start + high[start:stop].argmax()]))
    return np.unique(np.concatenate(kept))


def payload(data: ReportData, limit: int = POINTS) -> dict[str, Any]:
    """Everything the script needs, as plain values.

    Parameters
    ----------
    data : ReportData
    limit : int
        Samples of all series together.
    """
    start, arrays = start_of(data), PackedArrays()
    total = sum(len(p.time) for p in data.rss) + sum(len(p.time) for p in data.rank)

    def share(n: int) -> int:
        return n if total <= limit else max(200, limit * n // total)

    rss_settings = data.settings.get("rss") or {}
    return {
        "start": str(start.astype("datetime64[ms]")) if has_wall_clock(start) else "",
        "step_db": rss_settings.get("advanced", {}).get("step_db", 0.1),
        "span_db": list(rss_settings.get("span_db", (-50.0, 50.0))),
        "rss": [_rss(p, start, arrays, share(len(p.time))) for p in data.rss],
        "rank": [_rank(p, start, arrays, share(len(p.time))) for p in data.rank],
        "track": _track(data, start, arrays),
        "site": scene(data.site),
        "paths": [_paths(p, start) for p in data.paths],
        "packed": arrays.content(),
    }


def as_json(content: Mapping[str, Any]) -> str:
    """Text for a script element: no name can close it."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _place(panel: RssPanel | RankPanel, pick: IntArray, arrays: PackedArrays) -> dict[str, int]:
    """Places of the UAV, and those of a tower that moves."""
    names = {"east": panel.east_m, "north": panel.north_m, "up": panel.up_m}
    names |= {f"tower_{axis}": values for axis, values in tower_way(panel).items()}
    return {name: arrays.add(values[pick]) for name, values in names.items() if values is not None}


def _rss(panel: RssPanel, start: np.datetime64, arrays: PackedArrays, limit: int) -> dict[str, Any]:
    residual = panel.residual_db
    pick = keep_extremes([panel.measured_db, residual], limit) if len(panel.time) else np.arange(0)
    models = [{"name": "ray tracing", "offset": _number(panel.offset_db), "rmse": _number(panel.rmse_db),
               "level": arrays.add(panel.simulated_dbm[pick]), "learned_here": panel.training}]  # fmt: skip
    for one in panel.baselines:
        models.append({"name": pretty(one.name), "offset": _number(one.offset_db), "rmse": _number(one.rmse_db),
                       "level": arrays.add(one.level_dbm[pick])})  # fmt: skip
    geometry = [
        {"name": GEOMETRY[key].replace("\n", " "), "values": arrays.add(values[pick])}
        for key, values in panel.geometry.items()
        if key in GEOMETRY
    ]
    return {
        "name": panel.name,
        "tower": panel.tower,
        "unit": panel.unit,
        "of": len(panel.time),
        "time": arrays.add(seconds_since(panel.time, start)[pick], "f8"),
        **_place(panel, pick, arrays),
        "measured": arrays.add(panel.measured_db[pick]),
        "models": models,
        "geometry": geometry,
        **({} if panel.source is None else _source(panel, pick, arrays)),
    }


def _source(panel: RssPanel, pick: IntArray, arrays: PackedArrays) -> dict[str, Any]:
    """Where each sample stands in the logs: the files, and per sample its file and line."""
    assert panel.source is not None
    return {
        "files": list(panel.source.files),
        "file": arrays.add(panel.source.file[pick]),
        "line": arrays.add(panel.source.line[pick], "f8"),
    }


def _rank(panel: RankPanel, start: np.datetime64, arrays: PackedArrays, limit: int) -> dict[str, Any]:
    pick = keep_extremes([panel.measured], limit) if len(panel.time) else np.arange(0)
    return {
        "tower": panel.tower,
        "of": len(panel.time),
        "time": arrays.add(seconds_since(panel.time, start)[pick], "f8"),
        **_place(panel, pick, arrays),
        "measured": arrays.add(panel.measured[pick]),
        "best": _best(panel),
        "models": [{"name": f"K = {k_key(at.k)}", "rank": arrays.add(at.rank[pick])} for at in panel.simulated],
        "probability": [
            {"name": name, "values": arrays.add(np.asarray(values, dtype=np.float64)[pick])}
            for name, values in panel.values.items()
            if name.startswith("probability")
        ],
    }


def _best(panel: RankPanel) -> int:
    """Number of the K whose distribution comes nearest, shown first."""
    distance = [np.nan_to_num(at.total_variation, nan=np.inf) for at in panel.simulated]
    return int(np.argmin(distance)) if distance else 0


def _track(data: ReportData, start: np.datetime64, arrays: PackedArrays) -> dict[str, int] | None:
    track = data.track
    if track is None or not len(track.time):
        return None
    known: BoolArray = np.isfinite(track.east_m) & np.isfinite(track.north_m) & np.isfinite(track.up_m)
    pick = np.flatnonzero(known)[spread_out(int(known.sum()), TRACK_POINTS)]
    return {
        "time": arrays.add(seconds_since(track.time, start)[pick], "f8"),
        "east": arrays.add(track.east_m[pick]),
        "north": arrays.add(track.north_m[pick]),
        "up": arrays.add(track.up_m[pick]),
    }


def _paths(paths: PosePaths, start: np.datetime64) -> dict[str, Any]:
    return {
        "tower": paths.tower,
        "time": np.round(seconds_since(paths.time, start), 3).tolist(),
        "lines": [[[np.round(line, 1).tolist(), kind] for line, kind in lines] for lines in paths.lines],
    }


def scene(site: Site) -> dict[str, Any]:
    """Towers, buildings, trees and forests as plain lists, rounded to 0.1 m."""
    trees, pick = site.trees, spread_out(len(site.trees), TREES)
    columns = ("east_m", "north_m", "ground_m", "height_m", "crown_diameter_m", "crown_base_m")
    return {
        "name": site.name,
        "towers": [
            {"name": t.name, "at": listed([t.east_m, t.north_m, t.ground_m]), "top": round(float(t.position_m[2]), 2)}
            for t in site.towers.values()
        ],
        "buildings": [[listed(face) for face in walls(b)] for b in drawn_buildings(site)],
        "forests": [listed(outline(f.area)) for f in site.forests],
        "trees": listed(np.column_stack([getattr(trees, c)[pick] for c in columns])) if len(pick) else [],
    }


def plan_of(site: Site) -> dict[str, Any]:
    """:func:`scene` for a plan: no trees (foliage is in the levels), roofs alone of buildings."""
    whole = scene(site)
    return {**whole, "trees": [], "buildings": [faces[-1:] for faces in whole["buildings"]]}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
