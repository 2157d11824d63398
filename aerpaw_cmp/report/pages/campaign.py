"""campaign.html, campaign.json and campaign.csv, with the figures beside them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ...common.cells import guarded
from ...common.jsonable import fields_of, json_safe, named
from ..content.campaign import CampaignData, Repeat
from ..content.made import about
from ..figures import campaign as campaign_figures
from ..kit import canvas
from ..kit.canvas import Picture
from ..kit.files import json_text, write_file
from ..kit.page import rendered
from ..words import campaign as words
from ..words.flight import pretty

# Warnings that stand on the page at all.
MANY = 200

# Flights of a table that has a column or a heading for each.
_FEW_FLIGHTS = 20

# Rows of a table on the page; the files beside it hold all.
ROWS_SHOWN = 300

# From so many rows on campaign.json is written without indentation.
_COMPACT_ROWS = 2000

# Fields of a row that are samples, not numbers of a table.
ARRAYS = ("measured_db", "simulated_dbm", "position_m", "heading_deg")


def _entries(items: Iterable[Any], without: Sequence[str]) -> list[dict[str, Any]]:
    return [{f.name: getattr(x, f.name) for f in dataclasses.fields(x) if f.name not in without} for x in items]


def campaign_metrics(data: CampaignData) -> dict[str, Any]:
    """The numbers of the page under stable names; what does not exist is None."""
    failed = {f.flight for f in data.failures}
    result = {
        "campaign": data.name,
        **named(data, "title settings reference rank rank_transfers workers"),
        "flights": [
            {"flight": name, "ok": name not in failed, "synthetic": name in data.synthetic} for name in data.flights
        ],
        "failures": _entries(data.failures, ("traceback",)),
        "mean_rmse_db": words.mean_rmse(data),
        "likely_cause": fields_of(words.cause(data)),
        "rss": _entries(data.rss, (*ARRAYS, "difference")),
        "calibration": {"per": data.calibration, "groups": data.pooled},
        "repeatability": {
            **named(data, "radius_m heading_within_deg cell_m"),
            "pairs_total": len(data.repeats),
            "links": by_link(data.repeats),
            "pairs": telling(data.repeats),
            "table": _PAIR_TABLE if data.repeats else None,
        },
        "season": {
            **named(data.season, "held_out started ranking nodes"),
            "steps": words.step_words(data),
            "cells": 0 if data.season.places is None else len(data.season.places.cells),
        },
        **about(data),
    }
    safe: dict[str, Any] = json_safe(result)
    return safe


def _campaign_frame(data: CampaignData) -> pd.DataFrame:
    """One row per flight, setting, tower and channel (``kind`` rss) or K (``kind`` rank), and per failure."""
    rows = [
        {"kind": "rss", **cells(row), **{f"{name}_rmse_db": error for name, error in row.baselines.items()},
         "fitted": " ".join(row.fitted)}
        for row in data.rss
    ]  # fmt: skip
    rows += [{"kind": "rank", **cells(row)} for row in data.rank]
    rows += [{"kind": "failed", **cells(failure)} for failure in data.failures]
    frame: pd.DataFrame = pd.DataFrame(rows, columns=_CSV_COLUMNS)
    return frame


_CSV_COLUMNS = [
    "kind", "flight", "setting", "tower", "channel", "k", "offset_db", "offset_low_db", "offset_high_db", "rmse_db",
    "rmse_low_db", "rmse_high_db", "free_space_rmse_db", "two_ray_rmse_db", "pooled_offset_db", "pooled_rmse_db", "n",
    "n_out_of_coverage", "held_out_offset_db", "held_out_rmse_db", "correlation", "correlation_low", "correlation_high",
    "at_search_edge", "lag_s", "lag_verdict",
    "fitted", "total_variation", "total_variation_low", "total_variation_high", "agreement", "agreement_low",
    "agreement_high", "kappa", "wasserstein", "best_k", "message",
]  # fmt: skip


def _errors_of_pairs(data: CampaignData) -> list[tuple[Any, float, float]]:
    """Each pair of flights with the RMSE of both under the reference setting."""
    rmse = {row.key: row.rmse_db for row in data.reference_rows}

    def error(pair: Repeat, flight: str) -> float:
        return rmse.get((flight, pair.tower, pair.channel), float("nan"))

    return [(pair, error(pair, pair.first), error(pair, pair.second)) for pair in data.repeats]


def campaign_page(data: CampaignData, pictures: Sequence[Picture], files: Sequence[str]) -> str:
    """The whole page."""
    return rendered(
        "campaign",
        data=data,
        pictures=pictures,
        mean_rmse=words.mean_rmse(data),
        pair_errors=_errors_of_pairs(data),
        headline=words.headline(data),
        verdict=words.verdict(data),
        against_baselines=words.against_baselines,
        warnings=words.warnings(data),
        baselines=list(dict.fromkeys(name for row in data.rss for name in row.baselines)),
        rss_flights=words.rss_flights(data),
        pretty=pretty,
        files=files,
        season=data.season.over_all(),
        worst=words.worst_flights(data),
        worst_rows=sorted(data.rss, key=lambda r: -np.nan_to_num(r.rmse_db, nan=-1.0))[:ROWS_SHOWN]
        if len(data.rss) > ROWS_SHOWN
        else data.rss,
        few=words.FEW,
        many=MANY,
        few_flights=_FEW_FLIGHTS,
        rows_shown=ROWS_SHOWN,
    )


def write_campaign(data: CampaignData, folder: str | Path) -> list[Path]:
    """Write ``campaign.html``, ``campaign.json``, ``campaign.csv`` and ``figures/``; gives the files, page first.

    Pairs of flights at the same places stand in ``pairs.csv``, all of them; campaign.json has the telling ones.
    """
    folder = Path(folder)
    indent = 2 if len(data.rss) + len(data.rank) < _COMPACT_ROWS else None
    dates = [(n.node, *date) for n in data.season.nodes for date in zip(n.night, n.offset_db, strict=True)]
    tables = {
        "campaign.csv": _campaign_frame(data),
        _PAIR_TABLE: pd.DataFrame([cells(pair) for pair in data.repeats]),
        "offsets.csv": pd.DataFrame(dates, columns=["node", "date", "offset_db"]),
    }
    written = [write_file(folder / "campaign.json", json_text(campaign_metrics(data), indent))]
    for name, table in tables.items():
        if name == "campaign.csv" or len(table):
            written.append(write_file(folder / name, guarded(table).to_csv(index=False, lineterminator="\n")))
    specs = list(campaign_figures.figure_specs(data))
    drawn, pictures = canvas.write_figures(specs, folder / "figures", ("svg", "png"))
    page = write_file(folder / "campaign.html", campaign_page(data, drawn, [path.name for path in written]))
    return [page, *written, *pictures]


# --- pairs of flights at the same places -----------------------------------------------------------------------------

# Pairs that campaign.json lists; of more, those with the most places.
LISTED_PAIRS = 1000

# The file with all of them.
_PAIR_TABLE = "pairs.csv"


def telling(pairs: Sequence[Repeat], most: int = LISTED_PAIRS) -> list[Repeat]:
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
