"""Parameters of the rank comparison (mount, slants, ground, K), fitted on some flights and scored on others."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...common.stages import Progress, silent
from ...common.units import FloatArray, IntArray
from ...compare import rank as ranks
from ...compare.forecast import constant_forecast, log_losses
from ...compare.statistics import paired_difference
from ...flight.data import FlightData, choose_site
from ...flight.overrides import overridden
from ...flight.replay import replay_rank
from ...report.campaign_data import RankHeldOutFold, RankHeldOutRow
from .campaign_fit import HeldOutSettings, Point, Search, fitted_folds

K_KEY = "rank.k"
"""The one key of the fit that is no key of a replay: a single singular-value ratio."""

FINALISTS = 40
"""Combinations that are compared with the best one by one: what cannot be told from it is listed."""

MAX_RANK = ranks.MAX_RANK


@dataclass(slots=True)
class RankBench:
    """One flight, ready to be replayed with other parameters; singular values once computed are kept."""

    data: FlightData
    kept: dict[str, list[FloatArray]] = field(default_factory=dict)

    def singular_values(self, point: Point) -> list[FloatArray]:
        """Of every rank series (n, min(n_rx, n_tx)); NaN without a pose or below ``rank.minimum_height_m``."""
        changes = {key: value for key, value in point.items() if key != K_KEY}
        name = json.dumps(changes, sort_keys=True)
        if name not in self.kept:
            settings = overridden(self.data.settings, changes)
            site = self.data.site
            if settings.site != self.data.settings.site:
                site = choose_site(settings.site, self.data.folder)
            data = dataclasses.replace(self.data, settings=settings, site=site)
            low = settings.rank.minimum_height_m
            self.kept[name] = []
            for replayed in replay_rank(data, silent):
                sigma = ranks.singular_values(replayed.replay.h[:, 0])
                if low is not None:
                    sigma = np.where(replayed.poses.position_m[:, 2:] >= low, sigma, np.nan)
                whole = np.full((len(replayed.valid), sigma.shape[1]), np.nan)
                whole[replayed.valid] = sigma
                self.kept[name].append(whole)
        return self.kept[name]

    def pairs(self, point: Point) -> tuple[IntArray, IntArray]:
        """Reported and simulated ranks of all series where both are known (n,), one to :data:`MAX_RANK`."""
        k = float(point.get(K_KEY, min(self.data.settings.rank.k)))
        reported, simulated = [], []
        for series, sigma in zip(self.data.rank, self.singular_values(point), strict=True):
            known = np.isfinite(sigma).all(axis=1) & (series.rank >= 1)
            said = ranks.rank_from_singular_values(sigma[known], k)
            reported.append(series.rank[known][said >= 1])
            simulated.append(said[said >= 1])
        joined = (np.concatenate(part) if part else np.zeros(0) for part in (reported, simulated))
        reported_rank, simulated_rank = (np.minimum(part, MAX_RANK).astype(np.int64) for part in joined)
        return reported_rank, simulated_rank

    def thinned(self, samples: int) -> RankBench:
        """Evenly spread reports of every series."""
        series = []
        for item in self.data.rank:
            rows = np.unique(np.linspace(0, len(item.time) - 1, min(samples, len(item.time))).astype(int))
            position = None if item.position_m is None else item.position_m[rows]
            series.append(
                dataclasses.replace(
                    item, time=item.time[rows], rank=item.rank[rows], sinr_db=item.sinr_db[rows], position_m=position
                )
            )
        return RankBench(dataclasses.replace(self.data, rank=tuple(series)))


def shares_by_rank(reported: IntArray, simulated: IntArray) -> FloatArray:
    """Probability (4, 4) of each reported rank, by the simulated one: counts plus the overall shares as one report."""
    table = np.zeros((MAX_RANK, MAX_RANK))
    np.add.at(table, (simulated - 1, reported - 1), 1.0)
    table += constant_forecast(reported)
    return np.asarray(table / table.sum(axis=1, keepdims=True))


def loss(benches: Sequence[RankBench], point: Point, criterion: str) -> float:
    """Loss that the search lowers, mean over flights: 1 - kappa, total variation, or the log score [nats]."""
    pairs = [bench.pairs(point) for bench in benches]
    pairs = [(reported, simulated) for reported, simulated in pairs if len(reported)]
    if not pairs:
        return float("nan")
    if criterion == "kappa":
        each = [1.0 - np.nan_to_num(ranks.cohen_kappa(reported, simulated)) for reported, simulated in pairs]
    elif criterion == "total_variation":
        each = [
            ranks.total_variation(ranks.histogram(reported), ranks.histogram(simulated))
            for reported, simulated in pairs
        ]
    else:
        each = [float(np.mean(_log_losses(pairs, i))) for i in range(len(pairs))]
    return float(np.mean(each))


def _log_losses(pairs: Sequence[tuple[IntArray, IntArray]], scored: int) -> FloatArray:
    """Of one flight, by the table of the others; of a flight alone by its own."""
    others = [pair for i, pair in enumerate(pairs) if i != scored] or [pairs[scored]]
    table = shares_by_rank(*_joined(others))
    reported, simulated = pairs[scored]
    return log_losses(table[simulated - 1], reported)


def fit_rank_all(
    flights: Mapping[str, FlightData], settings: HeldOutSettings, setting: str = "", progress: Progress = silent
) -> list[RankHeldOutFold]:
    """Fit on the named flights, or leave each flight out once.

    Parameters
    ----------
    flights : mapping of str to FlightData
        Flights with rank, by name.
    settings : HeldOutSettings
        The log score takes the shares of reported ranks per simulated rank from the other flights of the fit.
    setting : str
        Label, for the record.
    progress : Progress

    Returns
    -------
    list of RankHeldOutFold
        One with ``fit_on``, else one per flight, which is left out of it.

    Raises
    ------
    UsageError, InputError
        As :func:`~aerpaw_cmp.jobs.campaigns.campaign_fit.fitted_folds`.
    """
    full = {name: RankBench(data) for name, data in flights.items()}
    few = {name: bench.thinned(settings.samples) for name, bench in full.items()}

    def lost(train: Sequence[str], point: Point) -> float:
        return loss([few[name] for name in train], point, settings.criterion)

    return [
        RankHeldOutFold(
            setting=setting,
            criterion=settings.criterion,
            fitted_on=tuple(train),
            applied_to=tuple(test),
            parameters=found.point,
            evaluations=len(found.tried),
            method=found.method,
            ties=tuple(_ties([few[name] for name in train], found)),
            rows=tuple(_rows(full, train, test, found.point)),
        )
        for train, test, found in fitted_folds("rank", list(flights), settings, lost, progress)
    ]


def _ties(benches: Sequence[RankBench], optimum: Search) -> list[dict[str, Any]]:
    """Other points whose misses cannot be told from those of the best one, on the flights of the fit."""

    def misses(point: Point) -> list[FloatArray]:
        out = []
        for bench in benches:
            k = float(point.get(K_KEY, min(bench.data.settings.rank.k)))
            for series, sigma in zip(bench.data.rank, bench.singular_values(point), strict=True):
                known = np.isfinite(sigma).all(axis=1) & (series.rank >= 1)
                said = ranks.rank_from_singular_values(np.nan_to_num(sigma), k)
                out.append(np.where(known, (said != series.rank).astype(np.float64), np.nan))
        return out

    best = np.concatenate(misses(optimum.point))
    same = []
    for point, _ in optimum.tried[1:FINALISTS]:
        difference = paired_difference(np.concatenate(misses(point)), best)
        if difference.verdict != "worse":
            same.append(point)
    return same


def _rows(
    full: Mapping[str, RankBench], train: Sequence[str], test: Sequence[str], point: Point
) -> list[RankHeldOutRow]:
    """Each flight as written and as fitted; shares and commonest rank always of the flights of the fit."""
    points: dict[str, Point] = {"start": {}, "fit": point}
    tables = {label: shares_by_rank(*_joined([full[name].pairs(at) for name in train])) for label, at in points.items()}
    fitted, _ = _joined([full[name].pairs(point) for name in train])
    constant, commonest = constant_forecast(fitted), int(np.bincount(fitted).argmax())
    rows = []
    for name in (*train, *test):
        reported, _ = full[name].pairs(point)
        flat = np.tile(constant, (len(reported), 1))
        scores: dict[str, Any] = {}
        for label, at in points.items():
            scores |= _scores(label, *full[name].pairs(at), tables[label])
        rows.append(
            RankHeldOutRow(
                flight=name,
                fitted_here=name in train,
                n=len(reported),
                majority_agreement=_mean(reported == commonest),
                constant_log_score=_mean(log_losses(flat, reported)),
                **scores,
            )
        )
    return rows


def _joined(pairs: Sequence[tuple[IntArray, IntArray]]) -> tuple[IntArray, IntArray]:
    reported, simulated = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return reported, simulated


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _scores(label: str, reported: IntArray, simulated: IntArray, table: FloatArray) -> dict[str, float]:
    """Numbers of one flight at one point, by the names of the row."""
    shares = (ranks.histogram(part) for part in (reported, simulated))
    return {
        f"{label}_kappa": ranks.cohen_kappa(reported, simulated),
        f"{label}_agreement": ranks.agreement(reported, simulated),
        f"{label}_total_variation": ranks.total_variation(*shares),
        f"{label}_log_score": _mean(log_losses(table[simulated - 1], reported)),
    }
