"""The columns of rss.csv and rank.csv: name, unit, meaning, and the function that computes the values.

:data:`RSS` and :data:`RANK` produce the CSV files, the NetCDF variables, the list of columns on a report's page and the
table in docs/outputs.md. A new column is one row here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..common.text import guarded
from ..common.units import FloatArray
from ..compare.result import RankResult, RssResult
from ..logs.records import has_wall_clock
from .texts import iso_time, k_key

# Positions are written to 0.1 mm and levels to 1e-4 dB, which is finer than any log.
DECIMALS = 4


@dataclass(frozen=True, slots=True)
class Column:
    """A column, or a family of columns. In the name and meaning of a family, {} is replaced by a model, K or rank.

    Parameters
    ----------
    name : str
    unit : str
        Unit in the usual notation. Empty for text, codes and shares.
    meaning : str
    values : callable, optional
        Function that returns the values (n,) of a series, one value for all its rows, or None if the series does not
        have the column. For a family it returns a mapping by model, K or rank. Columns of times have no function.
    optional : bool
        True if the column is missing in a file in which no series has it.
    """

    name: str
    unit: str
    meaning: str
    values: Callable[[Any], Any] | None = None
    optional: bool = False


_TIMES = (
    Column("time_utc", "", "ISO 8601, UTC; empty if the log has relative times without an origin"),
    Column("time_s", "s", "seconds after the first row of this tower and channel"),
)


def _tower_place(axis: int) -> Callable[[RssResult | RankResult], FloatArray | None]:
    return lambda series: None if series.tower_m is None else series.tower_m[:, axis]


_PLACES = (
    Column("east_m", "m", "UAV position, metres east of the site origin", lambda p: p.position_m[:, 0]),
    Column("north_m", "m", "metres north", lambda p: p.position_m[:, 1]),
    Column("up_m", "m", "metres above the ground at the origin", lambda p: p.position_m[:, 2]),
)
_TOWER_PLACES = (
    Column("tower_east_m", "m", "position of a tower that moves, metres east", _tower_place(0), optional=True),
    Column("tower_north_m", "m", "metres north", _tower_place(1), optional=True),
    Column("tower_up_m", "m", "metres above the ground at the origin", _tower_place(2), optional=True),
)


def _stated(name: str, unit: str, meaning: str) -> Column:
    """Return a column of the stated error of a prediction."""

    def values(series: RssResult) -> FloatArray | None:
        return None if series.stated is None else series.stated.columns(series.simulated_dbm)[name]

    return Column(name, unit, meaning, values, optional=True)


RSS: tuple[Column, ...] = (
    *_TIMES,
    Column("tower", "", "name of the tower", lambda p: p.tower),
    Column("channel", "", "name of the channel", lambda p: p.channel),
    Column("unit", "", "unit of measured_db", lambda p: p.unit),
    *_PLACES,
    Column("measured_db", "as logged", "as logged; empty: no signal", lambda p: p.measured_db),
    Column("calibrated_db", "dBm", "measured_db plus the offset of this tower and channel", lambda p: p.calibrated_db),
    Column("simulated_dbm", "dBm", "ray tracing; empty: no path", lambda p: p.simulated_dbm),
    Column("residual_db", "dB", "calibrated_db minus simulated_dbm", lambda p: p.residual_db),
    Column("measured_out_of_coverage", "", "1: the log has no signal here",
           lambda p: p.measured_out_of_coverage.astype(int)),
    Column("simulated_out_of_coverage", "", "1: the ray tracing has no path here",
           lambda p: p.simulated_out_of_coverage.astype(int)),
    Column("{}_dbm", "dBm", "level of the baseline {}",
           lambda p: {name: model.level_dbm for name, model in p.baselines.items()}, optional=True),
    _stated("simulated_sd_db", "dB", "standard deviation of a sample: all of the following parts"),
    _stated("gain_sd_db", "dB", "part of simulated_sd_db from the learned antennas"),
    _stated("own_sd_db", "dB", "part of simulated_sd_db from shadowing that differs between flights"),
    _stated("noise_sd_db", "dB", "part of simulated_sd_db from receiver noise"),
    _stated("fading_sd_db", "dB", "part of simulated_sd_db from fading"),
    _stated("simulated_low_dbm", "dBm", "lower end of the 90 % interval"),
    _stated("simulated_high_dbm", "dBm", "upper end of the 90 % interval"),
    *_TOWER_PLACES,
)  # fmt: skip


def _integers(values: Any) -> Any:
    """Return values as integers, so that they are written without decimals. NaN becomes an empty cell."""
    import pandas as pd

    return pd.Series(values, dtype="float64").astype("Int64").array


def _finite(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, np.nan)


RANK: tuple[Column, ...] = (
    *_TIMES,
    Column("tower", "", "name of the tower", lambda p: p.tower),
    *_PLACES,
    Column("measured_rank", "", "reported rank 1 to 4; empty: no CSI", lambda p: _integers(p.measured)),
    Column("simulated_rank_k{}", "", "rank by ray tracing, K = {}; 0: no path",
           lambda p: {k: _integers(rank) for k, rank in p.rank.items()}, optional=True),
    Column("level_dbm", "dBm", "simulated level; empty: no path", lambda p: _finite(p.level_dbm), optional=True),
    *_TOWER_PLACES,
    Column("sigma{}_over_sigma1_db", "dB", "singular value {} over the largest; empty: no path, or zero",
           lambda p: {i: _finite(ratio) for i, ratio in enumerate(p.singular_ratio_db.T, start=2)}, optional=True),
    Column("probability_rank{}", "", "probability of rank {} by the fitted receiver",
           lambda p: {i: _finite(share) for i, share in enumerate(() if p.probability is None else p.probability.T, 1)},
           optional=True),
)  # fmt: skip


def header(columns: Sequence[Column]) -> list[str]:
    """Return the names of the columns that are in every file."""
    return [column.name for column in columns if not column.optional]


def described(columns: Sequence[Column]) -> list[tuple[str, str, str]]:
    """Return name, unit and meaning of each column. In a family, an ellipsis replaces the model, K or rank."""
    return [(column.name.format("…"), column.unit, column.meaning.format("…")) for column in columns]


# --- tables ---------------------------------------------------------------------------------------------------------


def tables(columns: Sequence[Column], series: Sequence[Any]) -> tuple[list[Column], list[tuple[Any, dict[str, Any]]]]:
    """Compute the columns of some series without rounding. A column that only other series have is NaN.

    Parameters
    ----------
    columns : sequence of Column
        :data:`RSS` or :data:`RANK`.
    series : sequence of RssResult or RankResult

    Returns
    -------
    columns : list of Column
        Columns that any series has, with the members of each family.
    tables : list of (times, mapping)
        Times (n,) of each series, and its further columns by name: arrays (n,), or one value for all rows.
    """
    members: list[Column] = []
    rows: list[dict[str, Any]] = [{} for _ in series]
    for column in columns:
        if column.values is None:
            continue
        each = [_members(column.values(item)) for item in series]
        keys = list(dict.fromkeys(key for values in each for key in values))
        for key in keys if any(isinstance(key, str) for key in keys) else sorted(keys):
            text = key if isinstance(key, str) else k_key(key)
            name = column.name.format(text)
            members.append(replace(column, name=name, meaning=column.meaning.format(text)))
            for row, values, item in zip(rows, each, series, strict=True):
                row[name] = values[key] if key in values else np.full(len(item.time), np.nan)
    return members, [(item.time, row) for item, row in zip(series, rows, strict=True)]


def _members(values: Any) -> Mapping[Any, Any]:
    """Return values by model, K or rank. A single column has the key ""."""
    return values if isinstance(values, Mapping) else {} if values is None else {"": values}


# Number of rows per part.
_ROWS = 50_000


def csv_text(columns: Sequence[Column], series: Sequence[Any]) -> Iterator[str]:
    """Yield the text of rss.csv or rank.csv in parts, because a day of samples as text may not fit into memory."""
    import pandas as pd

    head = True
    for time, values in tables(columns, series)[1]:
        for start in range(0, len(time), _ROWS):
            part = slice(start, start + _ROWS)
            cells = {name: value if isinstance(value, str) else value[part] for name, value in values.items()}
            rows = pd.DataFrame({**_times(time, part), **cells}, index=range(len(time[part]))).round(DECIMALS)
            yield guarded(rows).to_csv(index=False, header=head, lineterminator="\n")
            head = False
    if head:
        yield ",".join(header(columns)) + "\n"


def _times(time: Any, part: slice) -> dict[str, Any]:
    """Return the columns ``time_utc`` and ``time_s`` of some rows. Seconds count from the first time of the table."""
    instants = np.asarray(time, dtype="datetime64[ns]")
    known = instants[~np.isnat(instants)]
    if not len(known):
        return {"time_utc": "", "time_s": np.full(len(instants[part]), np.nan)}
    # use the first time of the complete table, so that all parts have the same zero
    first = known.min()
    seconds = (instants[part] - first) / np.timedelta64(1, "s")
    return {"time_utc": iso_time(instants[part]) if has_wall_clock(first) else "", "time_s": seconds}
