"""metrics.json, rss.csv and rank.csv: finished numbers to JSON and tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ..common.content import KEY, union
from ..common.jsonable import fields_of, json_safe, named
from ..common.text import guarded
from ..common.units import FloatArray
from ..compare.result import APPLIED, GIVEN, ClockResult, EngineResult, RankResult, RssResult
from ..compare.statistics import Interval
from ..logs.records import has_wall_clock
from .flight_data import RANKS, ReportData
from .flight_words import audit_summary, cautions, offset_sentences, paragraph
from .page import RANK_COLUMNS, RSS_COLUMNS, about, merge
from .texts import iso_time, k_key

# 0.1 mm and 1e-4 dB: finer than any log, and the files stay readable.
DECIMALS = 4


def metrics(data: ReportData) -> dict[str, Any]:
    """The numbers of a report under their stable names; plain JSON values only.

    Keys keep one order: that of the report. ``extra_metrics`` of the data is merged in last, key by key.
    """
    rss: dict[str, dict[str, Any]] = {}
    for item in data.rss:
        rss.setdefault(item.tower, {})[item.channel] = _rss_metrics(item)
    pairs: dict[str, dict[str, Any]] = {}
    for pair in data.pairs:
        pairs.setdefault(pair.tower, {})[f"{pair.first} - {pair.second}"] = pair.score
    result: dict[str, Any] = {
        **named(data, "flight title synthetic settings"),
        "sentence": paragraph(data),
        "warnings": cautions(data),
        "antennas": data.antennas,
        "site": named(data.site, "name credit assumed"),
        "inputs": [
            named(f, "path sha256 reader lines accepted rejected blank role warnings")
            | ({"learned_on": f.learned_on} if f.learned_on else {})
            for f in data.inputs
        ],
        KEY: list(union(*(f.learned_on for f in data.inputs))),
        "rss": rss,
        "verdict": data.verdict,
        **named(data, "likely_cause next_step"),
        "offsets": offset_sentences(data.rss),
        "rank": {item.tower: _rank_metrics(item) for item in data.rank},
        "rt": None if data.engine is None else _engine_metrics(data.engine),
        **about(data),
        **({"ladder": data.ladder} if data.ladder else {}),
        "clock": {name: clock_metrics(clock) for name, clock in data.clocks.items()},
        **({} if data.serving is None else {"serving": data.serving.as_dict()}),
        **({"pairs": pairs} if pairs else {}),
    }
    safe: dict[str, Any] = json_safe(result)
    merge(safe, json_safe(data.extra_metrics))
    return safe


def _rss_metrics(series: RssResult) -> dict[str, Any]:
    score = series.score
    return {
        **named(score, "offset_db rmse_db n n_out_of_coverage"),
        "at_search_edge": score.at_edge,
        **named(score, "correlation rmse_ci95_db"),
        "offset_ci95_db": score.intervals.offset_db,
        "correlation_ci95": score.intervals.correlation,
        "n_effective": score.intervals.autocorrelation.n_effective,
        "lag_s": score.lag_s,
        "lag_verdict": series.clock_verdict,
        "unit": series.unit,
        "fitted": score.fitted_on_scored,
        "baselines": {name: named(model, "offset_db rmse_db") for name, model in series.baselines.items()},
        **fields_of(series.further),
    }


def clock_metrics(clock: ClockResult) -> dict[str, Any]:
    """``clock.<receiver>`` of metrics.json: numbers, verdict, whether applied, and the checks it rests on."""
    return {
        **clock.checks,
        **named(clock, "radio_minus_telemetry_s ci95_s verdict reason"),
        "applied": clock.applied in (APPLIED, GIVEN),
    }


def _histogram(share: FloatArray, intervals: Sequence[Interval]) -> dict[str, Any]:
    names = [str(rank) for rank in RANKS]
    return {
        "histogram": dict(zip(names, share, strict=True)),
        "histogram_ci95": dict(zip(names, intervals, strict=True)),
    }


def _rank_metrics(series: RankResult) -> dict[str, Any]:
    score = series.score
    simulated = {
        k_key(k): {
            **_histogram(fit.histogram, fit.histogram_ci95),
            **named(fit, "out_of_coverage agreement agreement_ci95 kappa total_variation total_variation_ci95"),
            "wasserstein": fit.wasserstein,
            "p_value": fit.p_histogram,
            "confusion": fit.confusion[1:],
        }
        for k, fit in score.simulated.items()
    }
    return {
        "measured": {
            **_histogram(score.histogram, score.histogram_ci95),
            "n": int(np.isfinite(series.measured).sum()),
            "n_no_csi": int((~np.isfinite(series.measured)).sum()),
        },
        "simulated": simulated,
        "best_k": score.best_k,
        "best_k_ci95": score.curve.best_k_interval,
        **further_numbers(series),
    }


def further_numbers(series: RssResult | RankResult) -> dict[str, Any]:
    """Numbers of a series that stand in a table of their own on the page, as JSON has them."""
    numbers: dict[str, Any] = {}
    if isinstance(series, RankResult):
        curve = series.score.curve
        numbers = {
            **named(series.score, "n n_effective n_no_csi"),
            "best_k_total_variation": curve.best_k_total_variation,
            "best_k_total_variation_ci95": curve.best_k_total_variation_interval,
            "stale": named(series.score.staleness, "verdict n_reports hold_s"),
        }
    safe: dict[str, Any] = json_safe(numbers | fields_of(series.further))
    return safe


def _engine_metrics(engine: EngineResult) -> dict[str, Any]:
    audit = engine.audit
    return {
        **named(engine, "engine links seconds paths left_out not_audited"),
        "audit": None
        if audit is None
        else {
            "summary": audit_summary(audit),
            **named(audit, "reference links missing_paths extra_paths rss_max_error_db"),
            "rank_disagreement": {k_key(k): v for k, v in audit.rank_disagreement.items()},
            "field": None if audit.fields is None else {**fields_of(audit.fields), "failed": audit.fields.failed},
            **named(audit, "seconds reference_seconds"),
        },
    }


def rss_csv(series: Sequence[RssResult]) -> Iterator[str]:
    """The text of rss.csv in pieces of bounded size."""
    return _text(rss_tables(series), RSS_COLUMNS)


def rank_csv(series: Sequence[RankResult]) -> Iterator[str]:
    """The text of rank.csv in pieces of bounded size."""
    return _text(rank_tables(series), RANK_COLUMNS)


# Times (n,) of a panel, and its further columns: arrays (n,), or one value for all rows.
_Table = tuple[Any, dict[str, Any]]

# Rows that are text at once.
_ROWS = 50_000


def rss_tables(series: Sequence[RssResult]) -> Iterator[_Table]:
    """Times and further columns of rss.csv by tower and channel, not yet rounded; what a series lacks is NaN."""
    models = list(dict.fromkeys(name for item in series for name in item.baselines))
    more = [_rss_columns(item) for item in series]
    names = dict.fromkeys(name for columns in more for name in columns)
    for panel, optional in zip(series, more, strict=True):
        nowhere = np.full(len(panel.time), np.nan)
        yield (
            panel.time,
            {
                **named(panel, "tower channel unit"),
                **_places(panel.position_m),
                **named(panel, "measured_db calibrated_db simulated_dbm residual_db"),
                "measured_out_of_coverage": panel.measured_out_of_coverage.astype(int),
                "simulated_out_of_coverage": panel.simulated_out_of_coverage.astype(int),
                **{f"{m}_dbm": panel.baselines[m].level_dbm if m in panel.baselines else nowhere for m in models},
                **{name: optional.get(name, nowhere) for name in names},
            },
        )


def _rss_columns(series: RssResult) -> dict[str, FloatArray]:
    """Columns that not every series has: stated intervals, the place of a moving tower."""
    return {
        **({} if series.stated is None else series.stated.columns(series.simulated_dbm)),
        **({} if series.tower_m is None else _places(series.tower_m, "tower_")),
    }


def _places(position_m: FloatArray, whose: str = "") -> dict[str, FloatArray]:
    """Columns of positions (n, 3)."""
    return dict(zip((f"{whose}east_m", f"{whose}north_m", f"{whose}up_m"), position_m.T, strict=True))


def rank_tables(series: Sequence[RankResult]) -> Iterator[_Table]:
    """Times and further columns of rank.csv by tower, not yet rounded; what a series lacks is empty."""
    import pandas as pd

    def integers(values: Any) -> Any:
        return pd.Series(values, dtype="float64").astype("Int64").array  # NaN becomes an empty cell, 2.0 becomes 2

    ks = sorted({k for item in series for k in item.rank})
    more = [_number_columns(item) for item in series]
    names = dict.fromkeys(name for columns in more for name in columns)
    for panel, optional in zip(series, more, strict=True):
        nowhere = np.full(len(panel.time), np.nan)
        yield (
            panel.time,
            {
                "tower": panel.tower,
                **_places(panel.position_m),
                "measured_rank": integers(panel.measured),
                **{f"simulated_rank_k{k_key(k)}": integers(panel.rank.get(k, nowhere)) for k in ks},
                **{name: optional.get(name, nowhere) for name in names},
            },
        )


def _number_columns(series: RankResult) -> dict[str, FloatArray]:
    """Numbers a receiver decides by; no path, a ratio of nothing and a vanishing singular value are empty cells."""
    columns = {"level_dbm": series.level_dbm, **({} if series.tower_m is None else _places(series.tower_m, "tower_"))}
    columns |= {f"sigma{i}_over_sigma1_db": ratio for i, ratio in enumerate(series.singular_ratio_db.T, start=2)}
    if series.probability is not None:
        columns |= {f"probability_rank{rank}": share for rank, share in enumerate(series.probability.T, start=1)}
    return {name: np.where(np.isfinite(values), values, np.nan) for name, values in columns.items()}


def _text(tables: Iterator[_Table], columns: Iterable[str]) -> Iterator[str]:
    """Tables below each other as CSV, some rows at a time: a day of samples as text would not fit into memory."""
    head = True
    for table in tables:
        for start in range(0, len(table[0]), _ROWS):
            rows = guarded(_rows(table, slice(start, start + _ROWS)))
            yield rows.to_csv(index=False, header=head, lineterminator="\n")
            head = False
    if head:
        yield ",".join(columns) + "\n"


def _rows(table: _Table, part: slice) -> Any:
    """Some rows of a table, rounded."""
    import pandas as pd

    time, columns = table
    parts = {name: value if isinstance(value, str) else value[part] for name, value in columns.items()}
    frame = pd.DataFrame({**_times(time, part), **parts}, index=range(len(time[part])))
    return frame.round(DECIMALS)


def _times(time: Any, part: slice) -> dict[str, Any]:
    """Columns ``time_utc`` and ``time_s`` of some rows; seconds count from the first instant of all."""
    instants = np.asarray(time, dtype="datetime64[ns]")
    known = instants[~np.isnat(instants)]
    if not len(known):
        return {"time_utc": "", "time_s": np.full(len(instants[part]), np.nan)}
    # of the whole table, not of these rows: a part must count as the one before it did
    first = known.min()
    seconds = (instants[part] - first) / np.timedelta64(1, "s")
    return {"time_utc": iso_time(instants[part]) if has_wall_clock(first) else "", "time_s": seconds}
