"""An entry, its scores and its refusals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.files import read_input
from aerpaw_cmp.common.jsonable import fields_of
from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.level import crps_normal, local_mean_db
from aerpaw_cmp.compare.receiver import constant_forecast, score_forecast
from aerpaw_cmp.jobs.referee import predicted_at, read_foreign, split_by_series

from .tasks import KEY, RANKS, SERIES, Bench

# Averaging window of ``rmse_4s_db`` [s].
WINDOW_S = 4.0

# Nominal coverage of the interval that is checked.
COVERAGE = 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelSeries:
    """Measured and predicted levels of one flight, tower and channel, in time order.

    Parameters
    ----------
    name : str
        ``flight tower.channel``.
    time_s : (n,)
    measured_db, level_db : (n,)
        Measured and predicted median [dB].
    sd_db : (n,), optional
        Standard deviation of the prediction [dB]. Without it no distribution is scored.
    own_offset : bool
        True if the series is scored after its mean error is subtracted.
    """

    name: str
    time_s: FloatArray
    measured_db: FloatArray
    level_db: FloatArray
    sd_db: FloatArray | None = None
    own_offset: bool = True

    @property
    def bias_db(self) -> float:
        """Mean of measured minus predicted [dB]."""
        return float(np.mean(self.measured_db - self.level_db))

    @property
    def error_db(self) -> FloatArray:
        """Measured minus predicted (n,), without the bias if the series has its own offset [dB]."""
        error = self.measured_db - self.level_db
        return np.asarray(error - error.mean() if self.own_offset else error)


def level_scores(series: Sequence[LevelSeries]) -> dict[str, float]:
    """Return the scores of one task: means over its series, so that long and short flights have the same weight.

    Parameters
    ----------
    series : sequence of LevelSeries
        At least one.

    Returns
    -------
    dict of str to float
        ``rmse_db, rmse_4s_db, bias_db`` (mean size of the offsets), ``crps_db, log_score, coverage_90`` (NaN without
        ``sd_db``), ``n``.
    """
    rows = [_series_scores(item) for item in series]
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "n"} | {
        "n": float(sum(row["n"] for row in rows))
    }


def _series_scores(s: LevelSeries) -> dict[str, float]:
    error = s.error_db
    slow = local_mean_db(s.time_s, s.measured_db, WINDOW_S) - local_mean_db(s.time_s, s.level_db, WINDOW_S)
    # the mean of local means differs from that of the samples and needs its own offset
    slow = slow - slow.mean() if s.own_offset else slow
    scores = {
        "rmse_db": float(np.sqrt(np.mean(error**2))),
        "rmse_4s_db": float(np.sqrt(np.mean(slow**2))),
        "bias_db": abs(s.bias_db),
        "crps_db": np.nan,
        "log_score": np.nan,
        "coverage_90": np.nan,
        "n": float(len(error)),
    }
    if s.sd_db is not None:
        scores["crps_db"] = float(crps_normal(error, s.sd_db).mean())
        scores["log_score"] = float(np.mean(0.5 * (error / s.sd_db) ** 2 + np.log(np.sqrt(2.0 * np.pi) * s.sd_db)))
        scores["coverage_90"] = float(np.mean(np.abs(error) <= ndtri(0.5 + COVERAGE / 2) * s.sd_db))
    return scores


LARGEST_ENTRY = 2**30

# Length of the blocks that are resampled [s].
BLOCK_S = 20.0
REPLICATES, SEED = 2000, 20240715


@dataclass(frozen=True, slots=True)
class Entry:
    """The predictions of one entrant: ``frame`` by :data:`KEY`, and its head (``entrant``, ``who``, ...)."""

    frame: pd.DataFrame
    head: Mapping[str, str]


def read_entry(path: Path, bench: Bench, tasks: Sequence[str]) -> Entry:
    """Read predictions.csv, or the CSV of ``report --against``. Both may have lines ``# key: value`` above the header.

    Raises
    ------
    InputError
        Unreadable, no table, columns missing, rows twice, values that are no numbers.
    """
    try:
        text = read_input(path, LARGEST_ENTRY, "a CSV of predictions").decode()
    except UnicodeDecodeError:
        raise InputError("not a text file", expected="a CSV of predictions in UTF-8", path=path) from None
    lines = text.splitlines()
    count = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    head = {k.strip(): v.strip() for k, _, v in (line[1:].partition(":") for line in lines[:count])}
    names = {name.strip().lower() for name in "".join(lines[count : count + 1]).split(",")}
    if "tower" in names and not {"task", "flight"} & names:
        return read_foreign_entry(path, bench, tasks, head)
    try:
        table = StringIO("\n".join(lines[count:]))
        frame = pd.read_csv(table, dtype=dict.fromkeys(KEY, str), keep_default_na=False, low_memory=False)
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise InputError(f"no table: {error}", expected=f"columns {', '.join(KEY)}, level_db", path=path) from None
    if absent := [name for name in KEY if name not in frame]:
        raise InputError(f"no column {absent[0]!r}", expected=f"columns {', '.join(KEY)}, level_db", path=path)
    values = [name for name in ("level_db", "sd_db", *RANKS) if name in frame]
    if not values or ("level_db" not in frame and not set(RANKS) <= set(frame)):
        raise InputError("no predictions", expected=f"level_db (and sd_db), or {', '.join(RANKS)}", path=path)
    for name in values:
        number = pd.to_numeric(frame[name].replace("", "nan"), errors="coerce")
        wrong = number.isna() & ~frame[name].astype(str).str.strip().str.lower().isin(["", "nan"])
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            text_of = f"{name} {str(frame[name].iloc[row])!r}"
            raise InputError(text_of, expected="a number", path=path, line=count + row + 2)
        frame[name] = number
    twice = frame.duplicated(KEY)
    if twice.any():
        row = int(np.flatnonzero(twice)[0])
        raise InputError(
            f"{int(twice.sum())} rows stand twice, {frame['flight'].iloc[row]} {frame['time'].iloc[row]} first",
            expected="one row per task, flight, tower, channel and time",
            path=path,
            line=count + row + 2,
        )
    return Entry(frame, head)


def read_foreign_entry(path: Path, bench: Bench, tasks: Sequence[str], head: Mapping[str, str]) -> Entry:
    """Match a CSV of ``report --against`` with the rows of the tasks, by time or else by position.

    A task that the file does not predict completely is left out, unless no task is complete.

    Raises
    ------
    InputError
        What :func:`~aerpaw_cmp.jobs.referee.read_foreign` refuses.
    """
    parts: list[pd.DataFrame] = []
    for task in tasks:
        spec = bench.manifest.tasks[task]
        wanted = RANKS if spec.kind == "rank" else ["level_db", "sd_db"]
        for flight in bench.tests(task):
            given = read_foreign(path, bench.flight(flight).data)
            for (tower, channel), rows in bench.table(task, flight).groupby(["tower", "channel"], sort=False):
                part = split_by_series(given.table, str(tower), "" if spec.kind == "rank" else str(channel))
                found, _ = predicted_at(
                    given, part, pd.to_datetime(rows["time"]).dt.tz_localize(None).to_numpy("datetime64[ns]"),
                    rows[["east_m", "north_m", "up_m"]].to_numpy(np.float64), rows["heading_deg"].to_numpy(np.float64),
                )  # fmt: skip
                # a loss has the reference of a level only where levels count about their mean error
                loss = given.quantity == "path_loss_db"
                level = np.full(len(rows), np.nan) if loss and not spec.own_offset else found["level"]
                values = found | {"level_db": level}
                parts.append(rows[KEY].assign(**{name: values[name] for name in wanted if name in values}))
                parts[-1]["known"] = np.isfinite(values.get(wanted[0], np.full(len(rows), np.nan)))
    frame = pd.concat(parts, ignore_index=True)
    complete = frame.groupby("task")["known"].transform("all")
    return Entry(frame[complete] if complete.any() else frame, head)


def check_training(bench: Bench, entry: Entry, tasks: Sequence[str]) -> None:
    """UsageError where the entrant declares a test file among what it was trained on."""
    declared = set(entry.head.get("trained_on", "").replace(",", " ").split())
    test_flights = [(task, flight) for task in tasks for flight in bench.manifest.tasks[task].test]
    for task, flight in test_flights if declared else ():
        files = [bench.manifest.files[name] for name in bench.logs_of(flight)]
        known = declared & {digest for file in files for digest in (file.sha256, *file.also)}
        if known and bench.manifest.tasks[task].own_offset:
            raise UsageError(
                f"trained on {flight}, a test flight of {task}",
                expected="predictions of a model that never saw the test flights",
                cause="'# trained_on:' at the top of the file names its SHA-256",
            )


def score_task(
    bench: Bench, task: str, entry: Entry, baselines: Mapping[str, Entry], *, accept_levels: bool = False
) -> dict[str, Any]:
    """Scores, intervals and counts of one task under stable names.

    Parameters
    ----------
    bench : Bench
    task : str
    entry : Entry
    baselines : mapping of str to Entry
        Whose RMSE is compared on the same blocks.
    accept_levels : bool
        Skip the test of sign and unit.

    Raises
    ------
    UsageError
        Rows missing, unknown rows, levels of the wrong sign or unit.
    """
    table = bench.rows(task)
    if bench.manifest.tasks[task].kind == "rank":
        return _score_rank(bench, task, _joined(task, table, entry, RANKS))
    series = _level_series(bench, task, table, entry)
    if not accept_levels:
        _check_levels(task, _joined(task, table, entry, ["level_db"]))
    answered = {n: b for n, b in baselines.items() if b is not entry and (b.frame["task"] == task).any()}
    peers = {name: _level_series(bench, task, table, peer) for name, peer in answered.items()}
    return {**level_scores(series), **intervals(series, peers)}


def _joined(task: str, table: pd.DataFrame, entry: Entry, values: Sequence[str]) -> pd.DataFrame:
    """The rows of the truth with the predictions beside them."""
    predicted = entry.frame[entry.frame["task"] == task]
    if absent := [name for name in values if name not in predicted]:
        raise UsageError(f"{task}: no column {absent[0]!r}", expected=f"{', '.join(values)} beside {', '.join(KEY)}")
    joined: pd.DataFrame = table.merge(predicted[[*KEY, *values]], on=KEY, how="left", validate="one_to_one")
    lost = ~np.isfinite(joined[list(values)]).all(axis=1)
    if lost.any():
        first = joined[lost].iloc[0]
        raise UsageError(
            f"{task}: {int(lost.sum())} of {len(joined)} rows have no prediction, first {first['flight']} "
            f"{first['tower']} {first['channel']} {first['time']}",
            expected="a number for every row of the template",
            cause="other times or channels, rows left out, or a flight that was not predicted",
        )
    return joined


def _level_series(bench: Bench, task: str, table: pd.DataFrame, entry: Entry) -> list[LevelSeries]:
    has_sd = "sd_db" in entry.frame and bool(entry.frame.loc[entry.frame["task"] == task, "sd_db"].notna().all())
    joined = _joined(task, table, entry, ["level_db", "sd_db"] if has_sd else ["level_db"])
    if has_sd and not (joined["sd_db"] > 0).all():
        raise UsageError(f"{task}: a standard deviation of {joined['sd_db'].min():g} dB", expected="sd_db above 0")
    own_offset = bench.manifest.tasks[task].own_offset
    return [
        LevelSeries(
            name=" ".join(map(str, name)),
            time_s=(pd.to_datetime(rows["time"]) - pd.to_datetime(rows["time"].iloc[0])).dt.total_seconds().to_numpy(),
            measured_db=rows["measured"].to_numpy(np.float64),
            level_db=rows["level_db"].to_numpy(np.float64),
            sd_db=rows["sd_db"].to_numpy(np.float64) if has_sd else None,
            own_offset=own_offset,
        )
        for name, rows in joined.groupby(SERIES, sort=False)
    ]


def _check_levels(task: str, joined: pd.DataFrame) -> None:
    """UsageError where levels rise with distance, or are spread as no dB are."""
    places = [joined[f"{axis}_m"] - joined[f"tower_{axis}_m"] for axis in ("east", "north", "up")]
    distance = np.log10(np.maximum(np.sqrt(sum(p**2 for p in places)), 1.0))
    spread, level = float(joined["level_db"].std()), joined["level_db"]
    if spread < 1e-9:
        return  # a constant is an honest model
    slope = float(np.polyfit(distance, level, 1)[0]) if float(distance.std()) > 1e-6 else 0.0
    measured = float(np.polyfit(distance, joined["measured"], 1)[0]) if float(distance.std()) > 1e-6 else 0.0
    if slope > 5.0 and measured < 0.0:
        raise UsageError(
            f"{task}: predicted levels rise by {slope:.0f} dB per decade of distance",
            expected="received levels, which fall",
            cause="path loss in place of a level; --accept-levels where it is meant",
        )
    if spread < 0.02 * float(joined["measured"].std()) or spread > 50.0 * float(joined["measured"].std()):
        raise UsageError(
            f"{task}: predicted levels are spread by {spread:.2g}, measured ones by {joined['measured'].std():.2g} dB",
            expected="dB",
            cause="milliwatts or amplitudes; --accept-levels where it is meant",
        )


def _score_rank(bench: Bench, task: str, joined: pd.DataFrame) -> dict[str, Any]:
    p = joined[RANKS].to_numpy(np.float64)
    if (p < 0.0).any() or not np.allclose(p.sum(axis=1), 1.0, atol=1e-3):
        raise UsageError(f"{task}: probabilities that do not add up to 1", expected=", ".join(RANKS))
    known = bench.rows(task, training=True)["measured"].to_numpy(np.float64)
    constant = constant_forecast(known) if len(known) else np.full(4, 0.25)
    decided = p.argmax(axis=1) + 1
    score = score_forecast(joined["measured"].to_numpy(np.float64), p / p.sum(axis=1)[:, None], decided, constant)
    return fields_of(score)


def block_of(series: LevelSeries) -> int:
    """Samples in :data:`BLOCK_S`, at least one."""
    n, span = len(series.time_s), float(np.ptp(series.time_s))
    return max(1, min(n, round(BLOCK_S * (n - 1) / span))) if span > 0.0 else 1


def bootstrap_means(columns: FloatArray, block: int, seed: int) -> FloatArray:
    """Return the column means (:data:`REPLICATES`, m) of circular resamples of blocks of rows (n, m)."""
    n, blocks = len(columns), -(-len(columns) // block)
    begin = np.random.default_rng(seed).integers(0, n, (REPLICATES, blocks))
    sums, last = (_block_sums(columns, length) for length in (block, n - (blocks - 1) * block))
    return np.asarray((sums[begin[:, :-1]].sum(axis=1) + last[begin[:, -1]]) / n)


def _block_sums(columns: FloatArray, length: int) -> FloatArray:
    """Return the sum of ``length`` rows from every start (n, m), on a circle."""
    running = np.zeros((len(columns) + length, columns.shape[1]))
    np.cumsum(np.concatenate([columns, columns[: length - 1]]), axis=0, out=running[1:])
    return np.asarray(running[length:] - running[:-length])


def rmse_replicates(series: Sequence[LevelSeries]) -> FloatArray:
    """Mean RMSE (replicates,) over series whose blocks of :data:`BLOCK_S` are drawn anew [dB].

    Blocks of one series are the same for every entrant, so differences of replicates are paired.
    """
    total = np.zeros(REPLICATES)
    for number, levels in enumerate(series):
        error = levels.error_db
        columns = np.column_stack([error**2, error])
        drawn = bootstrap_means(columns, block_of(levels), SEED + number)
        offset = drawn[:, 1] ** 2 if levels.own_offset else 0.0
        total += np.sqrt(np.maximum(drawn[:, 0] - offset, 0.0))
    return total / len(series)


def intervals(
    series: Sequence[LevelSeries], baselines: Mapping[str, Sequence[LevelSeries]]
) -> dict[str, tuple[float, float]]:
    """95 % intervals of the mean RMSE, and of its difference from each baseline [dB]."""
    replicates = rmse_replicates(series)
    spread = {"rmse_ci95_db": replicates}
    spread |= {
        f"difference_to_{name}_ci95_db": replicates - rmse_replicates(baseline) for name, baseline in baselines.items()
    }
    return {key: (float(np.quantile(v, 0.025)), float(np.quantile(v, 0.975))) for key, v in spread.items()}
