"""The data of the campaign page's script: a number per flight, setting and link, and what the season says of them."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..common.units import FloatArray
from .campaign_data import CampaignData, FlownTrack, PlaceMap, Season, SettingRank
from .explorer import plan_of
from .map_explorer import ramp
from .packed import PackedArrays, step_for

MOST_ROWS = 200_000
"""Rows that the page holds; beyond them the settings that stand last in the ranking are left out, but the first of
campaign.yaml."""

TRACK_POINTS = 80
FINEST_DB = 0.01


def payload(data: CampaignData, most_rows: int = MOST_ROWS) -> dict[str, Any] | None:
    """Everything the script needs, as plain values; None where no flight gave a level.

    Parameters
    ----------
    data : CampaignData
        With its season (:func:`aerpaw_cmp.jobs.campaigns.season.with_season`).
    most_rows : int
    """
    kept, left_out = _settings_that_fit(data, most_rows)
    rows = [row for row in data.rss if row.setting in kept and np.isfinite(row.rmse_db)]
    if not rows:
        return None
    arrays = PackedArrays()
    flights = {name: i for i, name in enumerate(data.flights)}
    links = {link: i for i, link in enumerate(dict.fromkeys((row.tower, row.channel) for row in rows))}
    settings = {name: i for i, name in enumerate(kept)}
    columns = [np.array([getattr(row, name) for row in rows]) for name in ("rmse_db", "held_out_rmse_db", "offset_db")]
    step = step_for(np.concatenate(columns), FINEST_DB)
    own, held, offset = (arrays.add_steps(column, step) for column in columns)
    track_step = _track_step(data.tracks)
    messages = list(dict.fromkeys(f.message for f in data.failures))
    by_name = {f"{tower} {channel}".strip(): i for (tower, channel), i in links.items()}
    first = next((settings[r.setting] for r in data.season.over_all() if r.setting in settings), 0)
    return {
        "settings": list(kept),
        "changes": [_changes(data.settings[name]) for name in kept],
        "first": first,
        "reference": settings[data.reference],
        "flights": [_flight(data.season, name) for name in data.flights],
        "links": [{"tower": t, "channel": c, "name": f"{t} {c}".strip()} for t, c in links],
        "held_out": data.season.held_out,
        "ranked_by": "held" if data.season.held_out else "own",
        "step": step,
        "left_out": left_out,
        "rows": {
            "flight": arrays.add(np.array([flights[row.flight] for row in rows]), "u2"),
            "setting": arrays.add(np.array([settings[row.setting] for row in rows]), "u2"),
            "link": arrays.add(np.array([links[row.tower, row.channel] for row in rows]), "u2"),
            "own": own,
            "held": held,
            "offset": offset,
        },
        "ranking": [_ranked(r, settings, by_name) for r in data.season.ranking if r.setting in settings],
        "drift": [
            {
                "setting": settings[d.setting],
                "link": links[d.tower, d.channel],
                "spread": number(d.spread_db),
                "slope": number(d.slope_db_per_30_days),
                "ci": [number(v) for v in d.slope_ci95_db],
            }
            for d in data.season.drift
            if d.setting in settings and (d.tower, d.channel) in links
        ],
        "places": [_places(p, links, arrays, data.cell_m, step) for p in data.season.places],
        "cell_m": data.cell_m,
        "reach": reach_of(data.season.places),
        "track_step": track_step,
        "tracks": {flights[t.flight]: _track(t.position_m, arrays, track_step) for t in data.tracks},
        "failures": [[flights.get(f.flight, -1), f.setting, messages.index(f.message)] for f in data.failures],
        "messages": messages,
        "site": None if data.site is None else plan_of(data.site),
        "ramp": ramp("RdBu_r"),
        "packed": arrays.content(),
    }  # fmt: skip


def _settings_that_fit(data: CampaignData, most_rows: int) -> tuple[list[str], str]:
    """Settings whose rows the page can hold, in the order of campaign.yaml, and words on those left out."""
    counts: dict[str, int] = {}
    for row in data.rss:
        counts[row.setting] = counts.get(row.setting, 0) + 1
    order = list(dict.fromkeys([data.reference, *(r.setting for r in data.season.over_all()), *data.settings]))
    kept: set[str] = set()
    total = 0
    for name in order:
        total += counts.get(name, 0)
        if total > most_rows and kept:
            break
        kept.add(name)
    left = len(order) - len(kept)
    words = f"the {left} settings that stand last, of {len(order)}" if left else ""
    return [name for name in data.settings if name in kept], words


def _changes(overrides: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}: {value}" for key, value in overrides.items()) or "nothing changed"


def _flight(season: Season, name: str) -> dict[str, Any]:
    start = season.started.get(name)
    seconds = None if start is None else datetime.datetime.fromisoformat(start.replace("Z", "+00:00")).timestamp()
    return {"name": name, "t": None if seconds is None else 1000.0 * seconds, "href": season.reports.get(name)}


def _ranked(entry: SettingRank, settings: dict[str, int], links: dict[str, int]) -> dict[str, Any]:
    ci = entry.difference_ci95_db
    return {
        "setting": settings[entry.setting],
        "link": links[entry.link] if entry.link else -1,
        "n": entry.n_flights,
        "mean": entry.mean_db,
        "quantiles": list(entry.quantiles_db),
        "difference": number(entry.difference_db),
        "ci": None if ci is None or not np.isfinite(ci).all() else list(ci),
        "verdict": entry.verdict,
    }


def _places(
    place_map: PlaceMap, links: dict[tuple[str, str], int], arrays: PackedArrays, cell_m: float, step: float
) -> dict[str, int]:
    return {
        "link": links.get((place_map.tower, place_map.channel), -1) if place_map.tower else -1,
        "east": arrays.add(np.floor(place_map.east_m / cell_m), "i4"),
        "north": arrays.add(np.floor(place_map.north_m / cell_m), "i4"),
        "mean": arrays.add_steps(place_map.mean_db, step),
        "spread": arrays.add_steps(place_map.spread_db, step),
        "n": arrays.add(np.minimum(place_map.n, 65_535), "u2"),
    }


def reach_of(places: Sequence[PlaceMap]) -> float:
    """End of the colour scale [dB]: 98 % of the cells lie within."""
    values = np.abs(np.concatenate([p.mean_db for p in places])) if places else np.zeros(0)
    return float(max(np.percentile(values, 98), 0.1)) if len(values) else 1.0


def _track_step(tracks: Sequence[FlownTrack]) -> float:
    parts = [t.position_m[:, :2].ravel() for t in tracks]
    return step_for(np.concatenate(parts), 0.1) if parts else 0.1


def _track(position_m: FloatArray, arrays: PackedArrays, step: float) -> list[int]:
    """East and north of a flown line, thinned to what a map of a season shows."""
    good = position_m[np.isfinite(position_m[:, :2]).all(axis=1)]
    shown = good[np.unique(np.linspace(0, max(len(good) - 1, 0), TRACK_POINTS).astype(int))] if len(good) else good
    return [arrays.add_steps(shown[:, 0], step), arrays.add_steps(shown[:, 1], step)]


def number(value: float) -> float | None:
    """A number for JSON; None where there is none."""
    return float(value) if np.isfinite(value) else None
