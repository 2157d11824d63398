"""Results that only several flights together can give: shared offsets, repeatability, K chosen on the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...common.jsonable import named
from ...common.units import finite_mean
from ...compare.offset import Pooling, pooled_moments
from ...compare.statistics.passes import Pass, PassPair, PassTable
from ...report.content.campaign import CampaignData, PooledOffset, RankRow, RankTransfer, Repeat, RssRow


def pool_offsets(rows: Sequence[RssRow], per: Pooling) -> tuple[list[RssRow], list[PooledOffset]]:
    """Shared offsets of each setting, entered into the rows and listed by group."""
    pooled_rows: list[RssRow] = []
    groups: list[PooledOffset] = []
    for setting in dict.fromkeys(row.setting for row in rows):
        members = [row for row in rows if row.setting == setting]
        span = (min(r.span_db[0] for r in members), max(r.span_db[1] for r in members))
        fits = pooled_moments(
            {row.key: row.moments for row in members},
            per,
            span_db=span,
        )
        pooled = [
            dataclasses.replace(
                row, pooled_offset_db=fits[row.key].offset_db, pooled_rmse_db=fits[row.key].rmse_db
            )
            for row in members
        ]  # fmt: skip
        pooled_rows += pooled
        by_group: dict[str, list[RssRow]] = {}
        for row in pooled:
            by_group.setdefault(_group(row, per), []).append(row)
        groups += [_pooled(setting, name, some, fits) for name, some in by_group.items()]
    return pooled_rows, groups


def _group(row: RssRow, per: Pooling) -> str:
    joined = {"link": f"{row.flight} {row.link}", "all": "all"}
    return joined[per] if per in joined else str(getattr(row, per))


def _pooled(setting: str, name: str, rows: list[RssRow], fits: Mapping[Any, Any]) -> PooledOffset:
    offsets_db = np.array([row.offset_db for row in rows])
    offsets_db = offsets_db[np.isfinite(offsets_db)]
    nan = float("nan")
    return PooledOffset(
        setting=setting,
        group=name,
        members=tuple(f"{row.flight} {row.link}" for row in rows),
        offset_db=rows[0].pooled_offset_db,
        spread_db=float(offsets_db.std(ddof=1)) if len(offsets_db) > 1 else nan,
        range_db=(float(offsets_db.min()), float(offsets_db.max())) if len(offsets_db) else (nan, nan),
        own_rmse_db=finite_mean([row.rmse_db for row in rows]),
        pooled_rmse_db=finite_mean([row.pooled_rmse_db for row in rows]),
        at_search_edge=any(fits[row.key].at_edge for row in rows),
        units=tuple(dict.fromkeys(row.unit for row in rows)),
    )


def repeats(rows: Sequence[RssRow]) -> list[Repeat]:
    """Every pair of flights that share a tower and channel, of the rows of one setting, in their order."""
    passes = [
        Pass(
            **named(row, "flight position_m residual_db heading_deg"),
            link=f"{row.tower}\n{row.channel}",
            level_db=row.measured_db,
        )
        for row in rows
    ]
    rule = named(CampaignData, "radius_m heading_within_deg")
    pairs = PassTable(passes, CampaignData.cell_m).pairs(**rule)
    known = [int(np.isfinite(row.measured_db).sum()) for row in rows]
    ordered = sorted(pairs, key=lambda pair: (pair.first, pair.second))
    return [_repeat(pair, rows[pair.first], rows[pair.second], known[pair.first]) for pair in ordered]


def _repeat(pair: PassPair, first: RssRow, second: RssRow, known: int) -> Repeat:
    same = "n rmse_db rmse_ci95_db offset_db residual_rmse_db place_rmse_db place_correlation cells height_difference_m"
    return Repeat(
        tower=first.tower,
        channel=first.channel,
        first=first.flight,
        second=second.flight,
        share=pair.n / max(known, 1),
        single_db=pair.rmse_db / 2.0**0.5,
        **named(pair, same),
    )


def transfer_ranks(rows: Sequence[RankRow]) -> list[RankTransfer]:
    """K chosen on the other flights, for every flight that has others with the same tower and K."""
    out = []
    for setting, tower in dict.fromkeys((row.setting, row.tower) for row in rows):
        by: dict[str, dict[float, RankRow]] = {}
        for row in rows:
            if (row.setting, row.tower) == (setting, tower) and np.isfinite(row.total_variation):
                by.setdefault(row.flight, {})[row.k] = row
        for flight, fits in by.items():
            other_flights = [at for name, at in by.items() if name != flight]
            common = [k for k in fits if other_flights and all(k in at for at in other_flights)]
            if not common:
                continue
            chosen = min(common, key=lambda k: finite_mean([at[k].total_variation for at in other_flights]))
            best = min(fits, key=lambda k: fits[k].total_variation)
            out.append(
                RankTransfer(
                    setting=setting,
                    flight=flight,
                    tower=tower,
                    chosen_on=tuple(name for name in by if name != flight),
                    k=chosen,
                    total_variation=fits[chosen].total_variation,
                    kappa=fits[chosen].kappa,
                    own_k=best,
                    own_total_variation=fits[best].total_variation,
                )
            )
    return out
