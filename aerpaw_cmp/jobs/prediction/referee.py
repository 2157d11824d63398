"""Predictions of other programs beside ours and the baselines, scored on one flight by one card.

``report flight.yaml --against FILE``. Samples are matched to predictions by time where the file has times, else by
position. Every model is scored on the samples that the file predicts, so that the cards can be compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from ...common.counting import counted
from ...common.errors import InputError
from ...common.jsonable import fields_of
from ...common.outputs import file_digest
from ...common.units import BoolArray, FloatArray, IntArray
from ...compare.rank import agreement, cohen_kappa, histogram, total_variation
from ...compare.ranks.forecast import score_forecast
from ...compare.referee import LevelCard, PredictedLevel, detection_floor_db, level_card, measured_thresholds
from ...compare.result import BASELINE_TITLE, FlightResult, RankResult, RssResult
from ...compare.statistics.intervals import PairedDifference, paired_difference
from ...flight.data import FlightData
from .foreign import RANKS, ForeignPrediction, split_by_series

# A sample is scored by the nearest predicted position within this distance [m], if no option says otherwise.
NEAR_M = 5.0

# A sample is scored by the nearest predicted time within this [s], and at least half of the prediction's step.
_NEAR_S = 0.5

# Fewer matched samples get no card.
FEWEST = 20

OURS = "ray tracing (this report)"


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesVerdict:
    """The cards of one tower and channel.

    Parameters
    ----------
    tower, channel, unit : str
    matched, unmatched : int
        Samples of the flight with and without a prediction nearby.
    cards : mapping of str to LevelCard
        The prediction first, then ours and the baselines, on the same samples.
    differences : mapping of str to PairedDifference
        RMSE of the prediction minus that of ours and of each baseline, each after one offset, with its interval.
    floor_db : float, optional
        Detection floor that the predicted levels show (an emulated receiver).
    """

    tower: str
    channel: str
    unit: str
    matched: int
    unmatched: int
    cards: Mapping[str, LevelCard]
    differences: Mapping[str, PairedDifference]
    floor_db: float | None = None

    @property
    def name(self) -> str:
        """Tower and channel as one label."""
        return f"{self.tower} {self.channel}".strip()


@dataclass(frozen=True, slots=True, kw_only=True)
class RankVerdict:
    """Predicted ranks of one tower beside ours, on the same samples.

    ``scores`` has kappa, total variation and agreement by model; ``log_score`` and ``constant_log_score`` are those of
    probabilities, if the prediction has them.
    """

    tower: str
    matched: int
    unmatched: int
    scores: Mapping[str, Mapping[str, float]]
    log_score: float | None = None
    constant_log_score: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """One prediction against one flight."""

    name: str
    sha256: str
    program: str
    series: tuple[SeriesVerdict, ...]
    ranks: tuple[RankVerdict, ...] = ()
    remarks: tuple[str, ...] = ()
    fitted_here: tuple[str, ...] = field(default=("the offset of each model and channel",))

    def metrics(self) -> dict[str, Any]:
        """Return the entry of ``referee`` in metrics.json and of card.json."""
        levels: dict[str, dict[str, Any]] = {}
        for item in self.series:
            levels.setdefault(item.tower, {})[item.channel] = {
                "unit": item.unit,
                "matched": item.matched,
                "unmatched": item.unmatched,
                "floor_db": item.floor_db,
                "cards": {name: fields_of(card) for name, card in item.cards.items()},
                "differences": {name: fields_of(pair) for name, pair in item.differences.items()},
            }
        ranks = {item.tower: fields_of(item) for item in self.ranks}
        return {
            "prediction": self.name,
            "sha256": self.sha256,
            "program": self.program,
            "fitted_on_this_flight": list(self.fitted_here),
            "sentence": self.sentence(),
            "remarks": list(self.remarks),
            "means": self.means(),
            "levels": levels,
            "rank": ranks,
            "table": {"columns": list(TABLE), "rows": [list(row.values()) for row in self.rows()]},
        }

    def means(self) -> list[dict[str, Any]]:
        """Return the means over channels of each model; None for a number that not every channel has."""
        rows = []
        for model in dict.fromkeys(name for item in self.series for name in item.cards):
            cards = [item.cards[model] for item in self.series if model in item.cards]
            row: dict[str, Any] = {"model": model, "channels": len(cards)}
            for key in ("bias_db", "rmse_db", "rmse_offset_db", "rmse_1s_db", "crps_db", "coverage_90"):
                values = [getattr(card, key) for card in cards]
                row[key] = None if None in values else float(np.mean(values))
            rows.append(row)
        return rows

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield one row per series and model for terminal, page and card.json, under the heads of :data:`TABLE`."""
        for item in self.series:
            for name, card in item.cards.items():
                pair = item.differences.get(name)
                low, high = (None, None) if pair is None else pair.difference_ci95_db
                yield dict(
                    zip(
                        TABLE,
                        (
                            item.name, name, card.n, card.bias_db, card.rmse_db, card.rmse_offset_db, card.rmse_1s_db,
                            card.correlation, card.crps_db, card.coverage_90,
                            None if pair is None else pair.difference_db, low, high,
                        ),
                        strict=True,
                    )
                )  # fmt: skip

    def sentence(self) -> str:
        """Return the result in two sentences: error beside ours, and whether the difference is significant."""
        if not self.series:
            return f"{self.name}: ranks only."
        mean = {name: float(np.mean([s.cards[name].rmse_offset_db for s in self.series])) for name in (self.name, OURS)}
        pairs = [s.differences[OURS] for s in self.series]
        words = {kind: sum(p.verdict == kind for p in pairs) for kind in ("better", "worse")}
        decided = " and ".join(f"significantly {kind} on {n}" for kind, n in words.items() if n)
        unit = counted(len(self.series), "channel")
        matched, every = (sum(getattr(s, key) for s in self.series) for key in ("matched", "unmatched"))
        return (
            f"{self.name}: RMSE {mean[self.name]:.1f} dB after one offset per channel, ray tracing {mean[OURS]:.1f} dB "
            f"on the same samples ({unit}). It is {decided or 'on no channel significantly different from ray tracing'}"
            f" (95 %). {matched} of {counted(matched + every, 'sample')} have a prediction."
        )


# Heads of the small table.
TABLE = (
    "series", "model", "n", "bias dB", "RMSE dB", "RMSE after offset dB", "RMSE 1 s dB", "correlation", "CRPS dB",
    "inside 90 %", "prediction minus model dB", "95 % low", "95 % high",
)  # fmt: skip


def judged(
    data: FlightData, result: FlightResult, given: Sequence[ForeignPrediction], near_m: float = NEAR_M
) -> list[Verdict]:
    """Score predictions of other programs on a flight.

    Parameters
    ----------
    data : FlightData
    result : FlightResult
        Ours: levels, baselines and ranks at the same samples.
    given : sequence of ForeignPrediction
    near_m : float
        Largest distance between a sample and its predicted position.

    Returns
    -------
    list of Verdict

    Raises
    ------
    InputError
        If none of the predictions of a file is near a sample.
    """
    return [_verdict(prediction, data, result, near_m) for prediction in given]


def _verdict(given: ForeignPrediction, data: FlightData, result: FlightResult, near_m: float) -> Verdict:
    name = given.path.name
    series = [
        s for item in result.rss if given.quantity and (s := _series(given, item, data, name, near_m)) is not None
    ]
    ranks = [r for tower in result.rank if (r := _ranks(given, tower, name, near_m)) is not None]
    if not series and not ranks:
        raise InputError(
            f"fewer than {FEWEST} samples of the flight have a prediction nearby",
            expected="a time within the step of the prediction" if given.timed else f"positions within {near_m:g} m",
            cause=_why_none(given, result),
            path=given.path,
        )
    remarks = list(given.remarks)
    lost = sum(s.unmatched for s in series)
    if series and lost > 0.1 * sum(s.matched + s.unmatched for s in series):
        where = "times" if given.timed else "positions"
        remarks.append(
            f"{name}: {counted(lost, 'sample')} lie outside the {where} of the prediction and are not scored."
        )
    digest = "" if given.path.is_dir() else file_digest(given.path)
    return Verdict(
        name=name,
        sha256=digest,
        program=given.program,
        series=tuple(series),
        ranks=tuple(ranks),
        remarks=tuple(remarks),
    )


def _series(
    given: ForeignPrediction, item: RssResult, data: FlightData, name: str, near_m: float
) -> SeriesVerdict | None:
    part = split_by_series(given.table, item.tower, item.channel)
    part = part[part["time"].notna()] if given.timed else part[part["east_m"].notna()]
    if part.empty:
        return None
    index, near = _nearest(item.time, item.position_m, part, given.timed, near_m)
    near &= item.posed
    chosen = part.iloc[index]
    level = np.where(near, chosen["level"].to_numpy(np.float64), np.nan)
    if given.quantity == "path_loss_db":
        level = _power_dbm(data, item) - level
    scored = near & np.isfinite(level) & np.isfinite(item.measured_db)
    if scored.sum() < FEWEST:
        return None
    absolute = given.quantity == "level_db" or (item.unit == "dBm" and given.quantity == "level_dbm")

    def column(key: str) -> FloatArray | None:
        return np.where(near, chosen[key].to_numpy(np.float64), np.nan) if key in chosen else None

    theirs = PredictedLevel(
        level_db=level, sd_db=column("sd_db"), low_db=column("q05_db"), high_db=column("q95_db"),
        absolute=absolute, asked=near.astype(np.float64),
    )  # fmt: skip
    models = {name: theirs, OURS: PredictedLevel(level_db=item.simulated_dbm, absolute=item.unit == "dBm")}
    models |= {
        BASELINE_TITLE[key]: PredictedLevel(level_db=model.level_dbm, absolute=False)
        for key, model in item.baselines.items()
    }
    seconds = (item.time - item.time[0]) / np.timedelta64(1, "s")
    thresholds = measured_thresholds(item.measured_db[near], ratio=item.unit == "dB")
    rows = near if absolute else scored
    cards, errors = {}, {}
    for key, model in models.items():
        same = rows if key == name else rows & (np.isfinite(level) | ~np.isfinite(item.measured_db))
        if (np.isfinite(model.level_db) & np.isfinite(item.measured_db) & same).sum() < FEWEST:
            continue
        cards[key] = level_card(seconds[same], item.measured_db[same], _part(model, same), thresholds)
        errors[key] = np.where(scored, item.measured_db - model.level_db, np.nan)
    pairs = {key: paired_difference(errors[name], error) for key, error in errors.items() if key != name}
    return SeriesVerdict(
        tower=item.tower, channel=item.channel, unit=item.unit, matched=int((near & item.posed).sum()),
        unmatched=int((item.posed & ~near).sum()), cards=cards, differences=pairs,
        floor_db=detection_floor_db(part["level"].to_numpy(np.float64)),
    )  # fmt: skip


def _part(model: PredictedLevel, rows: BoolArray) -> PredictedLevel:
    """Return the samples ``rows`` of a prediction."""

    def some(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else values[rows]

    return PredictedLevel(
        level_db=model.level_db[rows], sd_db=some(model.sd_db), low_db=some(model.low_db), high_db=some(model.high_db),
        absolute=model.absolute, asked=some(model.asked),
    )  # fmt: skip


def _power_dbm(data: FlightData, item: RssResult) -> float:
    """Transmit power of the link of a series [dBm]."""
    return next(s.link.transmit_power_dbm for s in data.rss if (s.tower, s.channel) == (item.tower, item.channel))


def _nearest(
    time: Any, position_m: FloatArray, part: pd.DataFrame, timed: bool, near_m: float
) -> tuple[IntArray, BoolArray]:
    """Return the nearest predicted row (n,) of each sample, and whether it is near (n,)."""
    if timed:
        known = part["time"].to_numpy("datetime64[ns]")
        order = np.argsort(known, kind="stable")
        at = known[order]
        after = np.clip(np.searchsorted(at, time), 1, len(at) - 1) if len(at) > 1 else np.zeros(len(time), dtype=int)
        before = np.maximum(after - 1, 0)
        closer = np.where(np.abs(at[after] - time) < np.abs(time - at[before]), after, before)
        steps = np.diff(np.unique(at)) / np.timedelta64(1, "s")
        most_s = max(_NEAR_S, 0.51 * float(np.median(steps)) if len(steps) else 0.0)
        apart_s = np.abs(at[closer] - time) / np.timedelta64(1, "s")
        return order[closer], np.asarray(apart_s <= most_s)
    from scipy.spatial import cKDTree

    place = part[["east_m", "north_m", "height_m"]].to_numpy(np.float64)
    posed: BoolArray = np.asarray(np.isfinite(position_m).all(axis=1))
    distance, index = cKDTree(place).query(np.where(posed[:, None], position_m, 0.0))
    return np.asarray(index), np.asarray(posed & (distance <= near_m))


def _ranks(given: ForeignPrediction, item: RankResult, name: str, near_m: float) -> RankVerdict | None:
    if not {"rank", *RANKS} & set(given.table):
        return None
    part = given.table[given.table["tower"] == item.tower]
    part = part[part["time"].notna()] if given.timed else part[part["east_m"].notna()]
    if part.empty:
        return None
    index, near = _nearest(item.time, item.position_m, part, given.timed, near_m)
    chosen, p = part.iloc[index], None
    if set(RANKS) <= set(part):
        p = chosen[list(RANKS)].to_numpy(np.float64)
        predicted = np.where(np.isfinite(p).all(axis=1), np.nan_to_num(p).argmax(axis=1) + 1.0, np.nan)
    if "rank" in part:
        predicted = chosen["rank"].to_numpy(np.float64)
    scored = near & np.isfinite(predicted) & np.isfinite(item.measured) & (item.measured > 0)
    if scored.sum() < FEWEST:
        return None
    best = max(item.rank, key=lambda k: item.score.simulated[k].agreement)
    models = {name: predicted, f"ray tracing, K = {best:g}": item.rank[best].astype(np.float64)}
    measured = item.measured[scored]
    scores = {
        key: {
            "kappa": cohen_kappa(measured, rank[scored]),
            "total_variation": total_variation(histogram(measured), histogram(rank[scored])),
            "agreement": agreement(measured, rank[scored]),
        }
        for key, rank in models.items()
    }
    log_score = constant = None
    if p is not None:
        stated = scored & np.isfinite(p).all(axis=1)
        forecast = score_forecast(item.measured[stated], p[stated], predicted[stated], np.nanmean(p, axis=0))
        log_score, constant = forecast.log_score, forecast.constant_log_score
    return RankVerdict(
        tower=item.tower, matched=int(scored.sum()), unmatched=int((~near).sum()), scores=scores,
        log_score=log_score, constant_log_score=constant,
    )  # fmt: skip


def _why_none(given: ForeignPrediction, result: FlightResult) -> str | None:
    """Return the likely cause if no sample is near a prediction: another time zone, another day, another route."""
    if not given.timed or not result.series:
        return "a prediction of another route or with another height reference; --against-distance widens the search"
    flown = np.concatenate([item.time for item in result.series])
    theirs = given.table["time"].dropna().to_numpy("datetime64[ns]")
    apart_h = float((np.median(theirs.astype(np.int64)) - np.median(flown.astype(np.int64))) / 3.6e12)
    spans = f"predicted {theirs.min()} to {theirs.max()}, flown {flown.min()} to {flown.max()} (UTC)"
    hours = round(apart_h * 2) / 2
    if 0.5 <= abs(hours) <= 14.0 and abs(apart_h - hours) < 0.25:
        return f"another time zone, {hours:+g} h: {spans}"
    return f"another flight: {spans}"
