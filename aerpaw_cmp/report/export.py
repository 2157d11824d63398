"""metrics.json, rss.csv and rank.csv: finished numbers to JSON and tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..common.cells import guarded
from ..common.jsonable import json_safe
from ..common.provenance import KEY, union
from ..logs.records import has_wall_clock
from .data import RANKS, Engine, Histogram, RankPanel, ReportData, RssPanel
from .names import RANK_COLUMNS, RSS_COLUMNS, iso_time, k_key
from .words import audit_summary

DECIMALS = 4
"""0.1 mm and 1e-4 dB: finer than any log, and the files stay readable."""


def metrics(data: ReportData) -> dict[str, Any]:
    """The numbers of a report under their stable names; plain JSON values only.

    Keys keep one order: that of the report. ``extra_metrics`` of the data is merged in last, key by key.
    """
    rss: dict[str, dict[str, Any]] = {}
    for panel in data.rss:
        rss.setdefault(panel.tower, {})[panel.channel] = _rss_metrics(panel)
    result: dict[str, Any] = {
        "flight": data.flight,
        "title": data.title,
        "generated": data.generated,
        "synthetic": data.synthetic,
        "site": {"name": data.site.name, "illustrative": data.site.illustrative},
        "versions": dict(sorted(data.versions.items())),
        "inputs": [
            _named(f, "path sha256 reader lines accepted rejected blank role warnings")
            | ({"learned_on": f.learned_on} if f.learned_on else {})
            for f in data.inputs
        ],
        KEY: list(union(*(f.learned_on for f in data.inputs))),
        "settings": json_safe(data.settings),
        "rss": rss,
        "rank": {panel.tower: _rank_metrics(panel) for panel in data.rank},
        "rt": None if data.engine is None else _engine_metrics(data.engine),
        "stages": {f"{name}_s": seconds for name, seconds in data.stages_s.items()},
        "warnings": list(data.warnings),
    }
    safe: dict[str, Any] = json_safe(result)
    merge(safe, json_safe(data.extra_metrics))
    return safe


def _named(record: Any, names: str) -> dict[str, Any]:
    """Fields of a record by name."""
    return {name: getattr(record, name) for name in names.split()}


def _rss_metrics(panel: RssPanel) -> dict[str, Any]:
    return {
        **_named(panel, "offset_db rmse_db n n_out_of_coverage at_search_edge correlation"),
        **_named(panel, "rmse_ci95_db offset_ci95_db correlation_ci95 n_effective lag_s lag_verdict unit fitted"),
        "baselines": {b.name: _named(b, "offset_db rmse_db") for b in panel.baselines},
        "variants": {v.name: _named(v, "offset_db rmse_db fitted") for v in panel.variants},
        **panel.extra,
    }


def _histogram(histogram: Histogram) -> dict[str, Any]:
    result: dict[str, Any] = {"histogram": dict(zip(map(str, RANKS), histogram.share, strict=True))}
    if histogram.low is not None and histogram.high is not None:
        pairs = zip(histogram.low, histogram.high, strict=True)
        result["histogram_ci95"] = {str(r): [low, high] for r, (low, high) in zip(RANKS, pairs, strict=True)}
    return result


def _rank_metrics(panel: RankPanel) -> dict[str, Any]:
    simulated = {
        k_key(at.k): {
            **_histogram(at.histogram),
            "out_of_coverage": at.n_out_of_coverage,
            **_named(at, "agreement agreement_ci95 kappa total_variation total_variation_ci95"),
            **_named(at, "wasserstein p_value confusion"),
        }
        for at in panel.simulated
    }
    return {
        "measured": {
            **_histogram(panel.histogram),
            "n": int(np.isfinite(panel.measured).sum()),
            "n_no_csi": int((~np.isfinite(panel.measured)).sum()),
        },
        "simulated": simulated,
        **_named(panel, "best_k best_k_ci95"),
        **panel.extra,
    }


def _engine_metrics(engine: Engine) -> dict[str, Any]:
    audit = engine.audit
    return {
        **_named(engine, "engine links seconds paths left_out"),
        **({} if engine.other_interactions is None else {"other_interactions": engine.other_interactions}),
        "audit": None
        if audit is None
        else {
            "summary": audit_summary(audit),
            **_named(audit, "reference links missing_paths extra_paths rss_max_error_db"),
            "rank_disagreement": {k_key(k): v for k, v in audit.rank_disagreement.items()},
            "field": None if audit.fields is None else audit.fields.as_dict(),
            **_named(audit, "seconds reference_seconds"),
        },
    }


def merge(into: dict[str, Any], other: Mapping[str, Any]) -> None:
    """Put ``other`` into ``into``, key by key; what is only in ``into`` stays."""
    for key, value in other.items():
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            merge(into[key], value)
        else:
            into[key] = value


def rss_frame(panels: Iterable[RssPanel]) -> Any:
    """All RSS samples as one table with the columns of :data:`RSS_COLUMNS` and one per baseline."""
    return _whole(rss_tables(list(panels)), RSS_COLUMNS)


def rss_csv(panels: Iterable[RssPanel]) -> Iterator[str]:
    """The text of :func:`rss_frame` in pieces of bounded size."""
    return _text(rss_tables(list(panels)), RSS_COLUMNS)


def rank_frame(panels: Iterable[RankPanel]) -> Any:
    """All rank samples as one table with the columns of :data:`RANK_COLUMNS` and one per K."""
    return _whole(rank_tables(list(panels)), RANK_COLUMNS)


def rank_csv(panels: Iterable[RankPanel]) -> Iterator[str]:
    """The text of :func:`rank_frame` in pieces of bounded size."""
    return _text(rank_tables(list(panels)), RANK_COLUMNS)


_Table = tuple[Any, dict[str, Any]]
"""Times (n,) of a panel, and its further columns: arrays (n,), or one value for all rows."""

_ROWS = 50_000
"""Rows that are text at once."""


def rss_tables(panels: list[RssPanel]) -> Iterator[_Table]:
    """Times and further columns of rss.csv by panel, not yet rounded."""
    names = list(dict.fromkeys(b.name for panel in panels for b in panel.baselines))
    further = list(dict.fromkeys(name for panel in panels for name in panel.per_sample))
    for panel in panels:
        nowhere = np.full(len(panel.time), np.nan)
        columns: dict[str, Any] = {
            "tower": panel.tower,
            "channel": panel.channel,
            "unit": panel.unit,
            "east_m": nowhere if panel.east_m is None else panel.east_m,
            "north_m": nowhere if panel.north_m is None else panel.north_m,
            "up_m": nowhere if panel.up_m is None else panel.up_m,
            "measured_db": panel.measured_db,
            "calibrated_db": panel.calibrated_db,
            "simulated_dbm": panel.simulated_dbm,
            "residual_db": panel.residual_db,
            "measured_out_of_coverage": panel.measured_out_of_coverage.astype(int),
            "simulated_out_of_coverage": panel.simulated_out_of_coverage.astype(int),
        }
        levels = {b.name: b.level_dbm for b in panel.baselines}
        columns.update({f"{name}_dbm": levels.get(name, nowhere) for name in names})
        columns.update({name: panel.per_sample.get(name, nowhere) for name in further})
        yield panel.time, columns


def rank_tables(panels: list[RankPanel]) -> Iterator[_Table]:
    """Times and further columns of rank.csv by panel, not yet rounded."""
    import pandas as pd

    def integers(values: Any) -> Any:
        return pd.Series(values, dtype="float64").astype("Int64").array  # NaN becomes an empty cell, 2.0 becomes 2

    ks = sorted({at.k for panel in panels for at in panel.simulated})
    further = list(dict.fromkeys(name for panel in panels for name in panel.per_sample))
    values = list(dict.fromkeys(name for panel in panels for name in panel.values))
    for panel in panels:
        columns: dict[str, Any] = {
            "tower": panel.tower,
            "east_m": panel.east_m,
            "north_m": panel.north_m,
            "up_m": panel.up_m,
            "measured_rank": integers(panel.measured),
        }
        ranks = {at.k: at.rank for at in panel.simulated}
        for k in ks:
            columns[f"simulated_rank_k{k_key(k)}"] = integers(ranks.get(k, np.full(len(panel.time), np.nan)))
        nowhere = np.full(len(panel.time), np.nan)
        columns.update({name: integers(panel.per_sample.get(name, nowhere)) for name in further})
        # no path: no level, and a ratio of nothing; a vanishing singular value is an empty cell, too
        seen = {name: panel.values.get(name, nowhere) for name in values}
        columns.update({name: np.where(np.isfinite(v), v, np.nan) for name, v in seen.items()})
        yield panel.time, columns


def _whole(tables: Iterator[_Table], columns: Iterable[str]) -> Any:
    """Tables below each other, rounded; without any, the bare columns."""
    import pandas as pd

    frames = [_rows(table, slice(None)) for table in tables]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=list(columns))


def _text(tables: Iterator[_Table], columns: Iterable[str]) -> Iterator[str]:
    """The same as CSV, some rows at a time: a day of samples as text would not fit into memory."""
    head = True
    for table in tables:
        for start in range(0, len(table[0]), _ROWS):
            rows = guarded(_rows(table, slice(start, start + _ROWS)))
            yield rows.to_csv(index=False, header=head, lineterminator="\n")
            head = False
    if head:
        yield _whole(iter(()), columns).to_csv(index=False, lineterminator="\n")


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
    first = known.min()
    seconds = (instants[part] - first) / np.timedelta64(1, "s")
    return {"time_utc": iso_time(instants[part]) if has_wall_clock(first) else "", "time_s": seconds}


def write_file(path: Path, content: str | bytes | Iterator[str]) -> Path:
    """Write one file of a folder of results; its own folder is made when missing, but not that one's parent.

    Text may come in pieces.

    The set becomes whole, and errors become messages, in :class:`~aerpaw_cmp.common.outputs.OutputFolder`.
    """
    path.parent.mkdir(exist_ok=True)
    pieces = iter([content]) if isinstance(content, (str, bytes)) else content
    with path.open("wb") as file:
        for piece in pieces:
            file.write(piece.encode("utf-8") if isinstance(piece, str) else piece)
    return path
