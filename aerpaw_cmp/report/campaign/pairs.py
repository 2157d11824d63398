"""Pairs of flights at the same places: all of them as a table, the telling ones and a summary for campaign.json."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from ..campaign_data import CampaignData, RankPairing, Repeat

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
    kinds: dict[str, Sequence[Any]] = {"rss": data.repeats, "rank": data.rank_repeats}
    table: pd.DataFrame = pd.DataFrame([{"kind": kind, **cells(p)} for kind, pairs in kinds.items() for p in pairs])
    return table


def cells(record: Any) -> dict[str, Any]:
    """Fields of a record as cells of a table; an interval ``x_ci95`` becomes ``x_low`` and ``x_high``."""
    out: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if "ci95" in field.name:
            low, high = value or (float("nan"), float("nan"))
            out |= {field.name.replace("ci95", "low"): low, field.name.replace("ci95", "high"): high}
        else:
            out[field.name] = value
    return out
