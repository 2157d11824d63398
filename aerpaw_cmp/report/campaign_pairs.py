"""Pairs of flights at the same places: all of them as a table, the telling ones and a summary for campaign.json."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from .campaign_data import CampaignData, RankPairing, Repeat

KEPT = 1000
"""Pairs of each kind that campaign.json lists; of more, those with the most places."""

TABLE = "pairs"
"""The file with all of them, less its ending."""


Pair = TypeVar("Pair", Repeat, RankPairing)


def telling(pairs: Sequence[Pair], most: int = KEPT) -> list[Pair]:
    """All pairs, or of more than ``most`` those with the most places, in their order."""
    chosen = sorted(range(len(pairs)), key=lambda i: (-pairs[i].n, i))[:most]
    return [pairs[i] for i in sorted(chosen)]


def by_link(pairs: Sequence[Repeat]) -> list[dict[str, Any]]:
    """Per tower and channel: pairs of flights, those that meet, their places, and how much they differ [dB]."""
    groups: dict[tuple[str, str], list[Repeat]] = {}
    for pair in pairs:
        groups.setdefault((pair.tower, pair.channel), []).append(pair)
    rows = []
    for (tower, channel), members in groups.items():
        meeting = [pair for pair in members if pair.n]
        rmse = np.array([pair.rmse_db for pair in meeting if np.isfinite(pair.rmse_db)])
        low, median, high = np.quantile(rmse, (0.1, 0.5, 0.9)).tolist() if len(rmse) else (float("nan"),) * 3
        rows.append(
            {
                "tower": tower,
                "channel": channel,
                "pairs": len(members),
                "meeting": len(meeting),
                "n": sum(pair.n for pair in meeting),
                "rmse_mean_db": float(rmse.mean()) if len(rmse) else float("nan"),
                "rmse_quantiles_db": {"10": low, "50": median, "90": high},
            }
        )
    return rows


def pair_frame(data: CampaignData) -> pd.DataFrame:
    """One row per pair of flights, tower and channel (``kind`` rss), or tower (``kind`` rank)."""
    rss = _columns(data.repeats, Repeat, {"rmse_ci95_db": ("rmse_low_db", "rmse_high_db")})
    rank = _columns(data.rank_repeats, RankPairing, {"kappa_ci95": ("kappa_low", "kappa_high")})
    frames = [pd.DataFrame({"kind": kind, **columns}) for kind, columns in (("rss", rss), ("rank", rank)) if columns]
    filled = [frame for frame in frames if len(frame)]
    table: pd.DataFrame = pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()
    return table


def _columns(items: Sequence[Any], kind: type, bounds: dict[str, tuple[str, str]]) -> dict[str, Any]:
    """Fields of records as columns; an interval becomes two."""
    columns: dict[str, Any] = {}
    for name in (field.name for field in dataclasses.fields(kind)):
        values = [getattr(item, name) for item in items]
        if name in bounds:
            for end, column in enumerate(bounds[name]):
                columns[column] = [float("nan") if value is None else value[end] for value in values]
        else:
            columns[name] = values
    return columns
