"""Parameters beyond the offset, fitted on some flights of a campaign and scored on all of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import prod
from typing import Any

import numpy as np

from ..common.errors import InputError, UsageError
from ..common.stages import Progress, silent
from ..common.units import FloatArray
from ..compare.heldout import fit_held_out, goes_round, rmse
from ..compare.offset import grid_offset
from ..compare.result import APPLIED
from ..flight.data import FlightData, choose_site
from ..flight.overrides import overridden
from ..flight.replay import Clock, estimate_clocks, replay_rss
from ..flight.settings import FlightFile, RssSettings
from ..report.campaign_data import HeldOutFold, HeldOutRow
from .levels import levels_of

Point = Mapping[str, float]

Spread = Callable[[Mapping[str, Sequence[Point]]], dict[str, list[float]]]
"""RMSE [dB] of points by flight, in their order."""

LARGEST_PRODUCT = 500
"""Combinations that are all tried; of more, one parameter after the other is searched."""

NO_EFFECT_DB = 0.01
"""A parameter that moves the RMSE by less did not fit anything."""

SWEEPS = 6
"""Rounds over all parameters, at most; it ends earlier when a round changes nothing."""


@dataclass(slots=True)
class Bench:
    """One flight, ready to be replayed with other parameters again and again.

    ``data`` holds the series as they are scored, ``measured_db`` their levels with unscored samples NaN; levels once
    simulated are kept, so a parameter of one channel does not cost the other channel a replay.
    """

    data: FlightData
    clocks: list[Clock | None]
    measured_db: list[FloatArray]
    kept: dict[tuple[int, str], FloatArray] = field(default_factory=dict)
    known: dict[tuple[tuple[str, float], ...], float] = field(default_factory=dict)
    """RMSE [dB] of points that workers computed."""

    def simulated(self, point: Point) -> list[FloatArray]:
        """Simulated level (n,) [dB] of every series with these parameters."""
        settings = overridden(self.data.settings, point)
        common = settings.rt.model_dump_json() + settings.site.model_dump_json() + str(settings.rss.lag)
        series = [
            dataclasses.replace(s, link=link, settings_key=link.model_dump_json())
            for s in self.data.rss
            for link in [settings.link.channels.get(s.channel, settings.link.rss)]
        ]
        keys = [(i, s.settings_key + common) for i, s in enumerate(series)]
        new = [i for i, key in enumerate(keys) if key not in self.kept]
        if new:
            data = self._changed(settings, [series[i] for i in new])
            # a lag that is tried stands in place of what the flight file says
            clocks = estimate_clocks(data, silent) if "rss.lag" in point else [self.clocks[i] for i in new]
            for i, replayed in zip(new, replay_rss(data, silent, clocks), strict=True):
                self.kept[keys[i]] = levels_of(series[i], replayed, settings.rss).simulated_db
        return [self.kept[key] for key in keys]

    def _changed(self, settings: FlightFile, series: list[Any]) -> FlightData:
        site = self.data.site
        if settings.site != self.data.settings.site:
            site = choose_site(settings.site, self.data.folder)
        return dataclasses.replace(self.data, settings=settings, site=site, rss=tuple(series))

    def residual_db(self, point: Point) -> FloatArray:
        """Residuals of all series, each with its own best offset; of a known point, their RMSE alone."""
        known = self.known.get(_named(point))
        if known is not None:
            return np.array([known])
        pairs = zip(self.measured_db, self.simulated(point), strict=True)
        return np.concatenate([own_residual_db(m, s, self.data.settings.rss) for m, s in pairs])

    def thinned(self, samples: int) -> Bench:
        """Evenly spread samples of every series."""
        picked = [
            np.unique(np.linspace(0, len(s.time) - 1, min(samples, len(s.time))).astype(int)) for s in self.data.rss
        ]
        series = [
            dataclasses.replace(s, time=s.time[i], measured_db=s.measured_db[i])
            for s, i in zip(self.data.rss, picked, strict=True)
        ]
        clocks = [
            None if c is None else dataclasses.replace(c, applied_s=c.applied_s[i])
            for c, i in zip(self.clocks, picked, strict=True)
        ]
        measured = [m[i] for m, i in zip(self.measured_db, picked, strict=True)]
        return Bench(dataclasses.replace(self.data, rss=tuple(series)), clocks, measured)


def _named(point: Point) -> tuple[tuple[str, float], ...]:
    return tuple(sorted((name, float(value)) for name, value in point.items()))


def _combinations(grids: Mapping[str, Sequence[float]]) -> int:
    return prod(len(values) for values in grids.values())


def own_residual_db(measured_db: FloatArray, simulated_db: FloatArray, rules: RssSettings) -> FloatArray:
    """Measured minus simulated after the best offset of these very samples (n,)."""
    fit = grid_offset(measured_db, simulated_db, step_db=rules.step_db, span_db=rules.span_db)
    return measured_db + fit.offset_db - simulated_db


def bench_of(data: FlightData) -> Bench:
    """Prepare a flight: clocks once, samples that are too low or without a pose left out."""
    settings = data.settings.rss
    applies = settings.lag == "apply" or isinstance(settings.lag, float)
    clocks: list[Clock | None] = estimate_clocks(data, silent) if applies else [None] * len(data.rss)
    replays = zip(data.rss, replay_rss(data, silent, clocks), strict=True)
    measured = [levels_of(series, replayed, settings).measured_db for series, replayed in replays]
    return Bench(data, clocks, measured)


def training_sets(names: Sequence[str], fit_on: Sequence[str] | None, kind: str) -> list[list[str]]:
    """Flights of each fit: those that are named and gave ``kind`` (RSS, rank), or all but one, each in turn.

    Raises
    ------
    UsageError
        No flight to fit on, or too few to leave one out.
    """
    if fit_on is None:
        if len(names) < 2:
            raise UsageError(f"{len(names)} flights with {kind}", expected="two or more, to leave one out at a time")
        return [[name for name in names if name != left] for left in names]
    chosen = [name for name in fit_on if name in names]
    if not chosen:
        known = ", ".join(names) or "none has"
        raise UsageError(f"no flight of held_out.fit_on gave {kind}", expected=f"a flight that has {kind}: {known}")
    return [chosen]


def fit_all(
    flights: Mapping[str, FlightData],
    grids: Mapping[str, Sequence[float]],
    fit_on: Sequence[str] | None,
    *,
    setting: str = "",
    samples: int = 1000,
    refine: bool = False,
    progress: Progress = silent,
    spread: Spread | None = None,
) -> list[HeldOutFold]:
    """Fit on the named flights, or leave each flight out once.

    Parameters
    ----------
    flights : mapping of str to FlightData
        Flights with RSS, by name.
    grids : mapping of str to sequence of float
        Values to try, by dotted flight key.
    fit_on : sequence of str, optional
        Names; those that are not in ``flights`` (they failed) are passed over.
    setting : str
        Label, for the record.
    samples : int
        Evenly spread samples per series that the search looks at; all are scored.
    refine : bool
        Search between the values, too.
    spread : callable, optional
        Computes the errors of all combinations of values, flight by flight, on workers: the same numbers, sooner.
    progress : Progress
        Gets what is fitted.

    Returns
    -------
    list of HeldOutFold
        One with ``fit_on``, else one per flight, which is left out of it.

    Raises
    ------
    UsageError
        No flight to fit on, or too few to leave one out.
    InputError
        A flight of the fit has no sample that could be compared.
    """
    names, trainings = list(flights), training_sets(list(flights), fit_on, "RSS")
    full = {}
    for name, data in flights.items():
        progress(f"held-out: prepare {name}")
        full[name] = bench_of(data)
    few = {name: bench.thinned(samples) for name, bench in full.items()}
    if spread is not None and _combinations(grids) <= LARGEST_PRODUCT:
        progress(f"held-out: {_combinations(grids)} combinations of values on the workers")
        points = [dict(zip(grids, map(float, values), strict=True)) for values in product(*grids.values())]
        for name, errors in spread(
            dict.fromkeys(dict.fromkeys(n for train in trainings for n in train), points)
        ).items():
            few[name].known.update(zip(map(_named, points), errors, strict=True))
    folds = []
    for train in trainings:
        progress("held-out: fit on " + ", ".join(train))
        test = [name for name in names if name not in train]
        try:
            optimum = search(few, grids, train, refine=refine)
        except ValueError as error:
            raise InputError(
                f"nothing can be fitted on {', '.join(train)}: {error}",
                expected="samples that are measured and simulated under some of the values",
                cause="no coverage, or values far off",
            ) from None
        curves = _curves(few, grids, optimum.parameters)
        flat = [n for n, by in curves.items() if all(np.ptp(by[f][1]) < NO_EFFECT_DB for f in train)]
        folds.append(
            HeldOutFold(
                setting=setting,
                fitted_on=tuple(train),
                applied_to=tuple(test),
                parameters=optimum.parameters,
                at_bounds=optimum.at_bounds,
                evaluations=optimum.evaluations,
                method=optimum.method,
                rows=tuple(_scores(full, optimum.parameters, train, test)),
                without_effect=tuple(flat),
                curves=curves,
            )
        )
    return folds


@dataclass(frozen=True, slots=True)
class Search:
    """What a search found, how, and in how many evaluations of a flight."""

    parameters: dict[str, float]
    at_bounds: tuple[str, ...]
    evaluations: int
    method: str


def search(
    benches: Mapping[str, Bench], grids: Mapping[str, Sequence[float]], train: Sequence[str], *, refine: bool
) -> Search:
    """Least mean square residual over the training flights, mean over flights.

    All combinations of values are tried up to :data:`LARGEST_PRODUCT`; beyond, one parameter after the other from
    three starts (the quartiles of every list), until a round changes nothing.

    Parameters
    ----------
    benches : mapping of str to Bench
        Flights by name.
    grids : mapping of str to sequence of float
        Values to try, increasing, by dotted flight key.
    train : sequence of str
        Names of the flights to fit on.
    refine : bool
        Search between the values, too (where all combinations are tried).

    Returns
    -------
    Search
        The best values, those at the end of their list, and how many points were looked at.
    """

    def objective(point: Mapping[str, float], flight: str) -> FloatArray:
        return benches[flight].residual_db(point)

    circular = [name for name, values in grids.items() if name.endswith("yaw_deg") and goes_round(values)]
    if _combinations(grids) <= LARGEST_PRODUCT:
        fit = fit_held_out(objective, grids, train, refine=refine, circular=circular)
        return Search(dict(fit.parameters), fit.at_bounds, fit.evaluations, "every combination")
    calls, best = 0, (np.inf, {name: float(v[0]) for name, v in grids.items()})
    for share in (0.25, 0.5, 0.75):
        point = {name: float(v[int(share * (len(v) - 1))]) for name, v in grids.items()}
        for _ in range(SWEEPS):
            before = dict(point)
            for name, values in grids.items():
                others = {key: [value] for key, value in point.items() if key != name}
                fit = fit_held_out(objective, {name: values, **others}, train, refine=False)
                point = {key: fit.parameters[key] for key in point}
                calls += fit.evaluations
            if point == before:
                break
        score = float(np.mean([rmse(objective(point, flight)) ** 2 for flight in train]))
        if score < best[0]:
            best = (score, point)
    edge = tuple(
        n for n, v in grids.items() if len(v) > 1 and n not in circular and best[1][n] in (float(v[0]), float(v[-1]))
    )
    return Search(best[1], edge, calls, "one parameter after the other, three starts")


def _scores(benches: Mapping[str, Bench], point: Point, train: list[str], test: list[str]) -> list[HeldOutRow]:
    """Each series with parameters as written and as fitted; elsewhere also with the offset of the training flights."""
    levels = {name: (bench.simulated({}), bench.simulated(point)) for name, bench in benches.items()}
    learned: dict[tuple[str, str], list[FloatArray]] = {}
    for name in train:
        for i, series in enumerate(benches[name].data.rss):
            learned.setdefault((series.tower, series.channel), []).append(
                levels[name][1][i] - benches[name].measured_db[i]
            )
    rows = []
    for name in (*train, *test):
        bench = benches[name]
        rules = bench.data.settings.rss
        for i, series in enumerate(bench.data.rss):
            measured, start, fitted = bench.measured_db[i], levels[name][0][i], levels[name][1][i]
            offset = float("nan")
            if name in test and (series.tower, series.channel) in learned:
                difference = np.concatenate(learned[series.tower, series.channel])
                offset = grid_offset(
                    np.zeros(len(difference)), difference, step_db=rules.step_db, span_db=rules.span_db
                ).offset_db
            rows.append(
                HeldOutRow(
                    flight=name,
                    tower=series.tower,
                    channel=series.channel,
                    fitted_here=name in train,
                    n=int((np.isfinite(measured) & np.isfinite(fitted)).sum()),
                    start_rmse_db=rmse(own_residual_db(measured, start, bench.data.settings.rss)),
                    rmse_db=rmse(own_residual_db(measured, fitted, bench.data.settings.rss)),
                    transferred_offset_db=offset,
                    transferred_rmse_db=rmse(measured + offset - fitted),
                    own=("offset_db", *_own_lag(bench.clocks[i], point)),
                )
            )
    return rows


def _own_lag(clock: Clock | None, point: Point) -> tuple[str, ...]:
    """``lag_s`` where a lag that was estimated on these very samples has been applied."""
    estimated = clock is not None and clock.result.applied == APPLIED and "rss.lag" not in point
    return ("lag_s",) if estimated else ()


def _curves(
    benches: Mapping[str, Bench], grids: Mapping[str, Sequence[float]], point: Point
) -> dict[str, dict[str, tuple[FloatArray, FloatArray]]]:
    """RMSE of every flight along each parameter, the others as fitted."""
    out: dict[str, dict[str, tuple[FloatArray, FloatArray]]] = {}
    for name, values in grids.items():
        tried = np.asarray(values, dtype=np.float64)
        out[name] = {
            flight: (tried, np.array([rmse(bench.residual_db({**point, name: float(v)})) for v in tried]))
            for flight, bench in benches.items()
        }
    return out
