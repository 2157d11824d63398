"""Data of the linked views of a report, as one block of packed arrays for the script of the page.

The script itself computes only the numbers of a selected segment (offset, RMSE, correlation and histograms), with the
formulas of :mod:`aerpaw_cmp.compare`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..common.jsonable import json_object
from ..common.units import IntArray, spread_out
from ..compare.level import PART_DB, RssComparison
from ..compare.offset import STEP_DB
from ..compare.result import ModelLevel, RankResult, RssResult
from ..logs.records import has_wall_clock
from .canvas import keep_extremes, seconds_since
from .charts import Chart
from .flight_data import GEOMETRY, PosePaths, ReportData, Source, start_of
from .flight_words import instants, nearest_k, pretty
from .packed import PackedArrays, packed, scene
from .texts import k_key

# Largest number of samples of all series on a page. Longer series are thinned, but retain their extremes.
POINTS = 50_000

TRACK_POINTS = 4000


def payload(data: ReportData, charts: Sequence[Chart] = (), limit: int = POINTS) -> dict[str, Any]:
    """Return all data of the script as plain values.

    Parameters
    ----------
    data : ReportData
    charts : sequence of Chart
    limit : int
        Largest number of samples of all series.
    """
    start, arrays = start_of(data), PackedArrays()
    total = sum(len(p.time) for p in data.rss) + sum(len(p.time) for p in data.rank)

    def share(n: int) -> int:
        # at least 200 samples, so that a short series is still recognisable next to a very long series
        return n if total <= limit else max(200, limit * n // total)

    rss_settings = data.settings.get("rss") or {}
    return {
        "start": str(start.astype("datetime64[ms]")) if has_wall_clock(start) else "",
        "step_db": STEP_DB,
        "span_db": list(rss_settings.get("span_db", (-50.0, 50.0))),
        "rss": [
            _rss(p, data.sources.get(p.name), start, arrays, share(len(p.time))) | _second_channel(data, p, start)
            for p in data.rss
        ],
        "rank": [_rank(p, start, arrays, share(len(p.time))) for p in data.rank],
        "track": _track(data, start, arrays),
        "site": scene(data.site),
        "paths": [_paths(p, start) for p in data.paths],
        "plots": [packed(chart.content, arrays) for chart in charts],
        "packed": arrays.content(),
    }


def _place(panel: RssResult | RankResult, pick: IntArray, arrays: PackedArrays) -> dict[str, int]:
    """Return the positions of the UAV, and of the tower if it moves."""
    ends = [("", panel.position_m), *([] if panel.tower_m is None else [("tower_", panel.tower_m)])]
    return {
        f"{whose}{axis}": arrays.add(places[pick])
        for whose, position_m in ends
        for axis, places in zip(AXES, position_m.T, strict=True)
    }


AXES = ("east", "north", "up")


def _rss(
    panel: RssResult, source: Source | None, start: np.datetime64, arrays: PackedArrays, limit: int
) -> dict[str, Any]:
    # also retain the extremes of the residual, because readers look for the largest errors
    pick = keep_extremes([panel.measured_db, panel.residual_db], limit)
    models = [{"name": "ray tracing", **_fit(panel.score), "level": arrays.add(panel.simulated_dbm[pick]),
               "learned_here": panel.training}]  # fmt: skip
    for name, baseline in panel.baselines.items():
        models.append({"name": pretty(name), **_fit(baseline), "level": arrays.add(baseline.level_dbm[pick])})
    geometry = [
        {"name": GEOMETRY[key], "values": arrays.add(values[pick])}
        for key, values in panel.geometry.items()
        if key in GEOMETRY
    ]
    channel = {
        "name": panel.name, "tower": panel.tower, "unit": panel.unit,
        "of": len(panel.time),
        "time": arrays.add(seconds_since(panel.time, start)[pick], "f8"),
        **_place(panel, pick, arrays),
        "measured": arrays.add(panel.measured_db[pick]),
        "models": models,
        "geometry": geometry,
    }  # fmt: skip
    if panel.stated is not None:
        band = panel.stated.columns(panel.simulated_dbm)
        channel["band"] = [arrays.add(band[f"simulated_{end}_dbm"][pick]) for end in ("low", "high")]
    if source is not None:
        channel |= {
            "files": list(source.files),
            "file": arrays.add(source.file[pick]),
            # a 32-bit float cannot store line numbers above 16 million
            "line": arrays.add(source.line[pick], "f8"),
        }
    return channel


def _second_channel(data: ReportData, panel: RssResult, start: np.datetime64) -> dict[str, Any]:
    """Return the second channel of a tower and the segments in which the channels differ, as in the paper's Fig. 15."""
    for pair in data.pairs:
        if pair.tower == panel.tower and panel.channel in (pair.first, pair.second):
            ends = [seconds_since(np.array(instants(pair.time, span)), start).tolist() for span in pair.score.spans]
            beside = pair.second if panel.channel == pair.first else pair.first
            return {"beside": f"{pair.tower} {beside}", "parted": ends, "parted_db": PART_DB}
    return {}


def _fit(model: RssComparison | ModelLevel) -> dict[str, float | None]:
    return json_object(offset=model.offset_db, rmse=model.rmse_db)


def _rank(panel: RankResult, start: np.datetime64, arrays: PackedArrays, limit: int) -> dict[str, Any]:
    pick = keep_extremes([panel.measured], limit)
    shares = [] if panel.probability is None else panel.probability.T
    best = nearest_k(panel)
    return {
        "tower": panel.tower,
        "of": len(panel.time),
        "time": arrays.add(seconds_since(panel.time, start)[pick], "f8"),
        **_place(panel, pick, arrays),
        "measured": arrays.add(panel.measured[pick]),
        "best": 0 if best is None else list(panel.rank).index(best),
        "models": [{"name": f"K = {k_key(k)}", "rank": arrays.add(rank[pick])} for k, rank in panel.rank.items()],
        "probability": [
            {"name": f"probability_rank{rank}", "values": arrays.add(share[pick])}
            for rank, share in enumerate(shares, start=1)
        ],
    }


def _track(data: ReportData, start: np.datetime64, arrays: PackedArrays) -> dict[str, int] | None:
    track = data.track
    if track is None or not len(track.time):
        return None
    known = np.flatnonzero(np.isfinite(track.position_m).all(axis=1))
    pick = known[spread_out(len(known), TRACK_POINTS)]
    position = {axis: arrays.add(place) for axis, place in zip(AXES, track.position_m[pick].T, strict=True)}
    return {"time": arrays.add(seconds_since(track.time, start)[pick], "f8"), **position}


def _paths(paths: PosePaths, start: np.datetime64) -> dict[str, Any]:
    return {
        "tower": paths.tower,
        "time": np.round(seconds_since(paths.time, start), 3).tolist(),
        "lines": [[[np.round(line, 1).tolist(), kind] for line, kind in lines] for lines in paths.lines],
    }
