"""Parameters beyond the offset, fitted on some flights of a campaign and scored on all of them.

Every key has values to try. All combinations are tried, or, of many, one key after the other; the flights that are
scored without a say are named. ``aerpaw-cmp calibrate`` learns patterns and searches between values; this does not.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import prod
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ...common.errors import InputError, UsageError
from ...common.stages import Progress, silent
from ...common.units import FloatArray
from ...compare.offset import grid_offset
from ...compare.result import APPLIED
from ...flight.data import FlightData, choose_site
from ...flight.overrides import overridden
from ...flight.replay import Clock, estimate_clocks, replay_rss
from ...flight.settings import FlightFile, RssSettings, Settings
from ...report.campaign_data import HeldOutFold, HeldOutRow
from ..reporting.levels import levels_of

Point = Mapping[str, Any]
"""Dotted flight key -> value."""

LARGEST_PRODUCT = 500
"""Combinations that are all tried; of more, one parameter after the other is searched."""

NO_EFFECT_DB = 0.01
"""A parameter that moves the RMSE by less did not fit anything."""

SWEEPS = 6
"""Rounds over all parameters, at most; it ends earlier when a round changes nothing."""


class HeldOutSettings(Settings):
    """Parameters that are fitted on some flights and scored on all."""

    fit: Annotated[dict[str, list[float] | list[list[float]]], Field(min_length=1)]
    """Dotted flight key -> values to try, increasing. Keys below ``link``, ``rt`` or ``site``, or ``rss.lag``; for rank
    also ``rank.k``, and lists as values (slants)."""
    criterion: Literal["rmse", "kappa", "log_score", "total_variation"] = "rmse"
    """What the fit lowers or raises: the RMSE of RSS, or a number of the reported rank."""
    fit_on: list[str] | None = None
    """Names of the flights to fit on; without it each flight is left out once."""
    setting: str | None = None
    """Label of the setting that the fit starts from; by default the first."""
    samples: Annotated[int, Field(ge=50)] = 1000
    """Evenly spread samples per series that the search looks at; all of them are scored."""


# --- the search -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Search:
    """Points that were tried with their losses, least first, and how they were chosen."""

    tried: tuple[tuple[dict[str, Any], float], ...]
    method: str

    @property
    def point(self) -> dict[str, Any]:
        """The best one."""
        return self.tried[0][0]


def search(loss: Callable[[Point], float], grids: Mapping[str, Sequence[Any]]) -> Search:
    """Least loss over all combinations of values; of more than :data:`LARGEST_PRODUCT`, key by key from three starts.

    A loss that is not finite is never the least one.
    """
    known: dict[str, tuple[dict[str, Any], float]] = {}

    def tried(point: dict[str, Any]) -> float:
        name = json.dumps(point, sort_keys=True)
        if name not in known:
            known[name] = dict(point), float(np.nan_to_num(loss(point), nan=np.inf))
        return known[name][1]

    if prod(len(values) for values in grids.values()) <= LARGEST_PRODUCT:
        for combination in product(*grids.values()):
            tried(dict(zip(grids, combination, strict=True)))
        method = "every combination"
    else:
        for share in (0.25, 0.5, 0.75):
            _by_key(tried, grids, {name: values[int(share * (len(values) - 1))] for name, values in grids.items()})
        method = "one parameter after the other, three starts"
    return Search(tuple(sorted(known.values(), key=lambda row: row[1])), method)


def _by_key(
    tried: Callable[[dict[str, Any]], float], grids: Mapping[str, Sequence[Any]], point: dict[str, Any]
) -> None:
    """Try the values of one key after the other, the others held, until a round changes nothing."""
    for _ in range(SWEEPS):
        before = dict(point)
        for name, values in grids.items():
            point[name] = min(values, key=lambda value: tried({**point, name: value}))
        if point == before:
            return


def fitted_folds(
    kind: str,
    names: Sequence[str],
    settings: HeldOutSettings,
    loss: Callable[[Sequence[str], Point], float],
    progress: Progress,
) -> Iterator[tuple[list[str], list[str], Search]]:
    """The fit on the named flights, or, without names, on all but one, each left out in turn.

    Parameters
    ----------
    kind : {"RSS", "rank"}
        What is fitted.
    names : sequence of str
        Flights that gave it; other names in ``fit_on`` are passed over.
    settings : HeldOutSettings
    loss : callable
        Of training flights at a point.
    progress : Progress

    Yields
    ------
    train, test, search
        Names of the flights of the fit, names of the others, and what was found.

    Raises
    ------
    UsageError
        No flight to fit on, or too few to leave one out.
    InputError
        No sample could be compared under any of the values.
    """
    if settings.fit_on is None:
        if len(names) < 2:
            raise UsageError(f"{len(names)} flights with {kind}", expected="two or more, to leave one out at a time")
        trainings = [[name for name in names if name != left] for left in names]
    else:
        trainings = [[name for name in settings.fit_on if name in names]]
        if not trainings[0]:
            known = ", ".join(names) or "none has"
            raise UsageError(f"no flight of held_out.fit_on gave {kind}", expected=f"a flight that has {kind}: {known}")
    for train in trainings:
        progress(f"held-out {kind}: fit on " + ", ".join(train))
        found = search(lambda point, train=train: loss(train, point), settings.fit)  # type: ignore[misc]
        if not np.isfinite(found.tried[0][1]):
            raise InputError(
                f"nothing can be fitted on {', '.join(train)}",
                expected=f"samples of {kind} that are measured and simulated under some of the values",
                cause="no coverage, no positions, a minimum height above the flight, or values far off",
            )
        yield train, [name for name in names if name not in train], found


# --- RSS ------------------------------------------------------------------------------------------------------------


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
        """Residuals of all series, each with its own best offset."""
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


def own_residual_db(measured_db: FloatArray, simulated_db: FloatArray, rules: RssSettings) -> FloatArray:
    """Measured minus simulated after the best offset of these very samples (n,)."""
    fit = grid_offset(measured_db, simulated_db, step_db=rules.advanced.step_db, span_db=rules.span_db)
    return measured_db + fit.offset_db - simulated_db


def bench_of(data: FlightData) -> Bench:
    """Prepare a flight: clocks once, samples that are too low or without a pose left out."""
    settings = data.settings.rss
    applies = settings.lag == "apply" or isinstance(settings.lag, float)
    clocks: list[Clock | None] = estimate_clocks(data, silent) if applies else [None] * len(data.rss)
    replays = zip(data.rss, replay_rss(data, silent, clocks), strict=True)
    measured = [levels_of(series, replayed, settings).measured_db for series, replayed in replays]
    return Bench(data, clocks, measured)


def fit_all(
    flights: Mapping[str, FlightData], settings: HeldOutSettings, setting: str = "", progress: Progress = silent
) -> list[HeldOutFold]:
    """Least mean over flights of the mean square residual.

    Parameters
    ----------
    flights : mapping of str to FlightData
        Flights with RSS, by name.
    settings : HeldOutSettings
    setting : str
        Label, for the record.
    progress : Progress

    Returns
    -------
    list of HeldOutFold
        One with ``fit_on``, else one per flight, which is left out of it.

    Raises
    ------
    UsageError, InputError
        As :func:`fitted_folds`.
    """
    full = {name: bench_of(data) for name, data in flights.items()}
    few = {name: bench.thinned(settings.samples) for name, bench in full.items()}
    grids: Mapping[str, Sequence[Any]] = settings.fit

    def loss(train: Sequence[str], point: Point) -> float:
        return float(np.mean([rmse(few[name].residual_db(point)) ** 2 for name in train]))

    folds = []
    for train, test, found in fitted_folds("RSS", list(flights), settings, loss, progress):
        curves = _curves(few, grids, found.point)
        ends = {name: (values[0], values[-1]) for name, values in grids.items() if len(values) > 1}
        folds.append(
            HeldOutFold(
                setting=setting,
                fitted_on=tuple(train),
                applied_to=tuple(test),
                parameters=found.point,
                at_bounds=tuple(n for n, v in ends.items() if found.point[n] in v and not _round(n, grids[n])),
                evaluations=len(found.tried) * len(train),
                method=found.method,
                rows=tuple(_scores(full, found.point, train, test)),
                without_effect=tuple(
                    n for n, by in curves.items() if all(np.ptp(by[name][1]) < NO_EFFECT_DB for name in train)
                ),
                curves=curves,
            )
        )
    return folds


def rmse(residual_db: FloatArray) -> float:
    """Root mean square without NaN; NaN if nothing is left."""
    values = residual_db[np.isfinite(residual_db)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _round(name: str, values: Sequence[float]) -> bool:
    return name.endswith("yaw_deg") and goes_round(values)


def goes_round(values: Sequence[float] | FloatArray) -> bool:
    """Check whether increasing angles [deg] cover the circle: the gap from last to first is no wider than another."""
    angles = np.asarray(values, dtype=np.float64)
    if len(angles) < 3:
        return False
    gap = 360.0 - (angles[-1] - angles[0])
    return bool(0.0 <= gap <= np.diff(angles).max() * (1.0 + 1e-9))


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
                    np.zeros(len(difference)), difference, step_db=rules.advanced.step_db, span_db=rules.span_db
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
